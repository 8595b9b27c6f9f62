//! Metrics of a worker, for Prometheus.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

use fathom_core::gpu::DeviceMemory;
use fathom_observe::http::Observed;
use fathom_observe::threads;
use fathom_proto::stage_name;
use fathom_proto::v1::{Progress, Stage};
use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use crate::execute::Executor;

type Labels = Vec<(&'static str, String)>;

/// Outcome of an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    Done,
    Failed,
    GivenBack,
    Abandoned,
}

/// All metrics of a worker. The label `gpu`, the adapter number, distinguishes the series of its GPUs.
pub struct Metrics {
    registry: Registry,
    up: Family<Labels, Gauge>,
    tasks: Family<Labels, Counter>,
    iterations: Family<Labels, Counter>,
    iterations_per_second: Family<Labels, Gauge<f64, AtomicU64>>,
    fetched_bytes: Family<Labels, Counter>,
    fetches: Family<Labels, Counter>,
    memory: Family<Labels, Gauge<i64>>,
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::with_prefix("fathom_worker");
        let build = Family::<Labels, Gauge>::default();
        build.get_or_create(&vec![("version", env!("CARGO_PKG_VERSION").to_owned())]).set(1);
        registry.register("build_info", "Version of the program; always 1", build);
        let up = Family::default();
        registry.register("up", "1 while the coordinator knows this GPU, else 0", up.clone());
        let tasks = Family::default();
        registry.register("tasks", "Attempts that ended here, by stage and outcome", tasks.clone());
        let iterations = Family::default();
        registry.register("iterations", "Training iterations", iterations.clone());
        let iterations_per_second = Family::default();
        let help = "Training speed as last reported; 0 while nothing is trained";
        registry.register("iterations_per_second", help, iterations_per_second.clone());
        let fetched_bytes = Family::default();
        let help = "Fetched from the coordinator into the cache";
        registry.register_with_unit("fetched", help, Unit::Bytes, fetched_bytes.clone());
        let fetches = Family::default();
        let help = "Files requested by tasks, by cache result: hit or miss";
        registry.register("cache", help, fetches.clone());
        let memory = Family::default();
        let help = "Device memory: allocated now, peak of the task, and the limit if set";
        registry.register_with_unit("gpu_memory", help, Unit::Bytes, memory.clone());
        Self { registry, up, tasks, iterations, iterations_per_second, fetched_bytes, fetches, memory }
    }
}

/// State of a GPU's session.
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum SessionState {
    Waits,
    Works,
    Ended,
}

/// Metrics of one GPU of a worker.
pub struct GpuMetrics {
    all: Arc<Metrics>,
    gpu: String,
    state: AtomicU8,
}

impl Default for GpuMetrics {
    fn default() -> Self {
        Self::of(&Arc::default(), 0)
    }
}

impl GpuMetrics {
    /// The metrics of adapter `number`, among `all`.
    pub fn of(all: &Arc<Metrics>, number: usize) -> Self {
        let metrics = Self {
            all: Arc::clone(all),
            gpu: number.to_string(),
            state: AtomicU8::new(SessionState::Waits as u8),
        };
        // List every GPU from the start, with zero counts.
        all.up.get_or_create(&metrics.labels([])).set(0);
        drop(all.iterations.get_or_create(&metrics.labels([])));
        metrics.at_speed(0.0);
        metrics
    }

    fn labels<const N: usize>(&self, others: [(&'static str, &str); N]) -> Labels {
        let own = std::iter::once(("gpu", self.gpu.as_str()));
        own.chain(others).map(|(name, value)| (name, value.to_owned())).collect()
    }

    fn at_speed(&self, iterations_per_second: f64) {
        self.all.iterations_per_second.get_or_create(&self.labels([])).set(iterations_per_second);
    }

    /// The coordinator knows this GPU's session.
    pub fn registered(&self) {
        self.state.store(SessionState::Works as u8, Ordering::Relaxed);
        self.all.up.get_or_create(&self.labels([])).set(1);
    }

    /// The session takes no more tasks.
    pub fn session_ended(&self) {
        self.state.store(SessionState::Ended as u8, Ordering::Relaxed);
        self.all.up.get_or_create(&self.labels([])).set(0);
        self.at_speed(0.0);
    }

    fn is(&self, state: SessionState) -> bool {
        self.state.load(Ordering::Relaxed) == state as u8
    }

    /// Counts an attempt's progress since its report `before`.
    pub fn trained(&self, before: u32, now: &Progress) {
        let done = now.iteration.saturating_sub(before);
        self.all.iterations.get_or_create(&self.labels([])).inc_by(done.into());
        self.at_speed(now.iterations_per_second.into());
    }

    /// Counts a finished attempt.
    pub fn ended(&self, stage: Stage, ended: Ended) {
        self.at_speed(0.0);
        let how = match ended {
            Ended::Done => "done",
            Ended::Failed => "failed",
            Ended::GivenBack => "given_back",
            Ended::Abandoned => "abandoned",
        };
        self.all.tasks.get_or_create(&self.labels([("stage", &stage_name(stage)), ("outcome", how)])).inc();
    }

    /// Counts a cache hit.
    pub fn hit(&self) {
        self.all.fetches.get_or_create(&self.labels([("found", "hit")])).inc();
    }

    /// Counts a fetched file.
    pub fn miss(&self, bytes: u64) {
        self.all.fetches.get_or_create(&self.labels([("found", "miss")])).inc();
        self.all.fetched_bytes.get_or_create(&self.labels([])).inc_by(bytes);
    }

    fn holds(&self, memory: DeviceMemory) {
        let set = |of, bytes| {
            let gauge = self.all.memory.get_or_create(&self.labels([("of", of)]));
            gauge.set(i64::try_from(bytes).unwrap_or(i64::MAX));
        };
        set("allocated", memory.allocated_bytes);
        set("peak", memory.peak_bytes);
        memory.limit_bytes.into_iter().for_each(|bytes| set("limit", bytes));
    }
}

/// A worker under observation.
pub struct Endpoint {
    /// Its metrics.
    pub metrics: Arc<Metrics>,
    /// Its GPUs.
    pub gpus: Vec<(Arc<GpuMetrics>, Arc<dyn Executor>)>,
}

impl Observed for Endpoint {
    async fn metrics(&self) -> Result<String, String> {
        for (metrics, executor) in &self.gpus {
            let executor = Arc::clone(executor);
            let memory = threads::blocking(move || executor.memory()).await;
            memory.map_err(|error| error.to_string())?.into_iter().for_each(|memory| metrics.holds(memory));
        }
        let mut page = String::new();
        text::encode(&mut page, &self.metrics.registry).map_err(|error| error.to_string())?;
        Ok(page)
    }

    async fn ready(&self) -> Result<(), String> {
        let any = |state| self.gpus.iter().any(|(metrics, _)| metrics.is(state));
        if any(SessionState::Waits) {
            Err("the coordinator has not answered yet".to_owned())
        } else if any(SessionState::Works) {
            Ok(())
        } else {
            Err("no GPU accepts tasks".to_owned())
        }
    }
}
