//! Log lines of jobs, in files under `logs/JOB/`; they outlive the worker of an attempt.
//!
//! The lines of an attempt lie in append-only segments, `TASK.ATTEMPT.SEGMENT`, one JSON object a line. When
//! an attempt exceeds its limit, its second segment is removed, later the next ones, so that its beginning
//! and end are kept. A line that a crash truncated is skipped. Nothing is synced: a power cut may lose the
//! latest lines, but never affects an answer of the service.
//!
//! Each line has a number that ascends in its job in the order of arrival (microseconds of the clock, so that
//! it ascends over restarts as well). Invariant: a number that [`JobLogs::read`] may return is in a file, and
//! so are all smaller ones.

mod read;
mod segment;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use tokio::sync::watch;

pub use self::read::{Position, Wanted};
use self::segment::Files;
use crate::schedule::{JobId, TaskId};

/// Maximum jobs with cached file data; the least recently used ones are reread.
const OPEN_JOBS: usize = 256;
/// Attempts of a task whose lines are kept: a task that is released repeatedly must not fill the disk.
const ATTEMPTS_KEPT: u32 = 16;
/// Segments of an attempt: its first, the two full ones before the latest, and the latest.
const SEGMENTS: u64 = 4;

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

/// An attempt of a job.
pub type Attempt = (TaskId, u32);

/// The logs of all jobs.
pub struct JobLogs {
    root: PathBuf,
    segment_bytes: u64,
    open: Mutex<HashMap<JobId, Opened>>,
    /// Counts appends: followers read again when it moves.
    appended: watch::Sender<u64>,
}

struct Opened {
    log: Arc<Mutex<JobLog>>,
    /// Value of `appended` at its last use.
    used: u64,
}

/// Cached data of the files of one job.
#[derive(Default)]
struct JobLog {
    /// Highest number in any file.
    last: u64,
    attempts: BTreeMap<Attempt, Files>,
}

impl JobLogs {
    /// Logs under a folder, which need not exist; an attempt keeps at most `attempt_bytes`.
    pub fn new(root: &Path, attempt_bytes: u64) -> Self {
        Self {
            root: root.to_owned(),
            segment_bytes: attempt_bytes / SEGMENTS,
            open: Mutex::default(),
            appended: watch::channel(0).0,
        }
    }

    /// Moves with every append.
    pub fn appended(&self) -> watch::Receiver<u64> {
        self.appended.subscribe()
    }

    /// The folder of a job's lines.
    pub fn folder(&self, job: &JobId) -> PathBuf {
        self.root.join(job.as_str())
    }

    fn opened(&self) -> MutexGuard<'_, HashMap<JobId, Opened>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The files of a job, read if not cached.
    fn open(&self, job: &JobId) -> io::Result<Arc<Mutex<JobLog>>> {
        let now = *self.appended.borrow();
        if let Some(known) = self.opened().get_mut(job) {
            known.used = now;
            return Ok(Arc::clone(&known.log));
        }
        // Without the lock: another job must not wait for it.
        let found = JobLog::find(&self.folder(job))?;
        let mut opened = self.opened();
        if opened.len() >= OPEN_JOBS && !opened.contains_key(job) {
            // One that is in use may be about to be written; a second one would assign numbers twice.
            let idle = opened.iter().filter(|(_, known)| Arc::strong_count(&known.log) == 1);
            let oldest = idle.min_by_key(|(_, known)| known.used).map(|(job, _)| job.clone());
            oldest.and_then(|job| opened.remove(&job));
        }
        let known = opened.entry(job.clone()).or_insert_with(|| Opened { log: Arc::default(), used: now });
        let log = Arc::clone(&known.log);
        {
            let mut fresh = lock(&log);
            // A faster thread has read the same, and may have written since.
            if fresh.attempts.is_empty() {
                *fresh = found;
            }
        }
        Ok(log)
    }

