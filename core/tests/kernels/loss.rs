//! Value and gradient of the loss.

use std::sync::Arc;

use fathom_core::config::LossLight;
use fathom_core::gpu::{Gpu, Recorder};
use fathom_core::rng::{Stream, random_bits, uniform_at};
use fathom_core::train::{DevicePhotograph, Loss};
use fathom_core::views::PackedImage;

use crate::device::{assert_same_bits, layouts, poison, storage};

const COUNTS: u32 = 255 << 24;

/// A photograph of noise; `ignored` gives the mask byte of a pixel that does not count.
fn photograph(seed: u32, width: u32, height: u32, ignored: impl Fn(u32) -> Option<u8>) -> PackedImage {
    let pixels = (0..width * height).map(|i| {
        let mask = ignored(i).map_or(COUNTS, |byte| u32::from(byte) << 24);
        (random_bits(seed, Stream::Test, i, 0)[0] & 0x00FF_FFFF) | mask
    });
    PackedImage { width, height, pixels: pixels.collect() }
}

fn render(seed: u32, pixels: u32) -> Vec<[f32; 4]> {
    let u = |i, j| 1.4 * uniform_at(seed, Stream::Test, i, j) - 0.2;
    (0..pixels).map(|i| [u(i, 0), u(i, 1), u(i, 2), 1.0]).collect()
}

/// Value and gradient from the kernels, on buffers full of rubbish.
fn on_device(
    gpu: &Gpu,
    loss: &mut Loss,
    render: &[[f32; 4]],
    truth: &PackedImage,
    weight: f32,
) -> (f32, Vec<[f32; 4]>) {
    loss.prepare(gpu, [truth.width, truth.height]).unwrap();
    for buffer in loss.scratch().unwrap() {
        poison(gpu, buffer);
    }
    // No kernel writes the alpha entry, so it keeps the initial 0 of the buffer.
    gpu.write(loss.v_image().unwrap(), 0, &vec![[f32::NAN, f32::NAN, f32::NAN, 0.0]; render.len()]);
    let image = storage(gpu, render);
    let mut recorder = Recorder::new(gpu);
    let photograph = DevicePhotograph::new(gpu, truth).unwrap();
    loss.record(gpu, &mut recorder, &photograph, &image, weight, 77).unwrap();
    recorder.submit();
    let v_image = gpu.read(loss.v_image().unwrap(), 0, truth.pixels.len()).unwrap();
    (loss.mean(gpu, 77..78).unwrap(), v_image)
}

#[track_caller]
fn check(gpu: &Arc<Gpu>, what: &str, loss: &mut Loss, render: &[[f32; 4]], truth: &PackedImage, weight: f32) {
    check_in(LossLight::Srgb, gpu, what, loss, render, truth, weight);
}

/// As [`check`] for a `loss` in this light.
#[track_caller]
fn check_in(
    light: LossLight,
    gpu: &Arc<Gpu>,
    what: &str,
    loss: &mut Loss,
    render: &[[f32; 4]],
    truth: &PackedImage,
    weight: f32,
) {
    let (width, height) = (truth.width, truth.height);
    let (value, v_image) = on_device(gpu, loss, render, truth, weight);
    let render64: Vec<[f64; 3]> = render.iter().map(|p| [p[0], p[1], p[2]].map(f64::from)).collect();
    // The photograph as the kernel sees it, rounded to f32, so that equal values stay equal.
    let (_, mask) = fathom_twins::unpack(truth);
    let colours = |p: &u32| {
        p.to_le_bytes().map(|v| match light {
            LossLight::Srgb => f64::from(f32::from(v) * (1.0 / 255.0)),
            LossLight::Linear => fathom_twins::decode(f64::from(v) / 255.0).0,
        })
    };
    let truth64: Vec<[f64; 3]> =
        truth.pixels.iter().map(|p| [colours(p)[0], colours(p)[1], colours(p)[2]]).collect();
    let twin = fathom_twins::loss(&render64, &truth64, &mask, width, height, f64::from(weight));
    // 1e-5: a sum in two levels of at most 1e4 numbers near 1.
    assert!((f64::from(value) - twin.total).abs() < 1e-5, "{what}: loss {value}, twin {}", twin.total);
    // In units of the L1 gradient of one pixel, 1/(3HW). SSIM divides by variances, which are differences of
    // rounded squares (1.2e-7), plus C2 = 9e-4. The derivative divides by them once more. Where a window is
    // flat, the error is up to 1.2e-7 / 9e-4 = 1.3e-4 of derivatives of some tens.
    let unit = 1.0 / (3.0 * f64::from(width * height));
    let tolerance = unit * (1e-5 + f64::from(weight) * 1e-2);
    for (i, v) in v_image.iter().enumerate() {
        for c in 0..3 {
            let (kernel, twin) = (f64::from(v[c]), twin.v_rgb[i][c]);
            assert!(
                (kernel - twin).abs() <= tolerance,
                "{what}: gradient of pixel {i}, channel {c}: kernel {kernel:e}, twin {twin:e}, tolerance {tolerance:e}"
            );
        }
        assert_eq!(v[3], 0.0, "{what}: alpha of pixel {i} must have no gradient");
    }
}

