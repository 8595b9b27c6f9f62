//! Trains a scene that is seen through a water surface, in this process, and measures it against its truth.
//!
//! `cargo run --release --example train_surface -- SCENE [--method wsgs|2dgs|3dgs] [--train KEY=VALUE]
//! [--surface KEY=VALUE] [--shift S] [--pictures FOLDER]`; SCENE as `fathom synth --kind pool` writes it.
//!
//! It prints one JSON object: PSNR of the whole picture, and inside the region of water. There it also has
//! the PSNR of the scene without water, and with oil in its place. `--shift` moves the surface at the start.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use fathom_core::config::{DataConfig, SurfaceConfig, SurfaceRefine, TrainConfig};
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Drawing, Gpu, GpuOptions, Rendered, Renderer, SurfaceOutput, SurfaceRenderer};
use fathom_core::metrics::{psnr, quantised};
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::scene::{Purpose, Scene, learning_scale, load_scene};
use fathom_core::surface::{Surface, SurfaceModel};
use fathom_core::train::surface::{SurfaceTrainer, surface_run};
use fathom_core::train::{Progress, TrainRun, Trainer, initial_gaussians};
use fathom_core::views::{InMemory, PackedImage, TrainView, ViewSource};
use serde_json::{Value, json};

type Fallible<T> = Result<T, Box<dyn Error>>;

/// Refractive index of the oil of the truth.
const OIL: f64 = 1.46;

/// Iterations between two lines of progress.
const BLOCK: u32 = 250;

/// What the blocks of a run took.
#[derive(Default)]
struct Pace {
    /// Its last iteration, and its seconds, by block.
    blocks: Vec<(u32, f64)>,
}

impl Pace {
    fn time(&mut self, advance: impl FnOnce() -> fathom_core::Result<Progress>) -> Fallible<Progress> {
        let begin = Instant::now();
        let progress = advance()?;
        self.blocks.push((progress.iteration, begin.elapsed().as_secs_f64()));
        Ok(progress)
    }

    /// Milliseconds of an iteration in the last quarter of the run, when all Gaussians are there.
    fn at_the_end(&self) -> Option<f64> {
        let end = self.blocks.last()?.0;
        let late: Vec<_> = self.blocks.windows(2).filter(|pair| pair[0].0 >= end - end / 4).collect();
        let iterations: u32 = late.iter().map(|pair| pair[1].0 - pair[0].0).sum();
        let seconds: f64 = late.iter().map(|pair| pair[1].1).sum();
        (iterations > 0).then(|| 1e3 * seconds / f64::from(iterations))
    }
}

struct Arguments {
    scene: PathBuf,
    method: String,
    train: TrainConfig,
    surface: SurfaceConfig,
    /// Added to the offset of the surface at the start, scene units.
    shift: f64,
    pictures: Option<PathBuf>,
}

/// Sets `KEY=VALUE` of a configuration.
fn set<T: serde::Serialize + serde::de::DeserializeOwned>(config: &mut T, pair: &str) -> Fallible<()> {
    let (key, value) = pair.split_once('=').ok_or("settings are KEY=VALUE")?;
    let mut all = serde_json::to_value(&*config)?;
    all[key] = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
    *config = serde_json::from_value(all)?;
    Ok(())
}

fn arguments() -> Fallible<Arguments> {
    let mut words = std::env::args().skip(1);
    let scene = PathBuf::from(words.next().ok_or("usage: train_surface SCENE [--method NAME] …")?);
    let train = TrainConfig { iterations: 3000, max_gaussians: 12_000, ..TrainConfig::default() };
    let mut found = Arguments {
        scene,
        method: "wsgs".into(),
        train,
        surface: SurfaceConfig::default(),
        shift: 0.0,
        pictures: None,
    };
    while let Some(key) = words.next() {
        let value = words.next().ok_or_else(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--method" => found.method = value,
            "--train" => set(&mut found.train, &value)?,
            "--surface" => set(&mut found.surface, &value)?,
            "--shift" => found.shift = value.parse()?,
            "--pictures" => found.pictures = Some(value.into()),
            _ => return Err(format!("there is no option {key}").into()),
        }
    }
    found.train.disks = found.method != "3dgs";
    Ok(found)
}

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

