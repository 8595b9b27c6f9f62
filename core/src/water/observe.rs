//! Samples the colours of sparse points in photographs, for [`sparse_prior`](super::sparse_prior).
//!
//! A colour is the mean of a square window of the same size in the scene at every range. A distant view blurs
//! what a near one resolves, and points lie on strong texture. Single pixels of a point would therefore
//! differ by more than the effect of the water. The track of a point lists the views that saw it. Without
//! tracks, it is every view that the point projects into, unless a much nearer sparse point lies in the same
//! direction. The robust estimate handles the errors of this rule.
//!
//! Work is limited by [`MAX_POINTS`], [`MAX_OBSERVATIONS`] and, without tracks, [`MAX_VIEWS`]; points and
//! views are thinned evenly. Each photograph is loaded at most once, with at most one in memory per thread.

use std::sync::LazyLock;

use glam::DVec3;
use rayon::prelude::*;

use super::{ByDirection, Observation};
use crate::picture::srgb_to_linear;
use crate::scene::{PinholeCamera, Points};
use crate::views::{PackedImage, TrainView, ViewSource};
use crate::{CoreError, Result};

/// Maximum number of points sampled.
pub const MAX_POINTS: usize = 20_000;
/// Maximum number of colours sampled.
pub const MAX_OBSERVATIONS: usize = 300_000;
/// Maximum number of views sampled without tracks.
pub const MAX_VIEWS: usize = 512;

/// Half the side of a window at the median range, pixels. The colour in a window still depends slightly on
/// range: pixels of a distant view blur, and a view along the ground covers more of it. On the wreck in nine
/// waters (240x180), this value gave a green beta_b that was up to 7 % too high. With 2, it was 5 to 16 % too
/// high. With 9, it was up to 14 %, since windows then include surfaces nearer or farther than the point.
const HALF_WINDOW_PX: f64 = 3.0;
/// Maximum as a share of the longer side of the picture, since small pictures show edges rather than detail;
/// but at least [`MIN_HALF_WINDOW_PX`].
const MAX_HALF_WINDOW_SHARE: f64 = 1.0 / 80.0;
const MIN_HALF_WINDOW_PX: f64 = 1.5;
/// Size of the smaller window, which shows the effect of window size, as a share of the other.
const FINER: f64 = 0.5;
/// Maximum half side of any window, pixels.
const MAX_HALF_WINDOW_PX: f64 = 12.0;
/// Codes from this one on may be saturated.
const SATURATED: u8 = 254;
/// Number of cells along the longer side of a picture, in which nearer points hide farther ones.
const CELLS: f64 = 64.0;
/// Maximum range of a visible point relative to the nearest point of its cell.
const HIDDEN_BEYOND: f64 = 1.1;
/// Maximum number of points that may hide others.
const MAX_HIDING: usize = 200_000;

/// Linear light of each 8-bit code.
static LINEAR: LazyLock<[f64; 256]> =
    LazyLock::new(|| std::array::from_fn(|code| srgb_to_linear(code as f64 / 255.0)));

/// The result of [`observe`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observed {
    /// The scene index of each point used; ascending.
    pub points: Vec<u32>,
    /// Colours by point and range; their `point` is an index into `points`.
    pub observations: Vec<Observation>,
}

impl Observed {
    /// Sets the tints of the observations from `by_direction`.
    pub fn tint(&mut self, by_direction: &ByDirection) {
        for seen in &mut self.observations {
            seen.tint = by_direction.factors(DVec3::from(seen.direction));
        }
    }
}

/// One point to sample in one view.
#[derive(Clone, Copy)]
struct Sighting {
    point: u32,
    view: u32,
    range: f64,
}

