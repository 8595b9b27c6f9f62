//! Bytes by content: photographs, plans, checkpoints, models.
//!
//! A blob lives at `cas/aa/<digest>` of the object store (`aa`: the first two digits of its BLAKE3) and is
//! never changed. An upload grows under `uploads/<digest>.part` on the same file system. When length and
//! digest are as declared, it is synced and renamed into place. So a blob is visible completely or not at
//! all, whatever crashes. The client's digest is never trusted. A blob that the disk has changed is
//! quarantined (`damaged.rs`) when a reader notices.

mod damaged;
mod declared;
mod garbage;
mod tenants;
mod writer;

use std::collections::HashSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use object_store::local::LocalFileSystem;
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::clock::Clock;

pub use garbage::Removed;
pub use tenants::TenantBlobs;
pub use writer::BlobWriter;

/// Errors of the object store.
#[derive(Debug, thiserror::Error)]
pub enum ObjectError {
    /// Not 64 lower-case hex digits.
    #[error("{0:?} is not a digest; a digest is BLAKE3 as 64 lower-case hex digits")]
    BadDigest(String),
    /// There is no such blob.
    #[error("there is no blob {0}; upload it first")]
    NotFound(String),
    /// A write at the wrong offset.
    #[error("the upload of {digest} continues at byte {committed_bytes}, not at {offset_bytes}")]
    WrongOffset {
        /// The blob.
        digest: String,
        /// The offset received.
        offset_bytes: u64,
        /// The offset expected.
        committed_bytes: u64,
    },
    /// The bytes differ from the declaration.
    #[error("blob {digest}: {message}; the received bytes were deleted, send the blob again")]
    DigestMismatch {
        /// The declared digest.
        digest: String,
        /// The fault.
        message: String,
    },
    /// A blob that is too large to be read into memory as its type.
    #[error("blob {digest} is {bytes} bytes; the limit for this type is {most}")]
    TooLarge {
        /// The blob.
        digest: String,
        /// Its length.
        bytes: u64,
        /// The limit.
        most: u64,
    },
    /// A blob has changed on disk.
    #[error(
        "blob {0} has another digest on the coordinator's disk: the disk changed it; check the disk, and upload the blob again"
    )]
    Damaged(String),
    /// Another stream writes this blob.
    #[error("blob {0} is being written by another stream; call QueryBlob and try again")]
    Busy(String),
    /// A tenant would exceed its quota.
    #[error("the blobs use {used_bytes} of {limit_bytes} bytes")]
    OverLimit {
        /// Bytes used.
        used_bytes: u64,
        /// Bytes allowed.
        limit_bytes: u64,
    },
    /// The disk is nearly full.
    #[error(
        "{free_bytes} bytes are free on the coordinator's disk, but {min_free_bytes} must stay free; free some space"
    )]
    LowSpace {
        /// Bytes free.
        free_bytes: u64,
        /// Bytes that must stay free.
        min_free_bytes: u64,
    },
    /// The file system failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// The path.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The object store failed.
    #[error("object store: {0}")]
    Store(#[from] object_store::Error),
}

/// Largest blob that is read into memory, bytes. The largest such blobs are sparse points: 100 million, each
/// seen by four views.
const MAX_READ_BYTES: u64 = 4 << 30;

/// The blobs of one tenant.
pub struct BlobStore {
    store: Arc<dyn ObjectStore>,
    root: PathBuf,
    min_free_bytes: u64,
    /// Whether the store is read-only: damaged blobs stay in place, and checks refresh no times.
    only_looks: bool,
    /// Clock for the age of files.
    clock: Clock,
    /// Digests that a stream is writing.
    writing: Mutex<HashSet<String>>,
    /// Read-locked while a blob is checked, write-locked while one is removed.
    asked: Arc<RwLock<()>>,
    /// Bytes of all complete blobs.
    whole_bytes: AtomicU64,
    /// Bytes of incomplete ones.
    declared: Mutex<declared::Declared>,
    /// Held during the whole check of a possibly damaged blob: a new upload may replace it.
    looking: Arc<Mutex<()>>,
}

