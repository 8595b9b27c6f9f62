//! JSON that is sent between programs: manifests, configurations, waters, reports.

use fathom_core::config::{Composition, JobConfig, Preset};
use fathom_core::scene::{BlobRef, Camera, CameraModel, Manifest, ManifestView, Pose};
use fathom_core::seams::SeamReport;
use fathom_core::water::{Consensus, PartitionEvidence, StandardErrors, Water, WaterRecord, consensus};
use fathom_fuzz::{Target, run};

/// The water in the header of a model.
pub fn water_record() -> WaterRecord {
    let errors = StandardErrors::from_array([0.01; 9]);
    WaterRecord::new(&Water::COASTAL, Composition::PixelsSrgb, errors, "sparse", 0.5)
}

fn manifest() -> Manifest {
    let view = |name: &str, mask: bool| ManifestView {
        name: name.to_owned(),
        camera_id: 3,
        pose: Pose::from_wxyz([0.9, 0.1, -0.2, 0.3], [0.5, 2.0, -1.5]),
        image: BlobRef::of(name.as_bytes()),
        mask: mask.then(|| BlobRef::of(b"mask")),
    };
    let params = vec![50.1, 32.0, 24.0, -0.01];
    Manifest {
        format: Manifest::FORMAT,
        source: "COLMAP binary".to_owned(),
        cameras: vec![Camera { id: 3, model: CameraModel::SimpleRadial, width: 64, height: 48, params }],
        views: vec![view("a.jpg", false), view("b/c d.jpg", true)],
        points: BlobRef::of(b""),
    }
}

#[test]
fn fuzzed_manifests_are_refused_or_name_nothing_outside() {
    let read = |bytes: &[u8]| {
        let Ok(manifest) = Manifest::from_json(bytes) else { return false };
        for view in &manifest.views {
            let camera = manifest.camera(view.camera_id).unwrap();
            assert!(view.pose.is_sound() && view.pose.centre().length() < 1e13, "{view:?}");
            assert!(camera.pinhole().is_ok_and(|camera| camera.direction(0).is_finite()), "{camera:?}");
            assert_eq!(fathom_core::paths::check_inside(&view.name), Ok(()), "{view:?}");
        }
        assert_eq!(Manifest::from_json(&manifest.to_json().unwrap()).unwrap(), manifest);
        true
    };
    let words = ["../", "/", "\\\\", "\\u0000", "C:", "FULL_OPENCV", "\"mask\":null,", "OPENCV", "[[", "{"];
    run(&Target { words: &words, ..Target::new("manifest", vec![manifest().to_json().unwrap()], &read) });
}

#[test]
fn fuzzed_configurations_are_refused_or_survive_the_store() {
    let whole = |preset| serde_json::to_vec(&JobConfig::of_preset(preset)).unwrap();
    let corpus = vec![
        br#"{"preset": "paper", "train": {"iterations": 7000, "ssim_weight": 0.3}, "partition": {"columns": 2}}"#.to_vec(),
        b"{}".to_vec(),
        whole(Preset::Fathom),
        whole(Preset::Splatting),
        whole(Preset::Disks),
        whole(Preset::Surface),
    ];
    let read = |bytes: &[u8]| {
        let Ok(text) = std::str::from_utf8(bytes) else { return false };
        let Ok(config) = JobConfig::from_json(text) else { return false };
        if config.validate().is_err() {
            return false;
        }
        // The scheduler and workers read a stored job again.
        let stored = serde_json::to_string(&config).unwrap();
        assert_eq!(JobConfig::from_json(&stored).unwrap(), config);
        assert_eq!(serde_json::from_str::<JobConfig>(&stored).unwrap(), config);
        true
    };
    run(&Target::new("job configuration", corpus, &read));
}

#[test]
fn fuzzed_waters_are_read_or_refused_and_are_physical() {
    let corpus = vec![water_record().to_comment().unwrap().into_bytes()];
    let read = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes).into_owned();
        let Ok(Some(record)) = WaterRecord::among(&[text]) else { return false };
        assert!(
            record.water().is_physical() && record.usual_water().to_array().iter().all(|v| v.is_finite())
        );
        let again = WaterRecord::among(&[record.to_comment().unwrap()]).unwrap();
        assert_eq!(again, Some(record));
        true
    };
    run(&Target::new("water of a model", corpus, &read));

    let of = |partition| PartitionEvidence { partition, water: Water::COASTAL, evidence: [2.0; 9] };
    let found = consensus(&water_record(), 5.0, &[of(0), of(1), of(2)]).unwrap();
    let read = |bytes: &[u8]| {
        Consensus::from_json(bytes).inspect(|read| assert!(read.water.water().is_physical())).is_ok()
    };
    run(&Target::new("consensus", vec![serde_json::to_vec(&found).unwrap()], &read));
}

#[test]
fn fuzzed_reports_of_borders_are_read_or_refused() {
    let band = r#"{"views": 2, "psnr": 30.5, "ssim": 0.9, "flank_psnr": 31.0, "flank_ssim": null, "loss_db": 0.5,
"loss_db_error": null, "interior_psnr": 31, "interior_ssim": 0.9, "pixels": 700, "pooled_psnr": 30, "pooled_ssim": 0.9}"#;
    let steps = r#"{"pairs": 40, "median": 0.01, "beside_pairs": 41, "beside_median": 0.01, "ratio": 1.0}"#;
    let report = format!(
        r#"{{"band": 0.5, "border": {band}, "control": {band}, "interior": {{"pixels": 9, "pooled_psnr": 30,
"pooled_ssim": null}}, "seam_db": 0.1, "seam_db_error": 0.2, "seam_ssim": null, "range_step": {{"border": {steps},
"control": {steps}}}, "views": []}}"#
    );
    let read = |bytes: &[u8]| {
        let Ok(report) = serde_json::from_slice::<SeamReport>(bytes) else { return false };
        let mut metrics = serde_json::json!({});
        fathom_core::seams::put_into(&mut metrics, Some(&report));
        assert!(metrics.get("seams").is_some());
        true
    };
    run(&Target::new("report of borders", vec![report.into_bytes()], &read));
}
