//! Priors under water, and the loss in linear light: kernels against the twins, and their effect on a run.

use std::sync::Arc;

use fathom_core::config::{
    Blend, DarkChannelOn, DbdrConfig, DbdrMode, LossLight, Medium, PriorsConfig, WaterConfig,
};
use fathom_core::gpu::{Frame, Gpu, Recorder};
use fathom_core::rng::{Stream, random_bits, uniform_at};
use fathom_core::train::{DeviceMedium, MediumRun, Trainer, WaterStep};
use fathom_core::water::{RangeModulation, Water};
use fathom_twins::{
    Blended, DarkChannel, PriorView, dark_channel, decode, depth_smoothness, encode, form, form_backward,
    form_refined, form_refined_backward,
};

use crate::device::{assert_same_bits, device, layouts, poison, storage};
use crate::trainer::{assert_same_model, config, photographs};
use crate::water::{COMPOSITIONS, fixed, sums, watery, with};

const WATER: Water =
    Water { beta_d: [0.32, 0.11, 0.08], beta_b: [0.26, 0.14, 0.11], b_inf: [0.3, 0.41, 0.49] };
const UNIT: f64 = 3.2;
const TERMS: f32 = 0.5;

/// The inputs of one comparison of gradients.
struct Picture {
    size: [u32; 2],
    image: Vec<[f32; 4]>,
    range: Vec<f32>,
    photograph: Vec<u32>,
    v: Vec<[f32; 4]>,
}

impl Picture {
    /// Noise: some pixels are open water, some almost, half are opaque, the rest have any alpha.
    fn random(seed: u32, size: [u32; 2], masked: f32) -> Self {
        let pixels = size[0] * size[1];
        let u = |i, j| uniform_at(seed, Stream::Test, i, j);
        let alpha = |i: u32| match i % 97 {
            3 => 0.0,
            5 => 1e-4,
            k if k.is_multiple_of(2) => 1.0,
            _ => 0.05 + 0.95 * u(i, 3),
        };
        let mask = |i| if u(i, 8) < masked { 0 } else { 255 << 24 };
        Self {
            size,
            image: (0..pixels)
                .map(|i| [alpha(i) * u(i, 0), alpha(i) * u(i, 1), alpha(i) * u(i, 2), alpha(i)])
                .collect(),
            range: (0..pixels).map(|i| alpha(i) * 9.0 * u(i, 4)).collect(),
            photograph: (0..pixels)
                .map(|i| (random_bits(seed, Stream::Test, i, 9)[0] & 0x00ff_ffff) | mask(i))
                .collect(),
            v: (0..pixels).map(|i| [u(i, 5) - 0.5, u(i, 6) - 0.5, u(i, 7) - 0.5, 0.0]).collect(),
        }
    }

    /// One colour, alpha and range everywhere, so every pixel of a patch is its darkest.
    fn flat(size: [u32; 2]) -> Self {
        let pixels = (size[0] * size[1]) as usize;
        Self {
            size,
            image: vec![[0.7, 0.8, 0.9, 1.0]; pixels],
            range: vec![2.0; pixels],
            photograph: vec![0xffe0_c0a0; pixels],
            v: vec![[0.0; 4]; pixels],
        }
    }
}

/// Gradients from the kernels with respect to the blended colour and alpha, the range and the water
/// parameters; and the formed picture.
struct Found {
    v_image: Vec<[f32; 4]>,
    v_range: Vec<f32>,
    v_water: [f64; 9],
    v_refinement: [f64; 4],
    seen: Vec<[f32; 4]>,
}

/// The range modulation of `DbdrMode::Maps`; `None` in other modes.
fn refinement_of(config: &WaterConfig) -> Option<RangeModulation> {
    let maps = config.dbdr.mode == DbdrMode::Maps;
    maps.then(|| RangeModulation::identity(2.0, UNIT).with_array([0.25, -0.125, -0.75, 0.5]))
}

