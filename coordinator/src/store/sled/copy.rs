//! A private copy of a store, for who only wants to look.
//!
//! sled writes when it opens: it cuts the end of its log off, makes a snapshot, frees segments. That changes
//! what was to be looked at, and cannot be done on a read-only or a full disk. So its files are copied
//! elsewhere, and the copy is opened. The store itself is only read, under the lock that a coordinator takes,
//! so that none starts to write in the middle.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::{SledOptions, SledStore, snapshots};

impl SledStore {
    /// Opens a copy of a store, in a folder of its own in `scratch` or else where the system has temporary
    /// files. The copy goes with the store that this gives.
    ///
    /// # Errors
    /// When a process has the store open, its files cannot be read, or `scratch` has no room for them; else
    /// as [`SledStore::open`].
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

/// Copies what sled reads of the directory `from`.
fn copy_store(from: &Path, to: &Path, scratch: &Path) -> Result<(), StoreError> {
    let unreadable =
        |path: &Path, error: io::Error| StoreError::Failed(format!("{}: {error}", path.display()));
    let log = from.join("db");
    let lock = File::open(&log).map_err(|error| unreadable(&log, error))?;
    match lock.try_lock_shared() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(StoreError::InUse { path: from.display().to_string() }),
        // A file system without locks has no coordinator on it either.
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

/// The files that a copy needs, as paths under `from`. Snapshots that sled cannot read stay behind, as they
/// do when a coordinator starts.
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
                "the store's snapshot {name} is left out of the copy: {why}; nothing is lost, it is made again from the log \
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
