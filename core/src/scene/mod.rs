//! Scenes as they come in: cameras, poses, sparse points and where the pictures are.

mod camera;
mod manifest;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use camera::{Camera, CameraModel, PinholeCamera, Pose};
pub use manifest::{BlobRef, Manifest, ManifestView};

/// Sparse points of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Points {
    /// Positions, scene units, world axes.
    pub positions: Vec<[f32; 3]>,
    /// sRGB colours.
    pub colours: Vec<[u8; 3]>,
}

/// One photograph: its camera, its pose and its files.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Name by the input, with `/` between folders; unique.
    pub name: String,
    /// Which camera took it.
    pub camera_id: u32,
    /// World to camera.
    pub pose: Pose,
    /// The photograph; `None` where a scene has poses only.
    pub image: Option<PathBuf>,
    /// Its mask.
    pub mask: Option<PathBuf>,
}

/// A scene that was read. Views are sorted by name; nothing of the pictures is loaded.
#[derive(Clone, Debug)]
pub struct Scene {
    /// What it was read from: "COLMAP binary", "COLMAP text", "nerfstudio", "cameras.json".
    pub source: &'static str,
    /// The folder or file that was given.
    pub root: PathBuf,
    /// Cameras by ascending id.
    pub cameras: Vec<Camera>,
    /// Views by ascending name.
    pub views: Vec<View>,
    /// Sparse points; may be empty where only poses are needed.
    pub points: Points,
    /// What the user should know: skipped, missing, chosen.
    pub warnings: Vec<String>,
}
