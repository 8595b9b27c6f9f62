//! Defects of known size on surfaces of known shape: exactly these must be measured.

use glam::DVec3;
use serde_json::{Value, json};

use super::*;

const WIDTH: u32 = 96;
const HEIGHT: u32 = 64;
/// Height of the cameras over the ground.
const DISTANCE: f64 = 10.0;
const BAND: f64 = 0.5;

fn at_x(at: f64) -> Line {
    Line { axis: Axis::X, at, from: f64::NEG_INFINITY, to: f64::INFINITY }
}

/// A border at x = 0 and control lines at x = -3 and 3, for cells that end at -6 and 6.
fn lines() -> SeamLines {
    SeamLines {
        world_to_aligned: DQuat::IDENTITY,
        borders: vec![at_x(0.0)],
        controls: vec![at_x(-3.0), at_x(3.0)],
        band: BAND,
    }
}

/// Two half planes of ground that meet at x = 0: y of either at x = 0 (y points down), and their slopes
/// dy/dx.
#[derive(Clone, Copy)]
struct Ground {
    y: [f64; 2],
    slope: [f64; 2],
}

const FLAT: Ground = Ground { y: [DISTANCE; 2], slope: [0.0; 2] };

/// A camera above (x, z), that looks at a point on the ground.
struct Shot {
    camera: PinholeCamera,
    pose: Pose,
    alpha: Vec<f32>,
    range: Vec<f32>,
}

impl Shot {
    fn new(eye: DVec3, target: DVec3, ground: Ground) -> Self {
        let (w, h) = (f64::from(WIDTH), f64::from(HEIGHT));
        let camera = PinholeCamera {
            width: WIDTH,
            height: HEIGHT,
            fx: 80.0,
            fy: 82.0,
            cx: w / 2.0 + 1.3,
            cy: h / 2.0,
        };
        let pose = Pose::looking_at(eye, target, DVec3::Z);
        let range = |index: u32| {
            let (x, y) = (f64::from(index % WIDTH) + 0.5, f64::from(index / WIDTH) + 0.5);
            let ray = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0).normalize();
            let ray = pose.rotation.inverse() * ray;
            // y = y0 + slope x along the ray, in the half plane of the hit.
            let hit = |side: usize| {
                let (y0, slope) = (ground.y[side], ground.slope[side]);
                let t = (y0 + slope * eye.x - eye.y) / (ray.y - slope * ray.x);
                let beyond = (eye.x + t * ray.x > 0.0) as usize;
                (t > 0.0 && beyond == side).then_some(t)
            };
            hit(0).into_iter().chain(hit(1)).fold(f64::INFINITY, f64::min)
        };
        let ranges: Vec<f64> = (0..WIDTH * HEIGHT).map(range).collect();
        let alpha = ranges.iter().map(|range| if range.is_finite() { 0.9 } else { 0.0 }).collect();
        let range = ranges.iter().map(|&r| if r.is_finite() { (0.9 * r) as f32 } else { 0.0 }).collect();
        Self { camera, pose, alpha, range }
    }

    /// Straight down onto (x, 0).
    fn above(x: f64, ground: Ground) -> Self {
        Self::new(DVec3::X * x, DVec3::new(x, DISTANCE, 0.0), ground)
    }

    fn seen(&self) -> SeenView<'_> {
        SeenView { camera: &self.camera, pose: &self.pose, alpha: &self.alpha, range: &self.range }
    }

    /// Ground x of a pixel in a shot from above.
    fn x(&self, index: usize) -> f64 {
        let column = (index % WIDTH as usize) as f64 + 0.5;
        // The picture's y points to +z, so its x points to -x or +x, depending on the pose.
        let right = self.pose.rotation.inverse() * DVec3::X;
        self.pose.centre().x + right.x * (column - self.camera.cx) / self.camera.fx * DISTANCE
    }
}

fn texture(index: usize) -> u8 {
    100 + (index * 37 % 41) as u8
}

