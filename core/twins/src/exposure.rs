//! Exposure of a training view: colour' = A colour + b before the loss, its backward pass, and Adam on the
//! maps of all views.
//!
//! As in 3DGS since October 2024, with one difference: each step of a view is subtracted from all views in
//! equal parts. The mean of all exposures therefore stays the identity
//! (`core/src/appearance/exposure/device.rs` explains why).

use super::adam_update;

/// Rows r, g, b of `[A | b]`.
pub type Exposure = [[f64; 4]; 3];

/// The map that changes nothing.
pub const IDENTITY: Exposure = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Applies `exposure` to every pixel.
pub fn expose(rgb: &[[f64; 3]], exposure: &Exposure) -> Vec<[f64; 3]> {
    rgb.iter().map(|&[r, g, b]| exposure.map(|row| row[0] * r + row[1] * g + row[2] * b + row[3])).collect()
}

/// Gradients with respect to the colours and the exposure, from the gradient with respect to the exposed
/// colours.
pub fn expose_backward(
    rgb: &[[f64; 3]],
    v_exposed: &[[f64; 3]],
    exposure: &Exposure,
) -> (Vec<[f64; 3]>, Exposure) {
    let mut v_exposure = [[0.0; 4]; 3];
    let mut v_rgb = Vec::with_capacity(rgb.len());
    for (colour, v) in rgb.iter().zip(v_exposed) {
        for (row, v) in v_exposure.iter_mut().zip(v) {
            for (entry, value) in row.iter_mut().zip([colour[0], colour[1], colour[2], 1.0]) {
                *entry += v * value;
            }
        }
        v_rgb.push(std::array::from_fn(|c| (0..3).map(|row| v[row] * exposure[row][c]).sum()));
    }
    (v_rgb, v_exposure)
}

/// Exposures of all views of a run, with Adam's state.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureState {
    /// One per view; their mean is the identity.
    pub exposures: Vec<Exposure>,
    first: Vec<Exposure>,
    second: Vec<Exposure>,
    steps: Vec<u32>,
}

impl ExposureState {
    /// The identity for each view.
    pub fn new(views: usize) -> Self {
        let zeros = vec![[[0.0; 4]; 3]; views];
        Self { exposures: vec![IDENTITY; views], first: zeros.clone(), second: zeros, steps: vec![0; views] }
    }

    /// Takes one step of Adam on `view` and subtracts it from all views in equal parts.
    pub fn step(&mut self, view: usize, v_exposure: &Exposure, rate: f64) {
        self.steps[view] += 1;
        let share = 1.0 / self.exposures.len() as f64;
        for (row, column) in (0..3).flat_map(|row| (0..4).map(move |column| (row, column))) {
            let before = self.exposures[view][row][column];
            adam_update(
                &mut self.exposures[view][row][column],
                v_exposure[row][column],
                &mut self.first[view][row][column],
                &mut self.second[view][row][column],
                self.steps[view],
                rate,
            );
            let moved = self.exposures[view][row][column] - before;
            self.exposures.iter_mut().for_each(|exposure| exposure[row][column] -= share * moved);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use crate::loss;
    use fathom_core::rng::{Stream, uniform_at};

    const WIDTH: u32 = 13;
    const HEIGHT: u32 = 7;

    fn picture(seed: u32) -> Vec<[f64; 3]> {
        let u = |i, c| f64::from(uniform_at(seed, Stream::Test, i, c));
        (0..WIDTH * HEIGHT).map(|i| [u(i, 0), u(i, 1), u(i, 2)]).collect()
    }

    fn some_exposure(seed: u32) -> Exposure {
        let u = |row, column| 0.4 * (f64::from(uniform_at(seed, Stream::Test, row, column)) - 0.5);
        std::array::from_fn(|row| std::array::from_fn(|c| IDENTITY[row][c] + u(row as u32, c as u32)))
    }

    #[test]
    fn gradients_by_colours_and_exposure_are_central_differences() {
        let (rgb, truth, exposure) = (picture(61), picture(62), some_exposure(63));
        let mask: Vec<bool> = (0..rgb.len()).map(|i| i % 5 != 0).collect();
        let of = |rgb: &[[f64; 3]], exposure: &Exposure| {
            loss(&expose(rgb, exposure), &truth, &mask, WIDTH, HEIGHT, 0.2)
        };
        let (v_rgb, v_exposure) = expose_backward(&rgb, &of(&rgb, &exposure).v_rgb, &exposure);
        for row in 0..3 {
            for column in 0..4 {
                // |x - y| has no derivative where x - y changes its sign, so the step is small.
                let numeric = 1e3
                    * derivative(|h| {
                        let mut moved = exposure;
                        moved[row][column] += 1e-3 * h;
                        of(&rgb, &moved).total
                    });
                assert_close(&format!("[{row}][{column}]"), v_exposure[row][column], numeric, 1e-1);
            }
        }
        for i in (0..rgb.len()).step_by(4) {
            for c in 0..3 {
                let numeric = derivative(|h| {
                    let mut moved = rgb.clone();
                    moved[i][c] += h;
                    of(&moved, &exposure).total
                });
                assert_close(&format!("pixel {i}, channel {c}"), v_rgb[i][c], numeric, 1e-2);
            }
        }
    }

    #[test]
    fn the_mean_exposure_stays_the_identity_and_views_move_apart() {
        let mut state = ExposureState::new(5);
        for (k, view) in [0, 3, 3, 1, 4, 2, 0, 3].into_iter().enumerate() {
            state.step(view, &some_exposure(70 + k as u32), 0.02);
        }
        for row in 0..3 {
            for column in 0..4 {
                let mean = state.exposures.iter().map(|e| e[row][column]).sum::<f64>() / 5.0;
                assert!((mean - IDENTITY[row][column]).abs() < 1e-14, "[{row}][{column}]: {mean}");
            }
        }
        let gain = |view: usize| state.exposures[view][0][0];
        assert!(
            gain(3) < gain(1) - 0.01,
            "a positive gradient must lower the gain: {} and {}",
            gain(3),
            gain(1)
        );
        assert_eq!(state.steps, [2, 1, 1, 3, 1]);
    }

    #[test]
    fn a_single_view_keeps_the_identity() {
        let mut state = ExposureState::new(1);
        state.step(0, &some_exposure(80), 0.1);
        assert_eq!(state.exposures[0], IDENTITY);
    }
}
