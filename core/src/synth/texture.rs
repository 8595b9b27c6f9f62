//! Appearance of surfaces: albedo in linear light from several scales of noise, lit by daylight.
//!
//! Structure from motion and splatting need contrast at many scales. The finest features are about 4 cm, a
//! pixel and a half at the usual distance, so nothing aliases.

use glam::DVec3;

use super::geometry::{Hit, Material, Ray, World};
use super::noise::{fractal, fractal_flat, lattice, ramp, value_flat};

/// Direction towards the light: up and slightly to the side. y points down.
const LIGHT: DVec3 = DVec3::new(0.36, -0.85, 0.38);

/// J of surfaces of one colour, linear light.
const SMOOTH_PALE: DVec3 = DVec3::new(0.40, 0.42, 0.39);
const SMOOTH_BLUE: DVec3 = DVec3::new(0.06, 0.15, 0.21);
const SMOOTH_SAND: DVec3 = DVec3::new(0.33, 0.28, 0.20);
/// Mean J of dark surfaces, linear light: close to the `b_inf` of [`crate::water::Water::COASTAL`], so that
/// they look similar to open water at any range.
const DARK: DVec3 = DVec3::new(0.021, 0.082, 0.122);

/// J: the radiance of a hit without water, linear light.
pub(super) fn radiance(world: &World, ray: &Ray, hit: &Hit, seed: u32) -> DVec3 {
    match hit.material {
        // No shadows or shading: these surfaces have constant colour.
        Material::SmoothPale => return SMOOTH_PALE,
        Material::SmoothBlue => return SMOOTH_BLUE,
        Material::SmoothSand => return SMOOTH_SAND,
        Material::Dark => return dark(hit),
        _ => (),
    }
    let light = LIGHT.normalize();
    let facing = hit.normal.dot(light).max(0.0);
    let place = ray.origin + ray.direction * hit.range;
    let start = place + hit.normal * 2e-3;
    let lit = facing > 0.0 && world.hit(&Ray { origin: start, direction: light }, 30.0).is_none();
    let ambient = 0.34 - 0.14 * hit.normal.y;
    let direct = if lit { 0.85 * facing } else { 0.0 };
    albedo(hit, seed) * (ambient + direct)
}

/// Reflectance of a hit, linear light.
pub(super) fn albedo(hit: &Hit, seed: u32) -> DVec3 {
    let p = hit.local;
    // Each part has its own shift, so that two barrels look different.
    let own = p + DVec3::splat(f64::from(hit.seed % 1021) * 3.7);
    match hit.material {
        Material::Sand => sand(p, seed),
        Material::Rock => rock(own, hit.seed),
        Material::Iron => iron(own, p, hit.seed),
        Material::Timber => timber(own, hit.seed),
        Material::Planks => planks(own, p, hit.seed),
        Material::Painted => painted(own, hit.seed),
        Material::Tiles => tiles(hit, hit.seed),
        Material::Stripes => stripes(hit, hit.seed),
        // `radiance` does not use the albedo of these.
        Material::Dark => DARK,
        Material::Lamp => DVec3::ONE,
        Material::SmoothPale => SMOOTH_PALE,
        Material::SmoothBlue => SMOOTH_BLUE,
        Material::SmoothSand => SMOOTH_SAND,
    }
}

/// Sponge with hardly any relief in blue light: within a quarter of [`DARK`].
fn dark(hit: &Hit) -> DVec3 {
    let own = hit.local + DVec3::splat(f64::from(hit.seed % 1021) * 3.7);
    let coarse = fractal(own * 1.9, 3, hit.seed ^ 0xA1);
    let fine = fractal(own * 5.0, 2, hit.seed ^ 0xA2);
    DARK * (1.0 + 0.4 * (coarse - 0.5) + 0.2 * (fine - 0.5) - 0.08 * hit.normal.y).clamp(0.75, 1.25)
}

