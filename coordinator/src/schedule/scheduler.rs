//! The rules: `step(rows of a job, event, now) -> outcome`.
//!
//! Every event may arrive twice and late. A repeated event that was applied returns [`Outcome::Already`] and
//! changes nothing; an event of an ended lease is refused. No other outcome is possible.

use fathom_core::scene::BlobRef;

use super::event::{
    Event, EventBody, Expired, FailClass, Outcome, Planned, PlannedTask, Refusal, TaskChange, TaskOutput,
};
use super::job::{Announcement, JobRecord, JobShape, JobState};
use super::lost_results::requeue_lost;
use super::rows::{JobRows, Rules, attempt_event, end_job, given_up, task_event};
use super::task::{Attempt, CheckpointRecord, Lease, TaskRecord, TaskState};
use super::{RunsOn, Stage, TaskId};

/// The task rows that an event needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RowsNeeded {
    /// These.
    Some(Vec<TaskId>),
    /// All rows of the job: the event may end it.
    All,
}

/// The task rows that `event` needs. Most events need one; only events that may end the job need all.
pub fn rows_needed(job: &JobRecord, event: &Event) -> RowsNeeded {
    match event {
        Event::Claim { task, .. } => RowsNeeded::Some(vec![*task]),
        Event::Checkpoint { lease, .. } | Event::Release { lease, .. } => RowsNeeded::Some(vec![lease.task]),
        Event::Complete { lease, .. } => {
            let mut tasks = vec![lease.task];
            tasks.extend(successors(&job.shape, lease.task));
            if job.open_tasks == 1
                && let Some(next) = job.shape.after(job.stage)
            {
                tasks.extend(job.shape.tasks_of(next));
            }
            RowsNeeded::Some(tasks)
        }
        Event::Fail { .. }
        | Event::Expire { .. }
        | Event::Cancel { .. }
        | Event::Retry
        | Event::ResultsLost { .. }
        | Event::GiveUp { .. } => RowsNeeded::All,
        Event::Pause { .. }
        | Event::Resume
        | Event::Update { .. }
        | Event::Announce { .. }
        | Event::Announced { .. } => RowsNeeded::Some(Vec::new()),
    }
}

/// The tasks of the same partition that start from the result of `task`.
fn successors(shape: &JobShape, task: TaskId) -> Vec<TaskId> {
    let Some(partition) = task.part.filter(|_| task.stage.is_per_partition()) else { return Vec::new() };
    let starts_from_it = |stage: &Stage| {
        shape.stages.contains(stage) && stage.is_per_partition() && stage.takes(task.stage.result())
    };
    Stage::all().filter(starts_from_it).map(|stage| stage.task_of(partition)).collect()
}

