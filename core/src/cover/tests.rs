use super::*;

const SIDE: u32 = 100;
const PIXELS: usize = 100 * 100;
const WALL: f64 = 10.0;

/// 100 x 100 pixels; at the wall a pixel is 0.1 wide.
fn camera() -> PinholeCamera {
    PinholeCamera { width: SIDE, height: SIDE, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 }
}

/// A camera at (x, 0, 0) that looks along z at a wall of depth 10.
fn at(x: f64) -> (PinholeCamera, Pose) {
    (camera(), Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [-x, 0.0, 0.0]))
}

/// The held-out view 0 in the middle, and training views at these x.
fn views(training: &[f64]) -> Vec<(PinholeCamera, Pose)> {
    std::iter::once(0.0).chain(training.iter().copied()).map(at).collect()
}

/// A point on the wall that the held-out view shows at the pixel (x, y).
fn on_wall(x: f64, y: f64) -> [f64; 3] {
    [(x - 50.0) / 100.0 * WALL, (y - 50.0) / 100.0 * WALL, WALL]
}

fn points(positions: &[[f64; 3]]) -> Points {
    let mut points = Points::default();
    for position in positions {
        assert!(points.push(*position, [0; 3]));
    }
    points
}

/// Points with tracks.
fn tracked(positions: &[([f64; 3], &[u32])]) -> Points {
    let mut points = Points::default();
    for (position, track) in positions {
        assert!(points.push_seen(*position, [0; 3], &mut track.to_vec()));
    }
    points
}

fn grey(code: u8) -> PackedImage {
    let pixel = u32::from_le_bytes([code, code, code, 255]);
    PackedImage { width: SIDE, height: SIDE, pixels: vec![pixel; PIXELS] }
}

/// A picture whose mask is set in these columns.
fn masked(image: PackedImage, columns: std::ops::Range<usize>) -> PackedImage {
    let masked = |(index, pixel): (usize, u32)| {
        if columns.contains(&(index % 100)) { pixel } else { pixel & 0x00ff_ffff }
    };
    PackedImage { pixels: image.pixels.into_iter().enumerate().map(masked).collect(), ..image }
}

/// The render of view 0: a wall with holes.
struct Shown {
    alpha: Vec<f32>,
    range: Vec<f32>,
    photograph: PackedImage,
    clear: Option<PackedImage>,
    truth: Option<PackedImage>,
}

impl Shown {
    /// The wall with this alpha at each pixel (x, y).
    fn wall(alpha: impl Fn(usize, usize) -> f32) -> Self {
        let alpha: Vec<f32> = (0..PIXELS).map(|pixel| alpha(pixel % 100, pixel / 100)).collect();
        let range = alpha.iter().enumerate().map(|(pixel, alpha)| {
            let range = WALL / camera().direction(pixel).z;
            alpha * range as f32
        });
        Self { range: range.collect(), alpha, photograph: grey(100), clear: None, truth: None }
    }

    fn measured(&self, views: &[(PinholeCamera, Pose)], points: &Points) -> ViewCover {
        let mut meter = CoverMeter::new(views, &[0], points);
        meter.add(&self.of(views));
        let report = meter.report();
        assert_eq!(report.views, [report.all], "one view is all");
        report.all
    }

    fn of<'a>(&'a self, views: &'a [(PinholeCamera, Pose)]) -> HeldOut<'a> {
        HeldOut {
            index: 0,
            camera: &views[0].0,
            pose: &views[0].1,
            alpha: &self.alpha,
            range: &self.range,
            photograph: &self.photograph,
            clear: self.clear.as_ref(),
            truth: self.truth.as_ref(),
        }
    }
}

#[test]
fn points_cover_pixels_within_a_hundredth_of_the_picture() {
    // A radius of one pixel: the pixel of the point and the four beside it.
    let covered = discs(&camera(), &[[20.5, 30.5]]);
    let at: Vec<(usize, usize)> =
        (0..PIXELS).filter(|pixel| covered[*pixel]).map(|pixel| (pixel % 100, pixel / 100)).collect();
    assert_eq!(at, [(20, 29), (19, 30), (20, 30), (21, 30), (20, 31)]);
    // At the corners of a picture four times as large, quarters of discs.
    let camera = camera().resized(400, 400);
    let corners = [[0.0, 0.0], [399.9, 0.0], [0.0, 399.9], [399.9, 399.9]];
    let covered = discs(&camera, &corners).iter().filter(|covered| **covered).count();
    let quarter = std::f64::consts::PI * 4.0 * 4.0 / 4.0;
    assert!((covered as f64 / 4.0 - quarter).abs() < 2.0, "{covered} of four quarters of {quarter}");
    assert_eq!(discs(&camera, &[]).iter().filter(|covered| **covered).count(), 0);
}

