//! Sparse points and their binary format.
//!
//! Layout of [`Points::to_bytes`] for points with tracks, little-endian, no padding:
//! ```text
//! 0         8 bytes   "FTHMPTS2"
//! 8         u64       N, the number of points
//! 16        u64       M, the number of observations
//! 24        N times   f32 x, f32 y, f32 z, u8 r, u8 g, u8 b    (15 bytes)
//! 24 + 15N  N times   u32, number of views that see the point; M in total
//! 24 + 19N M times u32 view, index among the views of the scene by name; ascending and unique for each point
//! ```
//! [`Points::to_bytes_with_places`] adds the pixels of the observations, if there are any:
//! ```text
//! 0         8 bytes   "FTHMPTS3"
//! 8                   as above
//! 24 + 19N + 4M  M times   u16 x, u16 y, shares of the sides in 1/65535; 65535 where they are unknown
//! ```
//! [`Points::to_bytes`] leaves them out: programs of version 0.2 do not read them, and what trains without a
//! water surface does not need them. For points without tracks (any version of Fathom reads this):
//! ```text
//! 0         8 bytes   "FTHMPTS1"
//! 8         u64       N
//! 16        N times   as above
//! ```
//! Equal points give equal bytes, so the digest of the bytes identifies them.

use glam::DVec3;

use super::camera::is_near;
use super::{PinholeCamera, Place, Points, Pose, Tracks};
use crate::config::Method;
use crate::{CoreError, Result};

const MAGIC: &[u8; 8] = b"FTHMPTS1";
const MAGIC_WITH_TRACKS: &[u8; 8] = b"FTHMPTS2";
const MAGIC_WITH_PLACES: &[u8; 8] = b"FTHMPTS3";
const HEADER_BYTES: usize = 16;
const HEADER_WITH_TRACKS_BYTES: usize = 24;
const POINT_BYTES: usize = 15;

impl Points {
    /// Room for `count` points.
    pub fn with_capacity(count: usize) -> Self {
        Self {
            positions: Vec::with_capacity(count),
            colours: Vec::with_capacity(count),
            tracks: Tracks::default(),
        }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Adds a point and returns true, unless a coordinate is not finite or beyond 1e12 scene units.
    pub fn push(&mut self, position: [f64; 3], colour: [u8; 3]) -> bool {
        let near = is_near(position.into());
        if near {
            self.positions.push(position.map(|value| value as f32));
            self.colours.push(colour);
        }
        near
    }

    /// As [`Points::push`], for a point that `views` see, in any order.
    pub fn push_seen(&mut self, position: [f64; 3], colour: [u8; 3], views: &mut Vec<u32>) -> bool {
        let pushed = self.push(position, colour);
        if pushed {
            self.tracks.set_last(self.len() - 1, views);
        }
        pushed
    }

    /// As [`Points::push_seen`], with the place where each view sees the point.
    pub fn push_seen_at(
        &mut self,
        position: [f64; 3],
        colour: [u8; 3],
        seen: &mut Vec<(u32, Place)>,
    ) -> bool {
        let pushed = self.push(position, colour);
        if pushed {
            self.tracks.set_last_seen(self.len() - 1, seen);
        }
        pushed
    }

    /// The points with these indices, in this order.
    pub fn select(&self, kept: &[u32]) -> Self {
        let mut points = Self::with_capacity(kept.len());
        for (index, &old) in kept.iter().enumerate() {
            points.positions.push(self.positions[old as usize]);
            points.colours.push(self.colours[old as usize]);
            points.tracks.set_last_seen(index, &mut self.tracks.seen(old as usize).collect());
        }
        points
    }

    /// The binary format that the head of this file describes, without places.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.encode(false)
    }

    /// As [`Points::to_bytes`], with places if there are any.
    pub fn to_bytes_with_places(&self) -> Vec<u8> {
        self.encode(self.tracks.have_places())
    }

    /// The bytes that jobs of this method get: with places if it looks through a water surface.
    pub fn to_bytes_for(&self, method: Method) -> Vec<u8> {
        self.encode(method.through_surface() && self.tracks.have_places())
    }

