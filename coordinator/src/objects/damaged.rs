//! Blobs that the disk has changed.
//!
//! A blob is hashed on arrival, and again by its readers. If the digests differ, the blob is moved to
//! `damaged/` and counts as missing. Clients are asked to upload it again, and tasks make results again. The
//! file stays there as long as garbage, for an analysis of the disk's fault.

use std::io;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};

use super::{BlobStore, ObjectError, object_path, spawn_io};

impl BlobStore {
    /// Hashes a blob that was reported as damaged, and quarantines it if it is; returns whether it is.
    /// Reports are never trusted.
    ///
    /// # Errors
    /// When the disk cannot be read, or the file cannot be moved.
    pub async fn set_aside_if_damaged(&self, digest: &str) -> Result<bool, ObjectError> {
        let path = self.root.join(object_path(digest)?.as_ref());
        let root = self.root.clone();
        let aside = self.root.join("damaged").join(digest);
        let (looking, digest, only_looks) = (Arc::clone(&self.looking), digest.to_owned(), self.only_looks);
        let set_aside = spawn_io(&root, move || {
            let _alone = looking.lock().unwrap_or_else(PoisonError::into_inner);
            let mut file = match std::fs::File::open(&path) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((false, 0)),
                file => file?,
            };
            let mut hasher = blake3::Hasher::new();
            let bytes = io::copy(&mut file, &mut hasher)?;
            let found = hasher.finalize().to_hex();
            if found.as_str() == digest {
                return Ok((false, 0));
            }
            if only_looks {
                return Ok((true, 0));
            }
            std::fs::rename(&path, &aside)?;
            tracing::error!(%digest, %found, aside = %aside.display(), "the disk has changed a blob; check the disk");
            Ok((true, bytes))
        });
        let (is_damaged, bytes) = set_aside.await?;
        self.whole_bytes.fetch_sub(bytes, Ordering::Relaxed);
        Ok(is_damaged)
    }
}
