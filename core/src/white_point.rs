//! Brightness and white balance of J in pictures for people: one gain per channel in linear light, by a
//! documented rule.
//!
//! Photographs cannot determine the scale of J, which is free by one gain per channel. These gains choose it
//! for display. They never change a stored model, and comparisons with ground truth do not use them.
//!
//! There are two rules, used alone or in sequence. The first makes a colour, or the mean of grey patches of a
//! chart, neutral and keeps its luminance. The second is [`Exposure`], the same gain for all channels. Over
//! pixels that show surfaces (alpha above [`SURFACE`]), it takes the 99th percentile of the brightest channel
//! to 0.9 of white in sRGB.

use serde::{Deserialize, Serialize};

use crate::gaussians::{Gaussians, SH_C0};
use crate::linear_colours::refitted;
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::{CoreError, Result};

/// Alpha above which a pixel shows a surface.
pub const SURFACE: f32 = 0.9;
/// Share of the surface pixels whose brightest channel is at most [`BRIGHT`]; the rest are highlights and
/// outliers.
pub const PERCENTILE: f64 = 0.99;
/// Target of that percentile, sRGB 0..1: below white, so that few pixels are clipped.
pub const BRIGHT: f64 = 0.9;
/// Pixels averaged on each side of the position of a patch: 5 x 5 in total.
const PATCH: i64 = 2;
/// Minimum light in each channel for a neutral colour, linear: below a third of an 8-bit step there is only
/// noise.
const LEAST: f64 = 1e-4;
/// Luminance of linear sRGB (IEC 61966-2-1).
const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// The gains and their rule: the content of `white_point.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WhitePoint {
    /// `auto`, `colour`, `chart`, or for example `chart, auto` if both rules were used.
    pub rule: String,
    /// Factors on red, green and blue in linear light.
    pub gains: [f64; 3],
    /// The colour that became neutral, linear light before the gains; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub neutral: Option<[f64; 3]>,
    /// The source of that colour, if it was a chart.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub chart: Option<Chart>,
}

/// Grey patches in a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Chart {
    /// Name of the picture.
    pub view: String,
    /// Positions, pixels from its top-left corner.
    pub positions: Vec<[f64; 2]>,
}

/// Gains that make `colour` (linear light) neutral without changing its luminance.
///
/// # Errors
/// When a channel is not a number or has too little light.
pub fn neutral(colour: [f64; 3]) -> Result<[f64; 3]> {
    if !colour.iter().all(|value| value.is_finite() && *value >= LEAST) {
        return Err(CoreError::Config(format!(
            "the colour {colour:?} (linear light) cannot become neutral: each channel must be at least {LEAST}; choose another \
             colour, or patches with light in all channels"
        )));
    }
    let luminance: f64 = colour.iter().zip(LUMINANCE).map(|(value, weight)| value * weight).sum();
    Ok(colour.map(|value| luminance / value))
}

/// The mean colour, linear light, of the patches at `positions` (pixels from the top-left corner) of a
/// picture with `width` columns: `rgb` `[H*W]` sRGB, `alpha` `[H*W]`. A patch is 5 x 5 pixels, fewer at the
/// edge.
///
/// # Errors
/// When there is no position, one is outside the picture, or its patch does not show a surface.
pub fn mean_of_patches(
    rgb: &[[f32; 3]],
    alpha: &[f32],
    width: u32,
    positions: &[[f64; 2]],
) -> Result<[f64; 3]> {
    let refuse = |[x, y]: [f64; 2], why: String| CoreError::Config(format!("the patch at {x},{y} {why}"));
    if positions.is_empty() {
        return Err(CoreError::Config("a chart needs the position of at least one patch".to_owned()));
    }
    let width = i64::from(width);
    let height = rgb.len() as i64 / width.max(1);
    let mut mean = [0.0; 3];
    for &position in positions {
        // Phrased positively, so that NaN counts as outside.
        let within = |v: f64, size: i64| v >= 0.0 && v < size as f64;
        if !(within(position[0], width) && within(position[1], height)) {
            return Err(refuse(position, format!("lies outside of the picture, which is {width}x{height}")));
        }
        let [x, y] = position.map(|v| v as i64);
        let span = |at: i64, size: i64| (at - PATCH).max(0)..=(at + PATCH).min(size - 1);
        let (mut sum, mut count) = ([0.0; 3], 0.0);
        for row in span(y, height) {
            for index in span(x, width).map(|column| (row * width + column) as usize) {
                let surface = alpha[index] > SURFACE;
                if !surface {
                    let what = alpha[index];
                    return Err(refuse(position, format!("is no surface: alpha is {what:.2} beside it")));
                }
                (0..3).for_each(|c| sum[c] += light(rgb[index][c]));
                count += 1.0;
            }
        }
        (0..3).for_each(|c| mean[c] += sum[c] / count / positions.len() as f64);
    }
    Ok(mean)
}

