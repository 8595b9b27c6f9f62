//! The prior on scenes that are made from a plane, and on the synthetic pool.

use glam::{DMat3, DQuat, DVec3};

use super::*;
use crate::config::DataConfig;
use crate::rng::{Stream, uniform_at};
use crate::scene::{PinholeCamera, Place, Points, Pose, Purpose, load_scene};
use crate::synth::{PoolOptions, SynthOptions, synthesise, synthesise_pool};

/// What a basin under cameras looks like. Before the rotation the surface is at y = 0 with y down.
#[derive(Clone)]
struct Basin {
    seed: u32,
    /// Of the water, scene units.
    depth: f64,
    ior: f64,
    /// Points in the water, and around it.
    wet: u32,
    dry: u32,
    /// Noise of dry and of wet pixels.
    noise_px: [f64; 2],
    /// Cameras above the surface, and below it.
    above: u32,
    below: u32,
    turned: DQuat,
    moved: DVec3,
}

impl Default for Basin {
    fn default() -> Self {
        Self {
            seed: 1,
            depth: 0.8,
            ior: WATER,
            wet: 300,
            dry: 300,
            noise_px: [0.3; 2],
            above: 36,
            below: 0,
            turned: DQuat::from_rotation_x(0.7) * DQuat::from_rotation_z(-0.4),
            moved: DVec3::new(3.0, -7.0, 11.0),
        }
    }
}

struct Made {
    points: Points,
    views: Vec<(PinholeCamera, Pose)>,
    truth: Surface,
    /// Places of the points.
    places: Vec<DVec3>,
}

const CAMERA: PinholeCamera =
    PinholeCamera { width: 160, height: 120, fx: 150.0, fy: 150.0, cx: 80.0, cy: 60.0 };

impl Basin {
    fn uniform(&self, a: u32, b: u32) -> f64 {
        f64::from(uniform_at(self.seed, Stream::Test, a, b))
    }

    /// Normally distributed (Box and Muller 1958).
    fn normal(&self, a: u32, b: u32) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform(a, 2 * b)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform(a, 2 * b + 1)).cos()
    }

    fn make(&self) -> Made {
        let placed = |at: DVec3| self.turned * at + self.moved;
        let normal = self.turned * DVec3::NEG_Y;
        let truth = Surface { normal, offset: normal.dot(self.moved), ior: self.ior };
        let pose = |view: u32| {
            let random = |k: u32| self.uniform(1_000_000 + view, k) - 0.5;
            let angle = 2.4 * f64::from(view) + 0.3 * random(0);
            let height = [0.8, 1.3, 1.9][view as usize % 3] + 0.1 * random(1);
            let (out, up) = if view < self.above { (2.6 - height, height) } else { (0.9, -0.5 * self.depth) };
            let eye = DVec3::new(out * angle.cos(), -up, out * angle.sin());
            let target = DVec3::new(random(2), 0.6 * self.depth, random(3));
            Pose::looking_at(placed(eye), placed(target), self.turned * DVec3::Y)
        };
        let views: Vec<_> = (0..self.above + self.below).map(|view| (CAMERA, pose(view))).collect();
        let (mut points, mut places) = (Points::default(), Vec::new());
        for index in 0..self.wet + self.dry {
            let random = |k: u32| 2.0 * self.uniform(index, 1000 + k) - 1.0;
            let is_wet = index < self.wet;
            let place = placed(if is_wet {
                DVec3::new(random(0), self.depth * (0.65 + 0.35 * random(1)), random(2))
            } else {
                DVec3::new(1.8 * random(0), -0.2 * (1.0 + random(1)), 1.8 * random(2))
            });
            let mut seen: Vec<(u32, Place)> = (0_u32..)
                .zip(&views)
                .filter_map(|(view, (camera, pose))| {
                    let is_air = view < self.above;
                    let at = if is_wet && is_air {
                        truth.crossing_by_halving(pose.centre(), place)
                    } else {
                        place
                    };
                    let p = pose.transform(at);
                    let noise =
                        |k: u32| self.noise_px[usize::from(is_wet)] * self.normal(index, 3 * view + k);
                    let pixel = [
                        camera.fx * p.x / p.z + camera.cx + noise(0),
                        camera.fy * p.y / p.z + camera.cy + noise(1),
                    ];
                    let place = Place::new(pixel, camera.width, camera.height);
                    // A feature is matched in the air or under water.
                    let is_matched = self.uniform(index, 500 + view) < 0.3 && (index % 2 == 0 || is_air);
                    (p.z > 0.1 && place.is_known() && is_matched).then_some((view, place))
                })
                .collect();
            points.push_seen_at(place.to_array(), [index as u8, (index / 256) as u8, 7], &mut seen);
            places.push(place);
        }
        Made { points, views, truth, places }
    }
}

