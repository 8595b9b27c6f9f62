//! Stages of a job beside training. Partitions agree on one water, and borders are trained after the merge.
//! Losses of workers or coordinators change no byte. An evaluation includes its pictures.

use std::sync::Arc;

use crate::support::{self, FakeTrainer, TestCluster, reason_of};
use bytes::Bytes;
use fathom_coordinator::schedule::Stage;
use fathom_core::config::{JobConfig, WaterPartitions};
use fathom_core::gpu::{GpuOptions, device_for_test};
use fathom_core::water::{Water, WaterRecord};
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use fathom_worker::blobs::{BlobSource, to_proto};
use fathom_worker::execute::CoreExecutor;
use prost::Message;
use serde_json::Value;

/// A small job whose partitions train the water jointly if there are several.
fn joint(columns: u32) -> JobConfig {
    let mut config = JobConfig::default();
    config.data.test_every = 5;
    config.partition.columns = columns;
    config.train.iterations = 400;
    config.water.partitions = WaterPartitions::Joint;
    config
}

async fn submit(cluster: &TestCluster, name: &str, config: &JobConfig) -> String {
    let request = cluster.request_with(&cluster.manifest, name, config).await;
    cluster.jobs().create_job(request).await.unwrap().into_inner().job_id
}

/// The water in a model's header.
fn water_of(model: &[u8], cluster: &TestCluster) -> WaterRecord {
    let path = cluster.dir.path().join("header.ply");
    std::fs::write(&path, model).unwrap();
    fathom_core::ply::water_record(&path).unwrap().expect("a model without a water")
}