/// The photograph, and a render that differs from it by `error` at each pixel, with alternating sign.
fn pictures(error: impl Fn(usize) -> u8) -> (PackedImage, PackedImage) {
    let picture = |value: &dyn Fn(usize) -> u8| {
        let rgb: Vec<u8> = (0..(WIDTH * HEIGHT) as usize).flat_map(|index| [value(index); 3]).collect();
        PackedImage::from_rgb8(WIDTH, HEIGHT, &rgb)
    };
    let off = |index: usize| {
        if index.is_multiple_of(2) { texture(index) + error(index) } else { texture(index) - error(index) }
    };
    (picture(&off), picture(&texture))
}

fn meter() -> SeamMeter {
    SeamMeter::new(lines(), SeamsConfig::default())
}

fn add(meter: &mut SeamMeter, shot: &Shot, error: impl Fn(usize) -> u8) -> ViewZones {
    let (render, truth) = pictures(error);
    meter.add(&shot.seen(), &render, &truth, SsimMap::new(&render, &truth).as_ref())
}

fn db(error: f64) -> f64 {
    20.0 * (255.0 / error).log10()
}

/// Compares means of values that are equal except for the rounding of logarithms.
fn assert_near(found: Option<f64>, expected: f64, what: &str) {
    assert!(found.is_some_and(|found| (found - expected).abs() < 1e-9), "{what}: {found:?}, not {expected}");
}

#[test]
fn a_defect_along_a_border_is_found_at_its_size() {
    let shots = [-1.0, 0.0, 1.0].map(|x| Shot::above(x, FLAT));
    let mut meter = meter();
    for shot in &shots {
        add(&mut meter, shot, |index| if shot.x(index).abs() <= BAND { 6 } else { 2 });
    }
    let report = meter.report();
    assert_eq!((report.border.views, report.control.views), (3, 3));
    assert_near(report.border.psnr, db(6.0), "border");
    assert_near(report.border.pooled_psnr, db(6.0), "border, pooled");
    assert_near(report.border.interior_psnr, db(2.0), "interior");
    assert_near(report.interior.pooled_psnr, db(2.0), "interior, pooled");
    assert_near(report.control.psnr, db(2.0), "control");
    assert_near(report.seam_db, db(2.0) - db(6.0), "seam");
    assert_near(report.seam_db_error, 0.0, "all views are alike");
    assert!(report.border.ssim.unwrap() < report.control.ssim.unwrap() - 0.05, "{report:?}");
    // Windows of SSIM that reach into the band lower the flank too.
    assert!(report.seam_ssim.unwrap() > 0.01, "{report:?}");
    assert_near(report.control.loss_db, 0.0, "nothing was cut along control lines");
}

#[test]
fn no_defect_is_found_where_there_is_none() {
    let mut meter = meter();
    for x in [-1.0, 0.5] {
        add(&mut meter, &Shot::above(x, FLAT), |_| 3);
    }
    let report = meter.report();
    assert_near(report.border.psnr, db(3.0), "border");
    assert_near(report.seam_db, 0.0, "seam");
    assert!(report.seam_ssim.unwrap().abs() < 0.02, "{report:?}");
    assert!(report.range_step.border.median.unwrap() < 1e-6, "{report:?}");
}

#[test]
fn hard_content_on_both_sides_of_a_border_is_no_seam() {
    // A wreck on the border, as wide as its flanks.
    let shot = Shot::above(0.0, FLAT);
    let mut meter = meter();
    add(&mut meter, &shot, |index| if shot.x(index).abs() <= 3.0 * BAND { 8 } else { 2 });
    let report = meter.report();
    assert_near(report.border.psnr, db(8.0), "border");
    assert!(report.border.interior_psnr.unwrap() > db(8.0) + 3.0, "the interior says little: {report:?}");
    assert_near(report.border.flank_psnr, db(8.0), "flank");
    assert_near(report.seam_db, 0.0, "seam");
}

#[test]
fn views_that_are_worse_all_over_do_not_look_like_a_seam() {
    // A bad photograph shows the border and a good one the control line, which is not caused by partitioning.
    let mut meter = meter();
    add(&mut meter, &Shot::above(-7.5, FLAT), |_| 1);
    add(&mut meter, &Shot::above(0.0, Ground { y: [4.0; 2], ..FLAT }), |_| 9);
    let report = meter.report();
    assert_eq!((report.border.views, report.control.views), (1, 1), "{report:?}");
    assert_near(report.border.psnr, db(9.0), "border");
    assert_near(report.control.psnr, db(1.0), "control");
    assert_near(report.seam_db, 0.0, "seam");
    assert_eq!(report.seam_db_error, None, "one view gives no standard error");
}

