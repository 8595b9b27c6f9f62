//! Finds the water surface from the tracks of structure from motion, which knows no surface.
//!
//! Each track is triangulated twice: by straight rays, and by rays that a plane refracts. A track in the
//! water has a smaller reprojection error by refracted rays under the true plane than by straight rays, and
//! than under other planes. The plane is that under which the tracks are most likely. Each track is a mixture
//! of both cases with a heavy tail (Student's t), which is a smooth form of the smaller of its two errors:
//!
//! 1. `sightings` chooses tracks and triangulates them by straight rays.
//! 2. `scan` tries offsets for the normals near the scene's up direction.
//! 3. `fit` refines offset and two tilts by Gauss-Newton steps; the points are eliminated (Schur complement).
//! 4. The standard errors are those of a sandwich estimator whose clusters are tracks and cameras.
//! 5. `sorted` lists the points in the water, with their places by refracted rays, and the dry ones.
//!
//! A plane that is given in whole skips 2 to 4. So does the rule of the paper (`paper`).
//!
//! Sums run over tracks in their order, so results do not depend on the number of threads.

mod fit;
mod paper;
mod scan;
mod sightings;
mod sorted;
mod triangulate;
mod up;

use glam::DVec3;

use super::optics::{AIR, Surface, WATER};
use crate::CoreError;
use crate::Result as CoreResult;
use crate::config::SurfaceStart;
use crate::scene::{PinholeCamera, Points, Pose, Scene, viewing_distance};
use fit::Noise;
use sightings::{Eye, Sightings};
use sorted::Sorted;

/// Tracks that the plane is fitted to, at most.
const FITTED_TRACKS: usize = 4000;
/// Points whose tracks are tried for that, at most.
const TRIED_TRACKS: usize = 40_000;
/// Least number of tracks to fit a plane to, and least number in the water.
const MIN_TRACKS: usize = 12;
/// Least share of the tracks that are clearly in the water.
const MIN_WET_SHARE: f64 = 0.02;
/// The log-likelihood by which a track is clearly wet: refracted rays are e^4 = 55 times as likely.
const CLEARLY: f64 = 4.0;
/// Ratio of the median errors of wet and dry tracks from which the surface is not a plane.
const WAVES: f64 = 4.0;
/// Reprojection error of dry tracks where a scene has hardly any, pixels: usual for structure from motion.
const USUAL_ERROR_PX: f64 = 1.0;

/// What is known of the surface beforehand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceOptions {
    /// Offset that the plane keeps, scene units; found if `None`.
    pub offset: Option<f64>,
    /// Normal that the plane keeps, into the air, of any length; found if `None`.
    pub normal: Option<DVec3>,
    /// Refractive index below the surface.
    pub ior: f64,
    /// Roughly up, of any length, where the search for the normal starts; from the cameras if `None`.
    pub up: Option<DVec3>,
    /// How what is not given is found.
    pub start: SurfaceStart,
}

impl Default for SurfaceOptions {
    fn default() -> Self {
        Self { offset: None, normal: None, ior: WATER, up: None, start: SurfaceStart::Tracks }
    }
}

/// The plane with its errors, what it rests on, and the points under it.
#[derive(Clone, Debug, PartialEq)]
pub struct SurfacePrior {
    /// The plane.
    pub surface: Surface,
    /// Errors of the plane; `None` by the rule of the paper, which knows none.
    pub standard_error: Option<SurfaceStandardErrors>,
    /// The mean point where rays to wet points cross the surface, scene units and axes. Without such rays,
    /// the foot of the mean camera.
    pub centre: DVec3,
    /// Number of tracks in the water, and of all others that could be judged.
    pub wet_tracks: usize,
    /// See `wet_tracks`.
    pub dry_tracks: usize,
    /// Median error of the wet tracks by refracted rays, pixels an axis, as of the noise of one pixel; 0
    /// without any.
    pub wet_error_px: f64,
    /// Median error of the same tracks by straight rays.
    pub wet_straight_error_px: f64,
    /// Median error of the dry tracks by straight rays.
    pub dry_error_px: f64,
    /// The points in the water, at their places by refracted rays; ascending.
    pub wet: Vec<WetPoint>,
    /// All other points; ascending.
    pub dry: Vec<u32>,
    /// The scene scale ([`viewing_distance`]), scene units; where no view shows a point, the mean height of
    /// the cameras.
    pub viewing_distance: f64,
}

