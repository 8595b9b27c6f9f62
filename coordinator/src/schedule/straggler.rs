//! Stragglers: attempts that take much longer than their siblings. An idle worker starts a second attempt,
//! because a machine may be slow without being silent.
//!
//! The measure is the time per iteration, from claim to result; iterations represent the size of a partition,
//! because they follow from its cameras. A second attempt resumes from the last checkpoint of the first.

use super::TaskId;
use super::rows::Rules;
use super::task::{Attempt, TaskRecord, TaskState};

/// Maximum second attempts of a task, until it is requeued or its job is retried.
const MAX_SECOND_ATTEMPTS: u32 = 1;

/// Whether the job has siblings to compare the task with.
fn has_siblings(task: TaskId) -> bool {
    task.stage.is_per_partition()
}

impl TaskRecord {
    /// Whether a second attempt may start beside the running one.
    pub fn may_have_second_attempt(&self) -> bool {
        let is_leased = matches!(self.state, TaskState::Leased(_));
        is_leased
            && self.second.is_none()
            && self.second_attempts < MAX_SECOND_ATTEMPTS
            && has_siblings(self.task)
    }

    /// Milliseconds that an iteration took, of a task with siblings that is done.
    pub fn pace_ms(&self) -> Option<f64> {
        let TaskState::Done { stats, seconds, .. } = &self.state else { return None };
        let iterations = self.iterations.saturating_sub(stats.resumed_from);
        (has_siblings(self.task) && iterations > 0).then(|| seconds * 1e3 / f64::from(iterations))
    }

    /// Iterations that an attempt has to do.
    pub fn iterations_of(&self, attempt: &Attempt) -> u32 {
        self.iterations.saturating_sub(attempt.resumed_from)
    }
}

impl Rules {
    /// The time from which an attempt counts as slow: it began at `since_ms` and has `iterations` to do, and
    /// siblings take `usual_pace_ms` per iteration. `None`: never.
    pub fn slow_from_ms(&self, since_ms: u64, iterations: u32, usual_pace_ms: f64) -> Option<u64> {
        let usual_ms = usual_pace_ms * f64::from(iterations);
        let patience_ms = (self.straggler_factor * usual_ms).max(self.straggler_after_ms as f64);
        (self.straggler_factor > 0.0).then(|| since_ms.saturating_add(patience_ms as u64))
    }
}

/// The median pace of done tasks, for an even number the faster one; `None` if none is done.
pub fn usual_pace_ms(paces_ms: impl Iterator<Item = f64>) -> Option<f64> {
    let mut paces_ms: Vec<f64> = paces_ms.collect();
    let middle = paces_ms.len().checked_sub(1)? / 2;
    Some(*paces_ms.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::sync::Arc;

    use fathom_core::scene::BlobRef;

    use super::*;
    use crate::schedule::{
        Event, EventBody, JobRows, Lease, Outcome, Stage, TaskOutput, TaskStats, WorkerProfile, step,
    };
    use crate::store::NewJob;

    fn rules(straggler_factor: f64) -> Rules {
        Rules { straggler_factor, straggler_after_ms: 5000, ..Rules::default() }
    }

    #[test]
    fn attempt_is_slow_at_3x_median_of_siblings() {
        let slow = |iterations, paces: &[f64]| {
            let usual_ms = usual_pace_ms(paces.iter().copied())?;
            rules(3.0).slow_from_ms(1000, iterations, usual_ms)
        };
        assert_eq!(slow(100, &[20.0, 1000.0, 30.0]), Some(1000 + 3 * 30 * 100));
        assert_eq!(slow(50, &[20.0, 1000.0, 30.0]), Some(1000 + 5000), "before its time");
        assert_eq!(slow(100, &[30.0, 20.0]), Some(1000 + 3 * 20 * 100));
        assert_eq!(slow(100, &[]), None, "with nothing to compare it with");
        assert_eq!(rules(0.0).slow_from_ms(1000, 100, 20.0), None, "where none is to be");
    }

    #[test]
    fn a_slow_attempt_can_win_over_its_rival() {
        let (mut job, _) = NewJob::sample(0).into_rows(0);
        (job.open_tasks, job.leased_tasks) = (2, 1);
        let task = Stage::Partition.task_of(0);
        let mut record = TaskRecord { attempts: 3, fence: 7, ..TaskRecord::new(task, None, 10) };
        record.state = TaskState::Leased(Attempt {
            worker: "old".into(),
            incarnation: "a".into(),
            request_id: "b".into(),
            number: 3,
            fence: 7,
            since_ms: 0,
            resumed_from: 0,
            memory_bytes: None,
        });
        let mut rows = JobRows { job, tasks: BTreeMap::from([(task, record)]) };
        let id = rows.job.job_id.clone();
        let named = |rows: &JobRows| {
            let leases = rows.tasks[&task].leases(&id).into_iter();
            leases.map(|lease| (lease.attempt, lease.fence)).collect::<Vec<_>>()
        };
        assert_eq!(named(&rows), [(3, 7)]);
        let worker = WorkerProfile {
            name: "new".into(),
            incarnation: "c".into(),
            stages: vec![Stage::Partition],
            methods: fathom_core::config::Method::ALL.to_vec(),
            memory_bytes: None,
            tenant: None,
        };
        let (peers, request_id) = (Arc::default(), "d".to_owned());
        let claim = Event::Claim { task, worker, peers, request_id, fence: 9, is_second: true };
        assert!(step(&mut rows, claim, 1, &Rules::default()).is_ok());
        assert_eq!(named(&rows), [(3, 7), (4, 9)]);
        let blob = BlobRef { digest: "0".repeat(64), bytes: 1 };
        let output = TaskOutput::of(task.stage, blob, TaskStats::default());
        let lease = Lease { job: id.clone(), task, attempt: 3, fence: 7 };
        let done = step(&mut rows, Event::Complete { lease, output }, 2, &Rules::default());
        let Ok(Outcome::Changed(events)) = done else { panic!("{done:?}") };
        assert!(
            matches!(&events[..], [EventBody::Task { attempt: 3, worker, .. }] if worker == "old"),
            "{events:?}"
        );
        assert_eq!((named(&rows), rows.job.leased_tasks), (Vec::new(), 0));
    }
}
