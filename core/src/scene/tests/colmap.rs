//! Valid and invalid COLMAP models.

use super::fixture::{CameraEntry, Dataset, HEIGHT, Model, WIDTH, assert_says, pinhole, write_png};
use crate::scene::{CameraModel, Place, Pose, Purpose};

#[test]
fn binary_and_text_give_the_same_scene() {
    let model = Model::sample();
    let (binary, text) = (Dataset::binary(&model).train(), Dataset::text(&model).train());
    assert_eq!((binary.source, text.source), ("COLMAP binary", "COLMAP text"));
    assert_eq!(binary.cameras, text.cameras);
    assert_eq!(binary.points, text.points);
    let all = |scene: &crate::scene::Scene| -> Vec<(String, u32, Pose)> {
        scene.views.iter().map(|v| (v.name.clone(), v.camera_id, v.pose)).collect()
    };
    assert_eq!(all(&binary), all(&text));
}

#[test]
fn all_parts_of_a_model_are_read_and_sorted_by_name() {
    let dataset = Dataset::binary(&Model::sample());
    let scene = dataset.train();
    assert_eq!(scene.warnings, Vec::<String>::new());
    let names: Vec<&str> = scene.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["a.png", "left cam/b 2.png", "left cam/c.png"]);
    // The ids of the sample are in another order.
    assert!(scene.views.iter().map(|view| view.listed_at).eq(0..3));
    let camera = &scene.cameras[0];
    assert_eq!(
        (camera.id, camera.model, camera.width, camera.height),
        (3, CameraModel::Pinhole, WIDTH, HEIGHT)
    );
    assert_eq!(camera.params, [10.5, 11.0, 4.25, 3.0]);
    let pose = scene.views[0].pose;
    assert_eq!(pose, Pose::from_wxyz([0.5, 0.5, -0.5, 0.5], [0.5, -1.25, 2.0]));
    assert_eq!(scene.points.positions[3], [0.75, 1.5, -2.0]);
    assert_eq!(scene.points.colours[3], [3, 128, 255]);
    let image = scene.views[1].image.as_ref().unwrap();
    assert!(image.ends_with("images/left cam/b 2.png"), "{}", image.display());
}

#[test]
fn tracks_name_the_views_in_their_order_by_name() {
    let mut model = Model::sample();
    // Twice in one image, as after a wrong match, and once in an image that the model lacks.
    model.points[3].track = vec![12, 11, 12, 99];
    let seen_by =
        |scene: &crate::scene::Scene| [0, 1, 2, 3].map(|point| scene.points.tracks.of(point).to_vec());
    for dataset in [Dataset::binary(&model), Dataset::text(&model)] {
        let scene = dataset.train();
        // By id, "left cam/b 2.png" is 10, "a.png" 11 and "left cam/c.png" 12.
        assert_eq!(seen_by(&scene), [vec![], vec![2], vec![0, 1], vec![0, 2]]);
        assert_says(&scene.warnings[0], &["points3D", "1 observations", "images."]);
        std::fs::remove_file(dataset.path("images/a.png")).unwrap();
        assert_eq!(seen_by(&dataset.train()), [vec![], vec![1], vec![0], vec![1]], "a.png is left out");
        assert_eq!(seen_by(&dataset.inspect()), [vec![], vec![2], vec![0, 1], vec![0, 2]], "a.png is kept");
    }
}

