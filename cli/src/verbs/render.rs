//! `fathom render`: pictures of a model from given cameras, along a path through them, or from an orbit.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{ArgGroup, Args, ValueEnum};
use fathom_core::config::DataConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, Output, Rendered, Renderer, SurfaceRenderer, WaterView};
use fathom_core::picture;
use fathom_core::scene::{CameraPath, Orbit, PinholeCamera, Pose, Purpose, load_scene};
use fathom_core::white_point::apply;
use glam::DVec3;
use serde_json::json;

use super::parse_size;
use crate::error::{CliError, Result};
use crate::maps::{Map, MapWriter};
use crate::model::{self, GpuArgs};
use crate::output;
use crate::progress::{Progress, Unit};
use crate::white_point::{self, WhitePointArgs};

/// Longest side of a picture, pixels: rendering 16384 x 16384 takes 5 GB.
const MAX_SIDE: u32 = 16_384;
/// Maximum number of frames of a path: more than an hour at 24 per second. File names count up to this.
const MAX_FRAMES: i64 = 100_000;
/// Size of the pictures of an orbit, which has no cameras to take it from.
const ORBIT_SIZE: (u32, u32) = (1280, 720);

/// Arguments of `fathom render`.
#[derive(Args, Debug)]
#[command(group(ArgGroup::new("from").required(true).args(["cameras", "orbit"])))]
pub struct RenderArgs {
    /// A result folder, or a PLY of any 3D Gaussian trainer
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Cameras to render from: a cameras.json (3DGS), a transforms.json, or a scene folder
    #[arg(long, value_name = "FILE")]
    cameras: Option<PathBuf>,
    /// Render N frames (frame_00000.png, ...) of a smooth path at constant speed through the cameras in file
    /// order (COLMAP: by name), instead of one picture per camera
    #[arg(long, value_name = "N", requires = "cameras", value_parser = clap::value_parser!(u32).range(1..=MAX_FRAMES))]
    path: Option<u32>,
    /// Without cameras: N frames on a circle around the centre of the model
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MAX_FRAMES))]
    orbit: Option<u32>,
    /// Up direction of the orbit, in the axes of the model
    #[arg(
        long,
        value_name = "AXIS",
        value_enum,
        requires = "orbit",
        default_value = "-y",
        allow_hyphen_values = true
    )]
    up: Axis,
    /// Radius of the orbit, scene units [default: twice the median distance of the Gaussians from the centre]
    #[arg(long, value_name = "R", requires = "orbit", value_parser = parse_positive)]
    orbit_radius: Option<f64>,
    /// Folder for the pictures, one PNG per camera or frame
    #[arg(short, long, value_name = "DIR", default_value = "frames")]
    output: PathBuf,
    /// Underwater models: `on` renders the scene as the camera sees it, `off` without the water, `only` the
    /// backscatter alone
    #[arg(long, value_name = "on|off|only", value_enum, default_value = "off")]
    water: WaterShown,
    /// Results of method wsgs: the scene without the water surface
    #[arg(long, conflicts_with = "ior")]
    no_surface: bool,
    /// Results of method wsgs: another liquid in place of the water, by its refractive index (oil: 1.46)
    #[arg(long, value_name = "N", value_parser = parse_positive)]
    ior: Option<f64>,
    #[command(flatten)]
    white_point: WhitePointArgs,
    /// Maps to write beside the colours, one folder each: DIR/range, DIR/alpha, ...
    #[arg(long, value_name = "MAP,...", value_enum, value_delimiter = ',')]
    maps: Vec<Map>,
    /// Size of the pictures, independent of the cameras: each picture holds the whole undistorted view of its
    /// camera, and more at the sides if the aspect ratios differ
    #[arg(
        long, value_name = "WxH", value_parser = parse_picture_size,
        conflicts_with_all = ["scale", "max_resolution"]
    )]
    size: Option<(u32, u32)>,
    /// Size of the pictures relative to the cameras: 0.5 halves both sides, 2 doubles them
    #[arg(long, value_name = "FACTOR", value_parser = parse_positive, conflicts_with = "max_resolution")]
    scale: Option<f64>,
    /// Longest side of a picture, pixels; larger pictures are scaled down [default: 1600]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_resolution: Option<u32>,
    #[command(flatten)]
    gpu: GpuArgs,
    /// Print the names of the pictures as JSON
    #[arg(long)]
    json: bool,
}

