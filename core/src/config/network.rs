//! WaterParamPredict in a run: its size, its learning rate, and when it determines the water.

use serde::{Deserialize, Serialize};

/// The initial prediction of the network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NetworkStart {
    /// Near the water parameters from the sparse points, or near `fixed` where the points give no estimate.
    #[default]
    Sparse,
    /// Near `water.start_beta_d`, `water.start_beta_b` and `water.start_b_inf`.
    Fixed,
}

/// WaterParamPredict (SMP-UWGS section 3.2), for `water.prior = network`: predicts the water parameters from
/// the ranges that a view sees. Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// Columns of the depth map that is its input: a multiple of 4, at least 16. Default 96.
    pub width: u32,
    /// Rows of the depth map: a multiple of 4, at least 16. Default 64; the release stretches every view to
    /// 1200 x 800.
    pub height: u32,
    /// Channels of the network: a multiple of 8, from 8 to 256. Default 8; 32 in `paper`. The release has 64.
    /// A training step at 96 x 64 takes 15, 115 and 395 ms of CPU time with 8, 32 and 64 channels
    /// (docs/decisions/0010).
    pub channels: u32,
    /// Learning rate of Adam on the network. Default 1e-3; 1e-4 in `paper`, which states none, where it steps
    /// in every iteration.
    pub learning_rate: f32,
    /// Share of the run after which the mean prediction over the training views becomes the water. Default
    /// 0.25 (SMP-UWGS: 3000 of 12,000). Gradient descent continues from there.
    pub until: f32,
    /// Iterations between two predictions, and from the input view of a prediction to its use. Default 4; 0
    /// in `paper`. A thread computes the prediction in the meantime. 0 predicts in every iteration, as
    /// printed: from the view being rendered, between blending and water. Training then waits for the
    /// prediction. 0 needs `water.medium = per_pixel`.
    pub every: u32,
    /// Initial prediction: `sparse` or `fixed`. Default sparse; fixed in `paper`.
    pub start: NetworkStart,
    /// Whether the loss also moves Gaussians through the depth map, which is differentiable in the paper.
    /// Default false; true in `paper`. Only with `every = 0`: with a delay, the Gaussians of the view have
    /// changed.
    pub depth_gradient: bool,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            width: 96,
            height: 64,
            channels: 8,
            learning_rate: 1e-3,
            until: 0.25,
            every: 4,
            start: NetworkStart::Sparse,
            depth_gradient: false,
        }
    }
}

impl NetworkConfig {
    /// As printed in SMP-UWGS, where the paper states a value.
    pub fn paper() -> Self {
        Self {
            channels: 32,
            learning_rate: 1e-4,
            every: 0,
            start: NetworkStart::Fixed,
            depth_gradient: true,
            ..Self::default()
        }
    }

    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        for (name, side) in [("width", self.width), ("height", self.height)] {
            require(
                side.is_multiple_of(4) && (16..=4096).contains(&side),
                &format!("water.network.{name} must be a multiple of 4, from 16 to 4096"),
            );
        }
        require(
            self.channels.is_multiple_of(8) && (8..=256).contains(&self.channels),
            "water.network.channels must be a multiple of 8, from 8 to 256",
        );
        require(
            self.learning_rate >= 0.0 && self.learning_rate.is_finite(),
            "water.network.learning_rate must be a finite number, 0 or more",
        );
        require(
            self.until > 0.0 && self.until <= 1.0,
            "water.network.until must be a share of the run, above 0 and at most 1",
        );
        require(
            !self.depth_gradient || self.every == 0,
            "water.network.depth_gradient needs water.network.every = 0: the gradient of a delayed prediction belongs to \
             Gaussians that have since moved; set every to 0 or depth_gradient to false",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{JobConfig, Medium, Preset, WaterPrior};

    /// The faults of a configuration with this network instead of the sparse prior.
    fn faults(change: impl Fn(&mut JobConfig)) -> String {
        let mut config = JobConfig::default();
        config.water.prior = WaterPrior::Network;
        change(&mut config);
        config.validate().err().map(|error| error.to_string()).unwrap_or_default()
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        assert_eq!(faults(|_| ()), "");
        let network = |change: fn(&mut NetworkConfig)| faults(|config| change(&mut config.water.network));
        for (error, name) in [
            (network(|n| n.width = 98), "water.network.width"),
            (network(|n| n.height = 12), "water.network.height"),
            (network(|n| n.channels = 12), "water.network.channels"),
            (network(|n| n.channels = 512), "water.network.channels"),
            (network(|n| n.learning_rate = -1.0), "water.network.learning_rate"),
            (network(|n| n.learning_rate = f32::NAN), "water.network.learning_rate"),
            (network(|n| n.until = 0.0), "water.network.until"),
            (network(|n| n.until = f32::NAN), "water.network.until"),
            (network(|n| n.until = 0.7), "must not be after water.freeze_at"),
            (network(|n| n.depth_gradient = true), "set every to 0 or depth_gradient to false"),
        ] {
            assert!(error.contains(name), "{name}: {error}");
        }
        assert_eq!(network(|n| n.every = 0), "");
        let on_gaussians = faults(|config| {
            config.water.medium = Medium::PerGaussian;
            config.water.network.every = 0;
        });
        assert!(on_gaussians.contains("water.medium = \"per_pixel\""), "{on_gaussians}");
    }

    #[test]
    fn rules_for_a_network_do_not_apply_to_other_priors() {
        let sparse = |config: &mut JobConfig| {
            config.water.prior = WaterPrior::Sparse;
            config.water.network.every = 0;
            config.water.network.until = 0.9;
        };
        assert_eq!(faults(sparse), "");
        let in_air = |config: &mut JobConfig| {
            config.water.medium = Medium::None;
            config.water.network.every = 0;
        };
        assert_eq!(faults(in_air), "");
    }

    #[test]
    fn every_preset_holds_and_paper_predicts_as_printed() {
        for preset in [Preset::Fathom, Preset::Paper, Preset::Splatting] {
            assert!(JobConfig::of_preset(preset).validate().is_ok(), "{preset:?}");
        }
        let paper = JobConfig::of_preset(Preset::Paper).water;
        assert_eq!((paper.prior, paper.network.every), (WaterPrior::Network, 0));
        assert!(paper.network.depth_gradient);
        let read = JobConfig::from_json(r#"{"water": {"prior": "network", "network": {"start": "fixed"}}}"#);
        let network = read.map(|config| config.water.network).unwrap_or_default();
        assert_eq!(network, NetworkConfig { start: NetworkStart::Fixed, ..NetworkConfig::default() });
    }
}
