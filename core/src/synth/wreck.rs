//! Builds the world: a listing hull with ribs, keelson, decks, deckhouse, boiler and fallen mast on an
//! undulating floor, with plates, barrels, an anchor and rocks around it.
//!
//! Units are metres; x along the ship, y down, z across. The seed moves scattered objects and all textures,
//! but not the ship.

use glam::{DMat3, DVec3};

use super::geometry::{Material, Part, SeaFloor, Shape, World};
use super::noise::{fractal_flat, ramp};
use crate::rng::{Stream, uniform_at};

/// Radii of the hull: half its length, its depth and half its beam.
pub(super) const HULL: DVec3 = DVec3::new(6.8, 1.9, 1.75);
/// Middle of the hull's deck line; the floor lies around y = 0.
const HULL_CENTRE: DVec3 = DVec3::new(0.0, -1.05, 0.0);

pub(super) fn build(seed: u32) -> World {
    let floor = SeaFloor::new(26.0, 20.0, |x, z| floor_y(x, z, seed));
    let mut yard = Yard { seed, parts: Vec::new() };
    yard.ship();
    yard.scatter(&floor);
    World::new(yard.parts, floor)
}

/// Dunes, and sand piled against the hull.
fn floor_y(x: f64, z: f64, seed: u32) -> f64 {
    let dunes = 0.75 * (fractal_flat(x * 0.22, z * 0.22, 3, seed ^ 0x31) - 0.5);
    let bumps = 0.10 * (fractal_flat(x * 1.4, z * 1.4, 3, seed ^ 0x32) - 0.5);
    let from_hull = ((x / (HULL.x + 1.2)).powi(2) + (z / (HULL.z + 1.4)).powi(2)).sqrt();
    let pile = 0.38 * (1.0 - ramp(0.55, 1.25, from_hull));
    -(dunes + bumps + pile)
}

/// Collects the parts of a world.
pub(super) struct Yard {
    pub seed: u32,
    pub parts: Vec<Part>,
}

impl Yard {
    pub fn add(&mut self, shape: Shape, centre: DVec3, axes: DMat3, material: Material) {
        let seed = self.seed.wrapping_mul(31).wrapping_add(self.parts.len() as u32 * 7 + 1);
        self.parts.push(Part { shape, centre, axes, material, seed });
    }

    /// A bar with round ends between two points.
    pub fn bar(&mut self, from: DVec3, to: DVec3, radius: f64, material: Material) {
        let x = (to - from).normalize();
        let y = x.any_orthonormal_vector();
        let axes = DMat3::from_cols(x, y, x.cross(y));
        self.add(Shape::Capsule(0.5 * (to - from).length(), radius), 0.5 * (from + to), axes, material);
    }

    pub fn ship(&mut self) {
        // The wreck lists to one side and its stern has sunk in.
        let list =
            DMat3::from_rotation_x(0.16) * DMat3::from_rotation_z(0.035) * DMat3::from_rotation_y(0.05);
        let at = |x: f64, y: f64, z: f64| HULL_CENTRE + list * DVec3::new(x, y, z);
        self.add(Shape::TornHull(HULL), HULL_CENTRE, list, Material::Iron);

        // Gunwales and ribs follow the hull's ellipse slightly inside it.
        let inside = HULL * 0.985;
        let rim = |x: f64, angle: f64| {
            let width = (1.0 - (x / inside.x).powi(2)).max(0.0).sqrt();
            at(x, inside.y * width * angle.sin(), inside.z * width * angle.cos())
        };
        for side in [0.0, std::f64::consts::PI] {
            for step in 0..14 {
                let x = |s: i32| -6.5 + 13.0 * f64::from(s) / 14.0;
                // The breach has removed the gunwale there.
                if side == 0.0 && (6..10).contains(&step) {
                    continue;
                }
                self.bar(rim(x(step), side), rim(x(step + 1), side), 0.085, Material::Iron);
            }
        }
        for rib in 0..13 {
            let x = -5.7 + 0.95 * f64::from(rib);
            for step in 0..8 {
                let angle = |s: i32| std::f64::consts::PI * f64::from(s) / 8.0;
                self.bar(rim(x, angle(step)), rim(x, angle(step + 1)), 0.07, Material::Iron);
            }
        }
        self.bar(at(-5.6, 0.9, 0.0), at(5.6, 0.9, 0.0), 0.14, Material::Timber);

        // Decks at stern and bow; beams without planks between them.
        self.add(Shape::Block(DVec3::new(1.35, 0.05, 1.12)), at(-4.25, 0.12, 0.0), list, Material::Planks);
        self.add(Shape::Block(DVec3::new(1.0, 0.05, 1.0)), at(4.6, 0.12, 0.0), list, Material::Planks);
        for beam in 0..4 {
            let x = -2.6 + 1.55 * f64::from(beam);
            self.bar(
                at(x, 0.1, -1.55),
                at(x, 0.1, if beam == 2 { 0.2 } else { 1.5 }),
                0.075,
                Material::Timber,
            );
        }

        // Deckhouse with a roof, a hatch, and the boiler with its funnel amidships.
        let house = list * DMat3::from_rotation_y(0.06);
        self.add(Shape::Block(DVec3::new(0.75, 0.5, 0.62)), at(-4.3, -0.42, 0.0), house, Material::Painted);
        self.add(Shape::Block(DVec3::new(0.88, 0.05, 0.74)), at(-4.3, -0.96, 0.0), house, Material::Planks);
        self.add(Shape::Block(DVec3::new(0.4, 0.16, 0.4)), at(4.5, -0.05, 0.1), list, Material::Timber);
        self.add(Shape::Cylinder(0.95, 0.62), at(-0.6, 0.42, -0.1), list, Material::Iron);
        self.add(
            Shape::Cylinder(0.5, 0.22),
            at(-0.5, -0.45, -0.1),
            list * DMat3::from_rotation_z(1.45),
            Material::Iron,
        );
        self.add(Shape::Block(DVec3::new(0.5, 0.35, 0.42)), at(1.25, 0.62, -0.15), list, Material::Painted);

        // The mast has fallen over the side; its spar crosses it.
        self.bar(at(2.4, -0.2, -0.5), DVec3::new(4.7, -0.05, 4.7), 0.13, Material::Timber);
        self.bar(DVec3::new(2.9, -0.22, 3.9), DVec3::new(5.4, -0.5, 2.6), 0.075, Material::Timber);
        self.bar(at(-5.4, 0.0, 0.0), at(-5.5, -1.0, 0.1), 0.07, Material::Iron);
        // Anchor and chain ahead of the bow.
        let anchor = DVec3::new(8.3, -0.18, -1.4);
        self.bar(anchor, anchor + DVec3::new(1.1, -0.12, -0.5), 0.08, Material::Iron);
        self.bar(
            anchor + DVec3::new(-0.25, 0.02, -0.55),
            anchor + DVec3::new(0.2, -0.25, 0.6),
            0.075,
            Material::Iron,
        );
        for link in 0..8 {
            let s = f64::from(link) / 8.0;
            let on_way =
                |s: f64| at(6.3, 0.5, 0.0).lerp(anchor, s) + DVec3::new(0.0, 0.05, 0.35 * (s * 5.0).sin());
            self.bar(on_way(s), on_way(s + 0.11), 0.05, Material::Iron);
        }
    }

