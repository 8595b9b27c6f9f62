#!/usr/bin/env python3
"""Records PSNR and SSIM by scikit-image and torchmetrics, and the gradient of the training loss by autograd.

    .venv/bin/python core/tests/peers/make_metric_expectations.py    # set up as in make_expectations.py

Our SSIM is that of 3DGS: a window of 11 x 11 with sigma 1.5 whose taps sum to 1, and variances divided by that sum (not
by n - 1). C1 = 0.01^2 and C2 = 0.03^2 on values of 0..1, each channel on its own, zeros beyond the border, the mean
over all pixels. The peers have this window and these constants as arguments or defaults. Their border differs:
scikit-image reflects and leaves 5 pixels out of its mean, torchmetrics reflects and uses all pixels. Here both get the
pictures inside a frame of 5 black pixels, as wide as the reach of the window, and their map is read inside the frame.
Their border rules only affect the frame, and no pixel is left out. This script takes the mean inside the frame and
applies the mask (black in both pictures, not in the mean).
"""

import numpy
import scipy.ndimage
import skimage.metrics
import torch
import torchmetrics.functional.image

import recording

REACH = 5


# ---- The peers


def ssim_map_skimage(render, truth):
    """Map [H, W, 3] of two pictures with values 0..1, by scikit-image."""
    framed = [numpy.pad(image, ((REACH, REACH), (REACH, REACH), (0, 0))) for image in (render, truth)]
    # With Gaussian weights, the window ends at 3.5 sigma: 5 pixels, 11 taps. torchmetrics does the same.
    _, full = skimage.metrics.structural_similarity(
        *framed,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    return full[REACH:-REACH, REACH:-REACH]


def ssim_map_torchmetrics(render, truth):
    """The same by torchmetrics, with a gradient."""
    framed = [
        torch.nn.functional.pad(image.permute(2, 0, 1)[None], (REACH, REACH, REACH, REACH)) for image in (render, truth)
    ]
    _, full = torchmetrics.functional.image.structural_similarity_index_measure(
        *framed, gaussian_kernel=True, sigma=1.5, data_range=1.0, return_full_image=True
    )
    return full[0, :, REACH:-REACH, REACH:-REACH].permute(1, 2, 0)


def psnr(render, truth, mask):
    """PSNR in dB of the 8-bit pixels that count; both peers must agree."""
    render, truth = render[mask], truth[mask]
    value = skimage.metrics.peak_signal_noise_ratio(truth, render, data_range=255)
    other = torchmetrics.functional.image.peak_signal_noise_ratio(
        torch.tensor(render / 255.0), torch.tensor(truth / 255.0), data_range=1.0
    )
    assert abs(value - float(other)) < 1e-10
    return float(value)


# ---- 8-bit pictures


def structured(width, height):
    """A ramp, a chequerboard, a disc and a dark corner: edges, textures and flat parts."""
    y, x = numpy.mgrid[0:height, 0:width]
    image = numpy.stack([160 * x / width, 120 * y / height + 40, 200 - 90 * (x + y) / (width + height)], axis=2)
    image += 50.0 * (((x // 4 + y // 3) % 2) * (x > width / 2))[..., None]
    image[(x - width / 3) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2] = [230, 210, 20]
    image[: height // 4, : width // 4] = 0
    return image


def to_8_bit(image):
    """Rounded and clamped."""
    return numpy.clip(numpy.round(image), 0, 255).astype(numpy.uint8)


def pictures(rng):
    """(name, render, truth, mask) of every case."""

    def noise(width, height):
        return rng.integers(0, 256, (height, width, 3)).astype(numpy.uint8)

    def everywhere(image):
        return numpy.ones(image.shape[:2], dtype=bool)

    def right_and_scattered(image):
        mask = rng.random(image.shape[:2]) > 0.1
        mask[:, : image.shape[1] // 4] = False
        return mask

    scene = structured(25, 15)
    blurred = scipy.ndimage.gaussian_filter(scene, (1.2, 1.2, 0)) + rng.normal(0, 4, scene.shape)
    murky = 90 + 0.06 * structured(13, 19)
    noisy_murky = murky + rng.normal(0, 2, murky.shape)
    return [
        ("two pictures of noise", noise(17, 14), noise(17, 14), everywhere),
        ("a scene and its blurred and noisy render", to_8_bit(blurred), to_8_bit(scene), everywhere),
        ("a scene and itself moved by a pixel", to_8_bit(numpy.roll(scene, 1, 1)), to_8_bit(scene), everywhere),
        ("murky water of little contrast", to_8_bit(noisy_murky), to_8_bit(murky), everywhere),
        ("a picture smaller than the window", noise(7, 4), noise(7, 4), everywhere),
        ("a scene that is partly masked", to_8_bit(blurred), to_8_bit(scene), right_and_scattered),
    ]


def hex_rows(image):
    """An 8-bit picture as one string per row."""
    return [row.tobytes().hex() for row in image]


def metric_cases(rng):
    """PSNR and SSIM of every pair of pictures."""
    cases = []
    for name, render, truth, masked in pictures(rng):
        mask = masked(truth)
        black_where_ignored = [image / 255.0 * mask[..., None] for image in (render, truth)]
        similarity = ssim_map_skimage(*black_where_ignored)
        other = ssim_map_torchmetrics(*(torch.tensor(image) for image in black_where_ignored)).numpy()
        assert numpy.abs(similarity - other).max() < 1e-11, f"{name}: the peers differ"
        cases.append(
            {
                "name": name,
                "render": hex_rows(render),
                "truth": hex_rows(truth),
                "mask": ["".join("1" if counts else "0" for counts in row) for row in mask],
                "psnr_db": psnr(render, truth, mask),
                "ssim": float(similarity[mask].mean()),
            }
        )
        if len(cases) < 2:
            # One channel of the map, row after row.
            cases[-1]["ssim_map_red"] = similarity[..., 0].flatten().tolist()
    return cases


# ---- The loss


def loss_case(rng, name, width, height, ssim_weight, ignored):
    """(1 - w) L1 + w (1 - SSIM) of an unclamped render, and its gradient by torchmetrics and autograd."""
    truth = (structured(width, height) / 255.0).round(4)
    render = (truth + rng.normal(0, 0.15, truth.shape)).round(4)
    # |difference| has no derivative at 0.
    render[render == truth] += 1e-3
    mask = torch.tensor(rng.random((height, width, 1)) >= ignored)
    x = torch.tensor(render, requires_grad=True)
    a, b = x * mask, torch.tensor(truth) * mask
    # Both means are over all pixels, as in the trainer; ignored pixels add nothing.
    l1 = (a - b).abs().mean()
    ssim = (ssim_map_torchmetrics(a, b) * mask).mean()
    total = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim)
    total.backward()
    return {
        "name": name,
        "width": width,
        "height": height,
        "ssim_weight": ssim_weight,
        "render": render.reshape(-1, 3).tolist(),
        "truth": truth.reshape(-1, 3).tolist(),
        "mask": mask.flatten().tolist(),
        "l1": float(l1.detach()),
        "ssim": float(ssim.detach()),
        "total": float(total.detach()),
        "v_rgb": x.grad.reshape(-1, 3).tolist(),
    }


if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    random = numpy.random.default_rng(7)
    recording.write(
        "metrics",
        {
            "made_with": recording.versions("numpy", "scikit-image", "torch", "torchmetrics"),
            "pictures": metric_cases(random),
            "losses": [
                loss_case(random, "everything counts", 13, 8, 0.2, 0.0),
                loss_case(random, "a third is ignored", 11, 9, 0.2, 0.33),
                loss_case(random, "SSIM alone", 6, 12, 1.0, 0.0),
            ],
        },
    )
