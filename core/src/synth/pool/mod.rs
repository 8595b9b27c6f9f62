//! A pool seen through its surface, with exact ground truth: rays split at a flat surface into a reflected
//! and a refracted one (Fresnel, Snell). The water is clear.
//!
//! Image formation per channel, linear light: `I = F R + (1 - F) T` where a pixel's ray meets the water. `R`
//! is the radiance that the reflected ray meets, `T` that the refracted ray meets, and `F` the reflectance of
//! unpolarised light. Elsewhere `I` is the radiance of what the ray meets.
//!
//! The folder holds `images/` and `sparse/0/` as the other scenes, and in `truth/`, of the held-out views:
//! - `dry/`, `oil/`: the photograph without the surface, and with one of index [`OIL`] above it;
//! - `reflected/`, `refracted/`: R and T, black where no ray of a pixel meets the water;
//! - `region/`: white where all rays of a pixel meet the water;
//! - `depth_m.npz`: z-depth without the surface, as for the other scenes;
//! - `surface.json`: plane and index.
//!
//! Pictures are 8-bit sRGB without noise.

mod hall;
mod points;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::DVec3;
use image::{GrayImage, Luma, RgbImage};
use rayon::prelude::*;

use super::geometry::{Ray, World};
use super::{
    NOISE, SynthSummary, TRUTH_EVERY, depth_map, encode, files, normal_numbers, pixel_ray, survey, unwritable,
};
use crate::rng::{Stream, uniform_at};
use crate::scene::{PinholeCamera, Pose};
use crate::surface::{AIR, Surface};
use crate::{CoreError, Result};
use hall::Basin;

/// Refractive index of the `oil` truth.
pub const OIL: f64 = 1.46;
/// Rays per pixel: the points of Hammersley. No two share a column or a row, so an edge along an axis covers
/// a pixel in steps of a 16th. With 2x2 rays, exact pictures were only 36 dB from the photographs.
const RAYS: u32 = 16;
/// Rings of cameras around a middle: height above the water and distance from the middle, metres.
const RINGS: [[f64; 2]; 3] = [[0.8, 1.7], [1.3, 1.5], [1.9, 1.15]];
/// Length of basin that one middle serves, metres.
const MIDDLES_APART: f64 = 2.0;
/// Pictures of the truth.
const TRUTH: [&str; 4] = ["dry", "oil", "reflected", "refracted"];

/// Options of a pool.
#[derive(Clone, Debug, PartialEq)]
pub struct PoolOptions {
    /// Seed of the textures, of loose objects, of the cameras and of the noise.
    pub seed: u32,
    /// Number of photographs.
    pub views: u32,
    /// Columns of a photograph.
    pub width: u32,
    /// Rows of a photograph.
    pub height: u32,
    /// Pixels of each photograph where a sparse point is tried. Fewer become points.
    pub points_per_view: u32,
    /// Length of the basin, metres; it is 2 metres wide.
    pub length: f64,
    /// Depth of the water, metres.
    pub depth: f64,
    /// Refractive index of the water; that of air is 1.000293.
    pub ior: f64,
}

impl Default for PoolOptions {
    fn default() -> Self {
        Self {
            seed: 1,
            views: 72,
            width: 240,
            height: 180,
            points_per_view: 90,
            length: 2.0,
            depth: 0.8,
            ior: 1.333,
        }
    }
}

impl PoolOptions {
    fn validate(&self) -> Result<()> {
        super::validate_sizes(self.views, self.width, self.height, self.points_per_view)?;
        if !(2.0..=20.0).contains(&self.length) {
            return Err(CoreError::Config(format!("--length is {}; it must be 2 to 20 metres", self.length)));
        }
        if !(0.3..=5.0).contains(&self.depth) {
            return Err(CoreError::Config(format!("--depth is {}; it must be 0.3 to 5 metres", self.depth)));
        }
        if !(1.05..=2.5).contains(&self.ior) {
            return Err(CoreError::Config(format!(
                "--ior is {}; it must be 1.05 to 2.5, where water has 1.333",
                self.ior
            )));
        }
        Ok(())
    }

    fn water(&self) -> Water {
        let surface = Surface { normal: DVec3::NEG_Y, offset: -hall::SURFACE_Y, ior: self.ior };
        Water { surface, basin: Basin::new(self.length, self.depth) }
    }
}

