//! Draws a measurement: the render with the lines on it, and beside it the differences by zone.

use super::{ViewZones, Zones};
use crate::Result;
use crate::picture::encode_png;
use crate::views::PackedImage;

/// Factor by which differences are amplified, as in the comparison of photograph and render.
const GAIN: u8 = 4;
/// Borders, on the render.
const BORDER: [u8; 3] = [255, 214, 0];
/// Control lines, on the render.
const CONTROL: [u8; 3] = [0, 210, 255];
/// Shades of a zone for no difference and for the largest.
const BORDER_SHADES: [[u8; 3]; 2] = [[74, 40, 0], [255, 214, 120]];
const CONTROL_SHADES: [[u8; 3]; 2] = [[0, 44, 66], [130, 235, 255]];
const INTERIOR_SHADES: [[u8; 3]; 2] = [[0, 0, 0], [255, 255, 255]];
/// Where nothing is measured.
const NOTHING: [u8; 3] = [56, 56, 64];

impl ViewZones {
    /// Two panels from left to right, PNG. Left: the render with borders between cells in yellow and control
    /// lines in blue. Right: four times the largest difference among a pixel's channels, where bright means
    /// wrong. It is yellow in the band of a border, blue in that of a control line and grey elsewhere; flat
    /// grey is not measured.
    ///
    /// # Errors
    /// When the picture has another size than the measured one.
    pub fn picture(&self, render: &PackedImage, truth: &PackedImage) -> Result<Vec<u8>> {
        let mut lined: Vec<[u8; 3]> = render.pixels.iter().map(|pixel| rgb(*pixel)).collect();
        // Two pixels wide, because thinner lines are hard to see in a large picture.
        let mut draw = |on: &[usize], colour: [u8; 3]| {
            for &index in on {
                for near in [index, index + 1, index + self.width] {
                    if let Some(pixel) = lined.get_mut(near) {
                        *pixel = colour;
                    }
                }
            }
        };
        draw(&self.on_control, CONTROL);
        draw(&self.on_border, BORDER);
        let errors = self.zones.iter().zip(render.pixels.iter().zip(&truth.pixels));
        let errors: Vec<[u8; 3]> = errors.map(|(zones, (a, b))| shaded(*zones, rgb(*a), rgb(*b))).collect();
        let rows = lined.chunks(self.width).zip(errors.chunks(self.width));
        let pixels: Vec<u8> =
            rows.flat_map(|(left, right)| left.iter().chain(right)).flatten().copied().collect();
        encode_png(2 * truth.width, truth.height, &pixels)
    }
}

fn shaded(zones: Zones, a: [u8; 3], b: [u8; 3]) -> [u8; 3] {
    let [dark, bright] = if zones == Zones::NOTHING {
        return NOTHING;
    } else if zones.are(Zones::BORDER) {
        BORDER_SHADES
    } else if zones.are(Zones::CONTROL) {
        CONTROL_SHADES
    } else {
        INTERIOR_SHADES
    };
    let largest = (0..3).map(|c| a[c].abs_diff(b[c])).max().unwrap_or(0);
    let error = u32::from(largest.saturating_mul(GAIN));
    std::array::from_fn(|c| {
        ((u32::from(dark[c]) * (255 - error) + u32::from(bright[c]) * error + 127) / 255) as u8
    })
}

fn rgb(pixel: u32) -> [u8; 3] {
    let [r, g, b, _] = pixel.to_le_bytes();
    [r, g, b]
}
