//! `fathom render` and `fathom eval` on models of other programs: sizes, maps, paths, orbits, formats.

use std::path::Path;

use crate::processes::{can_train, fail, json, succeed, under};
use fathom_core::config::Composition;
use fathom_core::gaussians::{Gaussians, SH_C0};
use fathom_core::ply;
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use image::GenericImageView as _;
use serde_json::{Value, json};

/// Distance of the wall from the origin, scene units.
const DISTANCE: f32 = 3.0;

/// Opaque flat discs 0.1 apart in the plane z = [`DISTANCE`], `half` of them on each side of the z axis.
fn wall(half: i32) -> Gaussians {
    let mut model = Gaussians::empty(0);
    for (row, column) in (-half..=half).flat_map(|row| (-half..=half).map(move |column| (row, column))) {
        let at = [0.1 * column as f32, 0.1 * row as f32, DISTANCE];
        model.means.push(at);
        model.quats.push([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.push([0.08_f32.ln(), 0.08_f32.ln(), 0.001_f32.ln()]);
        model.opacity_logits.push(4.0);
        // Red to the right, green downwards.
        let colour = [0.5 + 0.2 * at[0], 0.5 + 0.2 * at[1], 0.2];
        model.sh_coeffs.push(colour.map(|value| (value - 0.5) / SH_C0));
    }
    model
}

fn write_wall(folder: &Path, half: i32) -> String {
    let path = folder.join("wall.ply");
    ply::write_model(&path, &wall(half), &["not by fathom".to_owned()]).expect("a model");
    path.to_string_lossy().into_owned()
}

/// A camera at `position` that looks along +z, with axes parallel to the world's: 64 x 48 pixels, 77 degrees
/// wide.
fn camera(name: &str, position: [f64; 3]) -> Value {
    json!({"id": 0, "img_name": name, "width": 64, "height": 48, "position": position,
           "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 40.0, "fy": 40.0})
}

fn write_cameras(folder: &Path, cameras: &[Value]) -> String {
    let path = folder.join("cameras.json");
    std::fs::write(&path, json!(cameras).to_string()).expect("a file");
    path.to_string_lossy().into_owned()
}

/// The values and the header of an `.npy`.
fn read_npy(path: &Path) -> (String, Vec<f32>) {
    let bytes = std::fs::read(path).expect("an array");
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let header = String::from_utf8_lossy(&bytes[..128]).into_owned();
    (header, bytes[128..].chunks_exact(4).map(number).collect())
}

fn open(path: &Path) -> image::DynamicImage {
    image::open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The largest difference of two pictures, in 8-bit steps.
fn largest_difference(a: &Path, b: &Path) -> u8 {
    let (a, b) = (open(a).to_rgb8(), open(b).to_rgb8());
    assert_eq!(a.dimensions(), b.dimensions());
    a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

/// The mean difference of two pictures, in 8-bit steps.
fn mean_difference(a: &Path, b: &Path) -> f64 {
    let (a, b) = (open(a).to_rgb8(), open(b).to_rgb8());
    assert_eq!(a.dimensions(), b.dimensions());
    let sum: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.as_raw().len() as f64
}

fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry"));
    let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn maps_of_a_wall_have_its_distance_its_cover_and_its_normal() {
    if !can_train("maps_of_a_wall_have_its_distance_its_cover_and_its_normal") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    // The wall extends 1.2 to each side; the pictures see 2.4 x 1.8 to each side.
    let model = write_wall(folder.path(), 12);
    let cameras =
        write_cameras(folder.path(), &[camera("front.jpg", [0.0; 3]), camera("back.jpg", [0.0, 0.0, 6.0])]);
    let out = under(folder.path(), "out");
    let said = json(&[
        "render",
        &model,
        "--cameras",
        &cameras,
        "-o",
        &out,
        "--maps",
        "range,alpha,normal",
        "--allow-cpu",
        "--json",
    ]);
    assert_eq!(said["pictures"].as_array().map(Vec::len), Some(2));
    assert_eq!(said["maps"]["range"].as_array().map(Vec::len), Some(2), "{said}");
    let out = Path::new(&out);
    assert_eq!(names_in(out), ["alpha", "back.png", "front.png", "normal", "range"]);
    assert_eq!(
        names_in(&out.join("range")),
        ["back.npy", "back.png", "front.npy", "front.png", "scale.json"]
    );

    let (header, range) = read_npy(&out.join("range/front.npy"));
    assert!(header.contains("'shape': (48, 64)"), "{header}");
    let alpha = open(&out.join("alpha/front.png")).to_luma8();
    let normal = open(&out.join("normal/front.png")).to_rgb8();
    let grey = open(&out.join("range/front.png")).to_luma8();
    let mut walled = 0;
    for (x, y, cover) in alpha.enumerate_pixels() {
        let ray = [(f64::from(x) + 0.5 - 32.0) / 40.0, (f64::from(y) + 0.5 - 24.0) / 40.0];
        let at = ray.map(|slope| slope * f64::from(DISTANCE));
        let here = range[(y * 64 + x) as usize];
        if at.iter().all(|side| side.abs() < 1.1) {
            walled += 1;
            assert!(cover.0[0] > 250, "the wall at ({x}, {y}) covers {cover:?}");
            // The range is that of the blended Gaussians' centres, at most two deviations of 0.08 off the
            // ray: 0.05 along it.
            let expected = f64::from(DISTANCE) * (1.0 + ray[0] * ray[0] + ray[1] * ray[1]).sqrt();
            assert!(
                (f64::from(here) - expected).abs() < 0.05,
                "range {here} at ({x}, {y}), expected {expected}"
            );
            let [r, g, b] = normal.get_pixel(x, y).0;
            let towards_the_camera = r.abs_diff(128) <= 1 && g.abs_diff(128) <= 1 && b <= 1;
            assert!(towards_the_camera, "the normal at ({x}, {y}) is {:?}", [r, g, b]);
        } else if at.iter().any(|side| side.abs() > 1.7) {
            assert_eq!(
                (cover.0[0], here, grey.get_pixel(x, y).0[0]),
                (0, 0.0, 0),
                "nothing is at ({x}, {y})"
            );
            assert_eq!(normal.get_pixel(x, y).0, [128; 3]);
        }
    }
    assert!(walled > 500, "{walled} pixels were compared");
    // From behind, the wall is behind the camera.
    assert!(read_npy(&out.join("range/back.npy")).1.iter().all(|range| *range == 0.0));
}

#[test]
fn pictures_have_the_requested_size() {
    if !can_train("pictures_have_the_requested_size") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let model = write_wall(folder.path(), 12);
    let cameras = write_cameras(folder.path(), &[camera("a", [0.0; 3])]);
    let render = |name: &str, flags: &[&str]| {
        let out = under(folder.path(), name);
        let common = ["render", &model, "--cameras", &cameras, "-o", &out, "--maps", "range", "--allow-cpu"];
        succeed(&[&common[..], flags].concat());
        let picture = open(&Path::new(&out).join("a.png"));
        (picture.dimensions(), read_npy(&Path::new(&out).join("range/a.npy")).1)
    };
    let (plain, range) = render("plain", &[]);
    assert_eq!(plain, (64, 48));
    assert_eq!(render("reduced", &["--max-resolution", "32"]).0, (32, 24));
    let (size, doubled) = render("doubled", &["--scale", "2"]);
    assert_eq!(size, (128, 96));
    // A wide picture has the camera's whole picture in its middle: 64 x 48 doubled, 36 pixels in from each
    // side.
    let (size, wide) = render("wide", &["--size", "200x96"]);
    assert_eq!(size, (200, 96));
    for (x, y) in (20..44).flat_map(|x| (14..34).map(move |y| (x, y))) {
        let at = |range: &[f32], width: usize, left: usize| range[(2 * y + 1) * width + left + 2 * x + 1];
        let (near, far) = (at(&doubled, 128, 0), at(&wide, 200, 36));
        let here = range[y * 64 + x];
        // Pixels are counted from another corner, which rounds differently.
        assert!((near - far).abs() < 1e-5, "({x}, {y}): {near} {far}");
        // Half a pixel of the small picture is 0.0125 of the distance to the side, and 0.05 is as above.
        assert!((near - here).abs() < 0.06, "({x}, {y}): {near} {here}");
    }
    for (flags, words) in [
        (&["--size", "0x10"][..], &["1 to 16384 pixels"][..]),
        (&["--size", "20000x10"], &["1 to 16384 pixels"]),
        (&["--size", "10"], &["240x180"]),
        (&["--scale", "0"], &["above 0"]),
        (&["--scale", "0.001"], &["--scale 0.001", "64x48", "of a;"]),
        (&["--scale", "1e9"], &["larger than 16384 pixels", "--scale"]),
        (&["--scale", "2", "--size", "8x8"], &["cannot be used with"]),
        (&["--maps", "depth"], &["range, alpha, normal"]),
    ] {
        let out = under(folder.path(), "refused");
        let common = ["render", &model, "--cameras", &cameras, "-o", &out, "--allow-cpu"];
        let (_, said) = fail(&[&common[..], flags].concat());
        assert!(words.iter().all(|word| said.contains(word)), "{flags:?}: {said}");
        assert!(!Path::new(&out).exists(), "{flags:?} left a folder behind");
    }
}

#[test]
fn a_path_runs_through_the_cameras_in_the_order_of_their_file() {
    if !can_train("a_path_runs_through_the_cameras_in_the_order_of_their_file") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let model = write_wall(folder.path(), 12);
    // Evenly spaced, so that the middle of five frames is the middle camera; the names are in another order.
    let cameras = [("c", -0.6), ("a", 0.0), ("b", 0.6)].map(|(name, x)| camera(name, [x, 0.1 * x, 0.0]));
    let cameras = write_cameras(folder.path(), &cameras);
    let (stills, frames) = (under(folder.path(), "stills"), under(folder.path(), "frames"));
    succeed(&["render", &model, "--cameras", &cameras, "-o", &stills, "--allow-cpu"]);
    succeed(&["render", &model, "--cameras", &cameras, "--path", "5", "-o", &frames, "--allow-cpu"]);
    let expected: Vec<String> = (0..5).map(|frame| format!("frame_{frame:05}.png")).collect();
    assert_eq!(names_in(Path::new(&frames)), expected);
    let frame = |index: usize| Path::new(&frames).join(&expected[index]);
    for (index, name) in [(0, "c.png"), (2, "a.png"), (4, "b.png")] {
        let apart = largest_difference(&frame(index), &Path::new(&stills).join(name));
        // Poses reach the device by another computation: f64 rounding may change an 8-bit step.
        assert!(apart <= 1, "frame {index} is {apart} away from {name}");
    }
    assert!(largest_difference(&frame(0), &frame(1)) > 10, "the camera moves");
    let shorter = ["render", &model, "--cameras", &cameras, "--path", "3", "-o", &frames, "--allow-cpu"];
    let (_, said) = fail(&shorter);
    assert!(said.contains("frame_00003.png belongs to a film of more than 3 frames"), "{said}");
    let (_, said) = fail(&["render", &model, "--path", "5", "--allow-cpu"]);
    assert!(said.contains("--cameras"), "{said}");
    let (_, said) = fail(&["render", &model, "--cameras", &cameras, "--path", "0"]);
    assert!(said.contains("1..=100000"), "{said}");
}

#[test]
fn a_model_without_cameras_is_rendered_from_an_orbit() {
    if !can_train("a_model_without_cameras_is_rendered_from_an_orbit") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let model = write_wall(folder.path(), 5);
    let little = std::fs::read(&model).expect("a model");
    let end = little.windows(11).position(|word| word == b"end_header\n").expect("a header") + 11;
    let header = String::from_utf8_lossy(&little[..end]).into_owned();
    let numbers: Vec<f32> =
        little[end..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let rewrite = |name: &str, format: &str, body: &[u8]| {
        let path = under(folder.path(), name);
        let header = header.replace("binary_little_endian", format);
        std::fs::write(&path, [header.as_bytes(), body].concat()).expect("a model");
        path
    };
    let big: Vec<u8> = numbers.iter().flat_map(|value| value.to_be_bytes()).collect();
    let big = rewrite("big.ply", "binary_big_endian", &big);
    let text: String = numbers
        .chunks_exact(17)
        .map(|row| row.iter().map(f32::to_string).collect::<Vec<_>>().join(" ") + "\n")
        .collect();
    let text = rewrite("text.ply", "ascii", text.as_bytes());

    let orbit = |model: &str, name: &str| {
        let out = under(folder.path(), name);
        let said =
            json(&["render", model, "--orbit", "4", "--size", "40x40", "-o", &out, "--allow-cpu", "--json"]);
        assert_eq!(said["pictures"].as_array().map(Vec::len), Some(4));
        let centre = said["orbit"]["centre"][2].as_f64().expect("a number");
        assert!((centre - f64::from(DISTANCE)).abs() < 1e-6, "{said}");
        (0..4)
            .map(|frame| open(&Path::new(&out).join(format!("frame_{frame:05}.png"))).to_rgb8().into_raw())
            .collect::<Vec<_>>()
    };
    let frames = orbit(&model, "little");
    for (index, frame) in frames.iter().enumerate() {
        let middle = &frame[(20 * 40 + 20) * 3..][..3];
        assert!(middle.iter().any(|value| *value > 50), "frame {index} misses the model: {middle:?}");
    }
    // Seen from behind, left and right are swapped.
    let red = |frame: &[u8], x: usize| frame[(20 * 40 + x) * 3];
    assert!(red(&frames[0], 26) > red(&frames[0], 14) && red(&frames[2], 26) < red(&frames[2], 14));
    assert_eq!(orbit(&big, "big"), frames);
    assert_eq!(orbit(&text, "text"), frames);
}

#[test]
fn files_without_a_model_are_refused_with_a_remedy() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = |name: &str, bytes: &[u8]| {
        let path = under(folder.path(), name);
        std::fs::write(&path, bytes).expect("a file");
        path
    };
    let compressed = b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n\
        element vertex 0\nproperty uint packed_position\nend_header\n";
    for (path, words) in [
        (file("a.spz", b"\x1f\x8b\x08\x00"), &["a.spz", "a .spz file", "OUT.ply"][..]),
        (file("b.splat", &[0; 64]), &["b.splat", "a .splat file", "OUT.ply"]),
        (file("c.compressed.ply", compressed), &["compressed PLY", "OUT.ply"]),
        (file("d.png", b"\x89PNG\r\n\x1a\n\0\0"), &["d.png", "not a PLY file"]),
        (
            file("e.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"),
            &["\"y\""],
        ),
    ] {
        let (code, said) = fail(&["render", &path, "--orbit", "2"]);
        assert_eq!(code, 1);
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
    }
    let empty = under(folder.path(), "empty.ply");
    ply::write_model(Path::new(&empty), &Gaussians::empty(3), &[]).expect("a model");
    let (_, said) = fail(&["render", &empty, "--orbit", "2"]);
    assert!(said.contains("empty.ply") && said.contains("no visible Gaussian"), "{said}");
    let (code, said) = fail(&["render", &empty]);
    assert!(code == 2 && said.contains("--cameras") && said.contains("--orbit"), "{said}");
    let (_, said) = fail(&["inspect", &empty, "--no-plan"]);
    assert!(said.contains("fathom render"), "{said}");
}

#[test]
fn any_model_is_measured_without_points_and_on_every_view() {
    if !can_train("any_model_is_measured_without_points_and_on_every_view") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let model = write_wall(folder.path(), 5);
    let scene = under(folder.path(), "scene");
    succeed(&["synth", &scene, "--views", "3", "--size", "32x24"]);
    std::fs::remove_file(Path::new(&scene).join("sparse/0/points3D.bin")).expect("points");
    let metrics = json(&["eval", &model, "--data", &scene, "--test-every", "1", "--allow-cpu", "--json"]);
    assert_eq!(metrics["views"].as_array().map(Vec::len), Some(3));
    assert_eq!(metrics["gaussians"], 121);
    let psnr = metrics["psnr"].as_f64().expect("a number");
    assert!((1.0..20.0).contains(&psnr), "a wall is not the wreck: {psnr}");
    let (_, said) = fail(&["eval", &model]);
    assert!(said.contains("--data"), "{said}");
}

#[test]
fn export_turns_a_model_into_the_axes_of_its_plan_and_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let out = folder.path().join("out");
    std::fs::create_dir(&out).expect("a folder");
    let mut before = wall(2);
    before.sh_degree = 1;
    before.sh_coeffs = before
        .sh_coeffs
        .iter()
        .flat_map(|&dc| [dc, [0.3, 0.0, -0.1], [0.0, 0.2, 0.0], [-0.2, 0.1, 0.4]])
        .collect();
    ply::write_model(&out.join("model.ply"), &before, &["not by fathom".to_owned()]).expect("a model");
    let result = out.to_string_lossy().into_owned();
    let (_, error) = fail(&["export", &result, "--frame", "aligned", "-o", &at("aligned.ply")]);
    assert!(error.contains("plan.json"), "{error}");

    // Half a turn about x, then 30 degrees about y.
    let half = 15f64.to_radians();
    let quat = [0.0, half.cos(), 0.0, -half.sin()];
    let plan = json!({"alignment": {"world_to_aligned_quat_wxyz": quat}});
    std::fs::write(out.join("plan.json"), plan.to_string()).expect("a plan");
    succeed(&["export", &result, "--frame", "aligned", "-o", &at("aligned.ply")]);
    let aligned = ply::read_model(Path::new(&at("aligned.ply"))).expect("a model");
    let rotation = glam::DQuat::from_xyzw(quat[1], quat[2], quat[3], quat[0]);
    for (mean, turned) in before.means.iter().zip(&aligned.means) {
        let expected = rotation * glam::DVec3::from(mean.map(f64::from));
        assert!(expected.distance(glam::DVec3::from(turned.map(f64::from))) < 1e-6, "{mean:?} {turned:?}");
    }
    assert_ne!(aligned.sh_coeffs, before.sh_coeffs);
    let (_, error) = fail(&["export", &at("aligned.ply"), "--frame", "aligned", "-o", &at("again.ply")]);
    assert!(error.contains("already"), "{error}");

    succeed(&["export", &at("aligned.ply"), "-o", &at("back.ply")]);
    let back = ply::read_model(Path::new(&at("back.ply"))).expect("a model");
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-6);
    assert!(close(before.means.as_flattened(), back.means.as_flattened()));
    assert!(close(before.sh_coeffs.as_flattened(), back.sh_coeffs.as_flattened()));
    let reader = ply::SplatReader::open(Path::new(&at("back.ply"))).expect("a model");
    assert_eq!(reader.comments(), ["not by fathom"], "a comment of the other frame remains");
}

#[test]
fn an_aligned_model_renders_unchanged() {
    if !can_train("render an aligned model") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let model = write_wall(folder.path(), 10);
    let plan = json!({"alignment": {"world_to_aligned_quat_wxyz": [0.5, 0.5, -0.5, 0.5]}});
    std::fs::write(folder.path().join("plan.json"), plan.to_string()).expect("a plan");
    succeed(&["export", &model, "--frame", "aligned", "-o", &at("aligned.ply")]);
    let cameras = write_cameras(folder.path(), &[camera("a", [0.2, 0.1, 0.0])]);
    for (model, frames) in [(&model, "before"), (&at("aligned.ply"), "after")] {
        succeed(&["render", model, "--cameras", &cameras, "--allow-cpu", "-o", &at(frames)]);
    }
    let [before, after] =
        ["before/a.png", "after/a.png"].map(|name| open(&folder.path().join(name)).to_rgb8());
    let worst = before.as_raw().iter().zip(after.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
    // After the rotation and its inverse, means differ by f32 rounding.
    assert!(worst <= Some(2), "a pixel differs by {worst:?}");
    assert!(before.pixels().any(|pixel| pixel.0 != before.get_pixel(0, 0).0), "the picture is uniform");
}

#[test]
fn no_verb_reads_a_model_exported_in_linear_light() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = write_wall(folder.path(), 3);
    let to = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (plain, linear) = (to("plain.ply"), to("linear.ply"));
    succeed(&["export", &model, "-o", &plain]);
    assert_eq!(std::fs::read(&plain).expect("a copy"), std::fs::read(&model).expect("the model"));
    let said = succeed(&["export", &model, "--export-colour", "linear", "-o", &linear]);
    assert!(said.contains("linear.ply") && said.contains("49"), "{said}");
    let (before, after) = (wall(3), ply::read_model(Path::new(&linear)).expect("a model"));
    assert_eq!(after.means, before.means);
    for (before, after) in before.sh_coeffs.iter().zip(&after.sh_coeffs) {
        for c in 0..3 {
            let [srgb, light] = [before, after].map(|rgb| f64::from(0.5 + SH_C0 * rgb[c]));
            assert!((light - fathom_core::picture::srgb_to_linear(srgb)).abs() < 1e-6, "{srgb} and {light}");
        }
    }
    let cameras = write_cameras(folder.path(), &[camera("a", [0.0; 3])]);
    let (_, error) = fail(&["render", &linear, "--cameras", &cameras, "--allow-cpu", "-o", &to("frames")]);
    assert!(error.contains("linear light") && error.contains("linear.ply"), "{error}");
    let (_, error) = fail(&["export", &linear, "-o", &to("again.ply")]);
    assert!(error.contains("linear light"), "{error}");
    let (_, error) = fail(&["export", &model, "-o", &model]);
    assert!(error.contains("is the model itself"), "{error}");
    assert!(!Path::new(&to("again.ply")).exists());
}

#[test]
fn export_fits_viewer_colours_to_a_model_in_linear_light() {
    if !can_train("export colours for viewers") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    // A half-transparent blue wall in front of the coloured one.
    let mut model = wall(10);
    let behind = model.len();
    let front = wall(10);
    model.means.extend(front.means.iter().map(|&[x, y, _]| [x, y, DISTANCE - 0.5]));
    model.quats.extend(&front.quats);
    model.log_scales.extend(&front.log_scales);
    model.opacity_logits.extend(vec![-1.0; front.len()]);
    model.sh_coeffs.extend(vec![[0.05_f32, 0.1, 0.9].map(|value| (value - 0.5) / SH_C0); front.len()]);
    let water = Water { beta_d: [0.3, 0.1, 0.08], beta_b: [0.2, 0.1, 0.1], b_inf: [0.02, 0.1, 0.2] };
    let unknown = StandardErrors::default();
    let record = WaterRecord::new(&water, Composition::PixelsLinear, unknown, "fixed", 0.0);
    let record = record.to_comment().expect("a comment");
    ply::write_model(Path::new(&at("linear.ply")), &model, &[record]).expect("a model");
    let cameras = write_cameras(
        folder.path(),
        &[camera("a", [0.0; 3]), camera("b", [0.3, 0.0, 0.0]), camera("c", [0.0, -0.3, 0.0])],
    );
    let export = |model: &str, more: &[&str]| {
        let line = ["export", model, "--export-colour", "viewer", "-o", &at("viewer.ply"), "--allow-cpu"];
        line.iter().chain(more).map(|word| (*word).to_owned()).collect::<Vec<String>>()
    };
    let (_, error) = fail(&export(&at("linear.ply"), &[]));
    assert!(error.contains("cameras.json") && error.contains("--cameras"), "{error}");
    let (_, error) = fail(&["export", &at("linear.ply"), "-o", &at("viewer.ply"), "--iterations", "300"]);
    assert!(error.contains("--export-colour viewer"), "{error}");
    let (_, error) = fail(&export(&write_wall(folder.path(), 2), &["--cameras", &cameras]));
    assert!(error.contains("wall.ply") && error.contains("blended in sRGB"), "{error}");
    assert!(!Path::new(&at("viewer.ply")).exists());

    succeed(&export(&at("linear.ply"), &["--cameras", &cameras, "--iterations", "300"]));
    let fitted = ply::read_model(Path::new(&at("viewer.ply"))).expect("a model");
    assert_eq!(
        (fitted.means.clone(), fitted.opacity_logits.clone()),
        (model.means.clone(), model.opacity_logits.clone())
    );
    assert_eq!(ply::water_record(Path::new(&at("viewer.ply"))).expect("a model"), None);
    assert!(fitted.len() > behind);
    ply::write_model(Path::new(&at("plain.ply")), &model, &[]).expect("a model");
    for name in ["linear", "plain", "viewer"] {
        let model = at(&format!("{name}.ply"));
        succeed(&["render", &model, "--cameras", &cameras, "--allow-cpu", "-o", &at(name)]);
    }
    let off = |name: &str| {
        mean_difference(&folder.path().join("linear/b.png"), &folder.path().join(name).join("b.png"))
    };
    let [plain, fitted] = ["plain", "viewer"].map(off);
    assert!(plain > 4.0 && fitted < plain / 4.0, "8-bit steps: {plain} unchanged, {fitted} fitted");
}

#[test]
fn a_white_point_is_recorded_and_applied_to_all_outputs() {
    if !can_train("render with a white point") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let file = |name: &str| folder.path().join(name);
    let model = write_wall(folder.path(), 12);
    let before = std::fs::read(&model).expect("the model");
    let cameras =
        write_cameras(folder.path(), &[camera("a.jpg", [0.0; 3]), camera("b.jpg", [0.3, 0.0, 0.0])]);
    let render = |model: &str, more: &[&str], out: &str| {
        let out = at(out);
        let given = ["render", model, "--cameras", &cameras, "--allow-cpu", "-o", &out, "--json"];
        json(&[&given, more].concat())
    };
    let plain = render(&model, &[], "plain");
    assert!(plain.get("white_point").is_none() && !file("plain/white_point.json").exists());
    let auto = render(&model, &["--white-point", "auto"], "auto");
    let written: Value =
        serde_json::from_slice(&std::fs::read(file("auto/white_point.json")).expect("a file")).expect("JSON");
    assert_eq!((&written, &written["rule"]), (&auto["white_point"], &json!("auto")));
    // Red of the wall is 0.5 + 0.2 x: the gain raises it from below 0.74 to 0.9, less at the sparsely covered
    // rim.
    let gain = written["gains"][0].as_f64().expect("a gain");
    assert!((1.4..2.2).contains(&gain) && written["gains"][2] == written["gains"][0], "{written}");
    let brightest = *open(&file("auto/a.png")).to_rgb8().as_raw().iter().max().expect("pixels");
    assert!(
        (228..250).contains(&brightest),
        "0.9 of white is 229.5, and few pixels are brighter: \
        {brightest}"
    );

    let white = at("white.ply");
    let exported =
        ["export", &model, "--white-point", "auto", "--cameras", &cameras, "--allow-cpu", "-o", &white];
    assert!(succeed(&exported).contains("white point: auto"));
    render(&white, &[], "exported");
    // One blends discs before the curve, the other after it; near the rim they blend over black.
    let mean = mean_difference(&file("auto/a.png"), &file("exported/a.png"));
    assert!(mean < 1.0, "the pictures differ by {mean} steps");
    let (_, error) = fail(&["export", &white, "--white-point", "1,1,1", "-o", &at("again.ply")]);
    assert!(error.contains("was exported with a white point"), "{error}");
    assert_eq!(std::fs::read(&model).expect("the model"), before, "the model changed");

    render(&model, &["--chart", "32,24,20,24", "--chart-view", "a"], "chart");
    let picture = open(&file("chart/a.png")).to_rgb8();
    let light = |x: u32, c: usize| {
        fathom_core::picture::srgb_to_linear(f64::from(picture.get_pixel(x, 24).0[c]) / 255.0)
    };
    let mean = [0, 1, 2].map(|c| 0.5 * (light(20, c) + light(32, c)));
    // Red and green grow evenly to the right and down, so a patch equals its middle: within two steps of 117,
    // 2 % each.
    assert!(mean.iter().all(|value| (value / mean[1] - 1.0).abs() < 0.04), "grey in the mean: {mean:?}");
    let fails = |more: &[&str]| {
        fail(&[&["render", &model, "--cameras", &cameras, "--allow-cpu", "-o", &at("no")], more].concat()).1
    };
    assert!(fails(&["--chart", "64,3"]).contains("outside of the picture, which is 64x48"));
    assert!(fails(&["--chart", "2,2"]).contains("is no surface"));
    assert!(fails(&["--white-point", "auto", "--water", "only"]).contains("or omit --water"));
    assert!(fails(&["--white-point", "bright"]).contains("three numbers"));

    render(&model, &[], "auto");
    assert!(!file("auto/white_point.json").exists(), "an outdated white_point.json remains");
    assert_eq!(largest_difference(&file("plain/a.png"), &file("auto/a.png")), 0);
}
