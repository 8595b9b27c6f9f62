//! Coefficients that depend on the range of a pixel (DBDR, SMP-UWGS eq. 9).

use serde::{Deserialize, Serialize};

use super::Water;

/// The shared predictor of eq. 9: two factors on the coefficients of all channels, by the range of a pixel.
///
/// `m = ReLU(scale * sigmoid(w * r / unit + b))`, with r the expected distance along the ray in scene units.
/// `beta_d` is multiplied by the m of `attenuation`, `beta_b` by that of `backscatter`. This is a 1 x 1
/// convolution over the range image, as in the released code and SeaSplat. `scale` is above 0, so the ReLU
/// has no effect.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RangeModulation {
    /// Largest factor.
    pub scale: f64,
    /// Unit of range, in scene units of the input: the scene scale.
    pub unit: f64,
    /// Weight and bias of the factor on `beta_d`.
    pub attenuation: [f64; 2],
    /// Weight and bias of the factor on `beta_b`.
    pub backscatter: [f64; 2],
}

impl RangeModulation {
    /// The identity modulation; `scale` is above 1.
    pub fn identity(scale: f64, unit: f64) -> Self {
        // `+ 0.0` turns -0 into 0 for a scale of 2.
        let bias = -(scale - 1.0).ln() + 0.0;
        Self { scale, unit, attenuation: [0.0, bias], backscatter: [0.0, bias] }
    }

    /// Factors on `beta_d` and `beta_b` at `range`, scene units.
    pub fn factors(&self, range: f64) -> [f64; 2] {
        let z = range / self.unit;
        [self.attenuation, self.backscatter].map(|[weight, bias]| {
            // Clamped as in the shader, so that infinities never meet.
            let x = (weight * z + bias).clamp(-30.0, 30.0);
            (self.scale / (1.0 + (-x).exp())).max(0.0)
        })
    }

    /// The water at `range`, scene units.
    pub fn at(&self, water: &Water, range: f64) -> Water {
        let [on_d, on_b] = self.factors(range);
        Water {
            beta_d: water.beta_d.map(|beta| beta * on_d),
            beta_b: water.beta_b.map(|beta| beta * on_b),
            b_inf: water.b_inf,
        }
    }

    /// Weights and biases in device order: `attenuation`, then `backscatter`.
    pub fn to_array(&self) -> [f64; 4] {
        let ([a, b], [c, d]) = (self.attenuation, self.backscatter);
        [a, b, c, d]
    }

    /// Replaces weights and biases, in the order of [`RangeModulation::to_array`].
    #[must_use]
    pub fn with_array(self, [a, b, c, d]: [f64; 4]) -> Self {
        Self { attenuation: [a, b], backscatter: [c, d], ..self }
    }

    /// Whether all values are finite, and scale and unit are above 0.
    pub fn is_sound(&self) -> bool {
        let all = self.to_array().into_iter().chain([self.scale, self.unit]);
        all.into_iter().all(f64::is_finite) && self.scale > 0.0 && self.unit > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modulation_starts_as_identity_and_stays_within_its_scale() {
        for scale in [1.5, 2.0, 5.0] {
            let start = RangeModulation::identity(scale, 3.2);
            for range in [0.0, 0.7, 40.0] {
                for factor in start.factors(range) {
                    assert!((factor - 1.0).abs() < 1e-15, "{factor} at {range}");
                }
            }
        }
        assert_eq!(RangeModulation::identity(2.0, 3.2).to_array(), [0.0; 4]);
        assert_eq!(RangeModulation::identity(2.0, 3.2).at(&Water::COASTAL, 5.0), Water::COASTAL);
        let steep = RangeModulation::identity(2.0, 1e-3).with_array([1e30, 0.0, -1e30, 0.0]);
        for range in [0.0, 1.0, 1e30] {
            for factor in steep.factors(range) {
                assert!((0.0..=2.0).contains(&factor), "{factor} at {range}");
            }
        }
        let water = steep.at(&Water::COASTAL, 1.0);
        assert!((water.beta_d[0] / Water::COASTAL.beta_d[0] - 2.0).abs() < 1e-9 && water.beta_b[0] < 1e-12);
    }

    #[test]
    fn broken_range_modulations_are_not_sound() {
        let sound = RangeModulation::identity(2.0, 1.0);
        assert!(sound.is_sound());
        let faults = [
            RangeModulation { scale: 0.0, ..sound },
            RangeModulation { unit: f64::INFINITY, ..sound },
            RangeModulation { backscatter: [0.0, f64::NAN], ..sound },
        ];
        assert!(faults.iter().all(|refinement| !refinement.is_sound()));
    }
}
