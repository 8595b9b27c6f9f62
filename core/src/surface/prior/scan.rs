//! Finds about where the plane is: tries offsets for many normals near those that may be up.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::Fixed;
use super::fit::Noise;
use super::sightings::{Sightings, evenly};
use super::triangulate::{error_px, start_of};
use super::up;
use crate::surface::optics::Surface;

/// Tracks that are tried.
const TRACKS: usize = 400;
/// Offsets at even distances, and as many more at the heights of points: water lies between its ground and
/// its shore, however high the cameras are.
const OFFSETS: usize = 32;
/// Tilts of the normals that are tried, degrees, each in [`AROUND`] directions.
const TILTS_DEGREES: [f64; 2] = [4.0, 10.0];
const AROUND: u32 = 6;

/// The plane under which the tracks are most likely; `None` if no plane explains any track better than
/// straight rays.
///
/// Cameras may be below planes that are tried. Tracks of theirs count as dry.
pub(super) fn scan(sightings: &Sightings, fixed: &Fixed) -> Option<Surface> {
    let some = sightings.evenly(TRACKS);
    let noise = first_noise(&some);
    let normals = match (fixed.normal, fixed.up) {
        (Some(normal), _) => vec![normal],
        (None, Some(up)) => around(up),
        (None, None) => up::candidates(&some.eyes).into_iter().flat_map(around).collect(),
    };
    let planes: Vec<Surface> = normals
        .into_iter()
        .flat_map(|normal| {
            let offsets = fixed.offset.map_or_else(|| offsets(&some, normal), |offset| vec![offset]);
            offsets.into_iter().map(move |offset| Surface { normal, offset, ior: fixed.ior })
        })
        .collect();
    let gain = |plane: &Surface| {
        let of_track = |track| {
            let (_, squares) = start_of(&some.eyes, track, plane)?;
            Some(noise.gain(track, squares).max(0.0))
        };
        some.tracks.iter().filter_map(of_track).sum::<f64>()
    };
    let gains: Vec<f64> = planes.par_iter().map(gain).collect();
    let best = (0..planes.len()).max_by(|&a, &b| gains[a].total_cmp(&gains[b]).then(b.cmp(&a)))?;
    (gains[best] > 0.0 || fixed.offset.is_some()).then(|| planes[best])
}

/// The noise of pixels before it is known which tracks are dry: that of the better quarter.
fn first_noise(some: &Sightings) -> Noise {
    let errors = some.tracks.iter().map(|track| error_px(track.straight.squares, track.sights.len()));
    let mut errors: Vec<f64> = errors.collect();
    let at = errors.len() / 4;
    let quarter = if errors.is_empty() { 0.0 } else { *errors.select_nth_unstable_by(at, f64::total_cmp).1 };
    Noise::of(quarter)
}

/// A direction and directions around it.
fn around(up: DVec3) -> Vec<DVec3> {
    let side = up.any_orthonormal_vector();
    let tilted = TILTS_DEGREES.into_iter().flat_map(|tilt| {
        (0..AROUND).map(move |k| {
            let turn = std::f64::consts::TAU * f64::from(k) / f64::from(AROUND);
            let axis = DQuat::from_axis_angle(up, turn) * side;
            DQuat::from_axis_angle(axis, tilt.to_radians()) * up
        })
    });
    std::iter::once(up).chain(tilted).collect()
}

/// Offsets from the lowest points to the highest camera.
fn offsets(some: &Sightings, normal: DVec3) -> Vec<f64> {
    let mut heights: Vec<f64> = some.tracks.iter().map(|track| normal.dot(track.straight.position)).collect();
    heights.sort_by(f64::total_cmp);
    let top = some.eyes.iter().map(|eye| normal.dot(eye.centre)).fold(f64::NEG_INFINITY, f64::max);
    let bottom = heights.get(heights.len() / 50).copied().unwrap_or(top);
    let even = (0..OFFSETS).map(|k| bottom + (top - bottom) * (k as f64 + 0.5) / OFFSETS as f64);
    // A little above the point, so that it can be in the water.
    let raise = 0.005 * (top - bottom);
    let of_points = evenly(heights.len(), OFFSETS).map(|index| heights[index] + raise);
    even.chain(of_points).collect()
}
