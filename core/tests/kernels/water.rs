//! Water between Gaussians and camera: kernels against the twin, and its effect on a run.

use std::sync::Arc;

use fathom_core::appearance::chain::SplatGradients;
use fathom_core::config::{
    Blend, Composition, DarkChannelOn, LossLight, Medium, Moments, PriorsConfig, Strategy, TrainConfig,
    WaterConfig,
};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{
    Blocks, Frame, FrameUniform, Gpu, Output, Recorder, Renderer, StepUniform, WaterView, medium,
};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::train::{DeviceMedium, MediumRun, TrainRun, Trainer, WaterStep};
use fathom_core::views::{InMemory, TrainView};
use fathom_core::water::{ByDirection, Water};
use fathom_twins::{
    Blended, Gaussians64, SplatGradient, WaterState, encode, form, form_backward, in_water,
    in_water_backward, lr_scale_under_water, project_backward, project_forward,
    samples::{self, off_centre_view},
};

use glam::DVec3;

use crate::device::{device, layouts, poison, storage};
use crate::trainer::{banded, config, photographs, run, same_however_it_runs, truth};
use crate::view::{ImageGradients, Scene, View, gradients_only};

pub const WATER: Water =
    Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.025, 0.11, 0.19] };

pub fn medium_run(config: WaterConfig, water: Water) -> MediumRun {
    MediumRun { water, ..fixed(&config, 3.2) }
}

/// The medium of a run that starts from the parameters of `config` and uses its composition.
pub fn fixed(config: &WaterConfig, unit: f64) -> MediumRun {
    MediumRun::fixed(config, config.composition().unwrap().unwrap(), unit)
}

pub const COMPOSITIONS: [(Medium, Blend); 5] = [
    (Medium::PerGaussian, Blend::Srgb),
    (Medium::PerGaussian, Blend::Linear),
    (Medium::PerPixel, Blend::Linear),
    (Medium::PerPixel, Blend::Srgb),
    (Medium::PerPixel, Blend::OverBlack),
];

pub fn with((medium, blend): (Medium, Blend)) -> WaterConfig {
    WaterConfig { medium, blend, ..WaterConfig::default() }
}

/// The gradients of the splats of a view that was rendered in one piece.
pub fn gradients_of<'a>(frame: &'a Frame, blocks: &'a Blocks, slots: &'a wgpu::Buffer) -> SplatGradients<'a> {
    SplatGradients { frame, blocks, slots, in_bands: false }
}

/// Sums over all rows of `partials`, one per water parameter.
pub fn sums(gpu: &Gpu, partials: &wgpu::Buffer) -> [f64; 9] {
    let rows: Vec<[[f32; 4]; 3]> = gpu.read(partials, 0, (partials.size() / 48) as usize).unwrap();
    std::array::from_fn(|i| rows.iter().map(|row| f64::from(row[i / 3][i % 3])).sum())
}

#[test]
fn pictures_under_water_and_gradients_match_the_twin() {
    for gpu in layouts() {
        for composed in COMPOSITIONS {
            for (k, (width, height)) in [(1, 1), (33, 31), (32, 32), (75, 53)].into_iter().enumerate() {
                check_pictures(&gpu, composed, width, height, 300 + k as u32, None);
                if composed.0 == Medium::PerPixel {
                    check_pictures(&gpu, composed, width, height, 300 + k as u32, Some(BY_DIRECTION));
                }
            }
        }
    }
}

/// A water colour that changes by a factor of a few within the picture and reaches its limit in one corner.
const BY_DIRECTION: ByDirection = ByDirection {
    middle: [0.0, 0.6, 0.8],
    slopes: [[0.3, -1.0, 0.0], [0.0, -2.0, 0.2], [1.5, -3.0, 0.0]],
    most: 1.4,
};

