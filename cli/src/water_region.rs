//! Compares a model with the truth of a scene seen through a water surface, as `fathom synth --kind pool`
//! writes it.
//!
//! `region/` marks the pixels that meet the water. There the picture counts as seen, without the water
//! (`dry/`), and with oil in its place (`oil/`). A model without a water surface shows the same each time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use fathom_core::config::{DataConfig, MaskKeep};
use fathom_core::gpu::{Gpu, SurfaceRenderer};
use fathom_core::metrics;
use fathom_core::scene::{PinholeCamera, Scene, View};
use fathom_core::surface::{Surface, SurfaceModel};
use fathom_core::views::PackedImage;
use glam::DVec3;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::against_truth::mean;
use crate::error::{CliError, Result};
use crate::model;
use crate::output;
use crate::photographs::prepared;
use crate::verbs::render::picture_stem;

/// The surface of the truth's `surface.json`, scene units.
#[derive(Deserialize)]
struct TrueSurface {
    normal: [f64; 3],
    offset: f64,
    ior: f64,
    ior_of_oil: f64,
}

/// Measures view after view.
pub struct WaterRegion {
    truth: PathBuf,
    surface: TrueSurface,
    /// The model with oil, and its surface, if it has one.
    of_model: Option<(SurfaceRenderer, Surface)>,
    views: Vec<Value>,
    /// Sum of the centres of the cameras.
    eyes: DVec3,
}

/// The pictures of a model at a view.
pub struct Shown<'a> {
    /// The photograph that it is measured on.
    pub photograph: &'a PackedImage,
    /// As seen.
    pub wet: &'a PackedImage,
    /// Without the water.
    pub dry: &'a PackedImage,
}

impl WaterRegion {
    /// The truth in the folder `truth`, for the model at `model`; `None` if it has no water surface.
    ///
    /// # Errors
    /// When a file cannot be read, or the device cannot hold the model.
    pub fn open(truth: &Path, gpu: &Arc<Gpu>, model: &Path) -> Result<Option<Self>> {
        let path = truth.join("surface.json");
        if !path.is_file() || !truth.join("region").is_dir() {
            return Ok(None);
        }
        let refuse = |error: serde_json::Error| CliError::Message(format!("{}: {error}", path.display()));
        let surface: TrueSurface = serde_json::from_value(output::read_json(&path)?).map_err(refuse)?;
        let of_model = match model::surface_renderer(gpu, model)? {
            Some(mut oil) => {
                oil.set_ior(surface.ior_of_oil)?;
                let sets = model.with_file_name("sets");
                Some((oil, SurfaceModel::read_sets(&sets)?.record.surface()))
            }
            None => None,
        };
        Ok(Some(Self { truth: truth.to_owned(), surface, of_model, views: Vec::new(), eyes: DVec3::ZERO }))
    }

    /// Measures a view; nothing if the truth has no pictures of it.
    ///
    /// # Errors
    /// When a picture cannot be read, or rendering fails.
    pub fn add(
        &mut self,
        scene: &Scene,
        view: &View,
        camera: &PinholeCamera,
        shown: &Shown<'_>,
        config: &DataConfig,
    ) -> Result<()> {
        let stem = picture_stem(&view.name);
        let find = |folder: &str| {
            let path = self.truth.join(folder).join(format!("{stem}.png"));
            path.is_file().then_some(path)
        };
        let (Some(region), Some(dry), Some(oil)) = (find("region"), find("dry"), find("oil")) else {
            return Ok(());
        };
        let config = DataConfig { mask_keep: MaskKeep::White, ..config.clone() };
        let inside = |picture: &PathBuf| prepared(scene, view, (picture, Some(&region)), &config);
        let (_, true_dry) = inside(&dry)?;
        let (_, true_oil) = inside(&oil)?;
        let with_oil = match &mut self.of_model {
            Some((renderer, _)) => {
                let rendered = renderer.render(camera, &view.pose)?;
                &metrics::quantised(rendered.width, rendered.height, &rendered.rgb)
            }
            None => shown.wet,
        };
        self.eyes += view.pose.centre();
        self.views.push(json!({
            "name": view.name,
            "psnr": metrics::psnr(shown.wet, &within(shown.photograph, &true_dry)),
            "dry_psnr": metrics::psnr(shown.dry, &true_dry),
            "oil_psnr": metrics::psnr(with_oil, &true_oil),
        }));
        Ok(())
    }

