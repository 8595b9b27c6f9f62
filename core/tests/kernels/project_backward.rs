//! Gradients of all parameters from the gradients of splats.

use fathom_twins::{
    Gaussians64, RasterRules, ViewInput, project_backward, project_forward, samples, view_gradients,
};

use crate::device::device;
use crate::view::{ImageGradients, Scene, View, gradients_only, hard_scenes};

/// Parameters by kind: first and one past the last, in the order of `Gaussians64::parameter`.
const KINDS: [(&str, usize, usize); 5] = [
    ("mean", 0, 3),
    ("quaternion", 3, 7),
    ("log scale", 7, 10),
    ("opacity", 10, 11),
    ("coefficients", 11, 59),
];

fn norm(v: &Gaussians64, index: usize, from: usize, to: usize) -> f64 {
    (from..to).map(|p| v.parameter(index, p).powi(2)).sum::<f64>().sqrt()
}

/// Compares by Gaussian and kind: the length of the difference against the length of the gradient.
///
/// `share` holds for a condition number of 1. The inverse of the covariance loses digits with its condition
/// number, and a gradient passes through it twice.
#[track_caller]
fn check(view: &View, share: f64) -> usize {
    let scene = &view.scene;
    let v = ImageGradients::random(121, view.pixels());
    let slots = view.backward(&v, &gradients_only());
    let (v_splats, sizes) = (view.splat_gradients(&slots), view.slot_sizes(&slots));
    let (model, bare) = (view.drawn(), Gaussians64::from(&scene.model));
    let splats = project_forward(&model, &scene.camera, &scene.pose, scene.sh_degree, &scene.rules());
    let mut twin = project_backward(
        &model,
        &scene.camera,
        &scene.pose,
        scene.sh_degree,
        &splats,
        &v_splats,
        &scene.rules(),
    );
    view.smoothing()
        .iter()
        .enumerate()
        .for_each(|(index, _)| through_smoothing(&bare, &model, index, &mut twin));
    let kernel = view.parameter_gradients();
    let mut compared = 0;
    for (index, splat) in splats.iter().enumerate() {
        let Some(splat) = splat else { continue };
        let [a, b, c] = splat.conic;
        let condition = (a + c).powi(2) / (a * c - b * b);
        for (kind, from, to) in KINDS {
            let to = to.min(model.parameters());
            let length = norm(&twin, index, from, to);
            let difference = (from..to)
                .map(|p| (kernel.parameter(index, p) - twin.parameter(index, p)).powi(2))
                .sum::<f64>()
                .sqrt();
            // The tolerance is relative to the parts of the gradient: sums over slots, which may cancel.
            let size = &sizes[index];
            let mut shape = (size[2] + size[3] + size[4]) * (a + c) * condition.sqrt();
            if scene.mip_filter {
                // Opacity depends on the area without the low-pass, whose two vectors may be nearly parallel.
                shape += size[5] * condition.sqrt();
            }
            let parts = length
                + match kind {
                    "mean" => {
                        let per_unit = scene.camera.fx / splat.depth;
                        per_unit * (size[0] + size[1] + shape) + size[6] + size[8] + size[9] + size[10]
                    }
                    "quaternion" | "log scale" => shape,
                    "opacity" => 0.25 * size[5],
                    _ => size[8] + size[9] + size[10],
                };
            let tolerance = share * condition.sqrt() * parts + 1e-12;
            assert!(
                difference <= tolerance,
                "{}: {kind} of Gaussian {index}: difference {difference:e} of {length:e}, tolerance {tolerance:e}, condition {condition:.0}",
                scene.name
            );
        }
        compared += usize::from(v_splats[index].contribution > 0.0);
    }
    compared
}

/// From the gradient of a smoothed Gaussian to that of the bare one: w = ln sqrt(s^2 + d^2), o' = o times the
/// product of s / sqrt(s^2 + d^2).
fn through_smoothing(bare: &Gaussians64, smooth: &Gaussians64, index: usize, v: &mut Gaussians64) {
    let opacity = |logit: f64| 1.0 / (1.0 + (-logit).exp());
    let (before, after) = (opacity(bare.opacity_logits[index]), opacity(smooth.opacity_logits[index]));
    let v_log_opacity = v.opacity_logits[index] / (1.0 - after);
    v.opacity_logits[index] = v_log_opacity * (1.0 - before);
    for k in 0..3 {
        let share = (2.0 * (bare.log_scales[index][k] - smooth.log_scales[index][k])).exp();
        v.log_scales[index][k] = v.log_scales[index][k] * share + v_log_opacity * (1.0 - share);
    }
}

#[test]
fn parameter_gradients_of_hard_scenes_match_the_twin() {
    let Some(gpu) = device() else { return };
    for scene in hard_scenes(122, 400, 3) {
        let compared = check(&View::render(&gpu, &scene), 2e-5);
        assert!(compared > 30, "{}: {compared} compared", scene.name);
    }
}

#[test]
fn parameter_gradients_through_the_mip_filter_match_the_twin() {
    let Some(gpu) = device() else { return };
    for scene in hard_scenes(125, 400, 1) {
        let compared = check(&View::render(&gpu, &scene.clone().filtered()), 2e-5);
        assert!(compared > 20, "{}: {compared} compared", scene.name);
        let compared = check(&View::render_smoothed(&gpu, &scene), 2e-5);
        assert!(compared > 20, "{}, smoothed: {compared} compared", scene.name);
    }
}

#[test]
fn every_degree_of_every_model_has_the_gradients_of_the_twin() {
    let Some(gpu) = device() else { return };
    for stored in 0..=3 {
        for used in 0..=stored {
            let mut scene =
                Scene::new(&format!("degree {used} of {stored}"), samples::random(123, 150, stored), 75, 53);
            scene.sh_degree = used;
            assert!(check(&View::render(&gpu, &scene), 2e-5) > 100);
        }
    }
}

#[test]
fn the_whole_chain_in_f32_matches_the_twin_to_a_thousandth() {
    let Some(gpu) = device() else { return };
    let scene = Scene::new("chain", samples::random(124, 300, 2), 75, 53);
    let view = View::render(&gpu, &scene);
    let truth = vec![[0.3; 3]; view.pixels()];
    let mask = vec![true; view.pixels()];
    let input = ViewInput {
        camera: &scene.camera,
        pose: &scene.pose,
        sh_degree: 2,
        background: scene.background64(),
        truth: &truth,
        mask: &mask,
        ssim_weight: 0.2,
    };
    let twin = view_gradients(&Gaussians64::from(&scene.model), &input, &RasterRules::HARD);
    let v_image = twin.loss.v_rgb.iter().map(|v| [v[0] as f32, v[1] as f32, v[2] as f32, 0.0]).collect();
    let v = ImageGradients { image: v_image, range: vec![0.0; view.pixels()] };
    view.backward(&v, &gradients_only());
    let kernel = view.parameter_gradients();
    for (kind, from, to) in KINDS {
        let to = to.min(kernel.parameters());
        let (mut difference, mut length) = (0.0, 0.0);
        for index in 0..kernel.len() {
            length += norm(&twin.v_model, index, from, to).powi(2);
            difference += (from..to)
                .map(|p| (kernel.parameter(index, p) - twin.v_model.parameter(index, p)).powi(2))
                .sum::<f64>();
        }
        // One pixel more or less at the rim of a splat, at 1/255, changes less than a thousandth. A wrong
        // formula changes more.
        let share = (difference / length).sqrt();
        assert!(length > 0.0 && share < 1e-3, "{kind}: the gradients differ by {share:e} of their length");
    }
}
