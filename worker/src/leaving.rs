//! Waiting for the request to leave, and for the time that a leaving worker has.

use std::time::Duration;

use tokio::sync::watch;

/// Time limit for a leaving worker to submit a finished result. Service managers kill a process that takes
/// too long (`TimeoutStopSec` in `deploy/fathom-worker.service`).
pub const SUBMIT_WITHIN: Duration = Duration::from_secs(30);

/// Completes when the worker is asked to leave.
pub async fn stop_requested(stopping: &mut watch::Receiver<bool>) {
    // An error means that the sender is gone: then only the end of the process ends the work.
    if stopping.wait_for(|stopping| *stopping).await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// Completes `patience` after the worker was asked to leave.
pub async fn leave_deadline(stopping: &mut watch::Receiver<bool>, patience: Duration) {
    stop_requested(stopping).await;
    tokio::time::sleep(patience).await;
}
