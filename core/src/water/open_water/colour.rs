//! Fits the colour of open water by direction to cells that may show it.

use glam::DVec3;

use super::super::dense;
use crate::picture::{linear_to_srgb, srgb_to_linear};

/// Rounds of reweighting.
const ROUNDS: usize = 20;
/// Minimum scale of the robust weights, 8-bit codes over three channels.
const LEAST_SCALE: f64 = 3.0;
/// Maximum distance of a cell from the fit, 8-bit codes over three channels.
pub(super) const FARTHEST: f64 = 20.0;
/// Ridge weight on the slopes, as a share of the cells. It only matters if all cells look in one direction.
const RIDGE: f64 = 1e-4;
/// Accuracy of a colour after quantisation to 8 bits and image processing, codes.
const ROUNDING: f64 = 0.5;

/// A cell that may show open water.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    /// Index of its view.
    pub(super) view: u32,
    /// Unit direction, scene axes.
    pub(super) direction: DVec3,
    /// 8-bit sRGB codes.
    pub(super) codes: [f32; 3],
}

/// The colour of open water as a smooth function of direction, common to all views.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Fitted {
    /// Mean direction of the cells, not of unit length.
    pub(super) middle: DVec3,
    /// Natural logarithm of the colour in the middle direction, linear light.
    pub(super) at_middle: [f64; 3],
    /// Change of the logarithm by direction, scene axes.
    pub(super) slopes: [DVec3; 3],
    /// Standard error of `at_middle`.
    pub(super) error: [f64; 3],
}

impl Fitted {
    /// Linear light along `direction`.
    pub(super) fn along(&self, direction: DVec3) -> [f64; 3] {
        std::array::from_fn(|c| (self.at_middle[c] + self.slopes[c].dot(direction - self.middle)).exp())
    }

    /// Distance of `codes` from the colour along `direction`, 8-bit codes over three channels.
    pub(super) fn distance(&self, direction: DVec3, codes: [f32; 3]) -> f64 {
        distance(self.along(direction), codes)
    }

    /// A robust fit of a plane to the logarithms; `None` without cells.
    pub(super) fn of(cells: &[Candidate]) -> Option<Self> {
        if cells.is_empty() {
            return None;
        }
        let middle = cells.iter().map(|cell| cell.direction).sum::<DVec3>() / cells.len() as f64;
        let logarithm = |code: f32| srgb_to_linear(f64::from(code) / 255.0).max(1e-4).ln();
        let logs: Vec<[f64; 3]> = cells.iter().map(|cell| cell.codes.map(logarithm)).collect();
        let mut weights = vec![1.0; cells.len()];
        let mut fitted = Self { middle, at_middle: [0.0; 3], slopes: [DVec3::ZERO; 3], error: [0.0; 3] };
        for _ in 0..ROUNDS {
            let mut matrix = [[0.0; 4]; 4];
            let mut right = [[0.0; 4]; 3];
            for ((cell, logs), weight) in cells.iter().zip(&logs).zip(&weights) {
                let offset = cell.direction - middle;
                let row = [1.0, offset.x, offset.y, offset.z];
                for j in 0..4 {
                    (0..4).for_each(|k| matrix[j][k] += weight * row[j] * row[k]);
                    (0..3).for_each(|c| right[c][j] += weight * row[j] * logs[c]);
                }
            }
            (1..4).for_each(|k| matrix[k][k] += RIDGE * cells.len() as f64);
            for c in 0..3 {
                let [at, x, y, z] = dense::solve(matrix, right[c])?;
                (fitted.at_middle[c], fitted.slopes[c]) = (at, DVec3::new(x, y, z));
            }
            let distances: Vec<f64> =
                cells.iter().map(|cell| fitted.distance(cell.direction, cell.codes)).collect();
            let scale = (1.5 * median(distances.clone())).max(LEAST_SCALE);
            weights = distances.iter().map(|d| (1.0 + (d / scale).powi(2)).powi(-2)).collect();
        }
        fitted.error = fitted.errors(cells, &logs, &weights);
        Some(fitted)
    }

    /// Views are the independent units, since neighbouring cells share errors. Rounding is added.
    fn errors(&self, cells: &[Candidate], logs: &[[f64; 3]], weights: &[f64]) -> [f64; 3] {
        let mut views: Vec<(u32, f64, [f64; 3])> = Vec::new();
        for ((cell, logs), weight) in cells.iter().zip(logs).zip(weights) {
            if views.last().is_none_or(|(view, ..)| *view != cell.view) {
                views.push((cell.view, 0.0, [0.0; 3]));
            }
            if let Some((_, sum, by_channel)) = views.last_mut() {
                let offset = cell.direction - self.middle;
                *sum += weight;
                for c in 0..3 {
                    by_channel[c] += weight * (logs[c] - self.at_middle[c] - self.slopes[c].dot(offset));
                }
            }
        }
        let n = views.len() as f64;
        std::array::from_fn(|c| {
            let squares = views.iter().map(|(_, sum, by)| (by[c] / sum.max(1e-12)).powi(2)).sum::<f64>();
            let code = 255.0 * linear_to_srgb(self.at_middle[c].exp());
            let step = (srgb_to_linear((code + ROUNDING) / 255.0) / srgb_to_linear(code / 255.0)).ln();
            (squares / n / n.max(1.0)).sqrt().hypot(step)
        })
    }
}

pub(super) fn distance(linear: [f64; 3], codes: [f32; 3]) -> f64 {
    let off = |c: usize| 255.0 * linear_to_srgb(linear[c].min(1.0)) - f64::from(codes[c]);
    (off(0).powi(2) + off(1).powi(2) + off(2).powi(2)).sqrt()
}

/// The median of `values`, which may be infinite; 0 if empty.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    let at = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(at, f64::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_growing_upwards_is_fitted_despite_other_cells() {
        let (slopes, at) = ([-0.4, -1.3, -2.5], [0.02, 0.06, 0.12]);
        let mut cells = Vec::new();
        for view in 0..12_u32 {
            for k in 0..60 {
                let direction =
                    DVec3::new(f64::from(k % 10) * 0.05 - 0.2, -f64::from(k / 10) * 0.06, 1.0).normalize();
                let colour: [f64; 3] =
                    std::array::from_fn(|c| at[c] * (slopes[c] * (direction.y + 0.15)).exp());
                let codes = colour.map(|light| (255.0 * linear_to_srgb(light)).round() as f32);
                let codes = if k % 9 == 0 { [90.0, 40.0, 20.0] } else { codes };
                cells.push(Candidate { view, direction, codes });
            }
        }
        let fitted = Fitted::of(&cells).expect("cells");
        let there = DVec3::new(0.1, -0.1, 1.0).normalize();
        for (c, found) in fitted.along(there).into_iter().enumerate() {
            let truth = at[c] * (slopes[c] * (there.y + 0.15)).exp();
            assert!((found / truth - 1.0).abs() < 0.01, "channel {c}: {found} for {truth}");
            assert!((fitted.slopes[c].y - slopes[c]).abs() < 0.1, "{fitted:?}");
            assert!((0.001..0.1).contains(&fitted.error[c]), "{fitted:?}");
        }
        assert!(fitted.distance(there, [90.0, 40.0, 20.0]) > FARTHEST);
        assert_eq!(Fitted::of(&[]), None);
    }
}
