//! Refines a plane until the tracks are most likely, with the errors of the result.
//!
//! A track has v = 2 views - 3 degrees of freedom, and the squares S under rays of one kind. Its density is
//! that of Student's t: `(1 + S / (TAIL s^2))^(-(TAIL + v) / 2)`. [`TAIL`] is the degrees of freedom of the
//! tail, and s the noise of a pixel. With the share p of wet tracks, the likelihood of a track is
//! `p L(refracted) + (1 - p) L(straight)`. The plane maximises the product by steps of Gauss and Newton, with
//! p and s found along (expectation maximisation).
//!
//! A plane has three parameters about the point `centre` of it: its height there and two tilts.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::Fixed;
use super::sightings::{Eye, MOST_VIEWS, Sightings, Track};
use super::triangulate::{Found, by_refracted_rays, error_px, freedom, outer};
use crate::surface::optics::{Motion, Surface};

/// Degrees of freedom of the tail: wrong matches count little, and good tracks almost alike.
const TAIL: f64 = 4.0;
/// Steps, at most.
const ROUNDS: u32 = 30;
/// The largest step: tilt in radians, height as a share of the viewing distance.
const MAX_TILT: f64 = 0.05;
const MAX_HEIGHT: f64 = 0.1;
/// A step that promises less log-likelihood ends the search: it is a thousandth of a standard error.
const SETTLED: f64 = 1e-6;
/// The least noise of a pixel, pixels: places of observations are stored in steps of this size at best.
const MIN_NOISE_PX: f64 = 1e-3;

/// Likelihoods of tracks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    /// Variance of a pixel along an axis.
    variance: f64,
    /// Share of those in the water among the tracks that can be there.
    wet_share: f64,
}

/// A plane that was fitted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fitted {
    pub surface: Surface,
    /// The mean of the crossings.
    pub centre: DVec3,
    /// Of the height at `centre`, scene units, and of the angle, radians.
    pub standard_error: [f64; 2],
    pub noise: Noise,
}

impl Noise {
    /// For pixels with this error, before the share of wet tracks is known.
    pub fn of(error_px: f64) -> Self {
        Self { variance: error_px.max(MIN_NOISE_PX).powi(2), wet_share: 0.5 }
    }

    fn log_density(&self, squares: f64, sights: usize) -> f64 {
        -0.5 * (TAIL + freedom(sights)) * (squares / (TAIL * self.variance)).ln_1p()
    }

    /// How much more likely, as a logarithm, these squares by refracted rays are than those by straight rays.
    pub fn gain(&self, track: &Track, squares: f64) -> f64 {
        let sights = track.sights.len();
        self.log_density(squares, sights) - self.log_density(track.straight.squares, sights)
    }

    /// Logarithmic odds that a track is in the water, from its gain.
    pub fn odds(&self, gain: f64) -> f64 {
        gain + (self.wet_share / (1.0 - self.wet_share)).ln()
    }

    /// Weight of the squares under the tail.
    fn weight(&self, squares: f64, sights: usize) -> f64 {
        (TAIL + freedom(sights)) / (TAIL * self.variance + squares)
    }
}

/// A track under a plane.
#[derive(Clone, Copy)]
struct Wet {
    found: Found,
    /// Mean crossing.
    crossing: DVec3,
    /// Of the three parameters with the point eliminated, for half of the squares.
    hessian: DMat3,
    gradient: DVec3,
    /// The part of each sight in `gradient`.
    by_sight: [DVec3; MOST_VIEWS],
}

/// The directions in which a plane may move: its height at a point of it, and two tilts about that point.
fn motions(surface: &Surface, centre: DVec3, fixed: &Fixed) -> [Motion; 3] {
    let still = Motion::default();
    let (a, b) = surface.normal.any_orthonormal_pair();
    let tilt = |normal: DVec3| {
        // With a given offset the plane turns about the foot of the origin instead.
        let offset = if fixed.offset.is_some() { 0.0 } else { normal.dot(centre) };
        if fixed.normal.is_some() { still } else { Motion { normal, offset, ..still } }
    };
    let rise = Motion { offset: if fixed.offset.is_some() { 0.0 } else { 1.0 }, ..still };
    [rise, tilt(a), tilt(b)]
}