impl BlobStore {
    /// Opens or creates the store in a directory. Writes are refused when less than `min_free_bytes` is free;
    /// `clock` determines the age of files.
    ///
    /// # Errors
    /// When the directory cannot be created.
    pub fn open(root: &Path, min_free_bytes: u64, clock: Clock) -> Result<Self, ObjectError> {
        for folder in [root.to_owned(), root.join("uploads"), root.join("staging"), root.join("damaged")] {
            std::fs::create_dir_all(&folder).map_err(io_error("create", &folder))?;
        }
        let store = Self { min_free_bytes, only_looks: false, clock, ..Self::existing(root)? };
        let whole_bytes = store.count_bytes().map_err(io_error("read", root))?;
        store.whole_bytes.store(whole_bytes, Ordering::Relaxed);
        store.find_declared().map_err(io_error("read", root))?;
        Ok(store)
    }

    /// Opens an existing store read-only; nothing is created or quarantined.
    ///
    /// # Errors
    /// When the directory does not exist.
    pub fn existing(root: &Path) -> Result<Self, ObjectError> {
        // Without `with_fsync` a blob that was acknowledged can be lost or empty after a power cut.
        let store = LocalFileSystem::new_with_prefix(root)?.with_fsync(true);
        Ok(Self {
            store: Arc::new(store),
            root: root.to_owned(),
            min_free_bytes: 0,
            only_looks: true,
            clock: Clock::start(),
            writing: Mutex::default(),
            asked: Arc::default(),
            whole_bytes: AtomicU64::new(0),
            declared: Mutex::default(),
            looking: Arc::default(),
        })
    }

    fn whole_bytes(&self) -> u64 {
        self.whole_bytes.load(Ordering::Relaxed)
    }

    /// Removes files that an earlier process was writing under [`BlobStore::staging_path`] when it crashed.
    /// Call it when no other process has the store.
    ///
    /// # Errors
    /// When the folder cannot be read or a file cannot be removed.
    pub fn discard_staged(&self) -> Result<(), ObjectError> {
        let folder = self.root.join("staging");
        for entry in std::fs::read_dir(&folder).map_err(io_error("read", &folder))? {
            let path = entry.map_err(io_error("read", &folder))?.path();
            std::fs::remove_file(&path).map_err(io_error("remove", &path))?;
            tracing::info!(path = %path.display(), "removed unfinished files of a crashed coordinator");
        }
        Ok(())
    }

    /// Whether the blob is present and complete. From now on garbage collection spares it for a while.
    pub async fn contains(&self, blob: &BlobRef) -> Result<bool, ObjectError> {
        let (path, asked) = (self.local_path(blob)?, Arc::clone(&self.asked));
        let now = (!self.only_looks).then(|| self.clock.system_time());
        let bytes = spawn_io(&path.clone(), move || garbage::ask(&asked, &path, now)).await?;
        Ok(bytes == Some(blob.bytes))
    }

    /// Returns an error that names the blob unless it is present.
    pub async fn require(&self, blob: &BlobRef) -> Result<(), ObjectError> {
        if self.contains(blob).await? { Ok(()) } else { Err(ObjectError::NotFound(blob.digest.clone())) }
    }

    /// Length of a blob.
    pub async fn size(&self, digest: &str) -> Result<u64, ObjectError> {
        match threads::by_library(self.store.head(&object_path(digest)?)).await {
            Ok(meta) => Ok(meta.size),
            Err(object_store::Error::NotFound { .. }) => Err(ObjectError::NotFound(digest.to_owned())),
            Err(error) => Err(error.into()),
        }
    }

