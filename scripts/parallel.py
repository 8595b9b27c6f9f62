#!/usr/bin/env python3
"""Wall clock of one job on 1, 2 and 4 workers, and what it costs that some stages have one task.

    scripts/parallel.py [--cells 8x4] [--workers 1,2,4] [--share 0.4] [--iterations 20] [--json]

Trains a synthetic reef in 32 cells once for each number of workers. Every worker is a process with the same
share of a core (a quota of Linux' control groups), so that four workers are four times as fast as one on a
machine of two cores. Second attempts of slow tasks are off.

The wall clock is the sum of all stages, from the plan to the evaluation. The best schedule of a run is
computed from its own task times: each stage lasts at least as long as its longest task, and as the sum of its
tasks over the workers.

From the run with one worker follows what serial stages cost with 4 to 256 workers, for a scene with four
cells for each worker. Partitions take as long as they were measured to take, in the order in which they are
assigned; the coarse model is trained once; plan, merge and evaluation grow with the cells. The evaluation is
computed as one task and in parts.

Needs root, for the quotas; ends with 3 where control groups may not be changed.
"""

import argparse
import heapq
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
PERIOD_US = 20_000
# Cells for each worker in the forecast, and the numbers of workers.
CELLS_OF_A_WORKER = 4
FORECAST = (4, 16, 64, 256)
# Held-out views that one task evaluates by default (partition.evaluation_views).
VIEWS_OF_A_TASK = 64


def fail(message):
    sys.exit(f"parallel: {message}")


class Quota:
    """A control group whose processes share a part of a core."""

    def __init__(self, name, share):
        first, second = pathlib.Path("/sys/fs/cgroup/cpu"), pathlib.Path("/sys/fs/cgroup")
        is_first = (first / "cpu.cfs_quota_us").exists() or (first / "cpu.shares").exists()
        self.folder = (first if is_first else second) / f"fathom-{os.getpid()}-{name}"
        quota = int(share * PERIOD_US)
        try:
            self.folder.mkdir()
            if is_first:
                (self.folder / "cpu.cfs_period_us").write_text(str(PERIOD_US))
                (self.folder / "cpu.cfs_quota_us").write_text(str(quota))
            else:
                (self.folder / "cpu.max").write_text(f"{quota} {PERIOD_US}")
        except OSError as error:
            print(f"parallel: {self.folder}: {error}; run it as root where control groups may be changed",
                  file=sys.stderr)
            sys.exit(3)

    def enter(self):
        (self.folder / "cgroup.procs").write_text(str(os.getpid()))

    def remove(self):
        for _ in range(50):
            try:
                self.folder.rmdir()
                return
            except OSError:
                time.sleep(0.1)


def program():
    found = subprocess.run(
        ["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=ROOT, capture_output=True, check=True
    )
    path = pathlib.Path(json.loads(found.stdout)["target_directory"]) / "debug/fathom"
    return str(path) if path.exists() else fail(f"{path} is missing; run `make build`")


def ask(words):
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        fail(f"{' '.join(words)}: {ended.stderr.strip()}")
    return ended.stdout


def ended(fathom, url, job):
    """The job, once it has succeeded."""
    while True:
        shown = json.loads(ask([fathom, "show", job, "--coordinator", url, "--json"]))
        if shown["state"] not in ("running", "paused"):
            break
        time.sleep(1)
    if shown["state"] != "succeeded":
        fail(f"the job is {shown['state']}: {shown['error']}")
    return shown


def measure(fathom, scene, folder, workers, options):
    """One run: its tasks with their seconds, and the wall clock of its stages."""
    data = folder / f"data-{workers}"
    command = [fathom, "coordinator", "--stop-with-stdin", "--listen", "127.0.0.1:0", "--straggler-factor", "0",
               "--data-dir", str(data)]
    coordinator = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   stderr=subprocess.DEVNULL, text=True)
    quotas, running = [], []
    try:
        url = coordinator.stdout.readline().split()[-1]
        for number in range(workers):
            quota = Quota(f"{workers}-{number}", options.share)
            quotas.append(quota)
            running.append(subprocess.Popen(
                [fathom, "worker", "--allow-cpu", "--coordinator", url, "--name", f"worker-{number}",
                 "--cache-dir", str(folder / f"cache-{number}")],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=quota.enter,
                env=os.environ | {"LP_NUM_THREADS": "1"}))
        deadline = time.time() + 120
        while len(json.loads(ask([fathom, "worker", "list", "--coordinator", url, "--json"]))) < workers:
            if time.time() > deadline:
                fail("the workers do not register")
            time.sleep(0.2)
        submit = [fathom, "submit", str(scene), "--coordinator", url, "--max-gaussians", "8000"]
        # A driver compiles the kernels in the first task of a worker, for minutes on a CPU.
        first = [ask([*submit, "--iterations", "1", "--test-every", "0"]).strip() for _ in range(workers)]
        for job in first:
            ended(fathom, url, job)
        job = ask([*submit, "--partitions", options.cells, "--iterations", str(4 * options.iterations), "--set",
                   "train.checkpoint_seconds=600", "--set", "partition.global_least_iterations=1", "--set",
                   f"partition.iterations_per_partition={options.iterations}"]).strip()
        shown = ended(fathom, url, job)
        out = folder / f"out-{workers}"
        ask([fathom, "download", job, "--coordinator", url, "-o", str(out)])
    finally:
        for worker in running:
            worker.send_signal(signal.SIGTERM)
        for worker in running:
            worker.wait()
        coordinator.stdin.close()
        coordinator.wait()
        for quota in quotas:
            quota.remove()
    stages = json.loads((out / "metrics.json").read_text())["seconds"]
    tasks = [(task["stage"], task["seconds"]) for task in shown["tasks"]]
    seconds = {stage: value for stage, value in stages.items() if stage != "ingest"}
    return {"workers": workers, "tasks": tasks, "stages": seconds, "wall": sum(seconds.values())}


