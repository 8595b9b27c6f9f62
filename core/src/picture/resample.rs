//! Reduces pictures by the exact area average in linear light.
//!
//! Every output pixel is the mean of the source pixels under it that count, weighted by the shared area.
//! Source rows are computed when they are needed, so undistortion runs in the same pass and there is no
//! full-size copy in floats. Sums are plain f32 in a fixed order and give the same bytes on every machine.

use rayon::prelude::*;

use super::colour::{ENCODER, LINEAR_OF_8};
use super::decode::Photo;
use crate::scene::Undistortion;
use crate::views::PackedImage;

/// A source of rows: linear RGB times weight, and the weight (0: does not count, 1: counts).
pub(super) trait Rows: Sync {
    /// Columns and rows.
    fn size(&self) -> (u32, u32);
    /// Writes row `y`.
    fn fill(&self, y: u32, row: &mut [[f32; 4]]);
}

impl Rows for Photo {
    fn size(&self) -> (u32, u32) {
        Photo::size(self)
    }

    fn fill(&self, y: u32, row: &mut [[f32; 4]]) {
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = self.linear(x, y as usize);
        }
    }
}

/// A photograph resampled to its pinhole camera, bilinear in linear light.
pub(super) struct Undistorted<'a> {
    pub photo: &'a Photo,
    pub undistortion: Undistortion,
}

impl Rows for Undistorted<'_> {
    fn size(&self) -> (u32, u32) {
        self.photo.size()
    }

    fn fill(&self, y: u32, row: &mut [[f32; 4]]) {
        let (width, height) = self.photo.size();
        let v = f64::from(y) + 0.5;
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = match self.undistortion.source_of(x as f64 + 0.5, v) {
                Some((u, v)) => {
                    let (x0, x1, tx) = taps(u, width);
                    let (y0, y1, ty) = taps(v, height);
                    let top = mix(self.photo.linear(x0, y0), self.photo.linear(x1, y0), tx);
                    let bottom = mix(self.photo.linear(x0, y1), self.photo.linear(x1, y1), tx);
                    mix(top, bottom, ty)
                }
                None => [0.0; 4],
            };
        }
    }
}

/// The two pixels around a coordinate (centres at +0.5) and the share of the second; clamped at the borders.
fn taps(coordinate: f64, len: u32) -> (usize, usize, f32) {
    let centre = (coordinate - 0.5).clamp(0.0, f64::from(len - 1));
    let first = centre.floor();
    let second = (first + 1.0).min(f64::from(len - 1));
    (first as usize, second as usize, (centre - first) as f32)
}

fn mix(a: [f32; 4], b: [f32; 4], t: f32) -> [f32; 4] {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t)
}

impl Rows for PackedImage {
    fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    fn fill(&self, y: u32, row: &mut [[f32; 4]]) {
        let start = y as usize * self.width as usize;
        for (packed, pixel) in self.pixels[start..].iter().zip(row) {
            let [r, g, b, mask] = packed.to_le_bytes();
            *pixel = match mask {
                255 => {
                    let linear = |code: u8| LINEAR_OF_8[usize::from(code)];
                    [linear(r), linear(g), linear(b), 1.0]
                }
                _ => [0.0; 4],
            };
        }
    }
}

/// The source at `width` x `height`, which must not exceed its own size.
///
/// A pixel counts if at least half of its area does; others are black with mask 0.
pub(super) fn reduce(source: &impl Rows, width: u32, height: u32) -> PackedImage {
    let (source_width, source_height) = source.size();
    debug_assert!(width <= source_width && height <= source_height);
    let columns: Vec<Span> = (0..width).map(|x| Span::new(x, width, source_width)).collect();
    let mut pixels = vec![0_u32; width as usize * height as usize];
    let scratch = || (vec![[0.0_f32; 4]; source_width as usize], vec![[0.0_f32; 4]; source_width as usize]);
    pixels.par_chunks_mut(width as usize).enumerate().for_each_init(scratch, |(row, sum), (y, out)| {
        let rows = Span::new(y as u32, height, source_height);
        sum.fill([0.0; 4]);
        for (source_y, weight) in rows.weights() {
            source.fill(source_y, row);
            for (sum, pixel) in sum.iter_mut().zip(row.iter()) {
                add(sum, pixel, weight);
            }
        }
        for (out, columns) in out.iter_mut().zip(&columns) {
            let mut total = [0.0; 4];
            for (x, weight) in columns.weights() {
                add(&mut total, &sum[x as usize], weight);
            }
            *out = encode(total, rows.length() * columns.length());
        }
    });
    PackedImage { width, height, pixels }
}

fn add(sum: &mut [f32; 4], pixel: &[f32; 4], weight: f32) {
    for i in 0..4 {
        sum[i] += pixel[i] * weight;
    }
}

fn encode([r, g, b, counted]: [f32; 4], area: f32) -> u32 {
    let counts = counted > 0.0 && counted >= 0.5 * area;
    if !counts {
        return 0;
    }
    let code = |value: f32| ENCODER.code(value / counted);
    u32::from_le_bytes([code(r), code(g), code(b), 255])
}

/// The source pixels under one output pixel along one axis.
struct Span {
    start: f64,
    end: f64,
}

impl Span {
    fn new(index: u32, len: u32, source_len: u32) -> Self {
        // In integers up to the single division, so that neighbours share their border exactly.
        let border = |at: u32| (u64::from(at) * u64::from(source_len)) as f64 / f64::from(len);
        Self { start: border(index), end: border(index + 1) }
    }

    fn length(&self) -> f32 {
        (self.end - self.start) as f32
    }

    /// Each pixel with the share of its length inside the span.
    fn weights(&self) -> impl Iterator<Item = (u32, f32)> {
        let (start, end) = (self.start, self.end);
        (start.floor() as u32..end.ceil() as u32).map(move |at| {
            let low = start.max(f64::from(at));
            let high = end.min(f64::from(at) + 1.0);
            (at, (high - low) as f32)
        })
    }
}
