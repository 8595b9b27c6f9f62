//! Generates small underwater scenes with exact ground truth. A procedural wreck on a sea floor is ray-cast
//! under water with a noisy sensor and written as a COLMAP data set.
//!
//! Image formation per channel, linear light (Akkaynak & Treibitz, CVPR 2018):
//! `I = J exp(-beta_d r) + b_inf (1 - exp(-beta_b r))`, with r the distance along the ray in metres. `b_inf`
//! may change with the direction of the ray ([`ByDirection`]), both in front of surfaces and in open water.
//!
//! There are two looks. [`Look::Down`] surveys the wreck from above; no photograph shows open water.
//! [`Look::Forward`] dives along it with the camera near the horizon, on a bounded reef: many photographs
//! show much open water.
//!
//! The folder holds `images/vNNNN.png`, `sparse/0/*.bin` and `truth/` with the ground truth:
//! - `water.json`;
//! - `clear/vNNNN.png`: J of the held-out views, 8-bit sRGB;
//! - `valid/vNNNN.png`: white where all rays of the pixel meet a surface;
//! - `depth_m.npz`: z-depth of the pixel centres in metres, f32, 0 = nothing, one array for each held-out
//!   view.
//!
//! Every pixel is a pure function of the options, so the bytes do not depend on the number of threads.
//!
//! The forward look adds two maps of the held-out views, 8-bit grey:
//! - `truth/alpha/vNNNN.png`: share of the pixel's rays that meet a surface, 255 for all, 0 for none, which
//!   is open water;
//! - `truth/kind/vNNNN.png`: kind of surface that the rays meet. 0 means none; 2 that all meet a dark bluish
//!   one, with J close to the colour of open water. 3 means that all meet one with constant J, and 1 anything
//!   else.
//!
//! A pool seen through its surface ([`PoolOptions`]) has truth of its own.
//!
//! `truth/water.json` has `by_direction`, with the fields of [`ByDirection`], if the colour of open water
//! changes. Distant sand has features finer than a pixel, which nine rays a pixel do not average out.

mod files;
mod geometry;
mod noise;
mod points;
mod pool;
mod reef;
mod survey;
mod texture;
mod wreck;

use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::DVec3;
use image::{GrayImage, Luma, Rgb, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::rng::{Stream, random_bits, uniform};
use crate::scene::{PinholeCamera, Pose};
use crate::water::{ByDirection, Water};
use crate::{CoreError, Result};
use geometry::{Material, Ray, World};
pub use pool::{OIL, PoolOptions, synthesise_pool};

/// Every n-th view has ground truth: these are the views that training holds out by default.
const TRUTH_EVERY: usize = 8;
/// Sensor noise: standard deviation is this times the square root of the signal, linear light.
const NOISE: f64 = 0.004;
/// Largest range of a ray, metres.
const FARTHEST: f64 = 80.0;

/// The direction in which the cameras look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Look {
    /// Down on the wreck.
    #[default]
    Down,
    /// Ahead, slightly below the horizon, with open water above it.
    Forward,
}

impl Look {
    /// Rays per pixel and axis: more for distant surfaces at grazing angles.
    fn supersample(self) -> u32 {
        match self {
            Self::Down => 2,
            Self::Forward => 3,
        }
    }

    fn world(self, seed: u32) -> World {
        match self {
            Self::Down => wreck::build(seed),
            Self::Forward => reef::build(seed),
        }
    }

    fn poses(self, count: u32, seed: u32) -> Vec<Pose> {
        match self {
            Self::Down => survey::poses(count, seed),
            Self::Forward => survey::forward_poses(count, seed),
        }
    }
}

/// Open water that is brighter towards the surface, most of all in red, and towards a sun along x. Axes are
/// those of the scene, whose y points down. Over the directions in which the forward look sees open water,
/// colours change by a factor of about 2.
pub const BRIGHTER_UPWARDS: ByDirection = ByDirection {
    middle: [0.0, 0.0, 1.0],
    slopes: [[0.12, -1.35, 0.0], [0.10, -1.15, 0.0], [0.08, -0.90, 0.0]],
    most: 1.0,
};

/// Options of a synthetic scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthOptions {
    /// The direction in which the cameras look.
    pub look: Look,
    /// Seed of the textures, of scattered objects, of the dive and of the noise.
    pub seed: u32,
    /// Number of photographs.
    pub views: u32,
    /// Columns of a photograph.
    pub width: u32,
    /// Rows of a photograph.
    pub height: u32,
    /// Pixels of each photograph where a sparse point is tried. Fewer become points: those on a surface with
    /// texture that another photograph sees too.
    pub points_per_view: u32,
    /// The water between camera and wreck; a scene unit is a metre.
    pub water: Water,
    /// How the colour of open water changes with direction, scene axes; `None` if it is constant.
    pub by_direction: Option<ByDirection>,
}