/// Runs the kernels forward and backward, at half size, on buffers full of rubbish.
fn by_kernels(gpu: &Arc<Gpu>, picture: &Picture, config: WaterConfig) -> Found {
    let refinement = refinement_of(&config);
    let run = MediumRun { water: WATER, refinement, ..fixed(&config, UNIT) };
    let mut water = DeviceMedium::new(gpu, run).unwrap();
    let mut frame = Frame::new(gpu, 1, 1, 1).unwrap();
    frame.prepare_targets(gpu, picture.size).unwrap();
    water.give_to(gpu, &frame);
    water.prepare(gpu, picture.size, 1, 1).unwrap();
    for buffer in water.scratch().unwrap() {
        poison(gpu, buffer);
    }
    let targets = frame.targets().unwrap();
    gpu.write(&targets.image, 0, &picture.image);
    gpu.write(&targets.range_image, 0, &picture.range);
    let truth = storage(gpu, &picture.photograph);
    let pixels = picture.image.len();
    let (v_image, v_range) = (storage(gpu, &picture.v), storage(gpu, &vec![7.0_f32; pixels]));
    let step = WaterStep { size: picture.size, masked: true, terms: TERMS, level: 1, ..WaterStep::default() };
    let mut recorder = Recorder::new(gpu);
    let seen = water.record(gpu, &mut recorder, &frame, step, 1, 1).unwrap();
    water.record_backward(gpu, &mut recorder, &frame, &truth, None, step, [&v_image, &v_range]).unwrap();
    recorder.submit();
    Found {
        v_image: gpu.read(&v_image, 0, pixels).unwrap(),
        v_range: gpu.read(&v_range, 0, pixels).unwrap(),
        v_water: sums(gpu, water.scratch().unwrap()[1]),
        v_refinement: {
            let partials = water.scratch().unwrap()[2];
            let rows: Vec<[f32; 4]> =
                gpu.read(partials, 0, pixels.div_ceil(1024).min(partials.size() as usize / 16)).unwrap();
            std::array::from_fn(|k| rows.iter().map(|row| f64::from(row[k])).sum())
        },
        seen: gpu.read(seen, 0, pixels).unwrap(),
    }
}

/// Weights that make the gradients of a pixel about 1 at any picture size.
fn weighty(pixels: usize, patch: u32, on: DarkChannelOn) -> PriorsConfig {
    PriorsConfig {
        dark_channel: 0.5 * pixels as f32,
        dark_channel_negative: 3.0,
        dark_channel_patch: patch,
        dark_channel_on: on,
        depth_smoothness: 0.1 * pixels as f32,
        ..PriorsConfig::default()
    }
}

