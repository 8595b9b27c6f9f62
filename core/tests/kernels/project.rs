//! Splats: which Gaussians are visible, and every number of their records.

use fathom_core::scene::PinholeCamera;
use fathom_twins::{BLUR, Gaussians64, NEAR, Splat, min_sigma_in_rect, project_forward, samples};

use crate::bounds::EPSILON;
use crate::device::device;
use crate::view::{Scene, View, hard_scenes};

/// Condition number of the covariance, or slightly more: trace^2 / determinant of the conic.
fn condition(splat: &Splat) -> f64 {
    let [a, b, c] = splat.conic;
    (a + c).powi(2) / (a * c - b * b)
}

/// Compares the kernel's splats with the twin's. Returns the number of compared splats and of decisions
/// within rounding.
#[track_caller]
fn check(view: &View) -> (usize, usize) {
    let scene = &view.scene;
    let (camera, pose) = (&scene.camera, &scene.pose);
    let model = view.drawn();
    let twin = project_forward(&model, camera, pose, scene.sh_degree, &scene.rules());
    // From the centre of the first pixel to that of the last; tiles at the border reach further.
    let last = [f64::from(camera.width) - 0.5, f64::from(camera.height) - 0.5];
    let reaches = |splat: &Splat| min_sigma_in_rect(splat, [0.5; 2], last) <= splat.extent;
    let kernel = view.splats();
    let (mut compared, mut close) = (0, 0);
    for (id, (kernel, twin)) in kernel.iter().zip(&twin).enumerate() {
        match (kernel, twin) {
            (Some(kernel), Some(twin)) => {
                compare(scene, camera, &model, id, kernel, twin);
                compared += 1;
            }
            // The kernel culls splats that cannot reach the picture; the twin leaves that to `intersect`.
            (None, Some(twin)) => {
                assert!(!reaches(twin), "{}: Gaussian {id} must be seen: {twin:?}", scene.name)
            }
            (Some(kernel), None) => {
                // 1e-6: z and the opacity are sums and exponentials of numbers of order 1 in f32.
                let edge = (kernel.depth - NEAR).abs() < 1e-6 || kernel.extent.abs() < 1e-5;
                assert!(edge, "{}: Gaussian {id} must be culled: {kernel:?}", scene.name);
                close += 1;
            }
            (None, None) => {}
        }
    }
    (compared, close)
}

fn compare(
    scene: &Scene,
    camera: &PinholeCamera,
    model: &Gaussians64,
    id: usize,
    kernel: &Splat,
    twin: &Splat,
) {
    // Each coordinate in the camera's frame takes four products and sums.
    let size = model.means[id].iter().map(|v| v.abs()).sum::<f64>() + scene.pose.translation.length();
    let position = 4.0 * EPSILON * size;
    // Relative error of anything divided by z.
    let over_z = position / twin.depth + 4.0 * EPSILON;
    let ratio = 1.0 + twin.range / twin.depth;
    let focal = [camera.fx, camera.fy];
    let mean2d = |k: usize| focal[k] * ratio * over_z + 4.0 * EPSILON * twin.mean2d[k].abs();
    let mut opacity = (8.0 + model.opacity_logits[id].abs()) * EPSILON;
    if scene.mip_filter {
        // Errors of the determinant of the covariance and of the area |a_x x a_y|, whose two vectors may be
        // nearly parallel.
        let [a, b, c] = twin.conic;
        let determinant = a * c - b * b;
        let bare = [c / determinant - BLUR, a / determinant - BLUR].map(f64::sqrt);
        let full = 1.0 / (1.0 + (-model.opacity_logits[id]).exp());
        let area = bare[0] * bare[1] * determinant.sqrt() * full / twin.opacity;
        opacity += (1.0 + area) * (8.0 * EPSILON + 4.0 * ratio * over_z) + condition(twin) * 8.0 * EPSILON;
    }
    let largest = twin.conic.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let conic = condition(twin) * largest * (32.0 * EPSILON + 8.0 * ratio * over_z);
    let k = model.coeffs();
    let coefficients: f64 = model.sh_coeffs[id * k..(id + 1) * k].iter().flatten().map(|v| v.abs()).sum();
    // Basis functions are below 3 and their derivatives below 12; the direction has the error of the
    // position.
    let rgb = (0.5 + 3.0 * coefficients) * 16.0 * EPSILON + 12.0 * coefficients * (over_z + 4.0 * EPSILON);
    let numbers = [
        ("mean2d.x", kernel.mean2d[0], twin.mean2d[0], mean2d(0)),
        ("mean2d.y", kernel.mean2d[1], twin.mean2d[1], mean2d(1)),
        ("conic a", kernel.conic[0], twin.conic[0], conic),
        ("conic b", kernel.conic[1], twin.conic[1], conic),
        ("conic c", kernel.conic[2], twin.conic[2], conic),
        ("opacity", kernel.opacity, twin.opacity, opacity * twin.opacity),
        ("extent", kernel.extent, twin.extent, opacity + 8.0 * EPSILON * (1.0 + twin.extent)),
        ("range", kernel.range, twin.range, 2.0 * position + 4.0 * EPSILON * twin.range),
        ("red", kernel.rgb[0], twin.rgb[0], rgb),
        ("green", kernel.rgb[1], twin.rgb[1], rgb),
        ("blue", kernel.rgb[2], twin.rgb[2], rgb),
    ];
    for (name, kernel, twin, tolerance) in numbers {
        assert!(
            (kernel - twin).abs() <= tolerance,
            "{}: {name} of Gaussian {id}: kernel {kernel}, twin {twin}, difference {:e}, tolerance {tolerance:e}",
            scene.name,
            (kernel - twin).abs()
        );
    }
}

