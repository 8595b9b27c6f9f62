//! What a flat surface does to rays: Snell's law, and the reflectance of Fresnel and of Schlick. Also the
//! point where the ray between an eye in air and a point in the water crosses it. All in f64.
//!
//! ```text
//!        eye
//!         | \                h   height of the eye above the surface
//!       h |   \              z   depth of the point below it
//!   ------+-----q---------   R   distance of their feet on the surface
//!         '--r--' \  | z     r   distance of the crossing q from the eye's foot
//!         '----R---\-'       n1 r / |q - eye| = n2 (R - r) / |point - q|    (Snell)
//!                   point
//! ```

use glam::DVec3;

/// Refractive index of air.
pub const AIR: f64 = 1.000_293;
/// Refractive index of water, for visible light at 20 degrees Celsius.
pub const WATER: f64 = 1.333;

/// Newton steps and halvings towards a crossing, at most. Eight Newton steps reach f64 up to 88 degrees.
const ROUNDS: u32 = 64;

/// A flat water surface: the plane `normal . x = offset`, with air on the side of the normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Unit normal into the air, scene axes.
    pub normal: DVec3,
    /// Distance of the plane from the origin along the normal, scene units.
    pub offset: f64,
    /// Refractive index below the surface; above it is that of [`AIR`].
    pub ior: f64,
}

/// A ray from the air that meets the surface. Directions have unit length.
#[derive(Clone, Copy, Debug)]
pub struct Split {
    /// Share of the light that is reflected, for unpolarised light.
    pub reflectance: f64,
    /// Direction of the reflected ray.
    pub reflected: DVec3,
    /// Direction of the refracted ray.
    pub refracted: DVec3,
}

/// Where the ray between an eye and a point crosses the surface, with its derivatives.
#[derive(Clone, Copy, Debug)]
pub struct Crossing {
    /// The point q of the surface, scene units.
    pub at: DVec3,
    /// `h` and `z`.
    height: f64,
    depth: f64,
    /// From the foot of the eye to that of the point: `R` along the unit vector.
    along: DVec3,
    /// `r / R`.
    share: f64,
    /// Derivatives of `r` by `R`, `h` and `z`.
    slopes: [f64; 3],
}

/// A motion of the point and of the plane.
#[derive(Clone, Copy, Debug, Default)]
pub struct Motion {
    /// Of the point.
    pub point: DVec3,
    /// Of the normal, at right angles to it.
    pub normal: DVec3,
    /// Of the offset.
    pub offset: f64,
}

impl Surface {
    /// Signed distance of a point from the surface, scene units; positive in air.
    pub fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset
    }

    /// Range at which a ray from the air with this unit direction meets the surface; `None` for a ray that
    /// does not.
    pub fn meets(&self, origin: DVec3, direction: DVec3) -> Option<f64> {
        let falls = -self.normal.dot(direction);
        let range = self.height(origin) / falls;
        (falls > 1e-9 && range > 0.0).then_some(range)
    }

    /// Splits a ray from the air with this unit direction at the surface (WSGS eq. 8 and 9, exact Fresnel).
    pub fn split(&self, direction: DVec3) -> Split {
        let cos_i = -self.normal.dot(direction);
        // From air into a denser medium every ray has a refracted one.
        let refracted = refracted(direction, self.normal, AIR / self.ior).unwrap_or(direction);
        Split {
            reflectance: fresnel(cos_i, AIR, self.ior),
            reflected: direction + 2.0 * cos_i * self.normal,
            refracted,
        }
    }

    /// What a camera at `eye` sees where it would see `point` without the surface: the place at the same
    /// depth on the refracted ray. It is `point` itself if that is in air, or the surface is not between.
    pub fn seen_instead(&self, eye: DVec3, point: DVec3) -> DVec3 {
        let (along, depth) = ((point - eye).normalize(), -self.height(point));
        match self.meets(eye, along) {
            Some(range) if depth > 0.0 => {
                let bent = self.split(along).refracted;
                eye + range * along + depth / -bent.dot(self.normal) * bent
            }
            _ => point,
        }
    }

    /// Where the ray from `eye`, in air, to `point`, in the water, crosses the surface. `None` if they are
    /// not on these sides.
    pub fn crossing(&self, eye: DVec3, point: DVec3) -> Option<Crossing> {
        let (height, depth) = (self.height(eye), -self.height(point));
        let sides_are_right = height > 0.0 && depth > 0.0;
        if !sides_are_right {
            return None;
        }
        let across = (point - eye) + (height + depth) * self.normal;
        let far = across.length();
        // Along the normal every direction is as good as another.
        let is_above = far <= 1e-12 * (height + depth);
        let along = if is_above { self.normal.any_orthonormal_vector() } else { across / far };
        let far = if is_above { 0.0 } else { far };
        let ior = self.ior;
        // For small angles, r / R has this value.
        let paraxial = ior * height / (AIR * depth + ior * height);
        let (mut low, mut high) = (0.0, far);
        let mut r = paraxial * far;
        for _ in 0..ROUNDS {
            let (up, down) = (r.hypot(height), (far - r).hypot(depth));
            // Snell's law; it grows with r.
            let excess = AIR * r / up - ior * (far - r) / down;
            if excess < 0.0 {
                low = r
            } else {
                high = r
            }
            let slope = AIR * (height / up).powi(2) / up + ior * (depth / down).powi(2) / down;
            let newton = r - excess / slope;
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            let moved = (next - r).abs();
            r = next;
            if moved <= 1e-15 * far {
                break;
            }
        }
        let (up, down) = (r.hypot(height), (far - r).hypot(depth));
        let by_r = AIR * (height / up).powi(2) / up + ior * (depth / down).powi(2) / down;
        let by_far = -ior * (depth / down).powi(2) / down;
        let by_height = -AIR * r * height / up.powi(3);
        let by_depth = ior * (far - r) * depth / down.powi(3);
        Some(Crossing {
            at: eye - height * self.normal + r * along,
            height,
            depth,
            along,
            share: if far > 0.0 { r / far } else { paraxial },
            slopes: [by_far, by_height, by_depth].map(|by| -by / by_r),
        })
    }

    /// As [`Surface::crossing`], by halving an interval: slower, and right by its simplicity.
    #[cfg(test)]
    pub(crate) fn crossing_by_halving(&self, eye: DVec3, point: DVec3) -> DVec3 {
        let (height, depth) = (self.height(eye), -self.height(point));
        let across = (point - eye) + (height + depth) * self.normal;
        let far = across.length();
        let excess = |r: f64| AIR * r / r.hypot(height) - self.ior * (far - r) / (far - r).hypot(depth);
        let (mut low, mut high) = (0.0, far);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if excess(middle) < 0.0 { low = middle } else { high = middle }
        }
        eye - height * self.normal + across * (low / far.max(1e-300))
    }
}

