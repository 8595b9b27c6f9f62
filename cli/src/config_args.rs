//! The configuration of a job: defaults, then `--config FILE`, then `--set`, then flags.
//!
//! All three write into one TOML table, which is read as a [`JobConfig`] at the end. So unknown names and
//! wrong types are refused from every source.

use std::path::{Path, PathBuf};

use clap::Args;
use fathom_core::config::JobConfig;
use toml::{Table, Value};

use crate::error::{CliError, Result};

/// Flags of the verbs that make a job.
#[derive(Args, Clone, Debug, Default)]
pub struct JobArgs {
    /// Partitions as COLUMNSxROWS on the horizontal plane, or auto: the partitioning predicted to finish
    /// soonest within the GPU memory of the workers [default: 1x1]
    #[arg(long, value_name = "MxN|auto", value_parser = parse_partitions)]
    pub partitions: Option<Partitions>,
    /// Iterations of the whole job, counted as for one partition [default: 12000]
    #[arg(long, short = 'i', value_name = "N")]
    pub iterations: Option<u32>,
    /// Iterations of every partition, instead of its share of the total
    #[arg(long, value_name = "N")]
    pub iterations_per_partition: Option<u32>,
    /// Longest side of a training image, pixels; larger photographs are scaled down [default: 1600]
    #[arg(long, visible_alias = "resolution", value_name = "PX")]
    pub max_resolution: Option<u32>,
    /// Maximum number of Gaussians in the whole job [default: 3000000]
    #[arg(long, visible_aliases = ["max-splats", "max-cap"], value_name = "N")]
    pub max_gaussians: Option<u32>,
    /// Maximum degree of the spherical harmonics, 0 to 3 [default: 3]
    #[arg(long, value_name = "D")]
    pub sh_degree: Option<u8>,
    /// Hold out every N-th view, sorted by name; 0 holds none out [default: 8]
    #[arg(long, value_name = "N")]
    pub test_every: Option<u32>,
    /// Measure the held-out views every N iterations; 0 disables it [default: 0]
    #[arg(long, value_name = "N")]
    pub eval_every: Option<u32>,
    /// Pixels of a mask to keep: white or black [default: white]
    #[arg(long, value_name = "SIDE", value_parser = ["white", "black"])]
    pub mask_keep: Option<String>,
    /// Method that trains the scene: splats (3D Gaussians), 2dgs (disks on surfaces) or wsgs (through a water
    /// surface) [default: splats]
    #[arg(long, value_name = "NAME")]
    pub method: Option<String>,
    /// Preset that all other settings start from: fathom, paper (SMP-UWGS as printed), 3dgs (no water),
    /// 2dgs (disks, no water) or wsgs (seen through a water surface) [default: fathom]
    #[arg(long, value_name = "NAME")]
    pub preset: Option<String>,
    /// Seed of all random numbers [default: 1]
    #[arg(long, value_name = "S")]
    pub seed: Option<u32>,
    /// TOML file of settings, such as deploy/job.example.toml
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One setting, such as train.ssim_weight=0.3; may be repeated; wins over --config
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
}

impl JobArgs {
    /// The resolved, checked configuration.
    pub fn resolve(&self) -> Result<JobConfig> {
        let mut table = match &self.config {
            Some(path) => read_file(path)?,
            None => Table::new(),
        };
        for setting in &self.set {
            apply_setting(&mut table, setting)?;
        }
        let mut put = |section: &str, key: &str, value: Option<Value>| -> Result<()> {
            match value {
                Some(value) => insert(&mut table, section, key, value),
                None => Ok(()),
            }
        };
        let number = |n: Option<u32>| n.map(|n| Value::Integer(n.into()));
        let grid = self.partitions.map(|partitions| match partitions {
            Partitions::Grid(columns, rows) => (columns, rows),
            Partitions::Auto => (1, 1),
        });
        put("partition", "auto", self.partitions.map(|p| Value::Boolean(p == Partitions::Auto)))?;
        put("partition", "columns", number(grid.map(|(columns, _)| columns)))?;
        put("partition", "rows", number(grid.map(|(_, rows)| rows)))?;
        put("partition", "iterations_per_partition", number(self.iterations_per_partition))?;
        put("train", "iterations", number(self.iterations))?;
        put("train", "max_gaussians", number(self.max_gaussians))?;
        put("train", "sh_degree", number(self.sh_degree.map(u32::from)))?;
        put("train", "seed", number(self.seed))?;
        put("train", "eval_every", number(self.eval_every))?;
        put("data", "max_resolution", number(self.max_resolution))?;
        put("data", "test_every", number(self.test_every))?;
        put("data", "mask_keep", self.mask_keep.clone().map(Value::String))?;
        if let Some(preset) = &self.preset {
            if let Some(path) = &self.config {
                same_preset(&read_file(path)?, preset, path)?;
            }
            table.insert("preset".to_owned(), Value::String(preset.clone()));
        }
        if let Some(method) = &self.method {
            table.insert("method".to_owned(), Value::String(method.clone()));
        }
        let config = serde_json::to_value(table)
            .and_then(JobConfig::over_its_preset)
            .map_err(|error| usage(format!("{error}; `fathom train --help` lists the flags")))?;
        config.validate()?;
        Ok(config)
    }
}

