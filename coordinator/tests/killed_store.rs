#![cfg(unix)]
#![allow(clippy::unwrap_used)]
//! The store under SIGKILL, with real processes.
//!
//! A child (this binary, executed again) changes the store from several threads and prints a line for every change
//! that was acknowledged. It is killed at a random moment; then the parent opens the store and looks for everything
//! that was ever acknowledged. At the end all jobs must still come to their end: an index that had lost a
//! task, or a lease that nobody takes back, would stop one.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::Duration;

use fathom_coordinator::schedule::{
    EventBody, JobId, JobState, Lease, Peer, Planned, PlannedTask, Rules, TaskChange, TaskId, TaskKind,
    TaskOutput, TaskRecord, TaskState, TaskStats, Tenant,
};
use fathom_coordinator::store::{Claim, JobFilter, JobView, NewJob, SledOptions, SledStore, Store};
use fathom_core::rng::{Stream, random_bits};
use fathom_core::scene::BlobRef;

const LEASE_MS: u64 = 1000;
const T0: u64 = 1_700_000_000_000;
/// Between the clocks of two children: every lease of the first is over for the second.
const ROUND_MS: u64 = 1_000_000;
/// Threads of the child that change the store at the same time.
const WRITERS: u32 = 4;
/// A child that nobody kills ends by itself.
const CHILD_LIVES: Duration = Duration::from_secs(60);
/// No kill comes later after the first acknowledgement of a child.
const LATEST_KILL_MS: u32 = 250;

const DIR: &str = "FATHOM_TEST_KILLED_STORE";
const ROUND: &str = "FATHOM_TEST_KILLED_STORE_ROUND";

#[test]
fn what_was_acknowledged_survives_sigkill() {
    kill_again_and_again(6);
}

#[test]
#[ignore = "takes minutes"]
fn what_was_acknowledged_survives_hundreds_of_sigkills() {
    kill_again_and_again(300);
}

/// The child. Alone it has nothing to do.
#[test]
#[ignore = "started by the other tests, as the process that they kill"]
fn child() {
    let (Ok(dir), Ok(round)) = (std::env::var(DIR), std::env::var(ROUND)) else { return };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    // Ends the line in which the harness may have begun to name this test.
    println!();
    runtime.block_on(change_until_killed(Path::new(&dir), round.parse().unwrap()));
}

fn kill_again_and_again(rounds: u32) {
    let dir = tempfile::tempdir().unwrap();
    let mut known = Acknowledged::default();
    let mut round = 0;
    // A slow disk acknowledges little in a round.
    while round < rounds || (known.completed.len() < 10 && round < 10 * rounds) {
        let lines = run_and_kill(dir.path(), round);
        let acknowledged_before = known.count;
        let fence_before = known.last_fence();
        for line in &lines {
            known.add(line, fence_before);
        }
        assert!(known.count > acknowledged_before, "round {round}: nothing was acknowledged");
        block_on(async { known.check(&open(dir.path()), round).await });
        round += 1;
    }
    assert!(known.completed.len() >= 10, "only {} results were acknowledged", known.completed.len());
    block_on(finish_all_jobs(&open(dir.path()), &known, u64::from(round)));
}

/// Runs a child and kills it a random time after its first acknowledgement; gives what it acknowledged.
fn run_and_kill(dir: &Path, round: u32) -> Vec<String> {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child", "--ignored", "--nocapture"])
        .env(DIR, dir)
        .env(ROUND, round.to_string())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let stdout = child.stdout.take().unwrap();
    let (started, first) = channel();
    let reader = std::thread::spawn(move || {
        let mut lines = Vec::new();
        for line in BufReader::new(stdout).lines() {
            if let Some(line) = line.unwrap().strip_prefix("ack ") {
                // The parent may wait no longer; the line counts nevertheless.
                let _ = started.send(());
                lines.push(line.to_owned());
            }
        }
        lines
    });
    let is_alive = first.recv_timeout(CHILD_LIVES).is_ok();
    let pause_ms = random_bits(round, Stream::Test, 0, 0)[0] % LATEST_KILL_MS;
    std::thread::sleep(Duration::from_millis(pause_ms.into()));
    child.kill().unwrap();
    let status = child.wait().unwrap();
    assert!(is_alive, "round {round}: the child acknowledged nothing");
    assert_eq!(status.signal(), Some(9), "round {round}: the child ended by itself: {status}");
    reader.join().unwrap()
}

