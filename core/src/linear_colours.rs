//! Converts sRGB spherical harmonics to linear light, for programs that blend in linear light.

use std::f64::consts::PI;

use glam::DVec3;
use rayon::prelude::*;

use crate::gaussians::{Gaussians, MAX_SH_COEFFS};
use crate::harmonics::sh_basis;
use crate::picture::srgb_to_linear;

/// Gauss-Legendre with eight points: the nodes above 0 and their weights. With sixteen meridians it is exact
/// for polynomials of degree 15.
const LATITUDES: [(f64, f64); 4] = [
    (0.183_434_642_495_649_8, 0.362_683_783_378_362),
    (0.525_532_409_916_329, 0.313_706_645_877_887_3),
    (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
    (0.960_289_856_497_536_3, 0.101_228_536_290_376_26),
];
const MERIDIANS: u32 = 16;

/// The model with its colours in linear light, at the same degree. Each Gaussian gets the harmonics that fit
/// its decoded colour best, by least squares over all directions. Exact for degree 0. Colours below 0, which
/// render as black, become 0.
#[must_use]
pub fn in_linear_light(model: Gaussians) -> Gaussians {
    refitted(model, |rgb| rgb.map(|s| srgb_to_linear(s.max(0.0))))
}

/// The model with harmonics of the same degree that fit `of` of its colours best, by least squares over all
/// directions.
pub(crate) fn refitted(model: Gaussians, of: impl Fn([f64; 3]) -> [f64; 3] + Sync) -> Gaussians {
    let samples = sphere();
    let coeffs = model.coeffs();
    let mut refitted = model.sh_coeffs.clone();
    refitted.par_chunks_mut(coeffs).for_each(|of_one| {
        let old: Vec<[f32; 3]> = of_one.to_vec();
        let mut sums = [[0.0_f64; 3]; MAX_SH_COEFFS];
        for (_, basis, weight) in &samples {
            let mut rgb = [0.5; 3];
            for (coefficient, y) in old.iter().zip(basis) {
                (0..3).for_each(|c| rgb[c] += y * f64::from(coefficient[c]));
            }
            // Colours are 0.5 above what the harmonics give.
            let light = of(rgb).map(|value| value - 0.5);
            for (sum, y) in sums.iter_mut().zip(basis).take(coeffs) {
                (0..3).for_each(|c| sum[c] += weight * y * light[c]);
            }
        }
        for (coefficient, sum) in of_one.iter_mut().zip(sums) {
            *coefficient = sum.map(|value| value as f32);
        }
    });
    Gaussians { sh_coeffs: refitted, ..model }
}

/// Directions over the whole sphere, with the basis at each and weights that sum to the sphere's area.
pub(crate) fn sphere() -> Vec<(DVec3, [f64; MAX_SH_COEFFS], f64)> {
    let mut samples = Vec::new();
    for (height, weight) in LATITUDES.into_iter().flat_map(|(node, weight)| [(node, weight), (-node, weight)])
    {
        let radius = (1.0 - height * height).sqrt();
        for k in 0..MERIDIANS {
            let (sin, cos) = (2.0 * PI * f64::from(k) / f64::from(MERIDIANS)).sin_cos();
            let direction = DVec3::new(radius * cos, radius * sin, height);
            samples.push((direction, sh_basis(direction), weight * 2.0 * PI / f64::from(MERIDIANS)));
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Stream, uniform_at};

    fn model(sh_degree: u8, spread: f32) -> Gaussians {
        let coeffs = (usize::from(sh_degree) + 1).pow(2);
        let u = |i: usize, k: usize| uniform_at(97, Stream::Test, i as u32, k as u32);
        let colour = |i: usize| {
            let size = if i.is_multiple_of(coeffs) { 1.0 } else { spread };
            [0, 1, 2].map(|k| size * (2.0 * u(i, k) - 1.0))
        };
        Gaussians {
            sh_degree,
            means: vec![[0.0; 3]; 5],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 5],
            log_scales: vec![[0.0; 3]; 5],
            opacity_logits: vec![0.0; 5],
            sh_coeffs: (0..5 * coeffs).map(colour).collect(),
        }
    }

    fn shown(model: &Gaussians, i: usize, direction: DVec3) -> [f64; 3] {
        let basis = sh_basis(direction);
        let own = &model.sh_coeffs[i * model.coeffs()..][..model.coeffs()];
        [0, 1, 2].map(|c| 0.5 + own.iter().zip(basis).map(|(k, y)| f64::from(k[c]) * y).sum::<f64>())
    }

    #[test]
    fn the_basis_is_orthonormal_under_the_weights() {
        let samples = sphere();
        for i in 0..MAX_SH_COEFFS {
            for j in 0..MAX_SH_COEFFS {
                let product: f64 =
                    samples.iter().map(|(_, basis, weight)| weight * basis[i] * basis[j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-12, "{i}, {j}: {product}");
            }
        }
    }

    #[test]
    fn sh0_is_decoded_exactly_and_black_stays_black() {
        let mut srgb = model(0, 0.0);
        srgb.sh_coeffs[4] = [-3.0, 0.0, 0.2];
        let linear = in_linear_light(srgb.clone());
        for i in 0..5 {
            let (before, after) = (shown(&srgb, i, DVec3::X), shown(&linear, i, DVec3::X));
            for c in 0..3 {
                assert!(
                    (after[c] - srgb_to_linear(before[c].max(0.0))).abs() < 1e-6,
                    "{before:?}, {after:?}"
                );
            }
        }
    }

    #[test]
    fn view_dependent_colours_get_the_best_fit_in_linear_light() {
        let srgb = model(3, 0.05);
        let linear = in_linear_light(srgb.clone());
        assert_eq!((linear.sh_degree, &linear.means), (3, &srgb.means));
        let error = |model: &Gaussians| -> f64 {
            let mut sum = 0.0;
            for k in 0..200 {
                // Even over the sphere (Fibonacci).
                let z = 1.0 - (2.0 * f64::from(k) + 1.0) / 200.0;
                let (sin, cos) = (2.399_963_229_728_653 * f64::from(k)).sin_cos();
                let radius = (1.0 - z * z).sqrt();
                let direction = DVec3::new(radius * cos, radius * sin, z);
                for i in 0..5 {
                    let truth = shown(&srgb, i, direction).map(|s| srgb_to_linear(s.max(0.0)));
                    let found = shown(model, i, direction);
                    sum += (0..3).map(|c| (truth[c] - found[c]).powi(2)).sum::<f64>() / 3000.0;
                }
            }
            sum
        };
        let best = error(&linear);
        assert!(best.sqrt() < 0.01, "{}", best.sqrt());
        for k in 0..16 {
            for by in [-0.01, 0.01] {
                let mut other = linear.clone();
                other.sh_coeffs[16 + k][1] += by;
                assert!(error(&other) > best, "coefficient {k} by {by}");
            }
        }
    }
}
