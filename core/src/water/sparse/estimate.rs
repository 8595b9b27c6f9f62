//! The parameters of one channel and their standard errors: nine starts, then rounds of reweighting and least
//! squares.

use rayon::prelude::*;

use super::MIN_POINTS;
use super::least_squares::{Channel, Modelled, Sought, best_clear, median_clear};
use super::robust::{Loss, Residual, Weights, code_step, quantile};
use crate::water::solve::covariance;

/// Number of points used to choose a start.
const START_POINTS: usize = 600;
/// Number of points used until the parameters settle, before all points are used.
const SETTLE_POINTS: usize = 5000;
/// Maximum number of reweighting rounds.
const ROUNDS: usize = 25;
/// Relative cost penalty of a start per squared logarithm of beta_b / beta_d: 0.5 % for a factor of 2, 4 %
/// for a factor of 7. Both come from the same water. If they are equal, J T + B (1 - T) = (J - B) T + B: a
/// veil complete before the first point explains as much, with darker points. Its cost is within 0.5 % of the
/// other one, and sometimes lower.
const UNLIKE: f64 = 0.01;
/// Standard error from which a parameter is unknown: of beta times the median range, and of `b_inf`.
const UNKNOWN: [f64; 3] = [3.0, 3.0, 1.0];

/// The cost of a start with the [`UNLIKE`] penalty. The penalty vanishes for negligible coefficients.
fn seeming(cost: f64, [beta_d, beta_b, _]: [f64; 3]) -> f64 {
    let ratio = (beta_b + 0.01) / (beta_d + 0.01);
    cost * (1.0 + UNLIKE * ratio.ln().powi(2))
}

/// Result for one channel, in the units of [`Channel`].
pub(super) struct Estimate {
    pub(super) numbers: [f64; 3],
    pub(super) standard_error: [f64; 3],
    pub(super) weights: Vec<f64>,
    pub(super) inliers: f64,
}

impl Channel {
    /// Residuals with their direct signal and modelled colour, in the order of the observations; `of_point`
    /// finds J.
    fn residuals(
        &self,
        numbers: [f64; 3],
        weights: &[f64],
        of_point: impl Fn(&[Modelled], &[f64], &[f64]) -> f64 + Sync,
    ) -> Vec<Residual> {
        let by_chunk = self.by_chunks(numbers, Vec::new, |found: &mut Vec<Residual>, own, modelled| {
            let (values, weights) = (&self.values[own.clone()], &weights[own]);
            let clear = of_point(modelled, values, weights);
            // J follows the mean of n residuals, which leaves n - 1 degrees of freedom.
            let freedom = 1.0 - 1.0 / values.len() as f64;
            found.extend(modelled.iter().zip(values).map(|(m, value)| {
                let direct = clear * m.through;
                Residual { error: (value - m.veil - direct) / freedom.sqrt(), direct, seen: m.veil + direct }
            }));
        });
        by_chunk.into_iter().flatten().collect()
    }

