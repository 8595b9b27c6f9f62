//! `fathom synth`: makes a small underwater scene with exact truth.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use fathom_core::synth::{PoolOptions, SynthOptions, synthesise, synthesise_pool};
use fathom_core::water::Water;

use super::parse_size;
use crate::error::{CliError, Result};
use crate::output;
use crate::progress::{Progress, Unit};

/// Arguments of `fathom synth`.
#[derive(Args, Debug)]
pub struct SynthArgs {
    /// Folder to create, with images/, sparse/0 and truth/
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// What is photographed: a `wreck` under water, or a `pool` from above, through its surface
    #[arg(long, value_enum, default_value_t = Kind::Wreck)]
    kind: Kind,
    /// Viewing direction: `down` onto a wreck, or `forward` along it over a reef that ends; open water above
    /// the horizon is brighter upwards [default: down]
    #[arg(long, value_enum)]
    look: Option<Whereto>,
    /// Whether to add water between camera and wreck [default: on]
    #[arg(long, value_enum)]
    water: Option<Switch>,
    /// Length of a pool, metres; it is 2 metres wide [default: 2]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    length: Option<f64>,
    /// Depth of a pool, metres [default: 0.8]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    depth: Option<f64>,
    /// Refractive index of the water of a pool [default: 1.333]
    #[arg(long, value_name = "INDEX", allow_negative_numbers = true)]
    ior: Option<f64>,
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
enum Kind {
    Wreck,
    Pool,
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

impl SynthArgs {
    /// Refuses flags of another kind of scene.
    fn check(&self) -> Result<()> {
        let (given, of, needed) = match self.kind {
            Kind::Wreck => (
                vec![
                    ("--length", self.length.is_some()),
                    ("--depth", self.depth.is_some()),
                    ("--ior", self.ior.is_some()),
                ],
                "a pool",
                "pool",
            ),
            Kind::Pool => {
                (vec![("--look", self.look.is_some()), ("--water", self.water.is_some())], "a wreck", "wreck")
            }
        };
        match given.into_iter().find(|(_, is_given)| *is_given) {
            Some((flag, _)) => {
                Err(CliError::Message(format!("{flag} is for {of}; add --kind {needed}, or leave it out")))
            }
            None => Ok(()),
        }
    }

    fn pool(&self) -> PoolOptions {
        let usual = PoolOptions::default();
        PoolOptions {
            seed: self.seed,
            views: self.views,
            width: self.size.0,
            height: self.size.1,
            points_per_view: self.points_per_view,
            length: self.length.unwrap_or(usual.length),
            depth: self.depth.unwrap_or(usual.depth),
            ior: self.ior.unwrap_or(usual.ior),
        }
    }

    fn wreck(&self) -> SynthOptions {
        let of_look = match self.look {
            None | Some(Whereto::Down) => SynthOptions::default(),
            Some(Whereto::Forward) => SynthOptions::forward(),
        };
        let sized = SynthOptions {
            seed: self.seed,
            views: self.views,
            width: self.size.0,
            height: self.size.1,
            points_per_view: self.points_per_view,
            ..of_look
        };
        match self.water {
            None | Some(Switch::On) => sized,
            Some(Switch::Off) => SynthOptions { water: Water::CLEAR, by_direction: None, ..sized },
        }
    }
}

pub fn run(args: SynthArgs) -> Result<()> {
    args.check()?;
    let (width, height) = args.size;
    let progress = Progress::new("photographing", args.views.into(), Unit::Count("views"));
    let show = |done: u32, _| progress.set(done.into(), "");
    let summary = match args.kind {
        Kind::Wreck => synthesise(&args.out, &args.wreck(), show)?,
        Kind::Pool => synthesise_pool(&args.out, &args.pool(), show)?,
    };
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