/// The plane after the motions with these amounts.
fn moved(surface: &Surface, motions: &[Motion; 3], by: DVec3) -> Surface {
    let by = by.to_array();
    let normal: DVec3 = motions.iter().zip(by).map(|(motion, by)| motion.normal * by).sum();
    let offset: f64 = motions.iter().zip(by).map(|(motion, by)| motion.offset * by).sum();
    // The length of the sum is 1 to first order; dividing both keeps the plane. A given offset must not
    // change, though, and a given normal does not move.
    let sum = surface.normal + normal;
    let length = if motions[0].offset == 0.0 { 1.0 } else { sum.length() };
    Surface { normal: sum.normalize(), offset: (surface.offset + offset) / length, ior: surface.ior }
}

fn wet_track(
    eyes: &[Eye],
    track: &Track,
    surface: &Surface,
    start: Option<DVec3>,
    motions: &[Motion; 3],
) -> Option<Wet> {
    // A start from another plane may be dry under this one.
    let found = start
        .and_then(|start| by_refracted_rays(eyes, track, surface, Some(start)))
        .or_else(|| by_refracted_rays(eyes, track, surface, None))?;
    let position = found.position;
    let (mut own, mut mixed, mut plane) = (DMat3::ZERO, DMat3::ZERO, DMat3::ZERO);
    let mut crossings = DVec3::ZERO;
    let mut by_sight = [(DVec3::ZERO, DVec3::ZERO); MOST_VIEWS];
    for (sight, (own_gradient, gradient)) in track.sights.iter().zip(&mut by_sight) {
        let eye = &eyes[sight.eye as usize];
        let crossing = surface.crossing(eye.centre, position)?;
        let (pixel, slopes) = eye.project(crossing.at)?;
        let by = |motion: &Motion| crossing.moved(eye.centre, position, surface, motion);
        let of_point = [DVec3::X, DVec3::Y, DVec3::Z].map(|point| by(&Motion { point, ..Motion::default() }));
        let of_plane = [by(&motions[0]), by(&motions[1]), by(&motions[2])];
        for k in 0..2 {
            let residual = pixel[k] - sight.pixel[k];
            let by_point = DVec3::from(of_point.map(|moved| slopes[k].dot(moved)));
            let by_plane = DVec3::from(of_plane.map(|moved| slopes[k].dot(moved)));
            own += outer(by_point, by_point);
            mixed += outer(by_point, by_plane);
            plane += outer(by_plane, by_plane);
            *own_gradient += by_point * residual;
            *gradient += by_plane * residual;
        }
        crossings += crossing.at / track.sights.len() as f64;
    }
    let eliminated = mixed.transpose() * own.inverse();
    let hessian = plane - eliminated * mixed;
    let by_sight = by_sight.map(|(own_gradient, gradient)| gradient - eliminated * own_gradient);
    let gradient: DVec3 = by_sight.iter().sum();
    let is_sound = hessian.is_finite() && gradient.is_finite();
    is_sound.then_some(Wet { found, crossing: crossings, hessian, gradient, by_sight })
}

/// The tracks under one plane.
struct State {
    surface: Surface,
    wet: Vec<Option<Wet>>,
}

impl State {
    fn new(sightings: &Sightings, surface: Surface, before: Option<&Self>, motions: &[Motion; 3]) -> Self {
        let start = |index: usize| before.and_then(|before| before.wet[index].map(|wet| wet.found.position));
        let wet = sightings.tracks.par_iter().enumerate();
        let wet =
            wet.map(|(index, track)| wet_track(&sightings.eyes, track, &surface, start(index), motions));
        Self { surface, wet: wet.collect() }
    }

    /// Sum of the log-likelihoods.
    fn likelihood(&self, tracks: &[Track], noise: &Noise) -> f64 {
        let of = |(track, wet): (&Track, &Option<Wet>)| {
            let straight = noise.log_density(track.straight.squares, track.sights.len());
            // A point that reaches the surface has the same likelihood in and out of the water.
            let Some(wet) = wet else { return straight };
            let odds = noise.odds(noise.gain(track, wet.found.squares));
            // ln((1 - p) e^straight + p e^refracted), safe for odds of any size.
            straight + (1.0 - noise.wet_share).ln() + odds.max(0.0) + (-odds.abs()).exp().ln_1p()
        };
        tracks.iter().zip(&self.wet).map(of).sum()
    }

