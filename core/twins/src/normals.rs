//! Normal consistency of disks: the blended normal against that of the expected range (2DGS, Huang et al.
//! 2024, eq. 14).
//!
//! ```text
//! loss = weight * sum over pixels of (alpha - n.N),   N = dy x dx / |dy x dx|
//! ```
//!
//! n is the blended normal and N that of the surface on which the rays end, by central differences. Alpha
//! counts as a constant, as in the authors' code; through the expected range R / alpha it has a gradient.
//! Pixels at the border of the image, and those with a neighbour of low alpha, have no N.

use glam::DVec3;

use super::{DiskRaster, DiskRay};

/// The loss and its gradients.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NormalConsistency {
    /// The sum over pixels, times the weight.
    pub loss: f64,
    /// With respect to the blended normal, `[H*W]`.
    pub v_normal: Vec<[f64; 3]>,
    /// With respect to the blended range, `[H*W]`.
    pub v_range: Vec<f64>,
    /// With respect to alpha, `[H*W]`.
    pub v_alpha: Vec<f64>,
}

/// The normal consistency of a picture whose pixels have these rays.
pub fn normal_consistency(
    picture: &DiskRaster,
    rays: &[DiskRay],
    weight: f64,
    least_alpha: f64,
) -> NormalConsistency {
    let raster = &picture.raster;
    let (width, height) = (raster.width as usize, raster.height as usize);
    let pixels = rays.len();
    let unit = |i: usize| rays[i].direction.normalize();
    let range = |i: usize| raster.range[i] / raster.alpha[i].max(1e-6);
    let end = |i: usize| range(i) * unit(i);
    let mut out = NormalConsistency {
        loss: 0.0,
        v_normal: vec![[0.0; 3]; pixels],
        v_range: vec![0.0; pixels],
        v_alpha: vec![0.0; pixels],
    };
    let mut v_end = vec![DVec3::ZERO; pixels];
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            let [left, right, above, below] = [i - 1, i + 1, i - width, i + width];
            if [i, left, right, above, below].iter().any(|&j| raster.alpha[j] < least_alpha) {
                continue;
            }
            let (dx, dy) = (end(right) - end(left), end(below) - end(above));
            let across = dy.cross(dx);
            if across.length() <= 1e-20 {
                continue;
            }
            let surface = across.normalize();
            let normal = DVec3::from(picture.normal[i]);
            out.loss += weight * (raster.alpha[i] - normal.dot(surface));
            out.v_normal[i] = (-weight * surface).into();
            let v_surface = -weight * normal;
            let v_across = (v_surface - surface * surface.dot(v_surface)) / across.length();
            let (v_dx, v_dy) = (v_across.cross(dy), dx.cross(v_across));
            v_end[right] += v_dx;
            v_end[left] -= v_dx;
            v_end[below] += v_dy;
            v_end[above] -= v_dy;
        }
    }
    for i in (0..pixels).filter(|&i| raster.alpha[i] > 1e-6) {
        let v_range = v_end[i].dot(unit(i));
        out.v_range[i] = v_range / raster.alpha[i];
        out.v_alpha[i] = -v_range * range(i) / raster.alpha[i];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use crate::samples::off_centre_view;
    use crate::{Raster, pinhole_rays};
    use fathom_core::rng::{Stream, uniform_at};
    use fathom_core::scene::PinholeCamera;

    const WIDTH: u32 = 9;
    const HEIGHT: u32 = 7;

    fn picture() -> (DiskRaster, PinholeCamera) {
        let pixels = 0..WIDTH * HEIGHT;
        let u = |i, j| f64::from(uniform_at(91, Stream::Test, i, j));
        let alpha: Vec<f64> = pixels.clone().map(|i| 0.4 + 0.6 * u(i, 0)).collect();
        let range = pixels.clone().map(|i| alpha[i as usize] * (2.0 + 0.3 * u(i, 1))).collect();
        let normal = pixels.map(|i| [u(i, 2) - 0.5, u(i, 3) - 0.5, -u(i, 4)]).collect();
        let raster = Raster { width: WIDTH, height: HEIGHT, alpha, range, ..Raster::default() };
        (DiskRaster { raster, normal, ..DiskRaster::default() }, off_centre_view(WIDTH, HEIGHT, 3.0).0)
    }

    #[test]
    fn gradients_of_normal_consistency_are_central_differences() {
        let (picture, camera) = picture();
        let rays = pinhole_rays(&camera);
        let of = |picture: &DiskRaster| normal_consistency(picture, &rays, 1.5, 0.5);
        let analytic = of(&picture);
        let counted = analytic.v_normal.iter().filter(|v| **v != [0.0; 3]).count();
        assert!((5..30).contains(&counted), "{counted} pixels have a surface");
        for i in 0..rays.len() {
            let moved = |change: &dyn Fn(&mut DiskRaster, f64)| {
                derivative(|h| {
                    let mut moved = picture.clone();
                    change(&mut moved, h);
                    of(&moved).loss
                })
            };
            for c in 0..3 {
                let numeric = moved(&|picture, h| picture.normal[i][c] += h);
                assert_close(&format!("normal {c} of {i}"), analytic.v_normal[i][c], numeric, 1e-3);
            }
            let numeric = moved(&|picture, h| picture.raster.range[i] += h);
            assert_close(&format!("range of {i}"), analytic.v_range[i], numeric, 1e-2);
            // Alpha itself counts as a constant: its own share of the loss is not part of the gradient.
            let own = if analytic.v_normal[i] == [0.0; 3] { 0.0 } else { 1.5 };
            let numeric = moved(&|picture, h| picture.raster.alpha[i] += 0.1 * h) / 0.1 - own;
            assert_close(&format!("alpha of {i}"), analytic.v_alpha[i], numeric, 1e-2);
        }
    }

    #[test]
    fn a_plane_with_its_own_normal_has_no_loss() {
        let camera = PinholeCamera { width: 30, height: 20, fx: 25.0, fy: 25.0, cx: 15.0, cy: 10.0 };
        let rays = pinhole_rays(&camera);
        let normal = DVec3::new(0.2, -0.3, -0.9).normalize();
        // normal.x = -2
        let range = |ray: &DiskRay| -2.0 / normal.dot(ray.direction.normalize());
        let raster = Raster {
            width: 30,
            height: 20,
            alpha: vec![1.0; rays.len()],
            range: rays.iter().map(range).collect(),
            ..Raster::default()
        };
        let picture = DiskRaster { raster, normal: vec![normal.into(); rays.len()], ..DiskRaster::default() };
        let found = normal_consistency(&picture, &rays, 1.0, 0.5);
        assert!(found.loss.abs() < 1e-9, "{}", found.loss);
        assert!(found.v_range.iter().all(|v| v.abs() < 1e-6));
    }
}
