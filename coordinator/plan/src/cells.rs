//! Membership and cells: assigns cameras and rectangles of the plane to partitions.
//!
//! Cameras are assigned by rank: sorted by x into columns, each column sorted by z into rows, the remainder
//! to the last (SMP-UWGS eq. 1). The border between neighbours is the coordinate of the last camera of the
//! lower one (the paper's boundary camera). Cells are (lo, hi], and sides without a neighbour are open. So
//! every camera is in exactly one base set and every point in exactly one cell, for all m, n >= 1. The camera
//! on the border, and one that ties with it, belongs by rank; a neighbour sees it through its extended box.
//!
//! [`Node::halves`] cuts one cell in two by the same rules, across its longer side: the step of a recursive
//! cut. Cells tile the plane after cuts in any order.

use std::cmp::Ordering;

use fathom_core::seams::Axis;
use glam::DVec3;

use crate::geometry::{Interval, Rect};
use crate::plan::Layer;

/// Share of the cameras at either end of an axis that do not count for the longer side of a cell.
const STRAY_SHARE: f64 = 0.05;

/// A training camera on the plane.
#[derive(Clone, Copy, Debug)]
pub struct Centre<'a> {
    /// Index into the scene's views.
    pub view: u32,
    /// Name of the view; breaks ties.
    pub name: &'a str,
    /// Centre in the aligned frame.
    pub at: DVec3,
}

/// One rectangle of the plane with the cameras that are its own.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Column along x and row along z in a grid, from 0.
    pub place: Option<(u32, u32)>,
    /// Cuts that lead to it from the whole plane, in a recursive cut.
    pub path: String,
    /// Its rectangle.
    pub rect: Rect,
    /// Its views, ascending.
    pub views: Vec<u32>,
}

impl Cell {
    /// Its open sides.
    pub fn layer(&self) -> Layer {
        let open = |side: &Interval| side.lo.is_none() || side.hi.is_none();
        match (open(&self.rect.x), open(&self.rect.z)) {
            (true, true) => Layer::Corner,
            (false, false) => Layer::Inner,
            _ => Layer::Edge,
        }
    }
}

/// Distributes the cameras over `columns` x `rows` cells, column by column.
///
/// There must be at least `columns * rows` cameras.
pub fn cut<'a>(mut centres: Vec<Centre<'a>>, columns: u32, rows: u32) -> Vec<Cell> {
    debug_assert!(centres.len() >= columns as usize * rows as usize);
    centres.sort_unstable_by(|a, b| by_rank(Axis::X, a, b));
    let mut cells = Vec::with_capacity(columns as usize * rows as usize);
    for (column, (x, members)) in share_out(&centres, columns, |centre| centre.at.x).into_iter().enumerate() {
        let mut members: Vec<Centre<'a>> = members.to_vec();
        members.sort_unstable_by(|a, b| by_rank(Axis::Z, a, b));
        for (row, (z, members)) in share_out(&members, rows, |centre| centre.at.z).into_iter().enumerate() {
            let mut views: Vec<u32> = members.iter().map(|centre| centre.view).collect();
            views.sort_unstable();
            let place = Some((column as u32, row as u32));
            cells.push(Cell { place, path: String::new(), rect: Rect { x, z }, views });
        }
    }
    cells
}

/// Splits sorted `members` into `parts` runs of `len / parts`, the last with the remainder. The interval of
/// each run ends at the coordinate of its last member, and begins at the end of the previous one.
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

/// A cell of a recursive cut with its cameras.
#[derive(Clone, Debug)]
pub struct Node<'a> {
    path: String,
    rect: Rect,
    members: Vec<Centre<'a>>,
}

impl<'a> Node<'a> {
    /// The whole plane.
    pub fn root(members: Vec<Centre<'a>>) -> Self {
        Self { path: String::new(), rect: Rect { x: Interval::ALL, z: Interval::ALL }, members }
    }

    /// The cell and its own views.
    pub fn cell(&self) -> Cell {
        let mut views: Vec<u32> = self.members.iter().map(|centre| centre.view).collect();
        views.sort_unstable();
        Cell { place: None, path: self.path.clone(), rect: self.rect, views }
    }

    /// The low and the high half by rank across the longer side, each with at least `least` cameras; `None`
    /// where there are too few, or all stand in one place.
    ///
    /// The cut is the one nearest to the middle that separates two coordinates. So no cell has zero width,
    /// and every camera lies in its own cell.
    pub fn halves(&self, least: usize) -> Option<[Self; 2]> {
        let longer = if self.side(Axis::X) >= self.side(Axis::Z) { Axis::X } else { Axis::Z };
        [longer, longer.across()].into_iter().find_map(|axis| self.cut_across(axis, least))
    }

    /// Length of the range of its cameras along an axis, without strays.
    fn side(&self, axis: Axis) -> f64 {
        let mut at: Vec<f64> = self.members.iter().map(|centre| axis.of(centre.at)).collect();
        let Some(last) = at.len().checked_sub(1) else { return 0.0 };
        let strays = (STRAY_SHARE * last as f64) as usize;
        let lo = *at.select_nth_unstable_by(strays, f64::total_cmp).1;
        let hi = *at.select_nth_unstable_by(last - strays, f64::total_cmp).1;
        hi - lo
    }

