//! `fathom export`: a model for other programs, its colours in sRGB or in linear light, in the axes of the scene or in
//! those of its plan.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use fathom_core::frame;
use fathom_core::linear_colours::in_linear_light;
use fathom_core::ply::{SplatReader, SplatWriter, write_whole};
use fathom_core::water::WaterRecord;
use glam::DQuat;

use crate::error::{CliError, Result};
use crate::model;
use crate::output;

/// Gaussians that are converted at a time.
const BLOCK: usize = 262_144;

/// In which light colours are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Colour {
    /// As viewers of Gaussians take them: the model as it is.
    Srgb,
    /// Linear light, for programs that light and blend in it. Viewers of Gaussians show this too dark.
    Linear,
}

/// Whose axes a model has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Frame {
    /// The scene's: those of the cameras' poses.
    Scene,
    /// The plan's: y down, x and z along the sides of the cells; origin and unit of length are the scene's.
    Aligned,
}

/// Arguments of `fathom export`.
#[derive(Args, Debug)]
pub struct ExportArgs {
    /// A result folder, or a PLY
    #[arg(value_name = "OUT|MODEL.ply")]
    model: PathBuf,
    /// Light of the exported colours
    #[arg(long = "export-colour", visible_alias = "colour", value_name = "LIGHT", default_value = "srgb")]
    colour: Colour,
    /// Axes of the exported model; `aligned` needs the plan.json of its result folder
    #[arg(long, value_name = "AXES", default_value = "scene")]
    frame: Frame,
    /// The file to write
    #[arg(short, long, value_name = "FILE.ply")]
    output: PathBuf,
}

pub fn run(args: ExportArgs) -> Result<()> {
    let path = model::model_path(&args.model)?;
    model::refuse_linear(&path)?;
    let same = std::fs::canonicalize(&path).ok();
    if same.is_some() && same == std::fs::canonicalize(&args.output).ok() {
        return Err(CliError::Message(format!(
            "{} is the model itself; give another file to write with -o",
            args.output.display()
        )));
    }
    let mut reader = SplatReader::open(&path)?;
    let (count, layout) = (reader.count(), reader.layout());
    let mut comments = reader.comments().to_vec();
    if args.colour == Colour::Linear {
        // Who reads the water of a model decodes its colours.
        comments.retain(|comment| !WaterRecord::is_in(comment));
        comments.push(model::LINEAR_COLOURS.to_owned());
    }
    let rotation = rotation(args.frame, &path, &comments)?;
    comments.retain(|comment| !frame::is_in(comment));
    if let (Frame::Aligned, Some(rotation)) = (args.frame, rotation) {
        comments.push(frame::comment(rotation));
    }
    write_whole(&args.output, |file| {
        let name = args.output.to_string_lossy();
        let mut writer = SplatWriter::new(file, &name, count, layout.sh_degree(), &comments)?;
        while let Some(block) = reader.next_block(BLOCK)? {
            let block = if args.colour == Colour::Linear { in_linear_light(block) } else { block };
            let block = match rotation {
                Some(rotation) => frame::turned(block, rotation),
                None => block,
            };
            writer.write(&block)?;
        }
        writer.finish().map(|_| ())
    })?;
    output::line(format!("model: {} ({count} Gaussians)", args.output.display()));
    Ok(())
}

/// From the axes that the model at `path` has to those that it is to have; `None` where they are the same.
fn rotation(to: Frame, path: &Path, comments: &[String]) -> Result<Option<DQuat>> {
    let has = frame::among(comments)?;
    Ok(match (to, has) {
        (Frame::Scene, has) => has.map(|from_scene| from_scene.inverse()),
        (Frame::Aligned, None) => Some(model::alignment(path)?),
        (Frame::Aligned, Some(_)) => {
            return Err(CliError::Message(format!(
                "{} was exported with --frame aligned already; give the model it was made of",
                path.display()
            )));
        }
    })
}
