//! `fathom export`: writes a model for other programs. Its colours stay as they are, or are converted for
//! viewers or to linear light; its axes are those of the scene or of its plan. With `--html` it writes a page
//! ([`crate::handover`]).

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use fathom_core::CoreError;
use fathom_core::axes;
use fathom_core::config::DataConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Output, Renderer, WaterView};
use fathom_core::linear_colours::in_linear_light;
use fathom_core::ply::{self, SplatReader, SplatWriter, write_whole};
use fathom_core::scene::{Purpose, load_scene};
use fathom_core::viewer_colours::ViewerColours;
use fathom_core::views::TrainView;
use fathom_core::water::WaterRecord;
use fathom_core::white_point::{self as white, WhitePoint};
use glam::DQuat;

use crate::error::{CliError, Result};
use crate::handover::{self, HandoverArgs};
use crate::model::{self, GpuArgs};
use crate::output;
use crate::progress::{Progress, Unit};
use crate::white_point::{self, WhitePointArgs};

/// Training steps for viewer colours: 42.95 dB on sesa-wreck blended in linear light (BENCHMARKS.md).
const VIEWER_ITERATIONS: u32 = 3000;
/// PLY comment of a model with colours trained for viewers.
const VIEWER_COLOURS: &str = "colours are fitted for programs that blend in sRGB";
/// Gaussians converted at a time.
const BLOCK: usize = 262_144;

/// Encoding of the exported colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Colour {
    /// Unchanged: Gaussian viewers show J, unless the model was blended in linear light (--preset paper)
    Srgb,
    /// For a model blended in linear light: train the colours again until viewers, which blend in sRGB, show
    /// J
    Viewer,
    /// Linear light, for programs that light and blend in it; Gaussian viewers show this too dark
    Linear,
}

/// Axes of the exported model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Frame {
    /// Scene axes: those of the camera poses.
    Scene,
    /// Plan axes: y down, x and z along the sides of the cells; origin and unit of length stay those of the
    /// scene.
    Aligned,
}

/// Form of the exported model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Floats, as every program reads them
    Ply,
    /// The compressed PLY of PlayCanvas, for viewing: about a quarter of the bytes
    CompressedPly,
}

/// Arguments of `fathom export`.
#[derive(Args, Debug)]
pub struct ExportArgs {
    /// A result folder, or a PLY; for --html also a .compressed.ply or a .sog
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Form of the exported model [default: compressed-ply if its name ends with .compressed.ply, else ply]
    #[arg(long, value_name = "FORM")]
    format: Option<Format>,
    /// Encoding of the exported colours
    #[arg(long = "export-colour", visible_alias = "colour", value_name = "LIGHT", default_value = "srgb")]
    colour: Colour,
    /// Axes of the exported model; `aligned` needs the plan.json of its result folder
    #[arg(long, value_name = "AXES", default_value = "scene")]
    frame: Frame,
    #[command(flatten)]
    white_point: WhitePointArgs,
    /// Cameras for `viewer`, --white-point auto and --chart: a cameras.json, a transforms.json or a scene
    /// folder [default: the training cameras of the result]
    #[arg(long, value_name = "FILE")]
    cameras: Option<PathBuf>,
    /// `viewer`: number of training steps, one picture each [default: 3000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    iterations: Option<u32>,
    #[command(flatten)]
    gpu: GpuArgs,
    /// The file to write
    #[arg(short, long, value_name = "FILE.ply", required_unless_present = "html")]
    output: Option<PathBuf>,
    #[command(flatten)]
    handover: HandoverArgs,
}

pub fn run(args: ExportArgs) -> Result<()> {
    args.handover.check()?;
    match (&args.handover.html, &args.output) {
        (Some(html), _) => handover::write(&args.model, html, &args.handover),
        (None, Some(output)) => export(&args, output),
        (None, None) => {
            Err(CliError::Message("name the file to write with -o, or a page with --html".to_owned()))
        }
    }
}

