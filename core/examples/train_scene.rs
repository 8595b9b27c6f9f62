//! Trains a scene on this machine's adapter without any service: for profiling the trainer alone.
//!
//! `cargo run --example train_scene -- SCENE --iterations 2000 --max-gaussians 60000 --max-resolution 1600`

use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use fathom_core::config::{DataConfig, TrainConfig};
use fathom_core::gpu::{Gpu, GpuOptions, Renderer};
use fathom_core::metrics::{psnr, quantised, ssim};
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::scene::{Purpose, load_scene};
use fathom_core::train::{TrainRun, Trainer, gaussians_from_points};
use fathom_core::views::{PackedImage, TrainView, ViewSource};
use fathom_core::{Result, gaussians::Gaussians};

struct InMemory {
    views: Vec<TrainView>,
    images: Vec<Arc<PackedImage>>,
}

impl ViewSource for InMemory {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        Ok(Arc::clone(&self.images[index]))
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let scene_path = PathBuf::from(arguments.next().ok_or("usage: train_scene SCENE [--key value]...")?);
    let mut config = TrainConfig { iterations: 2000, max_gaussians: 60_000, ..TrainConfig::default() };
    let mut data = DataConfig::default();
    let mut table = serde_json::to_value(&config)?;
    let mut time_every = 0;
    while let (Some(key), Some(value)) = (arguments.next(), arguments.next()) {
        match key.trim_start_matches("--").replace('-', "_").as_str() {
            "max_resolution" => data.max_resolution = value.parse()?,
            "time_every" => time_every = value.parse()?,
            key if table.get(key).is_some() => table[key] = serde_json::from_str(&value)?,
            key => return Err(format!("unknown option {key}").into()),
        }
        config = serde_json::from_value(table.clone())?;
    }
    let scene = load_scene(&scene_path, Purpose::Train, &data)?;
    let load = |held_out: bool| -> Result<InMemory, Box<dyn Error>> {
        let (mut views, mut images) = (Vec::new(), Vec::new());
        for (index, view) in scene.views.iter().enumerate() {
            if (index as u32).is_multiple_of(data.test_every) != held_out {
                continue;
            }
            let camera = scene.camera(view.camera_id).ok_or("camera")?;
            let bytes = std::fs::read(view.image.as_ref().ok_or("image")?)?;
            let photograph = Photograph { name: &view.name, image: &bytes, mask: None };
            let (_, image) = prepare(&photograph, camera, data.mask_keep, data.max_resolution)?;
            let camera = prepared_camera(camera, data.max_resolution)?;
            views.push(TrainView { name: view.name.clone(), camera, pose: view.pose });
            images.push(Arc::new(image));
        }
        Ok(InMemory { views, images })
    };
    let (train, test) = (Arc::new(load(false)?), load(true)?);
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, index: None })?;
    eprintln!("{} train {} test views on {}", train.views.len(), test.views.len(), gpu.adapter().name);
    let evaluate = |model: &Gaussians| -> Result<(f64, f64), Box<dyn Error>> {
        let mut renderer = Renderer::new(Arc::clone(&gpu), model)?;
        let (mut p, mut s) = (0.0, 0.0);
        for (view, truth) in test.views.iter().zip(&test.images) {
            let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
            let picture = quantised(rendered.width, rendered.height, &rendered.rgb);
            p += psnr(&picture, truth);
            s += ssim(&picture, truth);
        }
        Ok((p / test.views.len() as f64, s / test.views.len() as f64))
    };
    let run = TrainRun {
        focus: gaussians_from_points(&scene.points, config.sh_degree)?,
        context: Gaussians::empty(config.sh_degree),
        extent: scene.extent() as f32,
        views: train,
        config: config.clone(),
    };
    let start = Instant::now();
    let mut trainer = Trainer::new(Arc::clone(&gpu), run)?;
    let every = (config.iterations / 10).max(1);
    let mut spent = 0.0;
    while trainer.progress().iteration < config.iterations {
        let begin = Instant::now();
        let progress = trainer.advance(every)?;
        spent += begin.elapsed().as_secs_f64();
        let (p, s) = evaluate(&trainer.gaussians()?)?;
        eprintln!(
            "{:6} loss {:.4} gaussians {} psnr {p:.2} ssim {s:.3} train {spent:.1} s ({:.0} ms/it)",
            progress.iteration,
            progress.loss,
            progress.gaussians,
            begin.elapsed().as_secs_f64() * 1e3 / f64::from(every)
        );
        if time_every > 0 && progress.iteration < config.iterations {
            let times = trainer.time_iteration()?;
            let total: f64 = times.iter().map(|time| time.seconds).sum();
            for time in times.iter().filter(|time| time.seconds > 0.01 * total) {
                eprintln!(
                    "    {:24} {:7.2} ms  {:4.1} %",
                    time.stage,
                    time.seconds * 1e3,
                    100.0 * time.seconds / total
                );
            }
        }
    }
    eprintln!("{:?} in {:.1} s", trainer.memory(), start.elapsed().as_secs_f64());
    println!("{}", blake3::hash(format!("{:?}", trainer.gaussians()?).as_bytes()));
    Ok(())
}
