//! Border metrics of `fathom eval`: finds the plan of a model, and formats the text output.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use fathom_core::config::SeamsConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Drawing, Gpu, SeamRun};
use fathom_plan::Plan;
use serde_json::Value;

use crate::error::{CliError, Result};
use crate::output;

/// The plan in `given`, otherwise the `plan.json` beside the model, a result folder or a PLY. `None` if there
/// is none; also, with a warning, if it has another version.
///
/// # Errors
/// When `given` holds no plan.
pub fn plan_of(model: &Path, given: Option<&Path>) -> Result<Option<Plan>> {
    let read = |path: &Path| -> Result<Plan> {
        serde_json::from_value(output::read_json(path)?).map_err(|error| {
            CliError::Message(format!("{} is not a plan that this version can read: {error}", path.display()))
        })
    };
    if let Some(path) = given {
        return read(path).map(Some);
    }
    let beside = beside(model, "plan.json");
    if !beside.is_file() {
        return Ok(None);
    }
    match read(&beside) {
        Ok(plan) => Ok(Some(plan)),
        Err(error) => {
            tracing::warn!("cell borders are not measured: {error}");
            Ok(None)
        }
    }
}

/// `seams` of the configuration in the `run.json` beside the plan in `given`, otherwise beside the model; the
/// defaults if there is none. A model is thus measured at another model's borders in bands of the same width.
pub fn config_of(model: &Path, given: Option<&Path>) -> Result<SeamsConfig> {
    let path = given.map_or_else(|| beside(model, "run.json"), |plan| plan.with_file_name("run.json"));
    if !path.is_file() {
        return Ok(SeamsConfig::default());
    }
    let Some(seams) = output::read_json(&path)?.pointer("/config/seams").cloned() else {
        return Ok(SeamsConfig::default());
    };
    serde_json::from_value(seams)
        .map_err(|error| CliError::Message(format!("{}: config.seams: {error}", path.display())))
}

/// A file of a result folder, or of the folder that a PLY lies in.
fn beside(model: &Path, name: &str) -> PathBuf {
    if model.is_dir() { model.join(name) } else { model.with_file_name(name) }
}

/// Starts to measure a model by a plan; `None` if the plan has one cell.
pub fn run_of(
    gpu: &Arc<Gpu>,
    model: &Gaussians,
    drawing: Drawing,
    plan: &Plan,
    config: SeamsConfig,
) -> Result<Option<SeamRun>> {
    // As sent to workers.
    let viewing_distance = plan.extent.viewing_distance.map(|distance| distance as f32);
    let Some(lines) = plan.seam_lines(&config) else { return Ok(None) };
    Ok(SeamRun::if_it_fits(gpu, model, drawing, viewing_distance, (lines, config))?)
}

/// One line about the borders and one about the surface; none if the plan has one cell.
pub fn summary_lines(metrics: &Value) -> Vec<String> {
    let number = |at: &str, digits: usize| {
        let value = metrics.pointer(&format!("/seams/{at}")).and_then(Value::as_f64);
        value.map_or_else(|| "none".to_owned(), |value| format!("{value:.digits$}"))
    };
    if !metrics["seams"].is_object() {
        return Vec::new();
    }
    if metrics.pointer("/seams/border/psnr").is_none_or(Value::is_null) {
        return vec![
            "borders: no view shows enough of a border to measure it (seams.least_share)".to_owned(),
        ];
    }
    let error = metrics.pointer("/seams/seam_db_error").and_then(Value::as_f64);
    let mut lines = vec![format!(
        "borders: PSNR {} dB, {} dB beside them and {} dB inside ({} views): a seam of {}{} dB; along lines where \
         nothing was cut {} dB",
        number("border/psnr", 2),
        number("border/flank_psnr", 2),
        number("border/interior_psnr", 2),
        number("border/views", 0),
        number("seam_db", 2),
        error.map_or_else(String::new, |error| format!(" +- {error:.2}")),
        number("control/loss_db", 2),
    )];
    let step = |at: &str| metrics.pointer(&format!("/seams/range_step/{at}")).and_then(Value::as_f64);
    if let (Some(median), Some(ratio)) = (step("border/median"), step("border/ratio")) {
        let control = step("control/ratio").map(|ratio| format!("; {ratio:.2} times where nothing was cut"));
        lines.push(format!(
            "         the surface steps by {:.2} % of its depth across borders, {ratio:.2} times as much as beside them{}",
            100.0 * median,
            control.unwrap_or_default()
        ));
    }
    lines
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn summary_reports_border_cost_only_for_partitioned_models() {
        assert_eq!(summary_lines(&json!({ "seams": null })), Vec::<String>::new());
        assert_eq!(summary_lines(&json!({})), Vec::<String>::new());
        let mut metrics = json!({ "seams": {
            "border": { "views": 9, "psnr": 30.0, "flank_psnr": 30.5, "interior_psnr": 31.5 },
            "control": { "loss_db": -0.125 }, "seam_db": 0.5, "seam_db_error": null,
            "range_step": { "border": { "median": 0.002, "ratio": 2.0 }, "control": { "ratio": null } },
        }});
        let lines = summary_lines(&metrics);
        let said = "PSNR 30.00 dB, 30.50 dB beside them and 31.50 dB inside (9 views): a seam of 0.50 dB;";
        assert!(lines[0].contains(said), "{}", lines[0]);
        assert!(lines[0].ends_with("where nothing was cut -0.12 dB"), "{}", lines[0]);
        assert!(lines[1].contains("0.20 % of its depth across borders, 2.00 times"), "{}", lines[1]);
        assert!(lines[1].ends_with("2.00 times as much as beside them"), "{}", lines[1]);
        metrics["seams"]["range_step"]["border"]["ratio"] = Value::Null;
        assert_eq!(summary_lines(&metrics).len(), 1);
        metrics["seams"]["seam_db_error"] = json!(0.125);
        assert!(summary_lines(&metrics)[0].contains("a seam of 0.50 +- 0.12 dB;"), "{metrics}");
        metrics["seams"]["border"]["psnr"] = Value::Null;
        assert!(summary_lines(&metrics)[0].contains("no view shows enough"), "{metrics}");
    }

    #[test]
    fn a_requested_plan_must_be_valid_and_a_found_one_need_not() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let ply = folder.path().join("model.ply");
        assert_eq!(plan_of(&ply, None).expect("no plan is no error"), None);
        let file = folder.path().join("plan.json");
        std::fs::write(&file, "{\"format\": 99}").expect("a file");
        assert_eq!(plan_of(&ply, None).expect("another version is no error"), None);
        let refused = plan_of(&ply, Some(&file)).expect_err("it was asked for").to_string();
        assert!(refused.contains("plan.json is not a plan that this version can read"), "{refused}");
        assert_eq!(config_of(folder.path(), None).expect("no run.json"), SeamsConfig::default());
        std::fs::write(folder.path().join("run.json"), r#"{"config": {"seams": {"band": 0.1}}}"#)
            .expect("a file");
        assert_eq!(config_of(&ply, None).expect("a configuration").band, 0.1);
        let elsewhere = Path::new("elsewhere/model.ply");
        assert_eq!(config_of(elsewhere, Some(&file)).expect("that of the plan").band, 0.1);
    }
}
