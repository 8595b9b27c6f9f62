//! Retention of ended jobs, uploads of datasets, and bytes that neither a job nor a dataset references.
//!
//! A blob is kept when a row of the store names it, or when a named blob contains its digest as text.
//! Manifests, plans, indexes and evaluations contain digests. This may keep too much, never too little. When
//! one of these cannot be read, nothing is removed at all. Pictures of previews are kept as long as the
//! history of their job names them.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tracing::Instrument;

use crate::datasets::DatasetId;
use crate::history;
use crate::logs::LogError;
use crate::objects::{ObjectError, Removed};
use crate::references::{Reference, reference_of, references};
use crate::schedule::{JobId, Tenant};
use crate::services::logs;
use crate::state::{State, stopped};
use crate::store::{JobFilter, StoreError};

/// Time to keep the mark of a silent worker: it may only be disconnected.
const MARKS_FOR: Duration = Duration::from_secs(30 * 24 * 60 * 60);
/// Jobs per page.
const PAGE: usize = 256;

/// Retention times.
#[derive(Clone, Copy, Debug)]
pub struct Policy {
    /// Time after its end after which a job is deleted; `None` keeps all.
    pub jobs: Option<Duration>,
    /// Time since its last use after which an unreferenced blob is removed.
    pub unused: Duration,
    /// Time since its latest BeginUpload after which an upload of a dataset expires.
    pub uploads: Duration,
}

/// Settings of the garbage collection.
#[derive(Clone, Copy, Debug)]
pub struct Housekeeping {
    /// The retention times.
    pub policy: Policy,
    /// Time between two rounds.
    pub every: Duration,
}

