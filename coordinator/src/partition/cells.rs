//! Membership and cells: whose camera is whose, and which piece of the plane belongs to whom.
//!
//! Cameras are shared out by rank: sorted by x into columns, each column sorted by z into rows, the
//! remainder to the last (SMP-UWGS eq. 1). The border between neighbours is the coordinate of the last
//! camera of the lower one (the paper's boundary camera), and cells are (lo, hi] with the sides that have
//! no neighbour open. So every camera is in exactly one base set and every point in exactly one cell, for
//! all m, n >= 1. The camera on the border, and one that ties with it, belongs by rank; a neighbour sees
//! it through its extended box.

use std::cmp::Ordering;

use glam::DVec3;

use super::plan::{Interval, Layer, Rect};

/// A training camera on the plane.
#[derive(Clone, Copy, Debug)]
pub struct Centre<'a> {
    /// Index into the scene's views.
    pub view: u32,
    /// Name of the view; the last word on ties.
    pub name: &'a str,
    /// Centre in the aligned frame.
    pub at: DVec3,
}

/// One rectangle of the grid with the cameras that are its own.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Column along x, from 0.
    pub column: u32,
    /// Row along z, from 0.
    pub row: u32,
    /// Its rectangle.
    pub rect: Rect,
    /// Its views, ascending.
    pub views: Vec<u32>,
}

impl Cell {
    /// Where it lies in the grid.
    pub fn layer(&self) -> Layer {
        let open = |side: &Interval| side.lo.is_none() || side.hi.is_none();
        match (open(&self.rect.x), open(&self.rect.z)) {
            (true, true) => Layer::Corner,
            (false, false) => Layer::Inner,
            _ => Layer::Edge,
        }
    }
}

/// Shares the cameras out over `columns` x `rows` cells, column by column.
///
/// There must be at least `columns * rows` cameras.
pub fn cut<'a>(mut centres: Vec<Centre<'a>>, columns: u32, rows: u32) -> Vec<Cell> {
    debug_assert!(centres.len() >= columns as usize * rows as usize);
    centres.sort_unstable_by(|a, b| {
        compare(a.at.x, b.at.x).then(compare(a.at.z, b.at.z)).then(a.name.cmp(b.name))
    });
    let mut cells = Vec::with_capacity(columns as usize * rows as usize);
    for (column, (x, members)) in share_out(&centres, columns, |centre| centre.at.x).into_iter().enumerate() {
        let mut members: Vec<Centre<'a>> = members.to_vec();
        members.sort_unstable_by(|a, b| {
            compare(a.at.z, b.at.z).then(compare(a.at.x, b.at.x)).then(a.name.cmp(b.name))
        });
        for (row, (z, members)) in share_out(&members, rows, |centre| centre.at.z).into_iter().enumerate() {
            let mut views: Vec<u32> = members.iter().map(|centre| centre.view).collect();
            views.sort_unstable();
            cells.push(Cell { column: column as u32, row: row as u32, rect: Rect { x, z }, views });
        }
    }
    cells
}

/// Splits sorted `members` into `parts` runs of `len / parts`, the last with the remainder, and gives
/// each its interval: up to the coordinate of its last member, from that of the run before.
fn share_out<'a, 'b>(
    members: &'b [Centre<'a>],
    parts: u32,
    coordinate: impl Fn(&Centre<'a>) -> f64,
) -> Vec<(Interval, &'b [Centre<'a>])> {
    let parts = parts as usize;
    let each = members.len() / parts;
    let mut shares = Vec::with_capacity(parts);
    let mut lo = None;
    for part in 0..parts {
        let last = part + 1 == parts;
        let end = if last { members.len() } else { (part + 1) * each };
        let hi = if last { None } else { Some(coordinate(&members[end - 1])) };
        shares.push((Interval { lo, hi }, &members[part * each..end]));
        lo = hi;
    }
    shares
}

