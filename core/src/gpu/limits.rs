//! Lists of a view that were too short, and how long they may become.

use super::Gpu;
use crate::memory::{LONGEST_ROW_BYTES, most_rows};
use crate::{CoreError, Result};

/// A list that was too short, and the length it needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Overflow {
    /// First iteration that failed; it and all later ones did nothing.
    pub failed_at: u32,
    /// Visible Gaussians that it needed; 0 if they fitted.
    pub visible: u32,
    /// Intersections that it needed; 0 if they fitted.
    pub intersections: u32,
}

/// Maximum lengths of the lists of a view. A view that needs more is rendered in bands of tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ListLimits {
    /// Visible Gaussians.
    pub visible: u32,
    /// Intersections.
    pub intersections: u32,
}

impl ListLimits {
    /// The limits of the device's bindings, for 3D Gaussians.
    pub fn of(gpu: &Gpu) -> Self {
        Self::of_rows(gpu, false)
    }

    /// The same, for 3D Gaussians or for disks.
    pub fn of_rows(gpu: &Gpu, disks: bool) -> Self {
        let rows = most_rows(gpu.largest_binding(), disks);
        Self { visible: rows, intersections: rows }
    }

    /// Number of bands for a view that overflowed with `bands`: more by the ratio of needed to allowed
    /// length, plus a fifth.
    ///
    /// # Errors
    /// [`CoreError::BufferTooLarge`] when every band is already a single tile.
    pub fn more_bands(&self, overflow: Overflow, bands: u32, tiles: u32) -> Result<u32> {
        if bands >= tiles {
            return Err(CoreError::BufferTooLarge {
                buffer: "the list of one tile of a view",
                needed_bytes: LONGEST_ROW_BYTES * u64::from(overflow.visible.max(overflow.intersections)),
                limit_bytes: LONGEST_ROW_BYTES * u64::from(self.visible.min(self.intersections)),
            });
        }
        let share = |need: u32, most: u32| f64::from(need) / f64::from(most.max(1));
        let missing =
            share(overflow.visible, self.visible).max(share(overflow.intersections, self.intersections));
        let wanted = (f64::from(bands) * missing * 1.2).ceil().min(f64::from(tiles));
        Ok((wanted as u32).clamp(bands + 1, tiles))
    }
}

impl Overflow {
    /// Whether lists of these lengths would have been enough.
    pub fn fits(&self, limits: ListLimits) -> bool {
        self.visible <= limits.visible && self.intersections <= limits.intersections
    }
}