/// Generates a pool in the folder `out`, which must not hold a scene; `progress(done, all)` counts
/// photographs. Every pixel is a pure function of the options.
///
/// # Errors
/// When the options are invalid, when `out` already holds a scene, or when it cannot be written.
pub fn synthesise_pool(
    out: &Path,
    options: &PoolOptions,
    progress: impl Fn(u32, u32) + Sync,
) -> Result<SynthSummary> {
    options.validate()?;
    let maps = TRUTH.iter().chain(&["region"]).map(|name| format!("truth/{name}"));
    super::new_folders(out, maps)?;
    let water = options.water();
    let world = hall::build(&water.basin, options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = poses(options);
    let names: Vec<String> = (1..=poses.len()).map(|n| format!("v{n:04}.png")).collect();
    let done = AtomicU32::new(0);
    let take = |view: usize| {
        let photograph = Photograph::take(&world, &water, &camera, &poses[view], view, options);
        let save = |folder: &str, picture: &RgbImage| {
            let path = out.join(folder).join(&names[view]);
            picture.save(&path).map_err(|error| unwritable(&path, &error))
        };
        save("images", &photograph.pixels)?;
        if let Some(truth) = &photograph.truth {
            for (name, picture) in TRUTH.iter().zip(&truth.pictures) {
                save(&format!("truth/{name}"), picture)?;
            }
            let path = out.join("truth/region").join(&names[view]);
            truth.region.save(&path).map_err(|error| unwritable(&path, &error))?;
        }
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, options.views);
        Ok(photograph)
    };
    let photographs = (0..poses.len()).into_par_iter().map(take).collect::<Result<Vec<_>>>()?;
    let points = points::sparse_points(&world, &water, &camera, &poses, &photographs, options);
    files::write_colmap(&out.join("sparse/0"), &camera, &names, &poses, &points)?;
    let depths: Vec<_> = (0..poses.len())
        .into_par_iter()
        .filter(|view| view.is_multiple_of(TRUTH_EVERY))
        .map(|view| (format!("v{:04}", view + 1), depth_map(&world, &camera, &poses[view])))
        .collect();
    files::write_npz(&out.join("truth/depth_m.npz"), options.width, options.height, &depths)?;
    files::write(&out.join("truth/surface.json"), surface_json(&water).as_bytes())?;
    Ok(SynthSummary { views: options.views, truth_views: depths.len() as u32, points: points.len() as u32 })
}

fn surface_json(Water { surface, basin }: &Water) -> String {
    let [x, z] = basin.half;
    let values = serde_json::json!({
        "image_formation": "I = F*R + (1-F)*T where a ray meets the water, linear light; F: Fresnel, unpolarised",
        "normal": surface.normal.to_array(),
        // Of the plane normal . x = offset, scene axes; the normal points into the air.
        "offset": surface.offset,
        "ior": surface.ior,
        "ior_of_air": AIR,
        "ior_of_oil": OIL,
        "half_size": [x, z],
        "metres_per_unit": 1.0,
        "test_views": "sorted names, index % 8 == 0; truth/ has the maps of exactly these",
        "noise": format!("sigma {NOISE}*sqrt(I) in linear light, then 8-bit PNG"),
    });
    format!("{values:#}\n")
}

/// Cameras in rings around the middles of the pool, looking down into it. The first photographs are those
/// around the first middle, and so on.
fn poses(options: &PoolOptions) -> Vec<Pose> {
    let PoolOptions { seed, views, length, .. } = *options;
    let random = |view: u32, k: u32| f64::from(uniform_at(seed, Stream::Synth, 10_000 + view, k)) - 0.5;
    let rings = RINGS.len() as u32;
    let middles = (length / MIDDLES_APART).round().max(1.0) as u32;
    let first_of = |middle: u32| (u64::from(views) * u64::from(middle) / u64::from(middles)) as u32;
    let pose = |middle: u32, view: u32| {
        let (first, end) = (first_of(middle), first_of(middle + 1));
        let along = length * ((f64::from(middle) + 0.5) / f64::from(middles) - 0.5);
        // Neighbours in the list are in different rings, so that each ring has views of the truth.
        let ([height, distance], step) = (RINGS[(view % rings) as usize], (view - first) / rings);
        let steps = (end - first).div_ceil(rings);
        let angle = std::f64::consts::TAU
            * (f64::from(step) + f64::from(view % rings) / f64::from(rings) + 0.4 * random(view, 0))
            / f64::from(steps);
        let eye = DVec3::new(
            along + distance * angle.cos(),
            hall::SURFACE_Y - height + 0.1 * random(view, 1),
            distance * angle.sin(),
        );
        let target = DVec3::new(along + 0.5 * random(view, 2), 0.3, 0.5 * random(view, 3));
        Pose::looking_at(eye, target, DVec3::Y)
    };
    (0..middles)
        .flat_map(|middle| (first_of(middle)..first_of(middle + 1)).map(move |view| (middle, view)))
        .map(|(middle, view)| pose(middle, view))
        .collect()
}

