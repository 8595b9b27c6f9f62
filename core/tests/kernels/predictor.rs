//! WaterParamPredict in a run: its effect on the water, which depends on nothing but the iteration.

use std::sync::Arc;

use fathom_core::config::{Blend, Medium, NetworkConfig, NetworkStart, WaterConfig, WaterPrior};
use fathom_core::gpu::{Blocks, Frame, Recorder};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::{DeviceMedium, NetworkRun, TrainRun, Trainer, WaterStep};
use fathom_core::views::InMemory;
use fathom_core::water::WaterRecord;
use fathom_twins::{Blended, WaterState, form_backward};

use crate::device::{assert_same_bits, device, layouts, storage};
use crate::trainer::{assert_same_model, banded, config, photographs, same_however_it_runs};
use crate::water::{WATER, gradients_of, medium_run, watery, with};

const PER_GAUSSIAN: (Medium, Blend) = (Medium::PerGaussian, Blend::Srgb);
const PER_PIXEL: (Medium, Blend) = (Medium::PerPixel, Blend::Linear);
/// The network sets the water in the first 11 of 24 iterations. With a cadence of 3, predictions start at 3,
/// 6 and 9; those of 3 and 6 take effect at 6 and 9.
const ITERATIONS: u32 = 24;
const END: u32 = 11;

fn every(every: u32, depth_gradient: bool) -> NetworkConfig {
    NetworkConfig {
        width: 16,
        height: 16,
        until: END as f32 / ITERATIONS as f32,
        learning_rate: 1e-3,
        every,
        depth_gradient,
        ..NetworkConfig::default()
    }
}

/// A run whose water comes from the network at first.
fn predicted(photographs: &InMemory, composed: (Medium, Blend), network: NetworkConfig) -> TrainRun {
    let water = WaterConfig { prior: WaterPrior::Network, network, ..with(composed) };
    let mut run = watery(photographs, config(ITERATIONS), water);
    let medium = run.medium.as_mut().unwrap();
    medium.network = Some(NetworkRun::default());
    medium.source = "network";
    run
}

/// The modes of prediction: on a thread with either medium, and within the iteration.
fn modes() -> [((Medium, Blend), NetworkConfig); 3] {
    [(PER_GAUSSIAN, every(3, false)), (PER_PIXEL, every(4, false)), (PER_PIXEL, every(0, true))]
}

fn record_of(trainer: &Trainer) -> WaterRecord {
    trainer.water_record(1.0).unwrap().unwrap()
}

#[test]
fn a_prediction_becomes_the_water_one_cadence_later() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let mut trainer =
        Trainer::new(Arc::clone(&gpu), predicted(&photographs, PER_GAUSSIAN, every(3, false))).unwrap();
    let mut waters = vec![trainer.water().unwrap().unwrap()];
    for _ in 0..END {
        trainer.advance(1).unwrap();
        waters.push(trainer.water().unwrap().unwrap());
    }
    let changes: Vec<usize> = (1..waters.len()).filter(|&at| waters[at] != waters[at - 1]).collect();
    assert_eq!(changes, [6, 9, 11], "the first prediction starts at 3");
    for (water, what) in waters.iter().zip(0..) {
        assert!(water.is_physical(), "{what}: {water:?}");
        for (k, (now, start)) in water.to_array().iter().zip(waters[0].to_array()).enumerate() {
            assert!((now / start - 1.0).abs() < 0.5, "{what}, {k}: {now} must stay near the start, {start}");
        }
    }
}

#[test]
fn timing_interruptions_lists_and_bands_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let [on_a_thread, _, at_once] = modes();
    for (composed, network) in [on_a_thread, at_once] {
        let new = || predicted(&photographs, composed, network.clone());
        let learnt = |trainer: &mut Trainer| (record_of(trainer), trainer.checkpoint().unwrap());
        let what = format!("{composed:?}, every {}", network.every);
        // Every iteration of two cadences, with pending predictions, and across the end of the network's
        // part.
        same_however_it_runs(&gpu, &what, new, 3..13, banded(&gpu), learnt);
    }
}