    fn cut_across(&self, axis: Axis, least: usize) -> Option<[Self; 2]> {
        let mut members = self.members.clone();
        members.sort_unstable_by(|a, b| by_rank(axis, a, b));
        let at = |rank: usize| axis.of(members[rank].at);
        let (least, middle) = (least.max(1), members.len() / 2);
        let ranks = least..(members.len() + 1).saturating_sub(least);
        let parts = |&rank: &usize| compare(at(rank - 1), at(rank)) == Ordering::Less;
        let rank = ranks.filter(parts).min_by_key(|&rank| (rank.abs_diff(middle), rank))?;
        let border = Some(at(rank - 1));
        let high = members.split_off(rank);
        let half = |sign: char, members: Vec<Centre<'a>>| {
            let mut rect = self.rect;
            let side = match axis {
                Axis::X => &mut rect.x,
                Axis::Z => &mut rect.z,
            };
            *(if sign == '-' { &mut side.hi } else { &mut side.lo }) = border;
            let name = match axis {
                Axis::X => 'x',
                Axis::Z => 'z',
            };
            Self { path: format!("{}{name}{sign}", self.path), rect, members }
        };
        Some([half('-', members), half('+', high)])
    }
}

/// Order of cameras along an axis: by its coordinate, ties by the other one, then by name.
fn by_rank(axis: Axis, a: &Centre<'_>, b: &Centre<'_>) -> Ordering {
    let along = |axis: Axis| compare(axis.of(a.at), axis.of(b.at));
    along(axis).then(along(axis.across())).then(a.name.cmp(b.name))
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
        fn every_camera_has_one_base_set_and_every_point_one_cell(
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
        fn recursive_cuts_give_each_camera_and_point_one_cell(
            at in prop::collection::vec((coordinate(), coordinate()), 2..80),
            points in prop::collection::vec((coordinate(), coordinate()), 1..40),
            which in prop::collection::vec(0usize..64, 0..20),
            least in 1usize..6,
        ) {
            let names = names(at.len());
            let cells = recursive(centres(&names, &at), &which, least);
            let mut homes = BTreeSet::new();
            for cell in &cells {
                prop_assert!(cells.len() == 1 || cell.views.len() >= least, "{:?}", cell);
                for &view in &cell.views {
                    prop_assert!(homes.insert(view), "view {} twice", view);
                    let (x, z) = at[view as usize];
                    prop_assert!(cell.rect.contains(DVec3::new(x, 0.0, z)), "view {} lies elsewhere", view);
                }
            }
            prop_assert_eq!(homes.len(), at.len());
            let far = [(1e30, 1e30), (-1e30, -1e30), (1e30, -1e30), (-1e30, 1e30)];
            for &(x, z) in points.iter().chain(&at).chain(&far) {
                let owners = cells.iter().filter(|cell| cell.rect.contains(DVec3::new(x, 0.0, z))).count();
                prop_assert_eq!(owners, 1, "point {} {}", x, z);
            }
        }

        #[test]
        fn recursive_cuts_do_not_depend_on_the_order_of_their_input(
            at in prop::collection::vec((coordinate(), coordinate()), 2..60),
            which in prop::collection::vec(0usize..64, 0..12),
            turn in 0usize..60,
        ) {
            let names = names(at.len());
            let one = centres(&names, &at);
            let mut other = one.clone();
            other.rotate_left(turn % at.len());
            other.reverse();
            prop_assert_eq!(recursive(one, &which, 2), recursive(other, &which, 2));
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

    /// Cuts the cells with these numbers (modulo how many there are) in two, one after the other.
    fn recursive(centres: Vec<Centre<'_>>, which: &[usize], least: usize) -> Vec<Cell> {
        let mut nodes = vec![Node::root(centres)];
        for number in which {
            let at = number % nodes.len();
            if let Some(halves) = nodes[at].halves(least) {
                nodes.splice(at..=at, halves);
            }
        }
        nodes.iter().map(Node::cell).collect()
    }

    #[test]
    fn a_cell_is_cut_across_its_longer_side_where_coordinates_part() {
        let names = names(9);
        // Five at x = 0 and four beyond: the middle rank has no border, the next one has.
        let at = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0].map(|x| (x, 0.5 * x));
        let cells = recursive(centres(&names, &at), &[0], 1);
        assert_eq!(cells.iter().map(|cell| cell.path.as_str()).collect::<Vec<_>>(), ["x-", "x+"]);
        assert_eq!(cells[0].rect.x, Interval { lo: None, hi: Some(0.0) });
        assert_eq!((&cells[0].views[..], &cells[1].views[..]), (&[0, 1, 2, 3, 4][..], &[5, 6, 7, 8][..]));
        let cells = recursive(centres(&names, &at), &[0, 1], 2);
        assert_eq!(cells[1].path, "x+x-", "the halves stay longer along x");
        assert_eq!((cells[1].rect.x.lo, cells[1].rect.x.hi), (Some(0.0), Some(2.0)));
        // All in one place: there is nothing to cut.
        assert!(Node::root(centres(&names, &[(1.0, 1.0); 9])).halves(1).is_none());
        assert!(Node::root(centres(&names, &at)).halves(5).is_none(), "nine are not twice five");
    }

    #[test]
    fn the_border_is_at_the_last_camera_of_the_lower_side() {
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

    /// Fault 4 of the public code: the far side of a grid of one row or one column stays closed, and
    /// Gaussians beyond it are lost at the merge.
    #[test]
    fn a_grid_of_one_row_is_open_on_sides_without_a_neighbour() {
        let names = names(8);
        let at: Vec<_> = (0..8).map(|i| (f64::from(i), f64::from(i))).collect();
        for (columns, rows) in [(1, 1), (1, 4), (4, 1), (2, 1), (2, 2)] {
            let cells = cut(centres(&names, &at), columns, rows);
            for cell in &cells {
                let Some((column, row)) = cell.place else { panic!("{cell:?} has no place") };
                assert_eq!(cell.rect.x.lo.is_none(), column == 0);
                assert_eq!(cell.rect.x.hi.is_none(), column + 1 == columns);
                assert_eq!(cell.rect.z.lo.is_none(), row == 0);
                assert_eq!(cell.rect.z.hi.is_none(), row + 1 == rows);
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