/// With `by_direction`, the view also has a map of what its rays end on. The map then replaces the test by
/// colour.
fn check_pictures(
    gpu: &Arc<Gpu>,
    composed: (Medium, Blend),
    width: u32,
    height: u32,
    seed: u32,
    by_direction: Option<ByDirection>,
) {
    let what = format!("{composed:?}, {width}x{height}");
    let pixels = width * height;
    let u = |i, j| uniform_at(seed, Stream::Test, i, j);
    // Empty, thin, partial and opaque pixels; every third pixel of the photograph is open water.
    let alpha = |i: u32| [0.0, 1e-4, u(i, 3), 1.0][(i % 4) as usize];
    let image: Vec<[f32; 4]> =
        (0..pixels).map(|i| [alpha(i) * u(i, 0), alpha(i) * u(i, 1), alpha(i) * u(i, 2), alpha(i)]).collect();
    let range: Vec<f32> = (0..pixels).map(|i| alpha(i) * 9.0 * u(i, 4)).collect();
    let open = WATER.b_inf.map(|l| (255.0 * encode(l).0).round() as u32);
    let photograph: Vec<u32> = (0..pixels)
        .map(|i| match i % 3 {
            0 => open[0] | (open[1] << 8) | (open[2] << 16) | if i % 2 == 0 { 255 << 24 } else { 0 },
            _ => 0xffff_ffff,
        })
        .collect();
    let v: Vec<[f32; 4]> = (0..pixels).map(|i| [u(i, 5) - 0.5, u(i, 6) - 0.5, u(i, 7) - 0.5, 0.0]).collect();

    let config = WaterConfig {
        alpha_background: 0.3,
        surface_alpha_weight: 0.2,
        alpha_open: 0.7,
        sparse_ranges: 0.4,
        ..with(composed)
    };
    let medium = MediumRun { by_direction, ..medium_run(config, WATER) };
    let slack = f64::from(medium.range_slack());
    let mut water = DeviceMedium::new(gpu, medium).unwrap();
    let (w, h) = (f64::from(width), f64::from(height));
    let camera = PinholeCamera { width, height, fx: w, fy: 0.9 * w, cx: 0.45 * w, cy: 0.6 * h };
    let pose = Pose::looking_at(DVec3::ZERO, DVec3::new(0.1, 0.5, 0.8), DVec3::Y);
    // Cells are unknown, surface, open water and edge in turn; every other cell has a range.
    let map_range = |cell: u32| if cell.is_multiple_of(2) { 4.0_f32 } else { 0.0 };
    let map: Vec<u32> = (0..15).map(|cell| (map_range(cell).to_bits() & !3) | (cell % 4)).collect();
    let cell_at = |i: u32| (i / width) * 3 / height * 5 + (i % width) * 5 / width;
    let mut frame = Frame::new(gpu, 1, 1, 1).unwrap();
    frame.prepare_targets(gpu, [width, height]).unwrap();
    water.give_to(gpu, &frame);
    gpu.write(&frame.uniform, 0, &[FrameUniform::of_camera(&camera, &pose, gpu.tile())]);
    water.prepare(gpu, [width, height], 1, 1).unwrap();
    for buffer in water.scratch().unwrap() {
        poison(gpu, buffer);
    }
    let targets = frame.targets().unwrap();
    gpu.write(&targets.image, 0, &image);
    gpu.write(&targets.range_image, 0, &range);
    let truth = storage(gpu, &photograph);
    let (v_image, v_range) = (storage(gpu, &v), storage(gpu, &vec![7.0_f32; pixels as usize]));
    let step = WaterStep {
        size: [width, height],
        masked: true,
        has_surfaces: true,
        terms: 1.0,
        map: if by_direction.is_some() { [5, 3] } else { [0; 2] },
        alike: 0.05,
        ..WaterStep::default()
    };
    let cells = by_direction.map(|_| storage(gpu, &map));
    let mut recorder = Recorder::new(gpu);
    let seen = water.record(gpu, &mut recorder, &frame, step, 1, 1).unwrap();
    let gradients = [&v_image, &v_range];
    water.record_backward(gpu, &mut recorder, &frame, &truth, cells.as_ref(), step, gradients).unwrap();
    recorder.submit();
    let seen: Vec<[f32; 4]> = gpu.read(seen, 0, pixels as usize).unwrap();
    let v_blended: Vec<[f32; 4]> = gpu.read(&v_image, 0, pixels as usize).unwrap();
    let v_range: Vec<f32> = gpu.read(&v_range, 0, pixels as usize).unwrap();

    let mut v_water = [0.0; 9];
    // Over black, open water looks like the scene, so these terms are off.
    let is_separable = if composed.1 == Blend::OverBlack { 0.0 } else { 1.0 };
    let [background, surface] =
        [0.3, 0.2].map(|weight: f32| is_separable * f64::from(weight / pixels as f32));
    for i in 0..pixels as usize {
        let [r, g, b, alpha] = image[i].map(f64::from);
        let pixel = Blended { rgb: [r, g, b], alpha, range: f64::from(range[i]) };
        let direction = pose.rotation.inverse() * camera.direction(i);
        let factors = by_direction.map_or([1.0; 3], |by_direction| by_direction.factors(direction));
        let here = by_direction.map_or(WATER, |by_direction| by_direction.along(&WATER, direction));
        let light = form(&here, composed.0, composed.1, &pixel);
        let as_it_is = composed == (Medium::PerGaussian, Blend::Srgb);
        let slopes = light.map(|l| if as_it_is { (l, 1.0) } else { encode(l) });
        let v: [f64; 3] = std::array::from_fn(|c| f64::from(v[i][c]) * slopes[c].1);
        let mut v_here = [0.0; 9];
        let mut by = form_backward(&here, composed.0, composed.1, &pixel, v, &mut v_here);
        if by_direction.is_some() && i % 6 != 3 && alpha >= 1e-3 {
            let (r, target) = (pixel.range / alpha, f64::from(map_range(cell_at(i as u32))));
            let off = (r.max(1e-6) / target.max(1e-6)).ln();
            if target > 0.0 && off.abs() > slack {
                let v_r = is_separable * f64::from(0.4_f32 / pixels as f32) * off.signum() / r.max(1e-6);
                by.range += v_r / alpha;
                by.alpha -= v_r * r / alpha;
            }
        }
        (0..9).for_each(|k| v_water[k] += v_here[k] * if k < 6 { 1.0 } else { factors[k - 6] });
        by.alpha += match (i % 6, by_direction) {
            // Masked.
            (3, _) => 0.0,
            (_, Some(_)) => {
                let off =
                    |c: usize| f64::from((photograph[i] >> (8 * c)) & 255) / 255.0 - encode(here.b_inf[c]).0;
                let off = (0..3).map(|c| off(c).powi(2)).sum::<f64>().sqrt();
                let ends_on = match cell_at(i as u32) % 4 {
                    3 if off < 0.6 * 0.05 => 2,
                    3 if off > 0.05 => 1,
                    3 => 0,
                    class => class,
                };
                [0.0, -surface / alpha.max(0.05), f64::from(0.7_f32 / pixels as f32)][ends_on as usize]
            }
            (0, None) => background,
            (_, None) => -surface / alpha.max(0.05),
        };
        for c in 0..3 {
            // 2e-6: the power function in f32 of a number up to 1.
            let difference = (f64::from(seen[i][c]) - slopes[c].0).abs();
            assert!(difference < 2e-6, "{what}: pixel {i}, {c}: {} and {}", seen[i][c], slopes[c].0);
            let close = (f64::from(v_blended[i][c]) - by.rgb[c]).abs() < 1e-5 * (1.0 + by.rgb[c].abs());
            assert!(close, "{what}: gradient of pixel {i}, {c}: {} and {}", v_blended[i][c], by.rgb[c]);
        }
        assert_eq!(seen[i][3], image[i][3], "{what}: alpha must not change");
        // A range of up to 9 is divided by an alpha that may be near 0.
        let scale = 1.0 + by.alpha.abs() + by.range.abs();
        let alpha = f64::from(v_blended[i][3]);
        assert!((alpha - by.alpha).abs() < 2e-5 * scale, "{what}: {i}, alpha {alpha} and {}", by.alpha);
        assert!((f64::from(v_range[i]) - by.range).abs() < 2e-5 * scale, "{what}: range of {i}");
    }
    for (k, (kernel, twin)) in sums(gpu, water.scratch().unwrap()[1]).iter().zip(v_water).enumerate() {
        // Sums of `pixels` numbers up to about 5, which mostly cancel.
        assert!(
            (kernel - twin).abs() < 2e-5 * f64::from(pixels).max(1.0),
            "{what}: {k}: {kernel} and {twin}"
        );
    }
}

