#!/usr/bin/env python3
"""Trains a scene with the published trainer VkSplat and reports its cost and quality as one JSON object.

    scripts/peers/vksplat.py SCENE --steps N --cap N [--width-limit PX | --images FOLDER] [...]

scripts/peers/vksplat.sh builds VkSplat. SCENE has images/ and sparse/0 as COLMAP writes them. The strategy is
its MCMC with the settings of its MCMCTrainerConfig; its schedule ends with the run. Every 8th photograph by
name is held out, as VkSplat and Fathom do. A PSNR is that of a render over black, clamped and rounded to 8
bits, against the photograph as trained; the mean over photographs.

Photographs are made smaller here as Fathom does it: by the exact area average in linear light, the longer
side at most PX. Times exclude loading and evaluation. VkSplat's own output goes to stderr.
"""

import argparse
import ctypes
import json
import os
import random
import struct
import sys
import tempfile
import time
import types
from pathlib import Path

HERE = Path(__file__).resolve()
OUT = Path(os.environ.get("PEERS_OUT") or HERE.parents[2] / "target/peers/vksplat").resolve()
HOLD_OUT = 8
LAST = 100
# Names and numbers of parameters of COLMAP's camera models by id.
MODELS = [("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
          ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
          ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)]


def stop(message):
    sys.exit(f"vksplat: {message}")


