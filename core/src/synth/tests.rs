//! What a synthetic scene promises.
#![expect(clippy::unwrap_used, reason = "a failed call fails the test")]

use super::*;

fn small() -> SynthOptions {
    SynthOptions { views: 12, width: 48, height: 36, ..SynthOptions::default() }
}

fn made(options: &SynthOptions) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    synthesise(folder.path(), options, |_, _| ()).unwrap();
    folder
}

fn bytes_of(folder: &Path, file: &str) -> Vec<u8> {
    std::fs::read(folder.join(file)).unwrap()
}

const FILES: [&str; 6] = [
    "images/v0001.png",
    "images/v0012.png",
    "sparse/0/images.bin",
    "sparse/0/points3D.bin",
    "truth/clear/v0009.png",
    "truth/depth_m.npz",
];

#[test]
fn the_same_options_give_the_same_bytes_on_any_number_of_threads() {
    let many = made(&small());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let one = pool.install(|| made(&small()));
    for file in FILES {
        assert!(bytes_of(many.path(), file) == bytes_of(one.path(), file), "{file} differs");
    }
    let other = made(&SynthOptions { seed: 2, ..small() });
    assert_ne!(bytes_of(many.path(), FILES[0]), bytes_of(other.path(), FILES[0]));
}

#[test]
fn the_photograph_is_the_truth_seen_through_the_water() {
    let folder = made(&small());
    let clear = image::open(folder.path().join("truth/clear/v0001.png")).unwrap().to_rgb8();
    let seen = image::open(folder.path().join("images/v0001.png")).unwrap().to_rgb8();
    let npz = bytes_of(folder.path(), "truth/depth_m.npz");
    let start = 30 + "v0001.npy".len() + 128;
    let camera = survey::camera(48, 36);
    let decode = |v: u8| {
        let v = f64::from(v) / 255.0;
        if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    };
    let mut worst: f64 = 0.0;
    let mut sum = 0.0;
    for (x, y, pixel) in seen.enumerate_pixels() {
        let at = start + 4 * (y * 48 + x) as usize;
        let depth = f64::from(f32::from_le_bytes(npz[at..at + 4].try_into().unwrap()));
        let (u, v) =
            ((f64::from(x) + 0.5 - camera.cx) / camera.fx, (f64::from(y) + 0.5 - camera.cy) / camera.fy);
        let range = depth * (1.0 + u * u + v * v).sqrt();
        let truth = DVec3::from(clear.get_pixel(x, y).0.map(decode));
        let expected = encode(Water::COASTAL.apply(truth, range));
        for c in 0..3 {
            let error = f64::from(pixel[c]) - f64::from(expected[c]);
            worst = worst.max(error.abs());
            sum += error;
        }
    }
    // Noise of 0.004 sqrt(I) is below 3 steps of 8 bits here, four deviations 12; a pixel on an edge mixes ranges.
    assert!(worst < 40.0, "worst {worst}");
    assert!((sum / (48.0 * 36.0 * 3.0)).abs() < 0.5, "mean error {sum}");
}

#[test]
fn without_water_the_photograph_is_the_clear_picture_and_noise() {
    let folder = made(&SynthOptions { water: Water::CLEAR, ..small() });
    let clear = image::open(folder.path().join("truth/clear/v0009.png")).unwrap().to_rgb8();
    let seen = image::open(folder.path().join("images/v0009.png")).unwrap().to_rgb8();
    let mean = clear.iter().zip(seen.iter()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>()
        / clear.as_raw().len() as f64;
    assert!(mean > 0.0 && mean < 3.0, "mean difference {mean}");
}

#[test]
fn every_sparse_point_lies_where_its_track_says() {
    let options = small();
    let world = wreck::build(options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = survey::poses(options.views, options.seed);
    let photographs: Vec<_> =
        (0..poses.len()).map(|v| Photograph::take(&world, &camera, &poses[v], v as u32, &options)).collect();
    let points = points::sparse_points(&world, &camera, &poses, &photographs, options.seed);
    assert!(points.len() > 300, "{} points", points.len());
    for point in &points {
        assert!(point.track.len() >= 2);
        for (view, pixel) in &point.track {
            let p = poses[*view as usize].transform(point.position);
            let (dx, dy) =
                (camera.fx * p.x / p.z + camera.cx - pixel[0], camera.fy * p.y / p.z + camera.cy - pixel[1]);
            // 0.3 px of noise at the view that found the point, at most three times nearer elsewhere, four deviations.
            assert!(dx.hypot(dy) < 0.3 * 3.0 * 5.0, "view {view}: off by {dx} {dy} pixels");
        }
    }
}

#[test]
fn a_folder_that_holds_a_scene_is_not_overwritten() {
    let folder = made(&small());
    let error = synthesise(folder.path(), &small(), |_, _| ()).unwrap_err().to_string();
    assert!(error.contains("holds images/ already"), "{error}");
}

#[test]
fn options_that_make_no_scene_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let refuse =
        |options: SynthOptions| synthesise(folder.path(), &options, |_, _| ()).unwrap_err().to_string();
    assert!(refuse(SynthOptions { views: 1, ..small() }).contains("--views is 1"));
    assert!(refuse(SynthOptions { width: 8, ..small() }).contains("--size is 8x36"));
}
