//! Samples match the photographs, and their number is limited.

use std::sync::Arc;

use super::*;
use crate::config::DataConfig;
use crate::picture::{Photograph, prepare};
use crate::scene::{Pose, Purpose, Tracks, load_scene};
use crate::synth::{SynthOptions, synthesise};
use crate::views::InMemory;
use crate::water::{Water, sparse_prior};

/// A camera of 40 x 30 pixels at `distance` in front of the origin, looking at it.
fn view(name: &str, distance: f64) -> TrainView {
    let camera = PinholeCamera { width: 40, height: 30, fx: 20.0, fy: 20.0, cx: 20.0, cy: 15.0 };
    let pose = Pose::looking_at(DVec3::new(0.0, 0.0, -distance), DVec3::ZERO, DVec3::Y);
    TrainView { name: name.to_owned(), camera, pose, clear_range: 0.0 }
}

fn grey(code: u8) -> u32 {
    u32::from_le_bytes([code, code, code, 255])
}

fn points(places: &[[f64; 3]], tracks: &[&[u32]]) -> Points {
    let mut points = Points::default();
    for (index, place) in places.iter().enumerate() {
        points.push_seen(*place, [0; 3], &mut tracks.get(index).copied().unwrap_or_default().to_vec());
    }
    points
}

#[test]
fn samples_have_linear_colours_and_ranges_along_the_ray() {
    let mut source = InMemory::plain(vec![view("a", 2.0), view("c", 4.0)], grey(10));
    // The point at (0.5, 0, 0) is at x = 25 of the near view and at 22.5 of the far one, y = 15.
    for (image, columns) in source.images.iter_mut().zip([22..28, 21..24]) {
        let image = Arc::make_mut(image);
        for column in columns {
            (12..18).for_each(|row| image.pixels[row * 40 + column] = u32::from_le_bytes([0, 128, 200, 255]));
        }
    }
    // View 1 of the scene is held out.
    let points = points(&[[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]], &[&[0, 1, 2], &[0, 1]]);
    let observed = observe(&points, &source, &[0, 2]).unwrap();
    assert_eq!(observed.points, [0], "only one view shows the other point");
    assert_eq!(observed.observations.len(), 2);
    for (observation, distance) in observed.observations.iter().zip([2.0_f64, 4.0]) {
        assert!((observation.range - (0.25 + distance * distance).sqrt()).abs() < 1e-9);
        for (found, code) in observation.colour.iter().zip([0.0, 128.0, 200.0]) {
            assert!((found - srgb_to_linear(code / 255.0)).abs() < 1e-9, "{:?}", observation.colour);
        }
    }
}

#[test]
fn smaller_window_covers_less_around_the_point() {
    let mut source = InMemory::plain(vec![view("a", 2.0), view("b", 4.0)], grey(10));
    // A bright stripe of two pixels around the middle of both.
    for image in &mut source.images {
        let image = Arc::make_mut(image);
        (0..30).for_each(|row| image.pixels[row * 40 + 19..row * 40 + 21].fill(grey(200)));
    }
    let points = points(&[[0.0, 0.0, 0.0]], &[&[0, 1]]);
    let observed = observe(&points, &source, &[0, 1]).unwrap();
    let [dark, bright] = [10.0, 200.0].map(|code| srgb_to_linear(code / 255.0));
    // The windows have a half side of 1.5 pixels at the median range, which is that of the far view, and half
    // of that.
    for (observation, half) in observed.observations.iter().zip([3.0, 1.5]) {
        for (found, half) in [(observation.colour, half), (observation.finer, half / 2.0)] {
            let share = 1.0_f64.min(1.0 / half);
            let expected = dark + (bright - dark) * share;
            assert!((found[0] - expected).abs() < 1e-9, "{found:?}, not {expected} with {half}");
        }
    }
}

#[test]
fn a_window_covers_the_same_patch_of_the_scene_at_every_range() {
    let view = view("a", 2.0);
    let camera = view.camera;
    let mut image = PackedImage { width: 40, height: 30, pixels: vec![grey(0); 1200] };
    // One bright pixel left of the middle: its share of the window is one divided by the window's area.
    image.pixels[14 * 40 + 19] = grey(200);
    let bright = srgb_to_linear(200.0 / 255.0);
    for (half_window, area) in [(0.1, 4.0), (0.2, 16.0), (0.25, 25.0)] {
        let [found, ..] = look_up(&image, &view, DVec3::ZERO, half_window).unwrap();
        let side = (2.0 * half_window * camera.fx / 2.0).powi(2);
        assert!((side - area).abs() < 1e-9);
        assert!((found - bright / area).abs() < 1e-9, "{found} of {bright} over {area}");
    }
    // A window is never smaller than a pixel: a quarter of it lies on the bright one.
    let [found, ..] = look_up(&image, &view, DVec3::ZERO, 1e-6).unwrap();
    assert!((found - bright / 4.0).abs() < 1e-9);
}