#[test]
fn holes_are_covered_pixels_that_the_model_leaves_open() {
    let views = views(&[-0.5, 0.5]);
    // A radius of one pixel, so each covers its own pixel, the one to the right and the one below.
    let points = points(&[on_wall(30.6, 50.6), on_wall(70.6, 50.6)]);
    let hole = |x, y| if (x, y) == (30, 50) || x > 90 { 0.89 } else { 0.95 };
    let shown = Shown::wall(hole);
    assert_eq!(shown.measured(&views, &points).holes, Some(1.0 / 6.0), "one of six covered pixels");
    // NaN does not count as a surface.
    let broken = Shown { alpha: vec![f32::NAN; PIXELS], ..shown };
    assert_eq!(broken.measured(&views, &points).holes, Some(1.0));
}

#[test]
fn a_point_that_only_one_training_view_sees_covers_nothing() {
    let open = Shown::wall(|_, _| 0.0);
    let left = [on_wall(5.5, 50.5)];
    // From x = 3 the picture begins at pixel 30 of the held-out view.
    assert_eq!(open.measured(&views(&[0.0, 3.0]), &points(&left)).holes, None);
    assert_eq!(open.measured(&views(&[0.0, 0.1]), &points(&left)).holes, Some(1.0));
    // Tracks decide if there are any; the held-out view itself does not count.
    let seen = |track: &[u32]| open.measured(&views(&[0.0, 0.1]), &tracked(&[(left[0], track)])).holes;
    assert_eq!([seen(&[0, 1]), seen(&[0, 1, 2])], [None, Some(1.0)]);
}

#[test]
fn positions_in_fewer_than_two_training_views_are_unseen() {
    let wall = Shown::wall(|x, _| if x < 20 { 0.5 } else { 1.0 });
    let unseen = |training: &[f64]| wall.measured(&views(training), &Points::default()).unseen;
    // The picture from x = 3 begins at pixel 30 of the held-out view; 20 columns are no surface.
    assert_eq!(unseen(&[0.0, 3.0]), Some(10.0 / 80.0), "a grid of every second pixel");
    assert_eq!(unseen(&[0.0, 0.0]), Some(0.0));
    assert_eq!(unseen(&[0.0]), Some(1.0));
    assert_eq!(unseen(&[]), None, "nothing was trained on");
    let nothing = Shown::wall(|_, _| 0.2);
    assert_eq!(nothing.measured(&views(&[0.0, 0.0]), &Points::default()).unseen, None);
}

#[test]
fn a_camera_sees_nothing_behind_it() {
    let mut views = views(&[0.0, 0.0]);
    views[2].1 = Pose::looking_at(DVec3::ZERO, -DVec3::Z, DVec3::Y);
    let wall = Shown::wall(|_, _| 1.0);
    assert_eq!(wall.measured(&views, &Points::default()).unseen, Some(1.0));
}

#[test]
fn light_left_in_open_water_is_a_share_of_the_white_of_j() {
    let views = views(&[0.0, 0.0]);
    let mut shown = Shown::wall(|x, _| if x < 40 { 0.1 } else { 1.0 });
    assert_eq!(shown.measured(&views, &Points::default()).open_water, None, "no medium");
    let mut clear = grey(200);
    // Half a percent of highlights must not count as white; open water is dim.
    for (pixel, value) in clear.pixels.iter_mut().enumerate() {
        match (pixel % 100, pixel / 100) {
            (..40, _) => *value = u32::from_le_bytes([0, 0, 100, 255]),
            (60, ..30) => *value = u32::from_le_bytes([255; 4]),
            _ => {}
        }
    }
    shown.clear = Some(clear);
    let light = |code: f64| srgb_to_linear(code / 255.0);
    let found = shown.measured(&views, &Points::default()).open_water.expect("open water");
    let expected = light(100.0) / 3.0 / light(200.0);
    assert!((found - expected).abs() < 1e-12, "{found} is not {expected}");
    let mut closed = Shown::wall(|_, _| 1.0);
    closed.clear = Some(grey(200));
    assert_eq!(closed.measured(&views, &Points::default()).open_water, None, "no open water");
    let mut black = Shown::wall(|x, _| if x < 40 { 0.1 } else { 1.0 });
    black.clear = Some(grey(0));
    assert_eq!(black.measured(&views, &Points::default()).open_water, None, "no white");
}

