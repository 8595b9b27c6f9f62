//! The views that see each sparse point: tracks of structure from motion, with the pixels where they see it.

use serde::{Deserialize, Serialize};

/// Steps of [`Place`] along a side of the picture; one number is left for [`Place::UNKNOWN`].
const STEPS: f64 = 65_535.0;

/// Where a view sees a point: shares of the width and the height of the undistorted picture, in 16 bits each.
///
/// A share does not depend on the size of the picture, so it stays true when photographs are reduced. It is
/// exact to 1/131,070 of the side: 0.03 px in a picture of 4096.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Place([u16; 2]);

impl Place {
    /// Of an observation without a pixel in the undistorted picture.
    pub const UNKNOWN: Self = Self([u16::MAX; 2]);

    /// From a `pixel` of a picture of this size, from its top-left corner; [`Place::UNKNOWN`] outside the
    /// picture.
    pub fn new([x, y]: [f64; 2], width: u32, height: u32) -> Self {
        let share = |at: f64, side: u32| {
            // Phrased positively, so that NaN is outside.
            let inside = at >= 0.0 && at <= f64::from(side);
            inside.then(|| (at / f64::from(side) * STEPS).min(STEPS - 1.0) as u16)
        };
        share(x, width).zip(share(y, height)).map_or(Self::UNKNOWN, |(x, y)| Self([x, y]))
    }

    /// The pixel in a picture of this size, from its top-left corner; `None` if it is unknown.
    pub fn pixel(self, width: u32, height: u32) -> Option<[f64; 2]> {
        let at = |share: u16, side: u32| (f64::from(share) + 0.5) / STEPS * f64::from(side);
        self.is_known().then(|| [at(self.0[0], width), at(self.0[1], height)])
    }

    /// Whether there is a pixel.
    pub fn is_known(self) -> bool {
        !self.0.contains(&u16::MAX)
    }

    /// Four bytes: x, then y, little-endian.
    pub(super) fn to_bytes(self) -> [u8; 4] {
        let [[a, b], [c, d]] = self.0.map(u16::to_le_bytes);
        [a, b, c, d]
    }

    /// The inverse of [`Place::to_bytes`].
    pub(super) fn from_bytes([a, b, c, d]: [u8; 4]) -> Self {
        let place = Self([u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])]);
        if place.is_known() { place } else { Self::UNKNOWN }
    }
}

/// For each point the views that see it, as indices into the views of the scene by name; ascending and
/// unique. For each of these observations the pixel, if the input has pixels.
///
/// Takes 8 bytes an observation with pixels, 4 without, and 4 a point. Points after the last one with a track
/// take no space, and neither does a scene without tracks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tracks {
    /// End of each point's track in `views`; it begins at the end of the previous one.
    ends: Vec<u32>,
    /// Tracks one after the other.
    views: Vec<u32>,
    /// The place of each observation; empty if none is known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    places: Vec<Place>,
}

impl Tracks {
    /// The views that see this point; none if unknown.
    pub fn of(&self, point: usize) -> &[u32] {
        self.views.get(self.range(point)).unwrap_or_default()
    }

    /// The views that see this point, each with the place where it does.
    pub fn seen(&self, point: usize) -> impl Iterator<Item = (u32, Place)> {
        let places = self.places.get(self.range(point)).unwrap_or_default();
        let place = |index: usize| places.get(index).copied().unwrap_or(Place::UNKNOWN);
        self.of(point).iter().enumerate().map(move |(index, &view)| (view, place(index)))
    }

    fn range(&self, point: usize) -> std::ops::Range<usize> {
        let end = |index: usize| self.ends.get(index).map_or(self.views.len(), |end| *end as usize);
        (if point == 0 { 0 } else { end(point - 1) })..end(point)
    }

    /// Number of observations: pairs of a point and a view.
    pub fn observations(&self) -> usize {
        self.views.len()
    }

    /// Whether no point has a track.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Whether the pixel of any observation is known.
    pub fn have_places(&self) -> bool {
        !self.places.is_empty()
    }

    /// Sets the track of `point`. Points get their tracks in ascending order; skipped points have none.
    pub(crate) fn set_last(&mut self, point: usize, views: &mut Vec<u32>) {
        views.sort_unstable();
        views.dedup();
        if self.make_room(point, views.len()) {
            self.views.extend_from_slice(views);
            self.end_track();
        }
    }

    /// As [`Tracks::set_last`], with places. A point that a view sees twice, as after a wrong match, keeps
    /// the first of its places.
    pub(crate) fn set_last_seen(&mut self, point: usize, seen: &mut Vec<(u32, Place)>) {
        seen.sort_by_key(|(view, _)| *view);
        seen.dedup_by_key(|(view, _)| *view);
        if self.make_room(point, seen.len()) {
            if seen.iter().any(|(_, place)| place.is_known()) {
                self.places.resize(self.views.len(), Place::UNKNOWN);
                self.places.extend(seen.iter().map(|(_, place)| *place));
            }
            self.views.extend(seen.iter().map(|(view, _)| *view));
            self.end_track();
        }
    }

