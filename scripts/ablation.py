#!/usr/bin/env python3
"""Measures the effect of each part of the water and the partitions. Trains a scene once for each row, appends the result
to bench/history.jsonl, and writes the table of BENCHMARKS.md from the last result of each row there.

    scripts/ablation.py [--partitions MxN] [ROW ...]       rows by name; default: all

Rows of the partitions (smp-MxN and so on) use that grid, default 2x3; all others use one partition.

A row runs once and is kept under FATHOM_ABLATION_OUT (default out/ablation) with its command. Another command, or
FATHOM_ABLATION_FRESH=1, runs it again. The table is rewritten after every row.
FATHOM_SCENES is the folder of the scenes (default ../shared/scenes).
"""

import datetime
import json
import os
import re
import resource
import subprocess
import sys
import time
from pathlib import Path

import history

ROOT = Path(__file__).resolve().parent.parent
METADATA = subprocess.run(["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=ROOT, capture_output=True, check=True)
FATHOM = Path(json.loads(METADATA.stdout)["target_directory"]) / "debug/fathom"
SCENES = Path(os.environ.get("FATHOM_SCENES", ROOT.parent / "shared/scenes"))
OUT = Path(os.environ.get("FATHOM_ABLATION_OUT", ROOT / "out/ablation"))
SCENE = "sesa-wreck"
COMMON = ["--max-resolution", "240", "--iterations", "1000", "--max-gaussians", "40000", "--workers", "1"]
GRID = "2x3"
BEGIN, END = "<!-- ablation: begin -->", "<!-- ablation: end -->"


def with_settings(*settings, preset=None, seed=1, partitions=None):
    preset = ["--preset", preset] if preset else []
    grid = ["--partitions", partitions] if partitions else []
    return [*preset, *grid, *(word for setting in settings for word in ("--set", setting)), "--seed", str(seed)]


def rows_of(grid):
    """The rows, those of the partitions on this grid. Differences of SMP-UWGS are those of its table 2, of PSNR on Lagoon."""
    def darws(mode):
        # At 1, as printed, the weights of a grid without inner partitions are all equal (figure `weights` of
        # bench/history.jsonl).
        return with_settings(f"partition.weights={mode}", "partition.weight_terms.clamp=4", partitions=grid)
    return [
        *ROWS,
        (f"smp-{grid}", f"{grid} partitions (SMP-UWGS -0.32 dB)", with_settings(partitions=grid)),
        (
            f"no-bare-{grid}",
            f"{grid} w/o BARE (SMP-UWGS -2.93 dB)",
            with_settings("partition.extend_base=0", "partition.visibility_edge_factor=1", partitions=grid),
        ),
        (f"darws-loss-{grid}", f"{grid} DARWS, loss x w (SMP-UWGS +0.72 dB)", darws("loss_factor")),
        (f"darws-joint-{grid}", f"{grid} DARWS, global views by w", darws("joint")),
    ]


# Name, description, arguments.
ROWS = [
    ("fathom", "`fathom`, the defaults", with_settings()),
    ("no-medium", "no water at all (`3dgs`)", with_settings(preset="3dgs")),
    ("no-sparse-prior", "w/o sparse prior", with_settings("water.prior=fixed")),
    (
        "network",
        "w/o sparse prior, WaterParamPredict",
        with_settings("water.prior=network", "water.network.start=fixed"),
    ),
    ("no-dbdr", "w/o DBDR", with_settings("water.dbdr.mode=none")),
    ("plain-colours", "SH 0 while the water is free", with_settings("water.sh0_while_free=true")),
    ("per-gaussian", "water per Gaussian", with_settings("water.medium=per_gaussian")),
    ("linear", "blended in linear light", with_settings("water.blend=linear")),
    ("paper", "`paper`", with_settings(preset="paper")),
    ("paper-no-predict", "`paper` w/o WaterParamPredict", with_settings("water.prior=fixed", preset="paper")),
    ("paper-no-dbdr", "`paper` w/o DBDR", with_settings("water.dbdr.mode=none", preset="paper")),
    ("paper-sparse", "`paper` with the sparse prior", with_settings("water.prior=sparse", preset="paper")),
    ("fathom-seed-2", "`fathom`, seed 2", with_settings(seed=2)),
    ("fathom-seed-3", "`fathom`, seed 3", with_settings(seed=3)),
    ("paper-seed-2", "`paper`, seed 2", with_settings(preset="paper", seed=2)),
    ("paper-seed-3", "`paper`, seed 3", with_settings(preset="paper", seed=3)),
]


def run(command):
    """Wall clock and CPU seconds of a command with all its children; its error ends the program."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        sys.exit(f"ablation: {' '.join(map(str, command))}\n{done.stderr}")
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return done.stdout, time.monotonic() - begin, cpu


def command(arguments):
    return ["fathom", "train", SCENE, *COMMON, *arguments]


def kept(name, arguments):
    """The figures of a row measured by the same command; None if there are none."""
    path = OUT / f"{name}.json"
    figures = json.loads(path.read_text()) if path.is_file() else {}
    return figures if figures.get("command") == command(arguments) else None


def row(name, arguments):
    """Measures the figures of a row and saves them."""
    said = command(arguments)
    result = OUT / name
    subprocess.run(["rm", "-rf", str(result)], check=True)
    print(f"ablation: {' '.join(said)}", flush=True)
    _, wall, cpu = run([FATHOM, "train", SCENES / SCENE, *COMMON, *arguments, "-o", result, "--allow-cpu"])
    evaluation = [FATHOM, "eval", result, "--truth", SCENES / SCENE / "truth", "--floaters", "--allow-cpu", "--json"]
    measured = json.loads(run(evaluation)[0])
    plan = json.loads((result / "plan.json").read_text())
    stages = [plan.get("global"), plan.get("borders"), *plan["partitions"]]
    figures = {
        "command": said,
        "date": datetime.date.today().isoformat(),
        "adapter": measured["adapter"],
        "iterations": sum(stage["iterations"] for stage in stages if stage),
        "seam_db": measured.get("seam_db"),
        "wall": wall,
        "cpu": cpu,
        "psnr": measured["psnr"],
        "ssim": measured["ssim"],
        "floaters": measured["floaters"]["count"],
        "clear": {key: measured["truth"][key] for key in ("psnr", "ssim", "psnr_with_gain")},
        "water": measured["truth"].get("water"),
    }
    (OUT / f"{name}.json").write_text(json.dumps(figures, indent=1))
    return figures


def values_of(figures):
    """The numbers of a row in the format of the history."""
    values = {
        "psnr": figures["psnr"],
        "ssim": figures["ssim"],
        "j_psnr": figures["clear"]["psnr"],
        "j_ssim": figures["clear"]["ssim"],
        "j_gain_psnr": figures["clear"]["psnr_with_gain"],
        "floaters": figures["floaters"],
        "cpu_min": figures["cpu"] / 60,
        "wall_min": figures["wall"] / 60,
        "iterations_in_all": figures["iterations"],
        "seam_db": figures["seam_db"],
    }
    if water := figures["water"]:
        for name in ("beta_d", "beta_b"):
            values[f"{name}_error_percent"] = [100 * abs(error) for error in water[f"{name}_error"]]
        values["b_inf_error"] = max(map(abs, water["b_inf_error"]))
        values |= {f"{name}_{channel}": water["found"][name][c] for name in ("beta_d", "beta_b", "b_inf")
                   for c, channel in enumerate(("red", "green", "blue"))}
    return values


def record(name, arguments, figures):
    """Appends a measured row to the history, and the spread over seeds once all three exist."""
    said = " ".join(command(arguments))
    history.append("ablation", said, values_of(figures), scene=SCENE, variant=name, adapter=figures["adapter"])


def record_spread(prefix, adapter):
    """Appends mean and standard deviation over the seeds of a preset, if all are of one program."""
    rows = history.latest("ablation")
    seeds = [rows.get(name) for name in (prefix, f"{prefix}-seed-2", f"{prefix}-seed-3")]
    if not all(seeds) or len({row.get("commit") or row["date"] for row in seeds}) > 1:
        return
    values = {}
    for key, first in seeds[0]["values"].items():
        each = [row["values"].get(key) for row in seeds]
        if isinstance(first, (int, float)) and None not in each:
            mean = values[key] = sum(each) / len(each)
            values[f"{key}_sd"] = (sum((value - mean) ** 2 for value in each) / (len(each) - 1)) ** 0.5
    history.append("ablation", f"{' '.join(command([]))}, seeds 1 to 3", values, scene=SCENE, variant=f"{prefix}-seeds",
                   adapter=adapter, note="mean and standard deviation over three seeds")


def line(what, row):
    """A row of the table from a row of the history."""
    values = row["values"]
    percent = [" / ".join(f"{error:.1f}" for error in values[key]) if key in values else "-"
               for key in ("beta_d_error_percent", "beta_b_error_percent")]
    cells = [
        what,
        f"{values['psnr']:.2f}, {values['ssim']:.4f}",
        f"{values['j_psnr']:.2f}, {values['j_ssim']:.4f}",
        *percent,
        f"{values['floaters']:.0f}",
        f"{values['cpu_min']:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def spread(rows, prefix):
    values = rows.get(f"{prefix}-seeds", {}).get("values")
    if not values:
        return None
    return (f"`{prefix}`, seeds 1 to 3: I {values['psnr']:.2f} ± {values['psnr_sd']:.2f} dB, "
            f"J {values['j_psnr']:.2f} ± {values['j_psnr_sd']:.2f} dB.")


def table(rows):
    """The table of BENCHMARKS.md; other grids and seeds are only in the history."""
    lines = ["| | I | J | beta_d % | beta_b % | floaters | CPU min |", "|---|---|---|---|---|---|---|"]
    shown = [(what, rows[name]) for name, what, _ in rows_of(GRID) if name in rows and "-seed-" not in name]
    lines += [line(what, row) for what, row in shown]
    dates = sorted(row["date"] for _, row in shown) or ["not"]
    spreads = [text for prefix in ("fathom", "paper") if (text := spread(rows, prefix))]
    return "\n".join([*lines, "", f"Measured {dates[0]} to {dates[-1]}.", *spreads])


def main():
    wanted, grid = sys.argv[1:], GRID
    if wanted[:1] == ["--partitions"]:
        if len(wanted) < 2 or not re.fullmatch(r"\d+x\d+", wanted[1]):
            sys.exit("ablation: --partitions takes COLUMNSxROWS, such as 2x3")
        grid, wanted = wanted[1], wanted[2:]
    all_rows = rows_of(grid)
    known = [name for name, _, _ in all_rows]
    for name in wanted:
        if name not in known:
            sys.exit(f"ablation: there is no row {name}; rows are {', '.join(known)}")
    if not (SCENES / SCENE).is_dir():
        sys.exit(f"ablation: {SCENES / SCENE} does not exist; set FATHOM_SCENES to the folder of the scenes")
    OUT.mkdir(parents=True, exist_ok=True)
    if history.between(history.benchmarks_path().read_text(encoding="utf-8"), BEGIN, END) is None:
        sys.exit(f"ablation: {history.benchmarks_path()} lacks the marker lines {BEGIN} and {END} of the table")
    rows = {name: figures for name, _, arguments in all_rows if (figures := kept(name, arguments))}
    fresh = bool(os.environ.get("FATHOM_ABLATION_FRESH"))
    for name, _, arguments in all_rows:
        if (not wanted or name in wanted) and (fresh or name not in rows):
            figures = row(name, arguments)
            record(name, arguments, figures)
            prefix, _, seed = name.partition("-seed-")
            if prefix in ("fathom", "paper") and (seed or not name.count("-")):
                record_spread(prefix, figures["adapter"])
            write()
    write()


def write():
    history.replace_between(BEGIN, END, table(history.latest("ablation")))


if __name__ == "__main__":
    main()
