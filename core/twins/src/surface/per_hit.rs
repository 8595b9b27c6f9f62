//! Disks traced without tiles and without an order of their centres: what the kernels approximate.

use glam::{DVec2, DVec3};

use super::Sight;
use crate::disks::{contribution, pixel_at};
use crate::{Disk, DiskRay, RasterRules};
use fathom_core::scene::PinholeCamera;

/// Colours over the background, `[H*W]`. Every ray blends the disks in the order in which it meets them. One
/// of which it sees only the low-pass counts as met beside its centre.
pub fn trace_per_hit(
    disks: &[Option<Disk>],
    rays: &[DiskRay],
    width: u32,
    background: [f64; 3],
    rules: &RasterRules,
) -> Vec<[f64; 3]> {
    let of_ray = |(i, ray): (usize, &DiskRay)| {
        let (x, y) = (i as u32 % width, i as u32 / width);
        let met = disks.iter().flatten().filter_map(|disk| {
            let at = contribution(disk, pixel_at(x, y), ray, rules)?;
            let beside = (disk.centre - ray.origin).dot(ray.direction) / ray.direction.length_squared();
            Some((at.hit.map_or(beside, |(_, _, t)| t), at.alpha, disk.bound.rgb))
        });
        let mut met: Vec<_> = met.collect();
        met.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut rgb, mut left) = (DVec3::ZERO, 1.0);
        for (_, alpha, colour) in met {
            let next = left * (1.0 - alpha);
            if next < rules.min_transmittance {
                break;
            }
            rgb += left * alpha * DVec3::from(colour);
            left = next;
        }
        (rgb + left * DVec3::from(background)).into()
    };
    rays.iter().enumerate().map(of_ray).collect()
}

/// Points of the outline of a refracted disk of radius `reach` (in standard deviations), in pixels from where
/// its centre appears.
pub fn refracted_outline(
    disk: &Disk,
    sight: &Sight,
    camera: &PinholeCamera,
    reach: f64,
    points: u32,
) -> Vec<[f64; 2]> {
    let half = disk.axes.map(|axis| axis / axis.length_squared());
    let focal = DVec2::new(camera.fx, camera.fy);
    let centre = DVec2::from(disk.centre2d) - DVec2::new(camera.cx, camera.cy);
    let point = |i: u32| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(points)).sin_cos();
        let q = sight.apparent(disk.centre + reach * (cos * half[0] + sin * half[1]))?;
        Some((focal * q.truncate() / q.z - centre).into())
    };
    (0..points).filter_map(point).collect()
}