/// One view: the output of the sensor, and of a held-out view its ground truth.
struct Photograph {
    pixels: RgbImage,
    truth: Option<HeldOutMaps>,
}

struct HeldOutMaps {
    /// As [`TRUTH`].
    pictures: [RgbImage; 4],
    region: GrayImage,
}

/// What a ray shows: as photographed, and as [`TRUTH`].
struct Shown {
    seen: DVec3,
    truth: [DVec3; 4],
    is_wet: bool,
}

/// The water in its basin.
struct Water {
    surface: Surface,
    basin: Basin,
}

impl Water {
    /// Where a ray from the air meets the water: range and place.
    fn meets(&self, ray: &Ray) -> Option<(f64, DVec3)> {
        let range = self.surface.meets(ray.origin, ray.direction)?;
        let place = ray.origin + ray.direction * range;
        self.basin.holds(place).then_some((range, place))
    }
}

fn shown(world: &World, water: &Water, ray: &Ray, seed: u32) -> Shown {
    let hit = world.hit(ray, 30.0);
    let dry = hit.as_ref().map_or(DVec3::ZERO, |hit| hall::radiance(hit, seed));
    let meets = water.meets(ray).filter(|&(range, _)| hit.is_none_or(|hit| range < hit.range));
    let Some((_, origin)) = meets else {
        return Shown { seen: dry, truth: [dry, dry, DVec3::ZERO, DVec3::ZERO], is_wet: false };
    };
    let under = |surface: &Surface| {
        let split = surface.split(ray.direction);
        let seen = |direction: DVec3| hall::seen(world, &Ray { origin, direction }, seed);
        let (reflected, refracted) = (seen(split.reflected), seen(split.refracted));
        let seen = split.reflectance * reflected + (1.0 - split.reflectance) * refracted;
        (seen, reflected, refracted)
    };
    let (seen, reflected, refracted) = under(&water.surface);
    let (oil, ..) = under(&Surface { ior: OIL, ..water.surface });
    Shown { seen, truth: [dry, oil, reflected, refracted], is_wet: true }
}

impl Photograph {
    fn take(
        world: &World,
        water: &Water,
        camera: &PinholeCamera,
        pose: &Pose,
        view: usize,
        options: &PoolOptions,
    ) -> Self {
        let (width, height) = (camera.width, camera.height);
        let picture = || RgbImage::new(width, height);
        let mut pixels = picture();
        let mut truth = HeldOutMaps {
            pictures: std::array::from_fn(|_| picture()),
            region: GrayImage::new(width, height),
        };
        let origin = pose.centre();
        for y in 0..height {
            for x in 0..width {
                let (mut seen, mut sums, mut wet) = (DVec3::ZERO, [DVec3::ZERO; 4], 0);
                for sub in 0..RAYS {
                    let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(RAYS);
                    let mirrored = sub.reverse_bits() >> (32 - RAYS.ilog2());
                    let pixel = [f64::from(x) + offset(sub), f64::from(y) + offset(mirrored)];
                    let ray = Ray { origin, direction: pixel_ray(camera, pose, pixel) };
                    let shown = shown(world, water, &ray, options.seed);
                    seen += shown.seen;
                    sums.iter_mut().zip(shown.truth).for_each(|(sum, one)| *sum += one);
                    wet += u32::from(shown.is_wet);
                }
                let samples = f64::from(RAYS);
                let seen = seen / samples;
                let error = normal_numbers(options.seed, 40_000 + view as u32, y * width + x);
                let sigma = NOISE * DVec3::new(seen.x.sqrt(), seen.y.sqrt(), seen.z.sqrt());
                pixels.put_pixel(x, y, encode(seen + error * sigma));
                // The means of R and T are those of the rays that meet the water.
                let of_wet = f64::from(wet.max(1));
                let means = [sums[0] / samples, sums[1] / samples, sums[2] / of_wet, sums[3] / of_wet];
                for (picture, mean) in truth.pictures.iter_mut().zip(means) {
                    picture.put_pixel(x, y, encode(mean));
                }
                truth.region.put_pixel(x, y, Luma([if wet == RAYS { 255 } else { 0 }]));
            }
        }
        Self { pixels, truth: view.is_multiple_of(TRUTH_EVERY).then_some(truth) }
    }
}
