//! `--white-point` and `--chart`: brightness and white balance of pictures of J, for viewing.
//! [`fathom_core::white_point`] holds the rules; this file parses the flags and renders the pictures that
//! they need.

use std::path::Path;

use clap::Args;
use fathom_core::gpu::Rendered;
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::white_point::{self, Chart, Exposure, WhitePoint};

use crate::error::{CliError, Result};
use crate::progress::{Progress, Unit};

/// File written beside the pictures.
pub const FILE: &str = "white_point.json";

/// Brightness and white balance of J.
#[derive(Args, Clone, Debug)]
pub struct WhitePointArgs {
    /// Brightness and white balance of J. `none`: unchanged; `auto`: scale all channels equally until the
    /// 99th percentile of surface pixels is 0.9 of white. `R,G,B`: make this colour of J (linear light)
    /// neutral
    #[arg(long, value_name = "auto|none|R,G,B", default_value = "none", value_parser = parse)]
    white_point: Choice,
    /// Positions of grey patches, pixels from the top-left corner of the picture; their mean becomes neutral,
    /// before `auto`
    #[arg(long, value_name = "x,y,...", value_delimiter = ',', allow_hyphen_values = true)]
    chart: Vec<f64>,
    /// The picture with the patches of --chart [default: the first]
    #[arg(long, value_name = "NAME", requires = "chart")]
    chart_view: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Choice {
    None,
    Auto,
    /// A colour in linear light.
    Colour([f64; 3]),
}

fn parse(text: &str) -> std::result::Result<Choice, String> {
    match text {
        "none" => return Ok(Choice::None),
        "auto" => return Ok(Choice::Auto),
        _ => (),
    }
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match (text.split(',').count(), numbers.as_slice()) {
        (3, &[r, g, b]) => {
            white_point::neutral([r, g, b]).map_err(|error| error.to_string())?;
            Ok(Choice::Colour([r, g, b]))
        }
        _ => Err("use auto, none, or three numbers of linear light such as 0.2,0.3,0.25".to_owned()),
    }
}

impl WhitePointArgs {
    /// Whether J stays unchanged.
    pub fn is_none(&self) -> bool {
        self.white_point == Choice::None && self.chart.is_empty()
    }

    /// Whether it needs rendered pictures.
    pub fn needs_pictures(&self) -> bool {
        self.white_point == Choice::Auto || !self.chart.is_empty()
    }

    /// Finds the white point from pictures with the names and cameras of `shots`; `None` if none was
    /// requested.
    ///
    /// # Errors
    /// When the flags contradict each other, or the pictures do not determine a white point.
    pub fn find(
        &self,
        shots: &[(&str, &PinholeCamera, &Pose)],
        mut render: impl FnMut(&PinholeCamera, &Pose) -> Result<Rendered>,
    ) -> Result<Option<WhitePoint>> {
        if self.is_none() {
            return Ok(None);
        }
        let mut found = WhitePoint { rule: String::new(), gains: [1.0; 3], neutral: None, chart: None };
        let mut rules = Vec::new();
        if let Some(chart) = self.chart_among(shots)? {
            let (camera, pose) = shots
                .iter()
                .find(|(name, ..)| *name == chart.view)
                .map(|(_, camera, pose)| (*camera, *pose))
                .ok_or_else(|| CliError::Message("--chart needs a picture".to_owned()))?;
            let picture = render(camera, pose)?;
            let mean =
                white_point::mean_of_patches(&picture.rgb, &picture.alpha, picture.width, &chart.positions)
                    .map_err(|error| CliError::Message(format!("--chart in {}: {error}", chart.view)))?;
            found.neutral = Some(mean);
            found.chart = Some(chart);
            rules.push("chart");
        }
        if let Choice::Colour(colour) = self.white_point {
            found.neutral = Some(colour);
            rules.push("colour");
        }
        if let Some(colour) = found.neutral {
            found.gains = white_point::neutral(colour)?;
        }
        if self.white_point == Choice::Auto {
            let mut exposure = Exposure::after(found.gains);
            let progress = Progress::new("exposing", shots.len() as u64, Unit::Count("pictures"));
            for (index, (_, camera, pose)) in shots.iter().enumerate() {
                let picture = render(camera, pose)?;
                exposure.add(&picture.rgb, &picture.alpha);
                progress.set(index as u64 + 1, "");
            }
            progress.finish();
            found.gains = exposure.gains()?;
            rules.push("auto");
        }
        found.rule = rules.join(", ");
        Ok(Some(found))
    }

