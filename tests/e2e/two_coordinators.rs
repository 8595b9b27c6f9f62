//! Two coordinators on one database and one bucket: what users do at one, the other keeps to.

use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::processes::{Service, can_train, fail, json, output_of, succeed, tiny_scene, under};
use crate::s3::S3Server;

/// Waits until `holds`, at most `within`.
fn soon(what: &str, within: Duration, holds: impl Fn() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < within, "not within {} s: {what}", within.as_secs());
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn two_coordinators_share_tokens_workers_quotas_and_logs() {
    if !can_train("two_coordinators_share_tokens_workers_quotas_and_logs") {
        return;
    }
    let Some(database) = crate::postgres::database() else { return };
    let bucket = S3Server::start();
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| under(folder.path(), name);
    let keys = bucket.environment();
    let keys = keys.each_ref().map(|(name, value)| (*name, value.as_str()));
    let objects = bucket.url("scenes");
    let start = |name: &str| {
        let data = path(name);
        let place = ["--data-dir", &data, "--store", &database, "--objects", &objects];
        let flags = [&["coordinator", "--listen=127.0.0.1:0", "--tokens"], &place[..]].concat();
        let mut service = Service::with_environment(&flags, Stdio::piped(), Stdio::inherit(), &keys);
        let url = service.wait_until_it_listens();
        (service, url)
    };
    let (one, first) = start("one");
    let (_two, second) = start("two");
    assert!(!folder.path().join("two/operator.token").exists(), "there is an operator already");
    std::fs::copy(path("one/operator.token"), path("operator")).expect("copied");
    let with = |words: &[&str], url: &str, token: &str| -> Vec<String> {
        let token = path(token);
        let words = [words, &["--coordinator", url, "--token-file", &token]].concat();
        words.into_iter().map(str::to_owned).collect()
    };
    // Whoever knows the last one knows all: the worker would end if its token were refused.
    for (name, role, tenant) in [("gpu", "worker", ""), ("ana", "submitter", "reef")] {
        let words = ["token", "issue", name, "--role", role, "--tenant", tenant];
        std::fs::write(path(name), succeed(&with(&words, &first, "operator"))).expect("written");
    }
    // It takes about a second where nothing else runs.
    let within = Duration::from_secs(15);
    soon("the second one knows a token", within, || {
        output_of(&with(&["ls"], &second, "ana")).status.success()
    });

    // A worker that calls one is listed at the other, which can drain it.
    let (worker_token, cache) = (path("gpu"), path("cache"));
    let flags = ["--token-file", &worker_token, "--cache-dir", &cache, "--name=reef-1"];
    let _worker = Service::worker_with(&[&["--coordinator", &second], &flags[..]].concat());
    let listed = |url: &str| json(&with(&["worker", "list", "--json"], url, "operator"));
    soon("its worker is known", Duration::from_secs(60), || listed(&first)[0]["state"] == "active");
    succeed(&with(&["worker", "cordon", "reef-1"], &first, "operator"));
    soon("the worker is cordoned", within, || listed(&second)[0]["state"] == "cordoned");

    // A job by one, with files by the other.
    let scene = tiny_scene(folder.path());
    succeed(&with(&["dataset", "upload", &scene, "--id=wreck"], &first, "ana"));
    let words = ["submit", "--dataset=wreck", "--iterations=60", "--max-gaussians=2000", "--json"];
    let job = json(&with(&words, &second, "ana"))["job"].as_str().expect("an id").to_owned();
    succeed(&with(&["worker", "uncordon", "reef-1"], &first, "operator"));
    succeed(&with(&["watch", &job], &first, "ana"));
    // Each coordinator keeps its own lines a moment later.
    soon("both have the same log", within, || {
        let lines = [&first, &second].map(|url| succeed(&with(&["logs", &job, "--json"], url, "ana")));
        lines[0] == lines[1] && lines[0].contains("reef-1")
    });
    let used = [&first, &second].map(|url| json(&with(&["tenant", "list", "--json"], url, "operator")));
    assert_eq!(used[0], used[1]);

    // Quotas and revocations hold at both.
    succeed(&with(&["tenant", "limit", "reef", "--bytes", "1"], &first, "operator"));
    let (_, said) = fail(&with(&words, &second, "ana"));
    assert!(said.contains("of 1 bytes"), "{said}");
    let tokens = json(&with(&["token", "list", "--json"], &second, "operator"));
    let ana = tokens.as_array().expect("tokens").iter().find(|token| token["name"] == "ana");
    let id = ana.expect("a token")["id"].as_str().expect("an id").to_owned();
    succeed(&with(&["token", "revoke", &id], &first, "operator"));
    soon("the second one refuses a revoked token", within, || {
        !output_of(&with(&["ls"], &second, "ana")).status.success()
    });

    // The first one goes, and comes back: nothing is disturbed.
    drop(one);
    let both = format!("{first},{second}");
    assert_eq!(json(&with(&["ls", "--json"], &both, "operator")).as_array().expect("jobs").len(), 1);
    let (_one, again) = start("one");
    soon("the started one knows the worker of the other", within, || listed(&again)[0]["state"] == "active");
}
