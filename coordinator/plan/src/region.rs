//! Regions: the extended box of each cell (SMP-UWGS eq. 2) and the points that fall into it.
//!
//! A box grows by a share of its cell's side, per axis. An open side has no length, so it is closed for that
//! purpose. It ends at the farther of the partition's outermost own camera and the 2nd or 98th percentile of
//! its own points. Percentiles, because a sparse cloud always has outliers, and one could stretch the box to
//! the whole scene. Nothing here is a constant in scene units.

use fathom_core::config::PartitionConfig;
use fathom_core::scene::Points;
use glam::DVec3;
use rayon::prelude::*;

use crate::cells::Cell;
use crate::geometry::{Alignment, Box3, Interval, Rect};
use crate::plan::Layer;

/// Points below this share and above one minus it do not count for a robust range.
const STRAY_SHARE: f64 = 0.02;
/// Minimum side of a cell for its extension, as a share of the scene: a cell of one camera, or between
/// cameras at one coordinate, has zero length.
const MIN_SIDE_SHARE: f64 = 0.01;
/// Height of a box without points below and above its cameras, as a share of its shorter side.
const BLIND_HEIGHT_SHARE: f64 = 0.25;

/// The region of a partition.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    /// The trained region: the extended box, open where the cell is.
    pub focus: Rect,
    /// The extended box, closed everywhere.
    pub extended: Box3,
}

/// Points of a strip. A cell covers tens of strips, and two searches in each find its points.
const STRIP: usize = 16_384;

/// Sparse points in the aligned frame, in strips along x and by z within each; points with infinities or NaN
/// are left out.
pub struct AlignedPoints {
    points: Vec<DVec3>,
    /// Largest x of each strip.
    ends: Vec<f64>,
}

impl AlignedPoints {
    /// Sorts `points`, so that nothing after depends on their order.
    pub fn new(mut points: Vec<DVec3>) -> Self {
        points.retain(|p| p.is_finite());
        points.par_sort_unstable_by(|a, b| {
            a.x.total_cmp(&b.x).then(a.z.total_cmp(&b.z)).then(a.y.total_cmp(&b.y))
        });
        let ends = points.chunks(STRIP).filter_map(|strip| strip.last()).map(|last| last.x).collect();
        points.par_chunks_mut(STRIP).for_each(|strip| {
            strip.sort_unstable_by(|a, b| {
                a.z.total_cmp(&b.z).then(a.x.total_cmp(&b.x)).then(a.y.total_cmp(&b.y))
            });
        });
        Self { points, ends }
    }

    /// The points of a scene.
    pub fn in_frame(points: &Points, alignment: &Alignment) -> Self {
        Self::new(points.positions.par_iter().map(|&p| alignment.to_aligned(p)).collect())
    }

    /// All of them.
    pub fn all(&self) -> &[DVec3] {
        &self.points
    }

    /// Those in `rect`, in order.
    pub fn within(&self, rect: &Rect) -> impl Iterator<Item = DVec3> {
        let Rect { x, z } = *rect;
        let first = x.lo.map_or(0, |lo| self.ends.partition_point(|&end| end <= lo));
        // A strip begins where the one before it ends, or later.
        let last = x.hi.map_or(self.ends.len(), |hi| self.ends.partition_point(|&end| end <= hi) + 1);
        let strips = self.points.chunks(STRIP).take(last).skip(first);
        strips.flat_map(move |strip| {
            let from = z.lo.map_or(0, |lo| strip.partition_point(|p| p.z <= lo));
            let to = z.hi.map_or(strip.len(), |hi| strip.partition_point(|p| p.z <= hi));
            strip.get(from..to).unwrap_or_default().iter().copied().filter(move |p| x.contains(p.x))
        })
    }

    /// The box between the robust ends of each axis.
    pub fn robust_box(&self) -> Option<Box3> {
        let axis = |axis: usize| robust_range(self.points.iter().map(|p| p[axis]).collect());
        let [x, y, z] = [axis(0)?, axis(1)?, axis(2)?];
        Some(Box3 { min: [x.0, y.0, z.0], max: [x.1, y.1, z.1] })
    }
}

/// The region of one cell. `own` are the centres of its own cameras, `scene_side` the longest horizontal
/// side of the scene.
pub fn region(
    cell: &Cell,
    own: &[DVec3],
    points: &AlignedPoints,
    config: &PartitionConfig,
    scene_side: f64,
) -> Region {
    let factor = match cell.layer() {
        Layer::Corner | Layer::Edge => config.extend_edge,
        Layer::Inner => config.extend_inner,
    };
    let share = config.extend_base * factor;
    let min_side = MIN_SIDE_SHARE * scene_side;
    let mine: Vec<DVec3> = points.within(&cell.rect).collect();
    let (focus_x, x) = extend(cell.rect.x, 0, own, &mine, share, min_side);
    let (focus_z, z) = extend(cell.rect.z, 2, own, &mine, share, min_side);
    let flat = Rect { x: closed(x), z: closed(z) };
    let y = robust_range(points.within(&flat).map(|p| p.y).collect())
        .or_else(|| robust_range(points.all().iter().map(|p| p.y).collect()))
        .unwrap_or_else(|| {
            let (lo, hi) = range(own.iter().map(|p| p.y));
            let height = BLIND_HEIGHT_SHARE * (x.1 - x.0).min(z.1 - z.0);
            (lo - height, hi + height)
        });
    Region {
        focus: Rect { x: focus_x, z: focus_z },
        extended: Box3 { min: [x.0, y.0, z.0], max: [x.1, y.1, z.1] },
    }
}

