//! Random kills of all processes, job after job, for a configurable time.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::harness::Harness;
use crate::history::History;
use crate::job::Job;
use crate::processes::can_train;
use crate::reference::scene;
use crate::s3::Fault;

/// Number of faults per job; after them it runs undisturbed and must finish.
const FAULTS: u64 = 8;

#[test]
fn random_kills_of_everything_change_no_byte() {
    let scenario = "random_kills_of_everything_change_no_byte";
    kill_at_random(scenario, || Some(Harness::new(scenario)), 1);
}

#[test]
fn random_kills_with_a_database_change_no_byte() {
    let scenario = "random_kills_with_a_database_change_no_byte";
    kill_at_random(scenario, || Harness::on_database(scenario), 1);
}

#[test]
#[ignore = "duration is configurable; run `make soak`"]
fn random_kills_for_long_change_no_byte() {
    let scenario = "random_kills_for_long_change_no_byte";
    kill_at_random(scenario, || Some(Harness::new(scenario)), rounds());
}

#[test]
#[ignore = "duration is configurable; run `make soak`"]
fn random_kills_for_long_with_a_database_change_no_byte() {
    let scenario = "random_kills_for_long_with_a_database_change_no_byte";
    kill_at_random(scenario, || Harness::on_database(scenario), rounds());
}

fn rounds() -> u32 {
    std::env::var("FATHOM_KILLS_ROUNDS").ok().and_then(|rounds| rounds.parse().ok()).unwrap_or(40)
}

/// Number of faults, and their cost.
#[derive(Default)]
struct Figures {
    coordinators: u32,
    databases: u32,
    /// Times in which requests to the bucket failed.
    buckets: u32,
    workers: u32,
    stopped: u32,
    asked_to_leave: u32,
    events: usize,
    /// Time from process start to readiness, milliseconds.
    restarts: Vec<f64>,
    /// Time from the kill of a worker until its lease is revoked, and until another worker has its task; in
    /// lease periods.
    taken_back: Vec<f64>,
    granted: Vec<f64>,
    /// Work lost by a kill.
    lost_seconds: Vec<f64>,
    lost_iterations: Vec<f64>,
}

/// One service, and the faults applied to it.
struct Chaos {
    harness: Harness,
    figures: Figures,
    /// Running workers, and the number started so far.
    living: Vec<String>,
    born: u32,
    /// Times of worker kills, by name, and of coordinator faults.
    killed: BTreeMap<String, Instant>,
    disturbed: Vec<Instant>,
}

fn kill_at_random(scenario: &'static str, harness: impl FnOnce() -> Option<Harness>, rounds: u32) {
    if !can_train(scenario) {
        return;
    }
    let begin = Instant::now();
    let Some(harness) = harness() else { return };
    let mut chaos = Chaos {
        harness,
        figures: Figures::default(),
        living: Vec::new(),
        born: 0,
        killed: BTreeMap::new(),
        disturbed: Vec::new(),
    };
    let scene = scene().to_string_lossy().into_owned();
    for round in 0..rounds {
        let id = format!("--request-id=round-{round}");
        let words = Harness::submission(&scene, &[&id]);
        let acknowledged = chaos.harness.ask(&words).trim().to_owned();
        let job = chaos.harness.watch(acknowledged);
        let faults = 3 + chaos.harness.random.below(FAULTS - 2);
        for _ in 0..faults {
            while chaos.living.len() < 2 {
                chaos.start_worker();
            }
            chaos.harness.random.sleep(50, 1200);
            if job.is_over() {
                break;
            }
            chaos.strike();
        }
        while chaos.living.len() < 2 {
            chaos.start_worker();
        }
        let history = chaos.harness.succeeded(&job);
        assert_eq!(chaos.harness.ask(&words).trim(), job.id, "a repeated request made another job");
        chaos.measure(&job, &history);
        if rounds > 1 {
            println!("round {round}: {} kills so far, {:.0?}", chaos.kills(), begin.elapsed());
        }
    }
    let kills = chaos.kills();
    chaos.harness.check_what_is_kept();
    println!("{rounds} jobs in {:.0?}, {kills} kills survived; {}", begin.elapsed(), chaos.figures.said());
}

impl Chaos {
    fn kills(&self) -> u32 {
        self.figures.coordinators + self.figures.databases + self.figures.workers
    }

    fn start_worker(&mut self) {
        self.born += 1;
        let name = format!("worker-{}", self.born);
        self.harness.start_worker(&name);
        self.living.push(name);
    }

    fn any_worker(&mut self) -> Option<String> {
        let count = self.living.len() as u64;
        (count > 0).then(|| self.living[self.harness.random.below(count) as usize].clone())
    }