def built():
    """What the build says about itself. Goes on in the Python that the module was built for."""
    try:
        build = json.loads((OUT / "build.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        stop(f"{OUT} has no build; run scripts/peers/vksplat.sh build --native, or --fallback without a GPU")
    if sys.executable != build["python"] and "VKSPLAT_PYTHON" not in os.environ:
        if not Path(build["python"]).exists():
            stop(f"{OUT} was built for {build['python']}, which is gone; run scripts/peers/vksplat.sh again")
        os.environ["VKSPLAT_PYTHON"] = build["python"]
        os.execv(build["python"], [build["python"], str(HERE), *sys.argv[1:]])
    return build


def arguments():
    summary, details = __doc__.split("\n\n", 1)
    parser = argparse.ArgumentParser(description=summary, epilog=details,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--cap", type=int, required=True, help="most Gaussians")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--width-limit", type=int, metavar="PX", help="longer side of a picture")
    size.add_argument("--images", help="folder of the scene with smaller photographs, such as images_4")
    parser.add_argument("--evaluate-at", default="", metavar="N,N", help="steps; default: the last")
    parser.add_argument("--initial-points", type=int, metavar="N", help="keep N points, chosen by the seed")
    parser.add_argument("--max-steps-of-schedule", type=int, metavar="N", help="default: the steps")
    parser.add_argument("--sh-interval", type=int, default=1000, metavar="N",
                        help="steps between two degrees of the harmonics; 1: all at once. "
                             "Default 1000 (VkSplat)")
    parser.add_argument("--refine-start", type=int, metavar="N", help="default 500 (VkSplat)")
    parser.add_argument("--refine-every", type=int, metavar="N", help="default 100 (VkSplat)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", type=int, default=-1, help="number in its list; default: its choice")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER",
                        help="write each held-out render beside its photograph, at the last evaluation")
    given = parser.parse_args()
    try:
        given.evaluate_at = sorted({int(at) for at in given.evaluate_at.split(",") if at} or {given.steps})
    except ValueError:
        parser.error(f"--evaluate-at {given.evaluate_at}: use numbers and commas")
    if given.steps < 1 or given.cap < 1 or given.sh_interval < 1:
        parser.error("--steps, --cap and --sh-interval must be at least 1")
    if not all(1 <= at <= given.steps for at in given.evaluate_at):
        parser.error("--evaluate-at: between 1 and the steps")
    return given


# The scene

def words_of(path):
    """Lines of a text file of COLMAP as words, without comments; an empty line is an empty list."""
    with open(path, encoding="utf-8") as file:
        return [line.split() for line in file if not line.startswith("#")]


def read_scene(folder):
    """Cameras by id (model, width, height, parameters), images (pose, camera, name), points (xyz, rgb)."""
    if (folder / "cameras.bin").exists():
        return read_binary(folder)
    if not (folder / "cameras.txt").exists():
        stop(f"{folder} has neither cameras.bin nor cameras.txt")
    ids = {name: number for number, (name, _) in enumerate(MODELS)}
    cameras, images, points = {}, [], []
    for line in filter(None, words_of(folder / "cameras.txt")):
        if line[1] not in ids:
            stop(f"VkSplat does not know the camera model {line[1]}")
        cameras[int(line[0])] = (ids[line[1]], int(line[2]), int(line[3]), [float(x) for x in line[4:]])
    # The second line of an image is its observations, which may be empty.
    for line in words_of(folder / "images.txt")[::2]:
        if line:
            images.append(([float(x) for x in line[1:8]], int(line[8]), " ".join(line[9:])))
    for line in filter(None, words_of(folder / "points3D.txt")):
        points.append(([float(x) for x in line[1:4]], [int(x) for x in line[4:7]]))
    return cameras, images, points


def read_binary(folder):
    def reader(name):
        data, at = (folder / name).read_bytes(), [0]

        def take(layout):
            values = struct.unpack_from("<" + layout, data, at[0])
            at[0] += struct.calcsize("<" + layout)
            return values

        def text():
            end = data.index(b"\0", at[0])
            begin, at[0] = at[0], end + 1
            return data[begin:end].decode()

        def skip(count):
            at[0] += count

        return take, text, skip

    cameras, images, points = {}, [], []
    take, _, _ = reader("cameras.bin")
    for _ in range(*take("Q")):
        number, model, width, height = take("iiQQ")
        if not 0 <= model < len(MODELS):
            stop(f"VkSplat does not know the camera model {model}")
        cameras[number] = (model, width, height, list(take(f"{MODELS[model][1]}d")))
    take, text, skip = reader("images.bin")
    for _ in range(*take("Q")):
        _, *pose, camera = take("i7di")
        images.append((pose, camera, text()))
        skip(24 * take("Q")[0])
    take, _, skip = reader("points3D.bin")
    for _ in range(*take("Q")):
        _, x, y, z, *rgb, _, track = take("Q3d3BdQ")
        points.append(([x, y, z], rgb))
        skip(8 * track)
    return cameras, images, points


def write_scene(folder, cameras, images, points):
    """The same for VkSplat, without observations, which it does not use."""
    with open(folder / "cameras.bin", "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for number, (model, width, height, values) in cameras.items():
            file.write(struct.pack(f"<iiQQ{len(values)}d", number, model, width, height, *values))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for number, (pose, camera, name) in enumerate(images, 1):
            file.write(struct.pack("<i7di", number, *pose, camera) + name.encode() + struct.pack("<xQ", 0))
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(points)))
        for number, (xyz, rgb) in enumerate(points, 1):
            file.write(struct.pack("<Q3d3BdQ", number, *xyz, *rgb, 0.0, 0))


def resized(camera, width, height):
    """A camera with its focal lengths and centre for another picture size."""
    model, old_width, old_height, values = camera
    x, y = width / old_width, height / old_height
    one_focal = MODELS[model][0].startswith("SIMPLE") or MODELS[model][0].startswith("RADIAL")
    if one_focal and x != y and MODELS[model][0] == "SIMPLE_PINHOLE":
        # Sizes are rounded, so that the factors of the two axes differ by a little.
        model, values, one_focal = 1, [values[0], *values], False
    factors = [x, x, y] if one_focal else [x, y, x, y]
    values = [value * factor for value, factor in zip(values, factors)] + values[len(factors):]
    return model, width, height, values


