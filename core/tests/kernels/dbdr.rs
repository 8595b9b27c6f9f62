//! DBDR (eq. 9), a water whose coefficients depend on range: kernels against the twin, and its effect on a
//! run.

use std::sync::Arc;

use fathom_core::CoreError;
use fathom_core::config::{Blend, Composition, DbdrConfig, DbdrMode, Medium, WaterConfig};
use fathom_core::gpu::{Blocks, Frame, Gpu, Output, Recorder, Renderer, WaterView, medium};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::{DeviceMedium, MediumRun, Trainer, WaterStep};
use fathom_core::water::{RangeModulation, Water, WaterRecord};
use fathom_twins::{
    Blended, RefinementState, WaterState, encode, form_refined, form_refined_backward, samples,
};

use crate::device::{assert_same_bits, device, layouts, poison, storage};
use crate::trainer::{assert_same_model, banded, config, photographs, same_however_it_runs};
use crate::view::{Scene, View};
use crate::water::{fixed, gradients_of, sunk, watery};

const WATER: Water =
    Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };
const UNIT: f64 = 3.2;
const RATE: f32 = 0.05;

/// A water on pixels with this mode of DBDR.
fn by_pixel(mode: DbdrMode) -> WaterConfig {
    let dbdr = DbdrConfig { mode, lr: RATE, ..DbdrConfig::default() };
    WaterConfig { medium: Medium::PerPixel, blend: Blend::Linear, dbdr, ..WaterConfig::default() }
}

fn medium_run(refinement: Option<RangeModulation>) -> MediumRun {
    MediumRun { water: WATER, refinement, ..fixed(&by_pixel(DbdrMode::Maps), UNIT) }
}

fn some_refinement(seed: u32) -> RangeModulation {
    let u = |k| f64::from(1.6 * uniform_at(seed, Stream::Test, k, 9) - 0.8);
    RangeModulation::identity(2.0, UNIT)
        .with_array([u(0), u(1), u(2), u(3)].map(|value| f64::from(value as f32)))
}

/// The outputs of one iteration of a picture, before and after the step of the water.
struct Outputs {
    seen: Vec<[f32; 4]>,
    v_image: Vec<[f32; 4]>,
    v_range: Vec<f32>,
    v_water: [f64; 9],
    v_refinement: [f64; 4],
    water: Water,
    refinement: Option<RangeModulation>,
    left_out: u32,
}

fn iteration(
    gpu: &Arc<Gpu>,
    start: MediumRun,
    [width, height]: [u32; 2],
    v: &[[f32; 4]],
    seed: u32,
) -> Outputs {
    let (image, range) = picture(width * height, seed);
    let mut water = DeviceMedium::new(gpu, start).unwrap();
    let mut frame = Frame::new(gpu, 1, 1, 1).unwrap();
    frame.prepare_targets(gpu, [width, height]).unwrap();
    water.give_to(gpu, &frame);
    water.prepare(gpu, [width, height], 1, 1).unwrap();
    for buffer in water.scratch().unwrap() {
        poison(gpu, buffer);
    }
    let targets = frame.targets().unwrap();
    gpu.write(&targets.image, 0, &image);
    gpu.write(&targets.range_image, 0, &range);
    let pixels = image.len();
    let truth = storage(gpu, &vec![0_u32; pixels]);
    let (v_image, v_range) = (storage(gpu, v), storage(gpu, &vec![7.0_f32; pixels]));
    let size = [width, height];
    let step = WaterStep {
        size,
        masked: true,
        has_surfaces: true,
        rate: Some(RATE),
        steps: 1,
        terms: 1.0,
        ..WaterStep::default()
    };
    let blocks = Blocks::new(gpu, 0).unwrap();
    let mut recorder = Recorder::new(gpu);
    let seen = water.record(gpu, &mut recorder, &frame, step, 1, 1).unwrap();
    water.record_backward(gpu, &mut recorder, &frame, &truth, None, step, [&v_image, &v_range]).unwrap();
    water.record_gradients(gpu, &mut recorder, gradients_of(&frame, &blocks, &v_range)).unwrap();
    water.record_step(&mut recorder, &frame).unwrap();
    recorder.submit();
    let scratch = water.scratch().unwrap();
    let (partials, refinement_partials) = (scratch[1], scratch[2]);
    let groups = pixels.div_ceil(1024);
    let rows: Vec<[[f32; 4]; 3]> = gpu.read(partials, 0, groups).unwrap();
    let refined: Vec<[f32; 4]> =
        gpu.read(refinement_partials, 0, groups.min(refinement_partials.size() as usize / 16)).unwrap();
    Outputs {
        seen: gpu.read(seen, 0, pixels).unwrap(),
        v_image: gpu.read(&v_image, 0, pixels).unwrap(),
        v_range: gpu.read(&v_range, 0, pixels).unwrap(),
        v_water: std::array::from_fn(|i| rows.iter().map(|row| f64::from(row[i / 3][i % 3])).sum()),
        v_refinement: std::array::from_fn(|i| refined.iter().map(|row| f64::from(row[i])).sum()),
        water: water.water(gpu, &frame).unwrap(),
        refinement: water.refinement(gpu, &frame).unwrap(),
        left_out: water.steps_left_out(gpu).unwrap(),
    }
}