/// Rendering of the water.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum WaterShown {
    On,
    Off,
    Only,
}

/// A direction along an axis of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Axis {
    X,
    Y,
    Z,
    #[value(name = "-x")]
    MinusX,
    /// As in most reconstructions and Fathom's synthetic scenes
    #[value(name = "-y")]
    MinusY,
    #[value(name = "-z")]
    MinusZ,
}

impl Axis {
    fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
            Self::MinusX => DVec3::NEG_X,
            Self::MinusY => DVec3::NEG_Y,
            Self::MinusZ => DVec3::NEG_Z,
        }
    }
}

/// One picture to render.
struct Shot {
    /// Name of its file.
    name: String,
    camera: PinholeCamera,
    pose: Pose,
}

pub fn run(args: RenderArgs) -> Result<()> {
    render(args).map_err(CliError::of_rendering)
}

fn render(args: RenderArgs) -> Result<()> {
    if args.water != WaterShown::Off && !args.white_point.is_none() {
        return Err(CliError::Message(
            "--white-point and --chart are for pictures without the water; omit them, or omit --water"
                .to_owned(),
        ));
    }
    let path = model::model_path(&args.model)?;
    let model = model::load(&path)?;
    let orbit = args.orbit.map(|frames| Ok::<_, CliError>((args.orbit_of(&model)?, frames))).transpose()?;
    let shots = match (&args.cameras, orbit) {
        (Some(cameras), _) => args.shots_of_cameras(cameras)?,
        (None, Some((orbit, frames))) => {
            let camera = args.sized(&Orbit::camera(ORBIT_SIZE.0, ORBIT_SIZE.1), "the orbit")?;
            numbered(orbit.poses(args.up.direction(), frames).map(|pose| (camera, pose)))
        }
        (None, None) => {
            return Err(CliError::Message(
                "choose the viewpoints with --cameras or \
            --orbit"
                    .to_owned(),
            ));
        }
    };
    if args.cameras.is_none() || args.path.is_some() {
        refuse_later_frames(&args.output, &shots)?;
    }
    let gpu = args.gpu.open()?;
    let mut surface = args.surface(&gpu, &path)?;
    if surface.is_some() && !args.white_point.is_none() {
        return Err(CliError::Message(
            "--white-point and --chart are for pictures without the water surface; add --no-surface"
                .to_owned(),
        ));
    }
    let mut renderer = Renderer::new(gpu, &model)?
        .drawn(fathom_core::ply::drawing(&path)?)?
        .with_water(args.water_view(&path)?);
    let named: Vec<_> = shots.iter().map(|shot| (shot.name.as_str(), &shot.camera, &shot.pose)).collect();
    let white = args
        .white_point
        .find(&named, |camera, pose| renderer.render(camera, pose, [0.0; 3]).map_err(Into::into))?;
    std::fs::create_dir_all(&args.output).map_err(CliError::io("create", &args.output))?;
    white_point::write(&args.output, white.as_ref())?;
    let mut maps = MapWriter::new(&args.output, &args.maps)?;
    let progress = Progress::new("rendering", shots.len() as u64, Unit::Count("pictures"));
    let mut files = Vec::new();
    for (index, shot) in shots.iter().enumerate() {
        let mut rendered = match &mut surface {
            Some(surface) => surface.render(&shot.camera, &shot.pose)?,
            None => renderer.render(&shot.camera, &shot.pose, [0.0; 3])?,
        };
        if let Some(white) = &white {
            apply(&mut rendered.rgb, white.gains);
        }
        let path = args.output.join(&shot.name);
        let png = picture::encode_png(rendered.width, rendered.height, &to_rgb8(&rendered))?;
        std::fs::write(&path, png).map_err(CliError::io("write", &path))?;
        let normals = if maps.wants(Map::Normal) {
            Some(renderer.normals(&model, &shot.camera, &shot.pose)?)
        } else {
            None
        };
        maps.write(&shot.name, &rendered, normals.as_deref())?;
        if let Some(surface) = &mut surface {
            maps.write_of_surface(&shot.name, |output| {
                Ok(surface.render_as(&shot.camera, &shot.pose, output)?)
            })?;
        }
        files.push(path);
        progress.set(index as u64 + 1, "");
    }
    let maps = maps.finish()?;
    progress.finish();
    if args.json {
        let orbit =
            orbit.map(|(orbit, _)| json!({ "centre": orbit.centre.to_array(), "radius": orbit.radius }));
        let mut said = json!({ "pictures": files, "maps": maps, "orbit": orbit });
        if let Some(white) = &white {
            said["white_point"] = json!(white);
        }
        return output::json(&said);
    }
    output::line(format!("{} pictures in {}", files.len(), args.output.display()));
    if let Some(white) = &white {
        output::line(white_point::summary(white));
    }
    if let Some((orbit, _)) = orbit {
        let centre = orbit.centre;
        output::line(format!(
            "orbit around ({:.4}, {:.4}, {:.4}) at a distance of {:.4} scene units (--orbit-radius, --up)",
            centre.x, centre.y, centre.z, orbit.radius
        ));
    }
    Ok(())
}

