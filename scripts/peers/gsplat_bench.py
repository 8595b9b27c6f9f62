#!/usr/bin/env python3
"""Times the CUDA kernels of gsplat on the inputs of Fathom, and trains a scene with gsplat.

    gsplat_bench.py stages SCENE_FILE [--repeats 20]
    gsplat_bench.py train SCENE [--steps 3000] [--cap 1000000] [--seconds 60] [--max-resolution 1600]

Run it through gsplat.sh, which finds the built gsplat. Each verb prints one JSON object on stdout; everything
else goes to stderr. Needs torch, numpy and Pillow. Exits with 3 without a CUDA GPU.

SCENE_FILE is one line of JSON ({"gaussians", "width", "height", "fx", "fy", "cx", "cy", "sh_degree",
"viewmat": 16 numbers, row-major, world to camera, x right, y down, z forward}) and then little-endian f32:
means N*3, quaternions N*4 (w x y z), log scales N*3, opacity logits N, harmonics N*16*3.
SCENE is a folder with images/ and sparse/0/*.bin of COLMAP, undistorted.

--rehearse runs every line without a GPU: gsplat's reference functions in plain PyTorch take the place of its
kernels. They are slow, so use few Gaussians (--points), small pictures and few steps; its times mean nothing.
"""

import argparse
import contextlib
import importlib.util
import json
import math
import statistics
import struct
import sys
import time
import types
from pathlib import Path

import numpy as np
import torch

# The gradient of the picture in every channel, the same as in Fathom's own bench.
PICTURE_GRADIENT = 0.3
WARM_UPS = 3
TILE = 16

# The settings of gsplat's examples/simple_trainer.py with its preset "mcmc".
MAX_STEPS = 30_000
SH_DEGREE = 3
SH_DEGREE_INTERVAL = 1000
INIT_OPACITY = 0.5
INIT_SCALE = 0.1
SSIM_LAMBDA = 0.2
OPACITY_REG = 0.01
SCALE_REG = 0.01
TEST_EVERY = 8
SEED = 42
RATES = {
    "means": 1.6e-4,  # times the size of the scene
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}


def fail(message, code=1):
    print(f"gsplat_bench: {message}", file=sys.stderr)
    raise SystemExit(code)


# ---- The operations: gsplat's kernels, or its reference functions --------------------------------


class Camera:
    """A pinhole camera as gsplat takes it: a batch of one."""

    def __init__(self, viewmat, fx, fy, cx, cy, width, height, device):
        self.width, self.height = width, height
        self.viewmats = torch.tensor(viewmat, dtype=torch.float32, device=device).reshape(1, 4, 4)
        k = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        self.ks = torch.tensor(k, dtype=torch.float32, device=device).reshape(1, 3, 3)
        self.tile_width = math.ceil(width / TILE)
        self.tile_height = math.ceil(height / TILE)


class Kernels:
    """gsplat's kernels with the arguments that its rasterization(packed=False) gives them."""

    rehearsal = False

    def __init__(self):
        if not torch.cuda.is_available():
            fail("there is no CUDA GPU", 3)
        found = importlib.util.find_spec("gsplat")
        # Without this, gsplat would start to compile everything when it is first used.
        if found is None or not list(Path(found.origin).parent.glob("csrc*.so")):
            fail("gsplat is not built; run gsplat.sh build, and this through gsplat.sh run")
        import gsplat

        self.gsplat = gsplat
        self.device = torch.device("cuda")
        self.has_selective_adam = gsplat.has_adam()

    def project(self, means, quats, scales, opacities, camera):
        radii, means2d, depths, conics, _ = self.gsplat.fully_fused_projection(
            means, None, quats, scales, camera.viewmats, camera.ks, camera.width, camera.height,
            packed=False, opacities=opacities,
        )
        return radii, means2d, depths, conics

    def harmonics(self, degree, means, sh, radii, camera):
        visible = (radii > 0).all(dim=-1)
        colours = self.gsplat.spherical_harmonics(degree, means, camera.viewmats, sh, masks=visible)
        return torch.clamp_min(colours + 0.5, 0.0)

    def intersect(self, means2d, radii, depths, conics, opacities, camera):
        _, isect_ids, flatten_ids = self.gsplat.isect_tiles(
            means2d, radii, depths, TILE, camera.tile_width, camera.tile_height,
            sort=True, packed=False, n_images=1, conics=conics, opacities=opacities[None],
        )
        return isect_ids, flatten_ids

    def offsets(self, isect_ids, camera):
        return self.gsplat.isect_offset_encode(isect_ids, 1, camera.tile_width, camera.tile_height)

    def rasterize(self, means2d, conics, colours, opacities, offsets, flatten_ids, camera):
        return self.gsplat.rasterize_to_pixels(
            means2d, conics, colours, opacities[None],
            camera.width, camera.height, TILE, offsets, flatten_ids,
        )

    def render(self, means, quats, scales, opacities, sh, degree, camera):
        """The picture as gsplat's trainer makes it, in one call. Returns it and the radii."""
        picture, _, info = self.gsplat.rasterization(
            means, quats, scales, opacities, sh, camera.viewmats, camera.ks, camera.width, camera.height,
            sh_degree=degree, packed=False,
        )
        return picture, info["radii"]


