//! Parts shared by the rules: budgets, the rows of a job, the end of a job, and events about tasks.

use std::collections::BTreeMap;

use super::event::{EventBody, TaskChange};
use super::job::{JobRecord, JobState};
use super::task::{Attempt, TaskRecord, TaskState};
use super::{Quota, TaskId};

/// Budgets and back-off.
#[derive(Clone, Debug)]
pub struct Rules {
    /// Maximum attempts of a task that end with an error; the last of them kills it. Default 3.
    pub max_errors: u32,
    /// Maximum attempts of a task whose worker is lost; the last of them kills it. Default 5.
    pub max_losses: u32,
    /// Back-off before the second attempt, milliseconds; doubles with each further one. Default 1000.
    pub backoff_ms: u64,
    /// Longest back-off, milliseconds. Default 60 000.
    pub max_backoff_ms: u64,
    /// The default quota of tenants. Default: no limits.
    pub quota: Quota,
    /// An attempt is slow if it takes this many times longer than its siblings took: an idle worker then
    /// starts a second attempt. 0 disables it. Default 3.
    pub straggler_factor: f64,
    /// Minimum age of a slow attempt, milliseconds. Default 600 000.
    pub straggler_after_ms: u64,
    /// Disables the check of fences: the simulation proves with it that it would notice.
    #[cfg(test)]
    pub ignore_fences: bool,
}

impl Default for Rules {
    fn default() -> Self {
        Self {
            max_errors: 3,
            max_losses: 5,
            backoff_ms: 1000,
            max_backoff_ms: 60_000,
            quota: Quota::default(),
            straggler_factor: 3.0,
            straggler_after_ms: 600_000,
            #[cfg(test)]
            ignore_fences: false,
        }
    }
}

impl Rules {
    /// Always false outside the simulation's proof that it would notice.
    pub(super) fn ignores_fences(&self) -> bool {
        #[cfg(test)]
        return self.ignore_fences;
        #[cfg(not(test))]
        false
    }

    /// Whether a task may be claimed. A time later than the longest back-off comes from a wall clock that was
    /// set back between two runs, and is ignored.
    pub fn is_due(&self, not_before_ms: u64, now_ms: u64) -> bool {
        not_before_ms <= now_ms || not_before_ms > now_ms + self.longest_pause_ms()
    }

    /// The longest time from a failure to the next attempt, milliseconds.
    pub fn longest_pause_ms(&self) -> u64 {
        self.max_backoff_ms + self.max_backoff_ms / 4
    }

    /// The back-off after `failures` failures: doubling, plus up to a quarter from `salt`, so that tasks that
    /// failed together do not return together.
    pub(super) fn backoff_ms(&self, failures: u32, salt: u64) -> u64 {
        let doubled = self.backoff_ms.saturating_mul(1 << failures.saturating_sub(1).min(16));
        let pause = doubled.min(self.max_backoff_ms);
        pause + salt.wrapping_mul(0x9E37_79B9_7F4A_7C15) % (pause / 4 + 1)
    }
}

/// The rows of one job that an event needs; [`super::rows_needed`] selects the tasks.
#[derive(Clone, Debug)]
pub struct JobRows {
    /// The job.
    pub job: JobRecord,
    /// Some or all of its tasks; new ones appear here when it is planned.
    pub tasks: BTreeMap<TaskId, TaskRecord>,
}

/// The error of a job whose task failed: that of a single attempt, otherwise also the counts of errors and
/// losses. `lost` names a loss, in singular and plural.
pub(super) fn given_up(record: &TaskRecord, lost: [&str; 2]) -> String {
    let (task, errors) = (record.task, record.last_errors.join("; "));
    if record.attempts <= 1 {
        return match errors.strip_prefix("attempt 1 on ") {
            Some(on_worker) => format!("{task} failed on {on_worker}"),
            None => format!("{task} failed: {errors}"),
        };
    }
    let count = |number: u32, [one, several]: [&str; 2]| match number {
        1 => format!("1 {one}"),
        number => format!("{number} {several}"),
    };
    format!(
        "{task} failed for good after {} attempts ({}, {}): {errors}",
        record.attempts,
        count(record.errors, ["error", "errors"]),
        count(record.losses, lost)
    )
}

/// Ends the job and every task of it that has not ended.
pub(super) fn end_job(
    rows: &mut JobRows,
    state: JobState,
    message: String,
    now_ms: u64,
    events: &mut Vec<EventBody>,
) {
    for record in rows.tasks.values_mut().filter(|record| !record.is_final()) {
        record.become_state(TaskState::Cancelled);
    }
    rows.job.state = state;
    rows.job.open_tasks = 0;
    rows.job.leased_tasks = 0;
    rows.job.ended_ms = Some(now_ms);
    rows.job.error.clone_from(&message);
    events.push(EventBody::JobState { state, message });
}

/// The event that an attempt began, or submitted the result.
pub(super) fn attempt_event(task: TaskId, attempt: &Attempt, state: TaskChange, message: &str) -> EventBody {
    EventBody::Task {
        task,
        state,
        attempt: attempt.number,
        worker: attempt.worker.clone(),
        message: message.to_owned(),
        resumed_from: if state == TaskChange::Leased { attempt.resumed_from } else { 0 },
    }
}

/// The event that a task was requeued or ended without a result, after its attempt `number`.
pub(super) fn task_event(record: &TaskRecord, number: u32, state: TaskChange, message: &str) -> EventBody {
    let (worker, message) = (record.worker.clone(), message.to_owned());
    EventBody::Task { task: record.task, state, attempt: number, worker, message, resumed_from: 0 }
}