    /// One fault, repaired after less or more than a lease period.
    fn strike(&mut self) {
        let lease = self.harness.rules.lease_ms;
        if self.harness.has_database() && self.harness.random.below(3) == 0 {
            self.disturbed.push(Instant::now());
            let pause = Duration::from_millis(self.harness.random.below(2 * lease));
            self.harness.kill_database(pause);
            self.figures.databases += 1;
            self.disturbed.push(Instant::now());
            return;
        }
        if self.harness.has_database() && self.harness.random.below(4) == 0 {
            self.break_bucket();
            return;
        }
        match self.harness.random.below(10) {
            0..4 => self.kill_coordinator(),
            4..7 => self.kill_worker(),
            7 => {
                let Some(name) = self.any_worker() else { return };
                self.harness.worker(&name).suspend();
                self.harness.random.sleep(lease / 4, 3 * lease);
                self.harness.worker(&name).go_on();
                self.figures.stopped += 1;
            }
            8 => {
                self.disturbed.push(Instant::now());
                self.harness.coordinator().suspend();
                self.harness.random.sleep(lease / 4, 3 * lease);
                self.harness.coordinator().go_on();
                self.disturbed.push(Instant::now());
                self.figures.stopped += 1;
            }
            _ => {
                let Some(name) = self.any_worker() else { return };
                self.harness.worker(&name).ask_to_leave();
                self.harness.worker(&name).end();
                self.living.retain(|living| *living != name);
                self.figures.asked_to_leave += 1;
            }
        }
    }

    /// Requests to the bucket fail, in one of the ways of real ones, and then no more.
    fn break_bucket(&mut self) {
        let slow = Fault::Slow(Duration::from_millis(500));
        let faults = [Fault::Status(500), Fault::Status(503), Fault::Truncated, slow];
        let fault = faults[self.harness.random.below(4) as usize];
        let every = 1 + self.harness.random.below(3);
        self.disturbed.push(Instant::now());
        self.harness.bucket().break_every(every, Some(fault));
        self.harness.random.sleep(0, 3000);
        self.harness.bucket().break_every(every, None);
        self.disturbed.push(Instant::now());
        self.figures.buckets += 1;
    }

    fn kill_coordinator(&mut self) {
        self.disturbed.push(Instant::now());
        self.harness.kill_coordinator();
        self.figures.coordinators += 1;
        // Sometimes a worker dies while the coordinator is down.
        if self.harness.random.below(4) == 0 {
            self.kill_worker();
        }
        if self.harness.random.below(2) == 0 {
            self.harness.random.sleep(0, 1500);
        }
        let ready = self.harness.start_coordinator();
        self.figures.restarts.push(ready.as_secs_f64() * 1e3);
        self.disturbed.push(Instant::now());
    }

    fn kill_worker(&mut self) {
        let Some(name) = self.any_worker() else { return };
        self.harness.kill_worker(&name);
        self.killed.insert(name.clone(), Instant::now());
        self.living.retain(|living| *living != name);
        self.figures.workers += 1;
    }

    /// The cost of a round's kills, where only the worker was disturbed.
    fn measure(&mut self, job: &Job, history: &History) {
        let lease = Duration::from_millis(self.harness.rules.lease_ms);
        self.figures.events += history.events_of_tasks();
        for task in ["global", "partition-0000", "partition-0001"] {
            let leases = history.leases(task);
            for pair in leases.windows(2) {
                let Some(&killed) = self.killed.get(&pair[0].worker) else { continue };
                let (attempt, next) = (pair[0].attempt, pair[1].attempt);
                let back = job.when(task, attempt, "ready");
                let (Some(back), Some(granted)) = (back, job.when(task, next, "running")) else { continue };
                if back < killed {
                    continue;
                }
                let done = job.iteration(task, killed).max(pair[0].resumed_from);
                self.figures.lost_iterations.push(done.saturating_sub(pair[1].resumed_from) as f64);
                let lost = job.lost_work(task, attempt, killed).unwrap_or_default();
                self.figures.lost_seconds.push(lost.as_secs_f64());
                if !self.disturbed.iter().any(|when| (killed..granted).contains(when)) {
                    let in_leases = |until: Instant| (until - killed).div_duration_f64(lease);
                    self.figures.taken_back.push(in_leases(back));
                    self.figures.granted.push(in_leases(granted));
                }
            }
        }
    }
}

impl Figures {
    fn said(&self) -> String {
        let Self { coordinators, databases, buckets, workers, stopped, asked_to_leave, events, .. } = self;
        format!(
            "coordinators {coordinators}, databases {databases}, workers {workers}; {stopped} processes stopped, {asked_to_leave} \
             workers asked to leave, {buckets} faults of the bucket; {events} events of tasks without a gap, and no acknowledgement lost\n\
             coordinator from start to ready, ms: {}\nlease taken back after a worker's kill, leases: {}\n\
             task given to another worker, leases: {}\nwork lost by a kill, seconds: {}; iterations: {}",
            spread(&self.restarts),
            spread(&self.taken_back),
            spread(&self.granted),
            spread(&self.lost_seconds),
            spread(&self.lost_iterations),
        )
    }
}

/// Median and maximum.
fn spread(values: &[f64]) -> String {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match (sorted.get(sorted.len() / 2), sorted.last()) {
        (Some(median), Some(most)) => {
            format!("median {median:.2}, at most {most:.2} ({} of them)", sorted.len())
        }
        _ => "none".to_owned(),
    }
}
