//! Several optimiser steps on the device against the twin, with the same gradients.

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Blocks, StepUniform};
use fathom_core::rng::{Stream, random_bits};
use fathom_twins::{AdamState, Gaussians64, LearningRates, adam, adam_compact, lr_scale, samples};

use crate::device::{assert_same_bits, device, poison};
use crate::view::{ImageGradients, Scene, View, gradients_only};

type Twin = fn(&mut Gaussians64, &Gaussians64, &mut AdamState, &[bool], &LearningRates);

const RATES: LearningRates = LearningRates {
    means: 1e-3,
    quats: 2e-3,
    log_scales: 5e-3,
    opacity_logits: 2e-2,
    sh_dc: 1e-2,
    sh_rest: 5e-4,
};

fn step() -> StepUniform {
    let r = RATES;
    let [means, quats, scales, opacity, dc, rest] =
        [r.means, r.quats, r.log_scales, r.opacity_logits, r.sh_dc, r.sh_rest].map(|v| v as f32);
    StepUniform {
        means_lr: means,
        quats_lr: quats,
        scales_lr: scales,
        opacity_lr: opacity,
        sh_dc_lr: dc,
        sh_rest_lr: rest,
        ..StepUniform::default()
    }
}

fn opacity(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}

/// Raw gradients of a model in the view of `scene`, and which Gaussians are visible.
fn gradients(
    gpu: &std::sync::Arc<fathom_core::gpu::Gpu>,
    scene: &Scene,
    v: &ImageGradients,
) -> (Gaussians64, Vec<bool>) {
    let view = View::render(gpu, scene);
    view.backward(v, &gradients_only());
    let mut seen = vec![false; scene.model.len()];
    view.tile_lists().iter().flatten().for_each(|&id| seen[id] = true);
    (view.parameter_gradients(), seen)
}

/// Takes `count` steps on the device; before each, the twin gets the gradients of the device.
fn compare(
    name: &str,
    scene: &Scene,
    step: &StepUniform,
    count: u32,
    regularise: impl Fn(&Gaussians64, &mut Gaussians64, usize, &[bool]),
) {
    compare_at_least(name, scene, step, count, 1000, regularise);
}

/// The same; more than `least` numbers must have been compared.
fn compare_at_least(
    name: &str,
    scene: &Scene,
    step: &StepUniform,
    count: u32,
    least: usize,
    regularise: impl Fn(&Gaussians64, &mut Gaussians64, usize, &[bool]),
) {
    for moments in [Moments::Compact, Moments::F32] {
        compare_kind(&format!("{name}, {moments:?}"), scene, step, count, least, moments, &regularise);
    }
}

fn compare_kind(
    name: &str,
    scene: &Scene,
    step: &StepUniform,
    count: u32,
    least: usize,
    moments: Moments,
    regularise: impl Fn(&Gaussians64, &mut Gaussians64, usize, &[bool]),
) {
    let Some(gpu) = device() else { return };
    let mut view = View::render_with(&gpu, scene, moments);
    // Rubbish that no Gaussian may read before its first step.
    let (_, _, training) = view.blocks.trainable().next().unwrap();
    poison(&gpu, &training.moments);
    poison(&gpu, &training.sh_moments);
    let (twin, of_a_step) = match moments {
        Moments::F32 => (adam as Twin, 1e-3),
        // Logarithms in 16 bits: half a level is 0.14 % of a first moment and 0.07 % of the root of a second.
        Moments::Compact => (adam_compact as Twin, 4e-3),
    };
    let mut model = Gaussians64::from(&scene.model);
    let mut state = AdamState::new(model.len(), model.sh_degree);
    let mut unseen = vec![true; model.len()];
    let mut compared = 0;
    for n in 0..count {
        let v = ImageGradients::random(130 + n, view.pixels());
        let now = Scene { model: view.blocks.download(&gpu).unwrap(), ..scene.clone() };
        let (mut v_model, seen) = gradients(&gpu, &now, &v);
        unseen.iter_mut().zip(&seen).for_each(|(unseen, seen)| *unseen &= !seen);
        regularise(&Gaussians64::from(&now.model), &mut v_model, view.visible().len(), &seen);
        let lr_scale = if step.trainable > 0 { lr_scale(model.len(), view.visible().len()) } else { 1.0 };
        let rates = RATES.scaled(lr_scale);
        twin(&mut model, &v_model, &mut state, &seen, &rates);
        view.backward(&v, step);
        let kernel = Gaussians64::from(&view.blocks.download(&gpu).unwrap());
        for index in (0..kernel.len()).filter(|&index| seen[index]) {
            for parameter in 0..kernel.parameters() {
                let (kernel, twin) = (kernel.parameter(index, parameter), model.parameter(index, parameter));
                // Per step, a share of the step, because the correction 1 - beta^t is computed in f32. Plus
                // half a spacing of the parameter itself.
                let tolerance =
                    f64::from(n + 1) * (of_a_step * rates.of_parameter(parameter) + 6e-8 * twin.abs());
                assert!(
                    (kernel - twin).abs() <= tolerance,
                    "{name}, step {n}: {} of {index}: kernel {kernel}, twin {twin}, difference {:e}, tolerance {tolerance:e}",
                    Gaussians64::parameter_name(parameter),
                    (kernel - twin).abs()
                );
                compared += 1;
            }
        }
        view.forward();
    }
    assert!(compared > least, "{name}: {compared} compared");
    let after = view.blocks.download(&gpu).unwrap();
    assert!(unseen.iter().any(|&unseen| unseen), "{name}: some Gaussian must be out of sight");
    for index in (0..unseen.len()).filter(|&index| unseen[index]) {
        assert_same_bits(
            &format!("{name}: mean of {index}, which no view saw"),
            &scene.model.means[index],
            &after.means[index],
        );
        let k = after.coeffs();
        let coefficients = |m: &Gaussians| m.sh_coeffs[index * k..(index + 1) * k].to_vec();
        assert_same_bits(
            "coefficients of the same Gaussian",
            &coefficients(&scene.model),
            &coefficients(&after),
        );
    }
}

