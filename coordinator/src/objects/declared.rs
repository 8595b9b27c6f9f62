//! Bytes of incomplete uploads.
//!
//! Uploads count towards a tenant's quota from their first message on: with all declared bytes while a stream
//! writes, otherwise with the bytes received. Otherwise unfinished uploads could fill the disk.

use std::collections::HashMap;
use std::sync::PoisonError;

use super::claim::Replaced;
use super::{BlobStore, ObjectError};

/// Bytes of incomplete uploads, by digest.
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
    /// Bytes of all blobs and uploads.
    ///
    /// # Errors
    /// When the database that counts them is not available.
    pub async fn used_bytes(&self) -> Result<u64, ObjectError> {
        if let Some(shared) = &self.shared {
            return shared.used_bytes().await;
        }
        let declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner).total;
        Ok(self.whole_bytes().saturating_add(declared))
    }

    /// Bytes counted for the uploads of some blobs together.
    ///
    /// # Errors
    /// As [`BlobStore::used_bytes`].
    pub async fn declared_bytes(&self, digests: &[&str]) -> Result<u64, ObjectError> {
        if let Some(shared) = &self.shared {
            return shared.declared_bytes(digests).await;
        }
        let declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner);
        let counted = digests.iter().filter_map(|digest| declared.by_digest.get(*digest));
        Ok(counted.fold(0, |sum, bytes| sum.saturating_add(*bytes)))
    }

    /// Counts an upload with `bytes`; 0 ends it.
    pub(super) fn declare(&self, digest: &str, bytes: u64) {
        self.declared.lock().unwrap_or_else(PoisonError::into_inner).set(digest, bytes);
    }

    /// The same for a new upload, unless the total would exceed `limit_bytes`. An upload that it replaces no
    /// longer counts.
    pub(super) fn declare_within(
        &self,
        digest: &str,
        bytes: u64,
        limit_bytes: Option<u64>,
        instead_of: Option<&str>,
    ) -> Result<(), ObjectError> {
        // One after the other: many that begin at once could exceed the limit together.
        let mut declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner);
        let replaced = [Some(digest), instead_of].into_iter().flatten();
        let before: u64 = replaced.filter_map(|digest| declared.by_digest.get(digest)).sum();
        let used_bytes = self.whole_bytes().saturating_add(declared.total - before);
        if let Some(limit_bytes) = limit_bytes
            && used_bytes.saturating_add(bytes) > limit_bytes
        {
            return Err(ObjectError::OverLimit { used_bytes, limit_bytes });
        }
        declared.set(digest, bytes);
        if let Some(replaced) = instead_of {
            declared.set(replaced, 0);
        }
        Ok(())
    }

    /// Counts a direct upload again that another one replaced, if it is still signed.
    pub(super) fn declare_again(&self, replaced: &Replaced) {
        let signed = self.signed.lock().unwrap_or_else(PoisonError::into_inner);
        if signed.contains_key(&replaced.upload) {
            self.declare(&replaced.upload, replaced.bytes);
        }
    }
}
