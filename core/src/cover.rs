//! Cover: whether a model fills what its photographs show, leaves open water empty, and is rendered where too
//! few training views look.
//!
//! Three measures on held-out views, which PSNR mixes:
//!
//! - `holes`: the share of covered pixels that the model leaves open. A pixel is covered if a sparse point
//!   that at least two training views see projects near it. With a truth ([`HeldOut::truth`]), a pixel is
//!   covered if it shows a surface whose position lies in at least two training views.
//! - `open_water`: the light left in J where there is no surface, as a share of J's white. J should be black
//!   there: remaining light is backscatter that was attributed to the scene.
//! - `unseen`: of the pixels where the model has a surface, the share whose position fewer than two training
//!   views see. The model extrapolates there, and training cannot help.
//!
//! A view counts as seeing a position that projects into its picture, in front of the camera. Occlusion is
//! ignored, so `unseen` is a lower bound and the number of covered pixels an upper bound. Pixels that the
//! mask of a photograph leaves out count nowhere.
//!
//! Work is bounded: positions are tested on a grid of at most 4,096 pixels a view, against the 4,096 training
//! views with the nearest cameras. No GPU here: a caller renders. Sums run in the order of pixels and views,
//! so results do not depend on threads.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::picture::srgb_to_linear;
use crate::scene::{PinholeCamera, Points, Pose};
use crate::seams::SURFACE_ALPHA;
use crate::views::PackedImage;

/// The description of these measures in `metrics.json`.
pub const PROTOCOL: &str = "holes: of the covered pixels, the share with alpha below 0.9; covered: within 1/100 of the longer \
     side of a sparse point that two training views see (by tracks, otherwise by projection), with a truth instead: pixels with a \
     surface whose position, at the range of the nearest sparse point of the view within 1/10 of the longer side, lies in two \
     training views; open_water: mean linear light of J where alpha is below 0.5, with a truth instead where it has no surface \
     within a pixel, as a share of the 99th percentile of the brightest channel of J where alpha is above 0.9; unseen: of pixels \
     with alpha above 0.5, the share whose position at the expected range lies in the pictures of fewer than two training views, \
     occlusion ignored; all over all held-out pixels that are not masked, on a grid where positions are needed";

/// A covered pixel with less alpha is a hole.
const CLOSED_ALPHA: f32 = 0.9;
/// Pixels with more alpha determine J's white: they are opaque.
const WHITE_ALPHA: f32 = 0.9;
/// Percentile of the brightest channel that counts as J's white; it excludes a few highlights.
const WHITE: f64 = 0.99;
/// Radius around a sparse point within which pixels are covered, as a share of the longer side of the
/// picture.
const COVERS: f64 = 0.01;
/// Radius around a sparse point within which pixels take its range, as a share of the longer side of the
/// picture.
const REACHES: f64 = 0.1;
/// Most pixels of a view whose position is tested.
const GRID: usize = 4096;
/// Most training views that are tested for one view: those nearest to it. Few of the others look there.
const NEAR_VIEWS: usize = 4096;
/// Most sparse points of one view that are compared with every pixel of its grid.
const RANGES: usize = 4096;
/// For one view, most sparse points without tracks that are projected into training views.
const UNTRACKED: usize = 32_768;
/// Most held-out views that [`predicted_unseen`] uses.
const PREDICTED: usize = 256;

/// A camera that a model was trained on.
struct Eye {
    camera: PinholeCamera,
    pose: Pose,
    centre: DVec3,
}

/// A sparse point in a picture.
#[derive(Clone, Copy)]
struct Spot {
    /// Index of the point.
    point: usize,
    /// Pixels from the top-left corner.
    at: [f64; 2],
    /// Distance from the camera, scene units.
    range: f64,
}

/// Input of the training: its views and the sparse points.
struct Trained<'a> {
    eyes: Vec<Eye>,
    points: &'a Points,
    /// Which points at least two training views see; `None` without tracks.
    seen_twice: Option<Vec<bool>>,
    /// Points that each held-out view sees, by index of the view; empty without tracks.
    of_view: HashMap<u32, Vec<usize>>,
}

