//! How a worker runs.

use std::net::SocketAddr;
use std::path::PathBuf;

use fathom_proto::dial::Dial;
use tracing::level_filters::LevelFilter;

use crate::gpus::Gpus;

/// How a worker runs.
#[derive(Clone, Debug)]
pub struct WorkerConfig {
    /// Where the coordinator is and how it is spoken to. Default `http://127.0.0.1:7420`, without a token.
    pub coordinator: Dial,
    /// For people; names may repeat. With several GPUs, "-gpu" and the number of each follow. Default
    /// "worker-" and the process id.
    pub name: String,
    /// Where fetched blobs are kept; several workers of one machine may share it. Default "fathom-cache".
    pub cache_dir: PathBuf,
    /// Size that the cache is kept under, bytes; what any worker's running task needs, and all that was used
    /// within the last hour, stays in any case. Default 20 GiB.
    pub cache_bytes: u64,
    /// Decoded photographs that are kept in memory, bytes; several GPUs have equal shares of it. Default 1
    /// GiB.
    pub image_cache_bytes: u64,
    /// Where to serve metrics and health over HTTP, neither encrypted nor authenticated; port 0 takes a free
    /// one. Default: nowhere.
    pub metrics_listen: Option<SocketAddr>,
    /// Log lines that go to the job's user: this level and what matters more. Default INFO.
    pub job_log_level: LevelFilter,
    /// Which GPUs are used, each for a task of its own. Default: the first.
    pub gpus: Gpus,
    /// Whether an adapter that runs on the CPU will do. Default no.
    pub allow_cpu: bool,
    /// Most memory that may be taken of each GPU, bytes; what the coordinator goes by. Default: all there is.
    pub gpu_memory_limit: Option<u64>,
}

impl Default for WorkerConfig {
    fn default() -> Self {
        Self {
            coordinator: Dial::default(),
            name: format!("worker-{}", std::process::id()),
            cache_dir: PathBuf::from("fathom-cache"),
            cache_bytes: 20 << 30,
            image_cache_bytes: 1 << 30,
            metrics_listen: None,
            job_log_level: LevelFilter::INFO,
            gpus: Gpus::default(),
            allow_cpu: false,
            gpu_memory_limit: None,
        }
    }
}
