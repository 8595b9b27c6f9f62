//! Neighbours and distances to them, computed from the cells independently of the plan's own code.

use super::*;
use crate::neighbours::common;

/// A piece of border between two cells, aligned frame.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    /// Every piece of border that two cells share, in order of the partitions on the low side, then on the
    /// high side.
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
}

impl Rect {
    /// Distance of an aligned point on the plane from this rectangle, scene units; 0 inside and on its sides.
    pub fn distance(&self, aligned: DVec3) -> f64 {
        outside(self.x, aligned.x).hypot(outside(self.z, aligned.z))
    }

    /// Distance of an aligned point of the rectangle from the nearest side that is not open, that is from the
    /// nearest other cell; infinite where all sides are open.
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

#[test]
fn grid_cells_have_up_to_8_neighbours_and_4_borders() {
    let plan = planned(&survey(300), &floor(500), &config(3, 3));
    let ids = |numbers: &[u32]| numbers.iter().map(|&id| PartitionId(id)).collect::<Vec<_>>();
    // Columns share their borders in x; rows are cut column by column, so corners need not meet across
    // columns.
    let middle = plan.neighbours(PartitionId(4));
    assert!(ids(&[1, 3, 5, 7]).iter().all(|id| middle.contains(id)), "{middle:?}");
    assert!(!middle.contains(&PartitionId(4)) && middle.is_sorted());
    for partition in &plan.partitions {
        for other in plan.neighbours(partition.id) {
            assert!(plan.neighbours(other).contains(&partition.id), "{} and {other}", partition.id);
        }
    }
    assert_eq!(plan.neighbours(PartitionId(99)), []);
    assert_eq!(planned(&survey(50), &floor(50), &config(1, 1)).shared_borders(), []);
}

#[test]
fn a_border_ends_the_low_cell_and_separates_what_is_kept() {
    let plan = planned(&survey(400), &floor(500), &config(3, 2));
    let borders = plan.shared_borders();
    // Two borders between columns, each in up to three pieces since rows differ, and one in each column.
    assert!(borders.len() >= 3 + 2 * 2, "{borders:?}");
    for border in &borders {
        let middle = match (border.span.lo, border.span.hi) {
            (Some(lo), Some(hi)) => (lo + hi) / 2.0,
            (lo, hi) => lo.map(|lo| lo + 1e-3).or(hi.map(|hi| hi - 1e-3)).unwrap_or(0.0),
        };
        let point = |along: f64| match border.axis {
            Axis::X => DVec3::new(along, 0.0, middle),
            Axis::Z => DVec3::new(middle, 0.0, along),
        };
        let cell = |id: PartitionId| plan.partitions[id.0 as usize].cell;
        assert!(
            cell(border.low).contains(point(border.at)) && cell(border.low).contains(point(border.at - 1e-6))
        );
        assert!(cell(border.high).contains(point(border.at + 1e-6)));
        assert!((border.distance(point(border.at + 0.25)) - 0.25).abs() < 1e-12);
        assert!((cell(border.low).distance(point(border.at + 1e-3)) - 1e-3).abs() < 1e-9);
    }
}

#[test]
fn the_distance_to_a_border_is_that_to_the_nearest_other_cell() {
    let plan = planned(&survey(400), &floor(500), &config(3, 3));
    let cells: Vec<Rect> = plan.partitions.iter().map(|p| p.cell).collect();
    for i in 0..2000 {
        let draw = |k: u32| f64::from(uniform_at(6, Stream::Test, i, k)) * 30.0 - 5.0;
        let point = DVec3::new(draw(0), 0.0, draw(1));
        let own = cells.iter().position(|cell| cell.contains(point)).unwrap();
        let others = cells.iter().enumerate().filter(|&(other, _)| other != own);
        let nearest = others.map(|(_, cell)| cell.distance(point)).fold(f64::INFINITY, f64::min);
        assert!((cells[own].distance_to_border(point) - nearest).abs() < 1e-12, "{point}");
    }
    let whole = Rect { x: Interval::ALL, z: Interval::ALL };
    assert_eq!(whole.distance_to_border(DVec3::ONE), f64::INFINITY);
}
