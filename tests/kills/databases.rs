//! Killed databases, buckets that fail, and coordinators whose jobs and files are in them.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::cut::Cut;
use crate::harness::Harness;
use crate::processes::{can_train, output_of};
use crate::reference;
use crate::s3::Fault;
use crate::small_disk::wait_for;

#[test]
fn a_database_killed_twice_in_a_job_costs_no_task() {
    let scenario = "a_database_killed_twice_in_a_job_costs_no_task";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    let lease = Duration::from_millis(harness.rules.lease_ms);
    // Longer than a lease: nobody could renew meanwhile, and that is no silence.
    harness.kill_database(lease * 2);
    job.wait_until_leased("partition-0001");
    harness.kill_database(lease / 4);
    let history = harness.succeeded(&job);
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
    let log = harness.log_of("coordinator");
    for said in ["the database is not available; calls are refused", "the database is available again"] {
        assert!(log.contains(said), "{said}: {log}");
    }
    harness.check_what_is_kept();
}

#[test]
fn a_bucket_that_fails_costs_no_task() {
    let scenario = "a_bucket_that_fails_costs_no_task";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_until_well_begun("partition-0000");
    let lease = Duration::from_millis(harness.rules.lease_ms);
    // For as long as a coordinator tries a request, and longer.
    harness.bucket().break_every(1, Some(Fault::Status(503)));
    std::thread::sleep(lease * 4);
    // To the end of the job, and while its model is fetched, every third request fails.
    harness.bucket().break_every(3, Some(Fault::Status(500)));
    job.wait_until_leased("partition-0001");
    harness.bucket().break_every(3, Some(Fault::Truncated));
    let history = harness.succeeded(&job);
    harness.bucket().break_every(3, None);
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
    let (requests, faults) = harness.bucket().requests();
    println!("{faults} of {requests} requests to the bucket failed");
    harness.check_what_is_kept();
}

#[test]
fn one_of_two_coordinators_is_killed_for_good() {
    let scenario = "one_of_two_coordinators_is_killed_for_good";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    harness.announce_second();
    harness.start_second();
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_until_well_begun("partition-0000");
    harness.kill_coordinator();
    let history = harness.succeeded(&job);
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
    let lines = harness.ask(&["logs", &job.id]);
    for task in ["plan", "partition-0000", "partition-0001", "merge"] {
        assert!(lines.contains(task), "the log lacks the lines of {task}: {lines}");
    }
    harness.check_what_is_kept();
}

#[test]
fn a_coordinator_cut_off_from_its_database_sends_workers_on() {
    let scenario = "a_coordinator_cut_off_from_its_database_sends_workers_on";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    let (server, url) = harness.database();
    let (network, url) = (Cut::to(server.folder()), url.clone());
    harness.announce_second();
    harness.start_second_at(Some(network.url(&url)));
    let second = harness.second_url();
    let addresses = format!("{second},{}", harness.url().split(',').next().expect("the first"));
    harness.start_worker_at("far", &addresses, &reference::cache());
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    let before = harness.log_of("second-coordinator").len();
    network.set(true);
    harness.succeeded(&job);
    // The job may end before the coordinator has waited long enough for its database.
    wait_for("the coordinator to send its clients on", || {
        let log = harness.log_of("second-coordinator");
        log[before..].contains("clients are sent to other coordinators").then_some(())
    });

    network.set(false);
    let deadline = Instant::now() + Duration::from_secs(60);
    while !output_of(&["ls", "--coordinator", &second]).status.success() {
        assert!(Instant::now() < deadline, "it admits nobody:\n{}", harness.log_of("second-coordinator"));
        std::thread::sleep(Duration::from_millis(200));
    }
    harness.check_what_is_kept();
}

#[test]
fn a_lone_coordinator_waits_for_the_way_to_its_database() {
    let scenario = "a_lone_coordinator_waits_for_the_way_to_its_database";
    if !can_train(scenario) {
        return;
    }
    let Some((mut harness, network)) = Harness::behind_a_network(scenario) else { return };
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    network.set(true);
    // Longer than a lease: nobody could renew meanwhile, and that is no silence.
    std::thread::sleep(Duration::from_millis(harness.rules.lease_ms * 2));
    let log = harness.log_of("coordinator");
    assert!(log.contains("the database is not available; calls are refused"), "{log}");
    network.set(false);
    let history = harness.succeeded(&job);
    assert_eq!(history.losses(), 0, "a live worker was counted as lost\n{history}");
    harness.check_what_is_kept();
}

#[test]
fn a_coordinator_dies_in_a_merge_and_another_merges() {
    let scenario = "a_coordinator_dies_in_a_merge_and_another_merges";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    harness.announce_second();
    harness.start_worker("first");
    let job = harness.submit();
    harness.hold_merge(&job);
    job.wait_until_leased("merge");
    // Its start takes no lease from the first one, which holds the merge.
    harness.start_second();
    std::thread::sleep(Duration::from_millis(harness.rules.lease_ms * 2));
    let merge = harness.task(&job, "merge");
    assert_eq!((&merge["state"], &merge["attempts"]), (&"running".into(), &1.into()), "{merge:#}");
    harness.kill_coordinator();
    let history = harness.succeeded(&job);
    assert_eq!((history.losses(), history.leases("merge").len()), (0, 2), "{history}");
    harness.check_what_is_kept();
}

#[test]
fn a_coordinator_serves_only_the_jobs_of_its_files() {
    let scenario = "a_coordinator_serves_only_the_jobs_of_its_files";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    let job = harness.submit();
    // A second coordinator on the same jobs would not know of this one.
    let said = harness.refused_coordinator();
    assert!(said.contains("in use by another coordinator"), "{said}");
    // The coordinator would delete the files of jobs that it does not see.
    harness.kill_coordinator();
    let said = harness.refused_without_store();
    assert!(said.contains("pass its --store"), "{said}");
    harness.start_coordinator();
    harness.start_worker("first");
    harness.conclude(&job);
}

#[test]
fn a_dump_and_a_later_copy_of_the_bucket_are_one_backup() {
    let scenario = "a_dump_and_a_later_copy_of_the_bucket_are_one_backup";
    if !can_train(scenario) {
        return;
    }
    let Some(mut harness) = Harness::on_database(scenario) else { return };
    let (dump, copy) = (harness.path("dump.sql"), harness.path("bucket"));
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    let (server, url) = harness.database();
    server.dump(url, Path::new(&dump));
    // The job goes on: checkpoints are replaced, and files come that the dump does not know.
    harness.succeeded(&job);
    harness.copy_bucket(Path::new(&copy));

    let restored = Harness::restored(scenario, Path::new(&dump), Path::new(&copy));
    let mut restored = restored.expect("there was a database");
    let again = restored.watch(job.id.clone());
    restored.start_worker("second");
    let history = restored.conclude(&again);
    let leases = history.leases("partition-0000");
    assert_eq!((leases.len(), leases[0].worker.as_str()), (2, "first"), "{history}");
    assert!(leases[1].resumed_from > 0, "the checkpoint of the dump was not used\n{history}");
    harness.check_what_is_kept();
}
