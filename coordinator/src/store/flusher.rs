//! Makes what was written durable, many writers at a time.
//!
//! sled's `flush` on Linux writes the log and calls `sync_file_range`, which syncs neither metadata nor the
//! disk's own cache: enough against a killed process, not against lost power. So after each flush we call
//! `fdatasync` on the database's file ourselves, and only then does anybody get a reply. All who wait at
//! that moment share one sync. After an error nobody knows what is on the disk, so nothing is written any
//! more: the process must be started anew.

use std::fs::File;
use std::path::Path;
use std::sync::{Arc, OnceLock, mpsc};
use std::thread::JoinHandle;

use tokio::sync::oneshot;

use super::StoreError;

type Waiter = oneshot::Sender<Result<(), String>>;

/// The thread that syncs.
pub struct Flusher {
    waiters: Option<mpsc::Sender<Waiter>>,
    thread: Option<JoinHandle<()>>,
    failure: Arc<OnceLock<String>>,
}

impl Flusher {
    /// Starts the thread for the database whose log is the file `log`.
    pub fn start(db: sled::Db, log: &Path) -> Result<Self, StoreError> {
        let failed = |e: std::io::Error| StoreError::Failed(format!("{}: {e}", log.display()));
        let file = File::open(log).map_err(failed)?;
        let (sender, waiters) = mpsc::channel::<Waiter>();
        let failure = Arc::new(OnceLock::<String>::new());
        let seen = Arc::clone(&failure);
        let thread = std::thread::Builder::new()
            .name("store-flusher".into())
            .spawn(move || {
                while let Ok(first) = waiters.recv() {
                    let mut batch = vec![first];
                    batch.extend(waiters.try_iter());
                    let result = match seen.get() {
                        Some(failure) => Err(failure.clone()),
                        None => sync(&db, &file),
                    };
                    if let Err(message) = &result {
                        seen.get_or_init(|| message.clone());
                    }
                    for waiter in batch {
                        // A waiter that went away does not need the answer.
                        let _ = waiter.send(result.clone());
                    }
                }
            })
            .map_err(failed)?;
        Ok(Self { waiters: Some(sender), thread: Some(thread), failure })
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

fn sync(db: &sled::Db, log: &File) -> Result<(), String> {
    db.flush().map_err(|e| format!("flush: {e}"))?;
    log.sync_data().map_err(|e| format!("fdatasync: {e}"))
}
