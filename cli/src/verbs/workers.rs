//! `fathom workers`, `cordon`, `drain`, `uncordon`: the workers of a service, and which of them take tasks.

use clap::Args;
use fathom_observe::shown;
use fathom_proto::admin::v1::{Worker, WorkerState};
use serde_json::{Value, json};

use super::ServiceArgs;
use super::show::stage_word;
use crate::client::Client;
use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom workers`.
#[derive(Args, Debug)]
pub struct WorkersArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Which worker.
#[derive(Args, Debug)]
pub struct OneWorker {
    /// Its name, where no other has it, or its id (`fathom workers`)
    #[arg(value_name = "WORKER")]
    worker: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Which worker, and why.
#[derive(Args, Debug)]
pub struct MarkArgs {
    #[command(flatten)]
    which: OneWorker,
    /// Why, for those who look at it later
    #[arg(long, default_value = "", hide_default_value = true)]
    reason: String,
}

pub async fn list(args: WorkersArgs) -> Result<()> {
    let client = args.service.client().await?;
    let workers = client.workers().await?;
    if args.json {
        return output::json(&workers.iter().map(worker_json).collect::<Vec<_>>());
    }
    if workers.is_empty() {
        output::line(format!("no workers at {}", client.url));
    }
    workers.iter().for_each(|worker| output::line(worker_line(worker)));
    Ok(())
}

pub async fn cordon(args: MarkArgs) -> Result<()> {
    let client = args.which.service.client().await?;
    let id = id_of(&client, &args.which.worker).await?;
    tell(&client.cordon(&id, &args.reason).await?, args.which.json)
}

pub async fn drain(args: MarkArgs) -> Result<()> {
    let client = args.which.service.client().await?;
    let id = id_of(&client, &args.which.worker).await?;
    tell(&client.drain(&id, &args.reason).await?, args.which.json)
}

pub async fn uncordon(args: OneWorker) -> Result<()> {
    let client = args.service.client().await?;
    let id = id_of(&client, &args.worker).await?;
    tell(&client.uncordon(&id).await?, args.json)
}

/// The id of a worker that is given by its id or by a name that it alone has among those that are connected.
async fn id_of(client: &Client, given: &str) -> Result<String> {
    let workers = client.workers().await?;
    if workers.iter().any(|worker| worker.worker_id == given) {
        return Ok(given.to_owned());
    }
    let named: Vec<&Worker> =
        workers.iter().filter(|worker| worker.name == given && worker.connected).collect();
    match named.as_slice() {
        [one] => Ok(one.worker_id.clone()),
        [] => Err(CliError::Message(format!(
            "there is no worker {given} at {}; `fathom workers` lists those that there are",
            client.url
        ))),
        several => Err(CliError::Message(format!(
            "{} workers have the name {given}; give one of their ids: {}",
            several.len(),
            several.iter().map(|worker| shown(&worker.worker_id)).collect::<Vec<_>>().join(", ")
        ))),
    }
}

fn tell(worker: &Worker, json: bool) -> Result<()> {
    if json {
        return output::json(&worker_json(worker));
    }
    output::line(worker_line(worker));
    Ok(())
}

fn worker_line(worker: &Worker) -> String {
    let mut line = format!("{}  {:<9} {}", worker.worker_id, state_word(worker), worker.name);
    if !worker.adapter.is_empty() {
        line += &format!(", {}", worker.adapter);
    }
    if worker.memory_bytes > 0 {
        line += &format!(", {:.1} GiB", worker.memory_bytes as f64 / f64::from(1_u32 << 30));
    }
    for held in &worker.held {
        line += &format!("; {} of {}", held.task_id, held.job_id);
    }
    if !worker.reason.is_empty() {
        line += &format!(" ({})", worker.reason);
    }
    line
}

/// What it is given, unless nobody has heard of it.
fn state_word(worker: &Worker) -> &'static str {
    match worker.state() {
        _ if !worker.connected => "silent",
        WorkerState::Unspecified => "unknown",
        WorkerState::Active => "active",
        WorkerState::Cordoned => "cordoned",
        WorkerState::Draining => "draining",
    }
}

fn worker_json(worker: &Worker) -> Value {
    let held = worker.held.iter();
    json!({
        "worker": worker.worker_id,
        "name": worker.name,
        "state": state_word(worker),
        "reason": (!worker.reason.is_empty()).then_some(&worker.reason),
        "last_seen_unix_seconds": output::unix_seconds(&worker.last_seen),
        "adapter": worker.adapter,
        "memory_bytes": (worker.memory_bytes > 0).then_some(worker.memory_bytes),
        "version": worker.build_version,
        "stages": worker.stages().map(stage_word).collect::<Vec<_>>(),
        "held": held
            .map(|held| json!({
                "job": held.job_id,
                "task": held.task_id,
                "attempt": held.attempt,
                "since_unix_seconds": output::unix_seconds(&held.since),
            }))
            .collect::<Vec<_>>(),
    })
}
