//! Doing a task, apart from the network: everything that is needed comes in as files, everything that is to
//! be said goes out through [`Control`].

mod borders;
mod contribution;
mod evaluate;
mod first_part;
mod global;
mod own_pixels;
mod partition;
#[cfg(test)]
mod tests;
mod training;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::config::{JobConfig, TrainConfig};
use fathom_core::gpu::{AdapterSummary, DeviceMemory, Gpu, GpuOptions, adapters};
use fathom_core::scene::{BlobRef, Manifest};
use fathom_core::views::{ViewSource, Weighted};
use fathom_proto::v1::{HeldOutMetrics, Progress, Stage};
use fathom_proto::worker::v1::task_spec::Work;
use fathom_proto::worker::v1::{
    Artifact, Capabilities, CommonSpec, FailClass, GlobalSpec, PartitionSpec, TaskSpec,
};
use futures::future::BoxFuture;

pub use crate::heartbeat::Stop;
use crate::views::{PhotographFile, PhotographSource};

/// Version of [`TaskSpec`]'s layout that this program reads.
pub const SPEC_FORMAT: u32 = 2;

/// Stages that this program takes tasks of. A stage is a row here, an arm of [`CoreExecutor::run`], and a
/// file.
const STAGES: [Stage; 5] =
    [Stage::Global, Stage::FirstPart, Stage::Partition, Stage::Borders, Stage::Evaluate];

/// A task with everything that it needs on this machine.
#[derive(Clone, Debug)]
pub struct TaskInput {
    /// Its stage, one of the worker's [`Capabilities`].
    pub stage: Stage,
    /// Resolved configuration of the job.
    pub config: JobConfig,
    /// The scene.
    pub manifest: Manifest,
    /// What its stage needs as every other.
    pub common: CommonSpec,
    /// What its stage alone needs.
    pub work: Work,
    /// What earlier stages made and this one starts from.
    pub inputs: HashMap<Artifact, PathBuf>,
    /// Checkpoint at which the first part of this partition ended.
    pub state: Option<PathBuf>,
    /// What the neighbours of this partition trained in their cells up to the exchange, PLY.
    pub neighbours: Vec<PathBuf>,
    /// Where an earlier attempt got to.
    pub checkpoint: Option<PathBuf>,
    /// Iterations of this task done in the checkpoint.
    pub checkpoint_iteration: u32,
    /// Photographs, masks and points of this task, by digest.
    pub files: HashMap<String, PathBuf>,
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

    /// What an earlier stage made; `None` where the job has none.
    pub fn input(&self, artifact: Artifact) -> Option<&Path> {
        self.inputs.get(&artifact).map(PathBuf::as_path)
    }

    /// The specification that it was planned with.
    pub fn spec(&self) -> TaskSpec {
        TaskSpec { format: SPEC_FORMAT, common: Some(self.common.clone()), work: Some(self.work.clone()) }
    }

    /// What a task of a partition needs; `None` for other stages.
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
        let factors = self.partition().map(|spec| (spec.loss_factor, spec.gradient_factor));
        let (loss_factor, gradient_factor) = factors.unwrap_or_default();
        config.loss_factor = loss_factor.unwrap_or(1.0);
        config.classic.gradient *= gradient_factor.unwrap_or(1.0);
        config
    }

    /// The usual viewing distance, scene units: what coefficients of the water are counted in.
    fn unit(&self) -> f64 {
        self.common.viewing_distance.map_or(1.0, f64::from)
    }

    /// An error with the settings on which memory hangs, where memory is what is missing: who reads the error
    /// has them from a file, or from somebody else.
    fn told(&self, error: TaskError) -> TaskError {
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
                "{ranges} clear ranges, which must be finite and 0 or more, for {views} views"
            )));
        }
        let views = self.views_of(views, clear_ranges, *max_resolution_px, limit_bytes)?;
        Ok(match &self.work {
            Work::Global(GlobalSpec { view_weights, .. }) if !view_weights.is_empty() => {
                Arc::new(Weighted::new(views, view_weights.clone())?)
            }
            _ => views,
        })
    }

    /// The views to measure while the task trains; none are kept in memory, since they are seldom looked at.
    fn held_out(&self) -> Result<Arc<dyn ViewSource>, TaskError> {
        self.views_of(&self.common.held_out, &[], self.common.max_resolution_px, 0)
    }

    /// `views` as large as the job trains on them, of which a global stage sees less: what a point looks like
    /// from far away is lost first. Each is looked at once, so none are kept in memory.
    fn full_views(&self, views: &Arc<dyn ViewSource>) -> Result<Arc<dyn ViewSource>, TaskError> {
        let full = self.config.data.max_resolution;
        if self.common.max_resolution_px >= full {
            return Ok(Arc::clone(views));
        }
        self.views_of(&self.common.views, &[], full, 0)
    }

    /// `clear_ranges` are those of `indices`; none where they do not matter.
    fn views_of(
        &self,
        indices: &[u32],
        clear_ranges: &[f32],
        max_resolution: u32,
        limit_bytes: u64,
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
        Ok(Arc::new(PhotographSource::new(files, mask_keep, max_resolution, limit_bytes)?))
    }
}

fn input_fault(message: String) -> TaskError {
    TaskError::Failed { class: FailClass::Input, message }
}

/// What a task gives.
#[derive(Clone, Debug, Default)]
pub struct TaskOutput {
    /// The result as [`fathom_proto::worker::v1::CompleteRequest`] describes it.
    pub result: Bytes,
    /// Gaussians in it.
    pub gaussians: u32,
    /// Iteration at which this attempt began.
    pub resumed_from: u32,
    /// Measurements on held-out views while it trained.
    pub held_out: Vec<HeldOutMetrics>,
    /// What the stage makes besides, uploaded.
    pub further: Vec<(Artifact, BlobRef)>,
}

