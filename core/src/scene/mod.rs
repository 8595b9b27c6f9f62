//! Reads scenes: cameras, poses, sparse points and the paths of the pictures.
//!
//! [`load_scene`] detects the format of a folder or file, reads it, and checks everything that can be checked
//! without decoding a picture. Readers only read; `assemble` holds the rules that all inputs share.

mod assemble;
mod bytes;
mod camera;
mod cameras_json;
mod colmap;
mod colmap_binary;
mod colmap_text;
mod distinct;
mod files;
mod manifest;
mod nerfstudio;
mod orbit;
mod path;
mod point_cloud;
mod points;
mod real;
mod tracks;
mod undistort;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use camera::{Camera, CameraModel, PinholeCamera, Pose};
pub use manifest::{BlobRef, Manifest, ManifestView};
pub use orbit::Orbit;
pub use path::CameraPath;
pub use points::{extent, learning_scale, viewing_distance};
pub use real::real_scene_for_test;
pub use tracks::{Place, Tracks};
pub(crate) use undistort::Undistortion;

use crate::config::DataConfig;
use crate::{CoreError, Result};
use files::check_name;

/// The purpose for which a scene is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// To inspect: photographs and points may be missing, and faults that training refuses are warnings.
    Inspect,
    /// To measure a model: every view that remains has its photograph, of the size of its camera.
    Measure,
    /// To train: as [`Purpose::Measure`], with points and with views that are not held out.
    Train,
}

/// Reads the scene at `path`: a COLMAP folder or model, a folder with `transforms.json` or `cameras.json`, or
/// one of these two files itself. If a folder has several, COLMAP precedes nerfstudio, and nerfstudio 3DGS.
///
/// Of the pictures only the headers are read. [`Scene::warnings`] states what was left out or chosen.
///
/// # Errors
/// [`CoreError::Input`] with the file, the place in it, the fault and the remedy.
pub fn load_scene(path: &Path, purpose: Purpose, options: &DataConfig) -> Result<Scene> {
    let root = std::fs::canonicalize(path).map_err(CoreError::io("read", path))?;
    let draft = match root.is_file() {
        true => read_file(&root, purpose)?,
        false => read_folder(&root, purpose, Reach::Anywhere)?,
    };
    assemble::assemble(draft, purpose, options)
}

/// Reads the scene in the folder `root` for training, where its files come from somebody else. A path in them
/// that leaves the folder is refused before anything is read there. The folder must have no links.
///
/// # Errors
/// As [`load_scene`].
pub fn load_foreign_scene(root: &Path, options: &DataConfig) -> Result<Scene> {
    let root = std::fs::canonicalize(root).map_err(CoreError::io("read", root))?;
    let draft = read_folder(&root, Purpose::Train, Reach::Inside)?;
    assemble::assemble(draft, Purpose::Train, options)
}

/// Where the files of a scene may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reach {
    /// Where its owner says: the process reads with the owner's rights.
    Anywhere,
    /// In the folder of the scene.
    Inside,
}

fn read_file(file: &Path, purpose: Purpose) -> Result<assemble::Draft> {
    // 3DGS writes a list, nerfstudio an object.
    let bytes = std::fs::read(file).map_err(CoreError::io("read", file))?;
    match bytes.iter().find(|byte| !byte.is_ascii_whitespace()) {
        Some(b'[') => cameras_json::read(file, file, purpose),
        Some(b'{') => nerfstudio::read(file, file, purpose, Reach::Anywhere),
        _ if bytes.starts_with(b"ply") => Err(CoreError::input(
            file,
            "is a PLY; a scene consists of photographs or cameras; use models with `fathom render` and `fathom eval`",
        )),
        _ => Err(CoreError::input(
            file,
            "is neither a transforms.json nor a cameras.json; for COLMAP, give the folder that holds images/ and sparse/",
        )),
    }
}

fn read_folder(root: &Path, purpose: Purpose, reach: Reach) -> Result<assemble::Draft> {
    let models = colmap::find_models(root)?;
    let json = |name: &str| Some(root.join(name)).filter(|file| file.is_file());
    let transforms = json("transforms.json").or_else(|| json("transforms_train.json"));
    if !models.is_empty() {
        let mut draft = colmap::read(root, &models, purpose, reach)?;
        if let Some(file) = transforms {
            draft.warnings.push(format!(
                "using the COLMAP model, not {}; give that file itself to use it",
                file.display()
            ));
        }
        return Ok(draft);
    }
    if let Some(file) = transforms {
        return nerfstudio::read(root, &file, purpose, reach);
    }
    if let Some(file) = json("cameras.json") {
        return cameras_json::read(root, &file, purpose);
    }
    Err(CoreError::input(
        root,
        "holds no scene: expected a COLMAP model (sparse/0/cameras.bin or .txt), a transforms.json or a cameras.json",
    ))
}

/// Sparse points of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Points {
    /// Positions, scene units, world axes.
    pub positions: Vec<[f32; 3]>,
    /// sRGB colours.
    pub colours: Vec<[u8; 3]>,
    /// The views that see each point, if the input has tracks.
    #[serde(default)]
    pub tracks: Tracks,
}

/// One photograph: its camera, its pose and its files.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Name in the input, with `/` between folders; unique.
    pub name: String,
    /// Its index in the list of the input, from 0. For COLMAP models it is the index by name, because their
    /// ids carry no order.
    pub listed_at: u32,
    /// Which camera took it.
    pub camera_id: u32,
    /// World to camera.
    pub pose: Pose,
    /// The photograph; `None` if it is missing.
    pub image: Option<PathBuf>,
    /// Its mask.
    pub mask: Option<PathBuf>,
}

/// A scene. Views are sorted by name; no picture is loaded.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Its format: "COLMAP binary", "COLMAP text", "nerfstudio", "cameras.json".
    pub source: &'static str,
    /// The folder or file that was given.
    pub root: PathBuf,
    /// Cameras by ascending id.
    pub cameras: Vec<Camera>,
    /// Views by ascending name.
    pub views: Vec<View>,
    /// Sparse points; may be empty if only poses are needed.
    pub points: Points,
    /// Warnings for the user about skipped, missing and chosen inputs.
    pub warnings: Vec<String>,
}

impl Scene {
    /// The camera with this id.
    pub fn camera(&self, id: u32) -> Option<&Camera> {
        self.cameras.binary_search_by_key(&id, |camera| camera.id).ok().map(|index| &self.cameras[index])
    }

    /// [`extent`] over all views, scene units.
    pub fn extent(&self) -> f64 {
        extent(&self.views.iter().map(|view| view.pose.centre()).collect::<Vec<_>>())
    }

    /// [`viewing_distance`] over the views whose camera can be undistorted.
    pub fn viewing_distance(&self) -> Option<f64> {
        let of_view = |view: &View| Some((self.camera(view.camera_id)?.pinhole().ok()?, view.pose));
        viewing_distance(&self.views.iter().filter_map(of_view).collect::<Vec<_>>(), &self.points)
    }
}

#[cfg(test)]
mod tests;
