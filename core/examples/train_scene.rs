//! Trains a scene on this machine's adapter without any service and reports the cost, for `make bench`.
//!
//! `cargo run --example train_scene -- SCENE [--iterations N] [--max-gaussians N] [--max-resolution PX]
//! [--KEY VALUE]...` where KEY is any field of `TrainConfig`. Further options:
//! - `--evaluate-every N` measures held-out views during the run;
//! - `--time-every N` prints the device time of each stage during the run;
//! - `--initial-points N` starts from this many of the scene's points;
//! - `--model PATH` writes the model;
//! - `--water.KEY VALUE` sets any field of `WaterConfig`, `--water.priors.KEY` one inside it; `medium` is
//!   `none` by default;
//! - `--shader-checks BOOL` makes shaders check indices and loops (default: in debug builds).
//!
//! If the scene has `truth/`, J is compared with it. At the end it prints one JSON object.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use cpu_time::cpu_seconds;
use fathom_core::config::{DataConfig, Medium, TrainConfig, WaterConfig};
use fathom_core::floaters::clear_ranges;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, GpuOptions, KernelTime, Output, Renderer, WaterView};
use fathom_core::memory::{MemoryForecast, RunSize, visible_in_fullest_view};
use fathom_core::metrics::{psnr, quantised, ssim};
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::ply::write_model;
use fathom_core::rng::{Stream, permutation};
use fathom_core::scene::{Points, Purpose, Scene, learning_scale, load_scene};
use fathom_core::train::{
    TrainRun, Trainer, initial_gaussians, starting_water, surface_points, with_ray_maps,
};
use fathom_core::views::{InMemory, PackedImage, TrainView, ViewSource};
use glam::DVec3;

#[path = "shared/cpu_time.rs"]
mod cpu_time;
#[path = "shared/floor.rs"]
mod floor;

type Fallible<T> = Result<T, Box<dyn Error>>;

/// Iterations at the end of the run whose stages are timed. They run one by one, so the means over the run
/// exclude them.
const TIMED: u32 = 12;

/// The held-out photographs of a scene, or the others.
fn photographs(scene: &Scene, data: &DataConfig, held_out: bool) -> Fallible<InMemory> {
    let (mut views, mut images) = (Vec::new(), Vec::new());
    for (index, view) in scene.views.iter().enumerate() {
        if (index as u32).is_multiple_of(data.test_every) != held_out {
            continue;
        }
        let camera = scene.camera(view.camera_id).ok_or("a view refers to a missing camera")?;
        let bytes = std::fs::read(view.image.as_ref().ok_or("a view has no photograph")?)?;
        let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
        let (_, image) = prepare(&photograph, camera, data.mask_keep, data.max_resolution)?;
        let camera = prepared_camera(camera, data.max_resolution)?;
        views.push(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 });
        images.push(Arc::new(image));
    }
    Ok(InMemory { views, images })
}

struct Arguments {
    scene: PathBuf,
    config: TrainConfig,
    water: WaterConfig,
    data: DataConfig,
    evaluate_every: u32,
    time_every: u32,
    shader_checks: Option<bool>,
    initial_points: Option<u32>,
    model: Option<PathBuf>,
}

fn arguments() -> Fallible<Arguments> {
    let mut words = std::env::args().skip(1);
    let scene = PathBuf::from(words.next().ok_or("usage: train_scene SCENE [--key value]...")?);
    let config = TrainConfig { iterations: 2000, max_gaussians: 60_000, ..TrainConfig::default() };
    let mut table = serde_json::to_value(&config)?;
    let mut water = serde_json::to_value(WaterConfig::none())?;
    let mut arguments = Arguments {
        scene,
        config,
        water: WaterConfig::none(),
        data: DataConfig::default(),
        evaluate_every: 0,
        time_every: 0,
        shader_checks: None,
        initial_points: None,
        model: None,
    };
    while let Some(key) = words.next() {
        let value = words.next().ok_or_else(|| format!("{key} has no value"))?;
        match key.trim_start_matches("--").replace('-', "_").as_str() {
            "max_resolution" => arguments.data.max_resolution = value.parse()?,
            "evaluate_every" => arguments.evaluate_every = value.parse()?,
            "time_every" => arguments.time_every = value.parse()?,
            "shader_checks" => arguments.shader_checks = Some(value.parse()?),
            "model" => arguments.model = Some(value.into()),
            "initial_points" => arguments.initial_points = Some(value.parse()?),
            key if let Some(key) = key.strip_prefix("water.") => {
                let path = format!("/{}", key.replace('.', "/"));
                let entry =
                    water.pointer_mut(&path).ok_or_else(|| format!("there is no option water.{key}"))?;
                *entry = serde_json::from_str(&value).unwrap_or_else(|_| value.into());
            }
            key if table.get(key).is_some() => table[key] = serde_json::from_str(&value)?,
            key => return Err(format!("there is no option {key}").into()),
        }
    }
    arguments.config = serde_json::from_value(table)?;
    arguments.water = serde_json::from_value(water)?;
    Ok(arguments)
}

