//! The rules under faults: virtual workers that die silently, messages that arrive late, twice and out of
//! order, and a virtual clock. Everything follows from a seed; a failure prints it.
//!
//! Merges find lost results of partitions. A user pauses and resumes jobs, limits their workers, and retries
//! failed jobs.
//!
//! Workers that find no ready task start second attempts, as if the others were slow.
//!
//! These properties are checked after every event:
//! - No task is done twice, or with another result than the first one submitted under a running lease.
//! - Only running leases change anything, and a task has at most two.
//! - Where the job has first parts (every other seed), partitions begin after the exchange, each from the
//!   result of its own first part.
//! - The model is that of the merge until borders are trained again, where they are (every fifth seed).
//! - Fences rise, and attempts stay within budgets.
//! - No task of a paused job is assigned, and no more at a time than the job's limit.
//! - Events are numbered without a gap.
//! - Every lease has a running clock, and no back-off exceeds the longest, so a job never stalls.
//! - At the end the job has succeeded, or failed because of a spent budget.
//!
//! The same harness with the check of fences off must find violations: otherwise it would prove nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use fathom_core::rng::{Stream, random_bits};
use fathom_core::scene::BlobRef;

use super::*;
use crate::store::NewJob;

const LEASE_MS: u64 = 1000;
/// Ten virtual hours. Half of all attempts fail and the back-off grows to a minute, so an hour is not always
/// enough. Every step checks that jobs never stall.
const RUN_MS: u64 = 36_000_000;

/// Random numbers of one run.
struct Dice {
    seed: u32,
    thrown: u32,
}

impl Dice {
    fn below(&mut self, n: u64) -> u64 {
        self.thrown += 1;
        u64::from(random_bits(self.seed, Stream::Test, self.thrown, 0)[0]) % n
    }

    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// A message on its way to the coordinator.
#[derive(Clone)]
struct InFlight {
    arrives_ms: u64,
    event: Event,
}

struct Simulation {
    dice: Dice,
    rules: Rules,
    rows: JobRows,
    leases: LeaseTable,
    now_ms: u64,
    last_fence: u64,
    messages: Vec<InFlight>,
    /// Result that each lease would submit, by fence.
    results: BTreeMap<u64, BlobRef>,
    /// Highest fence by task.
    granted: BTreeMap<TaskId, u64>,
    /// Tasks of the leases that run, by fence.
    running: BTreeMap<u64, TaskId>,
    /// The fence of each done task.
    done_under: BTreeMap<TaskId, u64>,
    /// Second attempts, and those of them that submitted the first result.
    second_attempts: (u32, u32),
    done: BTreeMap<TaskId, BlobRef>,
    stale: u32,
    silent: u32,
    pauses: u32,
    retries: u32,
    /// Lost results of partitions that a merge found.
    lost: u32,
    violations: Vec<String>,
}

/// The worker of one lease, which takes any task.
fn worker(fence: u64) -> WorkerProfile {
    let stages = Stage::all().collect();
    WorkerProfile {
        name: "virtual".into(),
        incarnation: format!("incarnation {fence}"),
        stages,
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes: None,
        tenant: None,
    }
}

fn blob(name: String) -> BlobRef {
    BlobRef { bytes: name.len() as u64, digest: name }
}

fn job() -> JobRows {
    let (job, plan) = NewJob::sample(0).into_rows(0);
    JobRows { job, tasks: BTreeMap::from([(Stage::Plan.task(), plan)]) }
}

impl Simulation {
    fn new(seed: u32, ignore_fences: bool) -> Self {
        Self {
            dice: Dice { seed, thrown: 0 },
            // Large budgets, so that most runs succeed under heavy faults; every seventh fails, and is
            // retried.
            rules: if seed % 7 == 6 {
                Rules { max_errors: 4, max_losses: 6, ignore_fences, ..Rules::default() }
            } else {
                Rules { max_errors: 40, max_losses: 60, ignore_fences, ..Rules::default() }
            },
            rows: job(),
            leases: LeaseTable::default(),
            now_ms: 0,
            last_fence: 0,
            messages: Vec::new(),
            results: BTreeMap::new(),
            granted: BTreeMap::new(),
            running: BTreeMap::new(),
            done_under: BTreeMap::new(),
            second_attempts: (0, 0),
            done: BTreeMap::new(),
            stale: 0,
            silent: 0,
            pauses: 0,
            retries: 0,
            lost: 0,
            violations: Vec::new(),
        }
    }

