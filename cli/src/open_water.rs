//! Compares a model's open water with the truth: its area, the surfaces that it covers, and its colour.
//!
//! `fathom synth --look forward` writes the truth. `alpha/` is 255 where a whole pixel sees a surface and 0
//! where it is all open water. `kind/` is 2 for dark bluish surfaces and 3 for surfaces of one colour. Models
//! lose two kinds of surfaces to open water first: dark ones, which look like open water, and smooth ones,
//! which have no sparse points to start from. Pixels with both surface and open water are ignored.

use std::path::{Path, PathBuf};

use fathom_core::scene::{Camera, CameraModel, PinholeCamera, Pose};
use fathom_core::water::{ByDirection, Water, WaterRecord};
use serde_json::{Value, json};

use crate::error::{CliError, Result};
use crate::output;

/// The model shows open water at pixels with a lower alpha.
const OPEN: f32 = 0.5;
/// A surface has lost alpha at pixels with a lower alpha of the model.
const WHOLE: f32 = 0.9;
/// Values of the pictures in `kind/`.
const DARK: u8 = 2;
const TEXTURELESS: u8 = 3;

/// The water of the truth's `water.json`, in scene units.
pub struct TruthWater {
    /// The water parameters: `beta_d`, `beta_b` and `b_inf`, three channels each.
    pub water: Water,
    /// Variation of `b_inf` with direction, if any.
    pub by_direction: Option<ByDirection>,
}

impl TruthWater {
    /// Reads the water of the folder `truth`; `None` if it has none.
    ///
    /// # Errors
    /// When the file exists but cannot be read.
    pub fn read(truth: &Path) -> Result<Option<Self>> {
        let path = truth.join("water.json");
        if !path.is_file() {
            return Ok(None);
        }
        let values = output::read_json(&path)?;
        let refuse =
            |name: &str, why: String| CliError::Message(format!("{}: {name}: {why}", path.display()));
        let three = |name: &str| -> Result<[f64; 3]> {
            serde_json::from_value(values[name].clone()).map_err(|error| refuse(name, error.to_string()))
        };
        let metres = values["metres_per_unit"].as_f64().unwrap_or(1.0);
        let water = Water {
            beta_d: three("beta_d_per_m")?.map(|beta| beta * metres),
            beta_b: three("beta_b_per_m")?.map(|beta| beta * metres),
            b_inf: three("b_inf_linear")?,
        };
        let by_direction: Option<ByDirection> = serde_json::from_value(values["by_direction"].clone())
            .map_err(|error| refuse("by_direction", error.to_string()))?;
        if by_direction.is_some_and(|by_direction| !by_direction.is_sound()) {
            return Err(refuse(
                "by_direction",
                "needs finite numbers, a middle of length 1 and a limit".to_owned(),
            ));
        }
        Ok(Some(Self { water, by_direction }))
    }

    /// The water parameters, with `b_inf` for the reference direction of `record`.
    pub fn beside(&self, record: &WaterRecord) -> Water {
        match (&self.by_direction, &record.by_direction) {
            (Some(truth), Some(found)) => truth.along(&self.water, found.middle.into()),
            _ => self.water,
        }
    }
}

/// The truth of a view's pixels, at the size of its render; `None` for a pixel that covers several values.
pub struct SurfaceTruth {
    alpha: Vec<Option<u8>>,
    /// `None` where the truth has no kinds.
    kind: Vec<Option<u8>>,
}

impl SurfaceTruth {
    /// Reads the truth of a view from the pictures `stem`.png in `truth`, for its camera `rendered`; `None`
    /// if there is none.
    ///
    /// # Errors
    /// When a picture cannot be read, or its size differs from that of `camera`.
    pub fn read(truth: &Path, stem: &str, camera: &Camera, rendered: &PinholeCamera) -> Result<Option<Self>> {
        let file = |folder: &str| truth.join(folder).join(format!("{stem}.png"));
        let alpha = file("alpha");
        if !alpha.is_file() {
            return Ok(None);
        }
        if !matches!(camera.model, CameraModel::Pinhole | CameraModel::SimplePinhole) {
            tracing::warn!(
                "open water is not compared: camera {} has the model {}, and {} has no pinhole picture",
                camera.id,
                camera.model.name(),
                alpha.display()
            );
            return Ok(None);
        }
        let read = |path: &PathBuf| -> Result<Vec<Option<u8>>> {
            let refuse = |why: String| CliError::Message(format!("{}: {why}", path.display()));
            let picture = image::open(path).map_err(|error| refuse(error.to_string()))?.into_luma8();
            if picture.dimensions() != (camera.width, camera.height) {
                let ((width, height), of) = (picture.dimensions(), (camera.width, camera.height));
                return Err(refuse(format!(
                    "is {width}x{height}, but the photograph of its view is {}x{}; use the truth of the same \
                     scene",
                    of.0, of.1
                )));
            }
            let size = (rendered.width as usize, rendered.height as usize);
            let from = (camera.width as usize, camera.height as usize);
            Ok(uniform_pixels(picture.as_raw(), from, size))
        };
        let kind = file("kind");
        let kind = if kind.is_file() { read(&kind)? } else { Vec::new() };
        Ok(Some(Self { alpha: read(&alpha)?, kind }))
    }
}

