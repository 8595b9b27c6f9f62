//! (1 - w) L1 + w (1 - SSIM) of a render against its photograph, and the gradient with respect to the render.
//!
//! SSIM as in 3DGS: Gaussian window of 11 taps, sigma 1.5, zeros outside the image, C1 = 0.01^2, C2 = 0.03^2,
//! per channel. L1 and SSIM are each the mean over pixels and channels. At masked pixels, render and
//! photograph are set to 0 before the window, and |difference| and the SSIM map are set to 0 after it. The
//! mean is still over all pixels, so a wholly masked picture has the loss w and no gradient.

use fathom_core::views::PackedImage;

/// Taps of the window.
pub const SSIM_TAPS: usize = 11;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// The loss of one view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Loss {
    /// (1 - w) l1 + w (1 - ssim).
    pub total: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Gradient of `total` with respect to the render, `[H*W]`.
    pub v_rgb: Vec<[f64; 3]>,
}

/// Colours as numbers from 0 to 1, and which pixels count (mask byte 255).
pub fn unpack(image: &PackedImage) -> (Vec<[f64; 3]>, Vec<bool>) {
    let bytes = image.pixels.iter().map(|p| p.to_le_bytes());
    bytes.map(|[r, g, b, mask]| ([r, g, b].map(|v| f64::from(v) / 255.0), mask == 255)).unzip()
}

/// Loss of `render` against `truth`, both `[H*W]` row-major, `mask` true where a pixel counts.
pub fn loss(
    render: &[[f64; 3]],
    truth: &[[f64; 3]],
    mask: &[bool],
    width: u32,
    height: u32,
    ssim_weight: f64,
) -> Loss {
    let pixels = (width * height) as usize;
    let (width, height) = (width as usize, height as usize);
    let per_value = 1.0 / (3 * pixels) as f64;
    let mut result = Loss { v_rgb: vec![[0.0; 3]; pixels], ..Loss::default() };
    for c in 0..3 {
        let masked = |image: &[[f64; 3]]| -> Vec<f64> {
            image.iter().zip(mask).map(|(rgb, &counts)| if counts { rgb[c] } else { 0.0 }).collect()
        };
        let (x, y) = (masked(render), masked(truth));
        let terms = Ssim::new(&x, &y, width, height);
        // The mask applies to every derivative of the map before it goes back through the window.
        let masked_terms = |of: fn(&Ssim, usize) -> f64| -> Vec<f64> {
            (0..pixels).map(|i| if mask[i] { of(&terms, i) } else { 0.0 }).collect()
        };
        let by_mean = blur(&masked_terms(Ssim::by_mean), width, height);
        let by_square = blur(&masked_terms(Ssim::by_square), width, height);
        let by_product = blur(&masked_terms(Ssim::by_product), width, height);
        for i in (0..pixels).filter(|&i| mask[i]) {
            let difference = x[i] - y[i];
            result.l1 += difference.abs() * per_value;
            result.ssim += terms.value(i) * per_value;
            let v_ssim = by_mean[i] + 2.0 * x[i] * by_square[i] + y[i] * by_product[i];
            result.v_rgb[i][c] = per_value * ((1.0 - ssim_weight) * sign(difference) - ssim_weight * v_ssim);
        }
    }
    result.total = (1.0 - ssim_weight) * result.l1 + ssim_weight * (1.0 - result.ssim);
    result
}

/// SSIM of one channel at every pixel.
pub fn ssim_map(x: &[f64], y: &[f64], width: u32, height: u32) -> Vec<f64> {
    let terms = Ssim::new(x, y, width as usize, height as usize);
    (0..x.len()).map(|i| terms.value(i)).collect()
}

/// The five windowed means of SSIM.
struct Ssim {
    x: Vec<f64>,
    y: Vec<f64>,
    xx: Vec<f64>,
    yy: Vec<f64>,
    xy: Vec<f64>,
}

