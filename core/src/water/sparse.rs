//! The water from sparse points that are seen from several distances.
//!
//! Per channel (Akkaynak & Treibitz, CVPR 2018), for point i in view j at range r along the ray, linear light:
//! `I_ij = J_i exp(-beta_d r_ij) + b_inf (1 - exp(-beta_b r_ij))`. The same J at several r fixes the three numbers of a
//! channel; each J enters linearly, at least 0, and is eliminated (variable projection; Golub & Pereyra 1973, with
//! Kaufman's Jacobian). What is left is least squares in three numbers: Levenberg-Marquardt in the unconstrained
//! numbers of [`Water::to_raw`], from nine starts.
//!
//! - **Noise** is estimated with the water: variance = c0 s² + c1 m + c2 (J exp(-beta_d r))², with m the modelled
//!   colour and s what one 8-bit code is worth there. The terms are quantisation and compression, photons, and
//!   texture: what is beside the point is seen too, and fades with the direct signal. Weights hang on the model, never
//!   on the observed colour, whose noise they would share.
//! - **Outliers** (occlusion, edges, fish) get Tukey's biweight, and a point whose residuals are all large counts less
//!   as a whole (as under Student's t with four degrees of freedom).
//! - **Errors** are those of a sandwich with points as clusters, since what is wrong with a point is wrong in all its
//!   views. Of many observations they are far below what the model leaves out, so to their square come those of two
//!   measured changes: how far the numbers move under Huber's loss, which gives outliers more say (they are one-sided
//!   at edges before a darker ground), and by how much darker and brighter points disagree.
//!
//! Channels are independent. Sums run over fixed chunks in order: the same numbers on any number of threads.

use rayon::prelude::*;

use super::Water;
use super::solve::{covariance, solve};
use crate::CoreError;

/// Fewer points with several ranges than this tell nothing.
const MIN_POINTS: usize = 12;
/// A point counts as seen from several distances where the largest range is this many times the smallest.
const MIN_RATIO: f64 = 1.03;
/// Tukey's constant for 95 % efficiency under Gaussian noise, standard deviations.
const TUKEY: f64 = 4.685;
/// Huber's constant for 95 % efficiency.
const HUBER: f64 = 1.345;
/// Median absolute deviation of a Gaussian to its standard deviation.
const MAD_TO_SIGMA: f64 = 1.4826;
/// Degrees of freedom of the weight of a whole point.
const POINT_FREEDOM: f64 = 4.0;
/// Points of a chunk whose sums one thread makes.
const CHUNK: usize = 256;
/// Points from which starts are judged.
const START_POINTS: usize = 600;
/// Points on which the numbers settle before all are taken.
const SETTLE_POINTS: usize = 5000;
/// Rounds of new weights.
const ROUNDS: usize = 25;
/// Unconstrained numbers stay within this: softplus and sigmoid of it are 1e-6 from their ends.
const RAW_LIMIT: f64 = 14.0;
/// Standard errors from which a number counts as unknown: of beta times the median range, and of `b_inf`.
const UNKNOWN: [f64; 3] = [3.0, 3.0, 1.0];

/// One point in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Which point, from 0.
    pub point: u32,
    /// Distance from the camera's centre, scene units.
    pub range: f64,
    /// What the photograph shows, linear light, 0..1; NaN in a channel that says nothing, as a saturated one.
    pub colour: [f64; 3],
}