    /// Received bytes of a blob, and whether it is complete and visible.
    pub async fn committed(&self, blob: &BlobRef) -> Result<(u64, bool), ObjectError> {
        check_digest(&blob.digest)?;
        if self.contains(blob).await? {
            return Ok((blob.bytes, true));
        }
        let path = self.part_path(&blob.digest);
        let part = path.clone();
        let arrived = spawn_io(&path, move || match std::fs::metadata(&part) {
            Ok(meta) => Ok(meta.len()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            Err(error) => Err(error),
        });
        Ok((arrived.await?, false))
    }

    /// Bytes of a blob from `offset` on, at most `limit`. Not checked against the digest: the reader does.
    pub async fn read_range(&self, digest: &str, offset: u64, limit: u64) -> Result<Bytes, ObjectError> {
        let end = self.size(digest).await?.min(offset.saturating_add(limit));
        if offset >= end {
            return Ok(Bytes::new());
        }
        Ok(threads::by_library(self.store.get_range(&object_path(digest)?, offset..end)).await?)
    }

    /// A whole blob, checked against its digest; at most 4 GiB of it.
    pub async fn read(&self, blob: &BlobRef) -> Result<Bytes, ObjectError> {
        self.read_at_most(blob, MAX_READ_BYTES).await
    }

    /// As [`BlobStore::read`], for small blobs: a reference may name any blob, also photographs and models of
    /// many GB.
    pub async fn read_at_most(&self, blob: &BlobRef, most: u64) -> Result<Bytes, ObjectError> {
        if blob.bytes > most {
            return Err(ObjectError::TooLarge { digest: blob.digest.clone(), bytes: blob.bytes, most });
        }
        // The length must match the reference, or it is not this blob.
        self.require(blob).await?;
        let path = object_path(&blob.digest)?;
        let bytes = threads::by_library(async { self.store.get(&path).await?.bytes().await }).await?;
        if blake3::hash(&bytes).to_hex().as_str() == blob.digest {
            return Ok(bytes);
        }
        self.set_aside_if_damaged(&blob.digest).await?;
        Err(ObjectError::Damaged(blob.digest.clone()))
    }

    /// Stores bytes that the coordinator made.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobRef, ObjectError> {
        let digest = blake3::hash(&bytes).to_hex().to_string();
        let blob = BlobRef { digest, bytes: bytes.len() as u64 };
        if !self.contains(&blob).await? {
            threads::by_library(self.store.put(&object_path(&blob.digest)?, bytes.into())).await?;
            self.write_time(self.local_path(&blob)?).await?;
            self.whole_bytes.fetch_add(blob.bytes, Ordering::Relaxed);
        }
        Ok(blob)
    }

    /// The file of a blob, for readers that stream.
    pub fn local_path(&self, blob: &BlobRef) -> Result<PathBuf, ObjectError> {
        check_digest(&blob.digest)?;
        Ok(self.root.join(object_path(&blob.digest)?.as_ref()))
    }

    /// A path on the same file system for a file that [`BlobStore::adopt`] takes over.
    pub fn staging_path(&self, name: &str) -> PathBuf {
        self.root.join("staging").join(name)
    }

    /// Turns a file under [`BlobStore::staging_path`] into a blob. The coordinator has written, hashed and
    /// synced it; the file is moved.
    pub async fn adopt(&self, name: &str, blob: BlobRef) -> Result<BlobRef, ObjectError> {
        let is_new = !self.contains(&blob).await?;
        let (from, to) = (ObjectPath::from_iter(["staging", name]), object_path(&blob.digest)?);
        self.write_time(self.staging_path(name)).await?;
        threads::by_library(self.store.rename(&from, &to)).await?;
        if is_new {
            self.whole_bytes.fetch_add(blob.bytes, Ordering::Relaxed);
        }
        Ok(blob)
    }

