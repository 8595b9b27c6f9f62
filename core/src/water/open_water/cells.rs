//! Divides a photograph into cells: their mean colour, and whether they show any structure.

use crate::views::PackedImage;

/// Number of cells along the longer side of a photograph: small enough for the gaps of a reef, large enough
/// to distinguish a smooth colour from noise.
const CELLS: f64 = 56.0;
/// Minimum side of a cell, pixels.
const LEAST_SIDE: f64 = 6.0;

/// The cells of a photograph, row-major from the top left. Cell (i, j) holds the pixels defined by
/// [`crate::views::RayMap`].
#[derive(Clone, Debug, Default)]
pub(super) struct Cells {
    pub(super) columns: u32,
    pub(super) rows: u32,
    /// Mean colour, 8-bit sRGB codes.
    pub(super) means: Vec<[f32; 3]>,
    /// Residual of 2 x 2 pixel means after subtracting a plane: the largest standard deviation of a channel,
    /// codes. Infinite if a pixel is masked or saturated.
    pub(super) texture: Vec<f32>,
    /// Root mean square distance of pixels from the mean over three channels, codes.
    pub(super) spread: Vec<f32>,
    /// Difference of the mean from the line between opposite neighbours: the largest over channels and
    /// directions, codes.
    pub(super) bend: Vec<f32>,
}

/// Numbers of cells across and down a picture.
pub(super) fn grid(width: u32, height: u32) -> [u32; 2] {
    let side = (f64::from(width.max(height)) / CELLS).max(LEAST_SIDE);
    [width, height].map(|pixels| (f64::from(pixels) / side).round().max(1.0) as u32)
}

/// The pixels of cell `index` of `cells` along a side of `pixels` pixels.
pub(super) fn span(index: u32, cells: u32, pixels: u32) -> std::ops::Range<u32> {
    // The smallest x with x * cells / pixels >= index.
    let from = |index: u32| (u64::from(index) * u64::from(pixels)).div_ceil(u64::from(cells)) as u32;
    from(index)..from(index + 1).min(pixels)
}

impl Cells {
    /// The cells of `image`.
    pub(super) fn of(image: &PackedImage) -> Self {
        let [columns, rows] = grid(image.width, image.height);
        let mut cells = Self { columns, rows, ..Self::default() };
        for row in 0..rows {
            for column in 0..columns {
                let (x, y) = (span(column, columns, image.width), span(row, rows, image.height));
                let (mean, texture, spread) = look(image, x, y);
                cells.means.push(mean);
                cells.texture.push(texture);
                cells.spread.push(spread);
            }
        }
        cells.bend =
            (0..rows * columns).map(|index| cells.bend_of(index / columns, index % columns)).collect();
        cells
    }

    fn bend_of(&self, row: u32, column: u32) -> f32 {
        let at = |row: u32, column: u32| self.means[(row * self.columns + column) as usize];
        let here = at(row, column);
        let between = |a: [f32; 3], b: [f32; 3]| {
            (0..3).map(|c| (0.5 * (a[c] + b[c]) - here[c]).abs()).fold(0.0, f32::max)
        };
        let (up, down) = (row.saturating_sub(1), (row + 1).min(self.rows - 1));
        let (left, right) = (column.saturating_sub(1), (column + 1).min(self.columns - 1));
        between(at(up, column), at(down, column)).max(between(at(row, left), at(row, right)))
    }
}