    fn run(mut self) -> Self {
        while self.goes_on_at_all() && self.now_ms < RUN_MS {
            self.now_ms += 1 + self.dice.below(200);
            self.deliver();
            for (lease, why) in self.leases.expired(self.now_ms, 0) {
                self.apply(Event::Expire { lease: lease.clone(), why });
                self.leases.end(&lease);
            }
            self.steer();
            if self.dice.one_in(2) {
                self.claim();
            }
            self.check();
        }
        if self.rows.job.state.is_open() {
            self.violations.push("the job has no end".into());
        }
        // Messages in flight arrive after the end.
        self.now_ms += 10 * LEASE_MS;
        self.deliver();
        self.check();
        self
    }

    /// Whether the job has not ended, or its user retries it.
    fn goes_on_at_all(&mut self) -> bool {
        if self.rows.job.state == JobState::Failed && self.retries < 20 {
            self.retries += 1;
            self.apply(Event::Retry);
            self.check();
        }
        self.rows.job.state.is_open()
    }

    /// The user pauses or resumes the job, or changes its limit of workers.
    fn steer(&mut self) {
        if self.rows.job.state == JobState::Paused {
            if self.dice.one_in(10) {
                self.apply(Event::Resume);
            }
        } else if self.dice.one_in(60) {
            self.pauses += 1;
            self.apply(Event::Pause { reason: "the user's".into() });
        }
        if self.dice.one_in(100) {
            let max_parallel = Some(self.dice.below(4) as u32);
            self.apply(Event::Update { priority: None, max_parallel });
        }
    }

    fn deliver(&mut self) {
        let now_ms = self.now_ms;
        let (mut due, later) =
            std::mem::take(&mut self.messages).into_iter().partition(|m: &InFlight| m.arrives_ms <= now_ms);
        self.messages = later;
        // In any order.
        while !due.is_empty() {
            let pick = self.dice.below(Vec::len(&due) as u64) as usize;
            let InFlight { event, .. }: InFlight = due.swap_remove(pick);
            if self.dice.one_in(8) {
                let arrives_ms = self.now_ms + self.dice.below(3 * LEASE_MS);
                self.messages.push(InFlight { arrives_ms, event: event.clone() });
            }
            self.apply(event);
        }
    }

    fn apply(&mut self, event: Event) {
        let before = self.rows.clone();
        match step(&mut self.rows, event.clone(), self.now_ms, &self.rules) {
            Ok(Outcome::Changed(events)) => {
                self.follow(&event);
                if self.rows.job.last_seq != before.job.last_seq + events.len() as u64 {
                    self.violations.push("a gap in the events".into());
                }
            }
            Ok(Outcome::Already) | Err(_)
                if self.rows.job != before.job || self.rows.tasks != before.tasks =>
            {
                self.violations.push("an event that was not applied changed something".into());
            }
            Ok(Outcome::Already) => {}
            Err(Refusal::StaleFence { .. }) => self.stale += 1,
            Err(_) => {}
        }
        let (rows, id) = (&self.rows, &before.job.job_id);
        self.leases
            .retain_of_job(id, |lease| rows.tasks.get(&lease.task).is_some_and(|t| t.is_held_by(lease)));
    }

