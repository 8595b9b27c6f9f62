//! A scene for transfer: poses and cameras, with every file named by its digest.

use serde::{Deserialize, Serialize};

use super::{Camera, Pose};
use crate::{CoreError, Result};

/// A file identified by its content: BLAKE3 in hex and its length.
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
    /// Name in the input; unique, sorted.
    pub name: String,
    /// Which camera took it.
    pub camera_id: u32,
    /// World to camera.
    pub pose: Pose,
    /// The original photograph.
    pub image: BlobRef,
    /// Its mask.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<BlobRef>,
}

/// The description of a scene from which a coordinator plans and a worker fetches files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this layout: 1.
    pub format: u32,
    /// Format of the input.
    pub source: String,
    /// Cameras by ascending id, as in the input; the worker undistorts.
    pub cameras: Vec<Camera>,
    /// Views by ascending name.
    pub views: Vec<ManifestView>,
    /// [`super::Points`] in their binary format.
    pub points: BlobRef,
}

impl Manifest {
    /// The layout version that this program writes and reads.
    pub const FORMAT: u32 = 1;

    /// The JSON text; equal manifests give equal bytes.
    ///
    /// # Errors
    /// When a number is not finite, which JSON cannot represent.
    pub fn to_json(&self) -> Result<Vec<u8>> {
        serde_json::to_vec(self).map_err(|error| CoreError::Scene(format!("manifest: {error}")))
    }

    /// Parses and checks the output of [`Manifest::to_json`], which may be untrusted.
    ///
    /// # Errors
    /// When the JSON has another layout or the manifest contradicts itself.
    pub fn from_json(bytes: &[u8]) -> Result<Self> {
        let manifest: Self = serde_json::from_slice(bytes)
            .map_err(|error| CoreError::Scene(format!("manifest: not of the known layout: {error}")))?;
        manifest.check().map_err(|message| CoreError::Scene(format!("manifest: {message}")))?;
        Ok(manifest)
    }

    fn check(&self) -> Result<(), String> {
        if self.format != Self::FORMAT {
            return Err(format!(
                "its format is {}, this program reads {}; use the same version of fathom everywhere",
                self.format,
                Self::FORMAT
            ));
        }
        if !self.cameras.is_sorted_by(|a, b| a.id < b.id) {
            return Err("cameras are not sorted by unique ids".to_owned());
        }
        for camera in &self.cameras {
            camera.check()?;
        }
        if let Some(pair) = self.views.windows(2).find(|pair| pair[0].name >= pair[1].name) {
            return Err(format!(
                "views are not sorted by unique names: \"{}\" precedes \"{}\"",
                pair[0].name, pair[1].name
            ));
        }
        for view in &self.views {
            super::check_name(&view.name)?;
            if self.camera(view.camera_id).is_none() {
                return Err(format!("view \"{}\" names the unknown camera {}", view.name, view.camera_id));
            }
            if !view.pose.is_sound() {
                return Err(format!(
                    "the pose of view \"{}\" is not finite, not a rotation, or too far from the origin",
                    view.name
                ));
            }
        }
        let blobs = self.views.iter().flat_map(|view| std::iter::once(&view.image).chain(view.mask.as_ref()));
        match blobs.chain(std::iter::once(&self.points)).find(|blob| !blob.is_well_formed()) {
            Some(blob) => Err(format!("\"{}\" is not a BLAKE3 digest of 64 hex digits", blob.digest)),
            None => Ok(()),
        }
    }

    /// The camera with this id.
    pub fn camera(&self, id: u32) -> Option<&Camera> {
        self.cameras.binary_search_by_key(&id, |camera| camera.id).ok().map(|index| &self.cameras[index])
    }
}

impl BlobRef {
    /// The reference of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self { digest: blake3::hash(bytes).to_hex().to_string(), bytes: bytes.len() as u64 }
    }

    /// Whether the digest is 64 lower-case hex digits, because it becomes part of paths.
    pub fn is_well_formed(&self) -> bool {
        self.digest.len() == 64 && self.digest.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
    }
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::scene::CameraModel;

    fn sample() -> Manifest {
        let pose = Pose::from_wxyz([0.9, 0.1, -0.2, 0.3], [1.0 / 3.0, 2.0, -5e-17]);
        let view = |name: &str| ManifestView {
            name: name.to_owned(),
            camera_id: 3,
            pose,
            image: BlobRef::of(name.as_bytes()),
            mask: None,
        };
        Manifest {
            format: Manifest::FORMAT,
            source: "COLMAP binary".to_owned(),
            cameras: vec![Camera {
                id: 3,
                model: CameraModel::SimpleRadial,
                width: 640,
                height: 480,
                params: vec![500.1, 320.0, 240.0, -0.01],
            }],
            views: vec![view("a.jpg"), view("b/c d.jpg")],
            points: BlobRef::of(b""),
        }
    }

    #[test]
    fn a_manifest_survives_json_to_the_last_bit() {
        let bytes = sample().to_json().unwrap();
        let read = Manifest::from_json(&bytes).unwrap();
        assert_eq!(read, sample());
        assert_eq!(read.to_json().unwrap(), bytes);
    }

    #[test]
    fn a_contradictory_manifest_is_refused_with_the_reason() {
        let refused = |change: &dyn Fn(&mut Manifest)| {
            let mut manifest = sample();
            change(&mut manifest);
            Manifest::from_json(&manifest.to_json().unwrap()).unwrap_err().to_string()
        };
        assert!(refused(&|m| m.format = 2).contains("format is 2"));
        assert!(refused(&|m| m.views.reverse()).contains("not sorted"));
        assert!(refused(&|m| m.views[1].name = "a.jpg".into()).contains("not sorted"));
        assert!(refused(&|m| m.views[0].name = "../etc".into()).contains("\"../etc\""));
        assert!(refused(&|m| m.views[0].camera_id = 9).contains("unknown camera 9"));
        assert!(refused(&|m| m.points.digest = "../x".into()).contains("BLAKE3"));
        assert!(refused(&|m| m.cameras[0].params.truncate(2)).contains("2 parameters"));
        assert!(
            refused(&|m| m.views[0].pose.rotation = glam::DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0))
                .contains("pose")
        );
    }
}
