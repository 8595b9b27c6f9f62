//! Colour by viewing direction: real spherical harmonics up to degree 3, with the signs of 3DGS.
//!
//! The basis is Y_l^m with the Condon-Shortley phase, written as polynomials of a unit direction
//! (Sloan 2013), coefficients in the order l^2 + l + m. Colour = 0.5 + sum of Y_k c_k, at least 0.

use glam::DVec3;

use fathom_core::gaussians::MAX_SH_COEFFS;
use fathom_core::harmonics::{C1, C2, C3, sh_basis};

/// Derivatives of the polynomials of [`sh_basis`] with respect to independent x, y and z; the caller projects
/// onto the sphere.
pub fn sh_basis_gradient(direction: DVec3) -> [DVec3; MAX_SH_COEFFS] {
    let DVec3 { x, y, z } = direction;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        DVec3::ZERO,
        DVec3::new(0.0, -C1, 0.0),
        DVec3::new(0.0, 0.0, C1),
        DVec3::new(-C1, 0.0, 0.0),
        C2[0] * DVec3::new(y, x, 0.0),
        C2[1] * DVec3::new(0.0, z, y),
        C2[2] * DVec3::new(-2.0 * x, -2.0 * y, 4.0 * z),
        C2[3] * DVec3::new(z, 0.0, x),
        C2[4] * DVec3::new(2.0 * x, -2.0 * y, 0.0),
        C3[0] * DVec3::new(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0),
        C3[1] * DVec3::new(y * z, x * z, x * y),
        C3[2] * DVec3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        C3[3] * DVec3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * DVec3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        C3[5] * DVec3::new(2.0 * x * z, -2.0 * y * z, xx - yy),
        C3[6] * DVec3::new(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0),
    ]
}

/// RGB of one Gaussian seen along `direction` (unit, from the camera to the Gaussian).
///
/// `coeffs` are the K coefficients in use: the first (degree of the schedule + 1)^2 stored ones. NaN stays
/// NaN (`max` would make it black), so that the gate of `project_forward` detects it.
pub fn sh_colour(direction: DVec3, coeffs: &[[f64; 3]]) -> [f64; 3] {
    unclamped_colour(direction, coeffs).map(|c| if c < 0.0 { 0.0 } else { c })
}

/// Backward pass of [`sh_colour`]: adds to `v_coeffs` and returns the gradient of `direction` as a free
/// vector.
///
/// A channel that was clamped to 0 has no gradient.
pub fn sh_colour_backward(
    direction: DVec3,
    coeffs: &[[f64; 3]],
    v_rgb: [f64; 3],
    v_coeffs: &mut [[f64; 3]],
) -> DVec3 {
    let unclamped = unclamped_colour(direction, coeffs);
    let v_rgb: [f64; 3] = std::array::from_fn(|c| if unclamped[c] > 0.0 { v_rgb[c] } else { 0.0 });
    let basis = sh_basis(direction);
    let gradient = sh_basis_gradient(direction);
    let mut v_direction = DVec3::ZERO;
    for (k, coeff) in coeffs.iter().enumerate() {
        let mut v_basis = 0.0;
        for c in 0..3 {
            v_coeffs[k][c] += basis[k] * v_rgb[c];
            v_basis += coeff[c] * v_rgb[c];
        }
        v_direction += gradient[k] * v_basis;
    }
    v_direction
}

fn unclamped_colour(direction: DVec3, coeffs: &[[f64; 3]]) -> [f64; 3] {
    let basis = sh_basis(direction);
    let mut rgb = [0.5; 3];
    for (k, coeff) in coeffs.iter().enumerate() {
        for c in 0..3 {
            rgb[c] += basis[k] * coeff[c];
        }
    }
    rgb
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, SQRT_2};

    use fathom_core::harmonics::C0;

    use super::*;
    use crate::finite_differences::derivative;
    use fathom_core::rng::{Stream, uniform_at};

    fn direction(i: u32) -> DVec3 {
        let u = |j| 2.0 * f64::from(uniform_at(3, Stream::Test, i, j)) - 1.0;
        DVec3::new(u(0), u(1), u(2)).normalize()
    }

    /// Associated Legendre function P_l^m(z) without the Condon-Shortley phase, by its recurrence.
    fn legendre(l: i32, m: i32, z: f64) -> f64 {
        let s = (1.0 - z * z).sqrt();
        let mut previous = (1..=m).map(|k| f64::from(2 * k - 1) * s).product::<f64>();
        if l == m {
            return previous;
        }
        let mut current = z * f64::from(2 * m + 1) * previous;
        for n in m + 2..=l {
            let next =
                (z * f64::from(2 * n - 1) * current - f64::from(n + m - 1) * previous) / f64::from(n - m);
            (previous, current) = (current, next);
        }
        current
    }

    #[test]
    fn the_basis_is_real_harmonics_with_the_condon_shortley_phase() {
        for i in 0..50 {
            let d = direction(i);
            let (basis, phi) = (sh_basis(d), d.y.atan2(d.x));
            for l in 0..=3_i32 {
                for m in -l..=l {
                    let a = m.abs();
                    let ratio: f64 = (l - a + 1..=l + a).map(f64::from).product();
                    let norm = (f64::from(2 * l + 1) / (4.0 * PI) / ratio).sqrt();
                    let phase = if a % 2 == 0 { 1.0 } else { -1.0 };
                    let angle = match m {
                        0 => 1.0,
                        1.. => SQRT_2 * (f64::from(m) * phi).cos(),
                        _ => SQRT_2 * (f64::from(a) * phi).sin(),
                    };
                    let expected = phase * norm * angle * legendre(l, a, d.z);
                    let k = (l * l + l + m) as usize;
                    // 1e-13: some tens of rounding errors of numbers near 1.
                    assert!((basis[k] - expected).abs() < 1e-13, "Y_{l}^{m}: {} != {expected}", basis[k]);
                }
            }
        }
    }

    #[test]
    fn the_mean_square_of_a_band_is_the_same_in_all_directions() {
        for i in 0..50 {
            let basis = sh_basis(direction(i));
            for l in 0..=3_usize {
                let band = &basis[l * l..(l + 1) * (l + 1)];
                let mean = band.iter().map(|value| value * value).sum::<f64>() / band.len() as f64;
                assert!((mean - C0 * C0).abs() < 1e-14, "band {l}: {mean}");
            }
        }
    }

    #[test]
    fn the_gradient_of_the_basis_is_its_central_difference() {
        for i in 0..20 {
            let d = direction(i);
            let gradient = sh_basis_gradient(d);
            for axis in 0..3 {
                for k in 0..MAX_SH_COEFFS {
                    let numeric = derivative(|h| {
                        let mut moved = d;
                        moved[axis] += h;
                        sh_basis(moved)[k]
                    });
                    // For polynomials of degree 3, the extrapolated difference is exact up to rounding, 1e-16
                    // / 1e-4.
                    assert!((gradient[k][axis] - numeric).abs() < 1e-10, "Y_{k} by axis {axis}");
                }
            }
        }
    }

    #[test]
    fn a_channel_below_zero_is_black_and_gives_no_gradient() {
        let coeffs = [[-3.0, 0.2, 0.1]];
        let rgb = sh_colour(DVec3::Z, &coeffs);
        assert_eq!(rgb[0], 0.0);
        assert!(rgb[1] > 0.5);
        let mut v_coeffs = [[0.0; 3]];
        sh_colour_backward(DVec3::Z, &coeffs, [1.0; 3], &mut v_coeffs);
        assert_eq!(v_coeffs, [[0.0, C0, C0]]);
    }
}