fn export(args: &ExportArgs, to: &Path) -> Result<()> {
    let path = model::model_path(&args.model)?;
    model::refuse_linear(&path)?;
    let same = std::fs::canonicalize(&path).ok();
    if same.is_some() && same == std::fs::canonicalize(to).ok() {
        return Err(CliError::Message(format!(
            "{} is the model itself; give another output file with -o",
            to.display()
        )));
    }
    let compares = args.colour == Colour::Viewer;
    if args.iterations.is_some() && !compares
        || args.cameras.is_some() && !compares && !args.white_point.needs_pictures()
    {
        return Err(CliError::Message(
            "--iterations needs --export-colour viewer, which trains colours; --cameras needs it too, or \
             --white-point auto or --chart; add one or omit them"
                .to_owned(),
        ));
    }
    let white = white_point_of(args, &path)?;
    if compares {
        return for_viewers(args, to, &path, white.as_ref());
    }
    let mut reader = SplatReader::open(&path)?;
    let (count, layout) = (reader.count(), reader.layout());
    let mut comments = reader.comments().to_vec();
    if args.colour == Colour::Linear {
        // Programs that read the water of a model decode its colours.
        comments.retain(|comment| !WaterRecord::is_in(comment));
        comments.push(model::LINEAR_COLOURS.to_owned());
    }
    let comment = white_point_comment(white.as_ref(), &mut comments)?;
    comments.extend(comment);
    let rotation = rotation(args.frame, &path, &comments)?;
    comments.retain(|comment| !axes::is_in(comment));
    if let (Frame::Aligned, Some(rotation)) = (args.frame, rotation) {
        comments.push(axes::comment(rotation));
    }
    let converted = |block: Gaussians| {
        let block = match (args.colour == Colour::Linear, &white) {
            (true, None) => in_linear_light(block),
            (true, Some(found)) => white::in_linear_light(in_linear_light(block), found.gains),
            (false, None) => block,
            (false, Some(found)) => white::in_srgb(block, found.gains),
        };
        match rotation {
            Some(rotation) => axes::turned(block, rotation),
            None => block,
        }
    };
    if format_of(args, to) == Format::CompressedPly {
        let mut whole = Gaussians::empty(layout.sh_degree());
        while let Some(block) = reader.next_block(BLOCK)? {
            let block = converted(block);
            (0..block.len()).for_each(|index| whole.push_from(&block, index));
        }
        write_compressed(to, &whole, &comments)?;
    } else {
        write_whole(to, |file| {
            let name = to.to_string_lossy();
            let mut writer = SplatWriter::new(file, &name, count, layout.sh_degree(), &comments)?;
            while let Some(block) = reader.next_block(BLOCK)? {
                writer.write(&converted(block))?;
            }
            writer.finish().map(|_| ())
        })?;
        output::line(format!("model: {} ({count} Gaussians)", to.display()));
    }
    white.iter().for_each(|found| output::line(white_point::summary(found)));
    Ok(())
}

/// The form to write: the requested one, or that of the name.
fn format_of(args: &ExportArgs, to: &Path) -> Format {
    let is_compressed = to.to_string_lossy().to_lowercase().ends_with(".compressed.ply");
    args.format.unwrap_or(if is_compressed { Format::CompressedPly } else { Format::Ply })
}

fn write_compressed(to: &Path, model: &Gaussians, comments: &[String]) -> Result<()> {
    let copy = ply::compressed(model, comments)?;
    write_whole(to, |file| file.write_all(&copy.bytes).map_err(CoreError::io("write", to)))?;
    let bytes = output::bytes(copy.bytes.len() as u64);
    output::line(format!("model: {} ({} Gaussians, {bytes})", to.display(), copy.gaussians));
    handover::remark_on(&copy);
    Ok(())
}

/// The requested white point. If it needs pictures, they are rendered from the model at `path` without its
/// water.
fn white_point_of(args: &ExportArgs, path: &Path) -> Result<Option<WhitePoint>> {
    if args.white_point.is_none() {
        return Ok(None);
    }
    model::refuse_white_point(path, "fit for another one")?;
    let record = ply::water_record(path)?;
    if args.colour == Colour::Srgb
        && record.as_ref().is_some_and(|record| record.composition.blends_in_linear_light())
    {
        return Err(CliError::Message(format!(
            "{} is blended in linear light, which programs that need a white point do not support; add \
             --export-colour viewer or --export-colour linear",
            path.display()
        )));
    }
    if !args.white_point.needs_pictures() {
        return args.white_point.find(&[], |_, _| Err(CliError::Message("there are no pictures".to_owned())));
    }
    let views = views(args)?;
    let shots: Vec<_> = views.iter().map(|view| (view.name.as_str(), &view.camera, &view.pose)).collect();
    let found = || -> Result<Option<WhitePoint>> {
        let mut renderer = Renderer::new(args.gpu.open()?, &model::load(path)?)?
            .drawn(ply::drawing(path)?)?
            .with_water(record.map(|record| WaterView::of_record(&record, Output::Restored)));
        args.white_point
            .find(&shots, |camera, pose| renderer.render(camera, pose, [0.0; 3]).map_err(Into::into))
    };
    found().map_err(CliError::of_rendering)
}