#[track_caller]
fn check(gpu: &Arc<Gpu>, what: &str, picture: &Picture, config: &WaterConfig) {
    let found = by_kernels(gpu, picture, config.clone());
    let refinement = refinement_of(config);
    let (medium, blend, priors) = (config.medium, config.blend, &config.priors);
    let in_linear_light = config.loss_light == LossLight::Linear;
    let blended: Vec<Blended> = picture
        .image
        .iter()
        .zip(&picture.range)
        .map(|(pixel, range)| {
            let [r, g, b, alpha] = pixel.map(f64::from);
            Blended { rgb: [r, g, b], alpha, range: f64::from(*range) }
        })
        .collect();
    let mask: Vec<bool> = picture.photograph.iter().map(|pixel| pixel >> 24 == 255).collect();
    let bytes = |pixel: &u32| pixel.to_le_bytes().map(|byte| f64::from(byte) / 255.0);
    let photograph: Vec<[f64; 3]> =
        picture.photograph.iter().map(|pixel| [bytes(pixel)[0], bytes(pixel)[1], bytes(pixel)[2]]).collect();
    // The picture that the kernel formed, so that rounding in the previous stage does not decide which pixel
    // is darkest.
    let seen: Vec<[f64; 3]> = found.seen.iter().map(|p| [p[0], p[1], p[2]].map(f64::from)).collect();
    let on_photograph = priors.dark_channel_on == DarkChannelOn::Photograph;
    let shown = if on_photograph { &photograph } else { &seen };
    let is_linear = in_linear_light && !on_photograph;
    let light: Vec<[f64; 3]> =
        shown.iter().map(|rgb| rgb.map(|s| if is_linear { s } else { decode(s).0 })).collect();
    let view = PriorView {
        size: picture.size.map(|side| side as usize),
        blended: &blended,
        mask: &mask,
        unit: UNIT,
        refinement: refinement.as_ref(),
    };
    let terms = f64::from(TERMS);
    let weights = DarkChannel {
        weight: terms * f64::from(priors.dark_channel),
        negative: f64::from(priors.dark_channel_negative),
        radius: priors.radius(1) as usize,
    };
    let dark = dark_channel(&WATER, &view, &light, &weights);
    let smooth = depth_smoothness(&view, &photograph, terms * f64::from(priors.depth_smoothness));
    let (mut v_water, mut v_refinement) = (dark.v_water, dark.v_refinement);
    for i in 0..blended.len() {
        let formed = match &refinement {
            Some(refinement) => form_refined(&WATER, refinement, blend, &blended[i]),
            None => form(&WATER, medium, blend, &blended[i]),
        };
        let v: [f64; 3] = std::array::from_fn(|c| {
            let slope = if is_linear { 1.0 } else { decode(seen[i][c]).1 };
            let by_light = if on_photograph { 0.0 } else { dark.v_light[i][c] * slope };
            let shown = match (blend, in_linear_light) {
                (Blend::Srgb, true) if medium == Medium::PerGaussian => {
                    (decode(formed[c]).0, decode(formed[c]).1)
                }
                (Blend::Srgb, false) if medium == Medium::PerGaussian => (formed[c], 1.0),
                (_, false) => encode(formed[c]),
                (_, true) => (formed[c], 1.0),
            };
            // 3e-6: one or two powers in f32.
            assert!((shown.0 - seen[i][c]).abs() < 3e-6, "{what}: {i}, {c}: {} and {}", seen[i][c], shown.0);
            shown.1 * (f64::from(picture.v[i][c]) + by_light)
        });
        let mut by = match &refinement {
            Some(refinement) => form_refined_backward(
                &WATER,
                refinement,
                blend,
                &blended[i],
                v,
                &mut v_water,
                &mut v_refinement,
            ),
            None => form_backward(&WATER, medium, blend, &blended[i], v, &mut v_water),
        };
        by.alpha += dark.v_alpha[i] + smooth.v_alpha[i];
        by.range += dark.v_range[i] + smooth.v_range[i];
        // Relative to the largest term: a pixel may be the darkest of many patches, and range is divided by
        // alpha.
        let size = 1.0
            + v.iter().chain(&by.rgb).map(|v| v.abs()).sum::<f64>()
            + [by.alpha, by.range, smooth.v_alpha[i], dark.v_alpha[i]].map(f64::abs).iter().sum::<f64>();
        let pairs = (0..3)
            .map(|c| (f64::from(found.v_image[i][c]), by.rgb[c]))
            .chain([(f64::from(found.v_image[i][3]), by.alpha), (f64::from(found.v_range[i]), by.range)]);
        for (k, (kernel, twin)) in pairs.enumerate() {
            assert!((kernel - twin).abs() < 2e-5 * size, "{what}: pixel {i}, {k}: {kernel} and {twin}");
        }
    }
    let size = v_water.iter().map(|v| v.abs()).fold(blended.len() as f64, f64::max);
    for (k, (kernel, twin)) in found.v_water.iter().zip(v_water).enumerate() {
        assert!((kernel - twin).abs() < 2e-5 * size, "{what}: water {k}: {kernel} and {twin}");
    }
    if refinement.is_some() {
        let size = v_refinement.iter().map(|v| v.abs()).fold(blended.len() as f64, f64::max);
        for (k, (kernel, twin)) in found.v_refinement.iter().zip(v_refinement).enumerate() {
            assert!((kernel - twin).abs() < 2e-5 * size, "{what}: eq. 9, {k}: {kernel} and {twin}");
        }
    }
}

