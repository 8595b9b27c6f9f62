//! Sparse points as structure from motion gives them for a pool. It knows nothing of the surface, so it
//! triangulates all pixels by straight rays: points in the water come out too high, with larger errors.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::super::geometry::{Ray, World};
use super::super::points::{ERROR_PX, SparsePoint, project};
use super::super::{normal_numbers, pixel_ray};
use super::{Photograph, PoolOptions, Water};
use crate::rng::{Stream, random_bits, uniform};
use crate::scene::{PinholeCamera, Pose};

/// Views that see a point in the water at least, so that its triangulation has an error.
const LEAST_VIEWS: usize = 3;
/// Views of a track at most.
const MOST_VIEWS: usize = 8;
/// A detector finds no features of the ground where the surface reflects more than this.
const MOST_REFLECTED: f64 = 0.5;

/// The points; `photographs` give their colours.
pub(super) fn sparse_points(
    world: &World,
    water: &Water,
    camera: &PinholeCamera,
    poses: &[Pose],
    photographs: &[Photograph],
    options: &PoolOptions,
) -> Vec<SparsePoint> {
    let PoolOptions { seed, points_per_view, .. } = *options;
    let one = |candidate: u32| {
        let (view, index) = (candidate / points_per_view, candidate % points_per_view);
        let pose = &poses[view as usize];
        let random = random_bits(seed, Stream::Synth, 20_000 + view, index).map(|b| f64::from(uniform(b)));
        let pixel = [random[0] * f64::from(camera.width), random[1] * f64::from(camera.height)];
        let ray = Ray { origin: pose.centre(), direction: pixel_ray(camera, pose, pixel) };
        let (point, is_wet) = found(world, water, &ray)?;
        let pixels = (0_u32..).zip(poses).filter_map(|(other, pose)| {
            Some((
                other,
                if is_wet {
                    refracted(world, water, camera, pose, point)?
                } else {
                    dry(world, water, camera, pose, point)?
                },
            ))
        });
        let all: Vec<(u32, [f64; 2])> = pixels.collect();
        if all.len() < LEAST_VIEWS {
            return None;
        }
        let step = all.len().div_ceil(MOST_VIEWS);
        let mut track: Vec<(u32, [f64; 2])> =
            all.into_iter().skip(index as usize % step).step_by(step).collect();
        if track.len() < LEAST_VIEWS {
            return None;
        }
        for (view, pixel) in &mut track {
            let error = normal_numbers(seed, 60_000 + *view, candidate);
            pixel[0] += ERROR_PX * error.x;
            pixel[1] += ERROR_PX * error.y;
        }
        let (position, error_px) = triangulated(camera, poses, &track)?;
        Some(SparsePoint { position, colour: colour_of(photographs, &track), error_px, track })
    };
    (0..poses.len() as u32 * points_per_view).into_par_iter().filter_map(one).collect()
}

/// The surface point that a detector finds along a ray, and whether it is seen through the water.
fn found(world: &World, water: &Water, ray: &Ray) -> Option<(DVec3, bool)> {
    let end = |ray: &Ray| world.hit(ray, 30.0).map(|hit| (hit.range, ray.origin + ray.direction * hit.range));
    let hit = end(ray);
    let meets = water.meets(ray).filter(|&(range, _)| hit.is_none_or(|(nearest, _)| range < nearest));
    match meets {
        None => hit.map(|(_, point)| (point, false)),
        Some((_, origin)) => {
            let split = water.surface.split(ray.direction);
            if split.reflectance > MOST_REFLECTED {
                return None;
            }
            end(&Ray { origin, direction: split.refracted }).map(|(_, point)| (point, true))
        }
    }
}

/// Where a camera sees a point through the water, if it does.
fn refracted(
    world: &World,
    water: &Water,
    camera: &PinholeCamera,
    pose: &Pose,
    point: DVec3,
) -> Option<[f64; 2]> {
    let eye = pose.centre();
    let crossing = water.surface.crossing(eye, point)?.at;
    let pixel = project(camera, pose, crossing)?;
    let is_clear = water.basin.holds(crossing) && world.sees(eye, crossing) && world.sees(crossing, point);
    let reflectance = water.surface.split((crossing - eye).normalize()).reflectance;
    (is_clear && reflectance <= MOST_REFLECTED).then_some(pixel)
}

/// Where a camera sees a point in air, if it does.
fn dry(world: &World, water: &Water, camera: &PinholeCamera, pose: &Pose, point: DVec3) -> Option<[f64; 2]> {
    let eye = pose.centre();
    let pixel = project(camera, pose, point)?;
    (water.surface.height(point) > 0.0 && world.sees(eye, point)).then_some(pixel)
}

/// The point with the least squares of distances from the straight rays of its track, refined once by the
/// squares in pixels, and its mean reprojection error, pixels. `None` if the rays are almost parallel.
fn triangulated(camera: &PinholeCamera, poses: &[Pose], track: &[(u32, [f64; 2])]) -> Option<(DVec3, f64)> {
    let mut point: Option<DVec3> = None;
    // The second time, each ray counts by the inverse of its range: a pixel is smaller nearby.
    for _ in 0..2 {
        let (mut left, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for &(view, pixel) in track {
            let pose = &poses[view as usize];
            let (eye, d) = (pose.centre(), pixel_ray(camera, pose, pixel));
            let weight = point.map_or(1.0, |point| 1.0 / (point - eye).length_squared());
            let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            left += across * weight;
            right += across * eye * weight;
        }
        if left.determinant() < 1e-9 {
            return None;
        }
        point = Some(left.inverse() * right);
    }
    let point = point?;
    let errors = track.iter().map(|&(view, pixel)| {
        let p = poses[view as usize].transform(point);
        (camera.fx * p.x / p.z + camera.cx - pixel[0]).hypot(camera.fy * p.y / p.z + camera.cy - pixel[1])
    });
    Some((point, errors.sum::<f64>() / track.len() as f64))
}

/// The mean colour of the photographs at a track.
fn colour_of(photographs: &[Photograph], track: &[(u32, [f64; 2])]) -> [u8; 3] {
    let mut sum = [0_u32; 3];
    for &(view, [x, y]) in track {
        let pixels = &photographs[view as usize].pixels;
        let at = |v: f64, size: u32| v.clamp(0.0, f64::from(size - 1)) as u32;
        let colour = pixels.get_pixel(at(x, pixels.width()), at(y, pixels.height()));
        (0..3).for_each(|c| sum[c] += u32::from(colour[c]));
    }
    sum.map(|sum| (f64::from(sum) / track.len() as f64).round() as u8)
}
