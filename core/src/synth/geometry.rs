//! Intersects rays with parts: boxes, cylinders, ellipsoids and torn shells, each in its own frame. A small
//! tree of bounding boxes finds them. The sea floor is a height field.

use glam::{DMat3, DVec3};

use super::noise;

/// A half-line; `direction` has unit length, so distances along it are ranges.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub origin: DVec3,
    pub direction: DVec3,
}

/// Material of a part, which decides its appearance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Material {
    Sand,
    Rock,
    Iron,
    Timber,
    Planks,
    Painted,
    /// Looks similar to open water.
    Dark,
    /// Of a pool: tiles, striped walls, lamps that shine by themselves.
    Tiles,
    Stripes,
    Lamp,
    /// Constant colour: pale paint, paint in the colour of water, raked sand.
    SmoothPale,
    SmoothBlue,
    SmoothSand,
}

impl Material {
    /// Whether its colour is constant, so that no features can be matched on it.
    pub fn is_smooth(self) -> bool {
        matches!(self, Self::SmoothPale | Self::SmoothBlue | Self::SmoothSand)
    }
}

/// An ellipse on the sea floor whose axes are those of the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patch {
    /// x and z.
    pub centre: [f64; 2],
    pub radii: [f64; 2],
}

impl Patch {
    /// 0 in the middle, 1 on the rim.
    pub fn reach(&self, x: f64, z: f64) -> f64 {
        ((x - self.centre[0]) / self.radii[0]).hypot((z - self.centre[1]) / self.radii[1])
    }
}

/// A body around the origin of its own frame.
#[derive(Clone, Copy, Debug)]
pub(super) enum Shape {
    /// Half the side lengths.
    Block(DVec3),
    /// Along x: half the length, radius; with flat ends.
    Cylinder(f64, f64),
    /// Along x: half the length of the axis, radius; with round ends.
    Capsule(f64, f64),
    /// Radii.
    Ellipsoid(DVec3),
    /// Radii of an ellipsoid whose lower half (y > 0) is a thin sheet with tears.
    TornHull(DVec3),
}

/// A shape in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Part {
    pub shape: Shape,
    pub centre: DVec3,
    /// Columns are the part's axes in the world.
    pub axes: DMat3,
    pub material: Material,
    /// Makes parts of one material differ.
    pub seed: u32,
}

/// The end of a ray on a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// Distance along the ray.
    pub range: f64,
    /// Unit, towards the ray's origin.
    pub normal: DVec3,
    /// In the frame of the part (the floor's is the world's).
    pub local: DVec3,
    pub material: Material,
    pub seed: u32,
}

/// Smaller distances are hits on the surface from which the ray starts.
const SELF_DISTANCE: f64 = 1e-4;

impl Part {
    /// Nearest hit in (SELF_DISTANCE, limit).
    fn hit(&self, ray: &Ray, limit: f64) -> Option<Hit> {
        let to_local = self.axes.transpose();
        let (o, d) = (to_local * (ray.origin - self.centre), to_local * ray.direction);
        let within = |t: f64| t > SELF_DISTANCE && t < limit;
        let (range, normal) = match self.shape {
            Shape::Block(half) => hit_block(o, d, half, within),
            Shape::Cylinder(half, radius) => hit_cylinder(o, d, half, radius, within),
            Shape::Capsule(half, radius) => hit_capsule(o, d, half, radius, within),
            Shape::Ellipsoid(radii) => hit_ellipsoid(o, d, radii, within, |_| true),
            Shape::TornHull(radii) => {
                hit_ellipsoid(o, d, radii, within, |p| p.y > 0.0 && !torn(p, radii, self.seed))
            }
        }?;
        let normal = (self.axes * normal).normalize();
        let normal = if normal.dot(ray.direction) > 0.0 { -normal } else { normal };
        Some(Hit { range, normal, local: o + d * range, material: self.material, seed: self.seed })
    }

