//! A renderer without tiles, lists or boxes, independent of the twins: it loops over all Gaussians for each
//! pixel.
//!
//! It computes the same numbers in other ways: glam's quaternions and inverses instead of written-out ones,
//! the colour from the caller's closure, the weights from the definition. Only tests use it.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};

use super::{Gaussians64, RasterRules};
use fathom_core::scene::{PinholeCamera, Pose};

/// Colour, alpha and range of one pixel.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pixel {
    pub rgb: DVec3,
    pub alpha: f64,
    pub range: f64,
}

/// Renders every pixel; `colour(gaussian, direction)` gives its unclamped RGB.
pub fn brute_force(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    background: DVec3,
    rules: &RasterRules,
    colour: impl Fn(usize, DVec3) -> DVec3,
) -> Vec<Pixel> {
    let mut order: Vec<(usize, DVec3)> = (0..model.len())
        .map(|i| (i, pose.transform(DVec3::from(model.means[i]))))
        .filter(|(_, m)| m.z > 0.01)
        .collect();
    order.sort_by(|(_, a), (_, b)| a.z.total_cmp(&b.z));

    let pixel = |x: u32, y: u32| {
        let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let mut out = Pixel::default();
        let mut left = 1.0;
        for &(i, m) in &order {
            let offset =
                centre - DVec2::new(camera.cx + camera.fx * m.x / m.z, camera.cy + camera.fy * m.y / m.z);
            let opacity = (0.5 * model.opacity_logits[i]).tanh() * 0.5 + 0.5;
            let exponent = -0.5 * offset.dot(covariance(model, i, camera, pose, m).inverse() * offset);
            let alpha = (opacity * exponent.exp()).min(rules.max_alpha);
            if alpha < rules.min_alpha {
                continue;
            }
            if left * (1.0 - alpha) < rules.min_transmittance {
                break;
            }
            let direction = (DVec3::from(model.means[i]) - pose.centre()).normalize();
            out.rgb += left * alpha * colour(i, direction).max(DVec3::ZERO);
            out.range += left * alpha * m.length();
            out.alpha += left * alpha;
            left *= 1.0 - alpha;
        }
        out.rgb += left * background;
        out
    };
    (0..camera.height)
        .flat_map(|y| (0..camera.width).map(move |x| (x, y)))
        .map(|(x, y)| pixel(x, y))
        .collect()
}

/// Covariance on the image from the definition: J W Sigma W^T J^T with 3x3 matrices, and the blur.
fn covariance(model: &Gaussians64, i: usize, camera: &PinholeCamera, pose: &Pose, m: DVec3) -> DMat2 {
    let [w, x, y, z] = model.quats[i];
    let axes = pose.rotation * DQuat::from_xyzw(x, y, z, w).normalize();
    let [sx, sy, sz] = model.log_scales[i].map(|s| (2.0 * s).exp());
    let turn = DMat3::from_quat(axes);
    let in_camera = turn * DMat3::from_diagonal(DVec3::new(sx, sy, sz)) * turn.transpose();

    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let u = (m.x / m.z)
        .max(-camera.cx / camera.fx - 0.15 * width / camera.fx)
        .min((width - camera.cx) / camera.fx + 0.15 * width / camera.fx);
    let v = (m.y / m.z)
        .max(-camera.cy / camera.fy - 0.15 * height / camera.fy)
        .min((height - camera.cy) / camera.fy + 0.15 * height / camera.fy);
    let jacobian = DMat3::from_cols(
        DVec3::new(camera.fx, 0.0, 0.0),
        DVec3::new(0.0, camera.fy, 0.0),
        DVec3::new(-camera.fx * u, -camera.fy * v, 0.0),
    ) * (1.0 / m.z);
    let full = jacobian * in_camera * jacobian.transpose();
    DMat2::from_cols(full.x_axis.truncate(), full.y_axis.truncate()) + DMat2::from_diagonal(DVec2::splat(0.3))
}
