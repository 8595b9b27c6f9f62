//! Optics against books, the halving of intervals and finite differences.

use super::*;
use crate::rng::{Stream, uniform_at};

fn random(index: u32, k: u32) -> f64 {
    2.0 * f64::from(uniform_at(3, Stream::Test, index, k)) - 1.0
}

fn vector(index: u32, k: u32) -> DVec3 {
    DVec3::new(random(index, k), random(index, k + 1), random(index, k + 2))
}

/// A surface, an eye in air and a point in the water.
fn case(index: u32) -> (Surface, DVec3, DVec3) {
    let normal = vector(index, 0).normalize();
    let surface = Surface { normal, offset: 3.0 * random(index, 3), ior: 1.4 + 0.35 * random(index, 4) };
    let foot = |k: u32| {
        let across = 3.0 * vector(index, k);
        across - across.dot(normal) * normal + surface.offset * normal
    };
    let eye = foot(5) + (1.05 + random(index, 8)) * normal;
    (surface, eye, foot(9) - (1.05 + random(index, 12)) * normal)
}

#[test]
fn the_reflectance_is_that_of_the_books() {
    let at = |degrees: f64| fresnel(degrees.to_radians().cos(), AIR, WATER);
    // ((n2 - n1) / (n2 + n1))^2 for a ray along the normal, and the values for water of Hecht, 4.6.
    assert!((at(0.0) - ((WATER - AIR) / (WATER + AIR)).powi(2)).abs() < 1e-12);
    assert!((at(45.0) - 0.028).abs() < 1e-3, "{}", at(45.0));
    assert!((at(80.0) - 0.348).abs() < 2e-3, "{}", at(80.0));
    assert!(at(89.99) > 0.99);
    // Light that is polarised in the plane of incidence is not reflected at Brewster's angle, so half of the
    // other part remains: ((n2^2 - n1^2) / (n2^2 + n1^2))^2 / 2.
    let brewster = (WATER / AIR).atan().to_degrees();
    let (n1, n2) = (AIR * AIR, WATER * WATER);
    assert!((at(brewster) - 0.5 * ((n2 - n1) / (n2 + n1)).powi(2)).abs() < 1e-12);
    // Energy is kept in both directions: what is reflected from below at the refracted angle is the same.
    let below = (AIR / WATER * 0.6_f64.sin()).asin();
    assert!((fresnel(below.cos(), WATER, AIR) - fresnel(0.6_f64.cos(), AIR, WATER)).abs() < 1e-12);
    assert_eq!(fresnel(60_f64.to_radians().cos(), WATER, AIR), 1.0, "total reflection");
}

#[test]
fn schlick_is_as_far_from_fresnel_as_documented() {
    let apart = |degrees: f64| {
        let cos = degrees.to_radians().cos();
        (schlick(cos, AIR, WATER) - fresnel(cos, AIR, WATER)).abs()
    };
    assert!(apart(0.0) < 1e-12);
    assert!((0..=70).all(|degrees| apart(f64::from(degrees)) < 0.0095));
    assert!((apart(80.0) - 0.05).abs() < 1e-3, "{}", apart(80.0));
    assert!((0..=90).all(|degrees| apart(f64::from(degrees)) < 0.06));
}

#[test]
fn a_refracted_ray_follows_snell_and_a_reflected_one_the_mirror() {
    for index in 0..50 {
        let (surface, eye, point) = case(index);
        let foot = point - surface.height(point) * surface.normal;
        let direction = (foot - eye).normalize();
        let range = surface.meets(eye, direction).unwrap();
        assert!(surface.height(eye + range * direction).abs() < 1e-12);
        let split = surface.split(direction);
        let sine = |direction: DVec3| direction.cross(surface.normal);
        assert!((AIR * sine(direction) - surface.ior * sine(split.refracted)).length() < 1e-12);
        assert!((split.refracted.length() - 1.0).abs() < 1e-12 && split.refracted.dot(surface.normal) < 0.0);
        assert!((sine(direction) - sine(split.reflected)).length() < 1e-12);
        assert!((direction + split.reflected).dot(surface.normal).abs() < 1e-12);
        assert!(surface.meets(eye, -direction).is_none(), "it looks up");
        // Without a change of the index nothing bends and nothing is reflected.
        let air = Surface { ior: AIR, ..surface }.split(direction);
        assert!(air.reflectance < 1e-20 && (air.refracted - direction).length() < 1e-12);
    }
    let level = DVec3::new(0.8, 0.6, 0.0);
    assert!(refracted(level, DVec3::NEG_Y, WATER / AIR).is_none(), "total reflection");
}

