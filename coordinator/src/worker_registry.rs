//! The workers that have called this coordinator, or another one with the same database: identity, liveness,
//! and marks (cordoned or draining).

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex, PoisonError};

use fathom_plan::Connected;
use serde::{Deserialize, Serialize};

use crate::access::{Access, Principal};
use crate::clock::Clock;
use crate::schedule::{Stage, Tenant, WorkerProfile};
use crate::service_error::ServiceError;
use crate::store::members::SharedWorker;
use crate::store::{StoreError, WorkerMark};

/// Longest line that is kept of a worker, characters.
const MAX_WORDS: usize = 296;
/// Cache time of [`WorkerRegistry::peers`], milliseconds.
const PEERS_FOR_MS: u64 = 200;

/// A worker that has registered.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KnownWorker {
    /// Its profile for the assignment of tasks.
    pub profile: WorkerProfile,
    /// Name of its adapter, as the driver reports it.
    pub adapter: String,
    /// Version of its program.
    pub build_version: String,
    /// Its last call, Unix milliseconds.
    #[serde(skip)]
    pub seen_ms: u64,
    /// The caller that registered it, its only owner.
    pub owner: Principal,
}

impl KnownWorker {
    /// Its owner in the rows that coordinators share.
    pub fn owner_key(&self) -> &str {
        self.owner.token_id.as_deref().unwrap_or_default()
    }

    /// It in the rows that coordinators share.
    pub fn to_row(&self) -> Result<Vec<u8>, StoreError> {
        let failed =
            |error: serde_json::Error| StoreError::Unwritable { tree: "workers", message: error.to_string() };
        serde_json::to_vec(self).map_err(failed)
    }
}

/// The beginning of a message, as one line.
fn short(message: &str) -> String {
    let line = message.replace(['\n', '\r'], " ");
    match line.char_indices().nth(MAX_WORDS) {
        Some((end, _)) => format!("{} ...", &line[..end]),
        None => line,
    }
}

/// All workers that this process knows of.
pub struct WorkerRegistry {
    clock: Clock,
    /// Lease duration, milliseconds.
    lease_ms: u32,
    /// Workers that have called, by incarnation.
    workers: Mutex<HashMap<String, KnownWorker>>,
    /// Those that have called this process since the latest report to other coordinators.
    called: Mutex<HashSet<String>>,
    /// Marked workers, by incarnation, also stored; and the number of changes by this process.
    marks: Mutex<(HashMap<String, WorkerMark>, u64)>,
    /// The latest line that a worker logged for a task, and when, by incarnation.
    last_words: Mutex<HashMap<String, (String, u64)>>,
    /// The cached answer of [`WorkerRegistry::peers`], and its time, Unix milliseconds.
    connected: Mutex<(u64, Arc<[WorkerProfile]>)>,
}

impl WorkerRegistry {
    /// An empty registry with the stored marks.
    pub fn new(clock: Clock, lease_ms: u32, marks: HashMap<String, WorkerMark>) -> Self {
        let connected = Mutex::new((0, Arc::default()));
        let (workers, called, last_words) = (Mutex::default(), Mutex::default(), Mutex::default());
        Self { clock, lease_ms, workers, called, marks: Mutex::new((marks, 0)), last_words, connected }
    }

