//! The cameras that a partition trains on in addition to its own.

use serde::{Deserialize, Serialize};

/// The criterion by which a partition trains on a camera of another partition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraSelection {
    /// The share of its picture that the extended box covers, by geometry alone (SMP-UWGS eq. 3):
    /// `partition.visibility`.
    #[default]
    Visibility,
    /// The share of its picture that shows surfaces of the coarse model in the extended box:
    /// `partition.contribution`. It is less than the box covers: boxes are tall and mostly empty, and objects
    /// in front hide them. It is known only after the global stage; an earlier plan uses visibility.
    Contribution,
}