class Rehearsal:
    """The same operations in plain PyTorch, mostly those of gsplat/cuda/_torch_impl.py."""

    rehearsal = True
    has_selective_adam = True

    def __init__(self):
        # gsplat must not look for kernels, nor compile them.
        sys.modules["gsplat.cuda._backend"] = types.ModuleType("gsplat.cuda._backend")
        sys.modules["gsplat.cuda._backend"]._C = None
        import gsplat
        import gsplat.optimizers.selective_adam
        import gsplat.strategy.ops
        from gsplat.cuda import _math, _torch_impl

        self.gsplat, self.reference, self.math = gsplat, _torch_impl, _math
        self.device = torch.device("cpu")
        # The parts of the strategy and of SelectiveAdam that are kernels.
        gsplat.strategy.ops.compute_relocation = reference_relocation
        gsplat.strategy.ops.quat_scale_to_covar_preci = _math._quat_scale_to_covar_preci
        gsplat.optimizers.selective_adam.adam = reference_adam

    def project(self, means, quats, scales, opacities, camera):
        covars, _ = self.math._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
        radii, means2d, depths, conics, _ = self.reference._fully_fused_projection(
            means, covars, camera.viewmats, camera.ks, camera.width, camera.height
        )
        return radii, means2d, depths, conics

    def harmonics(self, degree, means, sh, radii, camera):
        rotation, translation = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
        directions = means + rotation.T @ translation
        colours = self.reference._spherical_harmonics(degree, directions[None], sh)
        colours = colours * (radii > 0).all(dim=-1)[..., None]
        return torch.clamp_min(colours + 0.5, 0.0)

    def intersect(self, means2d, radii, depths, conics, opacities, camera):
        _, isect_ids, flatten_ids = self.reference._isect_tiles(
            means2d, radii, depths, TILE, camera.tile_width, camera.tile_height
        )
        return isect_ids, flatten_ids

    def offsets(self, isect_ids, camera):
        return self.reference._isect_offset_encode(isect_ids, 1, camera.tile_width, camera.tile_height)

    def rasterize(self, means2d, conics, colours, opacities, offsets, flatten_ids, camera):
        # gsplat's reference of this one still calls a kernel, so this is our own, tile by tile.
        starts = offsets.flatten().tolist() + [len(flatten_ids)]
        picture = torch.zeros(camera.tile_height * TILE, camera.tile_width * TILE, 3)
        alpha = torch.zeros(camera.tile_height * TILE, camera.tile_width * TILE, 1)
        for tile in range(camera.tile_width * camera.tile_height):
            ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
            if len(ids) == 0:
                continue
            y, x = tile // camera.tile_width * TILE, tile % camera.tile_width * TILE
            blended = blend_tile(x, y, means2d[0, ids], conics[0, ids], colours[0, ids], opacities[ids])
            picture[y : y + TILE, x : x + TILE], alpha[y : y + TILE, x : x + TILE] = blended
        size = (slice(camera.height), slice(camera.width))
        return picture[size][None], alpha[size][None]

    def render(self, means, quats, scales, opacities, sh, degree, camera):
        radii, means2d, depths, conics = self.project(means, quats, scales, opacities, camera)
        colours = self.harmonics(degree, means, sh, radii, camera)
        isect_ids, flatten_ids = self.intersect(means2d, radii, depths, conics, opacities, camera)
        offsets = self.offsets(isect_ids, camera)
        picture, _ = self.rasterize(means2d, conics, colours, opacities, offsets, flatten_ids, camera)
        return picture, radii


def blend_tile(x, y, means2d, conics, colours, opacities):
    """The colours and alphas of a tile whose upper left pixel is (x, y), from Gaussians sorted by depth."""
    rows, columns = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="ij")
    dx = (columns + x + 0.5)[..., None] - means2d[:, 0]
    dy = (rows + y + 0.5)[..., None] - means2d[:, 1]
    power = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = torch.clamp_max(opacities * torch.exp(-power), 0.99)
    alpha = torch.where((power >= 0) & (alpha >= 1 / 255), alpha, torch.zeros_like(alpha))
    passed = torch.cumprod(1 - alpha, dim=-1)
    before = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], dim=-1)
    return (alpha * before) @ colours, 1 - passed[..., -1:]


