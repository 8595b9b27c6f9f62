//! From a Gaussian to a splat in one camera (3DGS; EWA splatting, Zwicker et al. 2002).
//!
//! This stage alone decides visibility. Every splat that passes is finite, in front of the camera and has a
//! positive definite conic, so no later stage checks again. The guards are phrased positively (`depth >
//! NEAR`), so that NaN fails them. `intersect` decides whether a splat reaches the image.

use glam::{DMat3, DVec2, DVec3};

use super::{BLUR, Gaussians64, NEAR, RasterRules, sh_colour};
use fathom_core::scene::{PinholeCamera, Pose};

/// A Gaussian in one camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Splat {
    /// Centre, pixels from the top-left corner.
    pub mean2d: [f64; 2],
    /// Inverse covariance (a, b, c), 1/px^2: sigma = 0.5 (a dx^2 + c dy^2) + b dx dy.
    pub conic: [f64; 3],
    /// Colour in the direction of the camera.
    pub rgb: [f64; 3],
    /// Sigmoid of the logit, times the compensation of the low-pass with `mip_filter`.
    pub opacity: f64,
    /// Distance of the centre from the camera, scene units.
    pub range: f64,
    /// z of the centre in the camera's frame: the sort key, scene units.
    pub depth: f64,
    /// sigma at which alpha falls to `min_alpha`: ln(opacity / min_alpha). Infinite without that edge.
    pub extent: f64,
    /// Half sides of the box around the ellipse sigma = `extent`, pixels.
    pub half_size: [f64; 2],
}

/// Projects every Gaussian; `None` where it is culled.
///
/// `sh_degree` is that of the schedule; if it is lower than the model's, the higher bands are left out.
pub fn project_forward(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    rules: &RasterRules,
) -> Vec<Option<Splat>> {
    (0..model.len()).map(|index| project(model, index, camera, pose, sh_degree, rules)).collect()
}

fn project(
    model: &Gaussians64,
    index: usize,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    rules: &RasterRules,
) -> Option<Splat> {
    let finite = model.means[index].iter().all(|v| v.is_finite())
        && model.quats[index].iter().all(|v| v.is_finite())
        && model.log_scales[index].iter().all(|v| v.is_finite())
        && model.opacity_logits[index].is_finite();
    let quat_norm = norm(model.quats[index]);
    let opacity = sigmoid(model.opacity_logits[index]);
    let m = pose.transform(model.means[index].into());
    if !(finite
        && quat_norm > 0.0
        && quat_norm.is_finite()
        && m.z > NEAR
        && opacity > 0.0
        && opacity >= rules.min_alpha)
    {
        return None;
    }

    let geometry = Geometry::new(model, index, camera, pose, m);
    let [xx, xy, yy] = geometry.cov2d();
    let determinant = xx * yy - xy * xy;
    let conic = [yy / determinant, -xy / determinant, xx / determinant];
    let opacity = if rules.mip_filter { opacity * geometry.compensation() } else { opacity };
    let mean2d = [camera.fx * m.x / m.z + camera.cx, camera.fy * m.y / m.z + camera.cy];

    let direction = (DVec3::from(model.means[index]) - pose.centre()).normalize();
    let rgb = sh_colour(direction, active_coeffs(model, index, sh_degree));
    let range = m.length();

    let finite = mean2d.iter().chain(&conic).chain(&rgb).all(|v| v.is_finite())
        && range.is_finite()
        && xx.is_finite()
        && yy.is_finite();
    if !(finite && determinant > 0.0 && opacity > 0.0 && opacity >= rules.min_alpha) {
        return None;
    }
    let extent = (opacity / rules.min_alpha).ln();
    Some(Splat {
        mean2d,
        conic,
        rgb,
        opacity,
        range,
        depth: m.z,
        extent,
        half_size: [(2.0 * extent * xx).sqrt(), (2.0 * extent * yy).sqrt()],
    })
}

/// The frames and the linearised camera at one Gaussian, used by forward and backward.
pub(super) struct Geometry {
    /// World to camera.
    pub world_to_camera: DMat3,
    /// Axes of the Gaussian in the world, as orthonormal columns.
    pub rotation: DMat3,
    /// Standard deviations along them.
    pub scales: DVec3,
    /// Covariance in the world.
    pub sigma: DMat3,
    /// Rows of J W, the derivative of the pixel position with respect to the world position.
    pub rows: [DVec3; 2],
    /// x/z and y/z as used in J, clamped to [`ratio_bounds`].
    pub ratio: DVec2,
    /// Whether x/z and y/z are inside the bounds before clamping.
    pub inside: [bool; 2],
}