impl RenderArgs {
    /// How to render through the water surface of a result; `None` for other models, and without it.
    fn surface(&self, gpu: &Arc<Gpu>, path: &Path) -> Result<Option<SurfaceRenderer>> {
        let Some(mut renderer) = model::surface_renderer(gpu, path)? else {
            let of_surface = self.maps.iter().find(|map| map.of_surface().is_some());
            let wants = match (self.ior, of_surface) {
                _ if self.no_surface => "--no-surface".to_owned(),
                (Some(_), _) => "--ior".to_owned(),
                (None, Some(map)) => format!("--maps {}", map.folder()),
                (None, None) => return Ok(None),
            };
            return Err(CliError::Message(format!(
                "{wants} is for results with a water surface, but there is no folder `sets` beside {}; give the \
                 result folder of a job of method wsgs",
                path.display()
            )));
        };
        if self.no_surface {
            return Ok(None);
        }
        if let Some(ior) = self.ior {
            renderer.set_ior(ior).map_err(|error| CliError::Message(format!("--ior: {error}")))?;
        }
        Ok(Some(renderer))
    }

    /// Rendering of the model's water; `None` if it has none.
    fn water_view(&self, path: &Path) -> Result<Option<WaterView>> {
        let record = fathom_core::ply::water_record(path)?;
        let output = match self.water {
            WaterShown::On => Output::Underwater,
            WaterShown::Off => Output::Restored,
            WaterShown::Only => Output::Backscatter,
        };
        if record.is_none() && self.water != WaterShown::Off {
            return Err(CliError::Message(format!(
                "{} has no water to show; it was trained without a medium (--preset 3dgs) or by another \
                 program",
                path.display()
            )));
        }
        Ok(record.map(|record| WaterView::of_record(&record, output)))
    }

    fn orbit_of(&self, model: &Gaussians) -> Result<Orbit> {
        let orbit = Orbit::around(model)
            .map_err(|error| CliError::Message(format!("{}: {error}", self.model.display())))?;
        Ok(Orbit { radius: self.orbit_radius.unwrap_or(orbit.radius), ..orbit })
    }

    /// One picture for each camera of a file or scene, or the frames of the path through them.
    fn shots_of_cameras(&self, file: &Path) -> Result<Vec<Shot>> {
        let mut scene = load_scene(file, Purpose::Inspect, &DataConfig::default())?;
        if self.path.is_some() {
            scene.views.sort_by_key(|view| view.listed_at);
        }
        let mut cameras = Vec::with_capacity(scene.views.len());
        for view in &scene.views {
            let camera = scene.camera(view.camera_id).ok_or_else(|| {
                CliError::Message(format!("{}: view {} has no camera", file.display(), view.name))
            })?;
            cameras.push((self.sized(&camera.pinhole()?, &view.name)?, view.pose));
        }
        let Some(frames) = self.path else {
            let names = picture_names(scene.views.iter().map(|view| view.name.as_str()));
            let shots = names.into_iter().zip(cameras);
            return Ok(shots.map(|(name, (camera, pose))| Shot { name, camera, pose }).collect());
        };
        // All frames have the size of the first camera.
        if let Some((PinholeCamera { width, height, .. }, _)) = cameras.first().copied() {
            cameras.iter_mut().for_each(|(camera, _)| *camera = camera.reshaped(width, height));
        }
        Ok(numbered(CameraPath::new(&cameras)?.frames(frames)))
    }

