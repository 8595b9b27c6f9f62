//! Killed and stalled coordinators.

use std::time::Duration;

use crate::harness::Harness;
use crate::processes::can_train;
use crate::reference::scene;
use crate::small_disk::wait_for;

#[test]
fn a_coordinator_killed_during_planning_plans_again() {
    let scenario = "a_coordinator_killed_during_planning_plans_again";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    let scene = scene().to_string_lossy().into_owned();
    // Planning takes some tens of milliseconds, so repeated kills hit it eventually.
    let mut hit = None;
    for round in 0..40 {
        let id = format!("--request-id=round-{round}");
        let words = Harness::submission(&scene, &[&id]);
        let job = harness.ask(&words).trim().to_owned();
        harness.random.sleep(0, 25);
        harness.kill_coordinator();
        harness.start_coordinator();
        assert_eq!(harness.ask(&words).trim(), job, "a repeated request made another job");
        let attempts = harness.show(&job)["tasks"][0]["attempts"].as_u64();
        let job = harness.watch(job);
        job.wait_for("a plan", |event| event["task"] == "plan" && event["state"] == "done");
        if harness.task(&job, "plan")["attempts"].as_u64() > Some(1) || attempts > Some(1) {
            hit = Some(job);
            break;
        }
        harness.ask(&["cancel", &job.id]);
        harness.ended(&job, "cancelled");
    }
    let job = hit.expect("no coordinator was killed while it planned");
    harness.start_worker("first");
    let history = harness.conclude(&job);
    let plans = history.leases("plan");
    assert!(plans[0].returned.is_some() && plans[1].returned.is_none(), "{plans:?}");
}

#[test]
fn a_coordinator_killed_during_a_merge_merges_again() {
    let scenario = "a_coordinator_killed_during_a_merge_merges_again";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    let pipes = harness.hold_merge(&job);
    job.wait_until_leased("merge");
    harness.random.sleep(100, 400);
    assert_eq!(harness.task(&job, "merge")["state"], "running", "the merge was not held");
    harness.kill_coordinator();
    harness.start_coordinator();
    assert!(!pipes.iter().any(|pipe| std::path::Path::new(pipe).exists()), "a partial file remains");
    let merges = harness.conclude(&job).leases("merge");
    assert!(merges.len() == 2 && merges[0].returned.is_some(), "{merges:?}");
}

#[test]
fn a_coordinator_killed_at_the_end_of_a_stage_continues() {
    let scenario = "a_coordinator_killed_at_the_end_of_a_stage_continues";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    harness.start_worker("second");
    let job = harness.submit();
    for (last, stage) in [("global", "partition"), ("merge", "evaluate"), ("evaluate", "artifacts")] {
        // Read from the store, because a watcher's round may take longer than a stage.
        wait_for(&format!("the end of {last}"), || {
            let shown = harness.show(&job.id);
            let tasks = shown["tasks"].as_array().expect("tasks");
            tasks.iter().any(|task| task["task"] == last && task["state"] == "done").then_some(())
        });
        harness.random.sleep(0, 15);
        harness.kill_coordinator();
        harness.start_coordinator();
        let now = harness.show(&job.id)["stage"].as_str().unwrap_or_default().to_owned();
        assert!(now == stage || last != "global", "after {last} comes {stage}, not {now}");
    }
    let history = harness.conclude(&job);
    assert_eq!(history.losses(), 0, "live workers were counted as lost\n{history}");
}

#[test]
fn a_storm_of_restarts_changes_no_byte_and_forgets_nothing() {
    let scenario = "a_storm_of_restarts_changes_no_byte_and_forgets_nothing";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    let mut restarts = 0;
    while !job.is_over() && restarts < 12 {
        harness.random.sleep(50, 700);
        harness.kill_coordinator();
        harness.start_coordinator();
        restarts += 1;
        // A repeated request gets the same answer after every restart.
        assert_eq!(harness.show(&job.id)["job"], job.id.as_str());
    }
    assert!(restarts >= 5, "the job ended after {restarts} restarts");
    harness.conclude(&job);
}

#[test]
fn a_stalled_coordinator_takes_no_task_from_live_workers() {
    let scenario = "a_stalled_coordinator_takes_no_task_from_live_workers";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    harness.coordinator().suspend();
    std::thread::sleep(Duration::from_millis(3 * harness.rules.lease_ms));
    harness.coordinator().go_on();
    let history = harness.conclude(&job);
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
}
