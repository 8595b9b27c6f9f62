//! Background Gaussians behind everything: sky, open water and whatever lies beyond the sparse points.
//!
//! For rays that meet no surface, 3DGS has only its background colour. Training then builds what is seen
//! there from veils between the cameras and the scene, which fit their own views and obstruct all others. A
//! shell around the scene gives these rays an end on which all views agree, like the sky spheres in street
//! models.

use std::f64::consts::PI;

use glam::DVec3;

use crate::gaussians::{Gaussians, SH_C0};
use crate::scene::Points;
use crate::views::TrainView;
use crate::water::Water;

/// Radius of the shell, relative to the distance of the farthest camera or point.
const RADIUS: f64 = 1.2;
/// Share of the points that the shell must enclose; the others are considered outliers.
const ENCLOSED: f64 = 0.99;
/// Standard deviation relative to the spacing of neighbours: with [`OPACITY`], no gap is visible.
const OVERLAP: f64 = 0.7;
/// Initial opacity of the shell.
const OPACITY: f32 = 0.99;

/// The part of a shell of `count` Gaussians around `points` and cameras that any view sees, in the mean
/// colour of the points.
///
/// Empty if there are no points to enclose or if all of them lie in one place. Also empty if a water takes
/// more than half of the light of the shell. The colour of open water then ends the rays. The J of a shell
/// would be arbitrary, and would show through every hole of the surface once the water is removed.
pub(super) fn background_gaussians(
    points: &Points,
    views: &[TrainView],
    sh_degree: u8,
    count: u32,
    water: Option<&Water>,
) -> Gaussians {
    let mut shell = Gaussians::empty(sh_degree);
    let centres: Vec<DVec3> = views.iter().map(|view| view.pose.centre()).collect();
    let middle = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let reach = reach(points, &centres, middle);
    if count == 0 || points.is_empty() || !(reach > 0.0 && reach.is_finite()) {
        return shell;
    }
    let radius = RADIUS * reach;
    if water.is_some_and(|water| water.half_distance() < radius) {
        return shell;
    }
    let deviation = OVERLAP * radius * (4.0 * PI / f64::from(count)).sqrt();
    let colour = mean_colour(points);
    for direction in directions(count) {
        let mean = middle + radius * direction;
        if !views.iter().any(|view| is_in_view(mean, 2.0 * deviation, view)) {
            continue;
        }
        shell.means.push(mean.as_vec3().to_array());
        shell.quats.push([1.0, 0.0, 0.0, 0.0]);
        shell.log_scales.push([deviation.ln() as f32; 3]);
        shell.opacity_logits.push((OPACITY / (1.0 - OPACITY)).ln());
        shell.sh_coeffs.push(colour.map(|value| (value - 0.5) / SH_C0));
        shell.sh_coeffs.extend(std::iter::repeat_n([0.0; 3], shell.coeffs() - 1));
    }
    shell
}

/// Largest distance from `middle` of a camera, or of a point except the outliers.
fn reach(points: &Points, centres: &[DVec3], middle: DVec3) -> f64 {
    let mut distances: Vec<f64> =
        points.positions.iter().map(|point| DVec3::from(point.map(f64::from)).distance(middle)).collect();
    distances.sort_unstable_by(f64::total_cmp);
    let last = (distances.len() as f64 * ENCLOSED).ceil() as usize;
    let of_points = distances.get(last.saturating_sub(1)).copied().unwrap_or(0.0);
    centres.iter().map(|centre| centre.distance(middle)).fold(of_points, f64::max)
}

fn mean_colour(points: &Points) -> [f32; 3] {
    let sums = points.colours.iter().fold([0.0; 3], |sums: [f64; 3], colour| {
        std::array::from_fn(|channel| sums[channel] + f64::from(colour[channel]) / 255.0)
    });
    sums.map(|sum| (sum / points.colours.len().max(1) as f64) as f32)
}

/// `count` directions, evenly distributed over the sphere (Fibonacci lattice).
fn directions(count: u32) -> impl Iterator<Item = DVec3> {
    let turn = PI * (3.0 - 5.0_f64.sqrt());
    (0..count).map(move |index| {
        let y = 1.0 - 2.0 * (f64::from(index) + 0.5) / f64::from(count);
        let (across, angle) = ((1.0 - y * y).sqrt(), turn * f64::from(index));
        DVec3::new(across * angle.cos(), y, across * angle.sin())
    })
}