const LIGHTS: [(DarkChannelOn, LossLight); 4] = [
    (DarkChannelOn::Render, LossLight::Srgb),
    (DarkChannelOn::Render, LossLight::Linear),
    (DarkChannelOn::Photograph, LossLight::Srgb),
    (DarkChannelOn::Photograph, LossLight::Linear),
];

/// Sizes, each with its patch at full size; the kernels use half of the patch. Cases: one pixel, patches of
/// one pixel, whole runs of eight, and patches larger than the picture.
const SIZES: [([u32; 2], u32); 6] =
    [([1, 1], 41), ([33, 31], 1), ([32, 16], 5), ([75, 53], 41), ([9, 100], 7), ([29, 3], 255)];

#[test]
fn gradients_of_priors_match_the_twins_through_every_water() {
    for gpu in layouts() {
        for composed in COMPOSITIONS {
            for (on, loss_light) in LIGHTS {
                for (k, (size, patch)) in SIZES.into_iter().enumerate() {
                    let masked = [0.0, 0.3][k % 2];
                    let picture = Picture::random(400 + k as u32, size, masked);
                    let config = WaterConfig {
                        loss_light,
                        alpha_background: 0.0,
                        surface_alpha_weight: 0.0,
                        priors: weighty(picture.image.len(), patch, on),
                        ..with(composed)
                    };
                    check(
                        &gpu,
                        &format!("{composed:?}, {on:?}, {loss_light:?}, {size:?}"),
                        &picture,
                        &config,
                    );
                }
            }
        }
    }
}

#[test]
fn gradients_of_priors_match_the_twins_through_dbdr() {
    for gpu in layouts() {
        for (on, loss_light) in LIGHTS {
            let (size, patch) = ([75, 53], 41);
            let picture = Picture::random(450, size, 0.3);
            let config = WaterConfig {
                loss_light,
                alpha_background: 0.0,
                surface_alpha_weight: 0.0,
                priors: weighty(picture.image.len(), patch, on),
                dbdr: DbdrConfig { mode: DbdrMode::Maps, ..DbdrConfig::default() },
                ..with((Medium::PerPixel, Blend::Linear))
            };
            check(&gpu, &format!("{on:?}, {loss_light:?}"), &picture, &config);
        }
    }
}

#[test]
fn the_first_of_equal_pixels_in_a_patch_takes_the_gradient() {
    for gpu in layouts() {
        for (size, patch) in SIZES {
            let picture = Picture::flat(size);
            let config = WaterConfig {
                alpha_background: 0.0,
                surface_alpha_weight: 0.0,
                priors: weighty(picture.image.len(), patch, DarkChannelOn::Render),
                ..with(COMPOSITIONS[0])
            };
            check(&gpu, &format!("flat, {size:?}, patch {patch}"), &picture, &config);
        }
    }
}

#[test]
fn open_water_masks_and_nan_pixels_leave_all_else_finite() {
    for gpu in layouts() {
        for composed in COMPOSITIONS {
            let size = [41, 23];
            let mut open = Picture::random(440, size, 0.0);
            open.image.fill([0.0; 4]);
            open.range.fill(0.0);
            let masked = Picture::random(441, size, 1.1);
            for (picture, priors_matter) in
                [(&open, false), (&masked, false), (&Picture::random(442, size, 0.1), true)]
            {
                let with_priors = |priors: PriorsConfig| {
                    by_kernels(&gpu, picture, WaterConfig { priors, ..with(composed) })
                };
                let plain = with_priors(PriorsConfig::default());
                let found = with_priors(weighty(open.image.len(), 41, DarkChannelOn::Render));
                assert!(found.v_image.iter().flatten().chain(&found.v_range).all(|v| v.is_finite()));
                assert_eq!(found.v_image != plain.v_image, priors_matter, "{composed:?}");
            }
        }
        let mut torn = Picture::random(443, [41, 23], 0.0);
        torn.image[200] = [f32::NAN, f32::NAN, f32::NAN, 1.0];
        torn.image[300] = [f32::INFINITY, f32::NEG_INFINITY, 0.5, 1.0];
        let priors = weighty(torn.image.len(), 41, DarkChannelOn::Render);
        let found = by_kernels(&gpu, &torn, WaterConfig { priors, ..with(COMPOSITIONS[0]) });
        for (i, v) in found.v_image.iter().enumerate().filter(|(i, _)| ![200, 300].contains(i)) {
            assert!(v.iter().chain([&found.v_range[i]]).all(|v| v.is_finite()), "pixel {i}: {v:?}");
        }
        assert!(found.v_water.iter().all(|v| v.is_finite()), "{:?}", found.v_water);
    }
}

