//! Invariants of any history of a service, in tests only.
//!
//! A history is what clients and workers were answered ([`Fact`]) and the store at the end. It comes from a
//! simulated service (`tests/simulation`), from real processes that were killed (`tests/kills`), or from a
//! week of calls (`tests/simulation/tests/week.rs`). The rules are the same for all. What a history does not
//! record is not checked: real processes record no grants, and a week has no watchers.
//!
//! | | invariant | checked from | not here, but in |
//! |---|---|---|---|
//! | I1 | an acknowledged job or dataset exists until its user deletes it | answers, the store at the end | |
//! | I2 | one request makes one job | answers, the store | |
//! | I3 | a task is done once, and a merge has each partition's result once | events, reports of merges | |
//! | I4 | fences of a task rise, only a running lease changes a task, and at most two run | grants and changes, where they are recorded; events | |
//! | I5 | an acknowledged checkpoint or result is never lost | workers' logs, events | |
//! | I6 | state changes are legal, event numbers have no gap, watchers see each event once, in order and unchanged | events, watchers | |
//! | I7 | attempts stay within their budgets, and no pause is shortened | rows, grants | |
//! | I8 | once faults end, every job ends | the store | |
//! | I9 | no limit is ever exceeded, and no task goes to a worker with too little memory | grants | |
//! | I10 | nothing is done after a job was cancelled | events | |
//! | I11 | every referenced blob exists and matches its digest, and unreferenced blobs are removed | merged models | the simulation, `fathom store verify` |
//! | I12 | the merged model is that of a run without faults | | both callers |
//! | I13 | no token is in a log, and tenants see nothing of each other | answers | the simulation |

mod events;
mod fact;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use fathom_coordinator::schedule::{Artifact, EventBody, JobId, Stage, TaskChange, TaskState, Tenant};
use fathom_coordinator::store::export::{Export, JobExport};
use fathom_core::scene::BlobRef;
use serde_json::Value;

pub use fact::Fact;

/// The history of a service.
pub struct Record<'a> {
    /// Facts in order, each with its time since the beginning.
    pub facts: &'a [(Duration, Fact)],
    /// The store at the end.
    pub export: &'a Export,
    /// The errors and the losses that a task may have.
    pub budgets: (u32, u32),
    /// Whether every job has had the time to end after the last fault.
    pub all_end: bool,
    /// Whether disks may lose committed results, which are then made again.
    pub loses_results: bool,
    /// The tenant of a user.
    pub tenant_of: &'a dyn Fn(usize) -> String,
    /// The content of a tenant's blob; `None` if it cannot be read.
    pub read: &'a dyn Fn(&Tenant, &BlobRef) -> Option<Vec<u8>>,
}

