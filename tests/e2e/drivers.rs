//! A short training on SwiftShader, Google's Vulkan driver for CPUs: another compiler and another memory
//! model than Mesa's. `scripts/drivers.sh fetch` provides it, as `make test` does; `make drivers` tests far
//! more.

use std::path::{Path, PathBuf};
use std::process::Stdio;

use crate::processes::{Watchdog, can_train, fathom, json, succeed, tiny_scene, under};

/// SwiftShader's description for the Vulkan loader: of the system, or unpacked beside the program.
fn swiftshader() -> Option<PathBuf> {
    let target = Path::new(env!("CARGO_BIN_EXE_fathom")).ancestors().nth(2)?;
    let inside = "usr/lib/chromium/vk_swiftshader_icd.json";
    [Path::new("/").join(inside), target.join("drivers").join(inside)].into_iter().find(|icd| icd.is_file())
}

#[test]
fn swiftshader_trains_to_the_same_quality_and_repeats_its_bytes() {
    let test = "swiftshader_trains_to_the_same_quality_and_repeats_its_bytes";
    if !can_train(test) {
        return;
    }
    let Some(icd) = swiftshader() else {
        eprintln!("{test}: skipped, since SwiftShader is not here; scripts/drivers.sh fetch provides it");
        return;
    };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = tiny_scene(folder.path());
    let settings = ["--allow-cpu", "--iterations", "150", "--max-gaussians", "3000", "--seed", "3"];
    let mesa = under(folder.path(), "mesa");
    succeed(&[&["train", &scene, "-o", &mesa][..], &settings].concat());
    let trained = |name: &str| {
        let out = under(folder.path(), name);
        let child = fathom(&[&["train", &scene, "-o", &out][..], &settings].concat())
            .env("VK_DRIVER_FILES", &icd)
            .env("VK_ICD_FILENAMES", &icd)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the binary starts");
        let _watchdog = Watchdog::over(&child);
        let output = child.wait_with_output().expect("its output");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        out
    };
    let (one, again) = (trained("one"), trained("again"));
    let metrics = json(&["eval", &one, "--json"]);
    assert!(metrics["adapter"].as_str().is_some_and(|name| name.contains("SwiftShader")), "{metrics:#}");
    let model = |out: &str| std::fs::read(Path::new(out).join("model.ply")).expect("a model");
    assert!(model(&one) == model(&again), "two runs on one driver differ");
    let psnr = |metrics: &serde_json::Value| metrics["psnr"].as_f64().expect("a number");
    let (here, there) = (psnr(&metrics), psnr(&json(&["eval", &mesa, "--json"])));
    println!("PSNR {here:.2} dB on SwiftShader, {there:.2} dB on Mesa");
    assert!((here - there).abs() < 0.5, "{here} dB on SwiftShader, {there} dB on Mesa");
}