fn evaluate(
    gpu: &Arc<Gpu>,
    model: &Gaussians,
    mip_filter: bool,
    water: Option<WaterView>,
    test: &InMemory,
) -> Fallible<(f64, f64)> {
    let mut renderer = Renderer::new(Arc::clone(gpu), model)?.with_mip_filter(mip_filter).with_water(water);
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

/// The most memory that this process has had, with the device's on a CPU adapter; `None` except on Linux.
fn process_peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let kibibytes = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.trim();
    Some(1024 * kibibytes.split_whitespace().next()?.parse::<u64>().ok()?)
}

fn add(times: &mut Vec<KernelTime>, more: Vec<KernelTime>) {
    for time in more {
        match times.iter_mut().find(|have| have.kernel == time.kernel) {
            Some(have) => {
                have.seconds += time.seconds;
                have.dispatches += time.dispatches;
            }
            None => times.push(time),
        }
    }
}

/// Keeps `count` points, chosen by the seed, in their order.
fn thin(points: &mut Points, count: u32, seed: u32) {
    let all = points.positions.len();
    let mut kept = permutation(seed, Stream::Test, 0, all);
    kept.truncate(count as usize);
    kept.sort_unstable();
    *points = points.select(&kept);
}

/// The forecast of `fathom inspect` for this adapter.
fn forecast(gpu: &Gpu, run: &TrainRun, points: &Points) -> MemoryForecast {
    let points: Vec<DVec3> = points.positions.iter().map(|point| DVec3::from(point.map(f64::from))).collect();
    let views = run.views.views();
    let trained = run.config.max_gaussians.into();
    let pictures: Vec<[u32; 2]> = views.iter().map(|view| [view.camera.width, view.camera.height]).collect();
    let visible =
        visible_in_fullest_view(views.iter().map(|view| (view.camera, view.pose)), &[(&points, trained)]);
    let size = RunSize {
        settings: run.settings(),
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

/// A picture of the ground truth; `None` if there is none.
fn truth_picture(folder: &std::path::Path, part: &str, name: &str) -> Option<PackedImage> {
    let stem = folder.join("truth").join(part).join(name);
    let path = [stem.clone(), stem.with_extension("png")].into_iter().find(|path| path.is_file())?;
    let picture = image::open(path).ok()?.to_rgb8();
    let pixels = picture.pixels().map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect();
    Some(PackedImage { width: picture.width(), height: picture.height(), pixels })
}

/// Mean PSNR of J where the truth is valid, rendered without the water, and of the model in a plain viewer
/// against that render.
fn clear_quality(
    gpu: &Arc<Gpu>,
    model: &Gaussians,
    water: WaterView,
    test: &InMemory,
    folder: &std::path::Path,
) -> Fallible<Option<(f64, f64)>> {
    let mut clear = Renderer::new(Arc::clone(gpu), model)?
        .with_water(Some(WaterView { output: Output::Restored, ..water }));
    let mut plain = Renderer::new(Arc::clone(gpu), model)?;
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    for view in &test.views {
        let pictures =
            (truth_picture(folder, "clear", &view.name), truth_picture(folder, "valid", &view.name));
        let (Some(truth), Some(valid)) = pictures else { continue };
        let picture = |renderer: &mut Renderer| -> Fallible<PackedImage> {
            let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
            Ok(quantised(rendered.width, rendered.height, &rendered.rgb))
        };
        let (linear, viewer) = (picture(&mut clear)?, picture(&mut plain)?);
        if (truth.width, truth.height) == (linear.width, linear.height) {
            let mut truth = truth;
            for (pixel, valid) in truth.pixels.iter_mut().zip(&valid.pixels) {
                *pixel = (*pixel & 0x00ff_ffff) | (valid << 24);
            }
            sums[0] += psnr(&linear, &truth);
        }
        sums[1] += psnr(&viewer, &linear);
        count += 1.0;
    }
    Ok((count > 0.0).then(|| (sums[0] / count, sums[1] / count)))
}

fn main() -> Fallible<()> {
    let Arguments {
        scene: folder,
        config,
        water,
        data,
        evaluate_every,
        time_every,
        shader_checks,
        initial_points,
        model: model_path,
    } = arguments()?;
    let mut scene = load_scene(&folder, Purpose::Train, &data)?;
    if let Some(count) = initial_points {
        thin(&mut scene.points, count, config.seed);
    }
    let (mut train, test) = (photographs(&scene, &data, false)?, photographs(&scene, &data, true)?);
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, shader_checks, ..Default::default() })?;
    let unit = scene.viewing_distance().unwrap_or(1.0);
    let every = data.test_every as usize;
    let scene_views: Vec<u32> =
        (0..scene.views.len()).filter(|view| !view.is_multiple_of(every)).map(|view| view as u32).collect();
    if water.medium != Medium::None && water.floater_weight > 0.0 {
        let indexed: Vec<_> =
            scene_views.iter().zip(&train.views).map(|(i, view)| (*i, view.camera, view.pose)).collect();
        for (view, range) in train.views.iter_mut().zip(clear_ranges(&indexed, &scene.points)) {
            view.clear_range = range;
        }
    }
    let train = Arc::new(train);
    let (medium, points) = match starting_water(&water, unit, &scene.points, train.as_ref(), &scene_views)? {
        Some(start) => (Some(start.medium), start.points),
        None => (None, scene.points.clone()),
    };
    let train: Arc<dyn ViewSource> = train;
    let train = match &medium {
        Some(medium) => with_ray_maps(medium, &points, &train, &scene_views)?,
        None => train,
    };
    let run = TrainRun {
        focus: initial_gaussians(&points, train.views(), &config, medium.as_ref())?,
        context: Gaussians::empty(config.sh_degree),
        surfaces: surface_points(&points, train.views(), &scene_views, &config, medium.as_ref(), |_| true)?,
        medium,
        surface: None,
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
            let (psnr, ssim) =
                evaluate(&gpu, &trainer.gaussians()?, config.mip_filter, trainer.water_view()?, &test)?;
            eprintln!(
                "{:6} loss {:.4} gaussians {} psnr {psnr:.2} ssim {ssim:.4} wall {wall:.1} s cpu {cpu:.1} s",
                progress.iteration, progress.loss, progress.gaussians
            );
            if let Some(water) = trainer.water()? {
                eprintln!("       {:.4?}", water.to_array());
            }
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
                eprintln!("    {:24} {:8.2} ms", time.kernel, time.seconds * 1e3);
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
    if let Some(path) = &model_path {
        let record = trainer.water_record(0.0)?;
        let comments: Vec<String> =
            record.iter().map(|record| record.to_comment()).collect::<Result<_, _>>()?;
        write_model(path, &model, &comments)?;
    }
    // Before the renderer of the evaluation adds its memory.
    let device = gpu.memory();
    let (psnr, ssim) = evaluate(&gpu, &model, config.mip_filter, trainer.water_view()?, &test)?;
    let memory = trainer.memory();
    let found = trainer.water()?;
    let clear = trainer
        .water_view()?
        .map(|view| clear_quality(&gpu, &model, view, &test, &folder))
        .transpose()?
        .flatten();
    let pictures: BTreeSet<[u32; 2]> =
        test.images.iter().map(|picture| [picture.width, picture.height]).collect();
    let total: f64 = stages.iter().map(|time| time.seconds).sum();
    let floor = floor::floor_cpu_seconds(needed);
    let is_cpu = gpu.adapter().is_cpu;
    let shares: serde_json::Map<String, serde_json::Value> = stages
        .iter()
        .map(|time| (time.kernel.to_owned(), serde_json::json!((time.seconds / total * 1e4).round() / 1e4)))
        .collect();
    let result = serde_json::json!({
        "adapter": gpu.adapter().name,
        "driver": gpu.adapter().driver,
        "iterations": config.iterations,
        "gaussians": model.len(),
        "pictures": pictures,
        "psnr": psnr,
        "ssim": ssim,
        "wall_seconds": wall,
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
        "water": found,
        "water_record": trainer.water_record(0.0)?,
        "clear_psnr": clear.map(|(truth, _)| truth),
        "viewer_psnr": clear.map(|(_, viewer)| viewer),
        "water_steps_left_out": trainer.water_steps_left_out()?,
        "list_capacities": trainer.list_capacities(),
        "process_peak_bytes": process_peak_bytes(),
        "device_peak_bytes": device.map(|memory| memory.peak_bytes),
        "forecast": forecast,
        "forecast_bytes": forecast.total(),
        "share_of_stage": shares,
    });
    println!("{}", serde_json::to_string_pretty(&result)?);
    Ok(())
}
