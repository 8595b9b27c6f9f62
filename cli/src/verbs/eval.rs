//! `fathom eval`: shows the metrics of a result, or measures a model on held-out photographs or against the
//! truth.
//!
//! Renders are clamped and rounded to 8 bits in sRGB; PSNR is the mean over views; SSIM is as in 3DGS.
//! Against the truth, only pixels with a valid truth count: once as rendered, and once with one gain per
//! channel (linear light, least squares over all views). The gain of a medium is not observable from
//! pictures. If the truth marks open water, that is compared too ([`crate::open_water`]).

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use fathom_core::config::{DataConfig, MaskKeep};
use fathom_core::cover::{self, CoverMeter, HeldOut};
use fathom_core::floaters::floaters;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Output, Renderer, SeamRun, WaterView};
use fathom_core::metrics::{self, SsimMap};
use fathom_core::picture::{self, Photograph, linear_to_srgb, srgb_to_linear};
use fathom_core::scene::{PinholeCamera, Pose, Purpose, Scene, View, load_scene};
use fathom_core::views::PackedImage;
use fathom_core::water::WaterRecord;
use serde_json::{Value, json};

use super::render::{picture_names, picture_stem};
use crate::error::{CliError, Result};
use crate::model::{self, GpuArgs};
use crate::open_water::{self, OpenWater, SurfaceTruth, TruthWater};
use crate::output;
use crate::progress::{Progress, Unit};
use crate::seams;