/// All that any child acknowledged.
#[derive(Default)]
struct Acknowledged {
    count: usize,
    /// Job by request.
    submitted: BTreeMap<String, JobId>,
    /// Task by fence.
    claimed: BTreeMap<u64, (JobId, TaskId)>,
    /// Iteration of the latest checkpoint.
    checkpoints: BTreeMap<(JobId, TaskId), u32>,
    /// Digest of the result.
    completed: BTreeMap<(JobId, TaskId), String>,
}

impl Acknowledged {
    fn last_fence(&self) -> u64 {
        self.claimed.last_key_value().map_or(0, |(fence, _)| *fence)
    }

    fn add(&mut self, line: &str, fence_before: u64) {
        self.count += 1;
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["submit", request, job] => {
                self.submitted.insert(request.to_owned(), job.parse().unwrap());
            }
            ["claim", job, task, fence] => {
                let fence: u64 = fence.parse().unwrap();
                assert!(fence > fence_before, "{line}: {fence_before} was granted to an earlier process");
                let other = self.claimed.insert(fence, (job.parse().unwrap(), task.parse().unwrap()));
                assert!(other.is_none(), "{line}: the fence was granted before, for {other:?}");
            }
            ["checkpoint", job, task, iteration] => {
                let key = (job.parse().unwrap(), task.parse().unwrap());
                self.checkpoints.insert(key, iteration.parse().unwrap());
            }
            ["complete", job, task, digest] => {
                let key = (job.parse().unwrap(), task.parse().unwrap());
                let other = self.completed.insert(key, digest.to_owned());
                assert!(other.is_none(), "{line}: it was completed before, with {other:?}");
            }
            _ => panic!("the child said {line:?}"),
        }
    }

    async fn check(&self, store: &SledStore, round: u32) {
        for (request, job) in &self.submitted {
            let again = store.submit(new_job(request, JobId::new(0, 0)), T0).await.unwrap();
            assert_eq!(again.job_id, *job, "round {round}: {request} was forgotten");
        }
        // One writer's claim may be acknowledged before another's submission of its job.
        let claimed = self.claimed.values().map(|(job, _)| job);
        let jobs: BTreeSet<&JobId> = self.submitted.values().chain(claimed).collect();
        let mut views: BTreeMap<&JobId, JobView> = BTreeMap::new();
        for job in jobs {
            let view = store.job(job).await.unwrap();
            let events = store.events(job, 0, 10_000).await.unwrap();
            let numbers: Vec<u64> = events.iter().map(|event| event.seq).collect();
            assert_eq!(
                numbers,
                (1..=view.job.last_seq).collect::<Vec<_>>(),
                "round {round}: events of {job}"
            );
            let tells_done = |task: &TaskId| {
                events.iter().any(|event| {
                    matches!(&event.body, EventBody::Task { task: of, state: TaskChange::Done, .. } if of == task)
                })
            };
            for (record, _) in &view.tasks {
                let is_done = matches!(record.state, TaskState::Done { .. });
                assert_eq!(is_done, tells_done(&record.task), "round {round}: {job} {}", record.task);
            }
            views.insert(job, view);
        }
        let task = |job: &JobId, task: &TaskId| -> &TaskRecord {
            let view =
                views.get(job).unwrap_or_else(|| panic!("round {round}: {job} was never acknowledged"));
            let found = view.tasks.iter().map(|(record, _)| record).find(|record| record.task == *task);
            found.unwrap_or_else(|| panic!("round {round}: {job} has lost {task}"))
        };
        for (fence, (job, id)) in &self.claimed {
            let found = task(job, id).fence;
            assert!(
                found >= *fence,
                "round {round}: {job} {id}: fence {fence} was granted, {found} is stored"
            );
        }
        for ((job, id), iteration) in &self.checkpoints {
            let found = task(job, id).checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.iteration);
            assert!(
                found >= *iteration,
                "round {round}: {job} {id}: checkpoint {iteration}, {found} is stored"
            );
        }
        for ((job, id), digest) in &self.completed {
            if let TaskId::Refine(index) = id {
                let input = task(job, &TaskId::Partition(*index)).input.as_ref().map(|blob| &blob.digest);
                assert_eq!(
                    input,
                    Some(digest),
                    "round {round}: {job}: partition {index} goes on from something else"
                );
            }
            if *id == TaskId::Consensus {
                let found = views[job].job.consensus.as_ref().map(|blob| &blob.digest);
                assert_eq!(found, Some(digest), "round {round}: {job} has another consensus");
            }
            // The model of a job is that of its merge until its borders are refined.
            let replaced = |(task, _): &(TaskRecord, _)| {
                task.task == TaskId::Borders && matches!(task.state, TaskState::Done { .. })
            };
            if *id == TaskId::Borders || (*id == TaskId::Merge && !views[job].tasks.iter().any(replaced)) {
                let found = views[job].job.merged_model.as_ref().map(|blob| &blob.digest);
                assert_eq!(found, Some(digest), "round {round}: {job} has another model");
            }
            let state = &task(job, id).state;
            let holds = matches!(state, TaskState::Done { result, .. } if result.digest == *digest);
            assert!(holds, "round {round}: {job} {id}: {digest} was acknowledged, {state:?} is stored");
        }
    }
}

