//! The point of a track, by straight rays and by rays that a plane refracts: least squares in pixels.

use glam::{DMat3, DVec3};

use super::sightings::{Eye, MOST_VIEWS, Sight, Track};
use crate::surface::optics::{AIR, Motion, Surface, refracted};

/// Gauss-Newton steps, at most. Points close to a start by rays; three are usual.
const ROUNDS: u32 = 8;
/// A step that moves no pixel by more than about this ends the search.
const SETTLED_PX: f64 = 1e-5;
/// Rays that fall less steeply than this are not refracted: the crossing would be determined too badly.
const LEAST_FALL: f64 = 1e-3;

/// A triangulated point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    pub position: DVec3,
    /// Sum of the squared residuals, square pixels.
    pub squares: f64,
}

/// Residuals and derivatives of a track at one position.
#[derive(Clone, Copy, Debug)]
struct Normal {
    squares: f64,
    hessian: DMat3,
    gradient: DVec3,
}

impl Normal {
    // Not by default, which is the identity for matrices of glam.
    const ZERO: Self = Self { squares: 0.0, hessian: DMat3::ZERO, gradient: DVec3::ZERO };

    fn add(&mut self, residual: f64, slope: DVec3) {
        self.squares += residual * residual;
        self.hessian += outer(slope, slope);
        self.gradient += slope * residual;
    }
}

/// Error of a pixel along an axis, pixels: the root of the squares by degrees of freedom.
pub(super) fn error_px(squares: f64, sights: usize) -> f64 {
    (squares / freedom(sights)).sqrt()
}

/// Equations of a track beyond its three unknowns.
pub(super) fn freedom(sights: usize) -> f64 {
    2.0 * sights as f64 - 3.0
}

/// `a` times the transpose of `b`.
pub(super) fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// The point with the least squares of distances from lines, each with a weight. `None` if they are almost
/// parallel.
pub(super) fn nearest(lines: impl Iterator<Item = (DVec3, DVec3, f64)>) -> Option<DVec3> {
    let (mut left, mut right, mut sum) = (DMat3::ZERO, DVec3::ZERO, 0.0);
    for (origin, direction, weight) in lines {
        let across = DMat3::IDENTITY - outer(direction, direction);
        left += across * weight;
        right += across * origin * weight;
        sum += weight;
    }
    let is_sound = left.determinant() > 1e-9 * sum * sum * sum;
    is_sound.then(|| left.inverse() * right)
}

/// Minimises the squares from a start. `at` gives them with their derivatives, and `None` where a position is
/// impossible.
fn least_squares(start: DVec3, at: impl Fn(DVec3) -> Option<Normal>) -> Option<Found> {
    let mut position = start;
    let mut normal = at(position)?;
    for _ in 0..ROUNDS {
        let step = -(normal.hessian.inverse() * normal.gradient);
        if !step.is_finite() {
            return None;
        }
        // What the step promises, in square pixels.
        let promised = -step.dot(normal.gradient);
        if promised < SETTLED_PX * SETTLED_PX {
            break;
        }
        let mut scale = 1.0;
        let mut next = None;
        while scale > 0.05 && next.is_none() {
            let tried = position + scale * step;
            next = at(tried).filter(|next| next.squares <= normal.squares).map(|next| (tried, next));
            scale *= 0.25;
        }
        // A point at the edge of what is possible, such as the surface, is no minimum.
        let (moved, found) = next?;
        (position, normal) = (moved, found);
    }
    Some(Found { position, squares: normal.squares })
}

pub(super) fn by_straight_rays(eyes: &[Eye], sights: &[Sight]) -> Option<Found> {
    let lines = |weight: &dyn Fn(&Eye) -> f64| {
        nearest(sights.iter().map(|sight| {
            let eye = &eyes[sight.eye as usize];
            (eye.centre, sight.direction, weight(eye))
        }))
    };
    // The second time, each ray counts by the inverse of its range: a pixel is smaller nearby.
    let first = lines(&|_| 1.0)?;
    let start = lines(&|eye| 1.0 / (first - eye.centre).length_squared())?;
    least_squares(start, |position| {
        let mut normal = Normal::ZERO;
        for sight in sights {
            let (pixel, slopes) = eyes[sight.eye as usize].project(position)?;
            (0..2).for_each(|k| normal.add(pixel[k] - sight.pixel[k], slopes[k]));
        }
        Some(normal)
    })
}

/// A ray under the surface: where it begins, its unit direction, and the length of its ray in air.
pub(super) fn below(eye: &Eye, sight: &Sight, surface: &Surface) -> Option<(DVec3, DVec3, f64)> {
    let falls = -surface.normal.dot(sight.direction);
    let range = surface.meets(eye.centre, sight.direction).filter(|_| falls > LEAST_FALL)?;
    let direction = refracted(sight.direction, surface.normal, AIR / surface.ior)?;
    Some((eye.centre + range * sight.direction, direction, range))
}

/// The place of a track in the water; `None` if it is not there under this plane. `start` is a position near
/// it, if one is known.
pub(super) fn by_refracted_rays(
    eyes: &[Eye],
    track: &Track,
    surface: &Surface,
    start: Option<DVec3>,
) -> Option<Found> {
    let start = match start {
        Some(start) => start,
        None => start_of(eyes, track, surface)?.0,
    };
    least_squares(start, |position| {
        let mut normal = Normal::ZERO;
        for sight in &track.sights {
            let eye = &eyes[sight.eye as usize];
            let crossing = surface.crossing(eye.centre, position)?;
            let (pixel, slopes) = eye.project(crossing.at)?;
            let moved = [DVec3::X, DVec3::Y, DVec3::Z].map(|point| {
                crossing.moved(eye.centre, position, surface, &Motion { point, ..Motion::default() })
            });
            for k in 0..2 {
                let slope = DVec3::from(moved.map(|moved| slopes[k].dot(moved)));
                normal.add(pixel[k] - sight.pixel[k], slope);
            }
        }
        Some(normal)
    })
}

/// The point nearest to the refracted rays of a track, and about its squared residuals in pixels. `None` if
/// it is not in the water.
pub(super) fn start_of(eyes: &[Eye], track: &Track, surface: &Surface) -> Option<(DVec3, f64)> {
    let mut rays = [(DVec3::ZERO, DVec3::ZERO, 0.0); MOST_VIEWS];
    for (ray, sight) in rays.iter_mut().zip(&track.sights) {
        *ray = below(&eyes[sight.eye as usize], sight, surface)?;
    }
    let rays = &rays[..track.sights.len().min(MOST_VIEWS)];
    let point = nearest(rays.iter().map(|(origin, direction, range)| {
        // A pixel is smaller nearby; what matters is the part in air and in water.
        (*origin, *direction, 1.0 / (range + (track.straight.position - *origin).length()).powi(2))
    }))?;
    let is_wet = surface.height(point) < 0.0;
    if !is_wet {
        return None;
    }
    let mut squares = 0.0;
    for ((origin, direction, range), sight) in rays.iter().zip(&track.sights) {
        let to_point = point - *origin;
        let along = to_point.dot(*direction);
        let apart = (to_point - along * *direction).length();
        let focal = eyes[sight.eye as usize].focal[0];
        squares += (focal * apart / (range + along.max(0.0) * AIR / surface.ior)).powi(2);
    }
    Some((point, squares))
}
