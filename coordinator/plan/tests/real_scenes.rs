//! Plans of real scenes: the direction of down, the turn, the balance. The scenes lie outside the repository,
//! in `$FATHOM_SCENES`; without them each test reports that it was skipped.

#![expect(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::time::Instant;

use fathom_core::config::{DataConfig, JobConfig};
use fathom_core::scene::{Purpose, load_scene, real_scene_for_test};
use fathom_core::views::TrainView;
use fathom_plan::{Plan, PlanInput, TurnRule, UpRule, picture, plan};
use glam::DVec3;

/// Plan of a scene in a grid (or by `auto` where there is none), with its views.
fn planned(path: &Path, grid: Option<(u32, u32)>) -> (Plan, Vec<TrainView>) {
    let scene = load_scene(path, Purpose::Inspect, &DataConfig::default()).unwrap();
    let views: Vec<TrainView> = scene
        .views
        .iter()
        .map(|view| {
            let camera = scene.camera(view.camera_id).unwrap().pinhole().unwrap();
            TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 }
        })
        .collect();
    let mut config = JobConfig::default();
    match grid {
        Some((columns, rows)) => (config.partition.columns, config.partition.rows) = (columns, rows),
        None => (config.partition.auto, config.partition.workers) = (true, 6),
    }
    let begin = Instant::now();
    let plan = plan(&PlanInput { views: &views, points: &scene.points, config: &config }).unwrap();
    let seconds = begin.elapsed().as_secs_f64();
    let (alignment, balance, reason) = (plan.alignment, plan.balance, &plan.cut.reason);
    eprintln!("{}: {seconds:.2} s, {alignment:?}, {balance:?}, {reason}", path.display());
    if let Some(folder) = std::env::var_os("FATHOM_TEST_PICTURES") {
        let name = format!("{}-{}.png", path.file_stem().unwrap().to_string_lossy(), plan.partitions.len());
        let png = picture::draw(&plan, &views, &scene.points, &path.file_stem().unwrap().to_string_lossy());
        std::fs::write(Path::new(&folder).join(name), png.unwrap()).unwrap();
    }
    (plan, views)
}

/// Angle between the plan's down and another direction, degrees.
fn degrees_from(plan: &Plan, down: DVec3) -> f64 {
    DVec3::from(plan.alignment.down).angle_between(down).to_degrees()
}

/// Deviation of the cameras' right-hand axes from level, degrees: root mean square. Cameras held upright are
/// level in any direction, so this finds the vertical of an undocumented frame.
fn tilt(plan: &Plan, views: &[TrainView]) -> f64 {
    let down = DVec3::from(plan.alignment.down);
    let sines = views.iter().map(|view| (view.pose.rotation.inverse() * DVec3::X).dot(down));
    let squares: f64 = sines.map(|sine| sine.asin().to_degrees().powi(2)).sum();
    (squares / views.len() as f64).sqrt()
}

/// The whole rotation takes down to +y, and the turn is about it.
fn assert_sound(plan: &Plan, views: &[TrainView]) {
    let rotation = plan.alignment.rotation();
    assert!((rotation.length() - 1.0).abs() < 1e-12);
    assert!((rotation * DVec3::from(plan.alignment.down)).distance(DVec3::Y) < 1e-9);
    let turn = plan.alignment.turn;
    assert_eq!(turn.degrees != 0.0, turn.rule == TurnRule::CompactCells, "{turn:?}");
    assert!(turn.degrees > -45.0 && turn.degrees <= 45.0, "{turn:?}");
    for partition in &plan.partitions {
        let own = partition.base_views.iter().map(|&view| rotation * views[view as usize].pose.centre());
        // The last camera of a cell lies on its border, but for roundings; one that ties with it may belong
        // to either side.
        let tie = [DVec3::X, DVec3::Z].map(|axis| axis * 1e-9);
        let near = |centre: DVec3| {
            [centre, centre - tie[0], centre + tie[0], centre - tie[1], centre + tie[1]]
                .iter()
                .any(|&at| partition.cell.contains(at))
        };
        let inside = own.filter(|&centre| near(centre)).count();
        assert!(inside * 100 >= partition.base_views.len() * 95, "partition {}", partition.id);
    }
}

