//! The borders between cells, and the lines through the middle of cells that they are compared with.
//!
//! Cells are rectangles (lo, hi] that tile the plane. So every point of a border lies on the upper side of
//! exactly one cell: the borders are the upper sides of all cells. That holds for grids and for any other way
//! to cut.

use fathom_core::config::SeamsConfig;
use fathom_core::seams::{Axis, Line, SeamLines};

use crate::geometry::{Box3, Interval, Rect};
use crate::plan::Plan;

/// Minimum distance of a control line from the borders of its cell, in bands: the three of its flank, and the
/// band of the border.
const LEAST_BANDS: f64 = 4.0;

impl Plan {
    /// The lines along which a model of this plan is measured for seams; `None` for a single partition.
    pub fn seam_lines(&self, config: &SeamsConfig) -> Option<SeamLines> {
        let cells: Vec<Rect> = self.partitions.iter().map(|partition| partition.cell).collect();
        let borders = borders(&cells);
        // Without points in view the scene scale is unknown; the extent of the cameras replaces it.
        let band = config.band * self.extent.viewing_distance.unwrap_or(self.extent.radius);
        let controls = middles(&cells, &self.extent.cameras, LEAST_BANDS * band);
        let world_to_aligned = self.alignment.rotation();
        (!borders.is_empty()).then_some(SeamLines { world_to_aligned, borders, controls, band })
    }
}

/// The borders between cells that tile the plane, in as few pieces as they are straight; by axis, coordinate
/// and start.
pub fn borders(cells: &[Rect]) -> Vec<Line> {
    let sides = cells.iter().flat_map(|cell| {
        AXES.into_iter().filter_map(|axis| {
            let (across, along) = sides(cell, axis);
            across.hi.map(|at| line(axis, at, along))
        })
    });
    joined(sides.collect())
}

/// Lines through the middle of each cell, across every axis on which it has a neighbour: as far from the
/// borders as possible. Open sides are closed at the box of the cameras, because a scene beyond it is only
/// seen from afar. Lines nearer than `least` (scene units) to a border of their cell are left out.
pub fn middles(cells: &[Rect], cameras: &Box3, least: f64) -> Vec<Line> {
    let middle = |cell: &Rect, axis: Axis| {
        let (across, along) = sides(cell, axis);
        if across == Interval::ALL {
            return None;
        }
        let index = match axis {
            Axis::X => 0,
            Axis::Z => 2,
        };
        let lo = across.lo.unwrap_or(cameras.min[index]);
        let hi = across.hi.unwrap_or(cameras.max[index]);
        let at = (lo + hi) / 2.0;
        (hi - at >= least).then(|| line(axis, at, along))
    };
    joined(cells.iter().flat_map(|cell| AXES.into_iter().filter_map(|axis| middle(cell, axis))).collect())
}

const AXES: [Axis; 2] = [Axis::X, Axis::Z];

/// The interval of a cell on an axis, and that on the other one.
fn sides(cell: &Rect, axis: Axis) -> (Interval, Interval) {
    match axis {
        Axis::X => (cell.x, cell.z),
        Axis::Z => (cell.z, cell.x),
    }
}

fn line(axis: Axis, at: f64, along: Interval) -> Line {
    let (from, to) = (along.lo.unwrap_or(f64::NEG_INFINITY), along.hi.unwrap_or(f64::INFINITY));
    Line { axis, at, from, to }
}