/// Mean colour, texture and spread of a window.
fn look(image: &PackedImage, x: std::ops::Range<u32>, y: std::ops::Range<u32>) -> ([f32; 3], f32, f32) {
    let pixel = |x: u32, y: u32| image.pixels[(y * image.width + x) as usize].to_le_bytes();
    let (mut sums, mut squares, mut count, mut counts) = ([0.0_f64; 3], 0.0, 0.0, true);
    for row in y.clone() {
        for column in x.clone() {
            let [r, g, b, mask] = pixel(column, row);
            counts &= mask == 255 && r < 255 && g < 255 && b < 255;
            for (sum, code) in sums.iter_mut().zip([r, g, b]) {
                *sum += f64::from(code);
                squares += f64::from(code).powi(2);
            }
            count += 1.0;
        }
    }
    let means = sums.map(|sum| (sum / f64::max(count, 1.0)) as f32);
    let square_of_mean: f64 = sums.iter().map(|sum| (sum / f64::max(count, 1.0)).powi(2)).sum();
    let spread = (squares / f64::max(count, 1.0) - square_of_mean).max(0.0).sqrt() as f32;
    let (across, down) = ((x.end - x.start) / 2, (y.end - y.start) / 2);
    if !counts || across < 2 || down < 2 {
        return (means, f32::INFINITY, spread);
    }
    // Means of 2 x 2 pixels reduce the noise of single pixels.
    let middle = |count: u32| f64::from(count - 1) / 2.0;
    let n = f64::from(across * down);
    let mut most = 0.0_f64;
    for c in 0..3 {
        let value = |i: u32, j: u32| {
            let (left, top) = (x.start + 2 * i, y.start + 2 * j);
            let code = |dx: u32, dy: u32| f64::from(pixel(left + dx, top + dy)[c]);
            (code(0, 0) + code(1, 0) + code(0, 1) + code(1, 1)) / 4.0
        };
        let (mut sum, mut squares, mut by_x, mut by_y, mut xx, mut yy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for j in 0..down {
            for i in 0..across {
                let (value, dx, dy) =
                    (value(i, j), f64::from(i) - middle(across), f64::from(j) - middle(down));
                sum += value;
                squares += value * value;
                by_x += dx * value;
                by_y += dy * value;
                xx += dx * dx;
                yy += dy * dy;
            }
        }
        // The grid is regular, so the three components of the plane are orthogonal.
        let left = squares - sum * sum / n - by_x * by_x / xx - by_y * by_y / yy;
        most = most.max(left.max(0.0) / n);
    }
    (means, most.sqrt() as f32, spread)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: u32, height: u32, code: impl Fn(u32, u32) -> [u8; 3]) -> PackedImage {
        let pixels = (0..width * height).map(|i| {
            let [r, g, b] = code(i % width, i / width);
            u32::from_le_bytes([r, g, b, 255])
        });
        PackedImage { width, height, pixels: pixels.collect() }
    }

    #[test]
    fn every_pixel_lies_in_the_cell_of_its_ray_map() {
        for (width, height) in [(444, 296), (97, 31), (56, 200), (5, 3)] {
            let [columns, rows] = grid(width, height);
            for (cells, pixels) in [(columns, width), (rows, height)] {
                let spans: Vec<_> = (0..cells).map(|index| span(index, cells, pixels)).collect();
                assert_eq!(spans.iter().map(|span| span.end - span.start).sum::<u32>(), pixels);
                for pixel in 0..pixels {
                    assert!(spans[(pixel * cells / pixels) as usize].contains(&pixel));
                }
            }
        }
    }

    #[test]
    fn smooth_slope_has_no_texture_but_an_edge_has() {
        let slope = Cells::of(&picture(336, 336, |x, y| [(x / 2) as u8, (y / 2) as u8, 90]));
        assert!(slope.texture.iter().all(|texture| *texture < 0.3), "{:?}", slope.texture);
        let edge = Cells::of(&picture(336, 336, |x, _| if x % 4 < 2 { [60, 80, 90] } else { [70, 80, 90] }));
        assert!(edge.texture.iter().all(|texture| *texture > 2.0), "{:?}", edge.texture);
    }

    #[test]
    fn structure_wider_than_a_cell_shows_as_bend() {
        let band =
            Cells::of(&picture(224, 224, |_, y| if (100..108).contains(&y) { [40; 3] } else { [60; 3] }));
        let most = band.bend.iter().copied().fold(0.0, f32::max);
        assert!(most > 8.0, "{most}");
        assert!(band.bend[0] == 0.0);
    }

    #[test]
    fn masked_or_saturated_pixels_make_a_cell_uncertain() {
        let mut masked = picture(112, 112, |_, _| [9; 3]);
        masked.pixels[0] &= 0x00ff_ffff;
        assert_eq!(Cells::of(&masked).texture[0], f32::INFINITY);
        let bright = picture(112, 112, |x, y| if x + y == 0 { [255; 3] } else { [250; 3] });
        assert_eq!(Cells::of(&bright).texture[0], f32::INFINITY);
        assert!(Cells::of(&bright).texture[1] < 0.1);
    }
}