/// One axis of a region: the interval that it trains, and the ends of its closed box.
fn extend(
    side: Interval,
    axis: usize,
    own: &[DVec3],
    mine: &[DVec3],
    share: f64,
    min_side: f64,
) -> (Interval, (f64, f64)) {
    let cameras = range(own.iter().map(|p| p[axis]));
    let evidence = match robust_range(mine.iter().map(|p| p[axis]).collect()) {
        Some(points) => (cameras.0.min(points.0), cameras.1.max(points.1)),
        None => cameras,
    };
    let (lo, hi) = (side.lo.unwrap_or(evidence.0), side.hi.unwrap_or(evidence.1));
    let margin = share * (hi - lo).max(min_side);
    let focus = Interval { lo: side.lo.map(|lo| lo - margin), hi: side.hi.map(|hi| hi + margin) };
    // Even with an extension of 0 the box must not be empty, or no camera would see it.
    let (mut box_lo, mut box_hi) = (lo - margin, hi + margin);
    if box_hi - box_lo < min_side {
        let missing = (min_side - (box_hi - box_lo)) / 2.0;
        (box_lo, box_hi) = (box_lo - missing, box_hi + missing);
    }
    (focus, (box_lo, box_hi))
}

fn closed((lo, hi): (f64, f64)) -> Interval {
    Interval { lo: Some(lo), hi: Some(hi) }
}

/// Smallest and largest of at least one finite value.
pub fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
}

/// The range without the strays at both ends; `None` without values.
fn robust_range(mut values: Vec<f64>) -> Option<(f64, f64)> {
    let last = values.len().checked_sub(1)?;
    let strays = (STRAY_SHARE * last as f64).floor() as usize;
    let lo = *values.select_nth_unstable_by(strays, f64::total_cmp).1;
    let hi = *values.select_nth_unstable_by(last - strays, f64::total_cmp).1;
    Some((lo, hi))
}

#[cfg(test)]
mod tests {
    use fathom_core::rng::{Stream, uniform_at};

    use super::*;
    use crate::cells::{Centre, cut};

    fn grid_cells(columns: u32, rows: u32) -> (Vec<Cell>, Vec<DVec3>) {
        let at: Vec<DVec3> = (0..81).map(|i| DVec3::new(f64::from(i / 9), 0.0, f64::from(i % 9))).collect();
        let names: Vec<String> = (0..81).map(|i| format!("{i:02}")).collect();
        let centres =
            (0..81).map(|i| Centre { view: i as u32, name: &names[i], at: at[i] }).collect::<Vec<_>>();
        (cut(centres, columns, rows), at)
    }

    fn own(cell: &Cell, at: &[DVec3]) -> Vec<DVec3> {
        cell.views.iter().map(|&view| at[view as usize]).collect()
    }

    #[test]
    fn the_points_of_a_rectangle_are_found_across_strips() {
        // Three strips and a half, with many points on one coordinate, which lie on the borders of strips and
        // cells.
        let draw = |i: u32, k: u32| f64::from(uniform_at(12, Stream::Test, i, k));
        let points: Vec<DVec3> = (0..57_000)
            .map(|i| DVec3::new((8.0 * draw(i, 0)).floor() / 8.0, draw(i, 1), draw(i, 2)))
            .collect();
        let sorted = AlignedPoints::new(points.clone());
        assert_eq!(sorted.all().len(), points.len());
        let side = |lo, hi| Interval { lo, hi };
        for (x, z) in [
            (side(Some(0.125), Some(0.5)), side(Some(0.25), Some(0.75))),
            (side(None, Some(0.25)), Interval::ALL),
            (side(Some(0.3), None), side(None, Some(0.1))),
            (side(Some(0.5), Some(0.5)), Interval::ALL),
            (side(Some(0.9), Some(0.2)), side(Some(0.9), Some(0.2))),
            (Interval::ALL, Interval::ALL),
        ] {
            let rect = Rect { x, z };
            let expected = points.iter().filter(|p| rect.contains(**p)).count();
            let found: Vec<DVec3> = sorted.within(&rect).collect();
            assert!(found.iter().all(|p| rect.contains(*p)), "{rect:?}");
            assert_eq!(found.len(), expected, "{rect:?}");
        }
    }