#[test]
fn tracks_keep_the_pixels_of_the_undistorted_pictures() {
    let mut model = Model::sample();
    let lens =
        CameraEntry { model: 2, name: "SIMPLE_RADIAL", params: vec![9.0, 4.25, 3.0, -0.1], ..pinhole(4) };
    model.cameras.push(lens);
    // "left cam/b 2.png" has a lens; "left cam/c.png" has no such 2D point.
    model.images[0].camera_id = 4;
    model.images[0].points2d = vec![([1.0, 1.0], None), ([6.5, 4.75], Some(3)), ([-2.0, 1.0], Some(3))];
    model.images[1].points2d = vec![([2.125, 5.5], Some(3))];
    model.points[2].track = vec![10, 11, 12];
    model.points[2].indices = vec![1, 0, 0];
    for dataset in [Dataset::binary(&model), Dataset::text(&model)] {
        let seen = |scene: &crate::scene::Scene| -> Vec<(u32, Option<[f64; 2]>)> {
            scene.points.tracks.seen(2).map(|(view, place)| (view, place.pixel(WIDTH, HEIGHT))).collect()
        };
        let scene = dataset.train();
        let [(0, Some(plain)), (1, Some(lens)), (2, None)] = seen(&scene)[..] else {
            panic!("{:?}", seen(&scene));
        };
        // Sixteenths of a pixel would be coarser by a thousand: the picture has 8 x 6 pixels.
        let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-4;
        assert!(close(plain, [2.125, 5.5]), "{plain:?}");
        let undistortion = scene.camera(4).unwrap().undistortion().unwrap();
        let (x, y) = undistortion.source_of(lens[0], lens[1]).unwrap();
        assert!(close([x, y], [6.5, 4.75]), "{lens:?} is shown at {x}, {y}");
        assert!((lens[0] - 6.5).hypot(lens[1] - 4.75) > 1e-2, "the lens bends: {lens:?}");
        assert_eq!(scene.points.tracks.seen(1).collect::<Vec<_>>(), [(2, Place::UNKNOWN)]);
        // Views are renumbered where a photograph is missing.
        std::fs::remove_file(dataset.path("images/a.png")).unwrap();
        assert_eq!(seen(&dataset.train()), [(0, Some(lens)), (1, None)]);
    }
    model.images[0].points2d = vec![([9.5, 1.0], Some(3)), ([f64::NAN, 1.0], Some(3))];
    model.images[1].points2d.clear();
    for index in [0, 1] {
        model.points[2].indices[0] = index;
        for dataset in [Dataset::binary(&model), Dataset::text(&model)] {
            assert!(!dataset.train().points.tracks.have_places(), "2D point {index} is outside the picture");
        }
    }
}

#[test]
fn models_are_found_wherever_programs_put_them() {
    let model = Model::sample();
    for (place, given) in [
        ("sparse/0", ""),
        ("sparse", ""),
        ("colmap/sparse/0", ""),
        ("", ""),
        ("text_model", "text_model"),
        ("sparse/0", "sparse/0"),
        ("sparse/0", "sparse"),
        ("colmap/sparse/0", "colmap/sparse/0"),
    ] {
        let dataset = Dataset::empty();
        model.write_photographs(&dataset.path("images"));
        model.write_binary(&dataset.path(place));
        let scene = dataset.load_at(given, Purpose::Train).unwrap();
        assert_eq!(scene.views.len(), 3, "model in {place:?}, given {given:?}");
    }
}

#[test]
fn photographs_may_be_in_the_folder_itself() {
    let dataset = Dataset::empty();
    Model::sample().write_photographs(&dataset.path(""));
    Model::sample().write_binary(&dataset.path("sparse/0"));
    assert_eq!(dataset.train().views.len(), 3);
}

#[test]
fn binary_wins_over_text_in_one_folder() {
    let dataset = Dataset::binary(&Model::sample());
    dataset.write("sparse/0/cameras.txt", "nonsense");
    dataset.write("sparse/0/images.txt", "nonsense");
    assert_eq!(dataset.train().source, "COLMAP binary");
}

#[test]
fn rigs_and_frames_of_new_models_are_ignored() {
    let dataset = Dataset::binary(&Model::sample());
    dataset.write("sparse/0/rigs.bin", [1, 2, 3]);
    dataset.write("sparse/0/frames.bin", [4, 5, 6]);
    assert_eq!(dataset.train().views.len(), 3);
}

