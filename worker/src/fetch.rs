//! Fetches the inputs of a task to this machine.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::config::JobConfig;
use fathom_core::exchange::Exchange;
use fathom_core::scene::{BlobRef, Manifest};
use fathom_observe::threads;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::task_spec::Work;
use futures::stream::{StreamExt, TryStreamExt};
use prost::Message;

use crate::WorkerError;
use crate::blobs::{BlobClient, from_proto};
use crate::cache::BlobCache;
use crate::execute::{SPEC_FORMAT, TaskError, TaskInput};

/// Blobs fetched at the same time.
const FETCHES_AT_ONCE: usize = 4;

/// Fetches for the tasks of one job.
pub struct Fetch<'a> {
    /// The blob cache.
    pub cache: &'a BlobCache,
    /// The source of the blobs.
    pub blobs: BlobClient,
}

impl Fetch<'_> {
    /// Fetches all inputs of a task.
    pub async fn everything(&self, assignment: &v1::Assignment) -> Result<TaskInput, TaskError> {
        let manifest = self.read(&assignment.manifest, "manifest").await?;
        let manifest = Manifest::from_json(&manifest).map_err(|e| TaskError::protocol(e.to_string()))?;
        let config = JobConfig::from_json(&assignment.config_json).map_err(|e| {
            let message = format!("the job's configuration: {e}; use the same version on all machines");
            TaskError::Failed { class: v1::FailClass::Environment, message }
        })?;
        let spec = self.read(&assignment.spec, "spec").await?;
        let spec = v1::TaskSpec::decode(spec)
            .map_err(|e| TaskError::protocol(format!("a spec that cannot be read: {e}")))?;
        let v1::TaskSpec { format: SPEC_FORMAT, common: Some(common), work: Some(work) } = spec else {
            return Err(TaskError::protocol(
                "a spec of work that this worker does not know; use the same version on all machines".into(),
            ));
        };

        let mut wanted: BTreeMap<String, BlobRef> = BTreeMap::new();
        let mut want = |blob: &BlobRef| drop(wanted.insert(blob.digest.clone(), blob.clone()));
        for view in common
            .views
            .iter()
            .chain(&common.held_out)
            .filter_map(|&index| manifest.views.get(index as usize))
        {
            want(&view.image);
            view.mask.iter().for_each(&mut want);
        }
        // Points initialise runs, mark the end of the scene under water, and serve as a reference for
        // measurements.
        want(&manifest.points);
        let mut files: HashMap<String, PathBuf> = futures::stream::iter(wanted.into_values())
            .map(|blob| async move {
                let path = self.cache.fetch(&self.blobs, &blob).await?;
                Ok::<_, WorkerError>((blob.digest, path))
            })
            .buffer_unordered(FETCHES_AT_ONCE)
            .try_collect()
            .await
            .map_err(TaskError::environment)?;
        self.fetch_previewed(&manifest, &common, &config, &mut files).await;
        let mut inputs = HashMap::new();
        for input in &assignment.inputs {
            inputs.extend(self.fetch_some(&input.blob).await?.map(|path| (input.artifact(), path)));
        }
        let state = match inputs.get(&v1::Artifact::FirstPart) {
            Some(path) => {
                let first_part = v1::FirstPartResult::decode(self.read_file(path).await?)
                    .map_err(|e| TaskError::protocol(format!("a first part that cannot be read: {e}")))?;
                self.fetch_some(&first_part.state).await?
            }
            None => None,
        };
        let neighbours = match (inputs.get(&v1::Artifact::Exchange), &work) {
            (Some(path), Work::Partition(spec)) => self.fetch_neighbours(path, spec).await?,
            _ => Vec::new(),
        };
        let checkpoint = self.fetch_checkpoint(assignment).await?;
        Ok(TaskInput {
            stage: assignment.stage(),
            config,
            manifest,
            common,
            work,
            inputs,
            state,
            neighbours,
            checkpoint_iteration: if checkpoint.is_some() { assignment.checkpoint_iteration } else { 0 },
            checkpoint,
            files,
            reading: Arc::default(),
        })
    }

    /// The photographs of the views in previews. The task does not need them, so a failure is not one of the
    /// task.
    async fn fetch_previewed(
        &self,
        manifest: &Manifest,
        common: &v1::CommonSpec,
        config: &JobConfig,
        files: &mut HashMap<String, PathBuf>,
    ) {
        if config.train.preview_seconds == 0 {
            return;
        }
        let views = common.previews.iter().filter_map(|&index| manifest.views.get(index as usize));
        let wanted = views.flat_map(|view| [Some(view.image.clone()), view.mask.clone()]).flatten();
        let wanted: Vec<BlobRef> = wanted.filter(|blob| !files.contains_key(&blob.digest)).collect();
        let fetched = futures::stream::iter(wanted).map(|blob| async move {
            match self.cache.fetch(&self.blobs, &blob).await {
                Ok(path) => Some((blob.digest, path)),
                Err(error) => {
                    tracing::debug!(%error, digest = %blob.digest, "a preview has no photograph");
                    None
                }
            }
        });
        files.extend(
            fetched
                .buffer_unordered(FETCHES_AT_ONCE)
                .filter_map(std::future::ready)
                .collect::<Vec<_>>()
                .await,
        );
    }

    /// The checkpoint of an earlier attempt; `None` if there is none or it is damaged. Its iterations can be
    /// trained again, so this is no failure.
    async fn fetch_checkpoint(&self, assignment: &v1::Assignment) -> Result<Option<PathBuf>, TaskError> {
        let Some(blob) = assignment.checkpoint.clone() else { return Ok(None) };
        match self.cache.fetch(&self.blobs, &from_proto(blob)).await {
            Ok(path) => Ok(Some(path)),
            Err(error) if error.is_loss_of_data() => {
                tracing::warn!(%error, "the checkpoint is lost; restarting the task");
                Ok(None)
            }
            Err(error) => Err(TaskError::environment(error)),
        }
    }

    /// The Gaussians that the neighbours of a partition submitted for their cells; empty cells submit none.
    async fn fetch_neighbours(
        &self,
        exchange: &Path,
        spec: &v1::PartitionSpec,
    ) -> Result<Vec<PathBuf>, TaskError> {
        if spec.neighbours.is_empty() {
            return Ok(Vec::new());
        }
        let exchange = self.read_file(exchange).await?;
        let exchange = Exchange::from_json(&exchange).map_err(|e| TaskError::protocol(e.to_string()))?;
        let mut paths = Vec::with_capacity(spec.neighbours.len());
        for blob in spec.neighbours.iter().filter_map(|neighbour| exchange.rows.get(neighbour)) {
            paths.push(self.cache.fetch(&self.blobs, blob).await.map_err(TaskError::environment)?);
        }
        Ok(paths)
    }

    async fn fetch_some(
        &self,
        blob: &Option<fathom_proto::v1::BlobRef>,
    ) -> Result<Option<PathBuf>, TaskError> {
        match blob.clone() {
            Some(blob) => Ok(Some(
                self.cache.fetch(&self.blobs, &from_proto(blob)).await.map_err(TaskError::environment)?,
            )),
            None => Ok(None),
        }
    }

    async fn read(&self, blob: &Option<fathom_proto::v1::BlobRef>, what: &str) -> Result<Bytes, TaskError> {
        let path = self.fetch_some(blob).await?;
        let path = path.ok_or_else(|| TaskError::protocol(format!("an assignment without a {what}")))?;
        self.read_file(&path).await
    }

    async fn read_file(&self, path: &Path) -> Result<Bytes, TaskError> {
        let from = path.to_owned();
        let read = threads::blocking(move || std::fs::read(from)).await;
        let read = read.map_err(|error| TaskError::environment(WorkerError::Thread(error.to_string())))?;
        Ok(read.map_err(WorkerError::io("read", path)).map_err(TaskError::environment)?.into())
    }
}
