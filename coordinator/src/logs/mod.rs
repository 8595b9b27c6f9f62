//! Log lines and histories of jobs; they outlive the worker of an attempt. A data directory keeps them in
//! files ([`JobLogs`]), a database in tables (`store/postgres/logs.rs`), where all its coordinators see them.
//!
//! Each line has a number that ascends in its job in the order of arrival (microseconds of the clock, so that
//! it ascends over restarts as well). Numbers of lines are even; odd ones are for notices to readers.
//! Invariant: a number that [`Logs::read`] may return is stored, and so are all smaller ones.
//!
//! Of a long attempt only the first and the latest lines are kept, by segments: when there is one too many,
//! the second is removed. Nothing is synced: a power cut may lose the latest lines, but never affects an
//! answer of the service. The history of a task is one small value that is replaced (`crate::history`).

mod files;
mod read;
mod segment;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tonic::async_trait;

pub use self::files::JobLogs;
pub use self::read::Position;
use crate::objects::ObjectError;
use crate::schedule::{JobId, TaskId};
use crate::store::{Store, StoreError};

/// Attempts of a task whose lines are kept: a task that is released repeatedly must not fill the disk.
pub const ATTEMPTS_KEPT: u32 = 16;
/// Segments of an attempt: its first, the two full ones before the latest, and the latest.
pub const SEGMENTS: u64 = 4;
/// Maximum lines examined in one call, so that a selective reader can be stopped in between.
pub const LOOKED_AT: usize = 4096;
/// Bytes that an attempt keeps, by default.
pub const ATTEMPT_BYTES: u64 = 4 << 20;
/// Bytes of a segment when logs are copied: nothing is removed then, whatever the coordinator's setting is.
pub const COPIED_SEGMENT_BYTES: u64 = ATTEMPT_BYTES / SEGMENTS;
/// The notice in place of removed lines.
const CUT: &str = "lines were removed here: of a long attempt only the first and the latest are kept";

/// Severity of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    Trace,
    Debug,
    Info,
    Warn,
    Error,
}

impl Severity {
    /// All, in their order.
    pub const ALL: [Self; 5] = [Self::Trace, Self::Debug, Self::Info, Self::Warn, Self::Error];
}

/// A new line.
#[derive(Clone, Debug)]
pub struct NewLine {
    /// Its number among the worker's lines of this attempt, from 1; `None` for lines of the coordinator.
    pub from_worker: Option<u64>,
    /// When, Unix milliseconds.
    pub time_ms: u64,
    /// Severity.
    pub severity: Severity,
    /// The message.
    pub message: String,
}

/// A stored line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeptLine {
    /// Its task.
    pub task: TaskId,
    /// Its attempt.
    pub attempt: u32,
    /// The rest.
    pub row: Row,
}

/// A line in a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Row {
    /// Ascends in the job.
    pub number: u64,
    /// See [`NewLine::from_worker`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from_worker: Option<u64>,
    /// When, Unix milliseconds.
    pub time_ms: u64,
    /// Severity.
    pub severity: Severity,
    /// The worker of the attempt.
    pub worker: String,
    /// The message.
    pub message: String,
}

impl Row {
    /// The notice that lines before this one were removed. No line has its number, which is odd.
    pub fn notice(&self) -> Self {
        let (from_worker, severity, message) = (None, Severity::Warn, CUT.to_owned());
        Self { number: self.number - 1, from_worker, severity, message, ..self.clone() }
    }

    /// Whether it is a notice to readers instead of a line.
    pub fn is_notice(&self) -> bool {
        self.number % 2 == 1
    }
}

/// An attempt of a job.
pub type Attempt = (TaskId, u32);

/// A filter of lines.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// The task; `None` for all.
    pub task: Option<TaskId>,
    /// The attempt; `None` for all.
    pub attempt: Option<u32>,
    /// The minimum severity.
    pub severity: Severity,
}

impl Wanted {
    /// Every line.
    pub const ALL: Self = Self { task: None, attempt: None, severity: Severity::Trace };