/// What a child does: takes up what its predecessor left, makes new jobs and works on all.
async fn change_until_killed(dir: &Path, round: u64) {
    let store = Arc::new(open(dir));
    let now_ms = T0 + round * ROUND_MS;
    store.recover(now_ms).await.unwrap();
    store.sweep(now_ms + LEASE_MS).await.unwrap();
    let writers = (0..WRITERS).map(|writer| tokio::spawn(write(Arc::clone(&store), round, writer)));
    let all = futures::future::join_all(writers);
    // Nothing ends a writer but an error.
    if let Ok(ended) = tokio::time::timeout(CHILD_LIVES, all).await {
        panic!("{ended:?}");
    }
}

async fn write(store: Arc<SledStore>, round: u64, writer: u32) {
    let now_ms = T0 + round * ROUND_MS + LEASE_MS;
    for turn in 0_u32.. {
        let request = format!("request-{round}-{writer}-{turn}");
        let job = store.submit(new_job(&request, JobId::new(now_ms, (writer << 16) + turn)), now_ms).await;
        println!("ack submit {request} {}", job.unwrap().job_id);
        for step in 0..8 {
            let claim = claim(format!("claim-{round}-{writer}-{turn}-{step}"));
            let Some(grant) = store.claim(&claim, now_ms).await.unwrap() else { continue };
            let Lease { job, task, fence, .. } = &grant.lease;
            println!("ack claim {job} {task} {fence}");
            if TaskKind::WORKER.contains(&task.kind()) {
                let iteration = *fence as u32;
                let checkpoint = blob(&format!("checkpoint under {fence}"));
                store.checkpoint(&grant.lease, checkpoint, iteration, now_ms).await.unwrap();
                println!("ack checkpoint {job} {task} {iteration}");
            }
            let output = output(*task, *fence);
            let digest = digest_of(&output).to_owned();
            store.complete(&grant.lease, output, now_ms).await.unwrap();
            println!("ack complete {job} {task} {digest}");
        }
    }
}

