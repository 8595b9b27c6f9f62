//! `fathom eval`: shows the metrics of a result, or measures a model on held-out photographs or against the
//! truth.
//!
//! Renders are clamped and rounded to 8 bits in sRGB; PSNR is the mean over views; SSIM is as in 3DGS.
//! [`crate::against_truth`] compares with a truth. If it marks open water, that is compared too
//! ([`crate::open_water`]).

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use fathom_core::config::DataConfig;
use fathom_core::cover::{self, CoverMeter, HeldOut};
use fathom_core::floaters::floaters;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Output, Renderer, SeamRun, WaterView};
use fathom_core::metrics::{self, SsimMap};
use fathom_core::picture;
use fathom_core::scene::{Purpose, Scene, View, load_scene};
use fathom_core::views::PackedImage;
use serde_json::{Value, json};

use super::render::{picture_names, picture_stem};
use crate::against_truth::{Pair, ViewTruth, against_truth, mean, read_truth, water_against_truth};
use crate::error::{CliError, Result};
use crate::eval_summary::summary;
use crate::model::{self, GpuArgs};
use crate::open_water::{OpenWater, SurfaceTruth, TruthWater};
use crate::output;
use crate::photographs::{all_cameras, load_photograph, missing};
use crate::progress::{Progress, Unit};
use crate::seams;
use crate::water_region::{Shown, WaterRegion};

/// Arguments of `fathom eval`.
#[derive(Args, Debug)]
pub struct EvalArgs {
    /// A result folder, or a PLY
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Scene with the photographs; without it, eval shows the metrics of the result folder
    #[arg(long, short = 's', value_name = "DATA", required_unless_present_any = ["truth", "model"])]
    data: Option<PathBuf>,
    /// Folder with the truth that `fathom synth` wrote; without --data, its parent is the scene. It has
    /// clear/ and valid/, with open water also alpha/ and kind/. That of a pool has region/, dry/ and oil/
    #[arg(long, value_name = "DIR")]
    truth: Option<PathBuf>,
    /// Measure every N-th view by sorted name [default: as in training, otherwise 8]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    test_every: Option<u32>,
    /// Longest side of a picture, pixels [default: as in training, otherwise 1600]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_resolution: Option<u32>,
    /// Also measure two baselines that any model must beat: the mean colour and a 15-pixel blur of each
    /// photograph
    #[arg(long)]
    baselines: bool,
    /// Also count floaters: Gaussians, weighted by opacity, nearer to a training view than half the 2nd
    /// percentile of the ranges of its sparse points
    #[arg(long)]
    floaters: bool,
    /// Measure at the cell borders of this plan.json, for example to compare a model trained whole with a
    /// partitioned one [default: the plan beside the model]
    #[arg(long, value_name = "FILE")]
    plan: Option<PathBuf>,
    /// Folder for side-by-side pictures (photograph, render, difference) and pictures of the cell borders
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    gpu: GpuArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: EvalArgs) -> Result<()> {
    let reads_scene = args.data.is_some() || args.truth.is_some();
    if args.floaters && !reads_scene {
        return Err(CliError::Message(
            "--floaters needs the sparse points: give the scene with --data DATA".to_owned(),
        ));
    }
    if args.plan.is_some() && !reads_scene {
        return Err(CliError::Message(
            "--plan needs photographs: give the scene with --data DATA".to_owned(),
        ));
    }
    let result =
        if !reads_scene { stored(&args.model)? } else { measure(&args).map_err(CliError::of_rendering)? };
    if args.json {
        return output::json(&result);
    }
    output::lines(summary(&result));
    Ok(())
}

/// The metrics written by training.
fn stored(folder: &Path) -> Result<Value> {
    let path = folder.join("metrics.json");
    if !path.is_file() {
        return Err(CliError::Message(format!(
            "{} has no metrics.json; give the scene to measure it on with --data DATA",
            folder.display()
        )));
    }
    let mut metrics = output::read_json(&path)?;
    let water = folder.join("water.json");
    if water.is_file() {
        let record = output::read_json(&water)?;
        if let Some(metrics) = metrics.as_object_mut() {
            metrics.insert("water".to_owned(), record);
        }
    }
    Ok(metrics)
}

