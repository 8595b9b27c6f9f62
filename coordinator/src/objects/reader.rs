//! Blobs as files, for readers that go through them in pieces on threads for blocking work.

use std::fmt;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_merge::{Files, LocalFiles, ReadSeek};
use tokio::runtime::Handle;

use super::{BlobStore, ObjectError, Place, object_path};

/// Bytes that a reader asks a bucket for at a time.
const READ_AHEAD_BYTES: u64 = 8 << 20;

/// The blobs of a bucket as files.
struct BlobFiles {
    store: Arc<BlobStore>,
    /// Readers are on threads of their own, which belong to no runtime.
    runtime: Handle,
}

impl fmt::Debug for BlobFiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("BlobFiles")
    }
}

impl Files for BlobFiles {
    fn open(&self, path: &Path) -> io::Result<(Box<dyn ReadSeek>, u64)> {
        let digest = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let bytes = self.runtime.block_on(self.store.size(&digest)).map_err(io::Error::other)?;
        let (store, runtime) = (Arc::clone(&self.store), self.runtime.clone());
        let reader = BlobReader { store, runtime, digest, bytes, at: 0, ahead: Bytes::new(), ahead_at: 0 };
        Ok((Box::new(reader), bytes))
    }
}

impl BlobStore {
    /// Its blobs as files, by [`BlobStore::path_of`]; for threads that may block.
    pub fn files(self: &Arc<Self>) -> Arc<dyn Files> {
        match &self.place {
            Place::Disk(_) => Arc::new(LocalFiles),
            Place::Bucket(_) => Arc::new(BlobFiles { store: Arc::clone(self), runtime: Handle::current() }),
        }
    }

    /// The path of a blob in [`BlobStore::files`].
    pub fn path_of(&self, blob: &BlobRef) -> Result<PathBuf, ObjectError> {
        match &self.place {
            Place::Disk(disk) => disk.path(&blob.digest),
            Place::Bucket(_) => Ok(PathBuf::from(object_path(&blob.digest)?.as_ref())),
        }
    }

    /// The digest of a blob's bytes as they are now.
    ///
    /// # Errors
    /// When there is no such blob, or it cannot be read.
    pub async fn digest_of(self: &Arc<Self>, blob: &BlobRef) -> Result<String, ObjectError> {
        let (files, path) = (self.files(), self.path_of(blob)?);
        let to_open = path.clone();
        let digest = super::spawn_io(&path, move || {
            let mut hasher = blake3::Hasher::new();
            io::copy(&mut files.open(&to_open)?.0, &mut hasher)?;
            Ok(hasher.finalize().to_hex().to_string())
        });
        digest.await
    }
}

/// A blob in a bucket as a file.
struct BlobReader {
    store: Arc<BlobStore>,
    runtime: Handle,
    digest: String,
    bytes: u64,
    at: u64,
    ahead: Bytes,
    /// Offset of `ahead`.
    ahead_at: u64,
}

impl Read for BlobReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.at >= self.bytes || buffer.is_empty() {
            return Ok(0);
        }
        if !(self.ahead_at..self.ahead_at + self.ahead.len() as u64).contains(&self.at) {
            let range = self.at..self.bytes.min(self.at + READ_AHEAD_BYTES);
            let read = self.runtime.block_on(self.store.range(&self.digest, range));
            (self.ahead, self.ahead_at) = (read.map_err(io::Error::other)?, self.at);
        }
        let rest = &self.ahead[(self.at - self.ahead_at) as usize..];
        let bytes = rest.len().min(buffer.len());
        buffer[..bytes].copy_from_slice(&rest[..bytes]);
        self.at += bytes as u64;
        Ok(bytes)
    }
}

impl Seek for BlobReader {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.bytes.checked_add_signed(by),
        };
        self.at =
            at.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "a position before the start"))?;
        Ok(self.at)
    }
}