#[test]
fn all_18_camera_models_have_their_number_of_parameters() {
    // Numbers of parameters in sensor/models.h of COLMAP 4.1, in the order of the ids.
    let counts = [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2];
    let mut model = Model::sample();
    for (number, count) in counts.into_iter().enumerate() {
        let name = CameraModel::from_number(number as u32).unwrap().name();
        let params = (0..count).map(|i| 1.5 + f64::from(i)).collect();
        model.cameras.push(CameraEntry {
            id: 100 + number as u32,
            model: number as u32,
            name,
            params,
            ..pinhole(0)
        });
    }
    for dataset in [Dataset::binary(&model), Dataset::text(&model)] {
        let scene = dataset.train();
        assert_eq!(scene.cameras.len(), 19);
        for (number, count) in counts.into_iter().enumerate() {
            let camera = scene.camera(100 + number as u32).unwrap();
            assert_eq!(camera.model as usize, number);
            assert_eq!(camera.params.len(), count as usize, "{}", camera.model.name());
            assert_eq!(CameraModel::from_name(camera.model.name()), Some(camera.model));
        }
    }
    assert_eq!(CameraModel::from_number(18), None);
}

#[test]
fn models_that_cannot_be_undistorted_are_refused_for_training() {
    let mut model = Model::sample();
    model.cameras[0] = CameraEntry {
        model: 5,
        name: "OPENCV_FISHEYE",
        params: vec![10.0, 10.0, 4.0, 3.0, 0.1, 0.0, 0.0, 0.0],
        ..pinhole(3)
    };
    let dataset = Dataset::binary(&model);
    assert_eq!(dataset.inspect().views.len(), 3);
    assert_says(&dataset.refused("camera 3"), &["OPENCV_FISHEYE", "colmap image_undistorter"]);
}

#[test]
fn the_largest_of_several_models_is_read_with_a_warning() {
    let dataset = Dataset::binary(&Model::sample());
    let mut small = Model::sample();
    small.images.truncate(1);
    small.write_binary(&dataset.path("sparse/1"));
    small.write_text(&dataset.path("sparse/2"));
    let scene = dataset.train();
    assert_eq!(scene.views.len(), 3);
    assert_eq!(scene.warnings.len(), 1, "{:?}", scene.warnings);
    assert_says(
        &scene.warnings[0],
        &["3 COLMAP models", "sparse/0 (3 images)", "2 images of", "model_merger"],
    );
    // The folder name does not matter.
    small.write_binary(&dataset.path("sparse/0"));
    Model::sample().write_binary(&dataset.path("sparse/1"));
    assert_says(&dataset.train().warnings[0], &["sparse/1 (3 images)"]);
}

#[test]
fn half_a_model_is_refused_by_the_missing_file() {
    let dataset = Dataset::binary(&Model::sample());
    std::fs::remove_file(dataset.path("sparse/0/images.bin")).unwrap();
    assert_says(&dataset.refused("cameras.bin"), &["images.bin is not beside it"]);
}

#[test]
fn a_folder_without_a_scene_and_a_missing_folder_are_refused() {
    let dataset = Dataset::empty();
    dataset.write("notes.txt", "hello");
    let message = dataset.load_at("", Purpose::Inspect).unwrap_err().to_string();
    assert_says(&message, &["holds no scene", "transforms.json", "sparse/0/cameras.bin"]);
    let message = dataset.load_at("notes.txt", Purpose::Inspect).unwrap_err().to_string();
    assert_says(&message, &["notes.txt", "neither"]);
    let message = dataset.load_at("nowhere", Purpose::Inspect).unwrap_err().to_string();
    assert_says(&message, &["cannot read", "nowhere"]);
}

#[test]
fn a_truncated_file_is_refused_by_name_and_offset() {
    let model = Model::sample();
    for (file, whole) in [
        ("cameras.bin", model.cameras_bin()),
        ("images.bin", model.images_bin()),
        ("points3D.bin", model.points_bin()),
    ] {
        let dataset = Dataset::binary(&model);
        for len in 0..whole.len() {
            dataset.write(&format!("sparse/0/{file}"), &whole[..len]);
            let message = dataset.refused(file);
            assert_says(&message, &["byte ", "truncated"]);
        }
    }
    let dataset = Dataset::binary(&model);
    let bytes = model.images_bin();
    dataset.write("sparse/0/images.bin", &bytes[..bytes.len() - 30]);
    // The third image starts after the count, 64 + 17 + 8 + 48 bytes of the first image and 64 + 6 + 8 of the
    // second.
    let what = "the 2D points of image 3 of 3 (left cam/c.png)";
    assert_says(&dataset.refused("images.bin"), &["byte 302", what]);
}

