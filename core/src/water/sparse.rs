//! Estimates the water from sparse points that are seen from several distances.
//!
//! Per channel (Akkaynak & Treibitz, CVPR 2018), for point i in view j at range r along the ray, linear
//! light: `I_ij = J_i exp(-beta_d r_ij) + b_inf (1 - exp(-beta_b r_ij))`. Observing the same J at several r
//! determines the three parameters of a channel. Each J enters linearly, is at least 0, and is eliminated
//! (variable projection; Golub & Pereyra 1973, with Kaufman's Jacobian). The remaining least-squares problem
//! has three unknowns. Levenberg-Marquardt solves it in the unconstrained parameters of [`Water::to_raw`],
//! from nine starts.
//!
//! - **Noise** is estimated together with the water: variance = c0 s² + c1 m + c2 (J exp(-beta_d r))², with m
//!   the modelled colour and s the size of one 8-bit code there. The terms are quantisation and compression,
//!   photons, and texture: the surroundings of the point are seen too, and fade with the direct signal.
//!   Weights depend on the model, never on the observed colour, since they would share its noise.
//! - **Outliers** (occlusion, edges, fish) get Tukey's biweight. A point whose residuals are all large gets
//!   less weight as a whole (as under Student's t with four degrees of freedom).
//! - **Rounding** errors are shared by all observations of one shade, which together weigh as much as one.
//! - **Errors** come from a sandwich estimator. Points are clusters, since an error of a point affects all
//!   its views; so are shades. With many observations, these errors are far below those of the model itself,
//!   so the squares of three measured changes are added. The first is the change under Huber's loss, which
//!   gives outliers more influence (at edges before a darker ground, they are one-sided). The second is the
//!   difference between darker and brighter points. The third is the change with smaller windows around each
//!   point.
//!
//! Channels are independent. Sums run over fixed chunks in order, so results do not depend on the number of
//! threads.

mod estimate;
mod least_squares;
mod robust;
mod shades;

use rayon::prelude::*;

use super::Water;
use crate::CoreError;
use estimate::Estimate;
use least_squares::Channel;
use robust::quantile;
use shades::shades_of;

/// Minimum number of points with several ranges.
const MIN_POINTS: usize = 12;
/// A point counts as seen from several distances if its largest range is at least this many times the
/// smallest.
const MIN_RATIO: f64 = 1.03;

/// One point in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the point, from 0.
    pub point: u32,
    /// Distance from the camera's centre, scene units.
    pub range: f64,
    /// Colour in the photograph, linear light, 0..1; NaN in an unusable channel, such as a saturated one.
    pub colour: [f64; 3],
    /// The same for a smaller window around the point. The difference that it makes to the water shows the
    /// effect of blur and texture.
    pub finer: [f64; 3],
    /// Unit direction from the camera's centre, scene axes.
    pub direction: [f64; 3],
    /// Factors on the open-water colour along the ray: 1 if that colour does not depend on direction.
    pub tint: [f64; 3],
}

/// A water with its errors and statistics of the data behind it.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePrior {
    /// The water parameters. If the errors are infinite, `b_inf` is at most the median colour of the farthest
    /// observations. A `beta_b` that would exceed the inverse of the median range is then replaced by
    /// `beta_d`.
    pub water: Water,
    /// Standard error of each parameter in the order of SMP-UWGS eq. 8 ([`Water::to_array`]); infinite if the
    /// observations do not determine it. Never NaN.
    pub standard_error: [f64; 9],
    /// J of each point from the smaller windows, linear light, at least 0; `None` for a point that lacks
    /// usable observations in any channel.
    pub clear: Vec<Option<[f64; 3]>>,
    /// Number of points seen from several distances.
    pub points: usize,
    /// Number of observations of the channel that has the most.
    pub observations: usize,
    /// Share of the observations within Tukey's limit, for the channel where it is lowest.
    pub inliers: f64,
    /// Ranges of the observations, scene units: 5th percentile, median, 95th percentile.
    pub ranges: [f64; 3],
    /// Median over points of the ratio of the largest to the smallest range.
    pub range_ratio: f64,
}

