//! Adjacent partitions, which the picture gives different colours. (Measurement lines are in `seam_lines`,
//! the bands of the merge in `fathom-merge`.)

use crate::geometry::{Interval, Rect};
use crate::plan::{PartitionId, Plan};

impl Plan {
    /// The partitions whose cells touch that of `partition`, at a corner too; ascending.
    pub fn neighbours(&self, partition: PartitionId) -> Vec<PartitionId> {
        let Some(own) = self.partitions.get(partition.0 as usize) else { return Vec::new() };
        let others = self.partitions.iter().filter(|other| other.id != own.id);
        others.filter(|other| touch(&own.cell, &other.cell)).map(|other| other.id).collect()
    }
}

/// The intersection of two intervals, ends included; `None` where they are apart.
pub(super) fn common(a: Interval, b: Interval) -> Option<Interval> {
    let lo = [a.lo, b.lo].into_iter().flatten().reduce(f64::max);
    let hi = [a.hi, b.hi].into_iter().flatten().reduce(f64::min);
    let apart = lo.zip(hi).is_some_and(|(lo, hi)| lo > hi);
    (!apart).then_some(Interval { lo, hi })
}

fn touch(a: &Rect, b: &Rect) -> bool {
    common(a.x, b.x).is_some() && common(a.z, b.z).is_some()
}
