//! The numbers of one channel: from nine starts through rounds of weights and least squares, with standard
//! errors.

use rayon::prelude::*;

use super::MIN_POINTS;
use super::least_squares::{Channel, Modelled, Sought, best_clear, median_clear};
use super::robust::{Loss, Residual, Weights, code_step, quantile};
use crate::water::solve::covariance;

/// Points from which starts are judged.
const START_POINTS: usize = 600;
/// Points on which the numbers settle before all are taken.
const SETTLE_POINTS: usize = 5000;
/// Rounds of new weights.
const ROUNDS: usize = 25;
/// By what share a start seems worse than it is where backscatter grows e times faster or slower than the
/// direct signal fades: for a factor of 2 0.5 %, for one of 7 4 %. Both come of the same water; and where
/// they are the same, J T + B (1 - T) = (J - B) T + B, so that a veil which is all there before the first
/// point explains as much, with darker points. Its cost is within 0.5 % of the other one's, at times below
/// it.
const UNLIKE: f64 = 0.01;
/// Standard errors from which a number counts as unknown: of beta times the median range, and of `b_inf`.
const UNKNOWN: [f64; 3] = [3.0, 3.0, 1.0];

/// The cost of a start with [`UNLIKE`] in it. Numbers so small that they make no difference make none here.
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

    /// Weights that know nothing but the colours: by what a code is worth at the mean colour of the point,
    /// and by how many share the shade.
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

    /// The best of nine starts on some of the points, by the mean absolute residual in 8-bit codes and
    /// [`UNLIKE`].
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
                let cost: f64 = residuals.iter().zip(&weights).map(|(r, w)| r.error.abs() * w.sqrt()).sum();
                (seeming(cost, numbers), numbers)
            })
            .collect();
        let best = judged.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or([0.5, 0.5, veil], |(_, numbers)| numbers)
    }

    /// The numbers by some of the points, and the colour that each observation has under them; `None` where
    /// there are too few.
    pub(super) fn rough(&self) -> Option<([f64; 3], Vec<f64>)> {
        if self.points.len() < MIN_POINTS {
            return None;
        }
        let some = self.thinned(SETTLE_POINTS);
        let (numbers, _) = some.settle(self.start(), some.first_weights(), Loss::Tukey, Sought::All, ROUNDS);
        let seen = self.residuals(numbers, &self.first_weights(), median_clear);
        Some((numbers, seen.into_iter().map(|residual| residual.seen).collect()))
    }

    /// The numbers with their errors, from those by [`Channel::rough`].
    pub(super) fn estimate(&self, rough: Option<[f64; 3]>) -> Estimate {
        let Some(rough) = rough else {
            // The other channels may have more: a lamp saturates red only.
            let weights = vec![0.0; self.values.len()];
            return Estimate { numbers: [0.0; 3], standard_error: [f64::INFINITY; 3], weights, inliers: 1.0 };
        };
        // Where the numbers settle, and how far other choices move them, some of the points show as well as
        // all.
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
        // Without backscatter its growth means nothing; and its limit is seen only where it grows, or has
        // grown up long before the median range.
        let is_there = [1, 2].map(|k| numbers[k] > 2.0 * errors[k]);
        if !is_there[1] || (!is_there[0] && numbers[1] < 1.0) {
            errors[1] = f64::INFINITY;
            errors[2] = f64::INFINITY;
        }
        // What is unknown gets a usual value, and the others follow: backscatter grows towards no more than
        // the colour of what is far away, and as the direct signal fades where it would be all but grown up
        // before the first observation.
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
        // Points that grow brighter with their range, as those of a lit sea floor may, are no backscatter
        // where other choices give another growth altogether. A veil that is not there takes the dark from
        // the scene; so it grows only as the direct signal fades.
        if errors[1].is_infinite() && errors[2].is_infinite() && !some.has_growth(numbers) {
            numbers[1] = numbers[0];
        }
        Estimate { numbers, standard_error: errors, weights: found.weights, inliers: found.inliers }
    }

    /// Attenuation of a channel whose veil was taken away, and its standard error, infinite where nothing
    /// tells.
    pub(super) fn attenuation(&self) -> [f64; 2] {
        if self.points.len() < MIN_POINTS {
            return [0.0, f64::INFINITY];
        }
        // No attenuation is not the end of what it can be seen to be.
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

    /// The median of the farthest twentieth of the observations.
    fn far_colour(&self) -> f64 {
        let far = quantile(&mut self.ranges.clone(), 0.95);
        let seen = self.ranges.iter().zip(&self.values).filter(|(range, _)| **range >= far);
        quantile(&mut seen.map(|(_, value)| *value).collect::<Vec<_>>(), 0.5)
    }

    /// Variances of the numbers by the scatter of the points and the rounding of shades alone; of a limit
    /// that is not sought 0.
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

    /// Squares of how far the numbers move under another loss, between darker and brighter points, and with
    /// smaller windows: what the model of image and noise leaves out.
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
        // Halves differ by chance too, by twice the standard error of both together.
        let chance = self.variance(numbers, found, sought);
        std::array::from_fn(|k| {
            let between = (halves[1][k] - halves[0][k]) / 2.0;
            let moved = (under_huber[k] - numbers[k]).hypot(with_finer[k] - numbers[k]);
            moved * moved + (between * between - chance[k]).max(0.0)
        })
    }

    /// Whether backscatter grows beyond doubt towards the limit that `numbers` have.
    fn has_growth(&self, numbers: [f64; 3]) -> bool {
        let sought = Sought::WithoutLimit;
        let (numbers, found) = self.settle(numbers, self.first_weights(), Loss::Tukey, sought, ROUNDS);
        let systematic = self.systematic(numbers, &found, sought);
        numbers[1] > 2.0 * (self.variance(numbers, &found, sought)[1] + systematic[1]).sqrt()
    }

    /// J of each of `points` points, by the smaller windows: what is blurred less.
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
    fn a_veil_that_is_all_there_at_once_must_be_clearly_better_than_one_that_grows_as_light_fades() {
        // Green of the wreck in turbid water: the truth, and what explains the points as well.
        let (growing, at_once) = ([2.0, 2.16, 0.101], [2.0, 5.95, 0.101]);
        assert!(seeming(4419.0, growing) < seeming(4409.0, at_once));
        assert!(seeming(4419.0, growing) > seeming(4300.0, at_once), "evidence counts");
        // In air both are next to nothing, and their ratio says nothing.
        assert!(seeming(100.0, [1e-6, 1e-3, 0.1]) < 100.02);
    }
}
