use super::fixture::{ALL, WATER, ahead, brighter_upwards, dive};
use super::*;

#[test]
fn open_water_above_a_reef_is_found_and_mapped() {
    let truth = brighter_upwards();
    let dive = dive(ahead, |ray| truth.along(&WATER, ray).b_inf);
    let found = look_around(&dive.points, &dive.photographs, &ALL).unwrap();
    let open = found.open.expect("a third of each photograph shows open water");
    assert!(open.views == 6 && open.share > 0.15, "{open:?}");
    let [colour, error] = <[_; 2]>::from(open.colour());
    let expected = truth.along(&WATER, open.middle()).b_inf;
    for c in 0..3 {
        assert!((colour[c] / expected[c] - 1.0).abs() < 0.02, "{colour:?} for {expected:?}");
        assert!((colour[c] - expected[c]).abs() < 3.0 * error[c], "{error:?}");
        assert!((open.slopes()[c].y - truth.slopes[c][1]).abs() < 0.15, "{:?}", open.slopes());
    }
    let found = ByDirection {
        middle: open.middle().to_array(),
        slopes: open.slopes().map(|slope| slope.to_array()),
        most: 1.0,
    };
    let maps = ray_maps(&dive.points, &dive.photographs, &ALL, Some((colour, Some(&found)))).unwrap();
    let (mut open_right, mut open_all, mut surface_wrong, mut surface_all) = (0, 0, 0, 0);
    let mut undecided = 0;
    for (map, floor) in maps.iter().zip(&dive.floor) {
        for (index, meets) in floor.iter().enumerate() {
            let (column, row) = (index as u32 % 168, index as u32 / 168);
            let cell = map.cells[(row * map.rows / 126 * map.columns + column * map.columns / 168) as usize];
            match (cell, *meets) {
                (EndsOn::Open, false) => (open_right, open_all) = (open_right + 1, open_all + 1),
                (EndsOn::Edge, false) => (undecided, open_all) = (undecided + 1, open_all + 1),
                (_, false) => open_all += 1,
                (EndsOn::Open, true) => (surface_wrong, surface_all) = (surface_wrong + 1, surface_all + 1),
                (_, true) => surface_all += 1,
            }
        }
    }
    assert!(f64::from(open_right) > 0.8 * f64::from(open_all), "{open_right} of {open_all}");
    assert!(
        f64::from(open_right + undecided) > 0.99 * f64::from(open_all),
        "{open_right} and {undecided} of {open_all}"
    );
    assert!(f64::from(surface_wrong) < 0.005 * f64::from(surface_all), "{surface_wrong} of {surface_all}");
}

#[test]
fn middle_is_an_observed_direction_when_cameras_look_around() {
    let truth = brighter_upwards();
    let around = |k: f64| {
        let (sin, cos) = (k * std::f64::consts::TAU / 6.0).sin_cos();
        (DVec3::new(-8.0 * sin, 0.0, -8.0 * cos), DVec3::new(0.0, 0.4, 0.0))
    };
    let dive = dive(around, |ray| truth.along(&WATER, ray).b_inf);
    let open = look_around(&dive.points, &dive.photographs, &ALL).unwrap().open.unwrap();
    let up = -open.middle().y;
    assert!((0.0..0.4).contains(&up), "{} points {up} upwards", open.middle());
    assert!((open.middle().length() - 1.0).abs() < 1e-9);
}

#[test]
fn darkest_pixels_are_the_veil_if_something_is_black() {
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
fn downward_surveys_and_rooms_have_no_open_water() {
    let down = dive(
        |k| (DVec3::new(2.0 * k - 5.0, -2.0, 0.1), DVec3::new(2.0 * k - 5.0, 2.0, 0.3)),
        |_| WATER.b_inf,
    );
    assert_eq!(look_around(&down.points, &down.photographs, &ALL).unwrap().open, None);
    // Walls of different colours by direction.
    let walls = [[0.5, 0.4, 0.3], [0.1, 0.3, 0.1], [0.05, 0.05, 0.4], [0.9, 0.9, 0.8]];
    let room = dive(ahead, |ray| walls[((8.0 * (ray.x + 1.0)) as usize) % 4]);
    assert_eq!(look_around(&room.points, &room.photographs, &ALL).unwrap().open, None);
}

#[test]
fn result_does_not_depend_on_the_number_of_threads() {
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
