//! Jobs, events, workers, tenants, tokens, datasets and log lines as JSON: what `--json` of the command line
//! prints, and what the HTTP interface answers.
//!
//! States are words, times are seconds since 1970 or RFC 3339, and a value that is not known is `null`.

use fathom_proto::admin::v1::{Caller, Role, Tenant, Token, Worker, WorkerState};
use fathom_proto::v1::job_event::Event;
use fathom_proto::v1::{
    Dataset, DatasetState, HeldOutMetrics, HistoryPoint, Inspection, Job, JobEvent, JobState, LogEntry,
    LogSeverity, Preview, Rgb, RgbErrors, Stage, Task, TaskHistory, TaskState, TimeSpent, WaterNow,
};
use prost_types::Timestamp;
use serde_json::{Value, json};

/// A time: seconds since 1970, with fractions.
pub fn unix_seconds(time: &Option<Timestamp>) -> Option<f64> {
    time.as_ref().map(|time| time.seconds as f64 + f64::from(time.nanos) * 1e-9)
}

/// The state of a job in a word, without its stage.
pub fn job_state(state: JobState) -> &'static str {
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
pub fn stage(stage: Stage) -> String {
    if stage == Stage::Unspecified { "waiting".to_owned() } else { fathom_proto::stage_name(stage) }
}

/// The state of a task in a word.
pub fn task_state(state: TaskState) -> &'static str {
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
pub fn job(of: &Job) -> Value {
    json!({
        "job": of.job_id,
        "name": of.name,
        "state": job_state(of.state()),
        "stage": stage(of.stage()),
        "progress": of.progress,
        "time_left_seconds": of.time_left_seconds,
        "tenant": of.tenant,
        "dataset": (!of.dataset_id.is_empty()).then_some(&of.dataset_id),
        "plan": of.plan.as_ref().map(|plan| &plan.digest),
        "partitions": of.partitions,
        "priority": of.priority,
        "max_parallel": of.max_parallel,
        "created_unix_seconds": unix_seconds(&of.create_time),
        "ended_unix_seconds": unix_seconds(&of.end_time),
        "pause_reason": (!of.pause_reason.is_empty()).then_some(&of.pause_reason),
        "error": (!of.error.is_empty()).then_some(&of.error),
        "waiting_reason": (!of.waiting_reason.is_empty()).then_some(&of.waiting_reason),
        "waiting_since_unix_seconds": unix_seconds(&of.waiting_since),
        "tasks": of.tasks.iter().map(task).collect::<Vec<_>>(),
    })
}

fn is_per_partition(stage: Stage) -> bool {
    crate::schedule::Stage::from_proto(stage).is_some_and(crate::schedule::Stage::is_per_partition)
}

fn task(of: &Task) -> Value {
    // A finished task only keeps its counts.
    let measured = of.progress.filter(|_| of.state() != TaskState::Done);
    json!({
        "task": of.task_id,
        "stage": stage(of.stage()),
        "partition": is_per_partition(of.stage()).then_some(of.partition),
        "state": task_state(of.state()),
        "attempts": of.attempts,
        "errors": of.errors,
        "losses": of.losses,
        "worker": (!of.worker.is_empty()).then_some(&of.worker),
        "second_worker": (!of.second_worker.is_empty()).then_some(&of.second_worker),
        "iteration": of.progress.map_or(0, |p| p.iteration),
        "iterations": of.progress.map_or(0, |p| p.iterations),
        "gaussians": of.progress.map_or(0, |p| p.gaussians),
        "loss": measured.map(|p| p.loss),
        "iterations_per_second": measured.map(|p| p.iterations_per_second),
        "memory_bytes": (of.memory_bytes > 0).then_some(of.memory_bytes),
        "model": of.model.as_ref().map(|blob| &blob.digest),
        "resumed_from_iteration": of.resumed_from_iteration,
        "checkpoint_iteration": of.checkpoint_iteration,
        "last_errors": of.last_errors,
        "seconds": (of.state() == TaskState::Done).then_some(of.seconds),
    })
}

/// An event as JSON, in the words of `fathom show`; `None` for an event without information.
pub fn event(of: &JobEvent) -> Option<Value> {
    let mut value = match of.event.as_ref()? {
        Event::JobState(change) => {
            json!({"event": "job_state", "state": job_state(change.state()), "message": change.message})
        }
        Event::JobStage(change) => {
            json!({"event": "job_stage", "stage": stage(change.stage()), "tasks": change.tasks})
        }
        Event::TaskChanged(task) => json!({
            "event": "task",
            "task": task.task_id,
            "state": task_state(task.state()),
            "attempt": task.attempt,
            "worker": task.worker,
            "message": task.message,
            "resumed_from_iteration": task.resumed_from_iteration,
        }),
        Event::Progress(update) => json!({
            "event": "progress",
            "task": update.task_id,
            "iteration": update.progress.map_or(0, |p| p.iteration),
            "iterations": update.progress.map_or(0, |p| p.iterations),
            "gaussians": update.progress.map_or(0, |p| p.gaussians),
            "loss": update.progress.map(|p| p.loss),
            "held_out": update.progress.and_then(|p| p.held_out).as_ref().map(held_out),
            "job_progress": update.job_progress,
        }),
        Event::Checkpoint(checkpoint) => json!({
            "event": "checkpoint",
            "task": checkpoint.task_id,
            "attempt": checkpoint.attempt,
            "iteration": checkpoint.iteration,
        }),
        Event::Warning(warning) => json!({"event": "warning", "message": warning.message}),
        Event::Updated(now) => {
            json!({"event": "updated", "priority": now.priority, "max_parallel": now.max_parallel})
        }
        Event::KeepAlive(_) => return None,
    };
    value["time"] = of.time.as_ref().map(Timestamp::to_string).into();
    value["job"] = of.job_id.clone().into();
    value["seq"] = of.seq.into();
    Some(value)
}

