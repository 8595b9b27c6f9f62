//! Selects the next task to assign, without reading rows: it knows the waiting and leased tasks of open jobs.
//!
//! The tenant with the fewest leases is served next. Within a tenant, jobs with a higher priority come first,
//! then older ones; this also breaks ties between tenants. A tenant or a job at its limit waits.
//!
//! When no waiting task fits a worker, it may start a second attempt at a slow task (`straggler.rs`), in
//! the same order.
//!
//! A queue is derived from rows: [`Queue::note`] is called with every written row, in order of the writes.
//! The queue itself is not stored.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::fit::may_take;
use super::{
    Attempt, JobId, JobRecord, JobState, Quota, Requirements, Rules, Stage, TaskId, TaskRecord, TaskState,
    Tenant, WorkerProfile, usual_pace_ms,
};

/// All open jobs, with the data needed to assign their tasks.
#[derive(Debug, Default)]
pub struct Queue {
    jobs: BTreeMap<JobId, OpenJob>,
    /// The lease of each call, by process and call: a repeated call gets the same one.
    given: HashMap<Call, (JobId, TaskId)>,
}

/// The call that got a lease.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Call {
    incarnation: String,
    request_id: String,
}

#[derive(Debug)]
struct OpenJob {
    tenant: Tenant,
    runs: bool,
    priority: i32,
    max_parallel: u32,
    ready: BTreeMap<TaskId, Waiting>,
    /// Number of `ready` tasks by stage: a worker that takes none of them need not scan thousands.
    stages: BTreeMap<Stage, usize>,
    leased: BTreeMap<TaskId, Leased>,
    /// Leases of all of these.
    leases: u32,
    /// Milliseconds per iteration of done tasks.
    paces_ms: BTreeMap<TaskId, f64>,
    /// Their median pace by stage, cached: every waiting worker asks, and only done tasks change it.
    usual_paces_ms: BTreeMap<Stage, f64>,
}

/// A running task.
#[derive(Debug)]
struct Leased {
    /// The calls that got its leases: one or two.
    calls: Vec<Call>,
    /// Its requirements on a worker.
    need: Requirements,
    /// Data for a second attempt; `None` if none is allowed.
    alone: Option<Alone>,
}

/// A task with one attempt that may get a second one.
#[derive(Debug)]
struct Alone {
    failed_on: Vec<String>,
    since_ms: u64,
    /// Iterations that its worker has to do.
    iterations: u32,
}

/// An assigned task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Next {
    /// Its job.
    pub job: JobId,
    /// The task.
    pub task: TaskId,
    /// Whether it is a second attempt beside a slow worker.
    pub is_second: bool,
}

/// A waiting task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReadyTask {
    /// Its job.
    pub job: JobId,
    /// Its tenant.
    pub tenant: Tenant,
    /// Its requirements on a worker.
    pub need: Requirements,
    /// Earliest time to take it, Unix milliseconds.
    pub not_before_ms: u64,
}

/// The tasks of a running job, for those who start workers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenWork {
    /// Its tenant.
    pub tenant: Tenant,
    /// See [`JobRecord::max_parallel`].
    pub max_parallel: u32,
    /// Waiting tasks, each with the earliest time to take it, Unix milliseconds.
    pub waiting: Vec<(Requirements, u64)>,
    /// Tasks that are leased, once for each of their leases.
    pub leased: Vec<Requirements>,
}

#[derive(Debug)]
struct Waiting {
    need: Requirements,
    not_before_ms: u64,
    failed_on: Vec<String>,
}

/// Usage of a tenant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage {
    /// Jobs that have not ended.
    pub open_jobs: u32,
    /// Tasks that are leased.
    pub leased_tasks: u32,
}

