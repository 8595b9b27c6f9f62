#!/usr/bin/env python3
"""Records the images and gradients of gsplat's PyTorch reference with autograd for seeded scenes, in float64.

    python3 -m venv .venv && .venv/bin/pip install -r core/tests/peers/requirements.txt
    .venv/bin/python core/tests/peers/make_expectations.py

`main.rs` compares the twins in `core/twins/src` with the files that this script writes to `expectations/`. README.md
lists the conventions that differ.

gsplat (`gsplat/cuda/_torch_impl.py`, called as in its `rendering.py`) computes: covariances from quaternions and
scales, projection, spherical harmonics, tile lists, alpha, and blending, with nerfacc's products and sums along a ray.
autograd computes every derivative. This script handles:

- The pairs of pixel and Gaussian that are blended. gsplat only has a CUDA kernel for this; `PairsToBlend` applies its
  rule to gsplat's own tile lists. A choice has no derivative, so no gradient comes from this script.
- Rays of different lengths. nerfacc accepts them only on CUDA; `weights_in_rows` passes them to its batched form.
- exp of log scales, sigmoid of opacity logits, max(SH + 0.5, 0): one line each, as in all code that calls gsplat.
- Range. gsplat blends z; here its blending gets the distance from the camera as a fourth channel.
"""

import types

import gsplat.cuda._wrapper
import nerfacc
import numpy
import torch
from gsplat.cuda import _torch_impl

import recording

BLUR = 0.3
NEAR = 0.01
TILE = 16
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
# The cap of alpha: ours, and the constant in gsplat.
OUR_CAP = 0.99
GSPLAT_CAP = 0.999
# Rounding could change a decision that is closer to its edge than this relative distance.
CLEARANCE = 1e-9


# ---- gsplat on the CPU