/// Standard errors of a plane: 0 for what was given.
///
/// They cover errors of pixels, of points and of single poses, but no bend of the whole reconstruction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceStandardErrors {
    /// Of the height of the surface at [`SurfacePrior::centre`], scene units.
    pub offset: f64,
    /// The same as a share of the scene scale.
    pub offset_share: f64,
    /// Of the angle of the normal, degrees.
    pub tilt_degrees: f64,
}

/// A point in the water.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WetPoint {
    /// Index of the sparse point.
    pub point: u32,
    /// Its place by refracted rays, scene units and axes.
    pub position: DVec3,
    /// Its colour, sRGB.
    pub colour: [u8; 3],
    /// Its error, pixels an axis; `None` if its track cannot be judged, so that its height alone says that it
    /// is in the water.
    pub error_px: Option<f64>,
}

/// Why there is no [`SurfacePrior`].
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SurfaceError {
    /// The scene has no pixels of observations.
    #[error(
        "the water surface cannot be found: this scene does not say at which pixels photographs see its \
         sparse points; give a COLMAP model with 2D points (to `fathom dataset upload` with the --method of \
         the job), or give surface.offset and surface.normal"
    )]
    NoPixels,
    /// Too few tracks.
    #[error(
        "the water surface cannot be found: {tracks} sparse points are seen in three views from different \
         directions, but {MIN_TRACKS} are needed; reconstruct with more features, or give surface.offset and \
         surface.normal"
    )]
    TooFewTracks {
        /// Usable tracks.
        tracks: usize,
    },
    /// Refraction explains no tracks.
    #[error(
        "there is no water surface: refraction at a plane explains only {wet} of {tracks} sparse points \
         better than straight rays; train without a surface, or give surface.offset and surface.normal"
    )]
    NoSurface {
        /// Tracks that are clearly in the water.
        wet: usize,
        /// All usable tracks.
        tracks: usize,
    },
    /// All cameras are in the water.
    #[error(
        "all {cameras} cameras are below the water surface, but they must be in air; for photographs taken \
         under water train without a surface, or correct surface.offset and the sign of surface.normal, \
         which points into the air"
    )]
    CamerasBelow {
        /// Number of cameras.
        cameras: usize,
    },
    /// Cameras are on both sides.
    #[error(
        "{below} of {cameras} cameras are below the water surface, but all must be in air; remove the \
         photographs taken under water, or correct surface.offset"
    )]
    CamerasOnBothSides {
        /// Cameras below the plane.
        below: usize,
        /// Number of cameras.
        cameras: usize,
    },
    /// No camera looks at the plane.
    #[error(
        "none of {cameras} cameras sees the water surface; correct surface.offset and surface.normal, which \
         points into the air"
    )]
    NotSeen {
        /// Number of cameras.
        cameras: usize,
    },
    /// A plane does not explain the wet tracks.
    #[error(
        "the water surface is not a plane: points in the water are {wet_px:.2} px off by refracted rays, \
         others {dry_px:.2} px; photograph calm water, check surface.ior, or train without a surface"
    )]
    Waves {
        /// Median error of wet tracks, pixels an axis.
        wet_px: f64,
        /// Median error of dry tracks.
        dry_px: f64,
    },
    /// The index is that of no liquid.
    #[error(
        "surface.ior is {ior}; below the surface it must be above that of air, {AIR}, and at most 3; water \
         has {WATER}"
    )]
    Index {
        /// The refractive index.
        ior: f64,
    },
    /// The given plane is no plane.
    #[error("{option} is not finite or has no direction; give finite numbers, or leave it out")]
    NotAPlane {
        /// The option at fault.
        option: &'static str,
    },
}

impl From<SurfaceError> for CoreError {
    fn from(error: SurfaceError) -> Self {
        Self::Scene(error.to_string())
    }
}

