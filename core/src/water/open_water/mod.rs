//! Open water in photographs, and the darkest pixels at each range: evidence on the water beyond the sparse
//! points.
//!
//! A ray ends in open water if four conditions hold. It passes above everything that was reconstructed
//! (`hull`). Its cell of the picture has no texture at any scale (`cells`). No tracked point is near. And its
//! colour fits a smooth function of direction over all views (`colour`). Many such cells give the colour of
//! open water with its errors: observations at infinite range. With that colour, every view gets a map
//! (`map`) of open water, surface, unknown, and edges that are decided by pixel.
//!
//! The darkest pixels at each range are an upper bound of the backscatter (SeaThru; Akkaynak & Treibitz, CVPR
//! 2019). Ranges are those of the sparse points; the pixels around them are collected by range and direction
//! ([`DarkCell`]).
//!
//! Each photograph is read once, on one thread, and sums run in the order of views. Results therefore do not
//! depend on the number of threads.

mod cells;
mod colour;
mod hull;
mod map;

use glam::DVec3;
use rayon::prelude::*;

use super::ByDirection;
use super::observe::{position, project};
use crate::picture::srgb_to_linear;
use crate::scene::{PinholeCamera, Points};
use crate::views::{EndsOn, RayMap, TrainView, ViewSource};
use crate::{CoreError, Result};
use cells::Cells;
use colour::{Candidate, FARTHEST, Fitted};
use hull::{Hull, Levelled};

/// Maximum number of views, evenly thinned, for the colour of open water and the darkest pixels.
const MOST_VIEWS: usize = 512;
/// Number of photographs tallied at once: a tally takes 0.6 MB.
const BATCH: usize = 32;
/// Number of points projected into a view without tracks, evenly thinned.
const UNTRACKED: usize = 32_768;
/// Upper limit of the estimated noise, 8-bit codes: the texture of the smoothest twentieth of all cells.
const MOST_NOISE: f64 = 4.0;
/// A cell is smooth up to `SMOOTH + 1.5 noise` of texture and `STRAIGHT + noise` of bend, 8-bit codes.
const SMOOTH: f64 = 1.2;
const STRAIGHT: f64 = 2.0;
/// Minimum share of all cells for open water, and minimum number of views.
const LEAST_SHARE: f64 = 0.01;
const LEAST_VIEWS: usize = 3;
/// Minimum share of the candidate cells that must fit one colour by direction. In air, walls and windows are
/// above the scene: a fifth agreed on fox, at least 96 % on reefs.
const AGREEING: f64 = 0.6;
/// The points of a cell lie on one surface if the farthest range is less than this many times the nearest.
const MOST_DEPTH: f32 = 1.3;
/// Half-size of the square around a sparse point that is assumed at its range, as a share of the longer side
/// of the picture.
const AROUND: f64 = 1.0 / 148.0;
/// Numbers of classes of range, elevation and azimuth for the darkest pixels.
const BY_RANGE: usize = 16;
const BY_ELEVATION: usize = 4;
const BY_AZIMUTH: usize = 3;
/// Share of the pixels of a class below its dark value.
const DARKEST: f64 = 0.02;
/// Minimum number of pixels of a usable class.
const LEAST_PIXELS: u64 = 300;
/// Maximum number of open-water observations in fits, evenly thinned.
const MOST_OBSERVATIONS: usize = 400;

/// The evidence from all pixels of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Lookout {
    /// Open water, if photographs show it.
    pub(super) open: Option<OpenWater>,
    /// The darkest pixels by range and direction.
    pub(super) dark: Vec<DarkCell>,
    /// Up, right and forward of the levelled frame, if the cameras agree on one.
    pub(super) axes: Option<[DVec3; 3]>,
}

/// Open water that photographs show.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenWater {
    fitted: Fitted,
    /// Share of the cells of all views that show it.
    pub share: f64,
    /// Number of views that show it.
    pub views: usize,
    /// Directions, unit length, scene axes, and colours, linear light.
    pub(super) seen: Vec<(DVec3, [f64; 3])>,
}

impl OpenWater {
    /// The direction with the most typical colour among those observed, unit length, scene axes. The mean
    /// direction would not do if cameras look around: it points up, where no camera looked.
    pub fn middle(&self) -> DVec3 {
        let unusual = |direction: DVec3| -> f64 {
            let offset = direction - self.fitted.middle;
            self.fitted.slopes.iter().map(|slope| slope.dot(offset).powi(2)).sum()
        };
        let seen = self.seen.iter().map(|(direction, _)| *direction);
        seen.min_by(|a, b| unusual(*a).total_cmp(&unusual(*b))).map_or(DVec3::Z, DVec3::normalize)
    }

