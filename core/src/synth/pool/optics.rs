//! A flat surface between air and water: Fresnel, Snell, and where a ray between two points crosses it.

use glam::DVec3;

use super::super::geometry::Ray;

/// Refractive index of air.
pub(super) const AIR: f64 = 1.000_293;
/// Halvings of an interval of metres: to less than a billionth of a millimetre.
const HALVINGS: u32 = 60;

/// The surface y = `y`, with air above it (smaller y).
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    pub y: f64,
    /// Refractive index below it.
    pub ior: f64,
}

/// A ray from air that meets the surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Split {
    /// Share of the light that is reflected, for unpolarised light.
    pub reflectance: f64,
    pub reflected: Ray,
    pub refracted: Ray,
}

impl Surface {
    /// Where a ray from the air meets it; `None` for a ray that does not.
    pub fn meets(&self, ray: &Ray) -> Option<f64> {
        let range = (self.y - ray.origin.y) / ray.direction.y;
        (ray.direction.y > 1e-9 && range > 0.0).then_some(range)
    }

    /// Splits a ray that meets the surface at `range`.
    pub fn split(&self, ray: &Ray, range: f64) -> Split {
        let (d, origin) = (ray.direction, ray.origin + ray.direction * range);
        let eta = AIR / self.ior;
        let cos_i = d.y;
        // From air into a denser medium every ray has a refracted one.
        let cos_t = (1.0 - eta * eta * (1.0 - cos_i * cos_i)).max(0.0).sqrt();
        let refracted = DVec3::new(eta * d.x, cos_t, eta * d.z);
        let parallel = (self.ior * cos_i - AIR * cos_t) / (self.ior * cos_i + AIR * cos_t);
        let across = (AIR * cos_i - self.ior * cos_t) / (AIR * cos_i + self.ior * cos_t);
        Split {
            reflectance: 0.5 * (parallel * parallel + across * across),
            reflected: Ray { origin, direction: DVec3::new(d.x, -d.y, d.z) },
            refracted: Ray { origin, direction: refracted.normalize() },
        }
    }

    /// The point of the surface through which `eye`, above it, sees `point`, below it.
    pub fn crossing(&self, eye: DVec3, point: DVec3) -> DVec3 {
        let (height, depth) = (self.y - eye.y, point.y - self.y);
        let across = DVec3::new(point.x - eye.x, 0.0, point.z - eye.z);
        let far = across.length();
        if far < 1e-12 {
            return DVec3::new(eye.x, self.y, eye.z);
        }
        // Snell's law; it grows with the distance from the foot of the eye.
        let excess = |r: f64| AIR * r / r.hypot(height) - self.ior * (far - r) / (far - r).hypot(depth);
        let (mut low, mut high) = (0.0, far);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if excess(middle) < 0.0 { low = middle } else { high = middle }
        }
        let foot = DVec3::new(eye.x, self.y, eye.z);
        foot + across * (0.5 * (low + high) / far)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WATER: Surface = Surface { y: 0.4, ior: 1.333 };

    fn ray(angle: f64) -> Ray {
        Ray { origin: DVec3::new(0.3, -1.0, 0.1), direction: DVec3::new(angle.sin(), angle.cos(), 0.0) }
    }

    #[test]
    fn the_reflectance_is_that_of_the_books() {
        let at = |degrees: f64| {
            let ray = ray(degrees.to_radians());
            WATER.split(&ray, WATER.meets(&ray).unwrap()).reflectance
        };
        // ((n2 - n1) / (n2 + n1))^2 for a ray along the normal, and the values for water of Hecht, 4.6.
        assert!((at(0.0) - ((1.333 - AIR) / (1.333 + AIR)).powi(2)).abs() < 1e-12);
        assert!((at(45.0) - 0.028).abs() < 1e-3, "{}", at(45.0));
        assert!((at(80.0) - 0.348).abs() < 2e-3, "{}", at(80.0));
        assert!(at(89.99) > 0.99);
    }

    #[test]
    fn a_refracted_ray_follows_snell_and_a_reflected_one_the_mirror() {
        let ray = ray(0.9);
        let split = WATER.split(&ray, WATER.meets(&ray).unwrap());
        assert!((split.reflected.origin.y - WATER.y).abs() < 1e-12);
        assert!((AIR * 0.9_f64.sin() - WATER.ior * split.refracted.direction.x).abs() < 1e-12);
        assert!((split.refracted.direction.length() - 1.0).abs() < 1e-12);
        assert_eq!(split.reflected.direction, DVec3::new(ray.direction.x, -ray.direction.y, 0.0));
        assert!(WATER.meets(&Ray { direction: -ray.direction, ..ray }).is_none(), "it looks up");
        // Without a change of the index nothing bends and nothing is reflected.
        let air = Surface { ior: AIR, ..WATER }.split(&ray, WATER.meets(&ray).unwrap());
        assert!(air.reflectance < 1e-20 && (air.refracted.direction - ray.direction).length() < 1e-12);
    }

    #[test]
    fn an_eye_sees_a_point_where_its_refracted_ray_passes() {
        let eye = DVec3::new(0.3, -1.0, 0.1);
        for point in [DVec3::new(1.7, 1.1, -0.9), DVec3::new(0.3, 0.9, 0.1), DVec3::new(9.0, 0.41, 3.0)] {
            let crossing = WATER.crossing(eye, point);
            assert!((crossing.y - WATER.y).abs() < 1e-12);
            let ray = Ray { origin: eye, direction: (crossing - eye).normalize() };
            let Ray { origin, direction } = WATER.split(&ray, WATER.meets(&ray).unwrap()).refracted;
            let at = origin + direction * ((point.y - origin.y) / direction.y);
            assert!((at - point).length() < 1e-6, "{at} instead of {point}");
        }
    }
}
