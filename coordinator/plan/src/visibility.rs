//! The share of an image that a box covers: rho of SMP-UWGS eq. 3, exactly.
//!
//! The box is a convex polyhedron. Its visible part is the convex hull of its projected corners, after the
//! part behind the camera is cut away. Dropping the corners behind, instead of cutting, loses a tenth of the
//! area of boxes that straddle the camera plane: those that contain the camera. Hull and image are convex, so
//! a polygon clip gives their common area.

use fathom_core::scene::{PinholeCamera, Pose};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::geometry::Box3;

/// The near plane as a share of the box's diagonal. It must lie in front of the camera: the image of a box
/// changes by less than this share when the plane moves towards the centre.
const NEAR_SHARE: f64 = 1e-4;

/// Corner pairs that are edges: corner `i` is at the maximum of axis k where bit k of `i` is set.
const EDGES: [(usize, usize); 12] =
    [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

/// The pose for points that are given in the aligned frame.
pub fn aligned_pose(pose: &Pose, world_to_aligned: DQuat) -> Pose {
    Pose { rotation: pose.rotation * world_to_aligned.inverse(), translation: pose.translation }
}

/// Share of the picture that `bounds` covers, 0 to 1. `pose` takes points of the box's frame.
pub fn coverage(camera: &PinholeCamera, pose: &Pose, bounds: &Box3) -> f64 {
    if is_out_of_sight(camera, pose, bounds) {
        return 0.0;
    }
    let near = NEAR_SHARE * DVec3::from(bounds.max).distance(bounds.min.into());
    let corners: [DVec3; 8] = std::array::from_fn(|i| {
        let corner =
            std::array::from_fn(|axis| if i >> axis & 1 == 1 { bounds.max[axis] } else { bounds.min[axis] });
        pose.transform(DVec3::from_array(corner))
    });
    let mut outline = Vec::with_capacity(20);
    outline.extend(corners.iter().filter(|c| c.z > near).map(|&c| project(camera, c)));
    if outline.is_empty() {
        return 0.0;
    }
    for (a, b) in EDGES.map(|(i, j)| (corners[i], corners[j])) {
        if (a.z > near) != (b.z > near) {
            outline.push(project(camera, a.lerp(b, (near - a.z) / (b.z - a.z))));
        }
    }
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let covered = area(&clip_to_picture(convex_hull(outline), size));
    (covered / (size.x * size.y)).clamp(0.0, 1.0)
}

/// Whether the whole box lies behind the camera or beyond one side of its image. Then it covers nothing, as
/// for most pairs of camera and cell in a large scene. The test is conservative: it may miss a tilted box
/// that is out of sight.
fn is_out_of_sight(camera: &PinholeCamera, pose: &Pose, bounds: &Box3) -> bool {
    let (min, max) = (DVec3::from(bounds.min), DVec3::from(bounds.max));
    let (middle, half) = (pose.transform((min + max) / 2.0), (max - min) / 2.0);
    let to_camera = DMat3::from_quat(pose.rotation);
    let axes = [to_camera.x_axis * half.x, to_camera.y_axis * half.y, to_camera.z_axis * half.z];
    // u < 0 in front of the camera is fx x + cx z < 0, and so on.
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let inwards = [
        DVec3::Z,
        DVec3::new(camera.fx, 0.0, camera.cx),
        DVec3::new(-camera.fx, 0.0, width - camera.cx),
        DVec3::new(0.0, camera.fy, camera.cy),
        DVec3::new(0.0, -camera.fy, height - camera.cy),
    ];
    inwards.iter().any(|normal| {
        let reach: f64 = axes.iter().map(|axis| normal.dot(*axis).abs()).sum();
        normal.dot(middle) + reach < 0.0
    })
}

fn project(camera: &PinholeCamera, p: DVec3) -> DVec2 {
    DVec2::new(camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy)
}

/// Convex hull, without repeated points (Andrew's monotone chain).
fn convex_hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut hull: Vec<DVec2> = Vec::with_capacity(2 * points.len());
    let mut chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let start = hull.len();
        for p in points {
            while hull.len() >= start + 2 {
                let (a, b) = (hull[hull.len() - 2], hull[hull.len() - 1]);
                if (b - a).perp_dot(p - a) > 0.0 {
                    break;
                }
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
    };
    chain(&mut points.iter().copied());
    chain(&mut points.iter().rev().copied());
    hull
}

/// The part of a convex polygon between (0, 0) and `size` (Sutherland and Hodgman).
fn clip_to_picture(mut polygon: Vec<DVec2>, size: DVec2) -> Vec<DVec2> {
    for axis in 0..2 {
        polygon = clip_half_plane(&polygon, |p| p[axis]);
        polygon = clip_half_plane(&polygon, |p| size[axis] - p[axis]);
    }
    polygon
}

/// The part of a convex polygon where `distance` is not negative.
fn clip_half_plane(polygon: &[DVec2], distance: impl Fn(DVec2) -> f64) -> Vec<DVec2> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, &a) in polygon.iter().enumerate() {
        let b = polygon[(i + 1) % polygon.len()];
        let (da, db) = (distance(a), distance(b));
        if da >= 0.0 {
            kept.push(a);
        }
        if (da >= 0.0) != (db >= 0.0) {
            kept.push(a.lerp(b, da / (da - db)));
        }
    }
    kept
}

