//! What users do to jobs of a service, with right input and wrong. No worker is there: nothing is trained.

mod common;

use common::{Service, fail, free_port, json, succeed, tiny_scene, under};

#[test]
fn jobs_are_held_changed_tried_again_and_forgotten_by_their_verbs() {
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
    assert_eq!(json(&on("show", &wreck, &["--json"]))["state"], "paused");
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
    assert!(!said.contains("paused"), "{said}");

    let (_, error) = fail(&on("delete", &wreck, &[]));
    assert!(error.contains("cancel it"), "{error}");
    succeed(&on("cancel", &wreck, &[]));
    let (_, error) = fail(&on("retry", &wreck, &[]));
    assert!(error.contains("been cancelled") && error.contains("only failed jobs"), "{error}");
    let (_, error) = fail(&on("pause", &wreck, &[]));
    assert!(error.contains("ended"), "{error}");
    succeed(&on("delete", &wreck, &[]));
    for verb in ["show", "delete", "resume"] {
        let (_, error) = fail(&on(verb, &wreck, &[]));
        assert!(error.contains("there is no job"), "{verb}: {error}");
    }
    let said = succeed(&["workers", "--coordinator", &url]);
    assert!(said.contains("no workers at"), "{said}");
    for verb in ["cordon", "drain", "uncordon"] {
        let (_, error) = fail(&on(verb, "gpu-7", &[]));
        assert!(error.contains("no worker gpu-7") && error.contains("fathom workers"), "{error}");
    }
    let (_, error) = fail(&on("pause", "nonsense", &[]));
    assert!(error.contains("nonsense"), "{error}");
    assert_eq!(list(&[]), ["reef"]);
}
