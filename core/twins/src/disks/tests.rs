//! Disks against a renderer without tiles, and their gradients against central differences.

use super::*;
use crate::finite_differences::{assert_close, derivative};
use crate::intersect;
use crate::samples::{all, degenerate, off_centre_view, random};
use fathom_core::rng::{Stream, uniform_at};

const WIDTH: u32 = 37;
const HEIGHT: u32 = 21;
const BACKGROUND: [f64; 3] = [0.2, 0.7, 0.4];

struct Rendered {
    disks: Vec<Option<Disk>>,
    lists: TileLists,
    rays: Vec<DiskRay>,
    forward: DiskRaster,
}

fn render(model: &Gaussians64, camera: &PinholeCamera, pose: &Pose, rules: &RasterRules) -> Rendered {
    let disks = project_disks(model, camera, pose, model.sh_degree, rules);
    let lists = intersect(&bounds_of(&disks), camera.width, camera.height);
    let rays = pinhole_rays(camera);
    let size = [camera.width, camera.height];
    let forward = trace_forward(&disks, &lists, &rays, size, BACKGROUND, rules);
    Rendered { disks, lists, rays, forward }
}

/// Colour, alpha and range of a pixel from the definition: disks in the world, met by a ray in the world.
fn brute_force(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    [x, y]: [u32; 2],
    rules: &RasterRules,
) -> (DVec3, f64, f64) {
    let eye = pose.centre();
    let mut order: Vec<(f64, usize)> =
        (0..model.len()).map(|i| (pose.transform(model.means[i].into()).z, i)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let pixel = DVec2::from(pixel_at(x, y));
    let in_camera = DVec3::new((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy, 1.0);
    let ray = pose.rotation.inverse() * in_camera.normalize();
    let (mut rgb, mut range, mut left) = (DVec3::ZERO, 0.0, 1.0);
    for (depth, i) in order.into_iter().filter(|(depth, _)| *depth > NEAR) {
        let [w, qx, qy, qz] = model.quats[i];
        let turn = glam::DQuat::from_xyzw(qx, qy, qz, w).normalize();
        let mean = DVec3::from(model.means[i]);
        let normal = turn * DVec3::Z;
        let distance = normal.dot(mean - eye) / normal.dot(ray);
        let local = turn.inverse() * (eye + distance * ray - mean);
        let [su, sv, _] = model.log_scales[i].map(f64::exp);
        let solid = (local.x / su).powi(2) + (local.y / sv).powi(2);
        let m = pose.transform(mean);
        let centre = DVec2::new(camera.cx + camera.fx * m.x / depth, camera.cy + camera.fy * m.y / depth);
        let thin = (centre - pixel).length_squared() / DISK_BLUR;
        let is_hit = distance * in_camera.z / in_camera.length() > NEAR && solid <= thin;
        let opacity = 0.5 * (0.5 * model.opacity_logits[i]).tanh() + 0.5;
        let alpha = (opacity * (-0.5 * if is_hit { solid } else { thin }).exp()).min(rules.max_alpha);
        if alpha < rules.min_alpha {
            continue;
        }
        if left * (1.0 - alpha) < rules.min_transmittance {
            break;
        }
        let colour = sh_colour((mean - eye).normalize(), active_coeffs(model, i, model.sh_degree));
        rgb += left * alpha * DVec3::from(colour);
        range += left * alpha * if is_hit { distance } else { (mean - eye).length() };
        left *= 1.0 - alpha;
    }
    (rgb + left * DVec3::from(BACKGROUND), 1.0 - left, range)
}

/// Disks around the camera that reach behind it.
fn around_the_camera(pose: &Pose) -> Gaussians64 {
    let mut model = Gaussians64::from(&random(73, 80, 0));
    for (i, (mean, scales)) in (0..).zip(model.means.iter_mut().zip(&mut model.log_scales)) {
        let u = |k| f64::from(uniform_at(33, Stream::Test, i, k));
        let at = DVec3::new(8.0 * (u(0) - 0.5), 8.0 * (u(1) - 0.5), 0.05 + u(2)) - pose.translation;
        *mean = (pose.rotation.inverse() * at).into();
        *scales = [u(3) - 1.0, u(4) - 1.0, 0.0];
    }
    model
}

#[test]
fn a_disk_beside_the_camera_is_in_no_tile_but_its_centres() {
    let (camera, pose) = off_centre_view(75, 53, 3.0);
    let model = around_the_camera(&pose);
    let Rendered { disks, lists, .. } = render(&model, &camera, &pose, &RasterRules::HARD);
    let tiles = lists.tiles_per_gaussian(model.len());
    let centred = |disk: &Disk| disk.bound.mean2d == disk.centre2d;
    let beside = disks.iter().zip(&tiles).filter(|(disk, _)| disk.as_ref().is_some_and(centred)).count();
    let all = tiles.iter().filter(|&&count| count as usize == lists.ranges.len()).count();
    assert!(beside > 20 && all > 5, "{beside} beside the image, {all} in all tiles");
    assert!(tiles.iter().zip(&disks).all(|(&count, disk)| count < 2 || !disk.as_ref().is_some_and(centred)));
}

#[test]
fn tiles_of_disks_lose_nothing() {
    for (width, height) in [(75, 53), (17, 1), (1, 33)] {
        let (camera, pose) = off_centre_view(width, height, 3.0);
        for (name, model) in all(71, 60, 2).into_iter().chain([("around", around_the_camera(&pose))]) {
            let rules = RasterRules::HARD;
            let Rendered { forward, .. } = render(&model, &camera, &pose, &rules);
            for i in 0..width * height {
                let (rgb, alpha, range) = brute_force(&model, &camera, &pose, [i % width, i / width], &rules);
                let raster = &forward.raster;
                let i = i as usize;
                let close = |a: f64, b: f64| (a - b).abs() < 1e-8;
                assert!(
                    (0..3).all(|c| close(raster.rgb[i][c], rgb[c]))
                        && close(raster.alpha[i], alpha)
                        && close(raster.range[i], range),
                    "{name}, pixel {i} of {width}x{height}: {:?} {} {} against {rgb} {alpha} {range}",
                    raster.rgb[i],
                    raster.alpha[i],
                    raster.range[i],
                );
            }
        }
    }
}

/// One weight for each number of the pictures.
fn weights() -> DiskRasterGradients {
    let pixels = 0..WIDTH * HEIGHT;
    let u = |i, j| 2.0 * f64::from(uniform_at(31, Stream::Test, i, j)) - 1.0;
    DiskRasterGradients {
        raster: RasterGradients {
            rgb: pixels.clone().map(|i| [u(i, 0), u(i, 1), u(i, 2)]).collect(),
            alpha: pixels.clone().map(|i| u(i, 3)).collect(),
            range: pixels.clone().map(|i| u(i, 4)).collect(),
        },
        normal: pixels.clone().map(|i| [u(i, 5), u(i, 6), u(i, 7)]).collect(),
        mask: pixels.map(|i| u(i, 8)).collect(),
    }
}

fn weighted(forward: &DiskRaster, v: &DiskRasterGradients) -> f64 {
    let sum = |a: &[[f64; 3]], b: &[[f64; 3]]| {
        a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| a * b).sum::<f64>()
    };
    let raster = &forward.raster;
    let plain = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    sum(&raster.rgb, &v.raster.rgb)
        + sum(&forward.normal, &v.normal)
        + plain(&forward.mask, &v.mask)
        + plain(&raster.alpha, &v.raster.alpha)
        + plain(&raster.range, &v.raster.range)
}

/// Compares every gradient with its central difference. Left out are pixels where a step changes which of the
/// two terms of sigma decides: the picture has a kink there, and its range a jump.
fn check(name: &str, model: &Gaussians64) -> usize {
    let (camera, pose) = off_centre_view(WIDTH, HEIGHT, 3.0);
    let rules = RasterRules::SMOOTH;
    let Rendered { disks, lists, rays, forward } = render(model, &camera, &pose, &rules);
    let mut v = weights();
    let mut kept = 0;
    for (pixel, ray) in rays.iter().enumerate() {
        let (x, y) = (pixel as u32 % WIDTH, pixel as u32 / WIDTH);
        let near_the_kink = disks.iter().flatten().any(|disk| {
            let [a_u, a_v] = disk.axes;
            let normal = a_u.cross(a_v);
            let t = normal.dot(disk.centre) / normal.dot(ray.direction);
            let p = t * ray.direction - disk.centre;
            let solid = a_u.dot(p).powi(2) + a_v.dot(p).powi(2);
            let delta = DVec2::from(disk.centre2d) - DVec2::from(pixel_at(x, y));
            let thin = delta.length_squared() / DISK_BLUR;
            t < 0.1 || (solid - thin).abs() < 0.1 * thin.max(0.1)
        });
        if near_the_kink {
            (v.raster.rgb[pixel], v.normal[pixel]) = ([0.0; 3], [0.0; 3]);
            (v.raster.alpha[pixel], v.raster.range[pixel], v.mask[pixel]) = (0.0, 0.0, 0.0);
        } else {
            kept += 1;
        }
    }
    let v_disks = trace_backward(&disks, &lists, &rays, &camera, &forward, BACKGROUND, &rules, &v);
    let analytic = project_disks_backward(model, &camera, &pose, model.sh_degree, &disks, &v_disks);
    for id in 0..model.len() {
        for parameter in 0..model.parameters() {
            let numeric = derivative(|h| {
                let mut moved = model.clone();
                *moved.parameter_mut(id, parameter) += 0.1 * h;
                weighted(&render(&moved, &camera, &pose, &rules).forward, &v)
            }) / 0.1;
            let what = format!("{name}, {} of Gaussian {id}", Gaussians64::parameter_name(parameter));
            assert_close(&what, analytic.parameter(id, parameter), numeric, 10.0);
        }
    }
    kept
}

#[test]
fn gradients_of_disks_are_central_differences() {
    for sh_degree in [0, 2] {
        let model = Gaussians64::from(&crate::samples::random(72 + u32::from(sh_degree), 4, sh_degree));
        let kept = check("random", &model);
        assert!(kept > 150, "{kept} pixels without a kink");
    }
}

#[test]
fn gradients_of_disks_thinner_than_a_pixel_are_too() {
    let mut model = Gaussians64::from(&crate::samples::random(73, 6, 1));
    model.log_scales.iter_mut().for_each(|scales| *scales = [-8.0, -9.0, scales[2]]);
    let kept = check("specks", &model);
    assert!(kept > 300, "{kept} pixels without a kink");
}

#[test]
fn a_disk_that_must_not_be_drawn_is_culled() {
    let (camera, pose) = off_centre_view(75, 53, 3.0);
    let (model, names) = degenerate(2);
    let disks = project_disks(&Gaussians64::from(&model), &camera, &pose, 2, &RasterRules::HARD);
    for (disk, name) in disks.iter().zip(&names) {
        assert_eq!(*disk, None, "{name}");
    }
}

#[test]
fn a_disk_seen_from_its_edge_leaves_a_line() {
    let camera = PinholeCamera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
    let pose = Pose::looking_at(DVec3::new(0.0, 0.0, -2.0), DVec3::ZERO, DVec3::Y);
    let mut model = Gaussians64::zeros(1, 0);
    // Its normal is y: the camera lies in its plane.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    model.quats[0] = [half, half, 0.0, 0.0];
    model.log_scales[0] = [-2.0, -2.0, 0.0];
    model.opacity_logits[0] = 4.0;
    let Rendered { forward, .. } = render(&model, &camera, &pose, &RasterRules::HARD);
    let seen = |x: usize, y: usize| forward.raster.alpha[y * 40 + x];
    assert!(seen(20, 15) > 0.25 && seen(19, 14) > 0.25, "{} {}", seen(20, 15), seen(19, 14));
    // Beyond the low-pass of the centre nothing is left of it.
    assert!(seen(20, 19) == 0.0 && seen(26, 15) == 0.0);
    assert!(forward.raster.rgb.iter().flatten().all(|value| value.is_finite()));
}