impl<'a> Trained<'a> {
    /// `views` are all of the scene by name, as tracks number them; `held_out` are indices into them.
    fn new(views: &[(PinholeCamera, Pose)], held_out: &[u32], points: &'a Points) -> Self {
        let mut is_held_out = vec![false; views.len()];
        for &index in held_out {
            if let Some(held) = is_held_out.get_mut(index as usize) {
                *held = true;
            }
        }
        let of_training = views.iter().zip(&is_held_out).filter(|(_, held)| !**held);
        let eyes = of_training.map(|((camera, pose), _)| Eye {
            camera: *camera,
            pose: *pose,
            centre: pose.centre(),
        });
        let eyes = eyes.collect();
        let mut of_view = HashMap::<u32, Vec<usize>>::new();
        if points.tracks.is_empty() {
            return Self { eyes, points, seen_twice: None, of_view };
        }
        let is_trained_on = |view: &u32| is_held_out.get(*view as usize) == Some(&false);
        let mut seen_twice = Vec::with_capacity(points.len());
        for point in 0..points.len() {
            let track = points.tracks.of(point);
            seen_twice.push(track.iter().filter(|view| is_trained_on(view)).nth(1).is_some());
            for &view in track.iter().filter(|view| is_held_out.get(**view as usize) == Some(&true)) {
                of_view.entry(view).or_default().push(point);
            }
        }
        Self { eyes, points, seen_twice: Some(seen_twice), of_view }
    }

    /// The training views nearest to a camera, the nearest first.
    fn near(&self, centre: DVec3) -> Vec<&Eye> {
        let mut near: Vec<(f64, usize)> =
            self.eyes.iter().enumerate().map(|(i, eye)| (eye.centre.distance_squared(centre), i)).collect();
        let nearer = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if near.len() > NEAR_VIEWS {
            near.select_nth_unstable_by(NEAR_VIEWS, nearer);
            near.truncate(NEAR_VIEWS);
        }
        near.sort_unstable_by(nearer);
        near.into_iter().map(|(_, i)| &self.eyes[i]).collect()
    }

    fn spot(&self, camera: &PinholeCamera, pose: &Pose, point: usize) -> Option<Spot> {
        let (at, range) = project(camera, pose, self.position(point))?;
        Some(Spot { point, at, range })
    }

    fn position(&self, point: usize) -> DVec3 {
        DVec3::from(self.points.positions[point].map(f64::from))
    }

    /// The points that a held-out view sees: by tracks if there are any, otherwise all that project into its
    /// picture.
    fn seen_in(&self, index: u32, camera: &PinholeCamera, pose: &Pose) -> Vec<Spot> {
        let spot = |point| self.spot(camera, pose, point);
        match &self.seen_twice {
            Some(_) => self.of_view.get(&index).into_iter().flatten().filter_map(|&p| spot(p)).collect(),
            None => (0..self.points.len()).into_par_iter().filter_map(spot).collect(),
        }
    }

    /// The pixel positions in a picture of points that at least two training views see.
    fn covering(&self, camera: &PinholeCamera, pose: &Pose, near: &[&Eye]) -> Vec<[f64; 2]> {
        let all = (0..self.points.len()).into_par_iter();
        if let Some(twice) = &self.seen_twice {
            let spots = all.filter(|&point| twice[point]).filter_map(|p| self.spot(camera, pose, p));
            return spots.map(|spot| spot.at).collect();
        }
        let spots: Vec<Spot> = all.filter_map(|point| self.spot(camera, pose, point)).collect();
        let thinned: Vec<Spot> = thinned(&spots, UNTRACKED).copied().collect();
        let twice = thinned.into_par_iter().filter(|spot| is_seen_twice(near, self.position(spot.point)));
        twice.map(|spot| spot.at).collect()
    }
}