impl Record<'_> {
    /// A sentence for each violation, which begins with the name of the invariant.
    pub fn violations(&self) -> Vec<String> {
        let mut violations = Vec::new();
        self.acknowledged_jobs(&mut violations);
        self.acknowledged_datasets(&mut violations);
        self.fences_and_limits(&mut violations);
        self.safe_work(&mut violations);
        self.watchers(&mut violations);
        for job in &self.export.jobs {
            events::check(job, self.loses_results, &mut violations);
            self.budgets(job, &mut violations);
            self.merges(job, &mut violations);
        }
        violations
    }

    /// Jobs that their users deleted, or were deleting.
    pub fn deleted(&self) -> BTreeSet<&JobId> {
        let deleting = self.facts.iter().filter_map(|(_, fact)| match fact {
            Fact::Deleting { job, .. } => Some(job),
            _ => None,
        });
        deleting.collect()
    }

    /// I1 of datasets: they are unchanged since their commit.
    fn acknowledged_datasets(&self, violations: &mut Vec<String>) {
        let has = |done: &dyn Fn(&Fact) -> bool| self.facts.iter().any(|(_, fact)| done(fact));
        for (_, fact) in self.facts {
            let Fact::Committed { user, dataset, root } = fact else { continue };
            let tenant = (self.tenant_of)(*user);
            let there = self
                .export
                .datasets
                .iter()
                .find(|known| known.id.as_str() == dataset && known.tenant.as_str() == tenant)
                .map(|known| (known.committed_ms.is_some(), known.root.digest.as_str()));
            let is_deleted = has(&|fact| matches!(fact, Fact::Deleted { user: by, .. } if by == user));
            let may_be_deleted = has(&|fact| matches!(fact, Fact::Deleting { user: by, .. } if by == user));
            let is_right = match there {
                Some(known) => !is_deleted && known == (true, root.as_str()),
                None => may_be_deleted,
            };
            if !is_right {
                violations.push(format!(
                    "I1: dataset {dataset} of user {user} was committed as {root}, found {there:?}"
                ));
            }
        }
    }

    /// I1, I2, I13.
    fn acknowledged_jobs(&self, violations: &mut Vec<String>) {
        let deleted = self.deleted();
        let there: BTreeSet<&JobId> = self.export.jobs.iter().map(|job| &job.job.job_id).collect();
        let mut by_request = BTreeMap::new();
        for (_, fact) in self.facts {
            match fact {
                Fact::Created { request, job, .. } => {
                    if !there.contains(job) && !deleted.contains(job) {
                        violations.push(format!("I1: {job} was acknowledged for {request:?} and is missing"));
                    }
                    let first = *by_request.entry(request).or_insert(job);
                    if first != job {
                        violations.push(format!("I2: {request:?} made {first} and {job}"));
                    }
                }
                Fact::Deleted { job, .. } if there.contains(job) => {
                    violations.push(format!("I1: {job} was deleted and still exists"));
                }
                Fact::Revived { job, how, .. } => {
                    violations.push(format!("I2: {job} was deleted, and then {how}"));
                }
                Fact::ChangedTwice { lease, how } => violations
                    .push(format!("I3: {how} {} was applied twice (fence {})", lease.task, lease.fence)),
                Fact::TwoLeases { first, again } => {
                    violations.push(format!("I2: a repeated claim got {first:?} and {again:?}"));
                }
                Fact::Denied { job, said, .. } => {
                    violations.push(format!("I1: the user of {job} got the answer {said:?}"));
                }
                Fact::Betrayed { user, job, how } => {
                    violations.push(format!("I13: user {user} received data of {job}: {how}"));
                }
                _ => {}
            }
        }
        let mut requests = BTreeSet::new();
        for job in &self.export.jobs {
            if !requests.insert((&job.job.tenant, &job.job.request_id)) {
                violations.push(format!("I2: {:?} made several jobs", job.job.request_id));
            }
        }
    }

    /// I4, I7, I9: when a lease is granted, and when a change is made under one.
    fn fences_and_limits(&self, violations: &mut Vec<String>) {
        for (at, fact) in self.facts {
            match fact {
                Fact::Granted { lease, before, worker, need, has, limits, early_ms } => {
                    if *before >= lease.fence {
                        violations.push(format!(
                            "I4: at {at:?} fence {} of {} came after {before}",
                            lease.fence, lease.task
                        ));
                    }
                    if has.is_some_and(|has| has < *need) {
                        violations.push(format!(
                            "I9: {worker} with {has:?} bytes got {}, which needs {need}",
                            lease.task
                        ));
                    }
                    for (whose, is, most) in limits {
                        if *most > 0 && is > most {
                            violations
                                .push(format!("I9: {is} leases of {whose}, at most {most} are allowed"));
                        }
                    }
                    if (1..=LONGEST_PAUSE_MS).contains(early_ms) {
                        violations.push(format!(
                            "I7: {} was granted {early_ms} ms before the end of its pause",
                            lease.task
                        ));
                    }
                }
                Fact::Changed { lease, running, how }
                    if !running.contains(&lease.fence) || running.len() > 2 =>
                {
                    violations.push(format!(
                        "I4: at {at:?} {how} {} of {} was accepted under fence {}; running fences are \
                         {running:?}",
                        lease.task, lease.job, lease.fence
                    ));
                }
                _ => {}
            }
        }
    }

    /// I5.
    fn safe_work(&self, violations: &mut Vec<String>) {
        let deleted = self.deleted();
        let jobs: BTreeMap<&str, &JobExport> =
            self.export.jobs.iter().map(|job| (job.job.job_id.as_str(), job)).collect();
        for (_, fact) in self.facts {
            let (job, is_there): (&str, &dyn Fn(&JobExport) -> bool) = match fact {
                Fact::CheckpointSafe { job, task, attempt, iteration } => {
                    (job, &|job| holds_checkpoint(job, task, *attempt, *iteration))
                }
                Fact::ResultTaken { job, task, attempt } => (job, &|job| holds_result(job, task, *attempt)),
                _ => continue,
            };
            let is_deleted = deleted.iter().any(|deleted| deleted.as_str() == job);
            if !is_deleted && !jobs.get(job).is_some_and(|job| is_there(job)) {
                violations.push(format!("I5: {fact} and is not there"));
            }
        }
    }

    /// I6: events received by watchers.
    fn watchers(&self, violations: &mut Vec<String>) {
        let mut seen = BTreeMap::<_, Vec<(u64, &str)>>::new();
        let mut reread = BTreeMap::<_, BTreeMap<usize, Vec<(u64, &str)>>>::new();
        for (_, fact) in self.facts {
            match fact {
                Fact::Seen { user, job, seq, digest } => {
                    seen.entry((job, *user)).or_default().push((*seq, digest));
                }
                Fact::Reread { user, job, seq, digest } => {
                    let of_job = reread.entry(job).or_default();
                    of_job.entry(*user).or_default().push((*seq, digest));
                }
                _ => {}
            }
        }
        for ((job, user), events) in &seen {
            let numbers: Vec<u64> = events.iter().map(|(seq, _)| *seq).collect();
            if numbers != (1..=numbers.len() as u64).collect::<Vec<_>>() {
                violations.push(format!("I6: user {user} received the events {numbers:?} of {job}"));
            }
            let Some(again) = reread.get(job) else { continue };
            for (other, again) in again {
                let differs = events.iter().zip(again).find(|(a, b)| a != b);
                // The same user has seen as much before as it saw at the end.
                if differs.is_some() || (other == user && events.len() != again.len()) {
                    violations.push(format!(
                        "I6: user {user} saw {} events of {job}, and user {other} then {}: {differs:?}",
                        events.len(),
                        again.len()
                    ));
                }
            }
            // A retried job goes on after its first watcher has left.
            let is_last = again.last_key_value().is_some_and(|(last, _)| last == user);
            let stored = self.export.jobs.iter().find(|known| known.job.job_id == **job);
            let last = stored.map(|known| known.job.last_seq);
            if is_last && last.is_some_and(|last| last != numbers.len() as u64) {
                violations
                    .push(format!("I6: {job} has events up to {last:?}, user {user} saw {}", numbers.len()));
            }
        }
    }

    /// I7, I8.
    fn budgets(&self, job: &JobExport, violations: &mut Vec<String>) {
        let (max_errors, max_losses) = self.budgets;
        for task in &job.tasks {
            let spent = [(task.errors, max_errors, "errors"), (task.losses, max_losses, "losses")];
            for (is, most, what) in spent {
                if is > most {
                    violations.push(format!(
                        "I7: {} of {} has {is} {what}, at most {most} are allowed",
                        task.task, job.job.job_id
                    ));
                }
            }
            if task.attempts < task.errors + task.losses && !matches!(task.state, TaskState::Ready { .. }) {
                violations.push(format!(
                    "I7: {} of {} had {} attempts, and more of them failed",
                    task.task, job.job.job_id, task.attempts
                ));
            }
        }
        if self.all_end && job.job.state.is_open() {
            violations.push(format!("I8: {} is {:?} at {:?}", job.job.job_id, job.job.state, job.job.stage));
        }
    }

    /// I3: the merge used each partition's committed result once. I11: users received the merged model.
    fn merges(&self, job: &JobExport, violations: &mut Vec<String>) {
        let id = &job.job.job_id;
        let made = |artifact| job.job.output(artifact);
        let (Some(report), Some(model)) = (made(Artifact::MergeReport), made(Artifact::Model)) else {
            return;
        };
        for (_, fact) in self.facts {
            if let Fact::Fetched { job: of, model: fetched, .. } = fact
                && of == id
                && *fetched != model.digest
            {
                violations
                    .push(format!("I11: the user of {id} received {fetched} instead of {}", model.digest));
            }
        }
        let read = |blob: &BlobRef| -> Option<Value> {
            serde_json::from_slice(&(self.read)(&job.job.tenant, blob)?).ok()
        };
        let manifest =
            read(report).and_then(|report| read(&serde_json::from_value(report["manifest"].clone()).ok()?));
        let Some(manifest) = manifest else {
            return violations.push(format!("I11: the report of the merge of {id} cannot be read"));
        };
        let merged: Vec<&str> = manifest["partitions"]
            .as_array()
            .map(|all| all.iter().filter_map(|one| one["result"].as_str()).collect())
            .unwrap_or_default();
        let committed: Vec<&str> = results(job).map(|blob| blob.digest.as_str()).collect();
        if merged != committed {
            violations.push(format!("I3: {id} was merged of {merged:?}, committed are {committed:?}"));
        }
    }
}

