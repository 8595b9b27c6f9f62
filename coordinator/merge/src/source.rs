//! The data that both passes share about a result: its rows, which of them lie in its cell, and the counts of
//! each block.

use fathom_plan::{Partition, Plan};
use glam::DVec3;

use crate::MergeError;
use crate::ply_rows::{BLOCK_ROWS, PlyFile};

/// A partition with its result.
pub struct Source<'a> {
    /// The whole plan.
    pub plan: &'a Plan,
    /// Its index in the plan.
    pub index: u32,
    /// Its partition.
    pub partition: &'a Partition,
    /// The rows.
    pub file: PlyFile,
    /// BLAKE3 of the whole file as submitted, in hex.
    pub digest: &'a str,
}

/// The owner of a row.
pub enum Place {
    /// The cell; the row's centre in the aligned frame.
    Cell(DVec3),
    /// A neighbour.
    Margin,
    /// No partition: centre or opacity is not finite.
    Nowhere,
}

impl Source<'_> {
    /// The owner of a row with this centre and logit of the opacity.
    #[inline]
    pub fn place(&self, mean: [f32; 3], logit: f32) -> Place {
        if !(logit.is_finite() && mean.iter().all(|v| v.is_finite())) {
            return Place::Nowhere;
        }
        let aligned = self.plan.alignment.to_aligned(mean);
        if self.partition.cell.contains(aligned) { Place::Cell(aligned) } else { Place::Margin }
    }
}

/// A run of rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowBlock {
    /// Checksum of its bytes.
    pub crc: u32,
    /// Rows whose centre lies in the cell.
    pub inside: u32,
    /// Rows without a finite centre and opacity.
    pub not_finite: u32,
    /// Histogram bin of the most transparent row inside.
    pub lowest_bin: u16,
    /// Bounds of the rows inside.
    pub bounds: Extent,
    /// Greatest reach of a candidate in it; negative where there is none.
    pub reach: f32,
}

/// Bounds of the centres of some Gaussians, scene frame, and the width of the widest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Smallest coordinates.
    pub low: [f32; 3],
    /// Largest ones.
    pub high: [f32; 3],
    /// Greatest logarithm of a standard deviation; -infinity where rows have none.
    pub widest_log: f32,
}

impl Extent {
    /// The extent of no Gaussians.
    pub const NONE: Self = Self { low: [f32::MAX; 3], high: [f32::MIN; 3], widest_log: f32::NEG_INFINITY };

    /// Adds a Gaussian.
    pub fn add(&mut self, mean: [f32; 3], log_scales: Option<[f32; 3]>) {
        for axis in 0..3 {
            self.low[axis] = self.low[axis].min(mean[axis]);
            self.high[axis] = self.high[axis].max(mean[axis]);
        }
        if let Some([x, y, z]) = log_scales {
            self.widest_log = self.widest_log.max(x).max(y).max(z);
        }
    }
}

impl RowBlock {
    /// Compares the bytes of this block with those of the first pass.
    ///
    /// # Errors
    /// When they differ.
    pub fn check(&self, rows: &[u8], file: &PlyFile, block: u64) -> Result<(), MergeError> {
        if crc32c::crc32c(rows) == self.crc {
            return Ok(());
        }
        let first = block * BLOCK_ROWS;
        let message = format!(
            "changed during the merge: the {} rows from row {first} on differ from the first pass",
            file.rows_of(block)
        );
        Err(MergeError::File { path: file.path.clone(), message })
    }
}