/// Area of a simple polygon (shoelace).
fn area(polygon: &[DVec2]) -> f64 {
    let twice: f64 = (0..polygon.len()).map(|i| polygon[i].perp_dot(polygon[(i + 1) % polygon.len()])).sum();
    twice.abs() / 2.0
}

#[cfg(test)]
mod tests {
    use fathom_core::rng::{Stream, uniform_at};

    use super::*;

    const CAMERA: PinholeCamera =
        PinholeCamera { width: 640, height: 480, fx: 500.0, fy: 450.0, cx: 300.0, cy: 260.0 };
    const AT_ORIGIN: Pose = Pose { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Share of rays through random pixels that hit the box in front of the camera (slab test).
    fn coverage_by_rays(camera: &PinholeCamera, pose: &Pose, bounds: &Box3, rays: u32) -> f64 {
        let to_world = pose.rotation.inverse();
        let origin = pose.centre();
        let hits = (0..rays)
            .filter(|&i| {
                let u = f64::from(uniform_at(5, Stream::Test, i, 0)) * f64::from(camera.width);
                let v = f64::from(uniform_at(5, Stream::Test, i, 1)) * f64::from(camera.height);
                let ray =
                    to_world * DVec3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
                let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
                for axis in 0..3 {
                    let a = (bounds.min[axis] - origin[axis]) / ray[axis];
                    let b = (bounds.max[axis] - origin[axis]) / ray[axis];
                    enter = enter.max(a.min(b));
                    leave = leave.min(a.max(b));
                }
                enter <= leave
            })
            .count();
        hits as f64 / f64::from(rays)
    }

    /// A random box and a random camera near it; a third of the boxes straddle the camera plane.
    fn random_case(case: u32) -> (Pose, Box3) {
        let draw = |k: u32, lo: f64, hi: f64| {
            lo + (hi - lo) * f64::from(uniform_at(11, Stream::Test, case, 100 + k))
        };
        let eye = DVec3::new(draw(0, -6.0, 6.0), draw(1, -3.0, 3.0), draw(2, -6.0, 6.0));
        let target = DVec3::new(draw(3, -3.0, 3.0), draw(4, -2.0, 2.0), draw(5, -3.0, 3.0));
        let half = DVec3::new(draw(6, 0.2, 4.0), draw(7, 0.05, 2.0), draw(8, 0.2, 4.0));
        let pose = Pose::looking_at(eye, target + DVec3::Z * 1e-3, DVec3::new(0.1, 1.0, 0.2));
        (pose, Box3 { min: (-half).to_array(), max: half.to_array() })
    }

    /// Fault 6 of the public code: corners behind the camera are dropped, which loses a tenth of the area.
    #[test]
    fn coverage_agrees_with_rays_across_the_camera_plane() {
        let (mut straddling, mut partly) = (0, 0);
        for case in 0..300 {
            let (pose, bounds) = random_case(case);
            let expected = coverage_by_rays(&CAMERA, &pose, &bounds, 20_000);
            let found = coverage(&CAMERA, &pose, &bounds);
            // Five standard errors of a share from 20 000 rays: 5 * sqrt(0.25 / 20 000) = 0.0177.
            assert!((found - expected).abs() < 0.018, "case {case}: {found}, by rays {expected}");
            let behind = (0..8)
                .filter(|i| {
                    let corner =
                        [0, 1, 2].map(|k| if i >> k & 1 == 1 { bounds.max[k] } else { bounds.min[k] });
                    pose.transform(corner.into()).z <= 0.0
                })
                .count();
            straddling += usize::from((1..8).contains(&behind));
            partly += usize::from(expected > 0.02 && expected < 0.98);
        }
        assert!(straddling > 60 && partly > 100, "straddling {straddling}, partly visible {partly}");
    }

    #[test]
    fn a_box_found_out_of_sight_covers_nothing_and_most_are_found() {
        let (mut found, mut nothing) = (0, 0);
        for case in 0..1000 {
            let (pose, near) = random_case(case);
            // Smaller than those that fill pictures.
            let bounds = Box3 { min: near.min.map(|end| end / 4.0), max: near.max.map(|end| end / 4.0) };
            let by_rays = coverage_by_rays(&CAMERA, &pose, &bounds, 1000);
            let out = is_out_of_sight(&CAMERA, &pose, &bounds);
            assert!(!out || by_rays == 0.0, "case {case}: {by_rays} of the rays hit it");
            found += usize::from(out);
            nothing += usize::from(by_rays == 0.0);
        }
        assert!(found * 10 > nothing * 7 && nothing > 50, "{found} of {nothing}");
    }

    #[test]
    fn a_wall_that_fills_a_quarter_of_the_picture_covers_a_quarter() {
        // At depth 10 a pixel is 10 / fx wide: the wall ends at the principal point in x and y.
        let left = -CAMERA.cx / CAMERA.fx * 10.0;
        let top = -CAMERA.cy / CAMERA.fy * 10.0;
        let wall = Box3 { min: [left, top, 10.0], max: [0.0, 0.0, 10.0] };
        let expected = CAMERA.cx * CAMERA.cy / (640.0 * 480.0);
        assert!((coverage(&CAMERA, &AT_ORIGIN, &wall) - expected).abs() < 1e-12);
    }

    #[test]
    fn x_is_compared_with_the_width_and_y_with_the_height() {
        // Fault 3 of the public code: it swaps the two. A box that projects to x in 500..600 and y in
        // 10..110: inside a picture of 640x480, but outside of one of 480x640.
        let at = |u: f64, v: f64| [(u - CAMERA.cx) / CAMERA.fx * 4.0, (v - CAMERA.cy) / CAMERA.fy * 4.0];
        let ([x0, y0], [x1, y1]) = (at(500.0, 10.0), at(600.0, 110.0));
        let plate = Box3 { min: [x0, y0, 4.0], max: [x1, y1, 4.0] };
        let expected = 100.0 * 100.0 / (640.0 * 480.0);
        assert!((coverage(&CAMERA, &AT_ORIGIN, &plate) - expected).abs() < 1e-9);
        let portrait = PinholeCamera { width: 480, height: 640, ..CAMERA };
        assert_eq!(coverage(&portrait, &AT_ORIGIN, &plate), 0.0);
    }

    #[test]
    fn a_box_behind_covers_nothing_and_one_around_everything() {
        let behind = Box3 { min: [-1.0, -1.0, -9.0], max: [1.0, 1.0, -2.0] };
        let around = Box3 { min: [-1.0, -1.0, -1.0], max: [1.0, 1.0, 1.0] };
        assert_eq!(coverage(&CAMERA, &AT_ORIGIN, &behind), 0.0);
        assert!((coverage(&CAMERA, &AT_ORIGIN, &around) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn an_aligned_pose_projects_like_the_world_pose() {
        let turn = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 1.1);
        let pose = Pose::looking_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Y);
        let point = DVec3::new(-0.3, 0.7, 0.2);
        let aligned = aligned_pose(&pose, turn);
        assert!((aligned.transform(turn * point) - pose.transform(point)).length() < 1e-12);
        assert!((aligned.centre() - turn * pose.centre()).length() < 1e-12);
    }
}
