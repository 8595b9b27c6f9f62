//! User control of jobs, with valid and invalid input. There is no worker, so nothing is trained.

use std::fs::File;
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::processes::{Service, Watchdog, fail, fathom, free_port, json, succeed, tiny_scene, under};
use serde_json::Value;

/// The text in brackets: the job may have been planned in the meantime.
fn stage(said: &str) -> &str {
    said.split_once('(').and_then(|(_, rest)| rest.split_once(')')).map_or("", |(stage, _)| stage)
}

#[test]
fn jobs_are_paused_updated_retried_and_deleted_by_verbs() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let url = format!("http://127.0.0.1:{port}");
    let _coordinator = Service::coordinator(&under(folder.path(), "data"), port);
    let scene = tiny_scene(folder.path());
    let submit = |name: &str, more: &[&str]| {
        let line = ["submit", &scene, "--coordinator", &url, "--name", name, "--iterations=50"];
        succeed(&[&line[..], more].concat()).trim().to_owned()
    };
    let on = |verb: &'static str, job: &str, more: &[&str]| {
        let line = [verb, job, "--coordinator", &url].map(str::to_owned);
        line.into_iter().chain(more.iter().map(|word| (*word).to_owned())).collect::<Vec<String>>()
    };
    let list = |more: &[&str]| {
        let jobs = json(&[&["ls", "--coordinator", &url, "--json"][..], more].concat());
        let names = jobs.as_array().expect("jobs").iter();
        names.map(|job| job["name"].as_str().expect("a name").to_owned()).collect::<Vec<String>>()
    };
    let wreck = submit("wreck", &["--priority", "-3"]);
    let reef = submit("reef", &["--max-parallel", "2"]);
    let shown = json(&on("show", &wreck, &["--json"]));
    assert_eq!((shown["priority"].as_i64(), shown["state"].as_str()), (Some(-3), Some("running")));

    let said = succeed(&on("pause", &wreck, &["--reason", "later"]));
    assert!(said.contains("paused") && said.contains("fathom resume"), "{said}");
    let shown = json(&on("show", &wreck, &["--json"]));
    assert_eq!((shown["state"].as_str(), shown["pause_reason"].as_str()), (Some("paused"), Some("later")));
    let shown = succeed(&on("show", &wreck, &[]));
    assert!(shown.contains("paused because: later"), "{shown}");
    assert_eq!(list(&["--state", "paused"]), ["wreck"]);
    assert_eq!(list(&["--state", "paused", "--state", "running"]), ["reef", "wreck"]);
    assert_eq!(list(&["--name", "ree"]), ["reef"]);
    let said = succeed(&["ls", "--coordinator", &url, "--state", "failed"]);
    assert!(said.contains("no such jobs"), "{said}");

    let said = succeed(&on("update", &wreck, &["--priority", "9"]));
    assert!(said.contains("priority 9") && said.contains("no limit"), "{said}");
    assert_eq!(json(&on("update", &reef, &["--max-parallel=0", "--json"]))["max_parallel"], 0);
    let (code, error) = fail(&on("update", &wreck, &["--priority", "1001"]));
    assert!(code == 2 && error.contains("1001"), "{error}");
    let (_, error) = fail(&on("update", &wreck, &[]));
    assert!(error.contains("nothing to change"), "{error}");
    let said = succeed(&on("resume", &wreck, &[]));
    assert_eq!(said.trim(), format!("job {wreck}: resumed ({})", stage(&said)), "{said}");
    assert!(json(&on("show", &wreck, &["--json"]))["pause_reason"].is_null());
    let said = succeed(&on("update", &reef, &["--max-parallel=1"]));
    assert!(said.contains("at most 1 task at a time"), "{said}");

    let (_, error) = fail(&on("delete", &wreck, &[]));
    assert!(error.contains("cancel it"), "{error}");
    succeed(&on("cancel", &wreck, &[]));
    let (_, error) = fail(&on("retry", &wreck, &[]));
    assert!(error.contains("been cancelled") && error.contains("only failed jobs"), "{error}");
    let (_, error) = fail(&on("pause", &wreck, &[]));
    assert!(error.contains("has ended") && !error.contains("throw"), "{error}");
    succeed(&on("delete", &wreck, &[]));
    for verb in ["show", "delete", "resume"] {
        let (_, error) = fail(&on(verb, &wreck, &[]));
        assert!(error.contains("there is no job"), "{verb}: {error}");
    }
    let said = succeed(&["worker", "list", "--coordinator", &url]);
    assert!(said.contains("no workers at"), "{said}");
    for verb in ["cordon", "drain", "uncordon"] {
        let (_, error) = fail(&["worker", verb, "gpu-7", "--coordinator", &url]);
        assert!(error.contains("no worker gpu-7") && error.contains("fathom worker list"), "{error}");
    }
    let limit = ["tenant", "limit", "wrek", "--open-jobs", "3", "--coordinator", &url];
    let (_, error) = fail(&limit);
    assert!(error.contains("no tenant wrek") && error.contains("--new"), "{error}");
    assert!(succeed(&[&limit[..], &["--new"]].concat()).contains("open jobs 0 of 3"));
    let (_, error) = fail(&on("pause", "nonsense", &[]));
    assert!(error.contains("nonsense"), "{error}");
    assert_eq!(list(&[]), ["reef"]);
}

