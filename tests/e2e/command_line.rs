//! Each verb with wrong input: a non-zero exit code, and a message with the fault, its place and a remedy.

use std::path::Path;

use serde_json::Value;

use crate::processes::{fail, fathom, json, output_of, succeed, under};

/// Nothing listens there: the port of a closed listener.
fn nowhere() -> String {
    format!("http://127.0.0.1:{}", crate::processes::free_port())
}

#[track_caller]
fn assert_says(said: &str, words: &[&str]) {
    for word in words {
        assert!(said.contains(word), "expected {word:?} in: {said}");
    }
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn verbs_of_the_service_say_where_they_looked_for_a_coordinator() {
    let url = nowhere();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = under(folder.path(), "out");
    let scene = crate::processes::tiny_scene(folder.path());
    for arguments in [
        vec!["ls"],
        vec!["show", "job"],
        vec!["watch", "job"],
        vec!["logs", "job"],
        vec!["cancel", "job"],
        vec!["download", "job", "-o", &out],
        vec!["submit", &scene],
    ] {
        let (code, said) = fail(&[&arguments[..], &["--coordinator", &url]].concat());
        assert_eq!(code, 1, "{arguments:?}");
        assert_says(&said, &[&url, "cannot reach the coordinator", "--coordinator"]);
    }
    let (_, said) = fail(&["ls", "--coordinator", "not a url"]);
    assert_says(&said, &["not a url"]);
}

#[test]
fn a_missing_scene_is_named() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (missing, out) = (under(folder.path(), "missing"), under(folder.path(), "out"));
    for arguments in
        [vec!["inspect", &missing, "--no-plan"], vec!["train", &missing, "-o", &out, "--allow-cpu"]]
    {
        if arguments[0] == "train" && !crate::processes::can_train("a_missing_scene_is_named (train)") {
            continue;
        }
        let (code, said) = fail(&arguments);
        assert_eq!(code, 1);
        assert_says(&said, &[&missing]);
    }
    let empty = folder.path().to_string_lossy().into_owned();
    let (_, said) = fail(&["inspect", &empty, "--no-plan"]);
    assert_says(&said, &["sparse", "transforms.json"]);
}

#[test]
fn unknown_settings_are_refused_before_anything_starts() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = under(folder.path(), "out");
    let (code, said) = fail(&["train", "anywhere", "-o", &out, "--set", "train.iteratoins=5"]);
    assert_eq!(code, 2);
    assert_says(&said, &["iteratoins", "iterations"]);
    let (code, said) = fail(&["train", "anywhere", "-o", &out, "--partitions", "2by2"]);
    assert_eq!(code, 2);
    assert_says(&said, &["2by2", "2x3"]);
    let (_, said) = fail(&["train", "anywhere", "-o", &out, "--preset", "water"]);
    assert_says(&said, &["water", "3dgs"]);
    assert!(!folder.path().join("out").exists(), "a refused run leaves nothing behind");
}

#[test]
fn a_folder_without_an_interrupted_run_cannot_be_resumed() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = under(folder.path(), "out");
    let (_, said) = fail(&["train", "anywhere", "-o", &out, "--resume"]);
    assert_says(&said, &[&out, "holds no interrupted run"]);
}

#[test]
fn a_missing_or_invalid_model_is_named() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().to_string_lossy().into_owned();
    let broken = under(folder.path(), "broken.ply");
    std::fs::write(&broken, "ply\nformat ascii 1.0\n").expect("a file");
    let (_, said) = fail(&["eval", &path]);
    assert_says(&said, &[&path, "metrics.json", "--data"]);
    for verb in [vec!["render", &path, "--cameras", &path], vec!["eval", &path, "--truth", &path]] {
        let (code, _) = fail(&verb);
        assert_eq!(code, 1, "{verb:?}");
    }
    let (_, said) = fail(&["render", &path, "--cameras", &path]);
    assert_says(&said, &["model.ply"]);
    let (_, said) = fail(&["render", &broken, "--cameras", &path]);
    assert_says(&said, &["broken.ply"]);
}

#[test]
fn services_name_files_that_they_cannot_use() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = under(folder.path(), "file");
    std::fs::write(&file, "not a folder").expect("a file");
    let (code, said) = fail(&["coordinator", "--data-dir", &file, "--listen", "127.0.0.1:0"]);
    assert_eq!(code, 1);
    assert_says(&said, &[&file]);
    let config = under(folder.path(), "coordinator.toml");
    std::fs::write(&config, "lease = 5\n").expect("a file");
    let (_, said) = fail(&["coordinator", "--config", &config]);
    assert_says(&said, &["coordinator.toml", "lease"]);
    // The file sets 1, the environment too much, the flag a valid value: the flag takes precedence.
    std::fs::write(&config, "lease_ms = 1\nmax_errors = 0\n").expect("a file");
    let start = |flags: &[&str]| {
        let arguments = [&["coordinator", "--config", &config, "--data-dir", &file], flags].concat();
        let output =
            fathom(&arguments).env("FATHOM_LEASE_MS", "99999999").output().expect("the binary starts");
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert_says(&start(&[]), &["lease_ms must be at most", "max_errors"]);
    let said = start(&["--lease-ms", "6000"]);
    assert!(said.contains("max_errors") && !said.contains("lease_ms"), "{said}");
    let config = under(folder.path(), "worker.toml");
    std::fs::write(&config, "cache = 5\n").expect("a file");
    let (_, said) = fail(&["worker", "--config", &config]);
    assert_says(&said, &["worker.toml", "cache"]);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("an address").to_string();
    let data = under(folder.path(), "data");
    let (_, said) = fail(&["coordinator", "--data-dir", &data, "--listen", &address]);
    assert_says(&said, &[&address]);
    assert!(!std::path::Path::new(&data).exists(), "a coordinator that cannot listen left a data directory");
}

