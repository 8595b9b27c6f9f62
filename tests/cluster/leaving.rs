//! Tasks of a worker that is asked to leave.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::support::{FakeTrainer, TestCluster};
use fathom_proto::v1;
use fathom_worker::{IdleLimit, OnGpu, WorkerConfig};
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

const IDLE: Duration = Duration::from_secs(2);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_leaves_after_its_last_task_or_when_idle() {
    let cluster = TestCluster::start().await;
    let idle = Some(IdleLimit(IDLE));
    let settings = cluster.worker_settings(&cluster.url(), "patient");
    let trainer = FakeTrainer::quick();
    let on = |trainer: &Arc<FakeTrainer>| vec![OnGpu { number: 0, executor: Arc::clone(trainer) as _ }];

    // Three tasks and no more, though the job has further ones.
    let job = cluster.submit("more than three", 4).await;
    let limited = WorkerConfig { max_tasks: 3.try_into().ok(), ..settings.clone() };
    TestCluster::start_worker(limited, on(&trainer)).ended().await.unwrap();
    assert_eq!(trainer.calls.load(Ordering::SeqCst), 3);
    assert_ne!(cluster.get(&job).await.state(), v1::JobState::Succeeded);

    // The rest of the job, and then the idle time.
    let worker = TestCluster::start_worker(WorkerConfig { exit_when_idle: idle, ..settings }, on(&trainer));
    assert_eq!(cluster.finished(&job).await.state(), v1::JobState::Succeeded);
    let finished = std::time::Instant::now();
    worker.ended().await.unwrap();
    assert!(finished.elapsed() < 5 * IDLE, "it was idle for {:?}", finished.elapsed());
    let lost: u32 = cluster.get(&job).await.tasks.iter().map(|task| task.losses + task.errors).sum();
    assert_eq!(lost, 0, "a worker that leaves by itself loses nothing");
}

/// A worker must end soon after its idle time, whatever it waits for.
async fn ends(worker: crate::support::RunningWorker, waits_for: &str) {
    let ended = tokio::time::timeout(Duration::from_secs(40), worker.ended()).await;
    assert!(ended.is_ok_and(|ended| ended.is_ok()), "it still waits for {waits_for}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_worker_leaves_before_it_could_begin() {
    let cluster = TestCluster::start().await;
    let idle = |url: &str| WorkerConfig {
        exit_when_idle: Some(IdleLimit(IDLE)),
        ..cluster.worker_settings(url, "in vain")
    };
    let on = |executor: Arc<FakeTrainer>| vec![OnGpu { number: 0, executor }];
    // Nothing listens there.
    let unreachable = TestCluster::start_worker(idle("http://127.0.0.1:1"), on(FakeTrainer::quick()));
    let without_gpu = FakeTrainer::quick();
    without_gpu.unready.store(u32::MAX, Ordering::SeqCst);
    let unready = TestCluster::start_worker(idle(&cluster.url()), on(Arc::clone(&without_gpu)));
    ends(unreachable, "a coordinator").await;
    ends(unready, "its GPU").await;
    assert_eq!(without_gpu.calls.load(Ordering::SeqCst), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_worker_leaves_without_a_coordinator_too() {
    let cluster = TestCluster::start().await;
    let (held, holds) = watch::channel(false);
    let url = gated_proxy(cluster.address(), holds).await;
    let settings =
        WorkerConfig { exit_when_idle: Some(IdleLimit(IDLE)), ..cluster.worker_settings(&url, "cut off") };
    let executor = FakeTrainer::quick();
    let worker = TestCluster::start_worker(settings, vec![OnGpu { number: 0, executor }]);
    while cluster.workers().await.is_empty() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    held.send_replace(true);
    ends(worker, "a coordinator that does not answer").await;
}
