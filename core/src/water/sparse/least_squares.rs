//! Least squares for the water parameters of one channel under fixed weights, with J of each point
//! eliminated.

use rayon::prelude::*;

use super::Observation;
use super::robust::code_step;
use super::shades::{ROUNDING, crowds_of};
use crate::water::Water;
use crate::water::solve::{Matrix, solve};

/// Points per chunk; each chunk is summed by one thread.
const CHUNK: usize = 256;
/// Limit of the absolute unconstrained parameters: at it, softplus and sigmoid are within 1e-6 of their ends.
const RAW_LIMIT: f64 = 14.0;

/// Observations of one channel, point by point. Ranges are in units of the median range, so the unknowns have
/// no unit: `[beta_d, beta_b, b_inf]`, with the betas multiplied by that range.
#[derive(Clone, Default)]
pub(super) struct Channel {
    pub(super) ranges: Vec<f64>,
    pub(super) values: Vec<f64>,
    /// Values from the smaller windows.
    pub(super) finer: Vec<f64>,
    /// Factor on the limit of the backscatter along each ray.
    tints: Vec<f64>,
    /// Index of each observation.
    pub(super) observed: Vec<u32>,
    /// Shade of each observation ([`shades`](super::shades)).
    shades: Vec<u32>,
    /// Number of observations with the same shade.
    pub(super) crowds: Vec<f64>,
    /// Start of the observations of each point, and the end of the last.
    pub(super) starts: Vec<usize>,
    /// Index of each point.
    pub(super) points: Vec<u32>,
}

/// Which of the three parameters are optimised.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Sought {
    All,
    /// beta_b equals beta_d.
    WithoutGrowth,
    /// b_inf is fixed.
    WithoutLimit,
    /// beta_b and b_inf are fixed.
    Attenuation,
}

/// Sums of one pass: the cost and the normal equations.
#[derive(Clone, Copy, Default)]
pub(super) struct Normal {
    pub(super) cost: f64,
    pub(super) hessian: Matrix,
    pub(super) gradient: [f64; 3],
    /// Sum over points of the outer product of each point's gradient.
    pub(super) scatter: Matrix,
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

/// Model of one observation.
#[derive(Clone, Copy)]
pub(super) struct Modelled {
    /// exp(-beta_d r).
    pub(super) through: f64,
    /// Backscatter.
    pub(super) veil: f64,
    /// exp(-beta_b r).
    pub(super) unveiled: f64,
    /// Factor on b_inf.
    tint: f64,
}

pub(super) fn model([beta_d, beta_b, b_inf]: [f64; 3], range: f64, tint: f64) -> Modelled {
    let unveiled = (-beta_b * range).exp();
    Modelled { through: (-beta_d * range).exp(), veil: tint * b_inf * (1.0 - unveiled), unveiled, tint }
}

/// J of one point, and the sum of squares in its denominator.
pub(super) fn best_clear(modelled: &[Modelled], values: &[f64], weights: &[f64]) -> (f64, f64) {
    let (mut above, mut below) = (0.0, 0.0);
    for ((m, value), weight) in modelled.iter().zip(values).zip(weights) {
        above += weight * m.through * (value - m.veil);
        below += weight * m.through * m.through;
    }
    // If no light comes through (or all weights are 0), any J fits; 0 is as good as any.
    (if below > 1e-200 { (above / below).max(0.0) } else { 0.0 }, below)
}

/// J of one point as the weighted median over its observations. Each has its weight in a sum of absolute
/// residuals.
pub(super) fn median_clear(modelled: &[Modelled], values: &[f64], weights: &[f64]) -> f64 {
    let estimates = modelled.iter().zip(values).zip(weights).filter(|((m, _), _)| m.through > 1e-100);
    let mut estimates: Vec<(f64, f64)> = estimates
        .map(|((m, value), weight)| ((value - m.veil) / m.through, weight.sqrt() * m.through))
        .collect();
    estimates.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = estimates.iter().map(|(_, weight)| weight).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let median = estimates.iter().find(|(_, weight)| {
        below += weight;
        below >= half
    });
    median.map_or(0.0, |(clear, _)| clear.max(0.0))
}

impl Channel {
    /// Leaves out points with fewer than two observations: any water explains them. Every observation starts
    /// with a shade of its own.
    pub(super) fn of(observations: &[Observation], order: &[u32], c: usize, unit: f64) -> Self {
        let seen = |index: u32| &observations[index as usize];
        let mut channel = Self { starts: vec![0], ..Self::default() };
        for of_point in order.chunk_by(|&a, &b| seen(a).point == seen(b).point) {
            let usable = |seen: &Observation| seen.colour[c].is_finite() && seen.finer[c].is_finite();
            let counting = of_point.iter().filter(|&&index| usable(seen(index)));
            if counting.clone().count() < 2 {
                continue;
            }
            for &index in counting {
                channel.ranges.push(seen(index).range / unit);
                channel.values.push(seen(index).colour[c]);
                channel.finer.push(seen(index).finer[c]);
                channel.tints.push(seen(index).tint[c]);
                channel.observed.push(index);
            }
            channel.starts.push(channel.values.len());
            channel.points.push(seen(of_point[0]).point);
        }
        channel.shades = (0..channel.values.len() as u32).collect();
        channel.crowds = vec![1.0; channel.values.len()];
        channel
    }