impl Made {
    /// The sparse points as structure from motion puts them: where straight rays meet best.
    fn straight(&self) -> Vec<DVec3> {
        let nearest = |index: usize| {
            let (mut left, mut right) = (DMat3::ZERO, DVec3::ZERO);
            for (view, place) in self.points.tracks.seen(index) {
                let (camera, pose) = &self.views[view as usize];
                let [x, y] = place.pixel(camera.width, camera.height).unwrap();
                let ray = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0);
                let d = (pose.rotation.inverse() * ray).normalize();
                let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
                left += across;
                right += across * pose.centre();
            }
            left.inverse() * right
        };
        (0..self.points.len()).map(nearest).collect()
    }

    fn prior(&self, options: &SurfaceOptions) -> Result<SurfacePrior, SurfaceError> {
        let ids: Vec<u32> = (0..self.views.len() as u32).collect();
        surface_prior(&self.points, &self.views, &ids, options)
    }
}

fn standard_error(prior: &SurfacePrior) -> SurfaceStandardErrors {
    prior.standard_error.expect("a plane from tracks has standard errors")
}

/// Errors of a plane: of its height at the prior's centre, scene units, and of the normal, degrees.
fn errors(prior: &SurfacePrior, truth: &Surface) -> [f64; 2] {
    // acos loses small angles.
    let sine = prior.surface.normal.cross(truth.normal).length();
    [truth.height(prior.centre), sine.asin().to_degrees()]
}

fn assert_finds(prior: &SurfacePrior, truth: &Surface, what: &str) {
    let [height, tilt] = errors(prior, truth);
    let error = standard_error(prior);
    println!(
        "{what}: height {:.4} % of the viewing distance ({:.2} standard errors), tilt {tilt:.4} degrees \
         ({:.2}); {} wet {:.3} px, {} dry {:.3} px",
        100.0 * height / prior.viewing_distance,
        height / error.offset,
        tilt / error.tilt_degrees,
        prior.wet_tracks,
        prior.wet_error_px,
        prior.dry_tracks,
        prior.dry_error_px
    );
    let share = height.abs() / prior.viewing_distance;
    assert!(share < 0.002, "{what}: the height is {share} viewing distances off");
    assert!(tilt < 0.1, "{what}: the normal is {tilt} degrees off");
    assert!(height.abs() < 3.0 * error.offset, "{what}: {height} off, error {}", error.offset);
    assert!(tilt < 3.0 * error.tilt_degrees, "{what}: {tilt} degrees off, error {}", error.tilt_degrees);
}

#[test]
fn the_surface_of_the_pool_is_found_as_exactly_as_promised() {
    for seed in [1, 2, 3] {
        let folder = tempfile::tempdir().unwrap();
        let options = PoolOptions { seed, width: 160, height: 120, ..PoolOptions::default() };
        synthesise_pool(folder.path(), &options, |_, _| ()).unwrap();
        let scene = load_scene(folder.path(), Purpose::Train, &DataConfig::default()).unwrap();
        let truth = Surface { normal: DVec3::NEG_Y, offset: -0.05, ior: WATER };
        let tilted = DVec3::new(2_f64.to_radians().sin(), -2_f64.to_radians().cos(), 0.0);
        for up in [None, Some(tilted)] {
            let options = SurfaceOptions { up, ..SurfaceOptions::default() };
            let prior = SurfacePrior::of_scene(&scene, 0, &options).unwrap();
            assert_finds(&prior, &truth, &format!("pool {seed}, start {up:?}"));
            let offset = (prior.surface.offset - truth.offset).abs() / prior.viewing_distance;
            assert!(offset < 0.002, "the offset is {offset} viewing distances off");
            let (wet, dry) = (prior.wet_tracks, prior.dry_tracks);
            assert!(wet > 300 && dry > 300, "{wet} wet, {dry} dry");
            assert!(prior.wet_straight_error_px > 1.5 * prior.wet_error_px);
        }
    }
}

