//! Compares a render with a photograph: PSNR and SSIM, and the baselines that any model must beat.
//!
//! Both pictures are 8-bit sRGB. PSNR is over all pixels and channels. SSIM is as in 3DGS: a Gaussian window
//! of 11 x 11 with sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2. It is computed for each
//! channel and averaged over pixels and channels. Pixels that the mask of the truth leaves out count in
//! neither: for SSIM both pictures are set to black there, and the map is not averaged there.
//!
//! All sums are f64 and in a fixed order, so that results do not depend on threads.

use rayon::prelude::*;

use crate::views::PackedImage;

/// Side of the SSIM window.
const WINDOW: usize = 11;
/// Its standard deviation, pixels.
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
/// Standard deviation of [`blurred`], pixels.
const BLUR_SIGMA: f64 = 15.0;

/// An sRGB value in 0..1, clamped and rounded to 8 bits; NaN gives 0.
pub fn to_8_bit(value: f32) -> u8 {
    // The cast saturates and turns NaN into 0; adding a half before rounds to nearest.
    (value * 255.0 + 0.5) as u8
}

/// A render as 8-bit pixels, all of which count. `rgb` has one entry a pixel, sRGB 0..1, unclamped.
pub fn quantised(width: u32, height: u32, rgb: &[[f32; 3]]) -> PackedImage {
    let pixels = rgb.iter().map(|pixel| {
        let [r, g, b] = pixel.map(to_8_bit);
        u32::from_le_bytes([r, g, b, 255])
    });
    PackedImage { width, height, pixels: pixels.collect() }
}

/// How every number of a report was measured, in words.
pub fn protocol() -> String {
    format!(
        "render clamped and rounded to 8 bits in sRGB; PSNR in dB, mean over views; SSIM as in 3DGS: 11 taps, sigma 1.5, zero \
         padding, RGB; {}; {}",
        crate::seams::PROTOCOL,
        crate::cover::PROTOCOL
    )
}

/// Peak signal to noise ratio in dB over the pixels that `truth`'s mask counts; infinite for equal pictures.
///
/// NaN when the sizes differ or no pixel counts.
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
    SsimMap::new(render, truth).map_or(f64::NAN, |map| map.mean())
}

/// Structural similarity pixel by pixel.
pub struct SsimMap {
    /// One plane a channel, row-major.
    channels: [Vec<f64>; 3],
    /// Which pixels the mask of the truth counts; at least one.
    counted: Vec<bool>,
}

impl SsimMap {
    /// The map of a pair; `None` when the sizes differ or no pixel counts.
    pub fn new(render: &PackedImage, truth: &PackedImage) -> Option<Self> {
        if (render.width, render.height) != (truth.width, truth.height) {
            return None;
        }
        let (width, height) = (truth.width as usize, truth.height as usize);
        let counted: Vec<bool> = truth.pixels.iter().map(|pixel| pixel.to_le_bytes()[3] == 255).collect();
        if !counted.contains(&true) {
            return None;
        }
        let plane = |image: &PackedImage, channel: usize| -> Vec<f64> {
            let value = |(pixel, counts): (&u32, &bool)| {
                if *counts { f64::from(pixel.to_le_bytes()[channel]) / 255.0 } else { 0.0 }
            };
            image.pixels.iter().zip(&counted).map(value).collect()
        };
        let channels =
            [0, 1, 2].map(|channel| ssim_map(&plane(render, channel), &plane(truth, channel), width, height));
        Some(Self { channels, counted })
    }

    /// The mean over the pixels that count, and the channels.
    pub fn mean(&self) -> f64 {
        let of_channel = |map: &Vec<f64>| -> f64 {
            let counted = map.iter().zip(&self.counted);
            counted.map(|(value, counts)| if *counts { *value } else { 0.0 }).sum()
        };
        let sum: f64 = self.channels.iter().map(of_channel).fold(0.0, |sum, channel| sum + channel);
        sum / (3 * self.counted.iter().filter(|counts| **counts).count()) as f64
    }