    /// Records the running leases after an applied event; only a running one may have changed anything.
    fn follow(&mut self, event: &Event) {
        let lease = match event {
            Event::Checkpoint { lease, .. }
            | Event::Complete { lease, .. }
            | Event::Fail { lease, .. }
            | Event::Release { lease, .. }
            | Event::Expire { lease, .. }
            | Event::ResultsLost { lease, .. } => lease,
            _ => return,
        };
        let (task, fence) = (lease.task, lease.fence);
        if self.running.get(&fence) != Some(&task) {
            self.violations.push(format!("{task}: the lease under {fence} was over, and changed something"));
        }
        match event {
            Event::Checkpoint { .. } => {}
            Event::Complete { .. } => {
                let is_second = self.running.iter().any(|(other, of)| *of == task && *other < fence);
                self.second_attempts.1 += u32::from(is_second);
                self.running.retain(|_, of| *of != task);
                self.done_under.insert(task, fence);
            }
            Event::ResultsLost { tasks, .. } => {
                self.running.remove(&fence);
                self.lost += tasks.len() as u32;
                for task in tasks {
                    self.done.remove(task);
                    self.done_under.remove(task);
                }
            }
            _ => drop(self.running.remove(&fence)),
        }
    }

    /// A worker takes the first ready task, or one that another has, and then acts by the dice.
    fn claim(&mut self) {
        let ready = |t: &&TaskRecord| matches!(t.state, TaskState::Ready { not_before_ms } if not_before_ms <= self.now_ms);
        let ready = self.rows.tasks.values().find(ready);
        let is_second = ready.is_none();
        let alone = |t: &&TaskRecord| t.may_have_second_attempt();
        let Some(task) = ready.or_else(|| self.rows.tasks.values().find(alone)).map(|t| t.task) else {
            return;
        };
        self.last_fence += 1;
        let fence = self.last_fence;
        let event = Event::Claim {
            task,
            worker: worker(fence),
            peers: Arc::default(),
            request_id: format!("request {fence}"),
            fence,
            is_second,
        };
        let (state, leased) = (self.rows.job.state, self.leased());
        self.apply(event);
        let at_its_limit = self.rows.job.max_parallel > 0 && leased >= self.rows.job.max_parallel;
        let mut leases = self.rows.tasks[&task].leases(&self.rows.job.job_id).into_iter();
        let Some(lease) = leases.find(|lease| lease.fence == fence) else {
            if state == JobState::Running && !at_its_limit {
                self.violations.push(format!("{task} is ready and cannot be claimed"));
            }
            return;
        };
        if state != JobState::Running || at_its_limit {
            self.violations.push(format!("{task} was assigned in {state:?} with {leased} tasks leased"));
        }
        if self.granted.insert(task, fence).is_some_and(|older| older >= fence) {
            self.violations.push(format!("fence {fence} of {task} does not rise"));
        }
        self.second_attempts.0 += u32::from(is_second);
        self.running.insert(fence, task);
        self.leases.grant(lease.clone(), self.now_ms, self.now_ms + LEASE_MS);
        self.live(lease);
    }

    /// Queues all messages of the worker: the end of the lease implies renewals, and messages arrive in any
    /// order.
    fn live(&mut self, lease: Lease) {
        let work_ms = 100 + self.dice.below(4 * LEASE_MS);
        // Renewals as long as it is alive and connected; a network partition or slow network loses the lease
        // but not the worker.
        let heard_ms = if self.dice.one_in(2) { self.dice.below(work_ms) } else { work_ms };
        self.leases.renew(&lease, self.now_ms, self.now_ms + heard_ms + LEASE_MS, None);
        let result = blob(format!("result of {} under {}", lease.task, lease.fence));
        self.results.insert(lease.fence, result.clone());
        let send = |simulation: &mut Self, after_ms: u64, event: Event| {
            let delay_ms = simulation.dice.below(2 * LEASE_MS);
            let arrives_ms = simulation.now_ms + after_ms + delay_ms;
            simulation.messages.push(InFlight { arrives_ms, event });
        };
        if self.dice.one_in(3) {
            let (blob, iteration) = (blob(format!("checkpoint under {}", lease.fence)), lease.fence as u32);
            send(self, work_ms / 2, Event::Checkpoint { lease: lease.clone(), blob, iteration });
        }
        if lease.task == Stage::Merge.task() && self.dice.one_in(4) {
            let tasks = vec![Stage::Partition.task_of(self.dice.below(6) as u32)];
            let message = "a disk has changed it".to_owned();
            return send(self, work_ms, Event::ResultsLost { lease, tasks, message });
        }
        match self.dice.below(6) {
            // Dies silently.
            0 => self.silent += 1,
            1 => {
                let message = "virtual fault".to_owned();
                send(self, work_ms, Event::Fail { lease, class: FailClass::Training, message });
            }
            2 => send(self, work_ms, Event::Release { lease, reason: "leaves".into() }),
            _ => {
                let output = output(lease.task, result, self.dice.seed);
                send(self, work_ms, Event::Complete { lease, output });
            }
        }
    }