fn scene(degree: u8) -> Scene {
    let mut scene = Scene::new("steps", samples::random(131, 120, degree), 50, 37);
    scene.model.means[7] = [0.0, 0.0, -60.0];
    scene
}

#[test]
fn six_steps_match_the_twin() {
    for degree in [0, 1, 2, 3] {
        compare(&format!("degree {degree}"), &scene(degree), &step(), 6, |_, _, _, _| {});
    }
}

#[test]
fn a_view_of_few_gaussians_takes_the_longer_steps_of_the_twin() {
    let mut scene = scene(1);
    // Nine of ten Gaussians are behind the camera, so the factor is about sqrt(10). Scales and higher
    // harmonics keep their rates.
    scene.model.means.iter_mut().enumerate().filter(|(i, _)| i % 10 != 0).for_each(|(_, m)| m[2] = -60.0);
    let trainable = scene.model.len() as u32;
    let step = StepUniform { trainable, ..step() };
    if let Some(gpu) = device() {
        let seen = View::render(&gpu, &scene).visible().len();
        assert!((2.0..5.0).contains(&lr_scale(scene.model.len(), seen)), "{seen} are seen");
    }
    compare_at_least("longer steps", &scene, &step, 6, 300, |_, _, _, _| {});
}

#[test]
fn weights_on_opacity_and_scale_are_divided_by_the_visible() {
    let weights = (0.3, 0.7);
    let mut step = step();
    step.opacity_reg = weights.0 as f32;
    step.scale_reg = weights.1 as f32;
    compare("regularised", &scene(1), &step, 4, |model, v, visible, seen| {
        for index in (0..model.len()).filter(|&index| seen[index]) {
            let o = opacity(model.opacity_logits[index]);
            v.opacity_logits[index] += weights.0 / visible as f64 * o * (1.0 - o);
            for k in 0..3 {
                v.log_scales[index][k] +=
                    weights.1 / (3.0 * visible as f64) * model.log_scales[index][k].exp();
            }
        }
    });
}

#[test]
fn a_gaussian_under_masked_pixels_alone_stays_unchanged() {
    let Some(gpu) = device() else { return };
    let scene = scene(1);
    let mut step = StepUniform { mean_noise: 0.02, ..step() };
    (step.opacity_reg, step.scale_reg) = (0.3, 0.7);
    let view = View::render(&gpu, &scene);
    // Gradients as under a mask: only the first columns count.
    let mut v = ImageGradients::random(4, view.pixels());
    for (i, pixel) in v.image.iter_mut().enumerate().filter(|(i, _)| i % 50 >= 8) {
        *pixel = [0.0; 4];
        v.range[i] = 0.0;
    }
    let before = view.blocks.download(&gpu).unwrap();
    view.backward(&v, &step);
    let after = view.blocks.download(&gpu).unwrap();
    let moved =
        |i: usize| before.means[i] != after.means[i] || before.opacity_logits[i] != after.opacity_logits[i];
    let tiles: Vec<Vec<usize>> = view.tile_lists();
    let columns = 50_usize.div_ceil(gpu.tile() as usize);
    let touches = |counted: bool| {
        let side = gpu.tile() as usize;
        let mut seen = vec![false; before.len()];
        tiles
            .iter()
            .enumerate()
            .filter(|(tile, _)| if counted { tile % columns * side < 8 } else { true })
            .flat_map(|(_, list)| list)
            .for_each(|&id| seen[id] = true);
        seen
    };
    let (counted, seen) = (touches(true), touches(false));
    let away: Vec<usize> = (0..before.len()).filter(|&i| seen[i] && !counted[i]).collect();
    assert!(away.len() > 5, "{} Gaussians are only in masked tiles", away.len());
    assert!(away.iter().all(|&i| !moved(i)), "a Gaussian without a gradient moved");
    assert!((0..before.len()).filter(|&i| moved(i)).count() > 20);
}

