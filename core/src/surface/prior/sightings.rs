//! The tracks that the prior uses: who sees a point at which pixel, and where straight rays put it.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::triangulate::{Found, by_straight_rays};
use crate::scene::{PinholeCamera, Points, Pose};

/// Views of a track, at least: two would leave a single equation to judge it by.
const LEAST_VIEWS: usize = 3;
/// Views of a track, at most, evenly chosen.
pub(super) const MOST_VIEWS: usize = 8;
/// Largest angle between two rays of a track, at least, degrees. With less, both kinds of rays fit.
const LEAST_ANGLE_DEGREES: f64 = 2.0;

/// A camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Eye {
    /// Its centre, world.
    pub centre: DVec3,
    /// Rotation from world to camera.
    pub to_camera: DMat3,
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels.
    pub principal: [f64; 2],
    /// Columns and rows of the picture.
    size: [u32; 2],
}

/// A point in a view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    /// Index of the eye.
    pub eye: u32,
    /// Where it sees the point, pixels.
    pub pixel: [f64; 2],
    /// Unit direction of the ray through it, world.
    pub direction: DVec3,
}

/// A point in several views.
#[derive(Clone, Debug)]
pub(super) struct Track {
    pub sights: Vec<Sight>,
    /// Its place by straight rays.
    pub straight: Found,
}

/// The cameras, and tracks that can be judged, in the order of the points.
#[derive(Clone, Debug)]
pub(super) struct Sightings {
    pub eyes: Vec<Eye>,
    /// By view of the scene: its eye, if it is one of ours.
    eye_of_view: Vec<Option<u32>>,
    pub tracks: Vec<Track>,
}

impl Eye {
    pub fn new(camera: &PinholeCamera, pose: &Pose) -> Self {
        Self {
            centre: pose.centre(),
            to_camera: DMat3::from_quat(pose.rotation),
            focal: [camera.fx, camera.fy],
            principal: [camera.cx, camera.cy],
            size: [camera.width, camera.height],
        }
    }

    /// The pixel of a world point, and its derivatives by the point; `None` behind the camera.
    pub fn project(&self, point: DVec3) -> Option<([f64; 2], [DVec3; 2])> {
        let p = self.to_camera * (point - self.centre);
        let is_in_front = p.z > 1e-12;
        if !is_in_front {
            return None;
        }
        let plane = [p.x / p.z, p.y / p.z];
        let forward = self.to_camera.row(2);
        let pixel = [0, 1].map(|k| self.focal[k] * plane[k] + self.principal[k]);
        let slopes = [0, 1].map(|k| self.focal[k] / p.z * (self.to_camera.row(k) - plane[k] * forward));
        Some((pixel, slopes))
    }

    /// Unit directions into the corners of the picture, the middles of its sides, and its middle.
    pub fn looks(&self) -> impl Iterator<Item = DVec3> {
        let [width, height] = self.size.map(f64::from);
        (0..9).map(move |k| {
            let [x, y] = [k % 3, k / 3].map(|part| 0.5 * f64::from(part));
            self.direction([x * width, y * height])
        })
    }

    /// Unit direction of the ray through a pixel, world.
    pub fn direction(&self, pixel: [f64; 2]) -> DVec3 {
        let [x, y] = [0, 1].map(|k| (pixel[k] - self.principal[k]) / self.focal[k]);
        (self.to_camera.transpose() * DVec3::new(x, y, 1.0)).normalize()
    }
}