    /// Its colour in that direction, linear light, and the standard error of the colour.
    pub fn colour(&self) -> ([f64; 3], [f64; 3]) {
        let colour = self.fitted.along(self.middle());
        (colour, std::array::from_fn(|c| colour[c] * self.fitted.error[c]))
    }

    /// Change of the logarithm of its colour with direction, scene axes.
    pub(super) fn slopes(&self) -> [DVec3; 3] {
        self.fitted.slopes
    }
}

/// The darkest pixels of a class of range and direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DarkCell {
    /// Mean range, scene units.
    pub(super) range: f64,
    /// Mean direction, scene axes.
    pub(super) direction: DVec3,
    /// 2 % quantile of the pixels, linear light.
    pub(super) dark: [f64; 3],
    /// Median of the pixels, linear light.
    pub(super) middle: [f64; 3],
}

/// Analyses the photographs of `source`; `scene_views` as in [`super::observe`].
///
/// # Errors
/// When a photograph cannot be read.
pub(super) fn look_around(points: &Points, source: &dyn ViewSource, scene_views: &[u32]) -> Result<Lookout> {
    let views = source.views();
    let sighted = sighted(points, views, scene_views)?;
    let count = views.len().min(MOST_VIEWS);
    let chosen: Vec<usize> = (0..count).map(|k| k * views.len() / count).collect();
    let levelled = Levelled::of(views);
    let classes = Classes::of(points, views, &sighted, levelled);
    let hull = levelled.map(|levelled| Hull::new(levelled, points));
    let (mut looked, mut all) = (Vec::with_capacity(count), Tally::empty());
    for batch in chosen.chunks(BATCH) {
        let of_batch: Vec<(OfView, Option<Tally>)> = batch
            .par_iter()
            .map(|&view| {
                let image = source.load(view)?;
                let (of, seen) = (&views[view], &sighted[view]);
                let of_view = OfView::of(Cells::of(&image), points, of, seen, hull.as_ref());
                let tally = classes.as_ref().map(|classes| Tally::of(&image, classes, points, of, seen));
                Ok((of_view, tally))
            })
            .collect::<Result<_>>()?;
        for (of_view, tally) in of_batch {
            looked.push(of_view);
            tally.iter().for_each(|tally| all.add(tally));
        }
    }
    let noise = noise(looked.iter());
    let mut candidates = Vec::new();
    for (&view, of_view) in chosen.iter().zip(&looked) {
        let may_be = (0..of_view.means.len()).filter(|&cell| of_view.may_be_open(cell, noise));
        candidates.extend(may_be.map(|cell| Candidate {
            view: view as u32,
            direction: of_view.directions[cell],
            codes: of_view.means[cell],
        }));
    }
    let cells: usize = looked.iter().map(|of_view| of_view.means.len()).sum();
    let open = open_water(&candidates, cells);
    let dark = all.dark();
    let axes = levelled.map(|Levelled { up, right, forward }| [up, right, forward]);
    Ok(Lookout { open, dark, axes })
}

fn open_water(candidates: &[Candidate], cells: usize) -> Option<OpenWater> {
    let enough = |count: usize| count as f64 >= LEAST_SHARE * cells.max(1) as f64;
    if !enough(candidates.len()) {
        return None;
    }
    let fitted = Fitted::of(candidates)?;
    let agreeing: Vec<&Candidate> =
        candidates.iter().filter(|cell| fitted.distance(cell.direction, cell.codes) < FARTHEST).collect();
    let mut of_views: Vec<u32> = agreeing.iter().map(|cell| cell.view).collect();
    of_views.dedup();
    let agrees = agreeing.len() as f64 >= AGREEING * candidates.len() as f64;
    if !(enough(agreeing.len()) && agrees && of_views.len() >= LEAST_VIEWS) {
        return None;
    }
    let count = agreeing.len().min(MOST_OBSERVATIONS);
    let seen = (0..count).map(|k| agreeing[k * agreeing.len() / count]);
    let linear = |code: f32| srgb_to_linear(f64::from(code) / 255.0);
    let seen = seen.map(|cell| (cell.direction, cell.codes.map(linear))).collect();
    let share = agreeing.len() as f64 / cells as f64;
    Some(OpenWater { fitted, share, views: of_views.len(), seen })
}