/// Lines that touch or overlap made one; lines without length left out.
fn joined(mut lines: Vec<Line>) -> Vec<Line> {
    // Between cameras at one coordinate there are cells without width, whose sides have no length.
    lines.retain(|line| line.from < line.to);
    lines.sort_unstable_by(|a, b| {
        a.axis
            .cmp(&b.axis)
            .then(a.at.total_cmp(&b.at))
            .then(a.from.total_cmp(&b.from))
            .then(a.to.total_cmp(&b.to))
    });
    let mut joined: Vec<Line> = Vec::with_capacity(lines.len());
    for line in lines {
        match joined.last_mut() {
            Some(last) if last.axis == line.axis && last.at == line.at && line.from <= last.to => {
                last.to = last.to.max(line.to);
            }
            _ => joined.push(line),
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};
    use proptest::prelude::*;

    use super::*;

    const CAMERAS: Box3 = Box3 { min: [-10.0; 3], max: [10.0; 3] };

    fn interval(lo: impl Into<Option<f64>>, hi: impl Into<Option<f64>>) -> Interval {
        Interval { lo: lo.into(), hi: hi.into() }
    }

    /// Cells of any shape: each cut takes one cell, by number, and splits it on one axis at a coordinate
    /// inside it.
    fn split(cuts: &[(usize, bool, f64)]) -> Vec<Rect> {
        let mut cells = vec![Rect { x: Interval::ALL, z: Interval::ALL }];
        for &(which, along_x, at) in cuts {
            let cell = cells.swap_remove(which % cells.len());
            let (axis, _) = sides(&cell, if along_x { Axis::X } else { Axis::Z });
            // A coordinate outside gives a cell of zero width, as cameras at one coordinate do.
            let at = at.clamp(axis.lo.unwrap_or(-10.0), axis.hi.unwrap_or(10.0));
            for half in [Interval { hi: Some(at), ..axis }, Interval { lo: Some(at), ..axis }] {
                cells.push(if along_x { Rect { x: half, ..cell } } else { Rect { z: half, ..cell } });
            }
        }
        cells
    }

    fn owner(cells: &[Rect], point: DVec2) -> usize {
        let owners: Vec<usize> =
            (0..cells.len()).filter(|&i| cells[i].contains(DVec3::new(point.x, 0.0, point.y))).collect();
        assert_eq!(owners.len(), 1, "cells do not tile at {point}");
        owners[0]
    }

    fn cuts() -> impl Strategy<Value = Vec<(usize, bool, f64)>> {
        prop::collection::vec((0usize..64, any::<bool>(), (-9i32..=9).prop_map(f64::from)), 0..12)
    }

    proptest! {
        #[test]
        fn only_a_path_that_crosses_a_line_leads_to_another_cell(
            cuts in cuts(),
            at in (-11.0..11.0, -11.0..11.0),
            way in (-0.9..0.9, -0.9..0.9),
        ) {
            let cells = split(&cuts);
            let lines = borders(&cells);
            let a = DVec2::new(at.0, at.1);
            // Along one axis and then along the other, each less than the distance of two cuts.
            for b in [a + DVec2::X * way.0, a + DVec2::Y * way.1] {
                let crossed = lines.iter().filter(|line| line.is_crossed(a, b)).count();
                prop_assert!(crossed <= 1, "{crossed} lines between {a} and {b}: {lines:?}");
                prop_assert_eq!(crossed == 1, owner(&cells, a) != owner(&cells, b), "{} to {}: {:?}", a, b, lines);
            }
        }

        #[test]
        fn borders_do_not_depend_on_the_order_of_cells(cuts in cuts(), turn in 0usize..20) {
            let cells = split(&cuts);
            let mut other = cells.clone();
            other.rotate_left(turn % cells.len());
            other.reverse();
            prop_assert_eq!(borders(&cells), borders(&other));
            prop_assert_eq!(middles(&cells, &CAMERAS, 0.5), middles(&other, &CAMERAS, 0.5));
        }

        #[test]
        fn control_lines_keep_their_distance_from_borders(cuts in cuts()) {
            let cells = split(&cuts);
            for control in middles(&cells, &CAMERAS, 1.0) {
                for border in borders(&cells).iter().filter(|border| border.axis == control.axis) {
                    let overlap = border.to.min(control.to) - border.from.max(control.from);
                    let apart = (border.at - control.at).abs();
                    prop_assert!(overlap <= 0.0 || apart >= 1.0, "{:?} beside {:?}", control, border);
                }
            }
        }
    }

    #[test]
    fn a_grid_has_lines_between_columns_and_pieces_between_rows() {
        let (left, right) = (interval(None, 2.0), interval(2.0, None));
        let rect = |x: Interval, z: Interval| Rect { x, z };
        let cells = [
            rect(left, interval(None, 1.0)),
            rect(left, interval(1.0, None)),
            rect(right, interval(None, -3.0)),
            rect(right, interval(-3.0, None)),
        ];
        let (all, none) = ((f64::NEG_INFINITY, f64::INFINITY), 2.0);
        let expected = [
            Line { axis: Axis::X, at: 2.0, from: all.0, to: all.1 },
            Line { axis: Axis::Z, at: -3.0, from: none, to: all.1 },
            Line { axis: Axis::Z, at: 1.0, from: all.0, to: none },
        ];
        assert_eq!(borders(&cells), expected);
        // Between -10 and 2, and between 2 and 10; then along z of the left column and of the right one.
        let at = |axis: Axis| -> Vec<f64> {
            let all = middles(&cells, &CAMERAS, 0.1);
            all.iter().filter(|line| line.axis == axis).map(|line| line.at).collect()
        };
        assert_eq!(at(Axis::X), [-4.0, 6.0]);
        assert_eq!(at(Axis::Z), [-6.5, -4.5, 3.5, 5.5]);
    }

    #[test]
    fn nothing_is_cut_in_one_cell_and_narrow_cells_have_no_middle() {
        let whole = [Rect { x: Interval::ALL, z: Interval::ALL }];
        assert_eq!((borders(&whole), middles(&whole, &CAMERAS, 0.0)), (vec![], vec![]));
        let cells = split(&[(0, true, 9.5)]);
        // From 9.5 to the outermost camera at 10 there is no room for a distance of 0.3 to both.
        assert_eq!(middles(&cells, &CAMERAS, 0.3).len(), 1);
        assert_eq!(middles(&cells, &CAMERAS, 0.2).len(), 2);
    }
}