/// Values of `--partitions`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Partitions {
    /// Columns and rows.
    Grid(u32, u32),
    /// The plan chooses.
    Auto,
}

fn parse_partitions(text: &str) -> std::result::Result<Partitions, String> {
    if text == "auto" {
        return Ok(Partitions::Auto);
    }
    let fault = || "use COLUMNSxROWS with numbers from 1, such as 2x3, or auto".to_owned();
    let (columns, rows) = text.split_once(['x', 'X']).ok_or_else(fault)?;
    match (columns.parse(), rows.parse()) {
        (Ok(columns @ 1..), Ok(rows @ 1..)) => Ok(Partitions::Grid(columns, rows)),
        _ => Err(fault()),
    }
}

fn read_file(path: &Path) -> Result<Table> {
    let text = std::fs::read_to_string(path).map_err(CliError::io("read", path))?;
    let in_file =
        |error: toml::de::Error| usage(format!("{}: {}", path.display(), error.to_string().trim_end()));
    // Reading it as a configuration reports faults with their line. Values are checked later, over their
    // preset.
    let _: JobConfig = toml::from_str(&text).map_err(in_file)?;
    toml::from_str(&text).map_err(in_file)
}

/// Refuses a preset that the water settings of a file contradict: these win over every preset.
fn same_preset(file: &Table, preset: &str, path: &Path) -> Result<()> {
    let named = file.get("preset").and_then(Value::as_str);
    let of_file = named.unwrap_or("fathom");
    let unnamed = if named.is_none() { ", since it names none," } else { "" };
    match file.get("water").and_then(Value::as_table).and_then(|water| water.keys().next()) {
        Some(key) if of_file != preset => Err(usage(format!(
            "{} sets water.{key} for the preset {of_file}{unnamed} and would override the water of --preset {preset}; \
             write preset = \"{preset}\" in the file if you mean that, or remove its section [water]",
            path.display()
        ))),
        _ => Ok(()),
    }
}

fn apply_setting(table: &mut Table, setting: &str) -> Result<()> {
    let malformed =
        || usage(format!("--set {setting} is not SECTION.KEY=VALUE, such as train.ssim_weight=0.3"));
    let (name, value) = setting.split_once('=').ok_or_else(malformed)?;
    let (section, key) = name.trim().rsplit_once('.').ok_or_else(malformed)?;
    let value = value.trim();
    // A word without quotes is a string: --set data.mask_keep=black.
    let parsed = toml::from_str::<Table>(&format!("value = {value}"))
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| Value::String(value.to_owned()));
    insert(table, section, key, parsed)
}

/// `section` may lie in another: `train.classic`.
fn insert(table: &mut Table, section: &str, key: &str, value: Value) -> Result<()> {
    let mut inner = table;
    for name in section.split('.') {
        match inner.entry(name).or_insert_with(|| Value::Table(Table::new())) {
            Value::Table(section) => inner = section,
            _ => return Err(usage(format!("{section} is not a section of the configuration"))),
        }
    }
    inner.insert(key.to_owned(), value);
    Ok(())
}

