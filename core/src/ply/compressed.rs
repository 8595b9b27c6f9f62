//! Writes models as compressed PLY, the form of PlayCanvas for viewing: about a quarter of the bytes.
//!
//! The layout is that of the engine's reader (PlayCanvas 2.23.3, `framework/parsers/ply.js` and
//! `scene/gsplat/gsplat-compressed-data.js`). Gaussians are quantised within chunks of 256, whose bounds are
//! floats:
//!
//! | element | properties |
//! |---|---|
//! | `chunk` | `float`: bounds of centres, logarithms of scales, and colours |
//! | `vertex` | `uint`: `packed_position` 11-10-11 bits, `packed_rotation` 2-10-10-10, `packed_scale` 11-10-11, `packed_color` 8-8-8-8 |
//! | `sh` | `uchar`: `f_rest_0..`, -4 to 4 in 256 steps; absent at degree 0 |
//!
//! Rows follow a Morton curve, so that chunks are compact and their steps are small. The same model gives the
//! same bytes.

use std::fmt::Write as _;

use rayon::prelude::*;

use crate::gaussians::{Gaussians, SH_C0};
use crate::{CoreError, Result};

/// Gaussians of a chunk.
const CHUNK: usize = 256;
/// Logarithms of scales beyond this are clamped, as PlayCanvas does; e^20 is 485 million scene units.
const MOST_LOG_SCALE: f32 = 20.0;
/// Properties of a chunk in the order of the reader.
const BOUNDS: &str = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x \
                      max_scale_y max_scale_z min_r min_g min_b max_r max_g max_b";
const PACKED: &str = "packed_position packed_rotation packed_scale packed_color";
/// Bits of the three values of a position or a scale.
const BITS: [u32; 3] = [11, 10, 11];
/// Bits of a coordinate on the Morton curve; three of them fill a `u64`.
const CURVE_BITS: u32 = 21;

/// A compressed copy of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct CompressedCopy {
    /// The file.
    pub bytes: Vec<u8>,
    /// Gaussians in it.
    pub gaussians: usize,
    /// Gaussians that are not in it: a value is not finite, or the rotation is zero.
    pub left_out: usize,
}

/// Compresses a model. Its `comments` are kept in the header, one line each.
///
/// Largest errors of what the engine decodes:
///
/// - half a step of the chunk for a centre, the logarithm of a scale, and a colour (0.5 + `SH_C0` * `f_dc`);
/// - 1/510 for alpha, and 0.0007 for the three smaller components of a unit quaternion;
/// - 8/256 for a coefficient of the harmonics, which is clamped to -4 and 4.
///
/// # Errors
/// When no Gaussian can be written, the degree is above 3, or a comment has more than one line.
pub fn compressed(model: &Gaussians, comments: &[String]) -> Result<CompressedCopy> {
    let refuse = |message: String| CoreError::input("model.compressed.ply", message);
    if let Some(comment) = comments.iter().find(|comment| comment.contains(['\n', '\r'])) {
        return Err(refuse(format!("the comment {comment:?} is more than one line")));
    }
    if model.sh_degree > 3 {
        return Err(refuse(format!("SH degree {} cannot be written; 0 to 3 can", model.sh_degree)));
    }
    let usable: Vec<u32> =
        (0..model.len() as u32).filter(|&index| is_usable(model, index as usize)).collect();
    if usable.is_empty() {
        return Err(refuse(format!(
            "none of the {} Gaussians of the model has finite values and a rotation; train or download it again",
            model.len()
        )));
    }
    let left_out = model.len() - usable.len();
    let order = along_curve(model, usable);
    // Zeros have no exact code, so harmonics that are all zero are left out.
    let k = model.coeffs();
    let has_rest =
        model.sh_coeffs.chunks_exact(k).any(|coeffs| coeffs[1..].iter().any(|rgb| *rgb != [0.0; 3]));
    let rest = if has_rest { k - 1 } else { 0 };
    let mut bytes = header(order.len(), rest, comments).into_bytes();
    let chunks: Vec<(Bounds, &[u32])> =
        order.chunks(CHUNK).map(|rows| (Bounds::of(model, rows), rows)).collect();
    for (bounds, _) in &chunks {
        // Minimum and maximum of the position, then of the scale, then of the colour.
        for part in 0..3 {
            let range = 3 * part..3 * part + 3;
            let floats = bounds.lo[range.clone()].iter().chain(&bounds.hi[range]);
            floats.for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        }
    }
    for (bounds, rows) in &chunks {
        for &index in *rows {
            let words = packed(model, index as usize, bounds);
            words.iter().for_each(|word| bytes.extend_from_slice(&word.to_le_bytes()));
        }
    }
    if rest > 0 {
        for (row, &index) in order.iter().enumerate() {
            let coeffs = &model.sh_coeffs[index as usize * k + 1..(index as usize + 1) * k];
            // All of R, then all of G, then all of B.
            for channel in 0..3 {
                bytes.extend(coeffs.iter().enumerate().map(|(n, rgb)| harmonic(rgb[channel], row + n)));
            }
        }
    }
    Ok(CompressedCopy { bytes, gaussians: order.len(), left_out })
}

