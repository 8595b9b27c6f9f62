//! Requirements on every store, tested with each; `restart.rs` and `sync.rs` have those of a store on disk,
//! `postgres_only.rs` those of a database that several processes use.

mod datasets;
mod leases;
mod postgres_only;
mod restart;
mod stages;
mod steering;
mod stragglers;
mod sync;
mod tenants;

#[path = "../../../../tests/support/postgres.rs"]
pub(crate) mod postgres_server;

use std::collections::BTreeMap;
use std::sync::Arc;

use fathom_core::scene::BlobRef;

use self::datasets::*;
use self::leases::*;
use self::stages::*;
use self::steering::*;
use self::stragglers::*;
use self::tenants::*;
use super::*;
use crate::references::references;
use crate::schedule::{Artifact, Planned, PlannedTask, Refusal, Rules, Stage, TaskStats};

const LEASE_MS: u64 = 1000;
const STALL_MS: u64 = 60_000;
const T0: u64 = 1_700_000_000_000;

fn rules() -> Rules {
    Rules { backoff_ms: 100, ..Rules::default() }
}

fn blob(name: &str) -> BlobRef {
    BlobRef { digest: blake3::hash(name.as_bytes()).to_hex().to_string(), bytes: name.len() as u64 }
}

fn new_job(number: u32) -> NewJob {
    NewJob {
        announce: false,
        job_id: JobId::new(T0 + u64::from(number), number),
        request_id: format!("request-{number}"),
        name: format!("job {number}"),
        manifest: blob("manifest"),
        ..NewJob::sample(number)
    }
}

fn peer(name: &str, stages: &[Stage], memory_bytes: Option<u64>) -> WorkerProfile {
    WorkerProfile {
        tenant: None,
        name: name.into(),
        incarnation: format!("{name}-incarnation"),
        stages: stages.to_vec(),
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes,
    }
}

fn claim_as(worker: &str, request: &str, stages: &[Stage]) -> Claim {
    Claim { worker: peer(worker, stages, None), peers: Arc::default(), request_id: request.into() }
}

fn planned(partitions: usize) -> TaskOutput {
    planned_as(partitions, false)
}

fn planned_as(partitions: usize, has_first_parts: bool) -> TaskOutput {
    let task = |name: String| PlannedTask::new(blob(&name), 100);
    let own = |stage: Stage| (stage.task(), PlannedTask::default());
    let mut tasks = BTreeMap::from([own(Stage::Merge), own(Stage::Artifacts)]);
    tasks.insert(Stage::Evaluate.task(), PlannedTask::new(blob("evaluate"), 0));
    if partitions > 1 {
        tasks.insert(Stage::Global.task(), task("global".into()));
    }
    tasks.extend(has_first_parts.then(|| own(Stage::Exchange)));
    for index in 0..partitions {
        if has_first_parts {
            tasks.insert(Stage::FirstPart.task_of(index as u32), task(format!("first of {index}")));
        }
        tasks.insert(Stage::Partition.task_of(index as u32), task(format!("partition {index}")));
    }
    let planned = Planned { tasks, warnings: vec!["a warning".into()] };
    TaskOutput::planned(blob("plan"), blob("picture"), planned)
}

/// A plan of two partitions, with another task added or replaced.
fn planned_and(task: TaskId, planned_task: PlannedTask) -> TaskOutput {
    let mut output = planned(2);
    output.planned.as_mut().unwrap().tasks.insert(task, planned_task);
    output
}

/// The result of a task by its name.
fn result_of(task: TaskId) -> TaskOutput {
    result_as(task.stage, &task.to_string())
}

fn result_as(stage: Stage, name: &str) -> TaskOutput {
    let stats = TaskStats { iterations: 100, ..TaskStats::default() };
    match stage {
        Stage::Merge => TaskOutput::merged(blob(name), blob("report"), stats),
        stage => TaskOutput::of(stage, blob(name), stats),
    }
}

