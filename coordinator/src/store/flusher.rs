//! Makes what was written durable, many writers at a time.
//!
//! sled's `flush` on Linux writes the log and calls `sync_file_range`, which syncs neither metadata nor the
//! disk's own cache: enough against a killed process, not against lost power. So after each flush we call
//! `fdatasync` on the database's file ourselves, and only then does anybody get a reply. All who wait at
//! that moment share one sync. After an error nobody knows what is on the disk, so nothing is written any
//! more: the process must be started anew.
//!
//! Readers wait too: a row that was read before it was synced may be gone after a crash, and another one come in its place. Whoever
//! was told of it would know of something that never happened.

use std::fs::File;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, mpsc};
use std::thread::JoinHandle;

use tokio::sync::oneshot;

use super::StoreError;

type Waiter = oneshot::Sender<Result<(), String>>;

/// What makes writes safe. Tests put another one in its place: one that notes when it was asked, one that loses what was not synced.
pub trait Disk: Send + 'static {
    /// Returns when everything written so far is on the disk.
    ///
    /// # Errors
    /// What failed; nobody knows then what is on the disk.
    fn sync(&self) -> Result<(), String>;
}

/// A database and the file that it logs to.
pub struct SledDisk {
    db: sled::Db,
    log: File,
}

impl SledDisk {
    /// The database whose log is the file `log`.
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

/// How much has been written, and how much of it is on the disk.
#[derive(Default)]
struct Progress {
    /// Transactions that may be writing now.
    under_way: AtomicU64,
    /// Transactions that have ended.
    written: AtomicU64,
    /// How many of these had ended when the latest sync began.
    synced: AtomicU64,
}

/// A transaction under way; it has ended when this is dropped.
pub struct Writing<'a>(&'a Progress);

impl Drop for Writing<'_> {
    fn drop(&mut self) {
        // In this order: who finds none under way finds what it wrote counted.
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
                        // A waiter that went away does not need the answer.
                        let _ = waiter.send(result.clone());
                    }
                }
            })
            .map_err(|error| StoreError::Failed(format!("its flusher: {error}")))?;
        Ok(Self { waiters: Some(sender), thread: Some(thread), failure, progress })
    }

    /// To be held while a transaction writes.
    pub fn writing(&self) -> Writing<'_> {
        self.progress.under_way.fetch_add(1, Ordering::SeqCst);
        Writing(&self.progress)
    }

    /// Waits until everything that was read before this call is on the disk; nothing is synced when it is.
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

    /// Remembers an error that was found elsewhere, so that nothing is acknowledged any more.
    pub fn fail(&self, message: String) {
        self.failure.get_or_init(|| message);
    }
}

impl Drop for Flusher {
    fn drop(&mut self) {
        self.waiters = None;
        if let Some(thread) = self.thread.take() {
            // It ends when it has answered the last waiter; a panic in it has been seen by them.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;

    #[tokio::test]
    async fn what_is_read_counts_as_safe_only_after_the_sync_that_followed_its_write() {
        let dir = tempfile::tempdir().unwrap();
        let db = sled::open(dir.path()).unwrap();
        let flusher = Flusher::start(SledDisk::open(db, &dir.path().join("db")).unwrap()).unwrap();
        assert!(flusher.is_synced());
        let writing = flusher.writing();
        assert!(!flusher.is_synced(), "a transaction that may have committed is taken for synced");
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