#[test]
fn a_pixel_belongs_to_the_border_by_where_its_surface_lies() {
    let shot = Shot::above(0.2, FLAT);
    let zones = add(&mut meter(), &shot, |_| 1).zones;
    let all = [Zones::BORDER, Zones::INTERIOR, Zones::BORDER_FLANK, Zones::CONTROL, Zones::CONTROL_FLANK];
    let mut found = [0; 5];
    for (index, zones) in zones.iter().enumerate() {
        let (x, control) = (shot.x(index).abs(), (shot.x(index).abs() - 3.0).abs());
        let inside = x > BAND;
        let expected = [
            !inside,
            inside,
            inside && x <= 3.0 * BAND,
            inside && control <= BAND,
            inside && control > BAND && control <= 3.0 * BAND,
        ];
        assert_eq!(all.map(|zone| zones.are(zone)), expected, "pixel {index} at {x} from the border");
        (0..5).for_each(|zone| found[zone] += usize::from(expected[zone]));
    }
    assert!(found.iter().all(|count| *count > 100), "{found:?}");
}

#[test]
fn lines_are_in_the_aligned_frame_and_end_with_their_cells() {
    // A quarter turn about y maps world z to aligned x: the border runs along world x, for aligned z up to 1.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let lines = SeamLines {
        world_to_aligned: DQuat::from_xyzw(0.0, half, 0.0, half),
        borders: vec![Line { to: 1.0, ..at_x(0.0) }],
        controls: Vec::new(),
        band: BAND,
    };
    let shot = Shot::above(0.0, FLAT);
    let mut meter = SeamMeter::new(lines, SeamsConfig::default());
    let zones = add(&mut meter, &shot, |_| 1).zones;
    for (index, zone) in zones.iter().enumerate() {
        let down = (index / WIDTH as usize) as f64 + 0.5;
        let down_axis = shot.pose.rotation.inverse() * DVec3::Y;
        let z = down_axis.z * (down - shot.camera.cy) / shot.camera.fy * DISTANCE;
        // Aligned z is world -x. Beyond the end of the line, the distance is that to the end.
        let past = (-shot.x(index) - 1.0).max(0.0);
        let expected = z.hypot(past) <= BAND;
        assert_eq!(
            (zone.are(Zones::BORDER), zone.are(Zones::INTERIOR)),
            (expected, !expected),
            "pixel {index}"
        );
    }
    assert_eq!(meter.report().control.psnr, None, "there is no control line");
}

#[test]
fn masked_pixels_and_open_water_belong_to_no_zone() {
    let mut shot = Shot::above(0.0, FLAT);
    let open = |index: usize| index / WIDTH as usize >= 40;
    for index in (0..shot.alpha.len()).filter(|&index| open(index)) {
        shot.alpha[index] = 0.4;
        shot.range[index] = 0.4 * 10.0;
    }
    let masked = |index: usize| index / (WIDTH as usize) < 10;
    // Open and masked pixels have the largest possible error.
    let (render, mut truth) = pictures(|index| if open(index) || masked(index) { 90 } else { 2 });
    for (index, pixel) in truth.pixels.iter_mut().enumerate() {
        if masked(index) {
            *pixel &= 0x00ff_ffff;
        }
    }
    let mut meter = meter();
    let map = SsimMap::new(&render, &truth);
    let zones = meter.add(&shot.seen(), &render, &truth, map.as_ref()).zones;
    for (index, zone) in zones.iter().enumerate() {
        assert_eq!(*zone == Zones::NOTHING, open(index) || masked(index), "pixel {index}");
    }
    let report = meter.report();
    assert_near(report.border.pooled_psnr, db(2.0), "border");
    assert_near(report.border.interior_psnr, db(2.0), "interior");
    assert_near(report.control.pooled_psnr, db(2.0), "control");
}

