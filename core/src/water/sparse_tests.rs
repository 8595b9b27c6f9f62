//! Known waters are recovered, with honest error estimates.

use super::*;
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::rng::{Stream, random_bits, uniform};
use glam::DVec3;

const COAST: Water =
    Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
const GREEN: Water =
    Water { beta_d: [0.45, 0.16, 0.20], beta_b: [0.38, 0.20, 0.24], b_inf: [0.05, 0.14, 0.12] };
const BLUE: Water =
    Water { beta_d: [0.20, 0.05, 0.03], beta_b: [0.16, 0.07, 0.05], b_inf: [0.01, 0.06, 0.16] };

struct Made {
    observations: Vec<Observation>,
    clear: Vec<[f64; 3]>,
}

/// `points` points, each seen eight times from 2 to 14 units (or all from 5), by a sensor with noise 0.004
/// sqrt(I). A share of the observations has random colours.
fn made(water: &Water, seed: u32, points: u32, outliers: f64, spread: bool) -> Made {
    let draw = |a: u32, b: u32| random_bits(seed, Stream::Test, a, b).map(|bits| f64::from(uniform(bits)));
    let (mut observations, mut clear) = (Vec::new(), Vec::new());
    for point in 0..points {
        let albedo = draw(point, 1000).map(|u| 0.02 + 0.6 * u * u);
        clear.push(albedo);
        let nearest = 2.0 + 3.0 * draw(point, 1001)[0];
        for view in 0..8 {
            let (place, first, second) =
                (draw(point, 3 * view), draw(point, 3 * view + 1), draw(point, 3 * view + 2));
            let range = if spread { nearest * (1.0 + 1.8 * place[0]) } else { 5.0 };
            let seen = water.apply(DVec3::from(albedo), range).to_array();
            let colour = if place[1] < outliers {
                first
            } else {
                std::array::from_fn(|c| {
                    let normal =
                        (-2.0 * (1.0 - first[c]).ln()).sqrt() * (std::f64::consts::TAU * second[c]).cos();
                    seen[c] + 0.004 * seen[c].sqrt() * normal
                })
            };
            let (direction, tint) = ([0.0, 0.0, 1.0], [1.0; 3]);
            observations.push(Observation { point, range, colour, finer: colour, direction, tint });
        }
    }
    Made { observations, clear }
}

#[test]
fn known_waters_are_recovered_with_noise_and_outliers() {
    for (name, water) in [("coast", COAST), ("green", GREEN), ("blue", BLUE), ("default", Water::COASTAL)] {
        for seed in [1, 2] {
            let made = made(&water, seed, 1500, 0.1, true);
            let prior = sparse_prior(&made.observations, made.clear.len()).unwrap();
            assert!((0.85..0.97).contains(&prior.inliers), "{name}: inliers {}", prior.inliers);
            let (found, truth) = (prior.water.to_array(), water.to_array());
            for k in 0..9 {
                let error = prior.standard_error[k];
                assert!(error.is_finite() && error > 0.0, "{name}, number {k}: error {error}");
                let off = (found[k] - truth[k]).abs();
                // Four standard errors, since 72 values are compared.
                assert!(
                    off < 4.0 * error,
                    "{name} {seed}, number {k}: {} for {}, error {error}",
                    found[k],
                    truth[k]
                );
                // Goals for 12,000 observations: attenuation 3 %, growth 8 %, colour 0.005. The bounds are
                // twice that.
                let bound = [0.06 * truth[k], 0.16 * truth[k], 0.01][k / 3];
                assert!(off < bound, "{name} {seed}, number {k}: {} for {}", found[k], truth[k]);
            }
        }
    }
}

#[test]
fn standard_errors_cover_the_truth_and_are_not_padded() {
    let (mut within, mut all, mut half) = (0, 0, 0);
    for seed in 0..40 {
        let made = made(&COAST, 100 + seed, 250, 0.0, true);
        let prior = sparse_prior(&made.observations, made.clear.len()).unwrap();
        for ((found, truth), error) in
            prior.water.to_array().iter().zip(COAST.to_array()).zip(prior.standard_error)
        {
            if error.is_finite() {
                all += 1;
                within += u32::from((found - truth).abs() < 2.0 * error);
                half += u32::from((found - truth).abs() < 0.3 * error);
            }
        }
    }
    assert!(all > 340, "only {all} of 360 numbers have an error");
    let (within, half) = (f64::from(within) / f64::from(all), f64::from(half) / f64::from(all));
    // 95 % and 24 % under a normal distribution. Measured changes are added, so errors may be up to twice too
    // large.
    assert!(within > 0.92, "{within} within two errors");
    assert!((0.1..0.5).contains(&half), "{half} within 0.3 errors");
}

