//! View embeddings (FiLM, eq. 10): kernels against the twin, and their effect on a run.

use std::sync::Arc;

use fathom_core::config::{Composition, FilmConfig, TrainConfig, WaterConfig};
use fathom_core::gpu::{Gpu, ListLimits, Output, Recorder, Renderer, WaterView, counter};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::train::{FILM_UNITS, Film, FilmStep, TrainRun, Trainer};
use fathom_core::views::InMemory;
use fathom_core::water::Water;
use fathom_twins::{FilmPicture, FilmState, FilmWeights};

use crate::device::{device, layouts, poison, storage};
use crate::exposure::darkened;
use crate::trainer::{assert_same_model, config, same_however_it_runs};
use crate::water::{sunk, watery};

const RATE: f32 = 0.02;

fn on(cell: u32) -> FilmConfig {
    FilmConfig { on: true, cell, ..FilmConfig::default() }
}

/// `[pixels]` vec4 of noise between `low` and `low + 1`.
fn noise(seed: u32, pixels: u32, low: f32) -> Vec<[f32; 4]> {
    let u = |i, c| low + uniform_at(seed, Stream::Test, i, c);
    (0..pixels).map(|i| [u(i, 0), u(i, 1), u(i, 2), u(i, 3)]).collect()
}

fn wide(pixels: &[[f32; 4]]) -> Vec<[f64; 3]> {
    pixels.iter().map(|p| [p[0], p[1], p[2]].map(f64::from)).collect()
}

/// The weights on the device, in the layout of the twin.
fn weights(film: &Film, gpu: &Gpu) -> FilmWeights {
    let rows = film.weights(gpu).unwrap();
    FilmWeights {
        first: std::array::from_fn(|j| rows[j][0].map(f64::from)),
        second: std::array::from_fn(|j| std::array::from_fn(|c| f64::from(rows[j][1][c]))),
    }
}

#[track_caller]
fn assert_near(
    what: &str,
    kernel: impl Iterator<Item = f32>,
    twin: impl Iterator<Item = f64>,
    tolerance: f64,
) {
    let mut compared = 0;
    for (i, (kernel, twin)) in kernel.zip(twin).enumerate() {
        let difference = (f64::from(kernel) - twin).abs();
        assert!(difference <= tolerance * (1.0 + twin.abs()), "{what}, number {i}: {kernel} and {twin}");
        compared += 1;
    }
    assert!(compared > 0, "{what}: nothing was compared");
}