#[test]
fn watch_reports_missing_workers_and_a_lost_coordinator() {
    let folder = tempfile::tempdir().expect("a folder");
    let (data, port) = (under(folder.path(), "data"), free_port());
    let url = format!("http://127.0.0.1:{port}");
    let mut coordinator = Service::coordinator(&data, port);
    let scene = tiny_scene(folder.path());
    let job = succeed(&["submit", &scene, "--coordinator", &url, "--iterations=50"]).trim().to_owned();
    let watch = |name: &str, more: &[&str]| {
        let into = |end: &str| File::create(under(folder.path(), &format!("{name}.{end}"))).expect("a file");
        let arguments = [&["watch", &job, "--coordinator", &url][..], more].concat();
        let (out, err) = (Stdio::from(into("out")), Stdio::from(into("err")));
        fathom(&arguments).stdout(out).stderr(err).spawn().expect("the binary starts")
    };
    let said = |file: &str| std::fs::read_to_string(folder.path().join(file)).unwrap_or_default();
    let wait_for = |file: &str, words: &str| {
        let begin = Instant::now();
        while !said(file).contains(words) {
            assert!(begin.elapsed() < Duration::from_secs(60), "no {words:?} in {}", said(file));
            std::thread::sleep(Duration::from_millis(100));
        }
    };
    let (mut people, mut programs) = (watch("people", &[]), watch("programs", &["--json"]));
    let _watchdogs = [Watchdog::over(&people), Watchdog::over(&programs)];
    wait_for("people.err", "waiting: no worker is connected");
    wait_for("programs.out", r#""event":"waiting""#);
    coordinator.kill();
    wait_for("people.err", "connection lost, trying again");
    wait_for("programs.out", r#""event":"connection_lost""#);
    let _coordinator = Service::coordinator(&data, port);
    succeed(&["cancel", &job, "--coordinator", &url, "--reason", "enough"]);
    for watch in [&mut people, &mut programs] {
        assert_eq!(watch.wait().expect("its end").code(), Some(1));
    }
    assert_eq!(said("people.err").matches("connection lost").count(), 1, "{}", said("people.err"));
    // Stderr holds only the reason of the failure, and every stdout line is JSON with a time and the job.
    assert_eq!(said("programs.err").trim(), format!("fathom: job {job} was cancelled: enough"));
    for line in said("programs.out").lines() {
        let event: Value = serde_json::from_str(line).expect("JSON");
        assert!(event["time"].is_string() && event["job"] == *job, "{event}");
    }
}