/// The colour after a JPEG: luma and chroma as whole codes (BT.601), then red, green and blue as whole codes.
fn stored(colour: [f64; 3]) -> [f64; 3] {
    let [r, g, b] = colour.map(|value| 255.0 * linear_to_srgb(value.clamp(0.0, 1.0)));
    let luma = 0.299 * r + 0.587 * g + 0.114 * b;
    let (blue, red) = (((b - luma) / 1.772).round(), ((r - luma) / 1.402).round());
    let luma = luma.round();
    [luma + 1.402 * red, luma - 0.344_14 * blue - 0.714_14 * red, luma + 1.772 * blue]
        .map(|code| srgb_to_linear(code.round().clamp(0.0, 255.0) / 255.0))
}

#[test]
fn shared_rounding_of_open_water_is_covered_by_the_errors() {
    let mut apart = Vec::new();
    for step in 0..4 {
        // Nearly all light is gone before the farthest points. Each step places the open-water colour
        // elsewhere between two codes.
        let water = Water {
            beta_d: [0.9, 0.5, 0.6],
            beta_b: [0.8, 0.6, 0.7],
            b_inf: [0.06, 0.12 + 0.0009 * f64::from(step), 0.08],
        };
        let mut made = made(&water, 7, 1500, 0.02, true);
        for seen in &mut made.observations {
            seen.colour = stored(seen.colour);
            seen.finer = seen.colour;
        }
        let prior = sparse_prior(&made.observations, made.clear.len()).unwrap();
        let numbers = prior.water.to_array().into_iter().zip(water.to_array()).zip(prior.standard_error);
        for (number, ((found, truth), error)) in numbers.enumerate() {
            apart.push((found - truth).abs() / error);
            // An eighth of a code is 0.0003.
            assert!(number < 6 || (1e-4..2e-3).contains(&error), "number {number}: error {error}");
        }
    }
    // Without shades, a quarter of the values are more than two errors off, some by twelve.
    assert!(apart.iter().all(|apart| *apart < 2.5), "{apart:.2?}");
}

#[test]
fn smaller_windows_widen_the_errors_and_give_j() {
    let mut made = made(&COAST, 8, 800, 0.02, true);
    let plain = sparse_prior(&made.observations, made.clear.len()).unwrap();
    // Smaller windows show a stronger attenuation, as texture that blurs with range can.
    for seen in &mut made.observations {
        seen.finer = seen.colour.map(|value| value * (-0.012 * seen.range).exp());
    }
    let prior = sparse_prior(&made.observations, made.clear.len()).unwrap();
    assert_eq!(prior.water, plain.water, "the water is that of the larger windows");
    for c in 0..3 {
        let (before, now) = (plain.standard_error[c], prior.standard_error[c]);
        assert!(before < 0.005 && now > 0.008, "channel {c}: {now}, and {before} where windows agree");
    }
    let darker =
        prior.clear.iter().zip(&plain.clear).filter(|(now, before)| now.unwrap()[1] < before.unwrap()[1]);
    assert!(darker.count() > 790, "J is not that of the smaller windows");
}

#[test]
fn result_does_not_depend_on_scale_order_or_threads() {
    let made = made(&COAST, 5, 400, 0.05, true);
    let base = sparse_prior(&made.observations, 400).unwrap();
    let mut turned = made.observations.clone();
    turned.reverse();
    assert!(sparse_prior(&turned, 400).unwrap() == base, "order");
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(one.install(|| sparse_prior(&made.observations, 400).unwrap()) == base, "threads");
    for scale in [1e-3, 512.0] {
        let scaled: Vec<_> =
            made.observations.iter().map(|o| Observation { range: o.range * scale, ..*o }).collect();
        let prior = sparse_prior(&scaled, 400).unwrap();
        for k in 0..9 {
            let unit = if k < 6 { scale } else { 1.0 };
            let (a, b) = (prior.water.to_array()[k] * unit, base.water.to_array()[k]);
            assert!((a - b).abs() <= 1e-6 * b + 1e-9, "number {k} at {scale}: {a} and {b}");
            let (a, b) = (prior.standard_error[k] * unit, base.standard_error[k]);
            assert!(a == b || (a / b - 1.0).abs() < 1e-3, "error {k} at {scale}: {a} and {b}");
        }
    }
}