/// A held-out view and its render. All pictures have the size of the camera.
#[derive(Clone, Copy, Debug)]
pub struct HeldOut<'a> {
    /// Index among the views of the scene by name, as tracks number them.
    pub index: u32,
    /// Its camera.
    pub camera: &'a PinholeCamera,
    /// World to camera.
    pub pose: &'a Pose,
    /// Alpha of the render, `[H*W]`.
    pub alpha: &'a [f32],
    /// Sum of weight times distance along the ray, `[H*W]`, scene units.
    pub range: &'a [f32],
    /// The photograph, whose mask says which pixels count.
    pub photograph: &'a PackedImage,
    /// J of the render; `None` without a medium.
    pub clear: Option<&'a PackedImage>,
    /// A picture whose mask holds where there is a surface; `None` if unknown.
    pub truth: Option<&'a PackedImage>,
}

impl HeldOut<'_> {
    fn counts(&self, pixel: usize) -> bool {
        has_mask(self.photograph, pixel)
    }

    /// Phrased so that NaN counts as a hole.
    fn has_alpha(&self, pixel: usize, least: f32) -> bool {
        self.alpha[pixel] >= least
    }

    /// Whether a pixel has no surface. With a truth, its eight neighbours must have none either, because the
    /// mask of a truth leaves out pixels that show a surface in part.
    fn is_open(&self, pixel: usize) -> bool {
        let Some(truth) = self.truth else { return !self.has_alpha(pixel, SURFACE_ALPHA) };
        let (width, height) = (truth.width as usize, truth.height as usize);
        let (x, y) = (pixel % width, pixel / width);
        let around = |at: usize, len: usize| at.saturating_sub(1)..(at + 2).min(len);
        around(y, height).all(|y| around(x, width).all(|x| !has_mask(truth, y * width + x)))
    }
}

/// Measures of one view; `None` if there are no pixels to measure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewCover {
    /// Share of the covered pixels that are open, 0 to 1.
    pub holes: Option<f64>,
    /// Light left in J where there is no surface, as a share of the white of J over all views.
    pub open_water: Option<f64>,
    /// Share of the pixels with a surface that fewer than two training views see, 0 to 1.
    pub unseen: Option<f64>,
}

/// The results; the measures of all views are over all their pixels.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CoverReport {
    /// Of all views.
    #[serde(flatten)]
    pub all: ViewCover,
    /// Each view, in the order of measuring.
    #[serde(default)]
    pub views: Vec<ViewCover>,
}

/// A sum over pixels, and the number of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Share {
    sum: f64,
    pixels: f64,
}

impl Share {
    /// The share of `true`; each pixel stands for `weight` pixels of the picture.
    fn of(pixels: impl Iterator<Item = bool>, weight: f64) -> Self {
        let (held, all) =
            pixels.fold((0_u64, 0_u64), |(held, all), holds| (held + u64::from(holds), all + 1));
        Self { sum: weight * held as f64, pixels: weight * all as f64 }
    }

    fn add(&mut self, other: Self) {
        self.sum += other.sum;
        self.pixels += other.pixels;
    }

    fn value(self) -> Option<f64> {
        (self.pixels > 0.0).then(|| self.sum / self.pixels)
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Sums {
    holes: Share,
    /// Mean linear light over the channels.
    open_water: Share,
    unseen: Share,
}

impl Sums {
    fn numbers(self, white: Option<f64>) -> ViewCover {
        let open_water = self.open_water.value().zip(white).map(|(light, white)| light / white);
        ViewCover { holes: self.holes.value(), open_water, unseen: self.unseen.value() }
    }
}

/// All that was measured, from which a [`CoverReport`] follows. Several workers measure a part of the views
/// each; appended in the order of the views, their sums give the report of all views.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CoverSums {
    /// Each view, in the order of measuring.
    views: Vec<Sums>,
    /// Histogram of the brightest channel of J, 8-bit sRGB.
    brightest: Vec<u64>,
}

impl CoverSums {
    /// Number of measured views.
    pub fn views(&self) -> usize {
        self.views.len()
    }