impl Sightings {
    /// The tracks that can be judged among at most `most` points, evenly chosen. `scene_views` are the
    /// indices of `views` in the tracks.
    pub fn of(points: &Points, views: &[(PinholeCamera, Pose)], scene_views: &[u32], most: usize) -> Self {
        let eyes: Vec<Eye> = views.iter().map(|(camera, pose)| Eye::new(camera, pose)).collect();
        let largest = scene_views.iter().max().map_or(0, |view| *view as usize + 1);
        let mut eye_of_view = vec![None; largest];
        for (eye, &view) in (0_u32..).zip(scene_views).take(eyes.len()) {
            eye_of_view[view as usize] = Some(eye);
        }
        let cameras = Self { eyes, eye_of_view, tracks: Vec::new() };
        let candidates: Vec<u32> = (0..points.len() as u32)
            .filter(|&point| cameras.sights(points, point).nth(LEAST_VIEWS - 1).is_some())
            .collect();
        let chosen: Vec<u32> = evenly(candidates.len(), most).map(|index| candidates[index]).collect();
        let tracks = chosen.into_par_iter().filter_map(|point| cameras.track(points, point)).collect();
        Self { tracks, ..cameras }
    }

    /// Where our cameras see a point, as far as pixels are known.
    fn sights(&self, points: &Points, point: u32) -> impl Iterator<Item = Sight> {
        points.tracks.seen(point as usize).filter_map(|(view, place)| {
            let eye = self.eye_of(view)?;
            let Eye { size: [width, height], .. } = self.eyes[eye as usize];
            Some(self.sight(eye, place.pixel(width, height)?))
        })
    }

    fn eye_of(&self, view: u32) -> Option<u32> {
        self.eye_of_view.get(view as usize).copied().flatten()
    }

    fn sight(&self, eye: u32, pixel: [f64; 2]) -> Sight {
        Sight { eye, pixel, direction: self.eyes[eye as usize].direction(pixel) }
    }

    /// The track of a point, if it can be judged.
    pub fn track(&self, points: &Points, point: u32) -> Option<Track> {
        let all: Vec<Sight> = self.sights(points, point).collect();
        if all.len() < LEAST_VIEWS {
            return None;
        }
        let sights: Vec<Sight> = evenly(all.len(), MOST_VIEWS).map(|index| all[index]).collect();
        let widest = sights
            .iter()
            .flat_map(|a| sights.iter().map(|b| a.direction.dot(b.direction)))
            .fold(1.0, f64::min);
        if widest > LEAST_ANGLE_DEGREES.to_radians().cos() {
            return None;
        }
        let straight = by_straight_rays(&self.eyes, &sights)?;
        Some(Track { sights, straight })
    }

    /// A track whose straight rays meet at `position`, to refract its rays. Its views are those of the
    /// point's own track, or all that show the position if it has none.
    pub fn straight_track(&self, points: &Points, point: u32, position: DVec3) -> Track {
        let seen = |eye: u32| {
            let Eye { size, .. } = self.eyes[eye as usize];
            let (pixel, _) = self.eyes[eye as usize].project(position)?;
            let is_shown = (0..2).all(|k| pixel[k] >= 0.0 && pixel[k] <= f64::from(size[k]));
            is_shown.then(|| self.sight(eye, pixel))
        };
        let views = points.tracks.of(point as usize);
        let mut all: Vec<Sight> =
            views.iter().filter_map(|&view| self.eye_of(view)).filter_map(seen).collect();
        if all.is_empty() {
            all = (0..self.eyes.len() as u32).filter_map(seen).collect();
        }
        let sights = evenly(all.len(), MOST_VIEWS).map(|index| all[index]).collect();
        Track { sights, straight: Found { position, squares: 0.0 } }
    }

    fn without_tracks(&self) -> Self {
        Self { eyes: self.eyes.clone(), eye_of_view: self.eye_of_view.clone(), tracks: Vec::new() }
    }

    /// The same with at most `most` tracks.
    pub fn evenly(&self, most: usize) -> Self {
        let tracks = evenly(self.tracks.len(), most).map(|index| self.tracks[index].clone()).collect();
        Self { tracks, ..self.without_tracks() }
    }
}

/// At most `most` of the numbers below `count`, evenly spaced.
pub(super) fn evenly(count: usize, most: usize) -> impl Iterator<Item = usize> {
    let kept = count.min(most);
    (0..kept).map(move |k| (k as u64 * count as u64 / kept as u64) as usize)
}
