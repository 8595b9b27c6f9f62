//! Executes a task without network access: all inputs are files, and all reports go out through [`Control`].

mod borders;
mod evaluate;
mod first_part;
mod global;
mod loss_mask;
mod partition;
mod previews;
#[cfg(test)]
mod tests;
mod training;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::config::{JobConfig, Method, TrainConfig};
use fathom_core::gpu::{AdapterSummary, DeviceMemory, Gpu, GpuOptions, adapters};
use fathom_core::scene::{BlobRef, Manifest};
use fathom_core::views::{ViewSource, Weighted};
use fathom_proto::v1::{HeldOutMetrics, Progress, Stage};
use fathom_proto::worker::v1::task_spec::Work;
use fathom_proto::worker::v1::{
    Artifact, Capabilities, CommonSpec, FailClass, GlobalSpec, PartitionSpec, TaskSpec,
};
use futures::future::BoxFuture;

pub use self::previews::Picture;
use crate::WorkerError;
pub use crate::heartbeat::Stop;
use crate::views::{PhotographFile, PhotographSource, ReadingTime};

/// Layout version of [`TaskSpec`] that this program reads.
pub const SPEC_FORMAT: u32 = 2;

/// Stages that this worker executes. A stage is a row here, an arm of `CoreExecutor::run`, and a file.
pub const STAGES: [Stage; 5] =
    [Stage::Global, Stage::FirstPart, Stage::Partition, Stage::Borders, Stage::Evaluate];

/// A task with all its inputs on this machine.
#[derive(Clone, Debug)]
pub struct TaskInput {
    /// Its stage, one of the worker's [`Capabilities`].
    pub stage: Stage,
    /// Resolved configuration of the job.
    pub config: JobConfig,
    /// The scene.
    pub manifest: Manifest,
    /// The inputs common to all stages.
    pub common: CommonSpec,
    /// The inputs of its stage alone.
    pub work: Work,
    /// The results of earlier stages that this one starts from.
    pub inputs: HashMap<Artifact, PathBuf>,
    /// Checkpoint at which the first part of this partition ended.
    pub state: Option<PathBuf>,
    /// The Gaussians that the neighbours trained in their cells up to the exchange, PLY.
    pub neighbours: Vec<PathBuf>,
    /// Checkpoint of an earlier attempt.
    pub checkpoint: Option<PathBuf>,
    /// Iterations of this task completed in the checkpoint.
    pub checkpoint_iteration: u32,
    /// Photographs, masks and points of this task, by digest.
    pub files: HashMap<String, PathBuf>,
    /// How long the photographs of its training took so far.
    pub reading: Arc<ReadingTime>,
}

impl TaskInput {
    /// The file of a blob of this task.
    ///
    /// # Errors
    /// When it was not fetched.
    pub fn file(&self, blob: &BlobRef) -> Result<&Path, TaskError> {
        self.files.get(&blob.digest).map(PathBuf::as_path).ok_or_else(|| TaskError::Failed {
            class: FailClass::Environment,
            message: format!("blob {} was not fetched", blob.digest),
        })
    }

    /// The result of an earlier stage; `None` if the job has none.
    pub fn input(&self, artifact: Artifact) -> Option<&Path> {
        self.inputs.get(&artifact).map(PathBuf::as_path)
    }

    /// The specification that the plan gave it.
    pub fn spec(&self) -> TaskSpec {
        TaskSpec { format: SPEC_FORMAT, common: Some(self.common.clone()), work: Some(self.work.clone()) }
    }

    /// The inputs of a partition task; `None` for other stages.
    pub fn partition(&self) -> Option<&PartitionSpec> {
        match &self.work {
            Work::FirstPart(spec) | Work::Partition(spec) => Some(spec),
            _ => None,
        }
    }

    /// The configuration of this task's run: the job's, with the task's own iterations, cap and factors.
    fn train_config(&self) -> TrainConfig {
        let CommonSpec { iterations, max_gaussians, .. } = self.common;
        let mut config = TrainConfig { iterations, max_gaussians, ..self.config.train.clone() };
        config.loss_factor = self.partition().and_then(|spec| spec.loss_factor).unwrap_or(1.0);
        config
    }

    /// The scene scale, scene units: the median viewing distance, and the length unit of the water
    /// coefficients.
    fn unit(&self) -> f64 {
        self.common.viewing_distance.map_or(1.0, f64::from)
    }

