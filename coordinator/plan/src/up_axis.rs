//! Finds down, for the aligned frame in which the scene is cut.
//!
//! Structure from motion leaves the vertical arbitrary, and a cut on the wrong plane is worthless. People and
//! vehicles hold cameras upright, so the mean of the cameras' down vectors is the best evidence. It is short
//! for cameras that look straight down and turn (a survey's lawn-mower lines). Those move on a level plane,
//! so its normal is the vertical, and their viewing direction is down.

use fathom_core::scene::Pose;
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::geometry::{Alignment, Turn, TurnRule, UpRule};
use crate::turn;

/// A mean camera-down vector longer than this decides (docs/internals/plan.md).
const MEAN_DOWN_DECIDES: f64 = 0.5;
/// Below this share of the largest spread, centres have no extent along an axis.
const FLAT: f64 = 1e-3;
/// A sum of unit vectors shorter than this has no direction.
const NO_DIRECTION: f64 = 1e-6;

/// Finds down from the training cameras, the smallest rotation that makes it +y and, with `rotate`, the turn
/// about it that makes cells compact.
pub fn align(poses: &[Pose], rotate: bool) -> Alignment {
    let count = poses.len().max(1) as f64;
    let mean_down = poses.iter().map(Pose::down).sum::<DVec3>() / count;
    let mean_forward = poses.iter().map(Pose::forward).sum::<DVec3>() / count;
    let (rule, down) = if mean_down.length() > MEAN_DOWN_DECIDES {
        (UpRule::MeanCameraDown, mean_down.normalize())
    } else {
        down_from_centres(poses, mean_down, mean_forward)
    };
    let level = DQuat::from_rotation_arc(down, DVec3::Y);
    let turn = if rotate {
        let centres: Vec<DVec3> = poses.iter().map(|pose| level * pose.centre()).collect();
        turn::find(&centres.iter().map(|centre| DVec2::new(centre.x, centre.z)).collect::<Vec<_>>())
    } else {
        Turn { rule: TurnRule::Off, degrees: 0.0, perimeter_ratio: None }
    };
    let turned = DQuat::from_rotation_y(turn.degrees.to_radians()) * level;
    // Not turned at all is the same to the last bit.
    let q = if turn.degrees == 0.0 { level } else { turned.normalize() };
    Alignment {
        rule,
        down: down.to_array(),
        mean_down_length: mean_down.length(),
        turn,
        world_to_aligned_quat_wxyz: [q.w, q.x, q.y, q.z],
    }
}

/// Down for cameras without a common down vector.
fn down_from_centres(poses: &[Pose], mean_down: DVec3, mean_forward: DVec3) -> (UpRule, DVec3) {
    let centres: Vec<DVec3> = poses.iter().map(Pose::centre).collect();
    let (variances, axes) = principal_axes(&centres);
    // Spread is a length, so the share is squared for variances.
    let flat = variances[2] * FLAT * FLAT;
    if variances[1] > flat {
        let normal = axes.col(0);
        // Cameras that look down see down; those that look level give no sign, their down vectors do.
        let sign = if mean_forward.dot(normal).abs() > NO_DIRECTION { mean_forward } else { mean_down };
        let down = if sign.dot(normal) < 0.0 { -normal } else { normal };
        return (UpRule::CentrePlane, down);
    }
    let path = if variances[2] > 0.0 { axes.col(2) } else { DVec3::ZERO };
    let across = mean_forward - path * mean_forward.dot(path);
    if across.length() > NO_DIRECTION {
        (UpRule::ViewingDirection, across.normalize())
    } else {
        (UpRule::WorldY, DVec3::Y)
    }
}