/// Downsamples `from` to the size `to`. A pixel gets the value that all covered pixels of `from` share, or
/// `None`.
fn uniform_pixels(values: &[u8], from: (usize, usize), to: (usize, usize)) -> Vec<Option<u8>> {
    let span = |at: usize, from: usize, to: usize| at * from / to..((at + 1) * from).div_ceil(to);
    let mut uniform = Vec::with_capacity(to.0 * to.1);
    for y in 0..to.1 {
        for x in 0..to.0 {
            let mut covered = span(y, from.1, to.1)
                .flat_map(|row| span(x, from.0, to.0).map(move |column| values[row * from.0 + column]));
            let first = covered.next();
            uniform.push(first.filter(|first| covered.all(|value| value == *first)));
        }
    }
    uniform
}

/// Number of pixels of one kind, and how many of them have lost alpha.
#[derive(Clone, Copy, Debug, Default)]
struct Lost {
    pixels: u64,
    lost: u64,
}

impl Lost {
    fn add(&mut self, alpha: f32) {
        self.pixels += 1;
        self.lost += u64::from(alpha < WHOLE);
    }

    fn share(self) -> Option<f64> {
        share(self.lost, self.pixels)
    }
}

/// Counts over all views.
#[derive(Clone, Debug, Default)]
pub struct OpenWater {
    views: u32,
    /// Pixels that are open water in truth and model, in the model alone, in the truth alone.
    both: u64,
    model_only: u64,
    truth_only: u64,
    dark: Lost,
    textureless: Lost,
    /// Colour differences per channel, linear light: maximum and sum over `coloured` pixels.
    greatest: [f64; 3],
    sum: [f64; 3],
    coloured: u64,
}

impl OpenWater {
    /// Adds a view: `alpha` `[H*W]` of its render by `camera` at `pose`, and the truth. `record` is the
    /// model's water, if it has one.
    pub fn add(
        &mut self,
        surfaces: &SurfaceTruth,
        alpha: &[f32],
        (camera, pose): (&PinholeCamera, &Pose),
        (record, truth): (Option<&WaterRecord>, Option<&TruthWater>),
    ) {
        self.views += 1;
        let to_scene = pose.rotation.inverse();
        let of_direction = truth.and_then(|truth| Some((truth.water.b_inf, truth.by_direction.as_ref()?)));
        for (index, (alpha, truth)) in alpha.iter().zip(&surfaces.alpha).enumerate() {
            let open = *alpha < OPEN;
            match truth {
                Some(0) => {
                    self.both += u64::from(open);
                    self.truth_only += u64::from(!open);
                    if let (Some(record), Some((b_inf, by_direction))) = (record, of_direction) {
                        let direction = to_scene * camera.direction(index);
                        let found = record
                            .by_direction
                            .map_or([1.0; 3], |by_direction| by_direction.factors(direction));
                        let factors = by_direction.factors(direction);
                        for c in 0..3 {
                            let error = (record.b_inf[c] * found[c] - b_inf[c] * factors[c]).abs();
                            self.greatest[c] = self.greatest[c].max(error);
                            self.sum[c] += error;
                        }
                        self.coloured += 1;
                    }
                }
                Some(255) => self.model_only += u64::from(open),
                _ => (),
            }
            match surfaces.kind.get(index) {
                Some(Some(DARK)) => self.dark.add(*alpha),
                Some(Some(TEXTURELESS)) => self.textureless.add(*alpha),
                _ => (),
            }
        }
    }

    /// `truth.open_water` of the result; null if no view had a truth.
    pub fn report(&self) -> Value {
        if self.views == 0 {
            return Value::Null;
        }
        let coloured = (self.coloured > 0).then_some(self.coloured as f64);
        json!({
            "views": self.views,
            "pixels": self.both + self.truth_only,
            "precision": share(self.both, self.both + self.model_only),
            "recall": share(self.both, self.both + self.truth_only),
            "dark_pixels": self.dark.pixels,
            "dark_lost": self.dark.share(),
            "textureless_pixels": self.textureless.pixels,
            "textureless_lost": self.textureless.share(),
            "colour_error_max": coloured.map(|_| self.greatest),
            "colour_error_mean": coloured.map(|count| self.sum.map(|sum| sum / count)),
        })
    }
}

