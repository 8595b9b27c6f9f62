//! Settings of a worker.

use std::net::SocketAddr;
use std::path::PathBuf;

use fathom_proto::dial::Dial;
use serde::{Deserialize, Serialize};
use tracing::level_filters::LevelFilter;

use crate::gpus::Gpus;

/// Settings of a worker.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
pub struct WorkerConfig {
    /// Address of the coordinator and settings of the connection. Default `http://127.0.0.1:7420`, without a
    /// token.
    #[serde(skip)]
    pub coordinator: Dial,
    /// Display name; need not be unique. With several GPUs, "-gpu" and the GPU's number are appended. Default
    /// "worker-" and the process id.
    pub name: String,
    /// Directory for fetched blobs; several workers on one machine may share it. Default "fathom-cache".
    pub cache_dir: PathBuf,
    /// Limit of the cache, bytes. Files of running tasks and files used within the last hour stay even above
    /// it. Default 20 GiB.
    pub cache_bytes: u64,
    /// Memory for decoded photographs, bytes, shared equally by all GPUs. Default 1 GiB.
    pub image_cache_bytes: u64,
    /// Address of the HTTP server for metrics and health, neither encrypted nor authenticated; port 0 takes a
    /// free one. Default: no server.
    pub metrics_listen: Option<SocketAddr>,
    /// Minimum level of log lines sent to the job's user. Default INFO.
    #[serde(with = "level")]
    pub job_log_level: LevelFilter,
    /// GPUs to use; each runs its own task. Default: the first.
    #[serde(rename = "gpu")]
    pub gpus: Gpus,
    /// Whether a CPU adapter is allowed. Default: no.
    pub allow_cpu: bool,
    /// Memory limit of each GPU, bytes; also reported to the coordinator. Default: all of it.
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

/// A level by its name.
mod level {
    use serde::de::Error as _;
    use serde::{Deserialize as _, Deserializer, Serializer};
    use tracing::level_filters::LevelFilter;

    pub fn serialize<S: Serializer>(level: &LevelFilter, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(level)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<LevelFilter, D::Error> {
        let name = String::deserialize(deserializer)?;
        let known = ["off", "error", "warn", "info", "debug"].contains(&name.as_str());
        let level = known.then(|| name.parse().ok()).flatten();
        level.ok_or_else(|| D::Error::custom("use off, error, warn, info or debug"))
    }
}
