//! A factor on the whole loss of a run (SMP-UWGS section 3.1, "Depth-Adaptive Gradient Modulation") and its
//! effect under Adam.

use std::sync::Arc;

use fathom_core::config::{ClassicConfig, Medium, Moments, Strategy, TrainConfig, WaterConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::Gpu;
use fathom_core::train::{MediumRun, TrainRun, Trainer};
use fathom_core::views::InMemory;

use crate::device::device;
use crate::trainer::{grey, photographs, truth};
use crate::water::fixed;

/// The true Gaussians in grey, with their rotations. Without a rotation, the gradient of a quaternion starts
/// as pure rounding error. That error is as small as Adam's epsilon.
fn start() -> Gaussians {
    Gaussians { quats: truth().quats, ..grey(&truth()) }
}

fn trained(gpu: &Arc<Gpu>, config: &TrainConfig, views: &InMemory, medium: Option<MediumRun>) -> Gaussians {
    let run = TrainRun {
        config: config.clone(),
        extent: 2.0,
        views: Arc::new(views.clone()),
        focus: start(),
        context: Gaussians::empty(1),
        surfaces: Gaussians::empty(1),
        medium,
        surface: None,
    };
    let mut trainer = Trainer::new(Arc::clone(gpu), run).unwrap();
    trainer.advance(config.iterations).unwrap();
    trainer.gaussians().unwrap()
}

/// Largest difference between the centres of two models, scene units, and between their constant colours.
fn difference(a: &Gaussians, b: &Gaussians) -> [f32; 2] {
    assert_eq!(a.len(), b.len());
    let largest = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    [largest(&a.means, &b.means), largest(&a.sh_coeffs, &b.sh_coeffs)]
}

#[test]
fn a_factor_on_the_loss_changes_almost_nothing_under_adam() {
    let Some(gpu) = device() else { return };
    let views = photographs(&gpu, 64, 48);
    let config = |loss_factor| TrainConfig {
        iterations: 60,
        max_gaussians: 120,
        sh_degree: 1,
        resolution_at: [0.0; 2],
        // Compact moments round the logarithm of a gradient, and a factor shifts all logarithms.
        moments: Moments::F32,
        loss_factor,
        ..TrainConfig::default()
    };
    // A frozen water, with every loss term that a water adds.
    let water = |medium| {
        let mut water = WaterConfig { medium, ..WaterConfig::default() };
        (water.priors.dark_channel, water.priors.depth_smoothness) = (1.0, 2.0);
        Some(MediumRun { is_free: false, ..fixed(&water, 3.2) })
    };
    // A power of two preserves every mantissa. Any other factor changes the rounding of the gradients, by an
    // amount that depends on the size of tiles. Where the water acts on pixels, gradients are divided by
    // alphas that may be small, which amplifies rounding.
    for (medium, rounded) in
        [(None, 3e-2), (water(Medium::PerGaussian), 3e-2), (water(Medium::PerPixel), 5e-2)]
    {
        let trained = |config: TrainConfig| trained(&gpu, &config, &views, medium.clone());
        let plain = trained(config(1.0));
        let moved = difference(&plain, &trained(TrainConfig { seed: 2, ..config(1.0) }));
        for (factor, allowed) in [(0.5, 1e-6), (0.3, rounded)] {
            let scaled = difference(&plain, &trained(config(factor)));
            for (scaled, moved) in scaled.into_iter().zip(moved) {
                assert!(
                    scaled <= allowed * moved,
                    "factor {factor}: {scaled}, but another seed moves by {moved}"
                );
            }
        }
    }
}

#[test]
fn a_factor_on_the_loss_shifts_the_classic_density_threshold() {
    let Some(gpu) = device() else { return };
    let views = photographs(&gpu, 64, 48);
    let gaussians = |loss_factor: f32, gradient: f32| {
        let classic = ClassicConfig { gradient, reset_every: 0.0, ..ClassicConfig::default() };
        let config = TrainConfig {
            iterations: 60,
            max_gaussians: 1000,
            sh_degree: 1,
            resolution_at: [0.0; 2],
            strategy: Strategy::Classic,
            moments: Moments::F32,
            loss_factor,
            classic,
            ..TrainConfig::default()
        };
        trained(&gpu, &config, &views, None).len()
    };
    let (plain, halved) = (gaussians(1.0, 8e-3), gaussians(0.5, 8e-3));
    assert!(halved < plain, "{halved} with half the loss, {plain} with all of it");
    assert_eq!(halved, gaussians(1.0, 1.6e-2), "half the loss must equal twice the threshold");
}
