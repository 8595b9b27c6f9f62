//! Measures the cost of a coordinator with many partitions and workers: acknowledgements, claims, restart,
//! heartbeats.
//!
//! ```text
//! cargo run --release --example service_scale -- [PARTITIONS] [WORKERS] [SECONDS]
//! ```
//! 10,000 partitions, 1000 workers and 60 seconds by default. The store is the real one on the real disk;
//! with `FATHOM_STORE=postgres://…`, that database, which must be empty. The workers call over gRPC on
//! loopback from this process, renew every 15 seconds as with the default lease, and train nothing. The
//! printed CPU time is that of coordinator and workers together.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fathom_coordinator::schedule::{
    Event, JobId, Lease, Planned, PlannedTask, Rules, Stage, TaskOutput, Tenant, WorkerProfile,
};
use fathom_coordinator::store::{
    Claim, NewJob, PostgresOptions, PostgresStore, SledOptions, SledStore, Store,
};
use fathom_coordinator::{CoordinatorConfig, serve};
use fathom_core::scene::BlobRef;
use fathom_proto::dial::{Connection, Dial};
use fathom_proto::v1::{Progress, Stage as SentKind};
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;

#[path = "../../tests/support/memory.rs"]
mod memory;
use memory::resident_mib;

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// Time of the rows.
const NOW_MS: u64 = 1_700_000_000_000;
/// Number of timed acknowledgements.
const ACKNOWLEDGEMENTS: u32 = 2000;
/// Number of concurrent claims.
const CLAIMERS: usize = 8;
/// Connections that the workers share: a thousand sockets of one process measure the process.
const CONNECTIONS: usize = 50;
/// As with a lease of a minute.
const RENEW_EVERY: Duration = Duration::from_secs(15);

#[tokio::main]
async fn main() -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1);
    let mut argument = |default: usize| arguments.next().map_or(Ok(default), |text| text.parse::<usize>());
    let (partitions, workers, seconds) = (argument(10_000)?, argument(1000)?, argument(60)?);
    let dir = std::env::temp_dir().join(format!("fathom-service-scale-{}", std::process::id()));
    let measured = measure(&dir, partitions, workers, seconds as u64).await;
    std::fs::remove_dir_all(&dir)?;
    measured
}

async fn measure(dir: &Path, partitions: usize, workers: usize, seconds: u64) -> Result<(), Failure> {
    let data_dir = dir.join("data");
    let url = std::env::var("FATHOM_STORE").ok();
    let (rules, lease_ms, stall_ms) = (Rules::default(), 60_000, 0);
    let store: Arc<dyn Store> = match &url {
        Some(url) => {
            let options = PostgresOptions { url: url.clone(), rules, lease_ms, stall_ms, connections: 32 };
            Arc::new(PostgresStore::open(&options).await?)
        }
        None => {
            let options = SledOptions { dir: data_dir.join("store"), rules, lease_ms, stall_ms };
            Arc::new(SledStore::open(&options)?)
        }
    };
    acknowledgements(store.as_ref()).await?;
    let job = plan(store.as_ref(), partitions).await?;
    claims(&store, &job, partitions / 2).await?;
    drop(store);

    let begin = Instant::now();
    let config = CoordinatorConfig {
        data_dir,
        store: url,
        listen: ([127, 0, 0, 1], 0).into(),
        min_free_bytes: 0,
        ..CoordinatorConfig::default()
    };
    let coordinator = serve(config).await?;
    println!("restart to ready with {partitions} partitions: {:.0} ms", ms(begin.elapsed()));
    heartbeats(&coordinator.url(), workers, 0, seconds).await?;
    heartbeats(&coordinator.url(), workers, workers, seconds).await?;
    coordinator.stop().await?;
    Ok(())
}

fn blob(name: &str) -> BlobRef {
    BlobRef { digest: blake3::hash(name.as_bytes()).to_hex().to_string(), bytes: name.len() as u64 }
}

fn new_job(number: u32) -> NewJob {
    NewJob {
        announce: false,
        job_id: JobId::new(NOW_MS, number),
        tenant: Tenant::default(),
        request_id: format!("request {number}"),
        name: format!("job {number}"),
        config_json: "{}".into(),
        manifest: blob("manifest"),
        dataset: None,
        ingest_seconds: 0.0,
        priority: 0,
        max_parallel: 0,
    }
}

fn ms(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}