/// One held-out view: photograph and render.
struct Measured {
    name: String,
    photograph: PackedImage,
    render: PackedImage,
    /// The render without water.
    clear: PackedImage,
    /// J, if it is known and was requested.
    truth: Option<ViewTruth>,
    /// The surroundings of cell borders, PNG, if the view shows any.
    border: Option<Vec<u8>>,
}

impl Measured {
    /// What is compared with the truth; `None` without a truth of this view.
    fn pair(&self) -> Option<Pair<'_>> {
        Some((&self.name, &self.clear, &self.truth.as_ref()?.clear))
    }
}

fn measure(args: &EvalArgs) -> Result<Value> {
    let trained = model::data_config(&args.model)?;
    let known = trained.is_some();
    let mut config = trained.unwrap_or_default();
    config.test_every = args.test_every.unwrap_or(config.test_every);
    config.max_resolution = args.max_resolution.unwrap_or(config.max_resolution);
    if config.test_every == 0 {
        return Err(CliError::Message(
            "the model was trained on every view (data.test_every = 0); select views to measure with \
             --test-every"
                .to_owned(),
        ));
    }
    let data = match (&args.data, &args.truth) {
        (Some(data), _) => data.clone(),
        (None, Some(truth)) => std::fs::canonicalize(truth)
            .ok()
            .and_then(|truth| truth.parent().map(Path::to_owned))
            .ok_or_else(|| CliError::Message(format!("cannot read {}", truth.display())))?,
        (None, None) => {
            return Err(CliError::Message(
                "give the scene to measure on with --data \
            DATA"
                    .to_owned(),
            ));
        }
    };
    let scene = load_scene(&data, Purpose::Measure, &config)?;
    let path = model::model_path(&args.model)?;
    if args.truth.is_some() {
        model::refuse_white_point(&path, "fit for comparison with a truth")?;
    }
    let gaussians = model::load(&path)?;
    let gpu = args.gpu.open()?;
    let adapter = gpu.adapter().name.clone();
    let water = fathom_core::ply::water_record(&path)?;
    let through = |output| water.as_ref().map(|record| WaterView::of_record(record, output));
    let drawing = fathom_core::ply::drawing(&path)?;
    let mut renderer =
        Renderer::new(Arc::clone(&gpu), &gaussians)?.drawn(drawing)?.with_water(through(Output::Underwater));
    let mut surface = model::surface_renderer(&gpu, &path)?;
    let mut seams = match seams::plan_of(&args.model, args.plan.as_deref())? {
        Some(plan) => seams::run_of(
            &gpu,
            &gaussians,
            drawing,
            &plan,
            seams::config_of(&args.model, args.plan.as_deref())?,
        )?,
        None => None,
    };
    let held_out: Vec<(u32, &View)> = (0..).zip(&scene.views).step_by(config.test_every as usize).collect();
    let cameras = all_cameras(&scene, &config)?;
    let indices: Vec<u32> = held_out.iter().map(|(index, _)| *index).collect();
    let mut cover = CoverMeter::new(&cameras, &indices, &scene.points);
    let progress = Progress::new("measuring", held_out.len() as u64, Unit::Count("views"));
    let (mut measured, mut views) = (Vec::new(), Vec::new());
    let true_water = args.truth.as_deref().map(TruthWater::read).transpose()?.flatten();
    let mut open_water = OpenWater::default();
    let mut region = match &args.truth {
        Some(truth) => WaterRegion::open(truth, &gpu, &path)?,
        None => None,
    };
    for (index, view) in held_out {
        let (camera, photograph) = load_photograph(&scene, view, &config)?;
        let rendered = match &mut surface {
            Some(surface) => surface.render(&camera, &view.pose)?,
            None => renderer.render(&camera, &view.pose, [0.0; 3])?,
        };
        let render = metrics::quantised(rendered.width, rendered.height, &rendered.rgb);
        let map = SsimMap::new(&render, &photograph);
        let border = match &mut seams {
            Some(seams) => seams.add((&camera, &view.pose), &render, &photograph, map.as_ref())?,
            None => None,
        };
        let (psnr, ssim) = (metrics::psnr(&render, &photograph), map.as_ref().map(SsimMap::mean));
        let mut of_view = json!({ "name": view.name, "psnr": psnr, "ssim": ssim });
        // The scene without its water surface: what covers a pixel is seen straight there.
        let dry = match &surface {
            Some(_) => Some(renderer.render(&camera, &view.pose, [0.0; 3])?),
            None => None,
        };
        let clear = match (through(Output::Restored), &dry) {
            (_, Some(dry)) => metrics::quantised(dry.width, dry.height, &dry.rgb),
            // Without a medium, the render itself is compared with J.
            (None, None) => render.clone(),
            (output, None) => {
                renderer.set_water(output);
                let clear = renderer.render(&camera, &view.pose, [0.0; 3])?;
                let clear = metrics::quantised(clear.width, clear.height, &clear.rgb);
                // Viewers blend in sRGB, so they show other models unchanged.
                if water.as_ref().is_some_and(|record| record.composition.blends_in_linear_light()) {
                    renderer.set_water(None);
                    let plain = renderer.render(&camera, &view.pose, [0.0; 3])?;
                    let plain = metrics::quantised(plain.width, plain.height, &plain.rgb);
                    of_view["viewer_psnr"] = json!(metrics::psnr(&plain, &clear));
                }
                renderer.set_water(through(Output::Underwater));
                clear
            }
        };
        views.push(of_view);
        if let Some(region) = &mut region {
            let shown = Shown { photograph: &photograph, wet: &render, dry: &clear };
            region.add(&scene, view, &camera, &shown, &config)?;
        }
        if let Some(truth) = &args.truth {
            let taken_with = scene.camera(view.camera_id).ok_or_else(|| missing(&scene, view, "camera"))?;
            if let Some(surfaces) = SurfaceTruth::read(truth, &picture_stem(&view.name), taken_with, &camera)?
            {
                let waters = (water.as_ref(), true_water.as_ref());
                open_water.add(&surfaces, &rendered.alpha, (&camera, &view.pose), waters);
            }
        }
        let stem = picture_stem(&view.name);
        let truth = args.truth.as_deref().map(|truth| read_truth(truth, &stem, &scene, view, &config));
        let truth = truth.transpose()?.flatten();
        cover.add(&HeldOut {
            index,
            camera: &camera,
            pose: &view.pose,
            alpha: &dry.as_ref().unwrap_or(&rendered).alpha,
            range: &dry.as_ref().unwrap_or(&rendered).range,
            photograph: &photograph,
            clear: water.as_ref().map(|_| &clear),
            truth: truth.as_ref().filter(|truth| truth.says_where).map(|truth| &truth.clear),
        });
        measured.push(Measured { name: view.name.clone(), photograph, render, clear, truth, border });
        progress.set(measured.len() as u64, &view.name);
    }
    progress.finish();
    if let Some(folder) = &args.output {
        write_side_by_side(folder, &measured)?;
    }
    let mut result = json!({
        "psnr": mean(&views, "psnr"),
        "ssim": mean(&views, "ssim"),
        "lpips": null,
        "medium": water.as_ref().map_or(json!("none"), |record| json!(record.composition.medium())),
        "water": water,
        "colour_space": "sRGB",
        "protocol": metrics::protocol(),
        "gaussians": gaussians.len(),
        "adapter": adapter,
        "data": { "test_every": config.test_every, "max_resolution": config.max_resolution, "from_run_json": known },
        "views": views,
    });
    fathom_core::seams::put_into(&mut result, seams.map(SeamRun::report).as_ref());
    cover::put_into(&mut result, Some(&cover.report()));
    if args.baselines {
        result["baselines"] = baselines(&measured);
    }
    if args.floaters {
        result["floaters"] = count_floaters(&scene, &gaussians, &config)?;
    }
    if let Some(truth) = &args.truth {
        let pairs: Vec<_> = measured.iter().filter_map(Measured::pair).collect();
        result["truth"] = match (pairs.is_empty(), &region) {
            (true, Some(_)) => json!({}),
            _ => against_truth(truth, &pairs)?,
        };
        result["truth"]["open_water"] = open_water.report();
        result["truth"]["region"] = region.map_or(Value::Null, WaterRegion::report);
        if let Some(record) = &water {
            result["truth"]["water"] =
                true_water.map_or(Value::Null, |truth| water_against_truth(&truth, record));
        }
    }
    if water.is_some() {
        result["viewer_psnr"] = json!(mean(&views_of(&result), "viewer_psnr"));
    }
    Ok(result)
}