    /// Adds a worker that registers; it counts at once.
    ///
    /// # Errors
    /// When another caller has registered it: an incarnation is not a secret.
    pub fn add(&self, incarnation: String, worker: KnownWorker) -> Result<(), ServiceError> {
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

    /// All workers that have called recently, by incarnation.
    pub fn all(&self) -> Vec<(String, KnownWorker)> {
        let workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        workers.iter().map(|(id, worker)| (id.clone(), worker.clone())).collect()
    }

    /// A worker that has called recently.
    pub fn get(&self, incarnation: &str) -> Option<KnownWorker> {
        self.workers.lock().unwrap_or_else(PoisonError::into_inner).get(incarnation).cloned()
    }

    /// Whether a worker has called recently.
    pub fn is_known(&self, incarnation: &str) -> bool {
        self.workers.lock().unwrap_or_else(PoisonError::into_inner).contains_key(incarnation)
    }

    /// Looks up a worker of a caller, and records that it is alive.
    pub fn touch(&self, caller: &Principal, incarnation: &str) -> Option<KnownWorker> {
        let now_ms = self.clock.now_ms();
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let worker =
            workers.get_mut(incarnation).filter(|worker| worker.owner.token_id == caller.token_id)?;
        worker.seen_ms = now_ms;
        let worker = worker.clone();
        drop(workers);
        let mut called = self.called.lock().unwrap_or_else(PoisonError::into_inner);
        if !called.contains(incarnation) {
            called.insert(incarnation.to_owned());
        }
        Some(worker)
    }

    /// Notes a line that a worker has logged; of a worker that has not called it notes nothing.
    pub fn heard(&self, incarnation: &str, line: &str, time_ms: u64) {
        if self.is_known(incarnation) {
            let said = (short(line), time_ms);
            let mut last_words = self.last_words.lock().unwrap_or_else(PoisonError::into_inner);
            last_words.insert(incarnation.to_owned(), said);
        }
    }

    /// The latest line of a worker, and when it logged it, Unix milliseconds.
    pub fn last_words(&self, incarnation: &str) -> Option<(String, u64)> {
        self.last_words.lock().unwrap_or_else(PoisonError::into_inner).get(incarnation).cloned()
    }

    /// The workers that have called this process since the last question, and how long ago, milliseconds.
    pub fn take_seen(&self) -> Vec<(String, u64)> {
        let called = std::mem::take(&mut *self.called.lock().unwrap_or_else(PoisonError::into_inner));
        let now_ms = self.clock.now_ms();
        let workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let seen = called.into_iter().filter_map(|incarnation| {
            let silent_ms = now_ms.saturating_sub(workers.get(&incarnation)?.seen_ms);
            Some((incarnation, silent_ms))
        });
        seen.collect()
    }

    /// Adds what other coordinators know of workers; returns whether all of them are known now. One that
    /// another owner has registered meanwhile stays that of its first owner.
    pub fn add_others(&self, others: Vec<SharedWorker>) -> bool {
        let now_ms = self.clock.now_ms();
        let mut knows_all = true;
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        for SharedWorker { incarnation, silent_ms, registered } in others {
            let seen_ms = now_ms.saturating_sub(silent_ms);
            let has_row = registered.is_some();
            // One that a coordinator of another version cannot read has to register again.
            let new = registered.and_then(|row| serde_json::from_slice::<KnownWorker>(&row).ok());
            match (workers.get_mut(&incarnation), new) {
                (Some(known), new) => {
                    let seen_ms = known.seen_ms.max(seen_ms);
                    let new = new.filter(|new| new.owner.token_id == known.owner.token_id);
                    *known = KnownWorker { seen_ms, ..new.unwrap_or_else(|| known.clone()) };
                }
                (None, Some(new)) => drop(workers.insert(incarnation, KnownWorker { seen_ms, ..new })),
                (None, None) => knows_all &= has_row,
            }
        }
        knows_all
    }

    /// Removes workers whose tokens are no longer valid, and returns their incarnations.
    pub fn take_disowned(&self, access: &Access) -> Vec<String> {
        let now_ms = self.clock.now_ms();
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let gone = workers.extract_if(|_, worker| !access.still_holds(&worker.owner, now_ms));
        gone.map(|(incarnation, _)| incarnation).collect()
    }

    /// The workers available for the plan of a tenant's job: those that take partitions.
    pub fn connected(&self, tenant: &Tenant) -> Connected {
        let peers = self.peers();
        let there =
            peers.iter().filter(|peer| peer.stages.contains(&Stage::Partition) && peer.serves(tenant));
        let memory_bytes = there.clone().filter_map(|peer| peer.memory_bytes).min();
        Connected { workers: u32::try_from(there.count()).unwrap_or(u32::MAX), memory_bytes }
    }

    /// Removes workers that have been silent for long, or the table would leak memory.
    pub fn forget_silent(&self) {
        let now_ms = self.clock.now_ms();
        let limit_ms = self.forget_after_ms();
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        workers.retain(|_, worker| now_ms.saturating_sub(worker.seen_ms) <= limit_ms);
        let mut last_words = self.last_words.lock().unwrap_or_else(PoisonError::into_inner);
        last_words.retain(|incarnation, _| workers.contains_key(incarnation));
    }

    /// Time after which a silent worker is forgotten, milliseconds.
    pub fn forget_after_ms(&self) -> u64 {
        10 * u64::from(self.lease_ms)
    }

    /// Whether a worker has called within the duration of a lease.
    pub fn lives(&self, worker: &KnownWorker) -> bool {
        self.clock.now_ms().saturating_sub(worker.seen_ms) <= u64::from(self.lease_ms)
    }

    /// The mark of a worker; `None` if it is active.
    pub fn mark_of(&self, incarnation: &str) -> Option<WorkerMark> {
        self.marks.lock().unwrap_or_else(PoisonError::into_inner).0.get(incarnation).cloned()
    }

    /// All marked workers.
    pub fn marked(&self) -> Vec<String> {
        self.marks.lock().unwrap_or_else(PoisonError::into_inner).0.keys().cloned().collect()
    }

    /// Whether a worker is draining.
    pub fn drains(&self, incarnation: &str) -> bool {
        self.mark_of(incarnation).is_some_and(|mark| mark.drains)
    }

    /// Records a stored mark.
    pub fn note_mark(&self, incarnation: &str, mark: Option<WorkerMark>) {
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        match mark {
            Some(mark) => drop(marks.0.insert(incarnation.to_owned(), mark)),
            None => drop(marks.0.remove(incarnation)),
        }
        marks.1 += 1;
        drop(marks);
        self.connected.lock().unwrap_or_else(PoisonError::into_inner).0 = 0;
    }

    /// The number of marks that this process has changed.
    pub fn marks_version(&self) -> u64 {
        self.marks.lock().unwrap_or_else(PoisonError::into_inner).1
    }

    /// Takes over the stored marks, which were read when this process had changed `version` of them; returns
    /// whether there are other ones than before.
    pub fn set_marks(&self, version: u64, stored: Vec<(String, WorkerMark)>) -> bool {
        let stored: HashMap<String, WorkerMark> = stored.into_iter().collect();
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        if marks.1 != version || marks.0 == stored {
            return false;
        }
        marks.0 = stored;
        drop(marks);
        self.connected.lock().unwrap_or_else(PoisonError::into_inner).0 = 0;
        true
    }

    /// The active workers that have called within a lease's duration. The answer is cached briefly, because
    /// every waiting claim asks, and a thousand workers wait.
    pub fn peers(&self) -> Arc<[WorkerProfile]> {
        let now_ms = self.clock.now_ms();
        let mut connected = self.connected.lock().unwrap_or_else(PoisonError::into_inner);
        if now_ms.saturating_sub(connected.0) < PEERS_FOR_MS {
            return Arc::clone(&connected.1);
        }
        let workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        let takes_tasks =
            |worker: &&KnownWorker| self.lives(worker) && self.mark_of(&worker.profile.incarnation).is_none();
        let peers: Arc<[WorkerProfile]> =
            workers.values().filter(takes_tasks).map(|worker| worker.profile.clone()).collect();
        *connected = (now_ms, Arc::clone(&peers));
        peers
    }
}
