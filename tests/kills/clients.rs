//! Killed clients, and jobs that users stop at a bad moment.

use std::path::Path;

use crate::files::flip_a_bit;
use crate::harness::Harness;
use crate::process::Process;
use crate::processes::can_train;
use crate::reference::{self, scene};
use crate::slow_link::SlowLink;
use crate::small_disk::wait_for;

/// Bytes after the end of a photograph, ignored by decoders: more than two messages of an upload.
const PADDING: usize = 3 << 20;

/// A copy of the scene in which one photograph is a large file.
fn scene_with_a_large_photograph(at: &Path) {
    let copied = std::process::Command::new("cp").arg("-r").arg(scene()).arg(at).status();
    assert!(copied.expect("cp").success());
    let photograph = at.join("images/v0001.png");
    let mut bytes = std::fs::read(&photograph).expect("a photograph");
    bytes.resize(bytes.len() + PADDING, 7);
    std::fs::write(photograph, bytes).expect("written");
}

#[test]
fn an_upload_of_a_killed_client_is_resumed() {
    let mut harness = Harness::new("an_upload_of_a_killed_client_is_resumed");
    let scene = harness.path("scene");
    scene_with_a_large_photograph(Path::new(&scene));
    let link = SlowLink::to(harness.port);
    link.limit(2 << 20);
    let words_at = |link: &SlowLink| {
        let url = link.url();
        let words = Harness::submission(&scene, &["--request-id=once", "--coordinator", &url]);
        words.iter().map(|word| (*word).to_owned()).collect::<Vec<String>>()
    };
    let words = words_at(&link);
    let logs = harness.path("logs");
    let part_of = |harness: &Harness| harness.partial_uploads().into_iter().max().unwrap_or(0);
    // Killed twice: first before or during the upload of the large photograph, then during it.
    let mut client = Process::start("client", &words, Path::new(&logs));
    harness.random.sleep(50, 400);
    client.kill();
    let before = link.sent();
    let mut client = Process::start("client", &words, Path::new(&logs));
    // All other files have 700 kB.
    wait_for("a part of the photograph", || (link.sent() > before + 2_000_000).then_some(()));
    harness.random.sleep(0, 300);
    client.kill();
    drop(link);
    // A bucket has it a little later.
    let part =
        wait_for("a part of the photograph", || Some(part_of(&harness)).filter(|part| *part >= 1 << 20));
    let arrived = part_of(&harness).max(part);
    // Nothing partial is visible.
    assert!(harness.blobs().iter().all(|blob| blob.metadata().is_ok_and(|blob| blob.len() < PADDING as u64)));
    assert_eq!(harness.ask(&["ls", "--json"]).trim(), "[]", "a job of a partial scene");

    // Bytes that have arrived are not sent again.
    let link = SlowLink::to(harness.port);
    let mut client = Process::start("client", &words_at(&link), Path::new(&logs));
    let job = client.line().expect("a job").trim().to_owned();
    assert!(client.end().success());
    let sent = link.sent();
    let rest = PADDING as u64 + 700_000 - arrived;
    assert!(sent < rest, "{sent} bytes were sent although {arrived} had arrived");
    let job = harness.watch(job);
    job.wait_for("a plan", |event| event["task"] == "plan" && event["state"] == "done");
    assert_eq!(harness.partial_uploads().len(), 0, "a partial upload remains");
    harness.check_what_is_kept();
}

#[test]
fn a_download_leaves_no_half_file_and_no_damaged_one() {
    let scenario = "a_download_leaves_no_half_file_and_no_damaged_one";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    harness.ended(&job, "succeeded");
    let link = SlowLink::to(harness.port);
    link.limit(400_000);
    let (out, url, logs) = (harness.path("out"), link.url(), harness.path("logs"));
    let words = ["download", &job.id, "-o", &out, "--coordinator", &url].map(str::to_owned);
    let (model, half) = (Path::new(&out).join("model.ply"), Path::new(&out).join(".model.ply.part"));
    let mut client = Process::start("client", &words, Path::new(&logs));
    wait_for("the model on its way", || half.exists().then_some(()));
    harness.random.sleep(0, 300);
    client.kill();
    assert!(half.exists() && !model.exists(), "a partial model has the final name");
    link.limit(0);
    harness.ask(&["download", &job.id, "-o", &out]);
    assert!(std::fs::read(&model).expect("a model") == reference::model());
    assert!(!half.exists());

    // The model is damaged on the coordinator's disk and is not served anywhere.
    harness.check_what_is_kept();
    harness.start_coordinator();
    let rotten = |path: &&std::path::PathBuf| std::fs::read(path).is_ok_and(|b| b == reference::model());
    flip_a_bit(harness.blobs().iter().find(rotten).expect("the model"));
    let elsewhere = harness.path("elsewhere");
    let said = harness.refused(&["download", &job.id, "-o", &elsewhere]);
    assert!(said.contains("digest"), "{said}");
    assert!(!Path::new(&elsewhere).join("model.ply").exists());
}

#[test]
fn a_job_cancelled_during_its_merge_stays_cancelled() {
    let scenario = "a_job_cancelled_during_its_merge_stays_cancelled";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    harness.start_worker("second");
    let job = harness.submit();
    let pipes = harness.hold_merge(&job);
    job.wait_until_leased("merge");
    harness.random.sleep(100, 400);
    assert_eq!(harness.task(&job, "merge")["state"], "running", "the merge was not held");
    harness.ask(&["cancel", &job.id, "--reason", "enough"]);
    // The merge continues, and its result is discarded.
    let readers: Vec<_> =
        pipes.iter().map(|pipe| std::fs::OpenOptions::new().read(true).write(true).open(pipe)).collect();
    let history = harness.ended(&job, "cancelled");
    assert_eq!(history.leases("merge").len(), 1);
    let said = harness.refused(&["download", &job.id, "-o", &harness.path("out")]);
    assert!(said.contains("cancelled"), "{said}");
    let next = harness.submit();
    harness.succeeded(&next);
    drop(readers);
    assert_eq!(harness.show(&job.id)["state"], "cancelled");
    harness.check_what_is_kept();
}

#[test]
fn a_job_deleted_while_it_is_trained_frees_its_worker() {
    let scenario = "a_job_deleted_while_it_is_trained_frees_its_worker";
    if !can_train(scenario) {
        return;
    }
    let mut harness = Harness::new(scenario);
    harness.start_worker("first");
    let job = harness.submit();
    job.wait_for_checkpoint("partition-0000");
    harness.ask(&["cancel", &job.id]);
    harness.ask(&["delete", &job.id]);
    harness.forget(&job);
    let next = harness.submit();
    let said = harness.refused(&["show", &job.id]);
    assert!(said.contains("there is no job"), "{said}");
    harness.conclude(&next);
}
