//! The water from sparse points that are seen from several distances.
//!
//! Per channel (Akkaynak & Treibitz, CVPR 2018), for point i in view j at range r along the ray, linear
//! light: `I_ij = J_i exp(-beta_d r_ij) + b_inf (1 - exp(-beta_b r_ij))`. The same J at several r fixes the
//! three numbers of a channel; each J enters linearly, at least 0, and is eliminated (variable projection;
//! Golub & Pereyra 1973, with Kaufman's Jacobian). What is left is least squares in three numbers:
//! Levenberg-Marquardt in the unconstrained numbers of [`Water::to_raw`], from nine starts.
//!
//! - **Noise** is estimated with the water: variance = c0 s² + c1 m + c2 (J exp(-beta_d r))², with m the
//!   modelled colour and s what one 8-bit code is worth there. The terms are quantisation and compression,
//!   photons, and texture: what is beside the point is seen too, and fades with the direct signal. Weights
//!   hang on the model, never on the observed colour, whose noise they would share.
//! - **Outliers** (occlusion, edges, fish) get Tukey's biweight, and a point whose residuals are all large
//!   counts less as a whole (as under Student's t with four degrees of freedom).
//! - **Rounding** is shared by all observations of one shade, which together weigh as much as one.
//! - **Errors** are those of a sandwich with points as clusters, since what is wrong with a point is wrong in
//!   all its views, and with shades as others. Of many observations they are far below what the model leaves
//!   out, so to their square come those of three measured changes: how far the numbers move under Huber's
//!   loss, which gives outliers more say (they are one-sided at edges before a darker ground), by how much
//!   darker and brighter points disagree, and how far the numbers move when less of the scene around each
//!   point is looked at.
//!
//! Channels are independent. Sums run over fixed chunks in order: the same numbers on any number of threads.

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

/// Fewer points with several ranges than this tell nothing.
const MIN_POINTS: usize = 12;
/// A point counts as seen from several distances where the largest range is this many times the smallest.
const MIN_RATIO: f64 = 1.03;

/// One point in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Which point, from 0.
    pub point: u32,
    /// Distance from the camera's centre, scene units.
    pub range: f64,
    /// What the photograph shows, linear light, 0..1; NaN in a channel that says nothing, as a saturated one.
    pub colour: [f64; 3],
    /// The same of a smaller part of the scene around the point: by how much the water is another one then
    /// tells what blur and texture do to it.
    pub finer: [f64; 3],
    /// Unit direction from the camera's centre, scene axes.
    pub direction: [f64; 3],
    /// Factors on the colour of open water along it: 1 where that is the same in all directions.
    pub tint: [f64; 3],
}

/// A water with its errors, and what it was made from.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePrior {
    /// The nine numbers. Where errors are infinite, `b_inf` is at most the median colour of the farthest
    /// observations, and a `beta_b` that would be above the inverse of the median range is `beta_d`.
    pub water: Water,
    /// Standard error of each in the order of SMP-UWGS eq. 8 ([`Water::to_array`]); infinite where the
    /// observations do not tell the number. Never NaN.
    pub standard_error: [f64; 9],
    /// J of each point by the smaller windows, linear light, at least 0; `None` for a point without an
    /// observation that counts in some channel.
    pub clear: Vec<Option<[f64; 3]>>,
    /// Points that were seen from several distances.
    pub points: usize,
    /// Observations of the channel that has the most.
    pub observations: usize,
    /// Share of the observations within Tukey's limit, of the channel with the fewest.
    pub inliers: f64,
    /// Ranges of the observations, scene units: 5th percentile, median, 95th percentile.
    pub ranges: [f64; 3],
    /// Median over points of the largest range by the smallest.
    pub range_ratio: f64,
}

/// Why there is no [`SparsePrior`].
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SparsePriorError {
    /// Next to nothing was observed.
    #[error(
        "the water cannot be estimated from sparse points: {points} points are seen by two views or more, and \
         {MIN_POINTS} are needed; reconstruct with more features or give the water with water.prior"
    )]
    TooFewPoints {
        /// Points with two observations or more.
        points: usize,
    },
    /// Every point is seen from one distance, so whatever the water does may as well be its colour.
    #[error(
        "the water cannot be estimated from sparse points: of {points} points {spread} are seen from distances \
         that differ by 3 % or more, and {MIN_POINTS} are needed; add photographs from nearer or farther, or give \
         the water with water.prior"
    )]
    NoRangeSpread {
        /// Points with two observations or more.
        points: usize,
        /// Those seen from several distances.
        spread: usize,
    },
    /// An observation names a point that is not there.
    #[error("an observation names point {point}, but there are {points}")]
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

/// The water of these observations of `points` points, in any order.
///
/// Observations with a range that is not above 0 and finite do not count, nor channels that are not finite.
///
/// # Errors
/// [`SparsePriorError`] where there are too few points or none from several distances.
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

    // Which observations are rounded alike is told by the colours of a first estimate: those observed have
    // the noise that the weights must not share.
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

/// Attenuation alone, under a veil that is known: `beta_b` and `b_inf` of `water` with the tints of the
/// observations.
///
/// Gives `beta_d`, 1/scene unit, and standard errors, infinite in a channel of which nothing tells. Points
/// that grow brighter with their range once the veil is taken away have no attenuation: then it is 0, and the
/// error is at least as large as what they would amplify, since by that much the model does not hold for
/// them.
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

/// The observations that count in an order that leaves no trace of that of the input, and their median range.
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
    // Of one point by range, so that the order of the input leaves no trace in the sums.
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
