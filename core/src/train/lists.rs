//! Lists of visible Gaussians and of intersections. A list that was too short grows; if it cannot grow, the
//! view is rendered in bands of tiles.
//!
//! Invariant: no step depends on the lengths of the lists, because the device does nothing after the
//! iteration that failed.

use glam::DVec3;

use super::{MediumRun, Trainer, settings};
use crate::Result;
use crate::config::TrainConfig;
use crate::gaussians::Gaussians;
use crate::gpu::{Frame, Gpu, ListLimits, Overflow};
use crate::memory::{self, RunSize};
use crate::views::TrainView;

impl Trainer {
    /// Returns to the iteration that failed, with room for its view.
    pub(super) fn grow(&mut self, overflow: Overflow) -> Result<()> {
        let key = self.view_of(overflow.failed_at);
        self.iteration = overflow.failed_at;
        self.make_room(key, overflow)
    }

    /// Makes room for a view that failed: longer lists, or more bands if the device cannot bind longer ones.
    pub(super) fn make_room(&mut self, key: (usize, u32), overflow: Overflow) -> Result<()> {
        tracing::debug!(?overflow, "a list was too short; growing it");
        if !overflow.fits(self.frame.limits()) {
            let view = self.picture_of(key);
            let bands = self.bands.entry(key).or_insert(1);
            *bands = self.frame.limits().more_bands(overflow, view.band_count(*bands), view.tile_count())?;
            tracing::debug!(view = key.0, level = key.1, bands, "a view is rendered in bands");
        }
        let (visible, intersections) = self.frame.capacities_for(overflow);
        if (visible, intersections) == self.frame.capacities() {
            self.frame.forget_overflow(&self.gpu);
            return Ok(());
        }
        self.set_list_capacities(visible, intersections)
    }

    /// Replaces the lists by lists of these lengths. They still grow when too short, and no step depends on
    /// their lengths.
    ///
    /// # Errors
    /// When the device cannot bind them.
    pub fn set_list_capacities(&mut self, visible: u32, intersections: u32) -> Result<()> {
        // The old lists are freed first: both together would be the peak memory of the run. In between, the
        // lists have length 1, so that the trainer stays valid if there is no room for the new ones.
        for (visible, intersections) in [(1, 1), (visible, intersections)] {
            self.frame.replace_lists(&self.gpu, visible, intersections)?;
            self.slot_gradients = slot_gradients(&self.gpu, &self.frame)?;
            self.gpu.release_unused()?;
        }
        Ok(())
    }

    /// Limits the growth of the lists to these lengths and to what the device can bind. Views that need more
    /// are rendered in bands of tiles. No step depends on the limits.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn set_list_limits(&mut self, limits: ListLimits) -> Result<()> {
        let device = ListLimits::of_rows(&self.gpu, self.config.disks);
        let limits = ListLimits {
            visible: limits.visible.min(device.visible),
            intersections: limits.intersections.min(device.intersections),
        };
        let (visible, intersections) = self.frame.capacities();
        self.frame.set_limits(limits);
        self.set_list_capacities(visible.min(limits.visible), intersections.min(limits.intersections))
    }

    /// Largest number of bands of any view so far.
    pub fn most_bands(&self) -> u32 {
        self.bands.values().copied().max().unwrap_or(1)
    }

    /// Current capacities of the lists: visible Gaussians and intersections.
    pub fn list_capacities(&self) -> (u32, u32) {
        self.frame.capacities()
    }
}

/// The initial lists of a run.
pub(super) fn lists(
    gpu: &Gpu,
    config: &TrainConfig,
    views: &[TrainView],
    focus: &Gaussians,
    context: &Gaussians,
    medium: Option<&MediumRun>,
) -> memory::Lists {
    let means = |model: &Gaussians| -> Vec<DVec3> {
        model
            .means
            .iter()
            .map(|mean| DVec3::from(mean.map(f64::from)))
            .filter(|mean| mean.is_finite())
            .collect()
    };
    let (trained, frozen) = (u64::from(config.max_gaussians).max(focus.len() as u64), context.len() as u64);
    let pictures: Vec<[u32; 2]> = views.iter().map(|view| [view.camera.width, view.camera.height]).collect();
    let run = RunSize {
        settings: settings(config, medium),
        trained,
        frozen,
        visible: memory::visible_in_fullest_view(
            views.iter().map(|view| (view.camera, view.pose)),
            &[(&means(focus), trained), (&means(context), frozen)],
        ),
        pictures: &pictures,
        tile: gpu.tile(),
        binding_bytes: gpu.largest_binding(),
        measures: false,
    };
    run.lists()
}

/// A buffer with a gradient slot for each intersection.
pub(super) fn slot_gradients(gpu: &Gpu, frame: &Frame) -> Result<wgpu::Buffer> {
    gpu.buffer("slot gradients", u64::from(frame.capacities().1) * memory::slot_bytes(frame.disks.is_some()))
}