#[test]
fn descent_starts_afresh_from_the_last_predicted_water() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    for (composed, network) in modes() {
        let what = format!("{composed:?}, every {}", network.every);
        let new = |until: f32| {
            let mut run = predicted(&photographs, composed, network.clone());
            run.medium.as_mut().unwrap().config.freeze_at = until;
            run
        };
        // Without descent, the last prediction is final.
        let mut predicted_only = Trainer::new(Arc::clone(&gpu), new(network.until)).unwrap();
        predicted_only.advance(END).unwrap();
        let decided = record_of(&predicted_only);
        assert_eq!(decided.source, "network", "{what}");
        // No sparse points support it, and agreement between views gives no error estimate.
        assert_eq!(decided.standard_error.to_array(), [f64::INFINITY; 9], "{what}");
        predicted_only.advance(ITERATIONS).unwrap();
        assert_eq!(record_of(&predicted_only), decided, "{what}: the water must stay");

        let mut descends = Trainer::new(Arc::clone(&gpu), new(0.667)).unwrap();
        descends.advance(END).unwrap();
        let before = record_of(&descends);
        assert_eq!((before.water(), before.source.as_str()), (decided.water(), "descended"), "{what}");
        descends.advance(1).unwrap();
        let after = record_of(&descends);
        assert_eq!(after.standard_error, before.standard_error);
        // Adam's first step equals its rate at any gradient, so no earlier moments remain.
        let rate = f64::from(WaterConfig::default().lr);
        let raw = |record: &WaterRecord| record.water().to_raw(3.2);
        for (k, (after, before)) in raw(&after).iter().zip(raw(&before)).enumerate() {
            let step = (after - before).abs();
            assert!((step / rate - 1.0).abs() < 1e-2, "{what}: {k} took a step of {step}");
        }
    }
}

#[test]
fn gathered_gradients_are_the_twins_sums_over_sound_iterations() {
    let decay = 1e-3;
    for gpu in layouts() {
        let mut frame = Frame::new(&gpu, 1, 1, 1).unwrap();
        frame.prepare_targets(&gpu, [8, 8]).unwrap();
        let blocks = Blocks::new(&gpu, 0).unwrap();
        let run =
            medium_run(WaterConfig { l2_weight: decay, surface_alpha_weight: 0.0, ..with(PER_PIXEL) }, WATER);
        let mut water = DeviceMedium::new(&gpu, run).unwrap();
        water.give_to(&gpu, &frame);
        water.prepare(&gpu, [8, 8], 1, 1).unwrap();
        let before = water.water(&gpu, &frame).unwrap();
        let truth = storage(&gpu, &[0xff00_0000_u32; 64]);
        let zeros = storage(&gpu, &[0.0_f32; 64]);
        let u = |i: u32, j: u32| uniform_at(501, Stream::Test, i, j);
        let image: Vec<[f32; 4]> = (0..64).map(|i| [u(i, 0), u(i, 1), u(i, 2), 1.0]).collect();
        let range: Vec<f32> = (0..64).map(|i| 0.5 + 6.0 * u(i, 3)).collect();
        let targets = frame.targets().unwrap();
        gpu.write(&targets.image, 0, &image);
        gpu.write(&targets.range_image, 0, &range);
        let state = WaterState::new(&WATER, 3.2);
        let mut expected = [0.0; 9];
        for iteration in 0..4 {
            // One of the gradients is not finite and is left out.
            let bad = iteration == 2;
            let v: Vec<[f32; 4]> = (0..64)
                .map(|i| {
                    [0, 1, 2, 3].map(|c| if bad { f32::NAN } else { u(i, 10 + 4 * iteration + c) - 0.4 })
                })
                .collect();
            let v_image = storage(&gpu, &v);
            let step = WaterStep {
                size: [8, 8],
                has_surfaces: true,
                gathers: true,
                terms: 1.0,
                ..WaterStep::default()
            };
            let mut recorder = Recorder::new(&gpu);
            water.record(&gpu, &mut recorder, &frame, step, 1, 1).unwrap();
            water
                .record_backward(&gpu, &mut recorder, &frame, &truth, None, step, [&v_image, &zeros])
                .unwrap();
            water.record_gradients(&gpu, &mut recorder, gradients_of(&frame, &blocks, &zeros)).unwrap();
            water.record_step(&mut recorder, &frame).unwrap();
            recorder.submit();
            if bad {
                continue;
            }
            let mut v_water = [0.0; 9];
            for i in 0..64 {
                let [r, g, b, alpha] = image[i].map(f64::from);
                let pixel = Blended { rgb: [r, g, b], alpha, range: f64::from(range[i]) };
                let light = fathom_twins::form(&WATER, Medium::PerPixel, Blend::Linear, &pixel);
                let by: [f64; 3] =
                    std::array::from_fn(|c| f64::from(v[i][c]) * fathom_twins::encode(light[c]).1);
                form_backward(&WATER, Medium::PerPixel, Blend::Linear, &pixel, by, &mut v_water);
            }
            let v_raw = state.v_raw(&v_water, 3.2, f64::from(decay));
            expected.iter_mut().zip(v_raw).for_each(|(sum, v)| *sum += v);
        }
        let gathered = water.take_gathered(&gpu).unwrap();
        assert_eq!(gathered.iterations, 3);
        assert_eq!(water.steps_left_out(&gpu).unwrap(), 1);
        let size = expected.iter().map(|v| v.abs()).fold(0.0, f64::max);
        for (k, (found, expected)) in gathered.v_raw.iter().zip(expected).enumerate() {
            // Three sums of 64 numbers, in f32.
            assert!((f64::from(*found) - expected).abs() < 1e-5 * size, "{k}: {found} and {expected}");
        }
        let empty = water.take_gathered(&gpu).unwrap();
        assert_eq!((empty.v_raw, empty.iterations), ([0.0; 9], 0), "the sums must be reset");
        assert_same_bits(
            "the water must stay",
            &before.to_array(),
            &water.water(&gpu, &frame).unwrap().to_array(),
        );
    }
}

