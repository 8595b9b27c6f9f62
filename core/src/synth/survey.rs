//! The dive: three lawn-mower lines along the wreck, then an orbit around it.
//!
//! The surveyed area is about three times as long as wide, so that halves along either axis are partitions of
//! a usable size. On the lines the camera looks down with a tilt that changes from picture to picture.
//!
//! The forward look is another dive, two to three metres above the floor with the camera 6 to 15 degrees
//! below the horizon. It passes the wreck on one side, returns on the other and ends in a spiral around it.
//! The diver swims towards what the camera shows, so most surfaces are seen from far and near.

use glam::DVec3;

use crate::rng::{Stream, uniform_at};
use crate::scene::{PinholeCamera, Pose};

/// Offsets in z of the lines, metres.
const LINES: [f64; 3] = [-2.9, 0.0, 2.9];
/// Half the length of a line, metres.
const HALF_LENGTH: f64 = 9.0;
/// Horizontal field of view, degrees.
const FIELD_OF_VIEW: f64 = 72.0;

pub(super) fn camera(width: u32, height: u32) -> PinholeCamera {
    let focal = 0.5 * f64::from(width) / (0.5 * FIELD_OF_VIEW.to_radians()).tan();
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    PinholeCamera { width, height, fx: focal, fy: focal, cx, cy }
}

/// Offset of the lanes of the forward look from the wreck, metres.
const LANE: f64 = 5.4;
/// Start and end of a lane, metres along the wreck; the return lane mirrors it.
const LANE_ENDS: [f64; 2] = [-17.0, 8.0];
/// Radii of the spiral, metres; a factor that grows from 0.98 to 1.25 scales them.
const SPIRAL: [f64; 2] = [12.2, 8.2];

/// `count` poses of the forward look, in the order of the dive.
pub(super) fn forward_poses(count: u32, seed: u32) -> Vec<Pose> {
    let random = |view: u32, k: u32| f64::from(uniform_at(seed, Stream::Synth, 10_000 + view, k)) - 0.5;
    let on_lanes = count / 2;
    let first = on_lanes / 2;
    let look = |view: u32, eye: DVec3, yaw: f64| {
        let eye = eye + DVec3::new(0.3 * random(view, 0), 0.7 * random(view, 1), 0.3 * random(view, 2));
        let (yaw, pitch) = (yaw + 0.16 * random(view, 3), (10.5 + 9.0 * random(view, 4)).to_radians());
        let ahead = DVec3::new(yaw.cos() * pitch.cos(), pitch.sin(), yaw.sin() * pitch.cos());
        // A diver is never quite level.
        let down = DVec3::new(0.08 * random(view, 5), 1.0, 0.08 * random(view, 6));
        Pose::looking_at(eye, eye + ahead, down)
    };
    let pose = |view: u32| {
        if view < on_lanes {
            let (step, steps, side) =
                if view < first { (view, first, 1.0) } else { (view - first, on_lanes - first, -1.0) };
            let way = (f64::from(step) + 0.5) / f64::from(steps.max(1));
            let x = side * (LANE_ENDS[0] + (LANE_ENDS[1] - LANE_ENDS[0]) * way);
            // The camera looks ahead, turned towards the wreck, and swings from side to side.
            let swing = 0.32 + 0.30 * (std::f64::consts::TAU * 2.5 * way).sin();
            let heading = if side > 0.0 { 0.0 } else { std::f64::consts::PI };
            return look(view, DVec3::new(x, -2.5, side * LANE), heading - swing);
        }
        let way = (f64::from(view - on_lanes) + 0.5) / f64::from(count - on_lanes);
        let angle = std::f64::consts::TAU * way;
        let size = 0.98 + 0.27 * way;
        let eye = DVec3::new(size * SPIRAL[0] * angle.cos(), -2.6, size * SPIRAL[1] * angle.sin());
        let inwards = (-eye.z).atan2(-0.6 * eye.x);
        look(view, eye, inwards + 0.3 * (3.0 * angle).sin())
    };
    (0..count).map(pose).collect()
}

/// `count` poses in the order of the dive.
pub(super) fn poses(count: u32, seed: u32) -> Vec<Pose> {
    let on_orbit = count / 4;
    let on_lines = count - on_orbit;
    let random = |view: u32, k: u32| f64::from(uniform_at(seed, Stream::Synth, 10_000 + view, k)) - 0.5;
    let mut poses = Vec::with_capacity(count as usize);
    for (line, z) in (0_u32..).zip(LINES) {
        let share = |l: u32| on_lines * l / LINES.len() as u32;
        let views = share(line + 1) - share(line);
        for step in 0..views {
            let view = poses.len() as u32;
            let way = (f64::from(step) + 0.5) / f64::from(views);
            // Every other line is swum backwards.
            let heading = if line % 2 == 0 { 1.0 } else { -1.0 };
            let x = heading * (2.0 * way - 1.0) * HALF_LENGTH;
            let eye = DVec3::new(
                x + 0.3 * random(view, 0),
                -4.6 + 0.5 * random(view, 1),
                z + 0.35 * random(view, 2),
            );
            let ahead = heading * (0.5 + 1.4 * random(view, 3));
            let target = DVec3::new(eye.x + ahead, 0.0, 0.62 * z + 0.8 * random(view, 4));
            // In the picture, up is the direction of travel.
            poses.push(Pose::looking_at(eye, target, DVec3::new(-heading, 0.3, 0.1 * random(view, 5))));
        }
    }
    for step in 0..on_orbit {
        let view = poses.len() as u32;
        let angle = std::f64::consts::TAU * (f64::from(step) + 0.3 * random(view, 0)) / f64::from(on_orbit);
        let eye = DVec3::new(
            7.4 * angle.cos(),
            -4.2 + 0.5 * random(view, 1),
            3.9 * angle.sin() + 0.2 * random(view, 2),
        );
        let target = DVec3::new(0.62 * eye.x, 0.0, 0.15 * eye.z);
        poses.push(Pose::looking_at(eye, target, DVec3::Y));
    }
    poses
}