/// One writer, one job after another, each durable before the next.
async fn acknowledgements(store: &dyn Store) -> Result<(), Failure> {
    let mut took = Vec::new();
    for number in 1..=ACKNOWLEDGEMENTS {
        let begin = Instant::now();
        let id = store.submit(new_job(number), NOW_MS).await?.job_id;
        took.push(begin.elapsed());
        store.apply(&id, Event::Cancel { reason: String::new() }, NOW_MS).await?;
    }
    took.sort();
    let at = |share: f64| ms(took[((took.len() - 1) as f64 * share) as usize]);
    println!(
        "acknowledged CreateJob, one writer: p50 {:.2} ms, p99 {:.1} ms, most {:.0} ms",
        at(0.5),
        at(0.99),
        at(1.0)
    );
    Ok(())
}

/// A job at its partitions.
async fn plan(store: &dyn Store, partitions: usize) -> Result<JobId, Failure> {
    let id = store.submit(new_job(0), NOW_MS).await?.job_id;
    let plan = take(store, Stage::Plan, "plan".into()).await?.ok_or("no plan to make")?;
    let task = |index: u32| {
        let spec = blob(&format!("spec {index}"));
        (
            Stage::Partition.task_of(index),
            PlannedTask { memory_bytes: 1 << 30, ..PlannedTask::new(spec, 1000) },
        )
    };
    let own = [Stage::Merge, Stage::Artifacts].map(|stage| (stage.task(), PlannedTask::default()));
    let tasks = (0..partitions as u32).map(task).chain(own).collect();
    let output = TaskOutput::planned(blob("plan"), blob("picture"), Planned { tasks, warnings: Vec::new() });
    let begin = Instant::now();
    store.complete(&plan, output, NOW_MS).await?;
    println!("a plan of {partitions} partitions is durable after {:.0} ms", ms(begin.elapsed()));
    Ok(id)
}

async fn take(store: &dyn Store, stage: Stage, request_id: String) -> Result<Option<Lease>, Failure> {
    let worker = WorkerProfile {
        name: "bench".into(),
        incarnation: "bench".into(),
        stages: vec![stage],
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes: None,
        tenant: None,
    };
    let claim = Claim { worker, peers: Arc::default(), request_id };
    Ok(store.claim(&claim, NOW_MS).await?.map(|grant| grant.lease))
}