    /// Means over the views, and the surface of the model beside the true one.
    pub fn report(self) -> Value {
        let TrueSurface { normal, offset, ior, .. } = self.surface;
        let plane = Surface { normal: DVec3::from(normal).normalize_or_zero(), offset, ior };
        let beside = self.of_model.map(|(_, found)| {
            let eye = self.eyes / self.views.len().max(1) as f64;
            // The point of the true surface below the mean camera.
            let foot = eye - plane.height(eye) * plane.normal;
            json!({
                "height_error": -found.height(foot),
                "height_error_share": -found.height(foot) / plane.height(eye),
                "tilt_degrees": found.normal.angle_between(plane.normal).to_degrees(),
            })
        });
        json!({
            "psnr": mean(&self.views, "psnr"),
            "dry_psnr": mean(&self.views, "dry_psnr"),
            "oil_psnr": mean(&self.views, "oil_psnr"),
            "surface": beside,
            "views": self.views,
        })
    }
}

/// A picture with the mask of another.
fn within(picture: &PackedImage, masked: &PackedImage) -> PackedImage {
    let pixel = |(pixel, mask): (&u32, &u32)| (pixel & 0x00ff_ffff) | (mask & 0xff00_0000);
    PackedImage {
        width: picture.width,
        height: picture.height,
        pixels: picture.pixels.iter().zip(&masked.pixels).map(pixel).collect(),
    }
}

/// The lines for people.
pub fn summary_lines(truth: &Value) -> Vec<String> {
    let Some(region) = truth.get("region").filter(|region| region.is_object()) else { return Vec::new() };
    let value = |key: &str| region.pointer(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
    let mut lines = vec![format!(
        "truth:   PSNR where the water is {:.2} dB, {:.2} dB without the water, {:.2} dB with oil, on {} views",
        value("/psnr"),
        value("/dry_psnr"),
        value("/oil_psnr"),
        region["views"].as_array().map_or(0, Vec::len)
    )];
    if region["surface"].is_object() {
        lines.push(format!(
            "         the surface is {:+.4} scene units off in height ({:+.3} % of the distance) and {:.3} degrees in tilt",
            value("/surface/height_error"),
            100.0 * value("/surface/height_error_share"),
            value("/surface/tilt_degrees")
        ));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_takes_the_mask_of_another() {
        let picture = PackedImage::from_rgb8(2, 1, &[1, 2, 3, 4, 5, 6]);
        let mut masked = PackedImage::from_rgb8(2, 1, &[9; 6]);
        masked.pixels[1] &= 0x00ff_ffff;
        let found = within(&picture, &masked);
        assert_eq!(found.pixels, [picture.pixels[0], picture.pixels[1] & 0x00ff_ffff]);
    }

    #[test]
    fn the_summary_names_region_and_surface() {
        let truth = json!({ "region": {
            "psnr": 33.04, "dry_psnr": 28.2, "oil_psnr": 32.9, "views": [{}, {}],
            "surface": { "height_error": -0.0003, "height_error_share": -0.0001, "tilt_degrees": 0.02 },
        }});
        let lines = summary_lines(&truth).join("\n");
        for part in [
            "33.04 dB",
            "28.20 dB without",
            "32.90 dB with oil",
            "on 2 views",
            "-0.0003",
            "-0.010 %",
            "0.020 degrees",
        ] {
            assert!(lines.contains(part), "{part} is missing in {lines}");
        }
        assert!(summary_lines(&json!({ "psnr": 1.0 })).is_empty());
    }
}
