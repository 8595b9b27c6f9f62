"""Tables of the benchmark results, for scripts/bench.sh.

    bench_report.py random FILE...   files of bench_random by side and round: random-now-1.json, random-baseline-1.json
    bench_report.py peers FILE       output of train_scene for the run of the Brush measurement
"""

import json
import re
import sys
from statistics import median

# Brush on fox at 225x400 from its own poses and 10,000 points, lavapipe, 2 shared cores, August 2026.
BRUSH_CPU_SECONDS = 1.32
BRUSH_PSNR = {100: 12.2, 300: 14.2, 600: 17.2}


def rows_of(result, metric):
    """Rows of the table: name to seconds by `metric`, "cpu_seconds" or "seconds" (of the device)."""
    rows = {}
    for stage in result["stages"]:
        rows[stage["pass"], stage["stage"]] = stage[metric]
    whole = "cpu_seconds" if metric == "cpu_seconds" else "wall_seconds"
    passes = {name: times[whole] for name, times in result["passes"].items()}
    rows["whole", "forward"] = passes["forward"]
    rows["whole", "backward"] = passes["backward"]
    rows["whole", "step"] = passes["forward"] + passes["backward"]
    for primitive in result["primitives"]:
        bits = f" of {primitive['bits']} bits" if primitive["bits"] else ""
        rows["alone", f"{primitive['primitive']} {primitive['entries']:,}{bits}"] = primitive[metric]
    return {name: seconds for name, seconds in rows.items() if seconds is not None}


def milliseconds(values):
    return f"{1e3 * median(values):.2f}" if values else "-"


def millions(value):
    return "-" if value is None else f"{value * 1e-6:.1f} M"


def random_table(paths):
    rounds = {"now": {}, "baseline": {}}
    for path in paths:
        side, number = re.search(r"random-(now|baseline)-(\d+)\.json$", path).groups()
        with open(path, encoding="utf-8") as file:
            rounds[side][int(number)] = json.load(file)
    now, baseline = rounds["now"], rounds["baseline"]
    first = now[min(now)]
    metric = "cpu_seconds" if first["is_cpu"] else "seconds"
    width, height = first["size"]
    print(f"{first['gaussians']:,} random Gaussians at {width}x{height} on {first['adapter']}; "
          f"medians of {len(now)} rounds of {first['repeats']}")
    if first["is_cpu"]:
        print("times are CPU milliseconds of all threads, each dispatch alone, of which "
              f"{milliseconds([result['submission_cpu_seconds'] for result in now.values()])} are its submission; "
              "device: by timestamps")
    else:
        print("times are device milliseconds by timestamps; whole passes are wall time")
    heads = ["", "stage", "now", "baseline", "ratio", "spread", "device" if first["is_cpu"] else "GB/s"]
    table = [heads]
    times = {number: rows_of(result, metric) for number, result in now.items()}
    before = {number: rows_of(result, metric) for number, result in baseline.items()}
    device = {number: rows_of(result, "seconds") for number, result in now.items()}
    names = list(dict.fromkeys(name for side in (times, before) for rows in side.values() for name in rows))
    bandwidth = {(s["pass"], s["stage"]): s.get("gigabytes_per_second") for s in first["stages"]}
    for name in names:
        pairs = [(times[n].get(name), before[n].get(name)) for n in times if n in before]
        ratios = [ours / theirs for ours, theirs in pairs if ours is not None and theirs]
        last = "-"
        if not first["is_cpu"]:
            last = f"{bandwidth[name]:.0f}" if bandwidth.get(name) else "-"
        elif name[0] != "whole":
            last = milliseconds([rows[name] for rows in device.values() if name in rows])
        table.append([
            name[0],
            name[1],
            milliseconds([rows[name] for rows in times.values() if name in rows]),
            milliseconds([rows[name] for rows in before.values() if name in rows]),
            f"{median(ratios):.3f}" if ratios else "-",
            f"{min(ratios):.3f}..{max(ratios):.3f}" if ratios else "-",
            last,
        ])
    if not baseline:
        table = [row[:3] + row[6:] for row in table]
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    for row in table:
        cells = [cell.ljust(w) if column < 2 else cell.rjust(w) for column, (cell, w) in enumerate(zip(row, widths))]
        print("  ".join(cells).rstrip())

    print(f"visible {first['visible']:,}, intersections {first['intersections']:,}, tiles of {first['tile']} pixels; "
          f"evaluations a step {millions(first['listed_evaluations'])}, of which needed "
          f"{millions(first['needed_evaluations'])}")
    seconds, unit = ("cpu_second", "a CPU second") if first["is_cpu"] else ("second", "a second")

    def middle(*keys):
        return median_of([dig(result, keys) for result in now.values()])

    for stage in ("rasterize_forward", "rasterize_backward"):
        text = f"{stage}: {millions(middle(stage, f'evaluations_per_{seconds}'))} evaluations {unit}"
        floor = middle(stage, "ratio_to_floor")
        print(text + (f", {floor:.2f} of its floor" if floor else ""))
    if middle("ratio_to_floor"):
        print(f"step: {middle('ratio_to_floor'):.2f} of the floor of {1e3 * first['floor_cpu_seconds']:.1f} CPU ms")
    for at, primitive in enumerate(first["primitives"]):
        each = median_of([result["primitives"][at][f"entries_per_{seconds}"] for result in now.values()])
        bits = f" of {primitive['bits']} bits" if primitive["bits"] else ""
        print(f"{primitive['primitive']} of {primitive['entries']:,}{bits}: {millions(each)} {unit}")
    digests(now, baseline)


