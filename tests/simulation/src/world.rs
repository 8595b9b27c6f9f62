//! One run: a seed, its hosts, the state that they share with the simulation, and the loop that advances the
//! clock.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use fathom_coordinator::access::{Role, TokenRecord};
use fathom_coordinator::retention::{Housekeeping, Policy};
use fathom_coordinator::schedule::JobId;
use fathom_coordinator::{Clock, CoordinatorConfig, serve_over};
use fathom_invariants::Fact;
use fathom_observe::threads;
use fathom_worker::{WorkerConfig, run_with};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tracing_subscriber::layer::SubscriberExt;

use crate::disk::{Disk, DiskStore};
use crate::faults::Faults;
use crate::history::History;
use crate::invariants;
use crate::lines::Lines;
use crate::network::{COORDINATOR, dial, listen};
use crate::random::{Random, seed_thread};
use crate::scene::Variety;
use crate::trainer::Trainer;
use crate::users::user;

/// Simulated time between two rounds of all hosts; no message arrives sooner.
const TICK: Duration = Duration::from_millis(20);
/// Time of the first tick, Unix milliseconds. Long ago, so that a file that still has the machine's time
/// counts as new.
pub const EPOCH_MS: u64 = 1_500_000_000_000;
/// Days and hours of real services, scaled to seconds. Unreferenced blobs are kept longer than the slowest
/// answer takes.
pub const HOUSE: Housekeeping = Housekeeping {
    policy: Policy { jobs: None, unused: Duration::from_secs(20), uploads: Duration::from_secs(12) },
    every: Duration::from_secs(4),
};
/// Runs that check for removed files continue for this long after all hosts are done.
const HOUSE_IS_CLEAN_AFTER: Duration = Duration::from_secs(32);
/// Duration of the faults.
const FAULTS_FOR: Duration = Duration::from_secs(45);
/// Time limit for all jobs to end after the last fault. The network alone may need thirty seconds to detect a
/// dead connection.
const ENDS_WITHIN: Duration = Duration::from_secs(180);

/// All kinds of jobs: the number of partitions, and the additional stages.
pub const KINDS: [(u32, Variety); 6] = [
    (1, Variety::Plain),
    (2, Variety::Plain),
    (3, Variety::Plain),
    (2, Variety::Water),
    (2, Variety::Borders),
    (3, Variety::Borders),
];

/// A safeguard that can be disabled, to show that the invariants detect its absence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Safeguard {
    /// Events under an old lease are refused.
    Fence,
    /// A repeated request creates one job.
    Requests,
    /// No call is answered before its change is on the disk.
    Sync,
    /// Leases of silent workers are revoked.
    Sweeper,
}

/// Options of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// Of everything.
    pub seed: u64,
    /// Nothing fails.
    pub undisturbed: bool,
    /// The disabled safeguard.
    pub without: Option<Safeguard>,
    /// Partitions and variety of every job; if absent, drawn from the seed.
    pub jobs: Option<(u32, Variety)>,
}

/// Size and configuration of the simulation, drawn from the seed.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// One per user.
    pub jobs: Vec<WantedJob>,
    /// GPU memory of each worker, bytes; 0: not reported.
    pub workers: Vec<u64>,
    lease_ms: u32,
    tenant_parallel: u32,
}

/// The job of a user.
#[derive(Clone, Debug)]
pub struct WantedJob {
    /// Its partitions.
    pub partitions: u32,
    /// Its stages.
    pub variety: Variety,
    /// Maximum number of its tasks that run at a time; 0: no limit.
    pub max_parallel: u32,
    /// Whether its user may change its mind.
    pub may_be_cancelled: bool,
    /// Whether its scene is uploaded as a dataset first.
    pub has_dataset: bool,
    /// Whether its user deletes it, and its dataset, at the end.
    pub is_deleted: bool,
}

impl Scenario {
    fn of(options: &Options) -> Self {
        let mut random = Random::new(options.seed, "scenario");
        let job = |random: &mut Random| {
            let drawn = random.of(&KINDS);
            let (partitions, variety) = options.jobs.unwrap_or(drawn);
            WantedJob {
                partitions,
                variety,
                max_parallel: random.of(&[0, 0, 1, 2]),
                may_be_cancelled: random.permille(250),
                has_dataset: random.permille(400),
                is_deleted: random.permille(300),
            }
        };
        let mut jobs = vec![job(&mut random), job(&mut random)];
        if random.permille(250) {
            jobs.push(job(&mut random));
        }
        // In some runs, one with too little memory for some or all tasks.
        let small = random.of(&[0, 0, 1 << 20, 100 << 20]);
        Self {
            jobs,
            workers: vec![0, 0, small],
            lease_ms: random.of(&[1500, 3000, 5000]),
            tenant_parallel: random.of(&[0, 0, 1, 2]),
        }
    }
}

