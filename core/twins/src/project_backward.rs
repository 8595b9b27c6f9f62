//! Backward pass of `project_forward`: from the gradient of splats to the gradient of Gaussians.
//!
//! `extent`, `half_size` and `depth` only select and order splats, so they have no gradient. A ratio x/z or
//! y/z that was clamped in J is a constant there. The projection of the centre is never clamped.

use glam::{DMat3, DVec3};

use super::project_forward::{Geometry, active_coeffs, norm, sigmoid};
use super::{Gaussians64, RasterRules, Splat, SplatGradient, sh_colour_backward};
use fathom_core::scene::{PinholeCamera, Pose};

/// Gradient of the model from the gradient of its splats, both by Gaussian; culled ones get zeros.
pub fn project_backward(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    splats: &[Option<Splat>],
    v_splats: &[SplatGradient],
    rules: &RasterRules,
) -> Gaussians64 {
    let mut v_model = Gaussians64::zeros(model.len(), model.sh_degree);
    for (index, splat) in splats.iter().enumerate() {
        if let Some(splat) = splat {
            backward_of_one(
                model,
                index,
                camera,
                pose,
                sh_degree,
                splat,
                &v_splats[index],
                rules,
                &mut v_model,
            );
        }
    }
    v_model
}

fn backward_of_one(
    model: &Gaussians64,
    index: usize,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    splat: &Splat,
    v: &SplatGradient,
    rules: &RasterRules,
    v_model: &mut Gaussians64,
) {
    let mean = DVec3::from(model.means[index]);
    let m = pose.transform(mean);
    let geometry = Geometry::new(model, index, camera, pose, m);
    let (fx, fy) = (camera.fx, camera.fy);

    // conic = cov2d^-1, so v_cov2d = -conic G conic, where G is the symmetric matrix of v_conic. `b` stands
    // for two entries of the matrix; each has half of its gradient.
    let [a, b, c] = splat.conic;
    let [ga, gb, gc] = [v.conic[0], 0.5 * v.conic[1], v.conic[2]];
    let mut p = -(a * (ga * a + gb * b) + b * (gb * a + gc * b));
    let mut q = -(a * (ga * b + gb * c) + b * (gb * b + gc * c));
    let mut r = -(b * (ga * b + gb * c) + c * (gb * b + gc * c));

    // opacity = sigmoid * c, where c = |n| / sqrt(det cov2d), n = A_0 x A_1, and A_k are the rows of T R S.
    let sigmoid = sigmoid(model.opacity_logits[index]);
    let (mut factor, mut v_axes) = (1.0, [DVec3::ZERO; 2]);
    if rules.mip_filter {
        factor = geometry.compensation();
        let pull = -0.5 * v.opacity * sigmoid * factor;
        p += pull * a;
        q += pull * b;
        r += pull * c;
        let [a0, a1] = geometry.axes();
        let normal = a0.cross(a1);
        // det cov2d = (|n| / c)^2.
        let v_normal = v.opacity * sigmoid * factor / normal.length_squared() * normal;
        v_axes = [a1.cross(v_normal), v_normal.cross(a0)];
    }

    // cov2d = T Sigma T^T with T = J W.
    let [t0, t1] = geometry.rows;
    let (s0, s1) = (geometry.sigma * t0, geometry.sigma * t1);
    let half = geometry.rotation * DMat3::from_diagonal(geometry.scales);
    let v_j0 = geometry.world_to_camera * (2.0 * (p * s0 + q * s1) + half * v_axes[0]);
    let v_j1 = geometry.world_to_camera * (2.0 * (q * s0 + r * s1) + half * v_axes[1]);
    let v_sigma = p * outer(t0, t0) + q * (outer(t0, t1) + outer(t1, t0)) + r * outer(t1, t1);

    // Sigma = (R S) (R S)^T.
    let v_half = 2.0 * (v_sigma * half) + outer(t0, v_axes[0]) + outer(t1, v_axes[1]);
    let v_rotation = v_half * DMat3::from_diagonal(geometry.scales);
    for k in 0..3 {
        let v_scale = v_half.col(k).dot(geometry.rotation.col(k));
        v_model.log_scales[index][k] = v_scale * geometry.scales[k];
    }
    v_model.quats[index] = quat_backward(model.quats[index], v_rotation);

    // mean2d = (fx x/z + cx, fy y/z + cy).
    let inv_z = 1.0 / m.z;
    let mut v_m = DVec3::new(
        fx * inv_z * v.mean2d[0],
        fy * inv_z * v.mean2d[1],
        -(fx * m.x * v.mean2d[0] + fy * m.y * v.mean2d[1]) * inv_z * inv_z,
    );
    // J = ((fx/z, 0, -fx u/z), (0, fy/z, -fy w/z)), where u = x/z and w = y/z unless they are clamped.
    let (u, w) = (geometry.ratio.x, geometry.ratio.y);
    v_m.z += (-fx * v_j0.x - fy * v_j1.y + fx * u * v_j0.z + fy * w * v_j1.z) * inv_z * inv_z;
    let (v_u, v_w) = (-fx * inv_z * v_j0.z, -fy * inv_z * v_j1.z);
    if geometry.inside[0] {
        v_m.x += v_u * inv_z;
        v_m.z -= v_u * u * inv_z;
    }
    if geometry.inside[1] {
        v_m.y += v_w * inv_z;
        v_m.z -= v_w * w * inv_z;
    }
    // range = |m|.
    v_m += v.range / splat.range * m;

    // Colour by direction = (mean - camera) / |mean - camera|.
    let towards = mean - pose.centre();
    let distance = towards.length();
    let direction = towards / distance;
    let coeffs = active_coeffs(model, index, sh_degree);
    let first = index * model.coeffs();
    let v_coeffs = &mut v_model.sh_coeffs[first..first + coeffs.len()];
    let v_direction = sh_colour_backward(direction, coeffs, v.rgb, v_coeffs);
    let v_towards = (v_direction - direction * direction.dot(v_direction)) / distance;

    v_model.means[index] = (geometry.world_to_camera.transpose() * v_m + v_towards).into();
    v_model.opacity_logits[index] = v.opacity * factor * sigmoid * (1.0 - sigmoid);
}

