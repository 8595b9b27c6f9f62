//! Metrics on held-out views during training, and previews.
//!
//! The protocol is that of the final evaluation: renders over black without an exposure, clamped and rounded
//! to 8 bits in sRGB. Training does not depend on these metrics.

use std::sync::Arc;

use super::Trainer;
use crate::Result;
use crate::gpu::{Output, Rendered, Renderer, WaterView};
use crate::metrics::{psnr, quantised, ssim};
use crate::scene::{PinholeCamera, Pose};
use crate::views::ViewSource;

/// Means over the held-out views at one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldOutMetrics {
    /// Iterations done.
    pub iteration: u32,
    /// Mean PSNR over the views, dB. Views without one (identical, or fully masked) are left out; NaN if none
    /// is left.
    pub psnr_db: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Views measured.
    pub views: u32,
}

/// A small picture of a view, as the run sees it now.
#[derive(Clone, Debug, PartialEq)]
pub struct Preview {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// As the camera sees it, under water if there is any: sRGB, three bytes a pixel.
    pub render: Vec<u8>,
    /// The same without the water; `None` where there is none.
    pub clear: Option<Vec<u8>>,
}

impl Trainer {
    /// Renders everything that the run sees, its context included, with these cameras; ends early when
    /// `go_on`, which is called before each picture, returns false. The 3D filter of Mip-Splatting is left
    /// out. Training does not depend on it.
    ///
    /// # Errors
    /// When the device fails, or has no memory for the lists of a picture.
    pub fn preview(
        &mut self,
        cameras: &[(PinholeCamera, Pose)],
        go_on: impl Fn() -> bool,
    ) -> Result<Vec<Preview>> {
        let water = self.water_view()?;
        let mut renderer =
            Renderer::of_run(Arc::clone(&self.gpu), &self.blocks)?.drawn(self.config.drawing())?;
        let mut previews = Vec::with_capacity(cameras.len());
        for (camera, pose) in cameras {
            if !go_on() {
                break;
            }
            let mut through = |water: Option<WaterView>| -> Result<Vec<u8>> {
                renderer.set_water(water);
                let rendered = renderer.render(camera, pose, [0.0; 3])?;
                Ok(quantised(rendered.width, rendered.height, &rendered.rgb).to_rgb8())
            };
            let render = through(water)?;
            let restored = water.map(|water| WaterView { output: Output::Restored, ..water });
            let clear = restored.map(|restored| through(Some(restored))).transpose()?;
            previews.push(Preview { width: camera.width, height: camera.height, render, clear });
        }
        drop(renderer);
        self.gpu.release_unused()?;
        Ok(previews)
    }

    /// Renders the current Gaussians in focus from the `held_out` views and compares. `None` if there are no
    /// views, or if `go_on`, which is called before each view, returns false.
    ///
    /// # Errors
    /// When a photograph cannot be read, or the device cannot hold a second copy of the model.
    pub fn measure(
        &mut self,
        held_out: &dyn ViewSource,
        go_on: impl Fn() -> bool,
    ) -> Result<Option<HeldOutMetrics>> {
        let iteration = self.progress().iteration;
        let model = self.gaussians()?;
        let mut renderer = Renderer::new(Arc::clone(&self.gpu), &model)?
            .drawn(self.config.drawing())?
            .with_water(self.water_view()?);
        let found =
            measured(iteration, held_out, go_on, |camera, pose| renderer.render(camera, pose, [0.0; 3]));
        drop(renderer);
        self.gpu.release_unused()?;
        found
    }
}

/// Compares what `render` gives with the `held_out` views. `None` if there are no views, or if `go_on`, which
/// is called before each view, returns false.
pub(super) fn measured(
    iteration: u32,
    held_out: &dyn ViewSource,
    go_on: impl Fn() -> bool,
    mut render: impl FnMut(&PinholeCamera, &Pose) -> Result<Rendered>,
) -> Result<Option<HeldOutMetrics>> {
    let mut measured = Vec::new();
    for (index, view) in held_out.views().iter().enumerate() {
        if !go_on() {
            measured.clear();
            break;
        }
        let truth = held_out.load(index)?;
        let rendered = render(&view.camera, &view.pose)?;
        let render = quantised(rendered.width, rendered.height, &rendered.rgb);
        measured.push((psnr(&render, &truth), ssim(&render, &truth)));
    }
    if measured.is_empty() {
        return Ok(None);
    }
    Ok(Some(HeldOutMetrics {
        iteration,
        psnr_db: mean(measured.iter().map(|(psnr, _)| *psnr)),
        ssim: mean(measured.iter().map(|(_, ssim)| *ssim)),
        views: measured.len() as u32,
    }))
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let finite: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    finite.iter().sum::<f64>() / finite.len() as f64
}