    /// Adds the settings that determine memory to an out-of-memory error. A reader may have them from a file
    /// or from another user.
    fn with_settings(&self, error: TaskError) -> TaskError {
        let JobConfig { data, partition, train, .. } = &self.config;
        let partitions = if partition.auto {
            "auto".to_owned()
        } else {
            format!("{}x{}", partition.columns, partition.rows)
        };
        match error {
            TaskError::Failed { class: FailClass::OutOfMemory, message } => TaskError::Failed {
                class: FailClass::OutOfMemory,
                message: format!(
                    "{message} (now --partitions {partitions}, --max-gaussians {}, --max-resolution {})",
                    train.max_gaussians, data.max_resolution
                ),
            },
            other => other,
        }
    }

    /// The photographs of this task as views.
    fn views(&self, limit_bytes: u64) -> Result<Arc<dyn ViewSource>, TaskError> {
        let CommonSpec { views, clear_ranges, max_resolution_px, .. } = &self.common;
        let sound = |range: &f32| *range >= 0.0 && range.is_finite();
        if ![0, views.len()].contains(&clear_ranges.len()) || !clear_ranges.iter().all(sound) {
            let (ranges, views) = (clear_ranges.len(), views.len());
            return Err(input_fault(format!(
                "{ranges} clear ranges for {views} views; one per view is needed, finite and at least 0"
            )));
        }
        let reading = Arc::clone(&self.reading);
        let views = self.views_timed(views, clear_ranges, *max_resolution_px, limit_bytes, reading)?;
        Ok(match &self.work {
            Work::Global(GlobalSpec { view_weights }) if !view_weights.is_empty() => {
                Arc::new(Weighted::new(views, view_weights.clone())?)
            }
            _ => views,
        })
    }

    /// The views to measure during training; rarely used, so none are kept in memory.
    fn held_out(&self) -> Result<Arc<dyn ViewSource>, TaskError> {
        self.views_of(&self.common.held_out, &[], self.common.max_resolution_px, 0)
    }

    /// `views` at the job's full training size, which a global stage reduces: a point's appearance from far
    /// away would be lost first. Each view is read once, so none are kept in memory.
    fn full_views(&self, views: &Arc<dyn ViewSource>) -> Result<Arc<dyn ViewSource>, TaskError> {
        let full = self.config.data.max_resolution;
        if self.common.max_resolution_px >= full {
            return Ok(Arc::clone(views));
        }
        self.views_of(&self.common.views, &[], full, 0)
    }

    /// `clear_ranges` belong to `indices`; empty if they do not matter.
    fn views_of(
        &self,
        indices: &[u32],
        clear_ranges: &[f32],
        max_resolution: u32,
        limit_bytes: u64,
    ) -> Result<Arc<dyn ViewSource>, TaskError> {
        // Only the wait of the training is divided.
        self.views_timed(indices, clear_ranges, max_resolution, limit_bytes, Arc::default())
    }

    /// As [`Self::views_of`]; what reading them takes is added to `reading`.
    fn views_timed(
        &self,
        indices: &[u32],
        clear_ranges: &[f32],
        max_resolution: u32,
        limit_bytes: u64,
        reading: Arc<ReadingTime>,
    ) -> Result<Arc<dyn ViewSource>, TaskError> {
        let mut files = Vec::with_capacity(indices.len());
        for (place, &index) in indices.iter().enumerate() {
            let view = self.manifest.views.get(index as usize);
            let view = view.ok_or_else(|| input_fault(format!("the manifest has no view {index}")))?;
            let camera = self.manifest.cameras.iter().find(|camera| camera.id == view.camera_id);
            let camera = camera.ok_or_else(|| {
                input_fault(format!("{}: the manifest has no camera {}", view.name, view.camera_id))
            })?;
            let mask = view.mask.as_ref().map(|mask| self.file(mask)).transpose()?;
            files.push(PhotographFile {
                view: view.clone(),
                camera: camera.clone(),
                image: self.file(&view.image)?.to_owned(),
                mask: mask.map(Path::to_owned),
                clear_range: clear_ranges.get(place).copied().unwrap_or(0.0),
            });
        }
        let mask_keep = self.config.data.mask_keep;
        Ok(Arc::new(PhotographSource::new(files, mask_keep, max_resolution, limit_bytes, reading)?))
    }
}

fn input_fault(message: String) -> TaskError {
    TaskError::Failed { class: FailClass::Input, message }
}

