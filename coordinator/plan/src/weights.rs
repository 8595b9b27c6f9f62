//! Depth-aware weights of partitions (SMP-UWGS eq. 5 and 6) and their effects on a plan.
//!
//! A weight moves work between partitions and adds none: where iterations or caps follow from it, their sums
//! are those of a plan without weights. (The threshold of `classic` has no sum: it rises where a weight is
//! below 1.) Weighted shares are rounded by the largest remainders, so the result is unique.

use fathom_core::config::{JobConfig, Strategy, WeightMode, WeightTerms};

use crate::budget::{MIN_GAUSSIANS, MIN_ITERATIONS};
use crate::plan::{Layer, Partition, Weighed};

/// Sets the weights of all partitions by eq. 5, with depths relative to the largest one of all partitions.
/// The public code divides by a distance from the world's arbitrary origin instead.
pub fn weigh(partitions: &mut [Partition], terms: &WeightTerms) {
    let deepest = partitions.iter().map(|p| p.depth).fold(0.0, f64::max);
    for partition in partitions {
        let depth = if deepest > 0.0 { partition.depth / deepest } else { 0.0 };
        partition.weight = weight(partition.mean_visibility, depth, partition.layer, terms);
    }
}

/// Eq. 5: of a mean visibility and a depth that is a share of the largest one, both 0 to 1.
fn weight(visibility: f64, depth: f64, layer: Layer, terms: &WeightTerms) -> f64 {
    let gamma = match layer {
        Layer::Corner => terms.gamma_corner,
        Layer::Edge => terms.gamma_edge,
        Layer::Inner => terms.gamma_inner,
    };
    let amplified = 1.0 + terms.tau_init * (terms.depth_factor * depth).ln_1p();
    ((visibility + terms.beta) * amplified * gamma).clamp(0.0, terms.clamp)
}

/// Changes runs by their weights as configured, and records the changes in each partition.
pub fn apply(partitions: &mut [Partition], config: &JobConfig) {
    for partition in partitions.iter_mut() {
        partition.weighed = Weighed::nothing(partition.iterations, partition.max_gaussians);
    }
    if partitions.len() < 2 {
        return;
    }
    match config.partition.weights {
        WeightMode::None => {}
        WeightMode::LossFactor => {
            partitions.iter_mut().for_each(|p| p.weighed.loss_factor = p.weight);
        }
        WeightMode::DensityThreshold => match config.train.strategy {
            Strategy::Classic => {
                partitions.iter_mut().for_each(|p| p.weighed.gradient_factor = 1.0 / p.weight);
            }
            Strategy::Mcmc => share_out(partitions, |p| &mut p.max_gaussians, MIN_GAUSSIANS),
        },
        WeightMode::IterationBudget => share_out(partitions, |p| &mut p.iterations, MIN_ITERATIONS),
        WeightMode::Joint => {
            let views: f64 = partitions.iter().map(|p| p.base_views.len() as f64).sum();
            let sum: f64 = partitions.iter().map(|p| p.weight * p.base_views.len() as f64).sum();
            partitions.iter_mut().for_each(|p| p.weighed.sampling = p.weight * views / sum);
        }
    }
}

/// Redistributes the sum of `budget` over the partitions, in proportion to each one's value times its weight.
fn share_out(partitions: &mut [Partition], budget: impl Fn(&mut Partition) -> &mut u32, least: f64) {
    let by: Vec<f64> = partitions.iter_mut().map(|p| p.weight * f64::from(*budget(p))).collect();
    let total = partitions.iter_mut().map(|p| u64::from(*budget(p))).sum();
    for (partition, share) in partitions.iter_mut().zip(apportion(total, &by, least as u64)) {
        *budget(partition) = u32::try_from(share).unwrap_or(u32::MAX);
    }
}

