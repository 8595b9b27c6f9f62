//! Full disks, and flipped bits on the coordinator's disk.

use std::path::{Path, PathBuf};

use crate::files::flip_a_bit;
use crate::harness::{Harness, Rules, has_data_directory};
use crate::process::Process;
use crate::processes::can_train;
use crate::small_disk::{SmallDisk, wait_for};

#[test]
fn a_full_disk_refuses_new_jobs_and_the_running_one_continues() {
    let scenario = "a_full_disk_refuses_new_jobs_and_the_running_one_continues";
    if !can_train(scenario) || !has_data_directory(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    // The required free space exceeds any disk.
    harness.kill_coordinator();
    harness.rules.min_free_bytes = 1 << 60;
    harness.start_coordinator();
    let scene = crate::reference::scene().to_string_lossy().into_owned();
    let said = harness.refused(&Harness::submission(&scene, &[]));
    assert!(said.contains("free on the coordinator's disk"), "{said}");
    let other = harness.path("other");
    crate::processes::succeed(&["synth", &other, "--views", "24", "--size", "32x24", "--seed", "9"]);
    let said = harness.refused(&Harness::submission(&other, &[]));
    assert!(said.contains("free on the coordinator's disk"), "{said}");
    // The worker finishes training and keeps its result until there is room.
    harness.random.sleep(500, 3000);
    assert_eq!(harness.show(&job.id)["state"], "running");
    harness.kill_coordinator();
    harness.rules.min_free_bytes = 0;
    harness.start_coordinator();
    harness.conclude(&job);
}

#[test]
fn a_disk_full_to_the_last_byte_loses_nothing() {
    let scenario = "a_disk_full_to_the_last_byte_loses_nothing";
    if !can_train(scenario) || !has_data_directory(scenario) {
        return;
    }
    let mut harness = Harness::stopped(scenario, Rules::default());
    let Some(disk) = SmallDisk::mounted(&harness.data, 32 << 20) else {
        eprintln!("{scenario}: skipped, since nothing can be mounted here");
        return;
    };
    harness.start_coordinator();
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    let ballast = disk.fill();
    // It exits with a reason rather than acknowledge unsaved changes. Acknowledged changes must survive.
    let (url, logs) = (harness.url(), harness.path("logs"));
    let (mut priority, mut acknowledged) = (0, 0);
    let ended = wait_for("the end of the coordinator", || {
        priority += 1;
        let words = ["update", &job.id, "--priority", &priority.to_string(), "--coordinator", &url];
        let mut client = Process::start("client", &words.map(str::to_owned), Path::new(&logs));
        // The client waits for a lost coordinator; the test does not wait for the client.
        let (answered, ended) = wait_for("an answer, or the end of the coordinator", || {
            let (answered, ended) = (client.ended(), harness.coordinator().ended());
            (answered.is_some() || ended.is_some()).then_some((answered, ended))
        });
        if answered.is_some_and(|status| status.success()) {
            acknowledged = priority;
        }
        ended
    });
    assert!(!ended.success());
    let said = harness.coordinator().said();
    assert!(said.contains("free space or repair the disk and start the coordinator again"), "{said}");
    assert!(!harness.try_coordinator(), "a coordinator serves from a disk without a byte of room");
    std::fs::remove_file(&ballast).expect("room");
    harness.start_coordinator();
    let stored = harness.show(&job.id)["priority"].as_u64();
    assert!(stored >= Some(acknowledged), "priority {acknowledged} was acknowledged, it is {stored:?}");
    harness.conclude(&job);
}

#[test]
fn a_damaged_photograph_fails_its_job_and_is_uploaded_again() {
    let scenario = "a_damaged_photograph_fails_its_job_and_is_uploaded_again";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::with(scenario, Rules { max_losses: 2, ..Rules::default() });
    let job = harness.submit();
    job.wait_for("a plan", |event| event["task"] == "plan" && event["state"] == "done");
    for name in ["v0007.png", "v0012.png"] {
        let photograph =
            std::fs::read(crate::reference::scene().join("images").join(name)).expect("a photograph");
        let damaged =
            harness.blobs().into_iter().find(|blob| std::fs::read(blob).is_ok_and(|b| b == photograph));
        flip_a_bit(&damaged.expect("the photograph"));
    }
    let (url, cache) = (harness.url(), harness.path("cache"));
    harness.start_worker_at("first", &url, Path::new(&cache));
    harness.ended(&job, "failed");
    let error = harness.show(&job.id)["error"].as_str().unwrap_or_default().to_owned();
    assert!(
        error.contains("lost or changed files of the scene: v0007.png, v0012.png; check the disk"),
        "{error}"
    );

    // The next submission uploads the photograph again, and the failed job can be retried too.
    let next = harness.submit();
    harness.succeeded(&next);
    harness.ask(&["retry", &job.id]);
    let again = harness.watch(job.id.clone());
    harness.conclude(&again);
}

#[test]
fn a_damaged_checkpoint_is_discarded_and_its_task_restarts() {
    let scenario = "a_damaged_checkpoint_is_discarded_and_its_task_restarts";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit_with(&["--set=train.checkpoint_seconds=3600"]);
    job.wait_for_checkpoint("partition-0000");
    harness.kill_worker("first");
    // The newest one; the worker may have sent a result since.
    let is_checkpoint =
        |blob: &PathBuf| std::fs::read(blob).is_ok_and(|bytes| bytes.starts_with(b"fathomck"));
    let written = |blob: &PathBuf| blob.metadata().and_then(|meta| meta.modified()).ok();
    flip_a_bit(&harness.blobs().into_iter().filter(is_checkpoint).max_by_key(written).expect("a checkpoint"));
    harness.start_worker("second");
    let history = harness.conclude(&job);
    let leases = history.leases("partition-0000");
    assert_eq!(leases.len(), 2, "the damaged checkpoint cost more than itself: {leases:?}");
}

#[test]
fn a_damaged_result_is_retrained_before_the_merge() {
    let scenario = "a_damaged_result_is_retrained_before_the_merge";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for("a result", |event| event["task"] == "partition-0000" && event["state"] == "done");
    let is_model = |blob: &PathBuf| std::fs::read(blob).is_ok_and(|bytes| bytes.starts_with(b"ply\n"));
    let written = |blob: &PathBuf| blob.metadata().and_then(|meta| meta.modified()).ok();
    let result = harness.blobs().into_iter().filter(is_model).max_by_key(written).expect("a result");
    flip_a_bit(&result);
    harness.conclude(&job);
}
