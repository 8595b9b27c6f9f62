//! The whole life of a job over loopback in one process, with a trainer that needs no GPU.
//!
//! The trainer is deterministic: its result depends on its input and on every iteration. So a resumed run
//! gives the bytes of an undisturbed one only if the checkpoint worked.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::support::{self, FakeTrainer, TestCluster, reason_of};
use fathom_core::config::JobConfig;
use fathom_core::gpu::{GpuOptions, device_for_test};
use fathom_proto::admin::v1::{CordonWorkerRequest, DrainWorkerRequest, UncordonWorkerRequest, WorkerState};
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use fathom_worker::blobs::{BlobSource, to_proto};
use fathom_worker::execute::CoreExecutor;
use serde_json::Value;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_goes_from_photographs_to_artifacts() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("whole", 2).await;
    let _workers = [cluster.worker(FakeTrainer::quick()), cluster.worker(FakeTrainer::quick())];
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert_eq!((job.partitions, job.progress), (2, 1.0));

    let files = cluster.artifacts(&job.job_id).await;
    for name in [
        "model.ply",
        "model.compressed.ply",
        "model.json",
        "cameras.json",
        "plan.json",
        "plan.png",
        "metrics.json",
        "run.json",
    ] {
        assert!(files.contains_key(name), "no {name} among {:?}", files.keys());
    }
    assert_eq!(files.keys().filter(|path| path.starts_with("renders/0")).count(), 4);
    assert_eq!(files.keys().filter(|path| path.starts_with("renders/border_0")).count(), 4);
    let model = fathom_core::ply::from_bytes(&files["model.ply"], "model.ply").unwrap();
    assert_eq!(model.len(), support::POINTS, "every point belongs to exactly one cell");
    let models = job.tasks.iter().filter_map(|task| Some((task.stage(), task.model.clone()?)));
    let models: BTreeMap<_, _> = models.collect();
    assert_eq!(models[&v1::Stage::Merge].size_bytes, files["model.ply"].len() as u64);
    assert!(models.contains_key(&v1::Stage::Partition), "pages show finished partitions: {models:?}");
    for model in models.values() {
        let request = v1::ReadBlobRequest { digest: model.digest.clone(), ..Default::default() };
        assert!(cluster.uploads().read_blob(request).await.is_ok(), "{model:?}");
    }
    check_metrics(&serde_json::from_slice(&files["metrics.json"]).unwrap());

    let events = cluster.events(&job.job_id, 0).await;
    let durable: Vec<u64> = events.iter().filter(|e| support::is_durable(e)).map(|e| e.seq).collect();
    assert_eq!(durable, (1..=job.last_seq).collect::<Vec<_>>());
    let later = cluster.events(&job.job_id, 5).await;
    assert!(later.iter().all(|e| e.seq > 5) && !later.is_empty(), "a resumed watch repeats events");
}