/// Floaters in the training views, which are all views that are not measured.
fn count_floaters(scene: &Scene, model: &Gaussians, config: &DataConfig) -> Result<Value> {
    let views: Vec<_> = (0_u32..)
        .zip(all_cameras(scene, config)?)
        .filter(|(index, _)| !index.is_multiple_of(config.test_every))
        .map(|(index, (camera, pose))| (index, camera, pose))
        .collect();
    let found = floaters(model, &views, &scene.points).ok_or_else(|| {
        CliError::Message(format!(
            "{}: no view has the 20 sparse points needed to tell where its scene begins; omit --floaters",
            scene.root.display()
        ))
    })?;
    Ok(json!({ "count": found.count, "share": found.share, "views": found.views }))
}

fn views_of(result: &Value) -> Vec<Value> {
    result["views"].as_array().cloned().unwrap_or_default()
}

fn baselines(measured: &[Measured]) -> Value {
    let of = |degrade: fn(&PackedImage) -> PackedImage| {
        let (mut psnr, mut ssim) = (0.0, 0.0);
        for view in measured {
            let degraded = degrade(&view.photograph);
            psnr += metrics::psnr(&degraded, &view.photograph);
            ssim += metrics::ssim(&degraded, &view.photograph);
        }
        let count = measured.len() as f64;
        json!({ "psnr": psnr / count, "ssim": ssim / count })
    };
    json!({ "flat_colour": of(metrics::flat_colour), "blur": of(metrics::blurred) })
}

