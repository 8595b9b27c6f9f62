//! Bounds of the rounding error of the rasteriser against its twin, by forward error analysis in f64.
//!
//! The relative error of alpha comes from its sigma and from `exp`. The sum sigma may cancel, so its error
//! depends on the sizes of its terms. It is large for needles. All later errors follow from the formulas in
//! first order. A decision compares alpha with 1/255 or the cap, sigma with 0, or the transmittance with the
//! end of the ray. Kernel and twin may decide differently when the compared number is within its error of the
//! limit. Such pixels are edges and get the bound of the jump.

use fathom_twins::{RasterGradients, RasterRules, Splat, TileLists};

/// Spacing of f32 at 1: twice the rounding error of one operation.
pub const EPSILON: f64 = f32::EPSILON as f64;
/// Relative error of `exp` in units of EPSILON, without the error of its argument. WGSL allows 3 + 2 |x|.
const EXP: f64 = 8.0;
/// Operations between the numbers of a splat and its sigma, times one half.
const SIGMA: f64 = 4.0;
/// Longest chain of additions of a tile's partial sums: eight pixels, then at most 32 threads.
const SUM: f64 = 24.0;

/// One blended splat at one pixel.
struct Step {
    id: usize,
    delta: [f64; 2],
    falloff: f64,
    alpha: f64,
    /// Relative error of alpha.
    alpha_error: f64,
    /// Transmittance in front of it, with its relative error.
    transmittance: f64,
    transmittance_error: f64,
    capped: bool,
}

/// The blending of one pixel and its decisions.
struct Ray {
    steps: Vec<Step>,
    /// Transmittance behind the last splat, and its relative error.
    transmittance: f64,
    transmittance_error: f64,
    /// Weight that may change at edges, summed; 0 without edges.
    moved: f64,
    /// Whether the alpha of some splat is within its error of the cap.
    cap_edges: bool,
}

fn follow(splats: &[Option<Splat>], ids: &[u32], x: u32, y: u32) -> Ray {
    let rules = RasterRules::HARD;
    let mut ray =
        Ray { steps: Vec::new(), transmittance: 1.0, transmittance_error: 0.0, moved: 0.0, cap_edges: false };
    for &id in ids {
        let Some(splat) = &splats[id as usize] else { continue };
        let [a, b, c] = splat.conic;
        let delta = [splat.mean2d[0] - (f64::from(x) + 0.5), splat.mean2d[1] - (f64::from(y) + 0.5)];
        let terms = [0.5 * a * delta[0] * delta[0], 0.5 * c * delta[1] * delta[1], b * delta[0] * delta[1]];
        let sigma: f64 = terms.iter().sum();
        let sigma_error = SIGMA * EPSILON * terms.iter().map(|t| t.abs()).sum::<f64>();
        let alpha_error = EXP * EPSILON + sigma_error;
        let falloff = (-sigma).exp();
        let full = splat.opacity * falloff;
        let alpha = full.min(rules.max_alpha);
        let near = |value: f64, edge: f64, error: f64| (value / edge - 1.0).abs() <= error;
        if near(full, rules.min_alpha, alpha_error) {
            ray.moved += 2.0 * ray.transmittance * rules.min_alpha;
        }
        if sigma.abs() <= sigma_error && alpha >= rules.min_alpha && terms.iter().any(|t| *t != 0.0) {
            ray.moved += 2.0 * ray.transmittance * alpha;
        }
        if sigma < 0.0 || alpha < rules.min_alpha {
            continue;
        }
        ray.cap_edges |= near(full, rules.max_alpha, alpha_error);
        let next = ray.transmittance * (1.0 - alpha);
        let next_error = ray.transmittance_error + alpha * alpha_error / (1.0 - alpha) + 2.0 * EPSILON;
        if near(next, rules.min_transmittance, next_error) {
            ray.moved += 2.0 * ray.transmittance;
        }
        if next < rules.min_transmittance {
            break;
        }
        ray.steps.push(Step {
            id: id as usize,
            delta,
            falloff,
            alpha,
            alpha_error,
            transmittance: ray.transmittance,
            transmittance_error: ray.transmittance_error,
            capped: full > rules.max_alpha,
        });
        ray.transmittance = next;
        ray.transmittance_error = next_error;
    }
    ray
}

/// Bounds of one pixel of the images.
#[derive(Clone, Copy, Debug)]
pub struct PixelBound {
    /// Of each colour.
    pub rgb: f64,
    pub alpha: f64,
    pub range: f64,
    /// Whether a decision lay within its error.
    pub edge: bool,
}

impl Ray {
    /// Sum of the errors of the weights, and the error of the remaining transmittance.
    fn bound(&self) -> (f64, f64) {
        let weights: f64 = self
            .steps
            .iter()
            .map(|s| s.alpha * s.transmittance * (s.alpha_error + s.transmittance_error + 3.0 * EPSILON))
            .sum();
        // T is computed by subtracting weights: an absolute rounding error of at most EPSILON per splat.
        let left = self.transmittance * self.transmittance_error + EPSILON * (self.steps.len() as f64 + 1.0);
        let sums = EPSILON * (self.steps.len() as f64 + 2.0);
        (weights + sums + self.moved, left + self.moved)
    }
}

