#!/usr/bin/env python3
"""Measured results over time: bench/history.jsonl, one JSON object per line.

    scripts/history.py append --figure F --command C [--scene S] [--variant V] [--adapter A] [--note N]
                              [--current TEXT] [KEY=VALUE ...]
    scripts/history.py list [FIGURE]
    scripts/history.py plot FIGURE [--scene S] [--variant V] [--value psnr] [-o FILE.svg]
    scripts/history.py merge RESULTS
    scripts/history.py check

`append` adds a row with today's date and the commit of the working tree. A VALUE is a number or a JSON list;
None, NaN and infinite values are omitted.
With --current it also replaces the result and the date of that row in BENCHMARKS.md: the one between the
lines of MARKERS whose first two cells are the figure and "scene variant". It never adds a row there.
`merge` adds the rows of a folder that the GPU kit wrote (scripts/gpu.sh), each once, and renews the table of
bench/gpu.md. `list` prints all figures, scenes and values. `plot` draws one value over time as SVG, a line for each
scene, variant and settings. `check` reads every row, and tries all of this on made-up rows.

FATHOM_HISTORY, FATHOM_BENCHMARKS and FATHOM_BENCHMARKS_GPU name other files, for a dry run.

Keys of a row: date, commit, recorded_in (the commit that wrote an old row), figure, scene, variant, command,
adapter, settings, values, note. The figure is a function of scripts/accept.sh where there is one.
"""

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parent.parent
MARKERS = "<!-- accept: begin -->", "<!-- accept: end -->"
GPU_MARKERS = "<!-- begin -->", "<!-- end -->"
KEYS = ("date", "commit", "recorded_in", "figure", "scene", "variant", "command", "adapter", "settings", "values", "note")
# Options of `fathom train` and `train_scene` that affect a result.
OPTIONS = ("partitions", "workers", "preset", "max-resolution", "iterations", "max-gaussians", "seed")
# A result in BENCHMARKS.md is a table cell, and that file has its own size limit (the test `tidy`).
LONGEST_CELL = 120


def history_path():
    return Path(os.environ.get("FATHOM_HISTORY", ROOT / "bench/history.jsonl"))


def benchmarks_path():
    return Path(os.environ.get("FATHOM_BENCHMARKS", ROOT / "BENCHMARKS.md"))


def gpu_path():
    return Path(os.environ.get("FATHOM_BENCHMARKS_GPU", ROOT / "bench/gpu.md"))


def commit():
    """The measured commit, marked if the tree has changes; None outside a repository."""
    def git(*arguments):
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else None
    head = git("rev-parse", "--short", "HEAD")
    # Results are written to these two, so changes there do not concern the program.
    changes = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!bench/history.jsonl", ":!BENCHMARKS.md")
    return f"{head}+changes" if head and changes else head


def settings_of(command):
    """The settings in a command; a setting that occurs twice is omitted."""
    settings = {}
    for option in OPTIONS:
        found = re.findall(rf"--{option} ([^\s,;`']+)", command)
        if len(found) == 1:
            settings[option.replace("-", "_")] = int(found[0]) if found[0].isdigit() else found[0]
    changed = dict(re.findall(r"--set ([\w.]+)=([^\s`,;']+)", command))
    if changed:
        settings["set"] = changed
    seeds = re.search(r"\bseeds ([\d, ]+(?:(?:to|and) \d+)?)", command)
    if seeds:
        settings["seeds"] = seeds.group(1).strip(" ,")
    return settings


def append(figure, command, values=None, **more):
    """Adds a row to the history and returns it; keys without a value are left out."""
    if not figure or not command:
        raise ValueError("a row needs a figure and a command")
    numbers = {key: value for key, value in (values or {}).items() if value is not None}
    today = datetime.datetime.now(datetime.timezone.utc).date().isoformat()
    row = {"date": today, "commit": commit(), "figure": figure,
           "command": command, "settings": settings_of(command), "values": numbers, **more}
    if unknown := set(row) - set(KEYS):
        raise ValueError(f"there is no key {', '.join(sorted(unknown))}; keys are {', '.join(KEYS)}")
    row = {key: row[key] for key in KEYS if row.get(key) not in (None, "", {})}
    write_rows([row])
    return row


def write_rows(rows):
    """Adds whole rows at the end of the history."""
    lines = [json.dumps(row, ensure_ascii=False, allow_nan=False).encode() + b"\n" for row in rows]
    path = history_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+b") as file:
        # Start on a new line, in case an interrupted program left an incomplete one.
        if file.seek(0, os.SEEK_END) > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(b"".join(lines))


