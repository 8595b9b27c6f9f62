//! Compares renders and water parameters with a truth, as `fathom synth` writes it.
//!
//! Only pixels with a valid truth count: once as rendered, and once with one gain per channel (linear light,
//! least squares over all views). The gain of a medium is not observable from pictures.

use std::path::Path;

use fathom_core::config::{DataConfig, MaskKeep};
use fathom_core::metrics;
use fathom_core::picture::{linear_to_srgb, srgb_to_linear};
use fathom_core::scene::{Scene, View};
use fathom_core::views::PackedImage;
use fathom_core::water::WaterRecord;
use serde_json::{Value, json};

use crate::error::{CliError, Result};
use crate::open_water::TruthWater;
use crate::photographs::prepared;

/// The truth of one view.
pub struct ViewTruth {
    /// J, with the pixels that are not valid masked out.
    pub clear: PackedImage,
    /// Whether the mask marks surfaces: without a file in valid/, all pixels are valid.
    pub says_where: bool,
}

/// The water parameters beside those of the truth, at the scene scale if they depend on range. If both vary
/// with direction, the truth's `b_inf` is taken in the reference direction of the model.
pub fn water_against_truth(truth: &TruthWater, record: &WaterRecord) -> Value {
    let truth = truth.beside(record);
    let difference = |found: [f64; 3], truth: [f64; 3]| [0, 1, 2].map(|c| found[c] - truth[c]);
    // As a share of the truth, unless the truth is 0.
    let share = |found: [f64; 3], truth: [f64; 3]| {
        [0, 1, 2].map(|c| (found[c] - truth[c]).abs() / if truth[c] > 0.0 { truth[c] } else { 1.0 })
    };
    let found = record.usual_water();
    json!({
        "found": found,
        "truth": truth,
        "standard_error": record.standard_error,
        "beta_d_error": share(found.beta_d, truth.beta_d),
        "beta_b_error": share(found.beta_b, truth.beta_b),
        "b_inf_error": difference(found.b_inf, truth.b_inf),
    })
}

/// Mean of a value over the views that have it; `None` if none has.
pub fn mean(views: &[Value], key: &str) -> Option<f64> {
    let values: Vec<f64> = views.iter().filter_map(|view| view[key].as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Name, render without water and J of a view.
pub type Pair<'a> = (&'a str, &'a PackedImage, &'a PackedImage);

/// Metrics of renders without water against J, as rendered and with one gain per channel.
pub fn against_truth(truth: &Path, pairs: &[Pair<'_>]) -> Result<Value> {
    if pairs.is_empty() {
        return Err(CliError::Message(format!(
            "{}/clear has no picture of a measured view; it must hold every {}",
            truth.display(),
            "N-th view of --test-every"
        )));
    }
    let gain = gains(pairs);
    let mut views = Vec::new();
    for (name, render, clear) in pairs {
        let scaled = scale(render, gain);
        views.push(json!({
            "name": name,
            "psnr": metrics::psnr(render, clear),
            "ssim": metrics::ssim(render, clear),
            "psnr_with_gain": metrics::psnr(&scaled, clear),
        }));
    }
    Ok(json!({
        "psnr": mean(&views, "psnr"),
        "ssim": mean(&views, "ssim"),
        "psnr_with_gain": mean(&views, "psnr_with_gain"),
        "gain": gain,
        "views": views,
    }))
}

/// J of a view at the size of training; `None` if the folder has no picture of this stem.
pub fn read_truth(
    truth: &Path,
    stem: &str,
    scene: &Scene,
    view: &View,
    config: &DataConfig,
) -> Result<Option<ViewTruth>> {
    let find = |folder: &str| {
        ["png", "jpg"]
            .into_iter()
            .map(|ext| truth.join(folder).join(format!("{stem}.{ext}")))
            .find(|p| p.is_file())
    };
    let Some(clear) = find("clear") else { return Ok(None) };
    let config = DataConfig { mask_keep: MaskKeep::White, ..config.clone() };
    let valid = find("valid");
    let (_, picture) = prepared(scene, view, (&clear, valid.as_ref()), &config)?;
    Ok(Some(ViewTruth { clear: picture, says_where: valid.is_some() }))
}

/// For each channel the gain g that brings g * render closest to the truth (linear light, least squares).
fn gains(pairs: &[Pair<'_>]) -> [f64; 3] {
    let (mut cross, mut square) = ([0.0; 3], [0.0; 3]);
    for (_, render, clear) in pairs {
        for (r, c) in render.pixels.iter().zip(&clear.pixels) {
            let (r, c) = (r.to_le_bytes(), c.to_le_bytes());
            if c[3] != 255 {
                continue;
            }
            for channel in 0..3 {
                let linear = |v: u8| srgb_to_linear(f64::from(v) / 255.0);
                cross[channel] += linear(r[channel]) * linear(c[channel]);
                square[channel] += linear(r[channel]).powi(2);
            }
        }
    }
    std::array::from_fn(|c| if square[c] > 0.0 { cross[c] / square[c] } else { 1.0 })
}

fn scale(image: &PackedImage, gain: [f64; 3]) -> PackedImage {
    let pixels = image.pixels.iter().map(|pixel| {
        let bytes = pixel.to_le_bytes();
        let scaled = |c: usize| {
            let linear = srgb_to_linear(f64::from(bytes[c]) / 255.0) * gain[c];
            metrics::to_8_bit(linear_to_srgb(linear.min(1.0)) as f32)
        };
        u32::from_le_bytes([scaled(0), scaled(1), scaled(2), bytes[3]])
    });
    PackedImage { width: image.width, height: image.height, pixels: pixels.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_applied_gain_is_recovered() {
        let pixels = |gain: [f64; 3]| {
            let truth = PackedImage::from_rgb8(2, 1, &[200, 120, 60, 90, 200, 40]);
            scale(&truth, gain)
        };
        let (dim, truth) = (pixels([0.5, 0.25, 0.8]), pixels([1.0; 3]));
        let found = gains(&[("a", &dim, &truth)]);
        for (found, expected) in found.iter().zip([2.0, 4.0, 1.25]) {
            // The dimmed pixels are rounded to 8 bits: half a step of at least 40 is about 1 %, 3 % in linear
            // light.
            assert!((found / expected - 1.0).abs() < 0.03, "{found} {expected}");
        }
    }
}
