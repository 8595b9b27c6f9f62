//! A model or its gradient, in f64.

use fathom_core::gaussians::Gaussians;

/// [`Gaussians`] in f64. As a gradient, each entry is the derivative of the loss.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians64 {
    /// Degree of the spherical harmonics that are stored, 0 to 3.
    pub sh_degree: u8,
    /// Centres, scene units, world axes.
    pub means: Vec<[f64; 3]>,
    /// Rotation, order w x y z; normalised on use.
    pub quats: Vec<[f64; 4]>,
    /// Natural logarithm of the standard deviations along the rotated axes.
    pub log_scales: Vec<[f64; 3]>,
    /// Opacity before the sigmoid.
    pub opacity_logits: Vec<f64>,
    /// [N, K, 3] flattened over N and K: entry `n * K + k` is the RGB of coefficient k.
    pub sh_coeffs: Vec<[f64; 3]>,
}

impl Gaussians64 {
    /// `count` Gaussians with all numbers 0: the start of a sum of gradients.
    pub fn zeros(count: usize, sh_degree: u8) -> Self {
        let coeffs = (usize::from(sh_degree) + 1).pow(2);
        Self {
            sh_degree,
            means: vec![[0.0; 3]; count],
            quats: vec![[0.0; 4]; count],
            log_scales: vec![[0.0; 3]; count],
            opacity_logits: vec![0.0; count],
            sh_coeffs: vec![[0.0; 3]; count * coeffs],
        }
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
        (usize::from(self.sh_degree) + 1).pow(2)
    }

    /// Number of parameters of one Gaussian: 11 + 3 K.
    pub fn parameters(&self) -> usize {
        11 + 3 * self.coeffs()
    }

    /// Parameter `parameter` of Gaussian `index`, in the order mean, quat, log scale, opacity logit, SH
    /// (coefficient by coefficient, RGB inside).
    pub fn parameter(&self, index: usize, parameter: usize) -> f64 {
        let k = self.coeffs();
        match parameter {
            0..3 => self.means[index][parameter],
            3..7 => self.quats[index][parameter - 3],
            7..10 => self.log_scales[index][parameter - 7],
            10 => self.opacity_logits[index],
            p => self.sh_coeffs[index * k + (p - 11) / 3][(p - 11) % 3],
        }
    }

    /// The same, mutable.
    pub fn parameter_mut(&mut self, index: usize, parameter: usize) -> &mut f64 {
        let k = self.coeffs();
        match parameter {
            0..3 => &mut self.means[index][parameter],
            3..7 => &mut self.quats[index][parameter - 3],
            7..10 => &mut self.log_scales[index][parameter - 7],
            10 => &mut self.opacity_logits[index],
            p => &mut self.sh_coeffs[index * k + (p - 11) / 3][(p - 11) % 3],
        }
    }

    /// Name of a parameter of [`Self::parameter`], for messages.
    pub fn parameter_name(parameter: usize) -> String {
        match parameter {
            0..3 => format!("mean[{parameter}]"),
            3..7 => format!("quat[{}]", parameter - 3),
            7..10 => format!("log_scale[{}]", parameter - 7),
            10 => "opacity_logit".to_owned(),
            p => format!("sh[{}][{}]", (p - 11) / 3, (p - 11) % 3),
        }
    }
}

impl From<&Gaussians> for Gaussians64 {
    fn from(model: &Gaussians) -> Self {
        Self {
            sh_degree: model.sh_degree,
            means: model.means.iter().map(|v| v.map(f64::from)).collect(),
            quats: model.quats.iter().map(|v| v.map(f64::from)).collect(),
            log_scales: model.log_scales.iter().map(|v| v.map(f64::from)).collect(),
            opacity_logits: model.opacity_logits.iter().map(|&v| f64::from(v)).collect(),
            sh_coeffs: model.sh_coeffs.iter().map(|v| v.map(f64::from)).collect(),
        }
    }
}