/// The outcome of a task.
#[derive(Clone, Debug, Default)]
pub struct TaskOutput {
    /// The result, as described by [`fathom_proto::worker::v1::CompleteRequest`].
    pub result: Bytes,
    /// Gaussians in it.
    pub gaussians: u32,
    /// First iteration of this attempt.
    pub resumed_from: u32,
    /// Measurements on held-out views during training.
    pub held_out: Vec<HeldOutMetrics>,
    /// Additional results of the stage, uploaded.
    pub further: Vec<(Artifact, BlobRef)>,
}

/// The reason why a task has no result.
#[derive(Debug, thiserror::Error)]
pub enum TaskError {
    /// It was asked to stop.
    #[error("stopped")]
    Stopped {
        /// Its last checkpoint and iteration, unless the work is discarded.
        checkpoint: Option<(Bytes, u32)>,
    },
    /// It failed.
    #[error("{message}")]
    Failed {
        /// Class of the failure.
        class: FailClass,
        /// Error message.
        message: String,
    },
}

impl TaskError {
    /// A failure of the worker's surroundings, which counts as a lost worker.
    pub(crate) fn environment(error: WorkerError) -> Self {
        Self::Failed { class: FailClass::Environment, message: error.to_string() }
    }

    /// An answer of the coordinator that this worker does not understand.
    pub(crate) fn protocol(message: String) -> Self {
        Self::environment(WorkerError::Protocol(message))
    }
}

impl From<CoreError> for TaskError {
    fn from(error: CoreError) -> Self {
        let class = match &error {
            CoreError::Input { .. } | CoreError::Scene(_) | CoreError::Config(_) => FailClass::Input,
            CoreError::OutOfMemory { .. } | CoreError::BufferTooLarge { .. } => FailClass::OutOfMemory,
            CoreError::DeviceLost { .. } | CoreError::Gpu(_) | CoreError::NoAdapter(_) => FailClass::Device,
            CoreError::Io { .. } => FailClass::Environment,
            _ => FailClass::Training,
        };
        Self::Failed { class, message: error.to_string() }
    }
}

/// Reports of a running task. No method waits for the network unless its comment says so.
pub trait Control: Send + Sync {
    /// Reports progress.
    fn report(&self, progress: Progress);
    /// Submits previews of an iteration. They are uploaded in the background; later ones replace those that
    /// still wait.
    fn preview(&self, _iteration: u32, _pictures: Vec<Picture>) {}
    /// Submits a checkpoint. It is uploaded in the background; a later one replaces it if it still waits.
    fn checkpoint(&self, bytes: Bytes, iteration: u32);
    /// Whether the task must stop, and how.
    fn stop_reason(&self) -> Option<Stop>;
    /// Uploads a part of the result and waits until it is stored.
    ///
    /// # Errors
    /// When the coordinator refuses it, or the work must stop.
    fn upload(&self, bytes: Bytes) -> Result<BlobRef, TaskError>;
    /// As [`Control::upload`], for async work.
    fn uploading(&self, bytes: Bytes) -> BoxFuture<'_, Result<BlobRef, TaskError>> {
        Box::pin(std::future::ready(self.upload(bytes)))
    }
}

/// Executes tasks. The worker calls it on its own thread, one task at a time.
pub trait Executor: Send + Sync + 'static {
    /// Its capabilities.
    fn capabilities(&self) -> Capabilities;
    /// Prepares for a task. The worker calls it on a blocking thread, and claims no task until it succeeds.
    ///
    /// # Errors
    /// When no task can be executed now.
    fn prepare(&self) -> Result<(), TaskError> {
        Ok(())
    }
    /// Memory allocated on the device; `None` if unknown. May be called while a task runs.
    fn memory(&self) -> Option<DeviceMemory> {
        None
    }
    /// Executes one task.
    ///
    /// # Errors
    /// [`TaskError`]; a failure never ends the worker.
    fn execute(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError>;
    /// Replaces the method above where threads are simulated (`fathom_observe::threads`), in simulated time.
    fn simulate<'a>(
        &'a self,
        task: &'a TaskInput,
        control: &'a dyn Control,
    ) -> BoxFuture<'a, Result<TaskOutput, TaskError>> {
        Box::pin(std::future::ready(self.execute(task, control)))
    }
}

/// Executes tasks with the trainer of fathom-core.
pub struct CoreExecutor {
    options: GpuOptions,
    adapter: AdapterSummary,
    capabilities: Capabilities,
    image_cache_bytes: u64,
    /// Empty while a task runs, and after a task that panicked or failed because of the device or its memory.
    /// The next task then opens a new device, with all memory released.
    gpu: Mutex<Option<Arc<Gpu>>>,
    /// The last used device, for memory queries.
    seen: Mutex<Weak<Gpu>>,
}