/// Order of two finite coordinates; 0.0 and -0.0 tie.
fn compare(a: f64, b: f64) -> Ordering {
    (a + 0.0).total_cmp(&(b + 0.0))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn centres<'a>(names: &'a [String], at: &[(f64, f64)]) -> Vec<Centre<'a>> {
        at.iter()
            .enumerate()
            .map(|(i, &(x, z))| Centre { view: i as u32, name: &names[i], at: DVec3::new(x, 0.0, z) })
            .collect()
    }

    fn names(count: usize) -> Vec<String> {
        (0..count).map(|i| format!("view{i:04}")).collect()
    }

    /// Coordinates on a coarse grid, so that ties and shared borders are common.
    fn coordinate() -> impl Strategy<Value = f64> {
        prop_oneof![(-4i32..4).prop_map(f64::from), -4.0..4.0]
    }

    proptest! {
        #[test]
        fn every_camera_is_in_exactly_one_base_set_and_every_point_in_exactly_one_cell(
            at in prop::collection::vec((coordinate(), coordinate()), 25..80),
            points in prop::collection::vec((coordinate(), coordinate()), 1..40),
            columns in 1u32..=5,
            rows in 1u32..=5,
        ) {
            let names = names(at.len());
            let cells = cut(centres(&names, &at), columns, rows);
            prop_assert_eq!(cells.len() as u32, columns * rows);
            let mut seen = BTreeSet::new();
            for cell in &cells {
                prop_assert!(cell.views.len() >= at.len() / columns as usize / rows as usize);
                for &view in &cell.views {
                    prop_assert!(seen.insert(view), "view {} twice", view);
                }
            }
            prop_assert_eq!(seen.len(), at.len());
            // The cameras themselves lie on borders, so they are the hardest points of all.
            let far = [(1e30, 1e30), (-1e30, -1e30), (1e30, -1e30), (-1e30, 1e30)];
            for &(x, z) in points.iter().chain(&at).chain(&far) {
                let owners = cells.iter().filter(|cell| cell.rect.contains(DVec3::new(x, 0.0, z))).count();
                prop_assert_eq!(owners, 1, "point {} {}", x, z);
            }
        }

        #[test]
        fn the_cut_does_not_depend_on_the_order_of_its_input(
            at in prop::collection::vec((coordinate(), coordinate()), 12..40),
            turn in 0usize..40,
        ) {
            let names = names(at.len());
            let one = centres(&names, &at);
            let mut other = one.clone();
            other.rotate_left(turn % at.len());
            other.reverse();
            prop_assert_eq!(cut(one, 3, 2), cut(other, 3, 2));
        }
    }

    #[test]
    fn the_border_is_the_coordinate_of_the_last_camera_of_the_lower_side() {
        let names = names(7);
        let at = [(0.0, 0.0), (1.0, 5.0), (2.0, 1.0), (3.0, 4.0), (4.0, 2.0), (5.0, 3.0), (6.0, 9.0)];
        let cells = cut(centres(&names, &at), 2, 1);
        // 7 / 2 = 3 to the first, the remainder to the last.
        assert_eq!(cells[0].views, [0, 1, 2]);
        assert_eq!(cells[0].rect.x, Interval { lo: None, hi: Some(2.0) });
        assert_eq!(cells[1].rect.x, Interval { lo: Some(2.0), hi: None });
        assert_eq!(cells[0].rect.z, Interval::ALL);
        assert!(cells[0].rect.contains(DVec3::new(2.0, 0.0, 7.0)), "the border belongs to the lower side");
        assert!(!cells[1].rect.contains(DVec3::new(2.0, 0.0, 7.0)));
    }

    #[test]
    fn ties_in_x_go_by_z_and_then_by_name() {
        let names = ["b", "a", "c", "d"].map(String::from);
        let at = [(0.0, 1.0), (0.0, 1.0), (-0.0, 0.0), (0.0, 2.0)];
        let cells = cut(centres(&names, &at), 2, 1);
        // By z: view 2 first; then the tie of 0 and 1 by name: view 1 ("a").
        assert_eq!(cells[0].views, [1, 2]);
        assert_eq!(cells[1].views, [0, 3]);
    }

    #[test]
    fn a_grid_of_one_row_or_one_column_is_open_on_every_side_without_a_neighbour() {
        let names = names(8);
        let at: Vec<_> = (0..8).map(|i| (f64::from(i), f64::from(i))).collect();
        for (columns, rows) in [(1, 1), (1, 4), (4, 1), (2, 1), (2, 2)] {
            let cells = cut(centres(&names, &at), columns, rows);
            for cell in &cells {
                assert_eq!(cell.rect.x.lo.is_none(), cell.column == 0);
                assert_eq!(cell.rect.x.hi.is_none(), cell.column + 1 == columns);
                assert_eq!(cell.rect.z.lo.is_none(), cell.row == 0);
                assert_eq!(cell.rect.z.hi.is_none(), cell.row + 1 == rows);
            }
        }
    }

    #[test]
    fn layers_follow_from_the_number_of_open_axes() {
        let names = names(9);
        let at: Vec<_> = (0..9).map(|i| (f64::from(i), f64::from(i % 3))).collect();
        let cells = cut(centres(&names, &at), 3, 3);
        let layers: Vec<Layer> = cells.iter().map(Cell::layer).collect();
        use Layer::{Corner, Edge, Inner};
        assert_eq!(layers, [Corner, Edge, Corner, Edge, Inner, Edge, Corner, Edge, Corner]);
    }
}