def of_stages(tasks):
    stages = {}
    for stage, seconds in tasks:
        if stage != "artifacts":
            stages.setdefault(stage, []).append(seconds)
    return stages


def best(tasks, workers):
    """Seconds that the tasks need at least: no schedule is shorter."""
    return sum(max(max(times), sum(times) / workers) for times in of_stages(tasks).values())


def assigned(times, workers):
    """Seconds of a stage whose tasks are taken in this order by the worker that is free first."""
    free = [0.0] * workers
    for seconds in times:
        heapq.heapreplace(free, free[0] + seconds)
    return max(free)


def forecast(run, views):
    """Rows of the forecast: for each number of workers the stages' shares of the wall clock."""
    stages = of_stages(run["tasks"])
    cells = len(stages["partition"])
    mean = lambda stage: sum(stages.get(stage, [])) / max(len(stages.get(stage, [])), 1)
    per_view = sum(stages.get("evaluate", [0.0])) / max(views, 1)
    rows = []
    for workers in FORECAST:
        count = CELLS_OF_A_WORKER * workers
        times = (stages["partition"] * (count // cells + 1))[:count]
        all_views = views * count // cells
        parts = min(-(-all_views // VIEWS_OF_A_TASK), count)
        parallel = assigned(times, workers)
        once = {"plan": mean("plan") * count / cells, "global": mean("global"), "merge": mean("merge") * count / cells}
        whole, split = per_view * all_views, assigned([per_view * all_views / parts] * parts, workers)
        for name, evaluate in (("one task", whole), ("in parts", split)):
            wall = sum(once.values()) + parallel + evaluate
            ideal = (sum(times) + per_view * all_views) / workers
            rows.append({"workers": workers, "cells": count, "evaluation": name, "wall": wall, **once,
                         "partitions": parallel, "evaluate": evaluate, "efficiency": ideal / wall})
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", default="8x4")
    parser.add_argument("--workers", default="1,2,4")
    parser.add_argument("--share", type=float, default=0.4, help="of a core, for each worker")
    parser.add_argument("--iterations", type=int, default=20, help="of each cell, and of the coarse model")
    parser.add_argument("--views", type=int, default=256)
    parser.add_argument("--json", action="store_true", help="print all measurements as JSON")
    options = parser.parse_args()
    # So that workers and quotas are removed then too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("parallel: stopped"))
    fathom = program()
    folder = pathlib.Path(tempfile.mkdtemp(prefix="fathom-parallel-"))
    try:
        scene = folder / "scene"
        ask([fathom, "synth", str(scene), "--views", str(options.views), "--size", "96x72"])
        runs = [measure(fathom, scene, folder, int(count), options) for count in options.workers.split(",")]
        held_out = len(json.loads((folder / f"out-{runs[0]['workers']}" / "metrics.json").read_text())["views"])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    alone = [run for run in runs if run["workers"] == 1]
    rows = forecast(alone[0], held_out) if alone else []
    for run in runs:
        run["best"] = best(run["tasks"], run["workers"])
        run["share"] = run["best"] / run["wall"]
    if options.json:
        print(json.dumps({"runs": runs, "forecast": rows}, indent=1))
        return
    print("workers  wall clock s  best schedule s  share of it   by stage, s")
    for run in runs:
        stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in run["stages"].items() if seconds)
        print(f"{run['workers']:7}  {run['wall']:12.1f}  {run['best']:15.1f}  {run['share']:11.3f}   {stages}")
    print("\nworkers  cells  evaluation  wall clock s  plan  global  merge  partitions  evaluate  efficiency")
    for row in rows:
        print(f"{row['workers']:7}  {row['cells']:5}  {row['evaluation']:10}  {row['wall']:12.0f}  {row['plan']:4.1f}  "
              f"{row['global']:6.1f}  {row['merge']:5.1f}  {row['partitions']:10.0f}  {row['evaluate']:8.1f}  "
              f"{row['efficiency']:10.3f}")


if __name__ == "__main__":
    main()