    /// `camera` with the requested picture size; `whose` is for messages.
    fn sized(&self, camera: &PinholeCamera, whose: &str) -> Result<PinholeCamera> {
        let sized = match (self.size, self.scale) {
            (Some((width, height)), _) => camera.reshaped(width, height),
            (None, Some(scale)) => {
                // Values too large for u32 become its maximum, which is refused below.
                let side = |pixels: u32| (f64::from(pixels) * scale).round() as u32;
                let (width, height) = (side(camera.width), side(camera.height));
                if width == 0 || height == 0 {
                    return Err(CliError::Message(format!(
                        "--scale {scale} leaves no pixel of the {}x{} pixels of {whose}; use a larger scale",
                        camera.width, camera.height
                    )));
                }
                camera.resized(width, height)
            }
            (None, None) => {
                camera.fitted(self.max_resolution.unwrap_or(DataConfig::default().max_resolution))
            }
        };
        if sized.width.max(sized.height) > MAX_SIDE {
            return Err(CliError::Message(format!(
                "the picture of {whose} would be larger than {MAX_SIDE} pixels a side; choose a smaller \
                 --scale or --max-resolution, or set it with --size"
            )));
        }
        Ok(sized)
    }
}

/// Refuses a folder with frames of a longer film: they would end up at the end of a film made from the
/// folder.
fn refuse_later_frames(folder: &Path, shots: &[Shot]) -> Result<()> {
    let next = folder.join(frame_name(shots.len()));
    if next.exists() {
        return Err(CliError::Message(format!(
            "{} belongs to a film of more than {} frames; remove it and the frames after it, or choose \
             another folder with -o",
            next.display(),
            shots.len()
        )));
    }
    Ok(())
}

fn frame_name(index: usize) -> String {
    format!("frame_{index:05}.png")
}

/// Pictures with names numbered from 0.
fn numbered(cameras: impl Iterator<Item = (PinholeCamera, Pose)>) -> Vec<Shot> {
    let shot = |(index, (camera, pose)): (usize, _)| Shot { name: frame_name(index), camera, pose };
    cameras.enumerate().map(shot).collect()
}

fn parse_picture_size(text: &str) -> std::result::Result<(u32, u32), String> {
    let (width, height) = parse_size(text)?;
    if [width, height].iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
        return Err(format!("each side must be 1 to {MAX_SIDE} pixels"));
    }
    Ok((width, height))
}

fn parse_positive(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
        _ => Err("use a number above 0, such as 0.5".to_owned()),
    }
}

/// Clamped and rounded to 8 bits, as in the metrics.
pub fn to_rgb8(rendered: &Rendered) -> Vec<u8> {
    rendered.rgb.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

/// The name of a view's picture without its extension; folders become part of the name.
pub fn picture_stem(view: &str) -> String {
    let flat = flattened(view);
    flat.rsplit_once('.').map_or(flat.as_str(), |(stem, _)| stem).to_owned()
}

/// A unique file name for each view. Views whose names differ only in the extension keep it (`a.jpg.png`);
/// names that are still equal are numbered (`a_b.jpg~2.png`).
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
    fn a_picture_is_named_after_its_view() {
        assert_eq!(picture_names(["a.jpg", "left/b.tif", "c"]), ["a.png", "left_b.png", "c.png"]);
    }

    #[test]
    fn pictures_of_different_views_never_overwrite_each_other() {
        assert_eq!(picture_names(["a.jpg", "a.png", "b.jpg"]), ["a.jpg.png", "a.png.png", "b.png"]);
        assert_eq!(picture_names(["a/b.jpg", "a_b.jpg"]), ["a_b.jpg.png", "a_b.jpg~2.png"]);
        assert_eq!(picture_names(["a.jpg", "a.jpg.tif", "a.png"]), ["a.jpg.png", "a.jpg~2.png", "a.png.png"]);
    }
}
