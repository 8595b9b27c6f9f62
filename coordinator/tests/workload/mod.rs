//! The workload for a store whose process is killed or whose machine loses power, and the checks afterwards.
#![allow(
    dead_code,
    clippy::unwrap_used,
    reason = "each test file uses a part of this one, and fails by panicking"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use fathom_coordinator::schedule::{
    Artifact, EventBody, JobId, Lease, Planned, PlannedTask, Rules, Stage, TaskChange, TaskId, TaskOutput,
    TaskRecord, TaskState, TaskStats, Tenant, WorkerProfile,
};
use fathom_coordinator::store::{Claim, JobStore, JobView, NewJob, SledOptions, SledStore};
use fathom_core::scene::BlobRef;

pub const LEASE_MS: u64 = 1000;
pub const T0: u64 = 1_700_000_000_000;
/// Between the clocks of two children: every lease of the first is over for the second.
pub const ROUND_MS: u64 = 1_000_000;

/// All that any child acknowledged.
#[derive(Clone, Default)]
pub struct Acknowledged {
    pub count: usize,
    /// Job by request.
    pub submitted: BTreeMap<String, JobId>,
    /// Task by fence.
    pub claimed: BTreeMap<u64, (JobId, TaskId)>,
    /// Iteration of the latest checkpoint.
    pub checkpoints: BTreeMap<(JobId, TaskId), u32>,
    /// Digest of the result.
    pub completed: BTreeMap<(JobId, TaskId), String>,
}

impl Acknowledged {
    pub fn last_fence(&self) -> u64 {
        self.claimed.last_key_value().map_or(0, |(fence, _)| *fence)
    }

    pub fn add(&mut self, line: &str, fence_before: u64) {
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

    pub async fn check(&self, store: &SledStore, round: u32) {
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
            let is_reported_done = |task: &TaskId| {
                events.iter().any(|event| {
                    matches!(&event.body, EventBody::Task { task: of, state: TaskChange::Done, .. } if of == task)
                })
            };
            for (record, _) in &view.tasks {
                let is_done = matches!(record.state, TaskState::Done { .. });
                assert_eq!(is_done, is_reported_done(&record.task), "round {round}: {job} {}", record.task);
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
            if let (Stage::FirstPart, Some(index)) = (id.stage, id.part) {
                let successor = task(job, &Stage::Partition.task_of(index));
                let input = successor.inputs.get(&Artifact::FirstPart).map(|blob| &blob.digest);
                assert_eq!(
                    input,
                    Some(digest),
                    "round {round}: {job}: partition {index} resumes from another result"
                );
            }
            if *id == Stage::Exchange.task() {
                let found = views[job].job.output(Artifact::Exchange).map(|blob| &blob.digest);
                assert_eq!(found, Some(digest), "round {round}: {job} has another exchange");
            }
            // The model of a job is that of its merge until its borders are trained.
            let replaced = |(task, _): &(TaskRecord, _)| {
                task.task == Stage::Borders.task() && matches!(task.state, TaskState::Done { .. })
            };
            if *id == Stage::Borders.task()
                || (*id == Stage::Merge.task() && !views[job].tasks.iter().any(replaced))
            {
                let found = views[job].job.output(Artifact::Model).map(|blob| &blob.digest);
                assert_eq!(found, Some(digest), "round {round}: {job} has another model");
            }
            let state = &task(job, id).state;
            let holds = matches!(state, TaskState::Done { result, .. } if result.digest == *digest);
            assert!(holds, "round {round}: {job} {id}: {digest} was acknowledged, {state:?} is stored");
        }
    }
}

/// Creates jobs and works on all existing ones, for a number of turns; calls `acknowledged` after each
/// durable change.
pub async fn write(
    store: Arc<SledStore>,
    round: u64,
    writer: u32,
    turns: u32,
    acknowledged: impl Fn(String) + Send + Sync,
) {
    let now_ms = T0 + round * ROUND_MS + LEASE_MS;
    for turn in 0..turns {
        let request = format!("request-{round}-{writer}-{turn}");
        let job = store.submit(new_job(&request, JobId::new(now_ms, (writer << 16) + turn)), now_ms).await;
        acknowledged(format!("submit {request} {}", job.unwrap().job_id));
        for step in 0..8 {
            let claim = claim(format!("claim-{round}-{writer}-{turn}-{step}"));
            let Some(grant) = store.claim(&claim, now_ms).await.unwrap() else { continue };
            let Lease { job, task, fence, .. } = &grant.lease;
            acknowledged(format!("claim {job} {task} {fence}"));
            if !task.stage.is_own() {
                let iteration = *fence as u32;
                let checkpoint = blob(&format!("checkpoint under {fence}"));
                store.checkpoint(&grant.lease, checkpoint, iteration, now_ms).await.unwrap();
                acknowledged(format!("checkpoint {job} {task} {iteration}"));
            }
            let output = output(*task, *fence);
            let digest = digest_of(*task, &output).to_owned();
            store.complete(&grant.lease, output, now_ms).await.unwrap();
            acknowledged(format!("complete {job} {task} {digest}"));
        }
    }
}

pub fn block_on<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
}

