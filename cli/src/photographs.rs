//! The photographs of a scene as training sees them: undistorted, masked, at most so large.

use std::path::PathBuf;

use fathom_core::config::DataConfig;
use fathom_core::picture::{self, Photograph};
use fathom_core::scene::{PinholeCamera, Pose, Scene, View};
use fathom_core::views::PackedImage;

use crate::error::{CliError, Result};

/// The photograph of a view as training sees it.
pub fn load_photograph(
    scene: &Scene,
    view: &View,
    config: &DataConfig,
) -> Result<(PinholeCamera, PackedImage)> {
    let path = view.image.as_ref().ok_or_else(|| missing(scene, view, "photograph"))?;
    prepared(scene, view, (path, view.mask.as_ref()), config)
}

/// The error of a view that lacks a part.
pub fn missing(scene: &Scene, view: &View, what: &str) -> CliError {
    CliError::Message(format!("{}: view {} has no {what}", scene.root.display(), view.name))
}

/// A picture and its mask by the camera of a view, as training would see them.
pub fn prepared(
    scene: &Scene,
    view: &View,
    (path, mask): (&PathBuf, Option<&PathBuf>),
    config: &DataConfig,
) -> Result<(PinholeCamera, PackedImage)> {
    let read = |path: &PathBuf| std::fs::read(path).map_err(CliError::io("read", path));
    let camera = scene.camera(view.camera_id).ok_or_else(|| missing(scene, view, "camera"))?;
    let image = read(path)?;
    let mask = mask.map(read).transpose()?;
    let name = path.to_string_lossy();
    let photograph = Photograph { name: &name, image: &image, mask: mask.as_deref() };
    Ok(picture::prepare(&photograph, camera, config.mask_keep, config.max_resolution)?)
}

/// Cameras and poses of all views by name, at the size of the measured pictures.
pub fn all_cameras(scene: &Scene, config: &DataConfig) -> Result<Vec<(PinholeCamera, Pose)>> {
    let camera = |view: &View| {
        let camera = scene.camera(view.camera_id).ok_or_else(|| missing(scene, view, "camera"))?;
        Ok((picture::prepared_camera(camera, config.max_resolution)?, view.pose))
    };
    scene.views.iter().map(camera).collect()
}