/// Writes photograph, render and four times their difference side by side, and `border_*` for views of cell
/// borders.
fn write_side_by_side(folder: &Path, measured: &[Measured]) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(CliError::io("create", folder))?;
    let borders: Vec<String> = measured.iter().map(|view| format!("border_{}", view.name)).collect();
    let views = measured.iter().map(|view| view.name.as_str());
    let mut names = picture_names(views.chain(borders.iter().map(String::as_str)));
    let border_names = names.split_off(measured.len());
    for (view, (name, border_name)) in measured.iter().zip(names.into_iter().zip(border_names)) {
        let (width, height) = (view.render.width, view.render.height);
        let mut rgb = Vec::with_capacity((width * height * 9) as usize);
        let row = |image: &PackedImage, y: u32| {
            image.pixels[(y * width) as usize..((y + 1) * width) as usize].to_vec()
        };
        for y in 0..height {
            let (photograph, render) = (row(&view.photograph, y), row(&view.render, y));
            let colours =
                |row: &[u32]| row.iter().flat_map(|p| p.to_le_bytes()[..3].to_vec()).collect::<Vec<u8>>();
            rgb.extend(colours(&photograph));
            rgb.extend(colours(&render));
            rgb.extend(photograph.iter().zip(&render).flat_map(|(a, b)| {
                let (a, b) = (a.to_le_bytes(), b.to_le_bytes());
                (0..3).map(move |c| a[c].abs_diff(b[c]).saturating_mul(4))
            }));
        }
        let write = |name: String, png: &[u8]| {
            let path = folder.join(name);
            std::fs::write(&path, png).map_err(CliError::io("write", &path))
        };
        if let Some(png) = &view.border {
            write(border_name, png)?;
        }
        write(name, &picture::encode_png(3 * width, height, &rgb)?)?;
    }
    Ok(())
}
