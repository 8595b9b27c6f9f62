//! A scene seen through a water surface, end to end: a pool becomes a model that is shown wet, dry and with
//! oil.

use std::path::Path;

use crate::processes::{can_train, fail, json, succeed, under};

/// The settings below reach 21.64 dB (2026-11-28, llvmpipe); the floor is 2 dB under it.
const FLOOR_DB: f64 = 19.6;

fn pool(folder: &Path) -> String {
    let scene = under(folder, "pool");
    succeed(&["synth", &scene, "--kind", "pool", "--views", "27", "--size", "64x48"]);
    scene
}

#[test]
fn a_pool_becomes_a_model_with_and_without_water() {
    if !can_train("a_pool_becomes_a_model_with_and_without_water") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = pool(folder.path());
    let out = under(folder.path(), "out");
    let settings = ["--preset", "wsgs", "--workers", "1", "--iterations", "400", "--max-gaussians", "2500"];
    let metrics = json(&[&["train", &scene, "-o", &out, "--allow-cpu", "--json"][..], &settings].concat());
    let psnr = metrics["psnr"].as_f64().expect("a number");
    println!("PSNR {psnr:.2} dB on held-out views");
    assert!(psnr > FLOOR_DB, "PSNR {psnr}, floor {FLOOR_DB}");

    let read = |file: &str| std::fs::read(folder.path().join("out").join(file)).expect(file);
    let record: serde_json::Value = serde_json::from_slice(&read("surface.json")).expect("a record");
    let truth = std::fs::read(folder.path().join("pool/truth/surface.json")).expect("the truth");
    let truth: serde_json::Value = serde_json::from_slice(&truth).expect("a surface");
    let offset = |of: &serde_json::Value| of["offset"].as_f64().expect("an offset");
    assert!((offset(&record) - offset(&truth)).abs() < 0.01, "{record} against {truth}");
    assert_eq!(record["source"], "tracks");
    for set in ["base", "refracted", "reflected"] {
        assert!(read(&format!("sets/{set}.ply")).starts_with(b"ply\n"), "{set}");
    }

    // The job measured what `fathom eval` measures of its files.
    let again = json(&["eval", &out, "--data", &scene, "--allow-cpu", "--json"]);
    let of_files = again["psnr"].as_f64().expect("a number");
    assert!((of_files - psnr).abs() < 0.01, "{of_files} dB by `fathom eval`, {psnr} dB by the job");

    let shown = |name: &str, more: &[&str]| {
        let frames = under(folder.path(), name);
        succeed(&[&["render", &out, "--cameras", &scene, "--allow-cpu", "-o", &frames][..], more].concat());
        std::fs::read(Path::new(&frames).join("v0001.png")).expect("a picture")
    };
    let wet = shown("wet", &["--maps", "reflected,refracted,fresnel,mask,range"]);
    let dry = shown("dry", &["--no-surface"]);
    let oil = shown("oil", &["--ior", "1.46"]);
    assert!(wet != dry && wet != oil && dry != oil, "wet, dry and oil are different pictures");
    for map in ["reflected", "refracted", "fresnel", "mask", "range"] {
        let maps = std::fs::read_dir(folder.path().join("wet").join(map)).expect(map).count();
        assert!(maps >= 27, "{map}: {maps}");
    }
    let (_, said) = fail(&["render", &out, "--cameras", &scene, "--allow-cpu", "--ior", "0.9"]);
    assert!(said.contains("above that of air"), "{said}");
    let (_, said) = fail(&["render", &out, "--cameras", &scene, "--allow-cpu", "--white-point", "1,1,1"]);
    assert!(said.contains("add --no-surface"), "{said}");
    let model = under(folder.path(), "out/sets/refracted.ply");
    let (_, said) = fail(&["render", &model, "--cameras", &scene, "--allow-cpu", "--no-surface"]);
    assert!(said.contains("no folder `sets`"), "{said}");
}

#[test]
fn settings_of_a_water_surface_that_cannot_work_are_refused() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = pool(folder.path());
    let out = under(folder.path(), "out");
    for (set, says) in [
        ("surface.ior=0.9", "surface.ior must be above that of air"),
        ("surface.offset=0.5", "surface.offset needs surface.normal"),
        ("surface.normal=[0,0,0]", "not all 0"),
        ("surface.shares=[1,0,1]", "three numbers above 0"),
        ("surface.from=1.0", "surface.from below 1"),
        ("partition.columns=2", "trains one partition"),
        ("water.medium=per_pixel", "clear water"),
        ("train.strategy=classic", "needs train.strategy"),
        ("train.mip_filter=true", "low-pass of their own"),
    ] {
        let (_, said) = fail(&["train", &scene, "-o", &out, "--allow-cpu", "--preset", "wsgs", "--set", set]);
        assert!(said.contains(says), "{set}: {said}");
    }
    assert!(!folder.path().join("out").exists(), "a refused job left a folder");
}
