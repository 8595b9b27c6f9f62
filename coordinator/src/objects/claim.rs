//! Who writes a blob, and what an upload counts when its stream ends.

use std::sync::{Arc, Mutex, PoisonError};

use fathom_core::scene::BlobRef;

use super::{BlobStore, ObjectError};

/// The exclusive right to write one blob; returned when dropped.
pub(super) struct WriteClaim {
    pub store: Arc<BlobStore>,
    pub digest: String,
    /// Received bytes; `None` until the upload counts.
    arrived_bytes: Mutex<Option<u64>>,
    /// The direct upload that does not count while this one does.
    replaced: Mutex<Option<Replaced>>,
}

/// A direct upload whose bytes another upload counts.
#[derive(Clone, Debug)]
pub(super) struct Replaced {
    pub upload: String,
    pub bytes: u64,
    /// Whether this coordinator signed it, and so knows when its time is over.
    pub is_ours: bool,
}

impl WriteClaim {
    pub fn take(store: &Arc<BlobStore>, digest: &str) -> Result<Self, ObjectError> {
        let mut writing = store.writing.lock().unwrap_or_else(PoisonError::into_inner);
        if writing.insert(digest.to_owned()) {
            let (store, digest) = (Arc::clone(store), digest.to_owned());
            Ok(Self { store, digest, arrived_bytes: Mutex::default(), replaced: Mutex::default() })
        } else {
            Err(ObjectError::Busy(digest.to_owned()))
        }
    }

    /// Sets the bytes that count when the writer ends.
    pub fn count(&self, arrived_bytes: u64) {
        *self.arrived_bytes.lock().unwrap_or_else(PoisonError::into_inner) = Some(arrived_bytes);
    }

    /// This upload counts instead of another one, which counts again unless this one becomes a blob.
    pub fn replace(&self, replaced: Option<Replaced>) {
        *self.replaced.lock().unwrap_or_else(PoisonError::into_inner) = replaced;
    }

    /// The upload is complete: its blob counts. False if its object has to be written again, see
    /// [`BlobStore::count_whole`].
    pub async fn complete(&self, bytes: u64) -> Result<bool, ObjectError> {
        if !self.store.count_whole(&BlobRef { digest: self.digest.clone(), bytes }).await? {
            return Ok(false);
        }
        // A shared row of the upload has ended with the blob's.
        let ended = self.store.shared.is_none().then_some(0);
        *self.arrived_bytes.lock().unwrap_or_else(PoisonError::into_inner) = ended;
        let replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(replaced) = replaced {
            // It no longer counts, although its object stays until its time is over.
            drop(self.store.take_signed(&replaced.upload));
        }
        Ok(true)
    }

    /// Counts what has arrived in the shared rows, before another coordinator goes on.
    pub async fn settle(&self) {
        if self.store.shared.is_none() {
            return;
        }
        let arrived = self.arrived_bytes.lock().unwrap_or_else(PoisonError::into_inner).take();
        let replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner).take();
        leave(&self.store, &self.digest, arrived, replaced).await;
    }
}

/// Counts what a stream leaves of an upload in the shared rows, and again what it replaced.
async fn leave(store: &BlobStore, digest: &str, arrived: Option<u64>, replaced: Option<Replaced>) {
    let Some(shared) = &store.shared else { return };
    let count = async {
        // First, so that nothing is uncounted in between.
        if let Some(Replaced { upload, bytes, is_ours }) = replaced {
            if !is_ours {
                shared.leave(&upload, bytes).await?;
            } else if store.is_signed(&upload) {
                shared.reserve(&BlobRef { digest: upload, bytes }, None, None).await?;
            }
        }
        match arrived {
            Some(bytes) => shared.leave(digest, bytes).await,
            None => Ok(()),
        }
    };
    if let Err(error) = count.await {
        tracing::warn!(%error, digest, "an upload counts too much until the next garbage collection");
    }
}

impl Drop for WriteClaim {
    fn drop(&mut self) {
        // Before another stream may write it.
        let arrived = *self.arrived_bytes.get_mut().unwrap_or_else(PoisonError::into_inner);
        let replaced = self.replaced.get_mut().unwrap_or_else(PoisonError::into_inner).take();
        if self.store.shared.is_none() {
            if let Some(replaced) = replaced {
                self.store.declare_again(&replaced);
            }
            if let Some(bytes) = arrived {
                self.store.declare(&self.digest, bytes);
            }
        } else if (arrived.is_some() || replaced.is_some())
            && let Ok(runtime) = tokio::runtime::Handle::try_current()
        {
            // Its task has not settled it: the caller left before there was one, or it could not begin.
            let (store, digest) = (Arc::clone(&self.store), self.digest.clone());
            runtime.spawn(async move { leave(&store, &digest, arrived, replaced).await });
        }
        self.store.writing.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.digest);
    }
}
