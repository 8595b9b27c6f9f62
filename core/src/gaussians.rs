//! A model on the host: Gaussians as structure of arrays, in the parametrisation that is trained.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Coefficients per channel at the highest degree that Fathom trains (SH 3).
pub const MAX_SH_COEFFS: usize = 16;
/// Y_0^0, the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc.
pub const SH_C0: f32 = 0.282_094_8;

/// Whether a Gaussian is so large that many partitions see it: haze and distant background.
///
/// Every partition renders it as in the coarse model, and the partition whose cell contains it submits it
/// unchanged. If it were trained, each partition would fit its own copy to its own views, and the merged
/// model would keep only one of them. A standard deviation of a fifth of the scene scale (`viewing_distance`)
/// covers a picture. If the scene scale is unknown, no Gaussian is shared.
pub fn is_shared(log_scale: [f32; 3], viewing_distance: Option<f32>) -> bool {
    const SHARE: f32 = 0.2;
    viewing_distance.is_some_and(|distance| log_scale.iter().any(|log| log.exp() > SHARE * distance))
}

/// N Gaussians. All vectors have N entries; `sh_coeffs` has N * [`Gaussians::coeffs`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Gaussians {
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Centres, scene units, world axes.
    pub means: Vec<[f32; 3]>,
    /// Rotation, order w x y z; normalised on use.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithm of the standard deviations along the rotated axes.
    pub log_scales: Vec<[f32; 3]>,
    /// Opacity before the sigmoid.
    pub opacity_logits: Vec<f32>,
    /// [N, K, 3] flattened over N and K: entry `n * K + k` is the RGB of coefficient k.
    pub sh_coeffs: Vec<[f32; 3]>,
}

/// Position and size of a Gaussian in the layout of the device: centre and opacity logit; quaternion;
/// logarithms of the scales.
pub type Transform = [[f32; 4]; 3];

impl Gaussians {
    /// No Gaussians, of the given degree.
    pub fn empty(sh_degree: u8) -> Self {
        Self { sh_degree, ..Self::default() }
    }

