#!/usr/bin/env python3
"""What each part of the water brings: trains a scene once for each row and writes the table into BENCHMARKS.md.

    scripts/ablation.py [ROW ...]       rows by name; all of them without any

A row is done once and kept under FATHOM_ABLATION_OUT (default out/ablation) with the command that made it; another
command, or FATHOM_ABLATION_FRESH=1, does it again. The table is written anew after every row, from all that are there.
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
FATHOM = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug/fathom"
SCENES = Path(os.environ.get("FATHOM_SCENES", ROOT.parent / "shared/scenes"))
OUT = Path(os.environ.get("FATHOM_ABLATION_OUT", ROOT / "out/ablation"))
SCENE = "sesa-wreck"
COMMON = ["--max-resolution", "240", "--iterations", "1000", "--max-gaussians", "40000", "--workers", "1"]
BEGIN, END = "<!-- ablation: begin -->", "<!-- ablation: end -->"


def with_settings(*settings, preset=None, seed=1):
    preset = ["--preset", preset] if preset else []
    return [*preset, *(word for setting in settings for word in ("--set", setting)), "--seed", str(seed)]


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
    ("free-colours", "w/o SH 0 while the water is free", with_settings("water.plain_colours=false")),
    ("per-pixel", "per pixel in place of per Gaussian", with_settings("water.medium=per_pixel")),
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
    figures = {
        "command": said,
        "date": datetime.date.today().isoformat(),
        "adapter": measured["adapter"],
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


def table(rows):
    lines = [
        f"`make ablation`: `fathom train {SCENE} {' '.join(COMMON)} ...`, then `fathom eval --truth --floaters`. Errors of "
        "beta are in percent of the truth, red, green and blue, with eq. 9 at the usual viewing distance; that of b_inf is the largest of three, linear light. Every "
        "row has the same iterations and the same cap. CPU minutes are of all processes of a job; the machine had other "
        "load, so wall clocks are not to be compared.",
        "",
        "| | PSNR, SSIM of I | PSNR, SSIM of J | J, gains | beta_d % | beta_b % | b_inf | floaters | CPU min | wall min | iterations |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    iterations = COMMON[COMMON.index("--iterations") + 1]
    for name, what, _ in ROWS:
        if name in rows:
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
                iterations,
            ]
            lines.append(f"| {' | '.join(cells)} |")
    if rows:
        any_row = next(iter(rows.values()))
        dates = sorted(figures["date"] for figures in rows.values())
        lines += ["", f"{any_row['adapter']}, {dates[0]} to {dates[-1]}."]
    lines += [told for prefix in ("fathom", "paper") if (told := spread(rows, prefix))]
    return "\n".join(lines)


def main():
    wanted = sys.argv[1:]
    known = [name for name, _, _ in ROWS]
    for name in wanted:
        if name not in known:
            sys.exit(f"ablation: there is no row {name}; rows are {', '.join(known)}")
    if not (SCENES / SCENE).is_dir():
        sys.exit(f"ablation: {SCENES / SCENE} is not there; say with FATHOM_SCENES where the scenes are")
    OUT.mkdir(parents=True, exist_ok=True)
    report = ROOT / "BENCHMARKS.md"
    if BEGIN not in report.read_text() or END not in report.read_text():
        sys.exit(f"ablation: {report} lacks the lines {BEGIN} and {END} that the table goes between")
    rows = {name: figures for name, _, arguments in ROWS if (figures := kept(name, arguments))}
    fresh = bool(os.environ.get("FATHOM_ABLATION_FRESH"))
    for name, _, arguments in ROWS:
        if (not wanted or name in wanted) and (fresh or name not in rows):
            rows[name] = row(name, arguments)
            write(report, rows)
    write(report, rows)


def write(report, rows):
    between = re.escape(BEGIN) + ".*?" + re.escape(END)
    text = report.read_text()
    report.write_text(re.sub(between, lambda _: f"{BEGIN}\n{table(rows)}\n{END}", text, flags=re.DOTALL))


if __name__ == "__main__":
    main()
