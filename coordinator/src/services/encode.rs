//! Conversions between rows and messages.

use fathom_core::config::Method;
use fathom_core::scene::BlobRef;
use fathom_proto::{v1, worker::v1 as worker_v1};
use prost_types::Timestamp;

use crate::capacity::Gap;
use crate::schedule::{
    Artifact, EventBody, FailClass, HeldOut, JobRecord, JobState, Lease, LiveProgress, Stage, TaskChange,
    TaskRecord, TaskState, TaskStats, time_left,
};
use crate::service_error::ServiceError;
use crate::store::{Grant, JobView, StoredEvent};

pub fn blob(blob: &BlobRef) -> v1::BlobRef {
    v1::BlobRef { digest: blob.digest.clone(), size_bytes: blob.bytes }
}

/// A required reference.
pub fn required_blob(field: &'static str, blob: Option<v1::BlobRef>) -> Result<BlobRef, ServiceError> {
    let missing = || ServiceError::BadArgument { field, message: "is missing".into() };
    let v1::BlobRef { digest, size_bytes } = blob.ok_or_else(missing)?;
    Ok(BlobRef { digest, bytes: size_bytes })
}

/// Additional results of a worker's task.
pub fn named_blob(
    field: &'static str,
    named: worker_v1::NamedBlob,
) -> Result<(Artifact, BlobRef), ServiceError> {
    let unknown = || ServiceError::BadArgument {
        field,
        message: "is an artifact that this coordinator does not know".into(),
    };
    let artifact = Artifact::from_proto(named.artifact()).ok_or_else(unknown)?;
    Ok((artifact, required_blob(field, named.blob)?))
}

pub fn timestamp(ms: u64) -> Timestamp {
    Timestamp { seconds: (ms / 1000) as i64, nanos: (ms % 1000) as i32 * 1_000_000 }
}

/// Unix milliseconds of a timestamp; times before 1970 count as 1970.
pub fn unix_ms(time: &Timestamp) -> u64 {
    let (seconds, nanos) = (u64::try_from(time.seconds).unwrap_or(0), u64::try_from(time.nanos).unwrap_or(0));
    seconds.saturating_mul(1000).saturating_add(nanos / 1_000_000)
}

pub fn job_state(state: JobState) -> v1::JobState {
    match state {
        JobState::Running => v1::JobState::Running,
        JobState::Paused => v1::JobState::Paused,
        JobState::Succeeded => v1::JobState::Succeeded,
        JobState::Failed => v1::JobState::Failed,
        JobState::Cancelled => v1::JobState::Cancelled,
    }
}

/// A state in a filter; `None` for an unknown one.
pub fn state_of_filter(state: v1::JobState) -> Option<JobState> {
    match state {
        v1::JobState::Unspecified => None,
        v1::JobState::Running => Some(JobState::Running),
        v1::JobState::Paused => Some(JobState::Paused),
        v1::JobState::Succeeded => Some(JobState::Succeeded),
        v1::JobState::Failed => Some(JobState::Failed),
        v1::JobState::Cancelled => Some(JobState::Cancelled),
    }
}

/// A stage whose tasks a worker may be assigned; `None` for others.
pub fn worker_stage(stage: v1::Stage) -> Option<Stage> {
    Stage::from_proto(stage).filter(|stage| !stage.is_own())
}

/// The methods that a worker trains; names that this program does not know are left out.
pub fn methods(names: &[String]) -> Vec<Method> {
    if names.is_empty() {
        return vec![Method::Splats];
    }
    names.iter().filter_map(|name| Method::try_from(name.clone()).ok()).collect()
}

pub fn fail_class(class: worker_v1::FailClass) -> FailClass {
    match class {
        worker_v1::FailClass::Input => FailClass::Input,
        worker_v1::FailClass::Unspecified | worker_v1::FailClass::Training => FailClass::Training,
        worker_v1::FailClass::OutOfMemory => FailClass::OutOfMemory,
        worker_v1::FailClass::Device => FailClass::Device,
        worker_v1::FailClass::Environment => FailClass::Environment,
    }
}

pub fn progress(live: &LiveProgress) -> v1::Progress {
    v1::Progress {
        iteration: live.iteration,
        iterations: live.iterations,
        gaussians: live.gaussians,
        loss: live.loss,
        iterations_per_second: live.iterations_per_second,
        held_out: live.held_out.as_ref().map(held_out),
        ..v1::Progress::default()
    }
}

pub fn live_progress(progress: &v1::Progress) -> LiveProgress {
    LiveProgress {
        iteration: progress.iteration,
        iterations: progress.iterations,
        gaussians: progress.gaussians,
        loss: progress.loss,
        iterations_per_second: progress.iterations_per_second,
        held_out: progress.held_out.as_ref().and_then(measured),
    }
}

fn held_out(measured: &HeldOut) -> v1::HeldOutMetrics {
    let HeldOut { iteration, psnr_db, ssim, views } = *measured;
    v1::HeldOutMetrics { iteration, psnr_db, ssim, views }
}

