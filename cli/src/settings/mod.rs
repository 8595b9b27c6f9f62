//! Settings of the coordinator and of the worker, each declared once.
//!
//! A field of a [`Declaration`] is a flag, a variable of the environment, a key of the TOML file, and its
//! documentation. Its default is that of the service's configuration. Help, `docs/using/settings.md` and the
//! example files in `deploy/` are made from it.

#[cfg(test)]
mod generated;
#[cfg(test)]
mod source;

use std::collections::BTreeMap;
use std::path::Path;

use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use toml::Spanned;

use crate::error::{CliError, Result};

/// The settings of a service as flags. Every field is optional, and has the name of its key in the file.
pub trait Declaration: Args + Serialize {
    /// The resolved settings, read from one value for each key.
    type Resolved: DeserializeOwned;

    /// The default of every key; null for a key without a default.
    fn defaults() -> serde_json::Result<Value>;
}

/// The flags of a service. Help shows the defaults.
#[derive(Debug)]
pub struct Flags<D>(D);

impl<D: Declaration> Flags<D> {
    /// Flags and environment over the file, and the file over the defaults.
    pub fn resolve(&self, file: Option<&Path>) -> Result<D::Resolved> {
        let unreadable = |error: serde_json::Error| CliError::Message(format!("settings: {error}"));
        let mut settings = defaults::<D>().map_err(unreadable)?;
        if let Some(path) = file {
            settings.extend(read_file::<D>(path)?);
        }
        let given = entries(serde_json::to_value(&self.0).map_err(unreadable)?);
        settings.extend(given.into_iter().filter(|(_, value)| !value.is_null()));
        serde_json::from_value(Value::Object(settings)).map_err(unreadable)
    }
}

impl<D: Declaration> FromArgMatches for Flags<D> {
    fn from_arg_matches(matches: &ArgMatches) -> std::result::Result<Self, clap::Error> {
        D::from_arg_matches(matches).map(Self)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> std::result::Result<(), clap::Error> {
        self.0.update_from_arg_matches(matches)
    }
}

impl<D: Declaration> Args for Flags<D> {
    fn augment_args(command: Command) -> Command {
        with_defaults::<D>(D::augment_args(command))
    }

    fn augment_args_for_update(command: Command) -> Command {
        with_defaults::<D>(D::augment_args_for_update(command))
    }
}

/// Adds its default to the help of each flag, unless it is a switch or the help names one.
fn with_defaults<D: Declaration>(command: Command) -> Command {
    // The defaults of both services are plain values; a test serialises them.
    let defaults = defaults::<D>().unwrap_or_default();
    command.mut_args(|arg| {
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        let is_switch = !arg.get_action().takes_values() || arg.get_num_args() == Some(0.into());
        match defaults.get(arg.get_id().as_str()) {
            Some(default) if !default.is_null() && !is_switch && !help.contains(DEFAULT) => {
                let default = shown(&arg, default);
                arg.help(format!("{help}{DEFAULT}{default}]"))
            }
            _ => arg,
        }
    })
}

/// Start of the default at the end of a help text.
const DEFAULT: &str = " [default: ";

/// A default in readable form: sizes in GiB or MiB.
fn shown(arg: &Arg, default: &Value) -> String {
    let is_bytes = arg.get_value_names().is_some_and(|names| names.iter().any(|name| name == "BYTES"));
    match (default, default.as_u64()) {
        (_, Some(bytes)) if is_bytes && bytes > 0 && bytes % (1 << 30) == 0 => format!("{} GiB", bytes >> 30),
        (_, Some(bytes)) if is_bytes && bytes > 0 && bytes % (1 << 20) == 0 => format!("{} MiB", bytes >> 20),
        (Value::String(text), _) => text.clone(),
        (other, _) => other.to_string().trim_end_matches(".0").to_owned(),
    }
}

fn defaults<D: Declaration>() -> serde_json::Result<Map<String, Value>> {
    D::defaults().map(entries)
}

fn entries(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(entries) => entries,
        _ => Map::new(),
    }
}

/// The declared flags; their ids are the keys of the file.
fn flags<D: Declaration>() -> Vec<Arg> {
    D::augment_args(Command::new("")).get_arguments().cloned().collect()
}

/// The settings in a TOML file. Refuses keys that are not declared, and values that do not fit.
fn read_file<D: Declaration>(path: &Path) -> Result<Map<String, Value>> {
    let text = std::fs::read_to_string(path).map_err(CliError::io("read", path))?;
    let fault = |fault: &str| CliError::Message(format!("{}: {}", path.display(), fault.trim_end()));
    let file: BTreeMap<Spanned<String>, toml::Value> =
        toml::from_str(&text).map_err(|error| fault(&error.to_string()))?;
    let keys: Vec<String> = flags::<D>().iter().map(|arg| arg.get_id().to_string()).collect();
    let mut settings = Map::new();
    for (key, value) in file {
        let line = text[..key.span().start].matches('\n').count() + 1;
        let key = key.into_inner();
        if !keys.contains(&key) {
            return Err(fault(&format!(
                "line {line}: unknown key `{key}`; the keys are {}",
                keys.join(", ")
            )));
        }
        let fits = serde_json::to_value(value).and_then(|value| {
            let mut alone = defaults::<D>()?;
            alone.insert(key.clone(), value.clone());
            serde_json::from_value::<D::Resolved>(Value::Object(alone)).map(|_| value)
        });
        settings.insert(key.clone(), fits.map_err(|error| fault(&format!("line {line}: {key}: {error}")))?);
    }
    Ok(settings)
}