    /// Adds what was measured on later views.
    pub fn append(&mut self, later: Self) {
        self.views.extend(later.views);
        self.brightest.resize(self.brightest.len().max(later.brightest.len()), 0);
        for (mine, theirs) in self.brightest.iter_mut().zip(later.brightest) {
            *mine = mine.saturating_add(theirs);
        }
    }

    /// The results, with the views in the order in which they were added.
    pub fn report(self) -> CoverReport {
        let white = self.white();
        let mut all = Sums::default();
        for view in &self.views {
            all.holes.add(view.holes);
            all.open_water.add(view.open_water);
            all.unseen.add(view.unseen);
        }
        let views = self.views.iter().map(|view| view.numbers(white)).collect();
        CoverReport { all: all.numbers(white), views }
    }

    /// J's white, linear light, above 0.
    fn white(&self) -> Option<f64> {
        let all: u64 = self.brightest.iter().copied().fold(0, u64::saturating_add);
        let mut below = 0_u64;
        let reached = |count: &u64| {
            below = below.saturating_add(*count);
            below > 0 && below as f64 >= WHITE * all as f64
        };
        let code = self.brightest.iter().position(reached)?;
        (code > 0).then(|| srgb_to_linear(code as f64 / 255.0))
    }
}

/// Measures view after view.
pub struct CoverMeter<'a> {
    trained: Trained<'a>,
    sums: CoverSums,
}

impl<'a> CoverMeter<'a> {
    /// A meter without measurements. `views` are the cameras and poses (world to camera) of all views of the
    /// scene by name, as the tracks of `points` number them. All except those with an index in `held_out`
    /// count as training views.
    pub fn new(views: &[(PinholeCamera, Pose)], held_out: &[u32], points: &'a Points) -> Self {
        let sums = CoverSums { views: Vec::new(), brightest: vec![0; 256] };
        Self { trained: Trained::new(views, held_out, points), sums }
    }

    /// Measures one view.
    pub fn add(&mut self, view: &HeldOut<'_>) {
        let mut sums = Sums::default();
        if !self.trained.eyes.is_empty() {
            let near = self.trained.near(view.pose.centre());
            sums.holes = self.holes(view, &near);
            sums.unseen = unseen(view, &near);
        }
        if let Some(clear) = view.clear {
            sums.open_water = self.open_water(view, clear);
        }
        self.sums.views.push(sums);
    }

    /// All that was measured, with the views in the order in which they were added.
    pub fn sums(self) -> CoverSums {
        self.sums
    }

    /// The results of [`CoverMeter::sums`].
    pub fn report(self) -> CoverReport {
        self.sums.report()
    }

    fn holes(&self, view: &HeldOut<'_>, near: &[&Eye]) -> Share {
        let is_hole = |pixel: usize| !view.has_alpha(pixel, CLOSED_ALPHA);
        let Some(truth) = view.truth else {
            let covered = discs(view.camera, &self.trained.covering(view.camera, view.pose, near));
            let covered =
                covered.iter().enumerate().filter(|(pixel, covered)| **covered && view.counts(*pixel));
            return Share::of(covered.map(|(pixel, _)| is_hole(pixel)), 1.0);
        };
        let (grid, weight) = grid(view.camera);
        let surfaces: Vec<usize> =
            grid.into_iter().filter(|&pixel| view.counts(pixel) && has_mask(truth, pixel)).collect();
        let spots = self.trained.seen_in(view.index, view.camera, view.pose);
        let places = places(view.camera, view.pose, &surfaces, &spots);
        let covered: Vec<bool> =
            places.par_iter().map(|place| place.is_some_and(|place| is_seen_twice(near, place))).collect();
        let covered = surfaces.iter().zip(covered).filter(|(_, covered)| *covered);
        Share::of(covered.map(|(pixel, _)| is_hole(*pixel)), weight)
    }

