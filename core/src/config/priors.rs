//! The priors on what is under water: dark channel and depth smoothness, and when the terms beside the
//! picture's begin.

use serde::{Deserialize, Serialize};

/// Whose dark channel is drawn to 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DarkChannelOn {
    /// That of the picture that was rendered, as printed: "the estimated radiance". Gaussians and water learn
    /// from it.
    #[default]
    Render,
    /// That of the photograph (SeaSplat): water, range and alpha learn from it, colours do not.
    Photograph,
}

/// Statistical priors beside the loss of the picture (SMP-UWGS eq. 12 to 14, 17); nothing without a water,
/// and what has the weight 0 costs nothing. Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PriorsConfig {
    /// Weight of the dark channel of the direct signal, I - B in linear light (lambda_dcp of eq. 13). Default
    /// 0; 1 in `paper` (SeaSplat; the paper has no value).
    pub dark_channel: f32,
    /// What a negative dark channel, water that takes away more than there is, weighs beside a positive one
    /// (lambda_neg). Default 1000 (SMP-UWGS eq. 13, SeaSplat).
    pub dark_channel_negative: f32,
    /// Side of the square patch in which the darkest pixel is sought, pixels of a picture at full size; odd,
    /// 1 to 255. Half its side is halved with the picture while a run works at half and quarter size. Default
    /// 41 (SMP-UWGS's code).
    pub dark_channel_patch: u32,
    /// Whose dark channel it is: `render` (SMP-UWGS eq. 12) or `photograph` (SeaSplat). Default `render`.
    pub dark_channel_on: DarkChannelOn,
    /// Weight of differences of depth between neighbouring pixels, less where the photograph has an edge
    /// (lambda_d of eq. 14), as a mean over pixels; depth counts in the usual viewing distance. Default 0; 2
    /// in `paper` (SeaSplat; the paper has no value).
    pub depth_smoothness: f32,
    /// Share of the run from which the terms of eq. 17 beside the picture's count: the priors here,
    /// `water.alpha_background` (eq. 15) and `water.l2_weight` (eq. 16). Default 0; 0.25 in `paper` (where
    /// its water goes on to the second stage; the paper says "gradually").
    pub from: f32,
    /// Share of the run in which they rise from 0 to their weights, linearly. Default 0: at once; 0.05 in
    /// `paper` (ours, the paper has no value).
    pub rise: f32,
}

impl Default for PriorsConfig {
    fn default() -> Self {
        Self {
            dark_channel: 0.0,
            dark_channel_negative: 1000.0,
            dark_channel_patch: 41,
            dark_channel_on: DarkChannelOn::Render,
            depth_smoothness: 0.0,
            from: 0.0,
            rise: 0.0,
        }
    }
}

impl PriorsConfig {
    /// SMP-UWGS eq. 12 to 14 and 17; where its values come from stands at each.
    pub fn paper() -> Self {
        Self { dark_channel: 1.0, depth_smoothness: 2.0, from: 0.25, rise: 0.05, ..Self::default() }
    }

    /// What the weights of the terms beside the picture's are multiplied by where the share `progress` of the
    /// run is done: 0 up to `from`, 1 after `rise` more.
    pub fn share(&self, progress: f32) -> f32 {
        if self.rise > 0.0 {
            ((progress - self.from) / self.rise).clamp(0.0, 1.0)
        } else {
            f32::from(u8::from(progress >= self.from))
        }
    }

    /// Pixels of the patch on either side of its centre, in a picture that was halved `level` times.
    pub fn radius(&self, level: u32) -> u32 {
        (self.dark_channel_patch / 2) >> level.min(31)
    }

    /// Tells `require` of every value that cannot be, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        for (name, value) in [
            ("dark_channel", self.dark_channel),
            ("dark_channel_negative", self.dark_channel_negative),
            ("depth_smoothness", self.depth_smoothness),
        ] {
            require(
                value >= 0.0 && value.is_finite(),
                &format!("water.priors.{name} must be a finite number, 0 or more"),
            );
        }
        require(
            self.dark_channel_patch <= 255 && !self.dark_channel_patch.is_multiple_of(2),
            "water.priors.dark_channel_patch must be an odd number of pixels, 1 to 255",
        );
        for (name, share) in [("from", self.from), ("rise", self.rise)] {
            require(
                (0.0..=1.0).contains(&share),
                &format!("water.priors.{name} is a share of the run: 0 to 1"),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_nothing_before_their_part_of_the_run_and_rise_to_the_whole() {
        let paper = PriorsConfig::paper();
        let shares = [0.0, 0.25, 0.275, 0.3, 1.0].map(|progress| paper.share(progress));
        assert_eq!((shares[0], shares[1], shares[3], shares[4]), (0.0, 0.0, 1.0, 1.0));
        assert!((shares[2] - 0.5).abs() < 1e-5, "{}", shares[2]);
        let at_once = PriorsConfig { from: 0.5, ..PriorsConfig::default() };
        assert_eq!([0.49, 0.5].map(|progress| at_once.share(progress)), [0.0, 1.0]);
        assert_eq!(PriorsConfig::default().share(0.0), 1.0, "by default all terms count from the start");
    }

    #[test]
    fn a_patch_is_halved_with_the_picture_and_stays_odd() {
        let patches = |side: u32| {
            let config = PriorsConfig { dark_channel_patch: side, ..PriorsConfig::default() };
            [0, 1, 2].map(|level| 2 * config.radius(level) + 1)
        };
        assert_eq!(patches(41), [41, 21, 11]);
        assert_eq!(patches(1), [1, 1, 1]);
    }
}