/// A water with its errors, and what it was made from.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePrior {
    /// The nine numbers. Where errors are infinite, `b_inf` is at most the median colour of the farthest observations,
    /// and a `beta_b` that would be above the inverse of the median range is `beta_d`.
    pub water: Water,
    /// Standard error of each in the order of SMP-UWGS eq. 8 ([`Water::to_array`]); infinite where the observations do
    /// not tell the number. Never NaN.
    pub standard_error: [f64; 9],
    /// J of each point, linear light, at least 0; `None` for a point without an observation that counts in some
    /// channel.
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
    let unit = ranges[1];

    let channels: Vec<(Channel, Estimate)> = (0..3)
        .into_par_iter()
        .map(|c| {
            let channel = Channel::of(observations, &order, c, unit);
            let estimate = channel.estimate();
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

/// Observations of one channel, point by point. Ranges are in units of the median range, so the numbers sought have no
/// unit: `[beta_d, beta_b, b_inf]` with betas times that range.
struct Channel {
    ranges: Vec<f64>,
    values: Vec<f64>,
    /// Where the observations of each point start, and the end of the last.
    starts: Vec<usize>,
    /// Which point it is.
    points: Vec<u32>,
}

/// Result for one channel, in the units of [`Channel`].
struct Estimate {
    numbers: [f64; 3],
    standard_error: [f64; 3],
    weights: Vec<f64>,
    inliers: f64,
}

/// Which of the three numbers are sought.
#[derive(Clone, Copy, PartialEq)]
enum Sought {
    All,
    /// beta_b is beta_d.
    WithoutGrowth,
    /// b_inf stays as it is.
    WithoutLimit,
}

#[derive(Clone, Copy, PartialEq)]
enum Loss {
    Tukey,
    Huber,
}

/// Sums of one pass: the cost and its normal equations.
#[derive(Clone, Copy, Default)]
struct Normal {
    cost: f64,
    hessian: [[f64; 3]; 3],
    gradient: [f64; 3],
    /// Sum over points of the outer product of each point's gradient.
    scatter: [[f64; 3]; 3],
}

impl Normal {
    fn add(mut self, other: &Self) -> Self {
        self.cost += other.cost;
        for j in 0..3 {
            self.gradient[j] += other.gradient[j];
            for k in 0..3 {
                self.hessian[j][k] += other.hessian[j][k];
                self.scatter[j][k] += other.scatter[j][k];
            }
        }
        self
    }
}

/// What the model says of one observation.
#[derive(Clone, Copy)]
struct Modelled {
    /// exp(-beta_d r).
    through: f64,
    /// Backscatter.
    veil: f64,
    /// exp(-beta_b r).
    unveiled: f64,
}

fn model([beta_d, beta_b, b_inf]: [f64; 3], range: f64) -> Modelled {
    let unveiled = (-beta_b * range).exp();
    Modelled { through: (-beta_d * range).exp(), veil: b_inf * (1.0 - unveiled), unveiled }
}

/// J of one point and the sum of squares that it was divided by.
fn best_clear(modelled: &[Modelled], values: &[f64], weights: &[f64]) -> (f64, f64) {
    let (mut above, mut below) = (0.0, 0.0);
    for ((m, value), weight) in modelled.iter().zip(values).zip(weights) {
        above += weight * m.through * (value - m.veil);
        below += weight * m.through * m.through;
    }
    // Where nothing comes through (or all weights are 0) J is anything: 0 is as good as any.
    (if below > 1e-200 { (above / below).max(0.0) } else { 0.0 }, below)
}

/// J of one point as the median of what its observations say, each counting as it does in a sum of absolute residuals.
fn median_clear(modelled: &[Modelled], values: &[f64], weights: &[f64]) -> f64 {
    let said = modelled.iter().zip(values).zip(weights).filter(|((m, _), _)| m.through > 1e-100);
    let mut said: Vec<(f64, f64)> =
        said.map(|((m, value), weight)| ((value - m.veil) / m.through, weight.sqrt() * m.through)).collect();
    said.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = said.iter().map(|(_, weight)| weight).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let median = said.iter().find(|(_, weight)| {
        below += weight;
        below >= half
    });
    median.map_or(0.0, |(clear, _)| clear.max(0.0))
}

impl Channel {
    /// Points with fewer than two observations are left out: any water explains them.
    fn of(observations: &[Observation], order: &[u32], c: usize, unit: f64) -> Self {
        let seen = |index: u32| &observations[index as usize];
        let mut channel =
            Self { ranges: Vec::new(), values: Vec::new(), starts: vec![0], points: Vec::new() };
        for of_point in order.chunk_by(|&a, &b| seen(a).point == seen(b).point) {
            let counting =
                of_point.iter().map(|&index| seen(index)).filter(|seen| seen.colour[c].is_finite());
            if counting.clone().count() < 2 {
                continue;
            }
            for observation in counting {
                channel.ranges.push(observation.range / unit);
                channel.values.push(observation.colour[c]);
            }
            channel.starts.push(channel.values.len());
            channel.points.push(seen(of_point[0]).point);
        }
        channel
    }

    /// Every n-th point.
    fn thinned(&self, most: usize) -> Self {
        self.selected((0..self.points.len()).step_by(self.points.len().div_ceil(most).max(1)))
    }

    fn selected(&self, indices: impl Iterator<Item = usize>) -> Self {
        let mut thin = Self { ranges: Vec::new(), values: Vec::new(), starts: vec![0], points: Vec::new() };
        for index in indices {
            let own = self.starts[index]..self.starts[index + 1];
            thin.ranges.extend_from_slice(&self.ranges[own.clone()]);
            thin.values.extend_from_slice(&self.values[own]);
            thin.starts.push(thin.values.len());
            thin.points.push(self.points[index]);
        }
        thin
    }

    /// Runs `work` on the observations of each point (their indices and what the model says of them) and gathers what
    /// it gives by chunks of points, in order.
    fn by_chunks<T: Send>(
        &self,
        numbers: [f64; 3],
        start: impl Fn() -> T + Sync,
        work: impl Fn(&mut T, std::ops::Range<usize>, &[Modelled]) + Sync,
    ) -> Vec<T> {
        (0..self.points.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let (mut result, mut modelled) = (start(), Vec::new());
                for point in chunk * CHUNK..((chunk + 1) * CHUNK).min(self.points.len()) {
                    let own = self.starts[point]..self.starts[point + 1];
                    modelled.clear();
                    modelled.extend(self.ranges[own.clone()].iter().map(|range| model(numbers, *range)));
                    work(&mut result, own, &modelled);
                }
                result
            })
            .collect()
    }

    /// Cost and normal equations under these weights.
    fn normal(&self, numbers: [f64; 3], weights: &[f64]) -> Normal {
        let b_inf = numbers[2];
        let sums = self.by_chunks(numbers, Normal::default, |sums, own, modelled| {
            let (values, weights) = (&self.values[own.clone()], &weights[own.clone()]);
            let ranges = &self.ranges[own];
            let (clear, below) = best_clear(modelled, values, weights);
            let derivatives = |m: &Modelled, range: f64| {
                [-clear * range * m.through, b_inf * range * m.unveiled, 1.0 - m.unveiled]
            };
            // What J takes over of each derivative; nothing where it is held at 0.
            let mut taken = [0.0; 3];
            if clear > 0.0 {
                for ((m, range), weight) in modelled.iter().zip(ranges).zip(weights) {
                    let by = derivatives(m, *range);
                    (0..3).for_each(|k| taken[k] += weight * m.through * by[k] / below);
                }
            }
            let mut gradient = [0.0; 3];
            for (((m, range), weight), value) in modelled.iter().zip(ranges).zip(weights).zip(values) {
                let residual = value - m.veil - clear * m.through;
                let by = derivatives(m, *range);
                let by: [f64; 3] = std::array::from_fn(|k| by[k] - taken[k] * m.through);
                sums.cost += weight * residual * residual;
                for j in 0..3 {
                    gradient[j] += weight * residual * by[j];
                    for k in 0..3 {
                        sums.hessian[j][k] += weight * by[j] * by[k];
                    }
                }
            }
            for j in 0..3 {
                sums.gradient[j] += gradient[j];
                for k in 0..3 {
                    sums.scatter[j][k] += gradient[j] * gradient[k];
                }
            }
        });
        sums.iter().fold(Normal::default(), Normal::add)
    }

    /// Levenberg-Marquardt under fixed weights.
    fn minimise(&self, mut numbers: [f64; 3], weights: &[f64], steps: usize, sought: Sought) -> [f64; 3] {
        let mut raw = to_raw(numbers);
        let mut at = self.normal(numbers, weights);
        let mut damping = 1e-3;
        for _ in 0..steps {
            let slope = slopes(numbers);
            let mut gradient: [f64; 3] = std::array::from_fn(|j| at.gradient[j] * slope[j]);
            let mut hessian: [[f64; 3]; 3] =
                std::array::from_fn(|j| std::array::from_fn(|k| at.hessian[j][k] * slope[j] * slope[k]));
            if sought == Sought::WithoutGrowth {
                // One unknown in place of two; the second has nothing left to say.
                gradient[0] += gradient[1];
                hessian[0][0] += 2.0 * hessian[0][1] + hessian[1][1];
                hessian[0][2] += hessian[1][2];
                hessian[2][0] = hessian[0][2];
            }
            let held: &[usize] = match sought {
                Sought::All => &[],
                Sought::WithoutGrowth => &[1],
                Sought::WithoutLimit => &[2],
            };
            for &number in held {
                gradient[number] = 0.0;
                for k in 0..3 {
                    (hessian[number][k], hessian[k][number]) = (0.0, 0.0);
                }
            }
            let trace = (0..3).map(|j| hessian[j][j]).sum::<f64>();
            let mut accepted = false;
            while !accepted && damping < 1e9 {
                let mut damped = hessian;
                (0..3).for_each(|j| damped[j][j] += damping * (hessian[j][j] + 1e-9 * trace) + 1e-30);
                let step =
                    solve(damped, gradient).map(|s| if s.is_finite() { s.clamp(-2.0, 2.0) } else { 0.0 });
                let mut tried: [f64; 3] =
                    std::array::from_fn(|j| (raw[j] + step[j]).clamp(-RAW_LIMIT, RAW_LIMIT));
                if sought == Sought::WithoutGrowth {
                    tried[1] = tried[0];
                }
                let tried_numbers = from_raw(tried);
                let there = self.normal(tried_numbers, weights);
                if there.cost <= at.cost {
                    let moved = (0..3).map(|j| (tried_numbers[j] - numbers[j]).abs()).fold(0.0, f64::max);
                    let gained = at.cost - there.cost;
                    (raw, numbers) = (tried, tried_numbers);
                    let cost = at.cost;
                    at = there;
                    damping = (damping / 5.0).max(1e-9);
                    if moved < 1e-7 || gained <= 1e-12 * cost {
                        return numbers;
                    }
                    accepted = true;
                } else {
                    damping *= 5.0;
                }
            }
            if !accepted {
                break;
            }
        }
        numbers
    }

    /// Residuals and what they are made of, in the order of the observations; `of_point` finds J.
    fn residuals(
        &self,
        numbers: [f64; 3],
        weights: &[f64],
        of_point: impl Fn(&[Modelled], &[f64], &[f64]) -> f64 + Sync,
    ) -> Vec<Residual> {
        let by_chunk = self.by_chunks(numbers, Vec::new, |found: &mut Vec<Residual>, own, modelled| {
            let (values, weights) = (&self.values[own.clone()], &weights[own]);
            let clear = of_point(modelled, values, weights);
            // J follows the mean of n residuals, so n - 1 of them are free.
            let freedom = 1.0 - 1.0 / values.len() as f64;
            found.extend(modelled.iter().zip(values).map(|(m, value)| {
                let direct = clear * m.through;
                Residual { error: (value - m.veil - direct) / freedom.sqrt(), direct, seen: m.veil + direct }
            }));
        });
        by_chunk.into_iter().flatten().collect()
    }

    /// Weights of the next round, and the ratio by which they overstate how sure the numbers are.
    fn reweight(&self, residuals: &[Residual], loss: Loss) -> Weights {
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
                weights.push(weight * of_point / (variances[index] * scale * scale));
            }
        }
        Weights {
            weights,
            // At least a tenth: with hardly any observation inside there is nothing to be sure of anyway.
            overstated: sum / slope.max(0.1 * sum).max(1e-30),
            inliers: inside as f64 / scaled.len().max(1) as f64,
        }
    }

    /// Rounds of weights and least squares until the numbers stand still.
    fn settle(
        &self,
        mut numbers: [f64; 3],
        mut weights: Vec<f64>,
        loss: Loss,
        sought: Sought,
        rounds: usize,
    ) -> ([f64; 3], Weights) {
        // Least squares alone would give a point to its one outlier where that is far from the rest.
        let mut found = self.reweight(&self.residuals(numbers, &weights, median_clear), loss);
        let least_squares =
            |m: &[Modelled], values: &[f64], weights: &[f64]| best_clear(m, values, weights).0;
        for _ in 0..rounds {
            let before = numbers;
            weights.clone_from(&found.weights);
            numbers = self.minimise(numbers, &weights, 6, sought);
            found = self.reweight(&self.residuals(numbers, &weights, least_squares), loss);
            if (0..3).all(|k| (numbers[k] - before[k]).abs() < 1e-5) {
                break;
            }
        }
        (numbers, found)
    }

    /// Weights that know nothing but the colours: by what a code is worth at the mean colour of the point.
    fn first_weights(&self) -> Vec<f64> {
        let mut weights = Vec::with_capacity(self.values.len());
        for own in self.starts.windows(2) {
            let own = &self.values[own[0]..own[1]];
            let mean = own.iter().sum::<f64>() / own.len() as f64;
            weights.extend(std::iter::repeat_n(code_step(mean).powi(-2), own.len()));
        }
        weights
    }

    /// The best of nine starts on some of the points, by the mean absolute residual in 8-bit codes.
    fn start(&self) -> [f64; 3] {
        let some = self.thinned(START_POINTS);
        // A colour that the backscatter may have: a tenth of the observations is darker.
        let veil = quantile(&mut some.values.clone(), 0.1).clamp(0.002, 0.9);
        let weights = some.first_weights();
        let starts: Vec<[f64; 3]> =
            [0.1, 0.5, 2.0].iter().flat_map(|d| [0.1, 0.5, 2.0].map(|b| [*d, b, veil])).collect();
        let judged: Vec<(f64, [f64; 3])> = starts
            .into_par_iter()
            .map(|start| {
                let numbers = some.minimise(start, &weights, 8, Sought::All);
                let (numbers, _) = some.settle(numbers, weights.clone(), Loss::Huber, Sought::All, 4);
                let residuals = some.residuals(numbers, &weights, median_clear);
                let cost = residuals.iter().zip(&weights).map(|(r, w)| r.error.abs() * w.sqrt()).sum();
                (cost, numbers)
            })
            .collect();
        let best = judged.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or([0.5, 0.5, veil], |(_, numbers)| numbers)
    }

    fn estimate(&self) -> Estimate {
        if self.points.len() < MIN_POINTS {
            // The other channels may have more: a lamp saturates red only.
            let weights = vec![0.0; self.values.len()];
            return Estimate { numbers: [0.0; 3], standard_error: [f64::INFINITY; 3], weights, inliers: 1.0 };
        }
        // Where the numbers settle, and how far other choices move them, some of the points show as well as all.
        let some = self.thinned(SETTLE_POINTS);
        let (of_some, found) =
            some.settle(self.start(), some.first_weights(), Loss::Tukey, Sought::All, ROUNDS);
        let systematic = some.systematic(of_some, &found);
        let (mut numbers, mut found) = if some.points.len() < self.points.len() {
            self.settle(of_some, self.first_weights(), Loss::Tukey, Sought::All, ROUNDS)
        } else {
            (of_some, found)
        };
        let variance = self.variance(numbers, &found);
        let mut errors: [f64; 3] = std::array::from_fn(|k| (variance[k] + systematic[k]).sqrt());
        let bounded = |errors: [f64; 3]| -> [f64; 3] {
            // NaN counts as unknown.
            std::array::from_fn(|k| if errors[k] < UNKNOWN[k] { errors[k] } else { f64::INFINITY })
        };
        errors = bounded(errors);
        // Without backscatter its growth means nothing; and its limit is seen only where it grows, or has grown up long
        // before the median range.
        let is_there = [1, 2].map(|k| numbers[k] > 2.0 * errors[k]);
        if !is_there[1] || (!is_there[0] && numbers[1] < 1.0) {
            errors[1] = f64::INFINITY;
            errors[2] = f64::INFINITY;
        }
        // What is unknown gets a usual value, and the others follow: backscatter grows towards no more than the colour
        // of what is far away, and as the direct signal fades where it would be all but grown up before the first
        // observation.
        let far_colour = self.far_colour();
        let usual = if errors[2].is_infinite() && numbers[2] > far_colour {
            Some((
                [numbers[0], numbers[1] * numbers[2] / far_colour.max(1e-6), far_colour],
                Sought::WithoutLimit,
            ))
        } else if errors[1].is_infinite() && numbers[1] > 1.0 {
            Some(([numbers[0], numbers[0], numbers[2]], Sought::WithoutGrowth))
        } else {
            None
        };
        if let Some((mut start, sought)) = usual {
            start[1] = start[1].min(1.0);
            let before = numbers[0];
            (numbers, found) = self.settle(start, found.weights, Loss::Tukey, sought, ROUNDS);
            errors[0] = errors[0].hypot(numbers[0] - before);
            errors = bounded(errors);
        }
        Estimate { numbers, standard_error: errors, weights: found.weights, inliers: found.inliers }
    }

    /// The median of the farthest twentieth of the observations.
    fn far_colour(&self) -> f64 {
        let far = quantile(&mut self.ranges.clone(), 0.95);
        let seen = self.ranges.iter().zip(&self.values).filter(|(range, _)| **range >= far);
        quantile(&mut seen.map(|(_, value)| *value).collect::<Vec<_>>(), 0.5)
    }

    /// Variances of the numbers by the scatter of the points alone.
    fn variance(&self, numbers: [f64; 3], found: &Weights) -> [f64; 3] {
        let at = self.normal(numbers, &found.weights);
        covariance(at.hessian, at.scatter).map(|variance| variance * found.overstated.powi(2))
    }

    /// Squares of how far the numbers move under another loss, and between darker and brighter points: what the model
    /// of image and noise leaves out.
    fn systematic(&self, numbers: [f64; 3], found: &Weights) -> [f64; 3] {
        let (under_huber, _) = self.settle(numbers, found.weights.clone(), Loss::Huber, Sought::All, 10);
        let mut sorted: Vec<(f64, usize)> = self
            .starts
            .windows(2)
            .map(|own| {
                let own = own[0]..own[1];
                let modelled: Vec<Modelled> =
                    self.ranges[own.clone()].iter().map(|range| model(numbers, *range)).collect();
                best_clear(&modelled, &self.values[own.clone()], &found.weights[own]).0
            })
            .zip(0..)
            .collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let (darker, brighter) = sorted.split_at(sorted.len() / 2);
        let halves = [darker, brighter].map(|half| {
            let mut points: Vec<usize> = half.iter().map(|(_, point)| *point).collect();
            points.sort_unstable();
            let half = self.selected(points.into_iter());
            half.settle(numbers, half.first_weights(), Loss::Tukey, Sought::All, 10).0
        });
        // Halves differ by chance too, by twice the standard error of both together.
        let chance = self.variance(numbers, found);
        std::array::from_fn(|k| {
            let between = (halves[1][k] - halves[0][k]) / 2.0;
            (under_huber[k] - numbers[k]).powi(2) + (between * between - chance[k]).max(0.0)
        })
    }

    /// J of each of `points` points.
    fn clear(&self, estimate: &Estimate, points: usize) -> Vec<Option<f64>> {
        let mut found = vec![None; points];
        for (point, own) in self.points.iter().zip(self.starts.windows(2)) {
            let own = own[0]..own[1];
            let modelled: Vec<Modelled> =
                self.ranges[own.clone()].iter().map(|range| model(estimate.numbers, *range)).collect();
            let (clear, below) = best_clear(&modelled, &self.values[own.clone()], &estimate.weights[own]);
            found[*point as usize] = (below > 0.0).then_some(clear);
        }
        found
    }
}

