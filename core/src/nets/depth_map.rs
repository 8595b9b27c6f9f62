//! The input of a network for a view: a small range image in units of the scene scale, with 0 where nothing
//! is seen.

use crate::{CoreError, Result};

/// Largest range in a depth map, in scene scales. At 16 scene scales, no light of the scene is left in any
/// real water. A single far cell would also dominate the near ones in the normalisation.
pub const MAX_RANGE: f32 = 16.0;
/// Alpha below which a pixel counts as open water; the image formation uses the same limit to divide by
/// alpha.
const MIN_ALPHA: f32 = 1e-3;

/// A range image for a network, valid by construction: every value is a number from 0 to [`MAX_RANGE`].
///
/// In scene scales (the unit of `Water::to_raw`), row-major, 0 where nothing is seen.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    width: u32,
    height: u32,
    values: Vec<f32>,
    unusable: usize,
}

/// A rendered range image at full size, row-major.
#[derive(Clone, Copy, Debug)]
pub struct RangeImage<'a> {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Sum of alpha T range over the Gaussians of a pixel, scene units: `range_image` of `rasterize_forward`.
    pub ranges: &'a [f32],
    /// Rendered alpha, 0 to 1.
    pub alphas: &'a [f32],
}

impl DepthMap {
    /// A depth map of `width` x `height` values. Invalid ranges (NaN, infinite, negative) become 0 and are
    /// counted in [`DepthMap::unusable`]; ranges above [`MAX_RANGE`] are clipped.
    ///
    /// # Errors
    /// [`CoreError::Network`] when a side is not a multiple of 4 or is below 16, or `values` has another
    /// length.
    pub fn new(width: u32, height: u32, mut values: Vec<f32>) -> Result<Self> {
        check_size(width, height)?;
        if values.len() != width as usize * height as usize {
            return Err(CoreError::Network(format!(
                "a depth map of {width} x {height} has {} values",
                values.len()
            )));
        }
        let mut unusable = 0;
        for value in &mut values {
            let usable = value.is_finite() && *value >= 0.0;
            unusable += usize::from(!usable);
            *value = if usable { value.min(MAX_RANGE) } else { 0.0 };
        }
        Ok(Self { width, height, values, unusable })
    }

    /// The depth map of a render: each cell is the mean range over its covered area, weighted by alpha and
    /// divided by `unit` (scene units). Empty cells are 0. Pixels without a valid range or alpha count as not
    /// covered, and are counted in [`DepthMap::unusable`]. The whole picture is used, whatever its aspect
    /// ratio.
    ///
    /// # Errors
    /// [`CoreError::Network`] when a size is invalid (as in [`DepthMap::new`]), or `unit` is not a positive
    /// length.
    pub fn from_render(image: &RangeImage, width: u32, height: u32, unit: f32) -> Result<Self> {
        check_size(width, height)?;
        image.check(unit)?;
        let sums = image.sums(width, height);
        let values = sums.iter().map(|sum| sum.mean(unit).min(MAX_RANGE)).collect();
        let pixels = image.ranges.iter().zip(image.alphas);
        let unusable = pixels.filter(|&(&range, &alpha)| !is_usable(range, alpha)).count();
        Ok(Self { width, height, values, unusable })
    }

    /// Backward pass of [`DepthMap::from_render`]: the gradients with respect to `image.ranges` and
    /// `image.alphas`, from the gradient `v_depth` of the depth map of `width` x `height`.
    ///
    /// # Errors
    /// As [`DepthMap::from_render`], and when `v_depth` has another length.
    pub fn render_gradient(
        image: &RangeImage,
        width: u32,
        height: u32,
        unit: f32,
        v_depth: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>)> {
        check_size(width, height)?;
        image.check(unit)?;
        if v_depth.len() != width as usize * height as usize {
            return Err(CoreError::Network(format!(
                "the gradient of a depth map of {width} x {height} has {} values",
                v_depth.len()
            )));
        }
        let sums = image.sums(width, height);
        let mut v_ranges = vec![0.0; image.ranges.len()];
        let mut v_alphas = vec![0.0; image.alphas.len()];
        image.for_each_overlap(width, height, |cell, pixel, area| {
            let (sum, v) = (&sums[cell], f64::from(v_depth[cell]));
            let mean = sum.mean(unit);
            // The forward pass is constant at 0 and at MAX_RANGE.
            if mean > 0.0 && mean < MAX_RANGE {
                let v_sum = v * area / sum.alpha;
                v_ranges[pixel] += (v_sum / f64::from(unit)) as f32;
                v_alphas[pixel] -= (v_sum * f64::from(mean)) as f32;
            }
        });
        Ok((v_ranges, v_alphas))
    }

