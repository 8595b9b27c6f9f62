//! Rolling upgrades from another version, while a job runs. `scripts/rolling_upgrade.sh COMMIT` builds that
//! version and runs these tests.
//!
//! Models are not compared: another version may train differently.

use std::path::PathBuf;

use crate::harness::Harness;
use crate::job::Job;
use crate::processes::can_train;

/// The program of the other version.
fn other_version() -> PathBuf {
    let program = std::env::var_os("FATHOM_TEST_OLD_PROGRAM");
    program.expect("FATHOM_TEST_OLD_PROGRAM; run scripts/rolling_upgrade.sh").into()
}

/// Two coordinators and a worker of the other version, and a job that has begun to train its partitions.
fn begun(scenario: &'static str) -> Option<(Harness, Job)> {
    if !can_train(scenario) {
        return None;
    }
    let mut harness = Harness::on_database_of(scenario, Some(other_version()))?;
    harness.announce_second();
    harness.start_second();
    harness.start_worker("old");
    // Long enough for all that is restarted meanwhile. Submitted and planned by the other version: only the
    // new one knows all settings of the new one.
    let job = harness.submit_with(&["--set=partition.iterations_per_partition=1200"]);
    job.wait_for_checkpoint("partition-0000");
    harness.program = None;
    Some((harness, job))
}

fn replace_coordinators(harness: &mut Harness) {
    harness.restart_coordinator();
    harness.restart_second();
}

/// A worker that is asked to leave returns its task with a checkpoint.
fn replace_worker(harness: &mut Harness) {
    harness.worker("old").ask_to_leave();
    harness.worker("old").end();
    harness.start_worker("new");
}

fn ends(mut harness: Harness, job: &Job) {
    let history = harness.ended(job, "succeeded");
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
    let workers: Vec<String> =
        history.leases("partition-0001").into_iter().map(|lease| lease.worker).collect();
    assert_eq!(workers.last().map(String::as_str), Some("new"), "{history}");
    harness.download(job);
    harness.check_what_is_kept();
}

#[test]
#[ignore = "needs another version; run `scripts/rolling_upgrade.sh COMMIT`"]
fn coordinators_are_upgraded_first_and_a_job_goes_on() {
    let Some((mut harness, job)) = begun("coordinators_are_upgraded_first_and_a_job_goes_on") else { return };
    replace_coordinators(&mut harness);
    // The old worker goes on with the new coordinators before it is replaced.
    job.wait_after(job.seen().len(), "a checkpoint", |event| event["event"] == "checkpoint");
    replace_worker(&mut harness);
    ends(harness, &job);
}

#[test]
#[ignore = "needs another version; run `scripts/rolling_upgrade.sh COMMIT`"]
fn workers_are_upgraded_first_and_a_job_goes_on() {
    let Some((mut harness, job)) = begun("workers_are_upgraded_first_and_a_job_goes_on") else { return };
    replace_worker(&mut harness);
    job.wait_for("a task of the new worker", |event| event["worker"] == "new" && event["state"] == "running");
    replace_coordinators(&mut harness);
    ends(harness, &job);
}
