//! The world: a tiled basin in a hall. Units are metres, y down; the edge of the basin is at y = 0. Lamps and
//! striped walls are there to be reflected. Seed: textures and loose objects.
//!
//! A longer basin (along x) has a longer hall, with more lamps and more objects; the objects of the short one
//! move apart.

use glam::{DMat3, DVec3};

use super::super::geometry::{Hit, Material, Ray, SeaFloor, Shape, World};
use super::super::texture;
use super::super::wreck::Yard;
use crate::rng::{Stream, uniform_at};

/// Half the width of the basin, and half the least length.
const HALF_WIDTH: f64 = 1.0;
/// y of the water: below the edge.
pub(super) const SURFACE_Y: f64 = 0.05;
/// Thickness of walls and floors.
const WALL: f64 = 0.2;
/// Floor between the ends of the basin and the walls of the hall.
const FLOOR: f64 = 3.5;
/// Half the width of the hall, and its height above the edge.
const HALL: [f64; 2] = [4.0, 4.0];
/// Distance between lamps along the basin, and half the length of a lamp.
const LAMPS: [f64; 2] = [3.4, 0.9];
/// Loose objects a metre of basin: in the water, and along its sides where it is longer than wide.
const OBJECTS: f64 = 5.0;
/// Where light comes from: above and to the side.
const LIGHT: DVec3 = DVec3::new(0.36, -0.85, 0.38);

/// The basin.
#[derive(Clone, Copy, Debug)]
pub(super) struct Basin {
    /// Half its length and half its width.
    pub half: [f64; 2],
    /// y of its ground.
    pub bottom: f64,
}

impl Basin {
    /// A basin of this length with water of this depth.
    pub fn new(length: f64, depth: f64) -> Self {
        Self { half: [0.5 * length, HALF_WIDTH], bottom: SURFACE_Y + depth }
    }

    /// Whether a point of the surface is within the basin.
    pub fn holds(&self, point: DVec3) -> bool {
        point.x.abs() < self.half[0] && point.z.abs() < self.half[1]
    }
}

/// The world with this basin.
pub(super) fn build(basin: &Basin, seed: u32) -> World {
    let mut yard = Yard { seed, parts: Vec::new() };
    hall(&mut yard, basin);
    walls(&mut yard, basin);
    objects_in_water(&mut yard, basin);
    objects_around(&mut yard, basin);
    ladder(&mut yard, basin);
    // No sea floor: one so deep that no ray reaches it.
    World::new(yard.parts, SeaFloor::new(0.1, 0.1, |_, _| 1e3).ending(Vec::new()))
}

fn block(yard: &mut Yard, low: DVec3, high: DVec3, material: Material) {
    yard.add(Shape::Block(0.5 * (high - low)), 0.5 * (low + high), DMat3::IDENTITY, material);
}

fn hall(yard: &mut Yard, basin: &Basin) {
    let [z, height] = HALL;
    let x = FLOOR + basin.half[0];
    let below = basin.bottom + 2.0 * WALL;
    block(yard, DVec3::new(-x, -height, -z), DVec3::new(x, below, z), Material::Stripes);
    let [apart, half_lamp] = LAMPS;
    // As many pairs as have room.
    let pairs = ((x - half_lamp - 0.2) / apart + 0.5).floor() as u32;
    for column in 0..2 * pairs {
        for row in [-1.5, 1.5] {
            let column = f64::from(column) - (f64::from(pairs) - 0.5);
            let middle = DVec3::new(apart * column, -height + 0.08, row);
            let half = DVec3::new(half_lamp, 0.05, 0.16);
            block(yard, middle - half, middle + half, Material::Lamp);
        }
    }
    // The floor around the walls of the basin. It does not reach into them: of two faces in one plane, rays
    // would meet now one, now the other.
    let [bx, bz] = basin.half.map(|half| half + WALL);
    for (low, high) in
        [([-x, -z], [x, -bz]), ([-x, bz], [x, z]), ([-x, -bz], [-bx, bz]), ([bx, -bz], [x, bz])]
    {
        let (low, high) = (DVec3::new(low[0], 0.0, low[1]), DVec3::new(high[0], WALL, high[1]));
        block(yard, low, high, Material::Planks);
    }
}