#[test]
fn planes_of_any_index_and_depth_are_found() {
    for (ior, depth) in [(WATER, 0.8), (1.46, 0.8), (1.46, 0.3), (WATER, 0.25), (WATER, 1.5)] {
        let made = Basin { ior, depth, seed: 5, ..Basin::default() }.make();
        let prior = made.prior(&SurfaceOptions { ior, ..SurfaceOptions::default() }).unwrap();
        assert_finds(&prior, &made.truth, &format!("index {ior}, depth {depth}"));
    }
}

/// Distances of wet points from their true places.
fn apart(made: &Made, prior: &SurfacePrior) -> Vec<f64> {
    prior.wet.iter().map(|wet| wet.position.distance(made.places[wet.point as usize])).collect()
}

/// How many of the values are below a bound, in percent.
fn percent_below(values: &[f64], bound: f64) -> usize {
    100 * values.iter().filter(|value| **value < bound).count() / values.len()
}

#[test]
fn points_in_the_water_return_to_their_places() {
    let made = Basin::default().make();
    let prior = made.prior(&SurfaceOptions::default()).unwrap();
    let right = prior.wet.iter().filter(|wet| wet.point < 300).count();
    assert!(right > 270 && right * 50 > prior.wet.len() * 49, "{right} of {}", prior.wet.len());
    assert!(percent_below(&apart(&made, &prior), 0.02) > 90, "within 2 cm");
    assert!((prior.wet_error_px - 0.3).abs() < 0.03, "{} px", prior.wet_error_px);
    assert!((prior.dry_error_px - 0.3).abs() < 0.03, "{} px", prior.dry_error_px);
}

#[test]
fn each_point_is_wet_or_dry_and_keeps_its_colour() {
    let made = Basin::default().make();
    let prior = made.prior(&SurfaceOptions::default()).unwrap();
    assert!(prior.wet.is_sorted_by(|a, b| a.point < b.point) && prior.dry.is_sorted());
    let mut all: Vec<u32> = prior.wet.iter().map(|wet| wet.point).chain(prior.dry.iter().copied()).collect();
    all.sort_unstable();
    assert_eq!(all, (0..made.points.len() as u32).collect::<Vec<_>>());
    let (wet, dry) = (prior.wet_points(), prior.dry_points(&made.points));
    assert_eq!((wet.len(), dry.len()), (prior.wet.len(), prior.dry.len()));
    for (index, of) in prior.wet.iter().enumerate() {
        assert_eq!(wet.colours[index], made.points.colours[of.point as usize]);
        assert_eq!(wet.positions[index], of.position.as_vec3().to_array());
    }
    for (index, &point) in prior.dry.iter().enumerate() {
        assert_eq!(dry.positions[index], made.points.positions[point as usize]);
        assert!(dry.tracks.of(index) == made.points.tracks.of(point as usize));
    }
}

#[test]
fn points_with_short_tracks_are_sorted_by_their_height() {
    let mut made = Basin::default().make();
    let long = made.prior(&SurfaceOptions::default()).unwrap();
    // Straight rays put each of them there. Every third keeps a track of two views.
    let straight = made.straight();
    let mut points = Points::default();
    for (index, place) in (0_u32..).zip(straight) {
        let mut seen: Vec<_> = made.points.tracks.seen(index as usize).collect();
        seen.truncate(if index % 3 == 0 { 2 } else { seen.len() });
        points.push_seen_at(place.to_array(), [1; 3], &mut seen);
    }
    made.points = points;
    let prior = made.prior(&SurfaceOptions::default()).unwrap();
    let (judged, others): (Vec<&WetPoint>, Vec<&WetPoint>) =
        prior.wet.iter().partition(|wet| wet.error_px.is_some());
    assert!(judged.iter().all(|wet| wet.point % 3 != 0));
    let right = others.iter().filter(|wet| wet.point % 3 == 0 && wet.point < 300).count();
    assert!(right > 90 && right * 8 > others.len() * 7, "{right} of {} are right", others.len());
    assert!(prior.wet.len().abs_diff(long.wet.len()) < 25, "{} and {}", prior.wet.len(), long.wet.len());
    // Two rays may be almost parallel.
    let right = others.iter().filter(|wet| wet.point < 300);
    let apart: Vec<f64> = right.map(|wet| wet.position.distance(made.places[wet.point as usize])).collect();
    let near = percent_below(&apart, 0.1);
    assert!(near > 60, "{near} % of the points are within 10 cm");
}

