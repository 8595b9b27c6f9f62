//! An in-memory dive over a floor that ends, for tests of water estimates from photographs.

use std::sync::Arc;

use glam::DVec3;

use crate::picture::linear_to_srgb;
use crate::rng::{Stream, uniform_at};
use crate::scene::{PinholeCamera, Points, Pose};
use crate::views::{InMemory, PackedImage, TrainView};
use crate::water::observe::project;
use crate::water::{ByDirection, Water};

pub(in crate::water) const WATER: Water =
    Water { beta_d: [0.16, 0.06, 0.04], beta_b: [0.14, 0.07, 0.05], b_inf: [0.03, 0.07, 0.13] };
/// End of the floor, scene units ahead.
const END: f64 = 24.0;

pub(in crate::water) fn brighter_upwards() -> ByDirection {
    ByDirection {
        middle: [0.0, 0.0, 1.0],
        slopes: [[0.0, -0.3, 0.0], [0.0, -1.0, 0.0], [0.2, -2.0, 0.0]],
        most: 1.0,
    }
}

/// Views over a floor of dark and bright stones, 2 below them, looking along it or down on it; y down.
pub(in crate::water) struct Dive {
    pub(in crate::water) points: Points,
    pub(in crate::water) photographs: InMemory,
    /// By view and pixel, whether the ray hits the floor.
    pub(in crate::water) floor: Vec<Vec<bool>>,
}

fn colour_of(position: DVec3) -> [f64; 3] {
    let cell = |x: f64| ((2.0 * x).floor() as i64 + 500) as u32;
    let tone = f64::from(uniform_at(5, Stream::Test, cell(position.x), cell(position.z)));
    // A tenth of the stones are black.
    let tone = if tone < 0.1 { 0.0 } else { tone };
    [0.6 * tone, 0.5 * tone, 0.4 * tone]
}

pub(in crate::water) fn dive(
    looks: impl Fn(f64) -> (DVec3, DVec3),
    open: impl Fn(DVec3) -> [f64; 3],
) -> Dive {
    let camera = PinholeCamera { width: 168, height: 126, fx: 150.0, fy: 150.0, cx: 84.0, cy: 63.0 };
    let views: Vec<TrainView> = (0..6)
        .map(|k| {
            let (from, at) = looks(f64::from(k));
            TrainView {
                name: format!("v{k}"),
                camera,
                pose: Pose::looking_at(from, at, DVec3::Y),
                clear_range: 0.0,
            }
        })
        .collect();
    let (mut images, mut floor) = (Vec::new(), Vec::new());
    for view in &views {
        let (eye, turn) = (view.pose.centre(), view.pose.rotation.inverse());
        let (mut pixels, mut meets) = (Vec::new(), Vec::new());
        for index in 0..camera.width as usize * camera.height as usize {
            let ray = turn * camera.direction(index);
            let range = (2.0 - eye.y) / ray.y;
            let position = eye + range * ray;
            let is_floor = ray.y > 0.0 && position.z.abs() < END && position.x.abs() < END;
            let light = if is_floor {
                let limit = open(ray);
                let here = Water { b_inf: limit, ..WATER };
                here.apply(DVec3::from(colour_of(position)), range).to_array()
            } else {
                open(ray)
            };
            let code = |light: f64| (255.0 * linear_to_srgb(light.clamp(0.0, 1.0))).round() as u8;
            let [r, g, b] = light.map(code);
            pixels.push(u32::from_le_bytes([r, g, b, 255]));
            meets.push(is_floor);
        }
        images.push(Arc::new(PackedImage { width: camera.width, height: camera.height, pixels }));
        floor.push(meets);
    }
    let mut points = Points::default();
    for x in -40..40 {
        for z in -40..40 {
            let position = DVec3::new(f64::from(x) * 0.6, 2.0, f64::from(z) * 0.6);
            let mut seen: Vec<u32> = (0..views.len() as u32)
                .filter(|view| {
                    project(&views[*view as usize], position).is_some_and(|(_, range)| range < 30.0)
                })
                .collect();
            if seen.len() >= 2 {
                assert!(points.push_seen(position.to_array(), [99; 3], &mut seen));
            }
        }
    }
    Dive { points, photographs: InMemory { views, images }, floor }
}

pub(in crate::water) fn ahead(k: f64) -> (DVec3, DVec3) {
    (DVec3::new(0.4 * k - 1.0, 0.0, 1.5 * k - 4.0), DVec3::new(0.1 * k, 0.6, 10.0))
}

pub(in crate::water) const ALL: [u32; 6] = [0, 1, 2, 3, 4, 5];
