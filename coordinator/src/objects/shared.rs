//! Blobs of a bucket that several coordinators have: the rows of a database say which there are.
//!
//! A blob is an object first, and then a row. Garbage collection announces a removal in the row, deletes the
//! object, and then the row. Meanwhile callers that ask for the blob wait, so that none relies on it or sends
//! it again before the deletion has ended. What a dead coordinator has left half done is found by the next
//! one that asks, or by the next garbage collection.

use std::collections::{BTreeMap, HashSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use fathom_core::scene::BlobRef;
use futures::{StreamExt, TryStreamExt};
use object_store::ObjectMeta;
use object_store::path::Path as ObjectPath;
use tokio::time::Instant;

use super::bucket::{Bucket, digest_of_segment};
use super::garbage::Removed;
use super::{ObjectError, check_digest, object_path};
use crate::schedule::Tenant;
use crate::store::ledger::{Known, Ledger, REMOVAL_WITHIN, Removal, Reserved, UsedBlob};

/// Rows that are read or asked for at a time.
const ROWS_AT_ONCE: usize = 1000;
/// Objects that are removed while others wait.
const REMOVED_AT_ONCE: usize = 100;
/// Pause between two looks at a blob that is being removed.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// An object without a row that is older was left by a coordinator that died: others are about to become
/// blobs.
const ORPHAN_AFTER: Duration = Duration::from_secs(3600);
/// Time before a listing in which uploads have not changed, if they are corrected by it.
const SETTLED_FOR: Duration = Duration::from_secs(60);

/// The rows of one tenant's blobs.
pub(super) struct SharedRows {
    ledger: Arc<dyn Ledger>,
    tenant: Tenant,
}

impl SharedRows {
    pub fn new(ledger: Arc<dyn Ledger>, tenant: Tenant) -> Self {
        Self { ledger, tenant }
    }

    /// Fills the rows of a new database from the bucket.
    pub async fn fill(&self, bucket: &Bucket) -> Result<(), ObjectError> {
        if self.ledger.is_filled(&self.tenant).await? {
            return Ok(());
        }
        self.add_found(bucket, None).await?;
        for (digest, segments) in bucket.uploads().await? {
            let bytes = segments.iter().map(|segment| segment.size).sum();
            if check_digest(&digest).is_ok() {
                self.ledger.add_upload(&self.tenant, &BlobRef { digest, bytes }).await?;
            }
        }
        Ok(self.ledger.set_filled(&self.tenant).await?)
    }

    /// The lengths of blobs, which are last used now; `None` for those that are missing.
    pub async fn ask(&self, bucket: &Bucket, digests: &[&str]) -> Result<Vec<Option<u64>>, ObjectError> {
        let mut lengths = Vec::with_capacity(digests.len());
        for some in digests.chunks(ROWS_AT_ONCE) {
            for digest in some {
                check_digest(digest)?;
            }
            let known = self.ledger.ask(&self.tenant, some).await?;
            for (digest, known) in some.iter().zip(known) {
                lengths.push(self.length(bucket, digest, known).await?);
            }
        }
        Ok(lengths)
    }

    /// Waits for the end of a removal, and ends a late one by what is in the bucket.
    async fn length(
        &self,
        bucket: &Bucket,
        digest: &str,
        mut known: Known,
    ) -> Result<Option<u64>, ObjectError> {
        loop {
            match known {
                Known::There { bytes } => return Ok(Some(bytes)),
                Known::Missing => return Ok(None),
                Known::Going { is_late: false } => tokio::time::sleep(LOOK_EVERY).await,
                Known::Going { is_late: true } => {
                    // Several callers may find it late; the one that announces it again ends it.
                    if let Some(removal) = self.announce(digest).await? {
                        match bucket.head(&object_path(digest)?).await? {
                            Some(_) => self.ledger.keep(&self.tenant, &removal).await?,
                            None => self.ledger.removed(&self.tenant, &[removal]).await?,
                        }
                    }
                }
            }
            let again = self.ledger.ask(&self.tenant, &[digest]).await?;
            known = again.first().copied().unwrap_or(Known::Missing);
        }
    }

    /// Begins an upload, unless it would exceed the limit. An upload that it replaces no longer counts.
    pub async fn reserve(
        &self,
        blob: &BlobRef,
        limit_bytes: Option<u64>,
        instead_of: Option<&str>,
    ) -> Result<(), ObjectError> {
        match self.ledger.reserve(&self.tenant, blob, limit_bytes, instead_of).await? {
            Reserved::Counts => Ok(()),
            Reserved::OverLimit { used_bytes } => {
                Err(ObjectError::OverLimit { used_bytes, limit_bytes: limit_bytes.unwrap_or(0) })
            }
        }
    }

    /// See [`Ledger::leave`].
    pub async fn leave(&self, digest: &str, bytes: u64) -> Result<(), ObjectError> {
        Ok(self.ledger.leave(&self.tenant, digest, bytes).await?)
    }

    /// Records a blob whose object is complete. False if the blob was being removed: the caller has to write
    /// the object again.
    pub async fn publish(&self, bucket: &Bucket, blob: &BlobRef) -> Result<bool, ObjectError> {
        if self.ledger.publish(&self.tenant, blob).await? {
            return Ok(true);
        }
        self.ask(bucket, &[&blob.digest]).await?;
        Ok(false)
    }

    /// Bytes of all blobs and uploads.
    pub async fn used_bytes(&self) -> Result<u64, ObjectError> {
        Ok(self.ledger.used_bytes(&self.tenant).await?)
    }

    /// Bytes that the uploads of some blobs count together.
    pub async fn declared_bytes(&self, digests: &[&str]) -> Result<u64, ObjectError> {
        Ok(self.ledger.declared_bytes(&self.tenant, digests).await?)
    }

    /// Removes a blob that is damaged or gone, unless another coordinator is about to. `remove` deletes the
    /// object; returns whether it did.
    pub async fn withdraw(
        &self,
        digest: &str,
        remove: impl Future<Output = Result<bool, ObjectError>>,
    ) -> Result<bool, ObjectError> {
        let deadline = Instant::now() + REMOVAL_WITHIN / 2;
        let Some(removal) = self.announce(digest).await? else { return Ok(false) };
        // On an error, the removal becomes late, and the next one that asks looks at the object.
        let is_removed = until(deadline, remove).await?;
        if is_removed {
            self.ledger.removed(&self.tenant, &[removal]).await?;
        } else {
            self.ledger.keep(&self.tenant, &removal).await?;
        }
        Ok(is_removed)
    }

    /// Announces the removal of one blob, unless somebody else removes it.
    async fn announce(&self, digest: &str) -> Result<Option<Removal>, ObjectError> {
        Ok(self.ledger.condemn(&self.tenant, &[digest.to_owned()], None).await?.pop())
    }

    /// Removes the row of a blob whose object does not exist.
    pub async fn withdraw_lost(&self, bucket: &Bucket, digest: &str) -> Result<(), ObjectError> {
        let path = object_path(digest)?;
        if bucket.head(&path).await?.is_none() {
            self.withdraw(digest, async { Ok(bucket.head(&path).await?.is_none()) }).await?;
        }
        Ok(())
    }

    /// Removes blobs and uploads that were last used or written before `before`, except the blobs `used`.
    /// Streams of this process write the blobs `written`.
    pub async fn remove_unused(
        &self,
        bucket: &Bucket,
        before: SystemTime,
        used: &HashSet<String>,
        written: &[String],
    ) -> Result<Removed, ObjectError> {
        let now = bucket.now();
        self.ledger.close_uploads(&self.tenant, written).await?;
        // A coordinator died between object and row.
        let young = now.checked_sub(ORPHAN_AFTER).unwrap_or(SystemTime::UNIX_EPOCH);
        self.add_found(bucket, Some(young)).await?;
        bucket.remove_unfinished().await?;
        let mut removed = self.remove_blobs(bucket, before, used).await?;
        removed = removed.and(self.remove_uploads(bucket, now, before).await?);
        Ok(removed.and(bucket.remove_damaged(before).await?))
    }

    async fn remove_blobs(
        &self,
        bucket: &Bucket,
        before: SystemTime,
        used: &HashSet<String>,
    ) -> Result<Removed, ObjectError> {
        let before_ms = unix_ms(before);
        let (mut after, mut removed) = (String::new(), Removed::default());
        loop {
            let page = self.ledger.unused(&self.tenant, before_ms, &after, ROWS_AT_ONCE).await?;
            let Some(last) = page.last() else { return Ok(removed) };
            after.clone_from(&last.digest);
            let unused: Vec<String> =
                page.into_iter().map(|blob| blob.digest).filter(|digest| !used.contains(digest)).collect();
            for some in unused.chunks(REMOVED_AT_ONCE) {
                let deadline = Instant::now() + REMOVAL_WITHIN / 2;
                let mut going = self.ledger.condemn(&self.tenant, some, Some(before_ms)).await?;
                let paths = going
                    .iter()
                    .map(|removal| object_path(&removal.blob.digest))
                    .collect::<Result<_, _>>()?;
                let gone = Mutex::new(HashSet::new());
                let note = |path: &ObjectPath| {
                    let digest = path.filename().unwrap_or_default().to_owned();
                    gone.lock().unwrap_or_else(PoisonError::into_inner).insert(digest);
                };
                let deleted = until(deadline, bucket.delete(paths, note)).await;
                let gone = gone.into_inner().unwrap_or_else(PoisonError::into_inner);
                going.retain(|removal| gone.contains(&removal.blob.digest));
                self.ledger.removed(&self.tenant, &going).await?;
                removed.blobs += going.len() as u64;
                removed.bytes += going.iter().map(|removal| removal.blob.bytes).sum::<u64>();
                deleted?;
            }
        }
    }

    /// Removes old uploads, and corrects what the others count that a dead coordinator has left.
    async fn remove_uploads(
        &self,
        bucket: &Bucket,
        now: SystemTime,
        before: SystemTime,
    ) -> Result<Removed, ObjectError> {
        let settled_ms = unix_ms(now.checked_sub(SETTLED_FOR).unwrap_or(SystemTime::UNIX_EPOCH));
        let left = self.ledger.left_uploads(&self.tenant, settled_ms).await?;
        let mut uploads = bucket.uploads().await?;
        let mut removed = Removed::default();
        let names: Vec<String> =
            uploads.keys().filter(|digest| check_digest(digest).is_ok()).cloned().collect();
        let mut written = HashSet::new();
        for some in names.chunks(ROWS_AT_ONCE) {
            written.extend(self.ledger.written(&self.tenant, some).await?);
        }
        // An upload is as young as its youngest segment.
        let is_old = |meta: &ObjectMeta| SystemTime::from(meta.last_modified) < before;
        let old: Vec<String> = uploads
            .iter()
            .filter(|(digest, segments)| segments.iter().all(is_old) && !written.contains(*digest))
            .map(|(digest, _)| digest.clone())
            .collect();
        for digest in old {
            let segments = uploads.remove(&digest).unwrap_or_default();
            removed.uploads += 1;
            removed.bytes += segments.iter().map(|segment| segment.size).sum::<u64>();
            bucket.delete(segments.into_iter().map(|segment| segment.location).collect(), |_| ()).await?;
        }
        for BlobRef { digest, bytes: counted } in left {
            let segments = uploads.get(&digest).into_iter().flatten();
            let bytes = segments.map(|segment| segment.size).sum();
            if bytes != counted {
                self.ledger.correct(&self.tenant, &digest, bytes, settled_ms).await?;
            }
        }
        Ok(removed)
    }

    /// Adds rows for objects without one: all, or those last written before `before`. Another coordinator may
    /// delete an object after it was listed here, so those of a database in use are looked at again.
    async fn add_found(&self, bucket: &Bucket, before: Option<SystemTime>) -> Result<(), ObjectError> {
        let listed = bucket.list("cas").try_filter_map(move |meta| {
            let used = SystemTime::from(meta.last_modified);
            let digest = meta.location.filename().unwrap_or_default().to_owned();
            let is_blob = before.is_none_or(|before| used < before) && check_digest(&digest).is_ok();
            let blob = BlobRef { digest, bytes: meta.size };
            std::future::ready(Ok(is_blob.then(|| UsedBlob { blob, used_ms: unix_ms(used) })))
        });
        let mut pages = listed.try_chunks(ROWS_AT_ONCE);
        while let Some(page) = pages.next().await {
            self.ledger.add(&self.tenant, &page.map_err(|failed| failed.1)?, before.is_none()).await?;
        }
        Ok(())
    }
}

/// Runs the deletions of a removal. Its deadline is counted from before the announcement, and leaves time in
/// which requests that are under way end.
async fn until<T>(
    deadline: Instant,
    work: impl Future<Output = Result<T, ObjectError>>,
) -> Result<T, ObjectError> {
    let late = || ObjectError::Late { seconds: (REMOVAL_WITHIN / 2).as_secs() };
    // This process may have been suspended since.
    if Instant::now() >= deadline {
        return Err(late());
    }
    tokio::time::timeout_at(deadline, work).await.map_err(|_| late())?
}

fn unix_ms(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

impl Bucket {
    /// The segments of all uploads, by digest; those of no upload under an empty name.
    pub(super) async fn uploads(&self) -> Result<BTreeMap<String, Vec<ObjectMeta>>, ObjectError> {
        let mut uploads = BTreeMap::<String, Vec<ObjectMeta>>::new();
        let mut segments = self.list("uploads");
        while let Some(segment) = segments.try_next().await? {
            let digest = digest_of_segment(&segment.location).unwrap_or_default();
            uploads.entry(digest).or_default().push(segment);
        }
        Ok(uploads)
    }

    /// Removes blobs that were set aside before `before`.
    async fn remove_damaged(&self, before: SystemTime) -> Result<Removed, ObjectError> {
        let listed = self.list("damaged");
        let old: Vec<ObjectMeta> = listed
            .try_filter(|meta| std::future::ready(SystemTime::from(meta.last_modified) < before))
            .try_collect()
            .await?;
        let removed = Removed {
            blobs: old.len() as u64,
            bytes: old.iter().map(|meta| meta.size).sum(),
            ..Removed::default()
        };
        self.delete(old.into_iter().map(|meta| meta.location).collect(), |_| ()).await?;
        Ok(removed)
    }
}