/// Why garbage was not, or not completely, removed.
#[derive(Debug, thiserror::Error)]
pub enum RetentionError {
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A referenced blob cannot be read, so its own references are unknown.
    #[error("{what}: {source}; nothing was removed")]
    Unreadable {
        /// Its role.
        what: String,
        /// The reason.
        source: ObjectError,
    },
    /// The blobs of a tenant cannot be listed.
    #[error(transparent)]
    Object(#[from] ObjectError),
    /// Logs cannot be listed.
    #[error(transparent)]
    Logs(#[from] LogError),
    /// A file cannot be removed.
    #[error("blobs cannot be removed: {0}")]
    Io(#[from] std::io::Error),
}

/// Collects garbage at intervals, until the coordinator stops.
pub async fn collect_garbage(shared: Arc<State>, every: Duration) {
    let mut stopping = shared.stopping.clone();
    loop {
        tokio::select! {
            () = tokio::time::sleep(every) => {}
            () = stopped(&mut stopping) => return,
        }
        let round = collect(&shared, shared.policy).instrument(tracing::info_span!("retention"));
        if let Err(error) = round.await {
            tracing::warn!(%error, "garbage collection is incomplete");
        }
    }
}

/// Deletes expired jobs, and removes expired blobs.
///
/// # Errors
/// [`RetentionError`].
pub async fn collect(shared: &State, policy: Policy) -> Result<Removed, RetentionError> {
    let forgotten = forget_jobs(shared, policy.jobs).await?;
    forget_logs(shared).await?;
    forget_marks(shared).await?;
    forget_links(shared).await?;
    forget_uploads(shared, policy.uploads).await?;
    // Blobs that are used from now on are young, so no new reference can name a blob that this round removes.
    let before = shared.clock.system_time().checked_sub(policy.unused).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut used = used(shared).await?;
    let mut removed = Removed::default();
    for (tenant, objects) in shared.objects.all().await? {
        let used = used.remove(&tenant).unwrap_or_default();
        removed = removed.and(objects.remove_unused(before, used).await?);
    }
    shared.metrics.removed(&removed);
    if removed != Removed::default() || forgotten > 0 {
        let Removed { blobs, uploads, bytes } = removed;
        tracing::info!(jobs = forgotten, blobs, uploads, bytes, "removed garbage");
    }
    Ok(removed)
}

/// Deletes expired jobs; returns their number.
async fn forget_jobs(shared: &State, keep: Option<Duration>) -> Result<u64, StoreError> {
    let Some(keep) = keep else { return Ok(0) };
    let keep_ms = u64::try_from(keep.as_millis()).unwrap_or(u64::MAX);
    let oldest_ms = shared.clock.now_ms().saturating_sub(keep_ms);
    let (mut before, mut forgotten) = (None::<JobId>, 0);
    loop {
        let page = shared.jobs.list(&JobFilter::default(), before.as_ref(), PAGE).await?;
        let Some(last) = page.last() else { return Ok(forgotten) };
        before = Some(last.job_id.clone());
        for job in page.iter().filter(|job| job.ended_ms.is_some_and(|ended_ms| ended_ms < oldest_ms)) {
            match shared.jobs.delete(&job.job_id).await {
                Ok(()) => {
                    logs::forget(shared, &job.job_id).await;
                    tracing::info!(job = %job.job_id, name = %job.name, "deleted a job whose retention time is over");
                    forgotten += 1;
                }
                // Its user has deleted or retried it meanwhile.
                Err(StoreError::JobNotFound(_) | StoreError::Refused(_)) => {}
                Err(error) => return Err(error),
            }
        }
    }
}

/// Deletes the logs of deleted jobs: a coordinator may have crashed between the two deletions.
async fn forget_logs(shared: &State) -> Result<(), RetentionError> {
    for job in shared.logs.jobs().await? {
        match shared.jobs.job_row(&job).await {
            Ok(_) => {}
            Err(StoreError::JobNotFound(_)) => logs::forget(shared, &job).await,
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}

/// Deletes the tokens of links that ended a week ago. Until then they are listed as others are.
async fn forget_links(shared: &State) -> Result<(), StoreError> {
    const LISTED: Duration = Duration::from_secs(7 * 24 * 3600);
    let listed_ms = u64::try_from(LISTED.as_millis()).unwrap_or(u64::MAX);
    let before_ms = shared.clock.now_ms().saturating_sub(listed_ms);
    for token in shared.store.tokens().await? {
        if token.is_link_ended_before(before_ms) {
            shared.store.forget_token(&token.id).await?;
            shared.access.forget(&token.id);
        }
    }
    Ok(())
}

/// Deletes the marks of workers whose processes have presumably ended.
async fn forget_marks(shared: &State) -> Result<(), StoreError> {
    let oldest_ms = shared.clock.now_ms().saturating_sub(MARKS_FOR.as_millis() as u64);
    for (incarnation, mark) in shared.jobs.worker_marks().await? {
        if mark.since_ms < oldest_ms && !shared.workers.is_known(&incarnation) {
            shared.jobs.mark_worker(&incarnation, None).await?;
            shared.workers.note_mark(&incarnation, None);
        }
    }
    Ok(())
}

/// Deletes expired uploads of datasets.
async fn forget_uploads(shared: &State, keep: Duration) -> Result<(), StoreError> {
    let keep_ms = u64::try_from(keep.as_millis()).unwrap_or(u64::MAX);
    for dataset in shared.store.forget_given_up(shared.clock.now_ms().saturating_sub(keep_ms)).await? {
        tracing::info!(dataset = %dataset.id, tenant = %dataset.tenant, "deleted an upload without recent activity");
    }
    Ok(())
}

/// The digests of all blobs that a job or dataset references, directly or through another blob, by tenant.
async fn used(shared: &State) -> Result<HashMap<Tenant, HashSet<String>>, RetentionError> {
    let mut used = Used { shared, by_tenant: HashMap::new(), read: HashSet::new() };
    let mut after = None::<(Tenant, DatasetId)>;
    loop {
        let from = after.as_ref().map(|(tenant, id)| (tenant, id));
        let page = shared.store.datasets(None, from, PAGE).await?;
        let Some(last) = page.last() else { break };
        after = Some((last.tenant.clone(), last.id.clone()));
        for dataset in &page {
            used.add(&dataset.tenant, [reference_of(dataset)]).await?;
        }
    }
    let mut before = None::<JobId>;
    loop {
        let page = shared.jobs.list(&JobFilter::default(), before.as_ref(), PAGE).await?;
        let Some(last) = page.last() else { return Ok(used.by_tenant) };
        before = Some(last.job_id.clone());
        for job in &page {
            let view = match shared.jobs.job(&job.job_id).await {
                Ok(view) => view,
                // Deleted since the page was read.
                Err(StoreError::JobNotFound(_)) => continue,
                Err(error) => return Err(error.into()),
            };
            let tasks = view.tasks.iter().map(|(task, _)| task);
            used.add(&view.job.tenant, references(&view.job, tasks)).await?;
            let of_tenant = used.by_tenant.entry(view.job.tenant.clone()).or_default();
            of_tenant.extend(history::pictures(shared, &job.job_id).await?);
        }
    }
}

/// References found so far.
struct Used<'a> {
    shared: &'a State,
    by_tenant: HashMap<Tenant, HashSet<String>>,
    /// Jobs share scenes: each blob is read once.
    read: HashSet<(Tenant, String)>,
}

impl Used<'_> {
    /// Adds blobs of a tenant, and the blobs that they name.
    async fn add<'b>(
        &mut self,
        tenant: &Tenant,
        references: impl IntoIterator<Item = Reference<'b>>,
    ) -> Result<(), RetentionError> {
        let objects = self.shared.objects.of(tenant).await?;
        let used = self.by_tenant.entry(tenant.clone()).or_default();
        for Reference { what, blob, names_others } in references {
            used.insert(blob.digest.clone());
            if names_others && self.read.insert((tenant.clone(), blob.digest.clone())) {
                match objects.read(blob).await {
                    Ok(bytes) => used.extend(digests_in(&bytes)),
                    Err(source) => return Err(RetentionError::Unreadable { what, source }),
                }
            }
        }
        Ok(())
    }
}

/// Everything in `bytes` that may be a digest: 64 lower-case hex digits that stand alone.
fn digests_in(bytes: &[u8]) -> impl Iterator<Item = String> + '_ {
    let is_hex = |b: &u8| b.is_ascii_digit() || (b'a'..=b'f').contains(b);
    // In protobuf's binary form the byte before a text is its length, 64: an "@". Any byte may follow, also a
    // hex digit, so every window counts.
    let runs = bytes.split(move |b| !is_hex(b)).filter(|run| run.len() >= 64);
    runs.flat_map(|run| run.windows(64)).map(|digest| String::from_utf8_lossy(digest).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_digest_is_found_in_json_and_in_binary() {
        let [a, b] = ["a wreck", "a reef"].map(|text| blake3::hash(text.as_bytes()).to_hex().to_string());
        let json = format!(r#"{{"digest":"{a}","other":["{b}"]}}"#);
        assert_eq!(digests_in(json.as_bytes()).collect::<Vec<_>>(), [a.clone(), b.clone()]);
        // A field's tag and length before, and a hex digit behind.
        let binary = [b"\x0a\x40", a.as_bytes(), b"3\x12\x40", b.as_bytes(), b"\xff"].concat();
        let found: HashSet<String> = digests_in(&binary).collect();
        assert!(found.contains(&a) && found.contains(&b), "{found:?}");
        assert_eq!(digests_in(&a.as_bytes()[..63]).count(), 0);
        assert_eq!(digests_in(a.to_uppercase().as_bytes()).filter(|digest| *digest == a).count(), 0);
    }
}
