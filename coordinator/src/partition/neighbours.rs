//! Which partitions meet, where, and how far a point is from there: what the picture and tests of the cut ask. (Lines that models
//! are measured along are in `seam_lines`, bands of the merge in `merge::border`.)
//!
//! Cells tile the plane, so a border is a piece of a line that two cells share: at one coordinate of an axis, over the
//! common part of their intervals along the other. Everything here is a pure function of the cells.

use fathom_core::seams::Axis;
use glam::DVec3;
use serde::Serialize;

use super::plan::{Interval, Partition, PartitionId, Plan, Rect};

/// A piece of border between two cells, aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Border {
    /// The partition on the low side, to which the border itself belongs.
    pub low: PartitionId,
    /// The partition on the high side.
    pub high: PartitionId,
    /// The axis that it cuts.
    pub axis: Axis,
    /// Where, along that axis.
    pub at: f64,
    /// From where to where, along the other axis.
    pub span: Interval,
}

impl Border {
    /// Distance of an aligned point on the plane from this piece, scene units.
    pub fn distance(&self, aligned: DVec3) -> f64 {
        let beyond = outside(self.span, self.axis.across().of(aligned));
        (self.axis.of(aligned) - self.at).hypot(beyond)
    }
}

impl Plan {
    /// Every piece of border that two cells share, in order of the partitions on the low side, then on the high side.
    pub fn shared_borders(&self) -> Vec<Border> {
        let mut borders = Vec::new();
        for low in &self.partitions {
            for high in &self.partitions {
                borders
                    .extend([Axis::X, Axis::Z].into_iter().filter_map(|axis| border_across(axis, low, high)));
            }
        }
        borders
    }

    /// The partitions whose cells touch that of `partition`, at a corner too; ascending.
    ///
    /// These are all that can have something within a small distance of its border on the other side of it. A distance
    /// larger than a cell reaches beyond them: see [`Rect::distance`].
    pub fn neighbours(&self, partition: PartitionId) -> Vec<PartitionId> {
        let Some(own) = self.partitions.get(partition.0 as usize) else { return Vec::new() };
        let others = self.partitions.iter().filter(|other| other.id != own.id);
        others.filter(|other| touch(&own.cell, &other.cell)).map(|other| other.id).collect()
    }
}

impl Rect {
    /// Distance of an aligned point on the plane from this rectangle, scene units; 0 inside and on its sides.
    pub fn distance(&self, aligned: DVec3) -> f64 {
        outside(self.x, aligned.x).hypot(outside(self.z, aligned.z))
    }

    /// Distance of an aligned point of the rectangle from the nearest side that is not open, that is from the nearest
    /// other cell; infinite where all sides are open.
    pub fn distance_to_border(&self, aligned: DVec3) -> f64 {
        let sides = [(self.x, aligned.x), (self.z, aligned.z)];
        sides
            .iter()
            .flat_map(|&(side, at)| [side.lo, side.hi].map(|end| end.map(|end| (at - end).abs())))
            .flatten()
            .fold(f64::INFINITY, f64::min)
    }
}

/// How far `value` lies outside of an interval.
fn outside(side: Interval, value: f64) -> f64 {
    let below = side.lo.map_or(0.0, |lo| lo - value);
    let above = side.hi.map_or(0.0, |hi| value - hi);
    below.max(above).max(0.0)
}

/// What two intervals have in common, ends included; `None` where they are apart.
fn common(a: Interval, b: Interval) -> Option<Interval> {
    let lo = [a.lo, b.lo].into_iter().flatten().reduce(f64::max);
    let hi = [a.hi, b.hi].into_iter().flatten().reduce(f64::min);
    let apart = lo.zip(hi).is_some_and(|(lo, hi)| lo > hi);
    (!apart).then_some(Interval { lo, hi })
}

fn touch(a: &Rect, b: &Rect) -> bool {
    common(a.x, b.x).is_some() && common(a.z, b.z).is_some()
}

/// The border where `low` ends and `high` begins, if they share a piece of it that has a length.
fn border_across(axis: Axis, low: &Partition, high: &Partition) -> Option<Border> {
    let at = low.cell.along(axis).hi?;
    // A cell without width begins where it ends.
    if low.id == high.id || high.cell.along(axis).lo != Some(at) {
        return None;
    }
    let span = common(low.cell.along(axis.across()), high.cell.along(axis.across()))?;
    let has_length = span.lo.zip(span.hi).is_none_or(|(lo, hi)| lo < hi);
    has_length.then_some(Border { low: low.id, high: high.id, axis, at, span })
}