#[test]
fn a_count_that_is_too_small_is_refused() {
    let model = Model::sample();
    let count_of = |bytes: Vec<u8>, count: u64| [&count.to_le_bytes(), &bytes[8..]].concat();
    for (file, bytes) in [
        ("cameras.bin", count_of(model.cameras_bin(), 0)),
        ("images.bin", count_of(model.images_bin(), 2)),
        ("points3D.bin", count_of(model.points_bin(), 3)),
    ] {
        let dataset = Dataset::binary(&model);
        dataset.write(&format!("sparse/0/{file}"), bytes);
        assert_says(&dataset.refused(file), &["bytes follow after", "its count is wrong"]);
    }
}

#[test]
fn an_absurd_count_allocates_nothing_and_is_refused() {
    let model = Model::sample();
    for count in [u64::MAX, u64::MAX / 24, 1 << 40, 100] {
        for (file, bytes) in [
            ("cameras.bin", model.cameras_bin()),
            ("images.bin", model.images_bin()),
            ("points3D.bin", model.points_bin()),
        ] {
            let dataset = Dataset::binary(&model);
            dataset.write(&format!("sparse/0/{file}"), [&count.to_le_bytes(), &bytes[8..]].concat());
            assert_says(&dataset.refused(file), &["byte 0", &count.to_string()]);
        }
    }
    // The same for a count inside an image: its number of 2D points.
    let mut bytes = model.images_bin();
    let at = 8 + 64 + 17;
    bytes[at..at + 8].copy_from_slice(&u64::MAX.to_le_bytes());
    let dataset = Dataset::binary(&model);
    dataset.write("sparse/0/images.bin", bytes);
    assert_says(&dataset.refused("images.bin"), &["byte 89", "2D points of image 1", "18446744073709551615"]);
}

#[test]
fn a_pose_that_is_not_finite_is_refused_by_image_and_place() {
    for (place, value) in [(0, f64::NAN), (3, f64::INFINITY), (4, f64::NAN), (6, f64::NEG_INFINITY)] {
        let mut model = Model::sample();
        let image = &mut model.images[1];
        if place < 4 {
            image.quat_wxyz[place] = value;
        } else {
            image.translation[place - 4] = value;
        }
        let message = Dataset::binary(&model).refused("images.bin");
        assert_says(&message, &["byte 145", "\"a.png\"", "not finite"]);
        let message = Dataset::text(&model).refused("images.txt");
        assert_says(&message, &["line 4", "\"a.png\"", "not finite"]);
    }
}

#[test]
fn coordinates_whose_squares_overflow_are_refused_or_left_out() {
    let mut model = Model::sample();
    model.images[1].translation[0] = 1e200;
    for (message, place) in [
        (Dataset::binary(&model).refused("images.bin"), "byte 145"),
        (Dataset::text(&model).refused("images.txt"), "line 4"),
    ] {
        assert_says(&message, &[place, "\"a.png\"", "more than 1e12 scene units from the origin"]);
    }
    for (value, part) in [(1e-320, "focal length"), (1e300, "within 1e9 of 0")] {
        let mut model = Model::sample();
        model.cameras[0].params[0] = value;
        assert_says(&Dataset::binary(&model).refused("cameras.bin"), &["byte 8", part]);
        assert_says(&Dataset::text(&model).refused("cameras.txt"), &["line 2", part]);
    }
    let model = Model::sample();
    let dataset = Dataset::text(&model);
    let before = dataset.inspect().points.len();
    dataset.write("sparse/0/points3D.txt", format!("{}77 1e30 0 0 1 2 3 0.5 1 0\n", model.points_txt()));
    let scene = dataset.inspect();
    assert_eq!(scene.points.len(), before);
    assert!(
        scene.warnings.iter().any(|warning| warning.contains("1 points") && warning.contains("beyond 1e12"))
    );
}