fn sand(p: DVec3, seed: u32) -> DVec3 {
    let (x, z) = (p.x, p.z);
    let wide = fractal_flat(x * 0.45, z * 0.45, 3, seed ^ 0x51);
    let fine = fractal_flat(x * 4.0, z * 4.0, 3, seed ^ 0x52);
    let bend = 2.6 * value_flat(x * 0.5, z * 0.5, seed ^ 0x53);
    let ripple = (std::f64::consts::TAU * (x * 0.8 + z * 1.3 + bend)).sin();
    let tone = 0.25 + 0.95 * wide + 0.85 * (fine - 0.5) + 0.12 * ripple;
    let mut colour = DVec3::new(0.50, 0.39, 0.26) * tone.max(0.05);
    // Weed and dark silt in patches.
    let weed = ramp(0.50, 0.62, fractal_flat(x * 0.8 + 40.0, z * 0.8, 4, seed ^ 0x54));
    colour = colour.lerp(DVec3::new(0.06, 0.085, 0.045) * (0.5 + 1.4 * fine), 0.88 * weed);
    // Gravel in pale sand.
    let gravel = 0.4 * ramp(0.35, 0.6, wide);
    if let Some(stone) = pebble(p, 0.36, gravel, seed ^ 0x55) {
        colour = stone;
    }
    colour
}

/// Colour of the pebble at `p`, if any: an ellipse within its cell, at most one a cell.
fn pebble(p: DVec3, cell: f64, share: f64, seed: u32) -> Option<DVec3> {
    let (ix, iz) = ((p.x / cell).floor(), (p.z / cell).floor());
    let at = |k: i32| lattice(ix as i32, k, iz as i32, seed);
    if at(0) >= share {
        return None;
    }
    let long = cell * (0.16 + 0.24 * at(1));
    let slim = 0.55 + 0.45 * at(6);
    let middle = |v: f64, share: f64| (v + 0.5) * cell + (share - 0.5) * (cell - 2.0 * long);
    let (dx, dz) = (p.x - middle(ix, at(2)), p.z - middle(iz, at(3)));
    let (sin, cos) = (at(7) * std::f64::consts::PI).sin_cos();
    let (u, v) = ((dx * cos + dz * sin) / long, (dz * cos - dx * sin) / (long * slim));
    let inside = 1.0 - u * u - v * v;
    (inside > 0.0).then(|| {
        let tone = 0.04 + 0.5 * at(4) * at(4);
        DVec3::new(tone, tone * (0.88 + 0.12 * at(5)), tone * (0.7 + 0.3 * at(5)))
            * (0.45 + 0.55 * inside.sqrt())
    })
}

fn rock(own: DVec3, seed: u32) -> DVec3 {
    let coarse = fractal(own * 2.2, 4, seed);
    let crust = ramp(0.50, 0.62, fractal(own * 3.1 + 11.0, 3, seed ^ 0x61));
    let base = DVec3::new(0.20, 0.18, 0.15) * (0.35 + 1.3 * coarse);
    base.lerp(DVec3::new(0.48, 0.22, 0.25) * (0.5 + coarse), 0.75 * crust)
}

fn iron(own: DVec3, p: DVec3, seed: u32) -> DVec3 {
    let blotch = fractal(own * 1.3, 4, seed ^ 0x71);
    let grain = fractal(own * 6.0, 3, seed ^ 0x72);
    let rust = DVec3::new(0.42, 0.16, 0.055);
    let dark = DVec3::new(0.065, 0.05, 0.05);
    let mut colour = dark.lerp(rust, ramp(0.36, 0.62, blotch)) * (0.55 + 0.9 * grain);
    // Pale growth, in patches.
    let growth = ramp(0.56, 0.66, fractal(own * 2.4 + 7.0, 3, seed ^ 0x73));
    colour = colour.lerp(DVec3::new(0.46, 0.50, 0.36) * (0.5 + 0.9 * grain), 0.8 * growth);
    // Seams between plates.
    let seam = |v: f64, side: f64| (v / side - (v / side).round()).abs() * side < 0.022;
    if seam(p.x, 0.9) || seam(p.y, 0.55) { colour * 0.35 } else { colour }
}

