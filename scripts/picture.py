#!/usr/bin/env python3
"""Makes docs/fathom.png: a held-out photograph, the same view without water, and the plan of partitions.

The scene is our own: `fathom synth`, trained in 2x2 partitions by two workers, as in scripts/demo.sh but
larger. Needs Pillow and a built `fathom` (`make build`). About 20 minutes on 2 cores without a GPU.

    scripts/picture.py                      # trains in out/picture, then draws
    scripts/picture.py --view v0057         # draws again, with another held-out view
"""

import argparse
import json
import pathlib
import subprocess

from PIL import Image, ImageDraw, ImageFont

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Width at which GitHub and others show the picture in full, pixels.
WIDTH = 1600
GAP = 16
CAPTION = 44
# Pixels of plan.png with the map and its axes; the rest is the legend.
PLAN_MAP = (26, 62, 1214, 700)
INK = (30, 41, 51)


def fathom():
    """The binary built by `make build`."""
    command = ["cargo", "metadata", "--no-deps", "--format-version", "1"]
    metadata = json.loads(subprocess.check_output(command, cwd=ROOT))
    return pathlib.Path(metadata["target_directory"]) / "debug" / "fathom"


def train(out):
    """Makes and trains the scene, unless a result exists."""
    if not (out / "scene" / "sparse").exists():
        subprocess.check_call([fathom(), "synth", out / "scene", "--size", "480x360"])
    if not (out / "result" / "model.ply").exists():
        subprocess.check_call(
            [fathom(), "train", out / "scene", "-o", out / "result", "--partitions", "2x2", "--workers", "2"]
            + ["--allow-cpu", "--iterations", "1800", "--max-gaussians", "60000", "--seed", "1"]
        )


def panels(result, view):
    """Photograph and scene without water from renders/, and the map of plan.png."""
    strip = Image.open(next((result / "renders").glob(f"[0-9]*_{view}.png"))).convert("RGB")
    # Photograph, render, difference, scene without water, backscatter.
    width = strip.width // 5
    part = lambda index: strip.crop((index * width, 0, (index + 1) * width, strip.height))
    plan = Image.open(result / "plan.png").convert("RGB").crop(PLAN_MAP)
    return [
        ("Photograph, held out from training", part(0)),
        ("The model at this view, without the water", part(3)),
        ("Plan from above: four partitions and their cameras", plan),
    ]


def draw(parts):
    """The parts side by side at one height, with a caption below each."""
    ratio = sum(picture.width / picture.height for _, picture in parts)
    height = int((WIDTH - GAP * (len(parts) - 1)) / ratio)
    canvas = Image.new("RGB", (WIDTH, height + CAPTION), "white")
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=21)
    x = 0
    for caption, picture in parts:
        width = round(picture.width * height / picture.height)
        canvas.paste(picture.resize((width, height), Image.Resampling.LANCZOS), (x, 0))
        pen.text((x + 2, height + 12), caption, fill=INK, font=font)
        x += width + GAP
    return canvas


def main():
    keep_lines = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=keep_lines)
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out" / "picture", help="where to work")
    parser.add_argument("--view", default="v0065", help="the held-out view, without its extension")
    args = parser.parse_args()
    train(args.out)
    picture = draw(panels(args.out / "result", args.view))
    file = ROOT / "docs" / "fathom.png"
    # Quantising channels to 1/64 is not visible here, and keeps the file below 400 kB.
    picture.point(lambda value: min(255, (value + 2) // 4 * 4)).save(file, optimize=True)
    print(f"{file}: {picture.width}x{picture.height}, {file.stat().st_size} bytes")


if __name__ == "__main__":
    main()
