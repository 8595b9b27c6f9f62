//! `fathom show`: one job with its tasks.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use clap::Args;
use fathom_coordinator::schedule;
use fathom_proto::stage_name;
use fathom_proto::v1::{Job, JobState, Stage, Task, TaskState};
use serde_json::{Value, json};

use super::ServiceArgs;
use crate::error::Result;
use crate::output;

/// Arguments of `fathom show`.
#[derive(Args, Debug)]
pub struct ShowArgs {
    /// Id of the job
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
    if !job.pause_reason.is_empty() {
        output::line(format!("  paused because: {}", job.pause_reason));
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
    // If the coordinator's clock is ahead of ours, the attempt has just started.
    let waited = SystemTime::now().duration_since(UNIX_EPOCH + since).unwrap_or_default().as_secs();
    match waited {
        0..120 => format!(" for {waited} s"),
        120..7200 => format!(" for {} min", waited / 60),
        _ => format!(" for {} h", waited / 3600),
    }
}

fn task_line(task: &Task) -> String {
    let mut known = Vec::new();
    if let Some(progress) = &task.progress {
        known.push(format!(
            "{}/{} iterations, {} Gaussians",
            progress.iteration, progress.iterations, progress.gaussians
        ));
    } else if task.checkpoint_iteration > 0 && task.state() != TaskState::Done {
        known.push(format!("checkpoint at iteration {}", task.checkpoint_iteration));
    }
    if task.attempts > 1 {
        let from = match task.resumed_from_iteration {
            0 => String::new(),
            iteration => format!(" from iteration {iteration}"),
        };
        known.push(format!("attempt {}{from}", task.attempts));
    }
    if !task.worker.is_empty() {
        let too = match task.second_worker.as_str() {
            "" => String::new(),
            second => format!(" (slow; {second} too)"),
        };
        known.push(format!("{}{too}", task.worker));
    }
    let mut line = format!("{:<16} {:<9} {}", task.task_id, task_word(task.state()), known.join(", "));
    if let Some(error) = task.last_errors.last() {
        line.truncate(line.trim_end().len());
        line += &format!("; last error: {error}");
    }
    line.truncate(line.trim_end().len());
    line
}

/// The stage of a running job, otherwise its state.
pub fn state_word(job: &Job) -> String {
    match job.state() {
        JobState::Running | JobState::Unspecified => stage_word(job.stage()),
        state => job_state_word(state).to_owned(),
    }
}

/// The state of a job in a word, without its stage.
pub fn job_state_word(state: JobState) -> &'static str {
    match state {
        JobState::Unspecified => "unknown",
        JobState::Running => "running",
        JobState::Succeeded => "succeeded",
        JobState::Failed => "failed",
        JobState::Cancelled => "cancelled",
        JobState::Paused => "paused",
    }
}

/// The stage of a job or a task in a word.
pub fn stage_word(stage: Stage) -> String {
    if stage == Stage::Unspecified { "waiting".to_owned() } else { stage_name(stage) }
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

/// A job as JSON, with words for states.
pub fn job_json(job: &Job) -> Value {
    let seconds = output::unix_seconds;
    json!({
        "job": job.job_id,
        "name": job.name,
        "state": job_state_word(job.state()),
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
        "pause_reason": (!job.pause_reason.is_empty()).then_some(&job.pause_reason),
        "error": (!job.error.is_empty()).then_some(&job.error),
        "waiting_reason": (!job.waiting_reason.is_empty()).then_some(&job.waiting_reason),
        "waiting_since_unix_seconds": seconds(&job.waiting_since),
        "tasks": job.tasks.iter().map(task_json).collect::<Vec<_>>(),
    })
}

fn is_per_partition(stage: Stage) -> bool {
    schedule::Stage::from_proto(stage).is_some_and(schedule::Stage::is_per_partition)
}

fn task_json(task: &Task) -> Value {
    // A finished task only keeps its counts.
    let measured = task.progress.filter(|_| task.state() != TaskState::Done);
    json!({
        "task": task.task_id,
        "stage": stage_word(task.stage()),
        "partition": is_per_partition(task.stage()).then_some(task.partition),
        "state": task_word(task.state()),
        "attempts": task.attempts,
        "errors": task.errors,
        "losses": task.losses,
        "worker": (!task.worker.is_empty()).then_some(&task.worker),
        "second_worker": (!task.second_worker.is_empty()).then_some(&task.second_worker),
        "iteration": task.progress.map_or(0, |p| p.iteration),
        "iterations": task.progress.map_or(0, |p| p.iterations),
        "gaussians": task.progress.map_or(0, |p| p.gaussians),
        "loss": measured.map(|p| p.loss),
        "iterations_per_second": measured.map(|p| p.iterations_per_second),
        "memory_bytes": (task.memory_bytes > 0).then_some(task.memory_bytes),
        "resumed_from_iteration": task.resumed_from_iteration,
        "checkpoint_iteration": task.checkpoint_iteration,
        "last_errors": task.last_errors,
        "seconds": (task.state() == TaskState::Done).then_some(task.seconds),
    })
}

#[cfg(test)]
mod tests {
    use fathom_proto::v1::Progress;

    use super::*;

    fn task(state: TaskState) -> Task {
        Task { task_id: "merge".into(), state: state.into(), ..Task::default() }
    }

    #[test]
    fn a_line_of_a_task_has_no_empty_columns() {
        let done = Task { worker: "coordinator".into(), ..task(TaskState::Done) };
        assert_eq!(task_line(&done), "merge            done      coordinator");
        assert_eq!(task_line(&task(TaskState::Blocked)), "merge            blocked");
        let failed = Task { last_errors: vec!["no".into()], ..task(TaskState::Dead) };
        assert_eq!(task_line(&failed), "merge            failed; last error: no");
        let held = Task { checkpoint_iteration: 98, ..task(TaskState::Ready) };
        assert_eq!(task_line(&held), "merge            ready     checkpoint at iteration 98");
    }

    #[test]
    fn unknown_fields_of_a_finished_task_are_null() {
        let progress = Progress { iteration: 7, iterations: 7, ..Progress::default() };
        let of = |state| task_json(&Task { progress: Some(progress), ..task(state) });
        assert_eq!(
            (&of(TaskState::Done)["loss"], &of(TaskState::Done)["iteration"]),
            (&Value::Null, &7.into())
        );
        assert_eq!(of(TaskState::Leased)["loss"], 0.0);
    }
}
