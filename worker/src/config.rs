//! Settings of a worker.

use std::fmt;
use std::net::SocketAddr;
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use fathom_proto::dial::Dial;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
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
    /// The worker ends after this long without a task; each GPU counts for itself. Default: never.
    pub exit_when_idle: Option<IdleLimit>,
    /// Tasks of each GPU after which it takes no more; the worker ends with the last of them. A task that was
    /// returned or failed counts too. Default: no limit.
    pub max_tasks: Option<NonZeroU32>,
}

/// A time of at least a second, written like `120s`, `5m` or `1h 30m`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IdleLimit(pub Duration);

impl FromStr for IdleLimit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let limit = humantime::parse_duration(text)
            .map_err(|error| format!("{error}; write a time like 120s, 5m or 1h"))?;
        if limit < Duration::from_secs(1) {
            return Err("use at least 1s: a worker asks for a task before it is idle".to_owned());
        }
        Ok(Self(limit))
    }
}

impl fmt::Display for IdleLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        humantime::format_duration(self.0).fmt(f)
    }
}

impl Serialize for IdleLimit {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for IdleLimit {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)
            .map_err(|_| D::Error::custom("write a time in quotes, such as \"120s\""))?;
        text.parse().map_err(D::Error::custom)
    }
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
            exit_when_idle: None,
            max_tasks: None,
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
