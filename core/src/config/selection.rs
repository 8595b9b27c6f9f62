//! Which cameras a partition trains on besides its own.

use serde::{Deserialize, Serialize};

/// What decides that a camera of another partition is trained on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraSelection {
    /// How much of its picture the extended box covers, by geometry alone (SMP-UWGS eq. 3):
    /// `partition.visibility`.
    #[default]
    Visibility,
    /// How much of its picture shows surfaces of the coarse model that lie in the extended box:
    /// `partition.contribution`. Boxes are tall and mostly empty, and what stands before them hides them, so
    /// this is less than they cover. It is known after the global stage; a plan before that is by visibility.
    Contribution,
}
