//! `fathom worker`: connects to a coordinator, takes tasks, trains, and submits the results.

use std::net::SocketAddr;
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fathom_proto::dial::Dial;
use fathom_worker::gpus::{self, GpuName};
use fathom_worker::{IdleLimit, WorkerConfig, WorkerError, run_on};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::sync::watch;

use super::workers::Manage;
use crate::children;
use crate::dial_args::{DialArgs, HEADING};
use crate::error::{CliError, Result};
use crate::settings::{Declaration, Flags};

/// Time to checkpoint and return a task after the parent process has ended; the coordinator may have ended
/// too.
const LEAVE_WITHIN: Duration = Duration::from_secs(5);

/// Arguments of `fathom worker`: without a subcommand it runs one.
#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true)]
pub struct WorkerArgs {
    #[command(subcommand)]
    manage: Option<Manage>,
    #[command(flatten)]
    run: RunArgs,
}

/// Arguments of a worker that runs.
#[derive(Args, Debug)]
struct RunArgs {
    #[command(flatten)]
    settings: Flags<WorkerSettings>,
    /// TOML file with these settings, under the names of the flags with _ for -; flags and environment win
    #[arg(long, value_name = "FILE", env = "FATHOM_WORKER_CONFIG")]
    config: Option<PathBuf>,
    /// Stop when standard input closes, so that a parent process never leaves it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// The settings of a worker. Each is a field of [`WorkerConfig`], which has the default, or of the
/// connection.
#[derive(Args, Debug, Serialize)]
pub struct WorkerSettings {
    /// URL of the coordinator, or several with commas between them: the first that answers is used, and the
    /// next one when it is lost
    #[arg(long, value_name = "URL", help_heading = HEADING, env = "FATHOM_COORDINATOR")]
    coordinator: Option<String>,
    #[command(flatten)]
    #[serde(flatten)]
    dial: DialArgs,
    /// GPU number in `fathom doctor`, or all for every real GPU; several (--gpu 0 --gpu 2, in the file [0,
    /// 2]) run a task each [default: the first real GPU]
    #[arg(long, value_name = "N", env = "FATHOM_GPU", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    gpu: Vec<GpuName>,
    /// Use the CPU, through its Vulkan driver, when there is no GPU: correct, but slow
    #[arg(long, env = "FATHOM_ALLOW_CPU", value_parser = clap::builder::FalseyValueParser::new(), num_args = 0, default_missing_value = "true")]
    allow_cpu: Option<bool>,
    /// Memory that the worker may use of each GPU, bytes [default: all of it]
    #[arg(long, value_name = "BYTES", env = "FATHOM_GPU_MEMORY_LIMIT")]
    #[arg(value_parser = clap::value_parser!(u64).range(1..))]
    gpu_memory_limit: Option<u64>,
    /// Display name of this worker; with several GPUs, -gpu0 and so on are appended
    /// [default: worker- and its process id]
    #[arg(long, value_name = "NAME", env = "FATHOM_WORKER_NAME")]
    name: Option<String>,
    /// Folder for fetched photographs; workers of a machine may share it, and you may delete it
    #[arg(long, value_name = "DIR", env = "FATHOM_CACHE_DIR")]
    cache_dir: Option<PathBuf>,
    /// Size limit of this folder, bytes
    #[arg(long, value_name = "BYTES", env = "FATHOM_CACHE_BYTES")]
    cache_bytes: Option<u64>,
    /// Memory for decoded photographs, shared by all GPUs, bytes
    #[arg(long, value_name = "BYTES", env = "FATHOM_IMAGE_CACHE_BYTES")]
    image_cache_bytes: Option<u64>,
    /// Address that serves metrics and health over plain HTTP (/metrics, /healthz, /readyz), without
    /// authentication [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_WORKER_METRICS_LISTEN", value_parser = super::parse_address)]
    metrics_listen: Option<SocketAddr>,
    /// Least severe level of log lines that the job's user sees
    #[arg(long, value_name = "LEVEL", env = "FATHOM_JOB_LOG_LEVEL")]
    #[arg(value_parser = ["off", "error", "warn", "info", "debug"])]
    job_log_level: Option<String>,
    /// End after this long without a task, such as 120s or 5m; each GPU counts for itself [default: never]
    #[arg(long, value_name = "TIME", env = "FATHOM_EXIT_WHEN_IDLE")]
    exit_when_idle: Option<IdleLimit>,
    /// End after so many tasks of each GPU [default: no limit]
    #[arg(long, value_name = "N", env = "FATHOM_MAX_TASKS", value_parser = one_or_more)]
    max_tasks: Option<NonZeroU32>,
}

/// The resolved settings of a worker.
#[derive(Deserialize)]
pub struct Resolved {
    coordinator: String,
    #[serde(flatten)]
    dial: DialArgs,
    #[serde(flatten)]
    config: WorkerConfig,
}

impl Declaration for WorkerSettings {
    type Resolved = Resolved;

