//! Tasks of a worker that is asked to leave.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::support::{FakeTrainer, TestCluster};
use fathom_proto::v1;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

/// A proxy to the coordinator that delays its answers while `held`.
async fn gated_proxy(to: SocketAddr, held: watch::Receiver<bool>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(async move {
        while let Ok((worker, _)) = listener.accept().await {
            let coordinator = TcpStream::connect(to).await.unwrap();
            let ((mut asks, mut hears), (mut answers, mut listens)) =
                (worker.into_split(), coordinator.into_split());
            tokio::spawn(async move { tokio::io::copy(&mut asks, &mut listens).await });
            let mut held = held.clone();
            tokio::spawn(async move {
                let mut piece = [0; 4096];
                while let Ok(bytes @ 1..) = answers.read(&mut piece).await {
                    // After the test nothing uses it.
                    let _ = held.wait_for(|held| !held).await;
                    if hears.write_all(&piece[..bytes]).await.is_err() {
                        break;
                    }
                }
            });
        }
    });
    url
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_leaving_worker_submits_its_checkpoint_and_counts_no_loss() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("leaves", 1).await;
    let leaver = cluster.worker(FakeTrainer::slow());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.progress.is_some())).await;
    leaver.leave().await;
    let released = cluster.get(&job).await;
    let task = released.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert_eq!(task.state(), v1::TaskState::Ready);
    assert!(task.checkpoint_iteration > 0 && (task.errors, task.losses) == (0, 0));
    assert_eq!(task.attempts, 1, "it claimed again while leaving");
    let _successor = cluster.worker(FakeTrainer::quick());
    assert_eq!(cluster.finished(&job).await.state(), v1::JobState::Succeeded);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_leaving_worker_returns_a_task_still_being_assigned() {
    let cluster = TestCluster::start().await;
    let (held, holds) = watch::channel(false);
    let url = gated_proxy(cluster.address(), holds).await;
    let trainer = FakeTrainer::hangs_after_checkpoint();
    let worker = cluster.worker_at(&url, Arc::clone(&trainer));
    while cluster.workers().await.is_empty() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    // Its claim waits in the coordinator.
    tokio::time::sleep(Duration::from_millis(200)).await;
    held.send_replace(true);
    let job = cluster.submit("given", 1).await;
    let taken = |job: &v1::Job| job.tasks.iter().find(|task| task.worker == "fake").cloned();
    let before = taken(&cluster.wait_for(&job, |job| taken(job).is_some()).await).unwrap();
    worker.ask_to_leave();
    tokio::time::sleep(Duration::from_millis(100)).await;
    held.send_replace(false);
    worker.ended().await.unwrap();
    let job = cluster.get(&job).await;
    let task = job.tasks.iter().find(|task| task.task_id == before.task_id).unwrap();
    assert_eq!((task.state(), task.errors, task.losses), (v1::TaskState::Ready, 0, 0), "{task:?}");
    assert_eq!(trainer.running.load(Ordering::SeqCst), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_with_a_result_leaves_even_without_a_coordinator() {
    let cluster = TestCluster::start().await;
    let (held, holds) = watch::channel(false);
    let url = gated_proxy(cluster.address(), holds).await;
    let trainer = FakeTrainer::slow();
    let worker = cluster.worker_at(&url, Arc::clone(&trainer));
    let job = cluster.submit("not submitted", 1).await;
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.progress.is_some())).await;
    // From here on it receives no answers, and reaches a result.
    held.send_replace(true);
    while trainer.running.load(Ordering::SeqCst) > 0 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    worker.ask_to_leave();
    let begin = std::time::Instant::now();
    let ended = tokio::time::timeout(Duration::from_secs(50), worker.ended()).await;
    assert!(ended.is_ok_and(|ended| ended.is_ok()), "it still runs after {:?}", begin.elapsed());
    assert!(begin.elapsed() > Duration::from_secs(25), "it gave up too early: {:?}", begin.elapsed());
    held.send_replace(false);
}