#[test]
fn the_white_of_j_is_that_of_all_views_together() {
    let views = views(&[0.0, 0.0]);
    let points = Points::default();
    let half = |code| Shown { clear: Some(grey(code)), ..Shown::wall(|x, _| if x < 50 { 0.0 } else { 1.0 }) };
    let [dim, bright] = [half(50), half(250)];
    let mut meter = CoverMeter::new(&views, &[0], &points);
    meter.add(&dim.of(&views));
    meter.add(&bright.of(&views));
    let report = meter.report();
    let light = |code: f64| srgb_to_linear(code / 255.0) / srgb_to_linear(250.0 / 255.0);
    let found: Vec<f64> = report.views.iter().filter_map(|view| view.open_water).collect();
    assert!(found.len() == 2 && (found[0] - light(50.0)).abs() < 1e-12, "{report:?}");
    assert!((found[1] - 1.0).abs() < 1e-12, "{report:?}");
    let all = report.all.open_water.expect("open water");
    assert!((all - (light(50.0) + 1.0) / 2.0).abs() < 1e-12, "{report:?}");
}

#[test]
fn a_truth_decides_what_is_open_instead_of_the_model() {
    let views = views(&[0.0, 0.0]);
    // The truth has surfaces from column 50 on. The model has light in open water, and a hole in the surface.
    let mut shown = Shown::wall(|x, _| if (70..80).contains(&x) { 0.1 } else { 1.0 });
    shown.truth = Some(masked(grey(0), 50..100));
    let mut clear = grey(200);
    for (pixel, value) in clear.pixels.iter_mut().enumerate() {
        // Light beside the border of the surface does not count.
        if pixel % 100 < 49 {
            *value = u32::from_le_bytes([100, 100, 100, 255]);
        }
    }
    shown.clear = Some(clear);
    let points = points(&[on_wall(75.5, 50.5)]);
    let found = shown.measured(&views, &points);
    let expected = srgb_to_linear(100.0 / 255.0) / srgb_to_linear(200.0 / 255.0);
    assert!(found.open_water.is_some_and(|light| (light - expected).abs() < 1e-12), "{found:?}");
    // A disc of 10 pixels around the point, on a grid of every second pixel. It covers all columns of the
    // hole and as many beside it.
    let inside = |half: f64| {
        (0..PIXELS).filter(move |pixel| {
            let (x, y) = ((pixel % 100) as f64 + 0.5 - 75.5, (pixel / 100) as f64 + 0.5 - 50.5);
            x.hypot(y) <= 10.0 && x >= -half && x < half && pixel % 2 == 1 && pixel / 100 % 2 == 1
        })
    };
    let expected = inside(5.0).count() as f64 / inside(11.0).count() as f64;
    assert!(found.holes.is_some_and(|holes| (holes - expected).abs() < 1e-12), "{found:?}, {expected}");
}

#[test]
fn pixels_that_the_mask_leaves_out_count_nowhere() {
    let views = views(&[0.0, 3.0]);
    let points = points(&[on_wall(40.5, 50.5), on_wall(70.5, 50.5)]);
    let mut shown = Shown::wall(|x, _| if x < 50 { 0.0 } else { 1.0 });
    shown.clear = Some(grey(100));
    assert_eq!(shown.measured(&views, &points).holes, Some(0.5));
    shown.photograph = masked(grey(100), 50..100);
    let found = shown.measured(&views, &points);
    assert_eq!(found, ViewCover { holes: Some(0.0), open_water: None, unseen: Some(0.0) });
    shown.photograph = masked(grey(100), 0..0);
    assert_eq!(shown.measured(&views, &points), ViewCover::default());
}