def read(path=None):
    """All rows, oldest first; an invalid line ends the program with its number."""
    path, rows = path or history_path(), []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines() if path.is_file() else [], 1):
        try:
            row = json.loads(line)
            missing = [key for key in ("date", "figure") if not isinstance(row[key], str)]
        except (ValueError, KeyError, TypeError) as error:
            sys.exit(f"history: {path}:{number}: not a row ({error})")
        if missing or set(row) - set(KEYS):
            sys.exit(f"history: {path}:{number}: keys are {', '.join(KEYS)}; date and figure are text")
        rows.append(row)
    return rows


def latest(figure):
    """The last row of each variant of a figure, by its variant."""
    return {row.get("variant"): row for row in read() if row["figure"] == figure and row.get("values")}


def between(text, begin, end):
    """The position of the text between two marker lines; None without exactly one of each, in this order."""
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        return None
    return text.index(begin) + len(begin), text.index(end)


def replace_between(begin, end, new, path=None):
    """Replaces the text between two marker lines of BENCHMARKS.md or another file."""
    path = path or benchmarks_path()
    text = path.read_text(encoding="utf-8")
    place = between(text, begin, end)
    if place is None:
        sys.exit(f"history: {path} lacks the lines {begin} and {end}")
    path.write_text(f"{text[:place[0]]}\n{new}\n{text[place[1]:]}", encoding="utf-8")


def set_current(figure, scene, measured, date):
    """Replaces result and date of the row of BENCHMARKS.md with this figure and scene; False if there is none.

    Columns: figure, scene, run, measured, bound, date.
    """
    measured = measured.replace("|", "/").strip()
    if len(measured) > LONGEST_CELL or "\n" in measured:
        raise ValueError(f"a result in BENCHMARKS.md has at most {LONGEST_CELL} characters: {measured}")
    text = benchmarks_path().read_text(encoding="utf-8")
    place = between(text, *MARKERS)
    if place is None:
        return False
    lines, found = text[place[0]:place[1]].strip("\n").split("\n"), False
    for n, line in enumerate(lines):
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 6 and cells[0].strip("`") == figure and cells[1] == scene:
            lines[n] = f"| {' | '.join([*cells[:3], measured, cells[4], date])} |"
            found = True
    if found:
        replace_between(*MARKERS, "\n".join(lines))
    return found


def merge(folder):
    """Adds the rows of a run of the GPU kit and renews the table of GPUs; returns how many rows were new."""
    path = Path(folder) / "rows.jsonl"
    if not path.is_file():
        sys.exit(f"history: {path} is not there; name the folder of results that the kit wrote")
    have = {json.dumps(row, sort_keys=True) for row in read()}
    new = []
    for row in read(path):
        text = json.dumps(row, sort_keys=True)
        if text not in have:
            have.add(text)
            new.append(row)
    write_rows(new)
    if table := gpu_table(read()):
        replace_between(*GPU_MARKERS, table, gpu_path())
    return len(new)


def gpu_table(rows):
    """The newest result of each run on each card: whole trainings, and sums beside gsplat."""
    newest = {}
    for row in rows:
        shown = row["figure"] in ("gpu_scene", "gpu_mcmc", "gpu_pool") or row["figure"] == "gpu_gsplat" and "sum" in row.get("variant", "")
        if shown and row.get("values") and not row.get("settings", {}).get("rehearsal"):
            newest[row.get("adapter", ""), row["figure"], row.get("scene", ""), row.get("variant", "")] = row
    if not newest:
        return ""
    names = {"psnr": "{:.2f} dB", "j_psnr": "J {:.2f} dB", "wall_s": "{:.1f} s", "ms_per_step": "{:.2f} ms a step",
             "gaussians": "{:,.0f} Gaussians", "fathom_ms": "{:.2f} ms", "gsplat_ms": "gsplat {:.2f} ms", "ratio": "ratio {:.2f}"}
    lines = ["| card | run | measured | date |", "|---|---|---|---|"]
    for (adapter, figure, scene, variant), row in sorted(newest.items()):
        measured = ", ".join(text.format(row["values"][key]) for key, text in names.items() if key in row["values"])
        run = " ".join(word for word in (f"`{figure}`", scene, variant) if word)
        lines.append(f"| {adapter.split(' (')[0]} | {run} | {measured[:LONGEST_CELL]} | {row['date']} |")
    return "\n".join(lines)