/// Applies one event to the rows of its job.
///
/// # Errors
/// [`Refusal`] when the event may change nothing; the rows are then as they were.
pub fn step(rows: &mut JobRows, event: Event, now_ms: u64, rules: &Rules) -> Result<Outcome, Refusal> {
    let mut events = Vec::new();
    match event {
        Event::Claim { task, worker, peers, request_id, fence, is_second } => {
            match rows.job.state {
                JobState::Running => {}
                JobState::Paused => return Err(Refusal::JobPaused),
                JobState::Succeeded | JobState::Failed | JobState::Cancelled => {
                    return Err(Refusal::JobEnded);
                }
            }
            if rows.job.is_at_its_limit() {
                return Err(Refusal::AtItsLimit(rows.job.max_parallel));
            }
            let record = rows.tasks.get_mut(&task).ok_or(Refusal::NoSuchTask(task))?;
            match &record.state {
                TaskState::Ready { not_before_ms } if !is_second && rules.is_due(*not_before_ms, now_ms) => {}
                TaskState::Leased(slow) if is_second && record.may_have_second_attempt() => {
                    if slow.incarnation == worker.incarnation {
                        return Err(Refusal::Unfit(task));
                    }
                }
                _ => return Err(Refusal::NotReady(task)),
            }
            if !record.may_go_to(&rows.job.tenant, &worker, &peers) {
                return Err(Refusal::Unfit(task));
            }
            record.attempts += 1;
            record.fence = fence;
            let attempt = Attempt {
                worker: worker.name,
                incarnation: worker.incarnation,
                request_id,
                number: record.attempts,
                fence,
                since_ms: now_ms,
                resumed_from: record.checkpoint.as_ref().map_or(0, |c| c.iteration),
                memory_bytes: worker.memory_bytes,
            };
            let why =
                if is_second { format!("beside {}, which is slow", record.worker) } else { String::new() };
            events.push(attempt_event(task, &attempt, TaskChange::Leased, &why));
            if is_second {
                record.second_attempts += 1;
                record.second = Some(Box::new(attempt));
            } else {
                (record.worker, record.resumed_from) = (attempt.worker.clone(), attempt.resumed_from);
                record.become_state(TaskState::Leased(attempt));
            }
            rows.job.leased_tasks += 1;
        }
        Event::Checkpoint { lease, blob, iteration } => {
            let record = held(rows, &lease, rules)?;
            // A repeated call may arrive after the next checkpoint; it must not set the task back.
            let runs = |number: u32| record.running().any(|attempt| attempt.number == number);
            let known = |kept: &CheckpointRecord| {
                // Of two concurrent attempts, the slower one must not set the task back either.
                (kept.attempt == lease.attempt || runs(kept.attempt)) && kept.iteration >= iteration
            };
            if record.checkpoint.as_ref().is_some_and(known) {
                return Ok(Outcome::Already);
            }
            record.checkpoint = Some(CheckpointRecord { blob, iteration, attempt: lease.attempt });
            events.push(EventBody::Checkpoint { task: lease.task, attempt: lease.attempt, iteration });
        }
        Event::Complete { lease, output } => return complete(rows, &lease, output, now_ms, rules),
        Event::Fail { lease, class, message } => {
            if was_returned(rows, &lease) {
                return Ok(Outcome::Already);
            }
            let record = held(rows, &lease, rules)?;
            record.returned_fence = lease.fence;
            give_back(rows, &lease, Some(class), &message, now_ms, rules, &mut events);
        }
        Event::Expire { lease, why } => {
            held(rows, &lease, rules)?;
            let (class, message) = match why {
                // As at a restart: stopping a coordinator is no failed attempt.
                _ if lease.task.stage.is_own() => (None, "its coordinator is gone"),
                Expired::Silent => {
                    (Some(FailClass::Environment), "lease expired: its worker stopped renewing")
                }
                Expired::Stalled => {
                    let message = "lease expired: its worker is alive but makes no progress";
                    (Some(FailClass::Environment), message)
                }
            };
            give_back(rows, &lease, class, message, now_ms, rules, &mut events);
        }
        Event::Release { lease, reason } => {
            if was_returned(rows, &lease) {
                return Ok(Outcome::Already);
            }
            let record = held(rows, &lease, rules)?;
            record.returned_fence = lease.fence;
            give_back(rows, &lease, None, &reason, now_ms, rules, &mut events);
        }
        Event::ResultsLost { lease, tasks, message } => {
            held(rows, &lease, rules)?;
            let can_be_made = |task: &TaskId| task.stage == Stage::Partition && is_done(rows, *task);
            if !tasks.iter().any(can_be_made) {
                return Err(Refusal::WrongOutput(lease.task));
            }
            requeue_lost(rows, &lease, &tasks, &message, now_ms, rules, &mut events);
        }
        Event::Cancel { reason } => {
            if !rows.job.state.is_open() {
                return Ok(Outcome::Already);
            }
            end_job(rows, JobState::Cancelled, reason, now_ms, &mut events);
        }
        Event::GiveUp { reason } => {
            if !rows.job.state.is_open() {
                return Ok(Outcome::Already);
            }
            end_job(rows, JobState::Failed, reason, now_ms, &mut events);
        }
        Event::Pause { reason } => match rows.job.state {
            JobState::Running => {
                rows.job.state = JobState::Paused;
                rows.job.paused_since_ms = Some(now_ms);
                rows.job.pause_reason.clone_from(&reason);
                events.push(EventBody::JobState { state: JobState::Paused, message: reason });
            }
            JobState::Paused => return Ok(Outcome::Already),
            _ => return Err(Refusal::JobEnded),
        },
        Event::Resume => match rows.job.state {
            JobState::Paused => {
                rows.job.state = JobState::Running;
                rows.job.goes_on(now_ms);
                events.push(EventBody::JobState { state: JobState::Running, message: "resumed".to_owned() });
            }
            JobState::Running => return Ok(Outcome::Already),
            _ => return Err(Refusal::JobEnded),
        },
        Event::Retry => match rows.job.state {
            JobState::Failed => retry(rows, now_ms, &mut events),
            JobState::Running | JobState::Paused => return Ok(Outcome::Already),
            JobState::Succeeded => return Err(Refusal::NotFailed("succeeded")),
            JobState::Cancelled => return Err(Refusal::NotFailed("been cancelled")),
        },
        Event::Announce { ended_ms, known_ms, until_ms } => match rows.job.announcement {
            Announcement::Due { not_before_ms }
                if rows.job.ended_ms == Some(ended_ms) && not_before_ms == known_ms =>
            {
                rows.job.announcement = Announcement::Due { not_before_ms: until_ms };
            }
            _ => return Ok(Outcome::Already),
        },
        Event::Announced { ended_ms } => match rows.job.announcement {
            Announcement::Due { .. } if rows.job.ended_ms == Some(ended_ms) => {
                rows.job.announcement = Announcement::Made;
            }
            _ => return Ok(Outcome::Already),
        },
        Event::Update { priority, max_parallel } => {
            let job = &mut rows.job;
            if !job.state.is_open() {
                return Err(Refusal::JobEnded);
            }
            let wanted = (priority.unwrap_or(job.priority), max_parallel.unwrap_or(job.max_parallel));
            if wanted == (job.priority, job.max_parallel) {
                return Ok(Outcome::Already);
            }
            (job.priority, job.max_parallel) = wanted;
            events.push(EventBody::Updated { priority: job.priority, max_parallel: job.max_parallel });
        }
    }
    rows.job.last_seq += events.len() as u64;
    Ok(Outcome::Changed(events))
}