    fn bounds(&self) -> (DVec3, DVec3) {
        let half = match self.shape {
            Shape::Block(half) => half,
            Shape::Cylinder(half, radius) => DVec3::new(half, radius, radius),
            Shape::Capsule(half, radius) => DVec3::new(half + radius, radius, radius),
            Shape::Ellipsoid(radii) | Shape::TornHull(radii) => radii,
        };
        let reach = self.axes.x_axis.abs() * half.x
            + self.axes.y_axis.abs() * half.y
            + self.axes.z_axis.abs() * half.z;
        (self.centre - reach, self.centre + reach)
    }
}

/// Whether the sheet of a hull has rusted away at `p`: one large breach and scattered holes.
fn torn(p: DVec3, radii: DVec3, seed: u32) -> bool {
    let breach = ((p.x / radii.x - 0.18) / 0.16).powi(2) + ((p.z / radii.z - 0.9) / 0.75).powi(2);
    let ragged = noise::fractal(p * 1.6, 3, seed);
    breach < 0.55 + 0.9 * ragged || ragged > 0.74
}

type LocalHit = Option<(f64, DVec3)>;

fn hit_block(o: DVec3, d: DVec3, half: DVec3, within: impl Fn(f64) -> bool) -> LocalHit {
    let inverse = d.recip();
    let (a, b) = ((-half - o) * inverse, (half - o) * inverse);
    let (near, far) = (a.min(b), a.max(b));
    let (enter, leave) = (near.max_element(), far.min_element());
    if enter > leave {
        return None;
    }
    let range = [enter, leave].into_iter().find(|&t| within(t))?;
    let side = (o + d * range) / half;
    let normal = if side.x.abs() >= side.y.abs() && side.x.abs() >= side.z.abs() {
        DVec3::X
    } else if side.y.abs() >= side.z.abs() {
        DVec3::Y
    } else {
        DVec3::Z
    };
    Some((range, normal))
}

fn hit_cylinder(o: DVec3, d: DVec3, half: f64, radius: f64, within: impl Fn(f64) -> bool) -> LocalHit {
    let mut best: LocalHit = None;
    let mut offer = |t: f64, normal: DVec3| {
        if within(t) && best.is_none_or(|(nearest, _)| t < nearest) {
            best = Some((t, normal));
        }
    };
    let (a, b, c) = (d.y * d.y + d.z * d.z, o.y * d.y + o.z * d.z, o.y * o.y + o.z * o.z - radius * radius);
    let discriminant = b * b - a * c;
    if a > 1e-12 && discriminant > 0.0 {
        let root = discriminant.sqrt();
        for t in [(-b - root) / a, (-b + root) / a] {
            let p = o + d * t;
            if p.x.abs() < half {
                offer(t, DVec3::new(0.0, p.y, p.z));
            }
        }
    }
    for end in [-half, half] {
        let t = (end - o.x) / d.x;
        let p = o + d * t;
        if p.y * p.y + p.z * p.z < radius * radius {
            offer(t, DVec3::X);
        }
    }
    best
}

fn hit_capsule(o: DVec3, d: DVec3, half: f64, radius: f64, within: impl Fn(f64) -> bool) -> LocalHit {
    let mut best: LocalHit = None;
    let mut offer = |t: f64, normal: DVec3| {
        if within(t) && best.is_none_or(|(nearest, _)| t < nearest) {
            best = Some((t, normal));
        }
    };
    let (a, b, c) = (d.y * d.y + d.z * d.z, o.y * d.y + o.z * d.z, o.y * o.y + o.z * o.z - radius * radius);
    let discriminant = b * b - a * c;
    if discriminant < 0.0 {
        return None;
    }
    if a > 1e-12 {
        let t = (-b - discriminant.sqrt()) / a;
        let p = o + d * t;
        if p.x.abs() < half {
            offer(t, DVec3::new(0.0, p.y, p.z));
        }
    }
    for end in [-half, half] {
        let q = o - DVec3::X * end;
        let (b, c) = (q.dot(d), q.length_squared() - radius * radius);
        let discriminant = b * b - c;
        if discriminant > 0.0 {
            let t = -b - discriminant.sqrt();
            offer(t, q + d * t);
        }
    }
    best
}

