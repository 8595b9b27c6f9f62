#![cfg(unix)]
//! The store under SIGKILL, with real processes.
//!
//! A child (this binary, executed again) changes the store from several threads and prints a line for every
//! acknowledged change. It is killed at a random moment; then the parent opens the store and checks
//! everything that was ever acknowledged. Finally all jobs must still finish: a task lost from an index, or a
//! lease that is never revoked, would stop one.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::Duration;

use fathom_coordinator::schedule::{Artifact, JobState, Stage};
use fathom_coordinator::store::{JobFilter, JobStore, SledStore};
use fathom_core::rng::{Stream, random_bits};

mod workload;

use workload::{Acknowledged, LEASE_MS, ROUND_MS, T0, block_on, claim, open, output, write};

/// Threads of the child that change the store concurrently.
const WRITERS: u32 = 4;
/// Lifetime of a child that is not killed.
const CHILD_LIVES: Duration = Duration::from_secs(60);
/// Latest kill after the first acknowledgement of a child.
const LATEST_KILL_MS: u32 = 250;

const DIR: &str = "FATHOM_TEST_KILLED_STORE";
const ROUND: &str = "FATHOM_TEST_KILLED_STORE_ROUND";

#[test]
fn acknowledged_changes_survive_sigkill() {
    kill_again_and_again(6);
}

#[test]
#[ignore = "takes minutes"]
fn acknowledged_changes_survive_hundreds_of_sigkills() {
    kill_again_and_again(300);
}

/// The child process. Without the parent it does nothing.
#[test]
#[ignore = "started by the other tests, as the process that they kill"]
fn child() {
    let (Ok(dir), Ok(round)) = (std::env::var(DIR), std::env::var(ROUND)) else { return };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    // Ends the line in which the harness may have started to print this test's name.
    println!();
    runtime.block_on(change_until_killed(Path::new(&dir), round.parse().unwrap()));
}

fn kill_again_and_again(rounds: u32) {
    let dir = tempfile::tempdir().unwrap();
    let mut known = Acknowledged::default();
    let mut round = 0;
    // A slow disk acknowledges little in a round.
    while round < rounds || (known.completed.len() < 10 && round < 10 * rounds) {
        let lines = run_and_kill(dir.path(), round);
        let acknowledged_before = known.count;
        let fence_before = known.last_fence();
        for line in &lines {
            known.add(line, fence_before);
        }
        assert!(known.count > acknowledged_before, "round {round}: nothing was acknowledged");
        block_on(async { known.check(&open(dir.path()), round).await });
        round += 1;
    }
    assert!(known.completed.len() >= 10, "only {} results were acknowledged", known.completed.len());
    block_on(finish_all_jobs(&open(dir.path()), &known, u64::from(round)));
}

/// Runs a child and kills it a random time after its first acknowledgement; returns its acknowledged changes.
fn run_and_kill(dir: &Path, round: u32) -> Vec<String> {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child", "--ignored", "--nocapture"])
        .env(DIR, dir)
        .env(ROUND, round.to_string())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let stdout = child.stdout.take().unwrap();
    let (started, first) = channel();
    let reader = std::thread::spawn(move || {
        let mut lines = Vec::new();
        for line in BufReader::new(stdout).lines() {
            if let Some(line) = line.unwrap().strip_prefix("ack ") {
                // The parent may no longer wait; the line counts nevertheless.
                let _ = started.send(());
                lines.push(line.to_owned());
            }
        }
        lines
    });
    let is_alive = first.recv_timeout(CHILD_LIVES).is_ok();
    let pause_ms = random_bits(round, Stream::Test, 0, 0)[0] % LATEST_KILL_MS;
    std::thread::sleep(Duration::from_millis(pause_ms.into()));
    child.kill().unwrap();
    let status = child.wait().unwrap();
    assert!(is_alive, "round {round}: the child acknowledged nothing");
    assert_eq!(status.signal(), Some(9), "round {round}: the child ended by itself: {status}");
    reader.join().unwrap()
}

/// The work of a child: it continues its predecessor's jobs, creates new ones and works on all.
async fn change_until_killed(dir: &Path, round: u64) {
    let store = Arc::new(open(dir));
    let now_ms = T0 + round * ROUND_MS;
    store.recover(now_ms).await.unwrap();
    store.sweep(now_ms + LEASE_MS).await.unwrap();
    let writers = (0..WRITERS).map(|writer| {
        let said = |line: String| println!("ack {line}");
        tokio::spawn(write(Arc::clone(&store), round, writer, u32::MAX, said))
    });
    let all = futures::future::join_all(writers);
    // Only an error ends a writer.
    if let Ok(ended) = tokio::time::timeout(CHILD_LIVES, all).await {
        panic!("{ended:?}");
    }
}

/// Revokes the leases of killed processes and does all remaining work.
async fn finish_all_jobs(store: &SledStore, known: &Acknowledged, round: u64) {
    let now_ms = T0 + round * ROUND_MS;
    store.recover(now_ms).await.unwrap();
    let now_ms = now_ms + LEASE_MS;
    store.sweep(now_ms).await.unwrap();
    let mut last_fence = known.last_fence();
    for turn in 0.. {
        let Some(grant) = store.claim(&claim(format!("last-{turn}")), now_ms).await.unwrap() else { break };
        let fence = grant.lease.fence;
        assert!(fence > last_fence, "fence {fence} after {last_fence}");
        last_fence = fence;
        store.complete(&grant.lease, output(grant.lease.task, fence), now_ms).await.unwrap();
    }
    for job in store.list(&JobFilter::default(), None, 100_000).await.unwrap() {
        assert_eq!(job.state, JobState::Succeeded, "{} stands at {:?}", job.job_id, job.stage);
    }
    known.check(store, u32::MAX).await;
    let jobs = store.list(&JobFilter::default(), None, 100_000).await.unwrap();
    let exchanged = jobs.iter().filter(|job| job.output(Artifact::Exchange).is_some()).count();
    let bordered = jobs.iter().filter(|job| job.shape.stages.contains(&Stage::Borders)).count();
    assert!(bordered > 0 && bordered < jobs.len(), "{bordered} of {} jobs trained their borders", jobs.len());
    assert!(exchanged > 0 && exchanged < jobs.len(), "{exchanged} of {} jobs had an exchange", jobs.len());
}
