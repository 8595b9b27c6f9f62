//! The span of an attempt.

use tracing::Span;
use tracing::field::Empty;

/// The span of all work of one attempt at a task, on any thread.
///
/// With the feature `otel` all attempts of a job lie in one trace, whose id is derived from the job's.
/// Coordinator and workers need not exchange it, and a restart does not break it.
pub fn attempt_span(job: &str, task: &str, attempt: u32, worker: &str) -> Span {
    let span = tracing::info_span!("task", job, task, partition = Empty, attempt, worker);
    if let Some(partition) = partition_of(task) {
        span.record("partition", partition);
    }
    #[cfg(feature = "otel")]
    crate::otel::join_trace_of(job, &span);
    span
}

/// "partition-0003" and "first_part-0003" belong to partition 3, "evaluate-0003" to none.
fn partition_of(task: &str) -> Option<u32> {
    let (stage, number) = task.split_once('-')?;
    ["partition", "first_part"].contains(&stage).then(|| number.parse().ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tasks_of_partitions_have_one() {
        let found =
            ["partition-0003", "first_part-0012", "evaluate-0003", "merge", "partition-x"].map(partition_of);
        assert_eq!(found, [Some(3), Some(12), None, None, None]);
    }
}
