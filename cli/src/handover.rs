//! `fathom export --html`: one file with the viewer and a compressed copy of the model, which opens in a
//! browser without a server and without a network.

use std::fs::File;
use std::path::{Path, PathBuf};

use clap::Args;
use fathom_core::CoreError;
use fathom_core::ply::{self, CompressedCopy, SplatReader, write_whole};
use fathom_web::Handover;
use serde_json::{Value, json};

use crate::error::{CliError, Result};
use crate::model;
use crate::output;
use crate::viewed::Viewed;

/// Pages above this size get a warning: phones refuse them, and mail does long before.
const LARGE_BYTES: u64 = 200_000_000;

/// A page to hand over.
#[derive(Args, Debug)]
#[command(next_help_heading = "A page to hand over")]
pub struct HandoverArgs {
    /// Write one page that opens in a browser without a network: the model, its water, views and credits
    #[arg(long, value_name = "FILE.html")]
    #[arg(conflicts_with_all = ["output", "format", "colour", "frame", "white_point", "chart", "cameras", "iterations"])]
    pub html: Option<PathBuf>,
    /// Text that the page shows: who made the scene, and its licence
    #[arg(long, value_name = "TEXT")]
    credits: Option<String>,
    /// Folder with photographs of the result, which become part of the page; those of other cameras may be
    /// missing
    #[arg(long, value_name = "DIR")]
    photographs: Option<PathBuf>,
    /// A link that `fathom view` copied: the page begins with its view, and offers the views kept in it
    /// [default: 6 cameras that stand far from each other]
    #[arg(long, value_name = "LINK")]
    views: Option<String>,
}

impl HandoverArgs {
    /// Refuses the other flags without --html. `requires` of clap does not: it gives way to -o, which
    /// conflicts with --html.
    pub fn check(&self) -> Result<()> {
        let has_any = self.credits.is_some() || self.photographs.is_some() || self.views.is_some();
        if has_any && self.html.is_none() {
            return Err(CliError::Message(
                "--credits, --photographs and --views are for a page; add --html FILE.html, or omit them"
                    .to_owned(),
            ));
        }
        Ok(())
    }
}

/// Writes the page for a result folder or a model.
pub fn write(given: &Path, html: &Path, args: &HandoverArgs) -> Result<()> {
    let ending = html.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    if !["html", "htm"].contains(&ending.as_str()) {
        return Err(CliError::Message(format!(
            "{} does not end with .html, so browsers would not open it; give the page such a name",
            html.display()
        )));
    }
    let viewed =
        Viewed::read(given, args.photographs.as_deref(), args.credits.as_deref().unwrap_or_default())?;
    let mut scene = viewed.json;
    if let Some(link) = &args.views {
        scene["views"] = fragment(link)?.into();
    }
    scene["plan"] = shown_plan(&scene["plan"]);
    let copy = compressed_copy(&viewed.model, &viewed.model_name)?;
    if copy.is_some() {
        scene["model"] = json!("model.compressed.ply");
    }
    let scene_text = scene.to_string();
    let mut model_bytes = 0;
    write_whole(html, |file| {
        let failed = |error| CoreError::io("write", html)(error);
        let open = |path: &Path| File::open(path).map_err(CoreError::io("read", path));
        let mut page = Handover::begin(file, &viewed.name, &scene_text).map_err(failed)?;
        model_bytes = match &copy {
            Some(copy) => page.file("model.compressed.ply", copy.bytes.as_slice()),
            None => page.file(&viewed.model_name, open(&viewed.model)?),
        }
        .map_err(failed)?;
        for (name, path) in &viewed.photographs {
            page.file(name, open(path)?).map_err(failed)?;
        }
        page.finish().map_err(failed).map(drop)
    })?;
    let bytes = std::fs::metadata(html).map_err(CliError::io("read", html))?.len();
    let gaussians = copy.as_ref().map_or(String::new(), |copy| format!("{} Gaussians, ", copy.gaussians));
    let photographs = match viewed.photographs.len() {
        0 => String::new(),
        count => format!(", {}", output::count(count as u64, "photograph")),
    };
    output::line(format!(
        "page: {} ({gaussians}model {}{photographs}, page {})",
        html.display(),
        output::bytes(model_bytes),
        output::bytes(bytes)
    ));
    copy.iter().for_each(remark_on);
    if bytes > LARGE_BYTES {
        output::remark(format!(
            "warning: {} has {}; browsers open it slowly, and phones may not. Train with a lower \
             --max-gaussians, or give fewer photographs.",
            html.display(),
            output::bytes(bytes)
        ));
    }
    Ok(())
}

