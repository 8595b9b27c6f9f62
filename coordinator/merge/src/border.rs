//! The inner borders of a cell, and the distance of a Gaussian from them.
//!
//! Cells are rectangles that tile the plane, and their outer sides are open. So every closed side has
//! neighbours along its whole length, for any cut. From a point inside the cell, the nearest point of that
//! side is the foot of the perpendicular: a distance to a border is a difference of two coordinates.

use glam::DVec3;

use fathom_plan::{Interval, Partition};

/// A closed side of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Side {
    /// 0 for x, 2 for z.
    axis: usize,
    /// Its coordinate, aligned frame.
    at: f64,
    /// Half-width of the band in which duplicates are searched, scene units.
    limit: f64,
}

/// The bands along the inner borders of one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Bands(Vec<Side>);

impl Bands {
    /// Bands with a width of `share` of the partition's extension beyond each side of its cell.
    pub fn new(partition: &Partition, share: f64) -> Self {
        let mut sides = Vec::new();
        for (axis, cell, focus) in
            [(0, partition.cell.x, partition.focus.x), (2, partition.cell.z, partition.focus.z)]
        {
            let Interval { lo, hi } = cell;
            for (at, beyond) in [(lo, focus.lo), (hi, focus.hi)] {
                let Some(at) = at else { continue };
                let extension = beyond.map_or(f64::INFINITY, |beyond| (beyond - at).abs());
                // Zero times an infinite extension would be NaN.
                let limit = if share > 0.0 { share * extension } else { 0.0 };
                sides.push(Side { axis, at, limit });
            }
        }
        Self(sides)
    }

    /// Whether one of the cell's Gaussians is in a band and `reach` or less from its border, aligned frame.
    pub fn reaches(&self, aligned: DVec3, reach: f64) -> bool {
        self.0.iter().any(|side| {
            let distance = (aligned[side.axis] - side.at).abs();
            distance <= reach && distance < side.limit
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::grid_plan;

    #[test]
    fn a_band_lies_along_closed_sides_and_scales_with_extension() {
        let plan = grid_plan(2, 1);
        let partition = &plan.partitions[0];
        let border = partition.cell.x.hi.unwrap();
        let extension = partition.focus.x.hi.unwrap() - border;
        let at = |distance: f64| DVec3::new(border - distance * extension, 3.0, 1e9);
        let bands = Bands::new(partition, 0.25);
        assert!(bands.reaches(at(0.0), 0.0) && bands.reaches(at(0.24), extension));
        assert!(!bands.reaches(at(0.26), f64::INFINITY), "beyond the band");
        assert!(!bands.reaches(at(0.2), 0.1 * extension), "too small to reach the border");
        assert!(!Bands::new(partition, 0.0).reaches(at(0.0), f64::INFINITY), "no band at all");
        let only = grid_plan(1, 1);
        assert!(!Bands::new(&only.partitions[0], 1.0).reaches(DVec3::ZERO, f64::INFINITY), "no border");
    }
}