/// Roots of the mean squares of the errors over 20 seeds, in standard errors: height and tilt. Camera centres
/// are moved by up to `shift` scene units an axis after the pixels were made.
fn scores(shift: f64) -> [f64; 2] {
    let scores = (0..20).map(|seed| {
        let basin = Basin { seed: 100 + seed, ..Basin::default() };
        let mut made = basin.make();
        for (view, (_, pose)) in (2_000_000..).zip(&mut made.views) {
            let shifts = DVec3::new(basin.uniform(view, 0), basin.uniform(view, 1), basin.uniform(view, 2));
            pose.translation += shift * (2.0 * shifts - 1.0);
        }
        let prior = made.prior(&SurfaceOptions::default()).unwrap();
        let [height, tilt] = errors(&prior, &made.truth);
        let error = standard_error(&prior);
        [height / error.offset, tilt / error.tilt_degrees]
    });
    let squares = scores.fold([0.0; 2], |sum, score| [0, 1].map(|k| sum[k] + score[k] * score[k]));
    squares.map(|sum| (sum / 20.0).sqrt())
}

#[test]
fn standard_errors_match_the_scatter_over_seeds() {
    // Without errors of poses, and with 1 pixel of them and more. The root of a mean of 20 squares scatters
    // by 16 %, and 36 cameras are few clusters.
    for shift in [0.0, 0.005, 0.02] {
        let scores = scores(shift);
        println!("poses {shift} off: errors are {scores:?} standard errors");
        assert!(scores.iter().all(|score| (0.5..1.6).contains(score)), "poses {shift} off: {scores:?}");
    }
}

#[test]
fn the_result_has_the_same_bytes_on_any_number_of_threads() {
    let made = Basin::default().make();
    let many = made.prior(&SurfaceOptions::default()).unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(pool.install(|| made.prior(&SurfaceOptions::default())).unwrap(), many);
}

#[test]
fn what_is_given_is_kept() {
    let made = Basin::default().make();
    let truth = made.truth;
    let given = |options: SurfaceOptions| made.prior(&options).unwrap();
    let free = SurfaceOptions::default();
    let offset = given(SurfaceOptions { offset: Some(truth.offset), ..free });
    assert_eq!((offset.surface.offset, standard_error(&offset).offset), (truth.offset, 0.0));
    assert!(errors(&offset, &truth)[1] < 0.1 && standard_error(&offset).tilt_degrees > 0.0);
    let normal = given(SurfaceOptions { normal: Some(7.0 * truth.normal), ..free });
    assert!((normal.surface.normal - truth.normal).length() < 1e-15);
    assert_eq!(standard_error(&normal).tilt_degrees, 0.0);
    assert!(errors(&normal, &truth)[0].abs() < 0.003, "{normal:?}");
    let wrong = truth.offset + 0.03;
    let both = given(SurfaceOptions { offset: Some(wrong), normal: Some(truth.normal), ..free });
    assert_eq!((both.surface.offset, both.surface.ior), (wrong, WATER));
    let error = standard_error(&both);
    assert_eq!((error.offset, error.offset_share, error.tilt_degrees), (0.0, 0.0, 0.0));
    assert!(both.wet_error_px > normal.wet_error_px, "a wrong plane fits worse");
    assert_eq!(given(SurfaceOptions { ior: 1.34, ..free }).surface.ior, 1.34);
}

