//! Maps what the rays of a view end on, by cells.
//!
//! Certain cells pass above everything that was reconstructed, have no structure and have the colour of open
//! water. From them, open water spreads from cell to cell while there is no structure and the colour stays:
//! around a mast, down to the edge of a reef. It ends at texture, at another colour, or at a sighted point in
//! the cell or a neighbour. In the cells where it ends, each pixel is decided by its own colour
//! ([`EndsOn::Edge`]). A region that looks like open water but is not connected with it may be a gap in a
//! reef or a smooth stone. It stays unknown.

use glam::DVec3;
use rayon::prelude::*;

use super::{OfView, colour};
use crate::views::{EndsOn, RayMap};

/// Maximum distance of a certain cell from the colour of open water, 8-bit codes. Anything farther off is
/// left to the Gaussians. At 20, the uncertain pixels of seathru-japan had 32.8 dB; at 12, 33.4 dB.
const CERTAIN: f64 = 12.0;
/// Maximum distance of a similar cell, or of a pixel at an edge, from the colour of open water. It is a
/// multiple of the median distance of certain cells, or of the pixels in them.
const TIMES: f64 = 2.0;
/// Limits of that distance, 8-bit codes.
const LEAST_ALIKE: f64 = 2.0;
const MOST_ALIKE: f64 = 10.0;
/// A cell above the scene at this distance or farther is not open water; 8-bit codes.
const OTHER: f64 = 24.0;
/// Rings of cells around open water whose pixels are decided one by one. In a forward view, one ring leaves 5
/// % of the open water in cells that count as surfaces; two rings leave 1 %.
const EDGES: u32 = 2;

/// The maps of `views`, with the colour of open water `along` a direction, linear light, and `noise` from
/// [`super::noise`].
pub(super) fn ray_maps(
    views: Vec<OfView>,
    noise: f64,
    along: impl Fn(DVec3) -> [f64; 3] + Sync,
) -> Vec<RayMap> {
    let looked: Vec<(OfView, Vec<f64>)> = views
        .into_par_iter()
        .map(|view| {
            let off = |cell: usize| colour::distance(along(view.directions[cell]), view.means[cell]);
            let off = (0..view.means.len()).map(off).collect();
            (view, off)
        })
        .collect();
    let mut certain = [Vec::new(), Vec::new()];
    for (view, off) in &looked {
        for cell in (0..off.len()).filter(|&cell| is_certain(view, off, cell, noise)) {
            certain[0].push(off[cell]);
            certain[1].push(f64::from(view.spread[cell]));
        }
    }
    let [off_by, spread] = certain.map(colour::median);
    let [cells, pixels] = [off_by, off_by.hypot(spread)].map(|usual| TIMES * usual);
    let alike = [cells.clamp(LEAST_ALIKE, MOST_ALIKE), pixels.clamp(LEAST_ALIKE, MOST_ALIKE)];
    looked.into_par_iter().map(|(view, off)| ray_map(view, &off, noise, alike)).collect()
}

fn is_certain(view: &OfView, off: &[f64], cell: usize, noise: f64) -> bool {
    off[cell] < CERTAIN && view.may_be_open(cell, noise)
}

/// The map of a view whose cells are `off` from the colour of open water. Cells below `alike`, and pixels
/// below `of_pixels`, look like open water.
fn ray_map(view: OfView, off: &[f64], noise: f64, [alike, of_pixels]: [f64; 2]) -> RayMap {
    let mut ends: Vec<EndsOn> = (0..off.len())
        .map(|cell| match view.near[cell] {
            false if is_certain(&view, off, cell, noise) => EndsOn::Open,
            false if view.leaves[cell] && off[cell] < OTHER => EndsOn::Unknown,
            false if view.is_smooth(cell, noise) && off[cell] < alike => EndsOn::Unknown,
            _ => EndsOn::Surface,
        })
        .collect();
    let mut open: Vec<usize> = (0..ends.len()).filter(|&cell| ends[cell] == EndsOn::Open).collect();
    while let Some(cell) = open.pop() {
        for beside in around(&view, cell, 0) {
            let goes_on = ends[beside] != EndsOn::Open
                && !view.near[beside]
                && !view.steep[beside]
                && off[beside] < alike
                && view.is_smooth(beside, noise);
            if goes_on {
                ends[beside] = EndsOn::Open;
                open.push(beside);
            }
        }
    }
    let is_watery = |end: EndsOn| matches!(end, EndsOn::Open | EndsOn::Edge);
    for _ in 0..EDGES {
        let is_beside = |cell: usize| {
            !is_watery(ends[cell]) && around(&view, cell, 1).any(|beside| is_watery(ends[beside]))
        };
        let edge: Vec<usize> = (0..ends.len()).filter(|&cell| is_beside(cell)).collect();
        edge.into_iter().for_each(|cell| ends[cell] = EndsOn::Edge);
    }
    let alike = (of_pixels / 255.0) as f32;
    RayMap { columns: view.columns, rows: view.rows, cells: ends, ranges: view.ranges, alike }
}

