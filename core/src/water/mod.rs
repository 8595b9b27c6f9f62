//! Water between camera and scene: the nine parameters of [`Water`] and their effect on light.
//!
//! Image formation per channel in linear light (Akkaynak & Treibitz, CVPR 2018; SMP-UWGS eq. 7):
//! `I = J exp(-beta_d r) + b_inf (1 - exp(-beta_b r))`, with r the distance along the ray in scene units.
//!
//! [`ByDirection`] lets `b_inf` change with direction. [`RangeModulation`] lets coefficients depend on range
//! (eq. 9). [`observe`] samples photographs at sparse points, and [`sparse_prior`] estimates the water
//! parameters from these samples. [`consensus()`] combines the waters of several partitions.

mod consensus;
mod dense;
mod direction;
mod observe;
mod open_water;
mod prior;
mod record;
mod refinement;
mod solve;
mod sparse;
mod veil;

use glam::DVec3;
use serde::{Deserialize, Serialize};

pub use consensus::{Consensus, PartitionEvidence, PartitionWater, Shares, consensus};
pub use direction::ByDirection;
pub use observe::{MAX_OBSERVATIONS, MAX_POINTS, MAX_VIEWS, Observed, observe};
pub use open_water::{OpenWater, ray_maps};
pub use prior::{Prior, water_prior};
pub use record::{Known, StandardErrors, WaterRecord};
pub use refinement::RangeModulation;
pub use sparse::{Observation, SparsePrior, SparsePriorError, attenuation_under, sparse_prior};

/// Pixels with less alpha are open water where the water acts on pixels.
pub const LEAST_ALPHA: f64 = 1e-3;

/// The parameters of a homogeneous water, each for red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Water {
    /// Attenuation of the direct signal, 1/scene unit.
    pub beta_d: [f64; 3],
    /// Growth of the backscatter, 1/scene unit.
    pub beta_b: [f64; 3],
    /// Colour of the water at infinity, linear light.
    pub b_inf: [f64; 3],
}

/// `value` rounded to four significant digits, for log lines. Photographs do not support more.
pub fn four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

impl Water {
    /// The same water with [`four_digits`] of each parameter.
    #[must_use]
    pub fn in_short(&self) -> Self {
        Self::from_array(self.to_array().map(four_digits))
    }

    /// Coastal water for a scene unit of one metre. Slightly clearer than in a typical survey.
    pub const COASTAL: Self =
        Self { beta_d: [0.16, 0.06, 0.045], beta_b: [0.14, 0.08, 0.065], b_inf: [0.02, 0.085, 0.13] };
    /// No water: the camera sees J.
    pub const CLEAR: Self = Self { beta_d: [0.0; 3], beta_b: [0.0; 3], b_inf: [0.0; 3] };

    /// The observed colour I of the clear colour J at `range`, linear light.
    pub fn apply(&self, clear: DVec3, range: f64) -> DVec3 {
        let through = |beta: [f64; 3]| DVec3::from(beta.map(|b| (-b * range).exp()));
        clear * through(self.beta_d) + DVec3::from(self.b_inf) * (DVec3::ONE - through(self.beta_b))
    }

    /// The clear colour J of the observed colour I at `range`, linear light: the inverse of [`Water::apply`].
    /// Noise grows with `exp(beta_d range)`.
    pub fn remove(&self, seen: DVec3, range: f64) -> DVec3 {
        let through = |beta: [f64; 3]| DVec3::from(beta.map(|b| (-b * range).exp()));
        (seen - DVec3::from(self.b_inf) * (DVec3::ONE - through(self.beta_b))) / through(self.beta_d)
    }

    /// Range at which the clearest channel keeps half of its light, scene units; infinite without
    /// attenuation.
    pub fn half_distance(&self) -> f64 {
        std::f64::consts::LN_2 / self.beta_d.into_iter().fold(f64::INFINITY, f64::min)
    }

    /// The unconstrained parameters of SMP-UWGS eq. 8, in its order (`beta_d`, `beta_b`, `b_inf`). Softplus
    /// of the first six divided by `unit`, and sigmoid of the last three, give the parameters. `unit` is a
    /// length in scene units (the scene scale); it makes the result independent of the scale of the scene.
    pub fn to_raw(&self, unit: f64) -> [f64; 9] {
        let inverse_softplus = |y: f64| {
            let y = y.clamp(1e-6, 1e3);
            y + (-(-y).exp_m1()).ln()
        };
        let logit = |y: f64| {
            let y = y.clamp(1e-6, 1.0 - 1e-6);
            (y / (1.0 - y)).ln()
        };
        let mut raw = [0.0; 9];
        for c in 0..3 {
            raw[c] = inverse_softplus(self.beta_d[c] * unit);
            raw[c + 3] = inverse_softplus(self.beta_b[c] * unit);
            raw[c + 6] = logit(self.b_inf[c]);
        }
        raw
    }

