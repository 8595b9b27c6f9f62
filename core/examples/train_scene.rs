//! Trains a scene on this machine's adapter without any service, and says what it cost: for `make bench`.
//!
//! `cargo run --example train_scene -- SCENE [--iterations N] [--max-gaussians N] [--max-resolution PX] [--KEY VALUE]...`
//! where KEY is any field of `TrainConfig`. `--evaluate-every N` measures held-out views on the way and
//! `--time-every N` prints the device time of each stage then; `--initial-points N` starts from so many of the scene's points,
//! and `--shader-checks BOOL` says whether shaders check indices and loops (default: in debug builds).
//! One JSON object comes out at the end.

use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use cpu_time::cpu_seconds;
use fathom_core::config::{DataConfig, TrainConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, GpuOptions, Renderer, StageTime};
use fathom_core::memory::{MemoryForecast, RunSize, visible_in_fullest_view};
use fathom_core::metrics::{psnr, quantised, ssim};
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::rng::{Stream, permutation};
use fathom_core::scene::{Points, Purpose, Scene, learning_scale, load_scene};
use fathom_core::train::{TrainRun, Trainer, initial_gaussians};
use fathom_core::views::{InMemory, TrainView};
use glam::DVec3;

#[path = "shared/cpu_time.rs"]
mod cpu_time;
#[path = "shared/floor.rs"]
mod floor;

type Fallible<T> = Result<T, Box<dyn Error>>;

/// Iterations at the end of the run whose stages are timed; they are timed one by one, so the means over the run do not
/// count them.
const TIMED: u32 = 12;

/// Those photographs of a scene that are held out, or the others.
fn photographs(scene: &Scene, data: &DataConfig, held_out: bool) -> Fallible<InMemory> {
    let (mut views, mut images) = (Vec::new(), Vec::new());
    for (index, view) in scene.views.iter().enumerate() {
        if (index as u32).is_multiple_of(data.test_every) != held_out {
            continue;
        }
        let camera = scene.camera(view.camera_id).ok_or("a view names a camera that is not there")?;
        let bytes = std::fs::read(view.image.as_ref().ok_or("a view has no photograph")?)?;
        let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
        let (_, image) = prepare(&photograph, camera, data.mask_keep, data.max_resolution)?;
        let camera = prepared_camera(camera, data.max_resolution)?;
        views.push(TrainView { name: view.name.clone(), camera, pose: view.pose });
        images.push(Arc::new(image));
    }
    Ok(InMemory { views, images })
}

struct Arguments {
    scene: PathBuf,
    config: TrainConfig,
    data: DataConfig,
    evaluate_every: u32,
    time_every: u32,
    shader_checks: Option<bool>,
    initial_points: Option<u32>,
}

fn arguments() -> Fallible<Arguments> {
    let mut words = std::env::args().skip(1);
    let scene = PathBuf::from(words.next().ok_or("usage: train_scene SCENE [--key value]...")?);
    let config = TrainConfig { iterations: 2000, max_gaussians: 60_000, ..TrainConfig::default() };
    let mut table = serde_json::to_value(&config)?;
    let mut arguments = Arguments {
        scene,
        config,
        data: DataConfig::default(),
        evaluate_every: 0,
        time_every: 0,
        shader_checks: None,
        initial_points: None,
    };
    while let Some(key) = words.next() {
        let value = words.next().ok_or_else(|| format!("{key} has no value"))?;
        match key.trim_start_matches("--").replace('-', "_").as_str() {
            "max_resolution" => arguments.data.max_resolution = value.parse()?,
            "evaluate_every" => arguments.evaluate_every = value.parse()?,
            "time_every" => arguments.time_every = value.parse()?,
            "shader_checks" => arguments.shader_checks = Some(value.parse()?),
            "initial_points" => arguments.initial_points = Some(value.parse()?),
            key if table.get(key).is_some() => table[key] = serde_json::from_str(&value)?,
            key => return Err(format!("there is no option {key}").into()),
        }
    }
    arguments.config = serde_json::from_value(table)?;
    Ok(arguments)
}

fn evaluate(gpu: &Arc<Gpu>, model: &Gaussians, mip_filter: bool, test: &InMemory) -> Fallible<(f64, f64)> {
    let mut renderer = Renderer::new(Arc::clone(gpu), model)?.with_mip_filter(mip_filter);
    let (mut psnr_sum, mut ssim_sum) = (0.0, 0.0);
    for (view, truth) in test.views.iter().zip(&test.images) {
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
        let picture = quantised(rendered.width, rendered.height, &rendered.rgb);
        psnr_sum += psnr(&picture, truth);
        ssim_sum += ssim(&picture, truth);
    }
    let count = test.views.len() as f64;
    Ok((psnr_sum / count, ssim_sum / count))
}

fn add(times: &mut Vec<StageTime>, more: Vec<StageTime>) {
    for time in more {
        match times.iter_mut().find(|have| have.stage == time.stage) {
            Some(have) => {
                have.seconds += time.seconds;
                have.dispatches += time.dispatches;
            }
            None => times.push(time),
        }
    }
}

/// Keeps so many points, chosen by the seed, in their order.
fn thin(points: &mut Points, count: u32, seed: u32) {
    let all = points.positions.len();
    let mut kept = permutation(seed, Stream::Test, 0, all);
    kept.truncate(count as usize);
    kept.sort_unstable();
    *points = points.select(&kept);
}

