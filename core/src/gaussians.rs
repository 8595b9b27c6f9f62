//! A model on the host: Gaussians as structure of arrays, in the parametrisation that is trained.

use serde::{Deserialize, Serialize};

/// Coefficients per channel at the highest degree that Fathom trains (SH 3).
pub const MAX_SH_COEFFS: usize = 16;
/// Y_0^0, the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc.
pub const SH_C0: f32 = 0.282_094_8;

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

impl Gaussians {
    /// No Gaussians, of the given degree.
    pub fn empty(sh_degree: u8) -> Self {
        Self { sh_degree, ..Self::default() }
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

    /// Appends Gaussian `index` of `other`; both must have one degree.
    pub fn push_from(&mut self, other: &Self, index: usize) {
        debug_assert_eq!(self.sh_degree, other.sh_degree);
        let k = other.coeffs();
        self.means.push(other.means[index]);
        self.quats.push(other.quats[index]);
        self.log_scales.push(other.log_scales[index]);
        self.opacity_logits.push(other.opacity_logits[index]);
        self.sh_coeffs.extend_from_slice(&other.sh_coeffs[index * k..(index + 1) * k]);
    }

    /// The Gaussians whose centre satisfies `keep`, in order, and the others, in order.
    pub fn split_by(&self, mut keep: impl FnMut([f32; 3]) -> bool) -> (Self, Self) {
        self.split_where(|index| keep(self.means[index]))
    }

    /// Those whose index `keep` holds, and the others; both in their order.
    pub fn split_where(&self, mut keep: impl FnMut(usize) -> bool) -> (Self, Self) {
        let (mut inside, mut outside) = (Self::empty(self.sh_degree), Self::empty(self.sh_degree));
        for index in 0..self.len() {
            let side = if keep(index) { &mut inside } else { &mut outside };
            side.push_from(self, index);
        }
        (inside, outside)
    }
}