/// Samples the colours of the sparse points in the photographs of `source`.
///
/// `scene_views[i]` is the index of the source's view `i` among the views of the scene by name. The tracks of
/// `points` refer to these indices. Views missing from `source`, such as held-out views, are ignored.
///
/// # Errors
/// When `scene_views` does not have one index per view, or a photograph cannot be loaded.
pub fn observe(points: &Points, source: &dyn ViewSource, scene_views: &[u32]) -> Result<Observed> {
    let views = source.views();
    if scene_views.len() != views.len() {
        return Err(CoreError::Scene(format!(
            "sparse points: {} views have {} indices in the scene",
            views.len(),
            scene_views.len()
        )));
    }
    let (points_of_scene, mut sightings) = if points.tracks.is_empty() {
        by_projection(points, views)
    } else {
        by_tracks(points, views, scene_views)
    };
    sightings = thinned(sightings);
    let Some(window) = window_in_scene(&sightings, views) else {
        return Ok(Observed::default());
    };

    // Grouped by view, so that each photograph is loaded once; `order` maps back to sightings.
    let mut order: Vec<u32> = (0..sightings.len() as u32).collect();
    order.sort_by_key(|&index| sightings[index as usize].view);
    let by_view: Vec<&[u32]> =
        order.chunk_by(|&a, &b| sightings[a as usize].view == sightings[b as usize].view).collect();
    let colours = by_view
        .into_par_iter()
        .map(|indices| {
            let view = sightings[indices[0] as usize].view as usize;
            let image = source.load(view)?;
            let look = |&index: &u32| {
                let at = place(points, &points_of_scene, &sightings[index as usize]);
                let colour = |window| look_up(&image, &views[view], at, window);
                (index, colour(window).zip(colour(FINER * window)))
            };
            Ok(indices.iter().map(look).collect::<Vec<_>>())
        })
        .collect::<Result<Vec<_>>>()?;
    let mut colour_of = vec![None; sightings.len()];
    for (index, colour) in colours.into_iter().flatten() {
        colour_of[index as usize] = colour;
    }
    let observations = sightings
        .iter()
        .zip(colour_of)
        .filter_map(|(s, colours)| {
            let (colour, finer) = colours?;
            let away = place(points, &points_of_scene, s) - views[s.view as usize].pose.centre();
            let direction = away.normalize_or_zero().to_array();
            Some(Observation { point: s.point, range: s.range, colour, finer, direction, tint: [1.0; 3] })
        })
        .collect();
    Ok(Observed { points: points_of_scene, observations })
}

pub(super) fn position(points: &Points, index: u32) -> DVec3 {
    DVec3::from(points.positions[index as usize].map(f64::from))
}

fn place(points: &Points, points_of_scene: &[u32], sighting: &Sighting) -> DVec3 {
    position(points, points_of_scene[sighting.point as usize])
}

/// At most `most` of the numbers, evenly spaced.
fn evenly(numbers: &[u32], most: usize) -> Vec<u32> {
    let kept = numbers.len().min(most);
    (0..kept).map(|k| numbers[(k as u64 * numbers.len() as u64 / kept as u64) as usize]).collect()
}

/// The pixel position and the range of a point; `None` behind the camera or outside the picture.
pub(super) fn project(view: &TrainView, point: DVec3) -> Option<([f64; 2], f64)> {
    let PinholeCamera { width, height, fx, fy, cx, cy } = view.camera;
    let p = view.pose.transform(point);
    let (x, y) = (fx * p.x / p.z + cx, fy * p.y / p.z + cy);
    let inside = p.z > 0.0 && (0.0..f64::from(width)).contains(&x) && (0.0..f64::from(height)).contains(&y);
    inside.then(|| ([x, y], p.length()))
}

/// Sightings of points that have at least two, by point and range.
fn by_tracks(points: &Points, views: &[TrainView], scene_views: &[u32]) -> (Vec<u32>, Vec<Sighting>) {
    let largest = scene_views.iter().max().map_or(0, |view| *view as usize + 1);
    let mut view_of_scene = vec![None; largest];
    for (view, &in_scene) in (0_u32..).zip(scene_views) {
        view_of_scene[in_scene as usize] = Some(view);
    }
    let seen = |point: u32| {
        let track = points.tracks.of(point as usize);
        track.iter().filter_map(|&view| view_of_scene.get(view as usize).copied().flatten())
    };
    let candidates: Vec<u32> =
        (0..points.len() as u32).filter(|&point| seen(point).nth(1).is_some()).collect();
    let chosen = evenly(&candidates, MAX_POINTS);
    let sightings = chosen
        .par_iter()
        .enumerate()
        .flat_map_iter(|(slot, &index)| {
            let at = position(points, index);
            let mut own: Vec<Sighting> = seen(index)
                .filter_map(|view| {
                    let (_, range) = project(&views[view as usize], at)?;
                    Some(Sighting { point: slot as u32, view, range })
                })
                .collect();
            own.sort_by(|a, b| a.range.total_cmp(&b.range).then(a.view.cmp(&b.view)));
            own
        })
        .collect();
    (chosen, sightings)
}