/// The curves of a task.
pub fn task_history(of: &TaskHistory) -> Value {
    let point = |point: &HistoryPoint| {
        let progress = point.progress.unwrap_or_default();
        json!({
            "unix_seconds": unix_seconds(&point.time),
            "attempt": point.attempt,
            "iteration": progress.iteration,
            "iterations": progress.iterations,
            "gaussians": progress.gaussians,
            "loss": progress.loss,
            "iterations_per_second": progress.iterations_per_second,
            "memory_bytes": (progress.memory_bytes > 0).then_some(progress.memory_bytes),
            "held_out": progress.held_out.as_ref().map(held_out),
            "water": progress.water.as_ref().map(water),
            "time_spent": progress.time_spent.as_ref().map(time_spent),
        })
    };
    let preview = |of: &Preview| {
        json!({
            "view": of.view,
            "iteration": of.iteration,
            "render": of.render.as_ref().map(|blob| &blob.digest),
            "clear": of.clear.as_ref().map(|blob| &blob.digest),
            "psnr": of.psnr_db,
        })
    };
    json!({
        "task": of.task_id,
        "points": of.points.iter().map(point).collect::<Vec<_>>(),
        "previews": of.previews.iter().map(preview).collect::<Vec<_>>(),
    })
}

fn water(of: &WaterNow) -> Value {
    let rgb = |of: &Option<Rgb>| of.as_ref().map(|of| json!([of.red, of.green, of.blue]));
    let each = |of: &Option<RgbErrors>| of.as_ref().map(|of| json!([of.red, of.green, of.blue]));
    json!({
        "beta_d": rgb(&of.beta_d),
        "beta_b": rgb(&of.beta_b),
        "b_inf": rgb(&of.b_inf),
        "standard_error": of.standard_error.as_ref().map(|of| json!({
            "beta_d": each(&of.beta_d),
            "beta_b": each(&of.beta_b),
            "b_inf": each(&of.b_inf),
        })),
    })
}

fn time_spent(of: &TimeSpent) -> Value {
    json!({
        "seconds": of.seconds,
        "fetching_seconds": of.fetching_seconds,
        "training_seconds": of.training_seconds,
        "photographs_seconds": of.photographs_seconds,
        "watching_seconds": of.watching_seconds,
        "sending_seconds": of.sending_seconds,
        "disk_seconds": of.disk_seconds,
    })
}

fn held_out(of: &HeldOutMetrics) -> Value {
    json!({"iteration": of.iteration, "psnr": of.psnr_db, "ssim": of.ssim, "views": of.views})
}

/// A role, in a word.
pub fn role(role: Role) -> &'static str {
    match role {
        Role::Unspecified => "unknown",
        Role::Viewer => "viewer",
        Role::Submitter => "submitter",
        Role::Operator => "operator",
        Role::Worker => "worker",
    }
}

/// A token, without its secret.
pub fn token(of: &Token) -> Value {
    json!({
        "id": of.token_id,
        "name": of.name,
        "role": role(of.role()),
        "tenant": (!of.tenant.is_empty()).then_some(&of.tenant),
        "job": (!of.job_id.is_empty()).then_some(&of.job_id),
        "created_unix_seconds": unix_seconds(&of.create_time),
        "expires_unix_seconds": unix_seconds(&of.expire_time),
        "revoked_unix_seconds": unix_seconds(&of.revoke_time),
    })
}

/// The caller of a service.
pub fn caller(of: &Caller) -> Value {
    let text = |text: &str| (!text.is_empty()).then(|| text.to_owned());
    json!({
        "name": of.name,
        "role": role(of.role()),
        "tenant": text(&of.tenant),
        "job": text(&of.job_id),
        "expires_unix_seconds": unix_seconds(&of.expire_time),
        "tokens_required": of.tokens_required,
        "version": of.build_version,
    })
}

/// The state of a worker, in a word.
pub fn worker_state(worker: &Worker) -> &'static str {
    match worker.state() {
        _ if !worker.connected => "silent",
        WorkerState::Unspecified => "unknown",
        WorkerState::Active => "active",
        WorkerState::Cordoned => "cordoned",
        WorkerState::Draining => "draining",
    }
}