    /// Also fills the histogram for J's white.
    fn open_water(&mut self, view: &HeldOut<'_>, clear: &PackedImage) -> Share {
        let light: Vec<f64> = (0..=255).map(|code| srgb_to_linear(f64::from(code) / 255.0)).collect();
        let mut open = Share::default();
        for (pixel, value) in clear.pixels.iter().enumerate().filter(|(pixel, _)| view.counts(*pixel)) {
            let [r, g, b, _] = value.to_le_bytes();
            if view.is_open(pixel) {
                let sum: f64 = [r, g, b].iter().map(|code| light[usize::from(*code)]).sum();
                open.add(Share { sum: sum / 3.0, pixels: 1.0 });
            } else if view.alpha[pixel] > WHITE_ALPHA {
                self.sums.brightest[usize::from(r.max(g).max(b))] += 1;
            }
        }
        open
    }
}

/// Of the pixels with a surface in the render, those that fewer than two training views see.
fn unseen(view: &HeldOut<'_>, near: &[&Eye]) -> Share {
    let (grid, weight) = grid(view.camera);
    let has_surface =
        |&pixel: &usize| view.counts(pixel) && view.alpha[pixel] > SURFACE_ALPHA && view.range[pixel] > 0.0;
    let surfaces: Vec<usize> = grid.into_iter().filter(has_surface).collect();
    let of_pixel = |&pixel: &usize| {
        let range = f64::from(view.range[pixel] / view.alpha[pixel]);
        !is_seen_twice(near, place(view.camera, view.pose, pixel, range))
    };
    let unseen: Vec<bool> = surfaces.par_iter().map(of_pixel).collect();
    Share::of(unseen.into_iter(), weight)
}

/// Predicts `unseen` from the sparse points, before there is a model. Each held-out pixel takes the range of
/// the view's nearest sparse point, at most 1/10 of the longer side away. The result is the share of these
/// positions that fewer than two training views see. Pixels without such a point are left out.
///
/// `views` and `held_out` as in [`CoverMeter::new`]; a view's points are those whose track names it, or
/// without tracks all that project into its picture. At most 256 held-out views are used, evenly spaced.
/// `None` without training views or if no pixel has a point.
pub fn predicted_unseen(views: &[(PinholeCamera, Pose)], held_out: &[u32], points: &Points) -> Option<f64> {
    let trained = Trained::new(views, held_out, points);
    if trained.eyes.is_empty() {
        return None;
    }
    let mut all = Share::default();
    for &index in thinned(held_out, PREDICTED) {
        let Some((camera, pose)) = views.get(index as usize) else { continue };
        let near = trained.near(pose.centre());
        let (grid, weight) = grid(camera);
        let places = places(camera, pose, &grid, &trained.seen_in(index, camera, pose));
        let known: Vec<DVec3> = places.into_iter().flatten().collect();
        let unseen: Vec<bool> = known.par_iter().map(|place| !is_seen_twice(&near, *place)).collect();
        all.add(Share::of(unseen.into_iter(), weight));
    }
    all.value()
}

/// Puts a report into a `metrics.json` whose `views` are those that were measured; nulls without a report.
pub fn put_into(metrics: &mut Value, report: Option<&CoverReport>) {
    let put = |into: &mut Value, of: ViewCover| {
        into["holes"] = json!(of.holes);
        into["open_water"] = json!(of.open_water);
        into["unseen"] = json!(of.unseen);
    };
    put(metrics, report.map(|report| report.all).unwrap_or_default());
    let views = metrics["views"].as_array_mut().into_iter().flatten();
    for (index, view) in views.enumerate().filter(|(_, view)| view.is_object()) {
        put(view, report.and_then(|report| report.views.get(index).copied()).unwrap_or_default());
    }
}

/// Position of a point in a picture, pixels from the top-left corner, and its distance from the camera;
/// `None` outside the picture.
fn project(camera: &PinholeCamera, pose: &Pose, point: DVec3) -> Option<([f64; 2], f64)> {
    let p = pose.transform(point);
    let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
    let inside = p.z > 0.0
        && (0.0..f64::from(camera.width)).contains(&x)
        && (0.0..f64::from(camera.height)).contains(&y);
    inside.then(|| ([x, y], p.length()))
}