#[test]
fn windows_spelling_of_not_a_number_is_understood() {
    let model = Model::sample();
    let dataset = Dataset::text(&model);
    dataset
        .write("sparse/0/images.txt", model.images_txt().replace("-1.25 2 3 a.png", "-nan(ind) 2 3 a.png"));
    assert_says(&dataset.refused("images.txt"), &["line 4", "not finite"]);
}

#[test]
fn a_zero_quaternion_is_refused() {
    let mut model = Model::sample();
    model.images[2].quat_wxyz = [0.0; 4];
    assert_says(&Dataset::binary(&model).refused("images.bin"), &["\"left cam/c.png\"", "zero quaternion"]);
    assert_says(&Dataset::text(&model).refused("images.txt"), &["line 6", "zero quaternion"]);
}

#[test]
fn impossible_cameras_are_refused() {
    let wrong = |change: &dyn Fn(&mut CameraEntry)| {
        let mut model = Model::sample();
        change(&mut model.cameras[0]);
        let text = Dataset::text(&model).refused("cameras.txt");
        assert_says(&text, &["line 2"]);
        (Dataset::binary(&model).refused("cameras.bin"), text)
    };
    let both = |(binary, text): (String, String), part: &str| {
        assert_says(&binary, &["byte 8", part]);
        assert_says(&text, &[part]);
    };
    both(wrong(&|camera| camera.width = 0), "size 0x6");
    both(wrong(&|camera| camera.height = 1 << 20), "8x1048576");
    both(wrong(&|camera| camera.params[0] = f64::NAN), "parameter 1 of camera 3 (PINHOLE) is NaN");
    both(wrong(&|camera| camera.params[1] = -5.0), "focal length -5");
    both(wrong(&|camera| (camera.model, camera.name) = (77, "LENSLESS")), "unknown camera model");
    assert_says(&wrong(&|camera| camera.params.push(1.0)).1, &["5 parameters, but PINHOLE takes 4"]);
}

#[test]
fn duplicates_and_unknown_cameras_are_refused() {
    let mut model = Model::sample();
    model.images[2].name = "a.png".to_owned();
    assert_says(
        &Dataset::binary(&model).refused("images.bin"),
        &["\"a.png\" is listed twice", "byte 145", "byte 223"],
    );
    let mut model = Model::sample();
    model.images[1].camera_id = 4;
    let message = Dataset::text(&model).refused("images.txt");
    assert_says(&message, &["line 4", "\"a.png\"", "camera 4", "cameras.txt does not list"]);
    let mut model = Model::sample();
    model.cameras.push(pinhole(3));
    assert_says(&Dataset::binary(&model).refused("cameras.bin"), &["camera 3 is listed twice"]);
}

#[test]
fn names_that_leave_the_folder_are_refused() {
    let dataset = Dataset::binary(&Model::sample());
    let mut model = Model::sample();
    model.images[0].name = "../../secret.png".to_owned();
    model.write_binary(&dataset.path("sparse/0"));
    assert_says(&dataset.refused("images.bin"), &["byte 8", "../../secret.png", "relative path"]);
}

#[test]
fn damaged_text_is_refused_by_line() {
    let model = Model::sample();
    let (images, points) = (model.images_txt(), model.points_txt());
    for (file, text, parts) in [
        ("images.txt", images.replace(" 3 a.png", ""), ["line 4", "truncated"]),
        (
            "images.txt",
            images.replace("0.5 0.5 -0.5", "0.5 half -0.5"),
            ["line 4", "\"half\" is not a number"],
        ),
        ("images.txt", images.replace("2.5 -1 1.5", "2.5 1.5"), ["line 3", "multiple of three"]),
        // The empty line of a.png is missing, so the next image is read as its points.
        ("images.txt", images.replace("a.png\n\n", "a.png\n"), ["line 5", "multiple of three"]),
        (
            "points3D.txt",
            points.replace("0.25 1.5 -2 1 128 255 0.5 12 7", "0.25 1.5"),
            ["line 3", "truncated"],
        ),
        (
            "points3D.txt",
            points.replace("1 128 255", "1 300 255"),
            ["line 3", "found \"300\" instead of a colour"],
        ),
        ("points3D.txt", points.replace("0.5 12 7", "0.5 12"), ["line 3", "the 2D point of a track"]),
        ("cameras.txt", model.cameras_txt().replace("8 6", "8 six"), ["line 2", "\"six\""]),
    ] {
        let dataset = Dataset::text(&model);
        dataset.write(&format!("sparse/0/{file}"), text);
        assert_says(&dataset.refused(file), &parts);
    }
}