    fn leased(&self) -> u32 {
        self.rows.tasks.values().map(|record| record.running().count() as u32).sum()
    }

    fn check(&mut self) {
        let mut faults = Vec::new();
        if self.rows.job.leased_tasks != self.leased() {
            faults.push(format!("{} leases run, {} are counted", self.leased(), self.rows.job.leased_tasks));
        }
        if !self.rows.job.state.is_open() {
            self.running.clear();
        }
        for (task, record) in &self.rows.tasks {
            let known = self.running.iter().filter(|(_, of)| *of == task).map(|(fence, _)| *fence);
            let held = record.leases(&self.rows.job.job_id).into_iter().map(|lease| lease.fence);
            let (known, mut held): (Vec<u64>, Vec<u64>) = (known.collect(), held.collect());
            held.sort_unstable();
            if held != known || held.len() > 2 {
                faults.push(format!("{task} is leased under {held:?}, and {known:?} run"));
            }
            if let TaskState::Done { result, .. } = &record.state {
                let handed_in = &self.results[&self.done_under[task]];
                if result != handed_in {
                    faults.push(format!(
                        "{task} is done with {:?}, not with {:?}",
                        result.digest, handed_in.digest
                    ));
                }
                if self.done.insert(*task, result.clone()).is_some_and(|before| before != *result) {
                    faults.push(format!("{task} is done twice"));
                }
            } else if self.done.contains_key(task) {
                faults.push(format!("{task} was done and is not any more"));
            }
            if record.errors > self.rules.max_errors || record.losses > self.rules.max_losses {
                faults.push(format!("{task} continued beyond its budget"));
            }
        }
        if self.rows.job.shape.stages.contains(&Stage::Exchange) {
            faults.extend(self.faults_of_exchange());
        }
        faults.extend(self.faults_of_the_model());
        let open = self.rows.job.shape.tasks_of(self.rows.job.stage);
        let open =
            open.iter().filter(|t| !matches!(self.rows.tasks[t].state, TaskState::Done { .. })).count();
        if self.rows.job.state.is_open() && open != self.rows.job.open_tasks as usize {
            faults.push(format!("{open} tasks are open, {} are counted", self.rows.job.open_tasks));
        }
        if self.rows.job.state == JobState::Running && !self.goes_on() {
            faults.push("nothing will ever happen to the job again".into());
        }
        self.violations.extend(faults);
    }

    /// Faults of the two tasks of a partition and the exchange between them.
    fn faults_of_exchange(&self) -> Vec<String> {
        let mut faults = Vec::new();
        let exchange = self.done.get(&Stage::Exchange.task());
        if self.rows.job.output(Artifact::Exchange) != exchange {
            faults.push(format!(
                "the job has the exchange {:?}, not {exchange:?}",
                self.rows.job.output(Artifact::Exchange)
            ));
        }
        for (task, record) in &self.rows.tasks {
            match (task.stage, task.part) {
                (Stage::Partition, Some(index)) => {
                    if record.attempts > 0 && exchange.is_none() {
                        faults.push(format!("{task} began before the exchange"));
                    }
                    if record.inputs.get(&Artifact::FirstPart)
                        != self.done.get(&Stage::FirstPart.task_of(index))
                    {
                        faults.push(format!("{task} resumes from {:?}", record.inputs));
                    }
                }
                (Stage::Exchange, _) => {
                    let first =
                        (0..6).filter(|k| self.done.contains_key(&Stage::FirstPart.task_of(*k))).count();
                    if record.attempts > 0 && first != 6 {
                        faults.push(format!("an exchange of {first} first parts"));
                    }
                }
                _ => {}
            }
        }
        faults
    }