def area_weights(size, old):
    """Share of each old pixel in each new one along one axis."""
    import numpy as np
    borders = np.arange(size + 1) * old / size
    pixels = np.arange(old)
    overlap = np.minimum(borders[1:, None], pixels + 1) - np.maximum(borders[:-1, None], pixels)
    return (np.clip(overlap, 0, None) * size / old).astype(np.float32)


def reduced(picture, width, height):
    """The exact area average in linear light."""
    import numpy as np
    code = np.arange(256) / 255
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)
    rows, columns = area_weights(height, picture.shape[0]), area_weights(width, picture.shape[1])
    mean = np.stack([rows @ linear[picture[..., c]] @ columns.T for c in range(3)], axis=-1)
    mean = np.clip(mean, 0, 1).astype(np.float64)
    srgb = np.where(mean <= 0.0031308, mean * 12.92, 1.055 * mean ** (1 / 2.4) - 0.055)
    return np.floor(srgb * 255 + 0.5).astype(np.uint8)


def prepare(given, into):
    """Writes the scene that VkSplat reads; returns the pictures by name (RGB) and the number of points."""
    import cv2
    import numpy as np
    sparse = given.scene / "sparse/0"
    photographs = given.scene / (given.images or "images")
    for folder in (sparse, photographs):
        if not folder.is_dir():
            stop(f"{folder} is no folder")
    cameras, images, points = read_scene(sparse)
    count = given.initial_points or len(points)
    if not 1 <= count <= len(points):
        stop(f"--initial-points {count}: the scene has {len(points)}")
    if count > given.cap:
        stop(f"--cap {given.cap} is below the {count} initial points; use --initial-points")
    kept = np.sort(np.random.default_rng(given.seed).permutation(len(points))[:count])
    new_cameras, pictures = {}, {}
    for _, number, name in images:
        picture = cv2.imread(str(photographs / name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            stop(f"cannot read {photographs / name}")
        picture = picture[..., ::-1]
        height, width = picture.shape[:2]
        longest = max(width, height)
        if given.width_limit and longest > given.width_limit:
            scale = given.width_limit / longest
            width, height = (max(1, int(side * scale + 0.5)) for side in (width, height))
            picture = reduced(picture, width, height)
        if number in new_cameras and new_cameras[number][1:3] != (width, height):
            stop(f"{name} has another size than the other photographs of its camera")
        new_cameras[number] = resized(cameras[number], width, height)
        # VkSplat goes by the content of a file, so it keeps the name and with it the order.
        path = into / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        png = cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        path.write_bytes(png.tobytes())
        pictures[name] = picture
    (into / "sparse").mkdir()
    write_scene(into / "sparse", new_cameras, images, [points[i] for i in kept])
    return pictures, count


# VkSplat

def load_module():
    try:
        # The module does not name it, so that no Vulkan library is needed to build it.
        ctypes.CDLL("libvulkan.so.1", mode=ctypes.RTLD_GLOBAL)
    except OSError as error:
        stop(f"there is no Vulkan loader ({error}); apt-get install libvulkan1")
    sys.path.insert(0, str(OUT))
    # Its trainer script has the settings; it imports a progress bar.
    sys.modules.setdefault("tqdm", types.SimpleNamespace(tqdm=None))
    try:
        import simple_trainer
        import vksplat
    except ImportError as error:
        stop(f"{OUT} is incomplete or for another Python ({error}); run scripts/peers/vksplat.sh build again")
    return vksplat, simple_trainer


def configuration(trainer, given, scene):
    """Its settings, as a dictionary; `scene` is the prepared folder."""
    from dataclasses import asdict
    config = trainer.MCMCTrainerConfig()
    config.output_dir = config.output_ply = ""
    config.dataset_dir, config.mask_dir = f"{scene}/", ""
    config.image_dir, config.sparse_dir = f"{scene}/images/", f"{scene}/sparse/"
    config.eval_interval = HOLD_OUT
    config.train_steps = given.steps
    config.max_steps = given.max_steps_of_schedule or given.steps
    config.cap_max = given.cap
    if given.refine_start is not None:
        config.refine_start_iter = given.refine_start
    if given.refine_every is not None:
        config.refine_every = given.refine_every
    return asdict(config)


def driver_of(adapter):
    """Name and version of the driver of an adapter, which VkSplat does not report."""
    vulkan = ctypes.CDLL("libvulkan.so.1")
    pointer = ctypes.c_void_p
    application = struct.pack("@IxxxxPPIxxxxPII", 0, 0, 0, 0, 0, 0, 1 << 22 | 2 << 12)
    application = ctypes.create_string_buffer(application)
    create = struct.pack("@IxxxxPIxxxxPIxxxxPIxxxxP", 1, 0, 0, ctypes.addressof(application), 0, 0, 0, 0)
    instance, count = pointer(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(create, None, ctypes.byref(instance)) != 0:
        return "unknown"
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    devices = (pointer * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    found = "unknown"
    for device in devices:
        # VkPhysicalDeviceDriverProperties, and VkPhysicalDeviceProperties2 with some room at its end.
        driver = ctypes.create_string_buffer(struct.pack("@IxxxxP", 1000196000, 0), 544)
        properties = ctypes.create_string_buffer(
            struct.pack("@IxxxxP", 1000059001, ctypes.addressof(driver)), 2048)
        vulkan.vkGetPhysicalDeviceProperties2(pointer(device), properties)
        if properties.raw[36:292].split(b"\0")[0].decode() == adapter:
            found = " ".join(driver.raw[at:at + 256].split(b"\0")[0].decode() for at in (20, 276))
    vulkan.vkDestroyInstance(instance, None)
    return found


class Stages:
    """VkSplat's own times by stage, without those of the evaluations."""

    def __init__(self, module):
        self.module, self.start, self.apart = module, {}, {}

    def leave(self):
        self.start = self.module.get_timing_breakdown()

    def enter(self):
        for name, (count, seconds) in self.module.get_timing_breakdown().items():
            had = self.apart.get(name, (0, 0.0))
            before = self.start.get(name, (0, 0.0))
            self.apart[name] = had[0] + count - before[0], had[1] + seconds - before[1]

    def result(self):
        result = {}
        for name, (count, seconds) in self.module.get_timing_breakdown().items():
            apart = self.apart.get(name, (0, 0.0))
            if count > apart[0]:
                result[name] = {"count": count - apart[0], "seconds": seconds - apart[1]}
        return dict(sorted(result.items(), key=lambda item: -item[1]["seconds"]))


def evaluate(module, truths, names, into):
    import cv2
    import numpy as np
    total = 0.0
    for index, truth in enumerate(truths):
        module.render_val(index)
        # NaN would count as black.
        render = np.nan_to_num(module.pixel_state[..., :3])
        render = np.floor(np.clip(render, 0, 1) * 255 + 0.5).astype(np.uint8)
        if render.shape != truth.shape:
            stop(f"a render has {render.shape}, its photograph {truth.shape}")
        error = np.mean((render.astype(np.float64) - truth) ** 2) / 255 ** 2
        total += -10 * np.log10(max(error, 1e-12))
        if into:
            into.mkdir(parents=True, exist_ok=True)
            path = into / (names[index].replace("/", "_").rsplit(".", 1)[0] + ".png")
            cv2.imwrite(str(path), np.hstack([truth, render])[..., ::-1])
    return total / len(truths)


def gaussians(module, folder):
    """Their number at the end. Its arrays have the length of the cap, its file does not."""
    path = folder / "end.ply"
    module.write_ply(str(path))
    with open(path, "rb") as file:
        for line in file:
            if line.startswith(b"element vertex"):
                return int(line.split()[2])
    return None


def train(module, given, truths, names):
    random.seed(given.seed)
    stages, costs, held_out = Stages(module), [], []
    order = list(range(module.num_train))
    for step in range(given.steps):
        # As in its trainer: the first round in order.
        if step > 0 and step % len(order) == 0:
            random.shuffle(order)
        wall, cpu = time.perf_counter(), time.process_time()
        module.train_step(order[step % len(order)], step)
        costs.append((time.perf_counter() - wall, time.process_time() - cpu))
        if step + 1 in given.evaluate_at:
            stages.leave()
            last = step + 1 == given.evaluate_at[-1]
            psnr = evaluate(module, truths, names, given.pictures if last else None)
            stages.enter()
            held_out.append({"step": step + 1, "psnr": psnr})
            print(f"step {step + 1}: {psnr:.2f} dB", file=sys.stderr, flush=True)
    return costs, held_out, stages.result()


def main():
    given = arguments()
    build = built()
    # VkSplat prints to the standard output, which is for the result.
    result_file = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    os.environ["VKSPLAT_SH_INTERVAL"] = str(given.sh_interval)
    if build["kind"] == "fallback":
        os.environ.setdefault("LP_NATIVE_VECTOR_WIDTH", str(32 * build["subgroup_size"]))
    vksplat, trainer = load_module()
    with tempfile.TemporaryDirectory(prefix="vksplat-") as folder:
        folder = Path(folder)
        pictures, points = prepare(given, folder)
        module = vksplat.VkSplat()
        try:
            module.initialize(f"{OUT}/shader/", given.device)
            config = configuration(trainer, given, folder)
            device = module.set_train_config(config)["device"]
        except vksplat.RuntimeError as error:  # its own class
            stop(f"VkSplat does not start: {error}")
        if build["kind"] == "fallback" and device["subgroup_size"] != build["subgroup_size"]:
            stop(f"{device['name']} has subgroups of {device['subgroup_size']}, but the shaders were built "
                 f"for {build['subgroup_size']}; run scripts/peers/vksplat.sh build --native for a GPU")
        names = [os.path.relpath(module.get_val_image_path(i)["image_path"], folder / "images")
                 for i in range(module.num_val)]
        if names != sorted(pictures)[::HOLD_OUT] or module.num_train + module.num_val != len(pictures):
            stop("VkSplat holds out other photographs than every 8th by name")
        truths = [pictures[name] for name in names]
        for index, truth in enumerate(truths):
            if (module.get_val_image(index)[..., :3] != truth).any():
                stop(f"VkSplat reads {names[index]} as another picture")
        costs, held_out, stages = train(module, given, truths, names)
        peak, count = module.get_peak_vram_usage(), gaussians(module, folder)
        module.cleanup()
    sizes = sorted({(picture.shape[1], picture.shape[0]) for picture in pictures.values()})
    last = costs[-LAST:]
    result = {
        "program": "VkSplat", "commit": build["commit"], "build": build["kind"],
        "adapter": device["name"], "driver": driver_of(device["name"]),
        "scene": given.scene.resolve().name, "steps": given.steps, "cap": given.cap,
        "initial_points": points, "gaussians": count,
        "size": list(sizes[0]) if len(sizes) == 1 else [list(size) for size in sizes],
        "train_views": len(pictures) - len(names), "held_out_views": len(names),
        "cpu_seconds_per_step": sum(cpu for _, cpu in costs) / len(costs),
        "cpu_seconds_per_step_of_last_100": sum(cpu for _, cpu in last) / len(last),
        "wall_seconds_per_step": sum(wall for wall, _ in costs) / len(costs),
        "wall_seconds_per_step_of_last_100": sum(wall for wall, _ in last) / len(last),
        "peak_device_bytes": peak, "stages": stages, "held_out": held_out,
        "settings": {"seed": given.seed, "sh_interval": given.sh_interval,
                     **{key: config[key] for key in ("max_steps", "refine_start_iter", "refine_every")}},
    }
    json.dump(result, result_file, indent=1)
    result_file.write("\n")
    result_file.close()


if __name__ == "__main__":
    main()
