//! Calls that are repeated until they are answered.

use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder};
use fathom_proto::dial::reason;
use tonic::{Code, Status};

/// First pause between two tries.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Longest pause between two tries: a coordinator that comes back is noticed within it.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// Repeats `call` until it succeeds or fails for a reason that will not pass.
///
/// # Errors
/// The first status that will not pass.
pub async fn until_answered<T, F>(what: &str, mut call: impl FnMut() -> F) -> Result<T, Status>
where
    F: Future<Output = Result<T, Status>>,
{
    let mut pauses = pauses();
    let mut told = false;
    loop {
        let status = match call().await {
            Ok(answer) => return Ok(answer),
            Err(status) if will_pass(&status) => status,
            Err(status) => return Err(status),
        };
        if !told {
            tracing::warn!(what, error = %status.message(), "no answer from the coordinator; trying again");
            told = true;
        }
        tokio::time::sleep(pauses.next().unwrap_or(LONGEST_PAUSE)).await;
    }
}

/// Pauses between tries, growing to the longest, a little random so that workers do not call in step.
pub fn pauses() -> impl Iterator<Item = Duration> {
    ExponentialBuilder::new()
        .with_min_delay(FIRST_PAUSE)
        .with_max_delay(LONGEST_PAUSE)
        .with_jitter()
        .without_max_times()
        .build()
}

/// Whether the same call may succeed later. What the coordinator itself says carries a reason; without one it
/// is the connection that failed.
pub fn will_pass(status: &Status) -> bool {
    match reason(status) {
        Some(_) => matches!(status.code(), Code::Unavailable | Code::Aborted | Code::ResourceExhausted),
        None => matches!(
            status.code(),
            Code::Unavailable | Code::Unknown | Code::Internal | Code::Cancelled | Code::DeadlineExceeded
        ),
    }
}

/// Whether this worker may not work any more: its token was revoked or has expired, or it shows no certificate.
pub fn is_sent_away(status: &Status) -> bool {
    matches!(status.code(), Code::Unauthenticated | Code::PermissionDenied) && reason(status).is_some()
}

/// Whether the lease is over: the work is to be thrown away.
pub fn is_over(status: &Status) -> bool {
    matches!(
        reason(status).as_deref(),
        Some("STALE_FENCE" | "JOB_ENDED" | "JOB_NOT_FOUND" | "TASK_NOT_FOUND")
    )
}
