//! What is called over gRPC. Handlers only decode, send and encode: rules are in [`crate::schedule`].

mod admin;
mod backup;
pub mod capacity;
pub mod convert;
mod datasets;
pub mod encode;
mod jobs;
pub mod logs;
mod manifests;
mod results;
mod session;
mod tenants;
mod uploads;
mod watch;
mod workers;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use fathom_observe::queue::Queue;
use tokio::sync::{Semaphore, SemaphorePermit, watch as channel};

use self::convert::ServiceError;
use crate::access::{Access, Principal};
use crate::clock::Clock;
use crate::logs::JobLogs;
use crate::metrics::Metrics;
use crate::objects::TenantBlobs;
use crate::retention::Policy;
use crate::schedule::{JobId, Lease, Peer, TaskKind, Tenant};
use crate::store::{Store, StoreError, WorkerMark};
use fathom_plan::Connected;

pub use admin::Admin;
pub use capacity::Gap;
pub use jobs::Jobs;
pub use uploads::Uploads;
pub use workers::{Workers, release_disowned};

/// How long an answer of [`Shared::peers`] holds, milliseconds.
const PEERS_FOR_MS: u64 = 200;

/// Lists and manifests of clients that take more memory than this are long. Most have a few hundred kilobytes.
const LONG_BYTES: u64 = 4 << 20;
/// Memory that the long ones have, of up to 256 MiB each, for all callers together, and memory that the short ones have, KiB: so nobody
/// waits for a long one who has a short one.
const LONG_KIB: u32 = 288 << 10;
const SHORT_KIB: u32 = 64 << 10;
static LONG_ONES: Semaphore = Semaphore::const_new(LONG_KIB as usize);
static SHORT_ONES: Semaphore = Semaphore::const_new(SHORT_KIB as usize);

