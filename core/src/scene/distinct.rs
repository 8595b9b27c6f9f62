//! The cameras of an input that repeats their intrinsics in every frame: equal ones are one camera.

use std::collections::HashMap;

use super::{Camera, CameraModel};

/// Cameras by ascending id, from 1, in the order in which they came.
#[derive(Default)]
pub(super) struct DistinctCameras {
    cameras: Vec<Camera>,
    /// By all that makes them differ; numbers by their bits. A search through the list would take as long as the square of the
    /// frames where each has a camera of its own.
    ids: HashMap<(CameraModel, u32, u32, Vec<u64>), u32>,
}

impl DistinctCameras {
    /// The id of a camera, which is checked when it is new; its own id does not count.
    pub fn id_of(&mut self, camera: Camera) -> Result<u32, String> {
        // -0 is 0 here.
        let bits = camera.params.iter().map(|value| (value + 0.0).to_bits()).collect();
        let key = (camera.model, camera.width, camera.height, bits);
        if let Some(id) = self.ids.get(&key) {
            return Ok(*id);
        }
        let id = self.cameras.len() as u32 + 1;
        let camera = Camera { id, ..camera };
        camera.check()?;
        self.cameras.push(camera);
        self.ids.insert(key, id);
        Ok(id)
    }

    /// All of them.
    pub fn into_cameras(self) -> Vec<Camera> {
        self.cameras
    }
}