/// The task held under `lease`. This is the check of the fence.
fn held<'a>(rows: &'a mut JobRows, lease: &Lease, rules: &Rules) -> Result<&'a mut TaskRecord, Refusal> {
    let open = rows.job.state.is_open();
    let record = rows.tasks.get_mut(&lease.task).ok_or(Refusal::NoSuchTask(lease.task))?;
    if !open {
        return Err(Refusal::JobEnded);
    }
    if record.is_held_by(lease) || rules.ignores_fences() {
        Ok(record)
    } else {
        Err(Refusal::StaleFence { task: lease.task, given: lease.fence, latest: record.fence })
    }
}

fn is_done(rows: &JobRows, task: TaskId) -> bool {
    rows.tasks.get(&task).is_some_and(|record| matches!(record.state, TaskState::Done { .. }))
}

/// Whether a Fail or Release under this fence was applied before.
fn was_returned(rows: &JobRows, lease: &Lease) -> bool {
    let is_it = |record: &TaskRecord| record.returned_fence == lease.fence;
    rows.tasks.get(&lease.task).is_some_and(is_it) && !is_done(rows, lease.task)
}

/// Whether a committed result came under this fence.
fn is_result_of(record: &TaskRecord, lease: &Lease) -> bool {
    record.returned_fence == lease.fence
}

fn complete(
    rows: &mut JobRows,
    lease: &Lease,
    output: TaskOutput,
    now_ms: u64,
    rules: &Rules,
) -> Result<Outcome, Refusal> {
    let task = lease.task;
    let Some(result) = result_of(task, &output) else {
        return Err(Refusal::WrongOutput(task));
    };
    let TaskOutput { made, stats, planned } = output;
    if let Some(record) = rows.tasks.get(&task)
        && let TaskState::Done { result: committed, .. } = &record.state
        && is_result_of(record, lease)
    {
        return if *committed == result { Ok(Outcome::Already) } else { Err(Refusal::OtherResult(task)) };
    }
    let record = held(rows, lease, rules)?;
    let leases = record.running().count() as u32;
    let mut events = Vec::new();
    let mut seconds = 0.0;
    if let Some(attempt) = record.held_under(lease).cloned() {
        seconds = now_ms.saturating_sub(attempt.since_ms) as f64 / 1e3;
        events.push(attempt_event(task, &attempt, TaskChange::Done, ""));
        (record.worker, record.resumed_from) = (attempt.worker, attempt.resumed_from);
    }
    record.returned_fence = lease.fence;
    record.become_state(TaskState::Done { result: result.clone(), stats, seconds });
    let iterations = u64::from(record.iterations);

    let job = &mut rows.job;
    job.open_tasks = job.open_tasks.saturating_sub(1);
    job.leased_tasks = job.leased_tasks.saturating_sub(leases);
    job.iterations_done += iterations;
    if task.part.is_none() {
        job.outputs.extend(made);
    }
    for successor in successors(&rows.job.shape, task) {
        if let Some(record) = rows.tasks.get_mut(&successor) {
            record.inputs.insert(task.stage.result(), result.clone());
        }
    }
    if let Some(planned) = planned {
        accept_plan(rows, planned, &mut events);
    }
    if rows.job.open_tasks == 0 {
        enter_next_stage(rows, now_ms, &mut events);
    }
    rows.job.last_seq += events.len() as u64;
    Ok(Outcome::Changed(events))
}