fn hit_ellipsoid(
    o: DVec3,
    d: DVec3,
    radii: DVec3,
    within: impl Fn(f64) -> bool,
    stands: impl Fn(DVec3) -> bool,
) -> LocalHit {
    let (u, v) = (o / radii, d / radii);
    let (a, b, c) = (v.length_squared(), u.dot(v), u.length_squared() - 1.0);
    let discriminant = b * b - a * c;
    if discriminant < 0.0 {
        return None;
    }
    let root = discriminant.sqrt();
    let range = [(-b - root) / a, (-b + root) / a].into_iter().find(|&t| within(t) && stands(o + d * t))?;
    Some((range, (o + d * range) / (radii * radii)))
}

/// The sea floor: y (down) as a function of x and z, bilinear on a grid. Beyond its rim it continues level or
/// ends.
pub(super) struct SeaFloor {
    origin: [f64; 2],
    size: [usize; 2],
    heights: Vec<f64>,
    /// Highest and lowest y.
    slab: [f64; 2],
    /// Whether there is no floor beyond the rim.
    ends: bool,
    /// Areas of smooth sand.
    smooth: Vec<Patch>,
}

impl SeaFloor {
    const SPACING: f64 = 0.08;

    /// Samples `y_at(x, z)` over [-half_x, half_x] x [-half_z, half_z].
    pub fn new(half_x: f64, half_z: f64, y_at: impl Fn(f64, f64) -> f64) -> Self {
        let size = [half_x, half_z].map(|half| (2.0 * half / Self::SPACING) as usize + 2);
        let origin = [-half_x, -half_z];
        let heights: Vec<f64> = (0..size[0] * size[1])
            .map(|i| {
                let (ix, iz) = (i % size[0], i / size[0]);
                y_at(origin[0] + ix as f64 * Self::SPACING, origin[1] + iz as f64 * Self::SPACING)
            })
            .collect();
        let slab = heights.iter().fold([f64::MAX, f64::MIN], |[lo, hi], &y| [lo.min(y), hi.max(y)]);
        Self {
            origin,
            size,
            heights,
            slab: [slab[0] - 0.01, slab[1] + 0.01],
            ends: false,
            smooth: Vec::new(),
        }
    }

    /// The same floor, ending at the rim and with patches of smooth sand.
    #[must_use]
    pub fn ending(self, smooth: Vec<Patch>) -> Self {
        Self { ends: true, smooth, ..self }
    }

    /// Whether the sand is smooth there.
    pub fn is_smooth(&self, x: f64, z: f64) -> bool {
        self.smooth.iter().any(|patch| patch.reach(x, z) < 1.0)
    }

    fn has(&self, x: f64, z: f64) -> bool {
        let on = |v: f64, axis: usize| {
            let g = (v - self.origin[axis]) / Self::SPACING;
            g >= 0.0 && g <= (self.size[axis] - 1) as f64
        };
        !self.ends || (on(x, 0) && on(z, 1))
    }

    /// y of the floor.
    pub fn y_at(&self, x: f64, z: f64) -> f64 {
        let place = |v: f64, axis: usize| {
            let g =
                ((v - self.origin[axis]) / Self::SPACING).clamp(0.0, (self.size[axis] - 2) as f64 + 0.999);
            (g as usize, g - g.floor())
        };
        let ((ix, fx), (iz, fz)) = (place(x, 0), place(z, 1));
        let at = |dx: usize, dz: usize| self.heights[(iz + dz) * self.size[0] + ix + dx];
        let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
        mix(mix(at(0, 0), at(1, 0), fx), mix(at(0, 1), at(1, 1), fx), fz)
    }