/// Several concurrent claims, each lease durable before its use, and their results.
async fn claims(store: &Arc<dyn Store>, job: &JobId, count: usize) -> Result<(), Failure> {
    let begin = Instant::now();
    let lanes = (0..CLAIMERS).map(|lane| {
        let store = Arc::clone(store);
        tokio::spawn(async move {
            let mut leases = Vec::new();
            for call in 0..count / CLAIMERS {
                let lease = take(store.as_ref(), Stage::Partition, format!("{lane} {call}")).await?;
                leases.push(lease.ok_or("nothing left to claim")?);
            }
            Ok::<_, Failure>(leases)
        })
    });
    let mut leases = Vec::new();
    for lane in lanes.collect::<Vec<_>>() {
        leases.extend(lane.await??);
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!("durable claims, {CLAIMERS} at once: {:.0}/s", leases.len() as f64 / seconds);
    let begin = Instant::now();
    for lease in &leases {
        let output = TaskOutput::of(lease.task.stage, blob(&lease.task.to_string()), Default::default());
        store.complete(lease, output, NOW_MS).await?;
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!("durable results, one after another: {:.0}/s", leases.len() as f64 / seconds);
    let view = store.job(job).await?;
    let done = view.tasks.iter().filter(|(task, _)| task.task.stage == Stage::Partition && task.fence > 0);
    assert_eq!(done.count(), leases.len(), "a task was claimed twice");
    Ok(())
}

/// Workers that each renew a lease.
async fn heartbeats(url: &str, workers: usize, waiting: usize, seconds: u64) -> Result<(), Failure> {
    let lines: Vec<Connection> =
        (0..CONNECTIONS).map(|_| Dial::to(url).lazily()).collect::<Result<_, _>>()?;
    let renewals = Arc::new(AtomicU64::new(0));
    let begin = Instant::now();
    let mut living = Vec::new();
    for number in 0..workers {
        let mut client = WorkerServiceClient::new(lines[number % CONNECTIONS].clone());
        let lease = join(&mut client, number).await?;
        let renewals = Arc::clone(&renewals);
        living.push(tokio::spawn(async move {
            // Spread over the period, like workers that started at different times.
            tokio::time::sleep(RENEW_EVERY.mul_f64((number as f64 * 0.618) % 1.0)).await;
            let mut iteration = 0;
            loop {
                iteration += 15;
                let progress = Progress { iteration, iterations: 1000, ..Default::default() };
                let renewal = v1::Renewal {
                    lease: Some(lease.clone()),
                    progress: Some(progress),
                    ..Default::default()
                };
                let request =
                    v1::RenewRequest { incarnation: incarnation_of(number), renewals: vec![renewal] };
                let answer = client.renew(request).await?.into_inner();
                if answer.outcomes.iter().any(|outcome| outcome.verdict() != v1::RenewVerdict::Continue) {
                    return Err::<(), Failure>("a lease that was renewed is over".into());
                }
                renewals.fetch_add(1, Ordering::Relaxed);
                tokio::time::sleep(RENEW_EVERY).await;
            }
        }));
    }
    println!("{workers} workers registered and took a task each in {:.1} s", begin.elapsed().as_secs_f64());
    let idle: Vec<_> = (0..waiting)
        .map(|number| {
            tokio::spawn(wait(
                WorkerServiceClient::new(lines[number % CONNECTIONS].clone()),
                workers + number,
            ))
        })
        .collect();
    tokio::time::sleep(Duration::from_secs(5)).await;
    let (memory, cpu, counted) = (resident_mib(), cpu_seconds(), renewals.load(Ordering::Relaxed));
    let began = Instant::now();
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    let share = (cpu_seconds() - cpu) / began.elapsed().as_secs_f64();
    let rate = (renewals.load(Ordering::Relaxed) - counted) as f64 / began.elapsed().as_secs_f64();
    println!(
        "{workers} workers that renew ({rate:.0} renewals/s) and {waiting} that wait for work, {seconds} s: {:.1} % of a core for both \
         sides, {memory:.0} MiB before and {:.0} MiB after",
        100.0 * share,
        resident_mib()
    );
    for worker in idle {
        if worker.is_finished() {
            worker.await??;
        } else {
            worker.abort();
        }
    }
    for worker in living {
        if worker.is_finished() {
            worker.await??;
        } else {
            worker.abort();
        }
    }
    Ok(())
}

/// A worker that waits for a stage without tasks.
async fn wait(mut client: WorkerServiceClient<Connection>, number: usize) -> Result<(), Failure> {
    register(&mut client, number, SentKind::Borders).await?;
    for call in 0.. {
        let request_id = format!("{} {call}", name_of(number));
        let claim = v1::ClaimRequest { incarnation: incarnation_of(number), request_id, wait_ms: 10_000 };
        if client.claim(claim).await?.into_inner().assignment.is_some() {
            return Err("a worker that takes no partitions was given one".into());
        }
    }
    Ok(())
}

/// The incarnation of a worker: a UUID, as workers have it.
fn incarnation_of(number: usize) -> String {
    uuid::Builder::from_random_bytes((number as u128).to_be_bytes()).into_uuid().to_string()
}

fn name_of(number: usize) -> String {
    format!("worker {number}")
}

async fn join(client: &mut WorkerServiceClient<Connection>, number: usize) -> Result<v1::Lease, Failure> {
    register(client, number, SentKind::Partition).await?;
    let claim = v1::ClaimRequest {
        incarnation: incarnation_of(number),
        request_id: name_of(number),
        wait_ms: 10_000,
    };
    let assignment = client.claim(claim).await?.into_inner().assignment;
    assignment.and_then(|assignment| assignment.lease).ok_or_else(|| "no task for a worker".into())
}

async fn register(
    client: &mut WorkerServiceClient<Connection>,
    number: usize,
    kind: SentKind,
) -> Result<(), Failure> {
    let capabilities = v1::Capabilities { stages: vec![kind.into()], ..Default::default() };
    let register = v1::RegisterRequest {
        worker_name: name_of(number),
        incarnation: incarnation_of(number),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        capabilities: Some(capabilities),
        ..Default::default()
    };
    client.register(register).await?;
    Ok(())
}

/// CPU seconds of this process.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which may hold spaces: the 12th and 13th are user and system time, in hundredths.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |index: usize| fields.get(index).and_then(|ticks| ticks.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}
