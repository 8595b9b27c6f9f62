//! Backward pass of `rasterize_forward`, per pixel, front to back a second time.
//!
//! With q_i = rgb_i . v_rgb + range_i v_range, the gradient of a pixel with respect to one of its
//! alphas is
//!
//! ```text
//! v_alpha_i = T_i q_i - (S_i + T_end (background . v_rgb - v_alpha)) / (1 - alpha_i)
//! ```
//!
//! where T_i is the transmittance in front of splat i, S_i = sum over j behind i of alpha_j T_j q_j, and
//! T_end is the transmittance at the end. S_i is the whole sum of the pixel minus the part up to i, so one
//! pass in forward order suffices.

use super::rasterize_forward::contribution;
use super::{Raster, RasterRules, Splat, TILE, TileLists};

/// Gradient of the loss with respect to the outputs of `rasterize_forward`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RasterGradients {
    /// With respect to colour, `[H*W]`.
    pub rgb: Vec<[f64; 3]>,
    /// With respect to alpha, `[H*W]`.
    pub alpha: Vec<f64>,
    /// With respect to range, `[H*W]`.
    pub range: Vec<f64>,
}

impl RasterGradients {
    /// Gradient with respect to colour only.
    pub fn of_colour(rgb: Vec<[f64; 3]>) -> Self {
        let pixels = rgb.len();
        Self { rgb, alpha: vec![0.0; pixels], range: vec![0.0; pixels] }
    }
}

/// Gradient of the loss with respect to one [`Splat`], and its statistics for density control.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SplatGradient {
    /// With respect to the centre, per pixel.
    pub mean2d: [f64; 2],
    /// With respect to (a, b, c); `b` counted once.
    pub conic: [f64; 3],
    /// With respect to the colour.
    pub rgb: [f64; 3],
    /// With respect to the opacity (after the sigmoid).
    pub opacity: f64,
    /// With respect to the range.
    pub range: f64,
    /// Sum over pixels of |v_mean2d.x| + |v_mean2d.y|. It does not cancel when pixels pull a splat in
    /// opposite directions (AbsGS). Not a gradient.
    pub abs: f64,
    /// Sum over pixels of alpha T: its share of the image. Not a gradient.
    pub contribution: f64,
}

