//! Measures claims and renewals over gRPC, beside the same claims as bare SQL.
//!
//! ```text
//! cargo run --example claim_scale -- [PARTITIONS] [ROUNDS]
//! ```
//! 10,000 partitions of one job and 5 rounds by default, on a store in a data directory; with
//! `FATHOM_STORE=postgres://…`, on that database, which must be empty. In each round 8 clients claim tasks at
//! once over gRPC, each claim durable before its answer. With a database, 8 connections then take as many
//! rows of one table with `FOR UPDATE SKIP LOCKED` and a fence from a sequence, without events, limits and
//! leases. Both are on the same disk, seconds apart, so their ratio is fair. Then 1000 workers renew.

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fathom_coordinator::schedule::{
    JobId, Planned, PlannedTask, Rules, Stage, TaskOutput, Tenant, WorkerProfile,
};
use fathom_coordinator::store::{
    Claim, NewJob, PostgresOptions, PostgresStore, SledOptions, SledStore, Store,
};
use fathom_coordinator::{CoordinatorConfig, serve};
use fathom_core::scene::BlobRef;
use fathom_proto::dial::{Connection, Dial};
use fathom_proto::v1::{Progress, Stage as SentStage};
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use sqlx::postgres::PgPoolOptions;
use sqlx::{Executor as _, PgPool};

type Failure = Box<dyn std::error::Error + Send + Sync>;
type Client = WorkerServiceClient<Connection>;

/// Time of the rows.
const NOW_MS: u64 = 1_700_000_000_000;
/// Number of concurrent claims.
const CLAIMERS: usize = 8;
/// Workers that renew at the end.
const WORKERS: usize = 1000;

#[tokio::main]
async fn main() -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1);
    let mut argument = |default: usize| arguments.next().map_or(Ok(default), |text| text.parse::<usize>());
    let (partitions, rounds) = (argument(10_000)?, argument(5)?);
    let dir = std::env::temp_dir().join(format!("fathom-claim-scale-{}", std::process::id()));
    let measured = measure(&dir, partitions, rounds).await;
    std::fs::remove_dir_all(&dir)?;
    measured
}

async fn measure(dir: &Path, partitions: usize, rounds: usize) -> Result<(), Failure> {
    let data_dir = dir.join("data");
    let url = std::env::var("FATHOM_STORE").ok();
    let (rules, lease_ms, stall_ms) = (Rules::default(), 600_000, 0);
    let store: Box<dyn Store> = match &url {
        Some(url) => {
            let options = PostgresOptions { url: url.clone(), rules, lease_ms, stall_ms, connections: 32 };
            Box::new(PostgresStore::open(&options).await?)
        }
        None => {
            let options = SledOptions { dir: data_dir.join("store"), rules, lease_ms, stall_ms };
            Box::new(SledStore::open(&options)?)
        }
    };
    plan(store.as_ref(), partitions).await?;
    drop(store);
    let bare = match &url {
        Some(url) => Some(bare_table(url, partitions).await?),
        None => None,
    };
    let config = CoordinatorConfig {
        data_dir,
        store: url,
        lease_ms: 600_000,
        listen: ([127, 0, 0, 1], 0).into(),
        min_free_bytes: 0,
        ..CoordinatorConfig::default()
    };
    let coordinator = serve(config).await?;
    let url = coordinator.url();
    let mut claimers = Vec::new();
    for number in 0..CLAIMERS {
        let mut client = Client::new(Dial::to(&url).lazily()?);
        register(&mut client, number).await?;
        claimers.push(client);
    }
    let per_round = (partitions / rounds / CLAIMERS).max(1);
    let (mut leases, mut took) = (Vec::new(), Vec::new());
    for round in 0..rounds {
        let begin = Instant::now();
        let lanes = claimers.iter().enumerate().map(|(number, client)| {
            let client = client.clone();
            tokio::spawn(claims(client, number, round, per_round))
        });
        let mut claimed = 0;
        for lane in lanes.collect::<Vec<_>>() {
            let (of_lane, times) = lane.await??;
            claimed += of_lane.len();
            leases.extend(of_lane);
            took.extend(times);
        }
        let rate = claimed as f64 / begin.elapsed().as_secs_f64();
        let beside = match &bare {
            Some(pool) => {
                let bare = bare_claims(pool, claimed).await?;
                format!(", bare SQL {bare:.0}/s, ratio {:.2}", rate / bare)
            }
            None => String::new(),
        };
        println!("round {round}: {rate:.0} claims/s over gRPC, {CLAIMERS} at once{beside}");
    }
    println!("a claim: {}", spread(&mut took));
    let fences: HashSet<u64> = leases.iter().map(|(_, lease)| lease.fence).collect();
    assert_eq!(fences.len(), leases.len(), "a fence was granted twice");
    let tasks: HashSet<&str> = leases.iter().map(|(_, lease)| lease.task_id.as_str()).collect();
    assert_eq!(tasks.len(), leases.len(), "a task was granted twice");
    renewals(claimers, leases).await?;
    coordinator.stop().await?;
    Ok(())
}

