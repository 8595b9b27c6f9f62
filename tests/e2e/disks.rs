//! Disks end to end: partitions, merge, borders, evaluation and render of a job with `method = "2dgs"`.

use crate::processes::{can_train, fail, json, succeed, tiny_scene, under};

/// The settings below reach 25.71 dB (2026-11-29, llvmpipe); the floor is 2 dB under it.
const FLOOR_DB: f64 = 23.7;

#[test]
fn a_scene_of_disks_becomes_one_model() {
    if !can_train("a_scene_of_disks_becomes_one_model") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = tiny_scene(folder.path());
    let out = under(folder.path(), "out");
    let settings = [
        "--method",
        "2dgs",
        "--partitions",
        "2x1",
        "--workers",
        "1",
        "--iterations",
        "400",
        "--max-gaussians",
        "5000",
        "--set",
        "borders.enabled=true",
    ];
    let metrics = json(&[&["train", &scene, "-o", &out, "--allow-cpu", "--json"][..], &settings].concat());
    let psnr = metrics["psnr"].as_f64().expect("a number");
    println!("PSNR {psnr:.2} dB on held-out views");
    assert!(psnr > FLOOR_DB, "PSNR {psnr}, floor {FLOOR_DB}");
    assert_eq!(metrics["medium"], "per_pixel");
    let model = std::fs::read(folder.path().join("out/model.ply")).expect("the model");
    let header = String::from_utf8_lossy(&model[..model.len().min(4096)]).into_owned();
    assert!(header.contains("comment disks: 2D Gaussians"), "{header}");

    // `fathom eval` draws disks too: the metrics of the job and of the file agree.
    let again = json(&["eval", &out, "--data", &scene, "--allow-cpu", "--json"]);
    let of_file = again["psnr"].as_f64().expect("a number");
    assert!((of_file - psnr).abs() < 0.01, "{of_file} dB by `fathom eval`, {psnr} dB by the job");
    let frames = under(folder.path(), "frames");
    succeed(&["render", &out, "--cameras", &scene, "--allow-cpu", "-o", &frames, "--maps", "range,normal"]);
    let maps = |map: &str| std::fs::read_dir(folder.path().join("frames").join(map)).expect(map).count();
    assert!(maps("range") >= 64 && maps("normal") >= 64);
}

#[test]
fn disks_are_refused_where_they_cannot_be_trained() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = tiny_scene(folder.path());
    let out = under(folder.path(), "out");
    let refused =
        |set: &str| fail(&["train", &scene, "-o", &out, "--allow-cpu", "--method", "2dgs", "--set", set]);
    let (_, said) = refused("water.medium=per_gaussian");
    assert!(said.contains("blends disks before the water acts"), "{said}");
    let (_, said) = refused("train.mip_filter=true");
    assert!(said.contains("low-pass of their own"), "{said}");
    let (_, said) = fail(&["train", &scene, "-o", &out, "--allow-cpu", "--method", "4dgs"]);
    assert!(said.contains(r#"no method "4dgs""#) && said.contains("2dgs"), "{said}");
    assert!(!folder.path().join("out").exists(), "a refused job left a folder");
}