/// Why no [`SparsePrior`] was found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SparsePriorError {
    /// Too few points were observed.
    #[error(
        "the water cannot be estimated from sparse points: {points} points are seen in at least two views, but \
         {MIN_POINTS} are needed; reconstruct with more features or give the water with water.prior"
    )]
    TooFewPoints {
        /// Points with two observations or more.
        points: usize,
    },
    /// Every point is seen from one distance only, so the water cannot be separated from its colour.
    #[error(
        "the water cannot be estimated from sparse points: {spread} of {points} points are seen from distances \
         that differ by at least 3 %, but {MIN_POINTS} are needed; add photographs from nearer or farther, or give \
         the water with water.prior"
    )]
    NoRangeSpread {
        /// Points with two observations or more.
        points: usize,
        /// Number of points seen from several distances.
        spread: usize,
    },
    /// An observation refers to a point that does not exist.
    #[error("an observation refers to point {point}, but there are only {points}")]
    UnknownPoint {
        /// The index.
        point: u32,
        /// The number of points.
        points: usize,
    },
}

impl From<SparsePriorError> for CoreError {
    fn from(error: SparsePriorError) -> Self {
        Self::Scene(error.to_string())
    }
}

/// Estimates the water from these observations of `points` points, in any order.
///
/// Ignores observations whose range is not positive and finite, and colour channels that are not finite.
///
/// # Errors
/// [`SparsePriorError`] when there are too few points, or too few seen from several distances.
pub fn sparse_prior(observations: &[Observation], points: usize) -> Result<SparsePrior, SparsePriorError> {
    let (order, unit) = ordered(observations, points)?;
    let key = |index: u32| &observations[index as usize];
    let mut ratios: Vec<f64> = order
        .chunk_by(|&a, &b| key(a).point == key(b).point)
        .filter(|seen| seen.len() >= 2)
        .map(|seen| key(seen[seen.len() - 1]).range / key(seen[0]).range)
        .collect();
    let spread = ratios.iter().filter(|ratio| **ratio >= MIN_RATIO).count();
    if ratios.len() < MIN_POINTS {
        return Err(SparsePriorError::TooFewPoints { points: ratios.len() });
    }
    if spread < MIN_POINTS {
        return Err(SparsePriorError::NoRangeSpread { points: ratios.len(), spread });
    }
    let mut ranges: Vec<f64> = order.iter().map(|&index| key(index).range).collect();
    let ranges = [0.05, 0.5, 0.95].map(|share| quantile(&mut ranges, share));

    // Shades are assigned from the colours of a first estimate: the observed colours contain the noise, which
    // must not affect the weights.
    let rough: Vec<_> = (0..3)
        .into_par_iter()
        .map(|c| {
            let channel = Channel::of(observations, &order, c, unit);
            let rough = channel.rough();
            (channel, rough)
        })
        .collect();
    let mut colours = vec![[f64::NAN; 3]; observations.len()];
    for (c, (channel, rough)) in rough.iter().enumerate() {
        for (index, seen) in channel.observed.iter().zip(rough.iter().flat_map(|(_, seen)| seen)) {
            colours[*index as usize][c] = *seen;
        }
    }
    let mut shades = vec![0; observations.len()];
    for (index, shade) in order.iter().zip(shades_of(order.iter().map(|index| colours[*index as usize]))) {
        shades[*index as usize] = shade;
    }
    let channels: Vec<(Channel, Estimate)> = rough
        .into_par_iter()
        .map(|(channel, rough)| {
            let channel = channel.with_shades(&shades);
            let estimate = channel.estimate(rough.map(|(numbers, _)| numbers));
            (channel, estimate)
        })
        .collect();
    let (mut numbers, mut standard_error) = ([0.0; 9], [f64::INFINITY; 9]);
    for (c, (_, estimate)) in channels.iter().enumerate() {
        let in_scene_units = [1.0 / unit, 1.0 / unit, 1.0];
        for k in 0..3 {
            numbers[3 * k + c] = estimate.numbers[k] * in_scene_units[k];
            standard_error[3 * k + c] = estimate.standard_error[k] * in_scene_units[k];
        }
    }
    let mut clear = vec![Some([0.0; 3]); points];
    for (c, (channel, estimate)) in channels.iter().enumerate() {
        let found = channel.clear(estimate, points);
        for (clear, found) in clear.iter_mut().zip(found) {
            match (clear.as_mut(), found) {
                (Some(clear), Some(found)) => clear[c] = found,
                _ => *clear = None,
            }
        }
    }
    Ok(SparsePrior {
        water: Water::from_array(numbers),
        standard_error,
        clear,
        points: spread,
        observations: channels.iter().map(|(channel, _)| channel.values.len()).max().unwrap_or_default(),
        inliers: channels.iter().map(|(_, estimate)| estimate.inliers).fold(1.0, f64::min),
        ranges,
        range_ratio: quantile(&mut ratios, 0.5),
    })
}