def reference_relocation(opacities, scales, ratios, binoms, min_opacity):
    """Equation 9 of the MCMC paper: `ratio` equal Gaussians that together look like the old one."""
    n_max = len(binoms)
    ratios = ratios.clamp(1, n_max).long()
    new_opacities = 1 - (1 - opacities) ** (1 / ratios)
    new_opacities = new_opacities.clamp(min_opacity, 1 - 1e-6)
    factors = []
    for opacity, new, ratio in zip(opacities.tolist(), new_opacities.tolist(), ratios.tolist()):
        terms = (
            float(binoms[i, k]) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for i in range(ratio)
            for k in range(i + 1)
        )
        factors.append(opacity / sum(terms))
    return new_opacities, scales * torch.tensor(factors)[:, None]


def reference_adam(param, grad, exp_avg, exp_avg_sq, visible, rate, beta1, beta2, eps):
    """What gsplat's kernel for SelectiveAdam does; like it, without bias correction."""
    shape = (-1,) + (1,) * (param.dim() - 1)
    visible = visible.reshape(shape)
    exp_avg.copy_(torch.where(visible, beta1 * exp_avg + (1 - beta1) * grad, exp_avg))
    exp_avg_sq.copy_(torch.where(visible, beta2 * exp_avg_sq + (1 - beta2) * grad * grad, exp_avg_sq))
    param.sub_(torch.where(visible, rate * exp_avg / (exp_avg_sq.sqrt() + eps), torch.zeros_like(param)))


# ---- Measuring -----------------------------------------------------------------------------------


class GpuClock:
    """CUDA events."""

    def time(self, run, prepare, repeats, pause):
        """Milliseconds of each repeat. With `pause` the GPU first waits about 2 ms while the host launches
        the kernels, so that short stages are not measured as the speed of Python; a stage that itself
        waits for the GPU (tile intersection does) still contains its wait."""
        events = []
        for _ in range(WARM_UPS + repeats):
            prepare()
            pair = (torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True))
            if pause:
                torch.cuda._sleep(4_000_000)
            pair[0].record()
            run()
            pair[1].record()
            events.append(pair)
            if pause:
                torch.cuda.synchronize()
        torch.cuda.synchronize()
        return [start.elapsed_time(end) for start, end in events[WARM_UPS:]]

    def wait(self):
        torch.cuda.synchronize()

    def reset_peak(self):
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()

    def peak(self):
        return torch.cuda.max_memory_allocated()


class HostClock:
    """Stands in for GpuClock in a rehearsal."""

    def time(self, run, prepare, repeats, pause):
        times = []
        for _ in range(WARM_UPS + repeats):
            prepare()
            start = time.perf_counter()
            run()
            times.append((time.perf_counter() - start) * 1e3)
        return times[WARM_UPS:]

    def wait(self):
        pass

    def reset_peak(self):
        pass

    def peak(self):
        return None


def summary(times):
    return {"median_ms": statistics.median(times), "min_ms": min(times), "max_ms": max(times)}


def commit_of(module):
    """The commit that gsplat.sh pack wrote beside a package."""
    path = Path(module.__file__).resolve().parent.parent / "COMMIT"
    return path.read_text().strip() if path.is_file() else "unknown"


def ssim_used(ops):
    """Which SSIM gsplat.losses.ssim_loss takes: it prefers fused_ssim."""
    try:
        import fused_ssim
    except ImportError:
        return "torch conv2d 11x11"
    return "torch conv2d 11x11" if ops.rehearsal else f"fused_ssim {commit_of(fused_ssim)}"


def header(ops, verb):
    return {
        "program": "gsplat",
        "version": ops.gsplat.__version__,
        "commit": commit_of(ops.gsplat),
        "verb": verb,
        "rehearsal": ops.rehearsal,
        "adapter": "none" if ops.rehearsal else torch.cuda.get_device_name(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
    }


# ---- Stages --------------------------------------------------------------------------------------


def read_scene(path, points, device):
    """The header, the six tensors that gsplat's trainer optimises, and the camera."""
    with open(path, "rb") as file:
        head = json.loads(file.readline())
        values = np.fromfile(file, dtype="<f4")
    n = head["gaussians"]
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (16, 3)}
    expected = n * sum(math.prod(shape) for shape in shapes.values())
    if len(values) != expected:
        fail(f"{path} has {len(values)} numbers after its header instead of {expected}")
    params, at = {}, 0
    for name, shape in shapes.items():
        size = n * math.prod(shape)
        tensor = torch.from_numpy(values[at : at + size].reshape(n, *shape))
        params[name] = tensor[:points].contiguous().to(device)
        at += size
    sh = params.pop("sh")
    params["sh0"], params["shN"] = sh[:, :1].contiguous(), sh[:, 1:].contiguous()
    intrinsics = [head[key] for key in ("fx", "fy", "cx", "cy")]
    camera = Camera(head["viewmat"], *intrinsics, head["width"], head["height"], device)
    return head, params, camera


def activate(log_scales, logits):
    return torch.exp(log_scales), torch.sigmoid(logits)


def concatenate(sh0, shN):
    return torch.cat([sh0, shN], 1)