    fn encode(&self, with_places: bool) -> Vec<u8> {
        let seen = self.tracks.observations();
        let seen_bytes = if with_places { 8 } else { 4 };
        let track_bytes = if seen > 0 { 8 + 4 * self.len() + seen_bytes * seen } else { 0 };
        let mut bytes = Vec::with_capacity(HEADER_BYTES + self.len() * POINT_BYTES + track_bytes);
        bytes.extend_from_slice(match (seen > 0, with_places) {
            (false, _) => MAGIC,
            (true, false) => MAGIC_WITH_TRACKS,
            (true, true) => MAGIC_WITH_PLACES,
        });
        bytes.extend_from_slice(&(self.len() as u64).to_le_bytes());
        if seen > 0 {
            bytes.extend_from_slice(&(seen as u64).to_le_bytes());
        }
        for (position, colour) in self.positions.iter().zip(&self.colours) {
            for value in position {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
            bytes.extend_from_slice(colour);
        }
        if seen > 0 {
            for point in 0..self.len() {
                bytes.extend_from_slice(&(self.tracks.of(point).len() as u32).to_le_bytes());
            }
            for view in (0..self.len()).flat_map(|point| self.tracks.of(point)) {
                bytes.extend_from_slice(&view.to_le_bytes());
            }
        }
        if with_places {
            for (_, place) in (0..self.len()).flat_map(|point| self.tracks.seen(point)) {
                bytes.extend_from_slice(&place.to_bytes());
            }
        }
        bytes
    }

    /// The points of [`Points::to_bytes`] or [`Points::to_bytes_with_places`].
    ///
    /// # Errors
    /// When the bytes have another layout, are truncated, hold a coordinate that [`Points::push`] refuses, or
    /// a track whose views are not ascending.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let refuse = |message: String| CoreError::Scene(format!("sparse points: {message}"));
        let (with_tracks, seen_bytes) = match bytes.get(..8) {
            Some(magic) if magic == MAGIC => (false, 0),
            Some(magic) if magic == MAGIC_WITH_TRACKS => (true, 4),
            Some(magic) if magic == MAGIC_WITH_PLACES => (true, 8),
            _ => {
                return Err(refuse("the bytes do not start with \"FTHMPTS\" and 1, 2 or 3".to_owned()));
            }
        };
        let header_bytes = if with_tracks { HEADER_WITH_TRACKS_BYTES } else { HEADER_BYTES };
        let number =
            |at: usize| bytes.get(at..at + 8).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes);
        let (Some(count), Some(seen)) = (number(8), if with_tracks { number(16) } else { Some(0) }) else {
            return Err(refuse(format!("{} bytes are too few for a header of {header_bytes}", bytes.len())));
        };
        let body = &bytes[header_bytes..];
        let entry_bytes = POINT_BYTES as u64 + if with_tracks { 4 } else { 0 };
        let needed = count
            .checked_mul(entry_bytes)
            .zip(seen.checked_mul(seen_bytes))
            .and_then(|(a, b)| a.checked_add(b));
        if needed != Some(body.len() as u64) {
            return Err(refuse(format!(
                "the header says {count} points of {entry_bytes} bytes and {seen} observations of \
                 {seen_bytes}, but {} bytes follow",
                body.len()
            )));
        }
        let count = count as usize;
        let (positions, tracks) = body.split_at(count * POINT_BYTES);
        let (lengths, views) = tracks.split_at(if with_tracks { 4 * count } else { 0 });
        // As many observations as fit the bytes were checked above.
        let (mut views, mut places) = views.split_at(if with_tracks { 4 * seen as usize } else { 0 });
        let word = |bytes: &[u8], at: usize| {
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        let mut points = Self::with_capacity(count);
        let mut track = Vec::new();
        for (index, entry) in positions.chunks_exact(POINT_BYTES).enumerate() {
            let axis = |at: usize| f32::from_bits(word(entry, at));
            let position = [axis(0), axis(4), axis(8)];
            track.clear();
            if with_tracks {
                let track_bytes = 4 * u64::from(word(lengths, 4 * index));
                if track_bytes > views.len() as u64 {
                    return Err(refuse(format!(
                        "the tracks up to point {index} hold more than {seen} observations"
                    )));
                }
                let (own, rest) = views.split_at(track_bytes as usize);
                track.extend(own.chunks_exact(4).map(|view| (word(view, 0), Place::UNKNOWN)));
                views = rest;
                if seen_bytes == 8 {
                    let (own, rest) = places.split_at(own.len());
                    for ((_, place), bytes) in track.iter_mut().zip(own.chunks_exact(4)) {
                        *place = Place::from_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                    }
                    places = rest;
                }
                if !track.is_sorted_by(|a, b| a.0 < b.0) {
                    return Err(refuse(format!("the views that see point {index} are not ascending")));
                }
            }
            if !points.push_seen_at(position.map(f64::from), [entry[12], entry[13], entry[14]], &mut track) {
                return Err(refuse(format!("point {index} is not finite, or too far from the origin")));
            }
        }
        if views.is_empty() {
            Ok(points)
        } else {
            Err(refuse(format!("the tracks hold fewer than {seen} observations")))
        }
    }
}

