//! One run: a seed, the hosts that it has, what they share with the simulation, and the loop that turns the
//! clock.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use fathom_coordinator::access::{Role, TokenRecord};
use fathom_coordinator::retention::{Housekeeping, Policy};
use fathom_coordinator::schedule::JobId;
use fathom_coordinator::{Clock, CoordinatorConfig, serve_over};
use fathom_observe::threads;
use fathom_worker::{WorkerConfig, run_with};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tracing_subscriber::layer::SubscriberExt;

use crate::disk::{Disk, DiskStore};
use crate::faults::Faults;
use crate::history::{Fact, History};
use crate::invariants;
use crate::lines::Lines;
use crate::network::{COORDINATOR, dial, listen};
use crate::random::{Random, seed_thread};
use crate::scene::Variety;
use crate::trainer::Trainer;
use crate::users::user;

/// Simulated time between two rounds in which each host has its turn: no message arrives sooner.
const TICK: Duration = Duration::from_millis(20);
/// The time of the first tick, Unix milliseconds. Long ago: a file to which nobody has given a simulated time
/// yet, and which has one of the machine, is young.
pub const EPOCH_MS: u64 = 1_500_000_000_000;
/// Days and hours of real services as seconds. What nothing refers to is kept for longer than the slowest of
/// answers takes.
pub const HOUSE: Housekeeping = Housekeeping {
    policy: Policy { jobs: None, unused: Duration::from_secs(20), uploads: Duration::from_secs(12) },
    every: Duration::from_secs(4),
};
/// Where files are looked for that should be gone, everybody has been done for so long.
const HOUSE_IS_CLEAN_AFTER: Duration = Duration::from_secs(32);
/// While there are faults.
const FAULTS_FOR: Duration = Duration::from_secs(45);
/// All jobs have ended so long after the last fault, or never will. The network alone may need thirty seconds
/// to find out that a connection is dead.
const ENDS_WITHIN: Duration = Duration::from_secs(180);

/// All stages of jobs.
pub const KINDS: [(u32, Variety); 6] = [
    (1, Variety::Plain),
    (2, Variety::Plain),
    (3, Variety::Plain),
    (2, Variety::Water),
    (2, Variety::Borders),
    (3, Variety::Borders),
];

/// A mechanism that can be switched off, to show that its absence is noticed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Safeguard {
    /// What comes under an old lease is refused.
    Fence,
    /// A request that comes twice makes one job.
    Requests,
    /// Nobody is answered before the change is on the disk.
    Sync,
    /// Leases of silent workers are taken back.
    Sweeper,
}

/// What runs.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// Of everything.
    pub seed: u64,
    /// Nothing fails.
    pub undisturbed: bool,
    /// What is switched off.
    pub without: Option<Safeguard>,
    /// Partitions and variety of every job; as the seed says where there are none.
    pub jobs: Option<(u32, Variety)>,
}

/// How large what is simulated is, and how it is set up; by seed.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// One a user.
    pub jobs: Vec<WantedJob>,
    /// GPU memory of each worker, bytes; 0 where it does not say.
    pub workers: Vec<u64>,
    lease_ms: u32,
    tenant_parallel: u32,
}

/// What a user wants.
#[derive(Clone, Debug)]
pub struct WantedJob {
    /// Its partitions.
    pub partitions: u32,
    /// Its stages.
    pub variety: Variety,
    /// Its tasks that may be worked on at a time; 0: no limit.
    pub max_parallel: u32,
    /// Whether its user may change its mind.
    pub may_be_cancelled: bool,
    /// Whether its scene is a dataset first.
    pub has_dataset: bool,
    /// Whether its user deletes it, and its dataset, when all is done.
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
        // One that is too small for some tasks or for all, in some runs.
        let small = random.of(&[0, 0, 1 << 20, 100 << 20]);
        Self {
            jobs,
            workers: vec![0, 0, small],
            lease_ms: random.of(&[1500, 3000, 5000]),
            tenant_parallel: random.of(&[0, 0, 1, 2]),
        }
    }
}