/// Finds the water surface from the pixels where `views` see sparse points, and sorts the points.
///
/// `scene_views` gives the index of each view in the scene, as tracks have it. Cameras are those of
/// undistorted photographs of any size. The plane is fitted to at most 4000 tracks, evenly chosen.
///
/// A plane that is given in whole is taken as it is, if cameras in air see it. It needs no pixels.
///
/// # Errors
/// [`SurfaceError`] says what the scene lacks or contradicts.
pub fn surface_prior(
    points: &Points,
    views: &[(PinholeCamera, Pose)],
    scene_views: &[u32],
    options: &SurfaceOptions,
) -> Result<SurfacePrior, SurfaceError> {
    let fixed = Fixed::of(options)?;
    let sightings = Sightings::of(points, views, scene_views, TRIED_TRACKS);
    let seen = viewing_distance(views, points);
    let plane = match fixed.plane() {
        Some(surface) => Plane::kept(&sightings, surface),
        None => {
            if !points.tracks.have_places() {
                return Err(SurfaceError::NoPixels);
            }
            let tracks = sightings.tracks.len();
            let too_few = SurfaceError::TooFewTracks { tracks };
            let unit = seen.filter(|_| tracks >= MIN_TRACKS).ok_or(too_few)?;
            match options.start {
                SurfaceStart::Tracks => Plane::fitted(&sightings, &fixed, unit)?,
                SurfaceStart::Paper => Plane::of_paper(&sightings, &fixed)?,
            }
        }
    };
    check_cameras(&sightings.eyes, &plane.surface)?;
    check_sight(&sightings.eyes, &plane.surface)?;
    let sorted = Sorted::of(points, &sightings, &plane.surface, plane.noise.as_ref());
    if plane.is_fitted {
        check_tracks(&sorted)?;
    }
    let eyes = &sightings.eyes;
    let height = eyes.iter().map(|eye| plane.surface.height(eye.centre)).sum::<f64>();
    let unit = seen.unwrap_or(height / eyes.len().max(1) as f64);
    Ok(SurfacePrior {
        surface: plane.surface,
        standard_error: plane.standard_error.map(|[offset, tilt]| SurfaceStandardErrors {
            offset,
            offset_share: offset / unit,
            tilt_degrees: tilt.to_degrees(),
        }),
        centre: plane.centre,
        wet_tracks: sorted.wet_tracks,
        dry_tracks: sorted.dry_tracks,
        wet_error_px: sorted.wet_error_px,
        wet_straight_error_px: sorted.wet_straight_error_px,
        dry_error_px: sorted.dry_error_px,
        wet: sorted.wet,
        dry: sorted.dry,
        viewing_distance: unit,
    })
}

impl SurfacePrior {
    /// As [`surface_prior`], from the training views of a scene: without every `test_every`-th view, and none
    /// left out for 0.
    ///
    /// # Errors
    /// As [`surface_prior`], and when a camera cannot be undistorted.
    pub fn of_scene(scene: &Scene, test_every: u32, options: &SurfaceOptions) -> CoreResult<Self> {
        let (mut views, mut scene_views) = (Vec::new(), Vec::new());
        for (index, view) in (0_u32..).zip(&scene.views) {
            if test_every > 0 && index.is_multiple_of(test_every) {
                continue;
            }
            let missing = || CoreError::Scene(format!("view {} has no camera", view.name));
            let camera = scene.camera(view.camera_id).ok_or_else(missing)?;
            views.push((camera.pinhole()?, view.pose));
            scene_views.push(index);
        }
        Ok(surface_prior(&scene.points, &views, &scene_views, options)?)
    }

    /// The points in the water, without tracks.
    pub fn wet_points(&self) -> Points {
        let mut points = Points::with_capacity(self.wet.len());
        for wet in &self.wet {
            // A place that is too far away for a point is no place to start.
            points.push(wet.position.to_array(), wet.colour);
        }
        points
    }

    /// The points that are not in the water; `points` are those of the scene.
    pub fn dry_points(&self, points: &Points) -> Points {
        points.select(&self.dry)
    }
}

/// A plane before the points are sorted.
struct Plane {
    surface: Surface,
    centre: DVec3,
    /// Of the height at `centre`, scene units, and of the angle, radians.
    standard_error: Option<[f64; 2]>,
    /// Likelihoods of tracks; `None` if none can be in the water.
    noise: Option<Noise>,
    /// Whether tracks determined it.
    is_fitted: bool,
}

impl Plane {
    /// A plane that is taken as it is.
    fn kept(sightings: &Sightings, surface: Surface) -> Self {
        let kept = fit::keep(&sightings.evenly(FITTED_TRACKS), surface);
        let eyes = &sightings.eyes;
        let eye = eyes.iter().map(|eye| eye.centre).sum::<DVec3>() / eyes.len().max(1) as f64;
        let foot = eye - surface.height(eye) * surface.normal;
        Self {
            surface,
            centre: kept.map_or(foot, |(centre, _)| centre),
            standard_error: Some([0.0; 2]),
            noise: kept.map(|(_, noise)| noise),
            is_fitted: false,
        }
    }