/// What `fathom inspect` would forecast for this adapter.
fn forecast(gpu: &Gpu, run: &TrainRun, points: &Points) -> MemoryForecast {
    let points: Vec<DVec3> = points.positions.iter().map(|point| DVec3::from(point.map(f64::from))).collect();
    let views = run.views.views();
    let trained = run.config.max_gaussians.into();
    let pictures: Vec<[u32; 2]> = views.iter().map(|view| [view.camera.width, view.camera.height]).collect();
    let visible =
        visible_in_fullest_view(views.iter().map(|view| (view.camera, view.pose)), &[(&points, trained)]);
    let size = RunSize {
        config: &run.config,
        trained,
        frozen: 0,
        visible,
        pictures: &pictures,
        tile: gpu.tile(),
        binding_bytes: gpu.adapter().max_binding_bytes,
        measures: false,
    };
    size.forecast()
}

fn main() -> Fallible<()> {
    let Arguments { scene, config, data, evaluate_every, time_every, shader_checks, initial_points } =
        arguments()?;
    let mut scene = load_scene(&scene, Purpose::Train, &data)?;
    if let Some(count) = initial_points {
        thin(&mut scene.points, count, config.seed);
    }
    let (train, test) = (Arc::new(photographs(&scene, &data, false)?), photographs(&scene, &data, true)?);
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, shader_checks, ..Default::default() })?;
    let run = TrainRun {
        focus: initial_gaussians(&scene.points, &train.views, &config)?,
        context: Gaussians::empty(config.sh_degree),
        extent: learning_scale(scene.extent(), scene.viewing_distance()) as f32,
        views: train,
        config: config.clone(),
    };
    let forecast = forecast(&gpu, &run, &scene.points);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run)?;
    let (mut wall, mut cpu, mut stages) = (0.0, 0.0, Vec::new());
    let mut held_out = Vec::new();
    let last = config.iterations.saturating_sub(TIMED);
    let to_next_look = |iteration: u32| {
        let looks = [evaluate_every, time_every, 100].into_iter().filter(|&every| every > 0);
        looks.map(|every| every - iteration % every).min().unwrap_or(1)
    };
    while trainer.progress().iteration < last {
        let (wall_before, cpu_before) = (Instant::now(), cpu_seconds());
        let progress = trainer
            .advance(to_next_look(trainer.progress().iteration).min(last - trainer.progress().iteration))?;
        wall += wall_before.elapsed().as_secs_f64();
        cpu += cpu_seconds() - cpu_before;
        if evaluate_every > 0 && progress.iteration.is_multiple_of(evaluate_every) {
            let (psnr, ssim) = evaluate(&gpu, &trainer.gaussians()?, config.mip_filter, &test)?;
            eprintln!(
                "{:6} loss {:.4} gaussians {} psnr {psnr:.2} ssim {ssim:.4} wall {wall:.1} s cpu {cpu:.1} s",
                progress.iteration, progress.loss, progress.gaussians
            );
            held_out.push(serde_json::json!({
                "iteration": progress.iteration,
                "psnr": psnr,
                "ssim": ssim,
                "gaussians": progress.gaussians,
                "cpu_seconds": cpu,
            }));
        }
        if time_every > 0 && progress.iteration.is_multiple_of(time_every) {
            for time in trainer.time_iteration()? {
                eprintln!("    {:24} {:8.2} ms", time.stage, time.seconds * 1e3);
            }
        }
    }
    let (mut cpu_at_the_end, mut intersections, mut listed, mut needed) = (0.0, 0.0, 0.0, 0.0);
    while trainer.progress().iteration < config.iterations {
        let before = cpu_seconds();
        add(&mut stages, trainer.time_iteration()?);
        cpu_at_the_end += cpu_seconds() - before;
        let work = trainer.last_workload()?;
        intersections += f64::from(work.intersections);
        listed += work.listed_evaluations as f64;
        needed += work.needed_evaluations as f64;
    }
    let timed = f64::from(TIMED.min(config.iterations).max(1));
    let model = trainer.gaussians()?;
    // Before the renderer of the evaluation comes on top.
    let device = gpu.memory();
    let (psnr, ssim) = evaluate(&gpu, &model, config.mip_filter, &test)?;
    let memory = trainer.memory();
    let total: f64 = stages.iter().map(|time| time.seconds).sum();
    let floor = floor::floor_cpu_seconds(needed);
    let is_cpu = gpu.adapter().is_cpu;
    let shares: serde_json::Map<String, serde_json::Value> = stages
        .iter()
        .map(|time| (time.stage.to_owned(), serde_json::json!((time.seconds / total * 1e4).round() / 1e4)))
        .collect();
    let result = serde_json::json!({
        "adapter": gpu.adapter().name,
        "iterations": config.iterations,
        "gaussians": model.len(),
        "psnr": psnr,
        "ssim": ssim,
        "wall_seconds_per_step": wall / f64::from(last.max(1)),
        "cpu_seconds_per_step": cpu / f64::from(last.max(1)),
        "bytes_per_gaussian": memory.gaussians as f64 / f64::from(config.max_gaussians),
        "per_visible_bytes": memory.per_visible,
        "per_intersection_bytes": memory.per_intersection,
        "device_ms_per_step_at_the_end": total * 1e3 / timed,
        "at_the_end": {
            "steps": timed,
            "cpu_seconds_per_step": cpu_at_the_end / timed,
            "intersections_per_step": intersections / timed,
            "listed_evaluations_per_step": listed / timed,
            "needed_evaluations_per_step": needed / timed,
            "floor_cpu_seconds_per_step": is_cpu.then_some(floor / timed),
            "ratio_to_floor": is_cpu.then_some(cpu_at_the_end / floor),
        },
        "held_out": held_out,
        "list_capacities": trainer.list_capacities(),
        "device_peak_bytes": device.map(|memory| memory.peak_bytes),
        "forecast": forecast,
        "forecast_bytes": forecast.total(),
        "share_of_stage": shares,
    });
    println!("{}", serde_json::to_string_pretty(&result)?);
    Ok(())
}
