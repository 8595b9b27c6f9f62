//! Bytes by content: photographs, plans, checkpoints, models.
//!
//! A blob lives at `cas/aa/<digest>` of the object store (`aa`: the first two digits of its BLAKE3) and is
//! never changed. What is being uploaded grows under `uploads/<digest>.part` on the same file system; when
//! length and digest are as declared, it is synced and renamed into place, so a blob is visible whole or
//! not at all, whatever is killed when. The client's digest is never believed. A blob that the disk has changed since is put
//! aside (`damaged.rs`) when somebody finds it out.

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

/// What an object store may answer instead.
#[derive(Debug, thiserror::Error)]
pub enum ObjectError {
    /// Not 64 lower-case hex digits.
    #[error("{0:?} is no digest; a digest is BLAKE3 as 64 lower-case hex digits")]
    BadDigest(String),
    /// There is no such blob.
    #[error("there is no blob {0}; upload it first")]
    NotFound(String),
    /// A write that does not begin where the last one ended.
    #[error("the upload of {digest} goes on at byte {committed_bytes}, not at {offset_bytes}")]
    WrongOffset {
        /// Which blob.
        digest: String,
        /// What came.
        offset_bytes: u64,
        /// What is expected.
        committed_bytes: u64,
    },
    /// The bytes are not those that were declared.
    #[error("blob {digest}: {message}; what had arrived was thrown away, send it again")]
    DigestMismatch {
        /// What was declared.
        digest: String,
        /// What is wrong.
        message: String,
    },
    /// A blob that would have to be read into memory, and has more than whatever it could be.
    #[error("blob {digest} has {bytes} bytes, and of what it is said to be at most {most} are read")]
    TooLarge {
        /// Which blob.
        digest: String,
        /// Its length.
        bytes: u64,
        /// What is allowed.
        most: u64,
    },
    /// A blob that is there is not what it was.
    #[error(
        "blob {0} has another digest on the coordinator's disk: the disk changed it; check the disk, and upload the blob again"
    )]
    Damaged(String),
    /// Another stream writes this blob.
    #[error("blob {0} is being written by another stream; ask QueryBlob and try again")]
    Busy(String),
    /// A tenant would have more than it may.
    #[error("the blobs have {used_bytes} bytes and may have {limit_bytes}")]
    OverLimit {
        /// What they have.
        used_bytes: u64,
        /// What they may have.
        limit_bytes: u64,
    },
    /// The disk is nearly full.
    #[error("{free_bytes} bytes are free on the coordinator's disk and {min_free_bytes} are kept; free some")]
    LowSpace {
        /// What is free.
        free_bytes: u64,
        /// What must stay free.
        min_free_bytes: u64,
    },
    /// The file system failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The object store failed.
    #[error("object store: {0}")]
    Store(#[from] object_store::Error),
}

/// Most of a blob that is read into memory, bytes. The largest that is read so are sparse points: 100 million of them, each seen
/// by four views.
const MAX_READ_BYTES: u64 = 4 << 30;

/// The blobs of one tenant.
pub struct BlobStore {
    store: Arc<dyn ObjectStore>,
    root: PathBuf,
    min_free_bytes: u64,
    /// Whether what is damaged stays where it is, and nothing gets younger by being asked for.
    only_looks: bool,
    /// Tells how old files are.
    clock: Clock,
    /// Digests that a stream is writing.
    writing: Mutex<HashSet<String>>,
    /// Read while a blob is asked for, written while one is removed.
    asked: Arc<RwLock<()>>,
    /// Bytes of all blobs that are whole.
    whole_bytes: AtomicU64,
    /// Bytes of those that are not.
    declared: Mutex<declared::Declared>,
    /// Held from the look at a blob that may be damaged to its end: another one may come in its place.
    looking: Arc<Mutex<()>>,
}

impl BlobStore {
    /// Opens or creates the store in a directory. Writes are refused when less than `min_free_bytes` is free; `clock` tells how old
    /// files are.
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

    /// Opens a store that is there, to look at; nothing is created or put aside.
    ///
    /// # Errors
    /// When the directory is not there.
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

    /// Removes what an earlier process was writing under [`BlobStore::staging_path`] when it died. To be called when no other
    /// process has the store.
    ///
    /// # Errors
    /// When the folder cannot be read or a file cannot be removed.
    pub fn discard_staged(&self) -> Result<(), ObjectError> {
        let folder = self.root.join("staging");
        for entry in std::fs::read_dir(&folder).map_err(io_error("read", &folder))? {
            let path = entry.map_err(io_error("read", &folder))?.path();
            std::fs::remove_file(&path).map_err(io_error("remove", &path))?;
            tracing::info!(path = %path.display(), "removed what a coordinator that died was writing");
        }
        Ok(())
    }

    /// Whether the blob is there, whole. Garbage collection leaves it alone for a while from now on.
    pub async fn contains(&self, blob: &BlobRef) -> Result<bool, ObjectError> {
        let (path, asked) = (self.local_path(blob)?, Arc::clone(&self.asked));
        let now = (!self.only_looks).then(|| self.clock.system_time());
        let bytes = spawn_io(&path.clone(), move || garbage::ask(&asked, &path, now)).await?;
        Ok(bytes == Some(blob.bytes))
    }

    /// An error that names the blob unless it is there.
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

    /// How much of a blob has arrived, and whether it is whole and visible.
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

    /// As [`BlobStore::read`], for what is small: a reference may name any blob, also photographs and models of many GB.
    pub async fn read_at_most(&self, blob: &BlobRef, most: u64) -> Result<Bytes, ObjectError> {
        if blob.bytes > most {
            return Err(ObjectError::TooLarge { digest: blob.digest.clone(), bytes: blob.bytes, most });
        }
        // With the length that it is said to have, or it is not this blob.
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

    /// Makes a blob of a file under [`BlobStore::staging_path`] that the coordinator wrote, hashed as it wrote and synced; the
    /// file is moved.
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

    /// Opens the upload of a blob at `offset`, which must be what has arrived so far; `None` when it is there. With it there are at most
    /// `limit_bytes`, where that is given.
    ///
    /// # Errors
    /// When the offset is another, another stream writes this blob, the limit does not allow it, or the disk is nearly full.
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

    /// Bytes that are free on its disk, and that are to stay free.
    pub async fn space(&self) -> Result<(u64, u64), ObjectError> {
        let root = self.root.clone();
        let free_bytes = spawn_io(&self.root, move || free_bytes(&root)).await?;
        Ok((free_bytes, self.min_free_bytes))
    }

    /// Refuses when writing `bytes` more would leave less free than must stay free.
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

/// The right to write one blob; given back when dropped.
struct WriteClaim {
    store: Arc<BlobStore>,
    digest: String,
    /// What has come; `None` until the upload counts.
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

/// Also what keeps `..` and `/` out of every path that is made of a digest.
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
    /// Whether the disk, or what the system lets the process have of it, is full.
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

/// Where the system is not asked, the disk counts as empty; a full one still fails the write itself.
#[cfg(not(unix))]
fn free_bytes(_path: &Path) -> io::Result<u64> {
    Ok(u64::MAX)
}

#[cfg(test)]
mod tests;