    fn defaults() -> serde_json::Result<Value> {
        let mut defaults = serde_json::to_value(WorkerConfig::default())?;
        for key in ["token_file", "tls_ca", "tls_cert", "tls_key"] {
            defaults[key] = Value::Null;
        }
        defaults["insecure"] = false.into();
        defaults["coordinator"] = Dial::default().url.into();
        Ok(defaults)
    }
}

fn one_or_more(text: &str) -> std::result::Result<NonZeroU32, String> {
    text.parse().map_err(|_| "use a whole number from 1 on".to_owned())
}

impl RunArgs {
    fn resolve(&self) -> Result<WorkerConfig> {
        let Resolved { coordinator, dial, config } = self.settings.resolve(self.config.as_deref())?;
        Ok(WorkerConfig { coordinator: dial.dial(&coordinator)?, ..config })
    }
}

impl WorkerArgs {
    /// Whether it runs a worker, until that is stopped.
    pub fn is_service(&self) -> bool {
        self.manage.is_none()
    }
}

pub async fn run(args: WorkerArgs) -> Result<()> {
    match args.manage {
        Some(manage) => manage.run().await,
        None => work(args.run).await,
    }
}

async fn work(args: RunArgs) -> Result<()> {
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
                // An error means that the thread has ended, and with it the parent's pipe.
                Some(gone) => drop(gone.await),
                None => std::future::pending().await,
            }
        };
        let parent_has_gone = tokio::select! {
            () = gone => true,
            () = children::stop_signal() => false,
        };
        tracing::info!("asked to leave: returning the task");
        stop.send_replace(true);
        if parent_has_gone {
            tokio::time::sleep(LEAVE_WITHIN).await;
            std::process::exit(0);
        }
        // Keeps the channel open: closing it would also signal a stop.
        std::future::pending::<()>().await;
    });
    run_on(config, gpus, stopping).await.map_err(failed)
}

#[cfg(test)]
mod tests {
    use fathom_worker::Gpus;

    use super::*;
    use crate::verbs::{Verb, parsed};

    fn resolve(words: &[&str]) -> Result<WorkerConfig> {
        let Verb::Worker(args) = parsed(&[&["worker"], words].concat()) else { panic!("another verb") };
        args.run.resolve()
    }

    #[test]
    fn flags_win_over_the_file_and_the_file_over_defaults() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("worker.toml");
        let text = "coordinator = 'http://a:1'\ninsecure = true\nallow_cpu = true\ncache_bytes = 1\n\
                    gpu = 3\njob_log_level = 'warn'\n";
        std::fs::write(&file, text).unwrap();
        let file = file.to_str().unwrap();
        let config = resolve(&["--config", file]).unwrap();
        assert_eq!((config.coordinator.url.as_str(), config.coordinator.insecure), ("http://a:1", true));
        assert_eq!((config.gpus, config.allow_cpu, config.cache_bytes), (Gpus::These(vec![3]), true, 1));
        assert_eq!(config.job_log_level.to_string(), "warn");
        assert_eq!(config.image_cache_bytes, WorkerConfig::default().image_cache_bytes);

