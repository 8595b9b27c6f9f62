#!/usr/bin/env python3
"""What each part of the water and of the partitions brings: trains a scene once for each row and writes the table into
BENCHMARKS.md.

    scripts/ablation.py [--partitions MxN] [ROW ...]       rows by name; all of them without any

Rows of the partitions (smp-MxN and so on) are on that grid, 2x3 without the option; all others on one partition.

A row is done once and kept under FATHOM_ABLATION_OUT (default out/ablation) with the command that made it; another
command, or FATHOM_ABLATION_FRESH=1, does it again. The table is written anew after every row, from all that are there; rows of
the table that are not there stay as they are.
FATHOM_SCENES says where the scenes are (default ../shared/scenes).
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

ROOT = Path(__file__).resolve().parent.parent
METADATA = subprocess.run(["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=ROOT, capture_output=True, check=True)
FATHOM = Path(json.loads(METADATA.stdout)["target_directory"]) / "debug/fathom"
SCENES = Path(os.environ.get("FATHOM_SCENES", ROOT.parent / "shared/scenes"))
OUT = Path(os.environ.get("FATHOM_ABLATION_OUT", ROOT / "out/ablation"))
SCENE = "sesa-wreck"
COMMON = ["--max-resolution", "240", "--iterations", "1000", "--max-gaussians", "40000", "--workers", "1"]
BEGIN, END = "<!-- ablation: begin -->", "<!-- ablation: end -->"


def with_settings(*settings, preset=None, seed=1, partitions=None):
    preset = ["--preset", preset] if preset else []
    grid = ["--partitions", partitions] if partitions else []
    return [*preset, *grid, *(word for setting in settings for word in ("--set", setting)), "--seed", str(seed)]


def rows_of(grid):
    """The rows, those of the partitions on this grid. Differences of SMP-UWGS are those of its table 2, of PSNR on Lagoon."""
    def darws(mode):
        # At 1, as printed, the weights of a grid without inner partitions are all alike (BENCHMARKS.md).
        return with_settings(f"partition.weights={mode}", "partition.weight_terms.clamp=4", partitions=grid)
    return [
        *ROWS,
        (f"smp-{grid}", f"SMP: {grid} partitions (SMP-UWGS: -0.32 dB against w/o SMP)", with_settings(partitions=grid)),
        (
            f"no-bare-{grid}",
            f"{grid} w/o BARE: boxes end with their cells, tau_e = tau (SMP-UWGS: -2.93 dB)",
            with_settings("partition.extend_base=0", "partition.visibility_edge_factor=1", partitions=grid),
        ),
        (f"darws-loss-{grid}", f"{grid} with DARWS, loss x w (SMP-UWGS: +0.72 dB)", darws("loss_factor")),
        (f"darws-density-{grid}", f"{grid} with DARWS, caps x w", darws("density_threshold")),
        (f"darws-iterations-{grid}", f"{grid} with DARWS, iterations x w", darws("iteration_budget")),
        (f"darws-joint-{grid}", f"{grid} with DARWS, views of the global stage by w", darws("joint")),
    ]


# Name, what it is for the reader, arguments.
ROWS = [
    ("fathom", "`fathom`, our defaults", with_settings()),
    ("no-medium", "w/o DPR-Net: no water at all (`3dgs`)", with_settings(preset="3dgs")),
    ("no-sparse-prior", "w/o sparse prior: from the released code's numbers", with_settings("water.prior=fixed")),
    (
        "network",
        "w/o sparse prior, with WaterParamPredict",
        with_settings("water.prior=network", "water.network.start=fixed"),
    ),
    ("no-dbdr", "w/o DBDR: the prior stays as it is", with_settings("water.dbdr.mode=none")),
    ("plain-colours", "SH 0 while the water is free", with_settings("water.plain_colours=true")),
    ("per-gaussian", "per Gaussian in place of per pixel", with_settings("water.medium=per_gaussian")),
    ("linear", "blended in linear light", with_settings("water.blend=linear")),
    ("paper", "`paper`, the equations as printed", with_settings(preset="paper")),
    ("paper-no-predict", "`paper` w/o WaterParamPredict", with_settings("water.prior=fixed", preset="paper")),
    ("paper-no-dbdr", "`paper` w/o DBDR", with_settings("water.dbdr.mode=none", preset="paper")),
    ("paper-sparse", "`paper` with the sparse prior", with_settings("water.prior=sparse", preset="paper")),
    ("fathom-seed-2", "`fathom`, seed 2", with_settings(seed=2)),
    ("fathom-seed-3", "`fathom`, seed 3", with_settings(seed=3)),
    ("paper-seed-2", "`paper`, seed 2", with_settings(preset="paper", seed=2)),
    ("paper-seed-3", "`paper`, seed 3", with_settings(preset="paper", seed=3)),
]


def run(command):
    """Wall clock and CPU seconds of a command with all its children; its error is told as it is."""
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
    """The figures of a row that was measured by this very command; None where there are none."""
    path = OUT / f"{name}.json"
    figures = json.loads(path.read_text()) if path.is_file() else {}
    return figures if figures.get("command") == command(arguments) else None


def row(name, arguments):
    """Measures the figures of a row and keeps them."""
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


def errors(water):
    if not water:
        return ["-"] * 3
    percent = [" / ".join(f"{100 * abs(e):.1f}" for e in water[key]) for key in ("beta_d_error", "beta_b_error")]
    return [*percent, f"{max(map(abs, water['b_inf_error'])):.4f}"]


def spread(rows, prefix):
    """Mean and standard deviation over the seeds of a preset, once all three are there."""
    seeds = [rows[name] for name in (prefix, f"{prefix}-seed-2", f"{prefix}-seed-3") if name in rows]
    if len(seeds) < 3:
        return None
    def of(value):
        values = [value(figures) for figures in seeds]
        mean = sum(values) / len(values)
        return mean, (sum((v - mean) ** 2 for v in values) / (len(values) - 1)) ** 0.5
    told = {
        "I": ("{:.2f} +- {:.2f} dB", of(lambda f: f["psnr"])),
        "SSIM": ("{:.4f} +- {:.4f}", of(lambda f: f["ssim"])),
        "J": ("{:.2f} +- {:.2f} dB", of(lambda f: f["clear"]["psnr"])),
        "SSIM of J": ("{:.4f} +- {:.4f}", of(lambda f: f["clear"]["ssim"])),
        "J with gains": ("{:.2f} +- {:.2f} dB", of(lambda f: f["clear"]["psnr_with_gain"])),
    }
    for name in ("beta_d", "beta_b", "b_inf"):
        for c, channel in enumerate(("red", "green", "blue")):
            told[f"{name} {channel}"] = ("{:.4f} +- {:.4f}", of(lambda f: f["water"]["found"][name][c]))
    parts = [f"{name} {form.format(*values)}" for name, (form, values) in told.items()]
    return f"`{prefix}` over three seeds, mean and standard deviation: {', '.join(parts)}."


def table(told, rows, before):
    lines = [
        f"`make ablation`: `fathom train {SCENE} {' '.join(COMMON)} ...`, then `fathom eval --truth --floaters`. Errors of "
        "beta are in percent of the truth, red, green and blue, with eq. 9 at the usual viewing distance; that of b_inf is the largest of three, linear light. Every "
        "row has the same settings of iterations and cap; the last column has the iterations that were done in all, since partitions "
        "share cameras. CPU minutes are of all processes of a job; the machine had other "
        "load, so wall clocks are not to be compared.",
        "",
        "| | PSNR, SSIM of I | PSNR, SSIM of J | J, gains | beta_d % | beta_b % | b_inf | floaters | CPU min | wall min | iterations |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, what, _ in told:
        if name not in rows and what in before:
            lines.append(before.pop(what))
        if name in rows:
            before.pop(what, None)
            f = rows[name]
            cells = [
                what,
                f"{f['psnr']:.2f}, {f['ssim']:.4f}",
                f"{f['clear']['psnr']:.2f}, {f['clear']['ssim']:.4f}",
                f"{f['clear']['psnr_with_gain']:.2f}",
                *errors(f["water"]),
                f"{f['floaters']:.0f}",
                f"{f['cpu'] / 60:.1f}",
                f"{f['wall'] / 60:.1f}",
                str(f["iterations"]),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    # Of another grid; a row without one that is not told any more was renamed.
    lines += [line for what, line in before.items() if re.search(r"\b\d+x\d+\b", what)]
    if rows:
        any_row = next(iter(rows.values()))
        dates = sorted(figures["date"] for figures in rows.values())
        lines += ["", f"{any_row['adapter']}, {dates[0]} to {dates[-1]}."]
    lines += [text for prefix in ("fathom", "paper") if (text := spread(rows, prefix))]
    return "\n".join(lines)


def main():
    wanted, grid = sys.argv[1:], "2x3"
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
        sys.exit(f"ablation: {SCENES / SCENE} is not there; say with FATHOM_SCENES where the scenes are")
    OUT.mkdir(parents=True, exist_ok=True)
    report = ROOT / "BENCHMARKS.md"
    if BEGIN not in report.read_text() or END not in report.read_text():
        sys.exit(f"ablation: {report} lacks the lines {BEGIN} and {END} that the table goes between")
    rows = {name: figures for name, _, arguments in all_rows if (figures := kept(name, arguments))}
    fresh = bool(os.environ.get("FATHOM_ABLATION_FRESH"))
    for name, _, arguments in all_rows:
        if (not wanted or name in wanted) and (fresh or name not in rows):
            rows[name] = row(name, arguments)
            write(report, all_rows, rows)
    write(report, all_rows, rows)


def write(report, told, rows):
    between = re.escape(BEGIN) + ".*?" + re.escape(END)
    text = report.read_text()
    said = re.search(between, text, flags=re.DOTALL).group(0).splitlines()
    cells = [line for line in said if line.startswith("| ") and not line.startswith("| |")]
    before = {line.split(" | ")[0].removeprefix("| "): line for line in cells}
    # What was said below the table of rows that are not there.
    below = [line for line in said if line.startswith("`") and " over three seeds" in line]
    new = table(told, rows, before)
    new += "".join(f"\n{line}" for line in below if line.split(" three seeds")[0] not in new)
    report.write_text(text.replace("\n".join(said), f"{BEGIN}\n{new}\n{END}"))


if __name__ == "__main__":
    main()
