//! `fathom synth`: makes a small underwater scene with exact truth.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use fathom_core::synth::{SynthOptions, synthesise};
use fathom_core::water::Water;

use super::parse_size;
use crate::error::Result;
use crate::output;
use crate::progress::{Progress, Unit};

/// Arguments of `fathom synth`.
#[derive(Args, Debug)]
pub struct SynthArgs {
    /// Folder to create, with images/, sparse/0 and truth/
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Viewing direction: `down` onto a wreck, or `forward` along it over a reef that ends; open water above
    /// the horizon is brighter upwards
    #[arg(long, value_enum, default_value_t = Whereto::Down)]
    look: Whereto,
    /// Whether to add water between camera and wreck
    #[arg(long, value_enum, default_value_t = Switch::On)]
    water: Switch,
    /// Seed of textures, debris, camera path and noise
    #[arg(long, default_value_t = SynthOptions::default().seed)]
    seed: u32,
    /// Number of photographs
    #[arg(long, default_value_t = SynthOptions::default().views)]
    views: u32,
    /// Size of a photograph
    #[arg(long, value_name = "WxH", default_value = "240x180", value_parser = parse_size)]
    size: (u32, u32),
    /// Pixels of each photograph where a sparse point is tried; fewer become points
    #[arg(long, value_name = "N", default_value_t = SynthOptions::default().points_per_view)]
    points_per_view: u32,
    /// Print a summary as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Whereto {
    Down,
    Forward,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Switch {
    On,
    Off,
}

pub fn run(args: SynthArgs) -> Result<()> {
    let (width, height) = args.size;
    let of_look = match args.look {
        Whereto::Down => SynthOptions::default(),
        Whereto::Forward => SynthOptions::forward(),
    };
    let sized = SynthOptions {
        seed: args.seed,
        views: args.views,
        width,
        height,
        points_per_view: args.points_per_view,
        ..of_look
    };
    let options = match args.water {
        Switch::On => sized,
        Switch::Off => SynthOptions { water: Water::CLEAR, by_direction: None, ..sized },
    };
    let progress = Progress::new("photographing", args.views.into(), Unit::Count("views"));
    let summary = synthesise(&args.out, &options, |done, _| progress.set(done.into(), ""))?;
    progress.finish();
    if args.json {
        return output::json(&summary);
    }
    output::line(format!(
        "{}: {} photographs of {width}x{height}, {} sparse points, truth for {} held-out views",
        args.out.display(),
        summary.views,
        summary.points,
        summary.truth_views
    ));
    Ok(())
}