    /// Sets the shade of each observation.
    #[must_use]
    pub(super) fn with_shades(mut self, of_observations: &[u32]) -> Self {
        self.shades = self.observed.iter().map(|index| of_observations[*index as usize]).collect();
        self.crowds = crowds_of(&self.shades);
        self
    }

    /// Subtracts a known veil; `veil` returns it by observation.
    #[must_use]
    pub(super) fn without(mut self, veil: impl Fn(usize) -> f64) -> Self {
        for (at, index) in self.observed.iter().enumerate() {
            let veil = veil(*index as usize);
            self.values[at] -= veil;
            self.finer[at] -= veil;
        }
        self
    }

    /// Adds an attenuation of 1 / median range: light is reduced by a factor of e per median range.
    #[must_use]
    pub(super) fn faded(mut self) -> Self {
        for (at, range) in self.ranges.iter().enumerate() {
            let through = (-range).exp();
            self.values[at] *= through;
            self.finer[at] *= through;
        }
        self
    }

    /// The model of the observations `own`.
    pub(super) fn modelled(
        &self,
        numbers: [f64; 3],
        own: std::ops::Range<usize>,
    ) -> impl Iterator<Item = Modelled> {
        let seen = self.ranges[own.clone()].iter().zip(&self.tints[own]);
        seen.map(move |(range, tint)| model(numbers, *range, *tint))
    }

    /// The same points with the values of the smaller windows.
    pub(super) fn finer(&self) -> Self {
        Self { values: self.finer.clone(), ..self.clone() }
    }

    /// Every n-th point, so that at most `most` remain.
    pub(super) fn thinned(&self, most: usize) -> Self {
        self.selected((0..self.points.len()).step_by(self.points.len().div_ceil(most).max(1)))
    }

    pub(super) fn selected(&self, indices: impl Iterator<Item = usize>) -> Self {
        let mut thin = Self { starts: vec![0], ..Self::default() };
        for index in indices {
            let own = self.starts[index]..self.starts[index + 1];
            thin.ranges.extend_from_slice(&self.ranges[own.clone()]);
            thin.values.extend_from_slice(&self.values[own.clone()]);
            thin.finer.extend_from_slice(&self.finer[own.clone()]);
            thin.tints.extend_from_slice(&self.tints[own.clone()]);
            thin.observed.extend_from_slice(&self.observed[own.clone()]);
            thin.shades.extend_from_slice(&self.shades[own]);
            thin.starts.push(thin.values.len());
            thin.points.push(self.points[index]);
        }
        thin.crowds = crowds_of(&thin.shades);
        thin
    }