#[test]
fn a_size_that_differs_from_the_camera_is_refused_or_warned_of() {
    let dataset = Dataset::binary(&Model::sample());
    write_png(&dataset.path("images/a.png"), 16, 12);
    assert_says(&dataset.refused("images/a.png"), &["16x12", "8x6"]);
    let scene = dataset.inspect();
    assert_eq!(scene.views.len(), 3);
    assert_says(&scene.warnings[0], &["1 images cannot be trained on", "16x12"]);
    // A rotated picture: the message names the usual cause.
    write_png(&dataset.path("images/a.png"), HEIGHT, WIDTH);
    assert_says(&dataset.refused("images/a.png"), &["EXIF"]);
}

#[test]
fn unreadable_and_truncated_pictures_are_refused_at_once() {
    let mut model = Model::sample();
    model.images[1].name = "a.jpg".to_owned();
    let dataset = Dataset::binary(&model);
    image::RgbImage::new(WIDTH, HEIGHT).save(dataset.path("images/a.jpg")).unwrap();
    assert_eq!(dataset.train().views.len(), 3);
    let whole = std::fs::read(dataset.path("images/a.jpg")).unwrap();
    dataset.write("images/a.jpg", &whole[..whole.len() - 10]);
    assert_says(&dataset.refused("images/a.jpg"), &["truncated", "end marker"]);
    dataset.write("images/a.jpg", &whole[..20]);
    assert_says(&dataset.refused("images/a.jpg"), &["truncated"]);
    dataset.write("images/a.jpg", "");
    assert_says(&dataset.refused("images/a.jpg"), &["empty"]);
    dataset.write("images/a.jpg", "<html>404</html>");
    assert_says(&dataset.refused("images/a.jpg"), &["not a PNG, JPEG or TIFF"]);
    dataset.write("images/left cam/c.png", "");
    assert_says(&dataset.refused("images/a.jpg"), &["1 more images have a fault"]);
}

#[test]
fn missing_pictures_are_named_but_not_all_may_be_missing() {
    let dataset = Dataset::binary(&Model::sample());
    std::fs::remove_file(dataset.path("images/a.png")).unwrap();
    let scene = dataset.train();
    assert_eq!(scene.views.len(), 2);
    assert_says(&scene.warnings[0], &["1 of 3 images", "images", "left out", "\"a.png\""]);
    let scene = dataset.inspect();
    assert_eq!(scene.views.len(), 3);
    assert_eq!(scene.views[0].image, None);
    assert_says(&scene.warnings[0], &["kept as poses only"]);
    std::fs::remove_dir_all(dataset.path("images")).unwrap();
    assert_says(&dataset.refused("images.bin"), &["none of its 3 images exists", "\"a.png\"", "images"]);
    assert_eq!(dataset.inspect().views.len(), 3);
}

#[test]
fn pictures_are_found_when_only_the_case_of_their_names_differs() {
    let dataset = Dataset::binary(&Model::sample());
    std::fs::rename(dataset.path("images/a.png"), dataset.path("images/A.PNG")).unwrap();
    let scene = dataset.train();
    assert_eq!(scene.views.len(), 3);
    assert!(scene.views[0].image.as_ref().unwrap().ends_with("A.PNG"));
}

#[test]
fn no_points_are_refused_for_training_and_a_warning_for_inspect() {
    let mut model = Model::sample();
    model.points.clear();
    let dataset = Dataset::binary(&model);
    assert_says(&dataset.refused("points3D.bin"), &["no sparse points", "point_triangulator"]);
    std::fs::remove_file(dataset.path("sparse/0/points3D.bin")).unwrap();
    assert_says(&dataset.refused("points3D.bin"), &["no sparse points"]);
    let scene = dataset.inspect();
    assert!(scene.points.is_empty());
    assert_says(&scene.warnings[0], &["no sparse points"]);
}

