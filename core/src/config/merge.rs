//! The merge: what counts as one Gaussian where two partitions modelled the same surface (SMP-UWGS eq. 4).

use serde::{Deserialize, Serialize};

/// Near-duplicates across the borders of cells, and how they are told.
///
/// Cropping leaves every place to one partition, so a duplicate is one piece of surface that both have, with
/// one centre on either side of their border. SMP-UWGS writes `Unique` (eq. 4) and its code removes what has
/// exactly the same centre, which after cropping is nothing. Two Gaussians of different partitions count as
/// one when all of the bounds below hold; the more transparent one goes. Every bound is relative to the two
/// Gaussians' own sizes, so none depends on the scene's unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MergeConfig {
    /// Whether near-duplicates across borders are removed. Default true (SMP-UWGS eq. 4).
    pub duplicates: bool,
    /// Greatest distance of a duplicate from the border, as a share of how far its partition was trained
    /// beyond the border. Default 0.25 (ours): beyond, the neighbour's copy is at the end of its own margin.
    /// 0 removes none, and where nothing is trained beyond borders (`partition.extend_base` 0) there is
    /// nothing to remove.
    pub band: f64,
    /// Greatest distance between the centres, in standard deviations along the line between them, of the mean
    /// of both covariances. Default 0.5 (ours): neighbours of one surface stand further apart.
    pub centre: f64,
    /// In no direction may one be more than so many times as wide as the other: size and orientation in one
    /// bound, on covariances, since many quaternions give the same Gaussian. Default 1.5 (ours).
    pub width: f64,
    /// Before they are compared, both are widened on all axes by this share of their own largest deviation
    /// (as variances add), or flat Gaussians would never agree. Default 0.1 (ours).
    pub thickness: f64,
    /// Greatest difference of a channel of the constant colours, where 1 is white. Higher harmonics do not
    /// count. Default 0.1 (ours).
    pub colour: f64,
    /// Memory for the Gaussians near borders, MiB. Where they take more, the merge goes region by region and
    /// reads what lies near borders once more for each; the result is the same. Default 256: 2.3 million of
    /// them.
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
    /// Tells `require` of what makes no sense.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        require((0.0..=1.0).contains(&self.band), "merge.band is a share of the extension: 0 to 1");
        require(
            self.centre > 0.0 && self.centre <= 4.0,
            "merge.centre must be above 0 and at most 4 deviations",
        );
        require(
            self.width > 1.0 && self.width <= 8.0,
            "merge.width must be above 1 (equal) and at most 8 times",
        );
        require((1e-3..=1.0).contains(&self.thickness), "merge.thickness must be between 0.001 and 1");
        require(self.colour > 0.0 && self.colour <= 1.0, "merge.colour must be above 0 and at most 1");
        require(self.memory_mib >= 1, "merge.memory_mib must be at least 1");
    }
}