#[test]
fn wrong_matches_do_not_move_the_surface() {
    let mut made = Basin { seed: 9, ..Basin::default() }.make();
    let mut points = Points::default();
    for index in 0..made.points.len() {
        let mut seen: Vec<_> = made.points.tracks.seen(index).collect();
        if index % 10 == 0 && seen.len() > 3 {
            let [x, y] = seen[1].1.pixel(160, 120).unwrap();
            seen[1].1 = Place::new([(x + 40.0) % 160.0, y], 160, 120);
        }
        points.push_seen_at(made.points.positions[index].map(f64::from), [0; 3], &mut seen);
    }
    made.points = points;
    assert_finds(&made.prior(&SurfaceOptions::default()).unwrap(), &made.truth, "a tenth of wrong matches");
}

#[test]
fn a_dry_scene_has_no_water_surface() {
    let dry = Basin { wet: 0, dry: 600, ..Basin::default() }.make();
    let refused = dry.prior(&SurfaceOptions::default()).unwrap_err();
    assert!(matches!(refused, SurfaceError::NoSurface { .. }), "{refused}");
    assert!(refused.to_string().contains("no water surface"), "{refused}");
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions { views: 24, width: 160, height: 120, ..SynthOptions::default() };
    synthesise(folder.path(), &options, |_, _| ()).unwrap();
    let scene = load_scene(folder.path(), Purpose::Train, &DataConfig::default()).unwrap();
    let refused = SurfacePrior::of_scene(&scene, 8, &SurfaceOptions::default()).unwrap_err();
    println!("{refused}");
    assert!(refused.to_string().contains("no water surface"), "{refused}");
}

#[test]
fn scenes_without_pixels_or_tracks_are_refused() {
    let mut made = Basin::default().make();
    let few = Made { points: made.points.select(&[1, 2, 3, 4, 5, 6]), ..Basin::default().make() };
    let refused = few.prior(&SurfaceOptions::default()).unwrap_err();
    assert!(matches!(refused, SurfaceError::TooFewTracks { tracks: 1..=6 }), "{refused}");
    made.points = Points::from_bytes(&made.points.to_bytes()).unwrap();
    let refused = made.prior(&SurfaceOptions::default()).unwrap_err();
    assert_eq!(refused, SurfaceError::NoPixels);
    assert!(refused.to_string().contains("COLMAP"), "{refused}");
}

#[test]
fn cameras_that_are_not_all_in_air_are_refused() {
    let made = Basin { below: 12, ..Basin::default() }.make();
    let refused = made.prior(&SurfaceOptions::default()).unwrap_err();
    assert_eq!(refused, SurfaceError::CamerasOnBothSides { below: 12, cameras: 48 }, "{refused}");
    let made = Basin::default().make();
    let (normal, offset) = (Some(made.truth.normal), Some(made.truth.offset + 5.0));
    let refused = made.prior(&SurfaceOptions { normal, offset, ..SurfaceOptions::default() }).unwrap_err();
    assert_eq!(refused, SurfaceError::CamerasBelow { cameras: 36 }, "{refused}");
    let normal = Some(-made.truth.normal);
    let offset = Some(-made.truth.offset);
    let refused = made.prior(&SurfaceOptions { normal, offset, ..SurfaceOptions::default() }).unwrap_err();
    assert!(refused.to_string().contains("surface.normal"), "{refused}");
}

#[test]
fn a_plane_that_no_camera_sees_is_refused() {
    let mut made = Basin::default().make();
    let up = made.truth.normal;
    for (_, pose) in &mut made.views {
        let eye = pose.centre();
        *pose = Pose::looking_at(eye, eye + up, up.any_orthonormal_vector());
    }
    let (normal, offset) = (Some(up), Some(made.truth.offset));
    let refused = made.prior(&SurfaceOptions { normal, offset, ..SurfaceOptions::default() }).unwrap_err();
    assert_eq!(refused, SurfaceError::NotSeen { cameras: 36 });
    assert!(refused.to_string().contains("none of 36 cameras"), "{refused}");
}