    /// Alternates weights and least squares until the parameters settle.
    fn settle(
        &self,
        mut numbers: [f64; 3],
        mut weights: Vec<f64>,
        loss: Loss,
        sought: Sought,
        rounds: usize,
    ) -> ([f64; 3], Weights) {
        // Least squares alone would fit J to a single outlier far from the rest.
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

    /// Initial weights from colours alone: by the size of a code at the mean colour of the point, and by the
    /// number of observations of the shade.
    fn first_weights(&self) -> Vec<f64> {
        let mut weights = Vec::with_capacity(self.values.len());
        for own in self.starts.windows(2) {
            let own = own[0]..own[1];
            let mean = self.values[own.clone()].iter().sum::<f64>() / own.len() as f64;
            let variance = |index| code_step(mean).powi(2) + self.rounding_variance(index, mean);
            weights.extend(own.map(|index| variance(index).recip()));
        }
        weights
    }

    /// The best of nine starts on a subset of the points, by the mean absolute residual in 8-bit codes and
    /// the [`UNLIKE`] penalty.
    fn start(&self) -> [f64; 3] {
        let some = self.thinned(START_POINTS);
        // A plausible backscatter colour: a tenth of the observations are darker.
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
                let cost: f64 = residuals.iter().zip(&weights).map(|(r, w)| r.error.abs() * w.sqrt()).sum();
                (seeming(cost, numbers), numbers)
            })
            .collect();
        let best = judged.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or([0.5, 0.5, veil], |(_, numbers)| numbers)
    }

    /// The parameters from a subset of the points, and the modelled colour of each observation; `None` with
    /// too few points.
    pub(super) fn rough(&self) -> Option<([f64; 3], Vec<f64>)> {
        if self.points.len() < MIN_POINTS {
            return None;
        }
        let some = self.thinned(SETTLE_POINTS);
        let (numbers, _) = some.settle(self.start(), some.first_weights(), Loss::Tukey, Sought::All, ROUNDS);
        let seen = self.residuals(numbers, &self.first_weights(), median_clear);
        Some((numbers, seen.into_iter().map(|residual| residual.seen).collect()))
    }

    /// The parameters with their errors, starting from those of [`Channel::rough`].
    pub(super) fn estimate(&self, rough: Option<[f64; 3]>) -> Estimate {
        let Some(rough) = rough else {
            // The other channels may still have enough points: a lamp saturates red only.
            let weights = vec![0.0; self.values.len()];
            return Estimate { numbers: [0.0; 3], standard_error: [f64::INFINITY; 3], weights, inliers: 1.0 };
        };
        // A subset of the points is enough to settle the parameters and to measure how other choices change
        // them.
        let some = self.thinned(SETTLE_POINTS);
        let (of_some, found) = some.settle(rough, some.first_weights(), Loss::Tukey, Sought::All, ROUNDS);
        let systematic = some.systematic(of_some, &found, Sought::All);
        let (mut numbers, mut found) = if some.points.len() < self.points.len() {
            self.settle(of_some, self.first_weights(), Loss::Tukey, Sought::All, ROUNDS)
        } else {
            (of_some, found)
        };
        let variance = self.variance(numbers, &found, Sought::All);
        let mut errors: [f64; 3] = std::array::from_fn(|k| (variance[k] + systematic[k]).sqrt());
        let bounded = |errors: [f64; 3]| -> [f64; 3] {
            // NaN counts as unknown.
            std::array::from_fn(|k| if errors[k] < UNKNOWN[k] { errors[k] } else { f64::INFINITY })
        };
        errors = bounded(errors);
        // Without backscatter, its growth has no meaning. Its limit is visible only if it grows, or is
        // complete well before the median range.
        let is_there = [1, 2].map(|k| numbers[k] > 2.0 * errors[k]);
        if !is_there[1] || (!is_there[0] && numbers[1] < 1.0) {
            errors[1] = f64::INFINITY;
            errors[2] = f64::INFINITY;
        }
        // Unknown parameters get typical values, and the others are fitted again. Backscatter is limited to
        // the colour far away. If it would be nearly complete before the first observation, it grows as the
        // direct signal fades.
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
        // Points that get brighter with range, as on a lit sea floor, are not evidence of backscatter if
        // other choices change the growth completely. A false veil would remove dark colours from the scene,
        // so beta_b is set to beta_d.
        if errors[1].is_infinite() && errors[2].is_infinite() && !some.has_growth(numbers) {
            numbers[1] = numbers[0];
        }
        Estimate { numbers, standard_error: errors, weights: found.weights, inliers: found.inliers }
    }

    /// The attenuation of a channel after its veil was removed, and its standard error, infinite if
    /// undetermined.
    pub(super) fn attenuation(&self) -> [f64; 2] {
        if self.points.len() < MIN_POINTS {
            return [0.0, f64::INFINITY];
        }
        // An attenuation of 0 must not be the end of the scale, so that amplification can be measured.
        let [faded, error] = self.clone().faded().attenuation_from(1.0);
        if faded <= 1.0 {
            return [0.0, error.hypot(1.0 - faded)];
        }
        self.attenuation_from(faded - 1.0)
    }

    fn attenuation_from(&self, start: f64) -> [f64; 2] {
        let sought = Sought::Attenuation;
        let some = self.thinned(SETTLE_POINTS);
        let start = [start, 1.0, 0.0];
        let (numbers, found) = some.settle(start, some.first_weights(), Loss::Tukey, sought, ROUNDS);
        let systematic = some.systematic(numbers, &found, sought);
        let error = (some.variance(numbers, &found, sought)[0] + systematic[0]).sqrt();
        [numbers[0], if error < UNKNOWN[0] { error } else { f64::INFINITY }]
    }

    /// The median value of the farthest twentieth of the observations.
    fn far_colour(&self) -> f64 {
        let far = quantile(&mut self.ranges.clone(), 0.95);
        let seen = self.ranges.iter().zip(&self.values).filter(|(range, _)| **range >= far);
        quantile(&mut seen.map(|(_, value)| *value).collect::<Vec<_>>(), 0.5)
    }

    /// Variances of the parameters from the scatter of points and the rounding of shades alone; 0 for a fixed
    /// limit.
    fn variance(&self, numbers: [f64; 3], found: &Weights, sought: Sought) -> [f64; 3] {
        let mut at = self.normal(numbers, &found.weights);
        let rounding = self.scatter_of_rounding(numbers, &found.weights);
        for (row, more) in at.scatter.iter_mut().zip(rounding) {
            row.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
        }
        let held: &[usize] = match sought {
            Sought::WithoutLimit => &[2],
            Sought::Attenuation => &[1, 2],
            Sought::All | Sought::WithoutGrowth => &[],
        };
        for &number in held {
            for k in 0..3 {
                (at.hessian[number][k], at.hessian[k][number]) = (0.0, 0.0);
                (at.scatter[number][k], at.scatter[k][number]) = (0.0, 0.0);
            }
        }
        covariance(at.hessian, at.scatter).map(|variance| variance * found.overstated.powi(2))
    }

    /// Squared changes of the parameters under another loss, between darker and brighter points, and with
    /// smaller windows. They estimate the errors of the image and noise models.
    fn systematic(&self, numbers: [f64; 3], found: &Weights, sought: Sought) -> [f64; 3] {
        let (under_huber, _) = self.settle(numbers, found.weights.clone(), Loss::Huber, sought, 10);
        let finer = self.finer();
        let (with_finer, _) = finer.settle(numbers, finer.first_weights(), Loss::Tukey, sought, 10);
        let mut sorted: Vec<(f64, usize)> = self
            .starts
            .windows(2)
            .map(|own| {
                let own = own[0]..own[1];
                let modelled: Vec<Modelled> = self.modelled(numbers, own.clone()).collect();
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
            half.settle(numbers, half.first_weights(), Loss::Tukey, sought, 10).0
        });
        // Halves also differ by chance, by twice the standard error of the whole.
        let chance = self.variance(numbers, found, sought);
        std::array::from_fn(|k| {
            let between = (halves[1][k] - halves[0][k]) / 2.0;
            let moved = (under_huber[k] - numbers[k]).hypot(with_finer[k] - numbers[k]);
            moved * moved + (between * between - chance[k]).max(0.0)
        })
    }

    /// Whether backscatter clearly grows towards the limit in `numbers`.
    fn has_growth(&self, numbers: [f64; 3]) -> bool {
        let sought = Sought::WithoutLimit;
        let (numbers, found) = self.settle(numbers, self.first_weights(), Loss::Tukey, sought, ROUNDS);
        let systematic = self.systematic(numbers, &found, sought);
        numbers[1] > 2.0 * (self.variance(numbers, &found, sought)[1] + systematic[1]).sqrt()
    }

    /// J of each of `points` points, from the smaller windows, which are less blurred.
    pub(super) fn clear(&self, estimate: &Estimate, points: usize) -> Vec<Option<f64>> {
        let mut found = vec![None; points];
        for (point, own) in self.points.iter().zip(self.starts.windows(2)) {
            let own = own[0]..own[1];
            let modelled: Vec<Modelled> = self.modelled(estimate.numbers, own.clone()).collect();
            let (clear, below) = best_clear(&modelled, &self.finer[own.clone()], &estimate.weights[own]);
            found[*point as usize] = (below > 0.0).then_some(clear);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn veil_complete_at_once_needs_a_clearly_lower_cost() {
        // Green channel of the wreck in turbid water: the truth, and an alternative that explains the points
        // as well.
        let (growing, at_once) = ([2.0, 2.16, 0.101], [2.0, 5.95, 0.101]);
        assert!(seeming(4419.0, growing) < seeming(4409.0, at_once));
        assert!(seeming(4419.0, growing) > seeming(4300.0, at_once), "evidence counts");
        // In air both are negligible, and so is their ratio's penalty.
        assert!(seeming(100.0, [1e-6, 1e-3, 0.1]) < 100.02);
    }
}
