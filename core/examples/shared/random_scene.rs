//! The random scene of the benchmarks, defined by a formula and a seed so that it is the same everywhere.
//!
//! With u_k = `uniform_at(1, Test, i, k)` in [0, 1), Gaussian i of n has:
//! - depth `z = 2 + 4 u_2` and mean `(1.1 (u_0 - 1/2) z, 0.65 (u_1 - 1/2) z, z)`;
//! - quaternion `u_3..u_6 - 1/2`;
//! - log scales `s + 1.5 u_7..u_9` with `s = -4.2 - max(0, ln(n / 30,000) / 2)`, so that more than 30,000
//!   Gaussians cover the same area together;
//! - opacity logit `-3 + 5 u_10`;
//! - coefficient k of channel c: `u_(20 + 20 c + k) - 1/2`.
//!
//! The camera is at the origin and looks along z. Its focal length is 0.9 of the width, so that a picture of
//! 16:9 shows all Gaussians.

use fathom_core::gaussians::Gaussians;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};

/// The first `n` Gaussians, SH 3.
pub fn model(n: u32) -> Gaussians {
    let mut model = Gaussians::empty(3);
    let least = -4.2 - 0.5 * (n as f32 / 30_000.0).ln().max(0.0);
    model.sh_coeffs.reserve_exact(16 * n as usize);
    for i in 0..n {
        let u = |k: u32| uniform_at(1, Stream::Test, i, k);
        let z = 2.0 + 4.0 * u(2);
        model.means.push([(u(0) - 0.5) * z * 1.1, (u(1) - 0.5) * z * 0.65, z]);
        model.quats.push([u(3) - 0.5, u(4) - 0.5, u(5) - 0.5, u(6) - 0.5]);
        model.log_scales.push([least + 1.5 * u(7), least + 1.5 * u(8), least + 1.5 * u(9)]);
        model.opacity_logits.push(-3.0 + 5.0 * u(10));
        model.sh_coeffs.extend((0..16).map(|k| [u(20 + k) - 0.5, u(40 + k) - 0.5, u(60 + k) - 0.5]));
    }
    model
}

/// The camera that sees all Gaussians.
pub fn camera(width: u32, height: u32) -> (PinholeCamera, Pose) {
    let focal = 0.9 * f64::from(width);
    let camera = PinholeCamera {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
    };
    (camera, Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]))
}