class Operation:
    """One operation on inputs that are cut from the graph, so that its backward pass runs alone."""

    def __init__(self, function, *inputs):
        self.function = function
        self.inputs = [tensor.detach().requires_grad_() for tensor in inputs]
        self.outputs = function(*self.inputs)
        if torch.is_tensor(self.outputs):
            self.outputs = (self.outputs,)

    def forward(self):
        self.function(*self.inputs)

    def forget(self):
        """As zero_grad(set_to_none=True): the next backward pass stores its gradients and does not add."""
        for tensor in self.inputs:
            tensor.grad = None

    def backward(self, gradients):
        torch.autograd.backward(self.outputs[: len(gradients)], gradients, retain_graph=True)

    def gradients(self, upstream):
        """The gradients of the inputs, given those of the first outputs."""
        self.forget()
        self.backward(upstream)
        return [tensor.grad for tensor in self.inputs]


class Stages:
    """Times the stages of one training step."""

    def __init__(self, ops, clock, repeats, params, camera, degree):
        self.ops, self.clock, self.repeats = ops, clock, repeats
        self.params, self.camera, self.degree = params, camera, degree
        self.result = {}

    def measure(self, name, run, prepare=lambda: None):
        stage = summary(self.clock.time(run, prepare, self.repeats, pause=True))
        # Also without the pause: what a lone call takes, with the time that the host needs to launch it.
        stage["alone_median_ms"] = statistics.median(self.clock.time(run, prepare, self.repeats, pause=False))
        self.result[name] = stage

    def measure_backward(self, name, operation, upstream):
        self.measure(name, lambda: operation.backward(upstream), operation.forget)
        return operation.gradients(upstream)

    def run(self):
        """Returns the picture and the counts."""
        ops, camera, params = self.ops, self.camera, self.params
        activation = Operation(activate, params["scales"], params["opacities"])
        scales, opacities = (tensor.detach() for tensor in activation.outputs)
        concatenation = Operation(concatenate, params["sh0"], params["shN"])

        def project(means, quats, scales):
            # The outputs with gradients come first. The opacities only bound the radii.
            radii, means2d, depths, conics = ops.project(means, quats, scales, opacities, camera)
            return means2d, conics, radii, depths

        projection = Operation(project, params["means"], params["quats"], scales)
        means2d, conics, radii, depths = (tensor.detach() for tensor in projection.outputs)

        def colour(means, sh):
            return ops.harmonics(self.degree, means, sh, radii, camera)

        harmonics = Operation(colour, params["means"], concatenation.outputs[0])
        intersect = lambda: ops.intersect(means2d, radii, depths, conics, opacities, camera)  # noqa: E731
        isect_ids, flatten_ids = intersect()
        offsets = ops.offsets(isect_ids, camera)

        def rasterize(means2d, conics, colours, opacities):
            return ops.rasterize(means2d, conics, colours, opacities, offsets, flatten_ids, camera)

        raster = Operation(rasterize, means2d, conics, harmonics.outputs[0], opacities)
        picture = raster.outputs[0]

        self.measure("activations_forward", activation.forward)
        self.measure("harmonics_concatenation_forward", concatenation.forward)
        self.measure("projection_forward", projection.forward)
        self.measure("harmonics_forward", harmonics.forward)
        self.measure("intersect_and_sort", intersect)
        self.measure("tile_offsets", lambda: ops.offsets(isect_ids, camera))
        self.measure("rasterize_forward", raster.forward)

        upstream = [torch.full_like(picture, PICTURE_GRADIENT)]
        gradients = self.measure_backward("rasterize_backward", raster, upstream)
        v_means2d, v_conics, v_colours, v_opacities = gradients
        _, v_sh = self.measure_backward("harmonics_backward", harmonics, [v_colours])
        self.measure_backward("harmonics_concatenation_backward", concatenation, [v_sh])
        upstream = [v_means2d, v_conics]
        _, _, v_scales = self.measure_backward("projection_backward", projection, upstream)
        self.measure_backward("activations_backward", activation, [v_scales, v_opacities])
        self.gradients = {"scales": v_scales, "opacities": v_opacities, "sh": v_sh}
        visible = (radii > 0).all(dim=-1)
        return picture.detach(), {"visible": int(visible.sum()), "intersections": len(flatten_ids)}


def render_params(ops, params, degree, camera):
    """The picture of trained parameters, as simple_trainer's rasterize_splats."""
    scales, opacities = activate(params["scales"], params["opacities"])
    sh = concatenate(params["sh0"], params["shN"])
    return ops.render(params["means"], params["quats"], scales, opacities, sh, degree, camera)


def make_optimizers(params, rates):
    """One optimiser for each tensor, as simple_trainer has them."""
    return {
        name: torch.optim.Adam(
            [{"params": param, "lr": rates[name], "name": name}], eps=1e-15, betas=(0.9, 0.999), fused=True
        )
        for name, param in params.items()
    }


def step_optimizers(optimizers):
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)


def trainable(params):
    return torch.nn.ParameterDict({name: torch.nn.Parameter(p.clone()) for name, p in params.items()})


