//! A private copy of a store, for read-only operations.
//!
//! sled writes when it opens: it truncates its log, makes a snapshot, frees segments. That would change the
//! store under inspection, and fails on a read-only or full disk. So its files are copied elsewhere, and the
//! copy is opened. The store itself is only read, under the lock that a coordinator takes, so that none
//! starts to write meanwhile.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::{SledOptions, SledStore, snapshots};

impl SledStore {
    /// Opens a copy of a store, in a new folder in `scratch` or the system's folder for temporary files. The
    /// copy is deleted with the returned store.
    ///
    /// # Errors
    /// When a process has the store open, its files cannot be read, or `scratch` has no room for them;
    /// otherwise as [`SledStore::open`].
    pub fn open_copy(options: &SledOptions, scratch: Option<&Path>) -> Result<Self, StoreError> {
        let from = options.dir.join("sled");
        let scratch = scratch.map_or_else(std::env::temp_dir, Path::to_owned);
        let unusable =
            |error: io::Error| StoreError::NoCopy { scratch: scratch.clone(), message: error.to_string() };
        let copy = tempfile::Builder::new().prefix("fathom-store-").tempdir_in(&scratch).map_err(unusable)?;
        copy_store(&from, &copy.path().join("sled"), &scratch)?;
        let options = SledOptions { dir: copy.path().to_owned(), ..options.clone() };
        Ok(Self { _copy: Some(copy), ..Self::open(&options)? })
    }
}

/// Copies the files of the directory `from` that sled reads.
fn copy_store(from: &Path, to: &Path, scratch: &Path) -> Result<(), StoreError> {
    let unreadable =
        |path: &Path, error: io::Error| StoreError::Failed(format!("{}: {error}", path.display()));
    let log = from.join("db");
    let lock = File::open(&log).map_err(|error| unreadable(&log, error))?;
    match lock.try_lock_shared() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(StoreError::InUse { path: from.display().to_string() }),
        // A coordinator cannot run on a file system without locks either.
        Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {}
        Err(TryLockError::Error(error)) => return Err(unreadable(&log, error)),
    }
    let files = files_of(from).map_err(|error| unreadable(from, error))?;
    let copied = || -> io::Result<()> {
        fs::create_dir_all(to.join("blobs"))?;
        files.iter().try_for_each(|file| fs::copy(from.join(file), to.join(file)).map(drop))
    };
    copied().map_err(|error| {
        let bytes: u64 =
            files.iter().filter_map(|file| from.join(file).metadata().ok()).map(|meta| meta.len()).sum();
        let message = format!("{error} (the copy has {bytes} bytes)");
        StoreError::NoCopy { scratch: scratch.to_owned(), message }
    })
}

/// The files that a copy needs, as paths under `from`. Snapshots that sled cannot read are left out, as when
/// a coordinator starts.
fn files_of(from: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !entry.file_type()?.is_file() || name.starts_with("set-aside.") {
            continue;
        }
        if snapshots::is_one(&name)
            && let Some(why) = snapshots::fault(&entry.path())?
        {
            tracing::warn!(
                "the store's snapshot {name} is left out of the copy: {why}; nothing is lost, it is rebuilt from the log \
                 when a coordinator starts"
            );
            continue;
        }
        files.push(PathBuf::from(name));
    }
    let blobs = from.join("blobs");
    if blobs.is_dir() {
        for entry in fs::read_dir(blobs)? {
            files.push(Path::new("blobs").join(entry?.file_name()));
        }
    }
    Ok(files)
}
