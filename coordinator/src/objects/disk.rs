//! Blobs in a folder of the local disk.
//!
//! An upload grows in one file and is renamed into place, so it resumes where it stopped. File times come
//! from the coordinator's clock (`garbage.rs`).

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::SystemTime;

use bytes::Bytes;
use fathom_observe::threads;
use object_store::local::LocalFileSystem;
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt};

use super::{ObjectError, garbage, io_error, object_path};
use crate::clock::Clock;

/// The blobs of one tenant on the local disk.
pub(super) struct Disk {
    store: LocalFileSystem,
    pub root: PathBuf,
    /// Whether it is read-only: damaged blobs stay in place, and checks refresh no times.
    only_looks: bool,
    /// Clock for the age of files.
    pub clock: Clock,
    /// Read-locked while a blob is checked, write-locked while one is removed.
    pub asked: Arc<RwLock<()>>,
    /// Held during the whole check of a possibly damaged blob: a new upload may replace it.
    looking: Arc<Mutex<()>>,
}

impl Disk {
    /// Opens or creates a folder.
    pub fn open(root: &Path, clock: Clock) -> Result<Self, ObjectError> {
        for folder in [root.to_owned(), root.join("uploads"), root.join("staging"), root.join("damaged")] {
            std::fs::create_dir_all(&folder).map_err(io_error("create", &folder))?;
        }
        Ok(Self { only_looks: false, clock, ..Self::existing(root)? })
    }

    /// Opens an existing folder read-only.
    pub fn existing(root: &Path) -> Result<Self, ObjectError> {
        // Without `with_fsync` a blob that was acknowledged can be lost or empty after a power cut.
        let store = LocalFileSystem::new_with_prefix(root)?.with_fsync(true);
        Ok(Self {
            store,
            root: root.to_owned(),
            only_looks: true,
            clock: Clock::start(),
            asked: Arc::default(),
            looking: Arc::default(),
        })
    }

    /// The file of a blob.
    pub fn path(&self, digest: &str) -> Result<PathBuf, ObjectError> {
        Ok(self.root.join(object_path(digest)?.as_ref()))
    }

    /// The file of an upload.
    pub fn part_path(&self, digest: &str) -> PathBuf {
        self.root.join("uploads").join(part_name(digest))
    }

    pub fn store(&self) -> &dyn ObjectStore {
        &self.store
    }

    /// The length of a blob, which is last used now; `None` if there is none.
    pub async fn ask(&self, digest: &str) -> Result<Option<u64>, ObjectError> {
        let (path, asked) = (self.path(digest)?, Arc::clone(&self.asked));
        let now = (!self.only_looks).then(|| self.clock.system_time());
        spawn_io(&path.clone(), move || garbage::ask(&asked, &path, now)).await
    }

    /// Received bytes of an upload.
    pub async fn arrived(&self, digest: &str) -> Result<u64, ObjectError> {
        let path = self.part_path(digest);
        let part = path.clone();
        let arrived = spawn_io(&path, move || match std::fs::metadata(&part) {
            Ok(meta) => Ok(meta.len()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            Err(error) => Err(error),
        });
        arrived.await
    }

    /// Writes a blob.
    pub async fn put(&self, digest: &str, bytes: Bytes) -> Result<(), ObjectError> {
        threads::by_library(self.store.put(&object_path(digest)?, bytes.into())).await?;
        self.write_time(self.path(digest)?).await
    }

    /// Turns a synced file of the folder into a blob.
    pub async fn adopt(&self, file: &Path, digest: &str) -> Result<(), ObjectError> {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let (from, to) = (ObjectPath::from_iter(["staging", &*name]), object_path(digest)?);
        self.write_time(file.to_owned()).await?;
        Ok(threads::by_library(self.store.rename(&from, &to)).await?)
    }

    /// Moves a blob aside if its bytes have another digest; returns its length, or `None` if they have not.
    pub async fn set_aside_if_damaged(&self, digest: &str) -> Result<Option<u64>, ObjectError> {
        let path = self.path(digest)?;
        let aside = self.root.join("damaged").join(digest);
        let (looking, digest, only_looks) = (Arc::clone(&self.looking), digest.to_owned(), self.only_looks);
        let set_aside = spawn_io(&self.root, move || {
            let _alone = looking.lock().unwrap_or_else(PoisonError::into_inner);
            let mut file = match File::open(&path) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
                file => file?,
            };
            let mut hasher = blake3::Hasher::new();
            let bytes = io::copy(&mut file, &mut hasher)?;
            let found = hasher.finalize().to_hex();
            if found.as_str() == digest {
                return Ok(None);
            }
            if only_looks {
                return Ok(Some(0));
            }
            std::fs::rename(&path, &aside)?;
            tracing::error!(%digest, %found, aside = %aside.display(), "the disk has changed a blob; check the disk");
            Ok(Some(bytes))
        });
        set_aside.await
    }

