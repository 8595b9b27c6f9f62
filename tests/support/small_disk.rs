//! A disk that a test can fill, and waiting for what processes do.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Much longer than any step of a scenario takes on two busy cores.
const PATIENCE: Duration = Duration::from_secs(150);

/// Polls `look` until it returns a value.
pub fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let begin = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begin.elapsed() < PATIENCE, "waited {PATIENCE:?} in vain for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A small file system in memory, mounted at this path; gone when this is dropped.
pub struct SmallDisk(pub PathBuf);

impl SmallDisk {
    /// `None` if this user may not mount one.
    pub fn mounted(at: &Path, bytes: u64) -> Option<Self> {
        std::fs::create_dir_all(at).expect("a folder");
        mount(&["-t", "tmpfs", "-o", &format!("size={bytes}"), "none"], at).then(|| Self(at.to_owned()))
    }

    /// Writes until the disk is full; returns the file that fills it.
    pub fn fill(&self) -> PathBuf {
        let ballast = self.0.join("ballast");
        let mut file = File::create(&ballast).expect("a file");
        let written = io::copy(&mut io::repeat(1), &mut file);
        assert!(written.is_err_and(|error| error.kind() == io::ErrorKind::StorageFull));
        ballast
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Lazily, since processes that are about to be killed may still have files open there.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

/// Runs `mount` with these words; whether it succeeded.
pub fn mount(words: &[&str], at: &Path) -> bool {
    let status = Command::new("mount").args(words).arg(at).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}