/// Whether a ball is partly inside the image of a view.
fn is_in_view(centre: DVec3, radius: f64, view: &TrainView) -> bool {
    let camera = &view.camera;
    let p = view.pose.transform(centre);
    let (margin_x, margin_y) = (radius * camera.fx / p.z, radius * camera.fy / p.z);
    let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
    p.z > 0.0
        && (-margin_x..=f64::from(camera.width) + margin_x).contains(&x)
        && (-margin_y..=f64::from(camera.height) + margin_y).contains(&y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{PinholeCamera, Pose};

    fn looking(from: DVec3, at: DVec3) -> TrainView {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        TrainView {
            name: String::new(),
            camera,
            pose: Pose::looking_at(from, at, DVec3::Y),
            clear_range: 0.0,
        }
    }

    /// Points on a floor of 20 x 20 with one far outlier, and two views along it.
    fn scene() -> (Points, Vec<TrainView>) {
        let mut points = Points::default();
        for (x, z) in (-10..=10).flat_map(|x| (-10..=10).map(move |z| (x, z))) {
            points.positions.push([x as f32, 2.0, z as f32]);
            points.colours.push(if x > 0 { [255, 0, 51] } else { [0, 0, 51] });
        }
        points.positions[7] = [0.0, 0.0, 1e6];
        let views = vec![looking(DVec3::ZERO, DVec3::Z), looking(DVec3::X, DVec3::new(1.0, 0.5, -3.0))];
        (points, views)
    }

    #[test]
    fn every_ray_of_every_view_ends_on_the_shell() {
        let (points, views) = scene();
        let shell = background_gaussians(&points, &views, 1, 500, None);
        let deviation = f64::from(shell.log_scales[0][0].exp());
        for view in &views {
            let (camera, eye) = (&view.camera, view.pose.centre());
            for (x, y) in (0..=64).step_by(8).flat_map(|x| (0..=48).step_by(8).map(move |y| (x, y))) {
                let ray = DVec3::new(
                    (f64::from(x) - camera.cx) / camera.fx,
                    (f64::from(y) - camera.cy) / camera.fy,
                    1.0,
                );
                let ray = view.pose.rotation.inverse() * ray.normalize();
                let passed: f64 = shell.means.iter().fold(1.0, |passed, mean| {
                    let offset = DVec3::from(mean.map(f64::from)) - eye;
                    let along = offset.dot(ray);
                    let squared = (offset - along * ray).length_squared() / deviation.powi(2);
                    passed * if along > 0.0 { 1.0 - 0.99 * (-0.5 * squared).exp() } else { 1.0 }
                });
                assert!(passed < 0.03, "{passed} of the light passes at ({x}, {y})");
            }
        }
    }

    #[test]
    fn the_shell_lies_behind_the_points_but_not_behind_outliers() {
        let (points, views) = scene();
        let shell = background_gaussians(&points, &views, 0, 200, None);
        for mean in &shell.means {
            let distance = DVec3::from(mean.map(f64::from)).length();
            assert!((14.0..25.0).contains(&distance), "{distance}");
        }
    }

    #[test]
    fn under_water_half_of_the_light_of_the_shell_must_arrive() {
        let (points, views) = scene();
        let with = |blue: f64| {
            let water = Water { beta_d: [9.0, 0.5, blue], beta_b: [9.0; 3], b_inf: [0.1; 3] };
            background_gaussians(&points, &views, 0, 200, Some(&water))
        };
        // The shell is 12 to 18 units away; at 18, half is left with an attenuation of ln 2 / 18 = 0.039 per
        // unit.
        assert_eq!(with(0.02), background_gaussians(&points, &views, 0, 200, None));
        assert!(with(0.06).is_empty());
    }

    #[test]
    fn parts_of_the_shell_that_no_view_sees_are_left_out() {
        let (points, views) = scene();
        let (both, one) = (
            background_gaussians(&points, &views, 0, 500, None),
            background_gaussians(&points, &views[..1], 0, 500, None),
        );
        assert!(both.len() < 500, "{} of 500", both.len());
        assert!(one.len() < both.len());
        assert!(one.means.iter().all(|mean| mean[2] > 0.0), "the first view looks along z");
    }

    #[test]
    fn the_shell_has_the_mean_colour_and_the_configured_degree() {
        let (points, views) = scene();
        let shell = background_gaussians(&points, &views, 2, 100, None);
        assert_eq!(shell.sh_coeffs.len(), 9 * shell.len());
        let colour = shell.sh_coeffs[0].map(|value| 0.5 + SH_C0 * value);
        for (have, expected) in colour.iter().zip([10.0 / 21.0, 0.0, 0.2]) {
            assert!((have - expected).abs() < 0.01, "{colour:?}");
        }
        assert!(shell.sh_coeffs[1..9].iter().all(|value| *value == [0.0; 3]));
    }

    #[test]
    fn a_scene_in_one_place_or_without_points_has_no_shell() {
        let (points, views) = scene();
        assert!(background_gaussians(&points, &views, 0, 0, None).is_empty());
        assert!(background_gaussians(&Points::default(), &views, 0, 100, None).is_empty());
        let place = Points { positions: vec![[0.0; 3]; 5], colours: vec![[9; 3]; 5], ..Points::default() };
        assert!(background_gaussians(&place, &views[..1], 0, 100, None).is_empty());
    }
}
