//! Spherical harmonics against gsplat: values, and gradients with respect to coefficients and direction.

use fathom_twins::{sh_colour, sh_colour_backward};
use glam::DVec3;
use serde::Deserialize;

use crate::expectations::{assert_rows_close, read};

#[derive(Deserialize)]
struct File {
    cases: Vec<Case>,
}

/// One Gaussian seen along `direction`, which is not normalised; (degree + 1)^2 coefficients.
#[derive(Deserialize)]
struct Case {
    direction: [f64; 3],
    coeffs: Vec<[f64; 3]>,
    rgb: [f64; 3],
    v_rgb: [f64; 3],
    v_coeffs: Vec<[f64; 3]>,
    v_direction: [f64; 3],
}

impl Case {
    fn unit(&self) -> DVec3 {
        DVec3::from(self.direction).normalize()
    }
}

/// All cases, grouped by degree.
fn by_degree() -> Vec<(usize, Vec<Case>)> {
    let mut degrees: Vec<(usize, Vec<Case>)> = (0..=3).map(|degree| (degree, Vec::new())).collect();
    for case in read::<File>("spherical_harmonics").cases {
        let degree = case.coeffs.len().isqrt() - 1;
        degrees[degree].1.push(case);
    }
    assert!(degrees.iter().all(|(_, cases)| cases.len() >= 10), "every degree needs at least 10 directions");
    degrees
}

#[test]
fn colours_by_direction_match_gsplat_at_every_degree() {
    for (degree, cases) in by_degree() {
        let ours: Vec<_> = cases.iter().map(|case| sh_colour(case.unit(), &case.coeffs)).collect();
        let theirs: Vec<_> = cases.iter().map(|case| case.rgb).collect();
        assert_rows_close(&format!("colour at degree {degree}"), &ours, &theirs);
        assert!(theirs.iter().flatten().any(|&v| v == 0.0), "degree {degree}: no channel is clamped");
    }
}

#[test]
fn gradients_of_sh_coefficients_match_gsplat_at_every_degree() {
    for (degree, cases) in by_degree() {
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        for case in &cases {
            let mut v_coeffs = vec![[0.0; 3]; case.coeffs.len()];
            sh_colour_backward(case.unit(), &case.coeffs, case.v_rgb, &mut v_coeffs);
            ours.extend(v_coeffs);
            theirs.extend_from_slice(&case.v_coeffs);
        }
        assert_rows_close(&format!("gradient of coefficients at degree {degree}"), &ours, &theirs);
    }
}

#[test]
fn gradients_of_viewing_direction_match_gsplat_at_every_degree() {
    for (degree, cases) in by_degree() {
        let v_direction = |case: &Case| {
            let mut ignored = vec![[0.0; 3]; case.coeffs.len()];
            let free = sh_colour_backward(case.unit(), &case.coeffs, case.v_rgb, &mut ignored);
            // Through direction / |direction|, as in project_backward.
            let tangent = free - case.unit() * case.unit().dot(free);
            (tangent / DVec3::from(case.direction).length()).to_array()
        };
        let ours: Vec<_> = cases.iter().map(v_direction).collect();
        let theirs: Vec<_> = cases.iter().map(|case| case.v_direction).collect();
        if degree == 0 {
            assert_eq!(ours, theirs, "the constant harmonic must not depend on the direction");
        } else {
            assert_rows_close(&format!("gradient of direction at degree {degree}"), &ours, &theirs);
        }
    }
}
