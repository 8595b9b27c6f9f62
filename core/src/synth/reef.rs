//! Builds the world of the forward look: the wreck on a bounded reef, with open water behind it.
//!
//! The reef is a plateau with a crest along its rim, beyond which the floor falls away. The floor ends where
//! the water has absorbed all of its light. Coral heads on the crest, some above the horizon, are the distant
//! background of views across the plateau. Some are dark and look similar to open water. Plates and patches
//! of sand with constant colour have no features to match. Metres and axes as in [`super::wreck`]; the seed
//! moves coral heads, scattered objects and textures.

use glam::{DMat3, DVec3};

use super::geometry::{Material, Patch, SeaFloor, Shape, World};
use super::noise::{fractal_flat, ramp, value_flat};
use super::wreck::{HULL, Yard};
use crate::rng::{Stream, uniform_at};

/// Half the length and half the width of the plateau.
const PLATEAU: Patch = Patch { centre: [0.0, 0.0], radii: [25.0, 19.0] };
/// Width of the slope beyond the rim, metres; the floor falls 0.6 m per metre.
const FALL: f64 = 12.0;
/// Areas of smooth sand.
const SMOOTH: [Patch; 2] =
    [Patch { centre: [-11.5, 1.5], radii: [2.9, 2.3] }, Patch { centre: [11.0, -3.5], radii: [2.4, 2.0] }];
/// Number of coral heads on the crest, and of stones everywhere.
const HEADS: u32 = 38;
const STONES: u32 = 220;
/// Index of the first random number of this file; those of [`Yard::scatter`] are below.
const FIRST: u32 = 1000;

pub(super) fn build(seed: u32) -> World {
    // The rim is ragged by up to a tenth.
    let half = PLATEAU.radii.map(|radius| 1.1 * radius + FALL);
    let floor = SeaFloor::new(half[0], half[1], |x, z| floor_y(x, z, seed)).ending(SMOOTH.to_vec());
    let mut yard = Yard { seed, parts: Vec::new() };
    yard.ship();
    yard.scatter(&floor);
    stand(&mut yard);
    grow(&mut yard, &floor);
    World::new(yard.parts, floor)
}

/// Distance from the middle in radii of the plateau: 1 on its ragged rim.
fn reach(x: f64, z: f64, seed: u32) -> f64 {
    PLATEAU.reach(x, z) - 0.2 * (value_flat(x * 0.08, z * 0.08, seed ^ 0x41) - 0.5)
}

fn floor_y(x: f64, z: f64, seed: u32) -> f64 {
    let wide = 0.9 * (fractal_flat(x * 0.2, z * 0.2, 3, seed ^ 0x42) - 0.5);
    let bumps = 0.14 * (fractal_flat(x * 1.2, z * 1.2, 3, seed ^ 0x43) - 0.5);
    let from_hull = ((x / (HULL.x + 1.2)).powi(2) + (z / (HULL.z + 1.4)).powi(2)).sqrt();
    let pile = 0.38 * (1.0 - ramp(0.55, 1.25, from_hull));
    let reach = reach(x, z, seed);
    let crest = 1.1 * ramp(0.62, 0.95, reach);
    let fall = 0.6 * (reach - 1.0).max(0.0) * PLATEAU.radii[1];
    let rough = SMOOTH.iter().fold(1.0, |rough: f64, patch| rough.min(ramp(0.9, 1.5, patch.reach(x, z))));
    fall - crest - rough * (wide + bumps) - pile
}

