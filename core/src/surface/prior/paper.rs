//! The rule by which the paper of WSGS starts the offset, for comparison.

use super::sightings::Sightings;
use super::triangulate::error_px;
use super::{Fixed, up};
use crate::surface::optics::Surface;

/// The part of the tracks whose errors are the largest.
const PART: f64 = 0.05;

/// The plane of the paper's rule: halfway between the lowest camera and the mean height of the 5 % of the
/// tracks with the largest reprojection errors. These are in the water. The paper's normal is given with a
/// scene; where it is not, the most likely direction up serves. What is given is kept.
///
/// `None` without tracks.
pub(super) fn plane(sightings: &Sightings, fixed: &Fixed) -> Option<Surface> {
    let normal = fixed.normal.or(fixed.up).or_else(|| up::candidates(&sightings.eyes).first().copied())?;
    let mut errors: Vec<(f64, f64)> = sightings
        .tracks
        .iter()
        .map(|track| {
            let error = error_px(track.straight.squares, track.sights.len());
            (error, normal.dot(track.straight.position))
        })
        .collect();
    errors.sort_by(|a, b| b.0.total_cmp(&a.0));
    errors.truncate((PART * errors.len() as f64).ceil() as usize);
    if errors.is_empty() {
        return None;
    }
    let mean = errors.iter().map(|(_, height)| height).sum::<f64>() / errors.len() as f64;
    let lowest = sightings.eyes.iter().map(|eye| normal.dot(eye.centre)).fold(f64::INFINITY, f64::min);
    let offset = fixed.offset.unwrap_or(0.5 * (mean + lowest));
    Some(Surface { normal, offset, ior: fixed.ior })
}
