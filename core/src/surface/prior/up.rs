//! Directions that may be up, from how cameras are held.

use glam::{DMat3, DVec3};

use super::sightings::Eye;

/// A mean of unit vectors shorter than this has no direction.
const NO_DIRECTION: f64 = 0.05;

/// Directions that may be up, the most likely one first; units.
///
/// - At right angles to the x axes of cameras that are held level, if they look into several directions.
/// - The mean of what is up in the photographs, which is tilted if all cameras look down into one direction.
/// - Against the mean viewing direction: cameras above water look down.
pub(super) fn candidates(eyes: &[Eye]) -> Vec<DVec3> {
    let count = eyes.len().max(1) as f64;
    let mean = |row: fn(&Eye) -> DVec3| eyes.iter().map(row).sum::<DVec3>() / count;
    let (up, back) = (-mean(|eye| eye.to_camera.row(1)), -mean(|eye| eye.to_camera.row(2)));
    let mut sides = DMat3::ZERO;
    for eye in eyes {
        let x = eye.to_camera.row(0);
        sides += DMat3::from_cols(x * x.x, x * x.y, x * x.z) * (1.0 / count);
    }
    let level = least_axis(sides).map(|axis| if axis.dot(up + back) < 0.0 { -axis } else { axis });
    let means = [up, back].into_iter().filter(|mean| mean.length() > NO_DIRECTION).map(DVec3::normalize);
    level.into_iter().chain(means).collect()
}

/// The axis along which a cloud of unit vectors, whose second moments are `moments`, has the least extent, if
/// the other two are clearly longer. By powers of the inverse.
fn least_axis(moments: DMat3) -> Option<DVec3> {
    // Keeps the inverse finite where the vectors are exactly level.
    let floor = 1e-9;
    let inverse = (moments + DMat3::from_diagonal(DVec3::splat(floor))).inverse();
    let mut axis = DVec3::new(0.48, 0.6, 0.64);
    for _ in 0..100 {
        axis = (inverse * axis).try_normalize()?;
    }
    let least = axis.dot(moments * axis);
    // The trace is 1; the middle extent follows from the sum of principal minors.
    let [a, b, c] = [moments.x_axis, moments.y_axis, moments.z_axis];
    let minors = a.x * b.y - a.y * b.x + a.x * c.z - a.z * c.x + b.y * c.z - b.z * c.y;
    let rest = 1.0 - least;
    let product = minors - least * rest;
    let middle = 0.5 * (rest - (rest * rest - 4.0 * product).max(0.0).sqrt());
    (middle > 4.0 * least && middle > 0.02).then_some(axis)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{PinholeCamera, Pose};

    fn eyes(poses: impl Iterator<Item = Pose>) -> Vec<Eye> {
        let camera = PinholeCamera { width: 8, height: 6, fx: 6.0, fy: 6.0, cx: 4.0, cy: 3.0 };
        poses.map(|pose| Eye::new(&camera, &pose)).collect()
    }

    #[test]
    fn level_cameras_that_look_around_give_up_exactly() {
        let down = DVec3::new(0.2, 0.9, -0.3).normalize();
        let side = down.any_orthonormal_vector();
        // A third of a circle: the mean of what is up is off by far.
        let poses = (0..12).map(|i| {
            let eye = glam::DQuat::from_axis_angle(down, f64::from(i) * 0.18) * side * 2.0 - down;
            Pose::looking_at(eye, DVec3::ZERO, down)
        });
        let found = candidates(&eyes(poses));
        assert!((found[0] + down).length() < 1e-6, "{found:?}");
        assert!((found[1] + down).length() > 0.2, "{found:?}");
    }

    #[test]
    fn cameras_in_one_direction_give_means_only() {
        let poses = (0..9).map(|i| {
            let eye = DVec3::new(f64::from(i), -3.0, -4.0);
            Pose::looking_at(eye, eye + DVec3::new(0.0, 3.0, 4.0), DVec3::Y)
        });
        let found = candidates(&eyes(poses));
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].dot(-DVec3::Y) > 0.7 && found[1].dot(-DVec3::Y) > 0.5, "{found:?}");
    }
}