def dig(result, keys):
    for key in keys:
        result = result[key]
    return result


def median_of(values):
    values = [value for value in values if value is not None]
    return median(values) if values else None


def digests(now, baseline):
    """Reports whether bytes differ between the sides or between the rounds of a side."""
    for what in ("image", "gradients", "model"):
        found = {side: sorted({result["digests"][what] for result in results.values()})
                 for side, results in (("now", now), ("baseline", baseline)) if results}
        for side, values in found.items():
            if len(values) > 1:
                print(f"{what}: THE ROUNDS OF ONE PROGRAM DIFFER ({side}: {', '.join(values)})")
        if len(found) == 1:
            print(f"{what}: {found['now'][0]}")
        elif found["now"] == found["baseline"]:
            print(f"{what}: the same bytes as the baseline's")
        else:
            print(f"{what}: OTHER BYTES than the baseline's ({found['now'][0]} now, {found['baseline'][0]} before)")


def peers_table(path):
    with open(path, encoding="utf-8") as file:
        result = json.load(file)
    end = result["at_the_end"]
    reached = {row["iteration"]: row["psnr"] for row in result["held_out"]}
    reached[result["iterations"]] = result["psnr"]
    print(f"fox, {result['gaussians']:,} Gaussians, on {result['adapter']}; "
          "Brush with other poses and points, so an indication")
    print(f"{'':24}{'this':>10}{'Brush':>10}")
    print(f"{'CPU s a step':24}{result['cpu_seconds_per_step']:>10.3f}{BRUSH_CPU_SECONDS:>10.2f}")
    for step, theirs in BRUSH_PSNR.items():
        ours = f"{reached[step]:.2f}" if step in reached else "-"
        print(f"{f'PSNR at {step}, dB':24}{ours:>10}{theirs:>10.1f}")
    print(f"last {end['steps']:.0f} steps: {end['cpu_seconds_per_step']:.3f} CPU s, "
          f"{end['intersections_per_step']:,.0f} intersections, "
          f"{millions(end['listed_evaluations_per_step'])} evaluations, of which needed "
          f"{millions(end['needed_evaluations_per_step'])}")
    if end["ratio_to_floor"]:
        print(f"{end['ratio_to_floor']:.2f} of the floor of {end['floor_cpu_seconds_per_step']:.3f} CPU s")


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in ("random", "peers"):
        sys.exit(__doc__)
    if sys.argv[1] == "random":
        random_table(sys.argv[2:])
    else:
        peers_table(sys.argv[2])
