//! Datasets: files that are uploaded once, under a name, and never change from then on.
//!
//! ```text
//!            BeginUpload             CommitDataset, when every blob is there
//!  (nothing) ───────────► UPLOADING ───────────────────────────────────────► COMMITTED
//!                             │ keep_uploads_hours without a call                │ DeleteDataset, unless a job holds it
//!                             ▼                                                  ▼
//!                           (gone)                                             (gone)
//! ```
//!
//! Its list of files is a blob ([`FileList`]), whose digest is the root digest; the row in the store stays
//! small. Both states protect their blobs from garbage collection. Invariants: the files of a row never
//! change, and a job references only a committed dataset.

mod list;

use std::fmt;
use std::str::FromStr;

use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

pub use list::{FileFault, FileList, ListedFile};

use crate::schedule::{ParseIdError, Tenant};

/// Maximum datasets of a tenant; one more is refused.
pub const MAX_DATASETS: usize = 10_000;
/// The default manifest of a job in its dataset, unless the user names another.
pub const MANIFEST_PATH: &str = "manifest.json";

/// Name of a dataset among those of its tenant: 1 to 64 lower-case letters, digits, `-`, `_` and `.`, a
/// letter or a digit first.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct DatasetId(String);

impl DatasetId {
    /// Longest name, bytes.
    pub const MAX_BYTES: usize = 64;

    /// The generated name of a dataset: the same for a repeated request.
    pub fn of_request(tenant: &Tenant, request_id: &str) -> Self {
        let digest = blake3::hash(format!("{tenant}\0{request_id}").as_bytes()).to_hex();
        Self(format!("dataset-{}", &digest[..16]))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for DatasetId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for DatasetId {
    type Err = ParseIdError;

    fn from_str(text: &str) -> Result<Self, ParseIdError> {
        let is_plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        let begins_well = text.bytes().next().is_some_and(is_plain);
        let may_stand = |b: u8| is_plain(b) || matches!(b, b'-' | b'_' | b'.');
        if begins_well && text.len() <= Self::MAX_BYTES && text.bytes().all(may_stand) {
            Ok(Self(text.to_owned()))
        } else {
            Err(ParseIdError { what: "dataset", text: text.chars().take(80).collect() })
        }
    }
}

impl TryFrom<String> for DatasetId {
    type Error = ParseIdError;

    fn try_from(text: String) -> Result<Self, ParseIdError> {
        text.parse()
    }
}

impl From<DatasetId> for String {
    fn from(id: DatasetId) -> Self {
        id.0
    }
}

/// A new dataset.
#[derive(Clone, Debug)]
pub struct NewDataset {
    /// Its name.
    pub id: DatasetId,
    /// Its tenant.
    pub tenant: Tenant,
    /// Chosen by the client; one id of a tenant begins one dataset.
    pub request_id: String,
    /// Its [`FileList`].
    pub root: BlobRef,
    /// Number of its files.
    pub files: u64,
    /// Sum of their lengths; equal files count each.
    pub bytes: u64,
}

impl NewDataset {
    /// The row of the new dataset.
    pub(crate) fn into_row(self, now_ms: u64) -> DatasetRecord {
        let Self { id, tenant, request_id, root, files, bytes } = self;
        DatasetRecord {
            id,
            tenant,
            request_id,
            root,
            files,
            bytes,
            created_ms: now_ms,
            asked_ms: now_ms,
            committed_ms: None,
        }
    }
}

/// A dataset as it is stored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DatasetRecord {
    /// Its name.
    pub id: DatasetId,
    /// Its tenant.
    pub tenant: Tenant,
    /// The id of the call that began it.
    pub request_id: String,
    /// Its [`FileList`]; the digest of this blob is its root digest.
    pub root: BlobRef,
    /// Number of its files.
    pub files: u64,
    /// Sum of their lengths; equal files count each.
    pub bytes: u64,
    /// Beginning, Unix milliseconds.
    pub created_ms: u64,
    /// Latest call of BeginUpload, Unix milliseconds; an abandoned upload expires some time after it.
    pub asked_ms: u64,
    /// Since when it is frozen, Unix milliseconds; `None` during the upload.
    pub committed_ms: Option<u64>,
}

impl DatasetRecord {
    /// Whether it is frozen.
    pub fn is_committed(&self) -> bool {
        self.committed_ms.is_some()
    }

    /// Whether it is an upload without activity since `before_ms`.
    pub fn is_given_up(&self, before_ms: u64) -> bool {
        !self.is_committed() && self.asked_ms < before_ms
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_short_plain_and_the_same_for_a_repeated_request() {
        for good in ["reef", "2026-09_reef.v2", "a", &"a".repeat(64)] {
            assert_eq!(good.parse::<DatasetId>().map(|id| id.to_string()).as_deref(), Ok(good));
        }
        for wrong in ["", "-a", ".a", "Reef", "a b", "a/b", "a\0b", "ä", &"a".repeat(65)] {
            assert!(wrong.parse::<DatasetId>().is_err(), "{wrong:?}");
        }
        let made = DatasetId::of_request(&Tenant::default(), "one");
        assert_eq!(made.as_str().parse(), Ok(made.clone()));
        assert_eq!(DatasetId::of_request(&Tenant::default(), "one"), made);
        assert_ne!(DatasetId::of_request(&Tenant::default(), "other"), made);
    }
}
