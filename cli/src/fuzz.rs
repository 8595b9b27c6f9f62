//! Fuzzes the files that the command line reads itself: settings, and result folders that others may have
//! made. `fathom_fuzz` documents how to run it, for how long, and how to replay a finding.

use std::path::Path;

use fathom_core::config::JobConfig;
use fathom_fuzz::{Folder, Target, run};

use crate::config_args::JobArgs;
use crate::download::safe_path;
use crate::eval_summary::summary;
use crate::{model, output};

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;

#[test]
fn fuzzed_settings_are_taken_or_refused() {
    let folder = Folder::new("settings");
    let take = |args: &JobArgs| {
        let Ok(config) = args.resolve() else { return false };
        let sent = serde_json::to_string(&config).unwrap();
        assert_eq!(JobConfig::from_json(&sent).unwrap(), config, "what the coordinator reads");
        true
    };
    let read =
        |bytes: &[u8]| take(&JobArgs { config: Some(folder.put("job.toml", bytes)), ..JobArgs::default() });
    let words = [
        "inf",
        "nan",
        "[water]\n",
        "[[train]]\n",
        "\"\"\"",
        "train.iterations = 5\n",
        "preset = \"paper\"\n",
    ];
    let corpus = vec![
        b"preset = \"paper\"\n[train]\niterations = 7000\nssim_weight = 0.3\n[partition]\ncolumns = 2\n"
            .to_vec(),
        b"[water]\npartitions = \"joint\"\n[train.classic]\ngradient = 2e-4\n[data]\nmask_keep = \"black\"\n"
            .to_vec(),
    ];
    run(&Target { words: &words, ..Target::new("job configuration, TOML", corpus, &read) });

    let read = |bytes: &[u8]| {
        let set = vec![String::from_utf8_lossy(bytes).into_owned()];
        take(&JobArgs { set, ..JobArgs::default() })
    };
    let corpus = [
        "train.ssim_weight=0.3",
        "data.mask_keep=black",
        "train.classic.gradient=2e-4",
        "train.sh_degree_at=[0.1, 0.2, 0.3]",
    ];
    let corpus = corpus.map(|setting| setting.as_bytes().to_vec()).to_vec();
    run(&Target::new("--set", corpus, &read));
}

#[test]
fn fuzzed_files_of_a_result_are_read_or_refused() {
    let folder = Folder::new("result");
    let model = folder.path().join("model.ply");
    let read = |bytes: &[u8]| {
        folder.put("plan.json", bytes);
        model::alignment(&model).is_ok_and(|rotation| rotation.is_normalized())
    };
    let plan =
        br#"{"format": 4, "alignment": {"rule": "world_y", "world_to_aligned_quat_wxyz": [0.8, 0, 0.6, 0]}}"#;
    run(&Target::new("alignment of plan.json", vec![plan.to_vec()], &read));

    let read = |bytes: &[u8]| {
        folder.put("run.json", bytes);
        model::data_config(folder.path()).is_ok_and(|config| config.is_some())
    };
    let config =
        br#"{"version": "0.1", "config": {"data": {"max_resolution": 800, "test_every": 4}, "train": {}}}"#;
    run(&Target::new("run.json", vec![config.to_vec()], &read));

    let read = |bytes: &[u8]| {
        let Ok(metrics) = output::read_json(&folder.put("metrics.json", bytes)) else { return false };
        !summary(&metrics).is_empty()
    };
    let metrics = br#"{"psnr": 30.5, "ssim": 0.9, "lpips": null, "views": [{"name": "a.jpg", "psnr": 30, "ssim": null}],
"gaussians": 1000, "water": {"beta_d": [0.1, 0.2, 0.3], "beta_b": [1, 2, 3], "b_inf": [0, 0.1, 1], "medium": "per_pixel",
"standard_error": {"beta_d": [null, 0.1, 0.1]}}, "seams": {"border": {"psnr": 29.5}, "seam_db": 0.1}}"#;
    run(&Target::new("metrics.json", vec![metrics.to_vec()], &read));
}

#[test]
fn fuzzed_paths_of_a_coordinator_stay_in_their_folder() {
    let out = Path::new("out");
    let read = |bytes: &[u8]| {
        let Ok(path) = safe_path(out, &String::from_utf8_lossy(bytes)) else { return false };
        assert!(path.starts_with(out) && path.components().all(|part| part.as_os_str() != ".."), "{path:?}");
        true
    };
    let words = ["..", "../", "/", "\\", "C:", "\0", "//", "./"];
    let corpus = ["model.ply", "renders/0001_a b.png"].map(|path| path.as_bytes().to_vec()).to_vec();
    run(&Target { words: &words, ..Target::new("path of a file", corpus, &read) });
}
