//! Density control: adds, moves and removes Gaussians at fixed iterations.
//!
//! The host reads back four numbers per Gaussian. A pure function of them and of random numbers keyed by
//! (seed, iteration, index) decides, and kernels carry the decision out. So a strategy has no state of its
//! own, and a resumed run decides the same.

mod classic;
mod cover;
mod mcmc;

use bytemuck::{Pod, Zeroable};

use super::Trainer;
use crate::config::Strategy;
use crate::gpu::{Block, BlockTraining, Recorder, Size, SurfaceRays, block_capacity, sh_stride};
use crate::{CoreError, Result};

/// Largest number of Gaussians split or moved between two submissions: bounds the staging buffer.
const CHUNK: usize = 65_536;

/// Statistics of a trainable Gaussian, from `density_stats.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
struct Stats {
    /// 0 where a parameter is not finite.
    opacity: f32,
    /// Sum of absolute pixel gradients, mean over views (AbsGS).
    pixel_gradient: f32,
    /// Length of the gradient w.r.t. the centre in units of half an image, mean over views (3DGS).
    gradient: f32,
    /// Largest standard deviation, scene units.
    scale: f32,
}

/// Counts Gaussians larger than `largest` (scene units) as faded, so that they are relocated or removed.
///
/// Through a hole in an underwater surface one sees what lies behind it. The loss cannot distinguish open
/// water from a single Gaussian behind the whole scene. Such a Gaussian closes every hole, with a colour and
/// a range that are unrelated to the surface.
fn fade_oversized(stats: &mut [Stats], largest: f32) {
    for one in stats.iter_mut().filter(|one| one.scale > largest) {
        one.opacity = 0.0;
    }
}

impl Trainer {
    /// Runs the density steps that are due at this iteration; the device is idle before and after.
    pub(super) fn densify(&mut self) -> Result<()> {
        if self.schedule.densifies_at(self.iteration) {
            let mut stats = self.read_stats()?;
            if let Some(medium) = self.appearances.water() {
                fade_oversized(&mut stats, medium.run().largest_deviation());
            }
            self.cover_surfaces(&mut stats)?;
            match self.config.strategy {
                Strategy::Mcmc => self.densify_mcmc(&stats)?,
                Strategy::Classic => self.densify_classic(&stats)?,
            }
            self.update_smoothing()?;
        }
        if self.schedule.resets_at(self.iteration) {
            self.reset_opacities()?;
        }
        Ok(())
    }

    /// Reads the statistics of every trainable Gaussian and resets the sums.
    fn read_stats(&self) -> Result<Vec<Stats>> {
        let mut stats = Vec::new();
        for (_, block, training) in self.blocks.trainable() {
            if block.count == 0 {
                continue;
            }
            let buffer =
                self.gpu.buffer("density stats", u64::from(block.count) * size_of::<Stats>() as u64)?;
            let mut recorder = Recorder::new(&self.gpu);
            let mut bound = vec![
                ("block", &block.uniform),
                ("transforms", &block.transforms),
                ("density_sums", &training.density_sums),
                ("stats", &buffer),
            ];
            bound.extend(self.frame.bound_surface());
            recorder.dispatch(self.stats_kernel(), Size::Items(block.count, 64), &bound)?;
            recorder.submit();
            stats.extend(self.gpu.read::<Stats>(&buffer, 0, block.count as usize)?);
        }
        Ok(stats)
    }

    fn stats_kernel(&self) -> &'static str {
        match (self.config.disks, self.frame.rays()) {
            (false, _) => "density_stats",
            (true, None) if self.masked => "density_stats_masked",
            (true, None) => "density_stats_disks",
            (true, Some(SurfaceRays::Reflected)) => "density_stats_above",
            (true, Some(SurfaceRays::Refracted)) => "density_stats_below",
        }
    }

    /// A staging buffer for `count` Gaussians: transforms and coefficients.
    fn staged(&self, count: usize) -> Result<wgpu::Buffer> {
        let row = u64::from(3 + sh_stride(self.config.sh_degree)) * 16;
        self.gpu.buffer("staged Gaussians", count as u64 * row)
    }

    /// Writes staged Gaussians to entries: row n to the n-th of `places`.
    fn place(&self, recorder: &mut Recorder<'_>, staged: &wgpu::Buffer, places: &[u32]) -> Result<()> {
        self.by_block(places, |block, _, rows| {
            let buffer = self.gpu.buffer("densify rows", rows.len() as u64 * 8)?;
            self.gpu.write(&buffer, 0, rows);
            let count = self.gpu.uniform("densify", &[rows.len() as u32, 0, 0, 0]);
            recorder.dispatch(
                "densify_place",
                Size::Items(rows.len() as u32, 64),
                &[
                    ("block", &block.uniform),
                    ("place", &count),
                    ("placements", &buffer),
                    ("transforms", &block.transforms),
                    ("sh_coeffs", &block.sh_coeffs),
                    ("staged", staged),
                ],
            )
        })
    }

    /// Calls `act` for each trainable block that contains any of `indices`, with their (entry of the block,
    /// position in `indices`), in their order.
    fn by_block(
        &self,
        indices: &[u32],
        mut act: impl FnMut(&Block, &BlockTraining, &[[u32; 2]]) -> Result<()>,
    ) -> Result<()> {
        for (index, block, training) in self.blocks.trainable() {
            let first = index as u32 * block_capacity(training.kind);
            let rows: Vec<[u32; 2]> = indices
                .iter()
                .enumerate()
                .filter(|(_, at)| (first..first + block.capacity).contains(at))
                .map(|(n, at)| [at - first, n as u32])
                .collect();
            if !rows.is_empty() {
                act(block, training, &rows)?;
            }
        }
        Ok(())
    }

    /// Waits for the device; `what` names the operation in errors.
    fn finish(&self, what: &str) -> Result<()> {
        self.gpu.release_unused().map_err(|error| match error {
            CoreError::Gpu(message) => CoreError::Gpu(format!("{what}: {message}")),
            other => other,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_gaussians_beyond_the_size_limit_count_as_faded() {
        let one = |scale| Stats { opacity: 0.9, scale, ..Stats::default() };
        let mut stats = [one(3.9), one(4.0), one(4.1), one(f32::INFINITY)];
        fade_oversized(&mut stats, 4.0);
        assert_eq!(stats.map(|one| one.opacity), [0.9, 0.9, 0.0, 0.0]);
    }
}
