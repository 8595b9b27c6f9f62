//! Retries calls until they are answered.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder};
use fathom_proto::dial::{cause, reason};
use tokio::time::Instant;
use tonic::{Code, Status};

/// First pause between two attempts.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Longest pause between two attempts: a returning coordinator is noticed within it.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// Log a missing answer at the first failure, then at this interval.
const LOG_EVERY: Duration = Duration::from_secs(60);

/// The reason why calls are being retried, for the log of a worker that leaves without an answer. Clones
/// share it.
#[derive(Clone, Debug, Default)]
pub struct Trouble(Arc<Mutex<Option<String>>>);

impl Trouble {
    /// The reason of the last failure; `None` if the last call was answered.
    pub fn latest(&self) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn note(&self, reason: Option<String>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = reason;
    }
}

/// One retried call; logs the reason, but not at every retry.
pub struct Repeated<'a> {
    what: &'a str,
    trouble: &'a Trouble,
    logged: Option<Instant>,
}

impl<'a> Repeated<'a> {
    /// The log names `what`.
    pub fn new(what: &'a str, trouble: &'a Trouble) -> Self {
        Self { what, trouble, logged: None }
    }

    /// The call failed with `status` and will be retried.
    pub fn again(&mut self, status: &Status) {
        let reason = cause(status);
        if self.logged.is_none_or(|logged| logged.elapsed() >= LOG_EVERY) {
            tracing::warn!(what = self.what, %reason, "no answer from the coordinator; trying again");
            self.logged = Some(Instant::now());
        }
        self.trouble.note(Some(reason));
    }

    /// The call was answered.
    pub fn answered(&self) {
        self.trouble.note(None);
        if self.logged.is_some() {
            tracing::info!(what = self.what, "the coordinator answers again");
        }
    }
}

/// Retries `call` until it succeeds or fails permanently.
///
/// # Errors
/// The first permanent failure.
pub async fn until_answered<T, F>(
    what: &str,
    trouble: &Trouble,
    mut call: impl FnMut() -> F,
) -> Result<T, Status>
where
    F: Future<Output = Result<T, Status>>,
{
    let mut pauses = pauses();
    let mut repeated = Repeated::new(what, trouble);
    loop {
        match call().await {
            Ok(answer) => {
                repeated.answered();
                return Ok(answer);
            }
            Err(status) if will_pass(&status) => repeated.again(&status),
            Err(status) => return Err(status),
        }
        tokio::time::sleep(pauses.next().unwrap_or(LONGEST_PAUSE)).await;
    }
}

/// Growing pauses between attempts, randomised so that workers do not call in step.
pub fn pauses() -> impl Iterator<Item = Duration> {
    ExponentialBuilder::new()
        .with_min_delay(FIRST_PAUSE)
        .with_max_delay(LONGEST_PAUSE)
        .with_jitter()
        .without_max_times()
        .build()
}

/// Whether the same call may succeed later. The coordinator's own errors carry a reason; an error without one
/// is a connection failure.
pub fn will_pass(status: &Status) -> bool {
    match reason(status) {
        Some(_) => matches!(status.code(), Code::Unavailable | Code::Aborted | Code::ResourceExhausted),
        None => matches!(
            status.code(),
            Code::Unavailable | Code::Unknown | Code::Internal | Code::Cancelled | Code::DeadlineExceeded
        ),
    }
}

/// Whether this worker is no longer authorised: its token was revoked or expired, or it presents no
/// certificate.
pub fn is_sent_away(status: &Status) -> bool {
    matches!(status.code(), Code::Unauthenticated | Code::PermissionDenied) && reason(status).is_some()
}

/// Whether the lease has expired, so the work must be discarded.
pub fn is_over(status: &Status) -> bool {
    matches!(
        reason(status).as_deref(),
        Some("STALE_FENCE" | "JOB_ENDED" | "JOB_NOT_FOUND" | "TASK_NOT_FOUND")
    )
}
