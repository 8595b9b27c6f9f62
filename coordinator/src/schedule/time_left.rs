//! Estimates the time left of a job from the speed of its tasks.
//!
//! Only training counts, which is nearly all of the time: the coordinator's own tasks and the evaluation take
//! less than the error of the forecast.

use super::{JobRecord, JobState, LiveProgress, Stage, TaskRecord, TaskState};

/// Seconds of training left for a running job with `workers`; `None` until a speed has been measured, and
/// when nothing is left to train.
///
/// Stages follow each other. A stage takes the time of its tasks divided by the workers, and at least that of
/// its longest task. The speed is that of its current leases, or else of done tasks.
pub fn time_left(
    job: &JobRecord,
    tasks: &[(TaskRecord, Option<LiveProgress>)],
    workers: usize,
) -> Option<f64> {
    if job.state != JobState::Running {
        return None;
    }
    let speed = speed(tasks)?;
    let mut seconds = 0.0;
    for stage in Stage::all().filter(|stage| stage.spec().trains) {
        let of_stage = job.shape.tasks_of(stage);
        let left = |(task, live): &(TaskRecord, Option<LiveProgress>)| -> Option<f64> {
            let is_open = of_stage.contains(&task.task) && !matches!(task.state, TaskState::Done { .. });
            is_open.then(|| f64::from(task.iterations.saturating_sub(iteration(task, live.as_ref()))))
        };
        let left: Vec<f64> = tasks.iter().filter_map(left).collect();
        let longest = left.iter().copied().fold(0.0, f64::max);
        let at_once = left.len().min(workers).max(1) as f64;
        seconds += (left.iter().sum::<f64>() / at_once).max(longest) / speed;
    }
    (seconds > 0.0).then_some(seconds)
}

/// Iterations of a task that are already done.
fn iteration(task: &TaskRecord, live: Option<&LiveProgress>) -> u32 {
    let checkpoint = task.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.iteration);
    // Both count from the beginning of the task, also in the second part of a partition.
    live.map_or(0, |live| live.iteration).max(checkpoint)
}

/// Iterations a second of one worker.
fn speed(tasks: &[(TaskRecord, Option<LiveProgress>)]) -> Option<f64> {
    let live: Vec<f64> = tasks
        .iter()
        .filter_map(|(_, live)| live.as_ref())
        .map(|live| f64::from(live.iterations_per_second))
        .filter(|speed| *speed > 0.0)
        .collect();
    if !live.is_empty() {
        return Some(live.iter().sum::<f64>() / live.len() as f64);
    }
    let done = tasks.iter().filter_map(|(task, _)| match &task.state {
        TaskState::Done { stats, .. } if task.task.stage.spec().trains && stats.seconds > 0.0 => {
            Some((f64::from(stats.iterations.saturating_sub(stats.resumed_from)), stats.seconds))
        }
        _ => None,
    });
    let (iterations, seconds) = done.fold((0.0, 0.0), |(i, s), (more_i, more_s)| (i + more_i, s + more_s));
    (iterations > 0.0).then(|| iterations / seconds)
}

#[cfg(test)]
mod tests {
    use fathom_core::scene::BlobRef;

    use super::*;
    use crate::schedule::{JobShape, TaskId, TaskStats};
    use crate::store::NewJob;

    fn job(partitions: u32) -> JobRecord {
        let (mut job, _) = NewJob::sample(0).into_rows(0);
        let stages =
            [Stage::Plan, Stage::Global, Stage::Partition, Stage::Merge, Stage::Evaluate, Stage::Artifacts];
        job.shape = JobShape { partitions, stages: stages.into(), ..JobShape::default() };
        job
    }

    fn task(task: TaskId, iterations: u32, at: Option<(u32, f32)>) -> (TaskRecord, Option<LiveProgress>) {
        let live = at.map(|(iteration, iterations_per_second)| LiveProgress {
            iteration,
            iterations_per_second,
            ..LiveProgress::default()
        });
        (TaskRecord::new(task, None, iterations), live)
    }

    #[test]
    fn time_left_is_shared_by_workers_and_bounded_by_a_task() {
        let mut job = job(3);
        let mut tasks = vec![
            task(Stage::Global.task(), 100, Some((50, 10.0))),
            task(Stage::Partition.task_of(0), 200, None),
            task(Stage::Partition.task_of(1), 200, None),
            task(Stage::Partition.task_of(2), 800, None),
        ];
        let left = |job: &JobRecord, tasks: &[_], workers| time_left(job, tasks, workers);
        assert_eq!(left(&job, &tasks, 1), Some(5.0 + 120.0));
        assert_eq!(left(&job, &tasks, 2), Some(5.0 + 80.0), "the longest partition alone");
        assert_eq!(left(&job, &tasks, 0), Some(125.0), "the one that works has not called recently");

        // No task runs now: done tasks have a speed too.
        let stats = TaskStats { iterations: 100, seconds: 50.0, resumed_from: 50, ..TaskStats::default() };
        let result = BlobRef { digest: "0".repeat(64), bytes: 1 };
        tasks[0].0.state = TaskState::Done { result, stats, seconds: 60.0 };
        tasks[0].1 = None;
        assert_eq!(left(&job, &tasks, 1), Some(1200.0), "50 iterations in 50 s");

        job.state = JobState::Paused;
        assert_eq!(left(&job, &tasks, 1), None);
    }

    #[test]
    fn there_is_no_estimate_before_the_first_measurement() {
        let job = job(1);
        assert_eq!(time_left(&job, &[task(Stage::Partition.task_of(0), 100, None)], 4), None);
        assert_eq!(time_left(&job, &[task(Stage::Partition.task_of(0), 100, Some((0, 0.0)))], 4), None);
    }
}