/// A view of random Gaussians under water.
fn under_water(gpu: &Arc<Gpu>, blend: Blend, seed: u32, sh_degree: u8) -> View {
    let scene = Scene {
        background: [0.0; 3],
        ..Scene::new("under water", samples::random(seed, 300, sh_degree), 75, 53)
    };
    // With f32 moments, Adam's first step is as long as its rate.
    let blocks = View::render_with(gpu, &scene, Moments::F32).blocks;
    let mut view = View::prepare(gpu, &scene, blocks);
    view.uniform.medium = match blend {
        Blend::Srgb | Blend::OverBlack => medium::PER_GAUSSIAN_SRGB,
        Blend::Linear => medium::PER_GAUSSIAN,
    };
    view.frame.set_water(gpu, &WATER);
    view.forward();
    view
}

#[test]
fn splats_under_water_have_the_colours_of_the_twin() {
    for gpu in layouts() {
        for (blend, sh_degree) in [(Blend::Srgb, 0), (Blend::Linear, 3)] {
            let view = under_water(&gpu, blend, 171, sh_degree);
            let scene = &view.scene;
            let model = Gaussians64::from(&scene.model);
            let twin = project_forward(&model, &scene.camera, &scene.pose, sh_degree, &scene.rules());
            let mut compared = 0;
            for (id, kernel) in view.splats().iter().enumerate() {
                let (Some(kernel), Some(twin)) = (kernel, &twin[id]) else { continue };
                let light = in_water(&WATER, twin.rgb, twin.range);
                let expected = if blend == Blend::Srgb { light.map(|l| encode(l).0) } else { light };
                for c in 0..3 {
                    let difference = (kernel.rgb[c] - expected[c]).abs();
                    assert!(
                        difference < 2e-5 * (1.0 + expected[c]),
                        "{id}, {c}: {} {expected:?}",
                        kernel.rgb[c]
                    );
                }
                compared += 1;
            }
            assert!(compared > 100, "{compared} compared");
        }
    }
}