fn is_seen_twice(eyes: &[&Eye], place: DVec3) -> bool {
    eyes.iter().filter(|eye| project(&eye.camera, &eye.pose, place).is_some()).nth(1).is_some()
}

/// The world position that a pixel shows at a distance along its ray.
fn place(camera: &PinholeCamera, pose: &Pose, pixel: usize, range: f64) -> DVec3 {
    pose.centre() + pose.rotation.inverse() * camera.direction(pixel) * range
}

/// The positions of pixels at the range of the nearest spot in the picture; `None` if none is near. At most
/// [`RANGES`] spots are used.
fn places(camera: &PinholeCamera, pose: &Pose, pixels: &[usize], spots: &[Spot]) -> Vec<Option<DVec3>> {
    let spots: Vec<Spot> = thinned(spots, RANGES).copied().collect();
    let reach = REACHES * f64::from(camera.width.max(camera.height));
    let width = camera.width as usize;
    let of_pixel = |&pixel: &usize| {
        let (x, y) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let squared = |spot: &Spot| (spot.at[0] - x).powi(2) + (spot.at[1] - y).powi(2);
        let nearest = spots.iter().min_by(|a, b| squared(a).total_cmp(&squared(b)))?;
        (squared(nearest) <= reach * reach).then(|| place(camera, pose, pixel, nearest.range))
    };
    pixels.par_iter().map(of_pixel).collect()
}

/// The pixels whose middle lies within [`COVERS`] of a spot, with a radius of at least one pixel, `[H*W]`.
fn discs(camera: &PinholeCamera, spots: &[[f64; 2]]) -> Vec<bool> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let radius = (COVERS * width.max(height) as f64).max(1.0);
    // Number of discs that begin at a pixel, minus those that end before it. One extra column takes the discs
    // that reach the border.
    let mut changes = vec![0_i64; (width + 1) * height];
    // Pixels whose middle lies in [low, high] along a side.
    let within = |low: f64, high: f64, len: usize| {
        let first = (low - 0.5).ceil().max(0.0) as usize;
        first..((high + 0.5).floor().max(0.0) as usize).min(len)
    };
    for [x, y] in spots {
        for row in within(y - radius, y + radius, height) {
            let half = (radius.powi(2) - (row as f64 + 0.5 - y).powi(2)).max(0.0).sqrt();
            let columns = within(x - half, x + half, width);
            if !columns.is_empty() {
                changes[row * (width + 1) + columns.start] += 1;
                changes[row * (width + 1) + columns.end] -= 1;
            }
        }
    }
    let mut covered = Vec::with_capacity(width * height);
    for row in changes.chunks_exact(width + 1) {
        let mut open = 0;
        covered.extend(row[..width].iter().map(|change| {
            open += change;
            open > 0
        }));
    }
    covered
}

/// At most [`GRID`] pixels, evenly over the picture, and how many pixels each stands for.
fn grid(camera: &PinholeCamera) -> (Vec<usize>, f64) {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let along = |len: usize, step: usize| (len.min(step) / 2..len).step_by(step);
    let fits = |step: &usize| along(width, *step).len() * along(height, *step).len() <= GRID;
    // Steps as long as the longer side leave one pixel.
    let step = (1..width.max(height)).find(fits).unwrap_or(width.max(height).max(1));
    let pixels: Vec<usize> =
        along(height, step).flat_map(|y| along(width, step).map(move |x| y * width + x)).collect();
    let weight = (width * height) as f64 / pixels.len().max(1) as f64;
    (pixels, weight)
}

fn thinned<T>(all: &[T], most: usize) -> impl Iterator<Item = &T> {
    all.iter().step_by(all.len().div_ceil(most).max(1))
}

fn has_mask(image: &PackedImage, pixel: usize) -> bool {
    image.pixels[pixel].to_le_bytes()[3] == 255
}

#[cfg(test)]
mod tests;