impl Geometry {
    /// The geometry at Gaussian `index`, whose centre in the camera's frame is `m`.
    pub fn new(model: &Gaussians64, index: usize, camera: &PinholeCamera, pose: &Pose, m: DVec3) -> Self {
        let world_to_camera = DMat3::from_quat(pose.rotation);
        let rotation = rotation_matrix(model.quats[index]);
        let scales = DVec3::from(model.log_scales[index].map(f64::exp));
        let half = rotation * DMat3::from_diagonal(scales);
        let sigma = half * half.transpose();

        let free = DVec2::new(m.x / m.z, m.y / m.z);
        let (low, high) = ratio_bounds(camera);
        let ratio = free.clamp(low, high);
        let j0 = DVec3::new(camera.fx / m.z, 0.0, -camera.fx * ratio.x / m.z);
        let j1 = DVec3::new(0.0, camera.fy / m.z, -camera.fy * ratio.y / m.z);
        let rows = [world_to_camera.transpose() * j0, world_to_camera.transpose() * j1];
        let inside = [ratio.x == free.x, ratio.y == free.y];
        Self { world_to_camera, rotation, scales, sigma, rows, ratio, inside }
    }

    /// Rows of J W R S: cov2d without the low-pass is their Gram matrix.
    pub fn axes(&self) -> [DVec3; 2] {
        self.rows.map(|row| self.scales * (self.rotation.transpose() * row))
    }

    /// sqrt(det(cov2d without the low-pass) / det(cov2d)); the former is the square of an area.
    pub fn compensation(&self) -> f64 {
        let [xx, xy, yy] = self.cov2d();
        let [a, b] = self.axes();
        a.cross(b).length() / (xx * yy - xy * xy).sqrt()
    }

    /// J W Sigma W^T J^T + BLUR I as (xx, xy, yy), px^2.
    pub fn cov2d(&self) -> [f64; 3] {
        let [t0, t1] = self.rows;
        let (s0, s1) = (self.sigma * t0, self.sigma * t1);
        [t0.dot(s0) + BLUR, t0.dot(s1), t1.dot(s1) + BLUR]
    }
}

/// Coefficients of Gaussian `index` up to `sh_degree` or the degree of the model.
pub(super) fn active_coeffs(model: &Gaussians64, index: usize, sh_degree: u8) -> &[[f64; 3]] {
    let stored = model.coeffs();
    let active = (usize::from(sh_degree) + 1).pow(2).min(stored);
    &model.sh_coeffs[index * stored..index * stored + active]
}

pub(super) fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}

pub(super) fn norm(quat: [f64; 4]) -> f64 {
    quat.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Bounds of x/z and y/z in J: the image and 15 % of its size on each side (gsplat). Far outside the image,
/// the linearisation of the camera is meaningless and its covariance explodes.
fn ratio_bounds(camera: &PinholeCamera) -> (DVec2, DVec2) {
    let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let focal = DVec2::new(camera.fx, camera.fy);
    let centre = DVec2::new(camera.cx, camera.cy);
    let margin = 0.3 * size / (2.0 * focal);
    (-centre / focal - margin, (size - centre) / focal + margin)
}

/// Rotation of a quaternion w x y z of any length above 0.
pub(super) fn rotation_matrix(quat: [f64; 4]) -> DMat3 {
    let [w, x, y, z] = quat.map(|v| v / norm(quat));
    DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::samples::off_centre_view;

    #[test]
    fn under_the_mip_filter_the_low_pass_keeps_a_splats_integral() {
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        let mut model = Gaussians64::zeros(1, 0);
        model.quats[0] = [0.9, 0.1, -0.3, 0.2];
        let rules = RasterRules { mip_filter: true, ..RasterRules::SMOOTH };
        // From far below a pixel to far above it; flat and round.
        for log_scales in [[-7.0, -6.0, -6.5], [-4.0, -9.0, -3.0], [-1.0, -0.5, -2.0]] {
            model.log_scales[0] = log_scales;
            let m = pose.transform(model.means[0].into());
            let [xx, xy, yy] = Geometry::new(&model, 0, &camera, &pose, m).cov2d();
            let bare = (xx - BLUR) * (yy - BLUR) - xy * xy;
            let splat =
                project(&model, 0, &camera, &pose, 0, &rules).map(|splat| (splat.opacity, splat.conic));
            let Some((opacity, [a, b, c])) = splat else { panic!("{log_scales:?} is visible") };
            // Integral of opacity * exp(-sigma) over the plane, without 2 pi: with and without the low-pass.
            let (with, without) = (opacity / (a * c - b * b).sqrt(), 0.5 * bare.sqrt());
            assert!((with / without - 1.0).abs() < 1e-6, "{log_scales:?}: {with} and {without}");
        }
    }
}