/// Tenant of a user: the first and the third share a tenant and its limits.
pub fn tenant_of(user: usize) -> &'static str {
    ["reef", "wreck"][user % 2]
}

/// Tokens of all callers.
pub struct Tokens {
    /// One per user.
    pub users: Vec<String>,
    /// Of all workers.
    pub worker: String,
    /// Of the operator.
    pub operator: String,
}

/// Counts of events.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Runs.
    pub seeds: u64,
    /// Jobs that were created.
    pub jobs: u64,
    /// Leases granted.
    pub attempts: u64,
    /// Of these, on tasks that another worker had.
    pub second_attempts: u64,
    /// Processes of the coordinator.
    pub coordinators: u64,
    /// Workers that crashed or left.
    pub workers: u64,
    /// Links that were cut, in one direction or in both.
    pub partitions: u64,
    /// Links whose messages were held back.
    pub holds: u64,
    /// Disks that failed.
    pub disks: u64,
    /// Messages under an expired lease.
    pub stale: u64,
    /// Messages that reached the store twice.
    pub repeated: u64,
    /// Datasets committed.
    pub datasets: u64,
    /// Jobs that were deleted.
    pub deleted: u64,
    /// Blobs and uploads that were removed.
    pub removed: u64,
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, more: Self) {
        self.seeds += more.seeds;
        self.jobs += more.jobs;
        self.attempts += more.attempts;
        self.second_attempts += more.second_attempts;
        self.coordinators += more.coordinators;
        self.workers += more.workers;
        self.partitions += more.partitions;
        self.holds += more.holds;
        self.disks += more.disks;
        self.stale += more.stale;
        self.repeated += more.repeated;
        self.datasets += more.datasets;
        self.deleted += more.deleted;
        self.removed += more.removed;
    }
}

/// State shared by all hosts of a run and the simulation.
pub struct World {
    /// Of everything.
    pub seed: u64,
    /// The scenario.
    pub scenario: Scenario,
    /// The history.
    pub history: History,
    /// Of the coordinator.
    pub disk: Mutex<Disk>,
    /// Tokens of all callers.
    pub tokens: Tokens,
    without: Option<Safeguard>,
    folder: tempfile::TempDir,
    faults: AtomicBool,
    finished: Mutex<Vec<usize>>,
    /// A worker whose number is true is asked to leave.
    leaving: Vec<watch::Sender<bool>>,
    counts: Mutex<Counts>,
    said_tokens: Mutex<Vec<String>>,
}

impl World {
    fn new(options: &Options) -> Self {
        let seed = options.seed;
        let scenario = Scenario::of(options);
        let mut records = Vec::new();
        let mut issue = |name: &str, role: Role, tenant: &str| {
            let (token, record) =
                TokenRecord::issue(name.to_owned(), role, tenant, 0, EPOCH_MS).expect("a token");
            records.push(record);
            token.reveal()
        };
        let users =
            (0..scenario.jobs.len()).map(|user| issue("user", Role::Submitter, tenant_of(user))).collect();
        let (worker, operator) = (issue("worker", Role::Worker, ""), issue("operator", Role::Operator, ""));
        // A file system in memory if there is one: syncs of real disks are not tested here.
        let memory = Path::new("/dev/shm");
        let mut folder = tempfile::Builder::new();
        folder.prefix("fathom-simulation-");
        let folder = if memory.is_dir() { folder.tempdir_in(memory) } else { folder.tempdir() };
        Self {
            seed,
            leaving: scenario.workers.iter().map(|_| watch::Sender::new(false)).collect(),
            scenario,
            history: History::default(),
            disk: Mutex::new(Disk::with_tokens(records)),
            tokens: Tokens { users, worker, operator },
            without: options.without,
            folder: folder.expect("a temporary folder"),
            faults: AtomicBool::new(!options.undisturbed),
            finished: Mutex::default(),
            counts: Mutex::default(),
            said_tokens: Mutex::default(),
        }
    }