/// Finds the gain that makes surfaces neither clipped nor dim.
///
/// Counts pixels in classes of 1/128 octave, so any number of pictures can be added. The percentile is
/// accurate to 0.3 %.
#[derive(Clone, Debug)]
pub struct Exposure {
    gains: [f64; 3],
    classes: Vec<u64>,
}

/// Classes per octave.
const OCTAVE: f64 = 128.0;
/// Lowest and highest octave: a hundredth of an 8-bit step to 256 times white.
const OCTAVES: [f64; 2] = [-16.0, 8.0];

impl Exposure {
    /// For pictures to which `gains` are applied first.
    pub fn after(gains: [f64; 3]) -> Self {
        Self { gains, classes: vec![0; ((OCTAVES[1] - OCTAVES[0]) * OCTAVE) as usize] }
    }

    /// Adds a picture: `rgb` sRGB and `alpha`, both `[H*W]`.
    pub fn add(&mut self, rgb: &[[f32; 3]], alpha: &[f32]) {
        for (rgb, _) in rgb.iter().zip(alpha).filter(|(_, alpha)| **alpha > SURFACE) {
            let brightest = (0..3).map(|c| self.gains[c] * light(rgb[c])).fold(0.0, f64::max);
            // The cast maps values below all classes, such as black, to the first class.
            let class = ((brightest.log2() - OCTAVES[0]) * OCTAVE) as usize;
            let last = self.classes.len() - 1;
            self.classes[class.min(last)] += 1;
        }
    }

    /// The initial gains times that of the exposure.
    ///
    /// # Errors
    /// When no pixel shows a surface, or surfaces are black.
    pub fn gains(&self) -> Result<[f64; 3]> {
        let count: u64 = self.classes.iter().sum();
        if count == 0 {
            return Err(CoreError::Config(format!(
                "no pixel of the pictures shows a surface (alpha above {SURFACE}), so their brightness cannot be chosen; \
                 choose other cameras, or omit --white-point auto"
            )));
        }
        let rank = (PERCENTILE * count as f64).ceil() as u64;
        let mut below = 0;
        let class = self.classes.iter().position(|of_class| {
            below += of_class;
            below >= rank
        });
        let class = class.filter(|class| *class > 0).ok_or_else(|| {
            CoreError::Config(
                "all surfaces of the pictures are black, and no gain makes them brighter; omit --white-point auto".to_owned(),
            )
        })?;
        let percentile = ((class as f64 + 0.5) / OCTAVE + OCTAVES[0]).exp2();
        let gain = srgb_to_linear(BRIGHT) / percentile;
        Ok(self.gains.map(|of_channel| of_channel * gain))
    }
}

/// Applies gains to a picture, sRGB before and after.
pub fn apply(rgb: &mut [[f32; 3]], gains: [f64; 3]) {
    for pixel in rgb {
        *pixel = std::array::from_fn(|c| linear_to_srgb(gains[c] * light(pixel[c])) as f32);
    }
}

