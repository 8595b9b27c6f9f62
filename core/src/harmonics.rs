//! Real spherical harmonics up to degree 3, with the signs of 3DGS: the basis of the Gaussians' colours.
//!
//! The basis is Y_l^m with the Condon-Shortley phase, written as polynomials of a unit direction
//! (Sloan 2013), coefficients in the order l^2 + l + m.

use glam::DVec3;

use crate::gaussians::MAX_SH_COEFFS;

/// Factor of the constant band.
pub const C0: f64 = 0.282_094_791_773_878_14;
/// Factor of the three functions of degree 1.
pub const C1: f64 = 0.488_602_511_902_919_9;
/// Factors of degree 2.
pub const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Factors of degree 3.
pub const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Y_k(direction) for all 16 k; `direction` is a unit vector.
pub fn sh_basis(direction: DVec3) -> [f64; MAX_SH_COEFFS] {
    let DVec3 { x, y, z } = direction;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (2.0 * zz - xx - yy),
        C2[3] * x * z,
        C2[4] * (xx - yy),
        C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * x * (4.0 * zz - xx - yy),
        C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3.0 * yy),
    ]
}