impl Ssim {
    fn new(x: &[f64], y: &[f64], width: usize, height: usize) -> Self {
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(p, q)| p * q).collect::<Vec<_>>();
        Self {
            x: blur(x, width, height),
            y: blur(y, width, height),
            xx: blur(&product(x, x), width, height),
            yy: blur(&product(y, y), width, height),
            xy: blur(&product(x, y), width, height),
        }
    }

    /// (luminance numerator, contrast numerator, luminance denominator, contrast denominator).
    fn parts(&self, i: usize) -> (f64, f64, f64, f64) {
        let (mx, my) = (self.x[i], self.y[i]);
        (
            2.0 * mx * my + C1,
            2.0 * (self.xy[i] - mx * my) + C2,
            mx * mx + my * my + C1,
            (self.xx[i] - mx * mx) + (self.yy[i] - my * my) + C2,
        )
    }

    fn value(&self, i: usize) -> f64 {
        let (a, b, c, d) = self.parts(i);
        a * b / (c * d)
    }

    /// Derivative of the map with respect to the windowed mean of x, at fixed windowed means of x^2 and x y.
    fn by_mean(&self, i: usize) -> f64 {
        let (mx, my) = (self.x[i], self.y[i]);
        let (a, b, c, d) = self.parts(i);
        2.0 * my * (b - a) / (c * d) - a * b / (c * d) * 2.0 * mx * (1.0 / c - 1.0 / d)
    }

    /// With respect to the windowed mean of x^2.
    fn by_square(&self, i: usize) -> f64 {
        let (a, b, c, d) = self.parts(i);
        -a * b / (c * d * d)
    }

    /// With respect to the windowed mean of x y.
    fn by_product(&self, i: usize) -> f64 {
        let (a, _, c, d) = self.parts(i);
        2.0 * a / (c * d)
    }
}