/// A measurement of a worker; `None` if its numbers are not finite.
fn measured(metrics: &v1::HeldOutMetrics) -> Option<HeldOut> {
    let v1::HeldOutMetrics { iteration, psnr_db, ssim, views } = *metrics;
    (psnr_db.is_finite() && ssim.is_finite()).then_some(HeldOut { iteration, psnr_db, ssim, views })
}

pub fn stats(stats: &worker_v1::TaskStats) -> TaskStats {
    TaskStats {
        // JSON has no NaN: the row of the task would be unreadable.
        seconds: if stats.seconds.is_finite() { stats.seconds } else { 0.0 },
        iterations: stats.iterations,
        gaussians: stats.gaussians,
        adapter: stats.adapter.chars().take(200).collect(),
        resumed_from: stats.resumed_from_iteration,
        held_out: {
            let first = stats.held_out.len().saturating_sub(HeldOut::MOST);
            stats.held_out[first..].iter().filter_map(measured).collect()
        },
    }
}

pub fn lease(lease: &Lease) -> worker_v1::Lease {
    worker_v1::Lease {
        job_id: lease.job.to_string(),
        task_id: lease.task.to_string(),
        attempt: lease.attempt,
        fence: lease.fence,
    }
}

pub fn required_lease(lease: Option<worker_v1::Lease>) -> Result<Lease, ServiceError> {
    let missing = || ServiceError::BadArgument { field: "lease", message: "is missing".into() };
    let worker_v1::Lease { job_id, task_id, attempt, fence } = lease.ok_or_else(missing)?;
    Ok(Lease { job: job_id.parse()?, task: task_id.parse()?, attempt, fence })
}

pub fn assignment(grant: &Grant, lease_ms: u32) -> worker_v1::Assignment {
    let Grant { lease: granted, job, task } = grant;
    let made = granted.task.stage.spec().inputs.iter().filter_map(|artifact| {
        let made = task.inputs.get(artifact).or_else(|| job.output(*artifact))?;
        Some(worker_v1::NamedBlob {
            artifact: worker_v1::Artifact::from(*artifact).into(),
            blob: Some(blob(made)),
        })
    });
    worker_v1::Assignment {
        lease: Some(lease(granted)),
        stage: v1::Stage::from(granted.task.stage).into(),
        lease_ms,
        config_json: job.config_json.clone(),
        manifest: Some(blob(&job.manifest)),
        spec: task.spec.as_ref().map(blob),
        inputs: made.collect(),
        checkpoint: task.checkpoint.as_ref().map(|checkpoint| blob(&checkpoint.blob)),
        checkpoint_iteration: task.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.iteration),
    }
}

/// A job without its tasks.
pub fn job(job: &JobRecord, progress: f64, gap: Option<&Gap>) -> v1::Job {
    v1::Job {
        tenant: job.tenant.to_string(),
        dataset_id: job.dataset.as_ref().map(ToString::to_string).unwrap_or_default(),
        job_id: job.job_id.to_string(),
        name: job.name.clone(),
        state: job_state(job.state).into(),
        stage: v1::Stage::from(job.stage).into(),
        create_time: Some(timestamp(job.created_ms)),
        end_time: job.ended_ms.map(timestamp),
        error: job.error.clone(),
        config_json: job.config_json.clone(),
        manifest: Some(blob(&job.manifest)),
        last_seq: job.last_seq,
        partitions: job.shape.partitions,
        progress,
        tasks: Vec::new(),
        waiting_reason: gap.map(|gap| gap.shortfall.to_string()).unwrap_or_default(),
        waiting_since: gap.map(|gap| timestamp(gap.since_ms)),
        plan: job.output(Artifact::Plan).map(blob),
        priority: job.priority,
        max_parallel: job.max_parallel,
        time_left_seconds: None,
        pause_reason: if job.state == JobState::Paused { job.pause_reason.clone() } else { String::new() },
    }
}

/// A job with its tasks, and the time that `workers` still need to train it.
pub fn job_view(view: &JobView, gap: Option<&Gap>, workers: usize) -> v1::Job {
    let tasks = view.tasks.iter().map(|(record, live)| task(record, live.as_ref())).collect();
    let time_left_seconds = time_left(&view.job, &view.tasks, workers);
    v1::Job { tasks, time_left_seconds, ..job(&view.job, view.progress(), gap) }
}