/// Blended colours and their range: empty, thin, partial and opaque pixels.
fn picture(pixels: u32, seed: u32) -> (Vec<[f32; 4]>, Vec<f32>) {
    let u = |i, j| uniform_at(seed, Stream::Test, i, j);
    let alpha = |i: u32| [0.0, 1e-4, u(i, 3), 1.0][(i % 4) as usize];
    let colour = |i: u32| [alpha(i) * u(i, 0), alpha(i) * u(i, 1), alpha(i) * u(i, 2), alpha(i)];
    ((0..pixels).map(colour).collect(), (0..pixels).map(|i| alpha(i) * 9.0 * u(i, 4)).collect())
}

fn gradients(pixels: u32, seed: u32) -> Vec<[f32; 4]> {
    let u = |i, j| uniform_at(seed, Stream::Test, i, j) - 0.5;
    (0..pixels).map(|i| [u(i, 5), u(i, 6), u(i, 7), 0.0]).collect()
}

#[test]
fn pictures_and_gradients_with_dbdr_match_the_twin() {
    for gpu in layouts() {
        for (k, size) in [[1, 1], [33, 31], [32, 32], [75, 53]].into_iter().enumerate() {
            let (seed, pixels) = (400 + k as u32, size[0] * size[1]);
            let refinement = some_refinement(seed);
            let v = gradients(pixels, seed);
            let outputs = iteration(&gpu, medium_run(Some(refinement)), size, &v, seed);
            let (image, range) = picture(pixels, seed);
            let (mut v_water, mut v_refinement) = ([0.0; 9], [0.0; 4]);
            for i in 0..pixels as usize {
                let [r, g, b, alpha] = image[i].map(f64::from);
                let pixel = Blended { rgb: [r, g, b], alpha, range: f64::from(range[i]) };
                let seen = form_refined(&WATER, &refinement, Blend::Linear, &pixel).map(encode);
                let v: [f64; 3] = std::array::from_fn(|c| f64::from(v[i][c]) * seen[c].1);
                let by = form_refined_backward(
                    &WATER,
                    &refinement,
                    Blend::Linear,
                    &pixel,
                    v,
                    &mut v_water,
                    &mut v_refinement,
                );
                for c in 0..3 {
                    // 2e-6 and 1e-5, as for a water without DBDR.
                    let (kernel, twin) = (f64::from(outputs.seen[i][c]), seen[c].0);
                    assert!((kernel - twin).abs() < 2e-6, "{size:?}: pixel {i}, {c}: {kernel} and {twin}");
                    let (kernel, twin) = (f64::from(outputs.v_image[i][c]), by.rgb[c]);
                    let close = (kernel - twin).abs() < 1e-5 * (1.0 + twin.abs());
                    assert!(close, "{size:?}: gradient of pixel {i}, {c}: {kernel} and {twin}");
                }
                let scale = 1.0 + by.alpha.abs() + by.range.abs();
                // Every photograph is masked, so no loss term on alpha adds a gradient.
                let (kernel, twin) = (f64::from(outputs.v_image[i][3]), by.alpha);
                assert!((kernel - twin).abs() < 2e-5 * scale, "{size:?}: alpha of {i}: {kernel} and {twin}");
                let (kernel, twin) = (f64::from(outputs.v_range[i]), by.range);
                assert!((kernel - twin).abs() < 2e-5 * scale, "{size:?}: range of {i}: {kernel} and {twin}");
            }
            let sums = outputs.v_water.into_iter().chain(outputs.v_refinement);
            for (k, (kernel, twin)) in sums.zip(v_water.into_iter().chain(v_refinement)).enumerate() {
                // Sums of `pixels` numbers up to about 5, which mostly cancel.
                assert!(
                    (kernel - twin).abs() < 2e-5 * f64::from(pixels).max(1.0),
                    "{size:?}: {k}: {kernel} and {twin}"
                );
            }
            // The steps from these gradients.
            let mut twin_water = WaterState::new(&WATER, UNIT);
            twin_water.step(&outputs.v_water, UNIT, RATE.into(), 0.0);
            for (found, expected) in outputs.water.to_array().iter().zip(twin_water.water(UNIT).to_array()) {
                assert!((found / expected - 1.0).abs() < 1e-5, "{found} and {expected} after a step");
            }
            let mut twin_refinement = RefinementState::new(refinement);
            twin_refinement.step(&outputs.v_refinement, RATE.into());
            let found = outputs.refinement.unwrap();
            for (found, expected) in found.to_array().iter().zip(twin_refinement.refinement.to_array()) {
                assert!((found - expected).abs() < 1e-6, "{found} and {expected} after a step");
            }
            assert_eq!((found.scale, found.unit, outputs.left_out), (2.0, UNIT, 0));
        }
    }
}