/// The ray maps of every view of `source`. `open` holds the colour `b_inf` of open water, linear light, and
/// its factors by direction. Without open water, all rays end on surfaces. `scene_views` as in
/// [`super::observe`].
///
/// # Errors
/// When a photograph cannot be read.
pub fn ray_maps(
    points: &Points,
    source: &dyn ViewSource,
    scene_views: &[u32],
    open: Option<([f64; 3], Option<&ByDirection>)>,
) -> Result<Vec<RayMap>> {
    let views = source.views();
    let sighted = sighted(points, views, scene_views)?;
    let Some((b_inf, by_direction)) = open else {
        let all_surface = |(view, sighted): (&TrainView, &Vec<u32>)| {
            let [columns, rows] = cells::grid(view.camera.width, view.camera.height);
            let (_, ranges) = sightings([columns, rows], points, view, sighted);
            RayMap { columns, rows, cells: vec![EndsOn::Surface; ranges.len()], ranges, alike: 0.0 }
        };
        return Ok(views.par_iter().zip(&sighted).map(all_surface).collect());
    };
    let hull = Levelled::of(views).map(|levelled| Hull::new(levelled, points));
    let looked: Vec<OfView> = (0..views.len())
        .into_par_iter()
        .map(|view| {
            let cells = Cells::of(source.load(view)?.as_ref());
            Ok(OfView::of(cells, points, &views[view], &sighted[view], hull.as_ref()))
        })
        .collect::<Result<_>>()?;
    let noise = noise(looked.iter());
    let along = |direction: DVec3| {
        let factors = by_direction.map_or([1.0; 3], |by_direction| by_direction.factors(direction));
        std::array::from_fn(|c| b_inf[c] * factors[c])
    };
    Ok(map::ray_maps(looked, noise, along))
}

/// For each view, the points that it saw: those whose track contains it, or, without tracks, those projected
/// into its picture.
fn sighted(points: &Points, views: &[TrainView], scene_views: &[u32]) -> Result<Vec<Vec<u32>>> {
    if scene_views.len() != views.len() {
        return Err(CoreError::Scene(format!(
            "open water: {} views have {} indices in the scene",
            views.len(),
            scene_views.len()
        )));
    }
    let mut sighted = vec![Vec::new(); views.len()];
    if points.tracks.is_empty() {
        let step = points.len().div_ceil(UNTRACKED).max(1);
        sighted.par_iter_mut().zip(views).for_each(|(sighted, view)| {
            let inside = |point: &u32| project(view, position(points, *point)).is_some();
            sighted.extend((0..points.len() as u32).step_by(step).filter(inside));
        });
        return Ok(sighted);
    }
    let largest = scene_views.iter().max().map_or(0, |view| *view as usize + 1);
    let mut of_scene = vec![None; largest];
    for (view, &in_scene) in scene_views.iter().enumerate() {
        of_scene[in_scene as usize] = Some(view);
    }
    for point in 0..points.len() {
        for view in points.tracks.of(point) {
            if let Some(view) = of_scene.get(*view as usize).copied().flatten() {
                sighted[view].push(point as u32);
            }
        }
    }
    Ok(sighted)
}

/// Cells of a view with their geometry.
struct OfView {
    columns: u32,
    rows: u32,
    means: Vec<[f32; 3]>,
    texture: Vec<f32>,
    spread: Vec<f32>,
    bend: Vec<f32>,
    /// Unit directions, scene axes.
    directions: Vec<DVec3>,
    /// Whether a sighted point lies in the cell or beside it.
    near: Vec<bool>,
    /// Whether the ray passes above everything that was reconstructed.
    leaves: Vec<bool>,
    /// Whether the ray points down so steeply that it must end on a surface.
    steep: Vec<bool>,
    /// Range of the sighted points in the cell, scene units; 0 without points, or if their ranges differ too
    /// much.
    ranges: Vec<f32>,
}

impl OfView {
    fn of(cells: Cells, points: &Points, view: &TrainView, sighted: &[u32], hull: Option<&Hull>) -> Self {
        let PinholeCamera { width, height, fx, fy, cx, cy } = view.camera;
        let (columns, rows) = (cells.columns, cells.rows);
        let to_scene = view.pose.rotation.inverse();
        let middle = |index: u32, cells: u32, pixels: u32| {
            let span = cells::span(index, cells, pixels);
            f64::from(span.start + span.end) / 2.0
        };
        let directions: Vec<DVec3> = (0..rows * columns)
            .map(|index| {
                let (x, y) = (middle(index % columns, columns, width), middle(index / columns, rows, height));
                to_scene * DVec3::new((x - cx) / fx, (y - cy) / fy, 1.0).normalize()
            })
            .collect();
        let (near, ranges) = sightings([columns, rows], points, view, sighted);
        let outline = hull.map(|hull| (hull, hull.outline(view.pose.centre())));
        let leaves = directions.iter().map(|direction| {
            outline.as_ref().is_some_and(|(hull, outline)| hull.is_left_by(outline, *direction))
        });
        let steep = directions.iter().map(|direction| hull.is_some_and(|hull| hull.is_steep(*direction)));
        Self {
            columns,
            rows,
            means: cells.means,
            texture: cells.texture,
            spread: cells.spread,
            bend: cells.bend,
            leaves: leaves.collect(),
            steep: steep.collect(),
            ranges,
            directions,
            near,
        }
    }

