//! `fathom show`: one job with its tasks.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use clap::Args;
use fathom_coordinator::json;
use fathom_proto::v1::{Job, JobState, Task, TaskState};

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
        return output::json(&json::job(&job));
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
    let mut line = format!("{:<16} {:<9} {}", task.task_id, json::task_state(task.state()), known.join(", "));
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
        JobState::Running | JobState::Unspecified => json::stage(job.stage()),
        state => json::job_state(state).to_owned(),
    }
}

#[cfg(test)]
mod tests {
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
}
