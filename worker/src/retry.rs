//! Calls that are repeated until they are answered.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder};
use fathom_proto::dial::{cause, reason};
use tokio::time::Instant;
use tonic::{Code, Status};

/// First pause between two tries.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Longest pause between two tries: a coordinator that comes back is noticed within it.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// Who waits for a coordinator hears of it at the first failure, and then so often.
const TELL_EVERY: Duration = Duration::from_secs(60);

/// Why calls are repeated now: what a worker says when it leaves without an answer. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Trouble(Arc<Mutex<Option<String>>>);

impl Trouble {
    /// The reason of the latest failure; `None` when the latest call was answered.
    pub fn latest(&self) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn note(&self, reason: Option<String>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = reason;
    }
}

/// One call that is repeated: says why, not at every repetition.
pub struct Repeated<'a> {
    what: &'a str,
    trouble: &'a Trouble,
    told: Option<Instant>,
}

impl<'a> Repeated<'a> {
    /// `what` is named in the log.
    pub fn new(what: &'a str, trouble: &'a Trouble) -> Self {
        Self { what, trouble, told: None }
    }

    /// It failed with `status` and is made again.
    pub fn again(&mut self, status: &Status) {
        let reason = cause(status);
        if self.told.is_none_or(|told| told.elapsed() >= TELL_EVERY) {
            tracing::warn!(what = self.what, %reason, "no answer from the coordinator; trying again");
            self.told = Some(Instant::now());
        }
        self.trouble.note(Some(reason));
    }

    /// It was answered.
    pub fn answered(&self) {
        self.trouble.note(None);
        if self.told.is_some() {
            tracing::info!(what = self.what, "the coordinator answers again");
        }
    }
}

/// Repeats `call` until it succeeds or fails for a reason that will not pass.
///
/// # Errors
/// The first status that will not pass.
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

/// Whether this worker may not work any more: its token was revoked or has expired, or it shows no
/// certificate.
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
