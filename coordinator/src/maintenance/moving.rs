//! Moves a service: its rows, files and logs from one place to another, for example from a single machine to
//! a database and a bucket, and back.
//!
//! Everything is copied, and the source stays as it is. Files come first, then logs, then rows: a coordinator
//! on the new place never sees a job without its files. A move that was interrupted goes on where it stopped.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use fathom_core::scene::BlobRef;
use futures::TryStreamExt;

use super::{Counts, Place, Verified, open_copy, open_database, store_of, verify};
use crate::clock::Clock;
use crate::data_dir;
use crate::error::CoordinatorError;
use crate::logs::{self, JobLogs, Logs};
use crate::objects::{BlobStore, ObjectError, ObjectsAt, TenantBlobs};
use crate::store::export::Export;
use crate::store::{Hold, SledStore, Store};

/// Blobs that are copied at a time.
const BLOBS_AT_ONCE: usize = 8;
/// Bytes of a piece of a blob on its way.
const PIECE_BYTES: u64 = 4 << 20;

/// The result of a move.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Moved {
    /// Rows at the new place.
    pub counts: Counts,
    /// Blobs that were copied; others were there.
    pub blobs: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Log lines of jobs that were copied; others were there.
    pub logs: u64,
    /// Digests of blobs that are damaged at the source, and were left out.
    pub damaged: Vec<String>,
    /// A sentence for each fault at the new place.
    pub faults: Vec<String>,
}

/// Copies everything of the service at `from` to `to`, and verifies that every file that a job references is
/// there. What both places share stays where it is.
///
/// # Errors
/// When a coordinator uses one of the places, the new one has other jobs, or something cannot be read or
/// written. What was copied before stays, and the next move goes on from there.
pub async fn move_service(
    from: &Place,
    scratch: Option<&Path>,
    to: &Place,
) -> Result<Moved, CoordinatorError> {
    let (from_objects, to_objects) = (objects_of(from)?, objects_of(to)?);
    let source = read_source(from, scratch).await?;
    data_dir::make(&to.data_dir)?;
    let mut moved = Moved::default();
    if !is_same(&from_objects, &to_objects) {
        let Some(name) = &source.export.deployment else {
            return Err(CoordinatorError::Maintenance(format!(
                "the jobs in {from} are of a coordinator of an earlier version; start it once with this version, and stop it again"
            )));
        };
        to_objects.hold_for(name, &to.data_dir).await?;
        // Blobs that are copied into a bucket count in the rows of the database that will have the jobs.
        let rows = match &to.store {
            Some(url) => Some(open_database(url).await?),
            None => None,
        };
        let ledger = rows.as_ref().and_then(Store::ledger);
        let to_blobs = TenantBlobs::open(to_objects, &to.data_dir, 0, Clock::start(), ledger).await?;
        copy_objects(&source.export, &from_objects, &to_blobs, &mut moved).await?;
    }
    // Log lines are where the rows are.
    let shares_rows = match (&from.store, &to.store) {
        (None, None) => from.data_dir == to.data_dir,
        (one, other) => one == other,
    };
    if !shares_rows {
        moved.logs = import(&source, to).await?;
    }
    drop(source);
    let Verified { counts, faults, .. } = verify(to, scratch, false).await?;
    (moved.counts, moved.faults) = (counts, faults);
    Ok(moved)
}

fn objects_of(place: &Place) -> Result<ObjectsAt, CoordinatorError> {
    Ok(ObjectsAt::parse(place.objects.as_deref(), &place.data_dir)?)
}

fn is_same(one: &ObjectsAt, other: &ObjectsAt) -> bool {
    match (one, other) {
        (ObjectsAt::Folder(one), ObjectsAt::Folder(other)) => one == other,
        (ObjectsAt::Bucket { url: one, .. }, ObjectsAt::Bucket { url: other, .. }) => one == other,
        _ => false,
    }
}

/// All rows of a place, its logs, and what keeps coordinators away from it meanwhile.
struct Source {
    export: Export,
    logs: Arc<dyn Logs>,
    _held: Box<dyn Store>,
}

