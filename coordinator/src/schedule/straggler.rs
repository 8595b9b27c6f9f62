//! Attempts that take much longer than others at such tasks, beside which an idle worker begins a second one: a machine may be slow
//! without being silent.
//!
//! The measure is the time for an iteration, claim to result, in which the iterations stand for the size of a partition: they
//! follow from its cameras. A second attempt goes on from the last checkpoint of the first.

use super::scheduler::Rules;
use super::task::{Attempt, TaskRecord, TaskState};
use super::{TaskId, TaskKind};

/// Second attempts that are begun beside the first ones of a task, until it is made again or its job is tried again.
const MOST_RIVALS: u32 = 1;

/// Whether there are other tasks of a job to compare such a task with.
fn has_siblings(task: TaskId) -> bool {
    matches!(task.kind(), TaskKind::Refine | TaskKind::Partition)
}

impl TaskRecord {
    /// Whether a second attempt may be begun beside the one that runs.
    pub fn may_have_rival(&self) -> bool {
        let is_leased = matches!(self.state, TaskState::Leased(_));
        is_leased && self.rival.is_none() && self.rivals < MOST_RIVALS && has_siblings(self.task)
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
    /// When an attempt with so many iterations to do, that began at `since_ms`, is slow beside what others took; `None`: never.
    pub fn slow_from_ms(&self, since_ms: u64, iterations: u32, paces_ms: &mut [f64]) -> Option<u64> {
        let middle = paces_ms.len().checked_sub(1)? / 2;
        let (_, median_ms, _) = paces_ms.select_nth_unstable_by(middle, f64::total_cmp);
        let usual_ms = *median_ms * f64::from(iterations);
        let patience_ms = (self.straggler_factor * usual_ms).max(self.straggler_after_ms as f64);
        (self.straggler_factor > 0.0).then(|| since_ms.saturating_add(patience_ms as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules(straggler_factor: f64) -> Rules {
        Rules { straggler_factor, straggler_after_ms: 5000, ..Rules::default() }
    }

    #[test]
    fn an_attempt_is_slow_after_three_times_what_the_middle_one_of_its_siblings_took_for_as_many_iterations()
    {
        let slow = |iterations, paces: &[f64]| rules(3.0).slow_from_ms(1000, iterations, &mut paces.to_vec());
        assert_eq!(slow(100, &[20.0, 1000.0, 30.0]), Some(1000 + 3 * 30 * 100));
        assert_eq!(slow(50, &[20.0, 1000.0, 30.0]), Some(1000 + 5000), "before its time");
        assert_eq!(slow(100, &[30.0, 20.0]), Some(1000 + 3 * 20 * 100));
        assert_eq!(slow(100, &[]), None, "with nothing to compare it with");
        assert_eq!(rules(0.0).slow_from_ms(1000, 100, &mut [20.0]), None, "where none is to be");
    }
}