/// The means of a model after one step.
fn means_after(scene: &Scene, blocks: Blocks, step: &StepUniform) -> Vec<[f32; 3]> {
    let gpu = device().unwrap();
    let view = View::render_blocks(&gpu, scene, blocks);
    view.backward(&ImageGradients::random(3, view.pixels()), step);
    view.blocks.download(&gpu).unwrap().means
}

#[test]
fn noise_on_faint_gaussians_matches_the_twin_in_any_blocks() {
    let Some(gpu) = device() else { return };
    // Opacities from 1/255 to 0.02, around the gate at 0.005. Rates of 0, so that only noise moves means.
    let mut scene = scene(0);
    let n = scene.model.len();
    scene
        .model
        .opacity_logits
        .iter_mut()
        .enumerate()
        .for_each(|(i, logit)| *logit = -5.5 + 1.6 * i as f32 / n as f32);
    let step = StepUniform { mean_noise: 0.02, seed: 5, ..StepUniform::default() };
    let one = |n: usize| {
        let mut blocks = Blocks::new(&gpu, 0).unwrap();
        blocks.push_trainable(&gpu, &scene.model, n as u32, Moments::Compact).unwrap();
        blocks
    };
    let whole = means_after(&scene, one(n), &step);
    let mut moved = 0;
    let (v_model, _) = gradients(&gpu, &scene, &ImageGradients::random(3, 50 * 37));
    for (id, after) in whole.iter().enumerate() {
        // A Gaussian that is too faint for any pixel has no gradient and stays.
        if (11..14).all(|parameter| v_model.parameter(id, parameter) == 0.0) {
            assert_eq!(*after, scene.model.means[id]);
            continue;
        }
        let model = Gaussians64::from(&scene.model);
        let uniform = |bits: u32| (f64::from(bits >> 8) + 1.0) / 16_777_216.0;
        let bits = random_bits(5, Stream::MeanNoise, id as u32, 0);
        let bits2 = random_bits(5, Stream::MeanNoise, id as u32, u32::MAX);
        let radius = |bits: u32| (-2.0 * uniform(bits).ln()).sqrt();
        let turn = |bits: u32| std::f64::consts::TAU * uniform(bits);
        let normal = glam::DVec3::new(
            radius(bits[0]) * turn(bits[1]).cos(),
            radius(bits[0]) * turn(bits[1]).sin(),
            radius(bits2[0]) * turn(bits2[1]).cos(),
        );
        let [w, x, y, z] = model.quats[id];
        let rotation = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w).normalize());
        let deviations = glam::DVec3::from(model.log_scales[id].map(f64::exp));
        let shaped = rotation * (deviations * normal);
        let gate = 1.0 / (1.0 + (-100.0 * (0.005 - opacity(model.opacity_logits[id]))).exp());
        for k in 0..3 {
            let expected = model.means[id][k] + gate * 0.02 * shaped[k];
            let after = f64::from(after[k]);
            // 1e-6: about ten operations on numbers near 1; the noise itself is about 0.01.
            assert!((after - expected).abs() < 1e-6, "mean[{k}] of {id}: kernel {after}, twin {expected}");
            moved += usize::from((after - model.means[id][k]).abs() > 1e-5);
        }
    }
    assert!(moved > 50, "{moved} numbers moved");
    let mut blocks = Blocks::new(&gpu, 0).unwrap();
    let (mut first, mut second) = (Gaussians::empty(0), Gaussians::empty(0));
    (0..n).for_each(|i| if i < 50 { &mut first } else { &mut second }.push_from(&scene.model, i));
    blocks.push_trainable(&gpu, &first, 50, Moments::Compact).unwrap();
    blocks.push_trainable(&gpu, &second, n as u32 - 50, Moments::Compact).unwrap();
    assert_same_bits("means of two blocks", &whole, &means_after(&scene, blocks, &step));
}
