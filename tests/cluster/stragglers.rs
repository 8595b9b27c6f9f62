//! A live but slow worker: another one takes its task too.

use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::support::{FakeTrainer, TestCluster};
use fathom_proto::v1;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_worker_overtakes_a_slow_one_to_the_same_bytes() {
    let cluster = TestCluster::with(|config| {
        config.straggler_factor = 1.0;
        config.straggler_after_ms = 500;
    })
    .await;
    let undisturbed = cluster.submit("undisturbed", 2).await;
    let worker = cluster.worker(FakeTrainer::quick());
    cluster.finished(&undisturbed).await;
    worker.leave().await;

    let disturbed = cluster.submit("disturbed", 2).await;
    let slow = FakeTrainer::hangs_in(v1::Stage::Partition);
    let straggler = cluster.worker_named("slow", slow.clone());
    cluster.wait_for(&disturbed, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
    let _other = cluster.worker_named("quick", FakeTrainer::quick());
    let job = cluster.finished(&disturbed).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let trained = |task: &&v1::Task| task.stage() == v1::Stage::Partition;
    let taken: Vec<_> =
        job.tasks.iter().filter(trained).map(|task| (task.worker.as_str(), task.attempts)).collect();
    assert_eq!(taken, [("quick", 2), ("quick", 1)]);
    let overtaken = job.tasks.iter().find(trained).unwrap();
    assert!(overtaken.resumed_from_iteration > 0, "it started over: {overtaken:?}");
    assert_eq!((overtaken.errors, overtaken.losses, overtaken.second_worker.as_str()), (0, 0, ""));

    // The slow one discards its work, and is free for other tasks.
    let since = std::time::Instant::now();
    while slow.running.load(Ordering::SeqCst) > 0 {
        assert!(
            since.elapsed() < Duration::from_secs(30),
            "it still trains a task that another worker has \
            submitted"
        );
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    straggler.leave().await;
    let models = [cluster.artifacts(&undisturbed).await, cluster.artifacts(&disturbed).await];
    assert_eq!(models[0]["model.ply"], models[1]["model.ply"]);
}
