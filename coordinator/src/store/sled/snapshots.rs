//! Snapshots that sled did not finish or cannot read.
//!
//! A snapshot lists the position of each page in the log, and saves sled time when it opens. It is redundant
//! to the log. But sled 0.34.7 takes the last file whose name begins with `snap.`, and refuses to open if it
//! cannot read that one. A full disk or power loss leaves such a file behind, a `.generating`. Nothing is
//! lost then, so such files are set aside before sled starts, and it reads the log.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use flate2::Crc;

/// Names of files set aside: only the latest of each kind is kept for inspection.
const UNFINISHED: &str = "set-aside.unfinished-snapshot";
const UNREADABLE: &str = "set-aside.unreadable-snapshot";
const UNDONE: &str = "sled did not finish it";
/// Length and checksum at the end of a snapshot.
const TRAILER: usize = 12;

/// A snapshot that was set aside.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Aside {
    /// Its former name.
    pub(super) name: String,
    /// The fault.
    pub(super) why: &'static str,
    /// Its present path.
    pub(super) now: PathBuf,
}

/// Sets aside the snapshots in `dir`, a directory of sled, that would prevent it from opening. Does nothing
/// while another process has the store open, because that may be writing a snapshot.
///
/// # Errors
/// When the directory cannot be read or a file cannot be renamed.
pub(super) fn set_aside(dir: &Path) -> io::Result<Vec<Aside>> {
    let Some(_lock) = lock(&dir.join("db"))? else { return Ok(Vec::new()) };
    let mut names: Vec<String> = fs::read_dir(dir)?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<io::Result<_>>()?;
    // sled reads the last by name.
    names.retain(|name| is_one(name));
    names.sort_by(|a, b| b.cmp(a));
    let mut aside = Vec::new();
    for name in names {
        let Some(why) = fault(&dir.join(&name))? else { continue };
        let kept_as = if why == UNDONE { UNFINISHED } else { UNREADABLE };
        let now = dir.join(kept_as);
        fs::rename(dir.join(&name), &now)?;
        aside.push(Aside { name, why, now });
    }
    if !aside.is_empty() {
        super::opening::sync_folder(dir)?;
    }
    Ok(aside)
}

/// Whether a file is a snapshot, by its name.
pub(super) fn is_one(name: &str) -> bool {
    name.starts_with("snap.") && !name.ends_with(".in___motion")
}

/// The fault of a snapshot; `None` if sled can read it.
pub(super) fn fault(path: &Path) -> io::Result<Option<&'static str>> {
    if path.extension().is_some_and(|end| end == "generating") {
        return Ok(Some(UNDONE));
    }
    Ok((!is_whole(&fs::read(path)?)).then_some("its checksum is wrong"))
}

/// The lock that sled holds while it is open; `None` if it is held, or if there is no database.
fn lock(log: &Path) -> io::Result<Option<File>> {
    let file = match File::open(log) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(fs::TryLockError::WouldBlock) => Ok(None),
        Err(fs::TryLockError::Error(error)) => Err(error),
    }
}

/// Whether a snapshot's checksum is that of its contents (`write_snapshot` of sled 0.34.7: contents, length
/// as u64, CRC-32 as u32).
fn is_whole(bytes: &[u8]) -> bool {
    let Some(length) = bytes.len().checked_sub(TRAILER).filter(|length| *length > 0) else { return false };
    let mut crc = Crc::new();
    crc.update(&bytes[..length]);
    bytes[length + 8..] == crc.sum().to_le_bytes()
}
