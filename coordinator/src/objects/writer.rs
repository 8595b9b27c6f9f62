//! One upload in progress.

use std::fs::File;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use object_store::ObjectStoreExt;
use object_store::path::Path as ObjectPath;

use super::{ObjectError, WriteClaim, object_path, part_name, spawn_io};

/// Appends to one blob. Appended bytes stay when the writer is dropped; only [`BlobWriter::finish`] makes the
/// blob visible.
pub struct BlobWriter {
    claim: WriteClaim,
    blob: BlobRef,
    path: PathBuf,
    file: Arc<File>,
    hasher: blake3::Hasher,
    written: u64,
}

impl BlobWriter {
    pub(super) async fn open(claim: WriteClaim, blob: BlobRef, offset: u64) -> Result<Self, ObjectError> {
        let path = claim.store.part_path(&blob.digest);
        let existing = path.clone();
        // Earlier bytes are rehashed from the disk, because the disk's bytes will be published.
        let hasher = spawn_io(&path, move || {
            let mut hasher = blake3::Hasher::new();
            if offset > 0 {
                io::copy(&mut std::fs::File::open(&existing)?, &mut hasher)?;
            }
            Ok(hasher)
        })
        .await?;
        let to_open = path.clone();
        let file = spawn_io(&path, move || File::options().create(true).append(true).open(&to_open)).await?;
        Ok(Self { claim, blob, path, file: Arc::new(file), hasher, written: offset })
    }

    /// Bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Appends `data`, which must begin at `offset`.
    ///
    /// # Errors
    /// When it begins elsewhere, exceeds the declared length, or cannot be written.
    pub async fn append(&mut self, offset: u64, data: Bytes) -> Result<(), ObjectError> {
        if offset != self.written {
            return Err(ObjectError::WrongOffset {
                digest: self.blob.digest.clone(),
                offset_bytes: offset,
                committed_bytes: self.written,
            });
        }
        if self.written + data.len() as u64 > self.blob.bytes {
            let declared = self.blob.bytes;
            return Err(self.discard(format!("more than the declared {declared} bytes arrived")).await);
        }
        let (file, piece, now) = (Arc::clone(&self.file), data.clone(), self.claim.store.clock.system_time());
        spawn_io(&self.path, move || {
            (&*file).write_all(&piece)?;
            file.set_modified(now)
        })
        .await?;
        self.hasher.update(&data);
        self.written += data.len() as u64;
        self.claim.arrived_bytes = Some(self.written);
        Ok(())
    }

    /// Makes the received bytes durable without ending the upload.
    pub async fn pause(mut self) -> Result<u64, ObjectError> {
        self.sync().await?;
        Ok(self.written)
    }

    /// Ends the upload: checks length and digest, and makes the blob visible.
    ///
    /// # Errors
    /// [`ObjectError::DigestMismatch`] when the bytes, as received or on the disk, differ from the
    /// declaration; they are deleted.
    pub async fn finish(mut self) -> Result<(), ObjectError> {
        if self.written != self.blob.bytes {
            let message = format!("{} of {} bytes arrived", self.written, self.blob.bytes);
            return Err(self.discard(message).await);
        }
        let found = self.hasher.finalize().to_hex();
        if found.as_str() != self.blob.digest {
            return Err(self.discard(format!("the received bytes have the digest {found}")).await);
        }
        self.sync().await?;
        // The digest covers the bytes of this writer. A write of an abandoned upload may still be in flight
        // when this one opens the file, and adds bytes that this one never saw.
        let (file, now) = (Arc::clone(&self.file), self.claim.store.clock.system_time());
        let on_disk = spawn_io(&self.path, move || {
            file.set_modified(now)?;
            Ok(file.metadata()?.len())
        })
        .await?;
        if on_disk != self.blob.bytes {
            let declared = self.blob.bytes;
            let message =
                format!("{on_disk} bytes are on the disk, {declared} were declared; upload it again");
            return Err(self.discard(message).await);
        }
        let from = ObjectPath::from_iter(["uploads", &part_name(&self.blob.digest)]);
        let to = object_path(&self.blob.digest)?;
        threads::by_library(self.claim.store.store.rename(&from, &to)).await?;
        self.claim.store.whole_bytes.fetch_add(self.blob.bytes, Ordering::Relaxed);
        self.claim.arrived_bytes = Some(0);
        Ok(())
    }

    async fn sync(&mut self) -> Result<(), ObjectError> {
        let file = Arc::clone(&self.file);
        spawn_io(&self.path, move || file.sync_all()).await
    }

    async fn discard(&mut self, message: String) -> ObjectError {
        let path = self.path.clone();
        match spawn_io(&self.path, move || std::fs::remove_file(&path)).await {
            Ok(()) => {
                self.claim.arrived_bytes = Some(0);
                ObjectError::DigestMismatch { digest: self.blob.digest.clone(), message }
            }
            Err(error) => error,
        }
    }
}
