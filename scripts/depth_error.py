#!/usr/bin/env python3
"""Error of a model's depth where the truth is known: prints its median, m.

    scripts/depth_error.py FATHOM RESULT SCENE

SCENE/truth/depth_m.npz holds the depth along the camera's axis of some views by name, `[H, W]`, m, 0 where
there is nothing. RESULT is a result folder of `fathom train` in metres, FATHOM the program. Compares all
pixels that have a depth in both. Needs numpy.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

try:
    import numpy as np
except ImportError:
    sys.exit("depth_error: depths are read with numpy; install it with pip install numpy")


def main(fathom, result, scene):
    truth = np.load(Path(scene) / "truth" / "depth_m.npz")
    cameras = json.loads((Path(result) / "cameras.json").read_text())
    cameras = [camera for camera in cameras if Path(camera["img_name"]).stem in truth]
    if not cameras:
        sys.exit(f"depth_error: no camera of {result} has a depth in {scene}/truth/depth_m.npz")
    errors = []
    with tempfile.TemporaryDirectory() as folder:
        chosen, maps = Path(folder) / "cameras.json", Path(folder) / "maps"
        chosen.write_text(json.dumps(cameras))
        words = [fathom, "render", result, "--allow-cpu", "--cameras", chosen, "--maps", "range", "-o", maps]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        for camera in cameras:
            name = Path(camera["img_name"]).stem
            ranges, depths = np.load(maps / "range" / f"{name}.npy"), truth[name].astype(float)
            rows, columns = np.indices(ranges.shape) + 0.5
            x = (columns - camera["cx"]) / camera["fx"]
            y = (rows - camera["cy"]) / camera["fy"]
            both = (depths > 0) & (ranges > 0)
            errors.append(np.abs(ranges / np.sqrt(1 + x * x + y * y) - depths)[both])
    print(f"{np.median(np.concatenate(errors)):.4f}")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