/// A picture of the truth, with alpha 0 outside the region if one is given.
fn truth(folder: &Path, part: &str, name: &str, region: Option<&PackedImage>) -> Fallible<PackedImage> {
    let picture = image::open(folder.join("truth").join(part).join(name))?.to_rgb8();
    let pixels = picture.pixels().map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect();
    Ok(inside(PackedImage { width: picture.width(), height: picture.height(), pixels }, region))
}

fn inside(mut picture: PackedImage, region: Option<&PackedImage>) -> PackedImage {
    if let Some(region) = region {
        for (pixel, region) in picture.pixels.iter_mut().zip(&region.pixels) {
            *pixel = (*pixel & 0x00ff_ffff) | (region << 24);
        }
    }
    picture
}

fn picture(rendered: &Rendered) -> PackedImage {
    quantised(rendered.width, rendered.height, &rendered.rgb)
}

/// What the method shows: wet, dry, with oil.
enum Shown {
    Plain(Box<Renderer>),
    Surface(Box<(SurfaceRenderer, Renderer, SurfaceRenderer)>),
}

impl Shown {
    fn wet(&mut self, view: &TrainView) -> Fallible<PackedImage> {
        Ok(picture(&match self {
            Self::Plain(renderer) => renderer.render(&view.camera, &view.pose, [0.0; 3])?,
            Self::Surface(all) => all.0.render(&view.camera, &view.pose)?,
        }))
    }

    fn each(&mut self, view: &TrainView) -> Fallible<[PackedImage; 3]> {
        let wet = self.wet(view)?;
        Ok(match self {
            Self::Plain(_) => [wet.clone(), wet.clone(), wet],
            Self::Surface(all) => [
                wet,
                picture(&all.1.render(&view.camera, &view.pose, [0.0; 3])?),
                picture(&all.2.render(&view.camera, &view.pose)?),
            ],
        })
    }
}

/// Mean PSNR of whole pictures.
fn entire_db(shown: &mut Shown, views: &InMemory) -> Fallible<f64> {
    let mut sum = 0.0;
    for (view, photograph) in views.views.iter().zip(&views.images) {
        sum += psnr(&shown.wet(view)?, photograph);
    }
    Ok(sum / views.views.len() as f64)
}

fn save(folder: &Path, name: &str, picture: &PackedImage) -> Fallible<()> {
    std::fs::create_dir_all(folder)?;
    let bytes = picture.pixels.iter().flat_map(|pixel| pixel.to_le_bytes()[..3].to_vec()).collect();
    image::RgbImage::from_raw(picture.width, picture.height, bytes)
        .ok_or("a picture has another size")?
        .save(folder.join(format!("{name}.png")))?;
    Ok(())
}