fn usage(message: String) -> CliError {
    CliError::Core(fathom_core::CoreError::Config(message))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve(args: JobArgs) -> std::result::Result<JobConfig, String> {
        args.resolve().map_err(|error| error.to_string())
    }

    #[test]
    fn the_example_file_states_the_defaults() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/job.example.toml");
        let config = resolve(JobArgs { config: Some(file.into()), ..JobArgs::default() });
        assert_eq!(config, Ok(JobConfig::default()));
    }

    #[test]
    fn help_names_the_defaults() {
        let defaults = serde_json::to_value(JobConfig::default()).expect("JSON");
        let mut checked = 0;
        for arg in JobArgs::augment_args(clap::Command::new("")).get_arguments() {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            let Some((_, said)) = help.trim_end_matches(']').split_once(" [default: ") else { continue };
            let (id, sections) = (arg.get_id().as_str(), ["/data", "/partition", "/train", ""]);
            let found = sections.iter().find_map(|section| defaults.pointer(&format!("{section}/{id}")));
            match found {
                Some(default) => assert_eq!(default.to_string().trim_matches('"'), said, "--{id}"),
                None => assert_eq!((id, said), ("partitions", "1x1")),
            }
            checked += 1;
        }
        assert_eq!(checked, 11);
    }

    #[test]
    fn flags_win_over_settings_and_settings_over_the_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("job.toml");
        std::fs::write(&file, "[train]\niterations = 100\nseed = 5\nssim_weight = 0.1\n").expect("a file");
        let config = resolve(JobArgs {
            config: Some(file),
            set: vec![
                "train.iterations=200".into(),
                "train.seed=6".into(),
                "data.mask_keep=black".into(),
                "train.strategy=classic".into(),
                "train.classic.gradient=1e-3".into(),
            ],
            iterations: Some(300),
            partitions: Some(Partitions::Grid(2, 3)),
            ..JobArgs::default()
        })
        .expect("a configuration");
        assert_eq!((config.train.iterations, config.train.seed), (300, 6));
        assert_eq!(config.train.ssim_weight, 0.1);
        assert_eq!((config.partition.columns, config.partition.rows), (2, 3));
        assert_eq!(config.data.mask_keep, fathom_core::config::MaskKeep::Black);
        assert_eq!(config.train.strategy, fathom_core::config::Strategy::Classic);
        assert_eq!(config.train.classic.gradient, 1e-3);
    }

    #[test]
    fn no_arguments_give_the_defaults() {
        assert_eq!(resolve(JobArgs::default()).expect("defaults"), JobConfig::default());
    }

    #[test]
    fn other_settings_build_on_the_preset() {
        use fathom_core::config::{Medium, Preset};
        let of = |preset: &str, set: &[&str]| {
            let set = set.iter().map(|setting| (*setting).to_owned()).collect();
            resolve(JobArgs { preset: Some(preset.to_owned()), set, ..JobArgs::default() })
        };
        assert_eq!(of("3dgs", &[]).expect("3dgs").water.medium, Medium::None);
        let paper = of("paper", &["water.lr=0.5"]).expect("paper");
        assert_eq!(
            (paper.water.medium, paper.water.sh0_while_free, paper.water.lr),
            (Medium::PerPixel, false, 0.5)
        );
        assert_eq!(of("fathom", &[]), Ok(JobConfig::default()));
        let in_air = of("fathom", &["water.medium=none"]).expect("fathom without a medium");
        assert_eq!((in_air.preset, in_air.water.medium), (Preset::Fathom, Medium::None));
        let error = of("seasplat", &[]).expect_err("no such preset");
        assert!(error.contains("seasplat") && error.contains("3dgs"), "{error}");
        let error = of("fathom", &["water.start_at=0.9"]).expect_err("after its end");
        assert!(error.contains("water.start_at"), "{error}");
    }

    #[test]
    fn a_preset_is_refused_where_the_file_has_a_water_for_another() {
        let folder = tempfile::tempdir().expect("a folder");
        let of = |text: &str, preset: &str| {
            let path = folder.path().join("job.toml");
            std::fs::write(&path, text).expect("a file");
            resolve(JobArgs { config: Some(path), preset: Some(preset.to_owned()), ..JobArgs::default() })
        };
        let error = of("[water]\nlr = 0.02\n", "3dgs").expect_err("a water for another preset");
        assert!(
            ["job.toml", "water.lr", "fathom", "3dgs"].iter().all(|part| error.contains(part)),
            "{error}"
        );
        assert_eq!(of("[water]\nlr = 0.02\n", "fathom").expect("its preset").water.lr, 0.02);
        assert_eq!(
            of("preset = \"paper\"\n[water]\nlr = 0.02\n", "paper").expect("its preset").water.lr,
            0.02
        );
        let bare = of("[train]\nseed = 7\n", "3dgs").expect("no water settings");
        assert_eq!(bare.water, JobConfig::of_preset(fathom_core::config::Preset::Splatting).water);
    }

    #[test]
    fn an_unknown_name_is_refused_by_name() {
        let error = resolve(JobArgs { set: vec!["train.iteratoins=3".into()], ..JobArgs::default() })
            .expect_err("a spelling mistake");
        assert!(error.contains("iteratoins"), "{error}");
    }

    #[test]
    fn a_value_out_of_range_names_its_setting() {
        let error = resolve(JobArgs { set: vec!["train.ssim_weight=3".into()], ..JobArgs::default() })
            .expect_err("out of range");
        assert!(error.contains("train.ssim_weight"), "{error}");
    }

    #[test]
    fn a_fault_in_the_file_is_reported_with_file_and_line() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("job.toml");
        std::fs::write(&file, "[train]\niterations = \"many\"\n").expect("a file");
        let error = resolve(JobArgs { config: Some(file), ..JobArgs::default() }).expect_err("a string");
        assert!(error.contains("job.toml") && error.contains("line 2"), "{error}");
    }

    #[test]
    fn auto_wins_over_the_grid_of_a_file_and_a_grid_over_its_auto() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let of = |text: &str, partitions: Partitions| {
            let file = folder.path().join("job.toml");
            std::fs::write(&file, text).expect("a file");
            let args = JobArgs { config: Some(file), partitions: Some(partitions), ..JobArgs::default() };
            let partition = resolve(args).expect("a configuration").partition;
            (partition.auto, partition.columns, partition.rows)
        };
        assert_eq!(of("[partition]\ncolumns = 3\nrows = 2\n", Partitions::Auto), (true, 1, 1));
        assert_eq!(of("[partition]\nauto = true\n", Partitions::Grid(4, 2)), (false, 4, 2));
    }

    #[test]
    fn partitions_are_two_numbers_from_one_or_auto() {
        assert_eq!(parse_partitions("2x3"), Ok(Partitions::Grid(2, 3)));
        assert_eq!(parse_partitions("auto"), Ok(Partitions::Auto));
        for wrong in ["2", "0x1", "2x", "x", "2x-1", "axb"] {
            assert!(parse_partitions(wrong).is_err(), "{wrong}");
        }
    }
}
