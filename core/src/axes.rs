//! Rotates a model to other axes.
//!
//! A model has the axes of its photographs' poses. The frame of its plan has y down and the sides of the
//! survey along x and z. Means and quaternions are multiplied by the rotation. The harmonics of a band mix
//! among themselves. Colour by direction must not change, so the coefficients c' of the rotated Gaussian
//! satisfy `sum c'_k Y_k(R d) = sum c_k Y_k(d)` for every direction d. In a band, Y_k(R d) is an orthogonal
//! matrix D times Y_k(d), so c' = D c (Ivanic and Ruedenberg 1996). D is computed by its definition, the
//! integral of Y_k(R d) Y_l(d) over the sphere, with a quadrature that is exact for these polynomials.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::gaussians::{Gaussians, MAX_SH_COEFFS};
use crate::harmonics::sh_basis;
use crate::linear_colours::sphere;
use crate::{CoreError, Result};

/// Start of the header comment that states the axes of a model: the rotation from the scene's axes to its
/// own, order w x y z.
const COMMENT: &str = "fathom frame: scene_to_model_quat_wxyz ";

/// The header comment of a model whose axes are the scene's, rotated by `rotation`.
pub fn comment(rotation: DQuat) -> String {
    let DQuat { x, y, z, w } = rotation;
    format!("{COMMENT}{w} {x} {y} {z}")
}

/// Whether a header comment states the axes of the model.
pub fn is_in(comment: &str) -> bool {
    comment.starts_with(COMMENT)
}

/// The rotation from the scene's axes to the model's, read from its header comments; `None` if the model has
/// the scene's axes.
///
/// # Errors
/// When the comment does not hold the four numbers of a rotation.
pub fn among(comments: &[String]) -> Result<Option<DQuat>> {
    let Some(words) = comments.iter().find_map(|comment| comment.strip_prefix(COMMENT)) else {
        return Ok(None);
    };
    let numbers: Vec<f64> = words.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    let refuse = || CoreError::Scene(format!("the frame in the model's header is not a rotation: {words:?}"));
    let [w, x, y, z] = <[f64; 4]>::try_from(numbers).map_err(|_| refuse())?;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    // Phrased positively, so that NaN fails.
    let is_unit = (rotation.length() - 1.0).abs() < 1e-6;
    if is_unit { Ok(Some(rotation.normalize())) } else { Err(refuse()) }
}

/// The same model in rotated axes: a point p becomes `rotation * p`.
#[must_use]
pub fn turned(model: Gaussians, rotation: DQuat) -> Gaussians {
    let harmonics = harmonics(rotation);
    let coeffs = model.coeffs();
    let mut turned = model;
    turned.means.par_iter_mut().for_each(|mean| {
        *mean = (rotation * DVec3::from(mean.map(f64::from))).as_vec3().to_array();
    });
    turned.quats.par_iter_mut().for_each(|quat| {
        let [w, x, y, z] = quat.map(f64::from);
        let q = rotation * DQuat::from_xyzw(x, y, z, w);
        *quat = [q.w, q.x, q.y, q.z].map(|value| value as f32);
    });
    turned.sh_coeffs.par_chunks_mut(coeffs).for_each(|of_one| {
        let old: Vec<[f64; 3]> = of_one.iter().map(|rgb| rgb.map(f64::from)).collect();
        // The first band is a constant.
        for (k, new) in of_one.iter_mut().enumerate().skip(1) {
            let band = band_of(k);
            *new = std::array::from_fn(|c| {
                band.clone().map(|l| harmonics[k][l] * old[l][c]).sum::<f64>() as f32
            });
        }
    });
    turned
}

/// The coefficients of the band that coefficient `k` belongs to.
fn band_of(k: usize) -> std::ops::Range<usize> {
    let degree = k.isqrt();
    degree * degree..(degree + 1) * (degree + 1)
}