    /// Whether a track of `count` views can be set for `point`; earlier points without one get an empty one.
    fn make_room(&mut self, point: usize, count: usize) -> bool {
        // Offsets have 32 bits: no reconstruction has 4e9 observations.
        let fits = self.views.len() + count <= u32::MAX as usize;
        if count == 0 || !fits || point < self.ends.len() {
            return false;
        }
        self.ends.resize(point, self.views.len() as u32);
        true
    }

    fn end_track(&mut self) {
        self.ends.push(self.views.len() as u32);
        if self.have_places() {
            self.places.resize(self.views.len(), Place::UNKNOWN);
        }
    }

    /// Renumbers the views by `new_index[old]`, which is `None` for a view that was left out. New indices are
    /// ascending.
    pub(super) fn renumber(&mut self, new_index: &[Option<u32>]) {
        let mut renumbered = Self::default();
        let mut track = Vec::new();
        for point in 0..self.ends.len() {
            track.clear();
            track.extend(
                self.seen(point).filter_map(|(view, place)| {
                    Some((new_index.get(view as usize).copied().flatten()?, place))
                }),
            );
            renumbered.set_last_seen(point, &mut track);
        }
        *self = renumbered;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_that_were_left_out_leave_the_tracks() {
        let mut tracks = Tracks::default();
        for (point, mut views) in [(0, vec![0, 1, 2]), (2, vec![2, 3]), (3, vec![1])] {
            tracks.set_last(point, &mut views);
        }
        tracks.renumber(&[Some(0), None, Some(1), Some(2)]);
        assert_eq!(
            [0, 1, 2, 3, 4].map(|point| tracks.of(point).to_vec()),
            [vec![0, 1], vec![], vec![1, 2], vec![], vec![]]
        );
        assert_eq!(tracks.observations(), 4);
        tracks.renumber(&[]);
        assert_eq!(tracks, Tracks::default(), "no views, no tracks");
    }

    #[test]
    fn a_place_is_exact_to_a_small_part_of_a_pixel() {
        for (width, height) in [(8, 6), (4096, 3000), (65_535, 1)] {
            for k in 0..=1000 {
                let share = f64::from(k) / 1000.0;
                let pixel = [share * f64::from(width), (1.0 - share) * f64::from(height)];
                let read = Place::new(pixel, width, height).pixel(width, height).unwrap();
                let bound = |side: u32| f64::from(side) / 131_070.0 * (1.0 + 1e-9);
                assert!((read[0] - pixel[0]).abs() <= bound(width), "{read:?} instead of {pixel:?}");
                assert!((read[1] - pixel[1]).abs() <= bound(height), "{read:?} instead of {pixel:?}");
            }
        }
        let half = Place::new([1024.0, 750.0], 4096, 3000);
        assert!((half.pixel(400, 300).unwrap()[0] - 100.0).abs() < 0.004, "a reduced picture");
        for outside in [[-0.1, 1.0], [8.1, 1.0], [1.0, f64::NAN], [1.0, 6.5], [f64::INFINITY, 1.0]] {
            assert_eq!(Place::new(outside, 8, 6), Place::UNKNOWN, "{outside:?}");
        }
        assert_eq!(Place::from_bytes(half.to_bytes()), half);
        assert_eq!(Place::from_bytes([255, 255, 3, 0]), Place::UNKNOWN);
    }

    #[test]
    fn places_follow_their_views_and_take_no_space_if_unknown() {
        let at = |x: u16| Place([x, 1]);
        let mut tracks = Tracks::default();
        tracks.set_last(0, &mut vec![1, 4]);
        assert!(!tracks.have_places());
        tracks.set_last_seen(1, &mut vec![(2, at(12)), (0, at(10)), (2, at(99)), (3, Place::UNKNOWN)]);
        tracks.set_last(3, &mut vec![2]);
        tracks.set_last_seen(4, &mut vec![(2, Place::UNKNOWN)]);
        let seen = |tracks: &Tracks, point| tracks.seen(point).collect::<Vec<_>>();
        assert_eq!(seen(&tracks, 0), [(1, Place::UNKNOWN), (4, Place::UNKNOWN)]);
        assert_eq!(seen(&tracks, 1), [(0, at(10)), (2, at(12)), (3, Place::UNKNOWN)]);
        assert_eq!(seen(&tracks, 2), []);
        assert_eq!(seen(&tracks, 4), [(2, Place::UNKNOWN)]);
        assert_eq!((tracks.views.len(), tracks.places.len()), (7, 7));
        tracks.renumber(&[None, Some(0), Some(1), Some(2), Some(3)]);
        assert_eq!(seen(&tracks, 1), [(1, at(12)), (2, Place::UNKNOWN)]);
        tracks.renumber(&[Some(0), None, Some(1), Some(2)]);
        assert!(!tracks.have_places(), "the one view with a place is left out");
    }
}