#[test]
fn gradients_of_gaussians_and_water_parameters_match_the_twin() {
    for gpu in layouts() {
        for (blend, sh_degree) in [(Blend::Srgb, 0), (Blend::Srgb, 2), (Blend::Linear, 2)] {
            let view = under_water(&gpu, blend, 172, sh_degree);
            let scene = &view.scene;
            let v = ImageGradients::random(173, view.pixels());
            let slots_buffer = view.record_backward(&v, &gradients_only());
            let count = view.counter(fathom_core::gpu::counter::INTERSECTIONS);
            let slots: Vec<[f32; 12]> = gpu.read(&slots_buffer, 0, count).unwrap();
            let mut v_splats = view.splat_gradients(&slots);
            let model = Gaussians64::from(&scene.model);
            let splats = project_forward(&model, &scene.camera, &scene.pose, sh_degree, &scene.rules());
            let mut v_water = [0.0; 9];
            for (splat, v) in splats.iter().zip(&mut v_splats) {
                match splat {
                    Some(splat) => in_water_backward(&WATER, blend, splat.rgb, splat.range, v, &mut v_water),
                    None => *v = SplatGradient::default(),
                }
            }
            let twin = project_backward(
                &model,
                &scene.camera,
                &scene.pose,
                sh_degree,
                &splats,
                &v_splats,
                &scene.rules(),
            );
            let kernel = view.parameter_gradients();
            for (kind, from, to) in [("mean", 0, 3), ("coefficients", 11, model.parameters())] {
                let (mut difference, mut length) = (0.0, 0.0);
                for index in 0..model.len() {
                    for p in from..to {
                        let (a, b) = (kernel.parameter(index, p), twin.parameter(index, p));
                        difference += (a - b).powi(2);
                        length += b.powi(2);
                    }
                }
                let share = (difference / length).sqrt();
                assert!(
                    length > 0.0 && share < 2e-4,
                    "{kind}: the gradients differ by {share:e} of their length"
                );
            }

            let config = with((Medium::PerGaussian, blend));
            let mut water = DeviceMedium::new(&gpu, medium_run(config, WATER)).unwrap();
            let (gaussians, size) = (view.blocks.trainable_total(), view.uniform.size);
            water.prepare(&gpu, size, gaussians, 1).unwrap();
            let step = WaterStep { size, rate: Some(0.01), steps: 1, ..WaterStep::default() };
            let mut recorder = Recorder::new(&gpu);
            water.record(&gpu, &mut recorder, &view.frame, step, gaussians, 1).unwrap();
            recorder.clear(water.scratch().unwrap()[1]);
            water
                .record_gradients(&gpu, &mut recorder, gradients_of(&view.frame, &view.blocks, &slots_buffer))
                .unwrap();
            water.record_step(&mut recorder, &view.frame).unwrap();
            recorder.submit();
            let kernel = sums(&gpu, water.scratch().unwrap()[1]);
            let size = v_water.iter().map(|v| v.abs()).fold(0.0, f64::max);
            for (k, (kernel, twin)) in kernel.iter().zip(v_water).enumerate() {
                assert!((kernel - twin).abs() < 1e-4 * size, "{k}: {kernel} and {twin}");
            }
            // The step from these gradients.
            let mut twin = WaterState::new(&WATER, 3.2);
            twin.step(&kernel, 3.2, 0.01, 0.0);
            let (found, expected) =
                (water.water(&gpu, &view.frame).unwrap().to_array(), twin.water(3.2).to_array());
            for (found, expected) in found.iter().zip(expected) {
                assert!((found / expected - 1.0).abs() < 1e-5, "{found} and {expected} after a step");
            }
        }
    }
}

