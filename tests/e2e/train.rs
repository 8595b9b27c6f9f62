//! `fathom train` end to end with real processes: a synthetic scene, four partitions, two workers; and
//! extreme scenes.

use std::path::Path;

use crate::processes::{can_train, fail, json, succeed, under};
use serde_json::Value;

/// The settings below reach 27.11 dB (2026-11-22, llvmpipe); the floor is 2 dB under it.
const FLOOR_DB: f64 = 25.1;

#[test]
fn a_scene_becomes_one_model_with_a_report() {
    if !can_train("a_scene_becomes_one_model_with_a_report") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let out = under(folder.path(), "out");
    let settings =
        ["--partitions", "2x2", "--workers", "2", "--iterations", "500", "--max-gaussians", "6000"];
    let metrics = json(&[&["train", &scene, "-o", &out, "--allow-cpu", "--json"][..], &settings].concat());

    let psnr = metrics["psnr"].as_f64().expect("a number");
    println!("PSNR {psnr:.2} dB on held-out views");
    assert!(psnr > FLOOR_DB, "PSNR {psnr}, floor {FLOOR_DB}");
    assert_eq!(metrics["medium"], "per_pixel");
    assert_eq!(metrics["views"].as_array().map(Vec::len), Some(8), "every 8th of 64 views");
    assert_eq!(metrics["partitions"].as_array().map(Vec::len), Some(4));
    for file in [
        "model.ply",
        "model.compressed.ply",
        "model.json",
        "cameras.json",
        "plan.json",
        "plan.png",
        "metrics.json",
        "run.json",
        "water.json",
    ] {
        assert!(folder.path().join("out").join(file).is_file(), "{file} is missing");
    }
    let renders: Vec<String> = std::fs::read_dir(folder.path().join("out/renders"))
        .expect("renders")
        .map(|file| file.expect("a file").file_name().to_string_lossy().into_owned())
        .collect();
    let of_borders = renders.iter().filter(|name| name.starts_with("border_")).count();
    assert_eq!(renders.len() - of_borders, 8);

    // Measurements at the borders of the four cells.
    let seams = &metrics["seams"];
    assert_eq!(seams["border"]["views"].as_u64(), Some(of_borders as u64), "{seams}");
    assert!(of_borders > 0, "no view shows a border");
    for (key, bounds) in [
        ("border_psnr", psnr - 6.0..psnr + 6.0),
        ("interior_psnr", psnr - 6.0..psnr + 6.0),
        ("control_psnr", psnr - 6.0..psnr + 6.0),
        ("border_ssim", 0.3..1.0),
        ("interior_ssim", 0.3..1.0),
        ("seam_db", -3.0..3.0),
    ] {
        let value = metrics[key].as_f64().unwrap_or_else(|| panic!("{key} is {} in {seams}", metrics[key]));
        assert!(bounds.contains(&value), "{key} is {value}, not within {bounds:?}");
    }
    let steps = &seams["range_step"];
    println!("borders {seams}");
    assert!(steps["border"]["ratio"].as_f64().is_some_and(|ratio| (0.05..20.0).contains(&ratio)), "{steps}");
    assert!(!folder.path().join("out/.fathom").exists(), "a finished run still has its state for resuming");

    // `fathom eval` agrees with the metrics of the job: same protocol, same views, same adapter.
    let again = json(&["eval", &out, "--data", &scene, "--allow-cpu", "--json", "--baselines"]);
    let difference = (again["psnr"].as_f64().expect("a number") - psnr).abs();
    assert!(difference < 1e-6, "eval says {}, the job {psnr}", again["psnr"]);
    assert_eq!(again["gaussians"], metrics["gaussians"]);
    assert_eq!(again["colour_space"], metrics["colour_space"]);
    let seam_db = |metrics: &Value| metrics["seam_db"].as_f64().expect("a number");
    assert!((seam_db(&again) - seam_db(&metrics)).abs() < 1e-6, "eval {}, job {seams}", again["seams"]);
    assert_eq!(again["seams"]["border"]["pixels"], seams["border"]["pixels"], "by the same lines");
    let flat = again["baselines"]["flat_colour"]["psnr"].as_f64().expect("a number");
    assert!(psnr > flat + 1.0, "PSNR {psnr}, a flat colour has {flat}");
    let stored = json(&["eval", &out, "--json"]);
    assert_eq!(stored["psnr"], metrics["psnr"]);

    let truth = json(&["eval", &out, "--truth", &format!("{scene}/truth"), "--allow-cpu", "--json"]);
    // The gain minimises the squared error over all views, which is not exactly the highest mean PSNR.
    let of_truth = |key: &str| truth["truth"][key].as_f64().expect("a number");
    let (plain, gained) = (of_truth("psnr"), of_truth("psnr_with_gain"));
    assert!(gained > plain - 0.05, "the gain lowered the PSNR: {plain} {gained}");

    let water = &truth["truth"]["water"];
    // The sparse points do not determine the colour of open water here, and the report says so.
    assert_eq!(water["standard_error"]["b_inf"], serde_json::json!([null, null, null]));
    // Such small photographs lower beta_d of blue by a fifth, with one partition (.22) as with four (.21):
    // less than its standard error.
    for (name, bound) in [("beta_d_error", 0.25), ("b_inf_error", 0.06)] {
        let errors: Vec<f64> = (0..3).map(|c| water[name][c].as_f64().expect("a number").abs()).collect();
        println!("{name} {errors:.4?}");
        assert!(errors.iter().all(|error| *error < bound), "{name}: {errors:?}, {water}");
    }
    assert_eq!(again["water"], json(&["eval", &out, "--json"])["water"], "one water for job and model");

    // Underwater, restored and backscatter renders are three films.
    let frames = |water: &str| {
        let frames = under(folder.path(), water);
        let cameras = format!("{out}/cameras.json");
        let args = ["render", &out, "--cameras", &cameras, "-o", &frames, "--allow-cpu", "--water", water];
        succeed(&args);
        let pictures = std::fs::read_dir(&frames).expect("frames").count();
        assert_eq!(pictures, 64, "one for each view of the scene");
        std::fs::read(format!("{frames}/v0009.png")).expect("a picture")
    };
    let [on, off, only] = ["on", "off", "only"].map(frames);
    assert!(on != off && off != only && on != only);

    let control = under(folder.path(), "control");
    let settings = ["--preset", "3dgs", "--iterations", "20", "--max-gaussians", "500"];
    let metrics =
        json(&[&["train", &scene, "-o", &control, "--allow-cpu", "--json"][..], &settings].concat());
    assert_eq!(metrics["medium"], "none");
    assert_eq!((&metrics["seams"], &metrics["border_psnr"]), (&Value::Null, &Value::Null), "nothing was cut");
    let plan = format!("{out}/plan.json");
    let whole = json(&["eval", &control, "--data", &scene, "--plan", &plan, "--allow-cpu", "--json"]);
    assert!(
        whole["border_psnr"].is_number(),
        "it is measured at the other model's borders: {}",
        whole["seams"]
    );
    assert!(!folder.path().join("control/water.json").exists(), "no water, no file");
    let cameras = format!("{out}/cameras.json");
    let (_, said) = fail(&["render", &control, "--cameras", &cameras, "--allow-cpu", "--water", "on"]);
    assert!(said.contains("has no water to show"), "{said}");

    let (_, said) = fail(&["train", &scene, "-o", &out, "--allow-cpu"]);
    assert!(said.contains("already holds a result"), "{said}");
}