    fn is_smooth(&self, cell: usize, noise: f64) -> bool {
        f64::from(self.texture[cell]) < SMOOTH + 1.5 * noise && f64::from(self.bend[cell]) < STRAIGHT + noise
    }

    fn may_be_open(&self, cell: usize, noise: f64) -> bool {
        self.leaves[cell] && !self.near[cell] && self.is_smooth(cell, noise)
    }
}

/// For each of `columns` x `rows` cells of a view, whether a sighted point lies in it or in a neighbour, and
/// the range of the points in it.
fn sightings(
    [columns, rows]: [u32; 2],
    points: &Points,
    view: &TrainView,
    sighted: &[u32],
) -> (Vec<bool>, Vec<f32>) {
    let count = (columns * rows) as usize;
    let (mut near, mut seen) = (vec![false; count], vec![Vec::new(); count]);
    for &point in sighted {
        let Some(([x, y], range)) = project(view, position(points, point)) else { continue };
        let at = |pixel: f64, cells: u32, pixels: u32| {
            (pixel * f64::from(cells) / f64::from(pixels)).min(f64::from(cells - 1)) as u32
        };
        let (column, row) = (at(x, columns, view.camera.width), at(y, rows, view.camera.height));
        seen[(row * columns + column) as usize].push(range as f32);
        for row in row.saturating_sub(1)..(row + 2).min(rows) {
            for column in column.saturating_sub(1)..(column + 2).min(columns) {
                near[(row * columns + column) as usize] = true;
            }
        }
    }
    (near, seen.into_iter().map(range_of_cell).collect())
}

/// The median range of a cell's points; 0 without points, or if the farthest is much farther than the
/// nearest.
fn range_of_cell(mut ranges: Vec<f32>) -> f32 {
    ranges.sort_by(f32::total_cmp);
    match (ranges.first(), ranges.last()) {
        (Some(nearest), Some(farthest)) if *farthest < MOST_DEPTH * nearest => ranges[ranges.len() / 2],
        _ => 0.0,
    }
}

/// Texture of the smoothest twentieth of all cells, 8-bit codes.
fn noise<'a>(views: impl Iterator<Item = &'a OfView>) -> f64 {
    let mut textures: Vec<f64> =
        views.flat_map(|of_view| of_view.texture.iter().map(|t| f64::from(*t))).collect();
    if textures.is_empty() {
        return 0.0;
    }
    let at = textures.len() / 20;
    textures.select_nth_unstable_by(at, f64::total_cmp).1.min(MOST_NOISE)
}

/// Classes of range and direction.
struct Classes {
    ranges: Vec<f64>,
    elevations: Vec<f64>,
    azimuths: Vec<f64>,
    levelled: Option<Levelled>,
}

impl Classes {
    /// Classes with equal numbers of sighted points by range, by elevation and by azimuth; `None` without
    /// points.
    fn of(
        points: &Points,
        views: &[TrainView],
        sighted: &[Vec<u32>],
        levelled: Option<Levelled>,
    ) -> Option<Self> {
        let (mut ranges, mut elevations, mut azimuths) = (Vec::new(), Vec::new(), Vec::new());
        for (view, sighted) in views.iter().zip(sighted) {
            let eye = view.pose.centre();
            for &point in sighted.iter().step_by(sighted.len().div_ceil(1024).max(1)) {
                let away = position(points, point) - eye;
                ranges.push(away.length());
                if let Some(levelled) = levelled {
                    elevations.push(away.normalize_or_zero().dot(levelled.up));
                    azimuths.push(away.normalize_or_zero().dot(levelled.right));
                }
            }
        }
        let borders = |mut values: Vec<f64>, classes: usize| -> Vec<f64> {
            if values.is_empty() {
                return Vec::new();
            }
            values.sort_unstable_by(f64::total_cmp);
            (1..classes).map(|k| values[k * values.len() / classes]).collect()
        };
        let is_seen = !ranges.is_empty();
        is_seen.then(|| Self {
            ranges: borders(ranges, BY_RANGE),
            elevations: borders(elevations, BY_ELEVATION),
            azimuths: borders(azimuths, BY_AZIMUTH),
            levelled,
        })
    }