    /// Runs `work` on the observations of each point (their indices and models) and collects the results by
    /// chunks of points, in order.
    pub(super) fn by_chunks<T: Send>(
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
                    modelled.extend(self.modelled(numbers, own.clone()));
                    work(&mut result, own, &modelled);
                }
                result
            })
            .collect()
    }

    /// Calls `each` for every observation of a point with its index, residual, modelled colour, and
    /// derivatives of the colour with respect to the parameters. The part of the derivatives that J absorbs
    /// is subtracted.
    fn sensitivities(
        &self,
        b_inf: f64,
        own: std::ops::Range<usize>,
        modelled: &[Modelled],
        weights: &[f64],
        mut each: impl FnMut(usize, f64, f64, [f64; 3]),
    ) {
        let (values, weights) = (&self.values[own.clone()], &weights[own.clone()]);
        let ranges = &self.ranges[own.clone()];
        let (clear, below) = best_clear(modelled, values, weights);
        let derivatives = |m: &Modelled, range: f64| {
            [-clear * range * m.through, m.tint * b_inf * range * m.unveiled, m.tint * (1.0 - m.unveiled)]
        };
        // Zero if J is held at 0.
        let mut taken = [0.0; 3];
        if clear > 0.0 {
            for ((m, range), weight) in modelled.iter().zip(ranges).zip(weights) {
                let by = derivatives(m, *range);
                (0..3).for_each(|k| taken[k] += weight * m.through * by[k] / below);
            }
        }
        for (((m, range), value), index) in modelled.iter().zip(ranges).zip(values).zip(own) {
            let seen = m.veil + clear * m.through;
            let by = derivatives(m, *range);
            each(index, value - seen, seen, std::array::from_fn(|k| by[k] - taken[k] * m.through));
        }
    }

    /// Cost and normal equations under these weights.
    pub(super) fn normal(&self, numbers: [f64; 3], weights: &[f64]) -> Normal {
        let sums = self.by_chunks(numbers, Normal::default, |sums, own, modelled| {
            let mut gradient = [0.0; 3];
            self.sensitivities(numbers[2], own, modelled, weights, |index, residual, _, by| {
                let weight = weights[index];
                sums.cost += weight * residual * residual;
                for j in 0..3 {
                    gradient[j] += weight * residual * by[j];
                    for k in 0..3 {
                        sums.hessian[j][k] += weight * by[j] * by[k];
                    }
                }
            });
            for j in 0..3 {
                sums.gradient[j] += gradient[j];
                for k in 0..3 {
                    sums.scatter[j][k] += gradient[j] * gradient[k];
                }
            }
        });
        sums.iter().fold(Normal::default(), Normal::add)
    }

    /// Sum over shades of the outer product of the gradient caused by a rounding error of [`ROUNDING`] codes
    /// in all observations of the shade.
    pub(super) fn scatter_of_rounding(&self, numbers: [f64; 3], weights: &[f64]) -> Matrix {
        let by_chunk = self.by_chunks(numbers, Vec::new, |found: &mut Vec<[f64; 3]>, own, modelled| {
            self.sensitivities(numbers[2], own, modelled, weights, |index, _, seen, by| {
                let factor = weights[index] * ROUNDING * code_step(seen);
                found.push(by.map(|by| by * factor));
            });
        });
        let mut of_shade = vec![[0.0; 3]; self.shades.iter().max().map_or(0, |most| *most as usize + 1)];
        for (shade, gradient) in self.shades.iter().zip(by_chunk.into_iter().flatten()) {
            (0..3).for_each(|k| of_shade[*shade as usize][k] += gradient[k]);
        }
        let mut scatter = Matrix::default();
        for gradient in of_shade {
            for (row, left) in scatter.iter_mut().zip(gradient) {
                row.iter_mut().zip(gradient).for_each(|(sum, right)| *sum += left * right);
            }
        }
        scatter
    }

    /// Levenberg-Marquardt under fixed weights.
    pub(super) fn minimise(
        &self,
        mut numbers: [f64; 3],
        weights: &[f64],
        steps: usize,
        sought: Sought,
    ) -> [f64; 3] {
        let mut raw = to_raw(numbers);
        let mut at = self.normal(numbers, weights);
        let mut damping = 1e-3;
        for _ in 0..steps {
            let slope = water_of(numbers).slopes(1.0);
            let slope = [slope[0], slope[3], slope[6]];
            let mut gradient: [f64; 3] = std::array::from_fn(|j| at.gradient[j] * slope[j]);
            let mut hessian: Matrix =
                std::array::from_fn(|j| std::array::from_fn(|k| at.hessian[j][k] * slope[j] * slope[k]));
            if sought == Sought::WithoutGrowth {
                // One unknown in place of two; the second is held.
                gradient[0] += gradient[1];
                hessian[0][0] += 2.0 * hessian[0][1] + hessian[1][1];
                hessian[0][2] += hessian[1][2];
                hessian[2][0] = hessian[0][2];
            }
            let held: &[usize] = match sought {
                Sought::All => &[],
                Sought::WithoutGrowth => &[1],
                Sought::WithoutLimit => &[2],
                Sought::Attenuation => &[1, 2],
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
}

/// A water with equal channels.
fn water_of([beta_d, beta_b, b_inf]: [f64; 3]) -> Water {
    Water { beta_d: [beta_d; 3], beta_b: [beta_b; 3], b_inf: [b_inf; 3] }
}

/// The unconstrained parameters of one channel.
fn to_raw(numbers: [f64; 3]) -> [f64; 3] {
    let raw = water_of(numbers).to_raw(1.0);
    [raw[0], raw[3], raw[6]].map(|value| value.clamp(-RAW_LIMIT, RAW_LIMIT))
}

fn from_raw([d, b, i]: [f64; 3]) -> [f64; 3] {
    let water = Water::from_raw([d, d, d, b, b, b, i, i, i], 1.0);
    [water.beta_d[0], water.beta_b[0], water.b_inf[0]]
}
