//! `fathom worker`: dials a coordinator, takes tasks, trains, hands in.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fathom_core::gpu::GpuOptions;
use fathom_worker::execute::CoreExecutor;
use fathom_worker::{WorkerConfig, run_with};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use tokio::sync::watch;
use tracing::level_filters::LevelFilter;

use crate::children;
use crate::dial_args::DialArgs;
use crate::error::{CliError, Result};
use crate::model::GpuArgs;

/// Time to checkpoint and give a task back when the parent process has gone; with it, the coordinator may have too.
const LEAVE_WITHIN: Duration = Duration::from_secs(5);

/// Arguments of `fathom worker`. In order of strength: flags, environment, file.
#[derive(Args, Debug)]
pub struct WorkerArgs {
    /// URL of the coordinator [default: http://127.0.0.1:7420]
    #[arg(long, value_name = "URL", env = "FATHOM_COORDINATOR")]
    coordinator: Option<String>,
    #[command(flatten)]
    dial: DialArgs,
    #[command(flatten)]
    gpu: GpuArgs,
    /// Name of this worker in lists [default: worker- and its process id]
    #[arg(long, env = "FATHOM_WORKER_NAME")]
    name: Option<String>,
    /// Folder for fetched photographs; may be shared and may be deleted [default: fathom-cache]
    #[arg(long, value_name = "DIR", env = "FATHOM_CACHE_DIR")]
    cache_dir: Option<PathBuf>,
    /// Size that this folder is kept under, bytes [default: 20 GiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_CACHE_BYTES")]
    cache_bytes: Option<u64>,
    /// Decoded photographs that are kept in memory, bytes [default: 1 GiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_IMAGE_CACHE_BYTES")]
    image_cache_bytes: Option<u64>,
    /// Address to serve metrics and health on over HTTP (/metrics, /healthz, /readyz), neither encrypted nor authenticated
    /// [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_WORKER_METRICS_LISTEN")]
    metrics_listen: Option<SocketAddr>,
    /// Log lines that the job's user sees: off, error, warn, info or debug, with what matters more [default: info]
    #[arg(long, value_name = "LEVEL", env = "FATHOM_JOB_LOG_LEVEL", value_parser = parse_level)]
    job_log_level: Option<LevelFilter>,
    /// All of these in a TOML file, under the names of the flags with _ for -
    #[arg(long, value_name = "FILE", env = "FATHOM_WORKER_CONFIG")]
    config: Option<PathBuf>,
    /// Stop when standard input closes: for a parent process that must not leave it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// The file of a worker; unknown keys are refused.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct WorkerFile {
    coordinator: Option<String>,
    token_file: Option<PathBuf>,
    tls_ca: Option<PathBuf>,
    tls_cert: Option<PathBuf>,
    tls_key: Option<PathBuf>,
    insecure: Option<bool>,
    name: Option<String>,
    cache_dir: Option<PathBuf>,
    cache_bytes: Option<u64>,
    image_cache_bytes: Option<u64>,
    metrics_listen: Option<SocketAddr>,
    #[serde(default, deserialize_with = "level")]
    job_log_level: Option<LevelFilter>,
    gpu: Option<usize>,
    allow_cpu: Option<bool>,
    gpu_memory_limit: Option<u64>,
}

impl WorkerArgs {
    fn resolve(&self) -> Result<WorkerConfig> {
        let file: WorkerFile = super::settings(self.config.as_deref())?;
        let defaults = WorkerConfig::default();
        let dial = DialArgs {
            token_file: self.dial.token_file.clone().or(file.token_file),
            tls_ca: self.dial.tls_ca.clone().or(file.tls_ca),
            tls_cert: self.dial.tls_cert.clone().or(file.tls_cert),
            tls_key: self.dial.tls_key.clone().or(file.tls_key),
            insecure: self.dial.insecure || file.insecure.unwrap_or(false),
        };
        let url = self.coordinator.clone().or(file.coordinator).unwrap_or(defaults.coordinator.url);
        Ok(WorkerConfig {
            coordinator: dial.dial(&url)?,
            name: self.name.clone().or(file.name).unwrap_or(defaults.name),
            cache_dir: self.cache_dir.clone().or(file.cache_dir).unwrap_or(defaults.cache_dir),
            cache_bytes: self.cache_bytes.or(file.cache_bytes).unwrap_or(defaults.cache_bytes),
            image_cache_bytes: self
                .image_cache_bytes
                .or(file.image_cache_bytes)
                .unwrap_or(defaults.image_cache_bytes),
            metrics_listen: self.metrics_listen.or(file.metrics_listen),
            job_log_level: self.job_log_level.or(file.job_log_level).unwrap_or(defaults.job_log_level),
            gpu: GpuOptions {
                index: self.gpu.gpu.or(file.gpu).or(defaults.gpu.index),
                allow_cpu: self.gpu.allow_cpu.or(file.allow_cpu).unwrap_or(defaults.gpu.allow_cpu),
                memory_limit: self
                    .gpu
                    .gpu_memory_limit
                    .or(file.gpu_memory_limit)
                    .or(defaults.gpu.memory_limit),
                shader_checks: defaults.gpu.shader_checks,
            },
        })
    }
}