#[test]
fn synth_refuses_sizes_and_folders_that_it_cannot_use() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = under(folder.path(), "scene");
    let (_, said) = fail(&["synth", &out, "--size", "big"]);
    assert_says(&said, &["big", "240x180"]);
    let (_, said) = fail(&["synth", &out, "--views", "0"]);
    assert_says(&said, &["--views"]);
    crate::processes::tiny_scene(folder.path());
    let (_, said) = fail(&["synth", &out]);
    assert_says(&said, &[&out, "empty folder"]);
}

#[test]
fn synth_makes_a_pool_and_refuses_flags_of_another_kind() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = under(folder.path(), "pool");
    let (_, said) = fail(&["synth", &out, "--kind", "pool", "--look", "forward"]);
    assert_says(&said, &["--look", "--kind wreck"]);
    let (_, said) = fail(&["synth", &out, "--ior", "1.4"]);
    assert_says(&said, &["--ior", "--kind pool"]);
    let (_, said) = fail(&["synth", &out, "--kind", "pool", "--depth", "-1"]);
    assert_says(&said, &["--depth is -1", "0.3 to 5"]);
    let (_, said) = fail(&["synth", &out, "--kind", "pool", "--length", "1"]);
    assert_says(&said, &["--length is 1", "2 to 20"]);
    assert!(!Path::new(&out).exists(), "a refused scene leaves nothing");
    let pool = ["synth", &out, "--kind", "pool", "--views", "9", "--size", "64x48", "--depth", "1.2"];
    let made = succeed(&[&pool[..], &["--ior", "1.4", "--json"]].concat());
    let made: Value = serde_json::from_str(&made).expect("JSON");
    assert_eq!((&made["views"], &made["truth_views"]), (&9.into(), &2.into()));
    let surface = std::fs::read(under(folder.path(), "pool/truth/surface.json")).expect("the surface");
    let surface: Value = serde_json::from_slice(&surface).expect("JSON");
    assert_eq!((&surface["ior"], &surface["normal"]), (&1.4.into(), &serde_json::json!([0.0, -1.0, 0.0])));
    // Every reader of scenes reads it.
    let said = succeed(&["inspect", &out]);
    assert_says(&said, &["9"]);
}

#[test]
fn inspect_reads_and_plans_a_scene_of_synth() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let picture = under(folder.path(), "plan.png");
    let seen = json(&["inspect", &scene, "--partitions", "2x2", "--plan", &picture, "--json"]);
    assert_eq!(seen["counts"]["images"], 64);
    assert_eq!(seen["counts"]["with_photograph"], 64);
    assert_eq!(seen["images"].as_array().map(Vec::len), Some(64));
    assert_eq!(seen["plan"]["partitions"].as_array().map(Vec::len), Some(4));
    // The cameras look down along +y.
    let down = seen["plan"]["alignment"]["down"][1].as_f64().expect("a number");
    assert!(down > 0.99, "down is {}", seen["plan"]["alignment"]["down"]);
    let png = std::fs::read(&picture).expect("a picture");
    assert!(png.starts_with(b"\x89PNG"));
    let warns = |seen: &serde_json::Value| {
        let warnings = seen["warnings"].as_array().expect("a list");
        warnings
            .iter()
            .any(|text| text.as_str().is_some_and(|text| text.contains("fewer than two training views")))
    };
    let unseen = seen["unseen"].as_f64().expect("a share");
    assert!((0.0..0.05).contains(&unseen) && !warns(&seen), "unseen share {unseen} of a dense survey");
    // Of six views, the three training views overlap little.
    let few = under(folder.path(), "few");
    succeed(&["synth", &few, "--views", "6", "--size", "160x120"]);
    let few = ["inspect", &few, "--test-every", "2", "--no-plan"];
    let seen = json(&[&few[..], &["--json"]].concat());
    assert!(seen["unseen"].as_f64().is_some_and(|share| share > 0.2) && warns(&seen), "{}", seen["unseen"]);
    assert!(succeed(&few).contains("held-out views: "), "no sentence about them");
    let chosen = json(&[
        "inspect",
        &scene,
        "--partitions",
        "auto",
        "--set",
        "partition.workers=3",
        "--no-plan",
        "--json",
    ]);
    let cut = &chosen["plan"]["cut"];
    assert_eq!(cut["planned_for"]["workers"], 3);
    assert!(cut["reason"].as_str().is_some_and(|reason| reason.contains("GiB")), "{cut}");
}

#[test]
fn doctor_lists_adapters_or_says_which_package_is_missing() {
    let output = output_of(&["doctor", "--json"]);
    let said: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let adapters = said["adapters"].as_array().expect("a list");
    assert_eq!(output.status.success(), !adapters.is_empty());
    assert!(!said["advice"].as_array().expect("a list").is_empty());
}

#[test]
fn the_help_of_every_verb_is_printed() {
    for verb in [
        "train",
        "coordinator",
        "worker",
        "submit",
        "ls",
        "show",
        "watch",
        "cancel",
        "download",
        "inspect",
        "eval",
        "render",
        "synth",
        "doctor",
    ] {
        assert!(succeed(&[verb, "--help"]).contains("Usage: fathom"), "{verb}");
    }
}
