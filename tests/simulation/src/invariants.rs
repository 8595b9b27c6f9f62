//! What must hold of any history: I1 to I13.
//!
//! | | what must hold | from what it is seen |
//! |---|---|---|
//! | I1 | a job or a dataset that was acknowledged exists for ever after, or until its user deletes it | users' answers, the disk at the end |
//! | I2 | one request makes one job | users' answers, the disk |
//! | I3 | a task is done once, and a merge has each partition's result once | events, reports of merges |
//! | I4 | fences of a task rise, nothing is changed under one whose lease does not run, and two run at most | grants and changes |
//! | I5 | a checkpoint or a result that a worker was told is safe is not forgotten | workers' logs, events |
//! | I6 | states change as they may, numbers of events have no gap, watchers see each once, in order, as it stays | events, watchers |
//! | I7 | attempts stay within their budgets, and no pause is cut short | rows, grants |
//! | I8 | once nothing fails any more, every job ends | the run |
//! | I9 | no limit is exceeded at any instant, and no task goes to a worker without the memory | grants |
//! | I10 | nothing is done after a job was cancelled | events |
//! | I11 | every blob that is referred to is there and is what its digest says, and what is not referred to goes | files |
//! | I12 | the merged model is that of a run without faults | blobs, compared by who runs several |
//! | I13 | no token is in a log, and tenants see nothing of each other | logs, users' answers |

mod files;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use fathom_coordinator::schedule::{
    Artifact, EventBody, JobId, JobState, Stage, TaskChange, TaskId, TaskState,
};
use fathom_coordinator::store::export::{Export, JobExport};
use fathom_core::scene::BlobRef;
use serde_json::Value;

use crate::history::Fact;
use crate::scene::{config, kind_of};
use crate::world::{World, tenant_of};

/// What was found.
#[derive(Default)]
pub struct Found {
    /// A sentence for each.
    pub violations: Vec<String>,
    /// Digests of the merged models, by the kind of their jobs.
    pub models: Vec<(String, String)>,
}

/// Looks at a run that has ended.
pub fn look(world: &World) -> Found {
    let export = world.disk.lock().unwrap_or_else(std::sync::PoisonError::into_inner).synced();
    let mut found = Found::default();
    let deleted = deleted(world);
    acknowledged_jobs(world, &export, &deleted, &mut found.violations);
    acknowledged_datasets(world, &export, &mut found.violations);
    fences_and_limits(world, &mut found.violations);
    safe_work(world, &export, &deleted, &mut found.violations);
    watchers(world, &export, &mut found.violations);
    for job in &export.jobs {
        events(job, &mut found.violations);
        budgets(world, job, &mut found.violations);
        merges(world, job, &mut found);
    }
    models_of_deleted(world, &deleted, &mut found.models);
    files::look(world, &export, &mut found.violations);
    world.counts(|counts| counts.jobs += export.jobs.len() as u64);
    for job in &export.jobs {
        let kept = world.coordinator_config().data_dir.join("logs").join(job.job.job_id.as_str());
        lines_of(&kept).iter().for_each(|line| world.look_for_tokens(line));
    }
    let said = world.said_tokens();
    found.violations.extend(said.iter().map(|line| format!("I13: a token is in a log: {line}")));
    found
}

/// Lines of all files in a folder and in those in it.
fn lines_of(folder: &Path) -> Vec<String> {
    let mut lines = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            lines.append(&mut lines_of(&path));
        } else {
            let text = std::fs::read(&path).unwrap_or_default();
            lines.extend(String::from_utf8_lossy(&text).lines().map(str::to_owned));
        }
    }
    lines
}

/// Jobs that their users deleted, or were about to.
fn deleted(world: &World) -> BTreeSet<JobId> {
    let of = |fact| match fact {
        Fact::Deleting { job, .. } => Some(job),
        _ => None,
    };
    world.history.facts().into_iter().filter_map(|(_, fact)| of(fact)).collect()
}

/// I12 of jobs that are gone: the models that were fetched of them.
fn models_of_deleted(world: &World, deleted: &BTreeSet<JobId>, models: &mut Vec<(String, String)>) {
    for (_, fact) in world.history.facts() {
        if let Fact::Fetched { user, job, model } = fact
            && deleted.contains(&job)
        {
            let wanted = &world.scenario.jobs[user];
            let config = serde_json::to_string(&config(wanted.partitions, wanted.variety));
            models.push((kind_of(&config.unwrap_or_default()), model));
        }
    }
}

