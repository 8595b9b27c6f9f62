//! Links to one job, for colleagues: tokens that read this job until they expire, and nothing else.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use fathom_proto::v1;

use super::encode;
use crate::access::{Principal, TokenRecord};
use crate::history;
use crate::objects::{BlobStore, ObjectError};
use crate::own_tasks::input::MAX_MANIFEST_BYTES;
use crate::schedule::{Artifact, JobId};
use crate::service_error::ServiceError;
use crate::state::State;

/// How long a link lasts by default, at least and at most.
const USUAL: Duration = Duration::from_secs(7 * 24 * 3600);
const SHORTEST: Duration = Duration::from_secs(60);
const LONGEST: Duration = Duration::from_secs(90 * 24 * 3600);
/// Links of a tenant that are made in a day at most: tokens are in memory.
const MOST_A_DAY: usize = 200;
const DAY_MS: u64 = 24 * 3600 * 1000;

/// Issues the token of a link.
pub async fn share(
    shared: &State,
    caller: &Principal,
    job: JobId,
    expires_in_seconds: u64,
) -> Result<v1::ShareJobResponse, ServiceError> {
    let tenant = shared.owner(caller, &job).await?;
    if !shared.access.asks_for_tokens() {
        let message = if caller.token_id.is_some() {
            "cannot be shared: this page is for one run, and ends with it"
        } else {
            "needs no link: this service requires no tokens, so the address of its page is enough"
        };
        return Err(ServiceError::BadArgument { field: "job_id", message: message.into() });
    }
    let lasts = if expires_in_seconds == 0 { USUAL } else { Duration::from_secs(expires_in_seconds) };
    if !(SHORTEST..=LONGEST).contains(&lasts) {
        let message = format!("is {expires_in_seconds}; a link lasts from a minute to 90 days");
        return Err(ServiceError::BadArgument { field: "expires_in_seconds", message });
    }
    let now_ms = shared.clock.now_ms();
    // One at a time, so that the count of this process holds.
    let _alone = shared.links.issuing.lock().await;
    if shared.access.links_since(&tenant, now_ms.saturating_sub(DAY_MS)) >= MOST_A_DAY {
        return Err(ServiceError::TooManyLinks { tenant, most: MOST_A_DAY });
    }
    let wanted_ms = now_ms.saturating_add(u64::try_from(lasts.as_millis()).unwrap_or(u64::MAX));
    // A link ends with the token of the one who made it.
    let expires_ms = shared.access.expires_ms(caller).map_or(wanted_ms, |own_ms| own_ms.min(wanted_ms));
    let (token, record) = TokenRecord::of_link(job, tenant, caller, now_ms, expires_ms);
    shared.store.put_token(&record).await?;
    shared.access.note(record.clone());
    tracing::info!(token_id = %record.id, name = %record.name, by = %caller.name, "link issued");
    Ok(v1::ShareJobResponse {
        secret: token.reveal(),
        token_id: record.id,
        expire_time: Some(encode::timestamp(expires_ms)),
    })
}

/// What links need to be answered quickly.
#[derive(Default)]
pub struct Links {
    /// Held while a link is issued.
    issuing: tokio::sync::Mutex<()>,
    /// What the links of some jobs may read; held while one of them is looked up.
    readable: tokio::sync::Mutex<HashMap<JobId, Readable>>,
}

/// Jobs whose files are remembered.
const REMEMBERED: usize = 16;
/// Files that come while a job runs are looked up again after this time.
const LOOK_AGAIN_AFTER_MS: u64 = 2000;

/// The digests of the files of a job, 32 bytes each.
#[derive(Default)]
struct Readable {
    /// The lists that name the files: the manifest and, once the job has succeeded, the index of its results.
    lists: Vec<BlobRef>,
    files: HashSet<[u8; 32]>,
    /// Previews, and the models of tasks, which come while the job runs.
    on_the_way: HashSet<[u8; 32]>,
    looked_ms: Option<u64>,
}

/// Refuses a blob that is none of the job that a link is for. Other callers read every blob of their tenant.
pub async fn check_read(
    shared: &State,
    caller: &Principal,
    objects: &BlobStore,
    digest: &str,
) -> Result<(), ServiceError> {
    let Some(job) = &caller.job else { return Ok(()) };
    let none = || ServiceError::from(ObjectError::NotFound(digest.chars().take(64).collect()));
    let wanted = *blake3::Hash::from_hex(digest).map_err(|_| none())?.as_bytes();
    let row = shared.jobs.job_row(job).await?;
    if row.manifest.digest == digest || row.outputs.values().any(|blob| blob.digest == digest) {
        return Ok(());
    }
    let lists: Vec<BlobRef> =
        [Some(&row.manifest), row.output(Artifact::Index)].into_iter().flatten().cloned().collect();
    // One at a time: a list may be long.
    let mut readable = shared.links.readable.lock().await;
    if readable.len() >= REMEMBERED && !readable.contains_key(job) {
        readable.clear();
    }
    let known = readable.entry(job.clone()).or_default();
    if known.lists != lists {
        let mut files = HashSet::new();
        for list in &lists {
            let text = objects.read_at_most(list, MAX_MANIFEST_BYTES).await?;
            let found = threads::blocking(move || digests_in(&text)).await;
            files.extend(found.unwrap_or_default());
        }
        *known = Readable { lists, files, ..Readable::default() };
    }
    if known.files.contains(&wanted) || known.on_the_way.contains(&wanted) {
        return Ok(());
    }
    let now_ms = shared.clock.now_ms();
    if known.looked_ms.is_none_or(|looked_ms| looked_ms.saturating_add(LOOK_AGAIN_AFTER_MS) <= now_ms) {
        let previews =
            history::of_job(shared, job, None).await?.tasks.into_iter().flat_map(|task| task.previews);
        let pictures = previews.flat_map(|preview| [preview.render, preview.clear]).flatten();
        let tasks = shared.jobs.job(job).await?.tasks;
        let blobs = pictures.chain(tasks.iter().filter_map(|(record, _)| encode::model_of(record)));
        let digest = |blob: v1::BlobRef| Some(*blake3::Hash::from_hex(&blob.digest).ok()?.as_bytes());
        known.on_the_way = blobs.filter_map(digest).collect();
        known.looked_ms = Some(now_ms);
    }
    if known.on_the_way.contains(&wanted) { Ok(()) } else { Err(none()) }
}

/// All digests in a text: its runs of 64 hex digits.
fn digests_in(text: &[u8]) -> HashSet<[u8; 32]> {
    let runs = text.split(|byte| !byte.is_ascii_hexdigit()).filter(|run| run.len() == 64);
    runs.filter_map(|run| Some(*blake3::Hash::from_hex(run).ok()?.as_bytes())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_are_found_in_lists_and_nothing_else_is() {
        let (one, two) = ("ab".repeat(32), "0123456789abcdef".repeat(4));
        let text =
            format!(r#"{{"views": [{{"image": {{"digest": "{one}"}}}}], "points": "{two}", "x": "abc"}}"#);
        let found = digests_in(text.as_bytes());
        assert_eq!(found.len(), 2);
        assert!(found.contains(&[0xab; 32]));
        assert!(digests_in("a".repeat(65).as_bytes()).is_empty());
    }
}
