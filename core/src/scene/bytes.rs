//! Little-endian reading of untrusted files.
//!
//! Every read has its offset and a description, so that errors name the place in the file. A count is
//! accepted only if the rest of the file can hold that many entries, so nothing absurd is allocated.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use crate::{CoreError, Result};

/// A file that is read from front to back.
pub(super) struct ByteReader {
    file: BufReader<File>,
    path: PathBuf,
    offset: u64,
    len: u64,
}

impl ByteReader {
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(CoreError::io("read", path))?;
        let len = file.metadata().map_err(CoreError::io("read", path))?.len();
        Ok(Self { file: BufReader::with_capacity(1 << 18, file), path: path.to_owned(), offset: 0, len })
    }

    pub fn offset(&self) -> u64 {
        self.offset
    }

    pub fn left(&self) -> u64 {
        self.len.saturating_sub(self.offset)
    }

    pub fn bytes<const N: usize>(&mut self, what: &dyn Fn() -> String) -> Result<[u8; N]> {
        self.require(N as u64, what)?;
        let mut buffer = [0; N];
        self.file.read_exact(&mut buffer).map_err(CoreError::io("read", &self.path))?;
        self.offset += N as u64;
        Ok(buffer)
    }

    pub fn u32(&mut self, what: &dyn Fn() -> String) -> Result<u32> {
        self.bytes(what).map(u32::from_le_bytes)
    }

    pub fn u64(&mut self, what: &dyn Fn() -> String) -> Result<u64> {
        self.bytes(what).map(u64::from_le_bytes)
    }

    pub fn f64s<const N: usize>(&mut self, what: &dyn Fn() -> String) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.bytes(what)?);
        }
        Ok(values)
    }

    /// A string that ends with a zero byte.
    pub fn c_string(&mut self, what: &dyn Fn() -> String) -> Result<String> {
        // No file system has longer paths. Without a limit, a damaged file would be read to its end.
        const LIMIT: u64 = 4096;
        let start = self.offset;
        let mut name = Vec::new();
        (&mut self.file).take(LIMIT).read_until(0, &mut name).map_err(CoreError::io("read", &self.path))?;
        self.offset += name.len() as u64;
        if name.pop() != Some(0) {
            return Err(if self.left() == 0 {
                self.torn(start, what)
            } else {
                self.fault(
                    start,
                    &format!(
                        "{} is longer than {LIMIT} bytes: this is not such a file, or it is damaged",
                        what()
                    ),
                )
            });
        }
        String::from_utf8(name).map_err(|_| self.fault(start, &format!("{} is not valid UTF-8", what())))
    }

    /// A count of entries of at least `entry_bytes` each, checked against the size of the rest of the file.
    pub fn count(&mut self, entry_bytes: u64, entries: &str, what: &dyn Fn() -> String) -> Result<usize> {
        let start = self.offset;
        let count = self.u64(what)?;
        let fits = count.checked_mul(entry_bytes).is_some_and(|bytes| bytes <= self.left());
        if !fits {
            return Err(self.fault(
                start,
                &format!(
                    "{}: {count} {entries} of at least {entry_bytes} bytes each are declared, but only {} bytes follow; \
                     the file is truncated or damaged: copy it again or export the model anew",
                    what(),
                    self.left()
                ),
            ));
        }
        Ok(count as usize)
    }

    /// Refuses bytes after the last entry: they show that the count at the start of the file is wrong.
    pub fn finish(&self, count: usize, entries: &str) -> Result<()> {
        if self.left() == 0 {
            return Ok(());
        }
        Err(self.fault(
            self.offset,
            &format!(
                "{} bytes follow after the {count} {entries} that the file declares; \
                 its count is wrong: export the model anew",
                self.left()
            ),
        ))
    }

    /// An error at `offset` of this file.
    pub fn fault(&self, offset: u64, message: &str) -> CoreError {
        CoreError::input(&self.path, format!("byte {offset}: {message}"))
    }

    fn require(&self, bytes: u64, what: &dyn Fn() -> String) -> Result<()> {
        if bytes <= self.left() { Ok(()) } else { Err(self.torn(self.offset, what)) }
    }

    fn torn(&self, offset: u64, what: &dyn Fn() -> String) -> CoreError {
        self.fault(
            offset,
            &format!(
                "the file is truncated: it ends at byte {} inside {}; copy it again or export the model anew",
                self.len,
                what()
            ),
        )
    }
}