        let flags = ["--coordinator=http://b:2", "--gpu=6", "--gpu=4", "--job-log-level=debug"];
        let config = resolve(&[&["--config", file], &flags[..]].concat()).unwrap();
        assert_eq!((config.coordinator.url.as_str(), config.coordinator.insecure), ("http://b:2", true));
        assert_eq!((config.gpus, config.cache_bytes), (Gpus::These(vec![6, 4]), 1));
        assert_eq!(config.job_log_level.to_string(), "debug");
        assert!(!resolve(&[]).unwrap().allow_cpu && resolve(&["--allow-cpu"]).unwrap().allow_cpu);
        assert_eq!(resolve(&["--gpu=all"]).unwrap().gpus, Gpus::All);
        assert_eq!(
            resolve(&["--gpu=2,0"]).unwrap().gpus,
            Gpus::These(vec![2, 0]),
            "as FATHOM_GPU has several"
        );
    }

    #[test]
    fn every_setting_is_a_key_of_the_file_and_a_flag() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("worker.toml");
        // (key and value in the file, the same as flags, another value as a flag)
        let settings = [
            ("name = 'a'", "--name=a", "--name=b"),
            ("cache_dir = 'c'", "--cache-dir=c", "--cache-dir=d"),
            ("cache_bytes = 1", "--cache-bytes=1", "--cache-bytes=2"),
            ("image_cache_bytes = 3", "--image-cache-bytes=3", "--image-cache-bytes=4"),
            ("metrics_listen = '127.0.0.1:1'", "--metrics-listen=127.0.0.1:1", "--metrics-listen=[::1]:2"),
            ("gpu_memory_limit = 5", "--gpu-memory-limit=5", "--gpu-memory-limit=6"),
            ("job_log_level = 'warn'", "--job-log-level=warn", "--job-log-level=off"),
            ("gpu = 3", "--gpu=3", "--gpu=4"),
            ("exit_when_idle = '2m'", "--exit-when-idle=120s", "--exit-when-idle=1h"),
            ("max_tasks = 7", "--max-tasks=7", "--max-tasks=8"),
            (
                "coordinator = 'http://127.0.0.1:1'",
                "--coordinator=http://127.0.0.1:1",
                "--coordinator=http://[::1]:2",
            ),
        ];
        let resolved = |words: &[&str]| format!("{:?}", resolve(words).unwrap());
        for (in_file, same, other) in settings {
            std::fs::write(&file, in_file).unwrap();
            let file = ["--config", file.to_str().unwrap()];
            assert_eq!(resolved(&file), resolved(&[same]), "{in_file}");
            assert_ne!(resolved(&file), resolved(&[]), "{in_file} changes nothing");
            assert_eq!(resolved(&[&file[..], &[other]].concat()), resolved(&[other]), "{other} does not win");
        }
    }

    #[test]
    fn the_file_names_one_gpu_several_or_all() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("worker.toml");
        let read = |text: &str| {
            std::fs::write(&file, text).unwrap();
            resolve(&["--config", file.to_str().unwrap()])
                .map(|config| config.gpus)
                .map_err(|error| error.to_string())
        };
        assert_eq!(read("gpu = [0, 2]"), Ok(Gpus::These(vec![0, 2])));
        assert_eq!(read("gpu = 'all'"), Ok(Gpus::All));
        assert_eq!(read("gpu = []"), Ok(Gpus::First));
        for (text, part) in [
            ("gpu = 'most'", "line 1: gpu: use a number of `fathom doctor`, or all"),
            ("gpu = -1", "for gpu use a number, several in brackets, or \"all\""),
            ("gpu = [0, 'all']", "the GPUs 0, all: use either numbers or all"),
            ("gpus = 1", "unknown key `gpus`"),
            ("exit_when_idle = '1 minuet'", "exit_when_idle: unknown time unit \"minuet\""),
            ("exit_when_idle = 5", "exit_when_idle: write a time in quotes, such as \"120s\""),
            ("exit_when_idle = '10ms'", "exit_when_idle: use at least 1s"),
            ("job_log_level = 'loud'", "job_log_level: use off, error, warn, info or debug"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn the_example_file_is_what_a_worker_has_without_one() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/worker.example.toml");
        let [example, without] =
            [&["--config", file][..], &[]].map(|words| format!("{:?}", resolve(words).unwrap()));
        assert_eq!(example, without);
    }

    #[test]
    fn workers_are_managed_by_subcommands() {
        let is_service = |words: &[&str]| parsed(&[&["worker"], words].concat()).is_service();
        assert!(is_service(&[]) && is_service(&["--gpu=all"]));
        for words in [&["list"][..], &["drain", "gpu-7", "--reason=x"], &["cordon", "a"], &["uncordon", "a"]]
        {
            assert!(!is_service(words), "{words:?}");
        }
    }
}