#[test]
fn colours_gradients_and_steps_of_any_size_match_the_twin() {
    const VIEWS: u32 = 3;
    for gpu in layouts() {
        let mut film = Film::new(&gpu, &on(16), VIEWS, 7).unwrap();
        let mut twin = FilmState::new(weights(&film, &gpu), VIEWS as usize);
        let (mut seen, mut cells_seen) = ([0; VIEWS as usize], Vec::new());
        let counters = storage(&gpu, &[0_u32; counter::COUNT as usize]);
        // One cell, cells in one direction, many cells, and a small size after a large one. Not all sides are
        // multiples of a cell.
        let sizes = [(1, 1), (17, 5), (40, 7), (75, 53), (32, 32), (130, 99), (9, 100), (23, 25)];
        for (k, (width, height)) in sizes.into_iter().enumerate() {
            let (pixels, view, seed) = (width * height, (2 * k as u32) % VIEWS, 600 + k as u32);
            let (what, size) = (format!("{width}x{height}"), [width, height]);
            let (render, v_filmed) = (noise(seed, pixels, 0.0), noise(seed + 30, pixels, -0.4));
            let (image, v_image) = (storage(&gpu, &render), storage(&gpu, &v_filmed));
            film.prepare(&gpu, size).unwrap();
            for buffer in film.scratch().unwrap() {
                poison(&gpu, buffer);
            }
            seen[view as usize] += 1;
            let (steps, view_steps) = (k as u32 + 1, seen[view as usize]);
            let step = FilmStep { view, size, rate: Some(RATE), steps, view_steps };
            let mut recorder = Recorder::new(&gpu);
            let filmed = film.record(&gpu, &mut recorder, &image, step).unwrap();
            film.record_backward(&mut recorder, &image, &v_image, &counters, step).unwrap();
            recorder.submit();
            let filmed: Vec<[f32; 4]> = gpu.read(filmed, 0, pixels as usize).unwrap();
            let v_rendered: Vec<[f32; 4]> = gpu.read(&v_image, 0, pixels as usize).unwrap();

            let cells = film.cells(size);
            cells_seen.push(cells[0] * cells[1]);
            let (rgb, v) = (wide(&render), wide(&v_filmed));
            let picture = FilmPicture { rgb: &rgb, size, cells };
            let embedding = twin.embeddings[view as usize];
            let expected = fathom_twins::film(&picture, &twin.weights, &embedding);
            let by = fathom_twins::film_backward(&picture, &twin.weights, &embedding, &v);
            let flat =
                |pixels: &[[f32; 4]]| pixels.iter().flat_map(|p| [p[0], p[1], p[2]]).collect::<Vec<f32>>();
            // Means of up to 1e3 numbers and a sum of 16 products; the twin has the weights of the device.
            assert_near(&what, flat(&filmed).into_iter(), expected.into_iter().flatten(), 2e-5);
            let gradients = flat(&v_rendered).into_iter();
            assert_near(&format!("{what}, gradient"), gradients, by.rgb.iter().copied().flatten(), 2e-5);
            assert!(filmed.iter().zip(&render).all(|(a, b)| a[3] == b[3]), "{what}: alpha must not change");
            assert!(
                v_rendered.iter().zip(&v_filmed).all(|(a, b)| a[3] == b[3]),
                "{what}: the gradient of alpha must not change"
            );

            twin.step(view as usize, &by, RATE.into(), f64::from(RATE) * f64::from(VIEWS).sqrt());
            let embeddings = film.embeddings(&gpu).unwrap();
            let found = embeddings.iter().flatten().flatten().copied();
            // Adam's step is a ratio of two sums, which may cancel to a few digits.
            assert_near(
                &format!("{what}, embeddings"),
                found,
                twin.embeddings.iter().flatten().flatten().copied(),
                2e-4,
            );
            let now = weights(&film, &gpu);
            for j in 0..FILM_UNITS {
                let pairs = now.first[j].iter().zip(&twin.weights.first[j]);
                for (kernel, expected) in pairs.chain(now.second[j].iter().zip(&twin.weights.second[j])) {
                    assert!((kernel - expected).abs() < 2e-4, "{what}: {j}: {kernel} and {expected}");
                }
            }
            // The next size starts from the state of the device.
            twin.weights = now;
            for (twin, kernel) in twin.embeddings.iter_mut().zip(&embeddings) {
                *twin = kernel.map(|pair| pair.map(f64::from));
            }
        }
        assert!(cells_seen.contains(&1) && cells_seen.iter().any(|cells| *cells > 40), "{cells_seen:?}");
    }
}

#[test]
fn nothing_steps_with_short_lists_or_outside_the_schedule() {
    for gpu in layouts() {
        let mut film = Film::new(&gpu, &on(8), 3, 7).unwrap();
        film.prepare(&gpu, [20, 10]).unwrap();
        let image = storage(&gpu, &noise(1, 200, 0.0));
        let mut short = [0_u32; counter::COUNT as usize];
        short[counter::OVERFLOW as usize] = 2;
        let bits = |film: &Film| -> Vec<Vec<u8>> {
            film.arrays().map(|(buffer, length)| gpu.read(buffer, 0, length).unwrap()).to_vec()
        };
        let before = bits(&film);
        let cases = [
            (short, Some(0.1), 0.4, false),
            ([0; 16], None, 0.4, false),
            ([0; 16], Some(0.1), f32::NAN, false),
        ];
        for (counters, rate, v, changes) in cases.into_iter().chain([([0; 16], Some(0.1), 0.4, true)]) {
            let (counters, v_image) = (storage(&gpu, &counters), storage(&gpu, &[[v; 4]; 200]));
            let step = FilmStep { view: 1, size: [20, 10], rate, steps: 1, view_steps: 1 };
            let mut recorder = Recorder::new(&gpu);
            film.record(&gpu, &mut recorder, &image, step).unwrap();
            film.record_backward(&mut recorder, &image, &v_image, &counters, step).unwrap();
            recorder.submit();
            assert_eq!(bits(&film) != before, changes, "{rate:?} {v}");
        }
    }
}

const WATER: Water =
    Water { beta_d: [0.16, 0.06, 0.05], beta_b: [0.13, 0.07, 0.06], b_inf: [0.025, 0.11, 0.19] };

