//! nerfstudio's `transforms.json` and the `cameras.json` of 3DGS.

use glam::DVec3;
use serde_json::{Value, json};

use super::fixture::{Dataset, HEIGHT, Model, WIDTH, assert_says, write_png};
use crate::config::DataConfig;
use crate::scene::{CameraModel, Purpose, Scene, load_foreign_scene};

/// A camera at (1, 2, 3) that looks along world -z with its up along +y, as OpenGL cameras do at rest.
fn at_rest() -> Value {
    json!([[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
}

fn frame(path: &str) -> Value {
    json!({"file_path": path, "transform_matrix": at_rest()})
}

fn transforms() -> Value {
    json!({
        "fl_x": 10.0, "fl_y": 11.0, "cx": 4.5, "cy": 2.5, "w": 8, "h": 6.0,
        "ply_file_path": "points.ply",
        "frames": [frame("./images/b.png"), frame("images/a.png"), frame("images/c")],
    })
}

const POINTS: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
    property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n0.5 1 -2 10 20 30\n1e0 2 3 255 0 1\n";

fn dataset(transforms: &Value) -> Dataset {
    let dataset = Dataset::empty();
    for name in ["a.png", "b.png", "c.png"] {
        write_png(&dataset.path("images").join(name), WIDTH, HEIGHT);
    }
    dataset.write("points.ply", POINTS);
    dataset.write("transforms.json", transforms.to_string());
    dataset
}

fn names(scene: &Scene) -> Vec<&str> {
    scene.views.iter().map(|view| view.name.as_str()).collect()
}

fn assert_near(a: DVec3, b: DVec3) {
    assert!(a.distance(b) < 1e-12, "{a} is not {b}");
}

#[test]
fn opengl_cameras_become_world_to_camera() {
    let scene = dataset(&transforms()).train();
    assert_eq!(scene.source, "nerfstudio");
    assert_eq!(names(&scene), ["images/a.png", "images/b.png", "images/c.png"]);
    let pose = scene.views[0].pose;
    assert_near(pose.centre(), DVec3::new(1.0, 2.0, 3.0));
    assert_near(pose.forward(), DVec3::NEG_Z);
    assert_near(pose.down(), DVec3::NEG_Y);
    // One unit ahead, slightly to the right and below: positive x, y, z in our camera.
    assert_near(pose.transform(DVec3::new(1.25, 1.5, 2.0)), DVec3::new(0.25, 0.5, 1.0));
    assert_eq!(scene.cameras.len(), 1);
    assert_eq!(
        (scene.cameras[0].model, &scene.cameras[0].params[..]),
        (CameraModel::Pinhole, &[10.0, 11.0, 4.5, 2.5][..])
    );
    assert_eq!(scene.points.positions, [[0.5, 1.0, -2.0], [1.0, 2.0, 3.0]]);
    assert_eq!(scene.points.colours, [[10, 20, 30], [255, 0, 1]]);
    assert_eq!(scene.warnings, Vec::<String>::new());
}

#[test]
fn paths_of_a_foreign_scene_stay_in_its_folder() {
    let foreign = |transforms: &Value| {
        let dataset = dataset(transforms);
        load_foreign_scene(&dataset.path(""), &DataConfig::default())
    };
    assert_eq!(foreign(&transforms()).unwrap().views.len(), 3);
    for outside in ["../a.png", "/etc/hostname", "images/../../a.png", "C:\\a.png"] {
        for (key, place) in [("file_path", "frames[1]: file_path"), ("mask_path", "frames[1]: mask_path")] {
            let mut transforms = transforms();
            transforms["frames"][1][key] = json!(outside);
            let message = foreign(&transforms).unwrap_err().to_string();
            assert_says(&message, &["transforms.json", place, "inside the dataset"]);
        }
        let mut transforms = transforms();
        transforms["ply_file_path"] = json!(outside);
        assert_says(&foreign(&transforms).unwrap_err().to_string(), &["ply_file_path", "inside the dataset"]);
    }
}

#[test]
fn the_file_itself_may_be_given() {
    let dataset = dataset(&transforms());
    assert_eq!(dataset.load_at("transforms.json", Purpose::Train).unwrap().views.len(), 3);
}

#[test]
fn a_colmap_model_comes_first_with_a_warning() {
    let dataset = dataset(&transforms());
    Model::sample().write_binary(&dataset.path("colmap/sparse/0"));
    Model::sample().write_photographs(&dataset.path("images"));
    let scene = dataset.train();
    assert_eq!(scene.source, "COLMAP binary");
    assert_says(&scene.warnings[0], &["transforms.json", "give that file itself"]);
}

#[test]
fn distortion_counts_without_a_camera_model_and_up_to_k4() {
    let with = |extra: &[(&str, Value)]| {
        let mut transforms = transforms();
        for (key, value) in extra {
            transforms[*key] = value.clone();
        }
        let scene = dataset(&transforms).inspect();
        let camera = scene.cameras[0].clone();
        (camera.model, camera.params[4..].to_vec(), camera.pinhole())
    };
    let (model, params, _) = with(&[("k1", json!(0.1)), ("p2", json!(-0.01))]);
    assert_eq!((model, params), (CameraModel::Opencv, vec![0.1, 0.0, 0.0, -0.01]));
    let (model, params, pinhole) =
        with(&[("camera_model", json!("OPENCV")), ("k3", json!(0.3)), ("k4", json!(0.4))]);
    assert_eq!((model, params), (CameraModel::Opencv, vec![0.0, 0.0, 0.0, 0.0, 0.3, 0.4]));
    assert!(pinhole.is_ok());
    let (model, params, _) = with(&[("camera_model", json!("OPENCV")), ("k1", json!(0.0))]);
    assert_eq!((model, params), (CameraModel::Pinhole, vec![]));
    let (model, params, pinhole) = with(&[("camera_model", json!("OPENCV_FISHEYE")), ("k1", json!(0.1))]);
    assert_eq!((model, params), (CameraModel::OpencvFisheye, vec![0.1, 0.0, 0.0, 0.0]));
    assert!(pinhole.is_err());
}

#[test]
fn intrinsics_of_a_frame_win_and_equal_cameras_are_one() {
    let mut transforms = transforms();
    transforms["frames"][1]["fl_x"] = json!(20.0);
    let scene = dataset(&transforms).train();
    assert_eq!(scene.cameras.len(), 2);
    let focal = |index: usize| scene.camera(scene.views[index].camera_id).unwrap().params[0];
    assert_eq!([focal(0), focal(1), focal(2)], [20.0, 10.0, 10.0]);
}

#[test]
fn a_field_of_view_and_the_pictures_size_are_enough() {
    let frames = transforms()["frames"].clone();
    let dataset = dataset(
        &json!({"camera_angle_x": std::f64::consts::FRAC_PI_2, "frames": frames, "ply_file_path": "points.ply"}),
    );
    // The size comes from a picture that exists.
    std::fs::remove_file(dataset.path("images/b.png")).unwrap();
    let camera = dataset.train().cameras[0].clone();
    assert_eq!((camera.width, camera.height), (WIDTH, HEIGHT));
    let expected = [4.0, 4.0, 4.0, 3.0];
    assert!(camera.params.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{:?}", camera.params);
}

#[test]
fn missing_pictures_are_counted_named_and_skipped() {
    let dataset = dataset(&transforms());
    std::fs::remove_file(dataset.path("images/b.png")).unwrap();
    let scene = dataset.train();
    assert_eq!(names(&scene), ["images/a.png", "images/c.png"]);
    assert_says(&scene.warnings[0], &["transforms.json", "1 of 3 images", "\"images/b.png\""]);
    std::fs::remove_dir_all(dataset.path("images")).unwrap();
    assert_says(&dataset.refused("transforms.json"), &["none of its 3 images exists"]);
    assert_eq!(dataset.inspect().views.len(), 3);
}

#[test]
fn masks_of_frames_are_taken_and_must_exist() {
    let mut transforms = transforms();
    transforms["frames"][1]["mask_path"] = json!("masks/a.png");
    let dataset = dataset(&transforms);
    assert_says(&dataset.refused("transforms.json"), &["frames[1]", "masks/a.png does not exist"]);
    write_png(&dataset.path("masks/a.png"), WIDTH, HEIGHT);
    let scene = dataset.train();
    assert!(scene.views[0].mask.as_ref().unwrap().ends_with("masks/a.png"));
    assert_eq!(scene.views[1].mask, None);
}

#[test]
fn invalid_poses_are_refused_by_frame() {
    for (matrix, reason) in [
        (json!([[1, 0, 0, null], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not finite"),
        (json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]), "not a rotation"),
        (json!([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a rotation"),
        (json!([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a rotation"),
        (json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "3 or 4 rows of 4"),
    ] {
        let mut transforms = transforms();
        transforms["frames"][2]["transform_matrix"] = matrix;
        assert_says(&dataset(&transforms).refused("transforms.json"), &["frames[2]", "images/c", reason]);
    }
}

#[test]
fn absurd_lenses_and_positions_are_refused_by_frame() {
    let mut far = transforms();
    far["frames"][2]["transform_matrix"] = json!([[1, 0, 0, 1e200], [0, 1, 0, 0], [0, 0, 1, 0]]);
    assert_says(&dataset(&far).refused("transforms.json"), &["frames[2]", "images/c", "from the origin"]);
    let mut narrow = transforms();
    narrow["frames"][1]["fl_x"] = json!(1e-320);
    assert_says(&dataset(&narrow).refused("transforms.json"), &["frames[1]", "focal length"]);
}

#[test]
fn a_scaled_rotation_is_a_rotation() {
    let mut transforms = transforms();
    transforms["frames"][1]["transform_matrix"] = json!([[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3]]);
    let pose = dataset(&transforms).train().views[0].pose;
    assert!(pose.is_sound());
    assert_near(pose.centre(), DVec3::new(1.0, 2.0, 3.0));
}

#[test]
fn other_faults_of_the_file_are_refused_with_their_place() {
    let wrong = |change: &dyn Fn(&mut Value)| {
        let mut transforms = transforms();
        change(&mut transforms);
        dataset(&transforms).refused("transforms.json")
    };
    assert_says(&wrong(&|t| t["frames"] = json!([])), &["lists no images"]);
    assert_says(
        &wrong(&|t| t["frames"][1] = frame("images/b.png")),
        &["\"images/b.png\" is listed twice", "frames[1]"],
    );
    assert_says(&wrong(&|t| t["fl_x"] = json!(-3)), &["frames[0]", "focal length -3"]);
    assert_says(&wrong(&|t| t["w"] = json!(7.5)), &["w is 7.5"]);
    assert_says(&wrong(&|t| t["fl_x"] = Value::Null), &["neither fl_x nor camera_angle_x"]);
    assert_says(
        &wrong(&|t| t["camera_model"] = json!("EQUIRECTANGULAR")),
        &["EQUIRECTANGULAR", "not supported"],
    );
    assert_says(&wrong(&|t| t["frames"] = json!(7)), &["invalid type", "line 1"]);
    let dataset = dataset(&transforms());
    dataset.write("transforms.json", "{\"frames\": [{\"file_path\": NaN");
    assert_says(&dataset.refused("transforms.json"), &["line 1 column"]);
}

#[test]
fn an_applied_transform_gives_a_warning() {
    let mut transforms = transforms();
    transforms["applied_transform"] = json!([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]);
    assert_says(&dataset(&transforms).train().warnings[0], &["applied_transform", "transformed frame"]);
}

#[test]
fn points_are_read_from_every_kind_of_ply() {
    let mut transforms = transforms();
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n\
             property short label\nproperty float red\nproperty float green\nproperty float blue\nend_header\n"
        )
    };
    let rows = [([0.5, 1.0, -2.0], [0.0, 0.5, 1.0]), ([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0])];
    for big_endian in [false, true] {
        let mut bytes =
            header(if big_endian { "binary_big_endian" } else { "binary_little_endian" }).into_bytes();
        for (position, colour) in rows {
            let bits64 = |v: f64| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
            let bits32 = |v: f32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
            position.iter().for_each(|value| bytes.extend(bits64(*value)));
            bytes.extend([7, 7]);
            colour.iter().for_each(|value| bytes.extend(bits32(*value)));
        }
        let dataset = dataset(&transforms);
        dataset.write("points.ply", &bytes);
        let scene = dataset.train();
        assert_eq!(scene.points.positions, [[0.5, 1.0, -2.0]]);
        assert_eq!(scene.points.colours, [[0, 128, 255]]);
        assert_says(&scene.warnings[0], &["points.ply", "1 points"]);
        dataset.write("points.ply", &bytes[..bytes.len() - 1]);
        assert_says(&dataset.refused("points.ply"), &["2 vertices", "truncated"]);
    }
    let torn = dataset(&transforms);
    torn.write("points.ply", POINTS.replace("1e0 2 3 255 0 1\n", "1e0 2"));
    assert_says(&torn.refused("points.ply"), &["vertex 1 of 2", "truncated"]);
    transforms["ply_file_path"] = json!("nowhere.ply");
    let none = dataset(&transforms);
    assert_says(&none.refused("transforms.json"), &["no sparse points"]);
    assert_says(&none.inspect().warnings[0], &["nowhere.ply"]);
}

#[test]
fn views_keep_their_place_in_the_list() {
    let listed = |scene: &Scene| scene.views.iter().map(|view| view.listed_at).collect::<Vec<_>>();
    assert_eq!(listed(&dataset(&transforms()).train()), [1, 0, 2], "listed as b, a, c");
    let dataset = Dataset::empty();
    let mut cameras = cameras_json();
    cameras[0]["img_name"] = json!("z");
    dataset.write("cameras.json", cameras.to_string());
    assert_eq!(listed(&dataset.inspect()), [1, 0], "listed as z, cam1/a");
}

#[test]
fn measuring_needs_no_points_and_no_views_to_train_on() {
    let mut transforms = transforms();
    transforms["ply_file_path"] = json!(null);
    transforms["frames"] = json!([frame("images/a.png"), frame("images/gone.png")]);
    let one = dataset(&transforms);
    assert_says(&one.refused(""), &["training needs at least two"]);
    let scene = one.load_at("", Purpose::Measure).unwrap();
    assert_eq!(names(&scene), ["images/a.png"], "a view without photograph cannot be measured");
    assert_says(&scene.warnings[0], &["gone.png", "left out"]);
    // Photographs that exist must be valid, as for training.
    write_png(&one.path("images/a.png"), WIDTH + 1, HEIGHT);
    let refused = one.load_at("", Purpose::Measure).unwrap_err().to_string();
    assert_says(&refused, &["a.png"]);
}

fn cameras_json() -> Value {
    // Camera to world: x of the camera is world y, its y is world z, its z is world x.
    let rotation = json!([[0, 0, 1], [1, 0, 0], [0, 1, 0]]);
    let entry = |id: u32, name: &str| {
        json!({"id": id, "img_name": name, "width": 100, "height": 80, "position": [1, 2, 3],
               "rotation": rotation, "fx": 90.0, "fy": 91.0})
    };
    json!([entry(0, "b"), entry(1, "cam1/a")])
}

#[test]
fn cameras_of_3dgs_are_read_for_inspection() {
    let dataset = Dataset::empty();
    dataset.write("cameras.json", cameras_json().to_string());
    for scene in [dataset.inspect(), dataset.load_at("cameras.json", Purpose::Inspect).unwrap()] {
        assert_eq!(scene.source, "cameras.json");
        assert_eq!(names(&scene), ["b", "cam1/a"]);
        let pose = scene.views[0].pose;
        assert_near(pose.centre(), DVec3::new(1.0, 2.0, 3.0));
        assert_near(pose.forward(), DVec3::X);
        assert_near(pose.down(), DVec3::Z);
        assert_eq!(scene.cameras.len(), 1);
        let pinhole = scene.cameras[0].pinhole().unwrap();
        assert_eq!((pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy), (90.0, 91.0, 50.0, 40.0));
    }
    assert_says(&dataset.refused("cameras.json"), &["no sparse points", "COLMAP or nerfstudio folder"]);
}

#[test]
fn a_principal_point_in_cameras_json_is_used() {
    let dataset = Dataset::empty();
    let mut cameras = cameras_json();
    (cameras[1]["cx"], cameras[1]["cy"]) = (json!(47.5), json!(42.25));
    dataset.write("cameras.json", cameras.to_string());
    let scene = dataset.inspect();
    let points: Vec<(f64, f64)> = scene
        .views
        .iter()
        .map(|view| scene.camera(view.camera_id).unwrap().pinhole().unwrap())
        .map(|p| (p.cx, p.cy))
        .collect();
    assert_eq!(points, [(50.0, 40.0), (47.5, 42.25)]);
}

#[test]
fn bad_cameras_of_3dgs_are_refused_by_entry() {
    let wrong = |change: &dyn Fn(&mut Value)| {
        let dataset = Dataset::empty();
        let mut cameras = cameras_json();
        change(&mut cameras);
        dataset.write("cameras.json", cameras.to_string());
        dataset.load_at("", Purpose::Inspect).unwrap_err().to_string()
    };
    assert_says(
        &wrong(&|c| c[1]["rotation"][0] = json!([0, 0, 0])),
        &["cameras.json", "entry 1", "not a rotation"],
    );
    assert_says(&wrong(&|c| c[1]["img_name"] = json!("b")), &["\"b\" is listed twice"]);
    assert_says(&wrong(&|c| c[0]["fx"] = json!(0.0)), &["entry 0", "focal length 0"]);
    assert_says(&wrong(&|c| c[0]["position"] = json!([1, 2])), &["not a cameras.json", "line 1"]);
}