/// Whether a checkpoint is stored. With two workers on a task, the slower one learns that the other's
/// progress is stored.
fn holds_checkpoint(job: &JobExport, name: &str, attempt: u64, iteration: u64) -> bool {
    let has_two_workers = job.events.iter().any(|event| {
        matches!(&event.body, EventBody::Task { task, state: TaskChange::Leased, message, .. }
            if task.to_string() == name && message.starts_with("beside "))
    });
    job.events.iter().any(|event| {
        let EventBody::Checkpoint { task, attempt: by, iteration: at } = &event.body else { return false };
        let (by, at) = (u64::from(*by), u64::from(*at));
        let is_other = has_two_workers && by != attempt && at >= iteration;
        task.to_string() == name && ((by, at) == (attempt, iteration) || is_other)
    })
}

fn holds_result(job: &JobExport, name: &str, attempt: u64) -> bool {
    job.events.iter().any(|event| {
        matches!(&event.body, EventBody::Task { task, state: TaskChange::Done, attempt: by, .. }
            if task.to_string() == name && u64::from(*by) == attempt)
    })
}

/// Longest pause before another attempt: a minute, plus up to a random quarter. A longer apparent pause comes
/// from a clock that was set back.
const LONGEST_PAUSE_MS: u64 = 75_000;

/// The committed results of a job's partitions, in order.
fn results(job: &JobExport) -> impl Iterator<Item = &BlobRef> {
    job.tasks.iter().filter_map(|task| match (task.task.stage, &task.state) {
        (Stage::Partition, TaskState::Done { result, .. }) => Some(result),
        _ => None,
    })
}
