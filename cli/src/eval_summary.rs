//! The metrics of a result or of `fathom eval` as lines of text.

use fathom_core::water::WaterRecord;
use serde_json::{Value, json};

use crate::{open_water, seams, water_region};

/// The metrics as text.
pub fn summary(metrics: &Value) -> String {
    let number = |name: &str, digits: usize| {
        metrics
            .get(name)
            .and_then(Value::as_f64)
            .map_or_else(|| "none".to_owned(), |v| format!("{v:.digits$}"))
    };
    let views = metrics.get("views").and_then(Value::as_array).map_or(0, Vec::len);
    let mut lines = vec![format!(
        "metrics: PSNR {} dB, SSIM {} on {views} held-out views, {} Gaussians",
        number("psnr", 2),
        number("ssim", 4),
        metrics.get("gaussians").map_or_else(|| "?".to_owned(), Value::to_string)
    )];
    lines.extend(seams::summary_lines(metrics));
    lines.extend(cover_line(metrics));
    lines.extend(worst_line(metrics));
    if let Some(baselines) = metrics.get("baselines") {
        let pair = |name: &str| {
            let value = |key: &str| {
                baselines.pointer(&format!("/{name}/{key}")).and_then(Value::as_f64).unwrap_or(f64::NAN)
            };
            format!("{:.2} dB, {:.4}", value("psnr"), value("ssim"))
        };
        lines.push(format!(
            "         flat mean colour {}; 15-pixel blur {}",
            pair("flat_colour"),
            pair("blur")
        ));
    }
    if let Some(viewer) = metrics.get("viewer_psnr").and_then(Value::as_f64) {
        lines.push(format!(
            "         PSNR between this render and a viewer's picture without the water: {viewer:.2} dB"
        ));
    }
    if let Some(floaters) = metrics.get("floaters") {
        let value = |key: &str| floaters.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        lines.push(format!(
            "         floaters {:.1} ({:.3} % of all opacity), by {} views",
            value("count"),
            100.0 * value("share"),
            value("views")
        ));
    }
    if let Some(truth) = metrics.get("truth") {
        let value = |key: &str| truth.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        if truth.get("psnr").is_some() {
            lines.push(format!(
                "truth:   PSNR {:.2} dB as rendered, {:.2} dB with one gain a channel, on {} views",
                value("psnr"),
                value("psnr_with_gain"),
                truth.get("views").and_then(Value::as_array).map_or(0, Vec::len)
            ));
        }
        lines.extend(water_region::summary_lines(truth));
        lines.extend(open_water::summary_lines(truth));
    }
    lines.extend(water_lines(metrics));
    lines.join("\n")
}

/// Holes, open water and unseen surfaces; `None` if the metrics have none of them, as in older versions.
fn cover_line(metrics: &Value) -> Option<String> {
    let percent = |key: &str, what: &str| {
        metrics.get(key).and_then(Value::as_f64).map(|share| format!("{:.2} % {what}", 100.0 * share))
    };
    let said = [
        percent("holes", "of the covered pixels are holes"),
        percent("open_water", "of J's white is left in open water"),
        percent("unseen", "of the surfaces are in fewer than two training views"),
    ];
    let said: Vec<String> = said.into_iter().flatten().collect();
    (!said.is_empty()).then(|| format!("cover:   {}", said.join(", ")))
}

/// The first view with the largest share of holes; `None` if no view has holes.
fn worst_line(metrics: &Value) -> Option<String> {
    let views = metrics.get("views")?.as_array()?.iter();
    let holes = views.filter_map(|view| Some((view.get("name")?.as_str()?, view.get("holes")?.as_f64()?)));
    let (name, share) = holes.reduce(|worst, view| if view.1 > worst.1 { view } else { worst })?;
    (share > 0.0)
        .then(|| format!("         most holes in {name}: {:.2} % of its covered pixels", 100.0 * share))
}

/// The water parameters, and those of the truth if requested.
fn water_lines(metrics: &Value) -> Vec<String> {
    let found = metrics.get("water").filter(|water| water.is_object());
    let truth = metrics.pointer("/truth/water/truth");
    let Some(found) = found else { return Vec::new() };
    // Where the coefficients depend on range, the values at the scene scale are compared.
    let usual =
        serde_json::from_value::<WaterRecord>(found.clone()).ok().map(|record| json!(record.usual_water()));
    let numbers = usual.as_ref().unwrap_or(found);
    let three = |values: &Value, name: &str| -> String {
        let one = |c: usize| values[name][c].as_f64().map_or_else(|| "?".to_owned(), |v| format!("{v:.4}"));
        [one(0), one(1), one(2)].join(" ")
    };
    let line = |(name, unit): (&str, &str)| {
        let errors = three(&found["standard_error"], name);
        let truth = truth.map_or_else(String::new, |truth| format!("   truth {}", three(truth, name)));
        format!("water:   {name:6} {} +- {errors}{truth} ({unit})", three(numbers, name))
    };
    [("beta_d", "1/unit"), ("beta_b", "1/unit"), ("b_inf", "linear light")].map(line).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summary_reports_cover_unless_metrics_are_older() {
        assert_eq!(cover_line(&json!({ "psnr": 30.0 })), None);
        assert_eq!(cover_line(&json!({ "holes": null, "open_water": null, "unseen": null })), None);
        let said = cover_line(&json!({ "holes": 0.0125, "open_water": null, "unseen": 0.5 }));
        let expected = "cover:   1.25 % of the covered pixels are holes, 50.00 % of the surfaces are in fewer than two \
                        training views";
        assert_eq!(said.as_deref(), Some(expected));
    }

    #[test]
    fn the_view_with_most_holes_is_named_where_one_has_any() {
        let metrics = |holes: [Option<f64>; 3]| {
            let of_view = |(name, holes): (&str, Option<f64>)| json!({ "name": name, "holes": holes });
            let views: Vec<Value> = ["a", "b", "c"].into_iter().zip(holes).map(of_view).collect();
            json!({ "views": views })
        };
        let said = worst_line(&metrics([None, Some(0.25), Some(0.25)]));
        assert_eq!(said.as_deref(), Some("         most holes in b: 25.00 % of its covered pixels"));
        assert_eq!(worst_line(&metrics([None, Some(0.0), Some(0.0)])), None);
        assert_eq!(worst_line(&json!({ "views": [{ "name": "a" }] })), None);
        assert_eq!(worst_line(&json!({})), None);
    }
}