    fn hit(&self, ray: &Ray, limit: f64) -> Option<Hit> {
        let (o, d) = (ray.origin, ray.direction);
        if d.y.abs() < 1e-6 {
            return None;
        }
        let (a, b) = ((self.slab[0] - o.y) / d.y, (self.slab[1] - o.y) / d.y);
        let (enter, leave) = (a.min(b).max(SELF_DISTANCE), a.max(b).min(limit));
        // Positive above the floor.
        let above = |t: f64| {
            let p = o + d * t;
            self.y_at(p.x, p.z) - p.y
        };
        if enter >= leave {
            return None;
        }
        let (mut t, mut height) = (enter, above(enter));
        if height < 0.0 {
            return None;
        }
        // With slopes below 1, the height above the floor falls at most this fast along the ray.
        let approach = (d.y + d.x.hypot(d.z)).max(0.05);
        let mut next = t;
        while next < leave {
            next = (t + (height / approach).max(0.005)).min(leave);
            let h = above(next);
            if h < 0.0 {
                break;
            }
            (t, height) = (next, h);
            if next >= leave {
                return None;
            }
        }
        let (mut outside, mut inside) = (t, next);
        for _ in 0..12 {
            let middle = 0.5 * (outside + inside);
            if above(middle) < 0.0 { inside = middle } else { outside = middle }
        }
        let local = o + d * outside;
        if !self.has(local.x, local.z) {
            return None;
        }
        let e = Self::SPACING;
        let slope = |dx: f64, dz: f64| {
            (self.y_at(local.x + dx, local.z + dz) - self.y_at(local.x - dx, local.z - dz)) / (2.0 * e)
        };
        let normal = DVec3::new(slope(e, 0.0), -1.0, slope(0.0, e)).normalize();
        let material = if self.is_smooth(local.x, local.z) { Material::SmoothSand } else { Material::Sand };
        Some(Hit { range: outside, normal, local, material, seed: 0 })
    }
}

/// All parts and the floor.
pub(super) struct World {
    parts: Vec<Part>,
    nodes: Vec<Node>,
    pub floor: SeaFloor,
}

/// A box around `parts[first..first + count]`, or around two children when `count` is 0: the next
/// node and `nodes[first]`.
struct Node {
    lo: DVec3,
    hi: DVec3,
    first: u32,
    count: u32,
}

impl World {
    pub fn new(mut parts: Vec<Part>, floor: SeaFloor) -> Self {
        let mut nodes = Vec::new();
        let count = parts.len();
        build_node(&mut parts, 0, count, &mut nodes);
        Self { parts, nodes, floor }
    }

    /// The nearest surface within `limit`.
    pub fn hit(&self, ray: &Ray, limit: f64) -> Option<Hit> {
        let (mut best, mut nearest) = (None, limit);
        let inverse = ray.direction.recip();
        // The tree halves its parts at every level: 32 levels hold more parts than memory.
        let (mut stack, mut depth) = ([0_u32; 32], 1);
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            let (a, b) = ((node.lo - ray.origin) * inverse, (node.hi - ray.origin) * inverse);
            let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
            if enter > leave || leave < 0.0 || enter > nearest {
                continue;
            }
            if node.count == 0 {
                stack[depth] = node.first;
                stack[depth + 1] = index as u32 + 1;
                depth += 2;
                continue;
            }
            for part in &self.parts[node.first as usize..(node.first + node.count) as usize] {
                if let Some(hit) = part.hit(ray, nearest) {
                    nearest = hit.range;
                    best = Some(hit);
                }
            }
        }
        self.floor.hit(ray, nearest).or(best)
    }

    /// Whether nothing occludes the line between two points.
    pub fn sees(&self, from: DVec3, to: DVec3) -> bool {
        let way = to - from;
        let length = way.length();
        self.hit(&Ray { origin: from, direction: way / length }, length * (1.0 - 2e-3)).is_none()
    }
}

fn build_node(parts: &mut [Part], first: usize, end: usize, nodes: &mut Vec<Node>) {
    let (mut lo, mut hi) = (DVec3::MAX, DVec3::MIN);
    for part in &parts[first..end] {
        let (a, b) = part.bounds();
        (lo, hi) = (lo.min(a), hi.max(b));
    }
    let index = nodes.len();
    nodes.push(Node { lo, hi, first: first as u32, count: (end - first) as u32 });
    if end - first <= 2 {
        return;
    }
    let axis = usize::from((hi - lo).z > (hi - lo).x) * 2;
    parts[first..end].sort_by(|a, b| a.centre[axis].total_cmp(&b.centre[axis]));
    let middle = (first + end) / 2;
    build_node(parts, first, middle, nodes);
    let second = nodes.len() as u32;
    build_node(parts, middle, end, nodes);
    nodes[index].first = second;
    nodes[index].count = 0;
}
