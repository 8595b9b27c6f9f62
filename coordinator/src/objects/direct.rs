//! Uploads that clients send to the bucket themselves.
//!
//! A client gets a signed request for one object, `direct/<name>`, of the blob's length. It can write that
//! object again and again while its URL is valid. So the bucket copies the object to where no client can
//! write, and that copy is hashed and published, as the segment of an upload that has arrived.
//!
//! The object counts as an upload of its own, under its name instead of a digest, with its full length. That
//! ends when it has become a blob, or when its time is over and it is deleted. What is written later, or
//! signed by a coordinator that dies, is deleted by garbage collection.

use std::sync::{Arc, PoisonError};
use std::time::Duration;

use fathom_core::scene::BlobRef;
use fathom_proto::direct::sent_within;
use object_store::ObjectStoreExt;
use object_store::path::Path as ObjectPath;
use tokio::sync::{Semaphore, SemaphorePermit};
use uuid::Uuid;

use super::bucket::Bucket;
use super::claim::Replaced;
use super::signing::{DIRECT_FROM_BYTES, SignedRequest};
use super::{BlobStore, BlobWriter, ObjectError, Place, WriteClaim, check_digest, segments};

/// Longer blobs go through the coordinator: a request that breaks off has to be repeated as a whole.
const DIRECT_TO_BYTES: u64 = 256 << 20;
/// Age after which nobody else deletes an object; longer than any upload has.
pub(super) const UNFINISHED_FOR: Duration = Duration::from_secs(1800);
/// Most uploads of a tenant that are signed at a time.
const MOST_SIGNED: usize = 1024;
/// Uploads of a tenant that are checked at a time, each with some pieces of its object in memory, and that
/// may wait for it.
const FINISHES: [usize; 2] = [4, 64];
/// Digits of a digest with which names of its uploads begin.
const PREFIX: usize = 2;
/// Pause between two attempts to delete an object.
const DELETE_EVERY: Duration = Duration::from_secs(60);

/// An upload that a client may send to the bucket.
pub struct DirectWrite {
    /// Its name.
    pub upload: String,
    /// The request that sends it.
    pub request: SignedRequest,
}

/// An upload that is signed, and counts as long as this exists.
pub(super) struct Signed {
    #[expect(dead_code, reason = "held for its end")]
    claim: WriteClaim,
    /// The blob.
    blob: BlobRef,
}

/// The checks of a tenant's uploads.
pub(super) struct Finishes {
    running: Semaphore,
    waiting: Semaphore,
}

impl Default for Finishes {
    fn default() -> Self {
        let [running, waiting] = FINISHES.map(Semaphore::new);
        Self { running, waiting }
    }
}

impl Finishes {
    /// Waits for a turn; `None` if too many wait.
    async fn turn(&self) -> Option<SemaphorePermit<'_>> {
        let _waits = self.waiting.try_acquire().ok()?;
        self.running.acquire().await.ok()
    }
}

/// A name that nobody can guess. It is as long as a digest, which names an upload elsewhere, and begins like
/// that of the blob: both are counted in the same row of a database. A transaction that changed two could
/// wait for another one that waits for it.
fn name_for(digest: &str) -> String {
    let random = format!("{}{}", Uuid::new_v4().simple(), Uuid::new_v4().simple());
    format!("{}{}", &digest[..PREFIX], &random[PREFIX..])
}

fn path_of(upload: &str) -> ObjectPath {
    ObjectPath::from_iter(["direct", upload])
}

impl BlobStore {
    /// Whether a client may send this blob to the bucket itself, of which `arrived_bytes` have arrived.
    pub fn takes_directly(&self, blob: &BlobRef, arrived_bytes: u64) -> bool {
        arrived_bytes == 0
            && (DIRECT_FROM_BYTES..=DIRECT_TO_BYTES).contains(&blob.bytes)
            && self.signing.as_ref().is_some_and(|signing| signing.signs_lengths())
    }

