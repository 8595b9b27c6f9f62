//! Blobs that the disk or the bucket has changed.
//!
//! A blob is hashed on arrival, and again by its readers. If the digests differ, the blob is moved to
//! `damaged/` and counts as missing. Clients are asked to upload it again, and tasks make results again. The
//! bytes stay there as long as garbage, for an analysis of the fault.

use super::{BlobStore, ObjectError, Place};

impl BlobStore {
    /// Hashes a blob that was reported as damaged, and quarantines it if it is; returns whether it is.
    /// Reports are never trusted.
    ///
    /// # Errors
    /// When the blob cannot be read or moved.
    pub async fn set_aside_if_damaged(&self, digest: &str) -> Result<bool, ObjectError> {
        let set_aside = match &self.place {
            Place::Disk(disk) => disk.set_aside_if_damaged(digest).await?,
            Place::Bucket(bucket) => bucket.set_aside_if_damaged(digest, self.shared.as_ref()).await?,
        };
        self.count_removed(set_aside.unwrap_or(0));
        Ok(set_aside.is_some())
    }
}