/// Arguments of `fathom eval`.
#[derive(Args, Debug)]
pub struct EvalArgs {
    /// A result folder, or a PLY
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Scene with the photographs; without it, eval shows the metrics of the result folder
    #[arg(long, short = 's', value_name = "DATA", required_unless_present_any = ["truth", "model"])]
    data: Option<PathBuf>,
    /// Folder with the truth, as written by `fathom synth`: clear/ and valid/, with open water also alpha/
    /// and kind/; without --data, its parent folder is the scene
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

/// The metrics as text.
pub fn summary(metrics: &Value) -> String {
    let number = |name: &str, digits: usize| {
        metrics
            .get(name)
            .and_then(Value::as_f64)
            .map_or_else(|| "none".to_owned(), |v| format!("{v:.digits$}"))
    };
    let views = metrics.get("views").and_then(Value::as_array).map_or(0, Vec::len);
    let mut lines = vec![format!(
        "metrics: PSNR {} dB, SSIM {} on {views} held-out views, {} Gaussians",
        number("psnr", 2),
        number("ssim", 4),
        metrics.get("gaussians").map_or_else(|| "?".to_owned(), Value::to_string)
    )];
    lines.extend(seams::summary_lines(metrics));
    lines.extend(cover_line(metrics));
    lines.extend(worst_line(metrics));
    if let Some(baselines) = metrics.get("baselines") {
        let pair = |name: &str| {
            let value = |key: &str| {
                baselines.pointer(&format!("/{name}/{key}")).and_then(Value::as_f64).unwrap_or(f64::NAN)
            };
            format!("{:.2} dB, {:.4}", value("psnr"), value("ssim"))
        };
        lines.push(format!(
            "         flat mean colour {}; 15-pixel blur {}",
            pair("flat_colour"),
            pair("blur")
        ));
    }
    if let Some(viewer) = metrics.get("viewer_psnr").and_then(Value::as_f64) {
        lines.push(format!(
            "         PSNR between this render and a viewer's picture without the water: {viewer:.2} dB"
        ));
    }
    if let Some(floaters) = metrics.get("floaters") {
        let value = |key: &str| floaters.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        lines.push(format!(
            "         floaters {:.1} ({:.3} % of all opacity), by {} views",
            value("count"),
            100.0 * value("share"),
            value("views")
        ));
    }
    if let Some(truth) = metrics.get("truth") {
        let value = |key: &str| truth.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        lines.push(format!(
            "truth:   PSNR {:.2} dB as rendered, {:.2} dB with one gain a channel, on {} views",
            value("psnr"),
            value("psnr_with_gain"),
            truth.get("views").and_then(Value::as_array).map_or(0, Vec::len)
        ));
        lines.extend(open_water::summary_lines(truth));
    }
    lines.extend(water_lines(metrics));
    lines.join("\n")
}

/// Holes, open water and unseen surfaces; `None` if the metrics have none of them, as in older versions.
fn cover_line(metrics: &Value) -> Option<String> {
    let percent = |key: &str, what: &str| {
        metrics.get(key).and_then(Value::as_f64).map(|share| format!("{:.2} % {what}", 100.0 * share))
    };
    let said = [
        percent("holes", "of the covered pixels are holes"),
        percent("open_water", "of J's white is left in open water"),
        percent("unseen", "of the surfaces are in fewer than two training views"),
    ];
    let said: Vec<String> = said.into_iter().flatten().collect();
    (!said.is_empty()).then(|| format!("cover:   {}", said.join(", ")))
}

/// The first view with the largest share of holes; `None` if no view has holes.
fn worst_line(metrics: &Value) -> Option<String> {
    let views = metrics.get("views")?.as_array()?.iter();
    let holes = views.filter_map(|view| Some((view.get("name")?.as_str()?, view.get("holes")?.as_f64()?)));
    let (name, share) = holes.reduce(|worst, view| if view.1 > worst.1 { view } else { worst })?;
    (share > 0.0)
        .then(|| format!("         most holes in {name}: {:.2} % of its covered pixels", 100.0 * share))
}

/// The water parameters, and those of the truth if requested.
fn water_lines(metrics: &Value) -> Vec<String> {
    let found = metrics.get("water").filter(|water| water.is_object());
    let truth = metrics.pointer("/truth/water/truth");
    let Some(found) = found else { return Vec::new() };
    // Where the coefficients depend on range, the values at the scene scale are compared.
    let usual =
        serde_json::from_value::<WaterRecord>(found.clone()).ok().map(|record| json!(record.usual_water()));
    let numbers = usual.as_ref().unwrap_or(found);
    let three = |values: &Value, name: &str| -> String {
        let one = |c: usize| values[name][c].as_f64().map_or_else(|| "?".to_owned(), |v| format!("{v:.4}"));
        [one(0), one(1), one(2)].join(" ")
    };
    let line = |(name, unit): (&str, &str)| {
        let errors = three(&found["standard_error"], name);
        let truth = truth.map_or_else(String::new, |truth| format!("   truth {}", three(truth, name)));
        format!("water:   {name:6} {} +- {errors}{truth} ({unit})", three(numbers, name))
    };
    [("beta_d", "1/unit"), ("beta_b", "1/unit"), ("b_inf", "linear light")].map(line).to_vec()
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

/// The truth of one view.
struct ViewTruth {
    /// J, with the pixels that are not valid masked out.
    clear: PackedImage,
    /// Whether the mask marks surfaces: without a file in valid/, all pixels are valid.
    says_where: bool,
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
    let mip_filter = fathom_core::ply::is_antialiased(&path)?;
    let mut renderer = Renderer::new(Arc::clone(&gpu), &gaussians)?
        .with_mip_filter(mip_filter)
        .with_water(through(Output::Underwater));
    let mut seams = match seams::plan_of(&args.model, args.plan.as_deref())? {
        Some(plan) => seams::run_of(
            &gpu,
            &gaussians,
            mip_filter,
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
    for (index, view) in held_out {
        let (camera, photograph) = load_photograph(&scene, view, &config)?;
        let rendered = renderer.render(&camera, &view.pose, [0.0; 3])?;
        let render = metrics::quantised(rendered.width, rendered.height, &rendered.rgb);
        let map = SsimMap::new(&render, &photograph);
        let border = match &mut seams {
            Some(seams) => seams.add((&camera, &view.pose), &render, &photograph, map.as_ref())?,
            None => None,
        };
        let (psnr, ssim) = (metrics::psnr(&render, &photograph), map.as_ref().map(SsimMap::mean));
        let mut of_view = json!({ "name": view.name, "psnr": psnr, "ssim": ssim });
        let clear = match through(Output::Restored) {
            // Without a medium, the render itself is compared with J.
            None => render.clone(),
            output => {
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
        if let Some(truth) = &args.truth {
            let taken_with = scene.camera(view.camera_id).ok_or_else(|| missing(&scene, view, "camera"))?;
            if let Some(surfaces) = SurfaceTruth::read(truth, &picture_stem(&view.name), taken_with, &camera)?
            {
                let waters = (water.as_ref(), true_water.as_ref());
                open_water.add(&surfaces, &rendered.alpha, (&camera, &view.pose), waters);
            }
        }
        let truth = args.truth.as_deref().map(|truth| read_truth(truth, &scene, view, &config));
        let truth = truth.transpose()?.flatten();
        cover.add(&HeldOut {
            index,
            camera: &camera,
            pose: &view.pose,
            alpha: &rendered.alpha,
            range: &rendered.range,
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
        result["truth"] = against_truth(truth, &measured)?;
        result["truth"]["open_water"] = open_water.report();
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

/// The photograph of a view as training sees it.
fn load_photograph(scene: &Scene, view: &View, config: &DataConfig) -> Result<(PinholeCamera, PackedImage)> {
    let path = view.image.as_ref().ok_or_else(|| missing(scene, view, "photograph"))?;
    prepared(scene, view, (path, view.mask.as_ref()), config)
}

fn missing(scene: &Scene, view: &View, what: &str) -> CliError {
    CliError::Message(format!("{}: view {} has no {what}", scene.root.display(), view.name))
}

/// A picture and its mask by the camera of a view, as training would see them.
fn prepared(
    scene: &Scene,
    view: &View,
    (path, mask): (&PathBuf, Option<&PathBuf>),
    config: &DataConfig,
) -> Result<(PinholeCamera, PackedImage)> {
    let read = |path: &PathBuf| std::fs::read(path).map_err(CliError::io("read", path));
    let camera = scene.camera(view.camera_id).ok_or_else(|| missing(scene, view, "camera"))?;
    let image = read(path)?;
    let mask = mask.map(read).transpose()?;
    let name = path.to_string_lossy();
    let photograph = Photograph { name: &name, image: &image, mask: mask.as_deref() };
    Ok(picture::prepare(&photograph, camera, config.mask_keep, config.max_resolution)?)
}

/// Cameras and poses of all views by name, at the size of the measured pictures.
fn all_cameras(scene: &Scene, config: &DataConfig) -> Result<Vec<(PinholeCamera, Pose)>> {
    let camera = |view: &View| {
        let camera = scene.camera(view.camera_id).ok_or_else(|| missing(scene, view, "camera"))?;
        Ok((picture::prepared_camera(camera, config.max_resolution)?, view.pose))
    };
    scene.views.iter().map(camera).collect()
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

/// The water parameters beside those of the truth, at the scene scale if they depend on range. If both vary
/// with direction, the truth's `b_inf` is taken in the reference direction of the model.
fn water_against_truth(truth: &TruthWater, record: &WaterRecord) -> Value {
    let truth = truth.beside(record);
    let difference = |found: [f64; 3], truth: [f64; 3]| [0, 1, 2].map(|c| found[c] - truth[c]);
    // As a share of the truth, unless the truth is 0.
    let share = |found: [f64; 3], truth: [f64; 3]| {
        [0, 1, 2].map(|c| (found[c] - truth[c]).abs() / if truth[c] > 0.0 { truth[c] } else { 1.0 })
    };
    let found = record.usual_water();
    json!({
        "found": found,
        "truth": truth,
        "standard_error": record.standard_error,
        "beta_d_error": share(found.beta_d, truth.beta_d),
        "beta_b_error": share(found.beta_b, truth.beta_b),
        "b_inf_error": difference(found.b_inf, truth.b_inf),
    })
}

fn mean(views: &[Value], key: &str) -> Option<f64> {
    let values: Vec<f64> = views.iter().filter_map(|view| view[key].as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
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

fn against_truth(truth: &Path, measured: &[Measured]) -> Result<Value> {
    let pairs: Vec<_> = measured
        .iter()
        .filter_map(|view| Some((&view.name, &view.clear, view.truth.as_ref()?.clear.clone())))
        .collect();
    if pairs.is_empty() {
        return Err(CliError::Message(format!(
            "{}/clear has no picture of a measured view; it must hold every {}",
            truth.display(),
            "N-th view of --test-every"
        )));
    }
    let gain = gains(&pairs);
    let mut views = Vec::new();
    for (name, render, clear) in &pairs {
        let scaled = scale(render, gain);
        views.push(json!({
            "name": name,
            "psnr": metrics::psnr(render, clear),
            "ssim": metrics::ssim(render, clear),
            "psnr_with_gain": metrics::psnr(&scaled, clear),
        }));
    }
    Ok(json!({
        "psnr": mean(&views, "psnr"),
        "ssim": mean(&views, "ssim"),
        "psnr_with_gain": mean(&views, "psnr_with_gain"),
        "gain": gain,
        "views": views,
    }))
}

/// J of a view at the size of training; `None` if there is none.
fn read_truth(truth: &Path, scene: &Scene, view: &View, config: &DataConfig) -> Result<Option<ViewTruth>> {
    let stem = picture_stem(&view.name);
    let find = |folder: &str| {
        ["png", "jpg"]
            .into_iter()
            .map(|ext| truth.join(folder).join(format!("{stem}.{ext}")))
            .find(|p| p.is_file())
    };
    let Some(clear) = find("clear") else { return Ok(None) };
    let config = DataConfig { mask_keep: MaskKeep::White, ..config.clone() };
    let valid = find("valid");
    let (_, picture) = prepared(scene, view, (&clear, valid.as_ref()), &config)?;
    Ok(Some(ViewTruth { clear: picture, says_where: valid.is_some() }))
}

/// For each channel the gain g that brings g * render closest to the truth (linear light, least squares).
fn gains(pairs: &[(&String, &PackedImage, PackedImage)]) -> [f64; 3] {
    let (mut cross, mut square) = ([0.0; 3], [0.0; 3]);
    for (_, render, clear) in pairs {
        for (r, c) in render.pixels.iter().zip(&clear.pixels) {
            let (r, c) = (r.to_le_bytes(), c.to_le_bytes());
            if c[3] != 255 {
                continue;
            }
            for channel in 0..3 {
                let linear = |v: u8| srgb_to_linear(f64::from(v) / 255.0);
                cross[channel] += linear(r[channel]) * linear(c[channel]);
                square[channel] += linear(r[channel]).powi(2);
            }
        }
    }
    std::array::from_fn(|c| if square[c] > 0.0 { cross[c] / square[c] } else { 1.0 })
}

fn scale(image: &PackedImage, gain: [f64; 3]) -> PackedImage {
    let pixels = image.pixels.iter().map(|pixel| {
        let bytes = pixel.to_le_bytes();
        let scaled = |c: usize| {
            let linear = srgb_to_linear(f64::from(bytes[c]) / 255.0) * gain[c];
            metrics::to_8_bit(linear_to_srgb(linear.min(1.0)) as f32)
        };
        u32::from_le_bytes([scaled(0), scaled(1), scaled(2), bytes[3]])
    });
    PackedImage { width: image.width, height: image.height, pixels: pixels.collect() }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summary_reports_cover_unless_metrics_are_older() {
        assert_eq!(cover_line(&json!({ "psnr": 30.0 })), None);
        assert_eq!(cover_line(&json!({ "holes": null, "open_water": null, "unseen": null })), None);
        let said = cover_line(&json!({ "holes": 0.0125, "open_water": null, "unseen": 0.5 }));
        let expected = "cover:   1.25 % of the covered pixels are holes, 50.00 % of the surfaces are in fewer than two \
                        training views";
        assert_eq!(said.as_deref(), Some(expected));
    }

    #[test]
    fn the_view_with_most_holes_is_named_where_one_has_any() {
        let metrics = |holes: [Option<f64>; 3]| {
            let of_view = |(name, holes): (&str, Option<f64>)| json!({ "name": name, "holes": holes });
            let views: Vec<Value> = ["a", "b", "c"].into_iter().zip(holes).map(of_view).collect();
            json!({ "views": views })
        };
        let said = worst_line(&metrics([None, Some(0.25), Some(0.25)]));
        assert_eq!(said.as_deref(), Some("         most holes in b: 25.00 % of its covered pixels"));
        assert_eq!(worst_line(&metrics([None, Some(0.0), Some(0.0)])), None);
        assert_eq!(worst_line(&json!({ "views": [{ "name": "a" }] })), None);
        assert_eq!(worst_line(&json!({})), None);
    }

    #[test]
    fn an_applied_gain_is_recovered() {
        let pixels = |gain: [f64; 3]| {
            let truth = PackedImage::from_rgb8(2, 1, &[200, 120, 60, 90, 200, 40]);
            scale(&truth, gain)
        };
        let name = "a".to_owned();
        let (dim, truth) = (pixels([0.5, 0.25, 0.8]), pixels([1.0; 3]));
        let found = gains(&[(&name, &dim, truth)]);
        for (found, expected) in found.iter().zip([2.0, 4.0, 1.25]) {
            // The dimmed pixels are rounded to 8 bits: half a step of at least 40 is about 1 %, 3 % in linear
            // light.
            assert!((found / expected - 1.0).abs() < 0.03, "{found} {expected}");
        }
    }
}
