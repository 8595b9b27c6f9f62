//! Where a result is measured for seams between cells (`core::seams`).

use serde::{Deserialize, Serialize};

/// The band along the borders of cells in which PSNR and SSIM are measured apart. Changes no model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SeamsConfig {
    /// How far the band reaches on either side of a border, as a share of the usual viewing distance. Default
    /// 0.05, of our own: seen from that distance it is about a twentieth of a picture's width, at 240 pixels
    /// as wide as the window of SSIM reaches and three deviations of the Gaussians that are common there;
    /// what a cut breaks is nearer.
    pub band: f64,
    /// A view counts in the means when its band, and what lies beside it, have each at least this share of
    /// the picture. Default 0.01, of our own: 400 pixels of 240 x 180. A few pixels would count as much as a
    /// whole picture.
    pub least_share: f64,
}

impl Default for SeamsConfig {
    fn default() -> Self {
        Self { band: 0.05, least_share: 0.01 }
    }
}

impl SeamsConfig {
    /// Tells `require` of every value that cannot be, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        require(
            self.band > 0.0 && self.band <= 1.0,
            "seams.band is a share of the viewing distance: above 0 and at most 1",
        );
        require(
            (0.0..0.5).contains(&self.least_share),
            "seams.least_share is a share of a picture: 0 or more and below 0.5",
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
