//! The views that see each sparse point: tracks of structure from motion, without the pixels.

use serde::{Deserialize, Serialize};

/// For each point the views that see it, as indices into the views of the scene by name; ascending and
/// unique.
///
/// Takes 4 bytes an observation and 4 a point. Points after the last one with a track take no space, and
/// neither does a scene without tracks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tracks {
    /// End of each point's track in `views`; it begins at the end of the previous one.
    ends: Vec<u32>,
    /// Tracks one after the other.
    views: Vec<u32>,
}

impl Tracks {
    /// The views that see this point; none if unknown.
    pub fn of(&self, point: usize) -> &[u32] {
        let end = |index: usize| self.ends.get(index).map_or(self.views.len(), |end| *end as usize);
        let start = if point == 0 { 0 } else { end(point - 1) };
        self.views.get(start..end(point)).unwrap_or_default()
    }

    /// Number of observations: pairs of a point and a view.
    pub fn observations(&self) -> usize {
        self.views.len()
    }

    /// Whether no point has a track.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Sets the track of `point`. Points get their tracks in ascending order; skipped points have none.
    pub(crate) fn set_last(&mut self, point: usize, views: &mut Vec<u32>) {
        views.sort_unstable();
        views.dedup();
        // Offsets have 32 bits: no reconstruction has 4e9 observations.
        let fits = self.views.len() + views.len() <= u32::MAX as usize;
        if views.is_empty() || !fits || point < self.ends.len() {
            return;
        }
        self.ends.resize(point, self.views.len() as u32);
        self.views.extend_from_slice(views);
        self.ends.push(self.views.len() as u32);
    }

    /// Renumbers the views by `new_index[old]`, which is `None` for a view that was left out. New indices are
    /// ascending.
    pub(super) fn renumber(&mut self, new_index: &[Option<u32>]) {
        let mut renumbered = Self::default();
        let mut track = Vec::new();
        for point in 0..self.ends.len() {
            track.clear();
            track.extend(
                self.of(point).iter().filter_map(|&view| new_index.get(view as usize).copied().flatten()),
            );
            renumbered.set_last(point, &mut track);
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
}
