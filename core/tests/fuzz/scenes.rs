//! Scenes: COLMAP as binary and text, nerfstudio, the cameras of 3DGS, point clouds.

use fathom_core::config::DataConfig;
use fathom_core::scene::{CameraPath, Purpose, Scene, load_scene};
use fathom_fuzz::{Folder, Target, run};

use crate::Bytes;

/// Far beyond any scene, but its square still fits an f32: see `MAX_COORDINATE` in `core::scene`.
const FAR: f64 = 1e13;

/// Everything that the program does with a scene before it reads a photograph.
fn use_scene(scene: &Scene) {
    for camera in &scene.cameras {
        assert!(camera.params.iter().all(|value| value.is_finite()), "{camera:?}");
        if let Ok(pinhole) = camera.pinhole() {
            let direction = pinhole.direction(0);
            assert!(direction.is_finite(), "{pinhole:?} looks at {direction}");
        }
    }
    for view in &scene.views {
        let centre = view.pose.centre();
        assert!(view.pose.is_sound() && centre.length() < FAR, "{view:?}");
        assert!(scene.camera(view.camera_id).is_some(), "{view:?} has no camera");
        assert!(!view.name.contains("..") || !view.name.split('/').any(|part| part == ".."), "{view:?}");
    }
    let near = |position: &[f32; 3]| position.iter().all(|value| f64::from(value.abs()) < FAR);
    assert!(scene.points.positions.iter().all(near), "a point is not finite or too far away");
    assert!(scene.extent().is_finite());
    assert!(scene.viewing_distance().is_none_or(f64::is_finite));
    for point in 0..scene.points.len() {
        let track = scene.points.tracks.of(point);
        assert!(track.iter().all(|view| (*view as usize) < scene.views.len()), "point {point}: {track:?}");
        for [x, y] in scene.points.tracks.seen(point).filter_map(|(_, place)| place.pixel(48, 36)) {
            assert!((0.0..48.0).contains(&x) && (0.0..36.0).contains(&y), "point {point}: {x}, {y}");
        }
    }
}

fn inspect(path: &std::path::Path) -> bool {
    let scene = load_scene(path, Purpose::Inspect, &DataConfig::default());
    scene.as_ref().inspect(|scene| use_scene(scene)).is_ok()
}

fn cameras_bin() -> Vec<u8> {
    let opencv = [40.0, 41.0, 24.0, 18.0, 0.01, -0.02, 0.001, 0.002];
    let cameras = Bytes::default().u64(3).u32(1).u32(1).u64(48).u64(36).f64s(&[40.0, 41.0, 24.0, 18.0]);
    let cameras = cameras.u32(7).u32(4).u64(48).u64(36).f64s(&opencv);
    cameras.u32(8).u32(2).u64(48).u64(36).f64s(&[40.0, 24.0, 18.0, 0.05]).0
}

fn images_bin() -> Vec<u8> {
    let mut images = Bytes::default().u64(3);
    for (id, name) in [(1_u32, "a.png"), (2, "left/b c.png"), (9, "z.png")] {
        images = images.u32(id).f64s(&[0.9, 0.1, -0.2, 0.3]).f64s(&[f64::from(id), -2.0, 0.5]);
        images = images.u32(if id == 2 { 7 } else { 1 }).u8s(name.as_bytes()).u8s(&[0]).u64(2);
        images = images.f64s(&[1.5, 2.5]).u64(1).f64s(&[3.5, 4.5]).u64(u64::MAX);
    }
    images.0
}

fn points_bin() -> Vec<u8> {
    let mut points = Bytes::default().u64(4);
    for id in 1..=4_u64 {
        points = points.u64(id).f64s(&[id as f64, 0.25, 3.0]).u8s(&[10, 20, 30]).f64s(&[0.5]).u64(id % 3);
        for image in 0..id % 3 {
            points = points.u32([1, 9][image as usize]).u32(image as u32);
        }
    }
    points.0
}

const CAMERAS_TXT: &str = "# Camera list\n1 PINHOLE 48 36 40 41 24 18\n7 OPENCV 48 36 40 41 24 18 .01 -.02 .001 .002\n\
                           8 SIMPLE_RADIAL 48 36 40 24 18 0.05\n";
const IMAGES_TXT: &str = "# Image list\n1 0.9 0.1 -0.2 0.3 1 -2 0.5 1 a.png\n1.5 2.5 1 3.5 4.5 -1\n\
                          2 0.9 0.1 -0.2 0.3 2 -2 0.5 7 left/b c.png\n\n9 1 0 0 0 9 -2 0.5 1 z.png\n1.5 2.5 1\n";
const POINTS_TXT: &str =
    "# 3D points\n1 1 0.25 3 10 20 30 0.5 1 0\n2 2 0.25 3 10 20 30 0.5 1 0 9 1\n3 3 1e-1 3 0 0 255 0.5\n";

