//! Messages that a worker receives over its session, long before it would renew.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use crate::support::{FakeTrainer, TestCluster, reason_of, registration};
use fathom_proto::admin::v1::DrainWorkerRequest;
use fathom_proto::dial::Dial;
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

/// Workers renew after a quarter of it, so never in these tests.
const LEASE_MS: u32 = 3_600_000;

async fn cluster() -> TestCluster {
    TestCluster::with(|config| {
        config.lease_ms = LEASE_MS;
        config.stall_ms = 0;
    })
    .await
}

async fn has_stopped(trainer: &FakeTrainer) {
    let since = Instant::now();
    while trainer.running.load(Ordering::SeqCst) > 0 {
        assert!(since.elapsed() < Duration::from_secs(20), "it still trains");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_learns_at_once_of_cancel_pause_and_drain() {
    let cluster = cluster().await;
    let trainer = FakeTrainer::hangs_after_checkpoint();
    let _worker = cluster.worker(Arc::clone(&trainer));
    let trains = async |name| {
        let job = cluster.submit(name, 1).await;
        cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
        job
    };
    let cancelled = trains("cancelled").await;
    let request = v1::CancelJobRequest { job_id: cancelled, reason: "enough".into() };
    cluster.jobs().cancel_job(request).await.unwrap();
    has_stopped(&trainer).await;

    // A returned task comes with its checkpoint and counts against no budget.
    let given_back = async |job: &str| {
        let partition =
            |job: &v1::Job| job.tasks.iter().find(|task| task.task_id == "partition-0000").cloned();
        let job = cluster
            .wait_for(job, |job| partition(job).is_some_and(|t| t.state() == v1::TaskState::Ready))
            .await;
        let task = partition(&job).unwrap();
        assert!(task.checkpoint_iteration > 0 && (task.errors, task.losses) == (0, 0), "{task:?}");
    };
    let paused = trains("paused").await;
    let request = v1::PauseJobRequest { job_id: paused.clone(), reason: "wait".into() };
    cluster.jobs().pause_job(request).await.unwrap();
    given_back(&paused).await;
    let drained = trains("drained").await;
    let worker_id = cluster.workers().await[0].worker_id.clone();
    let request = DrainWorkerRequest { worker_id, reason: "service".into() };
    cluster.admin().drain_worker(request).await.unwrap();
    given_back(&drained).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_answers_renewals_and_pushes_lease_outcomes() {
    let cluster = cluster().await;
    let job = cluster.submit("by hand", 1).await;
    let mut worker = WorkerServiceClient::new(Dial::to(&cluster.url()).lazily().unwrap());
    worker.register(registration("hand")).await.unwrap();
    let incarnation = registration("hand").incarnation;
    let claim = worker_v1::ClaimRequest {
        incarnation: incarnation.clone(),
        request_id: "a claim".into(),
        wait_ms: 10_000,
    };
    let lease = worker.claim(claim).await.unwrap().into_inner().assignment.unwrap().lease;
    let (renewals, receiver) = mpsc::channel(4);
    let mut answers = worker.session(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    let renew = async |incarnation: &str| {
        let renewals_of = vec![worker_v1::Renewal { lease: lease.clone(), ..Default::default() }];
        let renewal = worker_v1::RenewRequest { incarnation: incarnation.into(), renewals: renewals_of };
        renewals.send(worker_v1::SessionRequest { renewal: Some(renewal) }).await.unwrap();
    };
    let mut hear = async || -> Result<Vec<worker_v1::RenewVerdict>, tonic::Status> {
        let heard =
            tokio::time::timeout(Duration::from_secs(20), answers.message()).await.expect("silence")?;
        let outcomes = heard.unwrap().renewed.unwrap().outcomes;
        assert!(outcomes.iter().all(|outcome| outcome.lease == lease));
        Ok(outcomes.iter().map(worker_v1::RenewOutcome::verdict).collect())
    };
    for _ in 0..3 {
        renew(&incarnation).await;
        assert_eq!(hear().await.unwrap(), [worker_v1::RenewVerdict::Continue]);
    }
    let request = v1::PauseJobRequest { job_id: job.clone(), reason: "wait".into() };
    cluster.jobs().pause_job(request).await.unwrap();
    assert_eq!(hear().await.unwrap(), [worker_v1::RenewVerdict::Release]);
    let request = v1::CancelJobRequest { job_id: job, reason: "enough".into() };
    cluster.jobs().cancel_job(request).await.unwrap();
    assert_eq!(hear().await.unwrap(), [worker_v1::RenewVerdict::Abandon]);
    // It ends with the same status as the single call.
    renew("somebody else").await;
    assert_eq!(reason_of(&hear().await.unwrap_err()), "UNKNOWN_WORKER");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_message_without_a_renewal_names_the_field() {
    let cluster = cluster().await;
    let mut worker = WorkerServiceClient::new(Dial::to(&cluster.url()).lazily().unwrap());
    let empty = tokio_stream::iter([worker_v1::SessionRequest { renewal: None }]);
    let mut answers = worker.session(empty).await.unwrap().into_inner();
    let status = answers.message().await.unwrap_err();
    assert_eq!((status.code(), reason_of(&status).as_str()), (tonic::Code::InvalidArgument, "BAD_ARGUMENT"));
    assert!(status.message().contains("renewal"), "{}", status.message());
}