/// Names what a compressed copy lacks.
pub fn remark_on(copy: &CompressedCopy) {
    if copy.left_out > 0 {
        output::remark(format!(
            "warning: {} of the model without finite values or without a rotation {} not in the copy.",
            output::count(copy.left_out as u64, "Gaussian"),
            if copy.left_out == 1 { "is" } else { "are" }
        ));
    }
}

/// The copy of a `.ply`; `None` for a model that is compressed already.
fn compressed_copy(path: &Path, name: &str) -> Result<Option<CompressedCopy>> {
    if name != "model.ply" {
        return Ok(None);
    }
    model::refuse_linear(path)?;
    let comments = SplatReader::open(path)?.comments().to_vec();
    Ok(Some(ply::compressed(&ply::read_model(path)?, &comments)?))
}

/// The fragment of a link to the viewer, where the views are.
fn fragment(link: &str) -> Result<&str> {
    let fragment = link.split_once('#').map_or(link, |(_, fragment)| fragment);
    let has_view = fragment.split('&').any(|part| part.starts_with("c=") || part.starts_with("b="));
    has_view.then_some(fragment).ok_or_else(|| {
        CliError::Message(format!(
            "--views: \"{link}\" holds no view; open the scene with `fathom view`, keep the views that you \
             want, and press \"Copy link\" there"
        ))
    })
}

/// The keys of `plan.json` that the viewer reads; the whole plan can be larger than the model.
fn shown_plan(plan: &Value) -> Value {
    if plan.is_null() {
        return Value::Null;
    }
    let cell = |part: &Value| json!({"id": part["id"], "cell": part["cell"]});
    let partitions = plan["partitions"].as_array().map(|parts| parts.iter().map(cell).collect::<Vec<_>>());
    json!({
        "alignment": plan["alignment"],
        "extent": {"viewing_distance": plan["extent"]["viewing_distance"]},
        "partitions": partitions,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_the_fragment_of_a_link() {
        let link = "http://127.0.0.1:7/0a/view.html#c=0,0,0,0,0,0,1&b=Bow~c%3D1";
        assert_eq!(fragment(link).unwrap(), "c=0,0,0,0,0,0,1&b=Bow~c%3D1");
        assert_eq!(fragment("b=Bow~c%3D1").unwrap(), "b=Bow~c%3D1");
        let error = fragment("http://127.0.0.1:7/0a/view.html").unwrap_err().to_string();
        assert!(error.contains("holds no view") && error.contains("Copy link"), "{error}");
    }

    #[test]
    fn a_plan_keeps_what_the_viewer_reads() {
        assert_eq!(shown_plan(&Value::Null), Value::Null);
        let plan = json!({"format": 3, "alignment": {"down": [0, 1, 0]}, "extent": {"viewing_distance": 2.5},
                          "partitions": [{"id": 4, "cell": {"x": 1}, "base_views": [1, 2, 3]}]});
        let expected = json!({"alignment": {"down": [0, 1, 0]}, "extent": {"viewing_distance": 2.5},
                              "partitions": [{"id": 4, "cell": {"x": 1}}]});
        assert_eq!(shown_plan(&plan), expected);
    }
}
