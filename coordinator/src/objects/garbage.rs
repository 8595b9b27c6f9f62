//! Removal of unreferenced blobs.
//!
//! Before referencing a blob, callers check that it exists ([`BlobStore::contains`]), which also refreshes
//! its last-used time. So an old unreferenced blob will not be referenced later. Checks and removals exclude
//! each other. File times come from the coordinator's clock, not from the file system's machine: all ages use
//! one clock, which a simulation controls.

use std::collections::HashSet;
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use super::{BlobStore, check_digest};

/// The last-used time of a blob is refreshed only if it is older than this: many checks cause one write. It
/// is far shorter than any retention time, also in simulations.
const YOUNG: Duration = Duration::from_secs(1);

/// Counts of removed blobs and uploads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Removed {
    /// Blobs.
    pub blobs: u64,
    /// Abandoned uploads.
    pub uploads: u64,
    /// Bytes of both.
    pub bytes: u64,
}

impl Removed {
    /// Both together.
    pub fn and(self, other: Self) -> Self {
        Self {
            blobs: self.blobs + other.blobs,
            uploads: self.uploads + other.uploads,
            bytes: self.bytes + other.bytes,
        }
    }
}

impl BlobStore {
    /// The bytes of all blobs, by a scan.
    pub(super) fn count_bytes(&self) -> io::Result<u64> {
        let mut bytes = 0;
        for folder in folders(&self.root.join("cas"))? {
            for (path, _) in files(&folder)? {
                bytes += std::fs::metadata(path)?.len();
            }
        }
        Ok(bytes)
    }

    /// Removes blobs and uploads that were last used or written before `before`, except the blobs `used`.
    ///
    /// # Errors
    /// When a folder cannot be read or a file cannot be removed; files removed before stay removed.
    pub fn remove_unused(&self, before: SystemTime, used: &HashSet<String>) -> io::Result<Removed> {
        let mut removed = Removed::default();
        for folder in folders(&self.root.join("cas"))? {
            for (path, name) in files(&folder)? {
                if check_digest(&name).is_err() || used.contains(&name) {
                    continue;
                }
                if let Some(bytes) = self.remove_if_old(&path, before)? {
                    removed.blobs += 1;
                    removed.bytes += bytes;
                    self.whole_bytes.fetch_sub(bytes, Ordering::Relaxed);
                }
            }
        }
        for (path, name) in files(&self.root.join("uploads"))? {
            let digest = name.trim_end_matches(".part");
            if self.writing.lock().unwrap_or_else(PoisonError::into_inner).contains(digest) {
                continue;
            }
            if let Some(bytes) = self.remove_if_old(&path, before)? {
                self.declare(digest, 0);
                removed.uploads += 1;
                removed.bytes += bytes;
            }
        }
        for (path, _) in files(&self.root.join("damaged"))? {
            if let Some(bytes) = self.remove_if_old(&path, before)? {
                removed.blobs += 1;
                removed.bytes += bytes;
            }
        }
        Ok(removed)
    }

    /// Removes a file unless it is younger than `before`; returns its length if removed. A file from the
    /// future is from before the clock was set back. It counts as made now; otherwise it would stay until
    /// that time.
    fn remove_if_old(&self, path: &Path, before: SystemTime) -> io::Result<Option<u64>> {
        let _nobody_asks = self.asked.write().unwrap_or_else(PoisonError::into_inner);
        let found = match std::fs::metadata(path) {
            Ok(found) => found,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let (modified, now) = (found.modified()?, self.clock.system_time());
        if modified > now {
            write_time(path, now)?;
        }
        if modified >= before {
            return Ok(None);
        }
        std::fs::remove_file(path)?;
        Ok(Some(found.len()))
    }
}

/// The length of a blob's file, whose last-used time becomes `now` if set; `None` if there is no file.
pub(super) fn ask(asked: &RwLock<()>, path: &Path, now: Option<SystemTime>) -> io::Result<Option<u64>> {
    let _nothing_is_removed = asked.read().unwrap_or_else(PoisonError::into_inner);
    let found = match std::fs::metadata(path) {
        Ok(found) => found,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    if let Some(now) = now
        && now.duration_since(found.modified()?).is_ok_and(|age| age > YOUNG)
    {
        write_time(path, now)?;
    }
    Ok(Some(found.len()))
}

/// Records when a file was made or used.
pub(super) fn write_time(path: &Path, now: SystemTime) -> io::Result<()> {
    File::options().append(true).open(path)?.set_modified(now)
}

/// Folders in a folder by name; empty if it does not exist.
fn folders(folder: &Path) -> io::Result<Vec<std::path::PathBuf>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error),
    };
    let mut found = Vec::new();
    for entry in entries {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Files in a folder with their names, by name.
pub(super) fn files(folder: &Path) -> io::Result<Vec<(std::path::PathBuf, String)>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_file() {
            found.push((entry.path(), entry.file_name().to_string_lossy().into_owned()));
        }
    }
    found.sort();
    Ok(found)
}
