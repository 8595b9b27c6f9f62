//! The curves of a job over real connections.

use std::time::Duration;

use fathom_coordinator::retention::Policy;
use fathom_proto::v1;

use crate::support::{FakeTrainer, TestCluster, reason_of};

async fn history(cluster: &TestCluster, job: &str) -> Vec<v1::TaskHistory> {
    let request = v1::GetHistoryRequest { job_id: job.to_owned(), ..Default::default() };
    cluster.jobs().get_history(request).await.unwrap().into_inner().tasks
}

fn iterations(of: &v1::TaskHistory) -> Vec<u32> {
    of.points.iter().filter_map(|point| Some(point.progress?.iteration)).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn curves_outlive_worker_and_coordinator_and_end_with_the_job() {
    let mut cluster = TestCluster::start().await;
    let job = cluster.submit("curves", 2).await;
    assert_eq!(history(&cluster, &job).await, []);
    let worker = cluster.worker(FakeTrainer::fails_once());
    let done = cluster.finished(&job).await;
    worker.leave().await;

    let curves = history(&cluster, &job).await;
    let trained: Vec<&v1::Task> = done
        .tasks
        .iter()
        .filter(|task| matches!(task.stage(), v1::Stage::Global | v1::Stage::Partition))
        .collect();
    assert_eq!(trained.len(), 3);
    for task in trained {
        let curve = curves.iter().find(|curve| curve.task_id == task.task_id).expect("its curve");
        let steps = iterations(curve);
        assert!(steps.windows(2).all(|pair| pair[0] < pair[1]), "{steps:?}");
        // Points that no renewal has sent arrive with the result.
        assert_eq!(steps.last().copied(), task.progress.map(|progress| progress.iterations), "{steps:?}");
        let last = curve.points.last().expect("a point");
        assert_eq!(last.attempt, task.attempts);
        let created = done.create_time.map(|time| time.seconds);
        let ended = done.end_time.map(|time| time.seconds);
        let measured = last.time.map(|time| time.seconds);
        assert!(created <= measured && measured <= ended, "{created:?} {measured:?} {ended:?}");
    }

    cluster.restart().await;
    assert_eq!(history(&cluster, &job).await, curves, "a restart lost points");
    cluster.jobs().delete_job(v1::DeleteJobRequest { job_id: job.clone() }).await.unwrap();
    let request = v1::GetHistoryRequest { job_id: job.clone(), ..Default::default() };
    assert_eq!(reason_of(&cluster.jobs().get_history(request).await.unwrap_err()), "JOB_NOT_FOUND");
    // Longer than the pause between two rounds of storing.
    tokio::time::sleep(Duration::from_secs(6)).await;
    assert!(!cluster.dir.path().join("data/logs").join(&job).exists(), "a deleted job left its curves");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_of_previews_are_kept_as_long_as_their_job() {
    let mut cluster = TestCluster::start().await;
    let job = cluster.submit("previews", 2).await;
    let worker = cluster.worker(FakeTrainer::hangs_after_checkpoint());
    let pictures = loop {
        let previews = history(&cluster, &job).await.into_iter().flat_map(|task| task.previews);
        let pictures: Vec<_> = previews.flat_map(|of| [of.render, of.clear]).flatten().collect();
        if !pictures.is_empty() {
            break pictures;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    assert_eq!(pictures.len(), 2, "with and without the water");
    let missing = async |cluster: &TestCluster| {
        let request = v1::FindMissingBlobsRequest { blobs: pictures.clone(), ..Default::default() };
        cluster.uploads().find_missing_blobs(request).await.unwrap().into_inner().missing.len()
    };
    let at_once = Policy { jobs: None, unused: Duration::ZERO, uploads: Duration::from_secs(3600) };

    cluster.collect(at_once).await;
    assert_eq!(missing(&cluster).await, 0, "previews that wait to be stored lost their pictures");
    worker.leave().await;
    cluster.restart().await;
    cluster.collect(at_once).await;
    assert_eq!(missing(&cluster).await, 0, "previews of a stored history lost their pictures");

    cluster
        .jobs()
        .cancel_job(v1::CancelJobRequest { job_id: job.clone(), ..Default::default() })
        .await
        .unwrap();
    cluster.jobs().delete_job(v1::DeleteJobRequest { job_id: job.clone() }).await.unwrap();
    cluster.collect(at_once).await;
    assert_eq!(missing(&cluster).await, 2, "a deleted job keeps its pictures");
}
