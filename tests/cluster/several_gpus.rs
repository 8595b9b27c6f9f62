//! One worker process with several GPUs; the coordinator sees one worker per GPU.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::support::{FakeTrainer, TestCluster, free_address, page};
use fathom_proto::v1;
use fathom_proto::worker::v1::Capabilities;
use fathom_worker::OnGpu;
use fathom_worker::execute::{Control, Executor, TaskError, TaskInput, TaskOutput};

/// The value of one series.
fn value(page: &str, series: &str) -> f64 {
    let line = page.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("no {series} in {page}")).parse().unwrap()
}

/// A GPU whose thread panics in its readiness check.
struct Panics;

impl Executor for Panics {
    fn capabilities(&self) -> Capabilities {
        FakeTrainer::quick().capabilities()
    }

    fn prepare(&self) -> Result<(), TaskError> {
        panic!("the driver of this GPU is broken");
    }

    fn execute(&self, _: &TaskInput, _: &dyn Control) -> Result<TaskOutput, TaskError> {
        unreachable!("it is never ready");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn gpus_of_one_worker_train_in_parallel_and_leave_together() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("two GPUs", 2).await;
    let on = |number| OnGpu { number, executor: FakeTrainer::hangs_in(v1::Stage::Partition) };
    let at = free_address();
    let worker = cluster.worker_on(vec![on(0), on(3)], Some(at));
    let trained = |job: &v1::Job| job.tasks.iter().filter(|task| task.checkpoint_iteration > 0).count() == 2;
    let job = cluster.wait_for(&job, trained).await;
    let partitions: Vec<_> = job.tasks.iter().filter(|task| task.checkpoint_iteration > 0).collect();
    let names: BTreeSet<_> = partitions.iter().map(|task| task.worker.as_str()).collect();
    assert_eq!(names, BTreeSet::from(["fake-gpu0", "fake-gpu3"]), "both partitions run at the same time");
    let workers = cluster.workers().await;
    let incarnations: BTreeSet<_> = workers.iter().map(|worker| &worker.worker_id).collect();
    assert_eq!((workers.len(), incarnations.len()), (2, 2), "{workers:#?}");

    let metrics = page(at, "/metrics").await.1;
    for gpu in ["0", "3"] {
        assert_eq!(value(&metrics, &format!("fathom_worker_up{{gpu=\"{gpu}\"}}")), 1.0);
        assert!(value(&metrics, &format!("fathom_worker_iterations_total{{gpu=\"{gpu}\"}}")) > 0.0);
    }
    let fetched = |gpu: &str| value(&metrics, &format!("fathom_worker_fetched_bytes_total{{gpu=\"{gpu}\"}}"));
    let mut kept = 0;
    for folder in std::fs::read_dir(cluster.dir.path().join("cache")).unwrap() {
        for file in std::fs::read_dir(folder.unwrap().path()).unwrap() {
            kept += file.unwrap().metadata().unwrap().len();
        }
    }
    assert_eq!(fetched("0") + fetched("3"), kept as f64, "a blob was fetched twice");

    worker.leave().await;
    let left = cluster.get(&job.job_id).await;
    for task in left.tasks.iter().filter(|task| task.stage() == v1::Stage::Partition) {
        assert_eq!(task.state(), v1::TaskState::Ready, "{task:#?}");
        assert!(task.checkpoint_iteration > 0 && (task.errors, task.losses) == (0, 0), "{task:#?}");
    }
    let _successor = cluster.worker(FakeTrainer::quick());
    assert_eq!(cluster.finished(&job.job_id).await.state(), v1::JobState::Succeeded);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failed_gpu_ends_no_other_and_is_reported_on_leaving() {
    let cluster = TestCluster::start().await;
    let at = free_address();
    let gpus = vec![
        OnGpu { number: 0, executor: Arc::new(Panics) },
        OnGpu { number: 1, executor: FakeTrainer::ready_after(u32::MAX) },
        OnGpu { number: 2, executor: FakeTrainer::quick() },
    ];
    let worker = cluster.worker_on(gpus, Some(at));
    let job = cluster.submit("on what is left", 2).await;
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let of_worker = |task: &&v1::Task| task.worker.starts_with("fake");
    assert!(job.tasks.iter().filter(of_worker).all(|task| task.worker == "fake-gpu2"), "{:#?}", job.tasks);
    let metrics = page(at, "/metrics").await.1;
    let up = [0, 1, 2].map(|gpu| value(&metrics, &format!("fathom_worker_up{{gpu=\"{gpu}\"}}")));
    assert_eq!(up, [0.0, 1.0, 1.0]);
    assert_eq!(page(at, "/readyz").await, (200, "ready\n".into()));

    worker.ask_to_leave();
    let error = worker.ended().await.unwrap_err().to_string();
    assert!(error.starts_with("fake-gpu0: a thread of the worker failed"), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_whose_gpus_all_fail_ends() {
    let cluster = TestCluster::start().await;
    let gpus = vec![
        OnGpu { number: 0, executor: Arc::new(Panics) },
        OnGpu { number: 1, executor: Arc::new(Panics) },
    ];
    let error = cluster.worker_on(gpus, None).ended().await.unwrap_err().to_string();
    assert!(error.contains("a thread of the worker failed"), "{error}");
}