#[test]
fn an_eye_sees_a_point_where_its_refracted_ray_passes() {
    for index in 0..200 {
        let (surface, eye, point) = case(index);
        let crossing = surface.crossing(eye, point).unwrap().at;
        assert!(surface.height(crossing).abs() < 1e-12);
        let slow = surface.crossing_by_halving(eye, point);
        assert!((crossing - slow).length() < 1e-10, "{index}: {crossing} instead of {slow}");
        let refracted = surface.split((crossing - eye).normalize()).refracted;
        let apart = (point - crossing).cross(refracted).length();
        assert!(apart < 1e-7, "{index}: the ray passes {apart} from the point");
        assert!(surface.crossing(point, eye).is_none(), "the sides are exchanged");
    }
}

#[test]
fn rays_along_the_normal_and_grazing_ones_cross_too() {
    let surface = Surface { normal: DVec3::Y, offset: 0.0, ior: WATER };
    let eye = DVec3::new(0.3, 2.0, 0.1);
    let below = surface.crossing(eye, DVec3::new(0.3, -1.0, 0.1)).unwrap();
    assert_eq!(below.at, DVec3::new(0.3, 0.0, 0.1));
    for (far, depth) in [(60.0, 0.5), (60.0, 1e-6), (1e-9, 1.0), (1000.0, 1000.0)] {
        let point = eye + DVec3::new(far, -2.0 - depth, 0.0);
        let crossing = surface.crossing(eye, point).unwrap().at;
        let slow = surface.crossing_by_halving(eye, point);
        assert!((crossing - slow).length() < 1e-11 * (1.0 + far), "{far}: {crossing} instead of {slow}");
    }
    assert!(surface.crossing(eye, DVec3::NAN).is_none());
}

#[test]
fn derivatives_of_a_crossing_match_finite_differences() {
    const STEP: f64 = 1e-5;
    for index in 0..100 {
        let (surface, eye, point) = case(index);
        let crossing = surface.crossing(eye, point).unwrap();
        let tilt = vector(index, 20);
        let still = Motion::default();
        let tilt = Motion { normal: tilt - tilt.dot(surface.normal) * surface.normal, ..still };
        for motion in [
            Motion { point: vector(index, 23), ..still },
            Motion { offset: 1.0, ..still },
            tilt,
            Motion { point: vector(index, 26), offset: -0.7, ..tilt },
        ] {
            let at = |step: f64| {
                let normal = (surface.normal + step * motion.normal).normalize();
                let surface = Surface { normal, offset: surface.offset + step * motion.offset, ..surface };
                surface.crossing(eye, point + step * motion.point).unwrap().at
            };
            let expected = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            let found = crossing.moved(eye, point, &surface, &motion);
            assert!(
                (found - expected).length() < 1e-6 * (1.0 + expected.length()),
                "{index}, {motion:?}: {found} instead of {expected}"
            );
        }
    }
    // Straight above the point all directions across are equal.
    let surface = Surface { normal: DVec3::Y, offset: 0.0, ior: WATER };
    let (eye, point) = (DVec3::Y, DVec3::NEG_Y);
    let motion = Motion { point: DVec3::new(0.6, 0.0, 0.8), ..Motion::default() };
    let moved = surface.crossing(eye, point).unwrap().moved(eye, point, &surface, &motion);
    let share = WATER / (AIR + WATER);
    assert!((moved - share * motion.point).length() < 1e-12, "{moved}");
}

#[test]
fn a_camera_sees_the_same_depth_along_its_refracted_ray() {
    for index in 0..40 {
        let (surface, eye, point) = case(index);
        let seen = surface.seen_instead(eye, point);
        assert!((surface.height(seen) - surface.height(point)).abs() < 1e-9);
        // Its ray through the surface begins in the direction of the point.
        let crossing = surface.crossing(eye, seen).unwrap();
        let apart = (crossing.at - eye).normalize().cross((point - eye).normalize()).length();
        assert!(apart < 1e-6, "case {index}: {apart}");
        assert_eq!(surface.seen_instead(eye, eye + 0.1 * surface.normal), eye + 0.1 * surface.normal);
        let in_air = surface.seen_instead(seen, point);
        assert_eq!(in_air, point, "an eye in the water sees it straight");
    }
}