fn every_stage() -> Vec<Stage> {
    Stage::all().collect()
}

fn merged() -> TaskOutput {
    TaskOutput::merged(blob("model"), blob("report"), TaskStats::default())
}

fn is_stale<T: std::fmt::Debug>(result: Result<T, StoreError>) -> bool {
    matches!(result, Err(StoreError::Refused(Refusal::StaleFence { .. })))
}

fn is_refused<T>(answer: &Result<T, StoreError>) -> bool {
    matches!(answer, Err(StoreError::Refused(_)))
}

async fn cancel(store: &dyn Store, id: &JobId, reason: &str, now_ms: u64) -> Result<JobView, StoreError> {
    store.steer(id, Event::Cancel { reason: reason.to_owned() }, now_ms).await
}

async fn claim(store: &dyn Store, stages: &[Stage], now_ms: u64) -> Option<Grant> {
    // A request id that is never repeated.
    let request = uuid::Uuid::new_v4().to_string();
    store.claim(&claim_as("worker", &request, stages), now_ms).await.unwrap()
}

/// Submits a job and plans it.
async fn planned_job(store: &dyn Store, number: u32, partitions: usize) -> JobId {
    job_of(store, number, planned(partitions)).await
}

async fn job_of(store: &dyn Store, number: u32, plan: TaskOutput) -> JobId {
    let id = store.submit(new_job(number), T0).await.unwrap().job_id;
    let grant = claim(store, &[Stage::Plan], T0).await.unwrap();
    assert_eq!(grant.lease.job, id);
    store.complete(&grant.lease, plan, T0 + 10).await.unwrap();
    id
}

/// Takes the next task, which is `task`, and submits a result under its name.
async fn do_next(store: &dyn Store, task: TaskId, now_ms: u64) -> Grant {
    let grant = claim(store, &every_stage(), now_ms).await.expect("work");
    assert_eq!(grant.lease.task, task);
    store.complete(&grant.lease, result_as(grant.lease.task.stage, &task.to_string()), now_ms).await.unwrap();
    grant
}

async fn levels_follow_what_happens_to_jobs_tasks_and_leases(store: Arc<dyn Store>) {
    use JobState::{Cancelled, Paused, Running};
    let store = store.as_ref();
    assert_eq!(store.levels().await.unwrap(), Levels::default());
    let id = planned_job(store, 1, 2).await;
    let other = store.submit(new_job(2), T0 + 20).await.unwrap().job_id;
    // Neither a repeated request nor a repeated pause counts twice.
    store.submit(new_job(2), T0 + 21).await.unwrap();
    let held = claim(store, &[Stage::Global], T0 + 30).await.unwrap().lease;
    let at = |iterations_per_second| Some(LiveProgress { iterations_per_second, ..LiveProgress::default() });
    store.renew(&held, at(2.5), T0 + 40).await.unwrap();
    let expected = Levels {
        jobs: [(Running, 2)].into(),
        ready: [(Stage::Plan, 1)].into(),
        oldest_ready_ms: Some(T0 + 20),
        leased: [(Stage::Global, 1)].into(),
        iterations_per_second: 2.5,
    };
    assert_eq!(store.levels().await.unwrap(), expected);
    // NaN is not summed.
    store.renew(&held, at(f32::NAN), T0 + 50).await.unwrap();
    for _ in 0..2 {
        store.steer(&other, Event::Pause { reason: String::new() }, T0 + 60).await.unwrap();
    }
    let expected = Levels {
        jobs: [(Running, 1), (Paused, 1)].into(),
        leased: [(Stage::Global, 1)].into(),
        ..Levels::default()
    };
    assert_eq!(store.levels().await.unwrap(), expected);
    store.recover(T0 + 70).await.unwrap();
    assert_eq!(store.levels().await.unwrap(), expected, "after a restart");
    store.complete(&held, result_as(held.task.stage, "global"), T0 + 80).await.unwrap();
    let levels = store.levels().await.unwrap();
    assert_eq!((levels.ready, levels.oldest_ready_ms), ([(Stage::Partition, 2)].into(), Some(T0 + 80)));
    cancel(store, &id, "", T0 + 90).await.unwrap();
    cancel(store, &other, "", T0 + 90).await.unwrap();
    store.delete(&other).await.unwrap();
    let expected = Levels { jobs: [(Cancelled, 1)].into(), ..Levels::default() };
    assert_eq!(store.levels().await.unwrap(), expected);
}