/// The result of a task; `None` if the output does not fit its stage.
fn result_of(task: TaskId, output: &TaskOutput) -> Option<BlobRef> {
    let spec = task.stage.spec();
    let is_whole = match spec.runs_on {
        RunsOn::Coordinator => spec.outputs.iter().all(|artifact| output.made.contains_key(artifact)),
        RunsOn::Worker => true,
    };
    let is_declared = output.made.keys().all(|artifact| spec.outputs.contains(artifact));
    let is_planned = (task.stage == Stage::Plan) == output.planned.is_some();
    let result = output.made.get(&task.stage.result())?;
    (is_whole && is_declared && is_planned).then(|| result.clone())
}

/// Gives the job the tasks of its plan, all blocked.
fn accept_plan(rows: &mut JobRows, planned: Planned, events: &mut Vec<EventBody>) {
    let job = &mut rows.job;
    job.shape.partitions = planned.partitions();
    job.shape.evaluations = planned.evaluations();
    job.shape.stages.extend(planned.tasks.keys().map(|task| task.stage));
    job.iterations_total = planned.tasks.values().map(|task| u64::from(task.iterations)).sum();
    for (task, PlannedTask { spec, iterations, method, memory_bytes }) in planned.tasks {
        rows.tasks
            .insert(task, TaskRecord { method, memory_bytes, ..TaskRecord::new(task, spec, iterations) });
    }
    events.extend(planned.warnings.into_iter().map(|message| EventBody::Warning { message }));
}

fn enter_next_stage(rows: &mut JobRows, now_ms: u64, events: &mut Vec<EventBody>) {
    let job = &mut rows.job;
    let seconds = job.stage_ms(now_ms) as f64 / 1e3;
    job.stage_seconds.insert(job.stage, seconds);
    job.stage_since_ms = now_ms;
    let Some(stage) = job.shape.after(job.stage) else {
        end_job(rows, JobState::Succeeded, String::new(), now_ms, events);
        return;
    };
    let tasks = job.shape.tasks_of(stage);
    job.stage = stage;
    job.open_tasks = tasks.len() as u32;
    events.push(EventBody::Stage { stage, tasks: job.open_tasks });
    for task in tasks {
        if let Some(record) = rows.tasks.get_mut(&task) {
            record.state = TaskState::Ready { not_before_ms: now_ms };
        }
    }
}