    /// Values in a row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Ranges in scene scales, row-major, 0 where nothing is seen.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Number of values, or pixels of the render, that were not valid ranges. Not 0 indicates a fault in an
    /// earlier stage.
    pub fn unusable(&self) -> usize {
        self.unusable
    }

    /// Share of the map with a range. At 0, a network learns nothing but its biases.
    pub fn coverage(&self) -> f32 {
        self.values.iter().filter(|value| **value > 0.0).count() as f32 / self.values.len() as f32
    }

    /// Whether a value is neither empty nor clipped, so that it has a gradient.
    pub(super) fn is_live(value: f32) -> bool {
        value > 0.0 && value < MAX_RANGE
    }
}

impl RangeImage<'_> {
    fn check(&self, unit: f32) -> Result<()> {
        let pixels = self.width as usize * self.height as usize;
        if pixels == 0 || self.ranges.len() != pixels || self.alphas.len() != pixels {
            return Err(CoreError::Network(format!(
                "a range image of {} x {} has {} ranges and {} alphas",
                self.width,
                self.height,
                self.ranges.len(),
                self.alphas.len()
            )));
        }
        if !(unit > 0.0 && unit.is_finite()) {
            return Err(CoreError::Network(format!(
                "the scene scale is {unit}; it must be finite and above 0"
            )));
        }
        Ok(())
    }

    /// Sums over the covered area of each cell.
    fn sums(&self, width: u32, height: u32) -> Vec<CellSum> {
        let mut sums = vec![CellSum::default(); width as usize * height as usize];
        self.for_each_overlap(width, height, |cell, pixel, area| {
            sums[cell].range += area * f64::from(self.ranges[pixel]);
            sums[cell].alpha += area * f64::from(self.alphas[pixel]);
        });
        sums
    }

    /// Calls `visit(cell, pixel, area)` for each covered pixel that overlaps a cell, in order of cells, then
    /// of pixels; `area` in pixels.
    fn for_each_overlap(&self, width: u32, height: u32, mut visit: impl FnMut(usize, usize, f64)) {
        for row in 0..height {
            for column in 0..width {
                let cell = (row * width + column) as usize;
                for (y, tall) in overlaps(row, height, self.height) {
                    for (x, wide) in overlaps(column, width, self.width) {
                        let pixel = y as usize * self.width as usize + x as usize;
                        let (range, alpha) = (self.ranges[pixel], self.alphas[pixel]);
                        if is_usable(range, alpha) && alpha >= MIN_ALPHA {
                            visit(cell, pixel, tall * wide);
                        }
                    }
                }
            }
        }
    }
}

/// Sums over the covered area of a cell, weighted by area in pixels: of alpha T range (scene units) and of
/// alpha.
#[derive(Clone, Copy, Default)]
struct CellSum {
    range: f64,
    alpha: f64,
}

impl CellSum {
    /// Mean range in units of `unit`; 0 if nothing is covered.
    fn mean(self, unit: f32) -> f32 {
        if self.alpha > 0.0 { (self.range / (self.alpha * f64::from(unit))) as f32 } else { 0.0 }
    }
}

fn is_usable(range: f32, alpha: f32) -> bool {
    range.is_finite() && range >= 0.0 && (0.0..=1.0 + 1e-3).contains(&alpha)
}

/// The pixels of `pixels` that overlap cell `cell` of `cells` along one axis, each with its overlap in
/// pixels.
fn overlaps(cell: u32, cells: u32, pixels: u32) -> impl Iterator<Item = (u32, f64)> {
    // In units of 1/cells of a pixel, all boundaries are integers, so rounding cannot miss one.
    let (pixels, cells) = (u64::from(pixels), u64::from(cells));
    let (first, end) = (u64::from(cell) * pixels, (u64::from(cell) + 1) * pixels);
    (first / cells..end.div_ceil(cells)).map(move |pixel| {
        let overlap = end.min((pixel + 1) * cells) - first.max(pixel * cells);
        (pixel as u32, overlap as f64 / cells as f64)
    })
}