#[test]
fn surveys_in_a_frame_with_y_down_keep_it() {
    for (name, grid) in [("sesa-wreck", (2, 3)), ("auv", (4, 6))] {
        let Some(path) = real_scene_for_test(name) else { continue };
        let (plan, views) = planned(&path, Some(grid));
        assert_sound(&plan, &views);
        // Down-looking cameras whose headings alternate: their own down vectors cancel, the plane of their
        // path decides.
        assert_eq!(plan.alignment.rule, UpRule::CentrePlane, "{name}");
        assert!(degrees_from(&plan, DVec3::Y) < 3.0, "{name}: {:?}", plan.alignment);
        // The lines of sesa-wreck run along the axes, those of auv nearly so.
        assert!(plan.alignment.turn.degrees.abs() < 15.0, "{name}: {:?}", plan.alignment.turn);
        assert!(name != "sesa-wreck" || plan.alignment.turn.rule == TurnRule::SmallGain);
    }
}

#[test]
fn a_car_that_drives_forward_keeps_its_y_down() {
    let Some(path) = real_scene_for_test("kitti") else { return };
    let (plan, views) = planned(&path, Some((4, 4)));
    assert_sound(&plan, &views);
    assert_eq!(plan.alignment.rule, UpRule::MeanCameraDown);
    assert!(degrees_from(&plan, DVec3::Y) < 3.0, "{:?}", plan.alignment);
    assert!(tilt(&plan, &views) < 3.0);
}

#[test]
fn a_street_in_a_frame_with_z_up_is_cut_on_its_ground() {
    let Some(path) = real_scene_for_test("street-cameras.json") else { return };
    let (plan, views) = planned(&path, Some((3, 3)));
    assert_sound(&plan, &views);
    assert!(degrees_from(&plan, -DVec3::Z) < 5.0, "{:?}", plan.alignment);
    // It runs diagonally, by about 15 degrees.
    let turn = plan.alignment.turn;
    assert_eq!(turn.rule, TurnRule::CompactCells);
    assert!((10.0..22.0).contains(&turn.degrees), "{turn:?}");
    // A street is flat beside what it is long.
    let cameras = plan.extent.cameras;
    assert!(cameras.side(1) < 0.2 * cameras.side(0).max(cameras.side(2)), "{cameras:?}");
}

#[test]
fn frames_are_levelled_by_how_cameras_are_held() {
    for (name, grid) in [("fox", (2, 2)), ("reef-clip", (4, 1)), ("sceaux", (1, 1))] {
        let Some(path) = real_scene_for_test(name) else { continue };
        let (plan, views) = planned(&path, Some(grid));
        assert_sound(&plan, &views);
        assert_eq!(plan.alignment.rule, UpRule::MeanCameraDown, "{name}");
        assert!(tilt(&plan, &views) < 10.0, "{name}: {} degrees", tilt(&plan, &views));
    }
}

#[test]
fn a_nearly_straight_transect_lies_along_an_axis() {
    let Some(path) = real_scene_for_test("reef-clip") else { return };
    let (plan, _) = planned(&path, Some((4, 1)));
    let cameras = plan.extent.cameras;
    let (long, short) = (cameras.side(0).max(cameras.side(2)), cameras.side(0).min(cameras.side(2)));
    assert!(short < 0.3 * long, "{cameras:?}, {:?}", plan.alignment.turn);
}

#[test]
fn auto_is_balanced_and_fast_on_real_scenes() {
    for name in ["sesa-wreck", "auv", "kitti", "street-cameras.json"] {
        let Some(path) = real_scene_for_test(name) else { continue };
        let begin = Instant::now();
        let (plan, views) = planned(&path, None);
        assert_sound(&plan, &views);
        assert!(plan.partitions.len() > 1, "{name}: {}", plan.cut.reason);
        assert!(plan.balance.seconds < 2.5, "{name}: {:?}", plan.balance);
        // Reading included; a busy machine is slow, so this only catches what hangs.
        assert!(begin.elapsed().as_secs() < 120, "{name}");
    }
}