#[test]
fn the_identity_is_the_water_without_a_refinement_to_the_bit() {
    for gpu in layouts() {
        let (size, seed) = ([75, 53], 410);
        let v = gradients(size[0] * size[1], seed);
        let plain = iteration(&gpu, medium_run(None), size, &v, seed);
        let identity = medium_run(Some(RangeModulation::identity(2.0, UNIT)));
        let refined = iteration(&gpu, identity, size, &v, seed);
        assert_same_bits("pictures", &plain.seen, &refined.seen);
        assert_same_bits("gradients by colour and alpha", &plain.v_image, &refined.v_image);
        assert_same_bits("gradients by range", &plain.v_range, &refined.v_range);
        assert_same_bits("gradients by the water parameters", &plain.v_water, &refined.v_water);
        assert_same_bits(
            "the water parameters after a step",
            &plain.water.to_array(),
            &refined.water.to_array(),
        );
        assert_eq!(plain.refinement, None);
        assert!(
            refined.refinement.unwrap().to_array().iter().all(|value| *value != 0.0),
            "the refinement must move"
        );
    }
}

#[test]
fn saturated_factors_stay_finite_and_nan_gradients_move_nothing() {
    for gpu in layouts() {
        let (size, seed) = ([33, 31], 420);
        let v = gradients(size[0] * size[1], seed);
        let steep = RangeModulation::identity(2.0, UNIT).with_array([1e20, 5.0, -1e20, -80.0]);
        let outputs = iteration(&gpu, medium_run(Some(steep)), size, &v, seed);
        assert!(outputs.seen.iter().flatten().all(|value| value.is_finite()));
        assert!(outputs.v_image.iter().flatten().chain(&outputs.v_range).all(|value| value.is_finite()));
        assert!(outputs.refinement.unwrap().is_sound() && outputs.water.is_physical());

        let start = some_refinement(seed);
        let nan = vec![[f32::NAN, 0.1, 0.1, 0.0]; v.len()];
        let outputs = iteration(&gpu, medium_run(Some(start)), size, &nan, seed);
        assert_eq!((outputs.refinement, outputs.left_out), (Some(start), 1));
        let unmoved = outputs.water.to_array().into_iter().zip(WATER.to_array());
        assert!(unmoved.into_iter().all(|(found, before)| (found - before).abs() < 1e-7));
    }
}

#[test]
fn a_renderer_from_the_record_matches_the_trainer() {
    let ways = [
        (medium::DECODED, Composition::PixelsLinear),
        (medium::AS_SHOWN, Composition::PixelsSrgb),
        (medium::OVER_BLACK, Composition::PixelsOverBlack),
    ];
    for (gpu, (compose, composition)) in
        layouts().into_iter().flat_map(|gpu| ways.map(|way| (Arc::clone(&gpu), way)))
    {
        let scene =
            Scene { background: [0.0; 3], ..Scene::new("refined", samples::random(430, 300, 1), 75, 53) };
        let blocks = View::render(&gpu, &scene).blocks;
        let mut view = View::prepare(&gpu, &scene, blocks);
        view.uniform.medium = compose;
        let mut run = medium_run(Some(some_refinement(431)));
        run.composition = composition;
        run.water = Water::from_array(WATER.to_array().map(|value| f64::from(value as f32)));
        let mut water = DeviceMedium::new(&gpu, run).unwrap();
        water.give_to(&gpu, &view.frame);
        water.prepare(&gpu, view.uniform.size, 300, 1).unwrap();
        view.forward();
        let size = view.uniform.size;
        let step = WaterStep { size, has_surfaces: true, terms: 1.0, ..WaterStep::default() };
        let mut recorder = Recorder::new(&gpu);
        let seen = water.record(&gpu, &mut recorder, &view.frame, step, 300, 1).unwrap();
        recorder.submit();
        let seen: Vec<[f32; 4]> = gpu.read(seen, 0, view.pixels()).unwrap();

        let record = water.record_of(&gpu, &view.frame, 0.5).unwrap();
        let record = WaterRecord::among(&[record.to_comment().unwrap()]).unwrap().unwrap();
        assert_eq!(record.refinement, Some(some_refinement(431)));
        let rendered = |output| {
            let water = WaterView::of_record(&record, output);
            let mut renderer = Renderer::new(Arc::clone(&gpu), &scene.model).unwrap().with_water(Some(water));
            renderer.render(&scene.camera, &scene.pose, [0.0; 3]).unwrap()
        };
        let picture = rendered(Output::Underwater);
        for (i, (trained, shown)) in seen.iter().zip(&picture.rgb).enumerate() {
            for c in 0..3 {
                // 1e-4 is a fortieth of an 8-bit step: f32 against f64, and another order of equal depths.
                let difference = (trained[c] - shown[c]).abs();
                assert!(
                    difference < 1e-4,
                    "{composition:?}, pixel {i}, {c}: {} trained, {} shown",
                    trained[c],
                    shown[c]
                );
            }
        }
        // The backscatter of the twin.
        let backscatter = rendered(Output::Backscatter);
        for (i, shown) in backscatter.rgb.iter().enumerate() {
            let [alpha, range] = [backscatter.alpha[i], backscatter.range[i]].map(f64::from);
            let twin = form_refined(
                &record.water(),
                &some_refinement(431),
                composition.blend(),
                &Blended { rgb: [0.0; 3], alpha, range },
            );
            for c in 0..3 {
                let expected = encode(twin[c]).0;
                assert!(
                    (f64::from(shown[c]) - expected).abs() < 1e-5,
                    "{composition:?}, {i}: {} and {expected}",
                    shown[c]
                );
            }
        }
    }
}