/// Gradient of the splats, by Gaussian; zeros where nothing was blended.
pub fn rasterize_backward(
    splats: &[Option<Splat>],
    lists: &TileLists,
    raster: &Raster,
    background: [f64; 3],
    rules: &RasterRules,
    v: &RasterGradients,
) -> Vec<SplatGradient> {
    let mut v_splats = vec![SplatGradient::default(); splats.len()];
    for y in 0..raster.height {
        for x in 0..raster.width {
            let pixel = (y * raster.width + x) as usize;
            let (v_rgb, v_alpha, v_range) = (v.rgb[pixel], v.alpha[pixel], v.range[pixel]);
            let behind_all = raster.transmittance[pixel] * (dot(background, v_rgb) - v_alpha);
            let ids = &lists.of_tile(x / TILE, y / TILE)[..raster.last[pixel] as usize];
            let value = |splat: &Splat| dot(splat.rgb, v_rgb) + splat.range * v_range;

            let (mut behind, mut transmittance) = (0.0, 1.0);
            for &id in ids {
                let Some(splat) = &splats[id as usize] else { continue };
                let Some(at) = contribution(splat, x, y, rules) else { continue };
                behind += at.alpha * transmittance * value(splat);
                transmittance *= 1.0 - at.alpha;
            }

            transmittance = 1.0;
            for &id in ids {
                let Some(splat) = &splats[id as usize] else { continue };
                let Some(at) = contribution(splat, x, y, rules) else { continue };
                let weight = at.alpha * transmittance;
                behind -= weight * value(splat);
                let v_this = transmittance * value(splat) - (behind + behind_all) / (1.0 - at.alpha);
                transmittance *= 1.0 - at.alpha;

                let sum = &mut v_splats[id as usize];
                for c in 0..3 {
                    sum.rgb[c] += weight * v_rgb[c];
                }
                sum.range += weight * v_range;
                sum.contribution += weight;
                if at.capped {
                    continue;
                }
                // alpha = opacity exp(-sigma)
                sum.opacity += at.falloff * v_this;
                let v_sigma = -at.alpha * v_this;
                let [a, b, c] = splat.conic;
                let [dx, dy] = at.delta;
                let v_mean2d = [v_sigma * (a * dx + b * dy), v_sigma * (b * dx + c * dy)];
                sum.mean2d[0] += v_mean2d[0];
                sum.mean2d[1] += v_mean2d[1];
                sum.abs += v_mean2d[0].abs() + v_mean2d[1].abs();
                sum.conic[0] += v_sigma * 0.5 * dx * dx;
                sum.conic[1] += v_sigma * dx * dy;
                sum.conic[2] += v_sigma * 0.5 * dy * dy;
            }
        }
    }
    v_splats
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use crate::samples::{all, off_centre_view};
    use crate::{intersect, project_forward, rasterize_forward};
    use fathom_core::rng::{Stream, uniform_at};

    const WIDTH: u32 = 37;
    const HEIGHT: u32 = 21;
    const BACKGROUND: [f64; 3] = [0.2, 0.7, 0.4];

    /// One weight for each number of the images.
    fn weights() -> RasterGradients {
        let pixels = 0..WIDTH * HEIGHT;
        let u = |i, j| 2.0 * f64::from(uniform_at(31, Stream::Test, i, j)) - 1.0;
        RasterGradients {
            rgb: pixels.clone().map(|i| [u(i, 0), u(i, 1), u(i, 2)]).collect(),
            alpha: pixels.clone().map(|i| u(i, 3)).collect(),
            range: pixels.map(|i| u(i, 4)).collect(),
        }
    }

    fn weighted(raster: &Raster, v: &RasterGradients) -> f64 {
        (0..raster.alpha.len())
            .map(|i| {
                dot(raster.rgb[i], v.rgb[i]) + raster.alpha[i] * v.alpha[i] + raster.range[i] * v.range[i]
            })
            .sum()
    }

    /// The numbers of a splat that have a gradient.
    fn number(splat: &mut Splat, i: usize) -> &mut f64 {
        match i {
            0..2 => &mut splat.mean2d[i],
            2..5 => &mut splat.conic[i - 2],
            5..8 => &mut splat.rgb[i - 5],
            8 => &mut splat.opacity,
            _ => &mut splat.range,
        }
    }

    fn gradient(v: &SplatGradient, i: usize) -> f64 {
        match i {
            0..2 => v.mean2d[i],
            2..5 => v.conic[i - 2],
            5..8 => v.rgb[i - 5],
            8 => v.opacity,
            _ => v.range,
        }
    }

    /// `step` shrinks the step of the central difference; the tolerance for rounding grows accordingly.
    fn check(rules: &RasterRules, seed: u32, step: f64) {
        let (camera, pose) = off_centre_view(WIDTH, HEIGHT, 3.0);
        let v = weights();
        for (name, model) in all(seed, 16, 0) {
            let splats = project_forward(&model, &camera, &pose, 0, rules);
            // The lists stay fixed while numbers change, because a splat enters a tile at alpha = min_alpha
            // only.
            let lists = intersect(&splats, WIDTH, HEIGHT);
            let forward = |splats: &[Option<Splat>]| {
                rasterize_forward(splats, &lists, WIDTH, HEIGHT, BACKGROUND, rules)
            };
            let raster = forward(&splats);
            let analytic = rasterize_backward(&splats, &lists, &raster, BACKGROUND, rules, &v);
            for id in (0..splats.len()).filter(|&id| splats[id].is_some()) {
                for i in 0..10 {
                    // A conic is about 0.01 / px^2, so its step is smaller.
                    let step = if (2..5).contains(&i) { 1e-2 * step } else { step };
                    let numeric = derivative(|h| {
                        let mut moved = splats.clone();
                        if let Some(splat) = &mut moved[id] {
                            *number(splat, i) += h * step;
                        }
                        weighted(&forward(&moved), &v)
                    }) / step;
                    let what = format!("{name}, number {i} of splat {id}");
                    assert_close(&what, gradient(&analytic[id], i), numeric, 0.1 / step);
                }
            }
        }
    }

    #[test]
    fn without_edges_the_gradient_is_the_central_difference() {
        check(&RasterRules::SMOOTH, 32, 1.0);
    }

    #[test]
    fn the_gradient_stops_at_the_cap_of_alpha() {
        let splat = Splat {
            mean2d: [8.5, 8.5],
            conic: [0.1, 0.0, 0.1],
            rgb: [1.0, 0.5, 0.25],
            opacity: 0.999,
            range: 2.0,
            depth: 2.0,
            extent: 5.0,
            half_size: [10.0, 10.0],
        };
        let rules = RasterRules::HARD;
        let lists = intersect(&[Some(splat)], 16, 16);
        let raster = rasterize_forward(&[Some(splat)], &lists, 16, 16, [0.0; 3], &rules);
        let centre = 8 * 16 + 8;
        assert!((raster.alpha[centre] - 0.99).abs() < 1e-15);
        let mut v = RasterGradients::of_colour(vec![[0.0; 3]; 256]);
        v.rgb[centre] = [1.0; 3];
        let [v_splat] = rasterize_backward(&[Some(splat)], &lists, &raster, [0.0; 3], &rules, &v)[..] else {
            panic!("one splat, one gradient")
        };
        assert_eq!((v_splat.opacity, v_splat.mean2d, v_splat.conic), (0.0, [0.0; 2], [0.0; 3]));
        assert!((v_splat.rgb[0] - 0.99).abs() < 1e-15);
    }

    #[test]
    fn between_edges_the_gradient_is_the_central_difference() {
        // If alpha crosses min_alpha within a step, the image jumps and the difference is of order 1/255 / H.
        // So the step is a hundredth of H, and these seeds have no crossing in it.
        check(&RasterRules::HARD, 33, 1e-2);
    }

    #[test]
    fn contribution_sums_to_alpha_and_abs_bounds_the_gradient() {
        let (camera, pose) = off_centre_view(WIDTH, HEIGHT, 3.0);
        let v = weights();
        for rules in [RasterRules::HARD, RasterRules::SMOOTH] {
            for (name, model) in all(34, 40, 0) {
                let splats = project_forward(&model, &camera, &pose, 0, &rules);
                let lists = intersect(&splats, WIDTH, HEIGHT);
                let raster = rasterize_forward(&splats, &lists, WIDTH, HEIGHT, BACKGROUND, &rules);
                let v_splats = rasterize_backward(&splats, &lists, &raster, BACKGROUND, &rules, &v);
                // The sum of alpha T over splats telescopes to 1 - T at each pixel.
                let shares: f64 = v_splats.iter().map(|s| s.contribution).sum();
                let alphas: f64 = raster.alpha.iter().sum();
                assert!((shares - alphas).abs() < 1e-10 * alphas, "{name}: {shares} and {alphas}");
                for (id, v_splat) in v_splats.iter().enumerate() {
                    let net = v_splat.mean2d[0].abs() + v_splat.mean2d[1].abs();
                    assert!(net <= v_splat.abs * (1.0 + 1e-12), "{name}, splat {id}");
                }
            }
        }
    }
}
