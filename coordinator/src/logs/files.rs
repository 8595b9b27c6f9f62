//! Log lines in files under `logs/JOB/`.
//!
//! The lines of an attempt lie in append-only segments, `TASK.ATTEMPT.SEGMENT`, one JSON object a line. When
//! an attempt exceeds its limit, its second segment is removed, later the next ones, so that its beginning
//! and end are kept. A line that a crash truncated is skipped.
//!
//! The history of a task is the file `TASK.history`, which is replaced as a whole.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fathom_observe::threads;
use tokio::sync::watch;
use tonic::async_trait;

use super::read::Position;
use super::segment::Files;
use super::{
    ATTEMPTS_KEPT, Attempt, COPIED_SEGMENT_BYTES, KeptLine, LogError, Logs, NewLine, Page, Row, SEGMENTS,
    Wanted,
};
use crate::objects::ObjectError;
use crate::schedule::{JobId, TaskId};

/// Maximum jobs with cached file data; the least recently used ones are reread.
const OPEN_JOBS: usize = 256;
/// Ending of the file of a history, behind the task.
const HISTORY: &str = ".history";

/// The logs of all jobs, in files.
pub struct JobLogs(Arc<Folders>);

impl JobLogs {
    /// Logs under a folder, which need not exist; an attempt keeps at most `attempt_bytes`.
    pub fn new(root: &Path, attempt_bytes: u64) -> Self {
        Self(Arc::new(Folders {
            root: root.to_owned(),
            segment_bytes: attempt_bytes / SEGMENTS,
            open: Mutex::default(),
            appended: watch::channel(0).0,
        }))
    }

    /// Runs `work` on the files of a job, on a thread that may block.
    async fn blocking<T: Send + 'static>(
        &self,
        action: &'static str,
        job: &JobId,
        work: impl FnOnce(&Folders, &JobId) -> io::Result<T> + Send + 'static,
    ) -> Result<T, LogError> {
        let (folders, job, path) = (Arc::clone(&self.0), job.clone(), self.0.folder(job));
        let done = threads::blocking(move || work(&folders, &job)).await;
        let done = done.unwrap_or_else(|error| Err(io::Error::other(error)));
        done.map_err(|source| ObjectError::Io { action, path, source }.into())
    }
}

#[async_trait]
impl Logs for JobLogs {
    fn appended(&self) -> watch::Receiver<u64> {
        self.0.appended.subscribe()
    }

    fn is_on_disk(&self) -> bool {
        true
    }

    async fn holder(&self, job: &JobId, attempt: Attempt, fence: u64) -> Result<Option<String>, LogError> {
        Ok(self.0.holder(job, attempt, fence))
    }

    async fn append(
        &self,
        job: &JobId,
        attempt: Attempt,
        (worker, fence): (&str, u64),
        lines: Vec<NewLine>,
        now_ms: u64,
    ) -> Result<(), LogError> {
        let worker = worker.to_owned();
        self.blocking("write the log", job, move |folders, job| {
            folders.append(job, attempt, (&worker, fence), lines, now_ms)
        })
        .await
    }

    async fn read(
        &self,
        job: &JobId,
        wanted: &Wanted,
        mut position: Position,
        limit: usize,
    ) -> Result<Page, LogError> {
        let wanted = wanted.clone();
        self.blocking("read the log", job, move |folders, job| {
            let (lines, more) = folders.read(job, &wanted, &mut position, limit)?;
            Ok(Page { lines, position, more })
        })
        .await
    }

    async fn put_history(&self, job: &JobId, task: TaskId, history: Vec<u8>) -> Result<(), LogError> {
        self.blocking("write a history", job, move |folders, job| folders.put_history(job, task, &history))
            .await
    }

    async fn histories(&self, job: &JobId, task: Option<TaskId>) -> Result<Vec<(TaskId, Vec<u8>)>, LogError> {
        self.blocking("read the histories", job, move |folders, job| folders.histories(job, task)).await
    }

    async fn remove(&self, job: &JobId) -> Result<(), LogError> {
        self.blocking("remove the log", job, Folders::remove).await
    }

    async fn jobs(&self) -> Result<Vec<JobId>, LogError> {
        let folders = Arc::clone(&self.0);
        let listed = threads::blocking(move || folders.jobs()).await;
        let listed = listed.unwrap_or_else(|error| Err(io::Error::other(error)));
        let (action, path) = ("list the logs", self.0.root.clone());
        listed.map_err(|source| ObjectError::Io { action, path, source }.into())
    }

    async fn last(&self, job: &JobId) -> Result<u64, LogError> {
        self.blocking("read the log", job, |folders, job| Ok(lock(&*folders.open(job)?).last)).await
    }