#[test]
fn only_the_constant_colour_moves_faster_the_less_it_is_seen() {
    const RATES: [f64; 2] = [1e-2, 5e-4];
    let Some(gpu) = device() else { return };
    // Also with water on pixels, where the colours of Gaussians contain no water.
    for medium in [medium::PER_GAUSSIAN_SRGB, medium::AS_SHOWN, medium::OVER_BLACK] {
        let mut view = under_water(&gpu, Blend::Srgb, 174, 2);
        view.uniform.medium = medium;
        view.forward();
        let before = Gaussians64::from(&view.blocks.download(&gpu).unwrap());
        let scene = &view.scene;
        let twin = project_forward(&before, &scene.camera, &scene.pose, 2, &scene.rules());
        let step =
            StepUniform { sh_dc_lr: RATES[0] as f32, sh_rest_lr: RATES[1] as f32, ..StepUniform::default() };
        view.backward(&ImageGradients::random(175, view.pixels()), &step);
        let after = Gaussians64::from(&view.blocks.download(&gpu).unwrap());
        let (mut compared, mut fastest) = (0, 1.0_f64);
        for (id, splat) in twin.iter().enumerate() {
            let Some(splat) = splat else { continue };
            let lr_scale = lr_scale_under_water(&WATER, splat.rgb.map(|s| s.max(0.0)), splat.range);
            for p in 11..after.parameters() {
                let moved = (after.parameter(id, p) - before.parameter(id, p)).abs();
                // No pixel shows it, or its colour is clamped at 0.
                if moved == 0.0 {
                    continue;
                }
                let c = (p - 11) % 3;
                let expected = if p < 14 { RATES[0] * lr_scale[c] } else { RATES[1] };
                let name = Gaussians64::parameter_name(p);
                // The slopes are powers in f32, and coefficients near 1 have a spacing of 1e-7.
                assert!((moved / expected - 1.0).abs() < 2e-3, "{name} of {id}: {moved}, not {expected}");
                (compared, fastest) = (compared + 1, fastest.max(lr_scale[c]));
            }
        }
        assert!(compared > 1000 && fastest > 4.0, "{compared} compared, fastest {fastest}");
    }
}

#[test]
fn a_nan_gradient_moves_no_water_parameter_and_is_counted() {
    for gpu in layouts() {
        let mut frame = Frame::new(&gpu, 1, 1, 1).unwrap();
        frame.prepare_targets(&gpu, [8, 8]).unwrap();
        let blocks = Blocks::new(&gpu, 0).unwrap();
        let mut water = DeviceMedium::new(&gpu, medium_run(with(COMPOSITIONS[2]), WATER)).unwrap();
        water.give_to(&gpu, &frame);
        water.prepare(&gpu, [8, 8], 1, 1).unwrap();
        let before = water.water(&gpu, &frame).unwrap();
        let truth = storage(&gpu, &[0xff00_0000_u32; 64]);
        let zeros = storage(&gpu, &[0.0_f32; 64]);
        let once = |v: [f32; 4], steps: u32| {
            let v = storage(&gpu, &[v; 64]);
            let mut recorder = Recorder::new(&gpu);
            let step = WaterStep { size: [8, 8], rate: Some(0.1), steps, ..WaterStep::default() };
            water.record(&gpu, &mut recorder, &frame, step, 1, 1).unwrap();
            water.record_backward(&gpu, &mut recorder, &frame, &truth, None, step, [&v, &zeros]).unwrap();
            water.record_gradients(&gpu, &mut recorder, gradients_of(&frame, &blocks, &zeros)).unwrap();
            water.record_step(&mut recorder, &frame).unwrap();
            recorder.submit();
            (water.water(&gpu, &frame).unwrap(), water.steps_left_out(&gpu).unwrap())
        };
        let (after, left_out) = once([f32::NAN, 0.1, 0.1, 0.0], 1);
        assert_eq!((after, left_out), (before, 1));
        let (after, left_out) = once([0.1; 4], 2);
        assert_eq!(left_out, 1);
        assert!(after.b_inf.iter().zip(before.b_inf).all(|(a, b)| *a < b), "open water must get darker");
        for (after, before) in after.beta_d.iter().zip(before.beta_d) {
            assert!(
                (after / before - 1.0).abs() < 1e-5,
                "nothing depends on range, so beta_d must stay: {after} and {before}"
            );
        }
    }
}