def measure_whole_step(ops, clock, repeats, params, camera, degree):
    """Rendering, backward pass and Adam together through gsplat's own rasterization(), and peak memory."""
    clock.reset_peak()
    params = trainable(params)
    # A rate of 0 does the same work and keeps the scene as it is, so that all repeats measure the same one.
    optimizers = make_optimizers(params, dict.fromkeys(params, 0.0))

    def step():
        picture, _ = render_params(ops, params, degree, camera)
        picture.backward(torch.full_like(picture, PICTURE_GRADIENT))
        step_optimizers(optimizers)

    # Steps follow each other without a pause, as in training.
    times = clock.time(step, lambda: None, repeats, pause=False)
    with torch.no_grad():
        picture, radii = render_params(ops, params, degree, camera)
    return summary(times), clock.peak(), picture, (radii > 0).all(dim=-1).any(0)


def relative_difference(found, expected):
    """The norm of the difference over the norm."""
    return ((found - expected).norm() / expected.norm().clamp_min(1e-20)).item()


def measure_render(ops, stages, params, camera, degree):
    """gsplat's rasterization() in one call. It evaluates the harmonics by another, fused kernel than the
    stage harmonics_forward, so its time is not the sum of the stages."""
    scales, opacities = activate(params["scales"], params["opacities"])
    sh = concatenate(params["sh0"], params["shN"])

    def render(means, quats, scales, opacities, sh):
        return ops.render(means, quats, scales, opacities, sh, degree, camera)[0]

    operation = Operation(render, params["means"], params["quats"], scales, opacities, sh)
    stages.measure("rasterization_call_forward", operation.forward)
    upstream = [torch.full_like(operation.outputs[0], PICTURE_GRADIENT)]
    gradients = stages.measure_backward("rasterization_call_backward", operation, upstream)
    _, _, v_scales, v_opacities, v_sh = gradients
    return {
        "scales": relative_difference(stages.gradients["scales"], v_scales),
        "opacities": relative_difference(stages.gradients["opacities"], v_opacities),
        "sh": relative_difference(stages.gradients["sh"], v_sh),
    }


def measure_adam(ops, stages, params, visible):
    """Both of gsplat's optimisers, on gradients of the size of the parameters."""
    params = trainable(params)
    for param in params.values():
        param.grad = torch.full_like(param, 1e-3)
    fused = make_optimizers(params, dict.fromkeys(params, 0.0))
    stages.measure("adam_fused", lambda: [optimizer.step() for optimizer in fused.values()])
    del fused
    if not ops.has_selective_adam:
        return
    selective = [
        ops.gsplat.SelectiveAdam([{"params": param, "lr": 0.0}], eps=1e-15, betas=(0.9, 0.999))
        for param in params.values()
    ]
    stages.measure("adam_selective", lambda: [optimizer.step(visible) for optimizer in selective])


def stages_verb(ops, clock, arguments):
    head, params, camera = read_scene(arguments.scene, arguments.points, ops.device)
    degree = head["sh_degree"]
    # First, because its peak memory must not contain what the single stages keep.
    step, peak, picture, visible = measure_whole_step(ops, clock, arguments.repeats, params, camera, degree)
    stages = Stages(ops, clock, arguments.repeats, params, camera, degree)
    staged_picture, counts = stages.run()
    differences = measure_render(ops, stages, params, camera, degree)
    measure_adam(ops, stages, params, visible)
    return header(ops, "stages") | {
        "gaussians": len(params["means"]),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": degree,
        "repeats": arguments.repeats,
        **counts,
        "picture_mean": picture.mean().item(),
        # The stages make the same picture and gradients as gsplat's own call, up to rounding.
        "picture_difference": (picture - staged_picture).abs().max().item(),
        "gradient_differences": differences,
        "whole_step": step,
        "whole_step_peak_bytes": peak,
        "stages": stages.result,
    }


# ---- COLMAP scenes -------------------------------------------------------------------------------

# Model number: number of parameters, and where fx, fy, cx, cy are in them. Further ones are distortion.
COLMAP_MODELS = {
    0: (3, (0, 0, 1, 2)),  # SIMPLE_PINHOLE
    1: (4, (0, 1, 2, 3)),  # PINHOLE
    2: (4, (0, 0, 1, 2)),  # SIMPLE_RADIAL
    3: (5, (0, 0, 1, 2)),  # RADIAL
    4: (8, (0, 1, 2, 3)),  # OPENCV
}