async fn one_request_makes_one_job(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let first = store.submit(new_job(1), T0).await.unwrap();
    let again = NewJob { job_id: JobId::new(T0 + 99, 99), ingest_seconds: 9.0, ..new_job(1) };
    assert_eq!(store.submit(again, T0 + 99).await.unwrap(), first);
    let other = NewJob { name: "another".into(), ..new_job(1) };
    assert!(matches!(store.submit(other, T0).await, Err(StoreError::RequestIdReused { .. })));
    let second = store.submit(new_job(2), T0 + 2).await.unwrap();
    let listed: Vec<JobId> = store
        .list(&JobFilter::default(), None, 10)
        .await
        .unwrap()
        .into_iter()
        .map(|job| job.job_id)
        .collect();
    assert_eq!(listed, [second.job_id.clone(), first.job_id.clone()], "the newest first");
    let older = store.list(&JobFilter::default(), Some(&second.job_id), 10).await.unwrap();
    assert_eq!(older, std::slice::from_ref(&first));
}

async fn a_cancelled_job_gives_and_takes_nothing_more(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 2).await;
    let lease = claim(store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    let view = cancel(store, &id, "no longer needed", T0 + 30).await.unwrap();
    assert_eq!((view.job.state, view.job.error.as_str()), (JobState::Cancelled, "no longer needed"));
    assert_eq!(cancel(store, &id, "again", T0 + 31).await.unwrap().job, view.job);
    assert_eq!(store.renew(&lease, None, T0 + 32).await.unwrap(), Renewed::Over);
    assert!(store.complete(&lease, result_as(lease.task.stage, "late"), T0 + 33).await.is_err());
    assert!(claim(store, &Stage::of_workers(), T0 + 40).await.is_none());
    assert!(store.sweep(T0 + 100_000).await.unwrap().is_empty());
    let unknown = JobId::new(0, 0);
    assert!(matches!(cancel(store, &unknown, "", T0).await, Err(StoreError::JobNotFound(_))));
}

async fn progress_is_seen_and_belongs_to_the_lease(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 1).await;
    let lease = claim(store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    let live = LiveProgress { iteration: 50, iterations: 100, ..LiveProgress::default() };
    assert_eq!(store.renew(&lease, Some(live), T0 + 30).await.unwrap(), Renewed::Runs);
    let (tasks, share) = store.progress(&id).await.unwrap();
    assert_eq!(tasks, [(Stage::Partition.task_of(0), live)]);
    assert!((share - 0.495).abs() < 1e-9, "{share}");
    store.sweep(T0 + 5000).await.unwrap();
    assert_eq!(store.progress(&id).await.unwrap(), (Vec::new(), 0.0));
}