def value_of(text):
    key, equals, value = text.partition("=")
    if not equals or not re.fullmatch(r"\w+", key):
        raise argparse.ArgumentTypeError(f"{text} is not KEY=VALUE")
    if value == "None":
        return key, None
    try:
        number = json.loads(value, parse_constant=lambda _: None)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{value} is neither a number nor a JSON list") from None
    if isinstance(number, (str, dict)):
        raise argparse.ArgumentTypeError(f"{value} is neither a number nor a JSON list")
    return key, number


def series_of(rows, value):
    """Lines of a plot: name to (index of the row, date, number)."""
    series = {}
    for index, row in enumerate(rows):
        number = row.get("values", {}).get(value)
        if isinstance(number, (int, float)):
            settings = row.get("settings", {})
            words = [row.get("scene"), row.get("variant"), *(f"{k} {v}" for k, v in settings.items() if k != "set"),
                     *(f"{k}={v}" for k, v in settings.get("set", {}).items())]
            series.setdefault(" ".join(str(w) for w in words if w) or row["figure"], []).append((index, row["date"], number))
    return series


COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#7f7f7f")


def svg(title, series):
    """The plot as SVG, with one x position per row, since many rows are of one day."""
    left, top, width, height, step = 70, 40, 640, 300, 18
    points = [point for line in series.values() for point in line]
    order = {index: n for n, index in enumerate(sorted({index for index, _, _ in points}))}
    low, high = min(v for _, _, v in points), max(v for _, _, v in points)
    low, high = (low - 1, high + 1) if low == high else (low, high)
    x = lambda index: left + width * (order[index] + .5) / len(order)
    y = lambda v: top + height * (high - v) / (high - low)
    out = [f'<text x="{left}" y="20" font-size="15">{escape(title)}</text>']
    for n in range(5):
        v = low + (high - low) * n / 4
        out.append(f'<path d="M{left} {y(v):.1f}h{width}" stroke="#ddd"/>'
                   f'<text x="{left - 6}" y="{y(v) + 4:.1f}" text-anchor="end">{v:.4g}</text>')
    last = None
    for index, date, _ in sorted(points):
        if date != last:
            out.append(f'<text x="{x(index):.1f}" y="{top + height + 18}" text-anchor="middle">{escape(date)}</text>')
        last = date
    for n, (name, line) in enumerate(series.items()):
        colour, legend = COLOURS[n % len(COLOURS)], top + height + 40 + step * n
        path = " ".join(f"{x(i):.1f},{y(v):.1f}" for i, _, v in line)
        out.append(f'<polyline points="{path}" fill="none" stroke="{colour}"/>')
        out += [f'<circle cx="{x(i):.1f}" cy="{y(v):.1f}" r="3" fill="{colour}"><title>{escape(f"{d}: {v}")}</title></circle>'
                for i, d, v in line]
        out.append(f'<circle cx="{left}" cy="{legend - 4}" r="4" fill="{colour}"/>'
                   f'<text x="{left + 10}" y="{legend}">{escape(name)}</text>')
    whole = top + height + 50 + step * len(series)
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + width + 20}" height="{whole}" '
            f'font-family="sans-serif" font-size="12">\n<rect width="100%" height="100%" fill="white"/>\n'
            + "\n".join(out) + "\n</svg>\n")


def plot(figure, scene, variant, value, output):
    rows = [row for row in read() if row["figure"] == figure and scene in (None, row.get("scene"))
            and variant in (None, row.get("variant"))]
    series = series_of(rows, value)
    if not series:
        sys.exit(f"history: no row of {figure} has a number {value}; `scripts/history.py list {figure}` lists the values")
    output.write_text(svg(f"{figure}: {value}", series), encoding="utf-8")
    print(f"history: {sum(map(len, series.values()))} points in {len(series)} lines: {output}")


def listing(figure):
    counts = {}
    for row in read():
        if figure in (None, row["figure"]):
            count = counts.setdefault((row["figure"], row.get("scene", "-")), [0, set()])
            count[0] += 1
            count[1] |= set(row.get("values", {}))
    for (name, scene), (rows, values) in sorted(counts.items()):
        print(f"{name}, {scene}: {rows} rows; {', '.join(sorted(values)) or 'text alone'}")