/// I1 of datasets, which are as they were frozen.
fn acknowledged_datasets(world: &World, export: &Export, violations: &mut Vec<String>) {
    let facts = world.history.facts();
    let has = |done: &dyn Fn(&Fact) -> bool| facts.iter().any(|(_, fact)| done(fact));
    for (_, fact) in &facts {
        let Fact::Committed { user, dataset, root } = fact else { continue };
        world.counts(|counts| counts.datasets += 1);
        let tenant = tenant_of(*user);
        let there = export
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
                "I1: dataset {dataset} of user {user} was frozen as {root}, there is {there:?}"
            ));
        }
    }
}

/// I1, I2, I13.
fn acknowledged_jobs(
    world: &World,
    export: &Export,
    deleted: &BTreeSet<JobId>,
    violations: &mut Vec<String>,
) {
    let there: BTreeSet<&str> = export.jobs.iter().map(|job| job.job.job_id.as_str()).collect();
    let mut by_request = BTreeMap::new();
    for (_, fact) in world.history.facts() {
        match fact {
            Fact::Created { request, job, .. } => {
                if !there.contains(job.as_str()) && !deleted.contains(&job) {
                    violations.push(format!("I1: {job} was acknowledged for {request:?} and is not there"));
                }
                let first = by_request.entry(request.clone()).or_insert_with(|| job.clone());
                if *first != job {
                    violations.push(format!("I2: {request:?} made {first} and {job}"));
                }
            }
            Fact::Deleted { job, .. } if there.contains(job.as_str()) => {
                violations.push(format!("I1: {job} was deleted and is there"));
            }
            Fact::Revived { job, how, .. } => {
                violations.push(format!("I2: {job} was deleted, and then {how}"));
            }
            Fact::ChangedTwice { lease, how } => {
                violations
                    .push(format!("I3: {how} {} was applied twice (fence {})", lease.task, lease.fence));
            }
            Fact::TwoLeases { first, again } => {
                violations.push(format!("I2: a claim that came twice gave {first:?} and {again:?}"));
            }
            Fact::Denied { job, said, .. } => {
                violations.push(format!("I1: the user of {job} was told {said:?}"));
            }
            Fact::Betrayed { user, job, how } => {
                violations.push(format!("I13: user {user} was told of {job}: {how}"));
            }
            _ => {}
        }
    }
    let mut requests = BTreeSet::new();
    for job in &export.jobs {
        if !requests.insert((&job.job.tenant, &job.job.request_id)) {
            violations.push(format!("I2: {:?} made several jobs", job.job.request_id));
        }
    }
}

/// Longest pause before another attempt: a minute, and a quarter more by chance. What seems longer was counted by a clock that
/// somebody has set back since.
const LONGEST_PAUSE_MS: u64 = 75_000;

/// I4, I7, I9: at the moment at which a lease is given, or a change is made under one.
fn fences_and_limits(world: &World, violations: &mut Vec<String>) {
    for (at, fact) in world.history.facts() {
        match fact {
            Fact::Granted { lease, before, worker, need, has, limits, early_ms } => {
                world.counts(|counts| counts.attempts += 1);
                if before >= lease.fence {
                    violations.push(format!(
                        "I4: at {at:?} fence {} of {} came after {before}",
                        lease.fence, lease.task
                    ));
                }
                if has.is_some_and(|has| has < need) {
                    violations.push(format!(
                        "I9: {worker} with {has:?} bytes got {}, which needs {need}",
                        lease.task
                    ));
                }
                for (whose, is, most) in limits {
                    if most > 0 && is > most {
                        violations.push(format!("I9: {is} leases of {whose}, at most {most} may be"));
                    }
                }
                if (1..=LONGEST_PAUSE_MS).contains(&early_ms) {
                    violations.push(format!(
                        "I7: {} was given {early_ms} ms before its pause was over",
                        lease.task
                    ));
                }
            }
            Fact::Changed { lease, running, how } if !running.contains(&lease.fence) || running.len() > 2 => {
                violations.push(format!(
                    "I4: at {at:?} {how} {} of {} was taken under fence {}, those that run are {running:?}",
                    lease.task, lease.job, lease.fence
                ));
            }
            _ => {}
        }
    }
}