/// Like [`by_tracks`], from geometry alone.
fn by_projection(points: &Points, views: &[TrainView]) -> (Vec<u32>, Vec<Sighting>) {
    let all: Vec<u32> = (0..points.len() as u32).collect();
    let chosen = evenly(&all, MAX_POINTS);
    let hiding = evenly(&all, MAX_HIDING);
    let looked_through = evenly(&(0..views.len() as u32).collect::<Vec<_>>(), MAX_VIEWS);
    let of_view = |&index: &u32| {
        let view = &views[index as usize];
        let cell_px = f64::from(view.camera.width.max(view.camera.height)) / CELLS;
        let columns = (f64::from(view.camera.width) / cell_px).ceil() as usize;
        let rows = (f64::from(view.camera.height) / cell_px).ceil() as usize;
        let cell = |[x, y]: [f64; 2]| {
            ((y / cell_px) as usize).min(rows - 1) * columns + ((x / cell_px) as usize).min(columns - 1)
        };
        let mut nearest = vec![f64::INFINITY; columns * rows];
        for &point in &hiding {
            if let Some((pixel, range)) = project(view, position(points, point)) {
                let nearest = &mut nearest[cell(pixel)];
                *nearest = nearest.min(range);
            }
        }
        let mut seen = Vec::new();
        for (slot, &point) in (0_u32..).zip(&chosen) {
            if let Some((pixel, range)) = project(view, position(points, point))
                && range <= HIDDEN_BEYOND * nearest[cell(pixel)]
            {
                seen.push(Sighting { point: slot, view: index, range });
            }
        }
        seen
    };
    let mut sightings: Vec<Sighting> = looked_through.par_iter().flat_map_iter(of_view).collect();
    let key = |a: &Sighting, b: &Sighting| {
        a.point.cmp(&b.point).then(a.range.total_cmp(&b.range)).then(a.view.cmp(&b.view))
    };
    sightings.par_sort_unstable_by(key);
    (chosen, sightings)
}

/// Reduces sightings to [`MAX_OBSERVATIONS`]: points with the most sightings lose some, evenly from near to
/// far.
fn thinned(sightings: Vec<Sighting>) -> Vec<Sighting> {
    let of_point = || sightings.chunk_by(|a, b| a.point == b.point);
    let kept = |most: usize| of_point().map(|own| own.len().min(most)).sum::<usize>();
    if sightings.len() <= MAX_OBSERVATIONS {
        return sightings;
    }
    // Finds the largest possible number per point: 20,000 points have room for at least 15 each.
    let (mut low, mut high) = (2, sightings.len());
    while low + 1 < high {
        let middle = low.midpoint(high);
        if kept(middle) <= MAX_OBSERVATIONS { low = middle } else { high = middle }
    }
    let thin = |own: &[Sighting]| -> Vec<Sighting> {
        let count = own.len().min(low);
        // The nearest and the farthest are kept, since they carry the most information.
        (0..count).map(|k| own[if count > 1 { k * (own.len() - 1) / (count - 1) } else { 0 }]).collect()
    };
    of_point().flat_map(thin).collect()
}

/// Half the side of a window on the scene, scene units; `None` without sightings.
fn window_in_scene(sightings: &[Sighting], views: &[TrainView]) -> Option<f64> {
    let half = |sighting: &Sighting| {
        let PinholeCamera { width, height, fx, .. } = views[sighting.view as usize].camera;
        let share = MAX_HALF_WINDOW_SHARE * f64::from(width.max(height));
        share.clamp(MIN_HALF_WINDOW_PX, HALF_WINDOW_PX) * sighting.range / fx
    };
    let mut halves: Vec<f64> = sightings.iter().map(half).filter(|half| half.is_finite()).collect();
    let middle = halves.len() / 2;
    (!halves.is_empty()).then(|| *halves.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Mean colour in linear light of the window around a point, NaN in a channel with a saturated pixel. `None`
/// if a pixel of the window is masked, or the point is outside the picture.
fn look_up(image: &PackedImage, view: &TrainView, point: DVec3, half_window: f64) -> Option<[f64; 3]> {
    let ([x, y], range) = project(view, point)?;
    let sides = |at: f64, focal: f64, size: u32| {
        let half = (half_window * focal / range).clamp(0.5, MAX_HALF_WINDOW_PX);
        ((at - half).max(0.0), (at + half).min(f64::from(size)))
    };
    let (left, right) = sides(x, view.camera.fx, image.width);
    let (top, bottom) = sides(y, view.camera.fy, image.height);
    // The part of pixel `index` between the two sides.
    let share =
        |index: u32, from: f64, to: f64| (f64::from(index + 1).min(to) - f64::from(index).max(from)).max(0.0);
    let (mut sum, mut area) = ([0.0; 3], 0.0);
    for row in top as u32..(bottom.ceil() as u32).min(image.height) {
        for column in left as u32..(right.ceil() as u32).min(image.width) {
            let part = share(column, left, right) * share(row, top, bottom);
            if part <= 0.0 {
                continue;
            }
            let [r, g, b, counts] = image.pixels[(row * image.width + column) as usize].to_le_bytes();
            if counts != 255 {
                return None;
            }
            for (sum, code) in sum.iter_mut().zip([r, g, b]) {
                *sum += if code >= SATURATED { f64::NAN } else { part * LINEAR[usize::from(code)] };
            }
            area += part;
        }
    }
    (area > 0.0).then(|| sum.map(|sum| sum / area))
}

#[cfg(test)]
#[path = "observe_tests.rs"]
mod tests;
