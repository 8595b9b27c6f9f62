//! A scene as it travels: poses and cameras, with every file named by its digest.

use serde::{Deserialize, Serialize};

use super::{Camera, Pose};

/// A file by content: BLAKE3 in hex and its length.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlobRef {
    /// BLAKE3 of the content, 64 hex digits.
    pub digest: String,
    /// Length.
    pub bytes: u64,
}

/// One photograph of a [`Manifest`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManifestView {
    /// Name by the input; unique, sorted.
    pub name: String,
    /// Which camera took it.
    pub camera_id: u32,
    /// World to camera.
    pub pose: Pose,
    /// The photograph as the user handed it in.
    pub image: BlobRef,
    /// Its mask.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<BlobRef>,
}

/// What a coordinator plans from and a worker fetches by.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this layout: 1.
    pub format: u32,
    /// What the scene was read from.
    pub source: String,
    /// Cameras by ascending id, as the input gives them; the worker undistorts.
    pub cameras: Vec<Camera>,
    /// Views by ascending name.
    pub views: Vec<ManifestView>,
    /// [`super::Points`] in their binary form.
    pub points: BlobRef,
}
