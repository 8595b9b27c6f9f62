//! Properties of pools.

use image::Rgb;

use super::*;
use crate::config::DataConfig;
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::scene::{Purpose, load_scene};

fn small() -> PoolOptions {
    PoolOptions { views: 18, width: 64, height: 48, points_per_view: 60, ..PoolOptions::default() }
}

fn made(options: &PoolOptions) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    synthesise_pool(folder.path(), options, |_, _| ()).unwrap();
    folder
}

fn colours(folder: &Path, file: &str) -> RgbImage {
    image::open(folder.join(file)).unwrap().to_rgb8()
}

/// Mean difference of two pictures in 8-bit steps, over pixels where `of` is true.
fn apart(a: &RgbImage, b: &RgbImage, of: impl Fn(u32, u32) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (x, y, Rgb(a)) in a.enumerate_pixels() {
        if of(x, y) {
            let Rgb(b) = b.get_pixel(x, y);
            sum += (0..3).map(|c| f64::from(a[c].abs_diff(b[c]))).sum::<f64>() / 3.0;
            count += 1.0;
        }
    }
    sum / f64::max(count, 1.0)
}

#[test]
fn a_pool_has_the_same_bytes_on_any_number_of_threads() {
    let many = made(&small());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let one = pool.install(|| made(&small()));
    for file in [
        "images/v0001.png",
        "images/v0018.png",
        "sparse/0/points3D.bin",
        "sparse/0/images.bin",
        "truth/oil/v0009.png",
        "truth/refracted/v0017.png",
        "truth/surface.json",
    ] {
        let read = |folder: &Path| std::fs::read(folder.join(file)).unwrap();
        assert!(read(many.path()) == read(one.path()), "{file} differs");
    }
}

#[test]
fn the_truth_of_a_pool_explains_its_photographs() {
    truth_explains_photographs(&small());
}

#[test]
fn the_truth_of_a_long_pool_explains_its_photographs() {
    let options = PoolOptions { length: 6.0, views: 24, ..small() };
    let folder = truth_explains_photographs(&options);
    let surface = std::fs::read(folder.path().join("truth/surface.json")).unwrap();
    let surface: serde_json::Value = serde_json::from_slice(&surface).unwrap();
    assert_eq!(surface["half_size"], serde_json::json!([3.0, 1.0]));
}

/// The folder of a pool whose photographs were compared with their truth.
fn truth_explains_photographs(options: &PoolOptions) -> tempfile::TempDir {
    let folder = made(options);
    for view in ["v0001.png", "v0009.png", "v0017.png"] {
        let picture = |kind: &str| colours(folder.path(), &format!("{kind}/{view}"));
        let region = image::open(folder.path().join("truth/region").join(view)).unwrap().to_luma8();
        let is_wet = |x: u32, y: u32| region.get_pixel(x, y).0[0] == 255;
        let wet = region.pixels().filter(|pixel| pixel.0[0] == 255).count();
        assert!(wet > 300, "{view}: {wet} of {} pixels show water", 64 * 48);
        let (photograph, dry) = (picture("images"), picture("truth/dry"));
        let (reflected, refracted) = (picture("truth/reflected"), picture("truth/refracted"));
        // Where R and T are black, no ray meets water, and the surface changes nothing but the noise.
        let is_dry = |x: u32, y: u32| {
            let black = |picture: &RgbImage| picture.get_pixel(x, y).0 == [0; 3];
            !is_wet(x, y) && black(&reflected) && black(&refracted)
        };
        assert!(apart(&photograph, &dry, is_dry) < 2.0, "{view}: {}", apart(&photograph, &dry, is_dry));
        assert!(apart(&photograph, &dry, is_wet) > 8.0, "{view}: refraction moves what is seen");
        let oil = picture("truth/oil");
        assert!(apart(&photograph, &oil, is_wet) > 3.0, "{view}: oil bends more");
        // I lies between R and T, up to noise and the mean within a pixel.
        let (mut outside, mut count) = (0, 0);
        for (x, y, Rgb(seen)) in photograph.enumerate_pixels() {
            if is_wet(x, y) {
                let (Rgb(r), Rgb(t)) = (reflected.get_pixel(x, y), refracted.get_pixel(x, y));
                count += 3;
                outside += (0..3)
                    .filter(|&c| {
                        let (low, high) =
                            (r[c].min(t[c]).saturating_sub(8), r[c].max(t[c]).saturating_add(8));
                        !(low..=high).contains(&seen[c])
                    })
                    .count();
            }
        }
        assert!(outside * 50 < count, "{view}: {outside} of {count} values are not between R and T");
    }
    folder
}

