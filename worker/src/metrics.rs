//! What a worker counts of itself, for Prometheus.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use fathom_observe::http::Observed;
use fathom_observe::threads;
use fathom_proto::v1::{Progress, TaskKind};
use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use crate::execute::Executor;

type Labels<const N: usize> = [(&'static str, &'static str); N];

/// How an attempt ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    Done,
    Failed,
    GivenBack,
    Abandoned,
}

/// All metrics of a worker.
pub struct Metrics {
    registry: Registry,
    registered: AtomicBool,
    tasks: Family<Labels<2>, Counter>,
    iterations: Counter,
    iterations_per_second: Gauge<f64, AtomicU64>,
    fetched_bytes: Counter,
    fetches: Family<Labels<1>, Counter>,
    memory: Family<Labels<1>, Gauge<i64>>,
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::with_prefix("fathom_worker");
        let build = Family::<Labels<1>, Gauge>::default();
        build.get_or_create(&[("version", env!("CARGO_PKG_VERSION"))]).set(1);
        registry.register("build_info", "Version of the program; always 1", build);
        let tasks = Family::default();
        registry.register("tasks", "Attempts that ended here, by kind of task and how", tasks.clone());
        let iterations = Counter::default();
        registry.register("iterations", "Iterations of training", iterations.clone());
        let iterations_per_second = Gauge::default();
        let help = "Speed of training as last reported; 0 when nothing is trained";
        registry.register("iterations_per_second", help, iterations_per_second.clone());
        let fetched_bytes = Counter::default();
        let help = "Fetched from the coordinator into the cache";
        registry.register_with_unit("fetched", help, Unit::Bytes, fetched_bytes.clone());
        let fetches = Family::default();
        let help = "Files that tasks needed, by whether the cache had them (hit) or not (miss)";
        registry.register("cache", help, fetches.clone());
        let memory = Family::default();
        let help =
            "Memory of the device: allocated now, at the peak of the task, and the limit where one is set";
        registry.register_with_unit("gpu_memory", help, Unit::Bytes, memory.clone());
        Self {
            registry,
            registered: AtomicBool::new(false),
            tasks,
            iterations,
            iterations_per_second,
            fetched_bytes,
            fetches,
            memory,
        }
    }
}

impl Metrics {
    /// The coordinator knows this worker.
    pub fn registered(&self) {
        self.registered.store(true, Ordering::Relaxed);
    }

    /// Counts what an attempt has done since it reported `before`.
    pub fn trained(&self, before: u32, now: &Progress) {
        self.iterations.inc_by(now.iteration.saturating_sub(before).into());
        self.iterations_per_second.set(now.iterations_per_second.into());
    }

    /// Counts an attempt that has ended.
    pub fn ended(&self, kind: TaskKind, ended: Ended) {
        self.iterations_per_second.set(0.0);
        let how = match ended {
            Ended::Done => "done",
            Ended::Failed => "failed",
            Ended::GivenBack => "given_back",
            Ended::Abandoned => "abandoned",
        };
        self.tasks.get_or_create(&[("kind", word(kind)), ("outcome", how)]).inc();
    }

    /// Counts a file that the cache had.
    pub fn hit(&self) {
        self.fetches.get_or_create(&[("found", "hit")]).inc();
    }

    /// Counts a file that was fetched.
    pub fn miss(&self, bytes: u64) {
        self.fetches.get_or_create(&[("found", "miss")]).inc();
        self.fetched_bytes.inc_by(bytes);
    }
}

/// A worker that is looked at.
pub struct Endpoint {
    /// What it counts.
    pub metrics: Arc<Metrics>,
    /// Whose device it is.
    pub executor: Arc<dyn Executor>,
}

impl Observed for Endpoint {
    async fn metrics(&self) -> Result<String, String> {
        let executor = Arc::clone(&self.executor);
        let memory = threads::blocking(move || executor.memory()).await;
        let Metrics { registry, memory: gauges, .. } = self.metrics.as_ref();
        if let Some(memory) = memory.map_err(|error| error.to_string())? {
            let set = |of, bytes| {
                gauges.get_or_create(&[("of", of)]).set(i64::try_from(bytes).unwrap_or(i64::MAX));
            };
            set("allocated", memory.allocated_bytes);
            set("peak", memory.peak_bytes);
            memory.limit_bytes.into_iter().for_each(|bytes| set("limit", bytes));
        }
        let mut page = String::new();
        text::encode(&mut page, registry).map_err(|error| error.to_string())?;
        Ok(page)
    }

    async fn ready(&self) -> Result<(), String> {
        if self.metrics.registered.load(Ordering::Relaxed) {
            Ok(())
        } else {
            Err("the coordinator has not answered yet".to_owned())
        }
    }
}

fn word(kind: TaskKind) -> &'static str {
    match kind {
        TaskKind::Global => "global",
        TaskKind::Refine => "refine",
        TaskKind::Partition => "partition",
        TaskKind::Borders => "borders",
        TaskKind::Evaluate => "evaluate",
        _ => "other",
    }
}
