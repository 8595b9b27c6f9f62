//! Measures the seams of a model while its views are rendered: renders the surfaces that [`crate::seams`]
//! needs.

use std::sync::Arc;

use super::{Drawing, Gpu, Renderer};
use crate::config::SeamsConfig;
use crate::gaussians::Gaussians;
use crate::metrics::SsimMap;
use crate::scene::{PinholeCamera, Pose};
use crate::seams::{SeamLines, SeamMeter, SeamReport, SeamSums, SeenView};
use crate::views::PackedImage;
use crate::{CoreError, Result};

/// The surfaces of a model on the device, and the measurements so far.
pub struct SeamRun {
    renderer: Renderer,
    meter: SeamMeter,
}

impl SeamRun {
    /// Uploads the surfaces of `model`: [`Gaussians::surfaces`] with `viewing_distance`, the scene scale of
    /// its plan, scene units.
    ///
    /// # Errors
    /// When the device cannot hold them in addition to what it already holds.
    pub fn new(
        gpu: &Arc<Gpu>,
        model: &Gaussians,
        drawing: Drawing,
        viewing_distance: Option<f32>,
        (lines, config): (SeamLines, SeamsConfig),
    ) -> Result<Self> {
        let surfaces = model.surfaces(viewing_distance);
        let renderer = Renderer::new(Arc::clone(gpu), &surfaces)?.drawn(drawing)?;
        Ok(Self { renderer, meter: SeamMeter::new(lines, config) })
    }

    /// As [`SeamRun::new`], but returns `None` and logs a warning if the device has no room. A model that can
    /// be rendered is thus always evaluated, with or without its borders.
    ///
    /// # Errors
    /// When the device fails for another reason.
    pub fn if_it_fits(
        gpu: &Arc<Gpu>,
        model: &Gaussians,
        drawing: Drawing,
        viewing_distance: Option<f32>,
        measured: (SeamLines, SeamsConfig),
    ) -> Result<Option<Self>> {
        match Self::new(gpu, model, drawing, viewing_distance, measured) {
            Ok(run) => Ok(Some(run)),
            Err(error @ (CoreError::OutOfMemory { .. } | CoreError::BufferTooLarge { .. })) => {
                tracing::warn!("seams at the borders of cells are not measured: {error}");
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// Measures one view as in [`SeamMeter::add`]. Returns a picture of it (PNG) if it shows enough of a
    /// border to count.
    ///
    /// # Errors
    /// When the device fails.
    pub fn add(
        &mut self,
        (camera, pose): (&PinholeCamera, &Pose),
        render: &PackedImage,
        truth: &PackedImage,
        ssim: Option<&SsimMap>,
    ) -> Result<Option<Vec<u8>>> {
        let shown = self.renderer.render(camera, pose, [0.0; 3])?;
        let view = SeenView { camera, pose, alpha: &shown.alpha, range: &shown.range };
        let zones = self.meter.add(&view, render, truth, ssim);
        zones.counts().then(|| zones.picture(render, truth)).transpose()
    }

    /// All measurements; views are in the order in which they were added.
    pub fn sums(self) -> SeamSums {
        self.meter.sums()
    }

    /// The results of [`SeamRun::sums`].
    pub fn report(self) -> SeamReport {
        self.meter.report()
    }
}