/// The model with gains on its sRGB colours. The harmonics of each Gaussian are refitted to its colours after
/// the gains, by least squares over all directions. Exact for degree 0.
///
/// Except near black, the sRGB curve is a power with an offset, so a gain changes all colours by the same
/// factor and offset. A blend with an alpha of 1 therefore changes like the picture.
#[must_use]
pub fn in_srgb(model: Gaussians, gains: [f64; 3]) -> Gaussians {
    refitted(model, |rgb| std::array::from_fn(|c| linear_to_srgb(gains[c] * srgb_to_linear(rgb[c].max(0.0)))))
}

/// The same for a model whose colours are in linear light; exact.
#[must_use]
pub fn in_linear_light(mut model: Gaussians, gains: [f64; 3]) -> Gaussians {
    let coeffs = model.coeffs();
    for (index, coefficient) in model.sh_coeffs.iter_mut().enumerate() {
        for (value, gain) in coefficient.iter_mut().zip(gains) {
            // Colours are the harmonics plus 0.5.
            let offset = if index % coeffs == 0 { 0.5 * (gain - 1.0) / f64::from(SH_C0) } else { 0.0 };
            *value = (gain * f64::from(*value) + offset) as f32;
        }
    }
    model
}

/// Linear light of an sRGB value; 0 for negative values.
fn light(value: f32) -> f64 {
    srgb_to_linear(f64::from(value).max(0.0))
}

#[cfg(test)]
mod tests {

    use super::*;

    /// A row of greys with light from 0 to `most`, then bright pixels with little alpha.
    fn row(most: f64) -> (Vec<[f32; 3]>, Vec<f32>) {
        let mut rgb: Vec<[f32; 3]> = (0..1000)
            .map(|i| {
                let grey = most * f64::from(i) / 999.0;
                [grey, 0.5 * grey, 0.8 * grey].map(|v| linear_to_srgb(v) as f32)
            })
            .collect();
        rgb.extend([[3.0; 3]; 200]);
        let mut alpha = vec![1.0; 1000];
        alpha.extend([0.5; 200]);
        (rgb, alpha)
    }

    #[test]
    fn brightest_surfaces_become_nine_tenths_of_white() {
        for most in [0.02, 0.4, 3.0] {
            let (mut rgb, alpha) = row(most);
            let mut exposure = Exposure::after([1.0; 3]);
            exposure.add(&rgb, &alpha);
            let gains = exposure.gains().unwrap();
            assert!(gains[0] == gains[1] && gains[1] == gains[2], "one gain: {gains:?}");
            apply(&mut rgb, gains);
            // Classes are half a percent wide in light, a quarter of a percent in sRGB.
            assert!((f64::from(rgb[989][0]) - BRIGHT).abs() < 0.003, "{most}: {:?}", rgb[989]);
            assert!(rgb[..1000].iter().flatten().all(|value| *value < 1.0), "nothing is clipped");
        }
    }

    #[test]
    fn exposure_keeps_a_neutral_colour_neutral() {
        let (mut rgb, alpha) = row(0.3);
        let neutral = neutral([0.3, 0.15, 0.24]).unwrap();
        let mut exposure = Exposure::after(neutral);
        exposure.add(&rgb, &alpha);
        apply(&mut rgb, exposure.gains().unwrap());
        let [r, g, b] = rgb[989].map(f64::from);
        assert!((r - BRIGHT).abs() < 0.003 && (g - r).abs() < 1e-6 && (b - r).abs() < 1e-6, "{r} {g} {b}");
    }

    #[test]
    fn neutral_colour_keeps_its_luminance() {
        let colour = [0.1, 0.4, 0.3];
        let gains = neutral(colour).unwrap();
        let grey = [0, 1, 2].map(|c| gains[c] * colour[c]);
        let luminance = 0.2126 * 0.1 + 0.7152 * 0.4 + 0.0722 * 0.3;
        assert!(grey.iter().all(|value| (value - luminance).abs() < 1e-12), "{grey:?}");
        for wrong in [[0.0, 0.4, 0.3], [f64::NAN, 0.4, 0.3], [-1.0, 0.4, 0.3]] {
            assert!(neutral(wrong).unwrap_err().to_string().contains("cannot become neutral"), "{wrong:?}");
        }
    }

