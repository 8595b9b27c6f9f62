//! Band-limited noise for procedural textures and terrain: a pure function of position and seed.

use glam::DVec3;

/// 32 well-mixed bits of a lattice point (the finaliser of MurmurHash3 over a linear key).
pub(super) fn lattice_bits(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x8DA6_B343)
        ^ (y as u32).wrapping_mul(0xD816_3841)
        ^ (z as u32).wrapping_mul(0xCB1A_B31F)
        ^ seed.wrapping_mul(0x9E37_79B9);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85EB_CA6B);
    h ^= h >> 13;
    h = h.wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// Uniform in [0, 1) at a lattice point.
pub(super) fn lattice(x: i32, y: i32, z: i32, seed: u32) -> f64 {
    f64::from(lattice_bits(x, y, z, seed)) * (1.0 / 4_294_967_296.0)
}

/// Smooth value noise in [0, 1], with one feature per unit of length.
pub(super) fn value(p: DVec3, seed: u32) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    // Cubic fade: continuous first derivative, so shading shows no lattice.
    let w = f * f * (DVec3::splat(3.0) - 2.0 * f);
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let edge =
        |dy: i32, dz: i32| mix(lattice(x, y + dy, z + dz, seed), lattice(x + 1, y + dy, z + dz, seed), w.x);
    mix(mix(edge(0, 0), edge(1, 0), w.y), mix(edge(0, 1), edge(1, 1), w.y), w.z)
}

/// [`value`] on the plane y = 0, at half the cost.
pub(super) fn value_flat(x: f64, z: f64, seed: u32) -> f64 {
    let (ix, iz) = (x.floor(), z.floor());
    let fade = |f: f64| f * f * (3.0 - 2.0 * f);
    let (wx, wz) = (fade(x - ix), fade(z - iz));
    let (ix, iz) = (ix as i32, iz as i32);
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let edge = |dz: i32| mix(lattice(ix, 0, iz + dz, seed), lattice(ix + 1, 0, iz + dz, seed), wx);
    mix(edge(0), edge(1), wz)
}

/// [`fractal`] on the plane y = 0.
pub(super) fn fractal_flat(x: f64, z: f64, octaves: u32, seed: u32) -> f64 {
    let (mut sum, mut weight, mut total, mut q) = (0.0, 1.0, 0.0, (x, z));
    for octave in 0..octaves {
        sum += weight * value_flat(q.0, q.1, seed.wrapping_add(octave));
        total += weight;
        weight *= 0.5;
        // Also rotated by 37 degrees, so that the axes of the lattice do not show.
        q = (1.62 * q.0 - 1.22 * q.1 + 17.3, 1.22 * q.0 + 1.62 * q.1 + 9.1);
    }
    sum / total
}

/// Weighted mean of `octaves` of [`value`], each with half the weight and twice the frequency; in [0, 1],
/// mean 0.5.
pub(super) fn fractal(p: DVec3, octaves: u32, seed: u32) -> f64 {
    let (mut sum, mut weight, mut total, mut q) = (0.0, 1.0, 0.0, p);
    for octave in 0..octaves {
        sum += weight * value(q, seed.wrapping_add(octave));
        total += weight;
        weight *= 0.5;
        // Not exactly 2, and shifted, so that lattices of different octaves never coincide.
        q = q * 2.03 + DVec3::new(17.3, 5.7, 9.1);
    }
    sum / total
}

/// 0 below `low`, 1 above `high`, smooth between.
pub(super) fn ramp(low: f64, high: f64, v: f64) -> f64 {
    let t = ((v - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