/// One observation against the model.
struct Residual {
    /// Seen less modelled, as large as if J were not fitted to it, linear light.
    error: f64,
    /// Modelled direct signal.
    direct: f64,
    /// Modelled colour.
    seen: f64,
}

/// Result of [`Channel::reweight`].
struct Weights {
    weights: Vec<f64>,
    /// Sum of the weights by the sum of the slopes of psi: the bread of the sandwich has weights in place of slopes.
    overstated: f64,
    /// Share of observations within Tukey's limit.
    inliers: f64,
}

/// Coefficients of the variance of one observation, in the order of [`Noise::parts`].
struct Noise([f64; 3]);

impl Noise {
    /// Squares of an 8-bit code, of photons and of texture.
    fn parts(residual: &Residual) -> [f64; 3] {
        let seen = residual.seen.max(1e-4);
        [code_step(seen).powi(2), 1e-3 * seen, residual.direct * residual.direct + 1e-12]
    }

    /// Fitted to the squares of the residuals, cut off at six variances: Gaussian noise has next to nothing there.
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
        // A mean over a few pixels does not know a colour better than to a thirtieth of a code.
        const FLOOR: f64 = 1e-3;
        let of = |residual: &Residual| {
            let parts = Self::parts(residual);
            (0..3).map(|k| self.0[k] * parts[k]).sum::<f64>() + FLOOR * parts[0]
        };
        residuals.iter().map(of).collect()
    }
}