#[test]
fn a_plane_that_is_given_in_whole_needs_no_pixels() {
    let mut made = Basin::default().make();
    let (normal, offset) = (Some(made.truth.normal), Some(made.truth.offset));
    let given = SurfaceOptions { normal, offset, ..SurfaceOptions::default() };
    let mut points = Points::default();
    for place in made.straight() {
        points.push(place.to_array(), [9; 3]);
    }
    made.points = points;
    let prior = made.prior(&given).unwrap();
    assert_eq!((prior.wet_tracks, prior.dry_tracks, prior.surface), (0, 0, made.truth));
    let right = prior.wet.iter().filter(|wet| wet.point < 300).count();
    assert!(right > 290 && right * 20 > prior.wet.len() * 19, "{right} of {}", prior.wet.len());
    let near = percent_below(&apart(&made, &prior), 0.1);
    assert!(near > 75, "{near} % of the points are within 10 cm");
    // Nor does it need points, or calm water.
    made.points = Points::default();
    let none = made.prior(&given).unwrap();
    assert_eq!((none.wet.len(), none.dry.len()), (0, 0));
    assert!(none.surface.height(none.centre).abs() < 1e-12 && none.viewing_distance > 0.5);
    let waves = Basin { noise_px: [0.3, 3.0], depth: 1.2, ..Basin::default() }.make();
    assert_eq!(waves.prior(&given).unwrap().surface, waves.truth);
}

#[test]
fn the_rule_of_the_paper_starts_between_ground_and_cameras() {
    let made = Basin::default().make();
    let paper = SurfaceOptions {
        normal: Some(made.truth.normal),
        start: SurfaceStart::Paper,
        ..SurfaceOptions::default()
    };
    let prior = made.prior(&paper).unwrap();
    assert_eq!((prior.standard_error, prior.surface.normal), (None, made.truth.normal));
    // The lowest camera is .8 above the surface, and the worst points of the ground are about .6 below.
    let off = prior.surface.offset - made.truth.offset;
    println!("the rule of the paper is {off:.3} off, {:.3} viewing distances", off / prior.viewing_distance);
    assert!((0.02..0.25).contains(&off.abs()), "{off} off");
    assert!(prior.wet_tracks > 200 && prior.wet_error_px > 0.3, "{prior:?}");
    let up = Some(made.truth.normal);
    let by_up = made.prior(&SurfaceOptions { normal: None, up, ..paper }).unwrap();
    assert_eq!(by_up.surface, prior.surface);
    let found = made.prior(&SurfaceOptions { normal: None, ..paper }).unwrap();
    assert!(found.surface.normal.dot(made.truth.normal) > 0.99, "{:?}", found.surface);
    let given = made.prior(&SurfaceOptions { offset: Some(made.truth.offset), ..paper }).unwrap();
    assert_eq!(given.surface, made.truth);
    let none = Made { points: made.points.select(&[]), ..Basin::default().make() };
    assert_eq!(none.prior(&paper).unwrap_err(), SurfaceError::NoPixels);
}

#[test]
fn waves_are_refused() {
    let made = Basin { noise_px: [0.3, 3.0], depth: 1.2, ..Basin::default() }.make();
    let refused = made.prior(&SurfaceOptions::default()).unwrap_err();
    assert!(matches!(refused, SurfaceError::Waves { .. }), "{refused}");
    assert!(refused.to_string().contains("not a plane"), "{refused}");
}

#[test]
fn options_that_are_no_plane_are_refused_by_name() {
    let made = Basin { wet: 20, dry: 20, ..Basin::default() }.make();
    let free = SurfaceOptions::default();
    let refused = |options: SurfaceOptions| made.prior(&options).unwrap_err().to_string();
    for ior in [0.9, 1.0, AIR, f64::NAN, 7.0] {
        assert!(refused(SurfaceOptions { ior, ..free }).contains(&format!("surface.ior is {ior}")));
    }
    assert!(refused(SurfaceOptions { offset: Some(f64::INFINITY), ..free }).contains("surface.offset"));
    for normal in [DVec3::ZERO, DVec3::new(f64::NAN, 1.0, 0.0)] {
        assert!(refused(SurfaceOptions { normal: Some(normal), ..free }).contains("surface.normal"));
    }
}
