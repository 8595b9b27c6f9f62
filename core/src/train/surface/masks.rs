//! Pseudo-masks: where each training view sees the water surface, from the depth of the straight set (WSGS
//! section 4.3).
//!
//! Before refracted light is trained, the straight set explains what lies in the water by disks below the
//! surface. So a pixel is water where the surface is nearer than what its ray sees. Pseudo-masks are made at
//! fixed iterations, at a quarter of the size.

use std::sync::Arc;

use glam::DVec3;

use crate::Result;
use crate::gpu::{Gpu, Rendered, Renderer};
use crate::scene::{PinholeCamera, Pose};
use crate::surface::Surface;
use crate::train::Trainer;
use crate::views::TrainView;

/// How often the sides of a view are halved for its pseudo-mask.
const HALVINGS: u32 = 2;
/// Alpha below which a pixel sees no surface of the straight set.
const LEAST_ALPHA: f32 = 0.5;
/// How much farther than the surface something must be to lie below it.
const CLEARLY_BEHIND: f64 = 1.002;
/// Share of the picture below which a connected part of a pseudo-mask is dropped: reflections on wet rims.
const LEAST_SHARE: f64 = 0.01;

/// The pseudo-masks of all training views.
pub(super) struct PseudoMasks {
    bits: wgpu::Buffer,
    words: Vec<u32>,
    /// Columns and rows, and the first word, of each view.
    views: Vec<([u32; 2], u32)>,
    made_at: Option<u32>,
}

impl PseudoMasks {
    pub(super) fn new(gpu: &Gpu, views: &[TrainView]) -> Result<Self> {
        let mut first = 0;
        let cells = views.iter().map(|view| {
            let small = small(&view.camera);
            let at = first;
            first += (small.width * small.height).div_ceil(32);
            ([small.width, small.height], at)
        });
        let views: Vec<_> = cells.collect();
        let bits = gpu.buffer("pseudo-masks", 4 * u64::from(first.max(1)))?;
        Ok(Self { bits, words: vec![0; first as usize], views, made_at: None })
    }

    pub(super) fn bits(&self) -> &wgpu::Buffer {
        &self.bits
    }

    /// Columns and rows of the pseudo-mask of a view, and its first word.
    pub(super) fn of_view(&self, view: usize) -> ([u32; 2], u32) {
        self.views.get(view).copied().unwrap_or(([1, 1], 0))
    }

    /// The iteration of the present masks.
    pub(super) fn made_at(&self) -> Option<u32> {
        self.made_at
    }

    /// What a checkpoint keeps.
    pub(super) fn words(&self) -> &[u32] {
        &self.words
    }

    /// Restores [`PseudoMasks::words`], made at an iteration; of the same views.
    pub(super) fn restore(&mut self, gpu: &Gpu, words: Vec<u32>, made_at: Option<u32>) {
        gpu.write(&self.bits, 0, &words);
        self.words = words;
        self.made_at = made_at;
    }

    /// Makes the masks from the present straight set and surface.
    pub(super) fn make(&mut self, straight: &Trainer, surface: &Surface, iteration: u32) -> Result<()> {
        let gpu = Arc::clone(&straight.gpu);
        let mut renderer =
            Renderer::of_run(Arc::clone(&gpu), &straight.blocks)?.drawn(straight.config.drawing())?;
        self.words.fill(0);
        for (view, (_, first)) in straight.targets.views().iter().zip(&self.views) {
            let camera = small(&view.camera);
            let seen = renderer.render(&camera, &view.pose, [0.0; 3])?;
            let mut water = water_of(surface, &camera, &view.pose, &seen);
            clean(&mut water, camera.width as usize);
            for (cell, _) in water.iter().enumerate().filter(|(_, water)| **water) {
                self.words[*first as usize + cell / 32] |= 1 << (cell % 32);
            }
        }
        drop(renderer);
        gpu.write(&self.bits, 0, &self.words);
        self.made_at = Some(iteration);
        gpu.release_unused()
    }
}

fn small(camera: &PinholeCamera) -> PinholeCamera {
    camera.resized((camera.width >> HALVINGS).max(1), (camera.height >> HALVINGS).max(1))
}