class PairsToBlend:
    """Replaces gsplat's `rasterize_to_indices_in_range` for one image, and counts the effects of its edges."""

    def __init__(self, cap, in_front):
        self.cap = cap
        self.in_front = in_front
        self.blended_pairs = 0
        self.capped_pairs = 0
        self.stopped_pixels = 0

    def __call__(
        self, start, _end, _left, means2d, conics, opacities, width, height, tile_size, offsets, flatten_ids
    ):
        """(Gaussians, pixels, images) of all blended pairs: pixel by pixel, front to back."""
        assert start == 0 and len(offsets) == 1, "one image, with Gaussians that fit gsplat's first batch"
        lists = numpy.split(flatten_ids.numpy(), offsets.flatten()[1:].numpy())
        gaussians, pixels = [], []
        for y in range(height):
            for x in range(width):
                alphas = alphas_at(x, y, means2d[0], conics[0], opacities[0])
                listed = lists[y // tile_size * offsets.shape[-1] + x // tile_size]
                # Neither gsplat's box of 3.33 sigma nor our ellipse may exclude a Gaussian above
                # the least alpha.
                assert set(numpy.flatnonzero((alphas >= MIN_ALPHA) & self.in_front)) <= set(listed)
                blended = self.blended([int(gaussian) for gaussian in listed], alphas)
                gaussians += blended
                pixels += [y * width + x] * len(blended)
        return torch.tensor(gaussians), torch.tensor(pixels), torch.zeros(len(pixels), dtype=torch.int64)

    def blended(self, listed, alphas):
        """The Gaussians of `listed` (front to back) that one pixel blends; `alphas` are not capped yet."""
        result, left = [], 1.0
        for gaussian in listed:
            alpha = alphas[gaussian]
            assert clear(alpha, MIN_ALPHA) and clear(alpha, self.cap)
            if alpha < MIN_ALPHA:
                continue
            after = left * (1.0 - min(alpha, self.cap))
            # Two at our cap leave 1.0000000000000018e-4: neither gsplat's T <= 1e-4 nor our T < 1e-4 stops.
            assert clear(after, MIN_TRANSMITTANCE) or after == (1.0 - OUR_CAP) ** 2
            if after < MIN_TRANSMITTANCE:
                self.stopped_pixels += 1
                break
            self.blended_pairs += 1
            self.capped_pairs += int(alpha > self.cap)
            result.append(gaussian)
            left = after
        return result


def alphas_at(x, y, means2d, conics, opacities):
    """opacity exp(-sigma) of every Gaussian at the centre of pixel (x, y)."""
    delta = means2d.detach().numpy() - [x + 0.5, y + 0.5]
    a, b, c = conics.detach().numpy().T
    sigma = 0.5 * (a * delta[:, 0] ** 2 + c * delta[:, 1] ** 2) + b * delta[:, 0] * delta[:, 1]
    return opacities.detach().numpy() * numpy.exp(-sigma)


def clear(value, edge):
    """Whether rounding cannot move `value` across `edge`."""
    return abs(value - edge) > CLEARANCE * edge


def weights_in_rows(alphas, ray_indices, n_rays):
    """nerfacc's `render_weight_from_alpha` for rays of different lengths, by its function for rays of one length."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    places = torch.arange(len(ray_indices)) - (torch.cumsum(counts, 0) - counts)[ray_indices]
    rows = torch.zeros(n_rays, int(counts.max())).index_put((ray_indices, places), alphas)
    weights, transmittances = NERFACC_WEIGHTS(rows)
    return weights[ray_indices, places], transmittances[ray_indices, places]


NERFACC_WEIGHTS = nerfacc.render_weight_from_alpha
GSPLAT_ACCUMULATE = _torch_impl.accumulate


def rasterize(cap, in_front, means2d, conics, colours, opacities, width, height, offsets, flatten_ids, backgrounds):
    """gsplat's `_rasterize_to_pixels` with another cap of alpha; also returns its `PairsToBlend`."""
    code = GSPLAT_ACCUMULATE.__code__
    assert code.co_consts.count(GSPLAT_CAP) == 1, "gsplat has changed its cap of alpha"
    constants = tuple(cap if constant == GSPLAT_CAP else constant for constant in code.co_consts)
    pairs = PairsToBlend(cap, in_front)
    _torch_impl.accumulate = types.FunctionType(code.replace(co_consts=constants), vars(_torch_impl))
    gsplat.cuda._wrapper.rasterize_to_indices_in_range = pairs
    nerfacc.render_weight_from_alpha = weights_in_rows
    image, alpha = _torch_impl._rasterize_to_pixels(
        means2d, conics, colours, opacities, width, height, TILE, offsets, flatten_ids, backgrounds
    )
    return image, alpha, pairs


# ---- Scenes


def random_scene(seed, width, height, count, sh_degree, size_px, stretch, logits, reach, sh_size=0.3):
    """Gaussians, and a randomly rotated camera with an off-centre principal point and pixels that are not square.

    `size_px` and `logits` are ranges of standard deviation in the picture and of opacity logits. `stretch` is the
    spread of the three scales (in e-folds). `reach` is 1 for centres in the picture, larger for some beyond its edges.
    All numbers are rounded, so that the files contain exactly the numbers of the computation.
    """
    rng = numpy.random.default_rng(seed)
    camera = {"width": width, "height": height}
    for key, size, low, high in [
        ("fx", width, 0.8, 1.3),
        ("fy", height, 0.8, 1.3),
        ("cx", width, 0.35, 0.65),
        ("cy", height, 0.35, 0.65),
    ]:
        camera[key] = round(size * rng.uniform(low, high), 3)
    pose = {"quat_wxyz": rng.normal(size=4).round(4), "translation": rng.uniform(-2, 2, 3).round(4)}

    z = rng.uniform(2.0, 6.0, count)
    pixel = (0.5 + reach * rng.uniform(-0.5, 0.5, (count, 2))) * [width, height]
    ratios = (pixel - [camera["cx"], camera["cy"]]) / [camera["fx"], camera["fy"]]
    in_camera = numpy.column_stack([ratios * z[:, None], z])
    scales = (rng.uniform(*size_px, count) * z / camera["fx"])[:, None]
    coeffs = (sh_degree + 1) ** 2
    sh_coeffs = rng.uniform(-1, 1, (count, coeffs, 3))
    sh_coeffs[:, 1:] *= sh_size
    model = {
        "means": to_world(in_camera, pose),
        "quats": rng.normal(size=(count, 4)).round(4),
        "log_scales": (numpy.log(scales) + stretch * rng.uniform(-0.5, 0.5, (count, 3))).round(4),
        "opacity_logits": rng.uniform(*logits, count).round(4),
        "sh_coeffs": sh_coeffs.round(4),
    }
    return {
        "camera": camera,
        "pose": pose,
        "cap": OUR_CAP,
        "background": [0.1, 0.3, 0.6],
        "sh_degree": sh_degree,
        "model": model,
    }


def to_world(in_camera, pose):
    """Points [N, 3] from the camera's frame to the world frame, rounded."""
    rotation = _torch_impl._quat_to_rotmat(torch.tensor(pose["quat_wxyz"])).numpy()
    return ((in_camera - pose["translation"]) @ rotation).round(5)


def crowd():
    """Gaussians of all shapes, one in front of the other, all harmonics."""
    return random_scene(1, 33, 18, 20, 3, (1.0, 5.0), 3.0, (-2.0, 3.0), 0.9, sh_size=0.5)


def opaque():
    """A stack that is nearly opaque: alpha is capped at 0.99 and rays end."""
    return random_scene(3, 21, 17, 9, 0, (2.0, 9.0), 0.4, (5.0, 11.0), 0.8)


def opaque_gsplat():
    """Another such stack, denser, with gsplat's cap of 0.999."""
    return random_scene(8, 17, 11, 9, 0, (3.0, 45.0), 0.4, (9.0, 16.0), 0.8) | {"cap": GSPLAT_CAP}


def needles():
    """One axis about a thousand times as long as the other two; degree 2 of a model of degree 3."""
    scene = random_scene(4, 17, 21, 16, 3, (3.0, 9.0), 0.2, (0.0, 4.0), 0.8)
    scene["model"]["log_scales"][:, 1:] = (scene["model"]["log_scales"][:, 1:] - 6.9).round(4)
    return scene | {"sh_degree": 2}


def border():
    """Large Gaussians around the edges and far beyond them; the last four must not be drawn."""
    scene = random_scene(5, 21, 17, 24, 1, (3.0, 16.0), 1.5, (-3.0, 2.0), 2.5)
    model, pose = scene["model"], scene["pose"]
    # Two Gaussians behind the camera, and one nearer than the near plane.
    model["means"][-4:-1] = to_world(numpy.array([[0.1, 0.2, -3.0], [0.0, 0.0, -0.5], [0.001, 0.0, 0.006]]), pose)
    # Alpha is below 1/255 everywhere.
    model["opacity_logits"][-1] = -6.0
    return scene


SCENES = [crowd, opaque, opaque_gsplat, needles, border]
# The purpose of each scene: the least counts of `observe`.
PURPOSE = {
    "crowd": {"black_channels": 3, "blended_pairs": 3000},
    "opaque": {"capped_pairs": 10, "stopped_pixels": 30},
    "opaque_gsplat": {"capped_pairs": 10, "stopped_pixels": 30},
    "needles": {"blended_pairs": 300},
    "border": {"clamped_ratios": 4, "beyond_the_picture": 6, "behind_or_near": 3, "transparent": 1},
}


# ---- One scene through gsplat


def weights(pixels):
    """Weights of the loss, [pixels, 5] in -1..1 for R, G, B, alpha and range; `splatting.rs` has the same formula."""
    k = numpy.arange(5 * pixels, dtype=numpy.int64)
    return torch.tensor((k * k * 31 + k * 7919) % 2003 / 1001.0 - 1.0).reshape(pixels, 5)


def record(make):
    """Runs the scene that `make` gives forward and backward and writes `expectations/<name of make>.json`."""
    name, scene = make.__name__, make()
    camera, pose = scene["camera"], scene["pose"]
    width, height = camera["width"], camera["height"]
    model = {key: torch.tensor(value, requires_grad=True) for key, value in scene["model"].items()}

    viewmat = torch.eye(4)
    viewmat[:3, :3] = _torch_impl._quat_to_rotmat(torch.tensor(pose["quat_wxyz"]))
    viewmat[:3, 3] = torch.tensor(pose["translation"])
    intrinsics = torch.tensor(
        [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    )

    covars, _ = _torch_impl._quat_scale_to_covar_preci(
        model["quats"], torch.exp(model["log_scales"]), compute_preci=False
    )
    radii, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
        model["means"], covars, viewmat[None], intrinsics[None], width, height, BLUR, NEAR
    )
    directions = model["means"] - torch.inverse(viewmat)[:3, 3]
    harmonics = _torch_impl._spherical_harmonics(scene["sh_degree"], directions, model["sh_coeffs"])
    splats = {
        "mean2d": means2d,
        "conic": conics,
        "rgb": torch.clamp_min(harmonics + 0.5, 0.0)[None],
        "opacity": torch.sigmoid(model["opacity_logits"])[None],
        "range": torch.linalg.norm(directions, dim=-1)[None],
    }
    for value in splats.values():
        value.retain_grad()

    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    _, isect_ids, flatten_ids = _torch_impl._isect_tiles(means2d, radii, depths, TILE, tiles_x, tiles_y)
    offsets = _torch_impl._isect_offset_encode(isect_ids, 1, tiles_x, tiles_y)
    in_front = (depths[0] > NEAR).numpy()
    z = numpy.sort(depths[0].detach().numpy())
    assert (numpy.diff(z) > 1e-6).all(), "gsplat sorts by depth in f32, so ties would have any order"
    image, alpha, pairs = rasterize(
        scene["cap"],
        in_front,
        means2d,
        conics,
        torch.cat([splats["rgb"], splats["range"][..., None]], dim=-1),
        splats["opacity"],
        width,
        height,
        offsets,
        flatten_ids,
        torch.tensor([[*scene["background"], 0.0]]),
    )
    image, alpha = image.reshape(-1, 4), alpha.reshape(-1, 1)
    outputs = torch.cat([image[:, :3], alpha, image[:, 3:]], dim=1)
    (weights(width * height) * outputs).sum().backward()

    shows = observe(scene, viewmat, depths[0], means2d[0], harmonics, pairs)
    for what, least in PURPOSE[name].items():
        assert shows[what] >= least, f"{name}: {what} is {shows[what]}, but the scene needs at least {least}"

    def drawn(values):
        """Values by Gaussian; None where gsplat's number has no meaning."""
        return [row.tolist() if front else None for row, front in zip(values.detach()[0], in_front, strict=True)]

    recording.write(
        name,
        {
            "purpose": make.__doc__,
            "made_with": recording.versions("gsplat", "nerfacc", "numpy", "torch"),
            "shows": shows,
            "camera": camera,
            "pose": {key: value.tolist() for key, value in pose.items()},
            "max_alpha": scene["cap"],
            "background": scene["background"],
            "sh_degree": scene["sh_degree"],
            "model": {key: rows(value) for key, value in model.items()},
            "splats": {key: drawn(value) for key, value in splats.items()} | {"depth": drawn(depths)},
            "raster": {"rgb": rows(image[:, :3]), "alpha": rows(alpha[:, 0]), "range": rows(image[:, 3])},
            "v_splats": {key: drawn(value.grad) for key, value in splats.items()},
            "v_model": {key: rows(value.grad) for key, value in model.items()},
        },
    )


def observe(scene, viewmat, depths, means2d, harmonics, pairs):
    """Counts of the edge cases in a scene."""
    camera, front = scene["camera"], torch.tensor(pairs.in_front)
    size = torch.tensor([camera["width"], camera["height"]], dtype=torch.float64)
    focal = torch.tensor([camera["fx"], camera["fy"]])
    centre = torch.tensor([camera["cx"], camera["cy"]])
    ratios = (means2d - centre) / focal
    beyond = (ratios < (-centre - 0.15 * size) / focal) | (ratios > (size - centre + 0.15 * size) / focal)
    outside = (means2d < 0) | (means2d > size)
    transparent = torch.sigmoid(torch.tensor(scene["model"]["opacity_logits"])) < MIN_ALPHA
    return {
        "gaussians": len(depths),
        "blended_pairs": pairs.blended_pairs,
        "capped_pairs": pairs.capped_pairs,
        "stopped_pixels": pairs.stopped_pixels,
        "clamped_ratios": int((beyond.any(dim=1) & front).sum()),
        "beyond_the_picture": int((outside.any(dim=1) & front).sum()),
        "behind_or_near": int((~front).sum()),
        "transparent": int(transparent.sum()),
        "black_channels": int((harmonics[front] < -0.5).sum()),
    }


def rows(values):
    """Nested lists; [N, K, 3] as [N * K, 3]."""
    values = values.detach()
    return (values.flatten(0, 1) if values.dim() == 3 else values).tolist()


# ---- Spherical harmonics alone


def spherical_harmonics():
    """gsplat's colours by direction at every degree, with gradients by direction and coefficients."""
    rng = numpy.random.default_rng(6)
    axes = numpy.concatenate([numpy.eye(3), -numpy.eye(3)])
    cases = []
    for degree in range(4):
        directions = numpy.concatenate([axes, rng.normal(size=(4, 3)).round(3)])
        directions = torch.tensor(directions, requires_grad=True)
        # Colours have the same spread at every degree, and some are below 0.
        size = 2.8 / (degree + 1)
        coeffs = torch.tensor(rng.uniform(-size, size, (10, (degree + 1) ** 2, 3)).round(3), requires_grad=True)
        v_rgb = torch.tensor(rng.uniform(-1, 1, (10, 3)).round(3))
        rgb = torch.clamp_min(_torch_impl._spherical_harmonics(degree, directions, coeffs) + 0.5, 0.0)
        (v_rgb * rgb).sum().backward()
        for i in range(10):
            cases.append(
                {
                    "direction": directions[i].tolist(),
                    "coeffs": coeffs[i].tolist(),
                    "rgb": rgb[i].tolist(),
                    "v_rgb": v_rgb[i].tolist(),
                    "v_coeffs": coeffs.grad[i].tolist(),
                    # Degree 0 does not depend on the direction.
                    "v_direction": directions.grad[i].tolist() if degree > 0 else [0.0, 0.0, 0.0],
                }
            )
    recording.write("spherical_harmonics", {"made_with": recording.versions("gsplat", "torch"), "cases": cases})


if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    for make in SCENES:
        record(make)
    spherical_harmonics()