/// Claims of one client, one after another, and how long each took.
async fn claims(
    mut client: Client,
    number: usize,
    round: usize,
    count: usize,
) -> Result<(Vec<(usize, v1::Lease)>, Vec<Duration>), Failure> {
    let (mut leases, mut took) = (Vec::new(), Vec::new());
    for call in 0..count {
        let request_id = format!("{number} {round} {call}");
        let begin = Instant::now();
        let claim = v1::ClaimRequest { incarnation: incarnation_of(number), request_id, wait_ms: 0 };
        let assignment = client.claim(claim).await?.into_inner().assignment;
        took.push(begin.elapsed());
        leases.push((number, assignment.and_then(|given| given.lease).ok_or("nothing left to claim")?));
    }
    Ok((leases, took))
}

/// A thousand leases are renewed one at a time by their clients, as by as many workers.
async fn renewals(claimers: Vec<Client>, leases: Vec<(usize, v1::Lease)>) -> Result<(), Failure> {
    let mut took = Vec::new();
    let begin = Instant::now();
    let leases: Vec<_> = leases.into_iter().take(WORKERS).collect();
    let count = leases.len();
    let mut by_client: Vec<Vec<v1::Lease>> = vec![Vec::new(); CLAIMERS];
    for (number, lease) in leases {
        by_client[number].push(lease);
    }
    let lanes = claimers.into_iter().zip(by_client).enumerate().map(|(number, (mut client, leases))| {
        tokio::spawn(async move {
            let mut took = Vec::new();
            for lease in leases {
                let progress = Progress { iteration: 1, iterations: 1000, ..Default::default() };
                let renewal =
                    v1::Renewal { lease: Some(lease), progress: Some(progress), ..Default::default() };
                let request =
                    v1::RenewRequest { incarnation: incarnation_of(number), renewals: vec![renewal] };
                let begin = Instant::now();
                let answer = client.renew(request).await?.into_inner();
                took.push(begin.elapsed());
                if answer.outcomes.iter().any(|outcome| outcome.verdict() != v1::RenewVerdict::Continue) {
                    return Err::<_, Failure>("a lease that was renewed is over".into());
                }
            }
            Ok(took)
        })
    });
    for lane in lanes.collect::<Vec<_>>() {
        took.extend(lane.await??);
    }
    let rate = count as f64 / begin.elapsed().as_secs_f64();
    println!("a renewal, {CLAIMERS} at once, {rate:.0}/s: {}", spread(&mut took));
    Ok(())
}

fn spread(took: &mut [Duration]) -> String {
    took.sort();
    let at = |share: f64| 1e3 * took[((took.len() - 1) as f64 * share) as usize].as_secs_f64();
    format!("p50 {:.1} ms, p99 {:.1} ms, most {:.0} ms ({} of them)", at(0.5), at(0.99), at(1.0), took.len())
}

