//! A small underwater scene with exact truth, made from nothing: a procedural wreck on a sea floor,
//! ray-cast, put under water, photographed with a noisy sensor, and written as a COLMAP data set.
//!
//! Image formation per channel, linear light (Akkaynak & Treibitz, CVPR 2018):
//! `I = J exp(-beta_d r) + b_inf (1 - exp(-beta_b r))`, with r the distance along the ray in metres.
//!
//! Layout of the folder: `images/vNNNN.png`, `sparse/0/*.bin`, and `truth/`: `water.json`,
//! `clear/vNNNN.png` (J of the held-out views, 8-bit sRGB), `valid/vNNNN.png` (white where a ray met a
//! surface), `depth_m.npz` (z-depth of the pixel centres in metres, f32, 0 = nothing, one array a
//! held-out view). Every pixel is a pure function of the options: the same bytes on any number of threads.

mod files;
mod geometry;
mod noise;
mod points;
mod survey;
mod texture;
mod wreck;

use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::DVec3;
use image::{GrayImage, Luma, Rgb, RgbImage};
use rayon::prelude::*;
use serde::Serialize;

use crate::rng::{Stream, random_bits, uniform};
use crate::scene::{PinholeCamera, Pose};
use crate::water::Water;
use crate::{CoreError, Result};
use geometry::{Ray, World};

/// Every n-th view gets truth: the views that training holds out by default.
const TRUTH_EVERY: usize = 8;
/// Rays per pixel and axis.
const SUPERSAMPLE: u32 = 2;
/// Sensor noise: standard deviation is this times the square root of the signal, linear light.
const NOISE: f64 = 0.004;
/// No ray goes further, metres.
const FARTHEST: f64 = 80.0;

/// What to make.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthOptions {
    /// Seed of the textures, of what lies about, of the dive and of the noise.
    pub seed: u32,
    /// Number of photographs.
    pub views: u32,
    /// Columns of a photograph.
    pub width: u32,
    /// Rows of a photograph.
    pub height: u32,
    /// What is between camera and wreck; a scene unit is a metre.
    pub water: Water,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self { seed: 1, views: 72, width: 240, height: 180, water: Water::COASTAL }
    }
}

/// What was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct SynthSummary {
    /// Photographs.
    pub views: u32,
    /// Views with truth.
    pub truth_views: u32,
    /// Sparse points.
    pub points: u32,
}

/// Makes a scene in the folder `out`, which must not hold one; `progress(done, all)` counts photographs.
///
/// # Errors
/// When the options make no scene, when `out` already holds photographs, or when it cannot be written.
pub fn synthesise(
    out: &Path,
    options: &SynthOptions,
    progress: impl Fn(u32, u32) + Sync,
) -> Result<SynthSummary> {
    if !(2..=9999).contains(&options.views) {
        return Err(CoreError::Config(format!("--views is {}; it must be 2 to 9999", options.views)));
    }
    if !(16..=8192).contains(&options.width) || !(16..=8192).contains(&options.height) {
        let (width, height) = (options.width, options.height);
        return Err(CoreError::Config(format!("--size is {width}x{height}; each side must be 16 to 8192")));
    }
    for folder in ["images", "sparse"] {
        if out.join(folder).exists() {
            return Err(CoreError::input(
                out,
                format!("holds {folder}/ already; give an empty folder, or remove that one first"),
            ));
        }
    }
    for folder in ["images", "sparse/0", "truth/clear", "truth/valid"] {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder).map_err(CoreError::io("create", &folder))?;
    }

    let world = wreck::build(options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = survey::poses(options.views, options.seed);
    let names: Vec<String> = (1..=poses.len()).map(|n| format!("v{n:04}.png")).collect();
    let done = AtomicU32::new(0);
    let photographs = (0..poses.len())
        .into_par_iter()
        .map(|view| {
            let photograph = Photograph::take(&world, &camera, &poses[view], view as u32, options);
            let path = out.join("images").join(&names[view]);
            photograph.pixels.save(&path).map_err(|error| unwritable(&path, &error))?;
            if view % TRUTH_EVERY == 0 {
                let path = out.join("truth/clear").join(&names[view]);
                photograph.clear.save(&path).map_err(|error| unwritable(&path, &error))?;
                let path = out.join("truth/valid").join(&names[view]);
                photograph.valid.save(&path).map_err(|error| unwritable(&path, &error))?;
            }
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, options.views);
            Ok(photograph)
        })
        .collect::<Result<Vec<_>>>()?;

    let points = points::sparse_points(&world, &camera, &poses, &photographs, options.seed);
    files::write_colmap(&out.join("sparse/0"), &camera, &names, &poses, &points)?;
    let depths: Vec<_> = (0..poses.len())
        .into_par_iter()
        .filter(|view| view % TRUTH_EVERY == 0)
        .map(|view| (format!("v{:04}", view + 1), depth_map(&world, &camera, &poses[view])))
        .collect();
    files::write_npz(&out.join("truth/depth_m.npz"), options.width, options.height, &depths)?;
    files::write(&out.join("truth/water.json"), water_json(&options.water).as_bytes())?;
    Ok(SynthSummary { views: options.views, truth_views: depths.len() as u32, points: points.len() as u32 })
}