/// What one 8-bit code is worth at this linear light: the derivative of the inverse sRGB curve by 255.
fn code_step(linear: f64) -> f64 {
    let encoded = crate::picture::linear_to_srgb(linear.clamp(0.0, 1.0));
    let slope =
        if encoded <= 0.040_45 { 1.0 / 12.92 } else { 2.4 / 1.055 * ((encoded + 0.055) / 1.055).powf(1.4) };
    slope / 255.0
}

/// The unconstrained numbers of one channel.
fn to_raw([beta_d, beta_b, b_inf]: [f64; 3]) -> [f64; 3] {
    let raw = Water { beta_d: [beta_d; 3], beta_b: [beta_b; 3], b_inf: [b_inf; 3] }.to_raw(1.0);
    [raw[0], raw[3], raw[6]].map(|value| value.clamp(-RAW_LIMIT, RAW_LIMIT))
}

fn from_raw([d, b, i]: [f64; 3]) -> [f64; 3] {
    let water = Water::from_raw([d, d, d, b, b, b, i, i, i], 1.0);
    [water.beta_d[0], water.beta_b[0], water.b_inf[0]]
}

/// Derivatives of the numbers with respect to the unconstrained ones.
fn slopes([beta_d, beta_b, b_inf]: [f64; 3]) -> [f64; 3] {
    [-(-beta_d).exp_m1(), -(-beta_b).exp_m1(), b_inf * (1.0 - b_inf)]
}

/// The value below which `share` of the values lie; 0 of none. Their order changes.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

#[cfg(test)]
#[path = "sparse_tests.rs"]
mod tests;
