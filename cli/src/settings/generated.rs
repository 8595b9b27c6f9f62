//! `docs/using/settings.md` and the example files of `deploy/`, made from the declarations.
//!
//! The test below compares them with the files. `make settings` runs it with [`WRITE`], which writes them.

use std::fmt::Write as _;
use std::path::PathBuf;

use fathom_core::config::{JobConfig, Preset};
use serde_json::Value;

use super::source::{Field, Source, first_sentence, said, unit};
use super::{DEFAULT, Declaration, defaults, flags, shown};
use crate::verbs::{CoordinatorSettings, WorkerSettings};

/// If this variable is set, the test writes the files.
const WRITE: &str = "FATHOM_WRITE_SETTINGS";

const COLUMNS: usize = 110;

const PAGE: &str = "# Settings

A job, the coordinator and a worker have settings. `make settings` generates this page from the source
code, and a test fails when it is out of date.

## Job

`fathom train` and `fathom submit` read the settings of a job from these sources. The later ones win:

1. a preset: `--preset NAME`, or `preset` in the file
2. a TOML file with the sections below: `--config FILE`
3. single settings: `--set SECTION.KEY=VALUE`, such as `--set train.ssim_weight=0.3`; may be repeated
4. the flags of common settings, which `fathom train --help` lists

Unknown keys are refused. `deploy/job.example.toml` holds every key with its default. Each result stores its
settings in `OUT/run.json`. Values of the presets `paper`, `3dgs`, `2dgs` and `wsgs` are listed where they
differ from the default. [Papers](../papers.md) has the sources in full.

A share is a number from 0 to 1. A share of the run counts in iterations of the run. Learning rates are
those of Adam, per iteration.

";

const COORDINATOR: &str = "## Coordinator

`fathom coordinator` reads its settings from flags, from the environment and from a TOML file
(`--config FILE`, or `FATHOM_CONFIG`). Flags win over the environment, and the environment wins over the
file. Unknown keys are refused. `deploy/coordinator.example.toml` holds every key with its default.

";

const WORKER: &str = "## Worker

`fathom worker` reads its settings in the same way. The file is `--config FILE`, or `FATHOM_WORKER_CONFIG`.
`deploy/worker.example.toml` holds every key with its default. `FATHOM_TOKEN` can hold the token itself.

";

