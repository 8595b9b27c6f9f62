//! Where the merge reads results.

use std::fmt;
use std::io::{self, Read, Seek};
use std::path::Path;
use std::sync::Arc;

/// Bytes that can be read from any position.
pub trait ReadSeek: Read + Seek + Send {}

impl<T: Read + Seek + Send> ReadSeek for T {}

/// Files by path, on the local disk or in an object store. A merge opens each file several times.
pub trait Files: fmt::Debug + Send + Sync {
    /// Opens a file; returns its length, too.
    ///
    /// # Errors
    /// When it does not exist or cannot be read.
    fn open(&self, path: &Path) -> io::Result<(Box<dyn ReadSeek>, u64)>;
}

/// The files of the local disk.
#[derive(Clone, Copy, Debug)]
pub struct LocalFiles;

impl Files for LocalFiles {
    fn open(&self, path: &Path) -> io::Result<(Box<dyn ReadSeek>, u64)> {
        let file = std::fs::File::open(path)?;
        let bytes = file.metadata()?.len();
        Ok((Box::new(file), bytes))
    }
}

/// The files of the local disk, as the functions of this crate take them.
pub fn local_files() -> Arc<dyn Files> {
    Arc::new(LocalFiles)
}
