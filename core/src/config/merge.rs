//! The merge: when Gaussians of two partitions that modelled the same surface are duplicates (SMP-UWGS eq.
//! 4).

use serde::{Deserialize, Serialize};

/// Near-duplicates across the borders of cells, and how they are detected.
///
/// Cropping leaves every place to one partition. A duplicate is therefore one piece of surface that both
/// partitions have, with one centre on each side of their border. SMP-UWGS writes `Unique` (eq. 4). Its code
/// removes Gaussians with exactly the same centre; after cropping there are none. Here, two Gaussians of
/// different partitions are duplicates when all of the bounds below hold, and the more transparent one is
/// removed. Every bound is relative to the sizes of the two Gaussians, so none depends on the scene's unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MergeConfig {
    /// Whether near-duplicates across borders are removed. Default true (SMP-UWGS eq. 4).
    pub duplicates: bool,
    /// Largest distance of a duplicate from the border, as a share of the partition's trained margin beyond
    /// the border. Default 0.25 (ours). 0 removes none. Farther out, the neighbour's copy is at the end of
    /// its own margin. Without training beyond borders (`partition.extend_base` 0) there are no duplicates to
    /// remove.
    pub band: f64,
    /// Largest distance between the centres, in standard deviations. Default 0.5 (ours). The deviation is
    /// that of the mean of both covariances along the line between the centres. Neighbours on one surface are
    /// farther apart.
    pub centre: f64,
    /// Largest ratio of the widths of the two Gaussians in any direction. Default 1.5 (ours). This bounds
    /// size and orientation together. It uses covariances, since many quaternions give the same Gaussian.
    pub width: f64,
    /// Widening of both Gaussians on all axes before the comparison, as a share of their own largest
    /// deviation. Default 0.1 (ours). It is added as a variance. Without it, flat Gaussians would never
    /// match.
    pub thickness: f64,
    /// Largest difference of the constant colours in any channel, where 1 is white. Default 0.1 (ours).
    /// Higher harmonics do not count.
    pub colour: f64,
    /// Memory for the Gaussians near borders, MiB. Default 256: 2.3 million of them. If they need more, the
    /// merge works region by region and rereads the Gaussians near borders for each. The result is the same.
    pub memory_mib: u32,
}

impl Default for MergeConfig {
    fn default() -> Self {
        Self {
            duplicates: true,
            band: 0.25,
            centre: 0.5,
            width: 1.5,
            thickness: 0.1,
            colour: 0.1,
            memory_mib: 256,
        }
    }
}

impl MergeConfig {
    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        require((0.0..=1.0).contains(&self.band), "merge.band must be a share of the extension, from 0 to 1");
        require(
            self.centre > 0.0 && self.centre <= 4.0,
            "merge.centre must be above 0 and at most 4 standard deviations",
        );
        require(self.width > 1.0 && self.width <= 8.0, "merge.width must be a ratio above 1 and at most 8");
        require((1e-3..=1.0).contains(&self.thickness), "merge.thickness must be between 0.001 and 1");
        require(self.colour > 0.0 && self.colour <= 1.0, "merge.colour must be above 0 and at most 1");
        require(self.memory_mib >= 1, "merge.memory_mib must be at least 1");
    }
}
