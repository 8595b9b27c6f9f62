//! Exposures of the training views: kernels against the twin, and their effect on a run.

use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::gpu::{Recorder, counter};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::{ExposureStep, Exposures, Trainer};
use fathom_core::views::InMemory;
use fathom_twins::{Exposure, ExposureState};

use crate::device::{assert_same_bits, device, layouts, poison, storage};
use crate::trainer::{
    assert_same_model, banded, config, mean_psnr, photographs, photographs_from, run, same_however_it_runs,
    truth,
};

/// `[pixels]` vec4 of noise between `low` and `low + 1`.
fn noise(seed: u32, pixels: u32, low: f32) -> Vec<[f32; 4]> {
    let u = |i, c| low + uniform_at(seed, Stream::Test, i, c);
    (0..pixels).map(|i| [u(i, 0), u(i, 1), u(i, 2), u(i, 3)]).collect()
}

fn wide(pixels: &[[f32; 4]]) -> Vec<[f64; 3]> {
    pixels.iter().map(|p| [p[0], p[1], p[2]].map(f64::from)).collect()
}

#[track_caller]
fn assert_near(what: &str, kernel: &[[f32; 4]], twin: &[[f64; 3]], tolerance: f64) {
    for (i, (kernel, twin)) in kernel.iter().zip(twin).enumerate() {
        for c in 0..3 {
            let (kernel, twin) = (f64::from(kernel[c]), twin[c]);
            assert!(
                (kernel - twin).abs() <= tolerance,
                "{what}, pixel {i}, channel {c}: {kernel} and {twin}"
            );
        }
    }
}

#[test]
fn colours_gradients_and_steps_of_any_size_match_the_twin() {
    const VIEWS: u32 = 5;
    for gpu in layouts() {
        let mut exposures = Exposures::new(&gpu, VIEWS).unwrap();
        let mut twin = ExposureState::new(VIEWS as usize);
        let mut seen = [0; VIEWS as usize];
        let counters = storage(&gpu, &[0_u32; counter::COUNT as usize]);
        // One pixel, sizes around the 1024 of a workgroup, many workgroups, and a small size after a large
        // one.
        let sizes = [(1, 1), (17, 1), (33, 31), (32, 32), (1025, 1), (75, 53), (300, 300), (9, 100)];
        for (k, (width, height)) in sizes.into_iter().enumerate() {
            let (pixels, view) = (width * height, (3 * k as u32) % VIEWS);
            let what = format!("{width}x{height}");
            let (render, v_exposed) =
                (noise(200 + k as u32, pixels, -0.2), noise(220 + k as u32, pixels, -0.4));
            let (image, v_image) = (storage(&gpu, &render), storage(&gpu, &v_exposed));
            exposures.prepare(&gpu, [width, height]).unwrap();
            for buffer in exposures.scratch().unwrap() {
                poison(&gpu, buffer);
            }
            seen[view as usize] += 1;
            let step = ExposureStep { view, steps: seen[view as usize], rate: 0.05, size: [width, height] };
            let mut recorder = Recorder::new(&gpu);
            let exposed = exposures.record(&gpu, &mut recorder, &image, step).unwrap();
            exposures.record_backward(&mut recorder, &image, &v_image, &counters, step.size).unwrap();
            recorder.submit();
            let exposed: Vec<[f32; 4]> = gpu.read(exposed, 0, pixels as usize).unwrap();
            let v_rendered: Vec<[f32; 4]> = gpu.read(&v_image, 0, pixels as usize).unwrap();

            let exposure = twin.exposures[view as usize];
            // 1e-5: three products of numbers near 1, with an exposure that is accurate to 1e-6 (see below).
            assert_near(&what, &exposed, &fathom_twins::expose(&wide(&render), &exposure), 1e-5);
            let (v_rgb, v_exposure) =
                fathom_twins::expose_backward(&wide(&render), &wide(&v_exposed), &exposure);
            assert_near(&format!("{what}, gradient"), &v_rendered, &v_rgb, 1e-5);
            assert!(exposed.iter().zip(&render).all(|(a, b)| a[3] == b[3]), "{what}: alpha must not change");
            assert!(
                v_rendered.iter().zip(&v_exposed).all(|(a, b)| a[3] == b[3]),
                "{what}: the gradient of alpha must not change"
            );

            twin.step(view as usize, &v_exposure, 0.05);
            let after = exposures.download(&gpu).unwrap();
            for (v, (kernel, twin)) in after.iter().zip(&twin.exposures).enumerate() {
                for (kernel, twin) in kernel.iter().flatten().zip(twin.iter().flatten()) {
                    // Sums of up to 1e5 numbers of similar size are accurate to 1e-6 of that size; a step is
                    // at most 0.2.
                    assert!(
                        (f64::from(*kernel) - twin).abs() < 2e-6,
                        "{what}: exposure of view {v}: {kernel}, twin {twin}"
                    );
                }
            }
        }
    }
}