fn largest(splats: &[Option<Splat>], of: impl Fn(&Splat) -> f64) -> f64 {
    splats.iter().flatten().map(of).fold(0.0, f64::max)
}

fn brightest(splats: &[Option<Splat>], background: [f64; 3]) -> f64 {
    let rgb = |c: [f64; 3]| c.iter().fold(0.0_f64, |m, v| m.max(*v));
    largest(splats, |s| rgb(s.rgb)).max(rgb(background))
}

/// Bounds of every pixel of `rasterize_forward`.
pub fn of_images(
    splats: &[Option<Splat>],
    lists: &TileLists,
    width: u32,
    height: u32,
    background: [f64; 3],
) -> Vec<PixelBound> {
    let (colour, range) = (brightest(splats, background), largest(splats, |s| s.range));
    let mut bounds = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let ray = follow(splats, lists.of_tile(x / 16, y / 16), x, y);
            let (weights, left) = ray.bound();
            bounds.push(PixelBound {
                rgb: colour * (weights + left),
                alpha: left,
                range: range * weights,
                edge: ray.moved > 0.0,
            });
        }
    }
    bounds
}

/// Bounds of the gradient of one splat.
#[derive(Clone, Copy, Debug, Default)]
pub struct SplatBound {
    pub mean2d: [f64; 2],
    pub conic: [f64; 3],
    pub rgb: [f64; 3],
    pub opacity: f64,
    pub range: f64,
    pub abs: f64,
    pub contribution: f64,
    /// Number of edge pixels that it contributes to.
    pub edges: u32,
}

/// Bounds of the sums over slots of `rasterize_backward`, by Gaussian.
pub fn of_splat_gradients(
    splats: &[Option<Splat>],
    lists: &TileLists,
    width: u32,
    height: u32,
    background: [f64; 3],
    v: &RasterGradients,
) -> Vec<SplatBound> {
    let mut bounds = vec![SplatBound::default(); splats.len()];
    let (colour, far) = (brightest(splats, background), largest(splats, |s| s.range));
    for y in 0..height {
        for x in 0..width {
            let pixel = (y * width + x) as usize;
            let ray = follow(splats, lists.of_tile(x / 16, y / 16), x, y);
            let (v_rgb, v_alpha, v_range) = (v.rgb[pixel], v.alpha[pixel].abs(), v.range[pixel].abs());
            // Upper bound of everything that is blended here.
            let scale = colour * v_rgb.iter().map(|v| v.abs()).sum::<f64>() + far * v_range + v_alpha;
            let (weights, left) = ray.bound();
            // `rem` starts as the whole pixel and loses each blended part.
            let mut rem_error = scale * (weights + left + 4.0 * EPSILON);
            for step in &ray.steps {
                let Some(splat) = &splats[step.id] else { continue };
                let bound = &mut bounds[step.id];
                let t = step.transmittance;
                let weight = step.alpha * t;
                let weight_error = step.alpha_error + step.transmittance_error + (3.0 + SUM) * EPSILON;
                let mut moved = 0.0;
                if ray.moved > 0.0 || (ray.cap_edges && !near_zero(step.alpha)) {
                    // |v_alpha| is at most 2 scale T; T itself changes by a share of the moved weight.
                    bound.edges += 1;
                    moved = 4.0 * scale * (t + ray.moved).min(1.0);
                }
                bound.contribution += weight * weight_error + ray.moved;
                bound.range += v_range * (weight * weight_error + ray.moved);
                for c in 0..3 {
                    bound.rgb[c] += v_rgb[c].abs() * (weight * weight_error + ray.moved);
                }
                rem_error += scale * (weight * (weight_error + 4.0 * EPSILON) + EPSILON);
                let this = (2.0 * scale * t) * (step.transmittance_error + 4.0 * EPSILON)
                    + (rem_error + scale * t * step.alpha * step.alpha_error) / (1.0 - step.alpha);
                let size = 2.0 * scale * t;
                if step.capped && moved == 0.0 {
                    continue;
                }
                let rounding = size * (step.alpha_error + (6.0 + SUM) * EPSILON);
                let total = this + rounding + moved;
                let sigma = step.alpha * total;
                let [a, b, c] = splat.conic.map(f64::abs);
                let [dx, dy] = step.delta.map(f64::abs);
                bound.opacity += step.falloff * total;
                let mean = [sigma * (a * dx + b * dy), sigma * (b * dx + c * dy)];
                bound.mean2d[0] += mean[0];
                bound.mean2d[1] += mean[1];
                bound.abs += mean[0] + mean[1];
                bound.conic[0] += sigma * 0.5 * dx * dx;
                bound.conic[1] += sigma * dx * dy;
                bound.conic[2] += sigma * 0.5 * dy * dy;
            }
        }
    }
    bounds
}

fn near_zero(alpha: f64) -> bool {
    alpha < 0.5
}