/// Whose a user is: the first and the third are of one tenant, and share what it may have.
pub fn tenant_of(user: usize) -> &'static str {
    ["reef", "wreck"][user % 2]
}

/// What everybody shows.
pub struct Tokens {
    /// One a user.
    pub users: Vec<String>,
    /// Of all workers.
    pub worker: String,
    /// Of the operator.
    pub operator: String,
}

/// How often what happened.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Runs.
    pub seeds: u64,
    /// Jobs that were created.
    pub jobs: u64,
    /// Leases that were given.
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
    /// Messages under a lease that was over.
    pub stale: u64,
    /// Messages that came to the store twice.
    pub repeated: u64,
    /// Datasets that were frozen.
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

/// What all hosts of a run share with what is around them.
pub struct World {
    /// Of everything.
    pub seed: u64,
    /// What is simulated.
    pub scenario: Scenario,
    /// What happened.
    pub history: History,
    /// Of the coordinator.
    pub disk: Mutex<Disk>,
    /// What everybody shows.
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
        // Memory, where there is some that looks like files: syncs of real disks are not what is tested here.
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

    /// Where files of this run lie.
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

    /// All jobs of a user have ended and it has seen it.
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

    /// Notes a line in which a token stands.
    pub fn look_for_tokens(&self, line: &str) {
        let Tokens { users, worker, operator } = &self.tokens;
        let mut secrets =
            users.iter().chain([worker, operator]).filter_map(|token| Some(token.rsplit_once('_')?.1));
        if secrets.any(|secret| line.contains(secret)) {
            self.said_tokens.lock().unwrap_or_else(PoisonError::into_inner).push(line.to_owned());
        }
    }

    /// Lines in which a token stood.
    pub fn said_tokens(&self) -> Vec<String> {
        self.said_tokens.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How the coordinator runs.
    pub fn coordinator_config(&self) -> CoordinatorConfig {
        CoordinatorConfig {
            data_dir: self.dir().join("data"),
            lease_ms: self.scenario.lease_ms,
            stall_ms: 0,
            backoff_ms: 300,
            // Often enough that two workers are at one task.
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

/// The coordinator's host: a process, and when that ends, another one.
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

/// What the clock on the wall says to a coordinator that starts `begin` after the first one: in half of the
/// cases somebody has just set it, up to three days back or forth.
fn wall_clock_ms(world: &World, begin: Duration) -> u64 {
    const THREE_DAYS_MS: u64 = 3 * 24 * 3600 * 1000;
    let now = EPOCH_MS + begin.as_millis() as u64;
    let mut random = Random::new(world.seed, &format!("clock from {begin:?} on"));
    if begin.is_zero() || random.permille(500) {
        return now;
    }
    now - THREE_DAYS_MS + random.within(0, 2 * THREE_DAYS_MS)
}

/// A worker's host: as the coordinator's.
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

/// What came of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Run {
    /// A sentence for each invariant that did not hold, which begins with its name.
    pub violations: Vec<String>,
    /// How often what happened.
    pub counts: Counts,
    /// The history, a line a fact.
    pub history: Vec<String>,
    /// Digests of the merged models, by the kind of their jobs.
    pub models: Vec<(String, String)>,
    /// Simulated time.
    pub took: Duration,
    /// The last part of the history.
    pub tail: String,
}

/// Runs one seed and looks at its history. To be called once in a process: tokio counts the runtimes that
/// there were, and what it draws hangs on the number.
///
/// # Panics
/// When the simulation itself fails.
pub fn run(options: &Options) -> Run {
    let options = options.clone();
    // A new thread has drawn nothing yet.
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
        // A host, not a client: how long the run is does not hang on it.
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
        // True at once when all hosts are done, and otherwise of no interest: users say when they are.
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
    let history = world.history.told();
    Run { violations, counts, history, models: found.models, took, tail: world.history.tail(60) }
}