/// Adds a standing mast, dark slabs, and plates of constant colour.
fn stand(yard: &mut Yard) {
    yard.bar(DVec3::new(-2.9, -0.9, 0.1), DVec3::new(-3.3, -6.6, 0.5), 0.14, Material::Timber);
    yard.bar(DVec3::new(-3.35, -4.7, -1.3), DVec3::new(-3.05, -5.1, 2.0), 0.08, Material::Timber);
    let turned = |y: f64, x: f64| DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
    let slabs = [
        (DVec3::new(0.9, 1.8, 0.4), DVec3::new(8.3, -1.4, 1.7), turned(0.9, 0.1), Material::Dark),
        (DVec3::new(0.9, 1.6, 0.6), DVec3::new(-8.9, -1.2, -2.2), turned(-0.4, -0.15), Material::Dark),
        (DVec3::new(1.5, 1.5, 0.06), DVec3::new(-8.6, -1.3, 2.0), turned(0.9, 0.2), Material::SmoothPale),
        (DVec3::new(1.3, 1.7, 0.06), DVec3::new(7.6, -1.5, -2.9), turned(-0.7, -0.2), Material::SmoothBlue),
        (DVec3::new(2.2, 2.3, 0.1), DVec3::new(1.5, -2.6, 15.2), turned(0.15, 0.1), Material::SmoothPale),
        (DVec3::new(2.2, 2.3, 0.1), DVec3::new(-4.0, -2.6, -15.0), turned(-0.2, -0.1), Material::SmoothBlue),
    ];
    for (half, centre, axes, material) in slabs {
        yard.add(Shape::Block(half), centre, axes, material);
    }
}

/// Adds coral heads on the crest, where no camera passes, and stones.
fn grow(yard: &mut Yard, floor: &SeaFloor) {
    let seed = yard.seed;
    let random = |item: u32, k: u32| f64::from(uniform_at(seed, Stream::Synth, FIRST + item, k));
    let on_floor = |x: f64, z: f64, lift: f64| DVec3::new(x, floor.y_at(x, z) - lift, z);
    for head in 0..HEADS {
        let random = |k: u32| random(head, k);
        let angle = std::f64::consts::TAU * (f64::from(head) + 0.7 * random(0)) / f64::from(HEADS);
        let out = 0.76 + 0.2 * random(1);
        let (x, z) = (out * PLATEAU.radii[0] * angle.cos(), out * PLATEAU.radii[1] * angle.sin());
        let material = if head % 4 == 1 { Material::Dark } else { Material::Rock };
        let (wide, tall) = (0.9 + 1.1 * random(2), 0.8 + 2.4 * random(3) * random(3));
        // Dark heads reach above the horizon.
        let tall = if material == Material::Dark { tall + 1.0 } else { tall };
        for lump in 0..4 {
            let at = |k: u32| random(4 + 5 * lump + k);
            let size = if lump == 0 { 1.0 } else { 0.35 + 0.4 * at(0) };
            let turn = std::f64::consts::TAU * at(1);
            let aside = if lump == 0 { 0.0 } else { wide * (0.6 + 0.5 * at(2)) };
            let radii = DVec3::new(wide, tall * (0.8 + 0.4 * at(3)), wide * (0.6 + 0.4 * at(4))) * size;
            let place = on_floor(x + aside * turn.cos(), z + aside * turn.sin(), 0.1 * radii.y);
            yard.add(Shape::Ellipsoid(radii), place, DMat3::from_rotation_y(turn), material);
        }
    }
    for stone in 0..STONES {
        let random = |k: u32| random(HEADS + stone, k);
        let angle = std::f64::consts::TAU * random(0);
        let out = 0.97 * (0.12 + 0.88 * random(1)).sqrt();
        let (x, z) = (out * PLATEAU.radii[0] * angle.cos(), out * PLATEAU.radii[1] * angle.sin());
        let from_hull = ((x / (HULL.x + 0.8)).powi(2) + (z / (HULL.z + 0.8)).powi(2)).sqrt();
        if from_hull < 1.0 || floor.is_smooth(x, z) {
            continue;
        }
        let radii = DVec3::new(0.3 + 0.5 * random(2), 0.2 + 0.45 * random(3), 0.3 + 0.4 * random(4));
        let axes = DMat3::from_rotation_y(std::f64::consts::TAU * random(5));
        yard.add(Shape::Ellipsoid(radii), on_floor(x, z, 0.3 * radii.y), axes, Material::Rock);
    }
}
