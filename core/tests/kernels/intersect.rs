//! Tile lists: which splats each tile holds, and in which order.

use fathom_core::gaussians::Gaussians;
use fathom_twins::{Splat, min_sigma_in_rect, samples};

use crate::bounds::EPSILON;
use crate::device::layouts;
use crate::view::{Scene, View, hard_scenes};

/// Compares every tile with an exhaustive search. Returns the number of pairs and of those that slack added.
#[track_caller]
fn check(view: &View) -> (usize, usize) {
    let (scene, splats, lists) = (&view.scene, view.splats(), view.tile_lists());
    let tile = view.gpu.tile();
    let side = f64::from(tile);
    let (mut pairs, mut extra) = (0, 0);
    for (at, ids) in lists.iter().enumerate() {
        let (x, y) = (at as u32 % view.uniform.tiles[0], at as u32 / view.uniform.tiles[0]);
        let low = [f64::from(x) * side + 0.5, f64::from(y) * side + 0.5];
        let high = low.map(|v| v + side - 1.0);
        let mut listed = vec![0; splats.len()];
        ids.iter().for_each(|&id| listed[id] += 1);
        for (id, splat) in splats.iter().enumerate() {
            let Some(splat) = splat else {
                assert_eq!(listed[id], 0, "{}: culled Gaussian {id} in tile {x}, {y}", scene.name);
                continue;
            };
            let least = min_sigma_in_rect(splat, low, high);
            let rounding = rounding(splat, low, high);
            let what = || {
                format!(
                    "{}: Gaussian {id}, tile {x}, {y}: sigma {least}, extent {}",
                    scene.name, splat.extent
                )
            };
            assert!(listed[id] <= 1, "{}: listed twice", what());
            if least <= splat.extent - rounding {
                assert_eq!(listed[id], 1, "{}: missing", what());
            }
            // The slack of tiles.wgsl: a relative and an absolute 1e-4.
            if least > splat.extent * 1.0001 + 1e-4 + rounding {
                assert_eq!(listed[id], 0, "{}: too far", what());
            }
            pairs += listed[id];
            extra += usize::from(listed[id] == 1 && least > splat.extent);
        }
        for pair in ids.windows(2) {
            let depth = |id: usize| splats[id].map_or(f64::NAN, |splat| splat.depth);
            let (front, back) = (depth(pair[0]), depth(pair[1]));
            // z is a sum of three products of numbers below 10.
            assert!(front <= back + 40.0 * EPSILON, "{}: tile {x}, {y}: {front} before {back}", scene.name);
        }
    }
    (pairs, extra)
}

/// Error of sigma in f32: its terms may be far larger than their sum. The box comes from the same conic. Near
/// the tips of a needle, its error is a share of the extent that grows with the condition number.
fn rounding(splat: &Splat, low: [f64; 2], high: [f64; 2]) -> f64 {
    let [a, b, c] = splat.conic;
    let near = |k: usize| (splat.mean2d[k].clamp(low[k], high[k]) - splat.mean2d[k]).abs() + high[k] - low[k];
    let (dx, dy) = (near(0), near(1));
    let condition = (a + c).powi(2) / (a * c - b * b);
    8.0 * EPSILON * (a * dx * dx + c * dy * dy + b.abs() * dx * dy + condition * splat.extent)
}

#[test]
fn tiles_hold_the_splats_that_reach_them_front_to_back() {
    for gpu in layouts() {
        for scene in hard_scenes(111, 800, 0) {
            let (pairs, extra) = check(&View::render(&gpu, &scene));
            assert!(pairs > 1000, "{}: {pairs} pairs", scene.name);
            assert!(extra <= pairs / 100, "{}: {extra} of {pairs} pairs by slack", scene.name);
        }
    }
}

#[test]
fn pictures_smaller_than_a_tile_have_one() {
    for gpu in layouts() {
        for (width, height) in [(1, 1), (17, 1), (1, 33), (16, 16), (8, 17)] {
            let view = View::render(
                &gpu,
                &Scene::new(&format!("{width}x{height}"), samples::random(112, 300, 0), width, height),
            );
            let tile = gpu.tile();
            assert_eq!(view.tile_lists().len() as u32, width.div_ceil(tile) * height.div_ceil(tile));
            check(&view);
        }
    }
}

#[test]
fn equal_depths_are_ordered_by_index() {
    for gpu in layouts() {
        let mut model = Gaussians::empty(0);
        // 3,000 splats of one depth exceed one workgroup of the sort.
        let one = samples::random(113, 1, 0);
        (0..3000).for_each(|_| model.push_from(&one, 0));
        model.means.fill([0.1, 0.0, 0.2]);
        model.log_scales.fill([-1.0; 3]);
        let view = View::render(&gpu, &Scene::new("one depth", model, 40, 24));
        let lists = view.tile_lists();
        assert!(lists.iter().any(|ids| ids.len() == 3000));
        for ids in &lists {
            assert!(ids.is_sorted(), "ties must keep the order of Gaussians");
        }
    }
}