def check():
    """Checks every row of the history, and tests append, latest, set_current and plot."""
    print(f"history: {len(read())} rows")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FATHOM_HISTORY"] = f"{folder}/history.jsonl"
        os.environ["FATHOM_BENCHMARKS"] = f"{folder}/BENCHMARKS.md"
        history_path().write_text('{"date": "2026-01-01", "figure": "fox", "values": {"psnr": 30.5}}')
        append("fox", "fathom train fox --iterations 20 --set water.lr=0", {"psnr": 31.25}, scene="fox", variant="2x2")
        append("fox", "fathom train fox, seeds 1 to 3", {"psnr": 32, "by_seed": [31, 33]}, scene="fox", variant="2x2")
        rows = read()
        assert len(rows) == 3, "the incomplete line damaged a row"
        assert rows[1]["settings"] == {"iterations": 20, "set": {"water.lr": "0"}}, rows[1]
        assert rows[2]["settings"] == {"seeds": "1 to 3"}, rows[2]
        assert latest("fox")["2x2"]["values"]["psnr"] == 32
        begin, end = MARKERS
        table = "| figure | scene | run | measured | bound | date |\n|---|---|---|---|---|---|\n"
        row = "| `fox` | fox 2x2 | 20 | 30.00 dB | 29 dB | 2026-01-01 |"
        other = row.replace("2x2", "1x1")
        benchmarks_path().write_text(f"a\n{begin}\n{table}{row}\n{other}\n{end}\nb {row}\n")
        assert set_current("fox", "fox 2x2", "31.25 | dB", "2026-01-02")
        new = row.replace("30.00 dB", "31.25 / dB").replace("01-01", "01-02")
        assert benchmarks_path().read_text() == f"a\n{begin}\n{table}{new}\n{other}\n{end}\nb {row}\n", benchmarks_path().read_text()
        assert not set_current("fox", "fox 3x3", "1 dB", "2026-01-02"), "a row was added"
        try:
            set_current("fox", "fox 2x2", "x" * (LONGEST_CELL + 1), "2026-01-02")
            raise AssertionError("a result of any length is accepted")
        except ValueError:
            pass
        os.environ["FATHOM_BENCHMARKS_GPU"] = f"{folder}/gpu.md"
        gpu_path().write_text(f"a\n{GPU_MARKERS[0]}\nnone\n{GPU_MARKERS[1]}\nb\n")
        row = {"date": "2026-01-03", "commit": "c", "figure": "gpu_scene", "scene": "fox", "command": "train_scene fox",
               "adapter": "Card (1.2)", "values": {"psnr": 33.456, "wall_s": 60}}
        tried = {**row, "adapter": "llvmpipe", "settings": {"rehearsal": True}}
        (Path(folder) / "rows.jsonl").write_text("".join(json.dumps(each) + "\n" for each in (tried, row, row)))
        assert (merge(folder), merge(folder)) == (2, 0), "a row was lost or added twice"
        assert "llvmpipe" not in gpu_path().read_text(), "a rehearsal is shown as a card"
        assert read()[-1] == row
        assert "| Card | `gpu_scene` fox | 33.46 dB, 60.0 s | 2026-01-03 |\n" in gpu_path().read_text()
        picture = Path(folder) / "plot.svg"
        plot("fox", None, None, "psnr", picture)
        assert picture.read_text().count("<polyline") == 3 and picture.read_text().endswith("</svg>\n")
    print("history: test rows are appended, replaced and drawn correctly")


def main():
    parser = argparse.ArgumentParser(description="Measured results over time, in bench/history.jsonl.")
    verbs = parser.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("append")
    for name in ("figure", "command"):
        verb.add_argument(f"--{name}", required=True)
    for name in ("scene", "variant", "adapter", "note", "current"):
        verb.add_argument(f"--{name}")
    verb.add_argument("values", nargs="*", type=value_of, metavar="KEY=VALUE")
    verb = verbs.add_parser("list")
    verb.add_argument("figure", nargs="?")
    verb = verbs.add_parser("plot")
    verb.add_argument("figure")
    verb.add_argument("--scene")
    verb.add_argument("--variant")
    verb.add_argument("--value", default="psnr")
    verb.add_argument("-o", "--output", type=Path)
    verb = verbs.add_parser("merge")
    verb.add_argument("results", type=Path)
    verbs.add_parser("check")
    said = parser.parse_args()
    if said.verb == "append":
        row = append(said.figure, said.command, dict(said.values), scene=said.scene, variant=said.variant,
                     adapter=said.adapter, note=said.note)
        place = " ".join(word for word in (said.scene, said.variant) if word)
        if said.current and not set_current(said.figure, place, said.current, row["date"]):
            print(f"history: {said.figure}, {place}: only in the history; BENCHMARKS.md has no such row", file=sys.stderr)
    elif said.verb == "merge":
        print(f"history: {merge(said.results)} new rows")
    elif said.verb == "list":
        listing(said.figure)
    elif said.verb == "plot":
        plot(said.figure, said.scene, said.variant, said.value, said.output or Path(f"{said.figure}-{said.value}.svg"))
    else:
        check()


if __name__ == "__main__":
    main()