impl Queue {
    /// Applies written rows: a job and some of its tasks.
    pub fn note<'a>(&mut self, job: &JobRecord, tasks: impl IntoIterator<Item = &'a TaskRecord>) {
        if !job.state.is_open() {
            self.forget(&job.job_id);
            return;
        }
        let known = self.jobs.entry(job.job_id.clone()).or_insert_with(|| OpenJob {
            tenant: job.tenant.clone(),
            runs: false,
            priority: 0,
            max_parallel: 0,
            ready: BTreeMap::new(),
            stages: BTreeMap::new(),
            leased: BTreeMap::new(),
            leases: 0,
            paces_ms: BTreeMap::new(),
            usual_paces_ms: BTreeMap::new(),
        });
        let mut stages_done = BTreeSet::new();
        known.runs = job.state == JobState::Running;
        (known.priority, known.max_parallel) = (job.priority, job.max_parallel);
        for record in tasks {
            for call in known.leased.remove(&record.task).into_iter().flat_map(|leased| leased.calls) {
                known.leases = known.leases.saturating_sub(1);
                self.given.remove(&call);
            }
            let stage = record.task.stage;
            let pace_ms = record.pace_ms();
            let before_ms = match pace_ms {
                Some(pace_ms) => known.paces_ms.insert(record.task, pace_ms),
                None => known.paces_ms.remove(&record.task),
            };
            if before_ms != pace_ms {
                stages_done.insert(stage);
            }
            if known.ready.remove(&record.task).is_some()
                && let Some(count) = known.stages.get_mut(&stage)
            {
                *count = count.saturating_sub(1);
            }
            match &record.state {
                TaskState::Ready { not_before_ms } => {
                    let failed_on = record.failed_on.clone();
                    let waiting = Waiting { need: record.need(), not_before_ms: *not_before_ms, failed_on };
                    known.ready.insert(record.task, waiting);
                    *known.stages.entry(stage).or_default() += 1;
                }
                TaskState::Leased(first) => {
                    let calls: Vec<Call> = record.running().map(Call::of).collect();
                    for call in &calls {
                        self.given.insert(call.clone(), (job.job_id.clone(), record.task));
                    }
                    let alone = record.may_have_second_attempt().then(|| Alone {
                        failed_on: record.failed_on.clone(),
                        since_ms: first.since_ms,
                        iterations: record.iterations_of(first),
                    });
                    known.leases += calls.len() as u32;
                    known.leased.insert(record.task, Leased { calls, need: record.need(), alone });
                }
                _ => {}
            }
        }
        for stage in stages_done {
            known.look_for_usual_pace(stage);
        }
    }

    /// Removes a job.
    pub fn forget(&mut self, job: &JobId) {
        let gone = self.jobs.remove(job);
        let leased = gone.into_iter().flat_map(|job| job.leased.into_values());
        for call in leased.flat_map(|leased| leased.calls) {
            self.given.remove(&call);
        }
    }

    /// The task that this call got before, if it is still leased.
    pub fn given(&self, worker: &WorkerProfile, request_id: &str) -> Option<(JobId, TaskId)> {
        let call = Call { incarnation: worker.incarnation.clone(), request_id: request_id.to_owned() };
        self.given.get(&call).cloned()
    }

    /// The next task for `worker`.
    pub fn next(
        &self,
        worker: &WorkerProfile,
        peers: &[WorkerProfile],
        quota_of: impl Fn(&Tenant) -> Quota,
        now_ms: u64,
        rules: &Rules,
    ) -> Option<Next> {
        let is_taken = |stage: &Stage, count: &usize| *count > 0 && worker.stages.contains(stage);
        let waits = |job: &OpenJob| {
            job.stages.iter().any(|(stage, count)| is_taken(stage, count)) && !job.is_at_its_limit()
        };
        let waiting = self.in_turn(worker, waits, &quota_of);
        let ready = waiting.into_iter().find_map(|(id, job)| {
            let may_go = |waiting: &Waiting| {
                rules.is_due(waiting.not_before_ms, now_ms)
                    && may_take(&job.tenant, waiting.need, &waiting.failed_on, worker, peers)
            };
            let (task, _) = job.ready.iter().find(|(_, waiting)| may_go(waiting))?;
            Some(Next { job: id.clone(), task: *task, is_second: false })
        });
        ready.or_else(|| {
            let has_slow = |job: &OpenJob| job.slow(now_ms, rules).next().is_some() && !job.is_at_its_limit();
            self.in_turn(worker, has_slow, &quota_of).into_iter().find_map(|(id, job)| {
                let may_go = |leased: &Leased, alone: &Alone| {
                    leased.calls.iter().all(|call| call.incarnation != worker.incarnation)
                        && may_take(&job.tenant, leased.need, &alone.failed_on, worker, peers)
                };
                let (task, ..) = job.slow(now_ms, rules).find(|(_, leased, alone)| may_go(leased, alone))?;
                Some(Next { job: id.clone(), task, is_second: true })
            })
        })
    }

    /// Running jobs with a task for `worker`, in order of service.
    fn in_turn(
        &self,
        worker: &WorkerProfile,
        has_work: impl Fn(&OpenJob) -> bool,
        quota_of: impl Fn(&Tenant) -> Quota,
    ) -> Vec<(&JobId, &OpenJob)> {
        let is_one = |job: &OpenJob| job.runs && worker.serves(&job.tenant) && has_work(job);
        let mut candidates: Vec<(&JobId, &OpenJob)> =
            self.jobs.iter().filter(|(_, job)| is_one(job)).collect();
        if candidates.is_empty() {
            return candidates;
        }
        let usage = self.usage();
        let leased = |tenant: &Tenant| usage.get(tenant).map_or(0, |usage| usage.leased_tasks);
        let is_at_its_limit = |tenant: &Tenant| {
            let limit = quota_of(tenant).max_parallel;
            limit > 0 && leased(tenant) >= limit
        };
        candidates.retain(|(_, job)| !is_at_its_limit(&job.tenant));
        candidates.sort_by_key(|(id, job)| (leased(&job.tenant), Reverse(job.priority), *id));
        candidates
    }

    /// Waiting tasks of running jobs, including those in back-off.
    pub fn ready(&self) -> Vec<ReadyTask> {
        let running = self.jobs.iter().filter(|(_, job)| job.runs);
        let tasks = running.flat_map(|(id, job)| job.ready.values().map(move |waiting| (id, job, waiting)));
        let ready = tasks.map(|(id, job, waiting)| ReadyTask {
            job: id.clone(),
            tenant: job.tenant.clone(),
            need: waiting.need,
            not_before_ms: waiting.not_before_ms,
        });
        ready.collect()
    }

    /// The tasks of each running job.
    pub fn open_work(&self) -> Vec<OpenWork> {
        let running = self.jobs.values().filter(|job| job.runs);
        let work = running.map(|job| OpenWork {
            tenant: job.tenant.clone(),
            max_parallel: job.max_parallel,
            waiting: job.ready.values().map(|waiting| (waiting.need, waiting.not_before_ms)).collect(),
            leased: job.leased.values().flat_map(|leased| leased.calls.iter().map(|_| leased.need)).collect(),
        });
        work.collect()
    }

    /// Tasks that are leased, each once.
    pub fn leased(&self) -> Vec<(JobId, TaskId)> {
        let tasks = self.jobs.iter().flat_map(|(id, job)| job.leased.keys().map(move |&task| (id, task)));
        tasks.map(|(id, task)| (id.clone(), task)).collect()
    }

    /// Usage of each tenant with any.
    pub fn usage(&self) -> HashMap<&Tenant, Usage> {
        let mut usage = HashMap::<&Tenant, Usage>::new();
        for job in self.jobs.values() {
            let of_tenant = usage.entry(&job.tenant).or_default();
            of_tenant.open_jobs += 1;
            of_tenant.leased_tasks += job.leases;
        }
        usage
    }

    /// Usage of a tenant.
    pub fn usage_of(&self, tenant: &Tenant) -> Usage {
        self.usage().get(tenant).copied().unwrap_or_default()
    }
}

