#![expect(clippy::unwrap_used, reason = "a test may panic")]

use std::sync::Arc;

use glam::DVec3;

use super::*;
use crate::picture::linear_to_srgb;
use crate::rng::{Stream, uniform_at};
use crate::scene::Pose;
use crate::views::{InMemory, PackedImage};
use crate::water::Water;

const WATER: Water =
    Water { beta_d: [0.16, 0.06, 0.04], beta_b: [0.14, 0.07, 0.05], b_inf: [0.03, 0.07, 0.13] };
/// The floor ends here, scene units ahead.
const END: f64 = 24.0;

fn brighter_upwards() -> ByDirection {
    ByDirection {
        middle: [0.0, 0.0, 1.0],
        slopes: [[0.0, -0.3, 0.0], [0.0, -1.0, 0.0], [0.2, -2.0, 0.0]],
        most: 1.0,
    }
}

/// Views over a floor of dark and bright stones, 2 below them, that look along it or down on it; y down.
struct Dive {
    points: Points,
    photographs: InMemory,
    /// By view and pixel whether a ray meets the floor.
    floor: Vec<Vec<bool>>,
}

fn colour_of(position: DVec3) -> [f64; 3] {
    let cell = |x: f64| ((2.0 * x).floor() as i64 + 500) as u32;
    let tone = f64::from(uniform_at(5, Stream::Test, cell(position.x), cell(position.z)));
    // A tenth of the stones is black.
    let tone = if tone < 0.1 { 0.0 } else { tone };
    [0.6 * tone, 0.5 * tone, 0.4 * tone]
}

fn dive(looks: impl Fn(f64) -> (DVec3, DVec3), open: impl Fn(DVec3) -> [f64; 3]) -> Dive {
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

fn ahead(k: f64) -> (DVec3, DVec3) {
    (DVec3::new(0.4 * k - 1.0, 0.0, 1.5 * k - 4.0), DVec3::new(0.1 * k, 0.6, 10.0))
}

const ALL: [u32; 6] = [0, 1, 2, 3, 4, 5];

#[test]
fn open_water_above_a_reef_is_found_with_its_colour_by_direction_and_mapped() {
    let truth = brighter_upwards();
    let dive = dive(ahead, |ray| truth.along(&WATER, ray).b_inf);
    let found = look_around(&dive.points, &dive.photographs, &ALL).unwrap();
    let open = found.open.expect("a third of each photograph shows it");
    assert!(open.views == 6 && open.share > 0.15, "{open:?}");
    let [colour, error] = <[_; 2]>::from(open.colour());
    let expected = truth.along(&WATER, open.middle()).b_inf;
    for c in 0..3 {
        assert!((colour[c] / expected[c] - 1.0).abs() < 0.02, "{colour:?} for {expected:?}");
        assert!((colour[c] - expected[c]).abs() < 3.0 * error[c], "{error:?}");
        assert!((open.slopes()[c].y - truth.slopes[c][1]).abs() < 0.15, "{:?}", open.slopes());
    }
    let told = ByDirection {
        middle: open.middle().to_array(),
        slopes: open.slopes().map(|slope| slope.to_array()),
        most: 1.0,
    };
    let maps = ray_maps(&dive.points, &dive.photographs, &ALL, colour, Some(&told)).unwrap();
    let (mut open_right, mut open_all, mut surface_wrong, mut surface_all) = (0, 0, 0, 0);
    for (map, floor) in maps.iter().zip(&dive.floor) {
        for (index, meets) in floor.iter().enumerate() {
            let (column, row) = (index as u32 % 168, index as u32 / 168);
            let cell = map.cells[(row * map.rows / 126 * map.columns + column * map.columns / 168) as usize];
            match (cell, *meets) {
                (EndsOn::Open, false) => (open_right, open_all) = (open_right + 1, open_all + 1),
                (_, false) => open_all += 1,
                (EndsOn::Open, true) => (surface_wrong, surface_all) = (surface_wrong + 1, surface_all + 1),
                (_, true) => surface_all += 1,
            }
        }
    }
    assert!(f64::from(open_right) > 0.8 * f64::from(open_all), "{open_right} of {open_all}");
    assert!(f64::from(surface_wrong) < 0.005 * f64::from(surface_all), "{surface_wrong} of {surface_all}");
}

#[test]
fn the_darkest_pixels_of_each_range_are_the_veil_where_something_is_black() {
    let dive = dive(ahead, |_| WATER.b_inf);
    let found = look_around(&dive.points, &dive.photographs, &ALL).unwrap();
    assert!(found.dark.len() > 20, "{}", found.dark.len());
    let mut off: Vec<f64> = found
        .dark
        .iter()
        .map(|cell| {
            (cell.dark[1] / (WATER.b_inf[1] * (1.0 - (-WATER.beta_b[1] * cell.range).exp()))).ln().abs()
        })
        .collect();
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.1, "half of the classes are within {:.3}", off[off.len() / 2]);
}

#[test]
fn a_survey_that_looks_down_and_a_room_above_a_scene_have_no_open_water() {
    let down = dive(
        |k| (DVec3::new(2.0 * k - 5.0, -2.0, 0.1), DVec3::new(2.0 * k - 5.0, 2.0, 0.3)),
        |_| WATER.b_inf,
    );
    assert_eq!(look_around(&down.points, &down.photographs, &ALL).unwrap().open, None);
    // Walls of other colours in each direction.
    let walls = [[0.5, 0.4, 0.3], [0.1, 0.3, 0.1], [0.05, 0.05, 0.4], [0.9, 0.9, 0.8]];
    let room = dive(ahead, |ray| walls[((8.0 * (ray.x + 1.0)) as usize) % 4]);
    assert_eq!(look_around(&room.points, &room.photographs, &ALL).unwrap().open, None);
}

#[test]
fn the_same_photographs_tell_the_same_on_any_number_of_threads() {
    let dive = dive(ahead, |ray| brighter_upwards().along(&WATER, ray).b_inf);
    let look = || look_around(&dive.points, &dive.photographs, &ALL).unwrap();
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(look);
    assert!(alone == look());
}

#[test]
fn views_without_an_index_in_the_scene_are_refused() {
    let dive = dive(ahead, |_| WATER.b_inf);
    let error = look_around(&dive.points, &dive.photographs, &ALL[..5]).unwrap_err().to_string();
    assert!(error.contains("6 views have 5 indices"), "{error}");
}