/// Estimates the attenuation alone, with a known veil: `beta_b` and `b_inf` of `water` with the tints of the
/// observations.
///
/// Returns `beta_d`, 1/scene unit, and standard errors, infinite in a channel without information. If points
/// get brighter with range after the veil is removed, the attenuation is 0. The error is then at least as
/// large as the amplification found, since the model is off by that much for these points.
///
/// # Errors
/// As [`sparse_prior`].
pub fn attenuation_under(
    observations: &[Observation],
    points: usize,
    water: &Water,
) -> Result<([f64; 3], [f64; 3]), SparsePriorError> {
    let (order, unit) = ordered(observations, points)?;
    let found: Vec<[f64; 2]> = (0..3)
        .into_par_iter()
        .map(|c| {
            let veil = |seen: &Observation| {
                seen.tint[c] * water.b_inf[c] * (1.0 - (-water.beta_b[c] * seen.range).exp())
            };
            Channel::of(observations, &order, c, unit)
                .without(|index| veil(&observations[index]))
                .attenuation()
        })
        .collect();
    let of = |k: usize| std::array::from_fn(|c| found[c][k] / unit);
    Ok((of(0), of(1)))
}

/// The usable observations, in an order independent of the input order, and their median range.
fn ordered(observations: &[Observation], points: usize) -> Result<(Vec<u32>, f64), SparsePriorError> {
    if let Some(stray) = observations.iter().find(|seen| seen.point as usize >= points) {
        return Err(SparsePriorError::UnknownPoint { point: stray.point, points });
    }
    let mut order: Vec<u32> = (0..observations.len() as u32)
        .filter(|&index| {
            let range = observations[index as usize].range;
            range > 0.0 && range.is_finite()
        })
        .collect();
    // By range within a point, so that sums do not depend on the input order.
    let key = |index: u32| &observations[index as usize];
    order.sort_by(|&a, &b| {
        let (a, b) = (key(a), key(b));
        let colours = || a.colour.iter().zip(&b.colour).map(|(a, b)| a.total_cmp(b)).find(|o| o.is_ne());
        let ranges = || a.range.total_cmp(&b.range);
        a.point.cmp(&b.point).then_with(ranges).then_with(|| colours().unwrap_or(std::cmp::Ordering::Equal))
    });
    let mut ranges: Vec<f64> = order.iter().map(|&index| key(index).range).collect();
    if ranges.is_empty() {
        return Err(SparsePriorError::TooFewPoints { points: 0 });
    }
    let unit = quantile(&mut ranges, 0.5);
    Ok((order, unit))
}

#[cfg(test)]
#[path = "sparse_tests.rs"]
mod tests;
