//! Real scenes from other programs: COLMAP, 3DGS, photographs from cameras. They are not in the repository;
//! `FATHOM_SCENES` names their folder. A test whose scene is missing reports that it was skipped.

#![expect(clippy::unwrap_used, reason = "a test may panic")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use fathom_core::config::{DataConfig, MaskKeep};
use fathom_core::picture::{self, Photograph};
use fathom_core::scene::{CameraModel, Points, Purpose, Scene, load_scene, real_scene_for_test};
use fathom_core::{metrics, ply};

fn load(path: &Path, purpose: Purpose) -> Scene {
    let started = Instant::now();
    let scene = load_scene(path, purpose, &DataConfig::default()).unwrap();
    let seconds = started.elapsed().as_secs_f64();
    eprintln!(
        "{}: {}, {} cameras, {} views, {} points, extent {:.3}, viewing distance {:?}, {seconds:.3} s",
        path.display(),
        scene.source,
        scene.cameras.len(),
        scene.views.len(),
        scene.points.len(),
        scene.extent(),
        scene.viewing_distance()
    );
    for warning in &scene.warnings {
        eprintln!("  warning: {warning}");
    }
    scene
}

#[test]
fn photographs_with_their_model_are_read_for_training() {
    for (name, views, size) in [
        ("fox", 50, (270, 480)),
        ("reef-clip", 71, (720, 405)),
        ("sesa-wreck", 465, (480, 360)),
        ("sceaux", 11, (1000, 737)),
    ] {
        let Some(path) = real_scene_for_test(name) else { continue };
        let scene = load(&path, Purpose::Train);
        assert_eq!(scene.source, "COLMAP binary");
        assert_eq!(scene.views.len(), views, "{name}");
        assert_eq!(scene.warnings, Vec::<String>::new(), "{name}");
        assert!(scene.views.is_sorted_by(|a, b| a.name < b.name));
        for view in &scene.views {
            let pinhole = scene.camera(view.camera_id).unwrap().pinhole().unwrap();
            assert_eq!((pinhole.width, pinhole.height), size, "{name}");
            assert!(view.pose.is_sound());
        }
        let points = &scene.points;
        let read = Points::from_bytes(&points.to_bytes_with_places()).unwrap();
        assert!(read == *points, "{name}: points and tracks do not survive a round trip");
        let placeless = points.to_bytes();
        assert!(placeless.len() < points.to_bytes_with_places().len(), "{name}: the model has no pixels");
        assert!(Points::from_bytes(&placeless).unwrap().to_bytes() == placeless, "{name}");
        // Most points must lie in front of some camera and in its picture. An inverted pose or a swapped axis
        // would fail this.
        let cameras: Vec<_> = scene
            .views
            .iter()
            .map(|view| (view.pose, scene.camera(view.camera_id).unwrap().pinhole().unwrap()))
            .collect();
        let seen = scene.points.positions.iter().filter(|position| {
            let point = position.map(f64::from).into();
            cameras.iter().any(|(pose, camera)| {
                let at = pose.transform(point);
                let (u, v) = (at.x / at.z * camera.fx + camera.cx, at.y / at.z * camera.fy + camera.cy);
                at.z > 0.0
                    && (0.0..f64::from(camera.width)).contains(&u)
                    && (0.0..f64::from(camera.height)).contains(&v)
            })
        });
        let share = seen.count() as f64 / scene.points.len() as f64;
        assert!(share > 0.99, "{name}: only {share} of the points project into a view");
    }
}