#[test]
fn masked_and_saturated_pixels_are_ignored() {
    let view = view("a", 2.0);
    let plain = PackedImage { width: 40, height: 30, pixels: vec![grey(99); 1200] };
    let with = |pixel: u32| {
        let mut image = plain.clone();
        image.pixels[14 * 40 + 20] = pixel;
        look_up(&image, &view, DVec3::ZERO, 0.1)
    };
    assert!(with(grey(99)).unwrap().iter().all(|value| value.is_finite()));
    assert_eq!(with(grey(99) & 0x00ff_ffff), None, "masked");
    let [r, g, b] = with(u32::from_le_bytes([99, 254, 253, 255])).unwrap();
    assert!(r.is_finite() && g.is_nan() && b.is_finite());
    for outside in [DVec3::new(9.0, 0.0, 0.0), DVec3::new(0.0, 0.0, -3.0)] {
        assert_eq!(look_up(&plain, &view, outside, 0.1), None);
    }
}

#[test]
fn without_tracks_points_behind_nearer_ones_are_skipped() {
    let source = InMemory::plain(vec![view("a", 2.0), view("b", 4.0)], grey(99));
    // For both views, the second point is behind the first, and the third is beside them.
    let points = points(&[[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [1.0, 0.5, 0.0]], &[]);
    let observed = observe(&points, &source, &[0, 1]).unwrap();
    let seen: Vec<u32> = observed.observations.iter().map(|o| o.point).collect();
    assert_eq!(seen, [0, 0, 2, 2]);
}

#[test]
fn thinning_keeps_the_nearest_and_farthest_sightings() {
    let sightings: Vec<Sighting> = (0..1000_u32)
        .flat_map(|point| (0..400_u32).map(move |view| Sighting { point, view, range: f64::from(view) }))
        .collect();
    let thin = thinned(sightings);
    assert!(thin.len() <= MAX_OBSERVATIONS && thin.len() > MAX_OBSERVATIONS * 9 / 10, "{}", thin.len());
    for own in thin.chunk_by(|a, b| a.point == b.point) {
        assert_eq!((own[0].view, own[own.len() - 1].view), (0, 399));
        assert!(own.is_sorted_by(|a, b| a.view < b.view));
    }
    assert_eq!(evenly(&[5, 6, 7, 8, 9], 2), [5, 7]);
}

#[test]
fn scene_views_must_have_one_index_per_view() {
    let source = InMemory::plain(vec![view("a", 2.0)], grey(99));
    let error = observe(&Points::default(), &source, &[]).unwrap_err().to_string();
    assert!(error.contains("1 views have 0 indices"), "{error}");
    assert_eq!(observe(&Points::default(), &source, &[0]).unwrap(), Observed::default());
}

#[test]
fn water_of_a_synthetic_dive_is_found_with_or_without_tracks() {
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions { views: 36, width: 120, height: 90, ..SynthOptions::default() };
    synthesise(folder.path(), &options, |_, _| ()).unwrap();
    let data = DataConfig::default();
    let mut scene = load_scene(folder.path(), Purpose::Train, &data).unwrap();
    let mut source = InMemory::default();
    for view in &scene.views {
        let bytes = std::fs::read(view.image.as_ref().unwrap()).unwrap();
        let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
        let camera = scene.camera(view.camera_id).unwrap();
        let (camera, image) = prepare(&photograph, camera, data.mask_keep, 1600).unwrap();
        source.views.push(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 });
        source.images.push(Arc::new(image));
    }
    let scene_views: Vec<u32> = (0..source.views.len() as u32).collect();
    let mut estimate = |with_tracks: bool| {
        if !with_tracks {
            scene.points.tracks = Tracks::default();
        }
        let observed = observe(&scene.points, &source, &scene_views).unwrap();
        sparse_prior(&observed.observations, observed.points.len()).unwrap()
    };
    let (tracked, projected) = (estimate(true), estimate(false));
    for (name, prior) in [("tracks", &tracked), ("projection", &projected)] {
        for c in 0..3 {
            // 0.014 is the accuracy that edges and texture leave at 120 pixels, with some margin.
            let (found, truth) = (prior.water.beta_d[c], Water::COASTAL.beta_d[c]);
            assert!((found - truth).abs() < 0.014, "{name}: beta_d {found} for {truth}");
            // Backscatter at 5 units, near the points, is determined better than its two parameters.
            let veil = |water: &Water| water.apply(DVec3::ZERO, 5.0)[c];
            let (found, truth) = (veil(&prior.water), veil(&Water::COASTAL));
            assert!((found - truth).abs() < 0.006, "{name}: backscatter {found} for {truth}");
        }
    }
}