async fn a_task_goes_to_workers_with_enough_memory_and_raises_it(store: Arc<dyn Store>) {
    const GIB: u64 = 1 << 30;
    let store = store.as_ref();
    let large = PlannedTask { memory_bytes: 6 * GIB, ..PlannedTask::new(blob("partition 0"), 100) };
    let id = job_of(store, 1, planned_and(Stage::Partition.task_of(0), large)).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    let peers: Arc<[WorkerProfile]> = [
        ("small", Some(4 * GIB)),
        ("large", Some(8 * GIB)),
        ("larger", Some(10 * GIB)),
        ("largest", Some(12 * GIB)),
    ]
    .map(|(name, memory)| peer(name, &Stage::of_workers(), memory))
    .into();
    let claim_by = async |worker: usize, now_ms: u64| {
        let (worker, peers) = (peers[worker].clone(), Arc::clone(&peers));
        let claim = Claim { worker, peers, request_id: uuid::Uuid::new_v4().to_string() };
        store.claim(&claim, now_ms).await.unwrap().map(|grant| grant.lease)
    };
    let ready = store.ready().await.unwrap();
    let needs: Vec<(TaskId, u64)> =
        ready.iter().map(|ready| (ready.need.task, ready.need.memory_bytes)).collect();
    assert_eq!(needs, [(Stage::Partition.task_of(0), 6 * GIB), (Stage::Partition.task_of(1), 0)]);
    let other = claim_by(0, T0 + 30).await.unwrap();
    assert_eq!(other.task, Stage::Partition.task_of(1), "assigned to a worker without enough memory");
    store.complete(&other, result_as(other.task.stage, "partition-0001"), T0 + 31).await.unwrap();
    assert!(claim_by(0, T0 + 32).await.is_none());
    let lease = claim_by(1, T0 + 33).await.unwrap();
    store.fail(&lease, FailClass::OutOfMemory, "needs more".into(), T0 + 34).await.unwrap();
    // A quarter more than the insufficient amount.
    assert_eq!(store.ready().await.unwrap()[0].need.memory_bytes, 10 * GIB);
    assert!(claim_by(1, T0 + 500).await.is_none());
    // A fault of another class requires another worker, but no more memory.
    let lease = claim_by(2, T0 + 500).await.unwrap();
    store.fail(&lease, FailClass::Training, "a fault".into(), T0 + 501).await.unwrap();
    assert!(claim_by(2, T0 + 2000).await.is_none(), "the worker that failed it retook it before another");
    let lease = claim_by(3, T0 + 2000).await.unwrap();
    assert_eq!((lease.task, lease.attempt), (Stage::Partition.task_of(0), 3));
    store.complete(&lease, result_as(lease.task.stage, "partition-0000"), T0 + 2001).await.unwrap();
    assert_eq!(store.job(&id).await.unwrap().job.stage, Stage::Merge);
}

async fn a_stalled_worker_loses_its_task_and_a_job_may_be_given_up(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 1).await;
    let lease = claim(store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    let live = LiveProgress { iteration: 50, iterations: 100, ..LiveProgress::default() };
    for now_ms in (T0 + 500..=T0 + STALL_MS).step_by(500) {
        assert_eq!(store.renew(&lease, Some(live), now_ms).await.unwrap(), Renewed::Runs);
        assert!(store.sweep(now_ms).await.unwrap().is_empty(), "{}", now_ms - T0);
    }
    store.renew(&lease, Some(live), T0 + STALL_MS + 500).await.unwrap();
    let swept = store.sweep(T0 + STALL_MS + 500).await.unwrap();
    assert_eq!(swept, [(lease.clone(), Expired::Stalled)]);
    assert_eq!(store.renew(&lease, Some(live), T0 + STALL_MS + 600).await.unwrap(), Renewed::Over);
    let view = store.job(&id).await.unwrap();
    let task = view.tasks.iter().find(|(task, _)| task.task == lease.task).unwrap();
    assert_eq!(task.0.losses, 1);
    assert!(task.0.last_errors[0].contains("makes no progress"), "{:?}", task.0.last_errors);

    let reason = "no worker has enough memory".to_owned();
    let given_up = store.steer(&id, Event::GiveUp { reason: reason.clone() }, T0 + 70_000).await.unwrap();
    assert_eq!((given_up.job.state, &given_up.job.error), (JobState::Failed, &reason));
    let resumed = store.steer(&id, Event::Retry, T0 + 70_001).await.unwrap();
    assert_eq!(resumed.job.state, JobState::Running);
}