/// `None` if the whole is 0.
fn share(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

/// Text lines for the output of [`OpenWater::report`].
pub fn summary_lines(truth: &Value) -> Vec<String> {
    let Some(open) = truth.get("open_water").filter(|open| open.is_object()) else { return Vec::new() };
    let percent = |name: &str| {
        open[name].as_f64().map_or_else(|| "none".to_owned(), |share| format!("{:.2} %", 100.0 * share))
    };
    let mut lines = vec![format!(
        "         open water: precision {}, recall {}; of dark surfaces {} lost alpha, of textureless {}",
        percent("precision"),
        percent("recall"),
        percent("dark_lost"),
        percent("textureless_lost")
    )];
    let three = |name: &str| -> Option<String> {
        let values: Vec<String> =
            open[name].as_array()?.iter().filter_map(Value::as_f64).map(|v| format!("{v:.4}")).collect();
        Some(values.join(" "))
    };
    if let (Some(most), Some(mean)) = (three("colour_error_max"), three("colour_error_mean")) {
        lines.push(format!(
            "         colour of open water differs by {mean} on average, {most} at most (linear light)"
        ));
    }
    lines
}

#[cfg(test)]
mod tests {
    use fathom_core::config::Composition;
    use fathom_core::water::StandardErrors;
    use glam::DVec3;

    use super::*;

    const UPWARDS: ByDirection =
        ByDirection { middle: [0.0, 0.0, 1.0], slopes: [[0.0, -1.0, 0.0]; 3], most: 1.0 };

    fn record(by_direction: Option<ByDirection>) -> WaterRecord {
        let errors = StandardErrors::default();
        WaterRecord::new(&Water::COASTAL, Composition::PixelsOverBlack, errors, "fixed", 1.0)
            .with_direction(by_direction)
    }

    fn camera() -> (PinholeCamera, Pose) {
        let camera = PinholeCamera { width: 3, height: 2, fx: 2.0, fy: 2.0, cx: 1.5, cy: 1.0 };
        (camera, Pose::looking_at(DVec3::ZERO, DVec3::Z, DVec3::Y))
    }

    #[test]
    fn only_pixels_fully_open_or_fully_covered_count() {
        let surfaces = SurfaceTruth {
            alpha: vec![Some(0), Some(0), Some(255), Some(255), Some(128), None],
            kind: vec![Some(0), Some(0), Some(2), Some(2), Some(1), None],
        };
        let (camera, pose) = camera();
        let mut open = OpenWater::default();
        open.add(&surfaces, &[0.0, 0.6, 0.2, 0.8, 0.0, 0.0], (&camera, &pose), (None, None));
        let report = open.report();
        assert_eq!(
            (&report["pixels"], &report["precision"], &report["recall"]),
            (&json!(2), &json!(0.5), &json!(0.5))
        );
        assert_eq!((&report["dark_pixels"], &report["dark_lost"]), (&json!(2), &json!(1.0)));
        assert_eq!((&report["textureless_lost"], &report["colour_error_max"]), (&Value::Null, &Value::Null));
        let said = summary_lines(&json!({ "open_water": report })).join("\n");
        assert!(said.contains("recall 50.00 %") && said.contains("of textureless none"), "{said}");
        assert_eq!(OpenWater::default().report(), Value::Null);
    }

    #[test]
    fn open_water_colour_is_compared_by_viewing_direction() {
        let surfaces = SurfaceTruth { alpha: vec![Some(0); 6], kind: Vec::new() };
        let truth = TruthWater { water: Water::COASTAL, by_direction: Some(UPWARDS) };
        let (camera, pose) = camera();
        let errors = |found: Option<ByDirection>| {
            let mut open = OpenWater::default();
            open.add(&surfaces, &[0.0; 6], (&camera, &pose), (Some(&record(found)), Some(&truth)));
            open.report()
        };
        assert_eq!(errors(Some(UPWARDS))["colour_error_max"], json!([0.0, 0.0, 0.0]));
        // The middle column has the steepest rays: half a pixel up and down at a focal length of two.
        let up = (0.25 / 1.0625_f64.sqrt()).exp() - 1.0;
        let report = errors(None);
        let most = report["colour_error_max"][2].as_f64().unwrap_or(0.0);
        assert!((most - up * Water::COASTAL.b_inf[2]).abs() < 1e-12, "{report}");
        assert!(report["colour_error_mean"][2].as_f64().is_some_and(|mean| mean > 0.0 && mean < most));
    }

    #[test]
    fn a_colour_at_infinity_is_compared_if_both_have_one() {
        let truth = TruthWater { water: Water::COASTAL, by_direction: Some(UPWARDS) };
        let up = ByDirection { middle: [0.0, -1.0, 0.0], ..UPWARDS };
        assert!(
            (truth.beside(&record(Some(up))).b_inf[0] / Water::COASTAL.b_inf[0] - 1.0_f64.exp()).abs()
                < 1e-12
        );
        assert_eq!(truth.beside(&record(None)), Water::COASTAL);
    }

    #[test]
    fn a_smaller_picture_keeps_values_shared_by_a_pixel() {
        let values = [0, 0, 9, 9, 0, 0, 9, 7];
        assert_eq!(uniform_pixels(&values, (4, 2), (2, 1)), [Some(0), None]);
        assert_eq!(uniform_pixels(&values, (4, 2), (4, 2)), values.map(Some));
    }
}