fn check_size(width: u32, height: u32) -> Result<()> {
    let fits = |side: u32| side.is_multiple_of(4) && side >= 16;
    if fits(width) && fits(height) {
        return Ok(());
    }
    Err(CoreError::Network(format!(
        "a depth map of {width} x {height} is not possible: both sides must be multiples of 4, at least 16"
    )))
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::rng::{Stream, uniform_at};

    /// A render with an empty top, holes, faint pixels, different ranges everywhere and some beyond the
    /// limit.
    fn render(width: u32, height: u32) -> (Vec<f32>, Vec<f32>) {
        let random = |a, b| uniform_at(11, Stream::Test, a, b);
        let alphas: Vec<f32> = (0..width * height)
            .map(|i| match random(0, i) {
                _ if i / width < 3 => 0.0,
                u if u < 0.2 => 0.0,
                u if u < 0.25 => 5e-4,
                u => u,
            })
            .collect();
        // The rightmost columns are far away.
        let far = |i: u32| if i % width + 4 > width { 40.0 } else { 0.0 };
        let ranges =
            alphas.iter().zip(0..).map(|(alpha, i)| alpha * (2.0 + 4.0 * random(1, i) + far(i))).collect();
        (ranges, alphas)
    }

    #[test]
    fn a_cell_is_the_mean_over_its_covered_area() {
        // Left half at 3 scene units with alpha 1, right half at 8 with alpha 0.5, nothing below; the unit
        // is 2.
        let (width, height) = (40, 48);
        let near = |i: u32| i % width < width / 2;
        let above = |i: u32| i / width < height / 2;
        let alphas: Vec<f32> = (0..width * height)
            .map(|i| match (above(i), near(i)) {
                (false, _) => 0.0,
                (true, true) => 1.0,
                (true, false) => 0.5,
            })
            .collect();
        let ranges: Vec<f32> =
            alphas.iter().zip(0..).map(|(alpha, i)| alpha * if near(i) { 3.0 } else { 8.0 }).collect();
        let image = RangeImage { width, height, ranges: &ranges, alphas: &alphas };
        let depth = DepthMap::from_render(&image, 16, 16, 2.0).unwrap();
        for (at, value) in depth.values().iter().enumerate() {
            let expected = match (at / 16 < 8, at % 16 < 8) {
                (false, _) => 0.0,
                (true, true) => 1.5,
                (true, false) => 4.0,
            };
            assert_eq!(*value, expected, "cell {at}");
        }
        assert_eq!((depth.unusable(), depth.coverage()), (0, 0.5));
    }

    #[test]
    fn cells_share_pixels_by_area_at_any_size() {
        for (pixels, cells) in [(37, 16), (16, 16), (15, 20), (1, 16), (1000, 96)] {
            let mut seen = vec![0.0; pixels as usize];
            for cell in 0..cells {
                let area: f64 = overlaps(cell, cells, pixels)
                    .map(|(pixel, overlap)| {
                        assert!(overlap > 0.0 && overlap <= 1.0, "{overlap} of pixel {pixel}");
                        seen[pixel as usize] += overlap;
                        overlap
                    })
                    .sum();
                let expected = f64::from(pixels) / f64::from(cells);
                assert!((area - expected).abs() < 1e-9, "cell {cell} of {cells} over {pixels}: {area}");
            }
            assert!(seen.iter().all(|sum| (sum - 1.0).abs() < 1e-9), "every pixel of {pixels} once");
        }
    }

    #[test]
    fn gradients_of_the_render_match_central_differences() {
        let (width, height) = (23, 19);
        let (ranges, alphas) = render(width, height);
        let unit = 0.45;
        let v_depth: Vec<f32> = (0..16 * 16).map(|i| uniform_at(12, Stream::Test, 2, i) - 0.5).collect();
        let loss = |ranges: &[f32], alphas: &[f32]| -> f64 {
            let image = RangeImage { width, height, ranges, alphas };
            let depth = DepthMap::from_render(&image, 16, 16, unit).unwrap();
            depth.values().iter().zip(&v_depth).map(|(d, v)| f64::from(*d) * f64::from(*v)).sum()
        };
        let image = RangeImage { width, height, ranges: &ranges, alphas: &alphas };
        let depth = DepthMap::from_render(&image, 16, 16, unit).unwrap();
        assert!(
            depth.values().contains(&MAX_RANGE) && depth.values().contains(&0.0),
            "constant parts are covered"
        );
        let (v_ranges, v_alphas) = DepthMap::render_gradient(&image, 16, 16, unit, &v_depth).unwrap();
        let mut compared = 0;
        for pixel in (0..ranges.len()).filter(|&pixel| alphas[pixel] >= 0.25 && alphas[pixel] < 0.99) {
            for (by_alpha, analytic) in [(false, v_ranges[pixel]), (true, v_alphas[pixel])] {
                let h = 1e-2;
                let at = |h: f32| {
                    let (mut ranges, mut alphas) = (ranges.clone(), alphas.clone());
                    let moved = if by_alpha { &mut alphas[pixel] } else { &mut ranges[pixel] };
                    let before = *moved;
                    *moved += h;
                    let by = f64::from(*moved - before);
                    (loss(&ranges, &alphas), by)
                };
                let ((up, wide), (down, back)) = (at(h), at(-h));
                let numeric = (up - down) / (wide - back);
                // The values are f32 near 10, so a difference is accurate to about 1e-6 / 1e-2; curvature
                // adds h^2.
                let tolerance = 2e-3 * (1.0 + numeric.abs());
                let error = (f64::from(analytic) - numeric).abs();
                assert!(error < tolerance, "pixel {pixel} {by_alpha}: {analytic} {numeric}");
                compared += usize::from(analytic != 0.0);
            }
        }
        assert!(compared > 300, "{compared}");
    }

    #[test]
    fn invalid_ranges_are_ignored_and_counted() {
        let mut values = vec![1.0; 256];
        values[..5].copy_from_slice(&[f32::NAN, f32::INFINITY, -1.0, 0.0, 1e30]);
        let depth = DepthMap::new(16, 16, values).unwrap();
        assert_eq!(depth.values()[..5], [0.0, 0.0, 0.0, 0.0, MAX_RANGE]);
        assert_eq!(depth.unusable(), 3);

        let (mut ranges, mut alphas) = (vec![2.0_f32; 32 * 32], vec![1.0_f32; 32 * 32]);
        (ranges[0], ranges[1], alphas[2], alphas[3]) = (f32::NAN, f32::INFINITY, f32::NAN, -1.0);
        let image = RangeImage { width: 32, height: 32, ranges: &ranges, alphas: &alphas };
        let depth = DepthMap::from_render(&image, 16, 16, 1.0).unwrap();
        assert_eq!(depth.unusable(), 4);
        assert!(depth.values().iter().all(|value| *value == 2.0), "the other pixels of a cell count");
    }

    #[test]
    fn invalid_sizes_are_refused() {
        let refused = |result: Result<DepthMap>| result.unwrap_err().to_string();
        assert!(refused(DepthMap::new(18, 16, vec![0.0; 18 * 16])).contains("18 x 16"));
        assert!(refused(DepthMap::new(16, 12, vec![0.0; 16 * 12])).contains("multiples of 4"));
        assert!(refused(DepthMap::new(16, 16, vec![0.0; 255])).contains("255 values"));
        let image = RangeImage { width: 4, height: 4, ranges: &[0.0; 16], alphas: &[0.0; 15] };
        assert!(refused(DepthMap::from_render(&image, 16, 16, 1.0)).contains("15 alphas"));
        let image = RangeImage { width: 4, height: 4, ranges: &[0.0; 16], alphas: &[0.0; 16] };
        assert!(refused(DepthMap::from_render(&image, 16, 16, 0.0)).contains("finite and above 0"));
        assert_eq!(DepthMap::from_render(&image, 16, 16, 1.0).unwrap().coverage(), 0.0);
    }
}
