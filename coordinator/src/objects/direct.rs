//! Uploads that clients send to the bucket themselves.
//!
//! A client gets a signed request for one object, `direct/<name>`, of the length of the blob or of a part of
//! it. It can write that object again and again while its URL is valid. So the bucket copies the object to
//! where no client can write, as a segment of an upload. When all have arrived, they are hashed and
//! published.
//!
//! The object counts as an upload of its own, under its name instead of a digest, with its full length. That
//! ends when it has become a segment or a blob, or when its time is over and it is deleted. What is written
//! later, or signed by a coordinator that dies, is deleted by garbage collection.

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
use super::signing::SignedRequest;
use super::{BlobStore, BlobWriter, ObjectError, Place, WriteClaim, check_digest, segments};

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
    /// Its length.
    pub bytes: u64,
}

/// An upload that is signed, and counts as long as this exists.
pub(super) struct Signed {
    #[expect(dead_code, reason = "held for its end")]
    claim: WriteClaim,
    /// The digest of the blob.
    digest: String,
    /// Its length, which it counts.
    bytes: u64,
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
    /// Whether a client may send the rest of this blob to the bucket itself, of which `arrived_bytes` have
    /// arrived.
    pub fn takes_directly(&self, blob: &BlobRef, arrived_bytes: u64) -> bool {
        self.signing.as_ref().is_some_and(|signing| signing.part(blob.bytes, arrived_bytes).is_some())
    }

    /// Whether one request to the bucket takes this whole blob.
    pub fn takes_at_once(&self, blob: &BlobRef) -> bool {
        self.signing.as_ref().is_some_and(|signing| signing.part(blob.bytes, 0) == Some(blob.bytes))
    }