#[test]
fn interruptions_short_lists_and_bands_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let new = || watery(&photographs, config(30), by_pixel(DbdrMode::Maps));
    let learnt = |trainer: &mut Trainer| trainer.water_view().unwrap().unwrap();
    let (_, water) = same_however_it_runs(&gpu, "maps", new, [0, 1, 13, 25], banded(&gpu), learnt);
    let moved = water.refinement.unwrap().to_array();
    assert!(moved.iter().all(|value| *value != 0.0), "{moved:?}");
}

#[test]
fn maps_at_rate_0_change_no_byte_and_no_dbdr_keeps_the_prior() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let trained = |water: WaterConfig| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), watery(&photographs, config(24), water)).unwrap();
        let before = trainer.water().unwrap();
        trainer.advance(24).unwrap();
        (trainer.gaussians().unwrap(), before, trainer.water().unwrap())
    };
    let mut still = by_pixel(DbdrMode::Maps);
    still.dbdr.lr = 0.0;
    let (constants, before, moved) = trained(by_pixel(DbdrMode::Constants));
    let (maps, _, with_maps) = trained(still);
    assert_same_model("maps at a rate of 0", &constants, &maps);
    assert_eq!(moved, with_maps);
    assert_ne!(before, moved, "constants must move");
    let (_, before, after) = trained(by_pixel(DbdrMode::None));
    assert_eq!(before, after, "without DBDR the water parameters must stay");
}

#[test]
fn maps_fit_a_water_that_constants_cannot() {
    let Some(gpu) = device() else { return };
    // Near water is twice as dense as far water.
    let refinement = RangeModulation::identity(2.0, UNIT).with_array([-2.5, 3.0, -2.5, 3.0]);
    let view = WaterView {
        water: WATER,
        refinement: Some(refinement),
        by_direction: None,
        composition: Composition::PixelsLinear,
        output: Output::Underwater,
    };
    let wet = sunk(&gpu, view);
    let loss = |mode: DbdrMode| {
        let mut run = watery(&wet, config(300), WaterConfig { freeze_at: 1.0, ..by_pixel(mode) });
        run.medium.as_mut().unwrap().water = WATER;
        let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
        // The loss of the last epoch of 18 views.
        trainer.advance(282).unwrap();
        (trainer.advance(18).unwrap().loss, trainer.water_view().unwrap().unwrap())
    };
    let (constants, _) = loss(DbdrMode::Constants);
    let (maps, found) = loss(DbdrMode::Maps);
    let [weight_d, _, weight_b, _] = found.refinement.unwrap().to_array();
    assert!(maps < 0.97 * constants, "loss {maps} with maps, {constants} with constants; {found:?}");
    assert!(weight_d < 0.0 && weight_b < 0.0, "denser where it is near: {found:?}");
}

#[test]
fn maps_are_refused_where_the_water_acts_on_gaussians() {
    let Some(gpu) = device() else { return };
    let mut run = medium_run(Some(RangeModulation::identity(2.0, UNIT)));
    run.composition = Composition::GaussiansLinear;
    match DeviceMedium::new(&gpu, run) {
        Err(CoreError::Config(fault)) => assert!(fault.contains("per_pixel"), "{fault}"),
        other => panic!("{:?}", other.map(|_| "accepted")),
    }
}
