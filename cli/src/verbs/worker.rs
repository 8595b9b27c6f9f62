//! `fathom worker`: dials a coordinator, takes tasks, trains, hands in.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fathom_worker::gpus::{self, GpuName};
use fathom_worker::{Gpus, WorkerConfig, WorkerError, run_on};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use tokio::sync::watch;
use tracing::level_filters::LevelFilter;

use crate::children;
use crate::dial_args::{DialArgs, HEADING};
use crate::error::{CliError, Result};

/// Time to checkpoint and give a task back when the parent process has gone; with it, the coordinator may have too.
const LEAVE_WITHIN: Duration = Duration::from_secs(5);

/// Arguments of `fathom worker`. In order of strength: flags, environment, file.
#[derive(Args, Debug)]
pub struct WorkerArgs {
    /// URL of the coordinator [default: http://127.0.0.1:7420]
    #[arg(long, value_name = "URL", help_heading = HEADING, env = "FATHOM_COORDINATOR")]
    coordinator: Option<String>,
    #[command(flatten)]
    dial: DialArgs,
    /// Adapter by its number in `fathom doctor`, or all for every real GPU; several (--gpu 0 --gpu 2) take a task each
    /// [default: the first real GPU]
    #[arg(long, value_name = "N", env = "FATHOM_GPU", value_delimiter = ',')]
    gpu: Vec<GpuName>,
    /// Allow an adapter that runs on the CPU when there is no GPU: correct, and slow
    #[arg(long, env = "FATHOM_ALLOW_CPU", value_parser = clap::builder::FalseyValueParser::new(), num_args = 0, default_missing_value = "true")]
    allow_cpu: Option<bool>,
    /// Most memory that may be taken of each GPU, bytes [default: all there is]
    #[arg(long, value_name = "BYTES", env = "FATHOM_GPU_MEMORY_LIMIT")]
    #[arg(value_parser = clap::value_parser!(u64).range(1..))]
    gpu_memory_limit: Option<u64>,
    /// Name of this worker in lists; with several GPUs, -gpu0 and so on follow [default: worker- and its process id]
    #[arg(long, env = "FATHOM_WORKER_NAME")]
    name: Option<String>,
    /// Folder for fetched photographs; may be shared and may be deleted [default: fathom-cache]
    #[arg(long, value_name = "DIR", env = "FATHOM_CACHE_DIR")]
    cache_dir: Option<PathBuf>,
    /// Size that this folder is kept under, bytes [default: 20 GiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_CACHE_BYTES")]
    cache_bytes: Option<u64>,
    /// Decoded photographs that are kept in memory, by all GPUs together, bytes [default: 1 GiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_IMAGE_CACHE_BYTES")]
    image_cache_bytes: Option<u64>,
    /// Address to serve metrics and health on over HTTP (/metrics, /healthz, /readyz), neither encrypted nor authenticated
    /// [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_WORKER_METRICS_LISTEN", value_parser = super::parse_address)]
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
    #[serde(default, deserialize_with = "gpu_names")]
    gpu: Vec<GpuName>,
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
        let gpu = if self.gpu.is_empty() { &file.gpu } else { &self.gpu };
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
            gpus: Gpus::named(gpu).map_err(CliError::Message)?,
            allow_cpu: self.allow_cpu.or(file.allow_cpu).unwrap_or(defaults.allow_cpu),
            gpu_memory_limit: self.gpu_memory_limit.or(file.gpu_memory_limit).or(defaults.gpu_memory_limit),
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

/// As on the command line, and also a number alone, or several.
fn gpu_names<'de, D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Vec<GpuName>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "for gpu use a number, several in brackets, or \"all\"")]
    enum Written {
        Number(usize),
        Numbers(Vec<usize>),
        Word(String),
    }
    match Written::deserialize(deserializer)? {
        Written::Number(number) => Ok(vec![GpuName::Number(number)]),
        Written::Numbers(numbers) => Ok(numbers.into_iter().map(GpuName::Number).collect()),
        Written::Word(word) => word.parse().map(|name| vec![name]).map_err(D::Error::custom),
    }
}

pub async fn run(args: WorkerArgs) -> Result<()> {
    let config = args.resolve()?;
    let failed = |error: WorkerError| match error {
        WorkerError::Core(error) => CliError::Core(error),
        other => CliError::Message(other.to_string()),
    };
    let chosen = config.clone();
    let gpus = tokio::task::spawn_blocking(move || gpus::open(&chosen))
        .await
        .map_err(|error| CliError::Message(format!("opening the GPUs: {error}")))?
        .map_err(failed)?;
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
    run_on(config, gpus, stopping).await.map_err(failed)
}

#[cfg(test)]
mod tests {
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
        assert_eq!((config.gpus, config.allow_cpu), (Gpus::These(vec![3]), true));
        assert_eq!(config.gpu_memory_limit, Some(7));

        let flags = [
            "--coordinator=http://b:2",
            "--name=b",
            "--cache-dir=b",
            "--cache-bytes=4",
            "--image-cache-bytes=5",
            "--metrics-listen=127.0.0.1:2",
            "--job-log-level=debug",
            "--gpu=6",
            "--gpu=4",
            "--gpu-memory-limit=8",
        ];
        let config = resolve(&[&["--config", file], &flags[..]].concat());
        assert_eq!((config.coordinator.url.as_str(), config.name.as_str()), ("http://b:2", "b"));
        assert_eq!((config.cache_dir, config.cache_bytes), (PathBuf::from("b"), 4));
        assert_eq!(config.image_cache_bytes, 5);
        assert_eq!(config.metrics_listen, Some(([127, 0, 0, 1], 2).into()));
        assert_eq!(config.job_log_level, LevelFilter::DEBUG);
        assert_eq!((config.gpus, config.gpu_memory_limit), (Gpus::These(vec![6, 4]), Some(8)));
        assert!(!resolve(&[]).allow_cpu && resolve(&["--allow-cpu"]).allow_cpu);
        assert_eq!(resolve(&["--gpu=all"]).gpus, Gpus::All);
        assert_eq!(resolve(&["--gpu=2,0"]).gpus, Gpus::These(vec![2, 0]), "as FATHOM_GPU has several");
    }

    #[test]
    fn the_file_names_one_gpu_several_or_all() {
        let read = |text: &str| -> std::result::Result<Gpus, String> {
            let file: WorkerFile = toml::from_str(text).map_err(|error| error.message().to_owned())?;
            Gpus::named(&file.gpu)
        };
        assert_eq!(read("gpu = [0, 2]"), Ok(Gpus::These(vec![0, 2])));
        assert_eq!(read("gpu = 'all'"), Ok(Gpus::All));
        assert_eq!(read("gpu = []"), Ok(Gpus::First));
        assert_eq!(read("gpu = 'most'"), Err("use a number of `fathom doctor`, or all".into()));
        assert_eq!(read("gpu = -1"), Err("for gpu use a number, several in brackets, or \"all\"".into()));
    }

    #[test]
    fn the_example_file_is_what_a_worker_has_without_one() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/worker.example.toml");
        let (example, without) = (resolve(&["--config", file]), resolve(&[]));
        assert_eq!(format!("{example:?}"), format!("{without:?}"));
    }
}