/// Splits `total` into whole parts in proportion to `by` (above 0), each at least `least`. The rest of
/// rounding goes to the largest remainders, among equals to the first. The sum of the parts is `total`,
/// unless that is too little for `least`.
fn apportion(total: u64, by: &[f64], least: u64) -> Vec<u64> {
    // Parts below the minimum get the minimum, and the others share the rest, until no other part falls
    // below.
    let mut fixed = vec![false; by.len()];
    let (mut left, mut sum) = (total as f64, by.iter().sum::<f64>());
    loop {
        let below = |i: &usize| !fixed[*i] && by[*i] / sum * left < least as f64;
        let fallen: Vec<usize> = (0..by.len()).filter(below).collect();
        if fallen.is_empty() {
            break;
        }
        fallen.iter().for_each(|&i| fixed[i] = true);
        left = (left - (fallen.len() as u64 * least) as f64).max(0.0);
        sum = (0..by.len()).filter(|&i| !fixed[i]).map(|i| by[i]).sum();
    }
    let exact = |i: usize| if fixed[i] { least as f64 } else { by[i] / sum * left };
    let mut parts: Vec<u64> = (0..by.len()).map(|i| exact(i).floor() as u64).collect();
    let mut order: Vec<usize> = (0..by.len()).filter(|&i| !fixed[i]).collect();
    order.sort_by(|&a, &b| exact(b).fract().total_cmp(&exact(a).fract()).then(a.cmp(&b)));
    let missing = total.saturating_sub(parts.iter().sum()) as usize;
    order.iter().take(missing).for_each(|&i| parts[i] += 1);
    parts
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_weight_is_that_of_equation_5_by_hand() {
        let terms = WeightTerms::default();
        // (.3 + .01) (1 + .12 ln 1.5) 1.5 = .31 * 1.0486558 * 1.5
        assert!((weight(0.3, 0.5, Layer::Edge, &terms) - 0.487_624_95).abs() < 1e-7);
        // (.1 + .01) (1 + .12 ln 2) 2.0 = .11 * 1.0831777 * 2
        assert!((weight(0.1, 1.0, Layer::Corner, &terms) - 0.238_299_09).abs() < 1e-7);
        // The released code has a factor of 100 on the depth: (.3 + .01) (1 + .12 ln 51) = .31 * 1.4718191
        let released = WeightTerms { depth_factor: 100.0, ..terms.clone() };
        assert!((weight(0.3, 0.5, Layer::Inner, &released) - 0.456_263_92).abs() < 1e-7);
        assert_eq!(weight(0.0, 0.0, Layer::Inner, &terms), 0.01, "never 0");
        assert_eq!(weight(1.0, 1.0, Layer::Corner, &terms), 1.0, "clamped");
        let free = WeightTerms { clamp: 4.0, ..terms };
        // (1 + .01) (1 + .12 ln 2) 2.0 = 1.01 * 1.0831777 * 2
        assert!((weight(1.0, 1.0, Layer::Corner, &free) - 2.188_018_87).abs() < 1e-7);
    }

    #[test]
    fn remainders_go_to_the_largest_and_among_equals_to_the_first() {
        assert_eq!(apportion(10, &[1.0, 1.0, 1.0], 1), [4, 3, 3]);
        assert_eq!(apportion(10, &[1.0, 2.0, 4.0], 1), [1, 3, 6]);
        assert_eq!(apportion(100, &[1e-6, 1.0, 1.0], 16), [16, 42, 42], "the least first");
        assert_eq!(apportion(40, &[1.0, 1.1, 9.0], 16), [16, 16, 16], "too little for the least");
    }

    proptest! {
        #[test]
        fn parts_add_up_to_the_total_and_rise_with_their_shares(
            by in prop::collection::vec(1e-3_f64..10.0, 1..40),
            more in 0_u64..1_000_000,
            least in 1_u64..20,
        ) {
            let total = least * by.len() as u64 + more;
            let parts = apportion(total, &by, least);
            prop_assert_eq!(parts.iter().sum::<u64>(), total);
            prop_assert!(parts.iter().all(|&part| part >= least));
            for i in 0..by.len() {
                for j in 0..by.len() {
                    prop_assert!(by[i] <= by[j] || parts[i] >= parts[j], "{:?} by {:?}", parts, by);
                }
            }
        }
    }
}
