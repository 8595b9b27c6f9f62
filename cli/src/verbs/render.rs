//! `fathom render`: pictures of a model from given cameras.

use std::path::PathBuf;

use clap::Args;
use fathom_core::config::DataConfig;
use fathom_core::gpu::{Rendered, Renderer};
use fathom_core::picture;
use fathom_core::scene::{Purpose, load_scene};
use serde_json::json;

use crate::error::{CliError, Result};
use crate::model::{self, GpuArgs};
use crate::output;
use crate::progress::{Progress, Unit};

/// Arguments of `fathom render`.
#[derive(Args, Debug)]
pub struct RenderArgs {
    /// A result folder, or a PLY
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Where to look from: a cameras.json (3DGS), a transforms.json, or a scene folder
    #[arg(long, value_name = "FILE")]
    cameras: PathBuf,
    /// Folder for the pictures, one PNG a camera
    #[arg(short, long, value_name = "DIR", default_value = "frames")]
    output: PathBuf,
    /// Longest side of a picture, pixels
    #[arg(long, value_name = "PX", default_value_t = DataConfig::default().max_resolution)]
    max_resolution: u32,
    #[command(flatten)]
    gpu: GpuArgs,
    /// Print the names of the pictures as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: RenderArgs) -> Result<()> {
    let model = model::load(&model::model_path(&args.model)?)?;
    let options = DataConfig { max_resolution: args.max_resolution, ..DataConfig::default() };
    let scene = load_scene(&args.cameras, Purpose::Inspect, &options)?;
    if scene.views.is_empty() {
        return Err(CliError::Message(format!("{} has no cameras", args.cameras.display())));
    }
    let mut renderer = Renderer::new(args.gpu.open()?, &model)?;
    std::fs::create_dir_all(&args.output).map_err(CliError::io("create", &args.output))?;
    let progress = Progress::new("rendering", scene.views.len() as u64, Unit::Count("pictures"));
    let mut files = Vec::new();
    for (index, view) in scene.views.iter().enumerate() {
        let camera = scene.camera(view.camera_id).ok_or_else(|| {
            CliError::Message(format!("{}: view {} has no camera", args.cameras.display(), view.name))
        })?;
        let camera = picture::prepared_camera(camera, args.max_resolution)?;
        let rendered = renderer.render(&camera, &view.pose, [0.0; 3])?;
        let path = args.output.join(picture_name(&view.name));
        let png = picture::encode_png(rendered.width, rendered.height, &to_rgb8(&rendered))?;
        std::fs::write(&path, png).map_err(CliError::io("write", &path))?;
        files.push(path);
        progress.set(index as u64 + 1, "");
    }
    progress.finish();
    if args.json {
        return output::json(&json!({ "pictures": files }));
    }
    output::line(format!("{} pictures in {}", files.len(), args.output.display()));
    Ok(())
}

/// Clamped and rounded to 8 bits, as the metrics take it.
pub fn to_rgb8(rendered: &Rendered) -> Vec<u8> {
    rendered.rgb.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

/// A file name for a view: folders become part of the name.
pub fn picture_name(view: &str) -> String {
    let flat = view.replace(['/', '\\'], "_");
    let stem = flat.rsplit_once('.').map_or(flat.as_str(), |(stem, _)| stem);
    format!("{stem}.png")
}