#[test]
fn workers_execute_the_stages_that_the_table_gives_them() {
    let of_table: Vec<v1::Stage> = Stage::of_workers().into_iter().map(v1::Stage::from).collect();
    assert_eq!(fathom_worker::execute::STAGES[..], of_table);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn partitions_agree_on_one_water_between_their_two_tasks() {
    let cluster = TestCluster::start().await;
    let _workers = [cluster.worker(FakeTrainer::quick()), cluster.worker(FakeTrainer::quick())];
    let job = cluster.finished(&submit(&cluster, "joint", &joint(2)).await).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let tasks: Vec<&str> = job.tasks.iter().map(|task| task.task_id.as_str()).collect();
    let expected = "plan global first_part-0000 first_part-0001 exchange partition-0000 partition-0001 merge evaluate artifacts";
    assert_eq!(tasks.join(" "), expected);
    let iterations = |task: usize| job.tasks[task].progress.unwrap().iterations;
    for partition in 0..2 {
        let (first, rest) = (iterations(2 + partition), iterations(5 + partition));
        assert_eq!(joint(2).water.free_iterations(first + rest), first, "not two thirds of the run");
    }
    assert_eq!(job.progress, 1.0);

    let files = cluster.artifacts(&job.job_id).await;
    let mut water: Value = serde_json::from_slice(&files["water.json"]).unwrap();
    let partitions = water.as_object_mut().unwrap().remove("partitions").unwrap();
    let record: WaterRecord = serde_json::from_value(water).unwrap();
    assert_eq!(
        record,
        water_of(&files["model.ply"], &cluster),
        "the model has another water than water.json"
    );
    assert_eq!(record.source, "consensus");
    // Two parts of the second, one of the first; parameters without evidence keep the coarse water's value.
    let raw = |water: Water| water.to_raw(1.0)[0];
    let mean = (raw(support::found_water(0)) + 2.0 * raw(support::found_water(1))) / 3.0;
    assert!((raw(record.water()) - mean).abs() < 1e-9, "{:?}", record.water());
    assert_eq!((record.beta_b, record.b_inf), (Water::COASTAL.beta_b, Water::COASTAL.b_inf));
    for index in 0..2 {
        let (gave, found) = (&partitions[index], support::found_water(index as u32));
        assert_eq!(gave["partition"], index);
        assert_eq!(gave["beta_d"], serde_json::json!(found.beta_d));
        let share = gave["weight"]["beta_d"][2].as_f64().unwrap();
        assert!((share - [1.0 / 3.0, 2.0 / 3.0][index]).abs() < 1e-12, "a share of {share}");
        assert_eq!(gave["weight"]["b_inf"], serde_json::json!([0.0, 0.0, 0.0]));
        assert_eq!(gave["far_off"], serde_json::json!([]));
    }
    let metrics: Value = serde_json::from_slice(&files["metrics.json"]).unwrap();
    for (index, partition) in metrics["partitions"].as_array().unwrap().iter().enumerate() {
        assert_eq!(partition["iterations"], iterations(2 + index) + iterations(5 + index));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn losses_in_either_part_of_a_partition_change_no_byte() {
    use v1::Stage::{FirstPart, Partition};
    let mut cluster = TestCluster::start().await;
    let undisturbed = submit(&cluster, "undisturbed", &joint(2)).await;
    let worker = cluster.worker(FakeTrainer::quick());
    assert_eq!(cluster.finished(&undisturbed).await.state(), v1::JobState::Succeeded);
    worker.leave().await;

    let disturbed = submit(&cluster, "disturbed", &joint(2)).await;
    let is_checkpointed = |job: &v1::Job, stage: v1::Stage| {
        job.tasks.iter().any(|task| task.stage() == stage && task.checkpoint_iteration > 0)
    };
    for stage in [FirstPart, Partition] {
        let victim = cluster.worker(FakeTrainer::hangs_in(stage));
        let hangs = cluster.wait_for(&disturbed, |job| is_checkpointed(job, stage)).await;
        assert_eq!(hangs.stage(), stage);
        cluster.restart().await;
        victim.kill();
    }
    let _successor = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&disturbed).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    for stage in [FirstPart, Partition] {
        let lost: Vec<&v1::Task> =
            job.tasks.iter().filter(|task| task.stage() == stage && task.losses > 0).collect();
        assert!(
            matches!(lost[..], [task] if task.resumed_from_iteration > 0),
            "{stage:?} started over: {lost:?}"
        );
        let others = job.tasks.iter().filter(|task| task.stage() == stage && task.losses == 0);
        assert!(others.into_iter().all(|task| task.attempts == 1), "a task was trained twice without need");
    }
    let files = [cluster.artifacts(&undisturbed).await, cluster.artifacts(&disturbed).await];
    for name in ["model.ply", "water.json"] {
        assert!(files[0][name] == files[1][name], "{name} differs");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_partition_exchanges_nothing_and_the_user_is_warned() {
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&submit(&cluster, "alone", &joint(1)).await).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(job.tasks.iter().all(|task| task.stage() != v1::Stage::FirstPart));
    let warned = cluster.events(&job.job_id, 0).await.into_iter().any(|event| {
        matches!(event.event, Some(v1::job_event::Event::Warning(w)) if w.message.contains("water.partitions"))
    });
    assert!(warned, "nothing was said");
    let mut endless = joint(2);
    endless.water.freeze_at = 1.0;
    let request = cluster.request_with(&cluster.manifest, "endless", &endless).await;
    let refused = cluster.jobs().create_job(request).await.unwrap_err();
    assert!(refused.message().contains("water.start_at < water.freeze_at < 1"), "{refused:?}");
}

/// A job with this many columns whose borders are trained.
fn bordered(columns: u32) -> JobConfig {
    let mut config = JobConfig::default();
    config.partition.columns = columns;
    config.data.test_every = 5;
    config.train.iterations = 400;
    config.borders.enabled = true;
    config
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn borders_are_trained_after_the_merge_despite_losses() {
    let mut cluster = TestCluster::start().await;
    let undisturbed = submit(&cluster, "undisturbed", &bordered(2)).await;
    let worker = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&undisturbed).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    let tasks: Vec<&str> = job.tasks.iter().map(|task| task.task_id.as_str()).collect();
    let expected = "plan global partition-0000 partition-0001 merge borders evaluate artifacts";
    assert_eq!((tasks.join(" ").as_str(), job.progress), (expected, 1.0));
    assert_eq!(job.tasks[5].progress.unwrap().iterations, 120, "three tenths of the job's");
    worker.leave().await;

    let disturbed = submit(&cluster, "disturbed", &bordered(2)).await;
    let victim = cluster.worker(FakeTrainer::hangs_in(v1::Stage::Borders));
    let hangs = cluster.wait_for(&disturbed, |job| job.tasks.iter().any(is_checkpointed_in_borders)).await;
    assert_eq!(hangs.stage(), v1::Stage::Borders);
    cluster.restart().await;
    victim.kill();
    let _successor = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&disturbed).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(job.tasks[5].losses == 1 && job.tasks[5].resumed_from_iteration > 0, "{:?}", job.tasks[5]);

    let files = [cluster.artifacts(&undisturbed).await, cluster.artifacts(&disturbed).await];
    assert!(files[0]["model.ply"] == files[1]["model.ply"], "the models differ");
    let plan: Value = serde_json::from_slice(&files[0]["plan.json"]).unwrap();
    assert_eq!(plan["borders"]["segments"].as_array().map(Vec::len), Some(1), "{}", plan["borders"]);
    // The fake gives the band rows that no partition has.
    let model = fathom_core::ply::from_bytes(&files[0]["model.ply"], "model").unwrap();
    let refined = model.opacity_logits.iter().filter(|logit| **logit < 0.0).count();
    assert!(refined > 0 && refined < model.len() && model.len() == support::POINTS, "{refined} refined");
    let metrics: Value = serde_json::from_slice(&files[0]["metrics.json"]).unwrap();
    assert!(metrics["seconds"]["borders"].as_f64().unwrap() > 0.0, "{}", metrics["seconds"]);
    assert_eq!(metrics["gaussians"], support::POINTS);
}

fn is_checkpointed_in_borders(task: &v1::Task) -> bool {
    task.stage() == v1::Stage::Borders && task.checkpoint_iteration > 0
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_partition_has_no_borders_and_the_user_is_warned() {
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(FakeTrainer::quick());
    let job = cluster.finished(&submit(&cluster, "alone", &bordered(1)).await).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(job.tasks.iter().all(|task| task.stage() != v1::Stage::Borders));
    let warned = cluster.events(&job.job_id, 0).await.into_iter().any(|event| {
        matches!(event.event, Some(v1::job_event::Event::Warning(w)) if w.message.contains("borders.enabled"))
    });
    assert!(warned, "nothing was said");
}

/// The real trainer. Photographs are grey, so there is little to learn, but parameters change.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_real_job_has_one_water_joint_or_frozen() {
    if device_for_test("a job with a joint water").is_none() {
        return;
    }
    let executor =
        CoreExecutor::new(GpuOptions { allow_cpu: true, ..GpuOptions::default() }, 1 << 20).unwrap();
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(Arc::new(executor));
    let run = async |partitions: WaterPartitions, neighbours_from: f64| {
        let mut config = joint(2);
        config.train.iterations = 160;
        config.train.max_gaussians = 1000;
        config.water.partitions = partitions;
        config.partition.neighbours_from = neighbours_from;
        // What is trained after the merge keeps the water, too.
        config.borders.enabled = true;
        let name = format!("{partitions:?} {neighbours_from}");
        let job = cluster.finished(&submit(&cluster, &name, &config).await).await;
        // The merge refuses partitions whose headers differ.
        assert_eq!(job.state(), v1::JobState::Succeeded, "{name}: {}", job.error);
        assert!(job.tasks.iter().all(|task| task.attempts == 1 && task.errors == 0), "{:?}", job.tasks);
        let borders = job.tasks.iter().find(|task| task.stage() == v1::Stage::Borders).unwrap();
        assert_eq!(borders.progress.unwrap().iterations, 48, "three tenths of the job's");
        let files = cluster.artifacts(&job.job_id).await;
        let mut water: Value = serde_json::from_slice(&files["water.json"]).unwrap();
        let found = water.as_object_mut().unwrap().remove("partitions");
        let record: WaterRecord = serde_json::from_value(water).unwrap();
        assert_eq!(record, water_of(&files["model.ply"], &cluster));
        let metrics: Value = serde_json::from_slice(&files["metrics.json"]).unwrap();
        let submitted = job.tasks.iter().filter(|task| task.stage() == v1::Stage::Partition);
        let submitted: u32 = submitted.map(|task| task.progress.unwrap().gaussians).sum();
        let of_cells = metrics["partitions"].as_array().unwrap().iter().flat_map(|partition| {
            ["gaussians", "gaussians_duplicate", "gaussians_over_cap"]
                .map(|key| partition[key].as_u64().unwrap())
        });
        let cropped = u64::from(submitted) - of_cells.sum::<u64>();
        (record, found, cropped)
    };
    let (frozen, none, in_margins) = run(WaterPartitions::Frozen, 1.0).await;
    assert_eq!((frozen.source.as_str(), none), ("descended", None));
    // A partition that ends beside its neighbours submits only its own cell; all share the water of the
    // coarse model.
    let (is_second, none, cropped) = run(WaterPartitions::Frozen, 0.7).await;
    assert_eq!((&is_second, none), (&frozen, None));
    assert!(
        in_margins > 50 && 10 * cropped < in_margins,
        "{cropped} Gaussians beyond their cells, {in_margins} where margins are trained"
    );
    let (refined, found, cropped) = run(WaterPartitions::Joint, 0.7).await;
    assert!(10 * cropped < in_margins, "{cropped} of {in_margins}");
    assert_eq!(refined.source, "consensus");
    let found = found.unwrap();
    assert_eq!(found.as_array().map(Vec::len), Some(2));
    for number in ["beta_d", "beta_b", "b_inf"] {
        let of = |partition: usize| found[partition][number][0].as_f64().unwrap();
        let weight = |partition: usize| found[partition]["weight"][number][0].as_f64().unwrap();
        assert_ne!(of(0), of(1), "{number}: each partition trains its own value");
        assert!((weight(0) + weight(1) - 1.0).abs() < 1e-9 && weight(0) > 0.0 && weight(1) > 0.0);
        let agreed = serde_json::json!(refined)[number][0].as_f64().unwrap();
        assert!(agreed > of(0).min(of(1)) && agreed < of(0).max(of(1)), "{number}: {agreed} of {found:#}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_evaluation_with_missing_pictures_is_refused() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("evaluated", 1).await;
    let first = cluster.worker(FakeTrainer::hangs_in(v1::Stage::Evaluate));
    let evaluated =
        |job: &v1::Job| job.tasks.iter().any(|task| task.task_id == "evaluate" && task.attempts == 1);
    cluster.wait_for(&job, evaluated).await;
    first.kill();
    let (mut worker, request) = cluster.worker_by_hand("by hand").await;
    let lease = worker.claim(request).await.unwrap().into_inner().assignment.unwrap().lease;
    assert_eq!(lease.as_ref().unwrap().task_id, "evaluate");

    let picture = Bytes::from_static(b"a picture");
    let digest = blake3::hash(&picture).to_hex().to_string();
    let side_by_side = Some(v1::BlobRef { digest, size_bytes: picture.len() as u64 });
    let view = worker_v1::ViewMetrics { side_by_side, ..Default::default() };
    let evaluation = worker_v1::Evaluation { views: vec![view], ..Default::default() };
    let result = cluster.blobs().upload(&BlobSource::Bytes(evaluation.encode_to_vec().into())).await.unwrap();
    let complete = worker_v1::CompleteRequest {
        lease,
        result: Some(to_proto(&result)),
        stats: None,
        further: Vec::new(),
    };
    let refused = worker.complete(complete.clone()).await.unwrap_err();
    assert_eq!(reason_of(&refused), "BLOB_NOT_FOUND", "{refused:?}");
    cluster.blobs().upload(&BlobSource::Bytes(picture)).await.unwrap();
    worker.complete(complete).await.unwrap();
}
