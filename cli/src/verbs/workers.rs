//! `fathom worker list`, `cordon`, `drain`, `uncordon`: the workers of a service, and which of them take
//! tasks.

use clap::{Args, Subcommand};
use fathom_coordinator::json;
use fathom_observe::shown;
use fathom_proto::admin::v1::Worker;

use super::ServiceArgs;
use crate::client::Client;
use crate::error::{CliError, Result};
use crate::output;

/// What to do with the workers of a service.
#[derive(Subcommand, Debug)]
pub enum Manage {
    /// List the workers of a service and their tasks
    List(ListArgs),
    /// Let a worker finish its task, and give it no other
    Cordon(MarkArgs),
    /// Take a worker out of service: others continue its tasks from their checkpoints
    Drain(MarkArgs),
    /// Return a cordoned or drained worker to service
    Uncordon(OneWorker),
}

/// Arguments of `fathom worker list`.
#[derive(Args, Debug)]
pub struct ListArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Which worker.
#[derive(Args, Debug)]
pub struct OneWorker {
    /// Name of the worker, if it is unique, or its id (`fathom worker list`)
    #[arg(value_name = "WORKER")]
    worker: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Which worker, and the reason.
#[derive(Args, Debug)]
pub struct MarkArgs {
    #[command(flatten)]
    which: OneWorker,
    /// Reason, which `fathom worker list` shows
    #[arg(long, default_value = "", hide_default_value = true)]
    reason: String,
}

impl Manage {
    pub async fn run(self) -> Result<()> {
        match self {
            Self::List(args) => list(args).await,
            Self::Cordon(args) => cordon(args).await,
            Self::Drain(args) => drain(args).await,
            Self::Uncordon(args) => uncordon(args).await,
        }
    }
}

async fn list(args: ListArgs) -> Result<()> {
    let client = args.service.client().await?;
    let workers = client.workers().await?;
    if args.json {
        return output::json(&workers.iter().map(json::worker).collect::<Vec<_>>());
    }
    if workers.is_empty() {
        output::line(format!("no workers at {}", client.url));
    }
    workers.iter().for_each(|worker| output::line(worker_line(worker)));
    Ok(())
}

async fn cordon(args: MarkArgs) -> Result<()> {
    let client = args.which.service.client().await?;
    let id = id_of(&client, &args.which.worker).await?;
    print(&client.cordon(&id, &args.reason).await?, args.which.json)
}

async fn drain(args: MarkArgs) -> Result<()> {
    let client = args.which.service.client().await?;
    let id = id_of(&client, &args.which.worker).await?;
    print(&client.drain(&id, &args.reason).await?, args.which.json)
}

async fn uncordon(args: OneWorker) -> Result<()> {
    let client = args.service.client().await?;
    let id = id_of(&client, &args.worker).await?;
    print(&client.uncordon(&id).await?, args.json)
}

/// The id of the worker with this id, or of the only connected worker with this name.
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
            "there is no worker {given} at {}; `fathom worker list` lists the workers",
            client.url
        ))),
        several => Err(CliError::Message(format!(
            "{} workers have the name {given}; give one of their ids: {}",
            several.len(),
            several.iter().map(|worker| shown(&worker.worker_id)).collect::<Vec<_>>().join(", ")
        ))),
    }
}

fn print(worker: &Worker, json: bool) -> Result<()> {
    if json {
        return output::json(&json::worker(worker));
    }
    output::line(worker_line(worker));
    Ok(())
}

fn worker_line(worker: &Worker) -> String {
    let mut line = format!("{}  {:<9} {}", worker.worker_id, json::worker_state(worker), worker.name);
    if !worker.adapter.is_empty() {
        line += &format!(", {}", worker.adapter);
    }
    if worker.memory_bytes > 0 {
        line += &format!(", {:.1} GiB", worker.memory_bytes as f64 / f64::from(1_u32 << 30));
    }
    for held in &worker.held {
        line += &format!("; {} of {}", held.task_id, held.job_id);
    }
    if worker.iterations_per_second > 0.0 {
        line += &format!(", {:.1} iterations/s", worker.iterations_per_second);
    }
    if !worker.reason.is_empty() {
        line += &format!(" ({})", worker.reason);
    }
    line
}