/// 1.1 times the largest distance of a centre from their mean: the extent that 3DGS scales learning rates by.
///
/// It is 0 for at most one centre, so do not divide by it.
pub fn extent(centres: &[DVec3]) -> f64 {
    let mean = centres.iter().sum::<DVec3>() / (centres.len().max(1)) as f64;
    1.1 * centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max)
}

/// The length to which the learning rate of the means is proportional, scene units: [`extent`] as in 3DGS,
/// but at most [`viewing_distance`].
///
/// The two agree for cameras around an object. In a survey of 100 m from 7 m above the ground, the extent is
/// eight times larger, and so would be the steps in pixels.
pub fn learning_scale(extent: f64, viewing_distance: Option<f64>) -> f64 {
    match viewing_distance {
        Some(distance) if extent > 0.0 => extent.min(distance),
        Some(distance) => distance,
        None => extent,
    }
}

/// The scene scale: the median over views of the median depth of the sparse points in view, scene units. At
/// most 128 views and 32,768 points are used, evenly spaced.
///
/// `None` when no view shows a point.
pub fn viewing_distance(views: &[(PinholeCamera, Pose)], points: &Points) -> Option<f64> {
    const VIEWS: usize = 128;
    const POINTS: usize = 32_768;
    let thin = |count: usize, most: usize| count.div_ceil(most).max(1);
    let positions: Vec<DVec3> = points
        .positions
        .iter()
        .step_by(thin(points.len(), POINTS))
        .map(|position| DVec3::from(position.map(f64::from)))
        .collect();
    let of_view = |(camera, pose): &(PinholeCamera, Pose)| {
        let depths = positions.iter().map(|point| pose.transform(*point)).filter(|p| {
            let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
            p.z > 0.0 && (0.0..camera.width.into()).contains(&x) && (0.0..camera.height.into()).contains(&y)
        });
        median(depths.map(|p| p.z).collect())
    };
    median(views.iter().step_by(thin(views.len(), VIEWS)).filter_map(of_view).collect())
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {

    use super::*;

    fn sample() -> Points {
        Points {
            positions: vec![[1.0, -2.5, 3.25], [9.5e11, f32::MIN_POSITIVE, -0.0]],
            colours: vec![[0, 127, 255], [9, 8, 7]],
            ..Points::default()
        }
    }

    /// No view sees the second and the last of four points.
    fn tracked() -> Points {
        let mut points = Points::default();
        for (x, mut views) in [(1.0, vec![7, 0, 3]), (2.0, vec![]), (3.0, vec![3, 3, 1]), (4.0, vec![])] {
            points.push_seen([x, 0.5, -x], [x as u8; 3], &mut views);
        }
        points
    }

    #[test]
    fn tracks_are_sorted_and_survive_bytes() {
        let points = tracked();
        assert_eq!(
            [0, 1, 2, 3].map(|point| points.tracks.of(point).to_vec()),
            [vec![0, 3, 7], vec![], vec![1, 3], vec![]]
        );
        let bytes = points.to_bytes();
        assert_eq!(bytes.len(), 24 + 4 * 15 + 4 * 4 + 5 * 4);
        assert_eq!(&bytes[..8], b"FTHMPTS2");
        let read = Points::from_bytes(&bytes).unwrap();
        assert_eq!(read, points);
        assert_eq!(read.to_bytes(), bytes, "the same points, the same bytes");
    }

    #[test]
    fn points_without_tracks_keep_their_first_format() {
        let mut old = b"FTHMPTS1".to_vec();
        old.extend(1_u64.to_le_bytes());
        for value in [1.0_f32, -2.0, 0.5] {
            old.extend(value.to_le_bytes());
        }
        old.extend([1, 2, 3]);
        let read = Points::from_bytes(&old).unwrap();
        assert_eq!((read.positions[0], read.colours[0]), ([1.0, -2.0, 0.5], [1, 2, 3]));
        assert!(read.tracks.is_empty());
        assert_eq!(read.to_bytes(), old);
    }

    #[test]
    fn truncated_or_contradictory_tracks_are_refused() {
        let bytes = tracked().to_bytes();
        for len in 0..bytes.len() {
            assert!(Points::from_bytes(&bytes[..len]).is_err(), "{len} of {} bytes passed", bytes.len());
        }
        let refused = |at: usize, value: u32| {
            let mut bytes = bytes.clone();
            bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            Points::from_bytes(&bytes).unwrap_err().to_string()
        };
        let lengths = 24 + 4 * 15;
        assert!(refused(lengths + 8, 1).contains("fewer than 5"));
        assert!(refused(lengths + 12, 1).contains("more than 5"));
        assert!(refused(lengths, u32::MAX).contains("more than 5"));
        assert!(refused(lengths + 16, 4).contains("point 0 are not ascending"));
        assert!(refused(16, u32::MAX).contains("4294967295 observations"));
    }

    #[test]
    fn places_survive_bytes_that_ask_for_them() {
        let place = |x: f64| Place::new([x, 1.0], 64, 48);
        let mut points = Points::default();
        for (x, mut seen) in
            [(1.0, vec![(7, place(3.5)), (0, Place::UNKNOWN)]), (2.0, vec![]), (3.0, vec![(3, place(9.25))])]
        {
            points.push_seen_at([x, 0.5, -x], [x as u8; 3], &mut seen);
        }
        let bytes = points.to_bytes_with_places();
        assert_eq!((&bytes[..8], bytes.len()), (&b"FTHMPTS3"[..], 24 + 3 * 19 + 3 * 8));
        assert_eq!(Points::from_bytes(&bytes).unwrap(), points);
        assert_eq!(Points::from_bytes(&bytes).unwrap().to_bytes_with_places(), bytes);
        for len in 0..bytes.len() {
            assert!(Points::from_bytes(&bytes[..len]).is_err(), "{len} of {} bytes passed", bytes.len());
        }
        // What version 0.2 hashes and reads has the same bytes as without places.
        let without = points.to_bytes();
        assert_eq!((&without[..8], without.len()), (&b"FTHMPTS2"[..], 24 + 3 * 19 + 3 * 4));
        assert!(!Points::from_bytes(&without).unwrap().tracks.have_places());
        assert_eq!(tracked().to_bytes_with_places(), tracked().to_bytes());
        for method in Method::ALL {
            let needed = if method.through_surface() { &bytes } else { &without };
            assert_eq!(&points.to_bytes_for(method), needed, "{method:?}");
        }
        let kept = points.select(&[2, 0]);
        assert_eq!(kept.tracks.seen(0).collect::<Vec<_>>(), [(3, place(9.25))]);
        assert_eq!(kept.tracks.seen(1).collect::<Vec<_>>(), [(0, Place::UNKNOWN), (7, place(3.5))]);
    }

    #[test]
    fn selected_points_keep_their_tracks() {
        let points = tracked().select(&[3, 2, 0]);
        assert_eq!(points.positions.iter().map(|p| p[0]).collect::<Vec<_>>(), [4.0, 3.0, 1.0]);
        assert_eq!(
            [0, 1, 2].map(|point| points.tracks.of(point).to_vec()),
            [vec![], vec![1, 3], vec![0, 3, 7]]
        );
        assert!(tracked().select(&[1, 3]).tracks.is_empty());
    }

    #[test]
    fn points_survive_bytes() {
        let bytes = sample().to_bytes();
        assert_eq!(bytes.len(), 16 + 2 * 15);
        assert_eq!(Points::from_bytes(&bytes).unwrap(), sample());
        assert_eq!(Points::from_bytes(&Points::default().to_bytes()).unwrap(), Points::default());
    }

    #[test]
    fn truncated_or_foreign_bytes_are_refused() {
        let bytes = sample().to_bytes();
        for len in 0..bytes.len() {
            assert!(Points::from_bytes(&bytes[..len]).is_err(), "{len} of {} bytes passed", bytes.len());
        }
        let mut absurd = bytes.clone();
        absurd[8..16].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(Points::from_bytes(&absurd).unwrap_err().to_string().contains("18446744073709551615 points"));
        let mut nan = bytes;
        nan[16..20].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(Points::from_bytes(&nan).unwrap_err().to_string().contains("point 0 is not finite"));
    }

    #[test]
    fn the_extent_is_a_tenth_above_the_farthest_camera() {
        let centres = [DVec3::new(0.0, 0.0, 0.0), DVec3::new(4.0, 0.0, 0.0), DVec3::new(2.0, 0.0, 0.0)];
        assert!((extent(&centres) - 2.2).abs() < 1e-12);
        assert_eq!(extent(&[]), 0.0);
    }

    fn survey() -> (Vec<(PinholeCamera, Pose)>, Points) {
        // Cameras in a row at y = -5 look down (y) on points at y = 0 and on one above them.
        let camera = PinholeCamera { width: 100, height: 100, fx: 50.0, fy: 50.0, cx: 50.0, cy: 50.0 };
        let views = (0..40).map(|i| {
            let eye = DVec3::new(f64::from(i) * 2.0, -5.0, 0.0);
            (camera, Pose::looking_at(eye, eye + DVec3::Y, DVec3::Z))
        });
        let mut points = Points::default();
        for i in 0..400 {
            points.push([f64::from(i) * 0.2, 0.0, f64::from(i % 3)], [0; 3]);
        }
        points.push([10.0, -4.0, 0.0], [0; 3]);
        (views.collect(), points)
    }

    #[test]
    fn the_viewing_distance_is_the_median_depth_in_view() {
        let (views, points) = survey();
        assert!((viewing_distance(&views, &points).unwrap() - 5.0).abs() < 1e-9);
        assert_eq!(viewing_distance(&views, &Points::default()), None);
        assert_eq!(viewing_distance(&[], &points), None);
        let (camera, pose) = views[0];
        let away = Pose::looking_at(pose.centre(), pose.centre() - DVec3::Y, DVec3::Z);
        assert_eq!(viewing_distance(&[(camera, away)], &points), None, "everything is behind the camera");
    }

    #[test]
    fn a_long_survey_does_not_raise_the_learning_scale() {
        let (views, points) = survey();
        let centres: Vec<DVec3> = views.iter().map(|(_, pose)| pose.centre()).collect();
        let (extent, distance) = (extent(&centres), viewing_distance(&views, &points));
        assert!(extent > 40.0);
        assert!((learning_scale(extent, distance) - 5.0).abs() < 1e-9);
        assert_eq!(learning_scale(3.0, distance), 3.0, "an orbit keeps the rates of 3DGS");
        assert_eq!(learning_scale(extent, None), extent);
        assert!((learning_scale(0.0, distance) - 5.0).abs() < 1e-9, "cameras at one position have no extent");
    }
}