/// A worker.
pub fn worker(of: &Worker) -> Value {
    let held = of.held.iter();
    json!({
        "worker": of.worker_id,
        "name": of.name,
        "state": worker_state(of),
        "reason": (!of.reason.is_empty()).then_some(&of.reason),
        "last_seen_unix_seconds": unix_seconds(&of.last_seen),
        "adapter": of.adapter,
        "memory_bytes": (of.memory_bytes > 0).then_some(of.memory_bytes),
        "version": of.build_version,
        "stages": of.stages().map(stage).collect::<Vec<_>>(),
        "iterations_per_second": (of.iterations_per_second > 0.0).then_some(of.iterations_per_second),
        "last_words": (!of.last_words.is_empty()).then_some(&of.last_words),
        "last_words_unix_seconds": unix_seconds(&of.last_words_time),
        "held": held
            .map(|held| json!({
                "job": held.job_id,
                "task": held.task_id,
                "attempt": held.attempt,
                "since_unix_seconds": unix_seconds(&held.since),
            }))
            .collect::<Vec<_>>(),
    })
}

/// A tenant with its usage and its limits; `null` for no limit.
pub fn tenant(of: &Tenant) -> Value {
    let quota = of.quota.unwrap_or_default();
    let limit = |most: u64| (most > 0).then_some(most);
    json!({
        "tenant": of.name,
        "open_jobs": of.open_jobs,
        "leased_tasks": of.leased_tasks,
        "bytes": of.bytes,
        "max_open_jobs": limit(quota.max_open_jobs.into()),
        "max_parallel": limit(quota.max_parallel.into()),
        "max_bytes": limit(quota.max_bytes),
        "own_limits": of.quota_is_own,
    })
}

/// What a job would train on.
pub fn inspection(of: &Inspection) -> Value {
    json!({
        "source": of.source,
        "views": of.views,
        "masks": of.masks,
        "held_out": of.held_out,
        "cameras": of.cameras,
        "points": of.points,
        "partitions": of.partitions,
        "unseen": of.unseen,
        "warnings": of.warnings,
    })
}

/// The state of a dataset, in a word.
pub fn dataset_state(dataset: &Dataset) -> &'static str {
    match dataset.state() {
        DatasetState::Unspecified => "unknown",
        DatasetState::Uploading => "uploading",
        DatasetState::Committed => "committed",
    }
}

/// A dataset, without its files.
pub fn dataset(of: &Dataset) -> Value {
    json!({
        "dataset": of.dataset_id,
        "state": dataset_state(of),
        "tenant": of.tenant,
        "root_digest": of.root.as_ref().map(|root| &root.digest),
        "files": of.files,
        "bytes": of.size_bytes,
        "created_unix_seconds": unix_seconds(&of.create_time),
        "committed_unix_seconds": unix_seconds(&of.commit_time),
        "ends_unix_seconds": unix_seconds(&of.expire_time),
    })
}

/// The severity of a log line, in a word.
pub fn severity(of: LogSeverity) -> &'static str {
    match of {
        LogSeverity::Unspecified => "?",
        LogSeverity::Trace => "trace",
        LogSeverity::Debug => "debug",
        LogSeverity::Info => "info",
        LogSeverity::Warn => "warn",
        LogSeverity::Error => "error",
    }
}

/// A log line of a job.
pub fn log_line(of: &LogEntry) -> Value {
    json!({
        "time": of.time.as_ref().map(Timestamp::to_string),
        "level": severity(of.severity()),
        "task": of.task_id,
        "attempt": of.attempt,
        "worker": of.worker,
        "message": of.message,
        "number": of.number,
    })
}

#[cfg(test)]
mod tests {
    use fathom_proto::v1::{JobStateChanged, Progress};

    use super::*;

    #[test]
    fn unknown_fields_of_a_finished_task_are_null() {
        let progress = Progress { iteration: 7, iterations: 7, ..Progress::default() };
        let of = |state: TaskState| {
            task(&Task { progress: Some(progress), state: state.into(), ..Task::default() })
        };
        assert_eq!(
            (&of(TaskState::Done)["loss"], &of(TaskState::Done)["iteration"]),
            (&Value::Null, &7.into())
        );
        assert_eq!(of(TaskState::Leased)["loss"], 0.0);
    }

    #[test]
    fn an_event_has_time_and_job_in_the_words_of_a_job() {
        let changed = JobStateChanged { state: JobState::Running.into(), message: String::new() };
        let of = JobEvent {
            job_id: "j".into(),
            seq: 3,
            time: Some(Timestamp { seconds: 1_700_000_000, nanos: 0 }),
            event: Some(Event::JobState(changed)),
        };
        let value = event(&of).unwrap_or_default();
        assert_eq!(
            value,
            json!({"event": "job_state", "state": "running", "message": "", "time": "2023-11-14T22:13:20Z", "job": "j", "seq": 3})
        );
    }
}
