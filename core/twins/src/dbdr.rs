//! Water whose coefficients depend on the range of a pixel (DBDR, SMP-UWGS eq. 9), its backward pass, and
//! Adam on its four parameters.

use super::{Blended, adam_update_with, form, form_backward};
use fathom_core::config::{Blend, Medium};
use fathom_core::water::{LEAST_ALPHA, RangeModulation, Water};

/// A pixel under water, in linear light: `form` for water on pixels, with the coefficients at the range of
/// the pixel.
pub fn form_refined(water: &Water, refinement: &RangeModulation, blend: Blend, pixel: &Blended) -> [f64; 3] {
    let here =
        if pixel.alpha < LEAST_ALPHA { *water } else { refinement.at(water, pixel.range / pixel.alpha) };
    form(&here, Medium::PerPixel, blend, pixel)
}

/// Backward pass of [`form_refined`]: returns the gradient with respect to the pixel, from the gradient `v`
/// with respect to the formed colour. Adds to `v_water` and to `v_refinement`, in the order of
/// [`RangeModulation::to_array`].
pub fn form_refined_backward(
    water: &Water,
    refinement: &RangeModulation,
    blend: Blend,
    pixel: &Blended,
    v: [f64; 3],
    v_water: &mut [f64; 9],
    v_refinement: &mut [f64; 4],
) -> Blended {
    if pixel.alpha < LEAST_ALPHA {
        return form_backward(water, Medium::PerPixel, blend, pixel, v, v_water);
    }
    let range = pixel.range / pixel.alpha;
    let (factors, here) = (refinement.factors(range), refinement.at(water, range));
    let mut v_here = [0.0; 9];
    let mut by = form_backward(&here, Medium::PerPixel, blend, pixel, v, &mut v_here);
    let values = water.to_array();
    let z = range / refinement.unit;
    let mut v_range = 0.0;
    for (k, weight) in [refinement.attenuation[0], refinement.backscatter[0]].into_iter().enumerate() {
        let mut v_factor = 0.0;
        for i in 3 * k..3 * k + 3 {
            v_water[i] += factors[k] * v_here[i];
            v_factor += values[i] * v_here[i];
        }
        // The derivative of m = scale * sigmoid(x) is m (1 - m / scale).
        let v_x = v_factor * factors[k] * (1.0 - factors[k] / refinement.scale);
        v_refinement[2 * k] += v_x * z;
        v_refinement[2 * k + 1] += v_x;
        v_range += v_x * weight / refinement.unit;
    }
    for i in 6..9 {
        v_water[i] += v_here[i];
    }
    by.range += v_range / pixel.alpha;
    by.alpha -= v_range * range / pixel.alpha;
    by
}

/// The weights and biases of eq. 9 with Adam's state.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinementState {
    /// The current parameters.
    pub refinement: RangeModulation,
    first: [f64; 4],
    second: [f64; 4],
    steps: u32,
}

impl RefinementState {
    /// Starts at `refinement`.
    pub fn new(refinement: RangeModulation) -> Self {
        Self { refinement, first: [0.0; 4], second: [0.0; 4], steps: 0 }
    }

    /// Takes one step of Adam (decay 0.9 and 0.999) with the gradient in the order of
    /// [`RangeModulation::to_array`].
    pub fn step(&mut self, v: &[f64; 4], rate: f64) {
        self.steps += 1;
        let mut values = self.refinement.to_array();
        for i in 0..4 {
            let moments = (&mut self.first[i], &mut self.second[i]);
            adam_update_with(&mut values[i], v[i], moments, self.steps, rate, [0.9, 0.999]);
        }
        self.refinement = self.refinement.with_array(values);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use fathom_core::rng::{Stream, uniform_at};

    const WATER: Water =
        Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };

    fn number(i: u32, j: u32) -> f64 {
        f64::from(uniform_at(92, Stream::Test, i, j))
    }