/// Column a times row b.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Gradient of q through R(q / |q|); `v_rotation` is the derivative with respect to each entry of R.
pub(super) fn quat_backward(quat: [f64; 4], v_rotation: DMat3) -> [f64; 4] {
    let length = norm(quat);
    let unit = quat.map(|v| v / length);
    let [w, x, y, z] = unit;
    let g = |row: usize, column: usize| v_rotation.col(column)[row];
    let v_unit = [
        2.0 * (x * (g(2, 1) - g(1, 2)) + y * (g(0, 2) - g(2, 0)) + z * (g(1, 0) - g(0, 1))),
        2.0 * (y * (g(0, 1) + g(1, 0)) + z * (g(0, 2) + g(2, 0)) + w * (g(2, 1) - g(1, 2))
            - 2.0 * x * (g(1, 1) + g(2, 2))),
        2.0 * (x * (g(0, 1) + g(1, 0)) + z * (g(1, 2) + g(2, 1)) + w * (g(0, 2) - g(2, 0))
            - 2.0 * y * (g(0, 0) + g(2, 2))),
        2.0 * (x * (g(0, 2) + g(2, 0)) + y * (g(1, 2) + g(2, 1)) + w * (g(1, 0) - g(0, 1))
            - 2.0 * z * (g(0, 0) + g(1, 1))),
    ];
    let along: f64 = unit.iter().zip(v_unit).map(|(a, b)| a * b).sum();
    std::array::from_fn(|i| (v_unit[i] - unit[i] * along) / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use crate::project_forward::project_forward;
    use crate::samples::{all, off_centre_view};
    use crate::{NEAR, RasterRules};
    use fathom_core::rng::{Stream, uniform_at};

    /// One weight for each number of a splat; the weighted sum is the loss.
    fn weights(id: usize) -> SplatGradient {
        let u = |j| 2.0 * f64::from(uniform_at(21, Stream::Test, id as u32, j)) - 1.0;
        SplatGradient {
            mean2d: [u(0), u(1)],
            conic: [u(2), u(3), u(4)],
            rgb: [u(5), u(6), u(7)],
            opacity: u(8),
            range: u(9),
            ..SplatGradient::default()
        }
    }

    fn weighted(splat: &Splat, v: &SplatGradient) -> f64 {
        let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        sum(&splat.mean2d, &v.mean2d)
            + sum(&splat.conic, &v.conic)
            + sum(&splat.rgb, &v.rgb)
            + splat.opacity * v.opacity
            + splat.range * v.range
    }

    #[test]
    fn gradients_are_central_differences_at_every_degree_and_shape() {
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        for (sh_degree, mip_filter) in [(0, false), (1, false), (2, false), (3, false), (1, true), (3, true)]
        {
            // With the filter, needles are too faint to be visible, so edges are switched off.
            let edges = if mip_filter { RasterRules::SMOOTH } else { RasterRules::HARD };
            let rules = RasterRules { mip_filter, ..edges };
            for (name, model) in all(22 + u32::from(sh_degree), 12, 3) {
                let splats = project_forward(&model, &camera, &pose, sh_degree, &rules);
                let v_splats: Vec<_> = (0..model.len()).map(weights).collect();
                let analytic =
                    project_backward(&model, &camera, &pose, sh_degree, &splats, &v_splats, &rules);
                assert!(splats.iter().flatten().count() > 8, "{name} must be visible");
                for id in (0..model.len()).filter(|&id| splats[id].is_some()) {
                    for parameter in 0..model.parameters() {
                        let numeric = derivative(|h| {
                            let mut moved = model.clone();
                            *moved.parameter_mut(id, parameter) += h;
                            project_forward(&moved, &camera, &pose, sh_degree, &rules)[id]
                                .map_or(f64::NAN, |splat| weighted(&splat, &v_splats[id]))
                        });
                        let what = format!(
                            "{name}, degree {sh_degree}, filter {mip_filter}, {} of Gaussian {id}",
                            Gaussians64::parameter_name(parameter)
                        );
                        // Pixel coordinates are near 100, so rounding is 1e-14 / H = 1e-10.
                        assert_close(&what, analytic.parameter(id, parameter), numeric, 1e-2);
                    }
                }
            }
        }
    }

    #[test]
    fn higher_bands_than_the_schedule_has_reached_get_no_gradient() {
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        let (_, model) = all(5, 10, 3).swap_remove(0);
        let splats = project_forward(&model, &camera, &pose, 1, &RasterRules::HARD);
        let v_splats: Vec<_> = (0..model.len()).map(weights).collect();
        let v_model = project_backward(&model, &camera, &pose, 1, &splats, &v_splats, &RasterRules::HARD);
        for (i, v) in v_model.sh_coeffs.iter().enumerate() {
            assert_eq!(i % 16 >= 4, *v == [0.0; 3], "coefficient {i}");
        }
    }

    #[test]
    fn beyond_the_bounds_of_the_linearisation_the_ratio_is_held() {
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        let (_, model) = all(5, 60, 0).swap_remove(3);
        let clamped = (0..model.len())
            .filter(|&id| {
                let m = pose.transform(model.means[id].into());
                m.z > NEAR && Geometry::new(&model, id, &camera, &pose, m).inside != [true; 2]
            })
            .count();
        // The central differences above include such Gaussians; this checks that some exist.
        assert!(clamped > 20, "{clamped}");
    }

    #[test]
    fn a_culled_gaussian_gets_no_gradient_even_from_nan() {
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        let (model, names) = crate::samples::degenerate(2);
        let model = Gaussians64::from(&model);
        let splats = project_forward(&model, &camera, &pose, 2, &RasterRules::HARD);
        for (splat, name) in splats.iter().zip(&names) {
            assert_eq!(*splat, None, "{name}");
        }
        let v_splats = vec![SplatGradient { opacity: f64::NAN, ..SplatGradient::default() }; model.len()];
        let v_model = project_backward(&model, &camera, &pose, 2, &splats, &v_splats, &RasterRules::HARD);
        assert_eq!(v_model, Gaussians64::zeros(model.len(), 2));
    }
}