#[test]
fn loss_and_gradient_of_any_size_match_the_twin() {
    for gpu in layouts() {
        // One loss object for all sizes, so that a small picture follows a large one and a long one a square
        // one.
        let mut loss = Loss::new(&gpu).unwrap();
        for (width, height) in
            [(16, 16), (17, 1), (200, 1), (1, 33), (1, 1), (75, 53), (11, 11), (100, 9), (9, 100)]
        {
            for weight in [0.0, 0.2, 1.0] {
                let what = format!("{width}x{height}, weight {weight}");
                let truth = photograph(1, width, height, |_| None);
                check(&gpu, &what, &mut loss, &render(2, width * height), &truth, weight);
            }
        }
    }
}

#[test]
fn in_linear_light_only_the_photograph_is_decoded() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap().in_light(LossLight::Linear);
        for (width, height) in [(75, 53), (17, 1), (1, 33), (16, 16)] {
            let truth =
                photograph(21, width, height, |i| uniform_at(22, Stream::Test, i, 0).lt(&0.2).then_some(0));
            for weight in [0.0, 0.2, 1.0] {
                let (what, render) = (format!("{width}x{height}"), render(23, width * height));
                check_in(LossLight::Linear, &gpu, &what, &mut loss, &render, &truth, weight);
            }
        }
    }
}

#[test]
fn a_long_picture_after_a_square_one_has_room_for_its_sums() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap();
        for (width, height) in [(64, 64), (4096, 1), (1, 4096)] {
            let truth = photograph(3, width, height, |_| None);
            check(&gpu, &format!("{width}x{height}"), &mut loss, &render(4, width * height), &truth, 0.2);
        }
    }
}

#[test]
fn masked_pixels_are_left_out_as_in_the_twin() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap();
        for (width, height) in [(75, 53), (16, 16), (17, 1), (1, 33)] {
            let truth =
                photograph(5, width, height, |i| uniform_at(6, Stream::Test, i, 0).lt(&0.3).then_some(0));
            for weight in [0.0, 0.2, 1.0] {
                let what = format!("{width}x{height} masked, weight {weight}");
                check(&gpu, &what, &mut loss, &render(7, width * height), &truth, weight);
            }
        }
        let all = photograph(8, 20, 20, |_| Some(0));
        check(&gpu, "all masked", &mut loss, &render(9, 400), &all, 0.2);
    }
}

#[test]
fn a_pixel_counts_only_where_its_mask_byte_is_255() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap();
        for byte in [1, 127, 128, 200, 254] {
            let truth = photograph(10, 40, 30, |i| (i % 7 == 0).then_some(byte));
            check(&gpu, &format!("mask byte {byte}"), &mut loss, &render(11, 1200), &truth, 0.2);
        }
    }
}

#[test]
fn the_value_of_a_masked_pixel_changes_nothing() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap();
        let truth = photograph(12, 40, 30, |i| (i % 5 == 0).then_some(0));
        let mut other = truth.clone();
        let mut image = render(13, 1200);
        let (value, v_image) = on_device(&gpu, &mut loss, &image, &truth, 0.2);
        for i in (0..1200).step_by(5) {
            other.pixels[i] = 0x0012_3456;
            image[i] = [9.0, -9.0, 1e6, 1.0];
        }
        let (other_value, other_v_image) = on_device(&gpu, &mut loss, &image, &other, 0.2);
        assert_same_bits("loss", &[value], &[other_value]);
        // Not by bits: the 0 of a masked pixel may have either sign.
        assert_eq!(v_image, other_v_image);
    }
}

#[test]
fn a_perfect_render_has_no_loss_and_no_gradient() {
    for gpu in layouts() {
        let mut loss = Loss::new(&gpu).unwrap();
        let truth = photograph(14, 33, 21, |_| None);
        let colour = |p: u32, c: usize| f32::from(p.to_le_bytes()[c]) * (1.0 / 255.0);
        let image: Vec<[f32; 4]> =
            truth.pixels.iter().map(|&p| [colour(p, 0), colour(p, 1), colour(p, 2), 1.0]).collect();
        let (value, v_image) = on_device(&gpu, &mut loss, &image, &truth, 0.2);
        assert!(value.abs() < 1e-5, "loss {value}");
        let unit = 1.0 / (3.0 * 33.0 * 21.0);
        let largest = v_image.iter().flatten().fold(0.0_f32, |m, v| m.max(v.abs()));
        assert!(largest < 1e-3 * unit, "gradient {largest:e}; an L1 gradient is {unit:e}");
    }
}
