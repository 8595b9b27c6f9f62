//! How much blending a view requires: counts that benchmarks relate times to.

use super::layout::counter;
use super::{Frame, FrameUniform, Gpu};
use crate::Result;

/// Work of the last forward pass of a view. An evaluation is one splat at one pixel of a tile that it
/// touches.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Workload {
    /// Gaussians that may be visible.
    pub visible: u32,
    /// Pairs of a splat and a tile that it touches.
    pub intersections: u32,
    /// Evaluations of every intersection at every pixel of its tile.
    pub listed_evaluations: u64,
    /// Evaluations up to the last splat that some pixel of the tile needs: the least that any pass working
    /// tile by tile can do. The backward pass stops there. Of disks, only those that are needed count.
    pub needed_evaluations: u64,
}

impl Frame {
    /// Counts the work of the forward pass of `view`, and waits for it. For a view in bands, counts the last
    /// band.
    ///
    /// # Errors
    /// When targets are missing or the device fails.
    pub fn workload(&self, gpu: &Gpu, view: &FrameUniform) -> Result<Workload> {
        let counters: Vec<u32> = gpu.read(&self.counters, 0, counter::COUNT as usize)?;
        let targets = self.targets()?;
        let (first, count) = (u64::from(view.first_tile), (view.end_tile - view.first_tile) as usize);
        let ranges: Vec<[u32; 2]> = gpu.read(&targets.ranges, 8 * first, count)?;
        let ends: Vec<u32> = gpu.read(&targets.tile_ends, 4 * first, count)?;
        let pixels = u64::from(gpu.tile()).pow(2);
        let listed = ranges.iter().map(|[begin, end]| u64::from(end - begin)).sum::<u64>();
        let needed = ranges.iter().zip(&ends).map(|([begin, end], &most)| u64::from(most.min(end - begin)));
        Ok(Workload {
            visible: counters[counter::VISIBLE as usize],
            intersections: counters[counter::INTERSECTIONS as usize],
            listed_evaluations: pixels * listed,
            needed_evaluations: pixels * needed.sum::<u64>(),
        })
    }
}