/// The right to have something in memory; given back when dropped.
pub struct Turn(#[expect(dead_code, reason = "held for its end")] Option<SemaphorePermit<'static>>);

/// The right to read something that takes so many bytes, and to have it for as long as it lives. What takes more than there is has all of
/// it.
async fn turn_to_read(bytes: u64) -> Turn {
    let (ones, most) = if bytes <= LONG_BYTES { (&SHORT_ONES, SHORT_KIB) } else { (&LONG_ONES, LONG_KIB) };
    let kib = u32::try_from(bytes.div_ceil(1024)).unwrap_or(most).clamp(1, most);
    // They are never closed.
    Turn(ones.acquire_many(kib).await.ok())
}

/// What all services share.
pub struct Shared {
    /// Jobs, leases, results.
    pub store: Arc<dyn Store>,
    /// Bytes.
    pub objects: TenantBlobs,
    /// Tokens.
    pub access: Arc<Access>,
    /// Log lines of jobs.
    pub logs: Arc<JobLogs>,
    /// Lines of the coordinator's own tasks on their way there.
    pub own_lines: Arc<Queue<Lease>>,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// The one clock.
    pub clock: Clock,
    /// Silence after which a lease is over, milliseconds.
    pub lease_ms: u32,
    /// Counts changes: watchers look again when it moves. Only a hint; they also look from time to time.
    pub changes: channel::Sender<u64>,
    /// The same for those that wait for work, without what brings none: a thousand workers wait, and renewals come all the time.
    pub work: channel::Sender<u64>,
    /// The same for workers that work: moves when work may have to stop that its worker did not stop itself.
    pub interrupts: channel::Sender<u64>,
    /// Ends waiting calls when the coordinator stops.
    pub stopping: channel::Receiver<bool>,
    /// Workers that have called, by incarnation.
    pub workers: Mutex<HashMap<String, KnownWorker>>,
    /// Workers that get no further task, by incarnation; the store has them too.
    pub marks: Mutex<HashMap<String, WorkerMark>>,
    /// The answer of [`Shared::peers`], and when it was made, Unix milliseconds.
    pub connected: Mutex<(u64, Arc<[Peer]>)>,
    /// Jobs that no connected worker can go on with.
    pub gaps: Mutex<HashMap<JobId, Gap>>,
    /// Held while a token is revoked.
    pub revoking: tokio::sync::Mutex<()>,
    /// Held while a backup is made.
    pub backing_up: tokio::sync::Mutex<()>,
    /// What is kept for how long.
    pub policy: Policy,
    /// See [`crate::CoordinatorConfig::capacity_timeout_ms`].
    pub capacity_timeout_ms: u32,
}

/// A worker that has registered with this process.
#[derive(Clone, Debug)]
pub struct KnownWorker {
    /// What tasks ask of it.
    pub peer: Peer,
    /// Name of its adapter by the driver.
    pub adapter: String,
    /// Version of its program.
    pub build_version: String,
    /// Its last call, Unix milliseconds.
    pub seen_ms: u64,
    /// Who registered it: nobody else is this worker.
    pub owner: Principal,
}

impl Shared {
    /// Tells all that wait to look again.
    pub fn changed(&self) {
        self.progressed();
        self.work.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Tells watchers to look again, where there can be no more work than before.
    pub fn progressed(&self) {
        self.changes.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Tells all that wait to look again, and workers whether they are to stop.
    pub fn interrupted(&self) {
        self.changed();
        self.interrupts.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Notes a worker that registers; it counts at once.
    ///
    /// # Errors
    /// When another caller has registered it: an incarnation is a name that others may come to know, and no secret.
    pub fn add_worker(&self, incarnation: String, worker: KnownWorker) -> Result<(), ServiceError> {
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let known = workers.get(&incarnation);
        if known.is_some_and(|known| known.owner.token_id != worker.owner.token_id) {
            return Err(ServiceError::OtherWorker);
        }
        workers.insert(incarnation, worker);
        drop(workers);
        self.connected.lock().unwrap_or_else(PoisonError::into_inner).0 = 0;
        Ok(())
    }

    /// Whether a worker has called lately.
    pub fn is_known(&self, incarnation: &str) -> bool {
        self.workers.lock().unwrap_or_else(PoisonError::into_inner).contains_key(incarnation)
    }

    /// The tenant of a job, if the caller may know of it: what belongs to another is not there.
    pub async fn owner(&self, caller: &Principal, job: &JobId) -> Result<Tenant, StoreError> {
        let tenant = self.store.job_row(job).await?.tenant;
        if caller.sees(&tenant) { Ok(tenant) } else { Err(StoreError::JobNotFound(job.clone())) }
    }

    /// Refuses when a tenant would have more than it may with `more` bytes.
    pub async fn check_bytes(&self, tenant: &Tenant, more: u64) -> Result<(), ServiceError> {
        let used_bytes = self.objects.used_bytes(tenant)?;
        match self.limit_bytes(tenant).await? {
            Some(limit_bytes) if used_bytes.saturating_add(more) > limit_bytes => {
                Err(ServiceError::TooManyBytes { tenant: tenant.clone(), used_bytes, limit_bytes })
            }
            _ => Ok(()),
        }
    }

    /// Bytes that a tenant may have; `None`: any number.
    pub async fn limit_bytes(&self, tenant: &Tenant) -> Result<Option<u64>, StoreError> {
        Ok(Some(self.store.quota(tenant).await?.max_bytes).filter(|&bytes| bytes > 0))
    }

    /// Looks a worker of a caller up and notes that it lives.
    pub fn touch_worker(&self, caller: &Principal, incarnation: &str) -> Option<KnownWorker> {
        let now_ms = self.clock.now_ms();
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let worker =
            workers.get_mut(incarnation).filter(|worker| worker.owner.token_id == caller.token_id)?;
        worker.seen_ms = now_ms;
        Some(worker.clone())
    }

    /// Forgets the workers whose tokens hold no more, and gives their incarnations.
    fn take_disowned(&self) -> Vec<String> {
        let now_ms = self.clock.now_ms();
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let gone = workers.extract_if(|_, worker| !self.access.still_holds(&worker.owner, now_ms));
        gone.map(|(incarnation, _)| incarnation).collect()
    }

    /// The workers that the plan of a tenant's job can count on: those that take partitions.
    pub fn connected(&self, tenant: &Tenant) -> Connected {
        let peers = self.peers();
        let there =
            peers.iter().filter(|peer| peer.kinds.contains(&TaskKind::Partition) && peer.serves(tenant));
        let memory_bytes = there.clone().filter_map(|peer| peer.memory_bytes).min();
        Connected { workers: u32::try_from(there.count()).unwrap_or(u32::MAX), memory_bytes }
    }

    /// Forgets workers that have been silent for long; a long table of the dead would be a leak.
    pub fn forget_silent_workers(&self) {
        let now_ms = self.clock.now_ms();
        let limit_ms = 10 * u64::from(self.lease_ms);
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        workers.retain(|_, worker| now_ms.saturating_sub(worker.seen_ms) <= limit_ms);
    }

    /// Whether a worker has called within the time of a lease.
    pub fn lives(&self, worker: &KnownWorker) -> bool {
        self.clock.now_ms().saturating_sub(worker.seen_ms) <= u64::from(self.lease_ms)
    }

    /// That a worker gets no further task; `None` where it does.
    pub fn mark_of(&self, incarnation: &str) -> Option<WorkerMark> {
        self.marks.lock().unwrap_or_else(PoisonError::into_inner).get(incarnation).cloned()
    }

    /// Those that get no further task.
    pub fn marked(&self) -> Vec<String> {
        self.marks.lock().unwrap_or_else(PoisonError::into_inner).keys().cloned().collect()
    }

    /// Whether a worker is to give back what it has.
    pub fn drains(&self, incarnation: &str) -> bool {
        self.mark_of(incarnation).is_some_and(|mark| mark.drains)
    }

    /// Notes what the store was told of a worker.
    pub fn note_mark(&self, incarnation: &str, mark: Option<WorkerMark>) {
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        match mark {
            Some(mark) => drop(marks.insert(incarnation.to_owned(), mark)),
            None => drop(marks.remove(incarnation)),
        }
        drop(marks);
        self.connected.lock().unwrap_or_else(PoisonError::into_inner).0 = 0;
    }

    /// The workers that take tasks and have called within a lease's time, as of a moment ago: every waiting claim asks, and a
    /// thousand workers wait.
    pub fn peers(&self) -> Arc<[Peer]> {
        let now_ms = self.clock.now_ms();
        let mut connected = self.connected.lock().unwrap_or_else(PoisonError::into_inner);
        if now_ms.saturating_sub(connected.0) < PEERS_FOR_MS {
            return Arc::clone(&connected.1);
        }
        let workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let takes_tasks =
            |worker: &&KnownWorker| self.lives(worker) && self.mark_of(&worker.peer.incarnation).is_none();
        let peers: Arc<[Peer]> =
            workers.values().filter(takes_tasks).map(|worker| worker.peer.clone()).collect();
        *connected = (now_ms, Arc::clone(&peers));
        peers
    }
}

/// Waits until the coordinator stops.
pub async fn stopped(stopping: &mut channel::Receiver<bool>) {
    // An error means that its owner is gone, which is the same.
    let _ = stopping.wait_for(|stopping| *stopping).await;
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    #[test]
    fn long_lists_share_a_bounded_memory_for_as_long_as_they_live_and_short_ones_wait_for_none_of_them() {
        let take = |bytes: u64| turn_to_read(bytes).now_or_never();
        let first = [take(200 << 20), take(80 << 20)];
        assert!(first.iter().all(Option::is_some), "there is room for both");
        assert!(take(20 << 20).is_none(), "a third one waits");
        assert!(take(LONG_BYTES).is_some(), "who is short waits for nobody");
        drop(first);
        let longest = take(1 << 40);
        assert!(longest.is_some() && take(LONG_BYTES + 1).is_none(), "the longest has all there is");
    }
}