fn header(count: usize, rest: usize, comments: &[String]) -> String {
    let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
    let mut line = |text: std::fmt::Arguments<'_>| {
        // Writing into a string cannot fail.
        let _ = header.write_fmt(text);
    };
    comments.iter().for_each(|comment| line(format_args!("comment {comment}\n")));
    line(format_args!("element chunk {}\n", count.div_ceil(CHUNK)));
    BOUNDS.split(' ').for_each(|name| line(format_args!("property float {name}\n")));
    line(format_args!("element vertex {count}\n"));
    PACKED.split(' ').for_each(|name| line(format_args!("property uint {name}\n")));
    if rest > 0 {
        line(format_args!("element sh {count}\n"));
        (0..3 * rest).for_each(|n| line(format_args!("property uchar f_rest_{n}\n")));
    }
    line(format_args!("end_header\n"));
    header
}

/// Whether every value is finite and the quaternion is not zero.
fn is_usable(model: &Gaussians, index: usize) -> bool {
    let k = model.coeffs();
    let quat = model.quats[index];
    let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
    finite(&model.means[index])
        && finite(&quat)
        && quat != [0.0; 4]
        && finite(&model.log_scales[index])
        && model.opacity_logits[index].is_finite()
        && finite(model.sh_coeffs[index * k..(index + 1) * k].as_flattened())
}

/// What is quantised within the bounds of a chunk: centre, logarithms of the scales, colour.
fn bounded(model: &Gaussians, index: usize) -> [f32; 9] {
    let [x, y, z] = model.means[index];
    let [sx, sy, sz] = model.log_scales[index].map(|log| log.clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE));
    let [r, g, b] = model.sh_coeffs[index * model.coeffs()].map(|dc| 0.5 + SH_C0 * dc);
    [x, y, z, sx, sy, sz, r, g, b]
}

/// Minimum and maximum of [`bounded`] over a chunk.
struct Bounds {
    lo: [f32; 9],
    hi: [f32; 9],
}

impl Bounds {
    fn of(model: &Gaussians, rows: &[u32]) -> Self {
        let mut bounds = Self { lo: [f32::INFINITY; 9], hi: [f32::NEG_INFINITY; 9] };
        for &index in rows {
            for (n, value) in bounded(model, index as usize).into_iter().enumerate() {
                bounds.lo[n] = bounds.lo[n].min(value);
                bounds.hi[n] = bounds.hi[n].max(value);
            }
        }
        bounds
    }

    /// Value `n` of [`bounded`] in steps from its minimum.
    fn steps(&self, n: usize, value: f32, bits: u32) -> u32 {
        let [lo, hi, value] = [self.lo[n], self.hi[n], value].map(f64::from);
        unorm(if hi > lo { (value - lo) / (hi - lo) } else { 0.0 }, bits)
    }
}

