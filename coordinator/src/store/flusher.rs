//! Makes writes durable, for many writers at a time.
//!
//! sled's `flush` on Linux writes the log and calls `sync_file_range`, which syncs neither metadata nor the
//! disk's own cache. That protects against a killed process, not against power loss. So after each flush we
//! call `fdatasync` on the database's file, and only then send replies. All waiters at that moment share one
//! sync. After an error the content of the disk is unknown, so nothing is written any more: the process must
//! be restarted.
//!
//! Readers wait too: a row read before its sync may be lost in a crash, and replaced by another one. The
//! reader would know of an event that never happened.

use std::fs::File;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, mpsc};
use std::thread::JoinHandle;

use tokio::sync::oneshot;

use super::StoreError;

type Waiter = oneshot::Sender<Result<(), String>>;

/// Makes writes durable. Tests replace it: by one that records calls, and by one that loses unsynced writes.
pub trait Disk: Send + 'static {
    /// Returns when everything written so far is on the disk.
    ///
    /// # Errors
    /// When the sync failed; the content of the disk is then unknown.
    fn sync(&self) -> Result<(), String>;
}

/// A database and its log file.
pub struct SledDisk {
    db: sled::Db,
    log: File,
}

impl SledDisk {
    /// The database with the log file `log`.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn open(db: sled::Db, log: &Path) -> Result<Self, StoreError> {
        let failed = |e: std::io::Error| StoreError::Failed(format!("{}: {e}", log.display()));
        Ok(Self { db, log: File::open(log).map_err(failed)? })
    }
}

impl Disk for SledDisk {
    fn sync(&self) -> Result<(), String> {
        self.db.flush().map_err(|e| format!("flush: {e}"))?;
        self.log.sync_data().map_err(|e| format!("fdatasync: {e}"))
    }
}

/// The thread that syncs.
pub struct Flusher {
    waiters: Option<mpsc::Sender<Waiter>>,
    thread: Option<JoinHandle<()>>,
    failure: Arc<OnceLock<String>>,
    progress: Arc<Progress>,
}

/// Numbers of transactions written and synced.
#[derive(Default)]
struct Progress {
    /// Transactions that may be writing.
    under_way: AtomicU64,
    /// Transactions that have ended.
    written: AtomicU64,
    /// Number of those that had ended when the latest sync began.
    synced: AtomicU64,
}

/// A running transaction; it ends when this is dropped.
pub struct Writing<'a>(&'a Progress);

impl Drop for Writing<'_> {
    fn drop(&mut self) {
        // In this order: a reader that finds none running finds its writes counted.
        self.0.written.fetch_add(1, Ordering::SeqCst);
        self.0.under_way.fetch_sub(1, Ordering::SeqCst);
    }
}

impl Flusher {
    /// Starts the thread.
    pub fn start(disk: impl Disk) -> Result<Self, StoreError> {
        let (sender, waiters) = mpsc::channel::<Waiter>();
        let failure = Arc::new(OnceLock::<String>::new());
        let seen = Arc::clone(&failure);
        let progress = Arc::<Progress>::default();
        let counted = Arc::clone(&progress);
        let thread = std::thread::Builder::new()
            .name("store-flusher".into())
            .spawn(move || {
                while let Ok(first) = waiters.recv() {
                    let mut batch = vec![first];
                    batch.extend(waiters.try_iter());
                    let written = counted.written.load(Ordering::SeqCst);
                    let result = match seen.get() {
                        Some(failure) => Err(failure.clone()),
                        None => disk.sync(),
                    };
                    if result.is_ok() {
                        counted.synced.store(written, Ordering::SeqCst);
                    }
                    if let Err(message) = &result {
                        seen.get_or_init(|| message.clone());
                    }
                    for waiter in batch {
                        // A waiter that has left does not need the answer.
                        let _ = waiter.send(result.clone());
                    }
                }
            })
            .map_err(|error| StoreError::Failed(format!("its flusher: {error}")))?;
        Ok(Self { waiters: Some(sender), thread: Some(thread), failure, progress })
    }

    /// Hold it while a transaction writes.
    pub fn writing(&self) -> Writing<'_> {
        self.progress.under_way.fetch_add(1, Ordering::SeqCst);
        Writing(&self.progress)
    }

    /// Waits until everything read before this call is on the disk; does not sync if it already is.
    pub async fn sync_what_was_read(&self) -> Result<(), StoreError> {
        if self.is_synced() { Ok(()) } else { self.sync().await }
    }

    fn is_synced(&self) -> bool {
        let Progress { under_way, written, synced } = &*self.progress;
        under_way.load(Ordering::SeqCst) == 0
            && synced.load(Ordering::SeqCst) >= written.load(Ordering::SeqCst)
    }

    /// Waits until everything written before this call is on the disk.
    pub async fn sync(&self) -> Result<(), StoreError> {
        let gone = || StoreError::Failed("its flusher is gone".into());
        let (sender, answer) = oneshot::channel();
        self.waiters.as_ref().ok_or_else(gone)?.send(sender).map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?.map_err(StoreError::Failed)
    }

    /// The first error, once there was one.
    pub fn failure(&self) -> Option<&String> {
        self.failure.get()
    }

    /// Records an error found elsewhere, so that nothing is acknowledged any more.
    pub fn fail(&self, message: String) {
        self.failure.get_or_init(|| message);
    }
}

impl Drop for Flusher {
    fn drop(&mut self) {
        self.waiters = None;
        if let Some(thread) = self.thread.take() {
            // It ends after the last waiter's answer; waiters have seen any panic.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;

    #[tokio::test]
    async fn a_read_counts_as_safe_only_after_the_sync_of_its_write() {
        let dir = tempfile::tempdir().unwrap();
        let db = sled::open(dir.path()).unwrap();
        let flusher = Flusher::start(SledDisk::open(db, &dir.path().join("db")).unwrap()).unwrap();
        assert!(flusher.is_synced());
        let writing = flusher.writing();
        assert!(!flusher.is_synced(), "a transaction that may have committed counts as synced");
        flusher.sync().await.unwrap();
        assert!(!flusher.is_synced(), "a sync that began before the end of a transaction counts for it");
        drop(writing);
        assert!(!flusher.is_synced());
        flusher.sync_what_was_read().await.unwrap();
        assert!(flusher.is_synced());
        flusher.fail("the disk is gone".into());
        drop(flusher.writing());
        assert!(matches!(flusher.sync_what_was_read().await, Err(StoreError::Failed(_))));
    }
}