    /// Opens the upload of a blob at `offset`, which must equal the received bytes; `None` if the blob is
    /// complete. The total may not exceed `limit_bytes`, if set.
    ///
    /// # Errors
    /// When the offset is wrong, another stream writes this blob, the limit would be exceeded, or the disk is
    /// nearly full.
    pub async fn begin_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        offset: u64,
        limit_bytes: Option<u64>,
    ) -> Result<Option<BlobWriter>, ObjectError> {
        check_digest(&blob.digest)?;
        let mut claim = WriteClaim::take(self, &blob.digest)?;
        let (committed_bytes, complete) = self.committed(blob).await?;
        if complete {
            return Ok(None);
        }
        if offset != committed_bytes {
            return Err(ObjectError::WrongOffset {
                digest: blob.digest.clone(),
                offset_bytes: offset,
                committed_bytes,
            });
        }
        self.check_space(blob.bytes.saturating_sub(offset)).await?;
        self.declare_within(&blob.digest, blob.bytes, limit_bytes)?;
        claim.arrived_bytes = Some(offset);
        BlobWriter::open(claim, blob.clone(), offset).await.map(Some)
    }

    /// Bytes free on its disk, and bytes that must stay free.
    pub async fn space(&self) -> Result<(u64, u64), ObjectError> {
        let root = self.root.clone();
        let free_bytes = spawn_io(&self.root, move || free_bytes(&root)).await?;
        Ok((free_bytes, self.min_free_bytes))
    }

    /// Refuses if writing `bytes` more would leave too little free.
    pub async fn check_space(&self, bytes: u64) -> Result<(), ObjectError> {
        let (free_bytes, min_free_bytes) = self.space().await?;
        if free_bytes.saturating_sub(bytes) < min_free_bytes {
            return Err(ObjectError::LowSpace { free_bytes, min_free_bytes });
        }
        Ok(())
    }

    async fn write_time(&self, path: PathBuf) -> Result<(), ObjectError> {
        let now = self.clock.system_time();
        spawn_io(&path.clone(), move || garbage::write_time(&path, now)).await
    }

    fn part_path(&self, digest: &str) -> PathBuf {
        self.root.join("uploads").join(part_name(digest))
    }
}

/// The exclusive right to write one blob; returned when dropped.
struct WriteClaim {
    store: Arc<BlobStore>,
    digest: String,
    /// Received bytes; `None` until the upload counts.
    arrived_bytes: Option<u64>,
}

impl WriteClaim {
    fn take(store: &Arc<BlobStore>, digest: &str) -> Result<Self, ObjectError> {
        let mut writing = store.writing.lock().unwrap_or_else(PoisonError::into_inner);
        if writing.insert(digest.to_owned()) {
            Ok(Self { store: Arc::clone(store), digest: digest.to_owned(), arrived_bytes: None })
        } else {
            Err(ObjectError::Busy(digest.to_owned()))
        }
    }
}

impl Drop for WriteClaim {
    fn drop(&mut self) {
        // Before another stream may write it.
        if let Some(bytes) = self.arrived_bytes {
            self.store.declare(&self.digest, bytes);
        }
        self.store.writing.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.digest);
    }
}

fn part_name(digest: &str) -> String {
    format!("{digest}.part")
}

/// This also keeps `..` and `/` out of every path made from a digest.
fn check_digest(digest: &str) -> Result<(), ObjectError> {
    let is_hex = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    if digest.len() == 64 && digest.bytes().all(is_hex) {
        Ok(())
    } else {
        Err(ObjectError::BadDigest(digest.chars().take(80).collect()))
    }
}

fn object_path(digest: &str) -> Result<ObjectPath, ObjectError> {
    check_digest(digest)?;
    Ok(ObjectPath::from_iter(["cas", &digest[..2], digest]))
}

impl ObjectError {
    /// Whether the disk, or the process's quota on it, is full.
    pub fn is_full(&self) -> bool {
        let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(self);
        while let Some(error) = cause {
            if let Some(error) = error.downcast_ref::<io::Error>()
                && matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            {
                return true;
            }
            cause = error.source();
        }
        false
    }
}

fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> ObjectError + use<> {
    let path = path.to_owned();
    move |source| ObjectError::Io { action, path, source }
}

/// Runs blocking file work on a thread for it.
async fn spawn_io<T: Send + 'static>(
    path: &Path,
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, ObjectError> {
    let result = threads::blocking(work).await.unwrap_or_else(|e| Err(io::Error::other(e)));
    result.map_err(io_error("use", path))
}

#[cfg(unix)]
fn free_bytes(path: &Path) -> io::Result<u64> {
    let stat = rustix::fs::statvfs(path)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Where the system cannot be asked, the disk counts as empty; writes to a full one still fail.
#[cfg(not(unix))]
fn free_bytes(_path: &Path) -> io::Result<u64> {
    Ok(u64::MAX)
}

#[cfg(test)]
mod tests;