fn timber(own: DVec3, seed: u32) -> DVec3 {
    let stretched = DVec3::new(own.x * 0.7, own.y * 7.0, own.z * 7.0);
    let grain = fractal(stretched, 3, seed ^ 0x81);
    let rot = ramp(0.45, 0.65, fractal(own * 1.7, 3, seed ^ 0x82));
    DVec3::new(0.34, 0.22, 0.12).lerp(DVec3::new(0.09, 0.10, 0.06), 0.8 * rot) * (0.45 + 1.1 * grain)
}

fn planks(own: DVec3, p: DVec3, seed: u32) -> DVec3 {
    const WIDTH: f64 = 0.2;
    let row = (p.z / WIDTH).floor();
    let along = p.x / 1.7 + lattice(0, row as i32, 1, seed);
    let tone = 0.45 + 0.95 * lattice(along.floor() as i32, row as i32, 0, seed);
    let gap = (p.z / WIDTH - row - 0.5).abs() > 0.44 || (along - along.round()).abs() < 0.02;
    let wear = timber(own, seed) * tone;
    if gap { wear * 0.2 } else { wear }
}

fn painted(own: DVec3, seed: u32) -> DVec3 {
    let tone = 0.12 + 0.4 * lattice(0, 3, 1, seed);
    let tint = |k: i32| tone * (0.65 + 0.7 * lattice(k, 3, 1, seed));
    let paint = DVec3::new(tint(1), 0.92 * tint(2), 0.72 * tint(3));
    let bare = ramp(0.48, 0.60, fractal(own * 2.8, 4, seed ^ 0x91));
    let grain = fractal(own * 6.0, 3, seed ^ 0x92);
    paint.lerp(DVec3::new(0.30, 0.12, 0.05), bare) * (0.5 + grain)
}

/// Tiles of different glazes with pale joints; some have a pattern.
fn tiles(hit: &Hit, seed: u32) -> DVec3 {
    const SIDE: f64 = 0.125;
    let p = hit.local / SIDE;
    let cell = p.floor();
    let within = p - cell - DVec3::splat(0.5);
    // Of the two axes along the face.
    let rim =
        DVec3::select(hit.normal.abs().cmplt(DVec3::splat(0.5)), within.abs(), DVec3::ZERO).max_element();
    if rim > 0.46 {
        return DVec3::new(0.55, 0.54, 0.50);
    }
    // The layer of a face does not depend on rounding.
    let cell = DVec3::select(hit.normal.abs().cmplt(DVec3::splat(0.5)), cell, hit.normal.signum());
    let at = |k: i32| lattice(cell.x as i32 + 13 * k, cell.y as i32, cell.z as i32, seed);
    let glaze = DVec3::new(0.10, 0.32, 0.42).lerp(DVec3::new(0.46, 0.52, 0.47), at(0));
    let marbled = 0.55 + 0.9 * fractal(hit.local * 9.0 + at(1) * 7.0, 3, seed ^ 0xB1);
    let is_dotted = at(2) > 0.72 && within.length() < 0.28;
    if is_dotted { DVec3::new(0.50, 0.20, 0.10) * marbled } else { glaze * marbled }
}

/// Slanted stripes of different colours.
fn stripes(hit: &Hit, seed: u32) -> DVec3 {
    let along = (hit.local.x + 0.6 * hit.local.y + hit.local.z) / 0.45;
    let at = |k: i32| lattice(along.floor() as i32, k, 0, seed);
    let tone = 0.08 + 0.62 * at(0);
    let rough = 0.7 + 0.6 * fractal(hit.local * 1.7, 3, seed ^ 0xC1);
    DVec3::new(tone * (0.7 + 0.5 * at(1)), tone * (0.7 + 0.4 * at(2)), tone * (0.6 + 0.5 * at(3))) * rough
}