    /// Makes the third scale a hundredth of the smaller of the others: as thin as programs that know only 3D
    /// Gaussians still show without gaps.
    pub fn flatten(&mut self) {
        const THIN: f32 = 0.01;
        self.log_scales.iter_mut().for_each(|[u, v, thin]| *thin = u.min(*v) + THIN.ln());
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// K = (degree + 1)^2.
    pub fn coeffs(&self) -> usize {
        (self.sh_degree as usize + 1).pow(2)
    }

    /// Position and size of a Gaussian.
    pub fn transform(&self, index: usize) -> Transform {
        let [x, y, z] = self.means[index];
        let [sx, sy, sz] = self.log_scales[index];
        [[x, y, z, self.opacity_logits[index]], self.quats[index], [sx, sy, sz, 0.0]]
    }

    /// The unit normal of each Gaussian: its shortest axis, pointing to the side of `eye`; world axes,
    /// `[N,3]`.
    ///
    /// If several axes are equally short, it is one of them. It is zero for a zero quaternion.
    pub fn normals_towards(&self, eye: DVec3) -> Vec<[f32; 3]> {
        let normal = |index: usize| {
            let [x, y, z] = self.log_scales[index];
            let shortest = if x <= y && x <= z {
                DVec3::X
            } else if y <= z {
                DVec3::Y
            } else {
                DVec3::Z
            };
            let [w, x, y, z] = self.quats[index].map(f64::from);
            let axis = (DQuat::from_xyzw(x, y, z, w) * shortest).normalize_or_zero();
            let towards = eye - DVec3::from(self.means[index].map(f64::from));
            if axis.dot(towards) < 0.0 { -axis } else { axis }
        };
        (0..self.len()).into_par_iter().map(|index| normal(index).as_vec3().to_array()).collect()
    }

    /// Whether Gaussian `index` is haze or distant background: wider than a fifth of the scene scale
    /// (`viewing_distance`, scene units). If that is unknown, none is.
    pub fn is_wide(&self, index: usize, viewing_distance: Option<f32>) -> bool {
        is_shared(self.log_scales[index], viewing_distance)
    }

    /// The Gaussians that can be surfaces, at degree 0. Haze is left out because it would move surfaces
    /// towards the camera, and distant background because it would end rays that meet no surface. Meant for
    /// alpha and range, which water does not change.
    #[must_use]
    pub fn surfaces(&self, viewing_distance: Option<f32>) -> Self {
        let (mut surfaces, k) = (Self::empty(0), self.coeffs());
        for index in (0..self.len()).filter(|&index| !self.is_wide(index, viewing_distance)) {
            surfaces.means.push(self.means[index]);
            surfaces.quats.push(self.quats[index]);
            surfaces.log_scales.push(self.log_scales[index]);
            surfaces.opacity_logits.push(self.opacity_logits[index]);
            surfaces.sh_coeffs.push(self.sh_coeffs[index * k]);
        }
        surfaces
    }

    /// Makes room for exactly `count` further Gaussians.
    pub fn reserve(&mut self, count: usize) {
        self.means.reserve_exact(count);
        self.quats.reserve_exact(count);
        self.log_scales.reserve_exact(count);
        self.opacity_logits.reserve_exact(count);
        self.sh_coeffs.reserve_exact(count * self.coeffs());
    }

    /// Appends Gaussian `index` of `other`; both must have the same degree.
    pub fn push_from(&mut self, other: &Self, index: usize) {
        debug_assert_eq!(self.sh_degree, other.sh_degree);
        let k = other.coeffs();
        self.means.push(other.means[index]);
        self.quats.push(other.quats[index]);
        self.log_scales.push(other.log_scales[index]);
        self.opacity_logits.push(other.opacity_logits[index]);
        self.sh_coeffs.extend_from_slice(&other.sh_coeffs[index * k..(index + 1) * k]);
    }

    /// The Gaussians of these indices, in their order.
    pub fn in_order(&self, order: &[u32]) -> Self {
        let mut ordered = Self::empty(self.sh_degree);
        order.iter().for_each(|&index| ordered.push_from(self, index as usize));
        ordered
    }

    /// The Gaussians whose centre satisfies `keep`, in order, and the others, in order.
    pub fn split_by(&self, mut keep: impl FnMut([f32; 3]) -> bool) -> (Self, Self) {
        self.split_where(|index| keep(self.means[index]))
    }

    /// The Gaussians whose index satisfies `keep`, in order, and the others, in order.
    pub fn split_where(&self, mut keep: impl FnMut(usize) -> bool) -> (Self, Self) {
        let (mut inside, mut outside) = (Self::empty(self.sh_degree), Self::empty(self.sh_degree));
        for index in 0..self.len() {
            let side = if keep(index) { &mut inside } else { &mut outside };
            side.push_from(self, index);
        }
        (inside, outside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_wider_than_a_fifth_of_the_scene_scale_are_shared() {
        let log_scale = |x: f32, y: f32, z: f32| [x.ln(), y.ln(), z.ln()];
        assert!(!is_shared(log_scale(0.9, 0.9, 0.9), Some(5.0)));
        assert!(is_shared(log_scale(0.1, 1.1, 0.1), Some(5.0)));
        assert!(!is_shared(log_scale(0.1, 1.1, 0.1), Some(50.0)));
        assert!(!is_shared(log_scale(1e3, 1e3, 1e3), None));
    }

    #[test]
    fn a_normal_is_the_shortest_axis_on_the_side_of_the_eye() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let mut model = Gaussians::empty(0);
        // The first is flat along z and not rotated. The second is flat along x, rotated by 90 degrees about
        // z, and its quaternion is not of unit length.
        for (quat, log_scale) in
            [([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -3.0]), ([3.0 * half, 0.0, 0.0, 3.0 * half], [-3.0, 0.0, 0.0])]
        {
            model.means.push([1.0, 1.0, 1.0]);
            model.quats.push(quat);
            model.log_scales.push(log_scale);
            model.opacity_logits.push(0.0);
            model.sh_coeffs.push([0.0; 3]);
        }
        for (eye, expected) in [
            (DVec3::ZERO, [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
            (DVec3::splat(9.0), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        ] {
            let normals = model.normals_towards(eye);
            for (normal, expected) in normals.iter().zip(expected) {
                let apart = (0..3).map(|i| (normal[i] - expected[i]).abs()).fold(0.0, f32::max);
                // Components are rounded to f32.
                assert!(apart < 1e-6, "from {eye}: {normal:?}, expected {expected:?}");
            }
        }
        model.quats[0] = [0.0; 4];
        assert_eq!(model.normals_towards(DVec3::ZERO)[0], [0.0; 3]);
    }

    #[test]
    fn gaussians_wider_than_a_fifth_of_the_scale_are_no_surface() {
        let mut model = Gaussians::empty(1);
        for (index, deviation) in [0.9_f32, 1.1, 1e3].into_iter().enumerate() {
            model.means.push([index as f32, 0.0, 0.0]);
            model.quats.push([1.0, 0.0, 0.0, 0.0]);
            model.log_scales.push([0.1_f32.ln(), deviation.ln(), 0.1_f32.ln()]);
            model.opacity_logits.push(index as f32);
            model.sh_coeffs.extend([[index as f32; 3], [9.0; 3], [9.0; 3], [9.0; 3]]);
        }
        let left = |distance: Option<f32>| model.surfaces(distance).opacity_logits;
        assert_eq!(left(Some(5.0)), [0.0]);
        assert_eq!(left(Some(50.0)), [0.0, 1.0]);
        assert_eq!(left(None), [0.0, 1.0, 2.0]);
        let surfaces = model.surfaces(Some(50.0));
        assert_eq!((surfaces.sh_degree, surfaces.sh_coeffs), (0, vec![[0.0; 3], [1.0; 3]]));
    }
}