    /// The water of these unconstrained parameters: the inverse of [`Water::to_raw`].
    pub fn from_raw(raw: [f64; 9], unit: f64) -> Self {
        let softplus = |x: f64| if x > 30.0 { x } else { x.exp().ln_1p() };
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        Self {
            beta_d: std::array::from_fn(|c| softplus(raw[c]) / unit),
            beta_b: std::array::from_fn(|c| softplus(raw[c + 3]) / unit),
            b_inf: std::array::from_fn(|c| sigmoid(raw[c + 6])),
        }
    }

    /// Derivatives of the parameters with respect to their unconstrained values, in the order of eq. 8;
    /// `unit` as in [`Water::to_raw`].
    pub fn slopes(&self, unit: f64) -> [f64; 9] {
        let values = self.to_array();
        // With raw parameter x: sigmoid(x) = 1 - exp(-softplus(x)).
        std::array::from_fn(|i| match values[i] {
            beta if i < 6 => -(-beta * unit).exp_m1() / unit,
            b_inf => b_inf * (1.0 - b_inf),
        })
    }

    /// All nine parameters in the order of eq. 8.
    pub fn to_array(&self) -> [f64; 9] {
        std::array::from_fn(|i| [self.beta_d, self.beta_b, self.b_inf][i / 3][i % 3])
    }

    /// The water of nine parameters in the order of eq. 8.
    pub fn from_array(values: [f64; 9]) -> Self {
        let [a, b, c, d, e, f, g, h, i] = values;
        Self { beta_d: [a, b, c], beta_b: [d, e, f], b_inf: [g, h, i] }
    }

    /// Whether all parameters are physically possible: finite, none negative, and colours at most 1.
    pub fn is_physical(&self) -> bool {
        self.to_array().iter().all(|value| value.is_finite() && *value >= 0.0)
            && self.b_inf.iter().all(|value| *value <= 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logged_numbers_have_four_digits() {
        let values = [0.16988753358843664, 0.00123456, 1234.56, 0.0, f64::INFINITY];
        assert_eq!(values.map(four_digits), [0.1699, 0.001235, 1235.0, 0.0, f64::INFINITY]);
    }

    #[test]
    fn clearest_channel_keeps_half_at_the_half_distance() {
        let direct = Water { b_inf: [0.0; 3], ..Water::COASTAL };
        assert!((direct.apply(DVec3::ONE, direct.half_distance()).z - 0.5).abs() < 1e-12);
        assert_eq!(Water::CLEAR.half_distance(), f64::INFINITY);
    }

    #[test]
    fn remove_inverts_apply() {
        let clear = DVec3::new(0.4, 0.02, 0.9);
        for range in [0.0, 0.3, 7.0] {
            let seen = Water::COASTAL.apply(clear, range);
            assert!((Water::COASTAL.remove(seen, range) - clear).length() < 1e-12, "at {range}");
        }
        let far = Water::COASTAL.apply(clear, 1e6);
        assert!((far - DVec3::from(Water::COASTAL.b_inf)).length() < 1e-12, "open water");
    }

    #[test]
    fn raw_parameters_round_trip_in_any_unit() {
        for unit in [1e-3, 1.0, 250.0] {
            let scaled = |beta: [f64; 3]| beta.map(|b| b / unit);
            let Water { beta_d, beta_b, b_inf } = Water::COASTAL;
            let water = Water { beta_d: scaled(beta_d), beta_b: scaled(beta_b), b_inf };
            let raw = water.to_raw(unit);
            let back = Water::from_raw(raw, unit);
            for (a, b) in back.to_array().iter().zip(water.to_array()) {
                assert!((a / b - 1.0).abs() < 1e-9, "{a} {b} at {unit}");
            }
            let same = Water::COASTAL.to_raw(1.0);
            assert!(raw.iter().zip(same).all(|(a, b)| (a - b).abs() < 1e-9), "independent of the unit");
        }
        assert!(Water::from_raw(Water::CLEAR.to_raw(1.0), 1.0).beta_d.iter().all(|b| *b < 2e-6));
    }

    #[test]
    fn slopes_match_central_differences() {
        for unit in [0.2, 1.0, 40.0] {
            let raw = Water::COASTAL.to_raw(unit);
            for (i, slope) in Water::COASTAL.slopes(unit).into_iter().enumerate() {
                let at = |step: f64| {
                    let mut raw = raw;
                    raw[i] += step;
                    Water::from_raw(raw, unit).to_array()[i]
                };
                let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                assert!(
                    (slope / numeric - 1.0).abs() < 1e-6,
                    "{i} in units of {unit}: {slope} and {numeric}"
                );
            }
        }
    }

    #[test]
    fn impossible_parameters_are_not_physical() {
        assert!(Water::COASTAL.is_physical() && Water::CLEAR.is_physical());
        for (at, value) in [(0, f64::NAN), (4, -0.1), (3, f64::INFINITY), (8, 1.5)] {
            let mut values = Water::COASTAL.to_array();
            values[at] = value;
            assert!(!Water::from_array(values).is_physical(), "{value} at {at}");
        }
    }
}