    fn admits(&self, (task, attempt): Attempt) -> bool {
        self.task.is_none_or(|wanted| wanted == task) && self.attempt.is_none_or(|wanted| wanted == attempt)
    }
}

/// What a read found.
pub struct Page {
    /// The lines, by number.
    pub lines: Vec<KeptLine>,
    /// Where the next read begins.
    pub position: Position,
    /// Whether there may be more lines at once.
    pub more: bool,
}

/// Why lines were not stored or read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// A file failed.
    #[error(transparent)]
    File(#[from] ObjectError),
    /// The database failed.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// The logs of all jobs.
#[async_trait]
pub trait Logs: Send + Sync {
    /// Moves with every append by this process: followers read again then.
    fn appended(&self) -> watch::Receiver<u64>;

    /// Whether they lie on the disk of the data directory, which may be full.
    fn is_on_disk(&self) -> bool;

    /// The worker whose lines of an attempt were accepted under `fence`: its last lines are accepted even
    /// after a newer attempt began. Files remember it until the process ends.
    async fn holder(&self, job: &JobId, attempt: Attempt, fence: u64) -> Result<Option<String>, LogError>;

    /// Stores lines of an attempt that `worker` holds under `fence`; worker lines with known numbers are
    /// skipped.
    ///
    /// # Errors
    /// When the disk or the database fails; some of the lines may be stored, and all may be sent again.
    async fn append(
        &self,
        job: &JobId,
        attempt: Attempt,
        holder: (&str, u64),
        lines: Vec<NewLine>,
        now_ms: u64,
    ) -> Result<(), LogError>;

    /// The next lines after `position`, at most `limit`.
    async fn read(
        &self,
        job: &JobId,
        wanted: &Wanted,
        position: Position,
        limit: usize,
    ) -> Result<Page, LogError>;

    /// Replaces the history of a task.
    async fn put_history(&self, job: &JobId, task: TaskId, history: Vec<u8>) -> Result<(), LogError>;

    /// The history of one task, or of all of a job, by task.
    async fn histories(&self, job: &JobId, task: Option<TaskId>) -> Result<Vec<(TaskId, Vec<u8>)>, LogError>;

    /// Removes the lines and the histories of a job.
    async fn remove(&self, job: &JobId) -> Result<(), LogError>;

    /// Jobs with lines or histories, whether or not the jobs exist.
    async fn jobs(&self) -> Result<Vec<JobId>, LogError>;

    /// The highest number in a job; 0 when it has no lines.
    async fn last(&self, job: &JobId) -> Result<u64, LogError>;

    /// Adds lines and notices of other logs, with their numbers. They ascend and are above [`Self::last`], so
    /// that a copy that was interrupted goes on from there.
    async fn import(&self, job: &JobId, lines: Vec<KeptLine>) -> Result<(), LogError>;
}

/// The logs of the jobs in `store`: there, or in files in the data directory.
pub fn of(store: &dyn Store, data_dir: &Path, attempt_bytes: u64) -> Arc<dyn Logs> {
    let in_files = || Arc::new(JobLogs::new(&data_dir.join("logs"), attempt_bytes)) as Arc<dyn Logs>;
    store.logs(attempt_bytes).unwrap_or_else(in_files)
}

/// Lines per step of a copy.
const COPIED_AT_ONCE: usize = 1024;

/// Copies the histories, and the lines that `to` does not have yet; returns the number of lines.
///
/// # Errors
/// When either side fails. What was copied stays.
pub async fn copy(from: &dyn Logs, to: &dyn Logs) -> Result<u64, LogError> {
    let mut copied = 0;
    for job in from.jobs().await? {
        let (mut position, mut more) = (Position::after(to.last(&job).await?), true);
        while more {
            let lines;
            Page { lines, position, more } = from.read(&job, &Wanted::ALL, position, COPIED_AT_ONCE).await?;
            copied += lines.iter().filter(|line| !line.row.is_notice()).count() as u64;
            to.import(&job, lines).await?;
        }
        for (task, history) in from.histories(&job, None).await? {
            to.put_history(&job, task, history).await?;
        }
    }
    Ok(copied)
}
