//! Merges equal cameras of inputs that repeat the intrinsics in every frame.

use std::collections::HashMap;

use super::{Camera, CameraModel};

/// Cameras by ascending id, from 1, in the order of their first use.
#[derive(Default)]
pub(super) struct DistinctCameras {
    cameras: Vec<Camera>,
    /// The id for each combination of model, size and parameters (as bits). A search through the list would
    /// take quadratic time if each frame has its own camera.
    ids: HashMap<(CameraModel, u32, u32, Vec<u64>), u32>,
}

impl DistinctCameras {
    /// The id of a camera. A new camera is checked; its own id is ignored.
    pub fn id_of(&mut self, camera: Camera) -> Result<u32, String> {
        // -0 and 0 are equal here.
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

    /// All cameras.
    pub fn into_cameras(self) -> Vec<Camera> {
        self.cameras
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    fn camera(focal: f64, cx: f64) -> Camera {
        Camera { id: 0, model: CameraModel::SimplePinhole, width: 8, height: 6, params: vec![focal, cx, 3.0] }
    }

    #[test]
    fn equal_cameras_are_one_and_impossible_ones_are_refused() {
        let mut cameras = DistinctCameras::default();
        assert_eq!(
            [(5.0, 0.0), (6.0, 0.0), (5.0, -0.0)].map(|(f, cx)| cameras.id_of(camera(f, cx)).ok()),
            [Some(1), Some(2), Some(1)]
        );
        for _ in 0..2 {
            assert!(cameras.id_of(camera(f64::NAN, 0.0)).is_err_and(|fault| fault.contains("camera 3")));
        }
        assert_eq!(cameras.into_cameras().len(), 2);
    }

    #[test]
    fn one_camera_per_frame_does_not_take_quadratic_time() {
        let start = Instant::now();
        let mut cameras = DistinctCameras::default();
        assert!((1..=300_000).all(|frame| cameras.id_of(camera(f64::from(frame), 4.0)) == Ok(frame)));
        // A search through a list would make 4.5e10 comparisons, over a minute; this takes a tenth of a
        // second.
        assert!(start.elapsed() < Duration::from_secs(15), "{:?}", start.elapsed());
    }
}