async fn read_source(from: &Place, scratch: Option<&Path>) -> Result<Source, CoordinatorError> {
    let held: Box<dyn Store> = match &from.store {
        Some(url) => {
            let store = open_database(url).await?;
            store.hold(Hold::Alone, None).await?;
            Box::new(store)
        }
        None => Box::new(open_copy(&from.data_dir, scratch)?),
    };
    let logs = logs::of(held.as_ref(), &from.data_dir, logs::ATTEMPT_BYTES);
    Ok(Source { export: held.export().await?, logs, _held: held })
}

/// Writes logs and rows; returns the number of new log lines. Those of this export may be there already, from
/// an interrupted move.
async fn import(Source { export, logs, .. }: &Source, to: &Place) -> Result<u64, CoordinatorError> {
    if let Some(url) = &to.store {
        let store = open_database(url).await?;
        // Before the logs: a coordinator would remove those of jobs that it does not know.
        store.hold(Hold::Alone, None).await?;
        let to_logs = logs::of(&store, &to.data_dir, logs::ATTEMPT_BYTES);
        let copied = logs::copy(logs.as_ref(), to_logs.as_ref()).await?;
        if store.export().await? != *export {
            store.import(export).await?;
        }
        store.close().await;
        return Ok(copied);
    }
    let to_logs = JobLogs::new(&to.data_dir.join("logs"), logs::ATTEMPT_BYTES);
    let copied = logs::copy(logs.as_ref(), &to_logs).await?;
    if store_of(&to.data_dir).is_ok() {
        let known = SledStore::open_copy(&super::options(&to.data_dir.join("store")), None)?;
        if known.export().await? == *export {
            return Ok(copied);
        }
    }
    super::import_into_folder(export, &to.data_dir).await?;
    Ok(copied)
}

/// Copies the blobs of all tenants.
async fn copy_objects(
    export: &Export,
    from: &ObjectsAt,
    to: &TenantBlobs,
    moved: &mut Moved,
) -> Result<(), CoordinatorError> {
    let of_jobs = export.jobs.iter().map(|job| &job.job.tenant);
    let tenants: std::collections::BTreeSet<_> =
        of_jobs.chain(export.datasets.iter().map(|dataset| &dataset.tenant)).collect();
    for tenant in tenants {
        let Some(from) = TenantBlobs::existing(from, tenant)? else { continue };
        let to = to.of(tenant).await?;
        let (blobs, bytes) = (AtomicU64::new(0), AtomicU64::new(0));
        let damaged = std::sync::Mutex::new(Vec::new());
        let listed = from.list().await?;
        futures::stream::iter(listed.iter().map(Ok::<_, CoordinatorError>))
            .try_for_each_concurrent(BLOBS_AT_ONCE, |blob| {
                let (from, to, blobs, bytes, damaged) = (&from, &to, &blobs, &bytes, &damaged);
                async move {
                    match copy_blob(from, to, blob).await {
                        Ok(true) => {
                            blobs.fetch_add(1, Ordering::Relaxed);
                            bytes.fetch_add(blob.bytes, Ordering::Relaxed);
                        }
                        Ok(false) => {}
                        Err(ObjectError::DigestMismatch { digest, .. } | ObjectError::Damaged(digest)) => {
                            damaged.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(digest);
                        }
                        Err(error) => return Err(error.into()),
                    }
                    Ok(())
                }
            })
            .await?;
        moved.blobs += blobs.into_inner();
        moved.bytes += bytes.into_inner();
        moved.damaged.extend(damaged.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner));
    }
    moved.damaged.sort();
    Ok(())
}

/// Copies a blob, whose bytes are hashed on the way; returns whether it was missing.
async fn copy_blob(from: &BlobStore, to: &Arc<BlobStore>, blob: &BlobRef) -> Result<bool, ObjectError> {
    let (mut at, is_complete) = to.committed(blob).await?;
    if is_complete {
        return Ok(false);
    }
    let Some(mut writer) = to.begin_write(blob, at, None).await? else { return Ok(false) };
    while at < blob.bytes {
        let piece = from.range(&blob.digest, at..blob.bytes.min(at + PIECE_BYTES)).await?;
        let next = at + piece.len() as u64;
        writer.append(at, piece).await?;
        at = next;
    }
    writer.finish().await?;
    Ok(true)
}