impl OpenJob {
    /// As [`JobRecord::is_at_its_limit`].
    fn is_at_its_limit(&self) -> bool {
        self.max_parallel > 0 && self.leases >= self.max_parallel
    }

    /// Tasks with a single, slow attempt.
    fn slow(&self, now_ms: u64, rules: &Rules) -> impl Iterator<Item = (TaskId, &Leased, &Alone)> {
        let alone =
            self.leased.iter().filter_map(|(task, leased)| Some((*task, leased, leased.alone.as_ref()?)));
        alone.filter(move |(task, _, alone)| {
            let usual_ms = self.usual_paces_ms.get(&task.stage);
            let from_ms = usual_ms.and_then(|&ms| rules.slow_from_ms(alone.since_ms, alone.iterations, ms));
            from_ms.is_some_and(|from_ms| from_ms <= now_ms)
        })
    }

    fn look_for_usual_pace(&mut self, stage: Stage) {
        let of_stage = self.paces_ms.iter().filter(|(task, _)| task.stage == stage);
        match usual_pace_ms(of_stage.map(|(_, pace_ms)| *pace_ms)) {
            Some(pace_ms) => drop(self.usual_paces_ms.insert(stage, pace_ms)),
            None => drop(self.usual_paces_ms.remove(&stage)),
        }
    }
}