/// Takes back what the dead held and does all that is left.
async fn finish_all_jobs(store: &SledStore, known: &Acknowledged, round: u64) {
    let now_ms = T0 + round * ROUND_MS;
    store.recover(now_ms).await.unwrap();
    let now_ms = now_ms + LEASE_MS;
    store.sweep(now_ms).await.unwrap();
    let mut last_fence = known.last_fence();
    for turn in 0.. {
        let Some(grant) = store.claim(&claim(format!("last-{turn}")), now_ms).await.unwrap() else { break };
        let fence = grant.lease.fence;
        assert!(fence > last_fence, "fence {fence} after {last_fence}");
        last_fence = fence;
        store.complete(&grant.lease, output(grant.lease.task, fence), now_ms).await.unwrap();
    }
    for job in store.list(&JobFilter::default(), None, 100_000).await.unwrap() {
        assert_eq!(job.state, JobState::Succeeded, "{} stands at {:?}", job.job_id, job.stage);
    }
    known.check(store, u32::MAX).await;
    let jobs = store.list(&JobFilter::default(), None, 100_000).await.unwrap();
    let refined = jobs.iter().filter(|job| job.consensus.is_some()).count();
    let bordered = jobs.iter().filter(|job| job.shape.is_some_and(|shape| shape.borders)).count();
    assert!(bordered > 0 && bordered < jobs.len(), "{bordered} of {} jobs refined their borders", jobs.len());
    assert!(refined > 0 && refined < jobs.len(), "{refined} of {} jobs refined their water", jobs.len());
}

fn block_on<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
}

fn open(dir: &Path) -> SledStore {
    // Many kills must not spend a task's budget.
    let rules = Rules { max_losses: 1_000_000, backoff_ms: 0, ..Rules::default() };
    SledStore::open(&SledOptions { dir: dir.to_owned(), rules, lease_ms: LEASE_MS, stall_ms: 0 }).unwrap()
}

fn blob(name: &str) -> BlobRef {
    BlobRef { digest: blake3::hash(name.as_bytes()).to_hex().to_string(), bytes: name.len() as u64 }
}

fn new_job(request: &str, job_id: JobId) -> NewJob {
    NewJob {
        job_id,
        tenant: Tenant::default(),
        request_id: request.to_owned(),
        name: request.to_owned(),
        config_json: "{}".into(),
        manifest: blob("manifest"),
        dataset: None,
        ingest_seconds: 0.0,
        priority: 0,
        max_parallel: 0,
    }
}

fn claim(request_id: String) -> Claim {
    let kinds = [TaskKind::OWN, TaskKind::WORKER].concat();
    let worker =
        Peer { name: "writer".into(), incarnation: "child".into(), kinds, memory_bytes: None, tenant: None };
    Claim { worker, peers: Default::default(), request_id }
}

/// A result that no other lease would hand in.
fn output(task: TaskId, fence: u64) -> TaskOutput {
    let result = blob(&format!("result of {task} under {fence}"));
    let planned = |name: &str| PlannedTask { spec: blob(name), iterations: 10, memory_bytes: 0 };
    match task {
        TaskId::Plan => TaskOutput::Plan(Box::new(Planned {
            plan: result,
            picture: blob("picture"),
            global: None,
            select: false,
            // Every other job has two tasks a partition, and a consensus between.
            refine: if fence.is_multiple_of(2) {
                vec![planned("first of left"), planned("first of right")]
            } else {
                Vec::new()
            },
            partitions: vec![planned("left"), planned("right")],
            // Every third one refines its borders.
            borders: fence.is_multiple_of(3).then(|| planned("borders")),
            evaluate: Some(blob("evaluate")),
            warnings: Vec::new(),
        })),
        TaskId::Merge => {
            TaskOutput::Merged { model: result, report: blob("report"), stats: TaskStats::default() }
        }
        _ => TaskOutput::Blob { blob: result, stats: TaskStats::default() },
    }
}

fn digest_of(output: &TaskOutput) -> &str {
    match output {
        TaskOutput::Plan(planned) => &planned.plan.digest,
        TaskOutput::Chosen(chosen) => &chosen.plan.digest,
        TaskOutput::Merged { model, .. } => &model.digest,
        TaskOutput::Blob { blob, .. } => &blob.digest,
    }
}