    /// Noise and share of wet tracks that fit this plane.
    fn noise(&self, tracks: &[Track], noise: &Noise) -> Noise {
        let (mut errors, mut sum, mut count) = (Vec::with_capacity(tracks.len()), 0.0, 0.0);
        for (track, wet) in tracks.iter().zip(&self.wet) {
            let chance = wet.map_or(0.0, |wet| chance(noise.odds(noise.gain(track, wet.found.squares))));
            let squares =
                wet.filter(|_| chance > 0.5).map_or(track.straight.squares, |wet| wet.found.squares);
            // The median of a mean of v squares is below its mean (Wilson and Hilferty 1931).
            let below = (1.0 - 2.0 / (9.0 * freedom(track.sights.len()))).powf(1.5);
            errors.push(error_px(squares, track.sights.len()) / below);
            sum += chance;
            count += f64::from(u8::from(wet.is_some()));
        }
        let wet_share = (sum / f64::max(count, 1.0)).clamp(0.01, 0.99);
        Noise { wet_share, ..Noise::of(super::median(errors)) }
    }
}

/// The probability of an event with these logarithmic odds.
fn chance(odds: f64) -> f64 {
    1.0 / (1.0 + (-odds).exp())
}

/// Refines a plane; `None` if it loses all its tracks. `unit` is the viewing distance.
pub(super) fn fit(sightings: &Sightings, start: Surface, fixed: &Fixed, unit: f64) -> Option<Fitted> {
    let tracks = &sightings.tracks;
    let mut centre = start.normal * start.offset;
    let mut state = State::new(sightings, start, None, &motions(&start, centre, fixed));
    let mut noise = first_noise(tracks);
    for _ in 0..ROUNDS {
        noise = state.noise(tracks, &noise);
        centre = state.centre(tracks, &noise).unwrap_or(centre);
        // Derivatives about the new centre.
        let motions = motions(&state.surface, centre, fixed);
        state = State::new(sightings, state.surface, Some(&state), &motions);
        let sums = state.sums(tracks, &noise, sightings.eyes.len());
        let step = -(regular(sums.bread) * sums.gradient);
        let largest = (step.x.abs() / (MAX_HEIGHT * unit)).max(step.y.hypot(step.z) / MAX_TILT).max(1.0);
        let step = step / largest;
        if !step.is_finite() {
            return None;
        }
        // What the step promises; half a unit is about a standard error.
        let promised = -0.5 * step.dot(sums.gradient);
        let likelihood = state.likelihood(tracks, &noise);
        if promised < SETTLED {
            break;
        }
        let mut scale = 1.0;
        let mut next = None;
        while scale > 0.01 && next.is_none() {
            let surface = moved(&state.surface, &motions, scale * step);
            let tried = State::new(sightings, surface, Some(&state), &motions);
            // Likelihoods have small jumps where points reach the surface, so short steps are not judged.
            let is_better = promised < 1.0 || tried.likelihood(tracks, &noise) > likelihood;
            next = is_better.then_some(tried);
            scale *= 0.25;
        }
        let Some(better) = next else { break };
        state = better;
    }
    centre = state.centre(tracks, &noise)?;
    let motions = motions(&state.surface, centre, fixed);
    let state = State::new(sightings, state.surface, Some(&state), &motions);
    let sums = state.sums(tracks, &noise, sightings.eyes.len());
    let bread = regular(sums.information);
    // Errors of a point affect all its views, and errors of a pose all its points (clusters in two ways:
    // Cameron, Gelbach and Miller 2011). The sum of the two counts each sight twice.
    let of = |scatter: DMat3| {
        let covariance = bread * scatter * bread;
        [covariance.x_axis.x, covariance.y_axis.y, covariance.z_axis.z]
    };
    let (by_track, by_both) =
        (of(sums.scatter), of(sums.scatter + sums.scatter_by_eye - sums.scatter_by_sight));
    let [rise, a, b] = [0, 1, 2].map(|k| by_track[k].max(by_both[k]));
    let variance = [rise, a + b];
    Some(Fitted {
        surface: state.surface,
        centre,
        standard_error: variance.map(|variance| variance.max(0.0).sqrt()),
        noise,
    })
}