    /// Signs the upload of a blob from `offset` on, as much as one request takes. That counts from now on.
    /// `None` if its client has to send it here.
    ///
    /// # Errors
    /// When all that is missing of the blob would exceed the limit, or the database is not available.
    pub async fn sign_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        offset: u64,
        limit_bytes: Option<u64>,
    ) -> Result<Option<DirectWrite>, ObjectError> {
        check_digest(&blob.digest)?;
        let Some(signing) = &self.signing else { return Ok(None) };
        let Some(bytes) = signing.part(blob.bytes, offset) else { return Ok(None) };
        if self.signed.lock().unwrap_or_else(PoisonError::into_inner).len() >= MOST_SIGNED {
            return Ok(None);
        }
        let upload = name_for(&blob.digest);
        let Some(request) = signing.to_write(&path_of(&upload), bytes).await else { return Ok(None) };
        let claim = WriteClaim::take(self, &upload)?;
        let later = blob.bytes - offset - bytes;
        let limit_of_part = limit_bytes.map(|limit| limit.saturating_sub(later));
        let reserved = self.reserve(&claim, bytes, 0, limit_of_part, None).await;
        reserved.map_err(|error| match error {
            ObjectError::OverLimit { used_bytes, .. } => {
                ObjectError::OverLimit { used_bytes, limit_bytes: limit_bytes.unwrap_or(0) }
            }
            error => error,
        })?;
        let signed = Signed { claim, digest: blob.digest.clone(), bytes };
        self.signed.lock().unwrap_or_else(PoisonError::into_inner).insert(upload.clone(), signed);
        let (store, ended) = (Arc::clone(self), upload.clone());
        let time = sent_within(bytes);
        tokio::spawn(async move {
            tokio::time::sleep(time).await;
            // Also if it has become a blob: its client may have sent the object once more.
            if let Place::Bucket(bucket) = &store.place {
                delete(bucket, &ended).await;
            }
            drop(store.take_signed(&ended));
        });
        Ok(Some(DirectWrite { upload, request, bytes }))
    }

    /// Takes what a client has sent to the bucket from `offset` on, and returns its length. If nothing is
    /// missing any more, checks all and makes it the blob. No caller interrupts it.
    ///
    /// # Errors
    /// [`ObjectError::NoUpload`] when nothing has arrived; [`ObjectError::DigestMismatch`] when the bytes
    /// differ from the declaration; [`ObjectError::Busy`] when a stream writes the blob, or too many uploads
    /// wait for their check; as [`BlobStore::begin_write`]. The client has to send it again.
    pub async fn finish_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        upload: &str,
        offset: u64,
        limit_bytes: Option<u64>,
    ) -> Result<u64, ObjectError> {
        check_digest(&blob.digest)?;
        if check_digest(upload).is_err() || upload[..PREFIX] != blob.digest[..PREFIX] {
            return Err(ObjectError::NoUpload);
        }
        let (store, blob, upload) = (Arc::clone(self), blob.clone(), upload.to_owned());
        let finished = tokio::spawn(async move {
            let Place::Bucket(bucket) = &store.place else { return Err(ObjectError::NoUpload) };
            let adopted = store.adopt_sent(bucket, &blob, &upload, offset, limit_bytes).await;
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

    /// Makes what was sent a segment of the blob, or the blob, unless the blob is there.
    async fn adopt_sent(
        self: &Arc<Self>,
        bucket: &Arc<Bucket>,
        blob: &BlobRef,
        upload: &str,
        offset: u64,
        limit_bytes: Option<u64>,
    ) -> Result<u64, ObjectError> {
        let sent = path_of(upload);
        let found = bucket.head(&sent).await?.ok_or(ObjectError::NoUpload)?;
        let end = offset.saturating_add(found.size);
        if end > blob.bytes || found.size == 0 {
            let message = format!("{} bytes arrived from byte {offset} of {} on", found.size, blob.bytes);
            return Err(ObjectError::DigestMismatch { digest: blob.digest.clone(), message });
        }
        // Only the last part is followed by reading all of them.
        let _turn = match end == blob.bytes {
            true => Some(self.finishes.turn().await.ok_or_else(|| ObjectError::Busy(blob.digest.clone()))?),
            false => None,
        };
        let claim = WriteClaim::take(self, &blob.digest)?;
        let (arrived_bytes, is_complete) = self.committed(blob).await?;
        if is_complete {
            return Ok(found.size);
        }
        if arrived_bytes != offset {
            // It would stay beside what has arrived, and nobody would count it.
            let (digest, committed_bytes) = (blob.digest.clone(), arrived_bytes);
            return Err(ObjectError::WrongOffset { digest, offset_bytes: offset, committed_bytes });
        }
        let segment = segments::path_at(&blob.digest, offset);
        let copied = match bucket.store().copy(&sent, &segment).await {
            Err(object_store::Error::NotFound { .. }) => Err(ObjectError::NoUpload),
            copied => copied.map_err(ObjectError::Unavailable),
        };
        let replaced =
            Replaced { upload: upload.to_owned(), bytes: found.size, is_ours: self.is_signed(upload) };
        let admitted = match copied {
            Ok(()) => self.admit(&claim, blob, end, limit_bytes, Some(replaced)).await,
            Err(error) => Err(error),
        };
        match admitted {
            Ok(true) if end == blob.bytes => {
                BlobWriter::open(claim, blob.clone(), end).await?.finish().await?;
            }
            Ok(true) => {
                claim.replace(None);
                drop(self.take_signed(upload));
                claim.settle().await;
            }
            admitted => {
                // The copy may have been made although the bucket did not say so.
                bucket.delete(vec![segment], |_| ()).await?;
                // Another coordinator may have completed it.
                claim.count(if let Ok(false) = admitted { 0 } else { offset });
                claim.settle().await;
                admitted?;
            }
        }
        Ok(found.size)
    }

    /// The upload of a blob that a client has not finished; sending the blob here replaces it.
    pub(super) fn signed_for(&self, digest: &str) -> Option<Replaced> {
        let signed = self.signed.lock().unwrap_or_else(PoisonError::into_inner);
        let (upload, found) = signed.iter().find(|(_, signed)| signed.digest == digest)?;
        Some(Replaced { upload: upload.clone(), bytes: found.bytes, is_ours: true })
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