    /// Faults of the model and of the tasks that use it.
    fn faults_of_the_model(&self) -> Vec<String> {
        let mut faults = Vec::new();
        let [merged, bordered] =
            [Stage::Merge.task(), Stage::Borders.task()].map(|task| self.done.get(&task));
        if self.rows.job.output(Artifact::Model) != bordered.or(merged) {
            faults.push(format!("the model is {:?}", self.rows.job.output(Artifact::Model)));
        }
        let attempts = |task| self.rows.tasks.get(&task).map_or(0, |record| record.attempts);
        if attempts(Stage::Borders.task()) > 0 && merged.is_none() {
            faults.push("borders of no model are trained".into());
        }
        let has_borders = self.rows.job.shape.stages.contains(&Stage::Borders);
        if has_borders != self.rows.tasks.contains_key(&Stage::Borders.task()) {
            faults.push(format!("a shape with borders: {has_borders}, and other tasks"));
        }
        let evaluations = self.rows.job.shape.tasks_of(Stage::Evaluate);
        if evaluations.into_iter().any(|task| attempts(task) > 0) && has_borders && bordered.is_none() {
            faults.push("a model is measured whose borders are being trained".into());
        }
        faults
    }

    /// Whether some task of a running job will be claimed or revoked without any further message: it is ready
    /// within the longest back-off, or its lease has a running clock.
    fn goes_on(&mut self) -> bool {
        let longest_ms = self.rules.max_backoff_ms + self.rules.max_backoff_ms / 4;
        self.rows.tasks.values().all(|record| match record.state {
            TaskState::Ready { not_before_ms } => not_before_ms <= self.now_ms + longest_ms,
            TaskState::Leased(_) => {
                // A deadline never moves back, so this changes nothing.
                let mut leases = record.leases(&self.rows.job.job_id).into_iter();
                leases.all(|lease| self.leases.renew(&lease, 0, 0, None) != Renewed::Over)
            }
            _ => true,
        }) && self.rows.tasks.values().any(|record| !record.is_final() && record.state != TaskState::Blocked)
    }
}

fn output(task: TaskId, result: BlobRef, seed: u32) -> TaskOutput {
    let (has_first_parts, borders) = (seed % 2 == 1, seed.is_multiple_of(5));
    match task.stage {
        Stage::Plan => {
            let own = |stage: Stage| (stage.task(), PlannedTask::default());
            let planned = |name: &str| PlannedTask::new(blob(name.to_owned()), 10);
            let mut tasks = BTreeMap::from([own(Stage::Merge), own(Stage::Artifacts)]);
            tasks.insert(Stage::Global.task(), planned("global"));
            let evaluate = |task| (task, PlannedTask::new(blob(format!("{task}")), 0));
            match seed % 3 {
                0 => tasks.extend((1..=3).map(|part| evaluate(Stage::Evaluate.task_of(part)))),
                _ => tasks.extend([evaluate(Stage::Evaluate.task())]),
            }
            tasks.extend(has_first_parts.then(|| own(Stage::Exchange)));
            tasks.extend(borders.then(|| (Stage::Borders.task(), planned("borders"))));
            for k in 0..6 {
                if has_first_parts {
                    tasks.insert(Stage::FirstPart.task_of(k), planned(&format!("first of {k}")));
                }
                tasks.insert(Stage::Partition.task_of(k), planned(&format!("partition {k}")));
            }
            TaskOutput::planned(result, blob("picture".into()), Planned { tasks, warnings: Vec::new() })
        }
        Stage::Merge => TaskOutput::merged(result, blob("report".into()), TaskStats::default()),
        stage => TaskOutput::of(stage, result, TaskStats::default()),
    }
}

#[test]
fn every_seed_commits_each_task_once_by_a_live_lease() {
    simulate(300);
}

#[test]
#[ignore = "takes a minute"]
fn thousands_of_seeds_commit_each_task_once_by_a_live_lease() {
    simulate(2000);
}

fn simulate(seeds: u32) {
    let (mut stale, mut silent, mut succeeded, mut exchanged, mut bordered) = (0, 0, 0, 0, 0);
    let (mut pauses, mut retries, mut second_attempts, mut ahead, mut lost) = (0, 0, 0, 0, 0);
    for seed in 0..seeds {
        let end = Simulation::new(seed, false).run();
        assert!(end.violations.is_empty(), "seed {seed}: {:?}", end.violations);
        stale += end.stale;
        silent += end.silent;
        pauses += end.pauses;
        retries += end.retries;
        second_attempts += end.second_attempts.0;
        lost += end.lost;
        ahead += end.second_attempts.1;
        exchanged += u32::from(end.rows.job.output(Artifact::Exchange).is_some());
        bordered += u32::from(end.done.contains_key(&Stage::Borders.task()));
        succeeded += u32::from(end.rows.job.state == JobState::Succeeded);
        let tasks: BTreeSet<TaskId> = end.rows.tasks.keys().copied().collect();
        assert!(end.done.keys().all(|task| tasks.contains(task)), "seed {seed}");
    }
    // The faults did happen, and did not stop the jobs.
    assert!(
        stale > seeds && silent > seeds,
        "{stale} stale messages, {silent} silent workers in {seeds} runs"
    );
    assert!(
        second_attempts > seeds && ahead > seeds / 4,
        "{second_attempts} second attempts, {ahead} of them first to a result"
    );
    assert!(lost > seeds / 10, "only {lost} results were lost");
    assert!(pauses > seeds && retries > seeds / 10, "{pauses} pauses, {retries} retries");
    assert!(exchanged > seeds / 30 * 14, "only {exchanged} of {seeds} jobs exchanged results");
    assert!(bordered > seeds / 30 * 5, "only {bordered} of {seeds} jobs trained their borders");
    assert!(succeeded > seeds / 30 * 29, "only {succeeded} of {seeds} jobs succeeded");
}

#[test]
fn the_simulation_notices_when_fences_are_not_checked() {
    let violating = (0..50).filter(|seed| !Simulation::new(*seed, true).run().violations.is_empty()).count();
    assert!(violating > 25, "only {violating} of 50 seeds notice that fences are not checked");
}

#[test]
fn the_same_seed_replays_to_the_same_end() {
    let ends = [(); 2].map(|()| Simulation::new(7, false).run());
    assert_eq!(ends[0].rows.tasks, ends[1].rows.tasks);
    assert_eq!((ends[0].now_ms, ends[0].stale), (ends[1].now_ms, ends[1].stale));
}

#[test]
fn a_late_repeated_checkpoint_does_not_set_its_task_back() {
    let mut simulation = Simulation::new(0, false);
    let take = |rows: &mut JobRows, fence: u64| {
        let (worker, peers, request_id) = (worker(fence), Arc::default(), format!("request {fence}"));
        let event =
            Event::Claim { task: Stage::Plan.task(), worker, peers, request_id, fence, is_second: false };
        step(rows, event, 0, &Rules::default()).unwrap();
        rows.tasks[&Stage::Plan.task()].leases(&rows.job.job_id).remove(0)
    };
    let reached = |rows: &mut JobRows, lease: &Lease, iteration: u32| {
        let blob = blob(format!("{iteration} under {}", lease.fence));
        let event = Event::Checkpoint { lease: lease.clone(), blob, iteration };
        let outcome = step(rows, event, 0, &Rules::default()).unwrap();
        (outcome == Outcome::Already, rows.tasks[&Stage::Plan.task()].checkpoint.as_ref().unwrap().iteration)
    };
    let rows = &mut simulation.rows;
    let first = take(rows, 1);
    let reports = [100, 200, 100, 200, 300].map(|iteration| reached(rows, &first, iteration));
    assert_eq!(reports, [(false, 100), (false, 200), (true, 200), (true, 200), (false, 300)]);

    // Another attempt that could not use the checkpoint restarts, with its own count.
    let release = Event::Release { lease: first, reason: "leaves".into() };
    step(rows, release, 0, &Rules::default()).unwrap();
    let second = take(rows, 2);
    assert_eq!(reached(rows, &second, 100), (false, 100));
}