impl Call {
    fn of(attempt: &Attempt) -> Self {
        Self { incarnation: attempt.incarnation.clone(), request_id: attempt.request_id.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Stage;

    const NOW_MS: u64 = 1_700_000_000_000;

    fn worker(tenant: Option<&str>) -> WorkerProfile {
        WorkerProfile {
            name: "worker".into(),
            incarnation: "incarnation".into(),
            stages: vec![Stage::Partition],
            methods: fathom_core::config::Method::ALL.to_vec(),
            memory_bytes: None,
            tenant: tenant.and_then(|tenant| tenant.parse().ok()),
        }
    }

    /// Hand-written jobs with tasks.
    #[derive(Default)]
    struct Rows {
        queue: Queue,
        jobs: BTreeMap<JobId, (JobRecord, BTreeMap<TaskId, TaskRecord>)>,
    }

    impl Rows {
        fn add(&mut self, number: u32, tenant: &str, priority: i32, tasks: u32) -> JobId {
            let new = crate::store::NewJob {
                tenant: tenant.parse().unwrap_or_default(),
                request_id: number.to_string(),
                priority,
                ..crate::store::NewJob::sample(number)
            };
            let (mut job, _) = new.into_rows(NOW_MS);
            job.stage = Stage::Partition;
            let task = |index| TaskRecord {
                state: TaskState::Ready { not_before_ms: NOW_MS },
                ..TaskRecord::new(Stage::Partition.task_of(index), None, 10)
            };
            let tasks: BTreeMap<_, _> = (0..tasks).map(task).map(|record| (record.task, record)).collect();
            self.queue.note(&job, tasks.values());
            let id = job.job_id.clone();
            self.jobs.insert(id.clone(), (job, tasks));
            id
        }

        /// Assigns tasks until none is left for the worker; returns the numbers of their jobs.
        fn give_all(&mut self, worker: &WorkerProfile, quota: Quota) -> Vec<String> {
            let mut order = Vec::new();
            while let Some(next) = self.queue.next(worker, &[], |_| quota, NOW_MS, &Rules::default()) {
                self.set(&next.job, next.task, leased(order.len()));
                order.push(self.jobs[&next.job].0.request_id.clone());
            }
            order
        }

        fn set(&mut self, id: &JobId, task: TaskId, state: TaskState) {
            let Some((job, tasks)) = self.jobs.get_mut(id) else { panic!("no job {id}") };
            let Some(record) = tasks.get_mut(&task) else { panic!("no task {task}") };
            record.state = state;
            self.queue.note(job, [&*record]);
        }
    }

    fn leased(call: usize) -> TaskState {
        TaskState::Leased(Attempt {
            worker: "worker".into(),
            incarnation: "incarnation".into(),
            request_id: format!("call {call}"),
            number: 1,
            fence: call as u64 + 1,
            since_ms: NOW_MS,
            resumed_from: 0,
            memory_bytes: None,
        })
    }

    #[test]
    fn tenants_share_workers_evenly_at_any_load_and_priority() {
        let mut rows = Rows::default();
        rows.add(1, "reef", 1000, 4);
        rows.add(2, "reef", 0, 4);
        rows.add(3, "wreck", 0, 2);
        let order = rows.give_all(&worker(None), Quota::default());
        assert_eq!(order, ["1", "3", "1", "3", "1", "1", "2", "2", "2", "2"]);
    }

    #[test]
    fn within_a_tenant_priority_decides_and_then_age() {
        let mut rows = Rows::default();
        rows.add(1, "reef", 0, 1);
        rows.add(2, "reef", 0, 1);
        rows.add(3, "reef", 5, 2);
        assert_eq!(rows.give_all(&worker(None), Quota::default()), ["3", "3", "1", "2"]);
    }

    #[test]
    fn a_tenant_at_its_limit_waits_until_a_lease_of_its_own_ends() {
        let mut rows = Rows::default();
        let reef = rows.add(1, "reef", 0, 3);
        rows.add(2, "wreck", 0, 1);
        let quota = Quota { max_parallel: 2, ..Quota::default() };
        assert_eq!(rows.give_all(&worker(None), quota), ["1", "2", "1"]);
        rows.set(&reef, Stage::Partition.task_of(0), TaskState::Dead);
        assert_eq!(rows.give_all(&worker(None), quota), ["1"]);
    }

    #[test]
    fn a_worker_of_one_tenant_takes_nothing_of_another() {
        let mut rows = Rows::default();
        rows.add(1, "reef", 9, 2);
        rows.add(2, "wreck", 0, 1);
        assert_eq!(rows.give_all(&worker(Some("wreck")), Quota::default()), ["2"]);
        assert_eq!(rows.give_all(&worker(None), Quota::default()), ["1", "1"]);
    }

    #[test]
    fn a_call_finds_its_lease_as_long_as_it_is_held() {
        let mut rows = Rows::default();
        let id = rows.add(1, "reef", 0, 2);
        rows.give_all(&worker(None), Quota::default());
        let given = |rows: &Rows| rows.queue.given(&worker(None), "call 1");
        assert_eq!(given(&rows), Some((id.clone(), Stage::Partition.task_of(1))));
        rows.set(&id, Stage::Partition.task_of(1), TaskState::Ready { not_before_ms: NOW_MS });
        assert_eq!(given(&rows), None);
        rows.give_all(&worker(None), Quota::default());
        rows.queue.forget(&id);
        assert_eq!(rows.queue.given(&worker(None), "call 0"), None);
        assert_eq!(rows.queue.usage_of(&"reef".parse().unwrap_or_default()), Usage::default());
    }
}