#[test]
fn the_depth_gradient_moves_gaussians_only_when_it_is_on() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let means = |depth_gradient: bool| {
        let run = predicted(&photographs, PER_PIXEL, every(0, depth_gradient));
        let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
        trainer.advance(1).unwrap();
        (trainer.water().unwrap(), trainer.gaussians().unwrap().means)
    };
    let (with, without) = (means(true), means(false));
    assert_eq!(with.0, without.0, "the first prediction must be the same");
    assert_ne!(with.1, without.1);
    assert_eq!(with.1, means(true).1);
}

#[test]
fn a_frozen_water_ignores_the_network() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let train = |network: bool| {
        let mut run = predicted(&photographs, PER_GAUSSIAN, every(3, false));
        let medium = run.medium.as_mut().unwrap();
        medium.is_free = false;
        medium.network = medium.network.filter(|_| network);
        let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
        let before = trainer.water().unwrap();
        trainer.advance(ITERATIONS).unwrap();
        assert_eq!(trainer.water().unwrap(), before);
        (trainer.gaussians().unwrap(), trainer.checkpoint().unwrap().len())
    };
    let ((with, bytes), (without, fewest)) = (train(true), train(false));
    assert_same_model("with a network that is not used", &with, &without);
    assert_eq!(bytes, fewest, "a checkpoint must not contain the network");
}

#[test]
fn a_diverged_network_leaves_a_sound_water_of_unknown_error() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    for (composed, network) in modes() {
        let network = NetworkConfig { learning_rate: 1e30, ..network };
        let mut run = predicted(&photographs, composed, network.clone());
        run.medium.as_mut().unwrap().config.freeze_at = network.until;
        let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
        trainer.advance(ITERATIONS).unwrap();
        let record = record_of(&trainer);
        let what = format!("{composed:?}, every {}: {record:?}", network.every);
        assert!(record.water().is_physical(), "{what}");
        assert_eq!(record.standard_error.to_array(), [f64::INFINITY; 9], "{what}");
        assert!(trainer.gaussians().unwrap().means.iter().flatten().all(|value| value.is_finite()), "{what}");
    }
}

#[test]
fn a_checkpoint_of_another_network_is_refused() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let run = |channels: u32, start: NetworkStart| {
        let network = NetworkConfig { channels, start, ..every(3, false) };
        predicted(&photographs, PER_GAUSSIAN, network)
    };
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(8, NetworkStart::Sparse)).unwrap();
    trainer.advance(5).unwrap();
    let checkpoint = trainer.checkpoint().unwrap();
    assert!(Trainer::resume(Arc::clone(&gpu), run(8, NetworkStart::Sparse), &checkpoint).is_ok());
    for other in [run(16, NetworkStart::Sparse), run(8, NetworkStart::Fixed)] {
        let error = Trainer::resume(Arc::clone(&gpu), other, &checkpoint).err().unwrap();
        assert!(error.to_string().contains("another run"), "{error}");
    }
    let impossible = run(9, NetworkStart::Sparse);
    let error = Trainer::new(Arc::clone(&gpu), impossible).err().unwrap();
    assert!(error.to_string().contains("9 channels"), "{error}");
}
