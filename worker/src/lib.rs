//! The worker of Fathom: connects, claims tasks, trains, checkpoints, submits results.
//!
//! Three parts run separately. The session (async) claims, fetches, uploads and completes. Training runs on
//! its own thread without network access. The heartbeat also has its own thread and runtime, so that neither
//! a busy GPU nor a long upload makes this worker look dead. While the coordinator is down, training
//! continues, and all calls are retried until they are answered.
//!
//! With several GPUs, each has these three parts and appears as a worker to the coordinator. They share the
//! cache, the metrics and the stop signal; a failed one does not end the others.

pub mod blobs;
pub mod cache;
mod config;
mod error;
pub mod execute;
mod fetch;
pub mod gpus;
mod heartbeat;
mod leaving;
mod logs;
mod metrics;
mod retry;
mod session;
mod training_thread;
mod views;

use std::collections::HashMap;
use std::sync::Arc;

use fathom_observe::{capture, http};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;

pub use config::{IdleLimit, WorkerConfig};
pub use error::WorkerError;
pub use gpus::{Gpus, OnGpu};
pub use views::PhotographSource;

use cache::BlobCache;
use execute::Executor;
use metrics::{Endpoint, GpuMetrics, Metrics};
use session::Session;

/// Works until SIGTERM or Ctrl-C, then checkpoints, returns its tasks and leaves.
///
/// # Errors
/// As [`gpus::open`] and [`run_on`].
pub async fn run(config: WorkerConfig) -> Result<(), WorkerError> {
    let chosen = config.clone();
    let gpus = tokio::task::spawn_blocking(move || gpus::open(&chosen))
        .await
        .map_err(|e| WorkerError::Thread(e.to_string()))??;
    let (stop, stopping) = watch::channel(false);
    tokio::spawn(async move {
        asked_to_leave().await;
        tracing::info!("stop requested: returning the task");
        stop.send_replace(true);
        // Keeps the channel open: a closed one would read as a signal too.
        std::future::pending::<()>().await;
    });
    run_on(config, gpus, stopping).await
}

/// Works with any executor until `stopping` turns true; for tests and embedders.
///
/// # Errors
/// As [`run_on`].
pub async fn run_with(
    config: WorkerConfig,
    executor: Arc<dyn Executor>,
    stopping: watch::Receiver<bool>,
) -> Result<(), WorkerError> {
    run_on(config, vec![OnGpu { number: 0, executor }], stopping).await
}

/// Works on each of `gpus` until `stopping` turns true. A failure of one is logged and the others continue.
///
/// # Errors
/// When the cache cannot be opened or the metrics address cannot be bound. When all GPUs have ended, the
/// first error that ended one, for example a refusal by the coordinator.
pub async fn run_on(
    config: WorkerConfig,
    gpus: Vec<OnGpu>,
    stopping: watch::Receiver<bool>,
) -> Result<(), WorkerError> {
    capture::set_level(config.job_log_level);
    let listener = match config.metrics_listen {
        Some(listen) => {
            Some(TcpListener::bind(listen).await.map_err(|source| WorkerError::Listen { listen, source })?)
        }
        None => None,
    };
    let cache = BlobCache::open(&config.cache_dir, config.cache_bytes)?;
    let metrics = Arc::new(Metrics::default());
    let are_several = gpus.len() > 1;
    let (mut sessions, mut names, mut observed) = (JoinSet::new(), HashMap::new(), Vec::new());
    for OnGpu { number, executor } in gpus {
        let name = if are_several { format!("{}-gpu{number}", config.name) } else { config.name.clone() };
        let config = WorkerConfig { name: name.clone(), ..config.clone() };
        let counted = Arc::new(GpuMetrics::of(&metrics, number));
        observed.push((Arc::clone(&counted), Arc::clone(&executor)));
        let cache = cache.for_another(Arc::clone(&counted));
        let session = Session::open(config, executor, cache, Arc::clone(&counted), stopping.clone())?;
        names.insert(sessions.spawn(session.run()).id(), (name, counted));
    }
    let endpoint = Arc::new(Endpoint { metrics, gpus: observed });
    let served = async {
        match listener {
            Some(listener) => http::serve(listener, endpoint).await,
            None => std::future::pending().await,
        }
    };
    let all_ended = async {
        let mut first = Ok(());
        while let Some(joined) = sessions.join_next_with_id().await {
            let (id, ended) = match joined {
                Ok(ended) => ended,
                // A panic, which was printed on stderr.
                Err(error) => (error.id(), Err(WorkerError::Thread(error.to_string()))),
            };
            let Some((name, counted)) = names.remove(&id) else { continue };
            counted.session_ended();
            let Err(source) = ended else { continue };
            let error = if are_several {
                tracing::error!(worker = %name, error = %source, left = names.len(), "this GPU takes no more tasks");
                WorkerError::Gpu { worker: name, source: Box::new(source) }
            } else {
                source
            };
            first = first.and(Err(error));
        }
        first
    };
    tokio::select! {
        biased;
        ended = all_ended => ended,
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
            tracing::warn!(%error, "SIGTERM cannot be handled, only Ctrl-C");
            let _ = tokio::signal::ctrl_c().await;
        }
    }
}

#[cfg(not(unix))]
async fn asked_to_leave() {
    let _ = tokio::signal::ctrl_c().await;
}