impl CoreExecutor {
    /// Opens the GPU.
    ///
    /// # Errors
    /// When no adapter may be used.
    pub fn new(options: GpuOptions, image_cache_bytes: u64) -> Result<Self, CoreError> {
        let gpu = Gpu::new(options)?;
        let adapter = gpu.adapter();
        if adapter.is_cpu {
            tracing::warn!(adapter = %adapter.name, "training on a CPU adapter: this is slow");
        }
        let capabilities = Capabilities {
            stages: STAGES.map(Into::into).to_vec(),
            methods: Method::ALL.map(String::from).to_vec(),
            adapter: adapter.name.clone(),
            adapter_is_cpu: adapter.is_cpu,
            max_binding_bytes: adapter.max_binding_bytes,
            memory_bytes: options.memory_limit.unwrap_or(0),
        };
        let seen = Mutex::new(Arc::downgrade(&gpu));
        let adapter = adapter.clone();
        Ok(Self { options, adapter, capabilities, image_cache_bytes, gpu: Mutex::new(Some(gpu)), seen })
    }

    fn slot(&self) -> MutexGuard<'_, Option<Arc<Gpu>>> {
        self.gpu.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reopens the device. It must be the one registered with the coordinator, and must not belong to another
    /// session. Its number changes if a GPU before it disappears.
    fn reopen(&self) -> Result<Arc<Gpu>, CoreError> {
        let there = adapters();
        let is_known = |index: &usize| there.get(*index) == Some(&self.adapter);
        let index = self.options.index.filter(is_known).or_else(|| (0..there.len()).find(is_known));
        let gpu = Gpu::new(GpuOptions { index: index.or(self.options.index), ..self.options })?;
        let (known, found) = (&self.adapter, gpu.adapter());
        if known != found {
            let message = format!(
                "{} is gone, and {} is in its place; restart this worker to use it",
                known.name, found.name
            );
            return Err(CoreError::NoAdapter(message));
        }
        Ok(gpu)
    }

    fn run(&self, gpu: &Arc<Gpu>, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let views = task.views(self.image_cache_bytes)?;
        match &task.work {
            Work::Global(_) => global::run(gpu, task, views, control),
            Work::FirstPart(spec) => first_part::run(gpu, task, spec, views, control),
            Work::Partition(spec) => partition::run(gpu, task, spec, views, control),
            Work::Borders(spec) => borders::run(gpu, task, spec, views, control),
            Work::Evaluate(spec) => evaluate::run(gpu, task, spec, views.as_ref(), control),
        }
    }
}

impl Executor for CoreExecutor {
    fn capabilities(&self) -> Capabilities {
        self.capabilities.clone()
    }

    fn prepare(&self) -> Result<(), TaskError> {
        let mut slot = self.slot();
        if let Some(error) = slot.as_ref().and_then(|gpu| gpu.wait().err()) {
            tracing::warn!(%error, "the GPU failed while no task ran");
            *slot = None;
        }
        if slot.is_none() {
            *slot = Some(self.reopen()?);
            tracing::info!(adapter = %self.capabilities.adapter, "the GPU was reopened");
        }
        Ok(())
    }

    fn memory(&self) -> Option<DeviceMemory> {
        let gpu = self.seen.lock().unwrap_or_else(PoisonError::into_inner).upgrade();
        gpu?.memory()
    }

    fn execute(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let opened = self.slot().take();
        let gpu = opened.map_or_else(|| self.reopen(), Ok)?;
        *self.seen.lock().unwrap_or_else(PoisonError::into_inner) = Arc::downgrade(&gpu);
        gpu.reset_peak();
        let result = self.run(&gpu, task, control).map_err(|error| task.with_settings(error));
        if let Some(memory) = gpu.memory() {
            tracing::info!(peak_bytes = memory.peak_bytes, limit_bytes = ?memory.limit_bytes, "GPU memory of the task");
        }
        let failed = |class: &FailClass| matches!(class, FailClass::Device | FailClass::OutOfMemory);
        let is_sound = !matches!(&result, Err(TaskError::Failed { class, .. }) if failed(class));
        // Otherwise caches would keep the buffers of this task beside those of the next one.
        if is_sound && gpu.release_unused().is_ok() {
            *self.slot() = Some(gpu);
        }
        result
    }
}
