//! Memory of the service over as many jobs as a week has, at full speed. Coordinator, workers and callers are
//! one process, so nothing that any of them keeps for a job may stay.

use std::time::{Duration, Instant};

use fathom_coordinator::retention::Policy;
use fathom_proto::v1;

use crate::postgres;
use crate::resident::resident_mib;
use crate::support::{FakeTrainer, TestCluster};

const DAYS: usize = 7;
const JOBS_A_DAY: usize = 52;
const HOUR: Duration = Duration::from_secs(3600);
const WORKERS: usize = 4;
/// What may be in use more after the last three days than after the first three, MiB.
const SLACK_MIB: f64 = 12.0;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes; run `make soak`"]
async fn a_week_of_jobs_leaves_no_memory_in_use() {
    memory_over_a_week(TestCluster::start().await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes; run `make soak`"]
async fn a_week_of_jobs_with_a_database_leaves_no_memory_in_use() {
    let Some(url) = postgres::database() else { return };
    memory_over_a_week(TestCluster::with(|config| config.store = Some(url)).await).await;
}

async fn memory_over_a_week(cluster: TestCluster) {
    let _workers: Vec<_> = (0..WORKERS)
        .map(|number| cluster.worker_named(&format!("worker-{number}"), FakeTrainer::quick()))
        .collect();
    // It keeps the photographs that all jobs use.
    let first = cluster.submit("first", 2).await;
    cluster.finished(&first).await;
    let begin = Instant::now();
    let mut after_days = Vec::new();
    for day in 0..DAYS {
        for number in 0..JOBS_A_DAY {
            let job = cluster.submit(&format!("{number} of day {day}"), 2).await;
            let job = cluster.finished(&job).await;
            assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
            assert!(!cluster.events(&job.job_id, 0).await.is_empty());
            cluster.jobs().delete_job(v1::DeleteJobRequest { job_id: job.job_id }).await.unwrap();
        }
        let removed = cluster.collect(Policy { jobs: None, unused: Duration::ZERO, uploads: HOUR }).await;
        assert!(removed.blobs > JOBS_A_DAY as u64, "{removed:?}");
        after_days.push(resident_mib());
    }
    println!(
        "{} jobs in {:.0?}; memory after each day, MiB: {after_days:.0?}",
        DAYS * JOBS_A_DAY,
        begin.elapsed()
    );
    // It differs from day to day by what the allocator keeps.
    let middle = |days: &[f64]| {
        let mut sorted = days.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[days.len() / 2]
    };
    let (early, late) = (middle(&after_days[..3]), middle(&after_days[DAYS - 3..]));
    assert!(early > 0.0 && late < early + SLACK_MIB, "memory grows: {after_days:.0?} MiB");
}
