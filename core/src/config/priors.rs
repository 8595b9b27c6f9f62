//! The priors for underwater scenes: dark channel and depth smoothness, and when the terms other than the
//! image loss begin.

use serde::{Deserialize, Serialize};

/// The image whose dark channel is pulled towards 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DarkChannelOn {
    /// The rendered picture, as printed: "the estimated radiance". Gaussians and water learn from it.
    #[default]
    Render,
    /// The photograph (SeaSplat): water, range and alpha learn from it, colours do not.
    Photograph,
}

/// Statistical priors in addition to the image loss (SMP-UWGS eq. 12 to 14, 17). They have no effect without
/// a medium, and a prior with weight 0 costs nothing. Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PriorsConfig {
    /// Weight of the dark channel of the direct signal, I - B in linear light (lambda_dcp of eq. 13). Default
    /// 0; 1 in `paper` (SeaSplat; the paper has no value).
    pub dark_channel: f32,
    /// Factor on a negative dark channel relative to a positive one (lambda_neg). Default 1000 (SMP-UWGS eq.
    /// 13, SeaSplat). It is negative where the backscatter exceeds the observed light.
    pub dark_channel_negative: f32,
    /// Side of the square patch that is searched for the darkest pixel, pixels at full picture size; odd, 1
    /// to 255. Default 41 (SMP-UWGS's code). While a run works at half and quarter size, half of this side is
    /// halved with the picture.
    pub dark_channel_patch: u32,
    /// Image whose dark channel counts: `render` (SMP-UWGS eq. 12) or `photograph` (SeaSplat). Default
    /// `render`.
    pub dark_channel_on: DarkChannelOn,
    /// Weight of depth differences between neighbouring pixels, averaged over pixels (lambda_d of eq. 14).
    /// Default 0; 2 in `paper` (SeaSplat; the paper has no value). They weigh less where the photograph has
    /// an edge. Depth is in scene scales.
    pub depth_smoothness: f32,
    /// Share of the run from which the terms of eq. 17 other than the image loss count. Default 0; 0.25 in
    /// `paper` (where its water goes on to the second stage; the paper says "gradually"). These terms are the
    /// priors here, `water.alpha_background` (eq. 15) and `water.l2_weight` (eq. 16).
    pub from: f32,
    /// Share of the run in which they rise linearly from 0 to their weights. Default 0; 0.05 in `paper`
    /// (ours, the paper has no value). 0 applies them in full at once.
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
    /// SMP-UWGS eq. 12 to 14 and 17; each field states the source of its value.
    pub fn paper() -> Self {
        Self { dark_channel: 1.0, depth_smoothness: 2.0, from: 0.25, rise: 0.05, ..Self::default() }
    }

    /// The factor on the weights of the terms other than the image loss, at the share `progress` of the run.
    /// It is 0 up to `from`, and 1 once `rise` has passed after that.
    pub fn share(&self, progress: f32) -> f32 {
        if self.rise > 0.0 {
            ((progress - self.from) / self.rise).clamp(0.0, 1.0)
        } else {
            f32::from(u8::from(progress >= self.from))
        }
    }

    /// Pixels of the patch on each side of its centre, in a picture that was halved `level` times.
    pub fn radius(&self, level: u32) -> u32 {
        (self.dark_channel_patch / 2) >> level.min(31)
    }

    /// Reports every invalid value to `require`, by name.
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
                &format!("water.priors.{name} must be a share of the run, from 0 to 1"),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_0_before_their_start_and_then_rise() {
        let paper = PriorsConfig::paper();
        let shares = [0.0, 0.25, 0.275, 0.3, 1.0].map(|progress| paper.share(progress));
        assert_eq!((shares[0], shares[1], shares[3], shares[4]), (0.0, 0.0, 1.0, 1.0));
        assert!((shares[2] - 0.5).abs() < 1e-5, "{}", shares[2]);
        let at_once = PriorsConfig { from: 0.5, ..PriorsConfig::default() };
        assert_eq!([0.49, 0.5].map(|progress| at_once.share(progress)), [0.0, 1.0]);
        assert_eq!(PriorsConfig::default().share(0.0), 1.0, "by default all terms count from the start");
    }

    #[test]
    fn patch_is_halved_with_the_picture_and_stays_odd() {
        let patches = |side: u32| {
            let config = PriorsConfig { dark_channel_patch: side, ..PriorsConfig::default() };
            [0, 1, 2].map(|level| 2 * config.radius(level) + 1)
        };
        assert_eq!(patches(41), [41, 21, 11]);
        assert_eq!(patches(1), [1, 1, 1]);
    }
}