    #[test]
    fn gradients_through_dbdr_are_central_differences() {
        for i in 0..30 {
            let blend = [Blend::Srgb, Blend::Linear, Blend::OverBlack][(i % 3) as usize];
            let four = std::array::from_fn(|k| 2.0 * number(i, 20 + k as u32) - 1.0);
            let refinement = RangeModulation {
                scale: 1.5 + number(i, 8),
                unit: 3.2,
                ..RangeModulation::identity(2.0, 1.0)
            }
            .with_array(four);
            let alpha = 0.05 + 0.95 * number(i, 3);
            let rgb = [alpha * number(i, 0), alpha * number(i, 1), alpha * number(i, 2)];
            let pixel = Blended { rgb, alpha, range: alpha * 9.0 * number(i, 7) };
            let weights = [number(i, 4) - 0.5, number(i, 5), -number(i, 6)];
            let value = |water: &Water, refinement: &RangeModulation, pixel: &Blended| -> f64 {
                form_refined(water, refinement, blend, pixel).iter().zip(weights).map(|(x, w)| x * w).sum()
            };
            let (mut v_water, mut v_refinement) = ([0.0; 9], [0.0; 4]);
            let v = form_refined_backward(
                &WATER,
                &refinement,
                blend,
                &pixel,
                weights,
                &mut v_water,
                &mut v_refinement,
            );
            let along = |change: &dyn Fn(&mut Blended, f64)| {
                derivative(|h| {
                    let mut pixel = pixel;
                    change(&mut pixel, h);
                    value(&WATER, &refinement, &pixel)
                })
            };
            for c in 0..3 {
                assert_close(&format!("{i}: {c}"), v.rgb[c], along(&|p, h| p.rgb[c] += h), 1e-5);
            }
            assert_close(&format!("{i}: alpha"), v.alpha, along(&|p, h| p.alpha += h), 1e-5);
            assert_close(&format!("{i}: range"), v.range, along(&|p, h| p.range += h), 1e-5);
            for (k, found) in v_water.iter().enumerate() {
                let numeric = derivative(|h| {
                    let mut values = WATER.to_array();
                    values[k] += h;
                    value(&Water::from_array(values), &refinement, &pixel)
                });
                assert_close(&format!("{i}: water {k}"), *found, numeric, 1e-5);
            }
            for (k, found) in v_refinement.iter().enumerate() {
                let numeric = derivative(|h| {
                    let mut values = refinement.to_array();
                    values[k] += h;
                    value(&WATER, &refinement.with_array(values), &pixel)
                });
                assert_close(&format!("{i}: refinement {k}"), *found, numeric, 1e-5);
            }
        }
    }

    #[test]
    fn the_identity_equals_constant_water_and_keeps_open_water() {
        let identity = RangeModulation::identity(2.0, 3.2);
        let pixel = Blended { rgb: [0.3, 0.2, 0.1], alpha: 0.7, range: 4.0 };
        let plain = form(&WATER, Medium::PerPixel, Blend::Linear, &pixel);
        assert_eq!(form_refined(&WATER, &identity, Blend::Linear, &pixel), plain);
        let steep = identity.with_array([5.0, 1.0, -3.0, 2.0]);
        let nothing = Blended { rgb: [0.0; 3], alpha: 0.0, range: 0.0 };
        assert_eq!(form_refined(&WATER, &steep, Blend::Linear, &nothing), WATER.b_inf);
    }

    #[test]
    fn adam_finds_factors_that_depend_on_range() {
        let goal = RangeModulation::identity(2.0, 3.2).with_array([0.6, -0.3, -0.4, 0.2]);
        let mut state = RefinementState::new(RangeModulation::identity(2.0, 3.2));
        let pixel = |i: u32| {
            let rgb = [0.2 + 0.7 * number(i, 0), 0.2 + 0.7 * number(i, 1), 0.2 + 0.7 * number(i, 2)];
            Blended { rgb, alpha: 1.0, range: 0.5 + 9.0 * number(i, 3) }
        };
        let sum = |state: &RefinementState| {
            let (mut total, mut v) = (0.0, [0.0; 4]);
            for pixel in (0..60).map(pixel) {
                let (now, then) = (
                    form_refined(&WATER, &state.refinement, Blend::Linear, &pixel),
                    form_refined(&WATER, &goal, Blend::Linear, &pixel),
                );
                let difference: [f64; 3] = std::array::from_fn(|c| now[c] - then[c]);
                total += difference.iter().map(|d| d * d).sum::<f64>();
                form_refined_backward(
                    &WATER,
                    &state.refinement,
                    Blend::Linear,
                    &pixel,
                    difference,
                    &mut [0.0; 9],
                    &mut v,
                );
            }
            (total, v)
        };
        let (before, _) = sum(&state);
        for _ in 0..1500 {
            let (_, v) = sum(&state);
            state.step(&v, 0.01);
        }
        let (after, _) = sum(&state);
        assert!(after < 1e-4 * before, "{before:e} before, {after:e} after");
        for (found, goal) in state.refinement.to_array().iter().zip(goal.to_array()) {
            assert!((found - goal).abs() < 0.02, "{found} and {goal}");
        }
    }
}