/// Variances in ascending order and the unit axes that they belong to, of a cloud of points.
fn principal_axes(points: &[DVec3]) -> ([f64; 3], DMat3) {
    let count = points.len().max(1) as f64;
    let mean = points.iter().sum::<DVec3>() / count;
    let mut covariance = DMat3::ZERO;
    for &point in points {
        let d = point - mean;
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    symmetric_eigen(covariance * (1.0 / count))
}

/// Eigenvalues in ascending order and unit eigenvectors of a symmetric matrix (cyclic Jacobi rotations).
fn symmetric_eigen(matrix: DMat3) -> ([f64; 3], DMat3) {
    let mut a = matrix.to_cols_array_2d();
    let mut v = DMat3::IDENTITY.to_cols_array_2d();
    // Converges quadratically: a 3x3 matrix needs 5 to 8 sweeps to the last bit.
    for _ in 0..32 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for k in 0..3 {
                let (kp, kq) = (a[k][p], a[k][q]);
                a[k][p] = c * kp - s * kq;
                a[k][q] = s * kp + c * kq;
            }
            for k in 0..3 {
                let (pk, qk) = (a[p][k], a[q][k]);
                a[p][k] = c * pk - s * qk;
                a[q][k] = s * pk + c * qk;
                let (kp, kq) = (v[p][k], v[q][k]);
                v[p][k] = c * kp - s * kq;
                v[q][k] = s * kp + c * kq;
            }
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[i][i].total_cmp(&a[j][j]));
    (order.map(|i| a[i][i]), DMat3::from_cols_array_2d(&order.map(|i| v[i])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How far `alignment` is from having `down` as its down, degrees.
    fn error_degrees(alignment: &Alignment, down: DVec3) -> f64 {
        let mapped = alignment.rotation() * down;
        assert!((alignment.rotation() * DVec3::from(alignment.down) - DVec3::Y).length() < 1e-12);
        mapped.angle_between(DVec3::Y).to_degrees()
    }

    /// Cameras around a circle that look at its middle, in a world whose down is `down`.
    fn ring(down: DVec3) -> Vec<Pose> {
        let side = down.any_orthonormal_vector();
        (0..36)
            .map(|i| {
                let turn = DQuat::from_axis_angle(down, f64::from(i) * std::f64::consts::TAU / 36.0);
                Pose::looking_at(turn * side * 5.0 - down, DVec3::ZERO, down)
            })
            .collect()
    }

    /// A lawn-mower survey: straight down, headings alternate with the lines.
    fn survey(down: DVec3, lines: u32) -> Vec<Pose> {
        let (x, z) = (down.any_orthonormal_vector(), down.cross(down.any_orthonormal_vector()));
        let mut poses = Vec::new();
        for line in 0..lines {
            let heading = if line % 2 == 0 { x } else { -x };
            for step in 0..20 {
                let eye = x * f64::from(step) + z * f64::from(line) * 3.0;
                poses.push(Pose::looking_at(eye, eye + down, -heading));
            }
        }
        poses
    }

    #[test]
    fn upright_cameras_give_down_in_a_world_with_y_down() {
        let alignment = align(&ring(DVec3::Y), true);
        assert_eq!(alignment.rule, UpRule::MeanCameraDown);
        assert!(error_degrees(&alignment, DVec3::Y) < 1e-6);
    }

    #[test]
    fn upright_cameras_give_down_in_a_world_with_z_up() {
        let alignment = align(&ring(-DVec3::Z), true);
        assert_eq!(alignment.rule, UpRule::MeanCameraDown);
        assert!(error_degrees(&alignment, -DVec3::Z) < 1e-6);
    }

    #[test]
    fn upright_cameras_give_down_in_a_world_with_y_up() {
        let alignment = align(&ring(-DVec3::Y), true);
        assert!(error_degrees(&alignment, -DVec3::Y) < 1e-6);
        assert!((alignment.rotation().length() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn cameras_on_a_straight_path_give_down() {
        let down = DVec3::new(0.1, 0.9, -0.3).normalize();
        let ahead = down.any_orthonormal_vector();
        let poses: Vec<Pose> = (0..50)
            .map(|i| ahead * f64::from(i))
            .map(|eye| Pose::looking_at(eye, eye + ahead, down))
            .collect();
        let alignment = align(&poses, true);
        assert_eq!(alignment.rule, UpRule::MeanCameraDown);
        assert!(error_degrees(&alignment, down) < 1e-6);
    }

    #[test]
    fn a_nadir_survey_gives_the_normal_of_its_plane() {
        for down in [DVec3::Y, -DVec3::Y, -DVec3::Z, DVec3::new(0.3, -0.5, 0.7).normalize()] {
            let alignment = align(&survey(down, 8), true);
            assert_eq!(alignment.rule, UpRule::CentrePlane);
            assert!(error_degrees(&alignment, down) < 1e-6, "down {down}");
        }
    }

    #[test]
    fn a_nadir_line_flown_both_ways_takes_its_viewing_direction() {
        let down = -DVec3::Z;
        let mut poses = survey(down, 1);
        for pose in poses.clone() {
            let heading = -(pose.rotation.inverse() * DVec3::Y);
            poses.push(Pose::looking_at(pose.centre(), pose.centre() + down, heading));
        }
        let alignment = align(&poses, true);
        assert_eq!(alignment.rule, UpRule::ViewingDirection);
        assert!(error_degrees(&alignment, down) < 1e-6);
    }

    #[test]
    fn cameras_without_any_common_direction_keep_the_worlds_y() {
        let up = Pose::looking_at(DVec3::ZERO, -DVec3::Y, DVec3::Z);
        let down = Pose::looking_at(DVec3::ZERO, DVec3::Y, -DVec3::Z);
        let alignment = align(&[up, down], true);
        assert_eq!(alignment.rule, UpRule::WorldY);
        assert_eq!(alignment.down, [0.0, 1.0, 0.0]);
    }

    #[test]
    fn eigenvectors_satisfy_their_equation() {
        let m = DMat3::from_cols_array(&[4.0, 1.0, -2.0, 1.0, 3.0, 0.5, -2.0, 0.5, 9.0]);
        let (values, axes) = symmetric_eigen(m);
        assert!(values.is_sorted());
        for (i, value) in values.into_iter().enumerate() {
            let residual = m * axes.col(i) - axes.col(i) * value;
            assert!(residual.length() < 1e-12, "eigenvalue {i}: residual {residual}");
        }
    }
}