#[test]
fn priors_act_only_with_a_weight_and_after_their_start() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    for composed in COMPOSITIONS {
        let train = |priors: PriorsConfig| {
            let water = WaterConfig { priors, alpha_background: 0.0, ..with(composed) };
            let mut trainer =
                Trainer::new(Arc::clone(&gpu), watery(&photographs, config(20), water)).unwrap();
            trainer.advance(20).unwrap();
            (trainer.gaussians().unwrap(), trainer.water().unwrap().unwrap())
        };
        let (plain, plain_water) = train(PriorsConfig::default());
        let weightless = PriorsConfig {
            dark_channel_negative: 7.0,
            dark_channel_patch: 3,
            dark_channel_on: DarkChannelOn::Photograph,
            from: 0.2,
            rise: 0.1,
            ..PriorsConfig::default()
        };
        let later =
            PriorsConfig { dark_channel: 1.0, depth_smoothness: 2.0, from: 1.0, ..Default::default() };
        for priors in [weightless, later.clone()] {
            let (model, water) = train(priors);
            assert_same_model("priors that are off", &plain, &model);
            assert_same_bits("water", &plain_water.to_array(), &water.to_array());
        }
        for on in [
            PriorsConfig { dark_channel: 1.0, ..PriorsConfig::default() },
            PriorsConfig { depth_smoothness: 2.0, ..PriorsConfig::default() },
            PriorsConfig { from: 0.5, ..later },
        ] {
            let (model, _) = train(on.clone());
            assert!(model.means != plain.means, "{composed:?}: {on:?} has no effect");
        }
    }
}

#[test]
fn depth_smoothness_makes_depth_smoother() {
    let Some(gpu) = device() else { return };
    let photographs = photographs(&gpu, 64, 48);
    let roughness = |weight: f32| {
        let priors = PriorsConfig { depth_smoothness: weight, ..PriorsConfig::default() };
        let water = WaterConfig { priors, ..with((Medium::PerGaussian, Blend::Srgb)) };
        let mut trainer = Trainer::new(Arc::clone(&gpu), watery(&photographs, config(150), water)).unwrap();
        trainer.advance(150).unwrap();
        let model = trainer.gaussians().unwrap();
        let mut renderer = fathom_core::gpu::Renderer::new(Arc::clone(&gpu), &model).unwrap();
        let each = photographs.views.iter().map(|view| {
            let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
            let depth: Vec<f64> = rendered
                .range
                .iter()
                .zip(&rendered.alpha)
                .map(|(range, alpha)| if *alpha > 0.1 { f64::from(range / alpha) } else { 0.0 })
                .collect();
            let pairs = depth.windows(2).filter(|pair| pair.iter().all(|depth| *depth > 0.0));
            pairs.map(|pair| (pair[0] - pair[1]).abs()).sum::<f64>() / depth.len() as f64
        });
        each.sum::<f64>()
    };
    let (plain, smooth) = (roughness(0.0), roughness(2.0));
    assert!(smooth < 0.8 * plain, "{smooth} with, {plain} without");
}
