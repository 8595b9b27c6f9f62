//! Measures a model for seams while its views are rendered: renders its surfaces for [`crate::seams`].

use std::sync::Arc;

use super::{Gpu, Renderer};
use crate::config::SeamsConfig;
use crate::gaussians::Gaussians;
use crate::metrics::SsimMap;
use crate::scene::{PinholeCamera, Pose};
use crate::seams::{SeamLines, SeamMeter, SeamReport, SeenView};
use crate::views::PackedImage;
use crate::{CoreError, Result};

/// The surfaces of a model on the device, and what was measured so far.
pub struct SeamRun {
    renderer: Renderer,
    meter: SeamMeter,
}

impl SeamRun {
    /// Uploads the surfaces of `model`: [`Gaussians::surfaces`] by the usual viewing distance of its plan,
    /// scene units.
    ///
    /// # Errors
    /// When the device cannot hold them beside what it holds already.
    pub fn new(
        gpu: &Arc<Gpu>,
        model: &Gaussians,
        mip_filter: bool,
        viewing_distance: Option<f32>,
        (lines, config): (SeamLines, SeamsConfig),
    ) -> Result<Self> {
        let surfaces = model.surfaces(viewing_distance);
        let renderer = Renderer::new(Arc::clone(gpu), &surfaces)?.with_mip_filter(mip_filter);
        Ok(Self { renderer, meter: SeamMeter::new(lines, config) })
    }

    /// The same, but `None`, with a warning, where the device has no room for it: a model that can be
    /// rendered is measured, with or without its borders.
    ///
    /// # Errors
    /// When the device fails otherwise.
    pub fn if_it_fits(
        gpu: &Arc<Gpu>,
        model: &Gaussians,
        mip_filter: bool,
        viewing_distance: Option<f32>,
        measured: (SeamLines, SeamsConfig),
    ) -> Result<Option<Self>> {
        match Self::new(gpu, model, mip_filter, viewing_distance, measured) {
            Ok(run) => Ok(Some(run)),
            Err(error @ (CoreError::OutOfMemory { .. } | CoreError::BufferTooLarge { .. })) => {
                tracing::warn!("nothing is measured at the borders of cells: {error}");
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// Measures one view as [`SeamMeter::add`]; a picture of it, PNG, where it shows enough of a border to
    /// count.
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

    /// Everything that was measured, the views in the order in which they were added.
    pub fn report(self) -> SeamReport {
        self.meter.report()
    }
}