async fn marks_of_workers_are_kept_and_leases_name_their_holders(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let mark = |drains| WorkerMark { drains, reason: "a fan is broken".into(), since_ms: T0 };
    store.mark_worker("one", Some(&mark(false))).await.unwrap();
    store.mark_worker("two", Some(&mark(false))).await.unwrap();
    store.mark_worker("two", Some(&mark(true))).await.unwrap();
    store.mark_worker("one", None).await.unwrap();
    store.mark_worker("unknown", None).await.unwrap();
    assert_eq!(store.worker_marks().await.unwrap(), [("two".to_owned(), mark(true))]);
    planned_job(store, 1, 1).await;
    assert!(store.leased().await.unwrap().is_empty());
    let grant = claim(store, &Stage::of_workers(), T0 + 20).await.unwrap();
    let leased = store.leased().await.unwrap();
    assert_eq!(leased.len(), 1);
    assert_eq!((&leased[0].0, leased[0].1.incarnation.as_str()), (&grant.lease, "worker-incarnation"));
}

async fn an_export_is_complete_and_continues_in_another_store(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 3).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    let held = claim(store, &Stage::of_workers(), T0 + 30).await.unwrap().lease;
    store.checkpoint(&held, blob("checkpoint"), 40, T0 + 31).await.unwrap();
    let deleted = planned_job(store, 2, 1).await;
    cancel(store, &deleted, "", T0 + 40).await.unwrap();
    store.delete(&deleted).await.unwrap();
    let export = store.export().await.unwrap();
    assert_eq!(verify::faults(&export), Vec::<String>::new());
    assert_eq!((export.jobs.len(), export.jobs[0].tasks.len()), (1, 8));
    assert_eq!(export.taken_requests, [("request-2".to_owned(), deleted)]);
    let named = references(&export.jobs[0].job, &export.jobs[0].tasks);
    assert!(named.iter().any(|named| *named.blob == blob("checkpoint") && !named.names_others));
    let refused = store.import(&export).await;
    assert!(matches!(refused, Err(StoreError::NotEmpty)), "{refused:?}");

    let dir = tempfile::tempdir().unwrap();
    let sled = open(dir.path());
    let others: [&dyn Store; 2] = [&MemoryStore::new(rules(), LEASE_MS, STALL_MS), &sled];
    for other in others {
        other.import(&export).await.unwrap();
        assert_eq!(other.export().await.unwrap(), export);
        other.recover(T0 + 100).await.unwrap();
        store_goes_on(other, &id, &held).await;
    }
    assert_eq!(sled.index_faults().unwrap(), Vec::<String>::new());
}

/// The held lease continues, nothing is granted twice, and no request makes a second job.
async fn store_goes_on(store: &dyn Store, id: &JobId, held: &Lease) {
    assert_eq!(store.renew(held, None, T0 + 110).await.unwrap(), Renewed::Runs);
    let next = claim(store, &Stage::of_workers(), T0 + 120).await.unwrap().lease;
    assert!(next.fence > held.fence && next.job == *id, "{next:?}");
    store.complete(held, result_of(held.task), T0 + 130).await.unwrap();
    assert_eq!(store.submit(new_job(1), T0 + 140).await.unwrap().job_id, *id);
    assert!(matches!(store.submit(new_job(2), T0 + 141).await, Err(StoreError::RequestIdReused { .. })));
    assert_eq!(verify::faults(&store.export().await.unwrap()), Vec::<String>::new());
}

fn options(dir: &std::path::Path) -> SledOptions {
    SledOptions { dir: dir.to_owned(), rules: rules(), lease_ms: LEASE_MS, stall_ms: STALL_MS }
}

fn open(dir: &std::path::Path) -> SledStore {
    let options = options(dir);
    let is_busy = |error: &StoreError| matches!(error, StoreError::InUse { .. });
    when_free(|| SledStore::open(&options), is_busy)
}