/// A share, 0 to 1, in `bits`, to the nearest.
fn unorm(share: f64, bits: u32) -> u32 {
    let most = f64::from((1_u32 << bits) - 1);
    (share * most + 0.5).floor().clamp(0.0, most) as u32
}

/// The four words of a Gaussian: position, rotation, scale, colour with alpha.
fn packed(model: &Gaussians, index: usize, bounds: &Bounds) -> [u32; 4] {
    let values = bounded(model, index);
    let three = |from: usize, bits: [u32; 3]| {
        (0..3).fold(0, |word, n| word << bits[n] | bounds.steps(from + n, values[from + n], bits[n]))
    };
    let alpha = 1.0 / (1.0 + (-f64::from(model.opacity_logits[index])).exp());
    let colour = three(6, [8; 3]) << 8 | unorm(alpha, 8);
    [three(0, BITS), rotation(model.quats[index]), three(3, BITS), colour]
}

/// The number of the largest component of w x y z in 2 bits, then the others in 10 bits each: within
/// 1/sqrt(2) of 0 once the largest is positive.
fn rotation(quat_wxyz: [f32; 4]) -> u32 {
    let quat = quat_wxyz.map(f64::from);
    let norm = quat.iter().map(|value| value * value).sum::<f64>().sqrt();
    // The first of equals.
    let largest = (1..4).fold(0, |best, n| if quat[n].abs() > quat[best].abs() { n } else { best });
    let sign = if quat[largest] < 0.0 { -1.0 } else { 1.0 };
    let others = (0..4).filter(|&n| n != largest);
    others.fold(largest as u32, |word, n| {
        let share = sign * quat[n] / norm * std::f64::consts::FRAC_1_SQRT_2 + 0.5;
        word << 10 | unorm(share, 10)
    })
}

/// A coefficient of the harmonics in 256 steps from -4 to 4, as PlayCanvas writes it.
///
/// 0 lies between two codes. It gets them by `turn`, so that in the mean over Gaussians it stays 0.
fn harmonic(value: f32, turn: usize) -> u8 {
    if value == 0.0 {
        return 127 + (turn % 2) as u8;
    }
    ((f64::from(value) / 8.0 + 0.5) * 256.0).clamp(0.0, 255.0) as u8
}

/// The Gaussians along a Morton curve. Those far outside of the others, such as a distant background, come
/// last with a curve of their own: in a chunk with others they would make its steps large.
fn along_curve(model: &Gaussians, mut indices: Vec<u32>) -> Vec<u32> {
    let coordinate = |index: u32, axis: usize| f64::from(model.means[index as usize][axis]);
    let mut near = [(0.0, 0.0); 3];
    let mut all = [(0.0, 0.0); 3];
    for axis in 0..3 {
        let mut values: Vec<f64> = indices.iter().map(|&index| coordinate(index, axis)).collect();
        values.sort_unstable_by(f64::total_cmp);
        let at = |percent: usize| values[(values.len() - 1) * percent / 100];
        let (lo, hi) = (at(1), at(99));
        near[axis] = (2.0 * lo - hi, 2.0 * hi - lo);
        all[axis] = (at(0), at(100));
    }
    let key = |&index: &u32| {
        let is_far = (0..3).any(|axis| {
            let value = coordinate(index, axis);
            value < near[axis].0 || value > near[axis].1
        });
        let bounds = if is_far { &all } else { &near };
        let code = (0..3).fold(0, |code, axis| {
            let (lo, hi) = bounds[axis];
            let share = if hi > lo { (coordinate(index, axis) - lo) / (hi - lo) } else { 0.0 };
            code | spread(unorm(share, CURVE_BITS)) << axis
        });
        (is_far, code, index)
    };
    indices.par_sort_by_cached_key(key);
    indices
}

/// The lowest 21 bits, each with two zeros above it.
fn spread(value: u32) -> u64 {
    (0..CURVE_BITS).fold(0, |code, bit| code | u64::from(value >> bit & 1) << (3 * bit))
}

#[cfg(test)]
mod tests;
