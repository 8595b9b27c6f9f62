//! The world: a tiled basin in a hall. Units are metres, y down; the edge of the basin is at y = 0. Lamps and
//! striped walls are there to be reflected. Seed: textures and loose objects.

use glam::{DMat3, DVec3};

use super::super::geometry::{Hit, Material, Ray, SeaFloor, Shape, World};
use super::super::texture;
use super::super::wreck::Yard;
use crate::rng::{Stream, uniform_at};

/// Half the length and half the width of the basin.
pub(super) const HALF: [f64; 2] = [1.0, 1.0];
/// y of the water: below the edge.
pub(super) const SURFACE_Y: f64 = 0.05;
/// Thickness of walls and floors.
const WALL: f64 = 0.2;
/// Half the length and width of the hall, and its height above the edge.
const HALL: [f64; 3] = [4.5, 4.0, 4.0];
/// Where light comes from: above and to the side.
const LIGHT: DVec3 = DVec3::new(0.36, -0.85, 0.38);

/// A basin with water of this depth.
pub(super) fn build(depth: f64, seed: u32) -> World {
    let mut yard = Yard { seed, parts: Vec::new() };
    let bottom = SURFACE_Y + depth;
    hall(&mut yard, bottom);
    basin(&mut yard, bottom);
    objects(&mut yard, bottom);
    // No sea floor: one so deep that no ray reaches it.
    World::new(yard.parts, SeaFloor::new(0.1, 0.1, |_, _| 1e3).ending(Vec::new()))
}

fn block(yard: &mut Yard, low: DVec3, high: DVec3, material: Material) {
    yard.add(Shape::Block(0.5 * (high - low)), 0.5 * (low + high), DMat3::IDENTITY, material);
}

fn hall(yard: &mut Yard, bottom: f64) {
    let [x, z, height] = HALL;
    let below = bottom + 2.0 * WALL;
    block(yard, DVec3::new(-x, -height, -z), DVec3::new(x, below, z), Material::Stripes);
    for (column, row) in [(-1, -1), (-1, 1), (1, -1), (1, 1)] {
        let middle = DVec3::new(1.7 * f64::from(column), -height + 0.08, 1.5 * f64::from(row));
        let half = DVec3::new(0.9, 0.05, 0.16);
        block(yard, middle - half, middle + half, Material::Lamp);
    }
    // The floor around the basin.
    let [bx, bz] = HALF;
    for (low, high) in
        [([-x, -z], [x, -bz]), ([-x, bz], [x, z]), ([-x, -bz], [-bx, bz]), ([bx, -bz], [x, bz])]
    {
        let (low, high) = (DVec3::new(low[0], 0.0, low[1]), DVec3::new(high[0], WALL, high[1]));
        block(yard, low, high, Material::Planks);
    }
}

fn basin(yard: &mut Yard, bottom: f64) {
    let [x, z] = HALF;
    let (lx, lz) = (x + WALL, z + WALL);
    block(yard, DVec3::new(-lx, bottom, -lz), DVec3::new(lx, bottom + WALL, lz), Material::Tiles);
    for (low, high) in
        [([-lx, -lz], [lx, -z]), ([-lx, z], [lx, lz]), ([-lx, -z], [-x, z]), ([x, -z], [lx, z])]
    {
        // A coping that stands above the floor.
        let (low, high) = (DVec3::new(low[0], -0.05, low[1]), DVec3::new(high[0], bottom, high[1]));
        block(yard, low, high, Material::Tiles);
    }
}

fn objects(yard: &mut Yard, bottom: f64) {
    let seed = yard.seed;
    let random = |index: u32, k: u32| f64::from(uniform_at(seed, Stream::Synth, 50_000 + index, k));
    let materials = [Material::Painted, Material::Rock, Material::Iron, Material::Timber];
    // In the water, on its ground.
    for index in 0..10 {
        let at = |k: u32, half: f64| (2.0 * random(index, k) - 1.0) * (half - 0.28);
        let (x, z) = (at(0, HALF[0]), at(1, HALF[1]));
        let half = DVec3::new(0.06, 0.05, 0.06)
            + 0.1 * DVec3::new(random(index, 2), random(index, 3), random(index, 4));
        let turned = DMat3::from_rotation_y(std::f64::consts::TAU * random(index, 5));
        let material = materials[index as usize % materials.len()];
        if index % 3 == 2 {
            let along = turned * DVec3::new(0.2, 0.0, 0.0);
            let middle = DVec3::new(x, bottom - half.y, z);
            yard.bar(middle - along, middle + along, half.y, material);
        } else {
            yard.add(Shape::Block(half), DVec3::new(x, bottom - half.y, z), turned, material);
        }
    }
    // Around it.
    for index in 10..20 {
        let angle = std::f64::consts::TAU * (f64::from(index) + 0.5 * random(index, 0)) / 10.0;
        let out = 1.55 + 0.7 * random(index, 1);
        let (x, z) = (out * angle.cos(), out * angle.sin());
        let radius = 0.06 + 0.08 * random(index, 2);
        let material = materials[index as usize % materials.len()];
        let foot = DVec3::new(x, -radius, z);
        if index % 2 == 0 {
            let top = foot - DVec3::Y * (0.2 + 0.4 * random(index, 3));
            yard.bar(foot, top, radius, material);
        } else {
            yard.add(Shape::Ellipsoid(DVec3::splat(radius)), foot, DMat3::IDENTITY, material);
        }
    }
    // A ladder stands in the water: its bars pass the surface.
    for side in [-0.16, 0.16] {
        let top = DVec3::new(HALF[0] - 0.08, -0.45, side);
        yard.bar(top, DVec3::new(top.x, bottom - 0.1, side), 0.022, Material::Painted);
    }
}

/// Radiance of a hit, linear light. Shadows and refracted light are left out, so that it does not depend on
/// the surface: the scene is the same dry and under water.
pub(super) fn radiance(hit: &Hit, seed: u32) -> DVec3 {
    if hit.material == Material::Lamp {
        return DVec3::new(0.95, 0.93, 0.86);
    }
    let facing = hit.normal.dot(LIGHT.normalize()).max(0.0);
    texture::albedo(hit, seed) * (0.62 + 0.55 * facing)
}

/// What a ray sees without the surface.
pub(super) fn seen(world: &World, ray: &Ray, seed: u32) -> DVec3 {
    world.hit(ray, 30.0).map_or(DVec3::ZERO, |hit| radiance(&hit, seed))
}

/// Whether a point of the surface is within the basin.
pub(super) fn is_in_basin(point: DVec3) -> bool {
    point.x.abs() < HALF[0] && point.z.abs() < HALF[1]
}