    fn of_paper(sightings: &Sightings, fixed: &Fixed) -> Result<Self, SurfaceError> {
        let too_few = SurfaceError::TooFewTracks { tracks: sightings.tracks.len() };
        let surface = paper::plane(sightings, fixed).ok_or(too_few)?;
        Ok(Self { standard_error: None, ..Self::kept(sightings, surface) })
    }

    fn fitted(sightings: &Sightings, fixed: &Fixed, unit: f64) -> Result<Self, SurfaceError> {
        let some = sightings.evenly(FITTED_TRACKS);
        let nothing = || SurfaceError::NoSurface { wet: 0, tracks: sightings.tracks.len() };
        let start = scan::scan(&some, fixed).ok_or_else(nothing)?;
        check_cameras(&sightings.eyes, &start)?;
        let fitted = fit::fit(&some, start, fixed, unit).ok_or_else(nothing)?;
        Ok(Self {
            surface: fitted.surface,
            centre: fitted.centre,
            standard_error: Some(fitted.standard_error),
            noise: Some(fitted.noise),
            is_fitted: true,
        })
    }
}

/// Parts of the plane that were given.
struct Fixed {
    offset: Option<f64>,
    normal: Option<DVec3>,
    ior: f64,
    up: Option<DVec3>,
}

impl Fixed {
    /// The plane, if it was given in whole.
    fn plane(&self) -> Option<Surface> {
        let (normal, offset) = self.normal.zip(self.offset)?;
        Some(Surface { normal, offset, ior: self.ior })
    }

    fn of(options: &SurfaceOptions) -> Result<Self, SurfaceError> {
        let SurfaceOptions { offset, normal, ior, up, .. } = *options;
        // Phrased positively, so that NaN fails. No liquid bends more than an index of 3.
        let is_liquid = ior > AIR + 1e-3 && ior <= 3.0;
        if !is_liquid {
            return Err(SurfaceError::Index { ior });
        }
        let unit = |direction: Option<DVec3>, option| {
            let unit = direction.map(|direction| direction.try_normalize());
            if unit == Some(None) { Err(SurfaceError::NotAPlane { option }) } else { Ok(unit.flatten()) }
        };
        if offset.is_some_and(|offset| !offset.is_finite()) {
            return Err(SurfaceError::NotAPlane { option: "surface.offset" });
        }
        Ok(Self { offset, normal: unit(normal, "surface.normal")?, ior, up: unit(up, "up")? })
    }
}

fn check_cameras(eyes: &[Eye], surface: &Surface) -> Result<(), SurfaceError> {
    let cameras = eyes.len();
    // Phrased positively, so that NaN is below.
    let above = eyes.iter().filter(|eye| surface.height(eye.centre) > 0.0).count();
    match cameras - above {
        0 => Ok(()),
        below if below == cameras => Err(SurfaceError::CamerasBelow { cameras }),
        below => Err(SurfaceError::CamerasOnBothSides { below, cameras }),
    }
}

/// Refuses a plane that no camera looks at.
fn check_sight(eyes: &[Eye], surface: &Surface) -> Result<(), SurfaceError> {
    let sees = |eye: &Eye| eye.looks().any(|look| surface.meets(eye.centre, look).is_some());
    if eyes.iter().any(sees) { Ok(()) } else { Err(SurfaceError::NotSeen { cameras: eyes.len() }) }
}

/// Refuses a fitted plane that does not explain its tracks.
fn check_tracks(sorted: &Sorted) -> Result<(), SurfaceError> {
    let tracks = sorted.wet_tracks + sorted.dry_tracks;
    let least = (MIN_WET_SHARE * tracks as f64).max(MIN_TRACKS as f64);
    if (sorted.clearly_wet as f64) < least {
        return Err(SurfaceError::NoSurface { wet: sorted.clearly_wet, tracks });
    }
    let usual = if sorted.dry_tracks < MIN_TRACKS { USUAL_ERROR_PX } else { sorted.dry_error_px };
    if sorted.wet_error_px > WAVES * usual {
        return Err(SurfaceError::Waves { wet_px: sorted.wet_error_px, dry_px: usual });
    }
    Ok(())
}

/// The middle one of the values; 0 without any.
fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