fn main() -> Fallible<()> {
    let Arguments { scene: folder, method, train: config, surface: settings, shift, pictures } = arguments()?;
    let data = DataConfig::default();
    let scene = load_scene(&folder, Purpose::Train, &data)?;
    let (train, test) = (photographs(&scene, &data, false)?, photographs(&scene, &data, true)?);
    let gpu = Gpu::new(GpuOptions { allow_cpu: true, ..Default::default() })?;
    let scene_views: Vec<u32> =
        (0..scene.views.len() as u32).filter(|view| !view.is_multiple_of(data.test_every)).collect();
    let started = Instant::now();
    let mut run = TrainRun {
        focus: initial_gaussians(&scene.points, train.views(), &config, None)?,
        context: Gaussians::empty(config.sh_degree),
        surfaces: Gaussians::empty(config.sh_degree),
        medium: None,
        surface: None,
        extent: learning_scale(scene.extent(), scene.viewing_distance()) as f32,
        views: Arc::new(train),
        config: config.clone(),
    };
    let (mut prior_seconds, mut pace) = (0.0, Pace::default());
    let (mut shown, surface, counts, model): (Shown, Option<Surface>, Vec<usize>, Option<SurfaceModel>) =
        if method == "wsgs" {
            let (straight, mut surface) =
                surface_run(&scene.points, run.views.views(), &scene_views, &config, &settings)?;
            prior_seconds = started.elapsed().as_secs_f64();
            surface.record.offset += shift;
            (run.focus, run.surface) = (straight, Some(surface));
            let mut trainer = SurfaceTrainer::new(Arc::clone(&gpu), run)?;
            while trainer.progress().iteration < config.iterations {
                let progress = pace.time(|| trainer.advance(BLOCK))?;
                let now = trainer.measure(&test, || true)?;
                eprintln!(
                    "{:6} loss {:.4} {} disks, {:.2} dB, {:.0} s",
                    progress.iteration,
                    progress.loss,
                    progress.gaussians,
                    now.map_or(f64::NAN, |now| now.psnr_db),
                    started.elapsed().as_secs_f64()
                );
            }
            let model = trainer.model()?;
            let mut oil = SurfaceRenderer::new(Arc::clone(&gpu), &model)?;
            oil.set_ior(OIL)?;
            let wet = SurfaceRenderer::new(Arc::clone(&gpu), &model)?;
            let dry = SurfaceRenderer::dry(Arc::clone(&gpu), &model)?;
            let counts = vec![model.straight.len(), model.refracted.len(), model.reflected.len()];
            (Shown::Surface(Box::new((wet, dry, oil))), Some(model.record.surface()), counts, Some(model))
        } else {
            let mut trainer = Trainer::new(Arc::clone(&gpu), run)?;
            while trainer.progress().iteration < config.iterations {
                pace.time(|| trainer.advance(BLOCK))?;
            }
            let model = trainer.gaussians()?;
            let drawing = Drawing { disks: config.disks, mip_filter: config.mip_filter };
            let renderer = Renderer::new(Arc::clone(&gpu), &model)?.drawn(drawing)?;
            (Shown::Plain(Box::new(renderer)), None, vec![model.len()], None)
        };
    let seconds = started.elapsed().as_secs_f64();
    let mut sums = [0.0; 5];
    for (view, photograph) in test.views.iter().zip(&test.images) {
        let region = truth(&folder, "region", &view.name, None)?;
        let [wet, dry, oil] = shown.each(view)?;
        let in_region = inside(photograph.as_ref().clone(), Some(&region));
        let values = [
            psnr(&wet, photograph),
            psnr(&wet, &in_region),
            psnr(&dry, &truth(&folder, "dry", &view.name, Some(&region))?),
            psnr(&oil, &truth(&folder, "oil", &view.name, Some(&region))?),
            psnr(&dry, &truth(&folder, "dry", &view.name, None)?),
        ];
        sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        if let Some(folder) = &pictures {
            let stem = view.name.trim_end_matches(".png");
            save(folder, &format!("{stem}-wet"), &wet)?;
            save(folder, &format!("{stem}-dry"), &dry)?;
            save(folder, &format!("{stem}-oil"), &oil)?;
            if let Some(model) = &model {
                let mut renderer = SurfaceRenderer::new(Arc::clone(&gpu), model)?;
                for (name, output) in [
                    ("reflected", SurfaceOutput::Reflected),
                    ("refracted", SurfaceOutput::Refracted),
                    ("reflectance", SurfaceOutput::Reflectance),
                    ("mask", SurfaceOutput::Mask),
                ] {
                    let map = renderer.render_as(&view.camera, &view.pose, output)?;
                    save(folder, &format!("{stem}-{name}"), &quantised(map.width, map.height, &map.rgb))?;
                }
            }
        }
    }
    let [entire, region, dry, oil, dry_entire] = sums.map(|sum| sum / test.views.len() as f64);
    let trained = entire_db(&mut shown, &photographs(&scene, &data, false)?)?;
    let plane: Option<Value> = std::fs::read(folder.join("truth/surface.json"))
        .ok()
        .and_then(|bytes| serde_json::from_slice(&bytes).ok());
    let off =
        surface.zip(plane).map(|(surface, truth)| surface.offset - truth["offset"].as_f64().unwrap_or(0.0));
    println!(
        "{}",
        json!({
            "adapter": gpu.adapter().name,
            "method": method,
            "iterations": config.iterations,
            "seed": config.seed,
            "gaussians": counts,
            "entire_db": entire,
            "region_db": region,
            "dry_db": dry,
            "oil_db": oil,
            "dry_entire_db": dry_entire,
            "trained_entire_db": trained,
            "offset_error": off,
            "refined": settings.refine != SurfaceRefine::Fixed,
            "prior_seconds": prior_seconds,
            "seconds": seconds,
            "ms_per_step_at_the_end": pace.at_the_end(),
        })
    );
    Ok(())
}