    /// Folder of this run's files.
    pub fn dir(&self) -> &Path {
        self.folder.path()
    }

    /// Whether anything may still fail.
    pub fn has_faults(&self) -> bool {
        self.faults.load(Ordering::SeqCst)
    }

    /// Whether a safeguard is switched off.
    pub fn is_off(&self, safeguard: Safeguard) -> bool {
        self.without == Some(safeguard)
    }

    /// Counts something.
    pub fn counts(&self, count: impl FnOnce(&mut Counts)) {
        count(&mut self.counts.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Records that all jobs of a user have ended and the user has seen it.
    pub fn finished(&self, user: usize) {
        self.finished.lock().unwrap_or_else(PoisonError::into_inner).push(user);
    }

    /// Asks a worker to leave, as SIGTERM does.
    pub fn ask_to_leave(&self, worker: usize) {
        self.leaving[worker].send_replace(true);
    }

    /// Jobs that users know of.
    pub fn created(&self) -> Vec<(usize, JobId)> {
        let mut created: Vec<(usize, JobId)> = Vec::new();
        for (_, fact) in self.history.facts() {
            if let Fact::Created { user, job, .. } = fact
                && !created.contains(&(user, job.clone()))
            {
                created.push((user, job));
            }
        }
        created
    }

    /// Records a log line that contains a token.
    pub fn look_for_tokens(&self, line: &str) {
        let Tokens { users, worker, operator } = &self.tokens;
        let mut secrets =
            users.iter().chain([worker, operator]).filter_map(|token| Some(token.rsplit_once('_')?.1));
        if secrets.any(|secret| line.contains(secret)) {
            self.said_tokens.lock().unwrap_or_else(PoisonError::into_inner).push(line.to_owned());
        }
    }

    /// Log lines that contained a token.
    pub fn said_tokens(&self) -> Vec<String> {
        self.said_tokens.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Configuration of the coordinator.
    pub fn coordinator_config(&self) -> CoordinatorConfig {
        CoordinatorConfig {
            data_dir: self.dir().join("data"),
            lease_ms: self.scenario.lease_ms,
            stall_ms: 0,
            backoff_ms: 300,
            // Often enough that two workers run the same task.
            straggler_factor: 1.0,
            straggler_after_ms: 2000,
            max_errors: 5,
            max_losses: 20,
            tenant_parallel: self.scenario.tenant_parallel,
            tokens: true,
            insecure: true,
            min_free_bytes: 0,
            ..CoordinatorConfig::default()
        }
    }
}

fn since_start() -> Duration {
    turmoil::sim_elapsed().unwrap_or_default()
}

/// The coordinator's host: restarts the process when it ends.
async fn coordinator(world: Arc<World>) -> turmoil::Result {
    loop {
        let begin = since_start();
        let random = Random::new(world.seed, &format!("disk from {begin:?} on"));
        world.counts(|counts| counts.coordinators += 1);
        let store = DiskStore::open(&world, random).await?;
        let clock = Clock::starting_at(wall_clock_ms(&world, begin));
        let ended = match serve_over(world.coordinator_config(), store, clock, HOUSE, listen().await?).await {
            Ok(coordinator) => coordinator.wait().await,
            Err(error) => Err(error),
        };
        world.history.line(format!("coordinator: ended: {ended:?}"));
        tokio::time::sleep(Duration::from_millis(300)).await;
    }
}

/// Wall clock of a coordinator that starts `begin` after the first one. In half of the cases it was just
/// changed by up to three days in either direction.
fn wall_clock_ms(world: &World, begin: Duration) -> u64 {
    const THREE_DAYS_MS: u64 = 3 * 24 * 3600 * 1000;
    let now = EPOCH_MS + begin.as_millis() as u64;
    let mut random = Random::new(world.seed, &format!("clock from {begin:?} on"));
    if begin.is_zero() || random.permille(500) {
        return now;
    }
    now - THREE_DAYS_MS + random.within(0, 2 * THREE_DAYS_MS)
}

/// A worker's host, like the coordinator's.
async fn worker(world: Arc<World>, index: usize) -> turmoil::Result {
    loop {
        let random = Random::new(world.seed, &format!("worker {index} from {:?} on", since_start()));
        let config = WorkerConfig {
            coordinator: dial(&world.tokens.worker),
            name: format!("worker-{index}"),
            cache_dir: world.dir().join(format!("cache-{index}")),
            ..WorkerConfig::default()
        };
        let trainer = Trainer::new(&world, random, world.scenario.workers[index]);
        world.leaving[index].send_replace(false);
        let ended = run_with(config, Arc::new(trainer), world.leaving[index].subscribe()).await;
        world.history.line(format!("worker {index}: ended: {ended:?}"));
        tokio::time::sleep(Duration::from_millis(700)).await;
    }
}

/// The outcome of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Run {
    /// A sentence for each violated invariant, starting with its name.
    pub violations: Vec<String>,
    /// Counts of events.
    pub counts: Counts,
    /// The history, one line per fact.
    pub history: Vec<String>,
    /// Digests of the merged models, by the kind of their jobs.
    pub models: Vec<(String, String)>,
    /// Simulated time.
    pub took: Duration,
    /// The last part of the history.
    pub tail: String,
}

/// Runs one seed and checks its history. Call it once per process: tokio counts its runtimes, and its random
/// choices depend on the count.
///
/// # Panics
/// When the simulation itself fails.
pub fn run(options: &Options) -> Run {
    let options = options.clone();
    // A new thread has drawn no random numbers yet.
    let running = std::thread::spawn(move || {
        seed_thread(options.seed);
        simulate(&options)
    });
    running.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

fn simulate(options: &Options) -> Run {
    let seed = options.seed;
    let world = Arc::new(World::new(options));
    let subscriber = tracing_subscriber::registry()
        .with(tracing_subscriber::filter::LevelFilter::INFO)
        .with(fathom_observe::capture::Capture)
        .with(Lines(Arc::clone(&world)));
    let _logs = tracing::subscriber::set_default(subscriber);
    let mut disk = Random::new(seed, "files");
    threads::simulate(move || disk.ms(0, 4));

    let mut sim = turmoil::Builder::new()
        .rng_seed(seed)
        .epoch(std::time::UNIX_EPOCH + Duration::from_millis(EPOCH_MS))
        .simulation_duration(Duration::from_secs(86_400))
        .tick_duration(TICK)
        .min_message_latency(Duration::from_millis(1))
        .max_message_latency(Duration::from_millis(60))
        .tcp_capacity(4096)
        .build();
    let shared = Arc::clone(&world);
    sim.host(COORDINATOR, move || coordinator(Arc::clone(&shared)));
    for index in 0..world.scenario.workers.len() {
        let shared = Arc::clone(&world);
        sim.host(format!("worker-{index}"), move || worker(Arc::clone(&shared), index));
    }
    let users = world.scenario.jobs.len();
    for index in 0..users {
        let shared = Arc::clone(&world);
        // A host, not a client: the length of the run does not depend on it.
        sim.host(format!("user-{index}"), move || user(Arc::clone(&shared), index));
    }

    let mut faults = Faults::of(&world, options.undisturbed);
    let until = if options.undisturbed { Duration::ZERO } else { FAULTS_FOR };
    let is_cleaned = world.scenario.jobs.iter().any(|job| job.is_deleted);
    let (mut broken, mut done_at) = (None, None);
    loop {
        let now = sim.elapsed();
        world.history.set_now(now);
        if world.finished.lock().unwrap_or_else(PoisonError::into_inner).len() == users {
            let done_at = *done_at.get_or_insert(now.max(until));
            if !is_cleaned || now >= done_at + HOUSE_IS_CLEAN_AFTER {
                break;
            }
        }
        if done_at.is_none() && now >= until + ENDS_WITHIN {
            broken = Some(format!("I8: not all jobs have ended {ENDS_WITHIN:?} after the last fault"));
            break;
        }
        if now >= until && world.has_faults() {
            faults.end(&mut sim);
            world.faults.store(false, Ordering::SeqCst);
        } else {
            faults.go_on(&mut sim, now);
        }
        // This is true at once when all hosts are done, and not useful otherwise: users report when they are
        // done.
        if let Err(error) = sim.step() {
            broken = Some(format!("a host ended: {error}"));
            break;
        }
    }
    let took = sim.elapsed();
    drop(sim);
    let found = invariants::look(&world);
    let mut violations: Vec<String> = broken.into_iter().collect();
    violations.extend(found.violations);
    world.counts(|counts| counts.seeds += 1);
    let counts = *world.counts.lock().unwrap_or_else(PoisonError::into_inner);
    let history = world.history.report();
    Run { violations, counts, history, models: found.models, took, tail: world.history.tail(60) }
}