/// Many kills must not spend a task's budget.
pub fn rules() -> Rules {
    Rules { max_losses: 1_000_000, backoff_ms: 0, ..Rules::default() }
}

pub fn open(dir: &Path) -> SledStore {
    let options = SledOptions { dir: dir.to_owned(), rules: rules(), lease_ms: LEASE_MS, stall_ms: 0 };
    SledStore::open(&options).unwrap()
}

pub fn blob(name: &str) -> BlobRef {
    BlobRef { digest: blake3::hash(name.as_bytes()).to_hex().to_string(), bytes: name.len() as u64 }
}

pub fn new_job(request: &str, job_id: JobId) -> NewJob {
    NewJob {
        announce: false,
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

pub fn claim(request_id: String) -> Claim {
    let stages = Stage::all().collect();
    let worker = WorkerProfile {
        name: "writer".into(),
        incarnation: "child".into(),
        stages,
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes: None,
        tenant: None,
    };
    Claim { worker, peers: Default::default(), request_id }
}

/// A result that is unique to a lease.
pub fn output(task: TaskId, fence: u64) -> TaskOutput {
    let result = blob(&format!("result of {task} under {fence}"));
    match task.stage {
        Stage::Plan => {
            let own = |stage: Stage| (stage.task(), PlannedTask::default());
            let planned = |name: &str| PlannedTask::new(blob(name), 10);
            let mut tasks = BTreeMap::from([own(Stage::Merge), own(Stage::Artifacts)]);
            // Every fifth job is evaluated by two tasks.
            let evaluate = |task: TaskId| (task, PlannedTask::new(blob(&task.to_string()), 0));
            match fence.is_multiple_of(5) {
                true => tasks.extend([1, 2].map(|part| evaluate(Stage::Evaluate.task_of(part)))),
                false => tasks.extend([evaluate(Stage::Evaluate.task())]),
            }
            // Every other job has two tasks a partition, and an exchange between.
            let has_first_parts = fence.is_multiple_of(2);
            tasks.extend(has_first_parts.then(|| own(Stage::Exchange)));
            for (index, side) in ["left", "right"].into_iter().enumerate() {
                if has_first_parts {
                    tasks
                        .insert(Stage::FirstPart.task_of(index as u32), planned(&format!("first of {side}")));
                }
                tasks.insert(Stage::Partition.task_of(index as u32), planned(side));
            }
            // Every third one trains its borders.
            tasks.extend(fence.is_multiple_of(3).then(|| (Stage::Borders.task(), planned("borders"))));
            TaskOutput::planned(result, blob("picture"), Planned { tasks, warnings: Vec::new() })
        }
        Stage::Merge => TaskOutput::merged(result, blob("report"), TaskStats::default()),
        stage => TaskOutput::of(stage, result, TaskStats::default()),
    }
}

pub fn digest_of(task: TaskId, output: &TaskOutput) -> &str {
    output.made.get(&task.stage.result()).map_or("", |result| &result.digest)
}
