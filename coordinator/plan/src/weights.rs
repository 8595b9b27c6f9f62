//! Depth-aware weights of partitions (SMP-UWGS eq. 5 and 6) and their effects on a plan.
//!
//! A weight changes the loss of a partition's run, or how often the global stage samples its views. It
//! changes no iterations and no caps.

use fathom_core::config::{JobConfig, WeightMode, WeightTerms};

use crate::plan::{Layer, Partition};

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
    if partitions.len() < 2 {
        return;
    }
    match config.partition.weights {
        WeightMode::None => {}
        WeightMode::LossFactor => {
            partitions.iter_mut().for_each(|p| p.weighed.loss_factor = p.weight);
        }
        WeightMode::Joint => {
            let views: f64 = partitions.iter().map(|p| p.base_views.len() as f64).sum();
            let sum: f64 = partitions.iter().map(|p| p.weight * p.base_views.len() as f64).sum();
            partitions.iter_mut().for_each(|p| p.weighed.sampling = p.weight * views / sum);
        }
    }
}

#[cfg(test)]
mod tests {
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
}
