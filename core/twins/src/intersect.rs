//! Finds the tiles that each splat touches, and the order of splats in a tile.
//!
//! A splat touches a tile when its least sigma over the tile's rectangle of pixel centres is at most its
//! extent. This is an exact test of ellipse against rectangle: a needle across the image touches the tiles
//! along it, not all tiles of its box. The rectangle is the whole 16x16 tile even where the image ends inside
//! it. Splats in a tile are sorted by depth, ties by the Gaussian's index.

use std::cmp::Ordering;

use super::{Splat, TILE};

/// The Gaussians that touch each tile, front to back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TileLists {
    /// Tiles across.
    pub tiles_x: u32,
    /// Tiles down.
    pub tiles_y: u32,
    /// [tiles_y * tiles_x], row-major: first entry and one past the last in `gaussian_ids`.
    pub ranges: Vec<[u32; 2]>,
    /// Gaussians by tile, then depth, then index.
    pub gaussian_ids: Vec<u32>,
}

impl TileLists {
    /// The Gaussians of one tile, front to back.
    pub fn of_tile(&self, tile_x: u32, tile_y: u32) -> &[u32] {
        let [start, end] = self.ranges[(tile_y * self.tiles_x + tile_x) as usize];
        &self.gaussian_ids[start as usize..end as usize]
    }

    /// The number of tiles that each of `count` Gaussians touches; 0 if the view does not see it.
    pub fn tiles_per_gaussian(&self, count: usize) -> Vec<u32> {
        let mut tiles = vec![0; count];
        for &id in &self.gaussian_ids {
            tiles[id as usize] += 1;
        }
        tiles
    }
}

/// Gaussians that were not culled, from near to far; ties by index.
pub fn depth_order(splats: &[Option<Splat>]) -> Vec<u32> {
    let mut order: Vec<(f64, u32)> =
        splats.iter().zip(0..).filter_map(|(splat, id)| splat.map(|s| (s.depth, id))).collect();
    order.sort_by(|a, b| a.0.partial_cmp(&b.0).unwrap_or(Ordering::Equal).then(a.1.cmp(&b.1)));
    order.into_iter().map(|(_, id)| id).collect()
}

/// The tile lists of an image of `width` x `height`.
pub fn intersect(splats: &[Option<Splat>], width: u32, height: u32) -> TileLists {
    let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
    let mut by_tile = vec![Vec::new(); (tiles_x * tiles_y) as usize];
    for id in depth_order(splats) {
        let Some(splat) = &splats[id as usize] else { continue };
        let (columns, rows) = (tile_span(splat, 0, tiles_x), tile_span(splat, 1, tiles_y));
        for tile_y in rows {
            for tile_x in columns.clone() {
                let (low, high) = tile_centres(tile_x, tile_y);
                if min_sigma_in_rect(splat, low, high) <= splat.extent {
                    by_tile[(tile_y * tiles_x + tile_x) as usize].push(id);
                }
            }
        }
    }
    let mut lists = TileLists { tiles_x, tiles_y, ..TileLists::default() };
    for ids in by_tile {
        let start = lists.gaussian_ids.len() as u32;
        lists.gaussian_ids.extend(ids);
        lists.ranges.push([start, lists.gaussian_ids.len() as u32]);
    }
    lists
}

/// The least sigma of `splat` over the rectangle from `low` to `high`, pixels.
///
/// sigma is convex, and its minimum is 0 at the centre. If the centre is outside the rectangle, the least
/// sigma is on the rim. On each side of the rim, sigma is a parabola of one variable.
pub fn min_sigma_in_rect(splat: &Splat, low: [f64; 2], high: [f64; 2]) -> f64 {
    let [a, b, c] = splat.conic;
    let [mx, my] = splat.mean2d;
    if low[0] <= mx && mx <= high[0] && low[1] <= my && my <= high[1] {
        return 0.0;
    }
    let sigma = |x: f64, y: f64| {
        let (dx, dy) = (mx - x, my - y);
        0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    };
    let mut least = f64::INFINITY;
    for x in [low[0], high[0]] {
        let y = my + b / c * (mx - x);
        least = least.min(sigma(x, y.clamp(low[1], high[1])));
    }
    for y in [low[1], high[1]] {
        let x = mx + b / a * (my - y);
        least = least.min(sigma(x.clamp(low[0], high[0]), y));
    }
    least
}

/// First and last pixel centre of a tile.
fn tile_centres(tile_x: u32, tile_y: u32) -> ([f64; 2], [f64; 2]) {
    let low = [f64::from(tile_x * TILE) + 0.5, f64::from(tile_y * TILE) + 0.5];
    let side = f64::from(TILE - 1);
    (low, [low[0] + side, low[1] + side])
}

