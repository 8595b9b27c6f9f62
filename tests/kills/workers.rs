//! Workers that are killed at each step of a task, that leave, or that return as zombies.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::files::files_in;
use crate::harness::{Harness, Rules};
use crate::history::{History, Leased};
use crate::processes::can_train;
use crate::slow_link::SlowLink;
use crate::small_disk::wait_for;

/// As in the jobs of the scenarios (`reference::JOB`).
const CHECKPOINT_EVERY: Duration = Duration::from_secs(1);
/// Allowance for the upload of a checkpoint, its event, and other load on two cores.
const SLACK: Duration = Duration::from_millis(1500);
/// Slow enough that a photograph or a checkpoint takes a second or more, bytes per second.
const SLOW: u64 = 100_000;
/// Longest delay of a kill after a checkpoint, milliseconds. A kill between two tasks is repeated sooner.
const STRIKES_WITHIN: [u64; 5] = [600, 300, 150, 75, 30];

/// The partition that its first worker did not finish, and its leases. A fast machine has finished one and
/// started the other.
fn interrupted(history: &History) -> Option<(&'static str, Vec<Leased>)> {
    let tasks = ["partition-0000", "partition-0001"];
    tasks.map(|task| (task, history.leases(task))).into_iter().find(|(_, leases)| leases.len() > 1)
}

#[test]
fn a_worker_killed_while_it_fetches_is_replaced() {
    let scenario = "a_worker_killed_while_it_fetches_is_replaced";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    let link = SlowLink::to(harness.port);
    let cache = harness.path("cache-of-first");
    harness.start_worker_at("first", &link.url(), Path::new(&cache));
    let job = harness.submit();
    link.limit(SLOW);
    assert_eq!(job.wait_until_leased("global"), "first");
    harness.random.sleep(200, 1500);
    let fetched = files_in(Path::new(&cache)).len();
    assert_eq!(
        harness.task(&job, "global")["iteration"],
        0,
        "{fetched} folders were fetched before it trained"
    );
    harness.kill_worker("first");
    harness.start_worker("second");
    let leases = harness.conclude(&job).leases("global");
    let returned = leases[0].returned.as_deref().unwrap_or_default();
    assert!(returned.starts_with("lease expired") && leases[1].worker == "second", "{leases:?}");
}

#[test]
fn a_killed_worker_costs_only_its_work_since_the_checkpoint() {
    let scenario = "a_killed_worker_costs_only_its_work_since_the_checkpoint";
    if !can_train(scenario) {
        return;
    }
    for within in STRIKES_WITHIN {
        let mut harness = Harness::new(scenario);
        harness.start_worker("first");
        let job = harness.submit();
        job.wait_for_checkpoint("partition-0000");
        harness.random.sleep(0, within);
        harness.kill_worker("first");
        let killed = Instant::now();
        harness.start_worker("second");
        let Some((task, leases)) = interrupted(&harness.conclude(&job)) else { continue };
        // Every history is checked for resuming at the last checkpoint; this test checks that the checkpoint
        // was recent.
        assert_eq!((leases.len(), leases[1].worker.as_str()), (2, "second"), "{leases:?}");
        // A lease that had not reached its worker costs nothing.
        let lost = job.lost_work(task, 1, killed).unwrap_or_default();
        assert!(lost < CHECKPOINT_EVERY + SLACK, "{lost:?} of work were lost");
        return;
    }
    panic!("the fault has not fired");
}

#[test]
fn a_worker_killed_in_a_checkpoint_upload_keeps_the_previous() {
    let scenario = "a_worker_killed_in_a_checkpoint_upload_keeps_the_previous";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    let link = SlowLink::to(harness.port);
    harness.start_worker_at("first", &link.url(), &crate::reference::cache());
    let job = harness.submit();
    let safe = job.wait_for_checkpoint("partition-0000");
    link.limit(SLOW);
    let before = link.sent();
    // A checkpoint has 340 kB; all other messages are much smaller.
    wait_for("a part of a checkpoint", || (link.sent() > before + 100_000).then_some(()));
    harness.kill_worker("first");
    drop(link);
    harness.start_worker("second");
    let leases = harness.conclude(&job).leases("partition-0000");
    assert_eq!((leases[1].resumed_from, leases[1].worker.as_str()), (safe, "second"), "{leases:?}");
}

#[test]
fn a_worker_killed_in_its_result_upload_is_replaced() {
    let scenario = "a_worker_killed_in_its_result_upload_is_replaced";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    let link = SlowLink::to(harness.port);
    harness.start_worker_at("first", &link.url(), &crate::reference::cache());
    // The first checkpoint comes after a tenth of the task, and no other.
    let job = harness.submit_with(&["--set=train.checkpoint_seconds=3600"]);
    let safe = job.wait_for_checkpoint("partition-0000");
    link.limit(SLOW);
    let before = link.sent();
    // The result has 150 kB.
    wait_for("a part of a result", || (link.sent() > before + 60_000).then_some(()));
    harness.kill_worker("first");
    drop(link);
    harness.start_worker("second");
    let leases = harness.conclude(&job).leases("partition-0000");
    assert_eq!((leases[1].resumed_from, leases[1].worker.as_str()), (safe, "second"), "{leases:?}");
}

