//! The input of the coordinator's own tasks: the configuration and the scene of a job, and its plan.

use std::collections::BTreeMap;

use fathom_core::config::JobConfig;
use fathom_core::scene::{BlobRef, Manifest};
use fathom_core::views::TrainView;
use fathom_observe::threads;
use fathom_plan::Plan;

use super::OwnTaskError;
use crate::objects::BlobStore;
use crate::schedule::{Artifact, JobRecord};

/// Longest manifest, bytes: half a kB for each of some 500,000 photographs.
pub const MAX_MANIFEST_BYTES: u64 = 256 << 20;

/// A job's configuration, manifest and points.
pub struct JobInput {
    /// Resolved configuration.
    pub config: JobConfig,
    /// The scene.
    pub manifest: Manifest,
}

pub fn config_of(job: &JobRecord) -> Result<JobConfig, OwnTaskError> {
    JobConfig::from_json(&job.config_json)
        .map_err(|e| OwnTaskError::input(format!("the job's configuration: {e}")))
}

impl JobInput {
    /// Reads the input of a job.
    pub async fn read(objects: &BlobStore, job: &JobRecord) -> Result<Self, OwnTaskError> {
        let config = config_of(job)?;
        Self::parse(config, &objects.read_at_most(&job.manifest, MAX_MANIFEST_BYTES).await?)
    }

    /// Parses the bytes of a manifest, which any client may have uploaded.
    pub fn parse(config: JobConfig, manifest: &[u8]) -> Result<Self, OwnTaskError> {
        let manifest = Manifest::from_json(manifest).map_err(|e| OwnTaskError::input(e.to_string()))?;
        Ok(Self { config, manifest })
    }

    /// All views with their undistorted cameras at full size.
    pub fn views(&self) -> Result<Vec<TrainView>, OwnTaskError> {
        let cameras: BTreeMap<u32, _> =
            self.manifest.cameras.iter().map(|camera| (camera.id, camera)).collect();
        let view = |view: &fathom_core::scene::ManifestView| {
            let camera = cameras.get(&view.camera_id).ok_or_else(|| {
                OwnTaskError::input(format!("{}: the manifest has no camera {}", view.name, view.camera_id))
            })?;
            let camera = camera.pinhole().map_err(|e| OwnTaskError::input(format!("{}: {e}", view.name)))?;
            Ok(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 })
        };
        self.manifest.views.iter().map(view).collect()
    }
}

/// An artifact of an earlier stage of the job.
pub fn made(job: &JobRecord, artifact: Artifact) -> Result<&BlobRef, OwnTaskError> {
    job.output(artifact).ok_or_else(|| OwnTaskError::failed(format!("the job has no {}", artifact.title())))
}

/// The plan of a job.
pub async fn read_plan(objects: &BlobStore, job: &JobRecord) -> Result<Plan, OwnTaskError> {
    Plan::from_json(&objects.read(made(job, Artifact::Plan)?).await?).map_err(OwnTaskError::input)
}

/// Runs computations on a thread for blocking work.
pub async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, OwnTaskError> + Send + 'static,
) -> Result<T, OwnTaskError> {
    // Its log lines belong to the task.
    let span = tracing::Span::current();
    match threads::blocking(move || span.in_scope(work)).await {
        Ok(result) => result,
        Err(error) => Err(OwnTaskError::failed(format!("panicked: {error}"))),
    }
}