/// A table of as many tasks, and connections to it.
async fn bare_table(url: &str, tasks: usize) -> Result<PgPool, Failure> {
    let pool = PgPoolOptions::new().max_connections(CLAIMERS as u32).connect(url).await?;
    pool.execute("DROP TABLE IF EXISTS bare_tasks; DROP SEQUENCE IF EXISTS bare_fences").await?;
    pool.execute(
        "CREATE TABLE bare_tasks (id bigint PRIMARY KEY, state text NOT NULL, worker text, fence bigint); \
         CREATE INDEX bare_ready ON bare_tasks (id) WHERE state = 'ready'; \
         CREATE SEQUENCE bare_fences",
    )
    .await?;
    sqlx::query("INSERT INTO bare_tasks SELECT id, 'ready' FROM generate_series(1, $1) AS id")
        .bind(tasks as i64)
        .execute(&pool)
        .await?;
    pool.execute("ANALYZE bare_tasks").await?;
    Ok(pool)
}

/// Rows per second that as many connections take.
async fn bare_claims(pool: &PgPool, count: usize) -> Result<f64, Failure> {
    let begin = Instant::now();
    let lanes = (0..CLAIMERS).map(|number| {
        let pool = pool.clone();
        tokio::spawn(async move {
            for _ in 0..count / CLAIMERS {
                let taken: Option<(i64, i64)> = sqlx::query_as(
                    "UPDATE bare_tasks SET state = 'leased', worker = $1, fence = nextval('bare_fences') \
                     WHERE id = (SELECT id FROM bare_tasks WHERE state = 'ready' ORDER BY id LIMIT 1 \
                     FOR UPDATE SKIP LOCKED) RETURNING id, fence",
                )
                .bind(incarnation_of(number))
                .fetch_optional(&pool)
                .await?;
                taken.ok_or("nothing left to take")?;
            }
            Ok::<_, Failure>(())
        })
    });
    for lane in lanes.collect::<Vec<_>>() {
        lane.await??;
    }
    Ok(count as f64 / begin.elapsed().as_secs_f64())
}

fn blob(name: &str) -> BlobRef {
    BlobRef { digest: blake3::hash(name.as_bytes()).to_hex().to_string(), bytes: name.len() as u64 }
}

/// A job at its partitions.
async fn plan(store: &dyn Store, partitions: usize) -> Result<(), Failure> {
    let new = NewJob {
        announce: false,
        job_id: JobId::new(NOW_MS, 0),
        tenant: Tenant::default(),
        request_id: "request".into(),
        name: "job".into(),
        config_json: "{}".into(),
        manifest: blob("manifest"),
        dataset: None,
        ingest_seconds: 0.0,
        priority: 0,
        max_parallel: 0,
    };
    store.submit(new, NOW_MS).await?;
    let worker = WorkerProfile {
        name: "plan".into(),
        incarnation: "plan".into(),
        stages: vec![Stage::Plan],
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes: None,
        tenant: None,
    };
    let claim = Claim { worker, peers: Arc::default(), request_id: "plan".into() };
    let plan = store.claim(&claim, NOW_MS).await?.ok_or("no plan to make")?.lease;
    let task = |index: u32| {
        let spec = blob(&format!("spec {index}"));
        let task = PlannedTask { memory_bytes: 1 << 30, ..PlannedTask::new(spec, 1000) };
        (Stage::Partition.task_of(index), task)
    };
    let own = [Stage::Merge, Stage::Artifacts].map(|stage| (stage.task(), PlannedTask::default()));
    let tasks = (0..partitions as u32).map(task).chain(own).collect();
    let output = TaskOutput::planned(blob("plan"), blob("picture"), Planned { tasks, warnings: Vec::new() });
    store.complete(&plan, output, NOW_MS).await?;
    Ok(())
}

/// The incarnation of a client: a UUID, as workers have it.
fn incarnation_of(number: usize) -> String {
    uuid::Builder::from_random_bytes((number as u128).to_be_bytes()).into_uuid().to_string()
}

async fn register(client: &mut Client, number: usize) -> Result<(), Failure> {
    let capabilities = v1::Capabilities { stages: vec![SentStage::Partition.into()], ..Default::default() };
    let register = v1::RegisterRequest {
        worker_name: format!("worker {number}"),
        incarnation: incarnation_of(number),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        capabilities: Some(capabilities),
        ..Default::default()
    };
    client.register(register).await?;
    Ok(())
}
