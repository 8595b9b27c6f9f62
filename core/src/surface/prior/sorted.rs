//! Sorts all sparse points into those in the water, with their places by refracted rays, and dry ones.
//!
//! A point whose track can be judged is in the water if refracted rays explain the track better. Any other
//! point is in the water if it lies below the plane. Its place is then that of the rays that meet at the
//! point when they are not refracted.

use glam::DVec3;
use rayon::prelude::*;

use super::fit::Noise;
use super::sightings::{Sightings, Track};
use super::triangulate::{by_refracted_rays, error_px};
use super::{CLEARLY, WetPoint, median};
use crate::scene::Points;
use crate::surface::optics::Surface;

/// All points of a scene under a plane.
#[derive(Default)]
pub(super) struct Sorted {
    pub wet: Vec<WetPoint>,
    pub dry: Vec<u32>,
    /// Numbers of judged tracks: in the water, clearly so, and dry.
    pub wet_tracks: usize,
    pub clearly_wet: usize,
    pub dry_tracks: usize,
    /// Median errors, pixels an axis: of wet tracks, of the same by straight rays, and of dry tracks.
    pub wet_error_px: f64,
    pub wet_straight_error_px: f64,
    pub dry_error_px: f64,
}

/// What a point is.
enum Verdict {
    /// Its track is in the water. `gain` as in [`Noise::gain`].
    Wet { position: DVec3, error_px: f64, straight_px: f64, gain: f64 },
    /// Its track is not in the water.
    Dry { straight_px: f64 },
    /// Its track cannot be judged, and it lies below the plane.
    Below { position: DVec3 },
    /// The same for a point above it.
    Above,
}

impl Sorted {
    /// Sorts the points. `noise` is that of the tracks; without it no track is in the water.
    pub fn of(points: &Points, cameras: &Sightings, surface: &Surface, noise: Option<&Noise>) -> Self {
        let verdict = |point: u32| match cameras.track(points, point) {
            Some(track) => judged(cameras, &track, surface, noise),
            None => by_height(points, cameras, surface, point),
        };
        let verdicts: Vec<Verdict> = (0..points.len() as u32).into_par_iter().map(verdict).collect();
        let mut sorted = Self::default();
        let (mut wet_px, mut straight_wet_px, mut dry_px) = (Vec::new(), Vec::new(), Vec::new());
        for (point, verdict) in (0_u32..).zip(verdicts) {
            let colour = points.colours[point as usize];
            match verdict {
                Verdict::Wet { position, error_px, straight_px, gain } => {
                    sorted.wet.push(WetPoint { point, position, colour, error_px: Some(error_px) });
                    sorted.clearly_wet += usize::from(gain > CLEARLY);
                    wet_px.push(error_px);
                    straight_wet_px.push(straight_px);
                }
                Verdict::Dry { straight_px } => {
                    sorted.dry.push(point);
                    dry_px.push(straight_px);
                }
                Verdict::Below { position } => {
                    sorted.wet.push(WetPoint { point, position, colour, error_px: None });
                }
                Verdict::Above => sorted.dry.push(point),
            }
        }
        (sorted.wet_tracks, sorted.dry_tracks) = (wet_px.len(), dry_px.len());
        [sorted.wet_error_px, sorted.wet_straight_error_px, sorted.dry_error_px] =
            [wet_px, straight_wet_px, dry_px].map(median);
        sorted
    }
}

fn judged(cameras: &Sightings, track: &Track, surface: &Surface, noise: Option<&Noise>) -> Verdict {
    let sights = track.sights.len();
    let straight_px = error_px(track.straight.squares, sights);
    let refracted = noise.zip(by_refracted_rays(&cameras.eyes, track, surface, None));
    let found = refracted.map(|(noise, found)| (noise, found, noise.gain(track, found.squares)));
    match found.filter(|(noise, _, gain)| noise.odds(*gain) > 0.0) {
        Some((_, found, gain)) => Verdict::Wet {
            position: found.position,
            error_px: error_px(found.squares, sights),
            straight_px,
            gain,
        },
        None => Verdict::Dry { straight_px },
    }
}

fn by_height(points: &Points, cameras: &Sightings, surface: &Surface, point: u32) -> Verdict {
    let position = DVec3::from(points.positions[point as usize].map(f64::from));
    let is_below = surface.height(position) < 0.0;
    let refracted = || {
        let track = cameras.straight_track(points, point, position);
        by_refracted_rays(&cameras.eyes, &track, surface, None)
    };
    let found = if is_below { refracted() } else { None };
    found.map_or(Verdict::Above, |found| Verdict::Below { position: found.position })
}
