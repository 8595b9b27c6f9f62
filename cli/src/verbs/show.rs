//! `fathom show`: one job with its tasks.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use clap::Args;
use fathom_proto::v1::{Job, JobStage, JobState, Task, TaskKind, TaskState};
use serde_json::{Value, json};

use super::ServiceArgs;
use crate::error::Result;
use crate::output;

/// Arguments of `fathom show`.
#[derive(Args, Debug)]
pub struct ShowArgs {
    /// Which job
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: ShowArgs) -> Result<()> {
    let client = args.service.client().await?;
    let job = client.job(&args.job).await?;
    if args.json {
        return output::json(&job_json(&job));
    }
    output::line(format!("job {}  {}", job.job_id, job.name));
    let left = job.time_left_seconds.map(|seconds| format!(", about {} left", output::duration(seconds)));
    output::line(format!(
        "  {}, {:.0} % done{}",
        state_word(&job),
        100.0 * job.progress,
        left.unwrap_or_default()
    ));
    if !job.waiting_reason.is_empty() {
        let since = job.waiting_since.as_ref().map(waited).unwrap_or_default();
        output::line(format!("  waits{since}: {}", job.waiting_reason));
    }
    if !job.error.is_empty() {
        output::line(format!("  {}", job.error));
    }
    for task in &job.tasks {
        output::line(format!("  {}", task_line(task)));
    }
    Ok(())
}

/// " for 12 min".
fn waited(since: &prost_types::Timestamp) -> String {
    let since = Duration::new(since.seconds.max(0).unsigned_abs(), since.nanos.max(0).unsigned_abs());
    // A clock of the coordinator that is ahead of ours: it has just begun.
    let waited = SystemTime::now().duration_since(UNIX_EPOCH + since).unwrap_or_default().as_secs();
    match waited {
        0..120 => format!(" for {waited} s"),
        120..7200 => format!(" for {} min", waited / 60),
        _ => format!(" for {} h", waited / 3600),
    }
}

fn task_line(task: &Task) -> String {
    let mut line = format!("{:<16} {:<9}", task.task_id, task_word(task.state()));
    if let Some(progress) = &task.progress {
        line += &format!(
            " {}/{} iterations, {} Gaussians",
            progress.iteration, progress.iterations, progress.gaussians
        );
    }
    if task.attempts > 1 {
        line += &format!(", attempt {}", task.attempts);
        if task.resumed_from_iteration > 0 {
            line += &format!(" from iteration {}", task.resumed_from_iteration);
        }
    }
    if !task.worker.is_empty() {
        line += &format!(", {}", task.worker);
    }
    if !task.second_worker.is_empty() {
        line += &format!(" (slow; {} too)", task.second_worker);
    }
    if let Some(error) = task.last_errors.last() {
        line += &format!("; last error: {error}");
    }
    line
}

/// "partitions" while running, otherwise how it ended.
pub fn state_word(job: &Job) -> &'static str {
    match job.state() {
        JobState::Succeeded => "succeeded",
        JobState::Failed => "failed",
        JobState::Cancelled => "cancelled",
        JobState::Paused => "paused",
        JobState::Running | JobState::Unspecified => stage_word(job.stage()),
    }
}

/// The stage in a word.
pub fn stage_word(stage: JobStage) -> &'static str {
    match stage {
        JobStage::Unspecified => "waiting",
        JobStage::Planning => "planning",
        JobStage::Global => "global",
        JobStage::Select => "select",
        JobStage::Refine => "refine",
        JobStage::Consensus => "consensus",
        JobStage::Partitions => "partitions",
        JobStage::Merge => "merge",
        JobStage::Borders => "borders",
        JobStage::Evaluate => "evaluate",
        JobStage::Artifacts => "artifacts",
    }
}

/// The state of a task in a word.
pub fn task_word(state: TaskState) -> &'static str {
    match state {
        TaskState::Unspecified => "unknown",
        TaskState::Blocked => "blocked",
        TaskState::Ready => "ready",
        TaskState::Leased => "running",
        TaskState::Done => "done",
        TaskState::Dead => "failed",
        TaskState::Cancelled => "cancelled",
    }
}

fn kind_word(kind: TaskKind) -> &'static str {
    match kind {
        TaskKind::Unspecified => "unknown",
        TaskKind::Plan => "plan",
        TaskKind::Global => "global",
        TaskKind::Select => "select",
        TaskKind::Refine => "refine",
        TaskKind::Consensus => "consensus",
        TaskKind::Partition => "partition",
        TaskKind::Merge => "merge",
        TaskKind::Borders => "borders",
        TaskKind::Evaluate => "evaluate",
        TaskKind::Artifacts => "artifacts",
    }
}

/// A job as JSON, with words for states.
pub fn job_json(job: &Job) -> Value {
    let seconds = |time: &Option<prost_types::Timestamp>| {
        time.as_ref().map(|time| time.seconds as f64 + f64::from(time.nanos) * 1e-9)
    };
    json!({
        "job": job.job_id,
        "name": job.name,
        "state": match job.state() {
            JobState::Unspecified => "unknown",
            JobState::Running => "running",
            JobState::Succeeded => "succeeded",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
            JobState::Paused => "paused",
        },
        "stage": stage_word(job.stage()),
        "progress": job.progress,
        "time_left_seconds": job.time_left_seconds,
        "tenant": job.tenant,
        "dataset": (!job.dataset_id.is_empty()).then_some(&job.dataset_id),
        "partitions": job.partitions,
        "priority": job.priority,
        "max_parallel": job.max_parallel,
        "created_unix_seconds": seconds(&job.create_time),
        "ended_unix_seconds": seconds(&job.end_time),
        "error": (!job.error.is_empty()).then_some(&job.error),
        "waiting_reason": (!job.waiting_reason.is_empty()).then_some(&job.waiting_reason),
        "waiting_since_unix_seconds": seconds(&job.waiting_since),
        "tasks": job.tasks.iter().map(task_json).collect::<Vec<_>>(),
    })
}

fn task_json(task: &Task) -> Value {
    json!({
        "task": task.task_id,
        "kind": kind_word(task.kind()),
        "partition": matches!(task.kind(), TaskKind::Partition | TaskKind::Refine).then_some(task.partition),
        "state": task_word(task.state()),
        "attempts": task.attempts,
        "errors": task.errors,
        "losses": task.losses,
        "worker": (!task.worker.is_empty()).then_some(&task.worker),
        "second_worker": (!task.second_worker.is_empty()).then_some(&task.second_worker),
        "iteration": task.progress.map_or(0, |p| p.iteration),
        "iterations": task.progress.map_or(0, |p| p.iterations),
        "gaussians": task.progress.map_or(0, |p| p.gaussians),
        "loss": task.progress.map(|p| p.loss),
        "iterations_per_second": task.progress.map(|p| p.iterations_per_second),
        "memory_bytes": (task.memory_bytes > 0).then_some(task.memory_bytes),
        "resumed_from_iteration": task.resumed_from_iteration,
        "checkpoint_iteration": task.checkpoint_iteration,
        "last_errors": task.last_errors,
        "seconds": task.seconds,
    })
}