#[test]
fn the_first_photograph_of_each_scene_is_prepared_for_training() {
    for name in ["fox", "reef-clip", "sesa-wreck", "sceaux"] {
        let Some(path) = real_scene_for_test(name) else { continue };
        let scene = load(&path, Purpose::Train);
        let view = &scene.views[0];
        let bytes = std::fs::read(view.image.as_ref().unwrap()).unwrap();
        let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
        let camera = scene.camera(view.camera_id).unwrap();
        let (full, _) = picture::prepare(&photograph, camera, MaskKeep::White, 1600).unwrap();
        let (small, image) = picture::prepare(&photograph, camera, MaskKeep::White, 240).unwrap();
        assert_eq!((full.width, full.height), (camera.width, camera.height));
        assert_eq!(small.width.max(small.height), 240);
        assert_eq!(image.pixels.len(), (small.width * small.height) as usize);
        assert_eq!(image.kept_share(), 1.0);
        // Half a photograph must be refused.
        let torn = Photograph { image: &bytes[..bytes.len() / 2], ..photograph };
        let message = picture::prepare(&torn, camera, MaskKeep::White, 240).unwrap_err().to_string();
        assert!(message.contains(&view.name) && message.contains("truncated"), "{message}");
    }
}

#[test]
fn binary_and_text_models_of_one_scene_have_the_same_poses() {
    let Some(path) = real_scene_for_test("sceaux") else { return };
    let binary = load(&path, Purpose::Inspect);
    // The text model belongs to the photographs before undistortion. Its only camera is larger and has radial
    // distortion; its poses are the same with six digits.
    let text = load(&path.join("text_model"), Purpose::Inspect);
    assert_eq!((binary.source, text.source), ("COLMAP binary", "COLMAP text"));
    assert_eq!(text.cameras.len(), 1);
    assert_eq!(text.cameras[0].model, CameraModel::SimpleRadial);
    assert_eq!(text.cameras[0].params, [2971.71, 1416.0, 1064.0, -0.164_224]);
    assert_eq!(binary.views.len(), text.views.len());
    for (a, b) in binary.views.iter().zip(&text.views) {
        assert_eq!(a.name, b.name);
        assert!(a.image.is_some() && a.image == b.image, "{}", a.name);
        let turned = a.pose.rotation.angle_between(b.pose.rotation);
        assert!(turned < 1e-5, "{}: rotated by {turned}", a.name);
        let moved = a.pose.centre().distance(b.pose.centre());
        assert!(moved < 1e-4, "{}: moved by {moved}", a.name);
    }
    // Training is refused when pictures and cameras differ in size.
    let error = load_scene(&path.join("text_model"), Purpose::Train, &DataConfig::default()).unwrap_err();
    assert!(error.to_string().contains("1000x737, but its camera is 2832x2128"), "{error}");
}

#[test]
fn a_text_model_with_a_camera_for_each_image_is_read() {
    let Some(path) = real_scene_for_test("sceaux") else { return };
    let scene = load(&path.join("text_model_per_image_cameras"), Purpose::Inspect);
    assert_eq!(scene.cameras.len(), 11);
    assert_eq!(scene.views.len(), 11);
    let ids: std::collections::BTreeSet<u32> = scene.views.iter().map(|view| view.camera_id).collect();
    assert_eq!(ids.len(), 11);
    // Another reconstruction of the same photographs: its poses differ from the other models, but its shape
    // is the same. Distances between camera centres agree up to one scale.
    let other = load(&path, Purpose::Inspect);
    let centres = |scene: &Scene| -> BTreeMap<String, glam::DVec3> {
        scene.views.iter().map(|view| (view.name.clone(), view.pose.centre())).collect()
    };
    let (a, b) = (centres(&scene), centres(&other));
    let mut ratios = Vec::new();
    for (name, centre) in &a {
        for (second, second_centre) in a.range::<String, _>(name.clone()..).skip(1) {
            ratios.push(centre.distance(*second_centre) / b[name].distance(b[second]));
        }
    }
    ratios.sort_by(f64::total_cmp);
    let (least, greatest) = (ratios[0], ratios[ratios.len() - 1]);
    assert!(greatest / least < 1.25, "distances scale by {least} to {greatest}");
}