#[test]
fn views_that_see_no_border_or_hardly_any_do_not_count() {
    let config = SeamsConfig { least_share: 0.05, ..SeamsConfig::default() };
    let mut meter = SeamMeter::new(lines(), config);
    add(&mut meter, &Shot::above(0.0, FLAT), |_| 5);
    // No border in sight, then a sliver of its band at the edge of the picture.
    add(&mut meter, &Shot::above(9.0, FLAT), |_| 1);
    let sliver = Shot::above(6.15, FLAT);
    add(&mut meter, &sliver, |index| if sliver.x(index) <= BAND { 50 } else { 1 });
    let report = meter.report();
    assert_eq!(report.border.views, 1);
    assert_near(report.border.psnr, db(5.0), "border");
    assert_near(report.border.interior_psnr, db(5.0), "interior of the views that count");
    assert_eq!(report.views[1].border_pixels, 0);
    let seen = report.views[2].border_pixels;
    assert!(seen > 0 && seen < u64::from(WIDTH * HEIGHT) / 20, "{seen}");
    assert_eq!((report.views[1].border_psnr, report.views[2].border_psnr), (None, None));
    assert!(report.border.pooled_psnr.unwrap() < db(5.0), "all pixels count in the pooled value");
}

/// The report of the same ground seen from straight above and from the side.
fn steps_of(ground: Ground) -> SeamReport {
    let mut meter = meter();
    add(&mut meter, &Shot::above(0.4, ground), |_| 1);
    add(&mut meter, &Shot::above(-0.9, ground), |_| 1);
    let aside = Shot::new(DVec3::new(1.0, 0.0, -4.0), DVec3::new(0.5, DISTANCE, 1.0), ground);
    add(&mut meter, &aside, |_| 1);
    meter.report()
}

#[test]
fn a_step_of_the_surface_at_a_border_is_found_at_its_height() {
    for height in [0.02, 0.1, 0.3] {
        let report = steps_of(Ground { y: [DISTANCE, DISTANCE + height], ..FLAT });
        let found = report.range_step.border.median.unwrap();
        // Depths are along the camera's axis, so those of the camera at the side differ a little from the
        // others.
        let expected = height / (DISTANCE + height / 2.0);
        assert!((found / expected - 1.0).abs() < 0.05, "{found}, not {expected}");
        // f32 ranges have 7 digits, and extrapolation amplifies their rounding.
        assert!(report.range_step.control.median.unwrap() < 2e-6, "{report:?}");
        assert!(report.range_step.border.beside_median.unwrap() < 2e-6, "{report:?}");
        assert!(report.range_step.border.ratio.unwrap() > 1e3, "{report:?}");
    }
}

#[test]
fn slopes_are_no_steps() {
    for slope in [0.0, 0.3, -0.8] {
        let report = steps_of(Ground { slope: [slope; 2], ..FLAT });
        assert!(report.range_step.border.pairs > 100, "{report:?}");
        let median = report.range_step.border.median.unwrap();
        assert!(median < 2e-6, "slope {slope}: {median}");
    }
    // An edge where two slopes meet at the same height is no step either.
    let report = steps_of(Ground { slope: [0.3, -0.2], ..FLAT });
    assert!(report.range_step.border.median.unwrap() < 0.01, "{report:?}");
}

#[test]
fn steps_elsewhere_do_not_count_for_a_border() {
    // The ground breaks at x = 0, and the border runs at x = 2.
    let lines = SeamLines { borders: vec![at_x(2.0)], controls: vec![at_x(0.0)], ..lines() };
    let mut meter = SeamMeter::new(lines, SeamsConfig::default());
    add(&mut meter, &Shot::above(0.7, Ground { y: [DISTANCE, DISTANCE + 0.3], ..FLAT }), |_| 1);
    let report = meter.report();
    assert!(report.range_step.border.median.unwrap() < 2e-6, "{report:?}");
    assert!(report.range_step.control.median.unwrap() > 0.02, "{report:?}");
    assert!(report.range_step.control.ratio.unwrap() > 1e3, "{report:?}");
}