#[test]
fn a_pixel_of_a_pool_is_the_mean_over_its_area() {
    // The mean of 8 x 8 pixels of a larger picture is nearly exact.
    const FINER: u32 = 8;
    let options = small();
    let (water, pose) = (options.water(), poses(&options)[9]);
    let world = hall::build(&water.basin, options.seed);
    let take = |factor: u32| {
        let camera = survey::camera(factor * options.width, factor * options.height);
        Photograph::take(&world, &water, &camera, &pose, 9, &options).pixels
    };
    let (photograph, fine) = (take(1), take(FINER));
    let mut sum = 0.0;
    for (x, y, Rgb(seen)) in photograph.enumerate_pixels() {
        for (c, seen) in seen.iter().enumerate() {
            let parts = (0..FINER * FINER).map(|i| {
                let Rgb(part) = fine.get_pixel(FINER * x + i % FINER, FINER * y + i / FINER);
                srgb_to_linear(f64::from(part[c]) / 255.0)
            });
            let mean = parts.sum::<f64>() / f64::from(FINER * FINER);
            sum += (linear_to_srgb(mean) - f64::from(*seen) / 255.0).powi(2);
        }
    }
    let psnr = -10.0 * (sum / f64::from(3 * options.width * options.height)).log10();
    // 2x2 rays a pixel reached 31.7 dB.
    assert!(psnr > 38.0, "{psnr} dB");
}

#[test]
fn cameras_and_points_fill_the_whole_length_of_a_pool() {
    let options = PoolOptions { length: 6.0, views: 36, ..small() };
    let folder = made(&options);
    let scene = load_scene(folder.path(), Purpose::Train, &DataConfig::default()).unwrap();
    // Of each metre of the length: how many cameras are there, and how many points of the water.
    let part = |x: f64| (x + 3.0) as usize;
    let (mut cameras, mut points) = ([0; 6], [0; 6]);
    for view in &scene.views {
        let at = view.pose.centre();
        assert!(at.x.abs() < 4.0 && at.y < -0.5, "a camera is at {at}");
        cameras[part(at.x).min(5)] += 1;
    }
    for &[x, y, z] in &scene.points.positions {
        if y > 0.2 && x.abs() < 3.0 && z.abs() < 1.0 {
            points[part(x.into())] += 1;
        }
    }
    assert!(cameras.iter().all(|count| *count >= 2), "cameras: {cameras:?}");
    assert!(points.iter().all(|count| *count >= 5), "points: {points:?}");
}

#[test]
fn points_in_the_water_come_out_too_high_and_less_exact() {
    let options = PoolOptions { views: 36, width: 160, height: 120, ..small() };
    let folder = made(&options);
    let scene = load_scene(folder.path(), Purpose::Train, &DataConfig::default()).unwrap();
    assert_eq!(scene.views.len(), 36);
    let water = options.water();
    let world = hall::build(&water.basin, options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = poses(&options);
    let take = |view: usize| Photograph::take(&world, &water, &camera, &poses[view], view, &options);
    let photographs: Vec<_> = (0..poses.len()).into_par_iter().map(take).collect();
    let points = points::sparse_points(&world, &water, &camera, &poses, &photographs, &options);
    let middle = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    // Straight rays lift the ground of the pool: to three quarters of its depth seen from above.
    let bottom = hall::SURFACE_Y + options.depth;
    let in_basin = |point: &DVec3| point.x.abs() < 0.9 && point.z.abs() < 0.9;
    let wet: Vec<_> =
        points.iter().filter(|p| in_basin(&p.position) && p.position.y > hall::SURFACE_Y + 0.15).collect();
    let dry: Vec<_> = points.iter().filter(|p| p.position.y < -0.005).collect();
    assert!(wet.len() > 150 && dry.len() > 150, "{} wet and {} dry points", wet.len(), dry.len());
    let y = middle(wet.iter().map(|p| p.position.y).collect());
    assert!(y < bottom - 0.12, "the median of the points is at {y}, the ground at {bottom}");
    let errors = |of: &[&super::super::points::SparsePoint]| middle(of.iter().map(|p| p.error_px).collect());
    let (wet, dry) = (errors(&wet), errors(&dry));
    assert!(dry < 0.6, "dry: {dry} px");
    assert!(wet > 1.5 * dry, "wet: {wet} px, dry: {dry} px");
    println!("median reprojection error: wet {wet:.2} px, dry {dry:.2} px");
}

#[test]
fn options_out_of_range_are_refused_by_name() {
    let said = |options: PoolOptions| {
        let folder = tempfile::tempdir().unwrap();
        let refused = synthesise_pool(folder.path(), &options, |_, _| ()).unwrap_err().to_string();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "something was written");
        refused
    };
    assert!(said(PoolOptions { depth: 0.0, ..small() }).contains("--depth is 0"));
    assert!(said(PoolOptions { depth: f64::NAN, ..small() }).contains("--depth"));
    assert!(said(PoolOptions { length: 1.9, ..small() }).contains("--length is 1.9"));
    assert!(said(PoolOptions { ior: 0.9, ..small() }).contains("--ior is 0.9"));
    assert!(said(PoolOptions { views: 1, ..small() }).contains("--views is 1"));
}