/// Every key that a reader of metrics.json may rely on. The fake evaluation gives view n a PSNR of 20 + n dB.
/// Views 0, 5, 10 and 15 are held out: the first two in the cell of one partition, the others in that of the
/// other.
fn check_metrics(metrics: &Value) {
    let number = |value: &Value, key: &str| {
        value[key].as_f64().unwrap_or_else(|| panic!("{key} is {} in {value:#}", value[key]))
    };
    assert_eq!(number(metrics, "psnr"), 27.5);
    assert!((number(metrics, "ssim") - 0.9).abs() < 1e-12);
    assert_eq!(metrics.get("lpips"), Some(&Value::Null));
    // With two cells, the plan has one border, and a line through the middle of each cell.
    let seams = &metrics["seams"];
    assert_eq!((number(&seams["border"], "pixels"), number(&seams["control"], "pixels")), (1.0, 2.0));
    assert!(number(seams, "band") > 0.0);
    let at_borders =
        ["border_psnr", "interior_psnr", "control_psnr", "seam_db"].map(|key| number(metrics, key));
    assert_eq!(at_borders, [27.0, 30.0, 28.0, 1.0]);
    assert!(metrics["protocol"].as_str().unwrap().contains("seams.band"));
    let views = metrics["views"].as_array().unwrap();
    let names: Vec<&str> = views.iter().map(|view| view["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["view_00.png", "view_05.png", "view_10.png", "view_15.png"]);
    let per_view: Vec<f64> = views.iter().map(|view| number(view, "psnr")).collect();
    assert_eq!(per_view, [20.0, 25.0, 30.0, 35.0]);
    assert!(views.iter().all(|view| number(view, "ssim") == 0.9));
    let borders: Vec<f64> = views.iter().map(|view| number(view, "border_psnr")).collect();
    assert_eq!(borders, [20.0, 21.0, 22.0, 23.0]);
    let cover = ["holes", "unseen"].map(|key| number(metrics, key));
    assert_eq!(cover, [0.15, 0.25]);
    assert_eq!(metrics.get("open_water"), Some(&Value::Null), "there is no medium");
    let holes: Vec<f64> = views.iter().map(|view| number(view, "holes")).collect();
    assert!(holes.iter().zip(0_u8..).all(|(share, view)| (share - 0.1 * f64::from(view)).abs() < 1e-12));
    assert!(metrics["protocol"].as_str().unwrap().contains("unseen: of pixels"));

    let partitions = metrics["partitions"].as_array().unwrap();
    assert_eq!(partitions.len(), 2);
    let mut in_cells: Vec<f64> = partitions.iter().map(|partition| number(partition, "psnr")).collect();
    in_cells.sort_by(f64::total_cmp);
    assert_eq!(in_cells, [22.5, 32.5]);
    for (index, partition) in partitions.iter().enumerate() {
        assert_eq!(partition["id"], index);
        for key in ["cameras", "gaussians", "iterations", "seconds"] {
            assert!(number(partition, key) > 0.0, "{key} of partition {index}");
        }
    }
    let kept: f64 = partitions.iter().map(|partition| number(partition, "gaussians")).sum();
    assert_eq!((kept, number(metrics, "gaussians")), (support::POINTS as f64, support::POINTS as f64));

    let seconds = &metrics["seconds"];
    assert_eq!(number(seconds, "ingest"), 0.25);
    for stage in ["plan", "global", "partition", "merge", "evaluate"] {
        assert!(number(seconds, stage) > 0.0, "{stage} took no time");
    }
    assert_eq!(number(metrics, "iterations"), 400.0);
    assert_eq!(metrics["adapter"], "fake");
    assert_eq!(metrics["colour_space"], "sRGB");
    assert_eq!(metrics["medium"], "none");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_workers_partition_resumes_to_the_same_bytes() {
    let cluster = TestCluster::start().await;
    let undisturbed = cluster.submit("undisturbed", 1).await;
    let worker = cluster.worker(FakeTrainer::quick());
    cluster.finished(&undisturbed).await;
    worker.leave().await;

    let disturbed = cluster.submit("disturbed", 1).await;
    let victim = FakeTrainer::hangs_after_checkpoint();
    let killed = cluster.worker(Arc::clone(&victim));
    cluster.wait_for(&disturbed, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
    killed.kill();
    let _successor = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&disturbed).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let task = job.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert_eq!((task.attempts, task.losses), (2, 1), "the fault did not fire");
    assert!(task.resumed_from_iteration > 0, "it started over");
    assert!(victim.started.load(Ordering::SeqCst), "the victim did nothing");
    let models = [cluster.artifacts(&undisturbed).await, cluster.artifacts(&disturbed).await];
    assert!(models[0]["model.ply"] == models[1]["model.ply"], "the models differ");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_zombies_late_result_is_refused_by_its_fence() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("zombie", 1).await;
    let (mut zombie, request) = cluster.worker_by_hand("zombie").await;
    let first = zombie.claim(request.clone()).await.unwrap().into_inner().assignment.unwrap();
    let again = zombie.claim(request).await.unwrap().into_inner().assignment.unwrap();
    assert_eq!(first, again, "a repeated claim took a second lease");

    // It is silent for longer than the lease; another worker finishes the job.
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.losses == 1)).await;
    let _successor = cluster.worker(FakeTrainer::slow());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.attempts == 2)).await;
    let result = cluster.blobs().upload(&BlobSource::Bytes("from the grave".into())).await.unwrap();
    let late = worker_v1::CompleteRequest {
        lease: first.lease,
        result: Some(to_proto(&result)),
        stats: None,
        further: Vec::new(),
    };
    let refused = zombie.complete(late.clone()).await.unwrap_err();
    assert_eq!(reason_of(&refused), "STALE_FENCE", "{refused:?}");
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert_eq!(reason_of(&zombie.complete(late).await.unwrap_err()), "JOB_ENDED");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_coordinator_continues_and_workers_keep_work() {
    let mut cluster = TestCluster::start().await;
    let job = cluster.submit("restart", 1).await;
    let trainer = FakeTrainer::slow();
    let _worker = cluster.worker(Arc::clone(&trainer));
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
    cluster.restart().await;
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let task = job.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert_eq!((task.attempts, task.losses), (1, 0), "the worker lost its lease");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_paused_job_is_returned_with_its_checkpoint() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("paused", 1).await;
    let slow = cluster.worker(FakeTrainer::slow());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.progress.is_some())).await;
    let pause = v1::PauseJobRequest { job_id: job.clone(), reason: "the machine is wanted".into() };
    let paused = cluster.jobs().pause_job(pause.clone()).await.unwrap().into_inner();
    assert_eq!(paused.state(), v1::JobState::Paused);
    let state =
        |job: &v1::Job| job.tasks.iter().find(|task| task.task_id == "partition-0000").cloned().unwrap();
    let given_back = cluster.wait_for(&job, |job| state(job).state() == v1::TaskState::Ready).await;
    let task = state(&given_back);
    assert!(task.checkpoint_iteration > 0 && (task.errors, task.losses) == (0, 0), "{task:?}");

    let other = cluster.submit("another", 1).await;
    cluster.wait_for(&other, |job| job.tasks.iter().any(|task| task.progress.is_some())).await;
    assert_eq!(cluster.jobs().pause_job(pause).await.unwrap().into_inner().state(), v1::JobState::Paused);
    assert_eq!(state(&cluster.get(&job).await).attempts, 1, "a paused job was given out");
    slow.leave().await;

    let _quick = cluster.worker(FakeTrainer::quick());
    assert_eq!(cluster.finished(&other).await.state(), v1::JobState::Succeeded);
    assert_eq!(state(&cluster.get(&job).await).attempts, 1, "a paused job was given out");
    cluster.jobs().resume_job(v1::ResumeJobRequest { job_id: job.clone() }).await.unwrap();
    let done = cluster.finished(&job).await;
    assert_eq!(done.state(), v1::JobState::Succeeded, "{}", done.error);
    let task = state(&done);
    assert_eq!((task.attempts, task.resumed_from_iteration > 0), (2, true));
    let undisturbed = cluster.submit("undisturbed", 1).await;
    cluster.finished(&undisturbed).await;
    let model = async |job: &str| cluster.artifacts(job).await.remove("model.ply").unwrap();
    assert_eq!(model(&job).await, model(&undisturbed).await, "a pause changed the model");
    let states: Vec<String> = cluster
        .events(&job, 0)
        .await
        .into_iter()
        .filter_map(|event| match event.event {
            Some(v1::job_event::Event::JobState(change)) => Some(change.state().as_str_name().to_owned()),
            _ => None,
        })
        .collect();
    let expected = ["RUNNING", "PAUSED", "RUNNING", "SUCCEEDED"].map(|state| format!("JOB_STATE_{state}"));
    assert_eq!(states, expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn job_requests_are_executed_or_refused_with_a_reason() {
    let cluster = TestCluster::start().await;
    let refused = |status: tonic::Status| (status.code(), reason_of(&status));
    let job = cluster.submit("steered", 2).await;
    let update =
        |priority, max_parallel| v1::UpdateJobRequest { job_id: job.clone(), priority, max_parallel };
    let changed = cluster.jobs().update_job(update(Some(-7), Some(3))).await.unwrap().into_inner();
    assert_eq!((changed.priority, changed.max_parallel), (-7, 3));
    let bad = (tonic::Code::InvalidArgument, "BAD_ARGUMENT".to_owned());
    for request in [update(Some(1001), None), update(None, None)] {
        assert_eq!(refused(cluster.jobs().update_job(request).await.unwrap_err()), bad);
    }
    let delete = v1::DeleteJobRequest { job_id: job.clone() };
    let running = refused(cluster.jobs().delete_job(delete.clone()).await.unwrap_err());
    assert_eq!(running, (tonic::Code::FailedPrecondition, "JOB_NOT_ENDED".to_owned()));
    let retry = v1::RetryJobRequest { job_id: job.clone() };
    assert_eq!(
        cluster.jobs().retry_job(retry.clone()).await.unwrap().into_inner().state(),
        v1::JobState::Running
    );

    let cancel = v1::CancelJobRequest { job_id: job.clone(), reason: String::new() };
    cluster.jobs().cancel_job(cancel).await.unwrap();
    let not_failed = refused(cluster.jobs().retry_job(retry).await.unwrap_err());
    assert_eq!(not_failed, (tonic::Code::FailedPrecondition, "JOB_NOT_FAILED".to_owned()));
    let resume = v1::ResumeJobRequest { job_id: job.clone() };
    let ended = refused(cluster.jobs().resume_job(resume).await.unwrap_err());
    assert_eq!(ended, (tonic::Code::FailedPrecondition, "JOB_ENDED".to_owned()));

    for name in ["first", "second", "third"] {
        cluster.submit(name, 1).await;
    }
    let list = |page_token: &str, name: &str| v1::ListJobsRequest {
        tenant: String::new(),
        page_size: 1,
        page_token: page_token.into(),
        states: vec![v1::JobState::Running.into()],
        name_contains: name.into(),
    };
    let page = cluster.jobs().list_jobs(list("", "ir")).await.unwrap().into_inner();
    let next = cluster.jobs().list_jobs(list(&page.next_page_token, "ir")).await.unwrap().into_inner();
    let names: Vec<&str> = page.jobs.iter().chain(&next.jobs).map(|job| job.name.as_str()).collect();
    assert_eq!(names, ["third", "first"]);
    for (token, name) in [(page.next_page_token.as_str(), "other"), ("nonsense", "ir"), (job.as_str(), "ir")]
    {
        assert_eq!(refused(cluster.jobs().list_jobs(list(token, name)).await.unwrap_err()), bad, "{token}");
    }

    cluster.jobs().delete_job(delete.clone()).await.unwrap();
    let gone = refused(cluster.jobs().delete_job(delete).await.unwrap_err());
    assert_eq!(gone, (tonic::Code::NotFound, "JOB_NOT_FOUND".to_owned()));
    let late = cluster.jobs().create_job(cluster.request("steered", 2).await).await.unwrap_err();
    assert_eq!(reason_of(&late), "REQUEST_ID_REUSED");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_drained_worker_returns_its_task_and_gets_no_other() {
    let mut cluster = TestCluster::start().await;
    let job = cluster.submit("drained", 1).await;
    let _slow = cluster.worker(FakeTrainer::slow());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.progress.is_some())).await;
    let workers = cluster.workers().await;
    let [worker] = workers.as_slice() else { panic!("{workers:?}") };
    assert_eq!((worker.name.as_str(), worker.state(), worker.connected), ("fake", WorkerState::Active, true));
    let held = (worker.held[0].job_id.as_str(), worker.held[0].task_id.as_str());
    assert_eq!(held, (job.as_str(), "partition-0000"));
    let worker_id = worker.worker_id.clone();
    let drain = DrainWorkerRequest { worker_id: worker_id.clone(), reason: "a fan is broken".into() };
    let drained = cluster.admin().drain_worker(drain).await.unwrap().into_inner();
    assert_eq!((drained.state(), drained.reason.as_str()), (WorkerState::Draining, "a fan is broken"));
    let task =
        |job: &v1::Job| job.tasks.iter().find(|task| task.task_id == "partition-0000").cloned().unwrap();
    let given_back = cluster.wait_for(&job, |job| task(job).state() == v1::TaskState::Ready).await;
    let given_back = task(&given_back);
    assert!(given_back.checkpoint_iteration > 0 && (given_back.errors, given_back.losses) == (0, 0));

    // A new coordinator knows the mark; the worker lives and claims, and the job reports why it waits.
    cluster.restart().await;
    let waits = cluster.wait_for(&job, |job| !job.waiting_reason.is_empty()).await;
    assert_eq!(task(&waits).attempts, 1, "a drained worker got a task");
    let known = async || cluster.workers().await.iter().any(|worker| worker.state() == WorkerState::Draining);
    let since = std::time::Instant::now();
    while !known().await {
        assert!(since.elapsed() < Duration::from_secs(30), "it never called again");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(task(&cluster.get(&job).await).attempts, 1);
    let uncordon = UncordonWorkerRequest { worker_id: worker_id.clone() };
    let active = cluster.admin().uncordon_worker(uncordon).await.unwrap().into_inner();
    assert_eq!(active.state(), WorkerState::Active);
    cluster.wait_for(&job, |job| task(job).attempts == 2).await;

    let cordon = |worker_id: &str| CordonWorkerRequest { worker_id: worker_id.into(), reason: String::new() };
    let cordoned = cluster.admin().cordon_worker(cordon(&worker_id)).await.unwrap().into_inner();
    assert_eq!((cordoned.state(), cordoned.held.len()), (WorkerState::Cordoned, 1), "it keeps its task");
    let unknown = cluster.admin().cordon_worker(cordon("nobody")).await.unwrap_err();
    assert_eq!((unknown.code(), reason_of(&unknown).as_str()), (tonic::Code::NotFound, "UNKNOWN_WORKER"));
    let long = CordonWorkerRequest { reason: "x".repeat(1001), ..cordon(&worker_id) };
    assert_eq!(reason_of(&cluster.admin().cordon_worker(long).await.unwrap_err()), "BAD_ARGUMENT");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_silent_worker_is_listed_with_its_mark_after_a_restart() {
    let mut cluster = TestCluster::start().await;
    let worker = cluster.worker(FakeTrainer::quick());
    let since = std::time::Instant::now();
    while cluster.workers().await.is_empty() {
        assert!(since.elapsed() < Duration::from_secs(30), "it never called");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let worker_id = cluster.workers().await[0].worker_id.clone();
    let drain = DrainWorkerRequest { worker_id: worker_id.clone(), reason: "a fan is broken".into() };
    cluster.admin().drain_worker(drain).await.unwrap();
    worker.leave().await;
    cluster.restart().await;

    let workers = cluster.workers().await;
    let [silent] = workers.as_slice() else { panic!("{workers:?}") };
    assert_eq!(
        (&silent.worker_id, silent.state(), silent.connected),
        (&worker_id, WorkerState::Draining, false)
    );
    assert_eq!(silent.reason, "a fan is broken");
    let uncordon = UncordonWorkerRequest { worker_id: worker_id.clone() };
    let back = cluster.admin().uncordon_worker(uncordon.clone()).await.unwrap().into_inner();
    assert_eq!((&back.worker_id, back.state()), (&worker_id, WorkerState::Active));
    assert_eq!(cluster.workers().await, [], "it is still listed");
    cluster.restart().await;
    assert_eq!(cluster.workers().await, [], "the mark came back");
    let again = cluster.admin().uncordon_worker(uncordon).await.unwrap_err();
    assert_eq!(reason_of(&again), "UNKNOWN_WORKER");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failure_is_reported_and_retried_and_the_worker_survives() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("fails once", 1).await;
    let _worker = cluster.worker(FakeTrainer::fails_once());
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let task = job.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert_eq!((task.attempts, task.errors), (2, 1));
    assert!(task.last_errors[0].contains("virtual fault"), "{:?}", task.last_errors);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_task_too_large_for_all_workers_fails_with_both_sizes() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("too large", 1).await;
    let _worker = cluster.worker(FakeTrainer::too_small());
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Failed);
    let task = job.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert_eq!(
        (task.attempts, task.errors, task.losses),
        (3, 3, 0),
        "wrong number of attempts, or wrong class"
    );
    assert!(job.error.contains("needs at least 3.0 GiB, has 2.0 GiB"), "{}", job.error);
    assert!(job.error.contains("use more partitions or lower --max-gaussians"), "{}", job.error);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_takes_no_task_before_it_is_ready() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("waits", 1).await;
    let trainer = FakeTrainer::ready_after(3);
    let _worker = cluster.worker(Arc::clone(&trainer));
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert_eq!(trainer.unready.load(Ordering::SeqCst), 0, "readiness was not checked");
    assert!(job.tasks.iter().all(|task| (task.errors, task.losses) == (0, 0)), "{:?}", job.tasks);
}

/// The real trainer behind a real coordinator, with a limit on the memory of its GPU.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_without_memory_for_one_job_does_the_next() {
    if device_for_test("a worker with little memory").is_none() {
        return;
    }
    let options = GpuOptions { allow_cpu: true, memory_limit: Some(64 << 20), ..GpuOptions::default() };
    let executor = CoreExecutor::new(options, 1 << 20).unwrap();
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(Arc::new(executor));
    let submit = async |name: &str, max_gaussians: u32| {
        let mut config = JobConfig::default();
        config.data.test_every = 5;
        config.train.iterations = 40;
        config.train.max_gaussians = max_gaussians;
        let request = cluster.request_with(&cluster.manifest, name, &config).await;
        cluster.jobs().create_job(request).await.unwrap().into_inner().job_id
    };
    let large = submit("large", 200_000).await;
    let waits = cluster.wait_for(&large, |job| job.waiting_reason.contains("GPU memory")).await;
    for part in ["partition-0000 needs", "may take 0.06 GiB", "a lower --max-gaussians"] {
        assert!(waits.waiting_reason.contains(part), "no {part:?} in {}", waits.waiting_reason);
    }
    let task = waits.tasks.iter().find(|task| task.task_id == "partition-0000").unwrap();
    assert!(task.attempts == 0 && task.memory_bytes > 64 << 20, "{task:?}");
    let small = cluster.finished(&submit("small", 2000).await).await;
    assert_eq!(small.state(), v1::JobState::Succeeded, "{}", small.error);
    assert!(small.tasks.iter().all(|task| task.errors == 0), "{:?}", small.tasks);
    let still = cluster.get(&large).await;
    assert_eq!((still.state(), still.waiting_since), (v1::JobState::Running, waits.waiting_since));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_request_makes_one_job_and_names_a_missing_photograph() {
    let cluster = TestCluster::start().await;
    let request = cluster.request("twice", 1).await;
    let first = cluster.jobs().create_job(request.clone()).await.unwrap().into_inner();
    let again = cluster.jobs().create_job(request.clone()).await.unwrap().into_inner();
    assert_eq!(first.job_id, again.job_id);
    let other = v1::CreateJobRequest { name: "another".into(), ..request.clone() };
    assert_eq!(reason_of(&cluster.jobs().create_job(other).await.unwrap_err()), "REQUEST_ID_REUSED");
    let unknown_key = v1::CreateJobRequest {
        request_id: "new".into(),
        config_json: r#"{"trian":{}}"#.into(),
        ..request.clone()
    };
    let refused = cluster.jobs().create_job(unknown_key).await.unwrap_err();
    assert!(refused.message().contains("trian"), "{refused:?}");

    let mut manifest = cluster.manifest.clone();
    manifest.views[3].image.digest = "0".repeat(64);
    let incomplete = cluster.request_for(&manifest, "incomplete", 1).await;
    let refused = cluster.jobs().create_job(incomplete).await.unwrap_err();
    assert_eq!(reason_of(&refused), "BLOB_NOT_FOUND");
    let said = refused.message();
    assert!(
        said.starts_with("missing blobs of the manifest: 1,") && said.contains(&manifest.views[3].name),
        "{said}"
    );
    let no_manifest = v1::CreateJobRequest {
        request_id: "of a photograph".into(),
        manifest: Some(to_proto(&cluster.manifest.views[0].image)),
        ..request
    };
    let refused = cluster.jobs().create_job(no_manifest).await.unwrap_err();
    assert_eq!(reason_of(&refused), "BAD_ARGUMENT");
    assert!(refused.message().starts_with("manifest: "), "{refused:?}");
    assert_eq!(
        cluster.jobs().list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner().jobs.len(),
        1
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_job_ends_its_watch_and_frees_its_worker() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("cancelled", 1).await;
    let _worker = cluster.worker(FakeTrainer::hangs_after_checkpoint());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
    let request = v1::CancelJobRequest { job_id: job.clone(), reason: "enough".into() };
    cluster.jobs().cancel_job(request).await.unwrap();
    let events = tokio::time::timeout(Duration::from_secs(5), cluster.events(&job, 0)).await.unwrap();
    let last = events.last().unwrap().event.clone().unwrap();
    assert!(matches!(last, v1::job_event::Event::JobState(s) if s.state() == v1::JobState::Cancelled));
    // The trainer hangs only until it is asked to stop; the worker then takes the next job.
    let next = cluster.submit("next", 1).await;
    cluster.wait_for(&next, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abandoned_training_stops_before_the_next_task_starts() {
    let cluster = TestCluster::start().await;
    let trainer = FakeTrainer::hangs_and_looks_rarely();
    let _worker = cluster.worker(Arc::clone(&trainer));
    for (round, name) in ["first", "second", "third"].into_iter().enumerate() {
        let job = cluster.submit(name, 1).await;
        cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
        assert_eq!(trainer.calls.load(Ordering::SeqCst), round as u32 + 1);
        assert_eq!(trainer.running.load(Ordering::SeqCst), 1, "the training of a cancelled job still runs");
        let request = v1::CancelJobRequest { job_id: job, reason: "enough".into() };
        cluster.jobs().cancel_job(request).await.unwrap();
    }
    assert_eq!(trainer.most_at_once.load(Ordering::SeqCst), 1, "two trainings ran at once");
}
