//! Log lines of jobs: from workers and the coordinator's own tasks to users.

use std::sync::Arc;
use std::time::Duration;

use fathom_observe::capture::{LoggedLine, tidy};
use fathom_observe::queue::{BATCH, Batch, Queue};
use fathom_proto::{v1, worker::v1 as worker_v1};
use futures::StreamExt;
use futures::stream::BoxStream;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tracing::Level;

use super::encode;
use crate::access::{Principal, Refused};
use crate::logs::{KeptLine, LogError, Logs, NewLine, Page, Position, Severity, Wanted};
use crate::schedule::{JobId, Lease, Refusal, TaskId};
use crate::service_error::ServiceError;
use crate::state::{State, stopped};
use crate::store::StoreError;

/// Time after the end of a job during which lines of its attempts are accepted.
const LATE_LINES_MS: u64 = 60_000;
/// Time that a follower waits after the end of a job for the last lines of its workers.
const LAST_LINES_MS: u64 = 2_000;
/// Lines per read, and the queue for a slow reader.
const PAGE: usize = 256;
/// Shortest and longest interval between reads of a follower.
const LOOK_EVERY: Duration = Duration::from_millis(200);
const LOOK_AT_LEAST_EVERY: Duration = Duration::from_secs(1);
/// Pause after which the coordinator's own lines are sent again when the database was away.
const AGAIN_AFTER: Duration = Duration::from_secs(1);
/// Worker name in lines of the coordinator.
const COORDINATOR: &str = "coordinator";

/// Stores lines that a worker logged under a lease.
pub async fn append(
    shared: &State,
    caller: &Principal,
    request: worker_v1::AppendLogsRequest,
) -> Result<(), ServiceError> {
    let lease = encode::required_lease(request.lease)?;
    shared.owner(caller, &lease.job).await?;
    let bad = |message: String| ServiceError::BadArgument { field: "lines", message };
    if request.lines.len() > BATCH {
        return Err(bad(format!("has {} entries, at most {BATCH} are allowed", request.lines.len())));
    }
    if request.lines.iter().any(|line| line.number == 0) {
        return Err(bad("has one with the number 0; they count from 1".into()));
    }
    let (worker, incarnation) = holder(shared, &lease).await?;
    let line = |line: worker_v1::LogLine| NewLine {
        from_worker: Some(line.number),
        time_ms: line.time.map_or(0, |time| encode::unix_ms(&time)),
        severity: severity(line.severity()).unwrap_or(Severity::Info),
        message: tidy(&line.message),
    };
    let lines: Vec<NewLine> = request.lines.into_iter().map(line).collect();
    if shared.logs.is_on_disk() {
        let bytes = lines.iter().map(|line| line.message.len() as u64).sum();
        shared.objects.check_space(bytes).await?;
    }
    let (attempt, holder) = ((lease.task, lease.attempt), (worker.as_str(), lease.fence));
    let is_said = |line: &&NewLine| line.severity >= Severity::Info;
    if let Some((last, incarnation)) = lines.iter().rev().find(is_said).zip(incarnation) {
        // By our clock: that of a worker may be wrong.
        shared.workers.heard(&incarnation, &last.message, shared.clock.now_ms());
    }
    Ok(shared.logs.append(&lease.job, attempt, holder, lines, shared.clock.now_ms()).await?)
}

/// The holder of a lease whose lines are still accepted: a task's latest attempt, or an earlier one whose
/// first lines were accepted. Its name, and while it holds the lease its incarnation.
async fn holder(shared: &State, lease: &Lease) -> Result<(String, Option<String>), ServiceError> {
    let job = shared.jobs.job_row(&lease.job).await?;
    let task = shared.jobs.task_row(&lease.job, lease.task).await?;
    let is_late = |ended_ms: u64| ended_ms.saturating_add(LATE_LINES_MS) < shared.clock.now_ms();
    if job.ended_ms.is_some_and(is_late) {
        return Err(StoreError::Refused(Refusal::JobEnded).into());
    }
    if let Some(attempt) = task.held_under(lease) {
        return Ok((attempt.worker.clone(), Some(attempt.incarnation.clone())));
    }
    let is_latest = lease.fence > 0 && (task.fence, task.attempts) == (lease.fence, lease.attempt);
    if is_latest && task.running().next().is_none() {
        return Ok((task.worker, None));
    }
    let earlier = shared.logs.holder(&lease.job, (lease.task, lease.attempt), lease.fence).await?;
    earlier.map(|worker| (worker, None)).ok_or_else(|| {
        let (task, given, latest) = (lease.task, lease.fence, task.fence);
        StoreError::Refused(Refusal::StaleFence { task, given, latest }).into()
    })
}

/// Writes a line about an attempt to its log.
pub fn note(shared: &State, lease: &Lease, level: Level, message: &str) {
    shared.own_lines.sink(lease.clone()).line(LoggedLine::now(level, message));
}

/// Stores the lines of the coordinator's own tasks until it stops.
pub async fn keep_own_lines(
    lines: Arc<Queue<Lease>>,
    logs: Arc<dyn Logs>,
    mut stopping: watch::Receiver<bool>,
) {
    let mut stops = stopping.clone();
    let keep = async {
        loop {
            let batch = lines.next().await;
            while let Err(error) = keep_batch(logs.as_ref(), &batch).await {
                let is_away = matches!(error, LogError::Store(StoreError::Unavailable(_)));
                if is_away && !*stops.borrow() {
                    // The database may come back. Without numbers of a worker, lines whose answer was lost
                    // are stored twice.
                    tokio::select! {
                        () = tokio::time::sleep(AGAIN_AFTER) => {}
                        () = stopped(&mut stops) => {}
                    }
                    continue;
                }
                tracing::warn!(%error, lines = batch.lines.len(), "lost lines of a job's log");
                break;
            }
            lines.remove(&batch);
        }
    };
    let end = async {
        stopped(&mut stopping).await;
        lines.emptied().await;
    };
    tokio::select! {
        biased;
        () = keep => {}
        () = end => {}
    }
}