/// A setting of a job.
struct JobSetting {
    key: String,
    unit: String,
    default: Value,
    /// Its values in the other presets, where they differ from the default.
    others: Vec<(&'static str, Value)>,
    meaning: String,
    source: String,
    /// The allowed words with their meanings; empty if any value of the type is allowed.
    values: Vec<(String, String)>,
}

/// A section of a job's settings; that of `preset` has no name.
struct Section {
    name: String,
    doc: String,
    settings: Vec<JobSetting>,
}

fn root() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Converts through text, so that an f32 has the few digits that people write.
fn json(config: &JobConfig) -> Value {
    serde_json::from_str(&serde_json::to_string(config).unwrap()).unwrap()
}

fn job_sections() -> Vec<Section> {
    let source = Source::read(&root().join("core/src/config"));
    let presets = [
        ("", json(&JobConfig::default())),
        ("paper", json(&JobConfig::of_preset(Preset::Paper))),
        ("3dgs", json(&JobConfig::of_preset(Preset::Splatting))),
        ("2dgs", json(&JobConfig::of_preset(Preset::Disks))),
        ("wsgs", json(&JobConfig::of_preset(Preset::Surface))),
    ];
    let mut sections = Vec::new();
    add_section(&source, "JobConfig", "", &presets, &mut sections);
    sections
}

fn add_section(
    source: &Source,
    of: &str,
    name: &str,
    presets: &[(&'static str, Value)],
    all: &mut Vec<Section>,
) {
    let section = source.section(of).unwrap_or_else(|| panic!("core/src/config has no struct {of}"));
    let (mut settings, mut below) = (Vec::<JobSetting>::new(), Vec::new());
    for field in &section.fields {
        let path = format!("{name}/{}", field.key);
        let defaults: Vec<_> =
            presets.iter().map(|(preset, all)| (*preset, all.pointer(&path).cloned())).collect();
        let Some((_, Some(default))) = defaults.first().cloned() else { panic!("no setting is at {path}") };
        if source.section(&field.of).is_some() {
            below.push((field.of.clone(), path));
            continue;
        }
        let differ = |(preset, value): (&'static str, Option<Value>)| Some((preset, value?));
        let others = defaults.into_iter().skip(1).filter_map(differ).filter(|(_, value)| *value != default);
        let others = others.filter(|_| field.key != "preset").collect();
        let before = settings.last().map_or("", |setting| &setting.unit);
        let setting = job_setting(source, field, default, others, before);
        settings.push(setting);
    }
    assert_eq!(
        settings.len() + below.len(),
        presets[0].1.pointer(name).unwrap().as_object().unwrap().len(),
        "keys of [{name}]"
    );
    let doc = if name.is_empty() { String::new() } else { source.readable(&section.doc) };
    let dotted = name.trim_start_matches('/').replace('/', ".");
    all.push(Section { name: dotted, doc, settings });
    for (of, path) in below {
        add_section(source, &of, &path, presets, all);
    }
}

fn job_setting(
    source: &Source,
    field: &Field,
    default: Value,
    others: Vec<(&'static str, Value)>,
    before: &str,
) -> JobSetting {
    assert!(!field.doc.is_empty(), "core/src/config: {} has no doc comment", field.key);
    let said = said(&source.readable(&field.doc), default.as_array().map_or(1, Vec::len));
    let unit = unit(&field.of, &said.meaning, before);
    let values = source.values(&field.of).unwrap_or_default();
    let values = values.iter().map(|value| (value.word.clone(), source.readable(&value.doc))).collect();
    let (meaning, source) = (said.meaning, said.source);
    JobSetting { key: field.key.clone(), unit, default, others, meaning, source, values }
}

fn page() -> String {
    let mut page = PAGE.to_owned();
    for section in job_sections() {
        if !section.name.is_empty() {
            writeln!(page, "### `[{}]`\n\n{}\n", section.name, wrapped(&section.doc, "")).unwrap();
        }
        page += "| key | default | unit | meaning | source and notes |\n|---|---|---|---|---|\n";
        for setting in &section.settings {
            let mut default = match &setting.default {
                Value::Null => "not set".to_owned(),
                default => format!("`{}`", toml(default)),
            };
            for (preset, value) in &setting.others {
                write!(default, "; `{preset}`: `{}`", toml(value)).unwrap();
            }
            let cells =
                [&format!("`{}`", setting.key), &default, &setting.unit, &setting.meaning, &setting.source];
            row(&mut page, &cells.map(String::as_str));
        }
        page.push('\n');
        for setting in section.settings.iter().filter(|setting| !setting.values.is_empty()) {
            writeln!(page, "Values of `{}`:\n\n| value | meaning |\n|---|---|", setting.key).unwrap();
            for (word, meaning) in &setting.values {
                row(&mut page, &[&format!("`{word}`"), meaning]);
            }
            page.push('\n');
        }
    }
    page + COORDINATOR
        + &service_table::<CoordinatorSettings>()
        + "\n"
        + WORKER
        + &service_table::<WorkerSettings>()
}

fn row(page: &mut String, cells: &[&str]) {
    let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
    writeln!(page, "| {} |", cells.join(" | ")).unwrap();
}

/// The settings of a service: flag, variable, key, default as text, meaning.
fn service_settings<D: Declaration>() -> Vec<[String; 5]> {
    let defaults = defaults::<D>().unwrap();
    let setting = |arg: clap::Arg| {
        let key = arg.get_id().to_string();
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        let (meaning, default) = match help.strip_suffix(']').and_then(|help| help.split_once(DEFAULT)) {
            Some((meaning, default)) => (meaning.to_owned(), default.to_owned()),
            None => match &defaults[&key] {
                Value::Null => (help, "none".to_owned()),
                default => (help.clone(), format!("`{}`", shown(&arg, default))),
            },
        };
        let flag = arg.get_long().unwrap_or_default().to_owned();
        let variable = arg.get_env().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        [flag, variable, key, default, meaning]
    };
    flags::<D>().into_iter().map(setting).collect()
}

fn service_table<D: Declaration>() -> String {
    let mut table = "| flag | environment | key | default | meaning |\n|---|---|---|---|---|\n".to_owned();
    for [flag, variable, key, default, meaning] in service_settings::<D>() {
        let variable = if variable.is_empty() { variable } else { format!("`{variable}`") };
        row(&mut table, &[&format!("`--{flag}`"), &variable, &format!("`{key}`"), &default, &meaning]);
    }
    table
}

const GENERATED: &str = "`make settings` generates this file; docs/using/settings.md describes each setting.";

fn service_example<D: Declaration>(verb: &str, variable: &str) -> String {
    let head = format!(
        "Settings of `{verb} --config FILE`, with their defaults. Flags and the environment ({variable} ...) win. \
         {GENERATED}"
    );
    let mut file = wrapped(&head, "# ") + "\n\n";
    let defaults = defaults::<D>().unwrap();
    for (arg, [_, _, key, _, meaning]) in flags::<D>().iter().zip(service_settings::<D>()) {
        writeln!(file, "{}", wrapped(&format!("{meaning}."), "# ")).unwrap();
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        let placeholder = arg.get_value_names().and_then(|names| names.first()).map_or("VALUE", |name| name);
        match &defaults[&key] {
            // There is no default value, or the help describes it in words: show a placeholder.
            default if default.is_null() || help.contains(DEFAULT) => match placeholder {
                "N" | "BYTES" => writeln!(file, "# {key} = {placeholder}").unwrap(),
                _ => writeln!(file, "# {key} = \"{placeholder}\"").unwrap(),
            },
            default => writeln!(file, "{key} = {}", toml(default)).unwrap(),
        }
    }
    file
}

fn job_example() -> String {
    let head = format!(
        "Settings of a job, with their defaults: `fathom train DATA -o OUT --config FILE`, or with `fathom submit`. \
         Flags and --set win over this file, and this file wins over a preset. Surroundings a section [water], --preset \
         must name the preset of this file. {GENERATED}"
    );
    let mut file = wrapped(&head, "# ") + "\n";
    for section in job_sections() {
        if section.settings.is_empty() {
            continue;
        }
        file += &if section.name.is_empty() { "\n".to_owned() } else { format!("\n[{}]\n", section.name) };
        for setting in &section.settings {
            let words: Vec<_> = setting.values.iter().map(|(word, _)| format!("\"{word}\"")).collect();
            let mut comment = first_sentence(&setting.meaning).trim_end_matches('.').to_owned();
            if !words.is_empty() && !words.iter().all(|word| comment.contains(word.trim_matches('"'))) {
                write!(comment, ": {}", words.join(", ")).unwrap();
            }
            writeln!(file, "{}", wrapped(&format!("{comment}."), "# ")).unwrap();
            match &setting.default {
                // TOML has no null.
                Value::Null => writeln!(file, "# {} is not set.", setting.key).unwrap(),
                default => writeln!(file, "{} = {}", setting.key, toml(default)).unwrap(),
            }
        }
    }
    file
}

/// A value in TOML syntax.
fn toml(value: &Value) -> String {
    match value {
        Value::Number(number) if number.is_f64() => match number.as_f64() {
            Some(small) if small != 0.0 && small.abs() < 1e-3 => format!("{small:e}"),
            _ => number.to_string(),
        },
        Value::Array(values) => format!("[{}]", values.iter().map(toml).collect::<Vec<_>>().join(", ")),
        other => other.to_string(),
    }
}

/// Lines of at most [`COLUMNS`] that begin with `start`.
fn wrapped(text: &str, start: &str) -> String {
    let mut lines = vec![start.to_owned()];
    for word in text.split(' ') {
        let line = lines.last_mut().unwrap();
        if line.len() > start.len() && line.chars().count() + 1 + word.chars().count() > COLUMNS {
            lines.push(format!("{start}{word}"));
        } else {
            *line += if line.len() > start.len() { " " } else { "" };
            *line += word;
        }
    }
    lines.join("\n")
}

#[test]
fn settings_page_and_example_files_are_current() {
    let files = [
        ("docs/using/settings.md", page()),
        ("deploy/job.example.toml", job_example()),
        (
            "deploy/coordinator.example.toml",
            service_example::<CoordinatorSettings>("fathom coordinator", "FATHOM_LEASE_MS"),
        ),
        (
            "deploy/worker.example.toml",
            service_example::<WorkerSettings>("fathom worker", "FATHOM_COORDINATOR"),
        ),
    ];
    for (name, text) in files {
        let path = root().join(name);
        if std::env::var_os(WRITE).is_some() {
            std::fs::write(&path, &text).unwrap();
        }
        let there = std::fs::read_to_string(&path).unwrap_or_default();
        let differs = there.lines().zip(text.lines()).position(|(there, now)| there != now);
        assert!(
            there == text,
            "{name} is out of date from line {differs:?} on: run `make settings`, commit the result"
        );
    }
}

#[test]
fn every_setting_is_declared_and_documented() {
    fn check<D: Declaration>() {
        let mut keys: Vec<_> = service_settings::<D>().into_iter().map(|[_, _, key, ..]| key).collect();
        let mut config: Vec<_> = defaults::<D>().unwrap().keys().cloned().collect();
        for [flag, variable, key, _, meaning] in service_settings::<D>() {
            assert_eq!(flag, key.replace('_', "-"));
            assert!(variable.starts_with("FATHOM_") || key == "insecure", "{key} has no variable");
            assert!(!meaning.is_empty(), "{key} has no doc comment");
        }
        keys.sort();
        config.sort();
        assert_eq!(keys, config, "flags, and fields of the configuration");
    }
    check::<CoordinatorSettings>();
    check::<WorkerSettings>();
}

/// Names like `FATHOM_LISTEN` in a text.
fn variables_in(text: &str) -> Vec<String> {
    let is_part = |c: char| c.is_ascii_uppercase() || c == '_';
    let words = text.split(|c: char| !is_part(c));
    words.filter(|word| word.starts_with("FATHOM_") && word.len() > 7).map(str::to_owned).collect()
}

#[test]
fn variables_that_deploy_and_its_pages_name_exist() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    // The token itself, and the file of settings, are no keys of a file.
    let mut known =
        vec!["FATHOM_TOKEN".to_owned(), "FATHOM_CONFIG".to_owned(), "FATHOM_WORKER_CONFIG".to_owned()];
    for [_, variable, ..] in service_settings::<CoordinatorSettings>() {
        known.push(variable);
    }
    for [_, variable, ..] in service_settings::<WorkerSettings>() {
        known.push(variable);
    }
    let mut named = 0;
    for file in [
        "deploy/Dockerfile",
        "deploy/compose.yaml",
        "deploy/compose.engines.yaml",
        "deploy/fathom-workers.sbatch",
        "deploy/fathom-coordinator.service",
        "deploy/fathom-worker.service",
        "deploy/helm/fathom/values.yaml",
        "deploy/helm/fathom/templates/_helpers.tpl",
        "deploy/helm/fathom/templates/coordinator.yaml",
        "docs/operating/kubernetes.md",
        "docs/operating/containers.md",
        "docs/operating/workers-on-demand.md",
        "docs/operating/several-machines.md",
    ] {
        let text = std::fs::read_to_string(root.join(file)).unwrap_or_else(|error| panic!("{file}: {error}"));
        for variable in variables_in(&text) {
            named += 1;
            assert!(known.contains(&variable), "{file} names {variable}, which no setting has");
        }
    }
    assert!(named > 15, "only {named} variables were found");
}