/// The neighbours of `cell`, including the diagonal ones if `corners` is 1.
fn around(view: &OfView, cell: usize, corners: i64) -> impl Iterator<Item = usize> {
    let (columns, rows) = (i64::from(view.columns), i64::from(view.rows));
    let (row, column) = (cell as i64 / columns, cell as i64 % columns);
    let beside = (-1..=1).flat_map(|down| (-1..=1).map(move |across| (down, across)));
    beside.filter_map(move |(down, across): (i64, i64)| {
        let steps = down.abs() + across.abs();
        let (row, column) = (row + down, column + across);
        let is_there = (0..rows).contains(&row) && (0..columns).contains(&column);
        (is_there && (1..=1 + corners).contains(&steps)).then_some((row * columns + column) as usize)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLUMNS: u32 = 12;
    const ROWS: u32 = 9;
    /// Rows above this one pass above everything that was reconstructed.
    const OUTLINE: u32 = 3;

    /// Open water down to row 5, except for a mast in columns 4 and 5. Below is a reef with a smooth stone of
    /// the colour of open water.
    fn view() -> (OfView, Vec<f64>) {
        let cells = || (0..ROWS).flat_map(|row| (0..COLUMNS).map(move |column| (row, column)));
        let is_mast = |row: u32, column: u32| row >= 1 && (4..6).contains(&column);
        let is_stone = |row: u32, column: u32| (7..8).contains(&row) && (8..10).contains(&column);
        let is_scene = |row: u32, column: u32| is_mast(row, column) || (row > 5 && !is_stone(row, column));
        let of_scene = |yes: f32, no: f32| {
            cells()
                .map(move |(row, column)| if is_scene(row, column) { yes } else { no })
                .collect::<Vec<f32>>()
        };
        let count = (COLUMNS * ROWS) as usize;
        let view = OfView {
            columns: COLUMNS,
            rows: ROWS,
            means: vec![[0.0; 3]; count],
            texture: of_scene(20.0, 0.2),
            spread: vec![1.0; count],
            bend: of_scene(20.0, 0.2),
            directions: vec![DVec3::Z; count],
            near: vec![false; count],
            leaves: cells().map(|(row, _)| row < OUTLINE).collect(),
            steep: vec![false; count],
            ranges: vec![0.0; count],
        };
        let off = cells().map(|(row, column)| if is_scene(row, column) { 40.0 } else { 1.0 }).collect();
        (view, off)
    }

    fn at(map: &RayMap, row: u32, column: u32) -> EndsOn {
        map.cells[(row * COLUMNS + column) as usize]
    }

    #[test]
    fn open_water_spreads_to_the_reef_but_not_to_a_stone_in_it() {
        let (view, off) = view();
        let map = ray_map(view, &off, 0.0, [4.0, 5.0]);
        for column in [0, 3, 6, 11] {
            for row in 0..=5 {
                assert_eq!(at(&map, row, column), EndsOn::Open, "row {row}, column {column}");
            }
        }
        assert_eq!(at(&map, 4, 4), EndsOn::Edge, "the mast's pixels are decided one by one");
        assert_eq!(
            [at(&map, 6, 0), at(&map, 7, 0), at(&map, 8, 0)],
            [EndsOn::Edge, EndsOn::Edge, EndsOn::Surface]
        );
        assert_ne!(at(&map, 7, 8), EndsOn::Open, "it is not connected with open water");
        assert!((f64::from(map.alike) - 5.0 / 255.0).abs() < 1e-6);
    }

    #[test]
    fn open_water_ends_at_sighted_points_and_steep_rays() {
        let (mut view, off) = view();
        for column in 0..COLUMNS {
            view.near[(3 * COLUMNS + column) as usize] = true;
        }
        let map = ray_map(view, &off, 0.0, [4.0, 5.0]);
        assert_eq!(
            [at(&map, 2, 0), at(&map, 3, 0), at(&map, 5, 0)],
            [EndsOn::Open, EndsOn::Edge, EndsOn::Unknown]
        );
        let (mut view, off) = self::view();
        for cell in 4 * COLUMNS..ROWS * COLUMNS {
            view.steep[cell as usize] = true;
        }
        let map = ray_map(view, &off, 0.0, [4.0, 5.0]);
        assert_eq!([at(&map, 3, 0), at(&map, 4, 0)], [EndsOn::Open, EndsOn::Edge]);
    }

    #[test]
    fn colour_tolerance_follows_the_certain_cells() {
        let [clean, rough] = [1.0_f32, 3.0].map(|spread| {
            let (mut view, _) = view();
            view.spread.fill(spread);
            let maps = ray_maps(vec![view], 0.0, |_| [0.0; 3]);
            maps[0].alike * 255.0
        });
        assert!((clean - 2.0).abs() < 1e-3 && (rough - 6.0).abs() < 1e-3, "{clean} {rough}");
    }
}