/// Eighteen photographs under water; every other one has 0.6 of the brightness.
fn uneven(gpu: &Arc<Gpu>) -> InMemory {
    let composition = Composition::PixelsSrgb;
    let view = WaterView {
        water: WATER,
        refinement: None,
        by_direction: None,
        composition,
        output: Output::Underwater,
    };
    darkened(&sunk(gpu, view), |i| if i % 2 == 0 { 0.6 } else { 1.0 })
}

/// A run whose water is known.
fn filmed(photographs: &InMemory, config: TrainConfig, film: FilmConfig) -> TrainRun {
    let mut run = watery(photographs, config, WaterConfig { film, ..WaterConfig::default() });
    let medium = run.medium.as_mut().unwrap();
    (medium.water, medium.is_free) = (WATER, false);
    run
}

#[test]
fn embeddings_that_do_not_learn_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = uneven(&gpu);
    let trained = |film: FilmConfig| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), filmed(&photographs, config(24), film)).unwrap();
        trainer.advance(24).unwrap();
        (trainer.gaussians().unwrap(), trainer.film_embeddings().unwrap())
    };
    let (plain, none) = trained(FilmConfig::default());
    assert!(none.is_empty());
    let (still, zeros) = trained(FilmConfig { lr: 0.0, lr_end: 0.0, ..on(16) });
    assert_same_model("a rate of 0", &plain, &still);
    assert!(zeros.iter().flatten().flatten().all(|value| *value == 0.0));
    // With 18 views and 24 iterations, the second epoch is the first to begin in the second half.
    let (late, moved) = trained(FilmConfig { from: 0.5, ..on(16) });
    assert_eq!(moved.iter().filter(|embedding| embedding.iter().flatten().any(|v| *v != 0.0)).count(), 18);
    assert_ne!(plain.means, late.means, "embeddings that learn must change the model");
}

#[test]
fn embeddings_fit_two_exposures_and_stay_out_of_measurements() {
    let Some(gpu) = device() else { return };
    let photographs = uneven(&gpu);
    let trained = |film: FilmConfig| {
        let mut trainer = Trainer::new(Arc::clone(&gpu), filmed(&photographs, config(360), film)).unwrap();
        trainer.advance(342).unwrap();
        trainer.advance(18).unwrap();
        trainer
    };
    let plain = trained(FilmConfig::default()).progress().loss;
    let mut trainer = trained(FilmConfig { lr: 0.01, lr_end: 1e-3, ..on(16) });
    let loss = trainer.progress().loss;
    assert!(loss < 0.7 * plain, "loss {loss} with embeddings, {plain} without");

    let embeddings = trainer.film_embeddings().unwrap();
    for j in 0..FILM_UNITS {
        for k in 0..2 {
            let mean = embeddings.iter().map(|embedding| embedding[j][k]).sum::<f32>() / 18.0;
            assert!(mean.abs() < 1e-5, "the mean of number {j}, {k} is {mean}");
        }
    }
    // Measurements during a run use the model under its water, without embeddings.
    let measured = trainer.measure(&photographs, || true).unwrap().unwrap().psnr_db;
    let (model, water) = (trainer.gaussians().unwrap(), trainer.water_view().unwrap());
    let mut renderer = Renderer::new(Arc::clone(&gpu), &model).unwrap().with_water(water);
    let each = photographs.views.iter().zip(&photographs.images).map(|(view, image)| {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3]).unwrap();
        psnr(&quantised(image.width, image.height, &rendered.rgb), image)
    });
    let alone = each.sum::<f64>() / photographs.views.len() as f64;
    assert!((measured - alone).abs() < 1e-9, "{measured} dB measured, {alone} dB of the model alone");
}

#[test]
fn interruptions_short_lists_and_bands_change_no_byte() {
    let Some(gpu) = device() else { return };
    let photographs = uneven(&gpu);
    let new = || filmed(&photographs, config(40), on(16));
    let learnt =
        |trainer: &mut Trainer| bytemuck::cast_slice::<_, u32>(&trainer.film_embeddings().unwrap()).to_vec();
    let limits = ListLimits { visible: 100, intersections: 200 };
    same_however_it_runs(&gpu, "embeddings", new, [0, 1, 25], limits, learnt);
}
