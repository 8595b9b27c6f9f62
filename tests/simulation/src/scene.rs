//! The scene of all jobs: flat, small, fast to plan and merge.

use fathom_core::config::{JobConfig, WaterPartitions};
use fathom_core::picture::encode_png;
use fathom_core::scene::{BlobRef, Camera, CameraModel, Manifest, ManifestView, Points, Pose};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Views of the scene, on a grid of 4 by 3.
const VIEWS: u32 = 12;
/// Points along a side.
const SIDE: usize = 8;

/// A client's scene before the upload.
pub struct Scene {
    /// The uploaded files, the manifest last.
    pub blobs: Vec<Vec<u8>>,
    /// The manifest.
    pub manifest: BlobRef,
}

/// Digest and length.
pub fn blob_ref(bytes: &[u8]) -> BlobRef {
    BlobRef { digest: blake3::hash(bytes).to_hex().to_string(), bytes: bytes.len() as u64 }
}

/// The scene.
pub fn scene() -> Scene {
    let mut blobs = Vec::new();
    let mut add = |bytes: Vec<u8>| {
        let blob = blob_ref(&bytes);
        blobs.push(bytes);
        blob
    };
    let mut points = Points::default();
    for index in 0..SIDE * SIDE {
        let (x, z) = ((index % SIDE) as f32, (index / SIDE) as f32);
        points.positions.push([1.2 * x - 4.2, (index % 3) as f32 * 0.1, 1.2 * z - 4.2]);
        points.colours.push([120, 130, 140]);
    }
    let mut views = Vec::new();
    for index in 0..VIEWS {
        let (column, row) = (f64::from(index % 4), f64::from(index / 4));
        // Rows are offset, so that only one camera is on the border of a cell.
        let eye = DVec3::new(column * 3.0 - 4.5 + row * 0.1, -6.0, row * 3.0 - 3.0);
        let picture = encode_png(16, 12, &[100 + index as u8; 16 * 12 * 3]).expect("a picture of 16 by 12");
        views.push(ManifestView {
            name: format!("view_{index:02}.png"),
            camera_id: 1,
            pose: Pose::looking_at(eye, eye + DVec3::new(0.0, 1.0, 0.6), DVec3::Y),
            image: add(picture),
            mask: None,
        });
    }
    let params = vec![12.5, 12.5, 8.0, 6.0];
    let cameras = vec![Camera { id: 1, model: CameraModel::Pinhole, width: 16, height: 12, params }];
    let points = add(points.to_bytes());
    let manifest = Manifest { format: 1, source: "simulation".into(), cameras, views, points };
    let manifest = add(serde_json::to_vec(&manifest).expect("a manifest as JSON"));
    Scene { blobs, manifest }
}

/// Additional stages of a job; only with several partitions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Variety {
    /// None.
    Plain,
    /// Cameras are chosen after the global stage; partitions refine the water and agree on one.
    Water,
    /// Borders are trained after the merge.
    Borders,
}

/// The configuration of a job with this many partitions.
pub fn config(partitions: u32, variety: Variety) -> JobConfig {
    let mut config = JobConfig::default();
    config.partition.columns = partitions;
    config.data.test_every = 6;
    config.train.iterations = 120;
    // Where a job has several partitions, several tasks evaluate.
    config.partition.evaluation_views = 1;
    match variety {
        Variety::Plain => {}
        Variety::Water => config.water.partitions = WaterPartitions::Joint,
        Variety::Borders => config.borders.enabled = true,
    }
    config
}

/// Identifies a kind of job: a digest of its configuration.
pub fn kind_of(config_json: &str) -> String {
    blake3::hash(config_json.as_bytes()).to_hex()[..16].to_owned()
}
