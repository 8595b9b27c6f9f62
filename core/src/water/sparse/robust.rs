//! Weights of observations: their noise, and the reduced weights of outliers and odd points.

use super::least_squares::Channel;
use super::shades::ROUNDING;
use crate::picture::{linear_to_srgb, srgb_slope};

/// Tukey's constant for 95 % efficiency under Gaussian noise, standard deviations.
const TUKEY: f64 = 4.685;
/// Huber's constant for 95 % efficiency.
const HUBER: f64 = 1.345;
/// Median absolute deviation of a Gaussian to its standard deviation.
const MAD_TO_SIGMA: f64 = 1.4826;
/// Degrees of freedom for the weight of a whole point.
const POINT_FREEDOM: f64 = 4.0;

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Loss {
    Tukey,
    Huber,
}

/// One observation against the model.
pub(super) struct Residual {
    /// Observed minus modelled colour, scaled as if J were not fitted to it, linear light.
    pub(super) error: f64,
    /// Modelled direct signal.
    pub(super) direct: f64,
    /// Modelled colour.
    pub(super) seen: f64,
}

/// Result of [`Channel::reweight`].
pub(super) struct Weights {
    pub(super) weights: Vec<f64>,
    /// Sum of the weights divided by the sum of the slopes of psi: the bread of the sandwich has weights in
    /// place of slopes.
    pub(super) overstated: f64,
    /// Share of the observations within Tukey's limit.
    pub(super) inliers: f64,
}

/// Coefficients of the variance of one observation, in the order of [`Noise::parts`].
struct Noise([f64; 3]);

impl Noise {
    /// Variance terms of 8-bit quantisation, of photons and of texture.
    fn parts(residual: &Residual) -> [f64; 3] {
        let seen = residual.seen.max(1e-4);
        [code_step(seen).powi(2), 1e-3 * seen, residual.direct * residual.direct + 1e-12]
    }

    /// Fits the noise to the squared residuals, clipped at six variances, beyond which Gaussian noise is
    /// negligible.
    fn of(residuals: &[Residual]) -> Self {
        const MOST: usize = 40_000;
        let some: Vec<(f64, [f64; 3])> = residuals
            .iter()
            .step_by(residuals.len().div_ceil(MOST).max(1))
            .map(|residual| (residual.error * residual.error, Self::parts(residual)))
            .collect();
        let mut squares: Vec<f64> = some.iter().map(|(square, _)| *square).collect();
        let typical = quantile(&mut squares, 0.5) * MAD_TO_SIGMA * MAD_TO_SIGMA;
        let mut noise = [0; 3].map(|_| 0.0);
        for k in 0..3 {
            let mean = some.iter().map(|(_, parts)| parts[k]).sum::<f64>() / some.len().max(1) as f64;
            noise[k] = (typical / mean.max(1e-30) / 3.0).max(1e-12);
        }
        // Multiplicative updates keep the coefficients above 0 (Lee & Seung 2001).
        for _ in 0..15 {
            let (mut above, mut below) = ([0.0; 3], [0.0; 3]);
            for (square, parts) in &some {
                let variance: f64 = (0..3).map(|k| noise[k] * parts[k]).sum();
                let square = square.min(6.0 * variance) / (variance * variance);
                for k in 0..3 {
                    above[k] += square * parts[k];
                    below[k] += parts[k] / variance;
                }
            }
            (0..3).for_each(|k| noise[k] = (noise[k] * above[k] / below[k].max(1e-30)).max(1e-12));
        }
        Self(noise)
    }

    fn variances(&self, residuals: &[Residual]) -> Vec<f64> {
        // A mean over a few pixels is accurate to about a thirtieth of a code at best.
        const FLOOR: f64 = 1e-3;
        let of = |residual: &Residual| {
            let parts = Self::parts(residual);
            (0..3).map(|k| self.0[k] * parts[k]).sum::<f64>() + FLOOR * parts[0]
        };
        residuals.iter().map(of).collect()
    }
}

impl Channel {
    /// Additional variance of an observation with the colour `seen` for its shared rounding error. With it,
    /// all observations of a shade together weigh as much as one of them without other noise.
    pub(super) fn rounding_variance(&self, index: usize, seen: f64) -> f64 {
        (self.crowds[index] - 1.0) * (ROUNDING * code_step(seen.max(1e-4))).powi(2)
    }

    /// Weights of the next round, and the factor by which they overstate the certainty of the parameters.
    pub(super) fn reweight(&self, residuals: &[Residual], loss: Loss) -> Weights {
        let variances = Noise::of(residuals).variances(residuals);
        let mut scaled: Vec<f64> = residuals
            .iter()
            .zip(&variances)
            .map(|(residual, variance)| residual.error / variance.sqrt())
            .collect();
        let mut sizes: Vec<f64> = scaled.iter().map(|z| z.abs()).collect();
        let scale = (MAD_TO_SIGMA * quantile(&mut sizes, 0.5)).max(1e-6);
        scaled.iter_mut().for_each(|z| *z /= scale);
        // psi(z) / z and psi'(z).
        let bend = |z: f64| match loss {
            Loss::Tukey if z.abs() < TUKEY => {
                let u = (z / TUKEY).powi(2);
                ((1.0 - u).powi(2), (1.0 - u) * (1.0 - 5.0 * u))
            }
            Loss::Tukey => (0.0, 0.0),
            Loss::Huber if z.abs() < HUBER => (1.0, 1.0),
            Loss::Huber => (HUBER / z.abs(), 0.0),
        };
        let mut weights = Vec::with_capacity(scaled.len());
        let (mut sum, mut slope, mut inside) = (0.0, 0.0, 0_usize);
        for own in self.starts.windows(2) {
            let own = own[0]..own[1];
            let (mut count, mut square) = (0.0, 0.0);
            for z in &scaled[own.clone()] {
                let (weight, _) = bend(*z);
                count += weight;
                square += weight * z * z;
            }
            let of_point = match loss {
                Loss::Tukey => (POINT_FREEDOM + (count - 1.0).max(0.0)) / (POINT_FREEDOM + square),
                Loss::Huber => 1.0,
            };
            for index in own {
                let (weight, derivative) = bend(scaled[index]);
                sum += weight * of_point;
                slope += derivative * of_point;
                inside += usize::from(scaled[index].abs() < TUKEY);
                let variance =
                    variances[index] * scale * scale + self.rounding_variance(index, residuals[index].seen);
                weights.push(weight * of_point / variance);
            }
        }
        Weights {
            weights,
            // At least a tenth: with hardly any inliers, the result is uncertain anyway.
            overstated: sum / slope.max(0.1 * sum).max(1e-30),
            inliers: inside as f64 / scaled.len().max(1) as f64,
        }
    }
}

/// Size of one 8-bit code at this linear light: the derivative of the inverse sRGB curve, divided by 255.
pub(super) fn code_step(linear: f64) -> f64 {
    let encoded = linear_to_srgb(linear.clamp(0.0, 1.0));
    srgb_slope(encoded) / 255.0
}

/// The value below which `share` of the values lie; 0 for an empty slice. Reorders the values.
pub(super) fn quantile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}