fn parse_level(text: &str) -> std::result::Result<LevelFilter, String> {
    match text {
        "off" | "error" | "warn" | "info" | "debug" => text.parse().map_err(|_| text.to_owned()),
        _ => Err("use off, error, warn, info or debug".to_owned()),
    }
}

fn level<'de, D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Option<LevelFilter>, D::Error> {
    let text = String::deserialize(deserializer)?;
    parse_level(&text).map(Some).map_err(D::Error::custom)
}

pub async fn run(args: WorkerArgs) -> Result<()> {
    let config = args.resolve()?;
    let failed = |error: fathom_worker::WorkerError| CliError::Message(error.to_string());
    let (gpu, image_cache_bytes) = (config.gpu, config.image_cache_bytes);
    let executor = tokio::task::spawn_blocking(move || CoreExecutor::new(gpu, image_cache_bytes))
        .await
        .map_err(|error| CliError::Message(format!("opening the GPU: {error}")))??;
    let (stop, stopping) = watch::channel(false);
    let parent_gone = args.stop_with_stdin.then(children::stdin_closes);
    tokio::spawn(async move {
        let gone = async {
            match parent_gone {
                // An error means that the thread has gone, and with it the parent's pipe.
                Some(gone) => drop(gone.await),
                None => std::future::pending().await,
            }
        };
        let parent_has_gone = tokio::select! {
            () = gone => true,
            () = children::stop_signal() => false,
        };
        tracing::info!("asked to leave: giving the task back");
        stop.send_replace(true);
        if parent_has_gone {
            tokio::time::sleep(LEAVE_WITHIN).await;
            std::process::exit(0);
        }
        // Keeps the channel open: a closed one would read as a signal too.
        std::future::pending::<()>().await;
    });
    run_with(config, Arc::new(executor), stopping).await.map_err(failed)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::verbs::{Verb, parsed};

    fn resolve(words: &[&str]) -> WorkerConfig {
        let Verb::Worker(args) = parsed(&[&["worker"], words].concat()) else { panic!("another verb") };
        args.resolve().unwrap()
    }

    #[test]
    fn every_setting_has_a_flag_that_wins_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("worker.toml");
        let text = "coordinator = 'http://a:1'\nname = 'a'\ncache_dir = 'a'\ncache_bytes = 1\n\
                    image_cache_bytes = 2\nmetrics_listen = '127.0.0.1:1'\njob_log_level = 'warn'\ngpu = 3\nallow_cpu = true\ngpu_memory_limit = 7\n";
        std::fs::write(&file, text).unwrap();
        let file = file.to_str().unwrap();
        let config = resolve(&["--config", file]);
        assert_eq!((config.coordinator.url.as_str(), config.name.as_str()), ("http://a:1", "a"));
        assert_eq!((config.cache_dir, config.cache_bytes), (PathBuf::from("a"), 1));
        assert_eq!(config.image_cache_bytes, 2);
        assert_eq!(config.metrics_listen, Some(([127, 0, 0, 1], 1).into()));
        assert_eq!(config.job_log_level, LevelFilter::WARN);
        assert_eq!((config.gpu.index, config.gpu.allow_cpu), (Some(3), true));
        assert_eq!(config.gpu.memory_limit, Some(7));

        let flags = [
            "--coordinator=http://b:2",
            "--name=b",
            "--cache-dir=b",
            "--cache-bytes=4",
            "--image-cache-bytes=5",
            "--metrics-listen=127.0.0.1:2",
            "--job-log-level=debug",
            "--gpu=6",
            "--gpu-memory-limit=8",
        ];
        let config = resolve(&[&["--config", file], &flags[..]].concat());
        assert_eq!((config.coordinator.url.as_str(), config.name.as_str()), ("http://b:2", "b"));
        assert_eq!((config.cache_dir, config.cache_bytes), (PathBuf::from("b"), 4));
        assert_eq!(config.image_cache_bytes, 5);
        assert_eq!(config.metrics_listen, Some(([127, 0, 0, 1], 2).into()));
        assert_eq!(config.job_log_level, LevelFilter::DEBUG);
        assert_eq!((config.gpu.index, config.gpu.memory_limit), (Some(6), Some(8)));
        assert!(!resolve(&[]).gpu.allow_cpu && resolve(&["--allow-cpu"]).gpu.allow_cpu);
    }

    #[test]
    fn the_example_file_is_what_a_worker_has_without_one() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/worker.example.toml");
        let (example, without) = (resolve(&["--config", file]), resolve(&[]));
        assert_eq!(format!("{example:?}"), format!("{without:?}"));
    }
}
