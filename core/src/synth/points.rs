//! Sparse points like those of structure from motion. They are on surfaces, seen by at least two views, with
//! an error of a fraction of a pixel and the colour of the photographs.

use glam::DVec3;
use rayon::prelude::*;

use super::geometry::{Ray, World};
use super::{Photograph, SynthOptions, pixel_ray};
use crate::rng::{Stream, random_bits, uniform};
use crate::scene::{PinholeCamera, Pose};

/// Error of a point across the line of sight, pixels, one standard deviation.
pub(super) const ERROR_PX: f64 = 0.3;

/// One point and its observations.
pub(super) struct SparsePoint {
    pub position: DVec3,
    pub colour: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error_px: f64,
    /// View index, pixel.
    pub track: Vec<(u32, [f64; 2])>,
}

pub(super) fn sparse_points(
    world: &World,
    camera: &PinholeCamera,
    poses: &[Pose],
    photographs: &[Photograph],
    options: &SynthOptions,
) -> Vec<SparsePoint> {
    let SynthOptions { seed, points_per_view, .. } = *options;
    (0..poses.len() as u32 * points_per_view)
        .into_par_iter()
        .filter_map(|candidate| {
            let view = candidate / points_per_view;
            let pose = &poses[view as usize];
            let random = random_bits(seed, Stream::Synth, 20_000 + view, candidate % points_per_view)
                .map(|b| f64::from(uniform(b)));
            let pixel = [random[0] * f64::from(camera.width), random[1] * f64::from(camera.height)];
            let ray = Ray { origin: pose.centre(), direction: pixel_ray(camera, pose, pixel) };
            // A detector finds no features on a constant colour.
            let hit = world.hit(&ray, 60.0).filter(|hit| !hit.material.is_smooth())?;
            let surface = ray.origin + ray.direction * hit.range;
            let track: Vec<_> = (0_u32..)
                .zip(poses)
                .filter_map(|(other, pose)| {
                    let pixel = project(camera, pose, surface)?;
                    // A detector finds no features at grazing angles.
                    let way = (pose.centre() - surface).normalize();
                    (hit.normal.dot(way) > 0.2 && world.sees(pose.centre(), surface))
                        .then_some((other, pixel))
                })
                .collect();
            if track.len() < 2 {
                return None;
            }
            let sum = track.iter().fold([0_u32; 3], |mut sum, (view, pixel)| {
                let photograph = &photographs[*view as usize].pixels;
                let colour = photograph.get_pixel(pixel[0] as u32, pixel[1] as u32);
                (0..3).for_each(|c| sum[c] += u32::from(colour[c]));
                sum
            });
            let colour = sum.map(|s| ((s as f64 / track.len() as f64).round()) as u8);
            let spread = ERROR_PX * hit.range / camera.fx;
            let error = super::normal_numbers(seed, 30_000 + view, candidate % points_per_view);
            // The mean reprojection error that follows from the points' noise.
            Some(SparsePoint { position: surface + error * spread, colour, error_px: ERROR_PX, track })
        })
        .collect()
}

/// Pixel of a world point, if it is in the picture and at least two pixels from its rim.
pub(super) fn project(camera: &PinholeCamera, pose: &Pose, point: DVec3) -> Option<[f64; 2]> {
    let p = pose.transform(point);
    if p.z < 0.1 {
        return None;
    }
    let pixel = [camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy];
    let inside = |v: f64, size: u32| v >= 2.0 && v < f64::from(size) - 2.0;
    (inside(pixel[0], camera.width) && inside(pixel[1], camera.height)).then_some(pixel)
}
