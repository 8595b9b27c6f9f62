//! Removal of unreferenced blobs.
//!
//! Before referencing a blob, callers check that it exists ([`BlobStore::contains`]), which also refreshes
//! its last-used time. So an old unreferenced blob will not be referenced later. Checks and removals exclude
//! each other. File times come from the coordinator's clock, not from the file system's machine: all ages use
//! one clock, which a simulation controls.

use std::collections::HashSet;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use super::disk::Disk;
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

/// The bytes of all blobs in a folder, by a scan.
pub(super) fn count_bytes(disk: &Disk) -> io::Result<u64> {
    let mut bytes = 0;
    for folder in folders(&disk.root.join("cas"))? {
        for (path, _) in files(&folder)? {
            bytes += std::fs::metadata(path)?.len();
        }
    }
    Ok(bytes)
}

/// Uploads of an earlier process: digests and received bytes.
pub(super) fn uploads(disk: &Disk) -> io::Result<Vec<(String, u64)>> {
    let length = |(path, name): (PathBuf, String)| {
        Ok((name.trim_end_matches(".part").to_owned(), std::fs::metadata(path)?.len()))
    };
    files(&disk.root.join("uploads"))?.into_iter().map(length).collect()
}

/// As [`BlobStore::remove_unused`], of the files in a folder.
pub(super) fn remove_unused(
    store: &BlobStore,
    disk: &Disk,
    before: SystemTime,
    used: &HashSet<String>,
) -> io::Result<Removed> {
    let mut removed = Removed::default();
    for folder in folders(&disk.root.join("cas"))? {
        for (path, name) in files(&folder)? {
            if check_digest(&name).is_err() || used.contains(&name) {
                continue;
            }
            if let Some(bytes) = remove_if_old(disk, &path, before)? {
                removed.blobs += 1;
                removed.bytes += bytes;
                store.count_removed(bytes);
            }
        }
    }
    for (path, name) in files(&disk.root.join("uploads"))? {
        let digest = name.trim_end_matches(".part");
        if store.is_written(digest) {
            continue;
        }
        if let Some(bytes) = remove_if_old(disk, &path, before)? {
            store.declare(digest, 0);
            removed.uploads += 1;
            removed.bytes += bytes;
        }
    }
    for (path, _) in files(&disk.root.join("damaged"))? {
        if let Some(bytes) = remove_if_old(disk, &path, before)? {
            removed.blobs += 1;
            removed.bytes += bytes;
        }
    }
    Ok(removed)
}

/// Removes a file unless it is younger than `before`; returns its length if removed. A file from the future
/// is from before the clock was set back. It counts as made now; otherwise it would stay until that time.
fn remove_if_old(disk: &Disk, path: &Path, before: SystemTime) -> io::Result<Option<u64>> {
    let _nobody_asks = disk.asked.write().unwrap_or_else(PoisonError::into_inner);
    let found = match std::fs::metadata(path) {
        Ok(found) => found,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    let (modified, now) = (found.modified()?, disk.clock.system_time());
    if modified > now {
        write_time(path, now)?;
    }
    if modified >= before {
        return Ok(None);
    }
    std::fs::remove_file(path)?;
    Ok(Some(found.len()))
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
fn folders(folder: &Path) -> io::Result<Vec<PathBuf>> {
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
pub(super) fn files(folder: &Path) -> io::Result<Vec<(PathBuf, String)>> {
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