#[test]
fn nothing_steps_while_a_list_is_too_short() {
    for gpu in layouts() {
        let mut exposures = Exposures::new(&gpu, 3).unwrap();
        exposures.prepare(&gpu, [20, 10]).unwrap();
        let (image, v_image) = (storage(&gpu, &noise(1, 200, 0.0)), storage(&gpu, &noise(2, 200, 0.0)));
        let mut short = [0_u32; counter::COUNT as usize];
        short[counter::OVERFLOW as usize] = 2;
        let bits = |exposures: &Exposures| -> Vec<Vec<u8>> {
            exposures.arrays().map(|(buffer, length)| gpu.read(buffer, 0, length).unwrap()).to_vec()
        };
        let before = bits(&exposures);
        for (counters, changes) in [(short, false), ([0; counter::COUNT as usize], true)] {
            let counters = storage(&gpu, &counters);
            let step = ExposureStep { view: 1, steps: 1, rate: 0.1, size: [20, 10] };
            let mut recorder = Recorder::new(&gpu);
            exposures.record(&gpu, &mut recorder, &image, step).unwrap();
            exposures.record_backward(&mut recorder, &image, &v_image, &counters, step.size).unwrap();
            recorder.submit();
            assert_eq!(bits(&exposures) != before, changes);
        }
    }
}

fn exposed(iterations: u32) -> TrainConfig {
    TrainConfig { exposure: true, ..config(iterations) }
}

/// The same photographs with photograph i scaled by `gain(i)`.
pub fn darkened(photographs: &InMemory, gain: impl Fn(usize) -> f32) -> InMemory {
    let mut photographs = photographs.clone();
    for (i, image) in photographs.images.iter_mut().enumerate() {
        for pixel in &mut Arc::make_mut(image).pixels {
            let [r, g, b, mask] = pixel.to_le_bytes();
            let [r, g, b] = [r, g, b].map(|value| (gain(i) * f32::from(value)).round() as u8);
            *pixel = u32::from_le_bytes([r, g, b, mask]);
        }
    }
    photographs
}

#[test]
fn views_of_two_exposures_give_a_model_of_their_mean_exposure() {
    let Some(gpu) = device() else { return };
    let turns = |first: f64| -> Vec<f64> { (0..8).map(|i| first + 0.25 * f64::from(i)).collect() };
    let photographs = photographs_from(&gpu, &truth(), 64, 48, &turns(-0.9));
    // Photographs alternate between the exposures 0.6 and 1. Held-out views lie between them and have the
    // mean exposure.
    let seen = darkened(&photographs, |i| if i % 2 == 0 { 0.6 } else { 1.0 });
    let held_out = darkened(&photographs_from(&gpu, &truth(), 64, 48, &turns(-0.775)), |_| 0.8);
    let trained = |config: TrainConfig| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&seen, config)).unwrap();
        trainer.advance(320).unwrap();
        let psnr = mean_psnr(&gpu, &trainer.gaussians().unwrap(), &held_out);
        (trainer.progress().loss, psnr, trainer.exposures().unwrap())
    };
    let (loss, psnr, exposures) = trained(exposed(320));
    let (plain_loss, plain_psnr, none) = trained(config(320));
    assert!(none.is_empty());
    // Measured: 0.011 against 0.058, 37.4 dB against 32.6 dB.
    assert!(loss < 0.4 * plain_loss, "loss {loss} with exposures, {plain_loss} without");
    assert!(psnr > plain_psnr + 3.0, "held out: {psnr:.2} dB with exposures, {plain_psnr:.2} dB without");
    // Each exposure applied to a grey of 0.5.
    let of_grey =
        |rows: &[[f32; 4]; 3]| rows.iter().map(|r| 0.5 * (r[0] + r[1] + r[2]) + r[3]).sum::<f32>() / 3.0;
    let greys: Vec<f32> = exposures.iter().map(of_grey).collect();
    let mean = greys.iter().sum::<f32>() / 8.0;
    assert!((mean - 0.5).abs() < 1e-4, "the mean exposure changes grey to {mean}");
    for pair in greys.chunks(2) {
        let ratio = pair[0] / pair[1];
        assert!((ratio - 0.6).abs() < 0.12, "grey under the exposures: {greys:?}");
    }
}

#[test]
fn exposures_that_do_not_learn_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let trained = |config: TrainConfig| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, config)).unwrap();
        trainer.advance(24).unwrap();
        trainer.gaussians().unwrap()
    };
    let still = TrainConfig { exposure_lr: 0.0, exposure_lr_end: 0.0, ..exposed(24) };
    assert_same_model("a rate of 0", &trained(config(24)), &trained(still));
    assert_ne!(
        trained(config(24)).means,
        trained(exposed(24)).means,
        "exposures that learn must change the model"
    );
}

#[test]
fn interruptions_short_lists_and_bands_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = darkened(&photographs(&gpu, 64, 48), |i| 1.0 - 0.1 * i as f32);
    let new = || run(&photographs, exposed(30));
    let learnt =
        |trainer: &mut Trainer| bytemuck::cast_slice::<_, u32>(&trainer.exposures().unwrap()).to_vec();
    same_however_it_runs(&gpu, "exposures", new, [0, 1, 13], banded(&gpu), learnt);
}

#[test]
fn a_masked_pixel_changes_no_exposure() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let trained = |colour: u32| {
        let mut photographs = photographs.clone();
        for image in &mut photographs.images {
            for (i, pixel) in Arc::make_mut(image).pixels.iter_mut().enumerate() {
                if i % 48 < 20 {
                    *pixel = colour;
                }
            }
        }
        let mut trainer = Trainer::new(Arc::clone(&gpu), run(&photographs, exposed(12))).unwrap();
        trainer.advance(12).unwrap();
        trainer.exposures().unwrap()
    };
    let identity: Exposure = fathom_twins::IDENTITY;
    let black = trained(0);
    assert_same_bits("exposures", &black, &trained(0x00FF_20FF));
    assert!(
        black
            .iter()
            .flatten()
            .flatten()
            .map(|v| f64::from(*v))
            .ne(std::iter::repeat_n(identity, 6).flatten().flatten())
    );
}