/// D of every band in one matrix: entry `[k][l]` is the weight of the old coefficient l in the new
/// coefficient k.
fn harmonics(rotation: DQuat) -> [[f64; MAX_SH_COEFFS]; MAX_SH_COEFFS] {
    let mut sums = [[0.0; MAX_SH_COEFFS]; MAX_SH_COEFFS];
    for (direction, basis, weight) in sphere() {
        let turned = sh_basis(rotation * direction);
        for (k, row) in sums.iter_mut().enumerate() {
            for l in band_of(k) {
                row[l] += weight * turned[k] * basis[l];
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Stream, uniform_at};

    fn draw(i: u32, k: u32) -> f64 {
        2.0 * f64::from(uniform_at(17, Stream::Test, i, k)) - 1.0
    }

    fn direction(i: u32) -> DVec3 {
        DVec3::new(draw(i, 0), draw(i, 1), draw(i, 2)).normalize()
    }

    fn rotation(i: u32) -> DQuat {
        DQuat::from_xyzw(draw(i, 3), draw(i, 4), draw(i, 5), draw(i, 6)).normalize()
    }

    fn model(sh_degree: u8, count: u32) -> Gaussians {
        let mut model = Gaussians::empty(sh_degree);
        for i in 0..count {
            let number = |k| draw(i, k) as f32;
            model.means.push([10, 11, 12].map(|k| 5.0 * number(k)));
            model.quats.push([13, 14, 15, 16].map(|k| 3.0 * number(k)));
            model.log_scales.push([17, 18, 19].map(number));
            model.opacity_logits.push(number(20));
            model
                .sh_coeffs
                .extend((0..model.coeffs() as u32).map(|k| [0, 1, 2].map(|c| number(21 + 3 * k + c))));
        }
        model
    }

    fn colour(model: &Gaussians, index: usize, direction: DVec3) -> [f64; 3] {
        let k = model.coeffs();
        let coeffs: Vec<[f64; 3]> =
            model.sh_coeffs[index * k..(index + 1) * k].iter().map(|rgb| rgb.map(f64::from)).collect();
        let basis = sh_basis(direction);
        std::array::from_fn(|c| {
            let sum: f64 = coeffs.iter().zip(&basis).map(|(coefficient, y)| y * coefficient[c]).sum();
            (0.5 + sum).max(0.0)
        })
    }

    #[test]
    fn a_rotated_gaussian_keeps_its_colour_in_the_rotated_direction() {
        for sh_degree in 0..=3 {
            let before = model(sh_degree, 20);
            for case in 0..10 {
                let rotation = rotation(case);
                let after = turned(before.clone(), rotation);
                for index in 0..before.len() {
                    let d = direction(100 + index as u32);
                    let (old, new) = (colour(&before, index, d), colour(&after, index, rotation * d));
                    for c in 0..3 {
                        // Coefficients below 1 are rounded to f32, 6e-8 each, 16 of them.
                        assert!((old[c] - new[c]).abs() < 2e-6, "SH {sh_degree}, {index}: {old:?} {new:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_rotated_gaussian_has_the_rotated_position_and_shape() {
        let (before, rotation) = (model(1, 30), rotation(3));
        let after = turned(before.clone(), rotation);
        let covariance = |model: &Gaussians, index: usize, along: DVec3| {
            let [w, x, y, z] = model.quats[index].map(f64::from);
            let local = DQuat::from_xyzw(x, y, z, w).normalize().inverse() * along;
            let scales = DVec3::from(model.log_scales[index].map(|s| f64::from(s).exp()));
            (local * scales).length_squared()
        };
        for index in 0..before.len() {
            let mean = rotation * DVec3::from(before.means[index].map(f64::from));
            assert!(mean.distance(DVec3::from(after.means[index].map(f64::from))) < 1e-6);
            let d = direction(index as u32);
            let (old, new) = (covariance(&before, index, d), covariance(&after, index, rotation * d));
            assert!((old - new).abs() < 1e-5 * old, "{index}: {old} {new}");
        }
        assert_eq!((after.log_scales, after.opacity_logits), (before.log_scales, before.opacity_logits));
    }

    #[test]
    fn rotating_there_and_back_gives_the_same_model() {
        let (before, rotation) = (model(3, 30), rotation(7));
        let after = turned(turned(before.clone(), rotation), rotation.inverse());
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 3e-6);
        assert!(close(before.means.as_flattened(), after.means.as_flattened()));
        assert!(close(before.quats.as_flattened(), after.quats.as_flattened()));
        assert!(close(before.sh_coeffs.as_flattened(), after.sh_coeffs.as_flattened()));
    }

    #[test]
    fn a_header_keeps_the_frame_and_refuses_a_non_rotation() {
        let rotation = rotation(5);
        let found = among(&["by hand".to_owned(), comment(rotation)]).expect("a frame").expect("one");
        assert!((found.x - rotation.x).abs() < 1e-15 && (found.w - rotation.w).abs() < 1e-15);
        assert_eq!(among(&["by hand".to_owned()]).expect("no frame"), None);
        for wrong in ["1 0 0", "1 0 0 x", "2 0 0 0", "NaN 0 0 0"] {
            let error = among(&[format!("{COMMENT}{wrong}")]).expect_err(wrong).to_string();
            assert!(error.contains(wrong), "{error}");
        }
    }
}