    #[test]
    fn edges_grow_by_two_base_units_and_inner_cells_by_1_5() {
        let (cells, at) = grid_cells(3, 3);
        let config = PartitionConfig::default();
        let none = AlignedPoints::new(Vec::new());
        let inner = region(&cells[4], &own(&cells[4], &at), &none, &config, 8.0);
        // The inner cell is (2, 5] on both axes: side 3, grown by 0.2 * 1.5 * 3 = 0.9.
        for axis in [0, 2] {
            assert!((inner.extended.min[axis] - 1.1).abs() < 1e-12);
            assert!((inner.extended.max[axis] - 5.9).abs() < 1e-12);
        }
        let corner = region(&cells[0], &own(&cells[0], &at), &none, &config, 8.0);
        // The corner cell is closed at its own cameras: 0 to 2, grown by 0.2 * 2.0 * 2 = 0.8.
        assert!((corner.extended.min[0] + 0.8).abs() < 1e-12);
        assert!((corner.extended.max[0] - 2.8).abs() < 1e-12);
        assert_eq!(corner.focus.x.lo, None, "what is open in the cell is open in the focus");
        assert_eq!(corner.focus.x.hi, Some(corner.extended.max[0]));
    }

    #[test]
    fn the_box_is_that_of_the_cell_and_not_that_of_the_scene() {
        let (cells, at) = grid_cells(3, 3);
        let points: Vec<DVec3> = (0..90 * 90)
            .map(|i| {
                DVec3::new(f64::from(i / 90) * 0.1, 1.0 + f64::from(i % 7) * 0.1, f64::from(i % 90) * 0.1)
            })
            .collect();
        let points = AlignedPoints::new(points);
        let config = PartitionConfig::default();
        let scene = points.robust_box().unwrap_or_else(|| unreachable!("there are points"));
        for cell in &cells {
            let found = region(cell, &own(cell, &at), &points, &config, 8.0);
            for axis in [0, 2] {
                assert!(found.extended.side(axis) < 0.9 * scene.side(axis), "cell {cell:?}: {found:?}");
            }
        }
    }

    #[test]
    fn distant_strays_do_not_enlarge_a_box() {
        let (cells, at) = grid_cells(2, 2);
        let near = (0..1000).map(|i| DVec3::new(f64::from(i % 80) * 0.1, 2.0, f64::from(i / 13) * 0.1));
        let strays = (0..8).map(|i| DVec3::new(1e6, -1e6, 1e6) * if i % 2 == 0 { 1.0 } else { -1.0 });
        let with = AlignedPoints::new(near.clone().chain(strays).collect());
        let without = AlignedPoints::new(near.collect());
        for cell in &cells {
            let config = PartitionConfig::default();
            let a = region(cell, &own(cell, &at), &with, &config, 8.0).extended;
            let b = region(cell, &own(cell, &at), &without, &config, 8.0).extended;
            for axis in 0..3 {
                assert!((a.min[axis] - b.min[axis]).abs() < 1.0, "{a:?} against {b:?}");
                assert!((a.max[axis] - b.max[axis]).abs() < 1.0, "{a:?} against {b:?}");
            }
        }
    }

    #[test]
    fn boxes_scale_with_the_scene() {
        let (cells, at) = grid_cells(3, 3);
        let points: Vec<DVec3> = (0..500)
            .map(|i| DVec3::new(f64::from(i % 25) * 0.3, f64::from(i % 3), f64::from(i / 25) * 0.4))
            .collect();
        for scale in [1024.0, 1.0 / 1024.0] {
            let scaled: Vec<DVec3> = at.iter().map(|&p| p * scale).collect();
            let scaled_points = AlignedPoints::new(points.iter().map(|&p| p * scale).collect());
            let points = AlignedPoints::new(points.clone());
            for cell in &cells {
                let stretch = |side: Interval| Interval {
                    lo: side.lo.map(|v| v * scale),
                    hi: side.hi.map(|v| v * scale),
                };
                let rect = Rect { x: stretch(cell.rect.x), z: stretch(cell.rect.z) };
                let large = Cell { rect, ..cell.clone() };
                let config = PartitionConfig::default();
                let one = region(cell, &own(cell, &at), &points, &config, 8.0).extended;
                let other =
                    region(&large, &own(&large, &scaled), &scaled_points, &config, 8.0 * scale).extended;
                // The factor is a power of two, so scaling is exact but for sums of different order.
                for (a, b) in one.min.iter().chain(&one.max).zip(other.min.iter().chain(&other.max)) {
                    assert!((a * scale - b).abs() <= 1e-12 * scale, "{one:?} against {other:?}");
                }
            }
        }
    }

    #[test]
    fn cells_without_points_or_width_still_have_a_box() {
        let at = vec![DVec3::ZERO; 4];
        let names = ["a", "b", "c", "d"];
        let centres =
            (0..4).map(|i| Centre { view: i as u32, name: names[i], at: at[i] }).collect::<Vec<_>>();
        for cell in cut(centres, 2, 2) {
            let found = region(
                &cell,
                &own(&cell, &at),
                &AlignedPoints::new(Vec::new()),
                &PartitionConfig::default(),
                1.0,
            );
            for axis in 0..3 {
                assert!(found.extended.side(axis) > 0.0, "{found:?}");
            }
        }
    }
}
