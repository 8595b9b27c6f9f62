//! Metrics of a coordinator, for Prometheus.
//!
//! Counters are updated at the source: in the store wrapper ([`store`]), in the server layer ([`rpc`]), and
//! on transfers. Gauges are read from the store on request ([`endpoint`]). Labels come from fixed lists,
//! never from a message: a client cannot create a series.

pub mod endpoint;
mod labels;
pub mod rpc;
pub mod store;

use std::sync::Mutex;
use std::sync::atomic::AtomicU64;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};

use self::endpoint::Snapshot;
use crate::objects::Removed;

type One = [(&'static str, &'static str); 1];
type Two = [(&'static str, &'static str); 2];
type Real = Gauge<f64, AtomicU64>;
type Histograms = Family<One, Histogram, fn() -> Histogram>;

/// All metrics of a coordinator.
pub struct Metrics {
    registry: Registry,
    levels: Levels,
    /// The cached gauges.
    snapshot: Mutex<Option<Snapshot>>,
    jobs_submitted: Counter,
    attempts_granted: Family<One, Counter>,
    retries: Family<One, Counter>,
    attempts_completed: Family<One, Counter>,
    attempts_failed: Family<Two, Counter>,
    attempts_released: Family<One, Counter>,
    leases_expired: Family<Two, Counter>,
    stale_fences: Counter,
    stage_seconds: Histograms,
    acknowledgement_seconds: Histogram,
    uploaded_bytes: Counter,
    served_bytes: Counter,
    served_directly_bytes: Counter,
    uploaded_directly_bytes: Counter,
    removed_blobs: Counter,
    removed_bytes: Counter,
    rpc: rpc::RpcMetrics,
}

/// Gauges, set on request.
#[derive(Default)]
struct Levels {
    jobs: Family<One, Gauge>,
    ready: Family<One, Gauge>,
    oldest_ready_seconds: Real,
    leases: Family<One, Gauge>,
    iterations_per_second: Real,
    workers: Family<One, Gauge>,
    free_bytes: Real,
    min_free_bytes: Real,
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::with_prefix("fathom");
        // Seconds to most of a day.
        let stage_seconds: Histograms =
            Family::new_with_constructor(|| Histogram::new(exponential_buckets(1.0, 4.0, 9)));
        // Half a millisecond to some seconds.
        let acknowledgement_seconds = Histogram::new(exponential_buckets(0.0005, 2.0, 14));
        let build = Family::<One, Gauge>::default();
        build.get_or_create(&[("version", env!("CARGO_PKG_VERSION"))]).set(1);
        registry.register("build_info", "Version of the program; always 1", build);
        let metrics = Self {
            levels: Levels::default(),
            snapshot: Mutex::default(),
            jobs_submitted: Counter::default(),
            attempts_granted: Family::default(),
            retries: Family::default(),
            attempts_completed: Family::default(),
            attempts_failed: Family::default(),
            attempts_released: Family::default(),
            leases_expired: Family::default(),
            stale_fences: Counter::default(),
            stage_seconds,
            acknowledgement_seconds,
            uploaded_bytes: Counter::default(),
            served_bytes: Counter::default(),
            served_directly_bytes: Counter::default(),
            uploaded_directly_bytes: Counter::default(),
            removed_blobs: Counter::default(),
            removed_bytes: Counter::default(),
            rpc: rpc::RpcMetrics::register(&mut registry),
            registry,
        };
        metrics.registered()
    }
}

impl Metrics {
    /// Registers all metrics with names and help texts.
    fn registered(mut self) -> Self {
        let r = &mut self.registry;
        let levels = &self.levels;
        r.register("jobs", "Stored jobs, by state", levels.jobs.clone());
        r.register(
            "tasks_ready",
            "Tasks of running jobs that wait for a worker, including those in back-off",
            levels.ready.clone(),
        );
        let help = "Time for which the longest-waiting task has been ready; 0 when none waits";
        r.register_with_unit("oldest_ready", help, Unit::Seconds, levels.oldest_ready_seconds.clone());
        r.register("leases", "Held leases, by stage", levels.leases.clone());
        let help = "Sum of the last reported training speeds of all leases";
        r.register("iterations_per_second", help, levels.iterations_per_second.clone());
        let help =
            "Workers that have called within the duration of a lease, by whether they are assigned tasks";
        r.register("workers", help, levels.workers.clone());
        let help = "Free space on the disk of the data directory";
        r.register_with_unit("disk_free", help, Unit::Bytes, levels.free_bytes.clone());
        let help = "Free space below which uploads and new jobs are refused";
        r.register_with_unit("disk_min_free", help, Unit::Bytes, levels.min_free_bytes.clone());
        r.register("jobs_submitted", "Acknowledged calls of CreateJob", self.jobs_submitted.clone());
        r.register("attempts_granted", "Granted leases, by stage", self.attempts_granted.clone());
        r.register("retries", "Leases granted on tasks that had an earlier lease", self.retries.clone());
        r.register("attempts_completed", "Committed results, by stage", self.attempts_completed.clone());
        let help = "Attempts that failed, by stage and class of failure";
        r.register("attempts_failed", help, self.attempts_failed.clone());
        r.register("attempts_released", "Tasks that workers released", self.attempts_released.clone());
        let help = "Revoked leases, by stage and whether the holder stopped renewing or made no progress";
        r.register("leases_expired", help, self.leases_expired.clone());
        let help = "Calls refused because of a stale lease";
        r.register("stale_fences", help, self.stale_fences.clone());
        let help = "Duration of job stages, observed at their end";
        r.register_with_unit("stage", help, Unit::Seconds, self.stage_seconds.clone());
        let help = "Time until a change is durable";
        let acknowledgement = self.acknowledgement_seconds.clone();
        r.register_with_unit("store_acknowledgement", help, Unit::Seconds, acknowledgement);
        r.register_with_unit(
            "uploaded",
            "Bytes received from clients and workers",
            Unit::Bytes,
            self.uploaded_bytes.clone(),
        );
        r.register_with_unit(
            "served",
            "Bytes sent to clients and workers",
            Unit::Bytes,
            self.served_bytes.clone(),
        );
        let help = "Bytes for which clients and workers were given URLs of the bucket";
        r.register_with_unit("served_directly", help, Unit::Bytes, self.served_directly_bytes.clone());
        let help = "Bytes that clients and workers sent to the bucket themselves";
        r.register_with_unit("uploaded_directly", help, Unit::Bytes, self.uploaded_directly_bytes.clone());
        r.register("blobs_removed", "Unreferenced blobs removed", self.removed_blobs.clone());
        let help = "Bytes of removed blobs and uploads";
        r.register_with_unit("removed", help, Unit::Bytes, self.removed_bytes.clone());
        self
    }

    /// Counts received bytes.
    pub fn uploaded(&self, bytes: usize) {
        self.uploaded_bytes.inc_by(bytes as u64);
    }

    /// Counts sent bytes.
    pub fn served(&self, bytes: usize) {
        self.served_bytes.inc_by(bytes as u64);
    }

    /// Counts bytes that a client fetches from the bucket itself.
    pub fn served_directly(&self, bytes: u64) {
        self.served_directly_bytes.inc_by(bytes);
    }

    /// Counts bytes that a client has sent to the bucket itself.
    pub fn uploaded_directly(&self, bytes: u64) {
        self.uploaded_directly_bytes.inc_by(bytes);
    }

    /// Counts the removals of a garbage collection.
    pub fn removed(&self, removed: &Removed) {
        self.removed_blobs.inc_by(removed.blobs);
        self.removed_bytes.inc_by(removed.bytes);
    }
}