#[test]
fn sparse_points_predict_what_will_be_unseen() {
    // Points in every tenth column and row: each pixel has one within 1/10.
    let lattice: Vec<[f64; 3]> = (0..100)
        .map(|i| on_wall(f64::from(i % 10).mul_add(10.0, 5.5), f64::from(i / 10).mul_add(10.0, 5.5)))
        .collect();
    let cloud = points(&lattice);
    let predicted = predicted_unseen(&views(&[0.0, 3.0]), &[0], &cloud).expect("points are near");
    // The lattice lies on a wall, whose range differs between a pixel and its point by at most a few percent.
    assert!((predicted - 0.3).abs() < 0.02, "{predicted}");
    assert_eq!(predicted_unseen(&views(&[0.0, 0.0]), &[0], &cloud), Some(0.0));
    assert_eq!(predicted_unseen(&views(&[0.0, 0.0]), &[0], &Points::default()), None);
    assert_eq!(predicted_unseen(&views(&[]), &[0], &cloud), None);
    assert_eq!(predicted_unseen(&views(&[0.0, 0.0]), &[], &cloud), None);
    // With tracks, only points that the view sees give a range, and only near them.
    let seen = tracked(&[(on_wall(15.5, 50.5), &[0, 1]), (on_wall(85.5, 50.5), &[1, 2])]);
    assert_eq!(predicted_unseen(&views(&[0.0, 3.0]), &[0], &seen), Some(1.0));
    assert_eq!(predicted_unseen(&views(&[0.0, 0.0]), &[0], &seen), Some(0.0));
}

#[test]
fn a_grid_is_even_and_bounded_for_any_picture() {
    for (width, height) in [(1, 1), (64, 64), (65, 64), (1600, 1200), (65_535, 1), (3, 65_535), (4096, 4096)]
    {
        let camera = camera().resized(width, height);
        let (pixels, weight) = grid(&camera);
        let all = width as usize * height as usize;
        assert!(!pixels.is_empty() && pixels.len() <= GRID, "{} of {width}x{height}", pixels.len());
        assert!(pixels.is_sorted_by(|a, b| a < b) && pixels.iter().all(|pixel| *pixel < all));
        assert!((weight * pixels.len() as f64 - all as f64).abs() < 1e-6, "{width}x{height}");
    }
    assert_eq!(grid(&camera().resized(64, 64)).0.len(), GRID, "all pixels of a small picture");
}

#[test]
fn the_nearest_views_come_first() {
    let points = Points::default();
    let trained = Trained::new(&views(&[5.0, -1.0, 2.0]), &[0], &points);
    let near: Vec<f64> = trained.near(DVec3::ZERO).iter().map(|eye| eye.centre.x).collect();
    assert_eq!(near, [-1.0, 2.0, 5.0]);
}

#[test]
fn a_report_goes_into_metrics_and_old_reports_are_read() {
    let view = |holes| ViewCover { holes: Some(holes), open_water: None, unseen: Some(0.5) };
    let report = CoverReport { all: view(0.25), views: vec![view(0.0), view(0.5)] };
    let mut metrics = json!({ "psnr": 30.0, "views": [{ "name": "a" }, { "name": "b" }] });
    put_into(&mut metrics, Some(&report));
    let expected = json!({ "psnr": 30.0,
        "views": [{ "name": "a", "holes": 0.0, "open_water": null, "unseen": 0.5 },
            { "name": "b", "holes": 0.5, "open_water": null, "unseen": 0.5 }],
        "holes": 0.25, "open_water": null, "unseen": 0.5 });
    assert_eq!(metrics, expected);
    let json = serde_json::to_string(&report).expect("JSON");
    assert_eq!(serde_json::from_str::<CoverReport>(&json).expect("a report"), report);
    assert_eq!(serde_json::from_str::<CoverReport>("{}").expect("a report"), CoverReport::default());
    let mut older = json!({ "views": [{ "name": "a" }] });
    put_into(&mut older, None);
    assert_eq!(older["holes"], Value::Null);
    assert!(older["views"][0].get("unseen").is_some_and(Value::is_null), "{older}");
}