    /// The requested chart in one of the pictures.
    fn chart_among(&self, shots: &[(&str, &PinholeCamera, &Pose)]) -> Result<Option<Chart>> {
        if self.chart.is_empty() {
            return Ok(None);
        }
        if matches!(self.white_point, Choice::Colour(_)) {
            return Err(CliError::Message(
                "--chart and --white-point R,G,B both set the neutral colour; omit one of them".to_owned(),
            ));
        }
        if !self.chart.len().is_multiple_of(2) {
            return Err(CliError::Message(format!(
                "--chart has {} numbers; it takes the x and y of each patch",
                self.chart.len()
            )));
        }
        let stem = |name: &str| Path::new(name).file_stem().map(std::ffi::OsStr::to_owned);
        let view = match &self.chart_view {
            None => shots.first(),
            Some(wanted) => {
                let same = shots.iter().find(|(name, ..)| *name == wanted.as_str());
                same.or_else(|| shots.iter().find(|(name, ..)| stem(name) == stem(wanted)))
            }
        };
        let (view, ..) = view.ok_or_else(|| {
            let wanted = self.chart_view.as_deref().unwrap_or("for the chart");
            CliError::Message(format!("--chart-view: the cameras have no picture {wanted}"))
        })?;
        let positions = self.chart.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect();
        Ok(Some(Chart { view: (*view).to_owned(), positions }))
    }
}

/// Writes [`FILE`] into the folder of the pictures, or removes the one of earlier pictures.
///
/// # Errors
/// When the folder cannot be written.
pub fn write(folder: &Path, found: Option<&WhitePoint>) -> Result<()> {
    let path = folder.join(FILE);
    let Some(found) = found else {
        return match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(CliError::io("remove", &path)(error))
            }
            _ => Ok(()),
        };
    };
    let text = serde_json::to_string_pretty(found)
        .map_err(|error| CliError::Message(format!("the white point cannot be written: {error}")))?;
    std::fs::write(&path, text + "\n").map_err(CliError::io("write", &path))
}

/// A text line.
pub fn summary(found: &WhitePoint) -> String {
    let [r, g, b] = found.gains;
    format!("white point: {}, gains {r:.3} {g:.3} {b:.3} in linear light", found.rule)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(white_point: &str, chart: &[f64]) -> WhitePointArgs {
        WhitePointArgs {
            white_point: parse(white_point).expect("a white point"),
            chart: chart.to_vec(),
            chart_view: None,
        }
    }

    /// The white point of a picture of one colour, sRGB.
    fn found(args: &WhitePointArgs, rgb: [f32; 3]) -> Result<Option<WhitePoint>> {
        let camera = PinholeCamera { width: 8, height: 6, fx: 4.0, fy: 4.0, cx: 4.0, cy: 3.0 };
        let pose = Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]);
        args.find(&[("a.png", &camera, &pose), ("b.png", &camera, &pose)], |_, _| {
            Ok(Rendered {
                width: 8,
                height: 6,
                rgb: vec![rgb; 48],
                alpha: vec![1.0; 48],
                range: vec![2.0; 48],
            })
        })
    }

    #[test]
    fn a_white_point_is_auto_none_or_a_positive_colour() {
        assert_eq!(parse("auto"), Ok(Choice::Auto));
        assert_eq!(parse("0.2, 0.3,0.25"), Ok(Choice::Colour([0.2, 0.3, 0.25])));
        for wrong in ["", "white", "1,2", "1,2,3,4", "a,b,c,d", "0.1,x,0.2,0.3"] {
            assert!(parse(wrong).is_err_and(|why| why.contains("three numbers")), "{wrong}");
        }
        assert!(parse("0,0.2,0.3").is_err_and(|why| why.contains("cannot become neutral")));
    }

    #[test]
    fn rules_are_combined_and_all_named() {
        let grey = [0.3, 0.5, 0.4];
        assert!(found(&args("none", &[]), grey).expect("nothing").is_none());
        let auto = found(&args("auto", &[]), grey).expect("gains").expect("gains");
        assert_eq!((auto.rule.as_str(), auto.gains[0]), ("auto", auto.gains[2]));
        let both = found(&args("auto", &[2.0, 3.0]), grey).expect("gains").expect("gains");
        assert_eq!(both.rule, "chart, auto");
        assert_eq!(both.chart.expect("a chart").view, "a.png");
        let mut picture = [grey];
        white_point::apply(&mut picture, both.gains);
        for value in picture[0] {
            assert!((value - 0.9).abs() < 0.003, "grey, and of the brightness of the brightest: {picture:?}");
        }
    }

    #[test]
    fn contradictions_are_refused_with_a_remedy() {
        let refused = |args: &WhitePointArgs| found(args, [0.5; 3]).expect_err("a contradiction").to_string();
        assert!(refused(&args("0.2,0.3,0.2", &[1.0, 1.0])).contains("omit one of them"));
        assert!(refused(&args("none", &[1.0, 1.0, 2.0])).contains("has 3 numbers"));
        assert!(refused(&args("none", &[9.0, 1.0])).contains("a.png: "));
        let elsewhere = WhitePointArgs { chart_view: Some("c".to_owned()), ..args("none", &[1.0, 1.0]) };
        assert!(refused(&elsewhere).contains("no picture c"));
        let by_stem = WhitePointArgs { chart_view: Some("b".to_owned()), ..elsewhere };
        let chart = found(&by_stem, [0.5; 3]).expect("gains").and_then(|found| found.chart);
        assert_eq!(chart.map(|chart| chart.view).as_deref(), Some("b.png"));
    }
}