    /// Signs the upload of a blob, which counts from now on; `None` if its client has to send it here.
    ///
    /// # Errors
    /// When the limit would be exceeded, or the database is not available.
    pub async fn sign_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        limit_bytes: Option<u64>,
    ) -> Result<Option<DirectWrite>, ObjectError> {
        check_digest(&blob.digest)?;
        let (true, Some(signing)) = (self.takes_directly(blob, 0), &self.signing) else { return Ok(None) };
        if self.signed.lock().unwrap_or_else(PoisonError::into_inner).len() >= MOST_SIGNED {
            return Ok(None);
        }
        let upload = name_for(&blob.digest);
        let Some(request) = signing.to_write(&path_of(&upload), blob.bytes).await else { return Ok(None) };
        let claim = WriteClaim::take(self, &upload)?;
        self.reserve(&claim, blob.bytes, 0, limit_bytes, None).await?;
        let signed = Signed { claim, blob: blob.clone() };
        self.signed.lock().unwrap_or_else(PoisonError::into_inner).insert(upload.clone(), signed);
        let (store, ended) = (Arc::clone(self), upload.clone());
        let time = sent_within(blob.bytes);
        tokio::spawn(async move {
            tokio::time::sleep(time).await;
            // Also if it has become a blob: its client may have sent the object once more.
            if let Place::Bucket(bucket) = &store.place {
                delete(bucket, &ended).await;
            }
            drop(store.take_signed(&ended));
        });
        Ok(Some(DirectWrite { upload, request }))
    }

    /// Checks what a client has sent to the bucket, and makes it the blob. No caller interrupts it.
    ///
    /// # Errors
    /// [`ObjectError::NoUpload`] when nothing has arrived; [`ObjectError::DigestMismatch`] when the bytes
    /// differ from the declaration; [`ObjectError::Busy`] when a stream writes the blob, or too many uploads
    /// wait for their check; as [`BlobStore::begin_write`]. The client has to send the blob again.
    pub async fn finish_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        upload: &str,
        limit_bytes: Option<u64>,
    ) -> Result<(), ObjectError> {
        check_digest(&blob.digest)?;
        if check_digest(upload).is_err() || upload[..PREFIX] != blob.digest[..PREFIX] {
            return Err(ObjectError::NoUpload);
        }
        let (store, blob, upload) = (Arc::clone(self), blob.clone(), upload.to_owned());
        let finished = tokio::spawn(async move {
            let Place::Bucket(bucket) = &store.place else { return Err(ObjectError::NoUpload) };
            let Some(turn) = store.finishes.turn().await else { return Err(ObjectError::Busy(blob.digest)) };
            let adopted = store.adopt_sent(bucket, &blob, &upload, limit_bytes).await;
            drop(turn);
            // After other errors the object may still be needed. Its time ends anyway.
            if let Ok(_) | Err(ObjectError::DigestMismatch { .. }) = adopted {
                let store = Arc::clone(&store);
                tokio::spawn(async move {
                    if let Place::Bucket(bucket) = &store.place {
                        delete(bucket, &upload).await;
                    }
                });
            }
            adopted
        });
        finished.await.map_err(|_| ObjectError::Interrupted)?
    }

    /// Makes what was sent the blob, unless the blob is there.
    async fn adopt_sent(
        self: &Arc<Self>,
        bucket: &Arc<Bucket>,
        blob: &BlobRef,
        upload: &str,
        limit_bytes: Option<u64>,
    ) -> Result<(), ObjectError> {
        let sent = path_of(upload);
        let found = bucket.head(&sent).await?.ok_or(ObjectError::NoUpload)?;
        if found.size != blob.bytes {
            let message = format!("{} of {} bytes arrived", found.size, blob.bytes);
            return Err(ObjectError::DigestMismatch { digest: blob.digest.clone(), message });
        }
        let claim = WriteClaim::take(self, &blob.digest)?;
        let (arrived_bytes, is_complete) = self.committed(blob).await?;
        if is_complete {
            return Ok(());
        }
        if arrived_bytes > 0 {
            // It would stay beside the copy, and nobody would count it.
            let (digest, committed_bytes) = (blob.digest.clone(), arrived_bytes);
            return Err(ObjectError::WrongOffset { digest, offset_bytes: 0, committed_bytes });
        }
        let segment = segments::path_at(&blob.digest, 0);
        let copied = match bucket.store().copy(&sent, &segment).await {
            Err(object_store::Error::NotFound { .. }) => Err(ObjectError::NoUpload),
            copied => copied.map_err(ObjectError::Unavailable),
        };
        let replaced =
            Replaced { upload: upload.to_owned(), bytes: blob.bytes, is_ours: self.is_signed(upload) };
        let admitted = match copied {
            Ok(()) => self.admit(&claim, blob, blob.bytes, limit_bytes, Some(replaced)).await,
            Err(error) => Err(error),
        };
        if let Ok(true) = admitted {
            return BlobWriter::open(claim, blob.clone(), blob.bytes).await?.finish().await;
        }
        // The copy may have been made although the bucket did not say so.
        bucket.delete(vec![segment], |_| ()).await?;
        claim.count(0);
        claim.settle().await;
        admitted.map(drop)
    }

    /// The upload of a blob that a client has not finished; sending the blob here replaces it.
    pub(super) fn signed_for(&self, digest: &str) -> Option<Replaced> {
        let signed = self.signed.lock().unwrap_or_else(PoisonError::into_inner);
        let (upload, found) = signed.iter().find(|(_, signed)| signed.blob.digest == digest)?;
        Some(Replaced { upload: upload.clone(), bytes: found.blob.bytes, is_ours: true })
    }

    pub(super) fn is_signed(&self, upload: &str) -> bool {
        self.signed.lock().unwrap_or_else(PoisonError::into_inner).contains_key(upload)
    }

    pub(super) fn take_signed(&self, upload: &str) -> Option<Signed> {
        self.signed.lock().unwrap_or_else(PoisonError::into_inner).remove(upload)
    }
}

/// Deletes the object of an upload.
async fn delete(bucket: &Bucket, upload: &str) {
    while let Err(error) = bucket.delete(vec![path_of(upload)], |_| ()).await {
        tracing::warn!(%error, upload, "cannot delete what a client has sent to the bucket; trying again");
        tokio::time::sleep(DELETE_EVERY).await;
    }
}