fn task(record: &TaskRecord, live: Option<&LiveProgress>) -> v1::Task {
    let (state, seconds, done) = match &record.state {
        TaskState::Blocked => (v1::TaskState::Blocked, 0.0, None),
        TaskState::Ready { .. } => (v1::TaskState::Ready, 0.0, None),
        TaskState::Leased(_) => (v1::TaskState::Leased, 0.0, None),
        TaskState::Done { stats, seconds, .. } => (v1::TaskState::Done, *seconds, Some(stats)),
        TaskState::Dead => (v1::TaskState::Dead, 0.0, None),
        TaskState::Cancelled => (v1::TaskState::Cancelled, 0.0, None),
    };
    let finished = done.filter(|stats| stats.iterations > 0).map(|stats| v1::Progress {
        iteration: stats.iterations,
        iterations: stats.iterations,
        gaussians: stats.gaussians,
        held_out: stats.held_out.last().map(held_out),
        ..Default::default()
    });
    v1::Task {
        task_id: record.task.to_string(),
        stage: v1::Stage::from(record.task.stage).into(),
        partition: record.task.number(),
        state: state.into(),
        attempts: record.attempts,
        errors: record.errors,
        losses: record.losses,
        worker: record.worker.clone(),
        progress: finished.or(live.map(progress)),
        resumed_from_iteration: record.resumed_from,
        checkpoint_iteration: record.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.iteration),
        last_errors: record.last_errors.clone(),
        seconds,
        memory_bytes: record.memory_bytes,
        second_worker: record.second.as_ref().map(|second| second.worker.clone()).unwrap_or_default(),
        model: model_of(record),
    }
}

/// The Gaussians that a task has made.
pub fn model_of(record: &TaskRecord) -> Option<v1::BlobRef> {
    let makes_model =
        matches!(record.task.stage, Stage::Global | Stage::Partition | Stage::Merge | Stage::Borders);
    match &record.state {
        TaskState::Done { result, .. } if makes_model => Some(blob(result)),
        _ => None,
    }
}

pub fn event(job_id: &str, event: &StoredEvent) -> v1::JobEvent {
    use v1::job_event::Event;
    let body = match &event.body {
        EventBody::JobState { state, message } => {
            Event::JobState(v1::JobStateChanged { state: job_state(*state).into(), message: message.clone() })
        }
        EventBody::Stage { stage: entered, tasks } => {
            Event::JobStage(v1::JobStageChanged { stage: v1::Stage::from(*entered).into(), tasks: *tasks })
        }
        EventBody::Task { task, state, attempt, worker, message, resumed_from } => {
            let state = match state {
                TaskChange::Ready => v1::TaskState::Ready,
                TaskChange::Leased => v1::TaskState::Leased,
                TaskChange::Done => v1::TaskState::Done,
                TaskChange::Dead => v1::TaskState::Dead,
            };
            Event::TaskChanged(v1::TaskChanged {
                task_id: task.to_string(),
                stage: v1::Stage::from(task.stage).into(),
                state: state.into(),
                attempt: *attempt,
                worker: worker.clone(),
                message: message.clone(),
                resumed_from_iteration: *resumed_from,
            })
        }
        EventBody::Checkpoint { task, attempt, iteration } => Event::Checkpoint(v1::TaskCheckpointed {
            task_id: task.to_string(),
            attempt: *attempt,
            iteration: *iteration,
        }),
        EventBody::Updated { priority, max_parallel } => {
            Event::Updated(v1::JobUpdated { priority: *priority, max_parallel: *max_parallel })
        }
        EventBody::Warning { message } => Event::Warning(v1::Warning { message: message.clone() }),
    };
    v1::JobEvent {
        job_id: job_id.to_owned(),
        seq: event.seq,
        time: Some(timestamp(event.time_ms)),
        event: Some(body),
    }
}

/// An event that is not stored; it repeats the number of the durable one before it.
pub fn passing_event(job_id: &str, seq: u64, now_ms: u64, event: v1::job_event::Event) -> v1::JobEvent {
    v1::JobEvent { job_id: job_id.to_owned(), seq, time: Some(timestamp(now_ms)), event: Some(event) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::record;

    #[test]
    fn methods_of_a_worker_are_those_that_this_program_knows() {
        let of = |names: &[&str]| methods(&names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>());
        assert_eq!(of(&[]), [Method::Splats], "workers that name none train splats");
        assert_eq!(of(&["fields", "splats"]), [Method::Splats]);
        assert_eq!(of(&["fields"]), []);
    }

    #[test]
    fn the_latest_measurements_are_kept_and_only_finite_ones() {
        let metrics = |iteration: u32| v1::HeldOutMetrics {
            iteration,
            psnr_db: if iteration == 300 { f64::NAN } else { 20.0 },
            ssim: if iteration == 301 { f64::INFINITY } else { 0.5 },
            views: 8,
        };
        let sent = worker_v1::TaskStats { held_out: (1..=400).map(metrics).collect(), ..Default::default() };
        let kept = stats(&sent).held_out;
        let iterations: Vec<u32> = kept.iter().map(|m| m.iteration).collect();
        assert_eq!(iterations, (145..=299).chain(302..=400).collect::<Vec<u32>>());
        for seconds in [f64::NAN, f64::INFINITY] {
            let sent = worker_v1::TaskStats { seconds, ..Default::default() };
            let row = record::encode("tasks", &stats(&sent))
                .and_then(|row| record::decode::<TaskStats>("tasks", &row));
            assert_eq!(row.map(|stats| stats.seconds).ok(), Some(0.0), "{seconds}");
        }
        let live = |iteration| v1::Progress { held_out: Some(metrics(iteration)), ..Default::default() };
        assert_eq!(live_progress(&live(300)).held_out, None);
        assert_eq!(progress(&live_progress(&live(7))), live(7));
    }
}
