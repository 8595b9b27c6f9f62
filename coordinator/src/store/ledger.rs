//! The blobs of a bucket as rows, so that several coordinators agree on them.
//!
//! A bucket can neither append, nor count, nor remember when an object was last used. A coordinator that has
//! it alone keeps that in its memory. Several ones keep it in their database: which blobs there are, when
//! each was last used, what running uploads count, and which blobs garbage collection is deleting.

use std::collections::HashSet;
use std::time::Duration;

use fathom_core::scene::BlobRef;
use tonic::async_trait;

use super::StoreError;
use crate::schedule::Tenant;

/// Time in which a removal that was announced by [`Ledger::condemn`] ends, or its coordinator is dead.
pub const REMOVAL_WITHIN: Duration = Duration::from_secs(60);

/// A blob that a caller asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// It is there, and last used now.
    There {
        /// Its length.
        bytes: u64,
    },
    /// There is none.
    Missing,
    /// It is being removed.
    Going {
        /// Whether the removal is late: its coordinator is dead, and the object may exist or not.
        is_late: bool,
    },
}

/// A removal that was announced. Only the latest one of a blob can be ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Removal {
    /// The blob.
    pub blob: BlobRef,
    /// When it becomes late, by the database's clock, Unix milliseconds.
    pub until_ms: u64,
}

/// A blob with the time of its last use, Unix milliseconds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UsedBlob {
    /// The blob.
    pub blob: BlobRef,
    /// Its last use.
    pub used_ms: u64,
}

/// Whether an upload may begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reserved {
    /// It may, and counts.
    Counts,
    /// It would exceed the limit.
    OverLimit {
        /// Bytes of all blobs and of the other uploads.
        used_bytes: u64,
    },
}

/// Blobs of all tenants, in a database. Digests are 64 lower-case hex digits.
#[async_trait]
pub trait Ledger: Send + Sync {
    /// Whether the rows of a tenant were filled from its bucket once. A new or imported database has none.
    async fn is_filled(&self, tenant: &Tenant) -> Result<bool, StoreError>;
    /// Records that they were.
    async fn set_filled(&self, tenant: &Tenant) -> Result<(), StoreError>;
    /// Adds blobs that were found in the bucket; those that are known stay as they are. Unless `is_sure`,
    /// another coordinator may have removed them since, so they begin as late removals.
    async fn add(&self, tenant: &Tenant, found: &[UsedBlob], is_sure: bool) -> Result<(), StoreError>;
    /// Adds an upload that was found in the bucket; one that is known stays as it is.
    async fn add_upload(&self, tenant: &Tenant, found: &BlobRef) -> Result<(), StoreError>;
    /// What is known of blobs, in their order. Those that are there are last used now.
    async fn ask(&self, tenant: &Tenant, digests: &[&str]) -> Result<Vec<Known>, StoreError>;
    /// Begins or continues an upload, which counts `bytes` from now on. An upload that it replaces no longer
    /// counts.
    async fn reserve(
        &self,
        tenant: &Tenant,
        blob: &BlobRef,
        limit_bytes: Option<u64>,
        instead_of: Option<&str>,
    ) -> Result<Reserved, StoreError>;
    /// Ends a stream of this process that leaves `bytes` of an upload in the bucket; 0 ends the upload. What
    /// another coordinator has taken over stays as it is.
    async fn leave(&self, tenant: &Tenant, digest: &str, bytes: u64) -> Result<(), StoreError>;
    /// Records a complete blob; its upload, if there is one, ends. False if the blob is being removed: its
    /// object may be gone, and nothing was recorded.
    async fn publish(&self, tenant: &Tenant, blob: &BlobRef) -> Result<bool, StoreError>;
    /// Bytes of all blobs and uploads of a tenant.
    async fn used_bytes(&self, tenant: &Tenant) -> Result<u64, StoreError>;
    /// Bytes that the uploads of some blobs count together.
    async fn declared_bytes(&self, tenant: &Tenant, digests: &[&str]) -> Result<u64, StoreError>;
    /// Those uploads that a stream of a living coordinator writes.
    async fn written(&self, tenant: &Tenant, digests: &[String]) -> Result<HashSet<String>, StoreError>;
    /// Blobs last used before `before_ms`, by digest, after the given one; at most `limit`.
    async fn unused(
        &self,
        tenant: &Tenant,
        before_ms: u64,
        after: &str,
        limit: usize,
    ) -> Result<Vec<BlobRef>, StoreError>;
    /// Announces the removal of blobs that nobody else is removing, and returns those that the caller has to
    /// remove within [`REMOVAL_WITHIN`]. With `before_ms`, only those that were not used since, and that no
    /// stream writes.
    async fn condemn(
        &self,
        tenant: &Tenant,
        digests: &[String],
        before_ms: Option<u64>,
    ) -> Result<Vec<Removal>, StoreError>;
    /// Ends removals: the objects are gone.
    async fn removed(&self, tenant: &Tenant, removals: &[Removal]) -> Result<(), StoreError>;
    /// Ends a removal: the object is there, and stays.
    async fn keep(&self, tenant: &Tenant, removal: &Removal) -> Result<(), StoreError>;
    /// Ends the uploads of this process that none of its streams writes, after a failure of the database.
    async fn close_uploads(&self, tenant: &Tenant, written: &[String]) -> Result<(), StoreError>;
    /// Uploads that no stream of a living coordinator writes, unchanged since `before_ms`.
    async fn left_uploads(&self, tenant: &Tenant, before_ms: u64) -> Result<Vec<BlobRef>, StoreError>;
    /// Corrects what such an upload counts; 0 ends it.
    async fn correct(
        &self,
        tenant: &Tenant,
        digest: &str,
        bytes: u64,
        before_ms: u64,
    ) -> Result<(), StoreError>;
}
