//! What the viewer shows of a result folder or a model: the content of its `scene.json`, and the files in it.
//! `fathom view` serves them, `fathom export --html` writes them into a page.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::error::{CliError, Result};
use crate::output;

/// What the viewer reads.
const MODELS: [&str; 2] = ["ply", "sog"];
/// Endings of photographs that browsers show.
const PHOTOGRAPHS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// A scene for the viewer.
#[derive(Debug)]
pub struct Viewed {
    /// Shown as the title.
    pub name: String,
    /// The model.
    pub model: PathBuf,
    /// Its path in `json`.
    pub model_name: String,
    /// The photographs by their paths in `json`.
    pub photographs: BTreeMap<String, PathBuf>,
    /// The content of `scene.json` (`web/README.md`).
    pub json: Value,
}

impl Viewed {
    /// Reads a result folder or a model, with the photographs of a folder if there is one.
    pub fn read(given: &Path, photographs: Option<&Path>, credits: &str) -> Result<Self> {
        let wrong = |message: String| CliError::Message(message);
        let is_result = given.is_dir();
        let model = if is_result { given.join("model.ply") } else { given.to_owned() };
        if !model.is_file() {
            let advice = "name a result folder of `fathom train`, or a model (.ply, .compressed.ply, .sog)";
            return Err(wrong(format!("{} is no file; {advice}", model.display())));
        }
        let ending = model.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        if !MODELS.contains(&ending.as_str()) {
            let path = model.display();
            return Err(wrong(format!(
                "{path} is no model that the viewer reads: .ply, .compressed.ply or .sog"
            )));
        }
        // Beside other models there may be files of something else.
        let folder = model.parent().filter(|_| is_result || model.ends_with("model.ply"));
        let beside = |name: &str| {
            let path = folder.map(|folder| folder.join(name)).filter(|path| path.is_file());
            path.map_or(Ok(Value::Null), |path| output::read_json(&path))
        };
        let cameras = beside("cameras.json")?;
        let file_name = model.file_name().unwrap_or_default().to_string_lossy();
        // The engine knows a model by its ending, and spaces would have to be escaped.
        let model_name = if file_name.to_lowercase().ends_with(".compressed.ply") {
            "model.compressed.ply".to_owned()
        } else {
            format!("model.{ending}")
        };
        let mut files = BTreeMap::new();
        let mut named = serde_json::Map::new();
        if let Some(folder) = photographs {
            for (index, name) in names(&cameras).enumerate() {
                let Some(path) = photograph(folder, name) else { continue };
                let ending = path.extension().unwrap_or_default().to_string_lossy().into_owned();
                let served = format!("photographs/{index}.{ending}");
                named.insert(name.to_owned(), served.clone().into());
                files.insert(served, path);
            }
            if named.is_empty() {
                let folder = folder.display();
                return Err(wrong(format!(
                    "{folder} has no photograph that {} names",
                    model.with_file_name("cameras.json").display()
                )));
            }
        }
        let title = if is_result { given } else { &model };
        let title = title.canonicalize().unwrap_or_else(|_| title.to_owned());
        let name = title.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let json = json!({
            "name": name,
            "model": model_name,
            "water": beside("water.json")?,
            "cameras": cameras,
            "plan": beside("plan.json")?,
            "photographs": named,
            "credits": credits,
        });
        Ok(Self { name, model, model_name, photographs: files, json })
    }
}

/// The photographs that cameras.json names.
fn names(cameras: &Value) -> impl Iterator<Item = &str> {
    cameras.as_array().into_iter().flatten().filter_map(|camera| camera["img_name"].as_str())
}

/// The file of a photograph, in the folder of the photographs or of the scene. Names come from a file that
/// may be somebody else's, so one that leaves the folder or is no picture is no photograph.
fn photograph(folder: &Path, name: &str) -> Option<PathBuf> {
    let whole = folder.canonicalize().ok()?;
    let found = [folder.join(name), folder.join("images").join(name)];
    let mut found = found.into_iter().filter_map(|path| path.canonicalize().ok());
    found.find(|path| {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        path.starts_with(&whole) && path.is_file() && PHOTOGRAPHS.contains(&ending.as_str())
    })
}