#[test]
fn splats_of_hard_scenes_match_the_twin() {
    let Some(gpu) = device() else { return };
    for scene in hard_scenes(101, 1000, 3) {
        let (compared, close) = check(&View::render(&gpu, &scene));
        assert!(compared > 100, "{}: {compared} compared", scene.name);
        assert!(close <= 2, "{}: {close} decisions within rounding", scene.name);
    }
}

#[test]
fn splats_under_the_mip_filter_match_the_twin() {
    let Some(gpu) = device() else { return };
    // The corner of a larger picture. Only their smoothing makes many of the Gaussians around it visible.
    let mut corner = Scene::new("corner", samples::random(106, 2000, 0), 25, 17);
    corner.model.log_scales.fill([-2.5; 3]);
    corner.model.opacity_logits.fill(4.0);
    corner.camera = PinholeCamera { cx: 40.0, cy: 30.0, fx: 60.0, fy: 60.0, ..corner.camera };
    for scene in hard_scenes(105, 1000, 0).into_iter().chain([corner]) {
        let (compared, close) = check(&View::render(&gpu, &scene.clone().filtered()));
        assert!(compared > 40, "{}: {compared} compared", scene.name);
        assert!(close <= 2, "{}: {close} decisions within rounding", scene.name);
        let smooth = View::render_smoothed(&gpu, &scene);
        assert!(smooth.smoothing().iter().filter(|&&width| width > 0.0).count() > 90);
        let (compared, close) = check(&smooth);
        assert!(compared > 40, "{}, smoothed: {compared} compared", scene.name);
        assert!(close <= 2, "{}, smoothed: {close} decisions within rounding", scene.name);
    }
}

#[test]
fn every_degree_of_every_model_has_the_colours_of_the_twin() {
    let Some(gpu) = device() else { return };
    for stored in 0..=3 {
        for used in 0..=stored {
            let mut scene =
                Scene::new(&format!("degree {used} of {stored}"), samples::random(102, 200, stored), 75, 53);
            scene.sh_degree = used;
            let (compared, _) = check(&View::render(&gpu, &scene));
            assert!(compared > 150, "{compared} compared");
        }
    }
}

#[test]
fn far_off_centre_cameras_see_the_same_as_the_twin() {
    let Some(gpu) = device() else { return };
    // Principal points outside the picture, long and short lenses, thin pictures.
    for (width, height, cx, cy, focal) in [
        (75, 53, -40.0, 20.0, 90.0),
        (75, 53, 37.0, 110.0, 60.0),
        (60, 60, 30.0, 30.0, 8.0),
        (128, 5, 64.0, 2.5, 400.0),
    ] {
        let mut scene =
            Scene::new(&format!("principal point {cx}, {cy}"), samples::random(103, 600, 1), width, height);
        scene.camera = PinholeCamera { width, height, fx: focal, fy: 1.1 * focal, cx, cy };
        let (compared, _) = check(&View::render(&gpu, &scene));
        assert!(compared > 10, "{}: {compared} compared", scene.name);
    }
}

#[test]
fn a_camera_among_the_gaussians_sees_those_in_front() {
    let Some(gpu) = device() else { return };
    let mut scene = Scene::new("inside", samples::random(104, 600, 1), 75, 53);
    (scene.camera, scene.pose) = samples::off_centre_view(75, 53, 0.1);
    // Keep away from NEAR: closer than 0.1, splats have any size and condition number.
    let keep = |mean: &[f32; 3]| scene.pose.transform(mean.map(f64::from).into()).z.abs() > 0.1;
    let (model, _) = scene.model.split_by(|mean| keep(&mean));
    let behind =
        model.means.iter().filter(|mean| scene.pose.transform(mean.map(f64::from).into()).z < 0.0).count();
    scene.model = model;
    let (compared, _) = check(&View::render(&gpu, &scene));
    assert!(behind > 100 && compared > 50, "{behind} behind, {compared} compared");
}