#[test]
fn thousands_of_poses_are_inspected_in_under_a_second() {
    for (name, views, points) in
        [("auv", 4736, true), ("kitti", 4541, false), ("street-cameras.json", 1499, false)]
    {
        let Some(path) = real_scene_for_test(name) else { continue };
        let started = Instant::now();
        let scene = load(&path, Purpose::Inspect);
        let seconds = started.elapsed().as_secs_f64();
        assert_eq!(scene.views.len(), views);
        assert_eq!(!scene.points.is_empty(), points);
        assert!(scene.views.iter().all(|view| view.image.is_none()));
        assert!(scene.warnings.iter().any(|warning| warning.contains("do not exist")));
        // Measured at 0.013 s for auv on two cores; the bound leaves room for a busy machine.
        assert!(seconds < 1.0, "{name} took {seconds} s");
        let error = load_scene(&path, Purpose::Train, &DataConfig::default()).unwrap_err().to_string();
        assert!(error.contains("images") || error.contains("cameras.json"), "{error}");
    }
}

#[test]
fn a_model_by_another_program_survives_a_round_trip() {
    let Some(path) = real_scene_for_test("splats/kacytran_iteration7000.ply") else { return };
    let model = ply::read_model(&path).unwrap();
    assert_eq!((model.len(), model.sh_degree), (9080, 3));
    let written = ply::to_bytes(&model, &[]).unwrap();
    assert_eq!(written.len() as u64, std::fs::metadata(&path).unwrap().len());
    // Only quaternions may change: they are normalised.
    let again = ply::from_bytes(&written, "written").unwrap();
    assert_eq!(again.means, model.means);
    assert_eq!(again.sh_coeffs, model.sh_coeffs);
    assert_eq!(again.opacity_logits, model.opacity_logits);
    assert_eq!(again.log_scales, model.log_scales);
    for (index, (new, old)) in again.quats.iter().zip(&model.quats).enumerate() {
        let norm = old.iter().map(|value| value * value).sum::<f32>().sqrt();
        let worst = (0..4).map(|i| (new[i] * norm - old[i]).abs()).fold(0.0, f32::max);
        assert!(worst <= 1e-6 * norm, "quaternion {index}: {new:?} for {old:?}");
    }
    // Row by row, the bytes equal those of the file.
    let bytes = std::fs::read(&path).unwrap();
    let mut reader = ply::SplatReader::open(&path).unwrap();
    let (row_bytes, mut rows) = (reader.layout().row_bytes(), 0);
    let body = bytes.len() - 9080 * row_bytes;
    while let Some(row) = reader.next_row().unwrap() {
        let start = body + row.index as usize * row_bytes;
        assert_eq!(row.bytes, &bytes[start..start + row_bytes]);
        assert_eq!(row.position, model.means[row.index as usize]);
        rows += 1;
    }
    assert_eq!(rows, 9080);
}

#[test]
fn the_baselines_on_the_wreck_have_their_known_psnr() {
    let Some(path) = real_scene_for_test("sesa-wreck") else { return };
    let scene = load(&path, Purpose::Train);
    let (mut flat, mut blurred, mut count) = (0.0, 0.0, 0.0);
    for view in scene.views.iter().step_by(8) {
        let bytes = std::fs::read(view.image.as_ref().unwrap()).unwrap();
        let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
        let camera = scene.camera(view.camera_id).unwrap();
        let (_, truth) = picture::prepare(&photograph, camera, MaskKeep::White, 1600).unwrap();
        flat += metrics::psnr(&metrics::flat_colour(&truth), &truth);
        blurred += metrics::psnr(&metrics::blurred(&truth), &truth);
        count += 1.0;
    }
    let (flat, blurred) = (flat / count, blurred / count);
    eprintln!("flat colour {flat:.2} dB, blur {blurred:.2} dB over {count} held-out views");
    // scipy.ndimage.gaussian_filter(sigma=15), which mirrors at the borders, gives 28.61 and 35.76 dB.
    assert!((flat - 28.61).abs() < 0.02, "{flat}");
    assert!((blurred - 35.8).abs() < 0.2, "{blurred}");
}
