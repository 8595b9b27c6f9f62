//! What uploads take before they are whole.
//!
//! A tenant may have so many bytes, and uploads count from their first message on: with all the bytes that were declared while a
//! stream writes, and with those that have come when none does. Else any number of uploads that are never finished would fill the
//! disk.

use std::collections::HashMap;
use std::io;
use std::sync::PoisonError;

use super::{BlobStore, ObjectError, garbage};

/// Bytes by digest of uploads that are not whole.
#[derive(Debug, Default)]
pub(super) struct Declared {
    by_digest: HashMap<String, u64>,
    total: u64,
}

impl Declared {
    fn set(&mut self, digest: &str, bytes: u64) {
        let before = match bytes {
            0 => self.by_digest.remove(digest),
            bytes => self.by_digest.insert(digest.to_owned(), bytes),
        };
        self.total = self.total.saturating_sub(before.unwrap_or(0)).saturating_add(bytes);
    }
}

impl BlobStore {
    /// Bytes of all blobs, and of what is being uploaded.
    pub fn used_bytes(&self) -> u64 {
        let declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner).total;
        self.whole_bytes().saturating_add(declared)
    }

    /// Bytes that an upload of a blob has been counted with.
    pub fn declared_bytes(&self, digest: &str) -> u64 {
        let declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner);
        declared.by_digest.get(digest).copied().unwrap_or(0)
    }

    /// Counts an upload with `bytes`; 0 ends it.
    pub(super) fn declare(&self, digest: &str, bytes: u64) {
        self.declared.lock().unwrap_or_else(PoisonError::into_inner).set(digest, bytes);
    }

    /// The same for one that begins, unless there would be more than `limit_bytes`.
    pub(super) fn declare_within(
        &self,
        digest: &str,
        bytes: u64,
        limit_bytes: Option<u64>,
    ) -> Result<(), ObjectError> {
        // One after the other: many that begin at once may together have too much.
        let mut declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner);
        let before = declared.by_digest.get(digest).copied().unwrap_or(0);
        let used_bytes = self.whole_bytes().saturating_add(declared.total - before);
        if let Some(limit_bytes) = limit_bytes
            && used_bytes.saturating_add(bytes) > limit_bytes
        {
            return Err(ObjectError::OverLimit { used_bytes, limit_bytes });
        }
        declared.set(digest, bytes);
        Ok(())
    }

    /// Counts what uploads of an earlier process have left.
    pub(super) fn find_declared(&self) -> io::Result<()> {
        for (path, name) in garbage::files(&self.root.join("uploads"))? {
            self.declare(name.trim_end_matches(".part"), std::fs::metadata(path)?.len());
        }
        Ok(())
    }
}
