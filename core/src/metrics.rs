//! How near a render is to a photograph: PSNR and SSIM, and the baselines that any model must beat.
//!
//! The protocol: both pictures are 8-bit sRGB; PSNR over all pixels and channels; SSIM as in 3DGS: a Gaussian
//! window of 11 x 11 with sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2, each channel on its own, the
//! mean over pixels and channels. Pixels that the mask of the truth leaves out count in neither: for SSIM both
//! pictures are black there and the map is not averaged there.
//!
//! f64 throughout and sums in a fixed order, so that a number does not depend on threads.

use rayon::prelude::*;

use crate::views::PackedImage;

/// Side of the SSIM window.
const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// An sRGB value in 0..1, clamped and rounded to 8 bits; NaN gives 0.
pub fn to_8_bit(value: f32) -> u8 {
    // The cast saturates and turns NaN into 0; adding a half before rounds to nearest.
    (value * 255.0 + 0.5) as u8
}

/// A render as 8-bit pixels, all counting. `rgb` has one entry a pixel, sRGB 0..1, unclamped.
pub fn quantised(width: u32, height: u32, rgb: &[[f32; 3]]) -> PackedImage {
    let pixels = rgb.iter().map(|pixel| {
        let [r, g, b] = pixel.map(to_8_bit);
        u32::from_le_bytes([r, g, b, 255])
    });
    PackedImage { width, height, pixels: pixels.collect() }
}

/// Peak signal to noise ratio in dB over the pixels that `truth`'s mask counts; infinite for equal pictures.
///
/// NaN when the sizes differ or no pixel counts: there is nothing to compare.
pub fn psnr(render: &PackedImage, truth: &PackedImage) -> f64 {
    if (render.width, render.height) != (truth.width, truth.height) {
        return f64::NAN;
    }
    let (mut squares, mut samples) = (0_u64, 0_u64);
    for (a, b) in render.pixels.iter().zip(&truth.pixels) {
        let (a, b) = (a.to_le_bytes(), b.to_le_bytes());
        if b[3] == 255 {
            squares += (0..3).map(|c| u64::from(a[c].abs_diff(b[c])).pow(2)).sum::<u64>();
            samples += 3;
        }
    }
    if samples == 0 {
        return f64::NAN;
    }
    let mse = squares as f64 / samples as f64 / (255.0 * 255.0);
    -10.0 * mse.log10()
}

/// Structural similarity over the pixels that `truth`'s mask counts; 1 for equal pictures.
///
/// NaN when the sizes differ or no pixel counts.
pub fn ssim(render: &PackedImage, truth: &PackedImage) -> f64 {
    if (render.width, render.height) != (truth.width, truth.height) {
        return f64::NAN;
    }
    let (width, height) = (truth.width as usize, truth.height as usize);
    let counted: Vec<bool> = truth.pixels.iter().map(|pixel| pixel.to_le_bytes()[3] == 255).collect();
    let count = counted.iter().filter(|counts| **counts).count();
    if count == 0 {
        return f64::NAN;
    }
    let plane = |image: &PackedImage, channel: usize| -> Vec<f64> {
        let values = image.pixels.iter().zip(&counted);
        values
            .map(
                |(pixel, counts)| if *counts { f64::from(pixel.to_le_bytes()[channel]) / 255.0 } else { 0.0 },
            )
            .collect()
    };
    let mut sum = 0.0;
    for channel in 0..3 {
        let map = ssim_map(&plane(render, channel), &plane(truth, channel), width, height);
        sum +=
            map.iter().zip(&counted).map(|(value, counts)| if *counts { *value } else { 0.0 }).sum::<f64>();
    }
    sum / (3 * count) as f64
}

/// SSIM of two planes at every pixel.
fn ssim_map(a: &[f64], b: &[f64], width: usize, height: usize) -> Vec<f64> {
    let product = |x: &[f64], y: &[f64]| -> Vec<f64> { x.iter().zip(y).map(|(x, y)| x * y).collect() };
    let blur = |plane: &[f64]| convolve(plane, width, height, &gaussian_window());
    let (mean_a, mean_b) = (blur(a), blur(b));
    let (square_a, square_b, cross) = (blur(&product(a, a)), blur(&product(b, b)), blur(&product(a, b)));
    (0..a.len())
        .map(|i| {
            let (mu_a, mu_b) = (mean_a[i], mean_b[i]);
            let var_a = square_a[i] - mu_a * mu_a;
            let var_b = square_b[i] - mu_b * mu_b;
            let covariance = cross[i] - mu_a * mu_b;
            let luminance = (2.0 * mu_a * mu_b + C1) / (mu_a * mu_a + mu_b * mu_b + C1);
            luminance * (2.0 * covariance + C2) / (var_a + var_b + C2)
        })
        .collect()
}

/// The window along one axis, of sum 1.
fn gaussian_window() -> [f64; WINDOW] {
    let weights: [f64; WINDOW] = std::array::from_fn(|i| {
        let distance = i as f64 - (WINDOW / 2) as f64;
        (-distance * distance / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// Convolution with a separable, symmetric window; zeros beyond the border.
fn convolve(plane: &[f64], width: usize, height: usize, window: &[f64]) -> Vec<f64> {
    let reach = window.len() / 2;
    let taps = |at: usize, len: usize| {
        let first = at.saturating_sub(reach);
        (first..(at + reach + 1).min(len)).map(move |i| (i, i + reach - at))
    };
    let mut across = vec![0.0; plane.len()];
    across.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        for (x, out) in out.iter_mut().enumerate() {
            *out = taps(x, width).map(|(i, tap)| row[i] * window[tap]).sum();
        }
    });
    let mut result = vec![0.0; plane.len()];
    result.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (i, tap) in taps(y, height) {
            for (out, value) in out.iter_mut().zip(&across[i * width..(i + 1) * width]) {
                *out += value * window[tap];
            }
        }
    });
    result
}

/// Baseline: the truth's mean colour at every pixel, the mean of the 8-bit sRGB values that count.
pub fn flat_colour(truth: &PackedImage) -> PackedImage {
    let (mut sums, mut count) = ([0_u64; 3], 0_u64);
    for pixel in &truth.pixels {
        let [r, g, b, mask] = pixel.to_le_bytes();
        if mask == 255 {
            for (sum, value) in sums.iter_mut().zip([r, g, b]) {
                *sum += u64::from(value);
            }
            count += 1;
        }
    }
    let [r, g, b] = sums.map(|sum| if count == 0 { 0 } else { ((2 * sum + count) / (2 * count)) as u8 });
    let colour = u32::from_le_bytes([r, g, b, 255]);
    PackedImage { pixels: vec![colour; truth.pixels.len()], ..*truth }
}
