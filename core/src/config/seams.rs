//! The measurement of seams between cells (`core::seams`).

use serde::{Deserialize, Serialize};

/// The band along the borders of cells in which PSNR and SSIM are measured separately. Does not change the
/// model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SeamsConfig {
    /// Width of the band on each side of a border, as a share of the scene scale. Default 0.05 (ours). Seen
    /// from that distance, it is about a twentieth of a picture's width. At 240 pixels, this equals the reach
    /// of the SSIM window and three deviations of the common Gaussians there. Seam errors are nearer to the
    /// border.
    pub band: f64,
    /// Smallest share of the picture at which a view counts in the means, for its band and for the area
    /// beside it. Default 0.01 (ours: 400 pixels of 240 x 180). With less, a few pixels would count as much
    /// as a whole picture.
    pub least_share: f64,
}

impl Default for SeamsConfig {
    fn default() -> Self {
        Self { band: 0.05, least_share: 0.01 }
    }
}

impl SeamsConfig {
    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        require(
            self.band > 0.0 && self.band <= 1.0,
            "seams.band must be a share of the scene scale, above 0 and at most 1",
        );
        require(
            (0.0..0.5).contains(&self.least_share),
            "seams.least_share must be a share of a picture, at least 0 and below 0.5",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::super::JobConfig;

    #[test]
    fn bands_that_measure_nothing_are_refused_by_name() {
        let faults = |band: f64, least_share: f64| {
            let mut config = JobConfig::default();
            (config.seams.band, config.seams.least_share) = (band, least_share);
            config.validate().err().map(|error| error.to_string()).unwrap_or_default()
        };
        assert_eq!(faults(0.05, 0.0), "");
        assert!(faults(0.0, 0.01).contains("seams.band"));
        assert!(faults(f64::NAN, 0.01).contains("seams.band"));
        assert!(faults(0.05, 0.5).contains("seams.least_share"));
    }
}