async fn keep_batch(logs: &dyn Logs, batch: &Batch<Lease>) -> Result<(), LogError> {
    let new = batch.lines.iter().map(|(_, line)| NewLine {
        from_worker: None,
        time_ms: line.time_ms,
        severity: severity_of(line.level),
        message: line.message.clone(),
    });
    let now_ms = batch.lines.last().map_or(0, |(_, line)| line.time_ms);
    let (lease, holder) = (&batch.of, (COORDINATOR, batch.of.fence));
    logs.append(&lease.job, (lease.task, lease.attempt), holder, new.collect(), now_ms).await
}

/// Removes the log of a deleted job. The next garbage collection removes the rest after a failure.
pub async fn forget(shared: &State, job: &JobId) {
    if let Err(error) = shared.logs.remove(job).await {
        tracing::warn!(%job, %error, "could not remove the log of a job");
    }
}

/// The log lines of a job for a user.
pub async fn stream(
    shared: Arc<State>,
    caller: Principal,
    request: v1::StreamLogsRequest,
) -> Result<BoxStream<'static, Result<v1::LogEntry, Status>>, ServiceError> {
    let min_severity = request.min_severity();
    let v1::StreamLogsRequest { job_id, task_id, attempt, after_number, follow, .. } = request;
    let job: JobId = job_id.parse()?;
    shared.owner(&caller, &job).await?;
    let task = if task_id.is_empty() { None } else { Some(task_id.parse::<TaskId>()?) };
    let wanted = Wanted {
        task,
        attempt: (attempt > 0).then_some(attempt),
        severity: severity(min_severity).unwrap_or(Severity::Trace),
    };
    let (sender, receiver) = mpsc::channel(PAGE);
    let reader = Reader { shared, caller, job, wanted, follow, sender };
    tokio::spawn(async move {
        if let Err(error) = reader.run(Position::after(after_number)).await {
            // A reader that has left does not need the error.
            let _ = reader.sender.send(Err(error.into())).await;
        }
    });
    Ok(ReceiverStream::new(receiver).boxed())
}

struct Reader {
    shared: Arc<State>,
    caller: Principal,
    job: JobId,
    wanted: Wanted,
    follow: bool,
    sender: mpsc::Sender<Result<v1::LogEntry, Status>>,
}

impl Reader {
    async fn run(&self, mut position: Position) -> Result<(), ServiceError> {
        let mut appended = self.shared.logs.appended();
        let mut stopping = self.shared.stopping.clone();
        loop {
            appended.mark_unchanged();
            if !self.shared.access.still_holds(&self.caller, self.shared.clock.now_ms()) {
                return Err(Refused::NotValid.into());
            }
            // Read before the lines: no line arrives after this.
            let ended_ms = self.shared.jobs.job_row(&self.job).await?.ended_ms;
            let is_over =
                ended_ms.is_some_and(|ended_ms| ended_ms + LAST_LINES_MS <= self.shared.clock.now_ms());
            let mut more = true;
            while more {
                let lines;
                Page { lines, position, more } =
                    self.shared.logs.read(&self.job, &self.wanted, position, PAGE).await?;
                for line in lines {
                    if self.sender.send(Ok(entry(line))).await.is_err() {
                        return Ok(());
                    }
                }
                if self.sender.is_closed() {
                    return Ok(());
                }
            }
            if !self.follow || is_over {
                return Ok(());
            }
            tokio::time::sleep(LOOK_EVERY).await;
            tokio::select! {
                biased;
                () = self.sender.closed() => return Ok(()),
                () = stopped(&mut stopping) => return Ok(()),
                _ = appended.changed() => {}
                () = tokio::time::sleep(LOOK_AT_LEAST_EVERY) => {}
            }
        }
    }
}

fn entry(KeptLine { task, attempt, row }: KeptLine) -> v1::LogEntry {
    let severity = match row.severity {
        Severity::Trace => v1::LogSeverity::Trace,
        Severity::Debug => v1::LogSeverity::Debug,
        Severity::Info => v1::LogSeverity::Info,
        Severity::Warn => v1::LogSeverity::Warn,
        Severity::Error => v1::LogSeverity::Error,
    };
    v1::LogEntry {
        time: Some(encode::timestamp(row.time_ms)),
        severity: severity.into(),
        task_id: task.to_string(),
        attempt,
        worker: row.worker,
        message: row.message,
        number: row.number,
    }
}

fn severity(severity: v1::LogSeverity) -> Option<Severity> {
    match severity {
        v1::LogSeverity::Unspecified => None,
        v1::LogSeverity::Trace => Some(Severity::Trace),
        v1::LogSeverity::Debug => Some(Severity::Debug),
        v1::LogSeverity::Info => Some(Severity::Info),
        v1::LogSeverity::Warn => Some(Severity::Warn),
        v1::LogSeverity::Error => Some(Severity::Error),
    }
}

fn severity_of(level: Level) -> Severity {
    match level {
        Level::TRACE => Severity::Trace,
        Level::DEBUG => Severity::Debug,
        Level::INFO => Severity::Info,
        Level::WARN => Severity::Warn,
        Level::ERROR => Severity::Error,
    }
}