fn walls(yard: &mut Yard, basin: &Basin) {
    let Basin { half: [x, z], bottom } = *basin;
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

/// Materials of loose objects in turn.
const MATERIALS: [Material; 4] = [Material::Painted, Material::Rock, Material::Iron, Material::Timber];

fn random(seed: u32, index: u32, k: u32) -> f64 {
    f64::from(uniform_at(seed, Stream::Synth, 50_000 + index, k))
}

/// On the ground of the basin.
fn objects_in_water(yard: &mut Yard, basin: &Basin) {
    let Basin { half: halves, bottom } = *basin;
    let seed = yard.seed;
    let random = |index: u32, k: u32| random(seed, index, k);
    for count in 0..(2.0 * OBJECTS * halves[0]).round() as u32 {
        // The numbers from 10 are those of objects around the basin.
        let index = if count < 10 { count } else { 1000 + count };
        let at = |k: u32, half: f64| (2.0 * random(index, k) - 1.0) * (half - 0.28);
        let (x, z) = (at(0, halves[0]), at(1, halves[1]));
        let half = DVec3::new(0.06, 0.05, 0.06)
            + 0.1 * DVec3::new(random(index, 2), random(index, 3), random(index, 4));
        let turned = DMat3::from_rotation_y(std::f64::consts::TAU * random(index, 5));
        let material = MATERIALS[index as usize % MATERIALS.len()];
        if index % 3 == 2 {
            let along = turned * DVec3::new(0.2, 0.0, 0.0);
            let middle = DVec3::new(x, bottom - half.y, z);
            yard.bar(middle - along, middle + along, half.y, material);
        } else {
            yard.add(Shape::Block(half), DVec3::new(x, bottom - half.y, z), turned, material);
        }
    }
}

/// Around the basin.
fn objects_around(yard: &mut Yard, basin: &Basin) {
    let seed = yard.seed;
    let random = |index: u32, k: u32| random(seed, index, k);
    let longer = basin.half[0] - HALF_WIDTH;
    let beside = (2.0 * OBJECTS * longer).round() as u32;
    for index in (10..20).chain((0..beside).map(|count| 2000 + count)) {
        let out = 1.55 + 0.7 * random(index, 1);
        let (x, z) = if index < 20 {
            let angle = std::f64::consts::TAU * (f64::from(index) + 0.5 * random(index, 0)) / 10.0;
            (out * angle.cos() + longer.copysign(angle.cos()), out * angle.sin())
        } else {
            let side = if index % 2 == 0 { 1.0 } else { -1.0 };
            ((2.0 * random(index, 0) - 1.0) * longer, side * out)
        };
        let radius = 0.06 + 0.08 * random(index, 2);
        // Half of the objects at a side stand, whatever their number says about the side.
        let stands = if index < 20 { index % 2 == 0 } else { index % 4 < 2 };
        let material = MATERIALS[index as usize % MATERIALS.len()];
        let foot = DVec3::new(x, -radius, z);
        if stands {
            let top = foot - DVec3::Y * (0.2 + 0.4 * random(index, 3));
            yard.bar(foot, top, radius, material);
        } else {
            yard.add(Shape::Ellipsoid(DVec3::splat(radius)), foot, DMat3::IDENTITY, material);
        }
    }
}

/// A ladder stands in the water: its bars pass the surface.
fn ladder(yard: &mut Yard, basin: &Basin) {
    for side in [-0.16, 0.16] {
        let top = DVec3::new(basin.half[0] - 0.08, -0.45, side);
        yard.bar(top, DVec3::new(top.x, basin.bottom - 0.1, side), 0.022, Material::Painted);
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