/// I5.
fn safe_work(world: &World, export: &Export, deleted: &BTreeSet<JobId>, violations: &mut Vec<String>) {
    let is_there = |job: &str, holds: &dyn Fn(&EventBody) -> bool| {
        if deleted.iter().any(|deleted| deleted.as_str() == job) {
            return true;
        }
        let found = export.jobs.iter().find(|known| known.job.job_id.as_str() == job);
        found.is_some_and(|job| job.events.iter().any(|event| holds(&event.body)))
    };
    for (_, fact) in world.history.facts() {
        match &fact {
            Fact::CheckpointSafe { job, task, attempt, iteration } => {
                let holds = |body: &EventBody| {
                    let EventBody::Checkpoint { task: of, attempt: by, iteration: at } = body else {
                        return false;
                    };
                    let (by, at) = (u64::from(*by), u64::from(*at));
                    // Of two workers at a task, the one that is behind is told that what the other has is safe.
                    of.to_string() == *task
                        && ((by, at) == (*attempt, *iteration) || (by != *attempt && at >= *iteration))
                };
                if !is_there(job, &holds) {
                    violations.push(format!("I5: {fact} and is not there"));
                }
            }
            Fact::ResultTaken { job, task, attempt } => {
                let holds = |body: &EventBody| {
                    matches!(body, EventBody::Task { task: of, state: TaskChange::Done, attempt: by, .. }
                        if of.to_string() == *task && u64::from(*by) == *attempt)
                };
                if !is_there(job, &holds) {
                    violations.push(format!("I5: {fact} and is not there"));
                }
            }
            _ => {}
        }
    }
}

/// I6: what watchers saw.
fn watchers(world: &World, export: &Export, violations: &mut Vec<String>) {
    let mut seen = BTreeMap::<_, Vec<(u64, String)>>::new();
    let mut reread = seen.clone();
    for (_, fact) in world.history.facts() {
        match fact {
            Fact::Seen { user, job, seq, digest } => seen.entry((user, job)).or_default().push((seq, digest)),
            Fact::Reread { user, job, seq, digest } => {
                reread.entry((user, job)).or_default().push((seq, digest));
            }
            _ => {}
        }
    }
    for ((user, job), told) in &seen {
        let numbers: Vec<u64> = told.iter().map(|(seq, _)| *seq).collect();
        if numbers != (1..=numbers.len() as u64).collect::<Vec<_>>() {
            violations.push(format!("I6: user {user} was told the events {numbers:?} of {job}"));
        }
        let last = export.jobs.iter().find(|known| known.job.job_id == *job).map(|known| known.job.last_seq);
        if let Some(again) = reread.get(&(*user, job.clone())) {
            if told != again {
                let other = told.iter().zip(again).find(|(a, b)| a != b);
                violations.push(format!(
                    "I6: events of {job} were others when user {user} saw them first: {other:?}"
                ));
            }
            if last.is_some_and(|last| last != numbers.len() as u64) {
                violations
                    .push(format!("I6: {job} has events up to {last:?}, user {user} saw {}", numbers.len()));
            }
        }
    }
}

