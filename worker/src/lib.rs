//! The worker of Fathom: dials in, takes tasks, trains, checkpoints, hands in.
//!
//! Three things run apart. The session (async) claims, fetches, uploads and completes. Training runs on a thread
//! of its own and knows nothing of the network. The heartbeat has a thread and a runtime of its own too, so
//! that neither a busy GPU nor a long upload can make this worker look dead. When the coordinator is away,
//! training goes on, and everything that has to be said is said again until it is heard.

pub mod blobs;
pub mod cache;
mod config;
mod error;
pub mod execute;
mod fetch;
mod heartbeat;
mod logs;
mod metrics;
mod retry;
mod session;
mod views;

use std::sync::Arc;

use fathom_observe::{capture, http};
use tokio::net::TcpListener;
use tokio::sync::watch;

pub use config::WorkerConfig;
pub use error::WorkerError;
pub use views::PhotographSource;

use execute::{CoreExecutor, Executor};
use metrics::Endpoint;

/// Works until SIGTERM or Ctrl-C: then checkpoints, gives its task back, and leaves.
///
/// # Errors
/// When there is no adapter that may be used, the cache cannot be opened, or the coordinator refuses this worker.
pub async fn run(config: WorkerConfig) -> Result<(), WorkerError> {
    let gpu = config.gpu;
    let image_cache_bytes = config.image_cache_bytes;
    let executor = tokio::task::spawn_blocking(move || CoreExecutor::new(gpu, image_cache_bytes))
        .await
        .map_err(|e| WorkerError::Thread(e.to_string()))??;
    let (stop, stopping) = watch::channel(false);
    tokio::spawn(async move {
        asked_to_leave().await;
        tracing::info!("asked to leave: giving the task back");
        stop.send_replace(true);
        // Keeps the channel open: a closed one would read as a signal too.
        std::future::pending::<()>().await;
    });
    run_with(config, Arc::new(executor), stopping).await
}

/// Works with any executor until `stopping` turns true: what tests and embedders use.
///
/// # Errors
/// As [`run`].
pub async fn run_with(
    config: WorkerConfig,
    executor: Arc<dyn Executor>,
    stopping: watch::Receiver<bool>,
) -> Result<(), WorkerError> {
    capture::set_level(config.job_log_level);
    let listener = match config.metrics_listen {
        Some(listen) => {
            Some(TcpListener::bind(listen).await.map_err(|source| WorkerError::Listen { listen, source })?)
        }
        None => None,
    };
    let session = session::Session::open(config, Arc::clone(&executor), stopping)?;
    let endpoint = Arc::new(Endpoint { metrics: session.metrics(), executor });
    let served = async {
        match listener {
            Some(listener) => http::serve(listener, endpoint).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        biased;
        ended = session.run() => ended,
        never = served => match never {},
    }
}

#[cfg(unix)]
async fn asked_to_leave() {
    use tokio::signal::unix::{SignalKind, signal};
    match signal(SignalKind::terminate()) {
        Ok(mut terminate) => {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = tokio::signal::ctrl_c() => {}
            }
        }
        Err(error) => {
            tracing::warn!(%error, "SIGTERM cannot be heard, only Ctrl-C");
            let _ = tokio::signal::ctrl_c().await;
        }
    }
}

#[cfg(not(unix))]
async fn asked_to_leave() {
    let _ = tokio::signal::ctrl_c().await;
}
