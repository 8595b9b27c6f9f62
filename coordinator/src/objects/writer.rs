//! One upload in progress.

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::scene::BlobRef;

use super::disk::PartFile;
use super::segments::Segments;
use super::{ObjectError, Place, WriteClaim};

/// Appends to one blob. Appended bytes stay when the writer is dropped; only [`BlobWriter::finish`] makes the
/// blob visible.
pub struct BlobWriter {
    claim: Arc<WriteClaim>,
    blob: BlobRef,
    body: Body,
    hasher: blake3::Hasher,
    written: u64,
}

/// Where the bytes go.
enum Body {
    File(PartFile),
    Segments(Segments),
}

impl BlobWriter {
    pub(super) async fn open(claim: WriteClaim, blob: BlobRef, offset: u64) -> Result<Self, ObjectError> {
        let claim = Arc::new(claim);
        let hasher = blake3::Hasher::new();
        let (body, hasher) = match &claim.store.place {
            Place::Disk(disk) => {
                let (file, hasher) = PartFile::open(disk, &blob.digest, offset, hasher).await?;
                (Body::File(file), hasher)
            }
            Place::Bucket(bucket) => {
                let opened = Segments::open(bucket, &claim, blob.bytes, offset, hasher).await?;
                (Body::Segments(opened.0), opened.1)
            }
        };
        Ok(Self { claim, blob, body, hasher, written: offset })
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
        match &mut self.body {
            Body::File(file) => {
                file.append(data.clone(), self.claim.store.clock.system_time()).await?;
                self.claim.count(self.written + data.len() as u64);
            }
            Body::Segments(segments) => segments.append(data.clone()).await?,
        }
        self.hasher.update(&data);
        self.written += data.len() as u64;
        Ok(())
    }

    /// Makes the received bytes durable without ending the upload.
    pub async fn pause(mut self) -> Result<u64, ObjectError> {
        match &mut self.body {
            Body::File(file) => file.sync().await?,
            Body::Segments(segments) => segments.save().await?,
        }
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
        match &mut self.body {
            Body::File(file) => {
                file.sync().await?;
                // The digest covers the bytes of this writer. A write of an abandoned upload may still be in
                // flight when this one opens the file, and adds bytes that this one never saw.
                let on_disk = file.stamp(self.claim.store.clock.system_time()).await?;
                if on_disk != self.blob.bytes {
                    let declared = self.blob.bytes;
                    let message =
                        format!("{on_disk} bytes are on the disk, {declared} were declared; upload it again");
                    return Err(self.discard(message).await);
                }
                file.publish().await?;
                // On a disk, garbage collection and uploads exclude each other.
                self.claim.complete(self.blob.bytes).await?;
            }
            Body::Segments(segments) => segments.publish().await?,
        }
        Ok(())
    }

    async fn discard(&mut self, message: String) -> ObjectError {
        let discarded = match &mut self.body {
            Body::File(file) => file.discard().await,
            Body::Segments(segments) => segments.discard().await,
        };
        match discarded {
            Ok(()) => {
                if let Body::File(_) = self.body {
                    self.claim.count(0);
                }
                ObjectError::DigestMismatch { digest: self.blob.digest.clone(), message }
            }
            Err(error) => error,
        }
    }
}
