//! The sRGB curve (IEC 61966-2-1), exact for every code and without a power function per pixel.

use std::sync::LazyLock;

/// Linear light of an sRGB value, both 0..1.
pub fn srgb_to_linear(value: f64) -> f64 {
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Derivative of [`srgb_to_linear`].
pub fn srgb_slope(value: f64) -> f64 {
    if value <= 0.040_45 { 1.0 / 12.92 } else { 2.4 / 1.055 * ((value + 0.055) / 1.055).powf(1.4) }
}

/// sRGB value of linear light, both 0..1.
pub fn linear_to_srgb(value: f64) -> f64 {
    if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

/// Linear light of every 8-bit code.
pub(super) static LINEAR_OF_8: LazyLock<Vec<f32>> =
    LazyLock::new(|| (0..=255).map(|code| srgb_to_linear(f64::from(code) / 255.0) as f32).collect());

/// Linear light of every 16-bit code.
pub(super) static LINEAR_OF_16: LazyLock<Vec<f32>> =
    LazyLock::new(|| (0..=65_535).map(|code| srgb_to_linear(f64::from(code) / 65_535.0) as f32).collect());

/// Rounds linear light to 8-bit sRGB codes.
pub(super) struct Encoder {
    /// The smallest linear light that rounds to each code; code 0 starts below every value.
    starts: Vec<f32>,
    /// The code at each of evenly spaced values, where the search starts.
    first: Vec<u8>,
}

/// Steps of [`Encoder::first`]; with 4096 the search advances by at most one code, except near black.
const STEPS: usize = 4096;

pub(super) static ENCODER: LazyLock<Encoder> = LazyLock::new(|| {
    let starts: Vec<f32> = (0..=255)
        .map(|code| {
            if code == 0 { f32::NEG_INFINITY } else { srgb_to_linear((f64::from(code) - 0.5) / 255.0) as f32 }
        })
        .collect();
    let first = (0..STEPS)
        .map(|step| {
            let value = step as f32 / STEPS as f32;
            (starts.partition_point(|start| *start <= value) - 1) as u8
        })
        .collect();
    Encoder { starts, first }
});

impl Encoder {
    /// The code nearest in sRGB; values outside 0..1 are clamped, NaN gives 0.
    pub fn code(&self, linear: f32) -> u8 {
        // The cast of NaN and of negative values gives 0.
        let step = ((linear * STEPS as f32) as usize).min(STEPS - 1);
        let mut code = usize::from(self.first[step]);
        while code < 255 && linear >= self.starts[code + 1] {
            code += 1;
        }
        code as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_survives_linear_light() {
        for code in 0..=255_u8 {
            assert_eq!(ENCODER.code(LINEAR_OF_8[usize::from(code)]), code);
            assert_eq!(ENCODER.code(LINEAR_OF_16[usize::from(code) * 257]), code);
        }
    }

    #[test]
    fn codes_are_those_of_the_formula() {
        for step in 0..100_000 {
            let linear = step as f32 / 99_999.0;
            let exact = linear_to_srgb(f64::from(linear)) * 255.0;
            let code = f64::from(ENCODER.code(linear));
            // f32 thresholds may move a value that lies within 1e-4 of a border to the other side.
            assert!((code - exact).abs() <= 0.5 + 1e-4, "linear {linear}: code {code}, exact {exact}");
        }
        assert_eq!(ENCODER.code(f32::NAN), 0);
        assert_eq!(ENCODER.code(-3.0), 0);
        assert_eq!(ENCODER.code(f32::INFINITY), 255);
    }
}
