//! `fathom pause`, `resume`, `retry`, `update`, `delete`: control of an existing job.

use clap::Args;
use fathom_coordinator::json;
use fathom_proto::v1::{Job, UpdateJobRequest};
use serde_json::json;

use super::ServiceArgs;
use super::show::state_word;
use crate::error::Result;
use crate::output;

/// The job, and its coordinator.
#[derive(Args, Debug)]
pub struct OneJob {
    /// Id of the job
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Arguments of `fathom pause`.
#[derive(Args, Debug)]
pub struct PauseArgs {
    #[command(flatten)]
    which: OneJob,
    /// The reason, shown with the job
    #[arg(long, default_value = "", hide_default_value = true)]
    reason: String,
}

/// Arguments of `fathom update`.
#[derive(Args, Debug)]
pub struct UpdateArgs {
    #[command(flatten)]
    which: OneJob,
    #[command(flatten)]
    scheduling: SchedulingArgs,
}

/// Priority and parallelism of a job among others.
#[derive(Args, Clone, Copy, Debug)]
pub struct SchedulingArgs {
    /// Priority, -1000 to 1000: workers take tasks of higher priority first; at equal priority, those of the
    /// older job
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = clap::value_parser!(i32).range(-1000..=1000))]
    pub priority: Option<i32>,
    /// Maximum number of tasks of the job that run at a time; 0: no limit
    #[arg(long, value_name = "N")]
    pub max_parallel: Option<u32>,
}

pub async fn pause(args: PauseArgs) -> Result<()> {
    let OneJob { job, service, json } = args.which;
    let job = service.client().await?.pause(&job, &args.reason).await?;
    print_job(&job, json, "workers return their tasks; `fathom resume` continues")
}

pub async fn resume(args: OneJob) -> Result<()> {
    let job = args.service.client().await?.resume(&args.job).await?;
    goes_on(&job, args.json, "resumed")
}

pub async fn retry(args: OneJob) -> Result<()> {
    let job = args.service.client().await?.retry(&args.job).await?;
    goes_on(&job, args.json, "retried")
}

pub async fn update(args: UpdateArgs) -> Result<()> {
    let OneJob { job, service, json } = args.which;
    let SchedulingArgs { priority, max_parallel } = args.scheduling;
    let request = UpdateJobRequest { job_id: job, priority, max_parallel };
    let job = service.client().await?.update(request).await?;
    let limit = match job.max_parallel {
        0 => "no limit on tasks at a time".to_owned(),
        limit => format!("at most {} at a time", output::count(limit, "task")),
    };
    print_job(&job, json, &format!("priority {}, {limit}", job.priority))
}

pub async fn delete(args: OneJob) -> Result<()> {
    args.service.client().await?.delete(&args.job).await?;
    if args.json {
        return output::json(&json!({ "job": args.job, "deleted": true }));
    }
    output::line(format!("job {}: deleted", args.job));
    Ok(())
}

/// "job J: resumed (partitions)".
fn goes_on(job: &Job, json: bool, how: &str) -> Result<()> {
    if json {
        return output::json(&json::job(job));
    }
    output::line(format!("job {}: {how} ({})", job.job_id, state_word(job)));
    Ok(())
}

fn print_job(job: &Job, json: bool, remark: &str) -> Result<()> {
    if json {
        return output::json(&json::job(job));
    }
    let remark = if remark.is_empty() { String::new() } else { format!(" ({remark})") };
    output::line(format!("job {}: {}{remark}", job.job_id, state_word(job)));
    Ok(())
}