/// The comment of a model with a white point. Removes its water from `comments`, because it applies to the
/// unchanged J.
fn white_point_comment(found: Option<&WhitePoint>, comments: &mut Vec<String>) -> Result<Option<String>> {
    let Some(found) = found else { return Ok(None) };
    comments.retain(|comment| !WaterRecord::is_in(comment));
    let json = serde_json::to_string(found)
        .map_err(|error| CliError::Message(format!("the white point cannot be written: {error}")))?;
    Ok(Some(format!("{}{json}", model::WHITE_POINT)))
}

/// Writes the model with colours that make viewers show its J.
fn for_viewers(args: &ExportArgs, to: &Path, path: &Path, white: Option<&WhitePoint>) -> Result<()> {
    let record = ply::water_record(path)?
        .filter(|record| record.composition.blends_in_linear_light())
        .ok_or_else(|| {
            CliError::Message(format!(
                "{} is blended in sRGB, so viewers already show it correctly; omit --export-colour viewer",
                path.display()
            ))
        })?;
    if ply::drawing(path)?.mip_filter {
        return Err(CliError::Message(format!(
            "{} was trained with train.mip_filter, and its smoothing would be applied twice; --export-colour \
             viewer is for models without it",
            path.display()
        )));
    }
    let views = views(args)?;
    let model = model::load(path)?;
    let iterations = args.iterations.unwrap_or(VIEWER_ITERATIONS);
    let progress = Progress::new("colours", u64::from(iterations), Unit::Count("pictures"));
    let colours = ViewerColours { iterations, seed: 1 };
    let shown = WaterView::of_record(&record, Output::Restored);
    let found = colours.find(&args.gpu.open()?, &model, shown, views, |now| {
        progress.set(u64::from(now.iteration), "");
    });
    let model: Gaussians = found.map_err(|error| CliError::from(error).of_rendering())?;
    progress.finish();
    let mut comments = SplatReader::open(path)?.comments().to_vec();
    // The water applies to colours that are blended in linear light.
    comments.retain(|comment| !WaterRecord::is_in(comment) && !axes::is_in(comment));
    comments.push(VIEWER_COLOURS.to_owned());
    let comment = white_point_comment(white, &mut comments)?;
    comments.extend(comment);
    let model = match white {
        Some(found) => white::in_srgb(model, found.gains),
        None => model,
    };
    let model = match args.frame {
        Frame::Scene => model,
        Frame::Aligned => {
            let rotation = model::alignment(path)?;
            comments.push(axes::comment(rotation));
            axes::turned(model, rotation)
        }
    };
    if format_of(args, to) == Format::CompressedPly {
        write_compressed(to, &model, &comments)?;
    } else {
        ply::write_model(to, &model, &comments)?;
        output::line(format!("model: {} ({} Gaussians)", to.display(), model.len()));
    }
    white.iter().for_each(|found| output::line(white_point::summary(found)));
    Ok(())
}

/// Cameras of the compared pictures: the given ones, or the training cameras of the result at its training
/// size.
fn views(args: &ExportArgs) -> Result<Vec<TrainView>> {
    let of_result = args.model.join("cameras.json");
    let cameras = match &args.cameras {
        Some(cameras) => cameras,
        None if of_result.is_file() => &of_result,
        None => {
            return Err(CliError::Message(format!(
                "{} does not exist; it holds the cameras of the compared pictures. Give a result folder, or \
                 --cameras",
                of_result.display()
            )));
        }
    };
    let trained = model::data_config(&args.model)?.unwrap_or_default();
    let test_every = if args.cameras.is_none() { trained.test_every as usize } else { 0 };
    let mut scene = load_scene(cameras, Purpose::Inspect, &DataConfig::default())?;
    scene.views.sort_by(|a, b| a.name.cmp(&b.name));
    let mut views = Vec::with_capacity(scene.views.len());
    for (index, view) in scene.views.iter().enumerate() {
        if test_every > 0 && index.is_multiple_of(test_every) {
            continue;
        }
        let camera = scene.camera(view.camera_id).ok_or_else(|| {
            CliError::Message(format!("{}: view {} has no camera", cameras.display(), view.name))
        })?;
        let camera = camera.pinhole()?.fitted(trained.max_resolution);
        views.push(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 });
    }
    Ok(views)
}

/// The rotation from the axes of the model at `path` to the requested ones; `None` if they are the same.
fn rotation(to: Frame, path: &Path, comments: &[String]) -> Result<Option<DQuat>> {
    let has = axes::among(comments)?;
    Ok(match (to, has) {
        (Frame::Scene, has) => has.map(|from_scene| from_scene.inverse()),
        (Frame::Aligned, None) => Some(model::alignment(path)?),
        (Frame::Aligned, Some(_)) => {
            return Err(CliError::Message(format!(
                "{} was already exported with --frame aligned; give the model that it was exported from",
                path.display()
            )));
        }
    })
}