/// The window on one axis; its taps sum to 1.
fn window() -> [f64; SSIM_TAPS] {
    let centre = (SSIM_TAPS / 2) as f64;
    let taps: [f64; SSIM_TAPS] =
        std::array::from_fn(|i| (-(i as f64 - centre).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = taps.iter().sum();
    taps.map(|tap| tap / sum)
}

/// Convolves with the window along rows, then columns, with zeros outside. It is symmetric, so it is its own
/// backward pass.
fn blur(image: &[f64], width: usize, height: usize) -> Vec<f64> {
    let taps = window();
    let along = |image: &[f64], step: usize, place: fn(usize, usize) -> usize, length: usize| -> Vec<f64> {
        let at = |i: usize, k: usize| {
            let position = (place(i, width) + k).checked_sub(SSIM_TAPS / 2)?;
            (position < length).then(|| taps[k] * image[i + k * step - (SSIM_TAPS / 2) * step])
        };
        (0..image.len()).map(|i| (0..SSIM_TAPS).filter_map(|k| at(i, k)).sum()).collect()
    };
    let rows = along(image, 1, |i, width| i % width, width);
    along(&rows, width, |i, width| i / width, height)
}

fn sign(v: f64) -> f64 {
    if v > 0.0 {
        1.0
    } else if v < 0.0 {
        -1.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use fathom_core::rng::{Stream, uniform_at};

    fn noise(seed: u32, pixels: u32) -> Vec<[f64; 3]> {
        (0..pixels)
            .map(|i| std::array::from_fn(|c| f64::from(uniform_at(seed, Stream::Test, i, c as u32))))
            .collect()
    }

    #[test]
    fn an_image_against_itself_has_ssim_one_and_no_loss() {
        let image = noise(1, 17 * 13);
        let result = loss(&image, &image, &[true; 17 * 13], 17, 13, 0.2);
        assert_eq!(result.l1, 0.0);
        // 1e-14: a mean of 663 numbers that are 1 up to rounding.
        assert!((result.ssim - 1.0).abs() < 1e-14, "ssim {}", result.ssim);
        assert!(result.total.abs() < 1e-14);
        // SSIM is at its maximum, so the gradient vanishes. It is a difference of numbers near 10.
        assert!(result.v_rgb.iter().flatten().all(|v| v.abs() < 1e-14));
    }

    #[test]
    fn inside_the_border_flat_images_have_the_ssim_of_their_levels() {
        let (x, y): (f64, f64) = (0.25, 0.75);
        let map = ssim_map(&[x; 21 * 21], &[y; 21 * 21], 21, 21);
        let expected = (2.0 * x * y + C1) / (x * x + y * y + C1);
        assert!((map[10 * 21 + 10] - expected).abs() < 1e-12);
        // At the corner, the window includes zeros outside the picture, so there is contrast.
        assert!((map[0] - expected).abs() > 1e-3);
    }

    #[test]
    fn the_blur_is_the_full_two_dimensional_window() {
        let (width, height) = (14, 9);
        let image: Vec<f64> = noise(5, 14 * 9).iter().map(|p| p[0]).collect();
        let blurred = blur(&image, width, height);
        let taps = window();
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for v in 0..height {
                    for u in 0..width {
                        let (i, j) = (u as isize - x as isize + 5, v as isize - y as isize + 5);
                        if (0..11).contains(&i) && (0..11).contains(&j) {
                            sum += taps[i as usize] * taps[j as usize] * image[v * width + u];
                        }
                    }
                }
                assert!((sum - blurred[y * width + x]).abs() < 1e-14, "pixel {x}, {y}");
            }
        }
    }

    #[test]
    fn masked_or_not_the_gradient_is_the_central_difference() {
        let (width, height) = (13_u32, 11_u32);
        let (render, mut truth) = (noise(2, width * height), noise(3, width * height));
        // |difference| has a kink at 0, where a central difference is meaningless.
        for (x, y) in render.iter().flatten().zip(truth.iter_mut().flatten()) {
            *y += if *y > *x { 1e-3 } else { -1e-3 };
        }
        for share in [0.0, 0.3] {
            let mask: Vec<bool> =
                (0..width * height).map(|i| f64::from(uniform_at(4, Stream::Test, i, 0)) >= share).collect();
            for weight in [0.0, 0.2, 1.0] {
                let total = |render: &[[f64; 3]]| loss(render, &truth, &mask, width, height, weight).total;
                let analytic = loss(&render, &truth, &mask, width, height, weight).v_rgb;
                for i in 0..render.len() {
                    for c in 0..3 {
                        let numeric = derivative(|h| {
                            let mut moved = render.clone();
                            moved[i][c] += h;
                            total(&moved)
                        });
                        let what = format!("pixel {i} channel {c}, weight {weight}, masked {share}");
                        assert_close(&what, analytic[i][c], numeric, 1e-3);
                    }
                }
            }
        }
    }

    #[test]
    fn the_value_of_an_ignored_pixel_changes_nothing() {
        let (width, height) = (12_u32, 12_u32);
        let (mut render, truth) = (noise(6, 144), noise(7, 144));
        let mask: Vec<bool> = (0..144).map(|i| i % 5 != 0).collect();
        let before = loss(&render, &truth, &mask, width, height, 0.2);
        render[10] = [f64::NAN, f64::INFINITY, -3.0];
        let after = loss(&render, &truth, &mask, width, height, 0.2);
        assert_eq!(before, after);
        assert_eq!(after.v_rgb[10], [0.0; 3]);
    }

    #[test]
    fn packed_pixels_unpack_to_colours_and_mask() {
        let image = PackedImage { width: 2, height: 1, pixels: vec![0xFF00_80FF, 0x0000_0000] };
        let (rgb, mask) = unpack(&image);
        assert_eq!(rgb, vec![[1.0, 128.0 / 255.0, 0.0], [0.0; 3]]);
        assert_eq!(mask, vec![true, false]);
    }
}