/// A COLMAP text scene: photographs of `scene`, one camera model with this focal length, and a centre for
/// each view number. All look along z at points on a wall four units in front of the first one.
fn wall_scene(
    scene: &str,
    folder: &Path,
    name: &str,
    focal: f64,
    centre: impl Fn(usize) -> [f64; 3],
) -> String {
    let made = folder.join(name);
    let sparse = made.join("sparse/0");
    for folder in [&sparse, &made.join("images")] {
        std::fs::create_dir_all(folder).expect("a folder");
    }
    let mut images = String::new();
    for index in 1..=10 {
        let [x, y, z] = centre(index).map(|at| -at);
        let photograph = format!("v{index:04}.png");
        images += &format!("{index} 1 0 0 0 {x} {y} {z} 1 {photograph}\n\n");
        let [from, to] = [Path::new(scene), &made].map(|scene| scene.join("images").join(&photograph));
        std::fs::copy(from, to).expect("a photograph");
    }
    let points: String = (0..49)
        .map(|i| {
            format!(
                "{} {} {} 4 120 90 60 0.5\n",
                i + 1,
                f64::from(i % 7) * 0.4 - 1.2,
                f64::from(i / 7) * 0.3 - 0.9
            )
        })
        .collect();
    for (file, text) in [
        ("cameras.txt", format!("1 PINHOLE 96 72 {focal} {focal} 48 36\n")),
        ("images.txt", images),
        ("points3D.txt", points),
    ] {
        std::fs::write(sparse.join(file), text).expect("a file");
    }
    made.to_string_lossy().into_owned()
}

/// The centre of each view by its number.
type Centres = fn(usize) -> [f64; 3];

#[test]
fn extreme_lenses_and_poses_train_to_a_finite_model() {
    if !can_train("extreme_lenses_and_poses_train_to_a_finite_model") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = under(folder.path(), "scene");
    succeed(&["synth", &scene, "--views", "10", "--size", "96x72"]);
    let beside: Centres = |index| [0.1 * index as f64, 0.0, 0.0];
    let far: Centres = |index| if index == 5 { [1e12, 0.0, 0.0] } else { [0.1 * index as f64, 0.0, 0.0] };
    let limits: [(&str, f64, Centres); 4] = [
        ("focal-1e9", 1e9, beside),
        ("focal-0.001", 1e-3, beside),
        ("pose-1e12", 80.0, far),
        ("one-pose", 80.0, |_| [0.0; 3]),
    ];
    for (name, focal, centre) in limits {
        let changed = wall_scene(&scene, folder.path(), name, focal, centre);
        let out = under(folder.path(), &format!("out-{name}"));
        succeed(&["train", &changed, "-o", &out, "--allow-cpu", "--iterations=20", "--max-gaussians=500"]);
        let model = fathom_core::ply::read_model(Path::new(&format!("{out}/model.ply"))).expect("a model");
        assert!(!model.is_empty(), "{name}: an empty model");
        let finite = model.means.iter().flatten().all(|number| number.is_finite())
            && model.log_scales.iter().flatten().all(|number| number.is_finite())
            && model.sh_coeffs.iter().flatten().all(|number| number.is_finite());
        assert!(finite, "{name}: the model has values that are not finite");
    }
}