/// A COLMAP model with the fuzzed input as one of its files.
fn colmap(test: &str, hostile: &str, words: &[&str]) {
    let folder = Folder::new(test);
    let binary = hostile.ends_with(".bin");
    let sound: [(&str, Vec<u8>); 3] = if binary {
        [("cameras.bin", cameras_bin()), ("images.bin", images_bin()), ("points3D.bin", points_bin())]
    } else {
        [
            ("cameras.txt", CAMERAS_TXT.into()),
            ("images.txt", IMAGES_TXT.into()),
            ("points3D.txt", POINTS_TXT.into()),
        ]
    };
    let mut corpus = Vec::new();
    for (name, bytes) in sound {
        folder.put(&format!("sparse/0/{name}"), &bytes);
        if name == hostile {
            corpus.push(bytes);
        }
    }
    let path = folder.path().join("sparse/0").join(hostile);
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        inspect(folder.path())
    };
    run(&Target { words, ..Target::new(&format!("COLMAP {hostile}"), corpus, &read) });
}

#[test]
fn fuzzed_colmap_cameras_are_read_or_refused() {
    colmap("cameras-bin", "cameras.bin", &[]);
    let models = [" FULL_OPENCV ", " FOV ", " SIMPLE_RADIAL ", " EQUIRECTANGULAR ", "#", "\n\n"];
    colmap("cameras-txt", "cameras.txt", &models);
}

#[test]
fn fuzzed_colmap_images_are_read_or_refused() {
    let names = ["../../etc/passwd", "/etc/passwd", "C:\\a.png", "\n\n", "#", "a.png"];
    colmap("images-bin", "images.bin", &names);
    colmap("images-txt", "images.txt", &names);
}

#[test]
fn fuzzed_colmap_points_are_read_or_refused() {
    colmap("points-bin", "points3D.bin", &[]);
    colmap("points-txt", "points3D.txt", &["\n\n", "#", " 9 1", " 1 0"]);
}

const TRANSFORMS: &str = r#"{"camera_model": "OPENCV", "fl_x": 40.5, "fl_y": 41, "cx": 24, "cy": 18, "w": 48, "h": 36.0,
"k1": 0.01, "k2": 0, "p1": 0, "p2": 0, "applied_scale": 1.0, "ply_file_path": "cloud.ply", "frames": [
{"file_path": "./images/a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]},
{"file_path": "images/b", "mask_path": "masks/b.png", "fl_x": 50, "k3": 0.001,
 "transform_matrix": [[0,-1,0,1],[1,0,0,2],[0,0,1,3.5]]}]}"#;
const ANGLES: &str = r#"{"camera_angle_x": 0.69, "w": 800, "h": 800, "frames": [{"file_path": "train/r_0",
"rotation": 0.01, "transform_matrix": [[-0.9999,0.0042,-0.0133,-0.0538],[-0.0140,-0.2997,0.9539,3.8455],
[-4.66e-10,0.9540,0.2997,1.2081],[0,0,0,1]]}]}"#;

#[test]
fn fuzzed_transforms_of_nerfstudio_are_read_or_refused() {
    let folder = Folder::new("transforms");
    folder.put("cloud.ply", crate::models::CLOUD.as_bytes());
    let read = |bytes: &[u8]| inspect(&folder.put("transforms.json", bytes));
    let words =
        ["\"k1\": 1e300, ", "\"w\": 65535, ", "OPENCV_FISHEYE", "../", "[[", "]]", "{", "\"frames\": [], "];
    run(&Target {
        words: &words,
        ..Target::new("transforms.json", vec![TRANSFORMS.into(), ANGLES.into()], &read)
    });
}

#[test]
fn fuzzed_cameras_of_3dgs_are_read_or_refused_and_make_a_path() {
    let folder = Folder::new("cameras-json");
    let camera = |id: u32, x: f64| {
        format!(
            r#"{{"id": {id}, "img_name": "img_{id}", "width": 48, "height": 36, "position": [{x}, 0.5, -2],
"rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "fx": 40.5, "fy": 41}}"#
        )
    };
    let corpus = vec![format!("[{}, {}, {}]", camera(0, 1.0), camera(1, 2.0), camera(2, 2.5)).into_bytes()];
    let read = |bytes: &[u8]| {
        let path = folder.put("cameras.json", bytes);
        let Ok(scene) = load_scene(&path, Purpose::Inspect, &DataConfig::default()) else { return false };
        use_scene(&scene);
        let keys: Vec<_> = scene
            .views
            .iter()
            .map(|view| (scene.camera(view.camera_id).unwrap().pinhole().unwrap(), view.pose))
            .collect();
        if let Ok(path) = CameraPath::new(&keys) {
            for (camera, pose) in path.frames(7) {
                assert!(pose.is_sound() && camera.fx.is_finite(), "{camera:?} {pose:?}");
            }
        }
        true
    };
    run(&Target::new("cameras.json", corpus, &read));
}

#[test]
fn fuzzed_clouds_of_points_are_read_or_refused() {
    let folder = Folder::new("cloud");
    folder.put("transforms.json", TRANSFORMS.as_bytes());
    let path = folder.path().join("cloud.ply");
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        inspect(folder.path())
    };
    run(&Target {
        words: &crate::models::PLY_WORDS,
        ..Target::new("cloud PLY", crate::models::clouds(), &read)
    });
}
