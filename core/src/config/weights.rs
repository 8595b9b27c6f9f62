//! The weight of each partition, by its visibility to its cameras and its depth (SMP-UWGS eq. 5 and 6).

use serde::{Deserialize, Serialize};

/// The target of the weight of a partition. The totals of the job (iterations, cap) are the same in every
/// mode. In a job of one partition, weights have no effect.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WeightMode {
    /// Nothing: weights are only reported.
    #[default]
    None,
    /// The weight multiplies the whole loss of a partition's run, as printed. Under Adam this has almost no
    /// effect: a step is a mean gradient over the root of a mean square. Two effects remain. Density control
    /// by `classic` changes, since its gradient threshold is not multiplied. So does the influence of
    /// partitions that train the water jointly on the consensus.
    LossFactor,
    /// The global stage sees a view in proportion to the weight of the view's own partition. On average this
    /// minimises the weighted sum of the paper. A factor on the loss of each view would affect only what
    /// views of several partitions see.
    Joint,
}

/// The terms of eq. 5: `w = (r + beta) (1 + tau_init log(1 + depth_factor d')) gamma`, clamped to 0..`clamp`.
/// d' is the depth of the partition (eq. 6) as a share of that of the deepest one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WeightTerms {
    /// Offset that keeps weights above 0. Default 0.01 (SMP-UWGS eq. 5).
    pub beta: f64,
    /// Strength of the depth term. Default 0.12 (SMP-UWGS's code).
    pub tau_init: f64,
    /// Factor on d' inside the logarithm. Default 1 (SMP-UWGS eq. 5 as printed; its code has 100).
    pub depth_factor: f64,
    /// gamma of partitions that are open on a side of x and a side of z. Default 2.0 (SMP-UWGS eq. 5).
    pub gamma_corner: f64,
    /// gamma of partitions that are open on one axis only. Default 1.5 (SMP-UWGS eq. 5).
    pub gamma_edge: f64,
    /// gamma of all other partitions. Default 1.0 (SMP-UWGS eq. 5).
    pub gamma_inner: f64,
    /// Largest weight. Default 1 (SMP-UWGS section 3.1). Where cameras see boxes that fill half of their
    /// pictures, all partitions except inner ones reach it and have equal weights. Only ratios of weights
    /// matter, except with `loss_factor`, which uses the weight itself.
    pub clamp: f64,
}

impl Default for WeightTerms {
    fn default() -> Self {
        Self {
            beta: 0.01,
            tau_init: 0.12,
            depth_factor: 1.0,
            gamma_corner: 2.0,
            gamma_edge: 1.5,
            gamma_inner: 1.0,
            clamp: 1.0,
        }
    }
}

impl WeightTerms {
    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        for (name, value) in [("tau_init", self.tau_init), ("depth_factor", self.depth_factor)] {
            let fault = format!("partition.weight_terms.{name} must be a finite number, 0 or more");
            require(value >= 0.0 && value.is_finite(), &fault);
        }
        // A weight of 0 would leave a partition without a loss, Gaussians or iterations.
        for (name, value) in [
            ("beta", self.beta),
            ("gamma_corner", self.gamma_corner),
            ("gamma_edge", self.gamma_edge),
            ("gamma_inner", self.gamma_inner),
            ("clamp", self.clamp),
        ] {
            let fault = format!("partition.weight_terms.{name} must be a finite number above 0");
            require(value > 0.0 && value.is_finite(), &fault);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{JobConfig, PartitionConfig};
    use super::*;

    fn refusals(change: impl Fn(&mut PartitionConfig)) -> String {
        let mut config = JobConfig::default();
        change(&mut config.partition);
        config.validate().err().map_or_else(String::new, |error| error.to_string())
    }

    #[test]
    fn modes_are_stored_by_name() {
        for (mode, name) in [
            (WeightMode::None, "\"none\""),
            (WeightMode::LossFactor, "\"loss_factor\""),
            (WeightMode::Joint, "\"joint\""),
        ] {
            assert_eq!(serde_json::to_string(&mode).ok().as_deref(), Some(name));
        }
    }

    #[test]
    fn terms_that_leave_a_partition_with_nothing_are_refused() {
        assert_eq!(refusals(|_| ()), "");
        let refused = refusals(|p| {
            p.weight_terms =
                WeightTerms { beta: 0.0, tau_init: -1.0, gamma_edge: f64::NAN, ..p.weight_terms.clone() };
        });
        for name in ["weight_terms.beta", "weight_terms.tau_init", "weight_terms.gamma_edge"] {
            assert!(refused.contains(name), "{name} is missing in {refused}");
        }
        assert!(!refused.contains("gamma_corner"), "{refused}");
    }
}
