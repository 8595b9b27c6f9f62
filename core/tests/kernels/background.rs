//! Training over a background with a new random colour in every iteration.

use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::gaussians::{Gaussians, SH_C0};
use fathom_core::gpu::{Gpu, Renderer};
use fathom_core::train::{Progress, TrainRun, Trainer};
use fathom_core::views::InMemory;

use crate::device::device;
use crate::trainer::{assert_same_model, config, grey, photographs, photographs_of, run};

fn random(iterations: u32) -> TrainConfig {
    TrainConfig { random_background: true, ..config(iterations) }
}

fn train(gpu: &Arc<Gpu>, run: TrainRun, steps: &[u32]) -> (Gaussians, Progress) {
    let mut trainer = Trainer::new(Arc::clone(gpu), run).unwrap();
    for &n in steps {
        trainer.advance(n).unwrap();
    }
    (trainer.gaussians().unwrap(), trainer.progress())
}

/// An opaque wall that fills every view: black on the left, orange on the right.
fn wall() -> Gaussians {
    let mut model = Gaussians::empty(0);
    for (x, y) in (-16..=16).flat_map(|x| (-12..=12).map(move |y| (x, y))) {
        model.means.push([0.25 * x as f32, 0.25 * y as f32, 0.0]);
        model.quats.push([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.push([-1.6, -1.6, -3.0]);
        model.opacity_logits.push(4.0);
        let colour = if x < 0 { [0.0; 3] } else { [0.9, 0.5, 0.1] };
        model.sh_coeffs.push(colour.map(|value| (value - 0.5) / SH_C0));
    }
    model
}

/// Mean alpha of the pixels that are black in the photographs.
fn alpha_where_black(gpu: &Arc<Gpu>, model: &Gaussians, photographs: &InMemory) -> f64 {
    let mut renderer = Renderer::new(Arc::clone(gpu), model).unwrap();
    let (mut sum, mut count) = (0.0, 0);
    for (view, image) in photographs.views.iter().zip(&photographs.images) {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        for (pixel, alpha) in image.pixels.iter().zip(&rendered.alpha) {
            if pixel & 0x00FF_FFFF == 0 {
                sum += f64::from(*alpha);
                count += 1;
            }
        }
    }
    assert!(count > 1000, "only {count} pixels are black");
    sum / f64::from(count)
}

#[test]
fn black_walls_become_opaque_only_over_random_backgrounds() {
    let Some(gpu) = device() else { return };
    let photographs = photographs_of(&gpu, &wall(), 64, 48);
    let mut start = grey(&wall());
    start.opacity_logits.fill(0.0);
    let trained = |config: TrainConfig| {
        let config = TrainConfig { max_gaussians: 900, mean_noise: 0.0, ..config };
        let mut trainer =
            Trainer::new(Arc::clone(&gpu), TrainRun { focus: start.clone(), ..run(&photographs, config) })
                .unwrap();
        let first = trainer.advance(6).unwrap().loss;
        let last = trainer.advance(240).unwrap().loss;
        assert!(last < 0.3 * first, "loss {first} after the first epoch, {last} at the end");
        alpha_where_black(&gpu, &trainer.gaussians().unwrap(), &photographs)
    };
    let (on, off) = (trained(random(240)), trained(config(240)));
    // Measured: 0.91 and 0.02.
    assert!(
        on > 0.85 && off < 0.2,
        "mean alpha where photographs are black: {on} over random colours, {off} over black"
    );
}

#[test]
fn a_seed_decides_random_backgrounds_also_after_a_resume() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let (whole, progress) = train(&gpu, run(&photographs, random(30)), &[30]);
    let (again, _) = train(&gpu, run(&photographs, random(30)), &[1, 7, 3, 19]);
    assert_same_model("in small steps", &whole, &again);
    let (black, black_progress) = train(&gpu, run(&photographs, config(30)), &[30]);
    assert_ne!(whole.means, black.means, "random backgrounds must change the model");
    assert_ne!(progress.loss, black_progress.loss);
    let mut first = Trainer::new(Arc::clone(&gpu), run(&photographs, random(30))).unwrap();
    first.advance(13).unwrap();
    let checkpoint = first.checkpoint().unwrap();
    let mut second = Trainer::resume(Arc::clone(&gpu), run(&photographs, random(30)), &checkpoint).unwrap();
    second.advance(30).unwrap();
    assert_same_model("resumed", &whole, &second.gaussians().unwrap());
}