#[test]
fn points_that_are_not_finite_are_left_out_and_counted() {
    let mut model = Model::sample();
    model.points[1].position[2] = f64::NAN;
    model.points[2].position[0] = 1e300;
    for dataset in [Dataset::binary(&model), Dataset::text(&model)] {
        let scene = dataset.train();
        assert_eq!(scene.points.len(), 2);
        assert_says(&scene.warnings[0], &["points3D", "2 points"]);
    }
}

#[test]
fn one_image_or_none_is_refused_for_training() {
    let mut model = Model::sample();
    model.images.truncate(1);
    let dataset = Dataset::binary(&model);
    assert_says(&dataset.refused("1 usable image"), &["at least two"]);
    assert_eq!(dataset.inspect().views.len(), 1);
    model.images.clear();
    let dataset = Dataset::binary(&model);
    assert_says(&dataset.refused("images.bin"), &["lists no images"]);
}

#[test]
fn masks_are_found_in_every_usual_spelling() {
    let dataset = Dataset::binary(&Model::sample());
    for mask in ["masks/A.PNG", "masks/left cam/b 2.png.png", "masks/left cam/c.mask.png"] {
        write_png(&dataset.path(mask), WIDTH, HEIGHT);
    }
    let scene = dataset.train();
    let masks: Vec<_> = scene.views.iter().map(|view| view.mask.clone().unwrap()).collect();
    assert!(masks[0].ends_with("masks/A.PNG"));
    assert!(masks[1].ends_with("masks/left cam/b 2.png.png"));
    assert!(masks[2].ends_with("masks/left cam/c.mask.png"));
    assert_eq!(scene.warnings, Vec::<String>::new());
    std::fs::remove_file(&masks[2]).unwrap();
    assert_says(&dataset.train().warnings[0], &["1 of 3 images have no mask", "\"left cam/c.png\""]);
}

#[test]
fn the_extent_is_that_of_the_camera_centres() {
    let scene = Dataset::binary(&Model::sample()).train();
    let centres: Vec<_> = scene.views.iter().map(|view| view.pose.centre()).collect();
    assert_eq!(scene.extent(), crate::scene::extent(&centres));
    assert!(scene.extent() > 0.0);
}

#[test]
fn no_damaged_byte_makes_a_reader_panic() {
    let model = Model::sample();
    let dataset = Dataset::binary(&model);
    let (mut read, mut refused) = (0, 0);
    for (file, whole) in [
        ("cameras.bin", model.cameras_bin()),
        ("images.bin", model.images_bin()),
        ("points3D.bin", model.points_bin()),
    ] {
        for at in 0..whole.len() {
            for value in [0x00, 0x7F, 0xFF] {
                let mut bytes = whole.clone();
                bytes[at] = value;
                dataset.write(&format!("sparse/0/{file}"), bytes);
                match dataset.load_at("", Purpose::Inspect) {
                    Ok(scene) => {
                        assert!(scene.views.iter().all(|view| view.pose.is_sound()), "{file}, byte {at}");
                        read += 1;
                    }
                    Err(_) => refused += 1,
                }
            }
        }
        dataset.write(&format!("sparse/0/{file}"), whole);
    }
    assert!(read > 100 && refused > 100, "{read} read, {refused} refused");
}

#[test]
fn coordinates_that_f32_cannot_resolve_give_a_warning() {
    let mut model = Model::sample();
    for image in &mut model.images {
        // UTM: centres millions of units from the origin, a few units apart.
        image.quat_wxyz = [1.0, 0.0, 0.0, 0.0];
        image.translation[0] -= 450_000.0;
        image.translation[1] -= 6_200_000.0;
    }
    let scene = Dataset::binary(&model).train();
    assert_says(&scene.warnings[0], &["far from the origin", "shift"]);
}