/// A store in PostgreSQL with the times of the tests.
async fn open_postgres(url: &str) -> PostgresStore {
    let options = PostgresOptions {
        url: url.to_owned(),
        rules: rules(),
        lease_ms: LEASE_MS,
        stall_ms: STALL_MS,
        connections: 8,
    };
    PostgresStore::open_with_own_clock(&options).await.unwrap()
}

/// Retries `open` until it succeeds: sled's threads release a directory a moment after its last handle is
/// dropped.
fn when_free<T, E: std::fmt::Debug>(open: impl Fn() -> Result<T, E>, is_busy: impl Fn(&E) -> bool) -> T {
    let begin = std::time::Instant::now();
    loop {
        match open() {
            Err(error) if is_busy(&error) && begin.elapsed().as_secs() < 20 => {
                std::thread::sleep(std::time::Duration::from_millis(20));
            }
            opened => return opened.unwrap(),
        }
    }
}

macro_rules! conformance {
    ($($name:ident),* $(,)?) => {
        mod memory {
            $(#[tokio::test]
            async fn $name() {
                super::$name(Arc::new(MemoryStore::new(rules(), LEASE_MS, STALL_MS))).await;
            })*
            use super::*;
        }
        mod sled {
            $(#[tokio::test]
            async fn $name() {
                let dir = tempfile::tempdir().unwrap();
                super::$name(Arc::new(open(dir.path()))).await;
            })*
            use super::*;
        }
        mod postgres {
            $(#[tokio::test]
            async fn $name() {
                let Some(url) = postgres_server::database() else { return };
                super::$name(Arc::new(open_postgres(&url).await)).await;
            })*
            use super::*;
        }
    };
}

conformance!(
    a_job_goes_through_all_its_stages,
    one_request_makes_one_job,
    a_silent_worker_loses_its_lease_and_late_messages_fail,
    every_message_may_arrive_twice,
    budgets_end_a_poisoned_job,
    a_cancelled_job_gives_and_takes_nothing_more,
    progress_is_seen_and_belongs_to_the_lease,
    partitions_resume_their_first_part_after_one_exchange,
    borders_are_trained_before_evaluation_and_change_the_model,
    an_evaluation_in_parts_ends_with_the_last_of_them,
    a_stage_that_fails_for_good_ends_the_job,
    a_paused_job_assigns_nothing_and_accepts_results,
    the_duration_of_a_stage_excludes_pauses,
    a_retried_job_resumes_where_it_failed,
    the_end_of_a_job_is_announced_by_one_coordinator_once,
    a_deleted_job_is_gone_and_its_request_makes_no_other,
    the_job_with_higher_priority_goes_first_within_limits,
    a_list_has_all_jobs_of_its_filter_page_by_page,
    a_task_goes_to_workers_with_enough_memory_and_raises_it,
    a_stalled_worker_loses_its_task_and_a_job_may_be_given_up,
    an_export_is_complete_and_continues_in_another_store,
    marks_of_workers_are_kept_and_leases_name_their_holders,
    tenants_share_workers_but_not_requests_and_lists,
    a_tenant_stays_within_its_quota,
    tokens_and_quotas_are_kept_and_travel_with_an_export,
    levels_follow_what_happens_to_jobs_tasks_and_leases,
    a_dataset_is_frozen_once_and_its_files_never_change,
    datasets_are_listed_by_page_and_abandoned_uploads_end,
    a_job_is_made_of_a_frozen_dataset_of_its_tenant_and_holds_it,
    datasets_travel_with_an_export,
    a_slow_task_gets_a_second_worker_and_the_first_result_counts,
    one_of_two_attempts_may_fail_and_nothing_is_counted,
    a_second_worker_that_fails_leaves_the_task_to_the_first,
    a_paused_or_ended_job_ends_both_workers_at_a_task,
    open_work_has_the_waiting_and_leased_tasks_of_running_jobs,
);
