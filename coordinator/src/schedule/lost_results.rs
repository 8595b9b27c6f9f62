//! Committed results that the disk has changed or lost.

use super::event::{EventBody, TaskChange};
use super::job::JobState;
use super::rows::{JobRows, Rules, end_job, given_up, task_event};
use super::task::{Lease, TaskRecord, TaskState};
use super::{Stage, TaskId};

/// Requeues the partitions `tasks` from their last checkpoints; the task under `lease`, which found the
/// fault, runs again after them. Each counts as the loss of a worker, so that a bad disk cannot keep a job
/// running forever.
pub fn requeue_lost(
    rows: &mut JobRows,
    lease: &Lease,
    tasks: &[TaskId],
    message: &str,
    now_ms: u64,
    rules: &Rules,
    events: &mut Vec<EventBody>,
) {
    if let Some(reader) = rows.tasks.get_mut(&lease.task) {
        rows.job.leased_tasks = rows.job.leased_tasks.saturating_sub(1);
        reader.returned_fence = lease.fence;
        reader.become_state(TaskState::Blocked);
        events.push(task_event(reader, lease.attempt, TaskChange::Ready, "released: waits for lost results"));
    }
    let mut ready = 0;
    let mut spent = None;
    let is_done = |record: &TaskRecord| matches!(record.state, TaskState::Done { .. });
    for task in tasks.iter().filter(|task| task.stage == Stage::Partition) {
        let Some(record) = rows.tasks.get_mut(task).filter(|record| is_done(record)) else { continue };
        rows.job.iterations_done = rows.job.iterations_done.saturating_sub(record.iterations.into());
        record.losses += 1;
        record.second_attempts = 0;
        record.last_errors.push(format!("result of attempt {}: {message}", record.attempts));
        let surplus = record.last_errors.len().saturating_sub(TaskRecord::ERRORS_KEPT);
        record.last_errors.drain(..surplus);
        if record.losses >= rules.max_losses {
            record.state = TaskState::Dead;
            events.push(task_event(record, record.attempts, TaskChange::Dead, message));
            spent = Some(given_up(record, ["lost worker or result", "lost workers or results"]));
            continue;
        }
        let pause = rules.backoff_ms(record.errors + record.losses, lease.fence);
        record.state = TaskState::Ready { not_before_ms: now_ms + pause };
        events.push(task_event(
            record,
            record.attempts,
            TaskChange::Ready,
            "result lost: the task is requeued",
        ));
        ready += 1;
    }
    // Also when the job ends: a retry continues with the lost results.
    rows.job.stage = Stage::Partition;
    rows.job.stage_since_ms = now_ms;
    if let Some(error) = spent {
        return end_job(rows, JobState::Failed, error, now_ms, events);
    }
    rows.job.open_tasks = ready;
    events.push(EventBody::Stage { stage: Stage::Partition, tasks: ready });
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use std::collections::BTreeMap;
    use std::sync::Arc;

    use fathom_core::scene::BlobRef;

    use super::super::{
        Event, Outcome, Planned, PlannedTask, Refusal, TaskOutput, TaskStats, WorkerProfile, step,
    };
    use super::*;
    use crate::store::NewJob;

    fn blob(name: &str) -> BlobRef {
        BlobRef { digest: name.into(), bytes: 1 }
    }

    /// A job of two partitions without a coarse model, at its beginning.
    struct TwoPartitions {
        rows: JobRows,
        rules: Rules,
        fence: u64,
    }

    impl TwoPartitions {
        fn new(max_losses: u32) -> Self {
            let (job, plan) = NewJob::sample(0).into_rows(0);
            let rows = JobRows { job, tasks: BTreeMap::from([(Stage::Plan.task(), plan)]) };
            Self { rows, rules: Rules { max_losses, ..Rules::default() }, fence: 0 }
        }

        fn apply(&mut self, event: Event) -> Result<Outcome, Refusal> {
            // Long after every back-off.
            step(&mut self.rows, event, 1_000_000 * self.fence, &self.rules)
        }

        fn take(&mut self, task: TaskId) -> Lease {
            self.fence += 1;
            let stages = Stage::all().collect();
            let worker = WorkerProfile {
                name: "any".into(),
                incarnation: "1".into(),
                stages,
                methods: fathom_core::config::Method::ALL.to_vec(),
                memory_bytes: None,
                tenant: None,
            };
            let (peers, request_id, fence) = (Arc::default(), self.fence.to_string(), self.fence);
            self.apply(Event::Claim { task, worker, peers, request_id, fence, is_second: false }).unwrap();
            self.rows.tasks[&task].leases(&self.rows.job.job_id).remove(0)
        }

        fn complete(&mut self, lease: Lease) -> Result<Outcome, Refusal> {
            let planned = || PlannedTask::new(blob("spec"), 10);
            let output = match lease.task {
                task if task.stage == Stage::Plan => {
                    let tasks = [
                        (Stage::Partition.task_of(0), planned()),
                        (Stage::Partition.task_of(1), planned()),
                        (Stage::Merge.task(), PlannedTask::default()),
                        (Stage::Artifacts.task(), PlannedTask::default()),
                    ];
                    let planned = Planned { tasks: tasks.into(), warnings: Vec::new() };
                    TaskOutput::planned(blob("plan"), blob("picture"), planned)
                }
                task => TaskOutput::of(task.stage, blob(&task.to_string()), TaskStats::default()),
            };
            self.apply(Event::Complete { lease, output })
        }

        /// Up to the merge, which is running.
        fn merging(max_losses: u32) -> (Self, Vec<Lease>) {
            let mut two = Self::new(max_losses);
            let mut leases = Vec::new();
            for task in [Stage::Plan.task(), Stage::Partition.task_of(0), Stage::Partition.task_of(1)] {
                let lease = two.take(task);
                leases.push(lease.clone());
                two.complete(lease).unwrap();
            }
            leases.push(two.take(Stage::Merge.task()));
            (two, leases)
        }

        fn lose(&mut self, lease: &Lease, tasks: &[TaskId]) -> Result<Outcome, Refusal> {
            let (lease, tasks) = (lease.clone(), tasks.to_vec());
            self.apply(Event::ResultsLost { lease, tasks, message: "has the digest 7".into() })
        }
    }

    #[test]
    fn a_lost_result_is_retrained_and_then_merged() {
        let (mut two, leases) = TwoPartitions::merging(5);
        let [_, _, second, merge] = &leases[..] else { panic!("{leases:?}") };
        let events = two.lose(merge, &[Stage::Partition.task_of(1)]).unwrap();
        assert!(matches!(events, Outcome::Changed(events) if events.len() == 3));
        let job = &two.rows.job;
        assert_eq!((job.stage, job.open_tasks, job.leased_tasks), (Stage::Partition, 1, 0));
        assert_eq!((job.iterations_done, job.iterations_total), (10, 20));
        assert_eq!(two.rows.tasks[&Stage::Merge.task()].state, TaskState::Blocked);
        assert_eq!(two.rows.tasks[&Stage::Partition.task_of(1)].losses, 1);
        // No earlier lease counts any more, and intact results stay.
        assert!(matches!(two.complete(second.clone()), Err(Refusal::StaleFence { .. })));
        assert!(matches!(two.lose(merge, &[Stage::Partition.task_of(0)]), Err(Refusal::StaleFence { .. })));
        assert!(matches!(two.rows.tasks[&Stage::Partition.task_of(0)].state, TaskState::Done { .. }));

        let again = two.take(Stage::Partition.task_of(1));
        two.complete(again).unwrap();
        assert_eq!((two.rows.job.stage, two.rows.job.open_tasks), (Stage::Merge, 1));
        assert_eq!((two.rows.job.iterations_done, two.take(Stage::Merge.task()).attempt), (20, 2));
    }

    #[test]
    fn a_disk_that_keeps_losing_results_fails_the_job() {
        let (mut two, leases) = TwoPartitions::merging(2);
        two.lose(&leases[3], &[Stage::Partition.task_of(0), Stage::Partition.task_of(1)]).unwrap();
        for task in [Stage::Partition.task_of(0), Stage::Partition.task_of(1)] {
            let lease = two.take(task);
            two.complete(lease).unwrap();
        }
        let merge = two.take(Stage::Merge.task());
        two.lose(&merge, &[Stage::Partition.task_of(0)]).unwrap();
        let job = &two.rows.job;
        assert_eq!((job.state, job.open_tasks, job.leased_tasks), (JobState::Failed, 0, 0));
        let parts = ["partition-0000 failed for good", "has the digest 7"];
        assert!(parts.iter().all(|part| job.error.contains(part)), "{}", job.error);

        // On another disk a retry makes the lost results, and then merges.
        two.apply(Event::Retry).unwrap();
        let job = &two.rows.job;
        assert_eq!((job.stage, job.open_tasks), (Stage::Partition, 1));
        let lease = two.take(Stage::Partition.task_of(0));
        two.complete(lease).unwrap();
        assert_eq!((two.rows.job.stage, two.rows.job.open_tasks), (Stage::Merge, 1));
        two.take(Stage::Merge.task());
    }

    #[test]
    fn only_partitions_that_are_done_can_be_lost() {
        let (mut two, leases) = TwoPartitions::merging(5);
        let before = two.rows.tasks.clone();
        for task in [Stage::Plan.task(), Stage::Merge.task(), Stage::Partition.task_of(7)] {
            assert_eq!(two.lose(&leases[3], &[task]), Err(Refusal::WrongOutput(Stage::Merge.task())));
        }
        assert_eq!(two.rows.tasks, before);
    }
}
