//! Colours for viewers: harmonics with which programs that blend in sRGB show a model as it is that was
//! blended in linear light.
//!
//! Light that is encoded after it was blended is brighter than the blend of what was encoded before, wherever
//! Gaussians of different colours lie over each other: no Gaussian's colour alone can make up for that. So
//! the colours, and nothing else, are trained against the model's own pictures.

use std::sync::{Arc, Mutex, PoisonError};

use crate::config::TrainConfig;
use crate::gaussians::Gaussians;
use crate::gpu::{Gpu, Renderer, WaterView};
use crate::metrics::quantised;
use crate::train::{Progress, TrainRun, Trainer};
use crate::views::{PackedImage, TrainView, ViewSource};
use crate::{CoreError, Result};

/// How colours are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewerColours {
    /// Iterations; one sees one view.
    pub iterations: u32,
    /// Of the order of the views.
    pub seed: u32,
}

/// Iterations that are done between two calls of `report`.
const REPORT_EVERY: u32 = 50;
/// Adam's rates of the constant colour and of all higher bands: on sesa-wreck trained in linear light, 3000
/// iterations from 33.20 dB gave 42.95 dB with these, and 41.85 dB with twice the second.
const DC_RATE: f32 = 0.02;
const REST_RATE: f32 = 0.002;

impl ViewerColours {
    /// `model` with other colours: blended in sRGB over black, it shows from `views` what the model shows
    /// through `shown` (J, with [`crate::gpu::Output::Restored`]). Positions, shapes and opacities stay to
    /// the bit.
    ///
    /// `report` is told where the training stands.
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
            // Only means have a rate that depends on it.
            extent: 1.0,
            views: Arc::new(pictures),
            focus: model.clone(),
            context: Gaussians::empty(model.sh_degree),
            surfaces: Gaussians::empty(model.sh_degree),
            medium: None,
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

    /// Rates for colours alone. What is compared are means over pixels, so L1 and SSIM weigh as in training.
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

/// What the model shows itself, in the place of photographs.
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
        // A renderer whose last user panicked overwrites all that it left.
        let mut renderer = self.renderer.lock().unwrap_or_else(PoisonError::into_inner);
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
        Ok(Arc::new(quantised(rendered.width, rendered.height, &rendered.rgb)))
    }
}
