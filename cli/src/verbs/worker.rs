//! `fathom worker`: dials a coordinator, takes tasks, trains, hands in.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fathom_worker::execute::CoreExecutor;
use fathom_worker::{WorkerConfig, run_with};
use tokio::sync::watch;

use super::ServiceArgs;
use crate::children;
use crate::error::{CliError, Result};
use crate::model::GpuArgs;

/// Time to checkpoint and give a task back when the parent process has gone; with it, the coordinator may have too.
const LEAVE_WITHIN: Duration = Duration::from_secs(5);

/// Arguments of `fathom worker`.
#[derive(Args, Debug)]
pub struct WorkerArgs {
    #[command(flatten)]
    service: ServiceArgs,
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
    /// Stop when standard input closes: for a parent process that must not leave it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub async fn run(args: WorkerArgs) -> Result<()> {
    let defaults = WorkerConfig::default();
    let config = WorkerConfig {
        coordinator_url: args.service.coordinator,
        name: args.name.unwrap_or(defaults.name),
        cache_dir: args.cache_dir.unwrap_or(defaults.cache_dir),
        cache_bytes: args.cache_bytes.unwrap_or(defaults.cache_bytes),
        gpu: args.gpu.options(),
        ..defaults
    };
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