def unpack(file, layout):
    layout = "<" + layout
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def read_cameras(path):
    """Camera number: (width, height, fx, fy, cx, cy)."""
    cameras = {}
    with open(path, "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            number, model, width, height = unpack(file, "IiQQ")
            if model not in COLMAP_MODELS:
                fail(f"{path}: camera model {model} is not supported")
            count, places = COLMAP_MODELS[model]
            values = unpack(file, f"{count}d")
            if any(values[max(places) + 1 :]):
                fail(f"{path}: camera {number} has distortion; undistort the scene first")
            cameras[number] = (width, height, *(values[place] for place in places))
    return cameras


def rotation_matrix(w, x, y, z):
    n = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / n, x / n, y / n, z / n
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_images(path):
    """(name, camera number, camera to world), sorted by name."""
    images = []
    with open(path, "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            _, *pose, camera = unpack(file, "I7dI")
            name = bytearray()
            while (byte := file.read(1)) != b"\0":
                if not byte:
                    fail(f"{path} ends too early")
                name += byte
            file.seek(24 * unpack(file, "Q")[0], 1)
            world_to_camera = np.eye(4)
            world_to_camera[:3, :3] = rotation_matrix(*pose[:4])
            world_to_camera[:3, 3] = pose[4:]
            images.append((name.decode(), camera, np.linalg.inv(world_to_camera)))
    return sorted(images, key=lambda image: image[0])


def read_points(path):
    """Positions and colours (0 to 255), sorted by number as gsplat's parser does."""
    points = []
    with open(path, "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            number, *values = unpack(file, "Q3d3Bd")
            file.seek(8 * unpack(file, "Q")[0], 1)
            points.append((number, *values[:6]))
    points = np.array(sorted(points), dtype=np.float64)
    return points[:, 1:4], points[:, 4:7]


def normalisation(camera_to_world):
    """gsplat's similarity_from_cameras: up is up, the point that the cameras look at is the origin, and the
    median distance of the cameras from it is 1. gsplat then also turns the scene to its principal axes; no
    distance changes by that, so it is left out."""
    rotations, centres = camera_to_world[:, :3, :3], camera_to_world[:, :3, 3]
    up = (rotations @ np.array([0.0, -1.0, 0.0])).mean(axis=0)
    up /= np.linalg.norm(up)
    target = np.array([0.0, -1.0, 0.0])
    x, y, z = np.cross(up, target)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    cosine = up @ target
    turn = np.eye(3) + skew + skew @ skew / (1 + cosine) if cosine > -1 else np.diag([-1.0, -1.0, 1.0])
    centres = centres @ turn.T
    forward = (turn @ rotations)[:, :, 2]
    nearest = centres - (forward * centres).sum(-1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1.0 / np.median(np.linalg.norm(centres + shift, axis=-1))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * scale, shift * scale
    return matrix, scale


def fitted(width, height, max_side):
    """The size with the longest side at most `max_side`, as Fathom's PinholeCamera::fitted rounds it."""
    longest = max(width, height)
    if longest <= max_side:
        return width, height
    return tuple(max(1, math.floor(side * (max_side / longest) + 0.5)) for side in (width, height))


def area_weights(size, source):
    """A matrix that averages `source` pixels to `size` by the area that they share."""
    borders = np.arange(size + 1) * source / size
    low = np.maximum(borders[:-1, None], np.arange(source))
    high = np.minimum(borders[1:, None], np.arange(source) + 1)
    weights = np.maximum(high - low, 0.0)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def srgb_to_linear(values):
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values):
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055)


def reduced(pixels, width, height):
    """The mean in linear light over the area of each pixel, as Fathom reduces pictures; 8 bits again."""
    if pixels.shape[:2] == (height, width):
        return pixels
    linear = srgb_to_linear(np.arange(256) / 255).astype(np.float32)[pixels]
    linear = np.einsum("yY,YXc->yXc", area_weights(height, pixels.shape[0]), linear, optimize=True)
    linear = np.einsum("xX,yXc->yxc", area_weights(width, pixels.shape[1]), linear, optimize=True)
    return np.floor(linear_to_srgb(linear) * 255 + 0.5).clip(0, 255).astype(np.uint8)


def read_picture(path):
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


class Scene:
    """The views and points of a COLMAP scene, normalised as gsplat's trainer does."""

    def __init__(self, folder, max_resolution, device):
        sparse = folder / "sparse" / "0"
        if not (sparse / "points3D.bin").is_file():
            fail(f"{folder} has no sparse/0 in COLMAP's binary form")
        cameras = read_cameras(sparse / "cameras.bin")
        images = read_images(sparse / "images.bin")
        points, self.colours = read_points(sparse / "points3D.bin")
        matrix, scale = normalisation(np.stack([pose for _, _, pose in images]))
        self.points = points @ matrix[:3, :3].T + matrix[:3, 3]
        self.views, centres = [], []
        for name, number, pose in images:
            width, height, fx, fy, cx, cy = cameras[number]
            pixels = read_picture(folder / "images" / name)
            if pixels.shape[:2] != (height, width):
                fail(f"{name} has another size than its camera")
            new_width, new_height = fitted(width, height, max_resolution)
            pixels = torch.from_numpy(reduced(pixels, new_width, new_height).copy()).to(device)
            sx, sy = new_width / width, new_height / height
            pose = matrix @ pose
            pose[:3, :3] /= scale
            centres.append(pose[:3, 3])
            viewmat = np.linalg.inv(pose).flatten().tolist()
            camera = Camera(viewmat, fx * sx, fy * sy, cx * sx, cy * sy, new_width, new_height, device)
            self.views.append((camera, pixels))
        centres = np.stack(centres)
        self.scale = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max() * 1.1
        self.test = self.views[::TEST_EVERY]
        self.train = [view for index, view in enumerate(self.views) if index % TEST_EVERY]


# ---- Training ------------------------------------------------------------------------------------


def mean_distance_to_neighbours(points):
    """Root mean square distance to the three nearest neighbours."""
    try:
        from scipy.spatial import KDTree
    except ImportError:
        pass
    else:
        # gsplat asks a tree on the CPU too. Comparing a million points with each other takes minutes.
        numbers = points.cpu().numpy()
        distances, _ = KDTree(numbers).query(numbers, k=4, workers=-1)
        return torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(axis=1))).to(points)
    # In parts, so that few distances exist at once.
    rows = max(1, 50_000_000 // len(points))
    parts = []
    for start in range(0, len(points), rows):
        # Without matrix products, which lose small distances to rounding.
        mode = "donot_use_mm_for_euclid_dist"
        distances = torch.cdist(points[start : start + rows], points, compute_mode=mode)
        nearest = distances.topk(4, largest=False).values[:, 1:]
        parts.append((nearest**2).mean(dim=-1).sqrt())
    return torch.cat(parts)


def initial_params(scene, limit, device):
    """As create_splats_with_optimizers of simple_trainer. `limit` takes a random part of the points."""
    points = torch.from_numpy(scene.points).float()
    colours = torch.from_numpy(scene.colours / 255.0).float()
    if limit is not None and limit < len(points):
        chosen = torch.randperm(len(points))[:limit]
        points, colours = points[chosen], colours[chosen]
    points, colours = points.to(device), colours.to(device)
    n = len(points)
    # gsplat takes the logarithm of 0 for points in one place; a tiny distance does no harm instead.
    distances = mean_distance_to_neighbours(points).clamp_min(1e-7)
    sh = torch.zeros(n, (SH_DEGREE + 1) ** 2, 3, device=device)
    sh[:, 0] = (colours - 0.5) / 0.28209479177387814
    return trainable(
        {
            "means": points,
            "scales": torch.log(distances * INIT_SCALE)[:, None].repeat(1, 3),
            "quats": torch.rand(n, 4, device=device),
            "opacities": torch.logit(torch.full((n,), INIT_OPACITY, device=device)),
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
        }
    )


def to_float(pixels):
    return pixels[None] / 255.0


class Trainer:
    """The training loop of simple_trainer with the preset mcmc, without viewer, logging and data loader.

    The pictures stay on the GPU, and the loss is not fetched in each step; both only make gsplat faster.
    """

    def __init__(self, ops, scene, cap, points, schedule_steps, sh_interval):
        self.ops, self.scene, self.sh_interval = ops, scene, sh_interval
        self.params = initial_params(scene, points, ops.device)
        rates = RATES | {"means": RATES["means"] * scene.scale}
        self.optimizers = make_optimizers(self.params, rates)
        self.schedule = torch.optim.lr_scheduler.ExponentialLR(
            self.optimizers["means"], gamma=0.01 ** (1.0 / schedule_steps)
        )
        self.strategy = ops.gsplat.MCMCStrategy(cap_max=cap)
        if ops.rehearsal:
            # So that a few steps reach it.
            self.strategy.refine_start_iter, self.strategy.refine_every = 4, 5
        self.strategy.check_sanity(self.params, self.optimizers)
        self.state = self.strategy.initialize_state()
        self.order = []

    def next_view(self):
        if not self.order:
            self.order = torch.randperm(len(self.scene.train)).tolist()
        return self.scene.train[self.order.pop()]

    def loss(self, picture, target):
        losses = self.ops.gsplat.losses
        l1 = losses.l1_loss(picture, target).mean()
        ssim = losses.ssim_loss(picture.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2))
        loss = torch.lerp(l1, ssim, SSIM_LAMBDA)
        loss = loss + OPACITY_REG * losses.opacity_reg_loss(self.params["opacities"])
        return loss + SCALE_REG * losses.scale_reg_loss(self.params["scales"])

    def step(self, number):
        camera, pixels = self.next_view()
        degree = min(number // self.sh_interval, SH_DEGREE)
        picture, _ = render_params(self.ops, self.params, degree, camera)
        self.loss(picture, to_float(pixels)).backward()
        step_optimizers(self.optimizers)
        self.schedule.step()
        rate = self.schedule.get_last_lr()[0]
        self.strategy.step_post_backward(self.params, self.optimizers, self.state, number, {}, lr=rate)

    def state_of_play(self):
        return {"psnr": self.psnr(), "gaussians": len(self.params["means"])}

    @torch.no_grad()
    def psnr(self):
        """The mean over the held-out views; the picture is rounded to 8 bits first."""
        values = []
        for camera, pixels in self.scene.test:
            picture, _ = render_params(self.ops, self.params, SH_DEGREE, camera)
            rounded = torch.round(picture.clamp(0, 1) * 255) / 255
            error = torch.mean((rounded - to_float(pixels)) ** 2).clamp_min(1e-12)
            values.append(-10 * math.log10(error.item()))
        return statistics.mean(values)


def measure_loss(trainer, clock):
    """The loss alone, forward and backward: its SSIM may be the slow one (see "ssim")."""
    camera, pixels = trainer.scene.test[0]
    with torch.no_grad():
        picture, _ = render_params(trainer.ops, trainer.params, SH_DEGREE, camera)
    picture.requires_grad_()
    target = to_float(pixels)
    run = lambda: trainer.loss(picture, target).backward()  # noqa: E731
    return summary(clock.time(run, lambda: None, 20, pause=True))


def train_loop(trainer, clock, steps, seconds, tail):
    """Trains `steps` steps, and further to `seconds` if they have not passed yet.

    The clock stands still during evaluation. The times per step are of the first `steps` steps.
    """
    result, trained, number = {}, 0.0, 0
    tail_from, tail_start = max(0, steps - tail), 0.0
    wanted = seconds
    clock.wait()
    start = time.perf_counter()

    def stop():
        nonlocal trained
        clock.wait()
        trained += time.perf_counter() - start

    while number < steps or wanted is not None:
        if number == tail_from:
            stop()
            tail_start, start = trained, time.perf_counter()
        trainer.step(number)
        number += 1
        if number == steps:
            stop()
            result["seconds"] = trained
            result["ms_per_step"] = trained / steps * 1e3
            result["ms_per_step_last"] = (trained - tail_start) / (steps - tail_from) * 1e3
            result |= trainer.state_of_play()
            start = time.perf_counter()
        if wanted is not None and trained + time.perf_counter() - start >= wanted:
            stop()
            result["after_seconds"] = {"seconds": trained, "steps": number} | trainer.state_of_play()
            wanted, start = None, time.perf_counter()
    return result


def train_verb(ops, clock, arguments):
    torch.manual_seed(SEED)
    scene = Scene(arguments.scene, arguments.max_resolution, ops.device)
    trainer = Trainer(
        ops, scene, arguments.cap, arguments.points, arguments.schedule_steps, arguments.sh_interval
    )
    first, psnr_first = len(trainer.params["means"]), trainer.psnr()
    clock.reset_peak()
    tail = min(500, arguments.steps)
    result = train_loop(trainer, clock, arguments.steps, arguments.seconds, tail)
    peak = clock.peak()
    pixels = scene.views[0][1]
    return header(ops, "train") | {
        "scene": arguments.scene.name,
        "width": pixels.shape[1],
        "height": pixels.shape[0],
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "cap": arguments.cap,
        "steps": arguments.steps,
        "ssim": ssim_used(ops),
        "schedule_steps": arguments.schedule_steps,
        "sh_interval": arguments.sh_interval,
        "initial_gaussians": first,
        "initial_psnr": psnr_first,
        **result,
        "last_steps": tail,
        "loss_alone": measure_loss(trainer, clock),
        # With the pictures, which are on the GPU as bytes.
        "peak_bytes": peak,
        "picture_bytes": sum(pixels.numel() for _, pixels in scene.views),
    }


# ---- Command line --------------------------------------------------------------------------------


def parse():
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    verbs = parser.add_subparsers(dest="verb", required=True)
    stages = verbs.add_parser("stages")
    stages.add_argument("--repeats", type=int, default=20)
    train = verbs.add_parser("train")
    train.add_argument("--steps", type=int, default=3000)
    train.add_argument("--cap", type=int, default=1_000_000)
    train.add_argument("--seconds", type=float)
    train.add_argument("--schedule-steps", type=int, default=MAX_STEPS, metavar="N",
                       help="steps over which the learning rate falls")
    train.add_argument("--sh-interval", type=int, default=SH_DEGREE_INTERVAL, metavar="N",
                       help="steps between two degrees of the harmonics; 1: all at once")
    train.add_argument("--max-resolution", type=int, default=1600, metavar="PX", help="of the longer side")
    for verb in (stages, train):
        verb.add_argument("scene", type=Path)
        verb.add_argument("--points", type=int, help="take only so many Gaussians of the scene")
        verb.add_argument("--rehearse", action="store_true", help="run without a GPU; times mean nothing")
    return parser.parse_args()


def main():
    arguments = parse()
    # gsplat prints to stdout at times; only the result may go there.
    with contextlib.redirect_stdout(sys.stderr):
        ops = Rehearsal() if arguments.rehearse else Kernels()
        clock = HostClock() if arguments.rehearse else GpuClock()
        verb = stages_verb if arguments.verb == "stages" else train_verb
        result = verb(ops, clock, arguments)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