pub fn watery(photographs: &InMemory, config: TrainConfig, water: WaterConfig) -> TrainRun {
    let start = Water { beta_d: [0.2; 3], beta_b: [0.2; 3], b_inf: [0.1; 3] };
    TrainRun { medium: Some(medium_run(water, start)), ..run(photographs, config) }
}

#[test]
fn interruptions_short_lists_and_bands_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    // Every composition, one with all loss terms while their weights rise, and the settings of the paper.
    let rising = PriorsConfig {
        dark_channel: 1.0,
        dark_channel_patch: 9,
        dark_channel_on: DarkChannelOn::Photograph,
        depth_smoothness: 2.0,
        from: 0.1,
        rise: 0.6,
        ..PriorsConfig::default()
    };
    let all_terms = WaterConfig { priors: rising, loss_light: LossLight::Linear, ..with(COMPOSITIONS[0]) };
    for water in COMPOSITIONS.map(with).into_iter().chain([all_terms, WaterConfig::paper()]) {
        let new = || watery(&photographs, config(30), water.clone());
        let learnt = |trainer: &mut Trainer| trainer.water().unwrap().unwrap().to_array().map(f64::to_bits);
        same_however_it_runs(&gpu, &format!("{water:?}"), new, [0, 1, 13, 25], banded(&gpu), learnt);
    }
}

#[test]
fn frozen_water_stays_and_sh0_while_free_delays_harmonics() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 48, 36);
    let frozen = {
        let mut run = watery(&photographs, config(20), with(COMPOSITIONS[0]));
        run.medium.as_mut().unwrap().is_free = false;
        run
    };
    let mut trainer = Trainer::new(Arc::clone(&gpu), frozen).unwrap();
    let before = trainer.water().unwrap();
    trainer.advance(20).unwrap();
    assert_eq!(trainer.water().unwrap(), before);
    let view_dependence =
        |model: &Gaussians| model.sh_coeffs.iter().skip(1).step_by(4).flatten().any(|c| *c != 0.0);
    assert!(view_dependence(&trainer.gaussians().unwrap()), "a frozen water must not delay the harmonics");

    let moving = |sh0_while_free| {
        let water = WaterConfig { freeze_at: 0.5, sh0_while_free, ..with(COMPOSITIONS[0]) };
        let mut trainer = Trainer::new(Arc::clone(&gpu), watery(&photographs, config(60), water)).unwrap();
        trainer.advance(30).unwrap();
        trainer
    };
    assert!(view_dependence(&moving(false).gaussians().unwrap()), "harmonics must not wait for the water");
    let mut trainer = moving(true);
    assert!(
        !view_dependence(&trainer.gaussians().unwrap()),
        "colours must not depend on direction while the water moves"
    );
    let moved = trainer.water().unwrap();
    assert_ne!(moved, before);
    trainer.advance(30).unwrap();
    assert_eq!(trainer.water().unwrap(), moved, "the water must stay after its part of the run");
    assert!(view_dependence(&trainer.gaussians().unwrap()));
}