    /// The mean over the channels at one pixel, row-major from the top left.
    pub fn at(&self, pixel: usize) -> f64 {
        self.channels.iter().map(|map| map[pixel]).sum::<f64>() / 3.0
    }
}

/// SSIM of two planes at every pixel.
fn ssim_map(a: &[f64], b: &[f64], width: usize, height: usize) -> Vec<f64> {
    let product = |x: &[f64], y: &[f64]| -> Vec<f64> { x.iter().zip(y).map(|(x, y)| x * y).collect() };
    let window = gaussian_window(WINDOW / 2, SIGMA);
    let blur = |plane: &[f64]| convolve(plane, width, height, &window);
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

/// A Gaussian window along one axis, `2 * reach + 1` long, of sum 1.
fn gaussian_window(reach: usize, sigma: f64) -> Vec<f64> {
    let weights: Vec<f64> = (0..=2 * reach)
        .map(|i| {
            let distance = i as f64 - reach as f64;
            (-distance * distance / (2.0 * sigma * sigma)).exp()
        })
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / sum).collect()
}

/// Convolution with a separable, symmetric window; zeros beyond the border.
fn convolve(plane: &[f64], width: usize, height: usize, window: &[f64]) -> Vec<f64> {
    let reach = window.len() / 2;
    // Row by row and tap by tap, so that the inner loops run over neighbouring pixels.
    let add = |out: &mut [f64], values: &[f64], weight: f64| {
        for (out, value) in out.iter_mut().zip(values) {
            *out += value * weight;
        }
    };
    let mut across = vec![0.0; plane.len()];
    across.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        for (tap, weight) in window.iter().enumerate() {
            // out[x] takes row[x + tap - reach].
            let (from, to) = (tap.saturating_sub(reach), reach.saturating_sub(tap));
            if from < width && to < width {
                add(&mut out[to..], &row[from..], *weight);
            }
        }
    });
    let mut result = vec![0.0; plane.len()];
    result.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for row in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            add(out, &across[row * width..(row + 1) * width], window[row + reach - y]);
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