/// Ends an attempt without a result: `class` is the cause, `None` for a released task.
///
/// If another attempt runs beside it, that one continues alone, and nothing is counted: the coordinator
/// itself started the second attempt, and there is only one. An unusable input ends both.
fn give_back(
    rows: &mut JobRows,
    lease: &Lease,
    class: Option<FailClass>,
    message: &str,
    now_ms: u64,
    rules: &Rules,
    events: &mut Vec<EventBody>,
) {
    let Some(record) = rows.tasks.get_mut(&lease.task) else { return };
    rows.job.leased_tasks = rows.job.leased_tasks.saturating_sub(1);
    let ended = record.held_under(lease).cloned();
    let goes_on = record.leave_to_other(lease.fence).is_some();
    match class {
        None => {}
        Some(_) if goes_on => {}
        Some(FailClass::Environment) => record.losses += 1,
        Some(_) => record.errors += 1,
    }
    if let (Some(class), Some(attempt)) = (class, &ended) {
        record.failed_on.push(attempt.incarnation.clone());
        let surplus = record.failed_on.len().saturating_sub(TaskRecord::FAILED_ON_KEPT);
        record.failed_on.drain(..surplus);
        if class == FailClass::OutOfMemory {
            // Its memory was too little, regardless of the forecast.
            let had = attempt.memory_bytes.unwrap_or(0).max(record.memory_bytes);
            record.memory_bytes = had.saturating_add(had / 4);
        }
        record.last_errors.push(format!("attempt {} on {}: {message}", lease.attempt, attempt.worker));
        let surplus = record.last_errors.len().saturating_sub(TaskRecord::ERRORS_KEPT);
        record.last_errors.drain(..surplus);
    }
    let spent = record.errors >= rules.max_errors || record.losses >= rules.max_losses;
    if class == Some(FailClass::Input) || (spent && !goes_on) {
        record.become_state(TaskState::Dead);
        events.push(task_event(record, lease.attempt, TaskChange::Dead, message));
        let error = given_up(record, ["lost worker", "lost workers"]);
        end_job(rows, JobState::Failed, error, now_ms, events);
        return;
    }
    if goes_on {
        let message = format!(
            "{}: attempt {} ended ({message}); the one on {} continues",
            lease.task, lease.attempt, record.worker
        );
        events.push(EventBody::Warning { message });
        return;
    }
    let pause = match class {
        None => 0,
        Some(_) => rules.backoff_ms(record.errors + record.losses, lease.fence),
    };
    record.become_state(TaskState::Ready { not_before_ms: now_ms + pause });
    events.push(task_event(record, lease.attempt, TaskChange::Ready, message));
}

/// Resumes a failed job at the stage where it failed. Results stay; attempts and fences continue to count.
fn retry(rows: &mut JobRows, now_ms: u64, events: &mut Vec<EventBody>) {
    let job = &mut rows.job;
    let of_stage = job.shape.tasks_of(job.stage);
    job.open_tasks = 0;
    for record in rows.tasks.values_mut().filter(|record| !matches!(record.state, TaskState::Done { .. })) {
        (record.errors, record.losses, record.second_attempts) = (0, 0, 0);
        record.failed_on.clear();
        record.state = if of_stage.contains(&record.task) {
            job.open_tasks += 1;
            TaskState::Ready { not_before_ms: now_ms }
        } else {
            TaskState::Blocked
        };
    }
    job.state = JobState::Running;
    (job.stage_since_ms, job.paused_since_ms) = (now_ms, None);
    job.ended_ms = None;
    if job.announcement == Announcement::Made {
        job.announcement = Announcement::DUE;
    }
    job.error.clear();
    events.push(EventBody::JobState { state: JobState::Running, message: "retried".to_owned() });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::{Artifact, TaskStats};

    fn blob() -> BlobRef {
        BlobRef::of(b"x")
    }

    fn made(artifacts: &[Artifact], planned: bool) -> TaskOutput {
        let made = artifacts.iter().map(|artifact| (*artifact, blob())).collect();
        TaskOutput { made, stats: TaskStats::default(), planned: planned.then(Planned::default) }
    }

    #[test]
    fn an_output_that_does_not_fit_its_stage_is_refused() {
        use Artifact::{Evaluation, MergeReport, Model, Plan, PlanPicture};
        for (stage, artifacts, planned, fits) in [
            (Stage::Plan, &[Plan, PlanPicture][..], true, true),
            (Stage::Plan, &[Plan, PlanPicture], false, false),
            (Stage::Plan, &[Plan], true, false),
            (Stage::Merge, &[Model, MergeReport], false, true),
            (Stage::Merge, &[Model], false, false),
            (Stage::Merge, &[Model, MergeReport], true, false),
            (Stage::Evaluate, &[Evaluation], false, true),
            (Stage::Evaluate, &[Evaluation, Model], false, false),
            (Stage::Evaluate, &[Model], false, false),
            (Stage::Evaluate, &[], false, false),
        ] {
            let result = result_of(stage.task(), &made(artifacts, planned));
            assert_eq!(result.is_some(), fits, "{stage} with {artifacts:?}, planned: {planned}");
        }
    }
}
