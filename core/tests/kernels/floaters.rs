//! Gaussians that float in front of the scene fade where the view is known to be clear, and only there.

use std::sync::Arc;

use fathom_core::config::{TrainConfig, WaterConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::Gpu;
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::InMemory;
use glam::DVec3;

use crate::device::device;
use crate::trainer::{config, photographs};
use crate::water::{COMPOSITIONS, watery, with};

/// Cameras are 3.2 from the point that they look at; the nearest Gaussians of the scene are 2 away.
const CLEAR: f32 = 1.5;
const ITERATIONS: u32 = 300;
/// Initial opacity of every Gaussian, including the one that floats in the water.
const BEGINS_AT: f32 = 0.5;

/// Final opacity of the Gaussian that floats one unit in front of the first camera, and the sum of all
/// others.
fn opacities(gpu: &Arc<Gpu>, photographs: &InMemory, clear_range: f32, weight: f32) -> (f32, f32) {
    let mut photographs = photographs.clone();
    photographs.views.iter_mut().for_each(|view| view.clear_range = clear_range);
    let first = &photographs.views[0];
    let at = first.pose.centre() + first.pose.rotation.inverse() * DVec3::new(0.1, 0.05, 1.0);
    let water = WaterConfig { floater_weight: weight, lr: 0.0, lr_end: 0.0, ..with(COMPOSITIONS[3]) };
    let config = TrainConfig { refine_steps: 0, ..config(ITERATIONS) };
    let mut run: TrainRun = watery(&photographs, config, water);
    run.focus.means.push(at.as_vec3().to_array());
    run.focus.quats.push([1.0, 0.0, 0.0, 0.0]);
    run.focus.log_scales.push([-2.5; 3]);
    run.focus.opacity_logits.push(0.0);
    run.focus.sh_coeffs.extend([[0.0; 3]; 4]);
    let mut trainer = Trainer::new(Arc::clone(gpu), run).unwrap();
    trainer.advance(ITERATIONS).unwrap();
    let model: Gaussians = trainer.gaussians().unwrap();
    let opacity = |index: usize| 1.0 / (1.0 + (-model.opacity_logits[index]).exp());
    let is_near = |index: &usize| {
        let mean = DVec3::from(model.means[*index].map(f64::from));
        mean.distance(at) < 0.3
    };
    let (floating, others): (Vec<usize>, Vec<usize>) = (0..model.len()).partition(is_near);
    assert_eq!(floating.len(), 1, "the floater must not move");
    (opacity(floating[0]), others.into_iter().map(opacity).sum())
}

#[test]
fn floaters_fade_where_the_view_is_known_to_be_clear() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 40);
    let (kept, scene) = opacities(&gpu, &photographs, 0.0, 20.0);
    // An unknown clear range and a weight of 0 give the same bytes.
    assert_eq!(opacities(&gpu, &photographs, CLEAR, 0.0), (kept, scene));
    let (faded, with_it_gone) = opacities(&gpu, &photographs, CLEAR, 20.0);
    assert!(faded < 0.2 * BEGINS_AT && faded < 0.5 * kept, "{faded} of {kept}");
    assert!(
        (with_it_gone / scene - 1.0).abs() < 0.1,
        "the scene itself must stay: {with_it_gone} of {scene}"
    );
}