impl Crossing {
    /// How far the crossing moves with the point and the plane, scene units: its derivative times `motion`,
    /// by implicit differentiation of Snell's law. `eye`, `point` and `surface` are those of the crossing.
    pub fn moved(&self, eye: DVec3, point: DVec3, surface: &Surface, motion: &Motion) -> DVec3 {
        let normal = surface.normal;
        let height = motion.normal.dot(eye) - motion.offset;
        let depth = motion.offset - motion.normal.dot(point) - normal.dot(motion.point);
        let across = motion.point + (height + depth) * normal + (self.height + self.depth) * motion.normal;
        let far = self.along.dot(across);
        let [by_far, by_height, by_depth] = self.slopes;
        let r = by_far * far + by_height * height + by_depth * depth;
        -height * normal - self.height * motion.normal
            + self.share * (across - far * self.along)
            + r * self.along
    }
}

/// Direction of a ray behind a surface (Snell; WSGS eq. 9). `direction` has unit length and meets the unit
/// `normal` from its side; `eta` is the index before the surface divided by that behind it. `None` under
/// total reflection.
pub fn refracted(direction: DVec3, normal: DVec3, eta: f64) -> Option<DVec3> {
    let cos_i = -normal.dot(direction);
    let cos_t_squared = 1.0 - eta * eta * (1.0 - cos_i * cos_i);
    (cos_t_squared >= 0.0)
        .then(|| (eta * direction + (eta * cos_i - cos_t_squared.sqrt()) * normal).normalize())
}

/// Share of unpolarised light that a surface reflects (Fresnel; Born and Wolf 1999, 1.5.2). `cos_i` is the
/// cosine of the angle to the normal on the side of index `before`. 1 under total reflection.
pub fn fresnel(cos_i: f64, before: f64, behind: f64) -> f64 {
    let eta = before / behind;
    let cos_t_squared = 1.0 - eta * eta * (1.0 - cos_i * cos_i);
    let is_split = cos_t_squared > 0.0;
    if !is_split {
        return 1.0;
    }
    let cos_t = cos_t_squared.sqrt();
    let parallel = (behind * cos_i - before * cos_t) / (behind * cos_i + before * cos_t);
    let across = (before * cos_i - behind * cos_t) / (before * cos_i + behind * cos_t);
    0.5 * (parallel * parallel + across * across)
}

/// Schlick's approximation of [`fresnel`] into a denser medium (1994; WSGS eq. 10). For water it is at most
/// .0095 off up to 70 degrees, .050 off at 80 and never more than .060.
pub fn schlick(cos_i: f64, before: f64, behind: f64) -> f64 {
    let ahead = ((before - behind) / (before + behind)).powi(2);
    ahead + (1.0 - ahead) * (1.0 - cos_i).powi(5)
}

#[cfg(test)]
#[path = "optics_tests.rs"]
mod tests;