    #[test]
    fn patches_must_be_surfaces_and_are_averaged_linearly() {
        let mut rgb = vec![[0.2_f32, 0.4, 0.6]; 12 * 6];
        rgb[2 * 12 + 2] = [1.0; 3];
        let mut alpha = vec![1.0; 12 * 6];
        alpha[5 * 12 + 11] = 0.3;
        let of = |positions: &[[f64; 2]]| mean_of_patches(&rgb, &alpha, 12, positions);
        let mean = of(&[[2.5, 2.5], [7.0, 2.0]]).unwrap();
        for (c, value) in [0.2, 0.4, 0.6].into_iter().enumerate() {
            // One of the 50 pixels is white.
            let expected = 0.98 * srgb_to_linear(value) + 0.02;
            assert!((mean[c] - expected).abs() < 1e-7, "channel {c}: {} for {expected}", mean[c]);
        }
        assert!(of(&[[0.0, 0.0]]).is_ok(), "a patch at the rim is smaller");
        assert!(
            of(&[[12.0, 2.0]]).unwrap_err().to_string().contains("outside of the picture, which is 12x6")
        );
        assert!(of(&[[f64::NAN, 2.0]]).unwrap_err().to_string().contains("outside"));
        assert!(of(&[[10.0, 4.0]]).unwrap_err().to_string().contains("is no surface: alpha is 0.30"));
        assert!(of(&[]).is_err());
    }

    #[test]
    fn pictures_without_surfaces_or_without_light_are_refused() {
        let none = Exposure::after([1.0; 3]).gains().unwrap_err().to_string();
        assert!(none.contains("no pixel"), "{none}");
        let mut exposure = Exposure::after([1.0; 3]);
        exposure.add(&[[0.0; 3]; 4], &[1.0; 4]);
        let black = exposure.gains().unwrap_err().to_string();
        assert!(black.contains("black"), "{black}");
    }

    #[test]
    fn gains_on_a_model_are_gains_on_its_pictures() {
        let gains = [2.0, 1.0, 0.5];
        let colour = [0.3_f64, 0.5, 0.7];
        let model = Gaussians {
            sh_degree: 1,
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[0.0; 3]],
            opacity_logits: vec![0.0],
            sh_coeffs: [
                colour.map(|v| ((v - 0.5) / f64::from(SH_C0)) as f32),
                [0.02; 3],
                [0.0; 3],
                [-0.01; 3],
            ]
            .to_vec(),
        };
        let shown = |model: &Gaussians, c: usize| 0.5 + f64::from(SH_C0 * model.sh_coeffs[0][c]);
        let srgb = in_srgb(model.clone(), gains);
        let linear = in_linear_light(model.clone(), gains);
        for c in 0..3 {
            let expected = linear_to_srgb(gains[c] * srgb_to_linear(colour[c]));
            // The curvature over the harmonics of degree 1 is of second order.
            assert!((shown(&srgb, c) - expected).abs() < 1e-3, "channel {c}: {}", shown(&srgb, c));
            assert!((shown(&linear, c) - gains[c] * colour[c]).abs() < 1e-6);
            assert!((f64::from(linear.sh_coeffs[1][c]) - gains[c] * 0.02).abs() < 1e-7);
            // The ratio of the slopes of the curve with and without the gain.
            let factor = f64::from(srgb.sh_coeffs[1][c]) / 0.02;
            assert!((factor - gains[c].powf(1.0 / 2.4)).abs() < 0.01, "channel {c}: {factor}");
        }
        assert_eq!((srgb.means, linear.opacity_logits), (model.means, model.opacity_logits));
    }
}