/// For a plane that is given in whole: the mean of the crossings, and the likelihoods of tracks under it.
/// `None` if no track can be in the water.
pub(super) fn keep(sightings: &Sightings, surface: Surface) -> Option<(DVec3, Noise)> {
    // Enough for the noise to settle.
    const ROUNDS: u32 = 6;
    let tracks = &sightings.tracks;
    let state = State::new(sightings, surface, None, &[Motion::default(); 3]);
    let mut noise = first_noise(tracks);
    for _ in 0..ROUNDS {
        noise = state.noise(tracks, &noise);
    }
    Some((state.centre(tracks, &noise)?, noise))
}

fn first_noise(tracks: &[Track]) -> Noise {
    let errors = tracks.iter().map(|track| error_px(track.straight.squares, track.sights.len()));
    Noise::of(super::median(errors.collect()))
}

/// Sums over tracks.
struct Sums {
    /// Weighted information of Gauss and Newton.
    bread: DMat3,
    gradient: DVec3,
    /// Second derivatives of the negative log-likelihood.
    information: DMat3,
    /// Outer products of the gradients of tracks, of cameras, and of sights.
    scatter: DMat3,
    scatter_by_eye: DMat3,
    scatter_by_sight: DMat3,
}

impl State {
    fn weights<'a>(
        &'a self,
        tracks: &'a [Track],
        noise: &'a Noise,
    ) -> impl Iterator<Item = (&'a Track, &'a Wet, f64, f64)> {
        tracks.iter().zip(&self.wet).filter_map(|(track, wet)| {
            let wet = wet.as_ref()?;
            let squares = wet.found.squares;
            Some((
                track,
                wet,
                chance(noise.odds(noise.gain(track, squares))),
                noise.weight(squares, track.sights.len()),
            ))
        })
    }

    fn centre(&self, tracks: &[Track], noise: &Noise) -> Option<DVec3> {
        let (mut sum, mut total) = (DVec3::ZERO, 0.0);
        for (_, wet, chance, weight) in self.weights(tracks, noise) {
            sum += chance * weight * wet.crossing;
            total += chance * weight;
        }
        (total > 0.0).then(|| sum / total)
    }

    fn sums(&self, tracks: &[Track], noise: &Noise, eyes: usize) -> Sums {
        let mut sums = Sums {
            bread: DMat3::ZERO,
            gradient: DVec3::ZERO,
            information: DMat3::ZERO,
            scatter: DMat3::ZERO,
            scatter_by_eye: DMat3::ZERO,
            scatter_by_sight: DMat3::ZERO,
        };
        let mut of_eyes = vec![DVec3::ZERO; eyes];
        for (track, wet, chance, weight) in self.weights(tracks, noise) {
            let gradient = weight * wet.gradient;
            let square = outer(gradient, gradient);
            sums.bread += chance * weight * wet.hessian;
            sums.gradient += chance * gradient;
            // The weight falls as the squares grow, and so does the chance.
            let bent = 2.0 / (TAIL + freedom(track.sights.len()));
            sums.information +=
                chance * (weight * wet.hessian - bent * square) - chance * (1.0 - chance) * square;
            sums.scatter += chance * chance * square;
            // The point follows errors of its sights, which shortens their residuals by this factor.
            let sights = track.sights.len();
            let shortened = (freedom(sights) / (2.0 * sights as f64)).sqrt();
            for (sight, part) in track.sights.iter().zip(wet.by_sight) {
                let part = chance * weight / shortened * part;
                of_eyes[sight.eye as usize] += part;
                sums.scatter_by_sight += outer(part, part);
            }
        }
        sums.scatter_by_eye = of_eyes.into_iter().map(|part| outer(part, part)).sum();
        sums
    }
}

/// The inverse of an information matrix, with 0 for parameters that do not move.
fn regular(information: DMat3) -> DMat3 {
    let diagonal = [information.x_axis.x, information.y_axis.y, information.z_axis.z];
    // Scaled to a unit diagonal: heights and tilts have other units.
    let scale = DVec3::from(diagonal.map(|value| if value > 0.0 { value.sqrt().recip() } else { 0.0 }));
    let still = DVec3::from(diagonal.map(|value| if value > 0.0 { 0.0 } else { 1.0 }));
    let scale = DMat3::from_diagonal(scale);
    let scaled = scale * information * scale + DMat3::from_diagonal(still);
    scale * scaled.inverse() * scale
}