#[test]
fn colours_without_water_are_recovered() {
    let mut made = made(&Water::COASTAL, 6, 600, 0.02, true);
    // One point has no observation, and another has no red.
    made.observations.retain(|o| o.point != 7);
    made.observations.iter_mut().filter(|o| o.point == 9).for_each(|o| o.colour[0] = f64::NAN);
    let prior = sparse_prior(&made.observations, 600).unwrap();
    assert_eq!((prior.clear[7], prior.clear[9]), (None, None));
    let mut errors: Vec<f64> = prior
        .clear
        .iter()
        .zip(&made.clear)
        .filter_map(|(found, truth)| Some(DVec3::from((*found)?).distance(DVec3::from(*truth))))
        .collect();
    assert!(errors.len() > 590);
    let median = quantile(&mut errors, 0.5);
    // Noise of 0.002 at the camera, reduced by sqrt(8) and doubled by the water.
    assert!(median < 0.01, "{median}");
}

#[test]
fn clear_air_has_no_attenuation_and_unknown_backscatter() {
    for seed in [1, 2, 3] {
        let made = made(&Water::CLEAR, seed, 800, 0.05, true);
        let prior = sparse_prior(&made.observations, 800).unwrap();
        assert!(prior.water.is_physical());
        for c in 0..3 {
            assert!(prior.water.beta_d[c] < 0.003, "{:?}", prior.water);
            assert!(prior.standard_error[c] < 0.01, "{:?}", prior.standard_error);
            assert!(prior.standard_error[3 + c].is_infinite(), "{:?}", prior.standard_error);
            // The values chosen for unknown parameters make a negligible veil.
            let veil = prior.water.apply(DVec3::ZERO, 10.0)[c];
            assert!(veil < 0.01, "{veil} in {:?}", prior.water);
        }
    }
}

#[test]
fn points_lit_better_from_afar_get_no_veil() {
    for seed in [1, 2] {
        let mut made = made(&Water::CLEAR, seed, 1500, 0.05, true);
        // A nearer camera casts more of a shadow: bright points gain more light than dark ones.
        for observation in &mut made.observations {
            let light = 1.0 + 0.03 * (observation.range - 6.0);
            observation.colour = observation.colour.map(|value| value * light);
        }
        let prior = sparse_prior(&made.observations, made.clear.len()).unwrap();
        for c in 0..3 {
            assert!(prior.standard_error[6 + c].is_infinite(), "{:?}", prior.standard_error);
            let veil = prior.water.apply(DVec3::ZERO, 6.0)[c];
            assert!(veil < 0.001, "seed {seed}: {veil} in {:?}", prior.water);
        }
    }
}

#[test]
fn insufficient_observations_are_reported() {
    assert_eq!(sparse_prior(&[], 0), Err(SparsePriorError::TooFewPoints { points: 0 }));
    let few = made(&COAST, 1, 5, 0.0, true);
    assert_eq!(sparse_prior(&few.observations, 5), Err(SparsePriorError::TooFewPoints { points: 5 }));
    let flat = made(&COAST, 1, 100, 0.0, false);
    let error = sparse_prior(&flat.observations, 100).unwrap_err();
    assert_eq!(error, SparsePriorError::NoRangeSpread { points: 100, spread: 0 });
    assert!(error.to_string().contains("add photographs from nearer or farther"), "{error}");
    let error = sparse_prior(&few.observations, 4).unwrap_err();
    assert_eq!(error, SparsePriorError::UnknownPoint { point: 4, points: 4 });
}

#[test]
fn bad_observations_give_finite_or_unknown_parameters() {
    let mut made = made(&COAST, 3, 300, 0.0, true);
    for (index, observation) in made.observations.iter_mut().enumerate() {
        match index % 40 {
            0 => observation.range = [0.0, -1.0, f64::NAN, f64::INFINITY][index / 40 % 4],
            1 => observation.colour = [f64::NAN, 1e6, f64::INFINITY],
            2 => observation.colour = [0.0; 3],
            3 => observation.finer = [1e6, f64::NAN, f64::NEG_INFINITY],
            _ => {}
        }
        observation.colour[2] = f64::NAN;
    }
    let prior = sparse_prior(&made.observations, 300).unwrap();
    assert!(prior.water.is_physical(), "{:?}", prior.water);
    assert!(prior.standard_error.iter().all(|error| !error.is_nan()));
    assert!((prior.water.beta_d[1] / COAST.beta_d[1] - 1.0).abs() < 0.1, "{:?}", prior.water);
    assert!([2, 5, 8].iter().all(|k| prior.standard_error[*k].is_infinite()));
    assert!(prior.clear.iter().all(Option::is_none));
    // All black, all white, and all open water.
    for colour in [[0.0; 3], [1.0; 3], COAST.b_inf] {
        let same: Vec<_> = made.observations.iter().map(|o| Observation { colour, ..*o }).collect();
        let prior = sparse_prior(&same, 300).unwrap();
        assert!(prior.water.is_physical(), "{colour:?}: {:?}", prior.water);
        assert!(prior.standard_error.iter().all(|error| !error.is_nan()));
        assert!(prior.clear.iter().flatten().flatten().all(|j| j.is_finite()));
    }
}
