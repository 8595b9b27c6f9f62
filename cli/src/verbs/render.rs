//! `fathom render`: pictures of a model from given cameras.

use std::collections::{BTreeMap, BTreeSet};
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
    let names = picture_names(scene.views.iter().map(|view| view.name.as_str()));
    for (index, (view, name)) in scene.views.iter().zip(names).enumerate() {
        let camera = scene.camera(view.camera_id).ok_or_else(|| {
            CliError::Message(format!("{}: view {} has no camera", args.cameras.display(), view.name))
        })?;
        let camera = picture::prepared_camera(camera, args.max_resolution)?;
        let rendered = renderer.render(&camera, &view.pose, [0.0; 3])?;
        let path = args.output.join(name);
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

/// The name of a view's picture without its ending: folders become part of the name.
pub fn picture_stem(view: &str) -> String {
    let flat = flattened(view);
    flat.rsplit_once('.').map_or(flat.as_str(), |(stem, _)| stem).to_owned()
}

/// A file name for each view, no two of them equal. Views whose names differ in the extension only keep it
/// (`a.jpg.png`), and what is equal even then is numbered (`a_b.jpg~2.png`).
pub fn picture_names<'a>(views: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    let views: Vec<(String, String)> =
        views.into_iter().map(|view| (picture_stem(view), flattened(view))).collect();
    let mut views_of_stem = BTreeMap::<&str, u32>::new();
    for (stem, _) in &views {
        *views_of_stem.entry(stem).or_default() += 1;
    }
    let mut taken = BTreeSet::new();
    let mut names = Vec::with_capacity(views.len());
    for (stem, flat) in &views {
        let base = if views_of_stem[stem.as_str()] == 1 { stem } else { flat };
        let mut name = format!("{base}.png");
        let mut number = 1;
        while !taken.insert(name.clone()) {
            number += 1;
            name = format!("{base}~{number}.png");
        }
        names.push(name);
    }
    names
}

fn flattened(view: &str) -> String {
    view.replace(['/', '\\'], "_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_lends_its_name_to_its_picture() {
        assert_eq!(picture_names(["a.jpg", "left/b.tif", "c"]), ["a.png", "left_b.png", "c.png"]);
    }

    #[test]
    fn pictures_of_different_views_never_overwrite_each_other() {
        assert_eq!(picture_names(["a.jpg", "a.png", "b.jpg"]), ["a.jpg.png", "a.png.png", "b.png"]);
        assert_eq!(picture_names(["a/b.jpg", "a_b.jpg"]), ["a_b.jpg.png", "a_b.jpg~2.png"]);
        assert_eq!(picture_names(["a.jpg", "a.jpg.tif", "a.png"]), ["a.jpg.png", "a.jpg~2.png", "a.png.png"]);
    }
}