#[test]
fn a_worker_asked_to_leave_counts_as_no_loss() {
    let scenario = "a_worker_asked_to_leave_counts_as_no_loss";
    if !can_train(scenario) {
        return;
    }
    for within in STRIKES_WITHIN {
        let mut harness = Harness::new(scenario);
        harness.start_worker("first");
        let job = harness.submit();
        job.wait_for_checkpoint("partition-0000");
        harness.random.sleep(0, within);
        let asked = Instant::now();
        harness.worker("first").ask_to_leave();
        let status = harness.worker("first").end();
        assert!(status.success(), "a worker that leaves ends with {status}");
        harness.start_worker("second");
        let history = harness.conclude(&job);
        assert_eq!(history.losses(), 0, "{history}");
        let Some((task, leases)) = interrupted(&history) else { continue };
        let returned = leases[0].returned.as_deref().unwrap_or_default();
        assert!(returned.starts_with("released: the worker was asked to leave"), "{leases:?}");
        // Work between its last checkpoint and its departure is not lost either.
        let done = job.iteration(task, asked);
        assert!(leases[1].resumed_from >= done && leases[1].worker == "second", "{done} of {leases:?}");
        assert_eq!(leases.len(), 2);
        return;
    }
    panic!("no checkpoint was submitted");
}

#[test]
fn a_worker_that_wakes_after_its_lease_changes_nothing() {
    let scenario = "a_worker_that_wakes_after_its_lease_changes_nothing";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    let link = SlowLink::to(harness.port);
    harness.start_worker_at("zombie", &link.url(), &crate::reference::cache());
    let job = harness.submit_with(&["--set=train.checkpoint_seconds=3600"]);
    job.wait_for_checkpoint("partition-0000");
    link.limit(SLOW);
    let before = link.sent();
    // It stops in the middle of submitting its result.
    wait_for("a part of a result", || (link.sent() > before + 60_000).then_some(()));
    harness.worker("zombie").suspend();
    harness.start_worker("successor");
    let (_, taken) = job.wait_after(0, "the successor", |event| {
        event["task"] == "partition-0000" && event["worker"] == "successor" && event["state"] == "running"
    });
    assert_eq!(taken["attempt"], 2, "{taken}");
    link.limit(0);
    harness.random.sleep(0, 1500);
    harness.worker("zombie").go_on();
    let history = harness.succeeded(&job);
    let leases = history.leases("partition-0000");
    assert_eq!((leases.len(), leases[1].worker.as_str()), (2, "successor"), "{leases:?}");
    // The answer to its result or its renewal, whichever came first, reported the loss of the lease.
    wait_for("the zombie to learn that its lease is over", || {
        let said = harness.worker("zombie").said();
        (said.contains("the coordinator asked to abandon the task")
            || said.contains("the result is no longer needed"))
        .then_some(())
    });
    harness.check_what_is_kept();
}

#[test]
fn a_task_that_keeps_killing_workers_fails_its_job() {
    let scenario = "a_task_that_keeps_killing_workers_fails_its_job";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::with(scenario, Rules { max_losses: 3, ..Rules::default() });
    let job = harness.submit();
    let mut seen = 0;
    for name in ["first", "second", "third"] {
        harness.start_worker(name);
        (seen, _) =
            job.wait_after(seen, "a lease", |event| event["worker"] == name && event["state"] == "running");
        harness.random.sleep(0, 300);
        harness.kill_worker(name);
        (seen, _) = job.wait_after(seen, "the end of a lease", |event| {
            event["worker"] == name && event["state"] != "running" && event["event"] == "task"
        });
    }
    let history = harness.ended(&job, "failed");
    assert_eq!(history.leases("global").len(), 3);
    let error = harness.show(&job.id)["error"].as_str().unwrap_or_default().to_owned();
    for part in ["global failed for good after 3 attempts (0 errors, 3 lost workers)", "attempt 3 on third"] {
        assert!(error.contains(part), "{part:?} is not in {error:?}");
    }
    // From here on no worker is lost: the user retries.
    harness.start_worker("fourth");
    harness.ask(&["retry", &job.id]);
    let again = harness.watch(job.id.clone());
    harness.conclude(&again);
}

#[test]
fn a_job_without_workers_waits_with_a_reason_until_one_comes() {
    let scenario = "a_job_without_workers_waits_with_a_reason_until_one_comes";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    harness.start_worker("second");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    for name in ["first", "second"] {
        harness.kill_worker(name);
    }
    let reason = wait_for("a reason", || harness.show(&job.id)["waiting_reason"].as_str().map(str::to_owned));
    assert!(reason.contains("no worker"), "{reason}");
    assert_eq!(harness.show(&job.id)["state"], "running");
    harness.start_worker("third");
    let history = harness.conclude(&job);
    assert!(history.losses() > 0, "the fault has not fired\n{history}");
}

#[test]
fn a_job_survives_the_kill_of_all_processes_at_once() {
    let scenario = "a_job_survives_the_kill_of_all_processes_at_once";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    harness.start_worker("second");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0001");
    harness.random.sleep(0, 500);
    harness.kill_coordinator();
    harness.kill_worker("first");
    harness.kill_worker("second");
    harness.start_coordinator();
    harness.start_worker("third");
    let history = harness.conclude(&job);
    assert!(history.losses() > 0, "the fault has not fired\n{history}");
}
