//! Colours for viewers: harmonics with which viewers that blend in sRGB reproduce a model that was blended in
//! linear light.
//!
//! Light that is blended and then encoded is brighter than a blend of encoded light, wherever Gaussians of
//! different colours overlap. The colour of a single Gaussian cannot compensate for this. The colours alone
//! are therefore trained against the model's own pictures.

use std::sync::{Arc, Mutex, PoisonError};

use crate::config::TrainConfig;
use crate::gaussians::Gaussians;
use crate::gpu::{Gpu, Renderer, WaterView};
use crate::metrics::quantised;
use crate::train::{Progress, TrainRun, Trainer};
use crate::views::{PackedImage, TrainView, ViewSource};
use crate::{CoreError, Result};

/// Settings for the training of colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewerColours {
    /// Number of iterations, each with one view.
    pub iterations: u32,
    /// Seed for the order of the views.
    pub seed: u32,
}

/// Iterations between two calls of `report`.
const REPORT_EVERY: u32 = 50;
/// Adam's learning rates of the constant colour and of all higher bands. On sesa-wreck trained in linear
/// light, 3000 iterations raised 33.20 dB to 42.95 dB. With twice the second rate it was 41.85 dB.
const DC_RATE: f32 = 0.02;
const REST_RATE: f32 = 0.002;

impl ViewerColours {
    /// `model` with new colours: blended in sRGB over black, it reproduces from `views` the pictures of the
    /// model through `shown` (J, with [`crate::gpu::Output::Restored`]). Positions, shapes and opacities stay
    /// bit-identical.
    ///
    /// `report` receives the progress of the training.
    ///
    /// # Errors
    /// When there are no views or no Gaussians, or the device fails or cannot hold the model twice.
    pub fn find(
        self,
        gpu: &Arc<Gpu>,
        model: &Gaussians,
        shown: WaterView,
        views: Vec<TrainView>,
        mut report: impl FnMut(Progress),
    ) -> Result<Gaussians> {
        let renderer = Renderer::new(Arc::clone(gpu), model)?.with_water(Some(shown));
        let pictures = OwnPictures { views, renderer: Mutex::new(renderer) };
        let run = TrainRun {
            config: self.config(model),
            // Only the rate of the means depends on it.
            extent: 1.0,
            views: Arc::new(pictures),
            focus: model.clone(),
            context: Gaussians::empty(model.sh_degree),
            surfaces: Gaussians::empty(model.sh_degree),
            medium: None,
            surface: None,
        };
        let mut trainer = Trainer::new(Arc::clone(gpu), run)?;
        loop {
            let progress = trainer.advance(REPORT_EVERY)?;
            report(progress);
            if progress.iteration >= progress.iterations {
                break;
            }
        }
        let trained = trainer.gaussians()?;
        Ok(Gaussians { sh_coeffs: trained.sh_coeffs, ..model.clone() })
    }

    /// Rates for colours alone. The pictures are compared as in training, so L1 and SSIM have their usual
    /// weights.
    fn config(self, model: &Gaussians) -> TrainConfig {
        TrainConfig {
            seed: self.seed,
            iterations: self.iterations,
            max_gaussians: model.len() as u32,
            sh_degree: model.sh_degree,
            means_lr: 0.0,
            means_lr_end: 0.0,
            opacity_lr: 0.0,
            scales_lr: 0.0,
            quats_lr: 0.0,
            opacity_reg: 0.0,
            scale_reg: 0.0,
            mean_noise: 0.0,
            refine_steps: 0,
            sh_dc_lr: DC_RATE,
            sh_rest_lr: REST_RATE,
            anneal_from: 0.3,
            anneal_to: 0.05,
            ..TrainConfig::default().continued()
        }
    }
}

/// The model's own pictures, in place of photographs.
struct OwnPictures {
    views: Vec<TrainView>,
    renderer: Mutex<Renderer>,
}

impl ViewSource for OwnPictures {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        let view =
            self.views.get(index).ok_or_else(|| CoreError::Scene(format!("there is no view {index}")))?;
        // After a panic of its last user, a renderer overwrites any partial state.
        let mut renderer = self.renderer.lock().unwrap_or_else(PoisonError::into_inner);
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
        Ok(Arc::new(quantised(rendered.width, rendered.height, &rendered.rgb)))
    }
}
