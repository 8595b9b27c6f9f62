//! Properties of synthetic scenes.

use super::*;

fn small() -> SynthOptions {
    SynthOptions { views: 12, width: 48, height: 36, ..SynthOptions::default() }
}

fn small_forward() -> SynthOptions {
    SynthOptions { views: 24, width: 48, height: 36, ..SynthOptions::forward() }
}

fn grey(folder: &Path, file: &str) -> GrayImage {
    image::open(folder.join(file)).unwrap().to_luma8()
}

fn colours(folder: &Path, file: &str) -> RgbImage {
    image::open(folder.join(file)).unwrap().to_rgb8()
}

fn decode(v: u8) -> f64 {
    crate::picture::srgb_to_linear(f64::from(v) / 255.0)
}

/// z-depth of the `view`-th view with ground truth, metres.
fn depths(folder: &Path, view: usize, (width, height): (usize, usize)) -> Vec<f32> {
    let npz = bytes_of(folder, "truth/depth_m.npz");
    let header = 30 + "v0001.npy".len() + 128;
    let start = view * (header + 4 * width * height) + header;
    let numbers = npz[start..start + 4 * width * height].chunks_exact(4);
    numbers.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
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
fn equal_options_give_equal_bytes_on_any_number_of_threads() {
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
    // Noise of 0.004 sqrt(I) is below 3 steps of 8 bits here, so four standard deviations are 12. A pixel on
    // an edge mixes ranges.
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
fn every_sparse_point_projects_to_its_track() {
    let options = small();
    let world = wreck::build(options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = survey::poses(options.views, options.seed);
    let photographs: Vec<_> =
        (0..poses.len()).map(|v| Photograph::take(&world, &camera, &poses[v], v as u32, &options)).collect();
    let points = points::sparse_points(&world, &camera, &poses, &photographs, &options);
    assert!(points.len() > 300, "{} points", points.len());
    for point in &points {
        assert!(point.track.len() >= 2);
        for (view, pixel) in &point.track {
            let p = poses[*view as usize].transform(point.position);
            let (dx, dy) =
                (camera.fx * p.x / p.z + camera.cx - pixel[0], camera.fy * p.y / p.z + camera.cy - pixel[1]);
            // The noise is 0.3 px in the view that found the point; other views are at most three times
            // nearer. The limit is five standard deviations.
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
fn invalid_options_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let refuse =
        |options: SynthOptions| synthesise(folder.path(), &options, |_, _| ()).unwrap_err().to_string();
    assert!(refuse(SynthOptions { views: 1, ..small() }).contains("--views is 1"));
    assert!(refuse(SynthOptions { width: 8, ..small() }).contains("--size is 8x36"));
    let unsound = ByDirection { most: -1.0, ..BRIGHTER_UPWARDS };
    assert!(
        refuse(SynthOptions { by_direction: Some(unsound), ..small() }).contains("the colours by direction")
    );
    let unphysical = Water { b_inf: [2.0; 3], ..Water::COASTAL };
    assert!(refuse(SynthOptions { water: unphysical, ..small() }).contains("the water must have"));
}

#[test]
fn looking_down_there_is_no_open_water_and_no_alpha_or_kind() {
    assert_eq!(SynthOptions::default().look, Look::Down);
    let folder = made(&small());
    assert!(!folder.path().join("truth/alpha").exists() && !folder.path().join("truth/kind").exists());
    assert!(grey(folder.path(), "truth/valid/v0009.png").iter().all(|valid| *valid == 255));
    let water: serde_json::Value =
        serde_json::from_slice(&bytes_of(folder.path(), "truth/water.json")).unwrap();
    assert_eq!(water.as_object().unwrap().len(), 7, "{water}");
}

#[test]
fn the_forward_look_is_the_same_on_any_number_of_threads() {
    let many = made(&small_forward());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let one = pool.install(|| made(&small_forward()));
    for file in FILES.into_iter().chain(["truth/alpha/v0009.png", "truth/kind/v0009.png", "truth/water.json"])
    {
        assert!(bytes_of(many.path(), file) == bytes_of(one.path(), file), "{file} differs");
    }
}

#[test]
fn looking_forward_shows_open_water_and_all_kinds_of_surface() {
    let folder = made(&SynthOptions { views: 72, ..small_forward() });
    let (mut of_kind, mut open_views) = ([0_usize; 4], 0);
    for view in (1..=72).step_by(TRUTH_EVERY) {
        let name = format!("v{view:04}.png");
        let [kind, alpha, valid] =
            ["kind", "alpha", "valid"].map(|map| grey(folder.path(), &format!("truth/{map}/{name}")));
        let clear = colours(folder.path(), &format!("truth/clear/{name}"));
        let mut open = 0;
        for (((kind, alpha), valid), clear) in
            kind.iter().zip(alpha.iter()).zip(valid.iter()).zip(clear.pixels())
        {
            of_kind[usize::from(*kind)] += 1;
            open += usize::from(*kind == 0);
            assert_eq!(*kind == 0, *alpha == 0, "open water is where no ray meets a surface");
            assert_eq!(*valid == 255, *alpha == 255, "J is known where all rays meet one");
            assert!(*kind < 2 || *alpha == 255, "dark and smooth are whole pixels");
            assert!(*alpha > 0 || clear.0 == [0; 3], "there is no J of open water");
        }
        // Typically a quarter to a third.
        open_views += usize::from((0.15..0.45).contains(&(open as f64 / (48.0 * 36.0))));
    }
    assert!(open_views >= 8, "{open_views} of 9 held-out views show 15 to 45 % of open water");
    let all = of_kind.iter().sum::<usize>() as f64;
    for (kind, least) in [(0, 0.22), (1, 0.4), (2, 0.03), (3, 0.02)] {
        let share = of_kind[kind] as f64 / all;
        assert!(share > least, "kind {kind} has {share} of the pixels");
    }
}

#[test]
fn looking_forward_the_water_is_brighter_upwards() {
    let options = small_forward();
    let folder = made(&options);
    let camera = survey::camera(48, 36);
    let poses = options.look.poses(options.views, options.seed);
    let (mut sum, mut count, mut open, mut dark) = (0.0, 0, [[f64::MAX, f64::MIN]; 3], 0);
    for (index, view) in (0..24).step_by(TRUTH_EVERY).enumerate() {
        let name = format!("v{:04}.png", view + 1);
        let (seen, clear) = (
            colours(folder.path(), &format!("images/{name}")),
            colours(folder.path(), &format!("truth/clear/{name}")),
        );
        let [alpha, kind] = ["alpha", "kind"].map(|map| grey(folder.path(), &format!("truth/{map}/{name}")));
        let depths = depths(folder.path(), index, (48, 36));
        for (x, y, pixel) in seen.enumerate_pixels() {
            let direction = pixel_ray(&camera, &poses[view], [f64::from(x) + 0.5, f64::from(y) + 0.5]);
            let depth = f64::from(depths[(y * 48 + x) as usize]);
            let range = depth / direction.dot(poses[view].forward());
            let water = BRIGHTER_UPWARDS.along(&Water::COASTAL, direction);
            let expected = match alpha.get_pixel(x, y).0 {
                [0] => {
                    assert_eq!(depth, 0.0);
                    let factors = BRIGHTER_UPWARDS.factors(direction);
                    for (c, [least, most]) in open.iter_mut().enumerate() {
                        (*least, *most) = (least.min(factors[c]), most.max(factors[c]));
                    }
                    encode(DVec3::from(water.b_inf))
                }
                // On a distant rough floor, the ranges of a pixel's rays differ; here they hardly do.
                [255] if range < 6.0 || kind.get_pixel(x, y).0 == [2] => {
                    dark += u32::from(kind.get_pixel(x, y).0 == [2]);
                    encode(water.apply(DVec3::from(clear.get_pixel(x, y).0.map(decode)), range))
                }
                _ => continue,
            };
            for c in 0..3 {
                let error = f64::from(pixel[c]) - f64::from(expected[c]);
                // As above.
                assert!(error.abs() < 40.0, "{name} at {x}, {y}: {pixel:?} for {expected:?}");
                sum += error;
                count += 1;
            }
        }
    }
    assert!(count > 3000 && dark > 20, "{count} values, {dark} dark pixels");
    assert!((sum / f64::from(count)).abs() < 0.5, "mean error {}", sum / f64::from(count));
    for (c, [least, most]) in open.into_iter().enumerate() {
        assert!((1.5..2.5).contains(&(most / least)), "channel {c}: open water from {least} to {most}");
    }
}

#[test]
fn looking_forward_points_have_several_ranges_and_texture() {
    let options = SynthOptions { views: 72, ..small_forward() };
    let world = options.look.world(options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = options.look.poses(options.views, options.seed);
    for (view, pose) in poses.iter().enumerate() {
        let down = pose.forward().y.asin().to_degrees();
        assert!((0.0..=15.5).contains(&down), "view {view} looks {down} degrees down");
        let eye = pose.centre();
        let above = world.floor.y_at(eye.x, eye.z) - eye.y;
        assert!((1.2..4.5).contains(&above), "view {view} is {above} m above the floor");
    }
    let photographs: Vec<_> =
        (0..poses.len()).map(|v| Photograph::take(&world, &camera, &poses[v], v as u32, &options)).collect();
    let points = points::sparse_points(&world, &camera, &poses, &photographs, &options);
    assert!(points.len() > 3000, "{} points", points.len());
    let mut from_several = 0;
    for point in &points {
        let range = |view: u32| (point.position - poses[view as usize].centre()).length();
        let ranges = point.track.iter().map(|(view, _)| range(*view));
        let [near, far] = ranges.fold([f64::MAX, 0.0], |[near, far]: [f64; 2], r| [near.min(r), far.max(r)]);
        from_several += usize::from(far >= 2.0 * near);
        assert!(far < 60.0, "no point lies in open water");
    }
    assert!(2 * from_several > points.len(), "{from_several} of {} from ranges of 1 to 2", points.len());
    let on_smooth = points.iter().flat_map(|point| &point.track).filter(|(view, [x, y])| {
        let photograph = &photographs[*view as usize];
        photograph.met[(*y as u32 * options.width + *x as u32) as usize].smooth == photograph.rays
    });
    let observations = points.iter().map(|point| point.track.len()).sum::<usize>();
    // The rest are points behind the foot of a plate, within the tolerance of `sees`.
    let on_smooth = on_smooth.count();
    assert!(
        500 * on_smooth < observations,
        "{on_smooth} of {observations} observations are of smooth surfaces"
    );
}