    async fn import(&self, job: &JobId, lines: Vec<KeptLine>) -> Result<(), LogError> {
        self.blocking("write the log", job, |folders, job| folders.import(job, lines)).await
    }
}

/// The folders of all jobs.
pub(super) struct Folders {
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
pub(super) struct JobLog {
    /// Highest number in any file.
    pub last: u64,
    pub attempts: BTreeMap<Attempt, Files>,
}

impl Folders {
    /// The folder of a job's lines.
    pub(super) fn folder(&self, job: &JobId) -> PathBuf {
        self.root.join(job.as_str())
    }

    fn opened(&self) -> MutexGuard<'_, HashMap<JobId, Opened>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The files of a job, read if not cached.
    pub(super) fn open(&self, job: &JobId) -> io::Result<Arc<Mutex<JobLog>>> {
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
    fn holder(&self, job: &JobId, attempt: Attempt, fence: u64) -> Option<String> {
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
    fn append(
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
                files.write(&folder, attempt, &text, self.segment_bytes, SEGMENTS as usize)?;
                text.clear();
            }
            text.extend(line);
            files.note(row.number);
        }
        if !text.is_empty() {
            files.write(&folder, attempt, &text, self.segment_bytes, SEGMENTS as usize)?;
            files.from_worker = Some(highest);
        }
        if *last > before {
            drop(log);
            self.appended.send_modify(|count| *count = count.wrapping_add(1));
        }
        Ok(())
    }

    /// Each line is written before the next one, so that an interruption leaves the first ones.
    fn import(&self, job: &JobId, lines: Vec<KeptLine>) -> io::Result<()> {
        let log = self.open(job)?;
        let mut log = lock(&log);
        let JobLog { last, attempts } = &mut *log;
        let folder = self.folder(job);
        std::fs::create_dir_all(&folder)?;
        for KeptLine { task, attempt, row } in lines {
            let files = attempts.entry((task, attempt)).or_default();
            if row.is_notice() {
                files.is_cut = true;
                continue;
            }
            let mut line = serde_json::to_vec(&row)?;
            line.push(b'\n');
            files.write(&folder, (task, attempt), &line, COPIED_SEGMENT_BYTES, usize::MAX)?;
            files.note(row.number);
            *last = row.number;
        }
        Ok(())
    }

    /// Replaces the history of a task.
    ///
    /// # Errors
    /// When the disk fails; the old history stays.
    fn put_history(&self, job: &JobId, task: TaskId, history: &[u8]) -> io::Result<()> {
        let log = self.open(job)?;
        // One at a time, and none while the job is removed.
        let _log = lock(&log);
        let folder = self.folder(job);
        std::fs::create_dir_all(&folder)?;
        let half_written = folder.join(format!("{task}.history.new"));
        std::fs::write(&half_written, history)?;
        std::fs::rename(half_written, folder.join(format!("{task}{HISTORY}")))
    }

    /// The history of one task, or of all.
    ///
    /// # Errors
    /// When a file cannot be read.
    fn histories(&self, job: &JobId, task: Option<TaskId>) -> io::Result<Vec<(TaskId, Vec<u8>)>> {
        let folder = self.folder(job);
        let tasks: BTreeSet<TaskId> = match task {
            Some(task) => BTreeSet::from([task]),
            None => {
                let entries = absent_is(std::fs::read_dir(&folder).map(Some), None)?;
                let names = entries.into_iter().flatten().collect::<io::Result<Vec<_>>>()?;
                let task = |name: &OsStr| name.to_str()?.strip_suffix(HISTORY)?.parse().ok();
                names.iter().filter_map(|entry| task(&entry.file_name())).collect()
            }
        };
        let mut histories = Vec::new();
        for task in tasks {
            let read = std::fs::read(folder.join(format!("{task}{HISTORY}"))).map(Some);
            histories.extend(absent_is(read, None)?.map(|history| (task, history)));
        }
        Ok(histories)
    }

    /// Removes the lines and histories of a job.
    ///
    /// # Errors
    /// When its files cannot be removed.
    fn remove(&self, job: &JobId) -> io::Result<()> {
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
    fn jobs(&self) -> io::Result<Vec<JobId>> {
        let mut jobs = Vec::new();
        for entry in absent_is(std::fs::read_dir(&self.root).map(Some), None)?.into_iter().flatten() {
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

/// What was read, or `otherwise` if there is nothing at its path.
fn absent_is<T>(read: io::Result<T>, otherwise: T) -> io::Result<T> {
    match read {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(otherwise),
        other => other,
    }
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