impl Default for SynthOptions {
    fn default() -> Self {
        let water = Water::COASTAL;
        Self {
            look: Look::Down,
            seed: 1,
            views: 72,
            width: 240,
            height: 180,
            points_per_view: 90,
            water,
            by_direction: None,
        }
    }
}

impl SynthOptions {
    /// The default number and size of photographs, looking forward under water that is brighter upwards.
    pub fn forward() -> Self {
        Self { look: Look::Forward, by_direction: Some(BRIGHTER_UPWARDS), ..Self::default() }
    }

    /// The water along `direction`, unit length, scene axes.
    fn water_along(&self, direction: DVec3) -> Water {
        self.by_direction.map_or(self.water, |by_direction| by_direction.along(&self.water, direction))
    }

    fn validate(&self) -> Result<()> {
        validate_sizes(self.views, self.width, self.height, self.points_per_view)?;
        if !self.water.is_physical() {
            return Err(CoreError::Config(format!(
                "the water must have finite numbers, none below 0, and colours of at most 1; it is {:?}",
                self.water
            )));
        }
        if let Some(by_direction) = self.by_direction.filter(|by_direction| !by_direction.is_sound()) {
            return Err(CoreError::Config(format!(
                "the colours by direction need finite numbers, a middle of length 1 and a limit; they are {by_direction:?}"
            )));
        }
        Ok(())
    }
}

/// Refuses numbers that no kind of scene allows.
fn validate_sizes(views: u32, width: u32, height: u32, points_per_view: u32) -> Result<()> {
    if !(2..=9999).contains(&views) {
        return Err(CoreError::Config(format!("--views is {views}; it must be 2 to 9999")));
    }
    if !(16..=8192).contains(&width) || !(16..=8192).contains(&height) {
        return Err(CoreError::Config(format!("--size is {width}x{height}; each side must be 16 to 8192")));
    }
    let most = u32::MAX / views;
    if !(1..=100_000).contains(&points_per_view) || points_per_view > most {
        return Err(CoreError::Config(format!(
            "--points-per-view is {points_per_view}; it must be 1 to {}",
            most.min(100_000)
        )));
    }
    Ok(())
}

/// Makes the folders of a scene in `out`, which must not hold one.
fn new_folders(out: &Path, maps: impl Iterator<Item = String>) -> Result<()> {
    for folder in ["images", "sparse"] {
        if out.join(folder).exists() {
            return Err(CoreError::input(
                out,
                format!("holds {folder}/ already; give an empty folder, or remove that one first"),
            ));
        }
    }
    for folder in ["images", "sparse/0"].map(str::to_owned).into_iter().chain(maps) {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder).map_err(CoreError::io("create", &folder))?;
    }
    Ok(())
}

/// Counts of the generated scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct SynthSummary {
    /// Photographs.
    pub views: u32,
    /// Views with ground truth.
    pub truth_views: u32,
    /// Sparse points.
    pub points: u32,
}

/// Generates a scene in the folder `out`, which must not hold one; `progress(done, all)` counts photographs.
///
/// # Errors
/// When the options are invalid, when `out` already holds a scene, or when it cannot be written.
pub fn synthesise(
    out: &Path,
    options: &SynthOptions,
    progress: impl Fn(u32, u32) + Sync,
) -> Result<SynthSummary> {
    options.validate()?;
    let maps: &[&str] = match options.look {
        Look::Down => &["truth/clear", "truth/valid"],
        Look::Forward => &["truth/clear", "truth/valid", "truth/alpha", "truth/kind"],
    };
    new_folders(out, maps.iter().map(|&map| map.to_owned()))?;

    let world = options.look.world(options.seed);
    let camera = survey::camera(options.width, options.height);
    let poses = options.look.poses(options.views, options.seed);
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
                let grey = [
                    ("valid", photograph.valid()),
                    ("alpha", photograph.alpha()),
                    ("kind", photograph.kind()),
                ];
                for (folder, picture) in grey.into_iter().take(maps.len() - 1) {
                    let path = out.join("truth").join(folder).join(&names[view]);
                    picture.save(&path).map_err(|error| unwritable(&path, &error))?;
                }
            }
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, options.views);
            Ok(photograph)
        })
        .collect::<Result<Vec<_>>>()?;

    let points = points::sparse_points(&world, &camera, &poses, &photographs, options);
    files::write_colmap(&out.join("sparse/0"), &camera, &names, &poses, &points)?;
    let depths: Vec<_> = (0..poses.len())
        .into_par_iter()
        .filter(|view| view % TRUTH_EVERY == 0)
        .map(|view| (format!("v{:04}", view + 1), depth_map(&world, &camera, &poses[view])))
        .collect();
    files::write_npz(&out.join("truth/depth_m.npz"), options.width, options.height, &depths)?;
    files::write(&out.join("truth/water.json"), water_json(options).as_bytes())?;
    Ok(SynthSummary { views: options.views, truth_views: depths.len() as u32, points: points.len() as u32 })
}