    fn class(&self, range: f64, direction: DVec3) -> usize {
        let place = |borders: &[f64], value: f64| borders.partition_point(|border| *border <= value);
        let (elevation, azimuth) = self.levelled.map_or((0, 0), |levelled| {
            let of = |borders: &[f64], axis: DVec3| place(borders, direction.dot(axis));
            (of(&self.elevations, levelled.up), of(&self.azimuths, levelled.right))
        });
        (place(&self.ranges, range) * BY_ELEVATION + elevation) * BY_AZIMUTH + azimuth
    }
}

/// Pixels by class.
struct Tally {
    /// Histogram of 8-bit codes by class and channel.
    codes: Vec<[[u32; 256]; 3]>,
    /// Sums of ranges and directions by class.
    sums: Vec<(f64, DVec3)>,
}

impl Tally {
    fn empty() -> Self {
        let classes = BY_RANGE * BY_ELEVATION * BY_AZIMUTH;
        Self { codes: vec![[[0; 256]; 3]; classes], sums: vec![(0.0, DVec3::ZERO); classes] }
    }

    /// Counts the pixels around the sighted points of a view. A pixel near several points gets the smallest
    /// of their ranges.
    fn of(
        image: &crate::views::PackedImage,
        classes: &Classes,
        points: &Points,
        view: &TrainView,
        sighted: &[u32],
    ) -> Self {
        let mut seen: Vec<(f64, [f64; 2])> = sighted
            .iter()
            .filter_map(|point| project(view, position(points, *point)))
            .map(|(at, range)| (range, at))
            .collect();
        seen.sort_by(|a, b| {
            b.0.total_cmp(&a.0).then(a.1[0].total_cmp(&b.1[0])).then(a.1[1].total_cmp(&b.1[1]))
        });
        let around = (AROUND * f64::from(image.width.max(image.height))).round().max(1.0) as i64;
        let (width, height) = (i64::from(image.width), i64::from(image.height));
        let mut ranges = vec![0.0_f64; image.pixels.len()];
        for (range, [x, y]) in seen {
            let (x, y) = (x as i64, y as i64);
            for row in (y - around).max(0)..(y + around + 1).min(height) {
                let (left, right) = ((x - around).max(0), (x + around + 1).min(width));
                ranges[(row * width + left) as usize..(row * width + right) as usize].fill(range);
            }
        }
        let mut tally = Self::empty();
        let to_scene = view.pose.rotation.inverse();
        for (index, (pixel, range)) in image.pixels.iter().zip(ranges).enumerate() {
            let [r, g, b, counts] = pixel.to_le_bytes();
            if range == 0.0 || counts != 255 {
                continue;
            }
            let direction = to_scene * view.camera.direction(index);
            let class = classes.class(range, direction);
            for (codes, code) in tally.codes[class].iter_mut().zip([r, g, b]) {
                codes[usize::from(code)] += 1;
            }
            tally.sums[class].0 += range;
            tally.sums[class].1 += direction;
        }
        tally
    }

    fn add(&mut self, other: &Self) {
        for (own, more) in self.codes.iter_mut().zip(&other.codes) {
            for (own, more) in own.iter_mut().zip(more) {
                own.iter_mut().zip(more).for_each(|(own, more)| *own += more);
            }
        }
        for (own, more) in self.sums.iter_mut().zip(&other.sums) {
            own.0 += more.0;
            own.1 += more.1;
        }
    }

    fn dark(&self) -> Vec<DarkCell> {
        let of_class = |(codes, (range, direction)): (&[[u32; 256]; 3], &(f64, DVec3))| {
            let count = codes[0].iter().map(|count| u64::from(*count)).sum::<u64>();
            let n = count as f64;
            let light =
                |share: f64| codes.map(|codes| srgb_to_linear(quantile_code(&codes, share * n) / 255.0));
            (count >= LEAST_PIXELS).then(|| DarkCell {
                range: range / n,
                direction: *direction / n,
                dark: light(DARKEST),
                middle: light(0.5),
            })
        };
        self.codes.iter().zip(&self.sums).filter_map(of_class).collect()
    }
}

/// The code below which `below` of the pixels lie; the pixels of one code are spread evenly over it.
fn quantile_code(codes: &[u32; 256], below: f64) -> f64 {
    let mut passed = 0.0;
    for (code, count) in codes.iter().enumerate() {
        let count = f64::from(*count);
        if passed + count > below {
            return (code as f64 - 0.5 + (below - passed) / count).max(0.0);
        }
        passed += count;
    }
    255.0
}

#[cfg(test)]
pub(super) mod fixture;
#[cfg(test)]
mod tests;