/// Tiles that the box of `splat` touches on one axis; an infinite box touches all of them.
fn tile_span(splat: &Splat, axis: usize, tiles: u32) -> std::ops::Range<u32> {
    let (centre, half) = (splat.mean2d[axis], splat.half_size[axis]);
    let bound = |v: f64| (v / f64::from(TILE)).clamp(0.0, f64::from(tiles));
    bound(centre - half).floor() as u32..bound(centre + half).ceil() as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rasterize_forward::contribution;
    use crate::samples::{all, off_centre_view, random};
    use crate::{Gaussians64, RasterRules, project_forward};

    #[test]
    fn the_least_sigma_of_a_tile_matches_dense_sampling() {
        const SAMPLES: u32 = 300;
        let (camera, pose) = off_centre_view(75, 53, 3.0);
        for (name, model) in all(11, 12, 0) {
            let splats = project_forward(&model, &camera, &pose, 0, &RasterRules::HARD);
            for (id, splat) in splats.iter().enumerate().filter_map(|(i, s)| s.map(|s| (i, s))) {
                for (tile_x, tile_y) in [(0, 0), (2, 1), (4, 3)] {
                    let (low, high) = tile_centres(tile_x, tile_y);
                    let exact = min_sigma_in_rect(&splat, low, high);
                    let step = 15.0 / f64::from(SAMPLES);
                    let mut sampled = f64::INFINITY;
                    for i in 0..=SAMPLES {
                        for j in 0..=SAMPLES {
                            let x = splat.mean2d[0] - (low[0] + step * f64::from(i));
                            let y = splat.mean2d[1] - (low[1] + step * f64::from(j));
                            let [a, b, c] = splat.conic;
                            sampled = sampled.min(0.5 * (a * x * x + c * y * y) + b * x * y);
                        }
                    }
                    // The nearest sample is at most (step/2, step/2) away from the minimum. Inside the
                    // rectangle, sigma rises by at most trace(conic) step^2 / 8. On the rim, the sample can
                    // only move along the rim, where the same bound holds for the parabola.
                    let rise = (splat.conic[0] + splat.conic[2]) * step * step / 4.0;
                    let rounding = 1e-9 * exact.max(1.0);
                    let what = format!("{name} {id}, tile {tile_x} {tile_y}: {exact} against {sampled}");
                    assert!(exact <= sampled + rounding, "{what}");
                    assert!(sampled <= exact + rise + rounding, "{what}, allowed rise {rise}");
                }
            }
        }
    }

    #[test]
    fn every_pixel_that_a_splat_colours_is_in_a_tile_that_lists_it() {
        let (width, height) = (75, 53);
        let (camera, pose) = off_centre_view(width, height, 3.0);
        for (name, model) in all(12, 40, 0) {
            let splats = project_forward(&model, &camera, &pose, 0, &RasterRules::HARD);
            let lists = intersect(&splats, width, height);
            let mut pairs = 0;
            for y in 0..height {
                for x in 0..width {
                    let ids = lists.of_tile(x / TILE, y / TILE);
                    for (id, splat) in splats.iter().enumerate().filter_map(|(i, s)| s.map(|s| (i as u32, s)))
                    {
                        if contribution(&splat, x, y, &RasterRules::HARD).is_some() {
                            pairs += 1;
                            assert!(ids.contains(&id), "{name}: Gaussian {id} at pixel {x}, {y}");
                        }
                    }
                }
            }
            assert!(pairs > 1000, "{name}: only {pairs} pairs");
        }
    }

    #[test]
    fn a_diagonal_needle_is_in_the_tiles_along_it_only() {
        let (width, height) = (160, 160);
        // Long axis along the diagonal: eigenvalues 1e-4 and 1 of the conic.
        let conic = [0.5 * (1.0 + 1e-4), -0.5 * (1.0 - 1e-4), 0.5 * (1.0 + 1e-4)];
        let half = (2.0 * 5.0 * 0.5 * (1.0 + 1e4_f64)).sqrt();
        let needle = Splat {
            mean2d: [80.0, 80.0],
            conic,
            rgb: [1.0; 3],
            opacity: 0.58,
            range: 1.0,
            depth: 1.0,
            extent: 5.0,
            half_size: [half, half],
        };
        let lists = intersect(&[Some(needle)], width, height);
        // Half width sqrt(2 * 5) = 3.2 px, so it touches the ten tiles of the diagonal and the corners beside
        // it.
        for tile_y in 0..10_u32 {
            for tile_x in 0..10_u32 {
                let listed = !lists.of_tile(tile_x, tile_y).is_empty();
                assert_eq!(listed, tile_x.abs_diff(tile_y) <= 1, "tile {tile_x} {tile_y}");
            }
        }
    }

    #[test]
    fn tiles_are_in_order_of_depth_with_ties_by_index() {
        let (camera, pose) = off_centre_view(64, 64, 3.0);
        let mut model = Gaussians64::from(&random(13, 60, 0));
        for i in (0..60).step_by(3) {
            model.means[i] = model.means[0];
        }
        let splats = project_forward(&model, &camera, &pose, 0, &RasterRules::HARD);
        let lists = intersect(&splats, 64, 64);
        let key = |id: u32| splats[id as usize].map(|s| s.depth).expect("only visible Gaussians are listed");
        let mut ties = 0;
        for tile in 0..16 {
            for pair in lists.of_tile(tile % 4, tile / 4).windows(2) {
                let (near, far) = (key(pair[0]), key(pair[1]));
                assert!(near < far || near == far && pair[0] < pair[1], "{pair:?} in tile {tile}");
                ties += usize::from(near == far);
            }
        }
        assert!(ties > 0);
        let touched = lists.tiles_per_gaussian(60);
        assert_eq!(touched.iter().sum::<u32>() as usize, lists.gaussian_ids.len());
    }

    #[test]
    fn a_splat_outside_the_image_is_in_no_tile() {
        let outside = Splat {
            mean2d: [-20.0, 10.0],
            conic: [1.0, 0.0, 1.0],
            rgb: [1.0; 3],
            opacity: 1.0,
            range: 1.0,
            depth: 1.0,
            extent: 255_f64.ln(),
            half_size: [(2.0 * 255_f64.ln()).sqrt(); 2],
        };
        assert!(intersect(&[Some(outside)], 32, 32).gaussian_ids.is_empty());
        let lists = intersect(&[None, Some(Splat { mean2d: [-2.0, 10.0], ..outside })], 32, 32);
        assert_eq!(lists.gaussian_ids, [1]);
        assert_eq!(lists.tiles_per_gaussian(2), [0, 1]);
    }
}