    /// Adds plates, planks, barrels, crates and rocks in the sand, denser near the ship.
    pub fn scatter(&mut self, floor: &SeaFloor) {
        let seed = self.seed;
        for item in 0..150_u32 {
            let random = |k: u32| f64::from(uniform_at(seed, Stream::Synth, item, k));
            let is_rock = item >= 60;
            let (mut x, mut z) = ((random(0) - 0.5) * 22.0, (random(1) - 0.5) * 12.0);
            if is_rock {
                (x, z) = ((random(0) - 0.5) * 34.0, (random(1) - 0.5) * 22.0);
            }
            let from_hull = ((x / (HULL.x + 0.4)).powi(2) + (z / (HULL.z + 0.5)).powi(2)).sqrt();
            if from_hull < 1.0 {
                // Items inside the hull move outside, on the same side.
                let push = 1.05 + 0.5 * random(9);
                (x, z) = (x * push / from_hull.max(0.05), z * push / from_hull.max(0.05));
            }
            if floor.is_smooth(x, z) {
                continue;
            }
            let turn = DMat3::from_rotation_y(random(2) * std::f64::consts::TAU)
                * DMat3::from_rotation_x((random(3) - 0.5) * 0.9)
                * DMat3::from_rotation_z((random(4) - 0.5) * 0.6);
            let size = 0.55 + 0.9 * random(5);
            let on_floor = |lift: f64| DVec3::new(x, floor.y_at(x, z) - lift, z);
            if is_rock {
                let radii =
                    DVec3::new(0.34 + 0.3 * random(6), 0.22 + 0.12 * random(7), 0.26 + 0.3 * random(8))
                        * size;
                self.add(Shape::Ellipsoid(radii), on_floor(0.25 * radii.y), turn, Material::Rock);
                continue;
            }
            match item % 5 {
                0 => {
                    let plate = DVec3::new(0.75, 0.025, 0.48) * size;
                    self.add(Shape::Block(plate), on_floor(0.09), turn, Material::Iron);
                }
                1 => {
                    let lying = DMat3::from_rotation_y(random(2) * std::f64::consts::TAU);
                    self.add(Shape::Cylinder(0.36, 0.24), on_floor(0.14), lying, Material::Painted);
                }
                2 => {
                    let crate_half = DVec3::new(0.3, 0.2, 0.22) * size;
                    self.add(Shape::Block(crate_half), on_floor(0.6 * crate_half.y), turn, Material::Timber);
                }
                3 => {
                    let plank = DVec3::new(0.95, 0.045, 0.12) * size;
                    self.add(Shape::Block(plank), on_floor(0.08), turn, Material::Timber);
                }
                _ => {
                    let pipe = DMat3::from_rotation_y(random(2) * std::f64::consts::TAU);
                    self.add(Shape::Cylinder(0.8 * size, 0.09), on_floor(0.05), pipe, Material::Iron);
                }
            }
        }
    }
}