    /// The worker whose lines of an attempt this process accepted under `fence`: its last lines are accepted
    /// even after a newer attempt began.
    pub fn holder(&self, job: &JobId, attempt: Attempt, fence: u64) -> Option<String> {
        let log = self.opened().get(job).map(|known| Arc::clone(&known.log))?;
        let log = lock(&log);
        let (worker, known) = log.attempts.get(&attempt)?.holder.as_ref()?;
        (*known == fence).then(|| worker.clone())
    }

    /// Writes lines of an attempt that `worker` holds under `fence`; worker lines with known numbers are
    /// skipped.
    ///
    /// # Errors
    /// When the disk fails; some of the lines may be stored, and all may be sent again.
    pub fn append(
        &self,
        job: &JobId,
        attempt: Attempt,
        (worker, fence): (&str, u64),
        lines: Vec<NewLine>,
        now_ms: u64,
    ) -> io::Result<()> {
        let log = self.open(job)?;
        let mut log = lock(&log);
        let JobLog { last, attempts } = &mut *log;
        let folder = self.folder(job);
        if !attempts.contains_key(&attempt) {
            std::fs::create_dir_all(&folder)?;
            forget_old_attempts(&folder, attempts, attempt)?;
        }
        let files = attempts.entry(attempt).or_default();
        if lines.iter().any(|line| line.from_worker.is_some()) {
            files.holder = Some((worker.to_owned(), fence));
        }
        let mut highest = files.last_from_worker(&folder, attempt)?;
        let (mut text, before) = (Vec::new(), *last);
        for NewLine { from_worker, time_ms, severity, message } in lines {
            if from_worker.is_some_and(|number| number <= highest) {
                continue;
            }
            highest = from_worker.unwrap_or(highest);
            // Even: odd numbers are for notices to readers.
            *last = (*last + 2).max(now_ms.saturating_mul(1000));
            let row =
                Row { number: *last, from_worker, time_ms, severity, worker: worker.to_owned(), message };
            let mut line = serde_json::to_vec(&row)?;
            line.push(b'\n');
            if !files.has_room(text.len() + line.len(), self.segment_bytes) && !text.is_empty() {
                files.write(&folder, attempt, &text, self.segment_bytes)?;
                text.clear();
            }
            text.extend(line);
            files.note(row.number);
        }
        if !text.is_empty() {
            files.write(&folder, attempt, &text, self.segment_bytes)?;
            files.from_worker = Some(highest);
        }
        if *last > before {
            drop(log);
            self.appended.send_modify(|count| *count = count.wrapping_add(1));
        }
        Ok(())
    }

    /// Removes the lines of a job.
    ///
    /// # Errors
    /// When its files cannot be removed.
    pub fn remove(&self, job: &JobId) -> io::Result<()> {
        let known = self.opened().remove(job);
        // Waits for a running write.
        let _log = known.as_ref().map(|known| lock(&known.log));
        match std::fs::remove_dir_all(self.folder(job)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    /// Jobs with files here.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn jobs(&self) -> io::Result<Vec<JobId>> {
        let entries = match std::fs::read_dir(&self.root) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(error),
        };
        let mut jobs = Vec::new();
        for entry in entries {
            jobs.extend(entry?.file_name().to_str().and_then(|name| name.parse::<JobId>().ok()));
        }
        Ok(jobs)
    }
}

/// Removes the files of too old attempts at the same task.
fn forget_old_attempts(
    folder: &Path,
    attempts: &mut BTreeMap<Attempt, Files>,
    (task, attempt): Attempt,
) -> io::Result<()> {
    let first = attempt.saturating_sub(ATTEMPTS_KEPT - 1);
    let old: Vec<Attempt> = attempts.range((task, 0)..(task, first)).map(|(attempt, _)| *attempt).collect();
    for attempt in old {
        if let Some(files) = attempts.remove(&attempt) {
            files.remove(folder, attempt)?;
        }
    }
    Ok(())
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