fn unwritable(path: &Path, error: &image::ImageError) -> CoreError {
    CoreError::input(path, format!("cannot be written: {error}"))
}

fn water_json(water: &Water) -> String {
    let values = serde_json::json!({
        "image_formation": "I = J*exp(-beta_d*r) + b_inf*(1-exp(-beta_b*r)), linear light, r = distance along the ray in metres",
        "beta_d_per_m": water.beta_d,
        "beta_b_per_m": water.beta_b,
        "b_inf_linear": water.b_inf,
        "metres_per_unit": 1.0,
        "test_views": "sorted names, index % 8 == 0; truth/clear holds J of exactly these, truth/valid is white where J is known; depth_m.npz holds their z-depth in metres (0 = nothing)",
        "noise": format!("sigma {NOISE}*sqrt(I) in linear light, then 8-bit PNG"),
    });
    format!("{values:#}\n")
}

/// One view: what the sensor gives, and the truth about it.
struct Photograph {
    pixels: RgbImage,
    clear: RgbImage,
    valid: GrayImage,
}

impl Photograph {
    fn take(world: &World, camera: &PinholeCamera, pose: &Pose, view: u32, options: &SynthOptions) -> Self {
        let (width, height) = (camera.width, camera.height);
        let mut photograph = Self {
            pixels: RgbImage::new(width, height),
            clear: RgbImage::new(width, height),
            valid: GrayImage::new(width, height),
        };
        let origin = pose.centre();
        let samples = f64::from(SUPERSAMPLE * SUPERSAMPLE);
        for y in 0..height {
            for x in 0..width {
                let (mut seen, mut clear, mut hits) = (DVec3::ZERO, DVec3::ZERO, 0);
                for sub in 0..SUPERSAMPLE * SUPERSAMPLE {
                    let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(SUPERSAMPLE);
                    let pixel =
                        [f64::from(x) + offset(sub % SUPERSAMPLE), f64::from(y) + offset(sub / SUPERSAMPLE)];
                    let ray = Ray { origin, direction: pixel_ray(camera, pose, pixel) };
                    // Where nothing is, open water is seen.
                    let (radiance, range) = match world.hit(&ray, FARTHEST) {
                        Some(hit) => {
                            hits += 1;
                            (texture::radiance(world, &ray, &hit, options.seed), hit.range)
                        }
                        None => (DVec3::ZERO, f64::INFINITY),
                    };
                    clear += radiance;
                    seen += options.water.apply(radiance, if range.is_finite() { range } else { 1e6 });
                }
                let (seen, clear) = (seen / samples, clear / samples);
                let error = normal_numbers(options.seed, 40_000 + view, y * width + x);
                let sigma = NOISE * DVec3::new(seen.x.sqrt(), seen.y.sqrt(), seen.z.sqrt());
                photograph.pixels.put_pixel(x, y, encode(seen + error * sigma));
                photograph.clear.put_pixel(x, y, encode(clear));
                let known = hits == SUPERSAMPLE * SUPERSAMPLE;
                photograph.valid.put_pixel(x, y, Luma([if known { 255 } else { 0 }]));
            }
        }
        photograph
    }
}

fn depth_map(world: &World, camera: &PinholeCamera, pose: &Pose) -> Vec<f32> {
    let (origin, forward) = (pose.centre(), pose.forward());
    let mut depths = Vec::with_capacity((camera.width * camera.height) as usize);
    for y in 0..camera.height {
        for x in 0..camera.width {
            let direction = pixel_ray(camera, pose, [f64::from(x) + 0.5, f64::from(y) + 0.5]);
            let hit = world.hit(&Ray { origin, direction }, FARTHEST);
            depths.push(hit.map_or(0.0, |hit| (hit.range * direction.dot(forward)) as f32));
        }
    }
    depths
}

/// Unit direction in the world through a pixel position.
fn pixel_ray(camera: &PinholeCamera, pose: &Pose, pixel: [f64; 2]) -> DVec3 {
    let in_camera =
        DVec3::new((pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0).normalize();
    pose.rotation.inverse() * in_camera
}

/// Three independent standard normal numbers (Box-Muller).
fn normal_numbers(seed: u32, a: u32, b: u32) -> DVec3 {
    let first = random_bits(seed, Stream::Synth, a, b.wrapping_mul(2)).map(|bits| f64::from(uniform(bits)));
    let second = random_bits(seed, Stream::Synth, a, b.wrapping_mul(2).wrapping_add(1))
        .map(|bits| f64::from(uniform(bits)));
    let pair = |u: f64, v: f64| (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos();
    DVec3::new(pair(first[0], second[0]), pair(first[1], second[1]), pair(first[2], second[2]))
}

/// Linear light to 8-bit sRGB (IEC 61966-2-1).
fn encode(linear: DVec3) -> Rgb<u8> {
    Rgb(linear.to_array().map(|v| {
        let v = v.clamp(0.0, 1.0);
        let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
        (encoded * 255.0).round() as u8
    }))
}

#[cfg(test)]
mod tests;