    async fn write_time(&self, path: PathBuf) -> Result<(), ObjectError> {
        let now = self.clock.system_time();
        spawn_io(&path.clone(), move || garbage::write_time(&path, now)).await
    }
}

/// An upload into one file.
pub(super) struct PartFile {
    disk: Arc<Disk>,
    digest: String,
    path: PathBuf,
    file: Arc<File>,
}

impl PartFile {
    /// Opens the file of an upload, of which `offset` bytes are there; adds these to `hasher`.
    pub async fn open(
        disk: &Arc<Disk>,
        digest: &str,
        offset: u64,
        mut hasher: blake3::Hasher,
    ) -> Result<(Self, blake3::Hasher), ObjectError> {
        let path = disk.part_path(digest);
        let existing = path.clone();
        // Earlier bytes are rehashed from the disk, because the disk's bytes will be published.
        let hasher = spawn_io(&path, move || {
            if offset > 0 {
                io::copy(&mut File::open(&existing)?, &mut hasher)?;
            }
            Ok(hasher)
        })
        .await?;
        let to_open = path.clone();
        let file = spawn_io(&path, move || File::options().create(true).append(true).open(&to_open)).await?;
        let (disk, digest) = (Arc::clone(disk), digest.to_owned());
        Ok((Self { disk, digest, path, file: Arc::new(file) }, hasher))
    }

    /// Appends bytes.
    pub async fn append(&self, piece: Bytes, now: SystemTime) -> Result<(), ObjectError> {
        let file = Arc::clone(&self.file);
        spawn_io(&self.path, move || {
            (&*file).write_all(&piece)?;
            file.set_modified(now)
        })
        .await
    }

    /// Makes the bytes durable.
    pub async fn sync(&self) -> Result<(), ObjectError> {
        let file = Arc::clone(&self.file);
        spawn_io(&self.path, move || file.sync_all()).await
    }

    /// Sets the time of the file; returns its length.
    pub async fn stamp(&self, now: SystemTime) -> Result<u64, ObjectError> {
        let file = Arc::clone(&self.file);
        let stamped = spawn_io(&self.path, move || {
            file.set_modified(now)?;
            Ok(file.metadata()?.len())
        });
        stamped.await
    }

    /// Makes the file the blob.
    pub async fn publish(&self) -> Result<(), ObjectError> {
        let from = ObjectPath::from_iter(["uploads", &part_name(&self.digest)]);
        let to = object_path(&self.digest)?;
        Ok(threads::by_library(self.disk.store.rename(&from, &to)).await?)
    }

    /// Deletes the file.
    pub async fn discard(&self) -> Result<(), ObjectError> {
        let path = self.path.clone();
        spawn_io(&self.path, move || std::fs::remove_file(&path)).await
    }
}

fn part_name(digest: &str) -> String {
    format!("{digest}.part")
}

/// Runs blocking file work on a thread for it.
pub(super) async fn spawn_io<T: Send + 'static>(
    path: &Path,
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, ObjectError> {
    let result = threads::blocking(work).await.unwrap_or_else(|e| Err(io::Error::other(e)));
    result.map_err(io_error("use", path))
}

/// Bytes free on the disk of a path.
#[cfg(unix)]
pub(super) fn free_bytes(path: &Path) -> io::Result<u64> {
    let stat = rustix::fs::statvfs(path)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Where the system cannot be asked, the disk counts as empty; writes to a full one still fail.
#[cfg(not(unix))]
pub(super) fn free_bytes(_path: &Path) -> io::Result<u64> {
    Ok(u64::MAX)
}