/// Photographs through water from near and far. Without both, attenuation and colour cannot be separated.
pub fn sunk(gpu: &Arc<Gpu>, water: WaterView) -> InMemory {
    let mut views = Vec::new();
    for (i, distance) in [1.7, 2.4, 3.2, 4.5, 6.5, 9.0].into_iter().enumerate() {
        for turn in [-0.6_f64, 0.1, 0.7] {
            let (camera, _) = off_centre_view(64, 48, 3.0);
            let eye = distance * DVec3::new(turn.sin(), 0.2 * turn, -turn.cos());
            let pose = Pose::looking_at(eye, DVec3::ZERO, DVec3::Y);
            views.push(TrainView { name: format!("{i} {turn}"), camera, pose, clear_range: 0.0 });
        }
    }
    let mut renderer = Renderer::new(Arc::clone(gpu), &truth()).unwrap().with_water(Some(water));
    let images = views.iter().map(|view| {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        Arc::new(quantised(rendered.width, rendered.height, &rendered.rgb))
    });
    let images = images.collect();
    InMemory { views, images }
}

#[test]
fn training_finds_the_unknown_water_parameters_and_keeps_others() {
    let Some(gpu) = device() else { return };
    let composition = Composition::GaussiansSrgb;
    let wet = sunk(
        &gpu,
        WaterView {
            water: WATER,
            refinement: None,
            by_direction: None,
            composition,
            output: Output::Underwater,
        },
    );
    let mut run = watery(&wet, config(400), WaterConfig { lr: 0.03, ..with(COMPOSITIONS[0]) });
    let medium = run.medium.as_mut().unwrap();
    medium.water = Water { b_inf: [0.1; 3], ..WATER };
    medium.standard_error = Some(std::array::from_fn(|i| if i < 6 { 1e-4 } else { f64::INFINITY }));
    let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
    trainer.advance(400).unwrap();
    let found = trainer.water().unwrap().unwrap();
    let view = trainer.water_view().unwrap().unwrap();
    let model = trainer.gaussians().unwrap();
    let mut renderer = Renderer::new(Arc::clone(&gpu), &model).unwrap().with_water(Some(view));
    let each = wet.views.iter().zip(&wet.images).map(|(view, image)| {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        psnr(&quantised(image.width, image.height, &rendered.rgb), image)
    });
    let seen = each.sum::<f64>() / wet.views.len() as f64;
    assert!(seen > 28.0, "I: {seen:.2} dB, {found:?}");
    for (k, (found, truth)) in found.to_array().iter().zip(WATER.to_array()).enumerate() {
        // At the start, `b_inf` is 0.075, 0.01 and 0.09 away.
        let bound = if k < 6 { 0.01 * truth } else { 0.006 };
        assert!((found - truth).abs() < bound, "{k}: {found} and {truth}");
    }
    let record = trainer.water_record(0.5).unwrap().unwrap();
    assert_eq!(record.water(), found);
    assert_eq!((record.source.as_str(), record.metres_per_unit), ("descended", Some(0.5)));
}

#[test]
fn the_last_density_step_covers_bare_surfaces() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    // No view sees this place, so Gaussians that are put there stay unchanged.
    let mut surfaces = samples::random(77, 12, 1);
    surfaces.means.iter_mut().enumerate().for_each(|(i, mean)| *mean = [900.0 + 10.0 * i as f32, 0.0, 0.0]);
    // The same number of Gaussians that are faint enough to be replaced.
    let mut faint = surfaces.clone();
    faint.means.iter_mut().for_each(|mean| mean[0] = -mean[0]);
    faint.opacity_logits.fill(-3.0);
    let covered = |least_cover: f32, strategy: Strategy| {
        let config = TrainConfig { strategy, ..config(30) };
        let run = watery(&photographs, config, WaterConfig { least_cover, ..with(COMPOSITIONS[0]) });
        let cap = run.config.max_gaussians as usize;
        let mut focus = run.focus.clone();
        (0..faint.len()).for_each(|index| focus.push_from(&faint, index));
        let mut trainer =
            Trainer::new(Arc::clone(&gpu), TrainRun { focus, surfaces: surfaces.clone(), ..run }).unwrap();
        trainer.advance(30).unwrap();
        let model = trainer.gaussians().unwrap();
        assert!(model.len() <= cap, "{} Gaussians, at most {cap}", model.len());
        surfaces.means.iter().filter(|mean| model.means.contains(mean)).count()
    };
    for strategy in [Strategy::Mcmc, Strategy::Classic] {
        assert_eq!([covered(0.0, strategy), covered(2.0, strategy)], [0, 12], "{strategy:?}");
    }
}
