//! The renderer: strips and bands of pictures that are not rendered in one piece, and normals.

use std::sync::Arc;

use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{ListLimits, Renderer};
use fathom_core::scene::{PinholeCamera, Pose};
use glam::{DQuat, DVec3};

use crate::device::{assert_same_bits, layouts};
use crate::view::hard_scenes;

/// A square of 9 x 9 half-opaque discs around `centre`, 0.15 apart. Each has radius 0.15 and a tenth of that
/// as thickness. `rotation` turns +z to their normal.
fn wall(centre: DVec3, rotation: DQuat) -> Gaussians {
    let mut model = Gaussians::empty(1);
    for (row, column) in (-4..=4).flat_map(|row| (-4..=4).map(move |column| (row, column))) {
        let at = centre + rotation * (0.15 * DVec3::new(f64::from(column), f64::from(row), 0.0));
        model.means.push(at.as_vec3().to_array());
        let q = rotation.as_quat();
        model.quats.push([q.w, q.x, q.y, q.z]);
        model.log_scales.push([0.15_f32.ln(), 0.15_f32.ln(), 0.015_f32.ln()]);
        model.opacity_logits.push(0.0);
        // Higher harmonics must not affect the normals.
        model.sh_coeffs.extend([[0.3, -0.2, 0.1], [5.0; 3], [-7.0; 3], [9.0; 3]]);
    }
    model
}

#[test]
fn a_picture_in_strips_is_the_picture_in_one_piece() {
    for gpu in layouts() {
        for scene in hard_scenes(7, 300, 2) {
            let whole = Renderer::new(Arc::clone(&gpu), &scene.model).unwrap();
            let cut = Renderer::new(Arc::clone(&gpu), &scene.model).unwrap();
            // 53 rows in strips of one row of tiles each.
            let mut cut = cut.with_strip_tiles(1);
            let mut whole = whole;
            let whole = whole.render(&scene.camera, &scene.pose, scene.background).unwrap();
            let cut = cut.render(&scene.camera, &scene.pose, scene.background).unwrap();
            assert_eq!((cut.width, cut.height), (75, 53));
            assert_eq!((cut.rgb.len(), cut.alpha.len(), cut.range.len()), (3975, 3975, 3975));
            let mut crossed = 0;
            for pixel in 0..whole.rgb.len() {
                let apart = (0..3)
                    .map(|c| (whole.rgb[pixel][c] - cut.rgb[pixel][c]).abs())
                    .fold((whole.alpha[pixel] - cut.alpha[pixel]).abs(), f32::max);
                crossed += usize::from(apart > 1e-3);
                let of_range = (whole.range[pixel] - cut.range[pixel]).abs();
                crossed += usize::from(of_range > 1e-3 * whole.range[pixel].max(1.0));
            }
            // Rows are counted from the strip, so positions round differently and a few blends cross alpha =
            // 1/255.
            assert!(crossed < 5, "{}: {crossed} numbers of 3975 pixels differ", scene.name);
        }
    }
}

#[test]
fn a_picture_rendered_in_bands_is_the_same_to_the_bit() {
    for gpu in layouts() {
        for scene in hard_scenes(8, 300, 2) {
            let render = |limits: Option<ListLimits>| {
                let renderer = Renderer::new(Arc::clone(&gpu), &scene.model).unwrap();
                let mut renderer = match limits {
                    Some(limits) => renderer.with_list_limits(limits),
                    None => renderer,
                };
                renderer.render(&scene.camera, &scene.pose, scene.background).unwrap()
            };
            let whole = render(None);
            let cut = render(Some(ListLimits { visible: 300, intersections: 1200 }));
            assert_same_bits(&format!("{}: colours", scene.name), &whole.rgb, &cut.rgb);
            assert_same_bits(&format!("{}: range", scene.name), &whole.range, &cut.range);
        }
    }
}

#[test]
fn unit_normals_in_camera_axes_leave_the_colours_unchanged() {
    let camera = PinholeCamera { width: 75, height: 53, fx: 80.0, fy: 80.0, cx: 37.5, cy: 26.5 };
    let eye = DVec3::new(1.0, -2.0, 0.5);
    let pose = Pose::looking_at(eye, eye + DVec3::new(0.3, 0.2, 1.0), DVec3::Y);
    let centre = eye + 4.0 * pose.forward();
    for gpu in layouts() {
        for degrees in [0.0_f64, 40.0, -25.0] {
            // The normal of a wall that faces the camera, turned about the camera's y axis.
            let tilt = DQuat::from_rotation_y(degrees.to_radians());
            let model = wall(centre, pose.rotation.inverse() * tilt);
            let mut renderer = Renderer::new(Arc::clone(&gpu), &model).unwrap();
            let before = renderer.render(&camera, &pose, [0.0; 3]).unwrap();
            let normals = renderer.normals(&model, &camera, &pose).unwrap();
            let after = renderer.render(&camera, &pose, [0.0; 3]).unwrap();
            assert_same_bits("colours after normals", &before.rgb, &after.rgb);
            let expected = tilt * DVec3::NEG_Z;
            let mut walled = 0;
            for (normal, alpha) in normals.iter().zip(&before.alpha) {
                if *alpha == 0.0 {
                    assert_eq!(*normal, [0.0; 3]);
                    continue;
                }
                walled += 1;
                // All Gaussians have the same normal, so blending only adds the rounding of f32 sums.
                let apart = DVec3::from(normal.map(f64::from)).distance(expected);
                assert!(apart < 1e-3, "{degrees} degrees: {normal:?}, expected {expected}, alpha {alpha}");
            }
            assert!((500..3900).contains(&walled), "{walled} pixels of 3975 show the wall");
        }
    }
}

#[test]
fn normals_of_another_model_are_refused() {
    for gpu in layouts() {
        let model = wall(DVec3::Z, DQuat::IDENTITY);
        let mut renderer = Renderer::new(Arc::clone(&gpu), &model).unwrap();
        let camera = PinholeCamera { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 };
        let pose = Pose { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
        let refused = renderer.normals(&Gaussians::empty(1), &camera, &pose).unwrap_err().to_string();
        assert!(refused.contains("0 colours for 81 Gaussians"), "{refused}");
    }
}
