#!/usr/bin/env python3
"""Upper bound of J from one photograph: PSNR of photographs inverted with the true water at the true ranges.

    scripts/one_photograph.py SCENE...

A SCENE comes from make_scene.py: `images`, and in `truth` the water, `clear` photographs, `valid` masks and ranges.
It has no camera noise, so the only losses are 8 bits and JPEG, times exp(beta_d r). A model exceeds this bound only
where other photographs saw a surface from nearer.
"""

import json
import sys
from pathlib import Path

import numpy
from PIL import Image


def linear(code):
    return numpy.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def encoded(light):
    return numpy.where(light <= 0.0031308, 12.92 * light, 1.055 * numpy.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def picture(path):
    return numpy.asarray(Image.open(path).convert("RGB")) / 255


def inverted(scene):
    """PSNR in dB of each photograph of `scene` with ranges: of all channels, then of red, green and blue."""
    water = json.loads((scene / "truth" / "water.json").read_text())
    beta_d, beta_b, b_inf = (numpy.array(water[key]) for key in ("beta_d_per_m", "beta_b_per_m", "b_inf_linear"))
    ranges = numpy.load(scene / "truth" / "depth_m.npz")
    for name in ranges.files:
        distance = ranges[name].astype(float)[..., None]
        photograph = next((scene / "images").glob(Path(name).stem + ".*"))
        clear = next((scene / "truth" / "clear").glob(Path(name).stem + ".*"))
        valid = numpy.asarray(Image.open(scene / "truth" / "valid" / (Path(name).stem + ".png")).convert("L")) > 127
        veil = b_inf * (1 - numpy.exp(-beta_b * distance))
        light = (linear(picture(photograph)) - veil) * numpy.exp(beta_d * distance)
        error = ((encoded(light.clip(0, 1)) - picture(clear)) ** 2)[valid].mean(axis=0)
        yield -10 * numpy.log10([error.mean(), *error])


for argument in sys.argv[1:] or sys.exit(__doc__):
    rows = numpy.array(list(inverted(Path(argument))))
    every, *channels = rows.mean(axis=0)
    shown = ", ".join(f"{channel:.2f}" for channel in channels)
    print(f"{argument}: {every:.2f} dB; red, green and blue {shown}; {len(rows)} photographs")