#[test]
fn a_line_is_crossed_between_its_ends_only() {
    let line = Line { axis: Axis::Z, at: 1.0, from: 0.0, to: 2.0 };
    let crosses = |a: (f64, f64), b: (f64, f64)| line.is_crossed(a.into(), b.into());
    assert!(crosses((1.0, 0.5), (1.0, 1.5)) && crosses((1.0, 1.5), (1.0, 0.5)));
    assert!(crosses((0.5, 1.0), (0.5, 1.1)), "a point on the line lies below it");
    assert!(!crosses((0.5, 0.9), (0.5, 1.0)));
    assert!(!crosses((3.0, 0.5), (3.0, 1.5)), "past its end");
    assert!(!crosses((0.0, 0.5), (0.0, 1.5)), "its lower end is another cell's");
    assert!(!crosses((1.0, 0.5), (1.0, 0.9)));
    let distance = |x: f64, z: f64| line.distance(DVec2::new(x, z));
    assert_eq!((distance(1.0, 3.5), distance(5.0, 5.0)), (2.5, 5.0));
}

#[test]
fn a_report_goes_into_the_metrics_and_into_each_view() {
    let mut meter = meter();
    add(&mut meter, &Shot::above(12.0, FLAT), |_| 1);
    add(&mut meter, &Shot::above(0.0, FLAT), |_| 5);
    let report = meter.report();
    let again: SeamReport = serde_json::from_str(&serde_json::to_string(&report).unwrap()).unwrap();
    assert_eq!(again, report, "it survives JSON");

    let views = || json!([{ "name": "a", "psnr": 1.0 }, { "name": "b", "psnr": 2.0 }]);
    let mut metrics = json!({ "views": views() });
    put_into(&mut metrics, Some(&report));
    assert_eq!(metrics["border_psnr"], json!(report.border.psnr));
    assert_eq!(metrics["interior_ssim"], json!(report.border.interior_ssim));
    assert_eq!(metrics["seams"]["control"]["views"], 1);
    assert_eq!(metrics["seams"].get("views"), None, "they are with the views");
    assert_eq!(metrics["views"][0]["border_psnr"], Value::Null);
    assert_eq!(
        (&metrics["views"][1]["name"], metrics["views"][1]["border_psnr"].is_number()),
        (&json!("b"), true)
    );

    let mut whole = json!({ "views": views() });
    put_into(&mut whole, None);
    for key in ["border_psnr", "border_ssim", "interior_psnr", "control_psnr", "seam_db", "seams"] {
        assert_eq!(whole.get(key), Some(&Value::Null), "{key}");
    }
    assert_eq!(whole["views"], views());
}

#[test]
fn a_picture_shows_the_lines_and_the_errors_of_each_zone() {
    let mut shot = Shot::above(0.0, FLAT);
    shot.alpha[0] = 0.0;
    let (render, truth) = pictures(|index| if index % WIDTH as usize == 20 { 70 } else { 0 });
    let zones = meter().add(&shot.seen(), &render, &truth, SsimMap::new(&render, &truth).as_ref());
    let png = image::load_from_memory(&zones.picture(&render, &truth).unwrap()).unwrap().to_rgb8();
    assert_eq!(png.dimensions(), (2 * WIDTH, HEIGHT));
    let row = 30;
    let column = |x: f64| (0..WIDTH).min_by_key(|c| ((shot.x(*c as usize) - x).abs() * 1e6) as u64).unwrap();
    let lined = |x: f64, colour: [u8; 3]| {
        let around = column(x) - 1..=column(x) + 1;
        around.filter(|column| png.get_pixel(*column, row).0 == colour).count()
    };
    assert!(lined(0.0, [255, 214, 0]) >= 1, "no border on the render");
    assert!(lined(3.0, [0, 210, 255]) >= 1, "no control line on the render");
    let right = |column: u32| png.get_pixel(WIDTH + column, row).0;
    assert_eq!(right(column(0.0)), [74, 40, 0]);
    assert_eq!(right(column(3.0)), [0, 44, 66]);
    assert_eq!(right(column(1.5)), [0, 0, 0]);
    assert_eq!(right(20), [255, 255, 255], "an error of 70, four times");
    assert_eq!(png.get_pixel(WIDTH, 0).0, [56, 56, 64], "open water");
}
