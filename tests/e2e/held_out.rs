//! Metrics on held-out views during training, end to end with real processes.

use std::collections::BTreeMap;

use crate::processes::{can_train, fail, json, output_of, succeed, under};
use serde_json::Value;

/// Trains the scene; returns metrics.json, the model's bytes, and stderr.
fn train(scene: &str, out: &str, settings: &[&str]) -> (Value, Vec<u8>, String) {
    let cap = ["--max-gaussians", "1500", "--iterations", "80"];
    let output =
        output_of(&[&["train", scene, "-o", out, "--allow-cpu", "--json"][..], &cap, settings].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    let metrics = serde_json::from_slice(&output.stdout).expect("metrics.json");
    (metrics, std::fs::read(format!("{out}/model.ply")).expect("a model"), said)
}

/// (task, iteration) of every measurement.
fn measured(metrics: &Value) -> Vec<(&str, u64)> {
    let rows = metrics["held_out_in_training"].as_array().map(Vec::as_slice).unwrap_or_default();
    rows.iter()
        .map(|row| (row["task"].as_str().expect("a task"), row["iteration"].as_u64().expect("a number")))
        .collect()
}

#[test]
fn measuring_held_out_views_changes_no_byte_of_the_model() {
    if !can_train("measuring_held_out_views_changes_no_byte_of_the_model") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let (plain, model, _) = train(&scene, &under(folder.path(), "plain"), &[]);
    assert!(plain.get("held_out_in_training").is_none(), "nothing is measured by default");

    // The worker that measured the job had the sparse points and all cameras, like `fathom eval`.
    let out = under(folder.path(), "plain");
    let eval = |place: &[&str]| json(&[&["eval", &out, "--allow-cpu", "--json"], place].concat());
    let (again, truth) = (eval(&["--data", &scene]), eval(&["--truth", &format!("{scene}/truth")]));
    for key in ["holes", "open_water", "unseen"] {
        assert_eq!(plain[key], again[key], "{key} of the job and of the same model, measured again");
        assert_eq!(plain["views"][0][key], again["views"][0][key], "{key} of the first view");
    }
    for metrics in [&plain, &again, &truth] {
        let share = |key: &str| metrics[key].as_f64().is_some_and(|share| (0.0..=1.0).contains(&share));
        assert!(share("holes") && share("unseen"), "{metrics:#}");
    }
    assert_ne!(truth["holes"], again["holes"], "the truth was not used");
    assert!(
        truth["open_water"].is_null(),
        "every pixel of the truth shows a surface: {}",
        truth["open_water"]
    );

    // The progress output is not checked: such a short run may end before the first poll.
    let (metrics, same_model, _) = train(&scene, &under(folder.path(), "out"), &["--eval-every", "20"]);
    let task = "partition-0000";
    assert_eq!(measured(&metrics), [(task, 20), (task, 40), (task, 60), (task, 80)]);
    assert!(model == same_model, "the model depends on the measurements");
    let rows = metrics["held_out_in_training"].as_array().expect("measurements");
    assert!(rows.iter().all(|row| row["views"] == 8), "every 8th of 64 views: {rows:?}");
    let psnr = |value: &Value| value["psnr"].as_f64().expect("a number");
    assert!(psnr(&rows[3]) > psnr(&rows[0]), "{rows:?}");
    // The same model, views and protocol as in the final evaluation.
    assert!(
        (psnr(&rows[3]) - psnr(&metrics)).abs() < 1e-3,
        "{} at the end, {}",
        psnr(&rows[3]),
        psnr(&metrics)
    );

    let settings =
        ["--partitions", "2x1", "--eval-every", "10", "--set", "partition.global_least_iterations=1"];
    let (metrics, _, said) = train(&scene, &under(folder.path(), "two"), &settings);
    assert_eq!(measured(&metrics), [("global", 10), ("global", 20)], "a quarter of 80 iterations");
    assert!(said.contains("measures the coarse model only"), "{said}");
}

#[test]
fn measuring_without_held_out_views_is_refused() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = under(folder.path(), "scene");
    succeed(&["synth", &scene, "--views", "8", "--size", "32x24"]);
    let out = under(folder.path(), "out");
    let (_, said) = fail(&["train", &scene, "-o", &out, "--test-every", "0", "--eval-every", "10"]);
    assert!(said.contains("train.eval_every needs held-out views"), "{said}");
}

/// The files of a folder by name.
fn files(folder: &str) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry"));
    entries
        .map(|file| {
            let name = file.file_name().to_string_lossy().into_owned();
            (name, std::fs::read(file.path()).expect("a file"))
        })
        .collect()
}

#[test]
fn an_evaluation_in_parts_changes_no_metric_and_no_picture() {
    if !can_train("an_evaluation_in_parts_changes_no_metric_and_no_picture") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let results = ["1000", "3"].map(|views| {
        let out = under(folder.path(), views);
        let parts = format!("partition.evaluation_views={views}");
        let settings = ["--partitions", "2x2", "--workers", "2", "--set", &parts];
        let (mut metrics, model, _) = train(&scene, &out, &settings);
        metrics["seconds"].take();
        metrics["partitions"].as_array_mut().expect("partitions").iter_mut().for_each(|partition| {
            partition["seconds"].take();
        });
        let run: Value = serde_json::from_slice(&std::fs::read(format!("{out}/run.json")).expect("run.json"))
            .expect("JSON");
        let tasks = run["tasks"].as_array().expect("tasks").iter();
        let names: Vec<String> = tasks
            .filter_map(|task| task["id"].as_str())
            .filter(|task| task.starts_with("evaluate"))
            .map(str::to_owned)
            .collect();
        (names, metrics, model, files(&format!("{out}/renders")))
    });
    let [(one, metrics, model, renders), (several, others, other_model, other_renders)] = results;
    assert_eq!(one, ["evaluate"]);
    assert_eq!(several, ["evaluate-0001", "evaluate-0002", "evaluate-0003"], "8 views, at most 3 in a task");
    assert!(model == other_model, "another model");
    assert_eq!(metrics, others);
    assert!(metrics["seams"].is_object() && metrics["picture_gains"].is_array(), "{metrics:#}");
    let names = |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&renders), names(&other_renders));
    for (name, picture) in &renders {
        assert!(other_renders[name] == *picture, "{name} differs");
    }
}