/// Baseline: the truth blurred by a Gaussian of sigma 15 pixels (cut at 4 sigma), over the pixels that count.
///
/// It keeps colour and shading but no texture. Under water, where contrast is low, it scores high.
pub fn blurred(truth: &PackedImage) -> PackedImage {
    let (width, height) = (truth.width as usize, truth.height as usize);
    let window = gaussian_window((4.0 * BLUR_SIGMA) as usize, BLUR_SIGMA);
    let blur = |value: &dyn Fn([u8; 4]) -> f64| {
        let plane: Vec<f64> = truth.pixels.iter().map(|pixel| value(pixel.to_le_bytes())).collect();
        convolve(&plane, width, height, &window)
    };
    // Divided by the blurred mask, so that neither the border nor masked pixels darken the rest.
    let counts = |pixel: [u8; 4]| f64::from(u8::from(pixel[3] == 255));
    let weight = blur(&counts);
    let planes = [0, 1, 2].map(|channel| blur(&|pixel| f64::from(pixel[channel]) * counts(pixel)));
    let pixels = (0..truth.pixels.len()).map(|i| {
        let [r, g, b] = [0, 1, 2].map(|channel| (planes[channel][i] / weight[i] + 0.5) as u8);
        u32::from_le_bytes([r, g, b, 255])
    });
    PackedImage { width: truth.width, height: truth.height, pixels: pixels.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: u32 = 37;
    const HEIGHT: u32 = 23;

    fn image(value: impl Fn(u32, u32, u32) -> u32) -> PackedImage {
        let rgb: Vec<u8> = (0..WIDTH * HEIGHT)
            .flat_map(|i| [0, 1, 2].map(|c| value(i % WIDTH, i / WIDTH, c).min(255) as u8))
            .collect();
        PackedImage::from_rgb8(WIDTH, HEIGHT, &rgb)
    }

    /// Two pairs: a noisy one and a smooth one.
    fn pairs() -> [(PackedImage, PackedImage); 2] {
        let smooth = |x, y, c| (x * 5 + y * 3 + 40 * c) % 200;
        [
            (
                image(|x, y, c| (x * 7 + y * 13 + c * 31) % 256),
                image(|x, y, c| (x * 7 + y * 13 + c * 31 + (x * x + 3 * y) % 17 * 3) % 256),
            ),
            (image(smooth), image(|x, y, c| smooth(x, y, c) + (x * 11 + y * 5) % 23)),
        ]
    }

    #[test]
    fn psnr_and_ssim_are_those_of_numpy() {
        // numpy and scipy 2026-11, on the same pictures: g = exp(-(arange(11) - 5)**2 / 4.5); g /= g.sum();
        // conv = correlate1d(correlate1d(p, g, axis=0, mode='constant'), g, axis=1, mode='constant'); the
        // formula of SSIM with C1 = 1e-4, C2 = 9e-4 on p/255, mean over pixels and channels. Its maps equal
        // those of skimage.metrics.structural_similarity(win_size=11, gaussian_weights=True, sigma=1.5,
        // use_sample_covariance=False) to 1e-13 where the window lies inside the picture.
        let expected = [
            (10.790_746_088_878_585, 0.552_597_284_171_246_6),
            (25.955_964_166_540_042, 0.898_519_145_530_636_7),
        ];
        for ((a, b), (psnr_db, similarity)) in pairs().iter().zip(expected) {
            assert!((psnr(a, b) - psnr_db).abs() < 1e-9, "{}", psnr(a, b));
            assert!((ssim(a, b) - similarity).abs() < 1e-12, "{}", ssim(a, b));
        }
    }

    #[test]
    fn equal_pictures_have_ssim_1_and_infinite_psnr() {
        let [(a, _), _] = pairs();
        assert_eq!(psnr(&a, &a), f64::INFINITY);
        assert!((ssim(&a, &a) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn pixels_outside_the_mask_change_nothing() {
        let [(render, mut truth), _] = pairs();
        for (i, pixel) in truth.pixels.iter_mut().enumerate() {
            if i % 5 == 0 || i < 100 {
                *pixel &= 0x00FF_FFFF;
            }
        }
        let before = (psnr(&render, &truth), ssim(&render, &truth), flat_colour(&truth), blurred(&truth));
        let mut painted = render;
        for (pixel, masked) in painted.pixels.iter_mut().zip(&mut truth.pixels) {
            if masked.to_le_bytes()[3] == 0 {
                *pixel = 0xFF12_34FF;
                *masked = 0x00FF_00AA;
            }
        }
        assert_eq!(
            (psnr(&painted, &truth), ssim(&painted, &truth), flat_colour(&truth), blurred(&truth)),
            before
        );
    }

    #[test]
    fn nothing_to_compare_gives_nan() {
        let [(a, b), _] = pairs();
        let smaller = PackedImage::from_rgb8(1, 1, &[0, 0, 0]);
        assert!(psnr(&smaller, &b).is_nan() && ssim(&smaller, &b).is_nan());
        let masked = PackedImage { pixels: b.pixels.iter().map(|p| p & 0x00FF_FFFF).collect(), ..b };
        assert!(psnr(&a, &masked).is_nan() && ssim(&a, &masked).is_nan());
    }

    #[test]
    fn a_render_is_clamped_and_rounded_to_8_bits() {
        let image = quantised(2, 1, &[[-0.5, 0.5, 2.0], [f32::NAN, 0.498 / 255.0, 0.502 / 255.0]]);
        assert_eq!(image.to_rgb8(), [0, 128, 255, 0, 0, 1]);
    }

    #[test]
    fn baselines_keep_the_mean_and_lose_the_texture() {
        let checker = image(|x, y, _| if (x + y) % 2 == 0 { 90 } else { 110 });
        assert!(flat_colour(&checker).to_rgb8().iter().all(|value| *value == 100));
        assert!(blurred(&checker).to_rgb8().iter().all(|value| (99..=101).contains(value)));
    }
}