/// Why a task has no result.
#[derive(Debug, thiserror::Error)]
pub enum TaskError {
    /// It was told to stop.
    #[error("stopped")]
    Stopped {
        /// Where it got to, with its iteration, unless the work is thrown away.
        checkpoint: Option<(Bytes, u32)>,
    },
    /// It failed.
    #[error("{message}")]
    Failed {
        /// How.
        class: FailClass,
        /// What happened.
        message: String,
    },
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

/// What a task says while it runs. Nothing here waits for the network unless it says so.
pub trait Control: Send + Sync {
    /// Reports how far the work is.
    fn report(&self, progress: Progress);
    /// Hands a checkpoint over; it is uploaded meanwhile, and a later one replaces it if it still waits.
    fn checkpoint(&self, bytes: Bytes, iteration: u32);
    /// Whether to stop, and how.
    fn stop_reason(&self) -> Option<Stop>;
    /// Uploads a part of the result; waits until it is there.
    ///
    /// # Errors
    /// When the coordinator refuses it, or the work is to stop.
    fn upload(&self, bytes: Bytes) -> Result<BlobRef, TaskError>;
    /// As [`Control::upload`], for work that is a task.
    fn uploading(&self, bytes: Bytes) -> BoxFuture<'_, Result<BlobRef, TaskError>> {
        Box::pin(std::future::ready(self.upload(bytes)))
    }
}

/// Does tasks. The worker calls it on a thread of its own, one task at a time.
pub trait Executor: Send + Sync + 'static {
    /// What it is able to do.
    fn capabilities(&self) -> Capabilities;
    /// Makes ready for a task; the worker calls it on a thread that may wait, and claims nothing until it
    /// succeeds.
    ///
    /// # Errors
    /// When no task could be done now.
    fn prepare(&self) -> Result<(), TaskError> {
        Ok(())
    }
    /// What is allocated on the device; `None` where nobody knows. May be asked while a task runs.
    fn memory(&self) -> Option<DeviceMemory> {
        None
    }
    /// Does one task.
    ///
    /// # Errors
    /// [`TaskError`]; a failure never ends the worker.
    fn execute(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError>;
    /// What is called in its place where threads are simulated (`fathom_observe::threads`): it takes
    /// simulated time.
    fn simulate<'a>(
        &'a self,
        task: &'a TaskInput,
        control: &'a dyn Control,
    ) -> BoxFuture<'a, Result<TaskOutput, TaskError>> {
        Box::pin(std::future::ready(self.execute(task, control)))
    }
}

/// Does tasks with the trainer of fathom-core.
pub struct CoreExecutor {
    options: GpuOptions,
    adapter: AdapterSummary,
    capabilities: Capabilities,
    image_cache_bytes: u64,
    /// Empty while a task runs and after one that failed for the device or its memory, or panicked: then the
    /// next task has a new device, with all memory given back.
    gpu: Mutex<Option<Arc<Gpu>>>,
    /// The device that was used last, for those who ask of its memory.
    seen: Mutex<Weak<Gpu>>,
}

impl CoreExecutor {
    /// Opens the GPU.
    ///
    /// # Errors
    /// When there is no adapter that may be used.
    pub fn new(options: GpuOptions, image_cache_bytes: u64) -> Result<Self, CoreError> {
        let gpu = Gpu::new(options)?;
        let adapter = gpu.adapter();
        if adapter.is_cpu {
            tracing::warn!(adapter = %adapter.name, "training on a CPU adapter: this is slow");
        }
        let capabilities = Capabilities {
            stages: STAGES.map(Into::into).to_vec(),
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

    /// Opens the device anew. It must be the one that the coordinator knows of, and none that belongs to
    /// another session; its number is another one when a GPU before it is gone.
    fn reopen(&self) -> Result<Arc<Gpu>, CoreError> {
        let there = adapters();
        let is_known = |index: &usize| there.get(*index) == Some(&self.adapter);
        let index = self.options.index.filter(is_known).or_else(|| (0..there.len()).find(is_known));
        let gpu = Gpu::new(GpuOptions { index: index.or(self.options.index), ..self.options })?;
        let (known, found) = (&self.adapter, gpu.adapter());
        if known != found {
            let message = format!(
                "{} is gone, and {} in its place; start this worker anew to use it",
                known.name, found.name
            );
            return Err(CoreError::NoAdapter(message));
        }
        Ok(gpu)
    }

    fn run(&self, gpu: &Arc<Gpu>, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let views = task.views(self.image_cache_bytes)?;
        match &task.work {
            Work::Global(spec) => global::run(gpu, task, spec, views, control),
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
            tracing::info!(adapter = %self.capabilities.adapter, "the GPU was opened anew");
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
        let result = self.run(&gpu, task, control).map_err(|error| task.told(error));
        if let Some(memory) = gpu.memory() {
            tracing::info!(peak_bytes = memory.peak_bytes, limit_bytes = ?memory.limit_bytes, "GPU memory of the task");
        }
        let failed = |class: &FailClass| matches!(class, FailClass::Device | FailClass::OutOfMemory);
        let is_sound = !matches!(&result, Err(TaskError::Failed { class, .. }) if failed(class));
        // What is kept for speed would else hold the buffers of this task beside those of the next one.
        if is_sound && gpu.release_unused().is_ok() {
            *self.slot() = Some(gpu);
        }
        result
    }
}