fn unwritable(path: &Path, error: &image::ImageError) -> CoreError {
    CoreError::input(path, format!("cannot be written: {error}"))
}

fn water_json(options: &SynthOptions) -> String {
    let SynthOptions { water, by_direction, .. } = options;
    let (b_inf, along) =
        if by_direction.is_some() { ("b_inf(d)", ", d = its direction") } else { ("b_inf", "") };
    let mut values = serde_json::json!({
        "image_formation": format!("I = J*exp(-beta_d*r) + {b_inf}*(1-exp(-beta_b*r)), linear light, r = distance along the ray in metres{along}"),
        "beta_d_per_m": water.beta_d,
        "beta_b_per_m": water.beta_b,
        "b_inf_linear": water.b_inf,
        "metres_per_unit": 1.0,
        "test_views": "sorted names, index % 8 == 0; truth/clear holds J of exactly these, truth/valid is white where J is known; depth_m.npz holds their z-depth in metres (0 = nothing)",
        "noise": format!("sigma {NOISE}*sqrt(I) in linear light, then 8-bit PNG"),
    });
    if let Some(by_direction) = by_direction {
        values["by_direction"] = serde_json::json!(by_direction);
    }
    if options.look == Look::Forward {
        values["alpha"] = "truth/alpha: share of a pixel's rays that meet a surface, 255 all, 0 open water; truth/kind: 0 where none do, 2 where all meet a dark bluish surface, 3 where all meet one of one colour, 1 otherwise".into();
    }
    format!("{values:#}\n")
}

/// Number of a pixel's rays that meet each kind of surface.
#[derive(Clone, Copy, Default)]
struct Met {
    surface: u32,
    dark: u32,
    smooth: u32,
}

impl Met {
    fn add(&mut self, material: Material) {
        self.surface += 1;
        self.dark += u32::from(material == Material::Dark);
        self.smooth += u32::from(material.is_smooth());
    }
}

/// One view: the output of the sensor and its ground truth.
struct Photograph {
    pixels: RgbImage,
    clear: RgbImage,
    /// Row by row.
    met: Vec<Met>,
    /// Rays of each pixel.
    rays: u32,
}

impl Photograph {
    fn take(world: &World, camera: &PinholeCamera, pose: &Pose, view: u32, options: &SynthOptions) -> Self {
        let (width, height) = (camera.width, camera.height);
        let side = options.look.supersample();
        let rays = side * side;
        let mut photograph = Self {
            pixels: RgbImage::new(width, height),
            clear: RgbImage::new(width, height),
            met: Vec::with_capacity((width * height) as usize),
            rays,
        };
        let origin = pose.centre();
        let samples = f64::from(rays);
        for y in 0..height {
            for x in 0..width {
                let (mut seen, mut clear, mut met) = (DVec3::ZERO, DVec3::ZERO, Met::default());
                for sub in 0..rays {
                    let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(side);
                    let pixel = [f64::from(x) + offset(sub % side), f64::from(y) + offset(sub / side)];
                    let ray = Ray { origin, direction: pixel_ray(camera, pose, pixel) };
                    // Without a surface, the ray shows open water.
                    let (radiance, range) = match world.hit(&ray, FARTHEST) {
                        Some(hit) => {
                            met.add(hit.material);
                            (texture::radiance(world, &ray, &hit, options.seed), hit.range)
                        }
                        None => (DVec3::ZERO, 1e6),
                    };
                    clear += radiance;
                    seen += options.water_along(ray.direction).apply(radiance, range);
                }
                let (seen, clear) = (seen / samples, clear / samples);
                let error = normal_numbers(options.seed, 40_000 + view, y * width + x);
                let sigma = NOISE * DVec3::new(seen.x.sqrt(), seen.y.sqrt(), seen.z.sqrt());
                photograph.pixels.put_pixel(x, y, encode(seen + error * sigma));
                photograph.clear.put_pixel(x, y, encode(clear));
                photograph.met.push(met);
            }
        }
        photograph
    }

    /// White where all rays meet a surface.
    fn valid(&self) -> GrayImage {
        self.grey(|met| if met.surface == self.rays { 255 } else { 0 })
    }

    /// The share of the rays that meet a surface, in 255ths.
    fn alpha(&self) -> GrayImage {
        self.grey(|met| ((255 * met.surface + self.rays / 2) / self.rays) as u8)
    }

    /// The kind of surface, by the numbers at the head of this file.
    fn kind(&self) -> GrayImage {
        self.grey(|met| match met {
            Met { surface: 0, .. } => 0,
            Met { dark, .. } if dark == self.rays => 2,
            Met { smooth, .. } if smooth == self.rays => 3,
            _ => 1,
        })
    }

    fn grey(&self, of: impl Fn(Met) -> u8) -> GrayImage {
        let (width, height) = self.pixels.dimensions();
        GrayImage::from_fn(width, height, |x, y| Luma([of(self.met[(y * width + x) as usize])]))
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
