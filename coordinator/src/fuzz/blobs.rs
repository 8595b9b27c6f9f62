//! Blobs: manifests and configurations of users, and results of workers.

use fathom_core::config::JobConfig;
use fathom_core::scene::{BlobRef, Camera, CameraModel, Manifest, ManifestView, PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use fathom_fuzz::{Target, run};
use fathom_plan::{Plan, PlanInput, plan};
use fathom_proto::worker::v1;
use glam::DVec3;
use prost::Message;

use super::calls::blob;
use crate::datasets::{FileList, ListedFile};
use crate::own_tasks::artifacts::{self, ArtifactIndex};
use crate::own_tasks::evaluation::Evaluated;
use crate::own_tasks::exchange;
use crate::own_tasks::input::JobInput;
use crate::schedule::TaskId;

fn poses() -> impl Iterator<Item = Pose> {
    (0..12).map(|i| {
        let eye = DVec3::new(f64::from(i % 4), -2.0, f64::from(i / 4));
        Pose::looking_at(eye, eye + DVec3::new(0.1, 1.0, 0.05), DVec3::Z)
    })
}

fn points() -> Points {
    let mut points = Points::default();
    for i in 0..60 {
        points.push([f64::from(i % 10) * 0.4, 0.1, f64::from(i / 10) * 0.5], [90; 3]);
    }
    points
}

fn two_by_two() -> JobConfig {
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (2, 2);
    config
}

/// Plans from uploaded manifests.
#[test]
fn fuzzed_manifests_are_planned_or_refused() {
    let view = |(index, pose): (usize, Pose)| ManifestView {
        name: format!("{index:02}.jpg"),
        camera_id: 3,
        pose,
        image: BlobRef::of(b"photograph"),
        mask: None,
    };
    let params = vec![30.0, 20.0, 15.0, -0.01];
    let manifest = Manifest {
        format: Manifest::FORMAT,
        source: "COLMAP binary".to_owned(),
        cameras: vec![Camera { id: 3, model: CameraModel::SimpleRadial, width: 40, height: 30, params }],
        views: poses().enumerate().map(view).collect(),
        points: BlobRef::of(b""),
    };
    let (points, config) = (points(), two_by_two());
    let read = |bytes: &[u8]| {
        let Ok(input) = JobInput::parse(config.clone(), bytes) else { return false };
        let Ok(views) = input.views() else { return false };
        let Ok(plan) = plan(&PlanInput { views: &views, points: &points, config: &config }) else {
            return false;
        };
        let json = serde_json::to_vec(&plan).unwrap();
        assert_eq!(Plan::from_json(&json).unwrap(), plan);
        true
    };
    let corpus = vec![manifest.to_json().unwrap()];
    run(&Target { inputs: 1000, ..Target::new("plan of a manifest", corpus, &read) });
}

/// Plans from submitted configurations.
#[test]
fn fuzzed_configurations_make_a_plan_or_are_refused() {
    let camera = PinholeCamera { width: 40, height: 30, fx: 30.0, fy: 30.0, cx: 20.0, cy: 15.0 };
    let view = |(index, pose): (usize, Pose)| TrainView {
        name: format!("{index:02}.jpg"),
        camera,
        pose,
        clear_range: 0.0,
    };
    let (views, points): (Vec<TrainView>, _) = (poses().enumerate().map(view).collect(), points());
    let read = |bytes: &[u8]| {
        let Some(config) = std::str::from_utf8(bytes).ok().and_then(|text| JobConfig::from_json(text).ok())
        else {
            return false;
        };
        let Ok(plan) = plan(&PlanInput { views: &views, points: &points, config: &config }) else {
            return false;
        };
        let json = serde_json::to_vec(&plan).unwrap();
        assert_eq!(Plan::from_json(&json).unwrap(), plan);
        plan.warnings(&config.train).iter().for_each(|warning| assert!(!warning.is_empty()));
        let _ = plan.seam_lines(&config.seams);
        true
    };
    let auto =
        br#"{"partition": {"auto": true, "memory_gib": 4.5, "workers": 2}, "data": {"test_every": 4}}"#;
    let corpus = vec![
        serde_json::to_vec(&two_by_two().partition)
            .map(|section| [b"{\"partition\":", &section[..], b"}"].concat())
            .unwrap(),
        auto.to_vec(),
        br#"{"train": {"iterations": 700, "max_gaussians": 5000}, "borders": {"enabled": true}}"#.to_vec(),
    ];
    run(&Target { inputs: 1000, ..Target::new("plan of a configuration", corpus, &read) });
}

#[test]
fn fuzzed_indexes_of_artifacts_are_read_or_refused() {
    let index = ArtifactIndex {
        files: vec![("renders/a.png".into(), BlobRef::of(b"a")), ("b".into(), BlobRef::of(b"b"))],
    };
    let read = |bytes: &[u8]| {
        let Ok(index) = ArtifactIndex::from_bytes(bytes) else { return false };
        assert!(
            index
                .files
                .iter()
                .all(|(path, _)| !path.contains("..") || !path.split('/').any(|part| part == ".."))
        );
        true
    };
    let words = ["../", "/", "C:", "\\u0000"];
    let corpus = vec![serde_json::to_vec(&index).unwrap()];
    run(&Target { words: &words, ..Target::new("index of artifacts", corpus, &read) });
}

#[test]
fn fuzzed_measurements_of_workers_are_taken_or_refused() {
    let three = vec![0.1; 3];
    let first_part = v1::FirstPartResult {
        format: 1,
        partition: 3,
        beta_d: three.clone(),
        beta_b: three.clone(),
        b_inf: three,
        evidence: vec![2.0; 9],
        unit: 5.0,
        ..Default::default()
    };
    let coarse = fathom_core::water::WaterRecord::new(
        &fathom_core::water::Water::COASTAL,
        fathom_core::config::Composition::PixelsSrgb,
        fathom_core::water::StandardErrors::from_array([0.01; 9]),
        "sparse",
        0.5,
    );
    let read = |bytes: &[u8]| {
        let Ok(first_part) = v1::FirstPartResult::decode(bytes) else { return false };
        let Ok(evidence) = exchange::evidence_of(3, &first_part) else { return false };
        let other = fathom_core::water::PartitionEvidence { partition: 4, ..evidence };
        let Ok(found) = fathom_core::water::consensus(&coarse, first_part.unit, &[evidence, other]) else {
            return false;
        };
        let json = serde_json::to_vec(&found).unwrap();
        assert_eq!(fathom_core::water::Consensus::from_json(&json).unwrap(), found);
        true
    };
    run(&Target::new("FirstPartResult", vec![first_part.encode_to_vec()], &read));

    let metrics = v1::ViewMetrics {
        name: "left/a.jpg".into(),
        psnr_db: 30.5,
        ssim: 0.9,
        side_by_side: blob(),
        border: blob(),
    };
    let evaluation = v1::Evaluation {
        format: 1,
        views: vec![metrics; 2],
        gaussians: 1000,
        adapter: "GPU".into(),
        cover_json: r#"{"holes": 0.1, "open_water": null, "unseen": 0, "views": [{"holes": 0.5}]}"#.into(),
        ..Default::default()
    };
    let read = |bytes: &[u8]| {
        let Ok(evaluation) = v1::Evaluation::decode(bytes) else { return false };
        let views = evaluation.views.len();
        let Ok(evaluated) = (match evaluation.cover_sums_json.is_empty() {
            true => Evaluated::of_one(evaluation),
            false => Evaluated::of_parts(vec![(evaluation, views)]),
        }) else {
            return false;
        };
        for (index, metrics) in evaluated.views.iter().enumerate() {
            let path = artifacts::render_path("border_", index, &metrics.name);
            assert_eq!(fathom_core::paths::check_inside(&path), Ok(()), "{path:?}");
        }
        true
    };
    let zone = r#"{"pixels": 9, "squares": 70, "ssim": 8.5}"#;
    let seams = format!(
        r#"{{"border": {zone}, "border_flank": {zone}, "control": {zone}, "control_flank": {zone}, "interior": {zone}, "least": 1}}"#
    );
    let cover = r#"{"holes": {"sum": 1, "pixels": 9}, "open_water": {"sum": 1, "pixels": 9}, "unseen": {"sum": 1, "pixels": 9}}"#;
    let steps = r#"[{"pairs": 2, "steps": [0.5, 0.25]}, {"pairs": 1, "steps": [0.125]}]"#;
    let part = v1::Evaluation {
        cover_json: String::new(),
        seam_sums_json: format!(
            r#"{{"band": 0.5, "views": [{seams}, {seams}], "border_steps": {steps}, "control_steps": {steps}}}"#
        ),
        cover_sums_json: format!(r#"{{"views": [{cover}, {cover}], "brightest": [1, 2, 3]}}"#),
        ..evaluation.clone()
    };
    assert!(read(&part.encode_to_vec()), "a part of an evaluation");
    run(&Target::new("Evaluation", vec![evaluation.encode_to_vec(), part.encode_to_vec()], &read));
}

#[test]
fn fuzzed_names_of_jobs_and_tasks_round_trip_or_are_refused() {
    let read = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        let (job, task) = (text.parse::<crate::schedule::JobId>(), text.parse::<TaskId>());
        assert!(job.as_ref().is_ok_and(|id| id.as_str() == text) || job.is_err());
        assert!(task.as_ref().is_ok_and(|id| id.to_string() == text) || task.is_err());
        job.is_ok() || task.is_ok()
    };
    let corpus = ["0193a5b2c4d100000007", "partition-0003", "first_part-12345", "merge"]
        .map(|id| id.as_bytes().to_vec());
    run(&Target::new("names of jobs and tasks", corpus.to_vec(), &read));
}

/// The coordinator reads uploads of any client, not only those that our client checks first.
#[test]
fn a_manifest_with_an_invalid_pose_or_name_fails_the_plan() {
    let manifest = |name: &str, x: f64| Manifest {
        format: Manifest::FORMAT,
        source: "COLMAP binary".to_owned(),
        cameras: vec![Camera {
            id: 3,
            model: CameraModel::Pinhole,
            width: 40,
            height: 30,
            params: vec![30.0, 30.0, 20.0, 15.0],
        }],
        views: vec![ManifestView {
            name: name.to_owned(),
            camera_id: 3,
            pose: Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [x, 0.0, 0.0]),
            image: BlobRef::of(b"photograph"),
            mask: None,
        }],
        points: BlobRef::of(b""),
    };
    let parse = |manifest: Manifest| {
        JobInput::parse(JobConfig::default(), &manifest.to_json().unwrap()).map_err(|error| error.message)
    };
    assert_eq!(parse(manifest("a.jpg", 1.0)).map(|input| input.manifest.views.len()).ok(), Some(1));
    for (manifest, reason) in [
        (manifest("a.jpg", 1e300), "the pose of view \"a.jpg\""),
        (manifest("../../a.jpg", 1.0), "without \"..\""),
    ] {
        let refused = parse(manifest).err().unwrap();
        assert!(refused.contains(reason), "{refused}");
    }
}

/// The files of a dataset, which a client may upload as a list.
#[test]
fn fuzzed_lists_of_files_are_read_back_or_refused() {
    let file = |path: &str| ListedFile { path: path.into(), blob: BlobRef::of(path.as_bytes()) };
    let list =
        FileList::new(vec![file("images/a.jpg"), file("images/t\u{e4}uchung.jpg"), file("manifest.json")]);
    let read = |bytes: &[u8]| {
        let Ok(list) = FileList::parse(bytes.to_vec()) else { return false };
        let files = list.files().map(|file| ListedFile { path: file.path.into(), blob: file.blob() });
        let again = FileList::new(files.collect());
        assert_eq!(again.as_ref().map(FileList::text), Ok(list.text()), "two texts of one list");
        assert_eq!(again, Ok(list));
        true
    };
    let words = ["../", "/", " ", "\n", "18446744073709551615", "e\u{301}"];
    let corpus = vec![list.unwrap().into_text().into_bytes()];
    run(&Target { words: &words, ..Target::new("list of files", corpus, &read) });
}