/// I3, I6, I10: the events of one job.
fn events(job: &JobExport, violations: &mut Vec<String>) {
    let id = &job.job.job_id;
    // What was told last of each task, its attempts, and those of them that run.
    let mut tasks = BTreeMap::<TaskId, (TaskChange, u32, Vec<u32>)>::new();
    let (mut state, mut stage, mut cancelled) = (None::<JobState>, None::<Stage>, false);
    for (index, event) in job.events.iter().enumerate() {
        let mut illegal = |name: &str, why: &str| {
            violations.push(format!("{name}: event {} of {id} {why}: {:?}", index + 1, event.body));
        };
        if event.seq != index as u64 + 1 {
            illegal("I6", &format!("has number {}", event.seq));
        }
        match &event.body {
            EventBody::JobState { state: next, .. } => {
                use JobState::{Failed, Paused, Running};
                let legal = match state {
                    None => *next == Running,
                    Some(Running) => *next != Running,
                    Some(Paused) => *next != Paused,
                    Some(Failed) => *next == Running,
                    Some(_) => false,
                };
                if !legal {
                    illegal("I6", &format!("cannot follow {state:?}"));
                }
                if state == Some(Failed) {
                    // Tried again: what was not done is ready.
                    tasks
                        .values_mut()
                        .filter(|(change, ..)| *change != TaskChange::Done)
                        .for_each(|task| task.0 = TaskChange::Ready);
                }
                state = Some(*next);
                cancelled |= *next == JobState::Cancelled;
            }
            EventBody::Stage { stage: next, .. } => {
                if stage.is_some_and(|stage| stage >= *next) {
                    illegal("I6", &format!("cannot follow {stage:?}"));
                }
                stage = Some(*next);
            }
            EventBody::Task { task, state: next, attempt, message, .. } => {
                use TaskChange::{Dead, Done, Leased, Ready};
                if cancelled {
                    illegal(if *next == Done { "I10" } else { "I6" }, "came after the job was cancelled");
                }
                let (before, attempts, mut running) =
                    tasks.get(task).cloned().unwrap_or((Ready, 0, Vec::new()));
                let is_second = message.starts_with("beside ");
                let legal = match (before, next) {
                    (Ready | Dead, Leased) => *attempt == attempts + 1 && !is_second,
                    (Leased, Leased) => *attempt == attempts + 1 && is_second && running.len() == 1,
                    (Leased, Ready | Done | Dead) => running.contains(attempt),
                    (Ready, Dead) => *attempt == attempts,
                    _ => false,
                };
                if !legal {
                    let name = if before == Done && *next == Done { "I3" } else { "I6" };
                    illegal(name, &format!("cannot follow {before:?} of attempt {attempts}"));
                }
                if *next == Leased {
                    running.push(*attempt);
                } else {
                    running.clear();
                }
                tasks.insert(*task, (*next, attempts.max(*attempt), running));
            }
            EventBody::Checkpoint { task, attempt, .. } => {
                let runs = tasks.get(task).is_some_and(|(.., running)| running.contains(attempt));
                if cancelled || !runs {
                    illegal("I6", "came while nobody had that attempt");
                }
            }
            EventBody::Updated { .. } | EventBody::Warning { .. } => {}
        }
    }
    if job.job.state == JobState::Succeeded && tasks.values().any(|(change, ..)| *change != TaskChange::Done)
    {
        violations.push(format!("I3: {id} has succeeded, and not all of its tasks are done"));
    }
}

/// I7, I8.
fn budgets(world: &World, job: &JobExport, violations: &mut Vec<String>) {
    let config = world.coordinator_config();
    for task in &job.tasks {
        let spent = [(task.errors, config.max_errors, "errors"), (task.losses, config.max_losses, "losses")];
        for (is, most, what) in spent {
            if is > most {
                violations.push(format!(
                    "I7: {} of {} has {is} {what}, at most {most} may be",
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
    if job.job.state.is_open() {
        violations.push(format!("I8: {} is {:?} at {:?}", job.job.job_id, job.job.state, job.job.stage));
    }
}

/// I3: the merge took each partition once, and what was committed. Gives the model for I12.
fn merges(world: &World, job: &JobExport, found: &mut Found) {
    let id = &job.job.job_id;
    let made = |artifact| job.job.output(artifact);
    let (Some(report), Some(model)) = (made(Artifact::MergeReport), made(Artifact::Model)) else { return };
    let results: Vec<&BlobRef> = job
        .tasks
        .iter()
        .filter_map(|task| match (task.task.stage, &task.state) {
            (Stage::Partition, TaskState::Done { result, .. }) => Some(result),
            _ => None,
        })
        .collect();
    if job.job.state == JobState::Succeeded {
        found.models.push((kind_of(&job.job.config_json), model.digest.clone()));
    }
    for (_, fact) in world.history.facts() {
        if let Fact::Fetched { job: of, model: fetched, .. } = fact
            && of == *id
            && fetched != model.digest
        {
            found
                .violations
                .push(format!("I11: the user of {id} was given {fetched}, and not {}", model.digest));
        }
    }
    let read = |blob: &BlobRef| -> Option<Value> {
        let path = files::path(world, &job.job.tenant, &blob.digest);
        serde_json::from_slice(&std::fs::read(path).ok()?).ok()
    };
    let manifest =
        read(report).and_then(|report| read(&serde_json::from_value(report["manifest"].clone()).ok()?));
    let Some(manifest) = manifest else {
        return found.violations.push(format!("I11: the report of the merge of {id} cannot be read"));
    };
    let merged: Vec<&str> = manifest["partitions"]
        .as_array()
        .map(|all| all.iter().filter_map(|one| one["result"].as_str()).collect())
        .unwrap_or_default();
    let committed: Vec<&str> = results.iter().map(|blob| blob.digest.as_str()).collect();
    if merged != committed {
        found.violations.push(format!("I3: {id} was merged of {merged:?}, committed are {committed:?}"));
    }
}