/// Whether each pixel sees the surface before anything else.
fn water_of(surface: &Surface, camera: &PinholeCamera, pose: &Pose, seen: &Rendered) -> Vec<bool> {
    let to_world = pose.rotation.inverse();
    let eye = pose.centre();
    let pixel = |index: usize| {
        let direction: DVec3 = (to_world * camera.direction(index)).normalize();
        let Some(range) = surface.meets(eye, direction) else { return false };
        let alpha = seen.alpha[index];
        alpha < LEAST_ALPHA || f64::from(seen.range[index] / alpha) > CLEARLY_BEHIND * range
    };
    (0..seen.alpha.len()).map(pixel).collect()
}

/// Closes gaps of a cell, then drops connected parts that are smaller than [`LEAST_SHARE`].
fn clean(water: &mut Vec<bool>, columns: usize) {
    let rows = water.len() / columns.max(1);
    let around = |mask: &[bool], value: bool| -> Vec<bool> {
        let near = |at: usize| {
            let (x, y) = (at % columns, at / columns);
            (y.saturating_sub(1)..=(y + 1).min(rows - 1)).any(|v| {
                (x.saturating_sub(1)..=(x + 1).min(columns - 1)).any(|u| mask[v * columns + u] == value)
            })
        };
        (0..mask.len()).map(near).collect()
    };
    if rows == 0 {
        return;
    }
    let wider = around(water, true);
    // A cell at the edge of a closed mask has a dry neighbour.
    *water = around(&wider, false).iter().map(|near_dry| !near_dry).collect();
    let mut part = vec![usize::MAX; water.len()];
    let mut sizes = Vec::new();
    for start in 0..water.len() {
        if !water[start] || part[start] != usize::MAX {
            continue;
        }
        let (mut open, mut size) = (vec![start], 0);
        part[start] = sizes.len();
        while let Some(at) = open.pop() {
            size += 1;
            let (x, y) = (at % columns, at / columns);
            for v in y.saturating_sub(1)..=(y + 1).min(rows - 1) {
                for u in x.saturating_sub(1)..=(x + 1).min(columns - 1) {
                    let next = v * columns + u;
                    if water[next] && part[next] == usize::MAX {
                        part[next] = sizes.len();
                        open.push(next);
                    }
                }
            }
        }
        sizes.push(size);
    }
    let least = LEAST_SHARE * water.len() as f64;
    for (cell, part) in water.iter_mut().zip(&part) {
        *cell = *cell && f64::from(sizes[*part] as u32) >= least;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> Vec<bool> {
        rows.iter().flat_map(|row| row.chars().map(|c| c == '#')).collect()
    }

    #[test]
    fn gaps_close_and_specks_disappear() {
        // 1 % of 14 x 9 cells are 1.3. What lies within a cell of the border would grow to it.
        let mut water = mask(&[
            "..............",
            "..............",
            "..#####.......",
            "..##.##.......",
            "..#####....#..",
            "..#####.......",
            "..............",
            "..............",
            "..............",
        ]);
        clean(&mut water, 14);
        let expected = mask(&[
            "..............",
            "..............",
            "..#####.......",
            "..#####.......",
            "..#####.......",
            "..#####.......",
            "..............",
            "..............",
            "..............",
        ]);
        assert_eq!(water, expected);
    }

    #[test]
    fn water_is_where_the_surface_is_nearer_than_what_is_seen() {
        let surface = Surface { normal: DVec3::Y, offset: 0.0, ior: 1.333 };
        let camera = PinholeCamera { width: 3, height: 1, fx: 1.0, fy: 1.0, cx: 1.5, cy: 0.5 };
        // Straight down from a height of 2.
        let rotation = glam::DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
        let rotation = if (rotation.inverse() * DVec3::Z).y < 0.0 { rotation } else { rotation.inverse() };
        let pose = Pose { rotation, translation: -(rotation * DVec3::new(0.0, 2.0, 0.0)) };
        let middle = 2.0;
        let side = 2.0 * 2.0_f32.sqrt();
        let seen = Rendered {
            width: 3,
            height: 1,
            rgb: vec![[0.0; 3]; 3],
            alpha: vec![0.9, 0.9, 0.1],
            range: vec![0.9 * side * 0.8, 0.9 * middle * 1.2, 0.1 * side],
        };
        assert_eq!(water_of(&surface, &camera, &pose, &seen), [false, true, true]);
    }
}
