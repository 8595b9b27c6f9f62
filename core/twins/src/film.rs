//! View embeddings (FiLM, SMP-UWGS eq. 10): factors on the colours of a training view, from the mean colours
//! of its cells. Also their backward pass, and Adam on the weights and the embeddings of all views.
//!
//! Each step of an embedding is subtracted from all embeddings in equal parts. Their mean stays 0, which is
//! the identity (`core/src/appearance/film/device.rs` explains why).

use super::adam_update_with;

/// Hidden units.
pub const UNITS: usize = 16;
/// Bound on the logarithm of a factor.
pub const BOUND: f64 = 0.5;

/// Scale and shift of each hidden unit.
pub type Embedding = [[f64; 2]; UNITS];

/// Per unit: weights of the mean colour, bias, and weights of the three outputs.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmWeights {
    /// `[units][r, g, b, 1]`.
    pub first: [[f64; 4]; UNITS],
    /// `[units][r, g, b]`.
    pub second: [[f64; 3]; UNITS],
}

/// A picture with its cells.
#[derive(Clone, Copy, Debug)]
pub struct FilmPicture<'a> {
    /// `[H*W]`.
    pub rgb: &'a [[f64; 3]],
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Number of cells across and down.
    pub cells: [u32; 2],
}

/// Gradients of [`film`].
#[derive(Clone, Debug, PartialEq)]
pub struct FilmGradients {
    /// With respect to the picture.
    pub rgb: Vec<[f64; 3]>,
    /// With respect to the weights.
    pub weights: FilmWeights,
    /// With respect to the embedding of the view.
    pub embedding: Embedding,
}

/// The part of a side that contains pixel `x`; part i begins at `i side / count`, rounded down.
fn part_of(x: u32, count: u32, side: u32) -> u32 {
    ((x + 1) * count - 1) / side
}

/// The two parts whose centres surround pixel `x`, with their shares.
fn between(x: u32, count: u32, side: u32) -> [(u32, f64); 2] {
    let at =
        ((f64::from(x) + 0.5) * f64::from(count) / f64::from(side) - 0.5).clamp(0.0, f64::from(count - 1));
    let part = (at as u32).min(count.max(2) - 2);
    let share = at - f64::from(part);
    [(part, 1.0 - share), ((part + 1).min(count - 1), share)]
}

impl FilmPicture<'_> {
    fn pixels(&self) -> impl Iterator<Item = (usize, u32, u32)> + use<> {
        let [width, height] = self.size;
        (0..width * height).map(move |i| (i as usize, i % width, i / width))
    }

    fn cell_of(&self, x: u32, y: u32) -> usize {
        let (column, row) =
            (part_of(x, self.cells[0], self.size[0]), part_of(y, self.cells[1], self.size[1]));
        (row * self.cells[0] + column) as usize
    }

    /// The cells whose factors a pixel interpolates, with their shares.
    fn shares(&self, x: u32, y: u32) -> impl Iterator<Item = (usize, f64)> + use<> {
        let across = between(x, self.cells[0], self.size[0]);
        let columns = self.cells[0];
        let down = between(y, self.cells[1], self.size[1]);
        down.into_iter().flat_map(move |(row, v)| {
            across.into_iter().map(move |(column, u)| ((row * columns + column) as usize, u * v))
        })
    }

    /// Mean colour and number of pixels of each cell.
    fn means(&self) -> Vec<([f64; 3], f64)> {
        let mut means = vec![([0.0; 3], 0.0); (self.cells[0] * self.cells[1]) as usize];
        for (i, x, y) in self.pixels() {
            let (sum, count) = &mut means[self.cell_of(x, y)];
            *count += 1.0;
            (0..3).for_each(|c| sum[c] += self.rgb[i][c]);
        }
        means.iter_mut().for_each(|(sum, count)| sum.iter_mut().for_each(|s| *s /= *count));
        means
    }
}

/// A unit before and after modulation: `a` and `s`.
fn unit(weights: &FilmWeights, embedding: &Embedding, j: usize, mean: [f64; 3]) -> (f64, f64) {
    let row = weights.first[j];
    let plain = row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3];
    (plain, plain * (1.0 + embedding[j][0]) + embedding[j][1])
}

/// The factors of a cell.
fn map(weights: &FilmWeights, embedding: &Embedding, mean: [f64; 3]) -> [f64; 3] {
    let mut outputs = [0.0; 3];
    for j in 0..UNITS {
        let (plain, modulated) = unit(weights, embedding, j, mean);
        let added = modulated.max(0.0) - plain.max(0.0);
        (0..3).for_each(|c| outputs[c] += added * weights.second[j][c]);
    }
    outputs.map(|o| (BOUND * (o / BOUND).tanh()).exp())
}

/// Applies the factors of a view's embedding to the picture.
pub fn film(picture: &FilmPicture<'_>, weights: &FilmWeights, embedding: &Embedding) -> Vec<[f64; 3]> {
    let maps: Vec<[f64; 3]> =
        picture.means().iter().map(|(mean, _)| map(weights, embedding, *mean)).collect();
    let mut filmed = vec![[0.0; 3]; picture.rgb.len()];
    for (i, x, y) in picture.pixels() {
        for (cell, share) in picture.shares(x, y) {
            (0..3).for_each(|c| filmed[i][c] += share * maps[cell][c] * picture.rgb[i][c]);
        }
    }
    filmed
}

/// Backward pass of [`film`], from the gradient with respect to its result.
pub fn film_backward(
    picture: &FilmPicture<'_>,
    weights: &FilmWeights,
    embedding: &Embedding,
    v_filmed: &[[f64; 3]],
) -> FilmGradients {
    let means = picture.means();
    let maps: Vec<[f64; 3]> = means.iter().map(|(mean, _)| map(weights, embedding, *mean)).collect();
    let mut v_rgb = vec![[0.0; 3]; picture.rgb.len()];
    let mut v_maps = vec![[0.0; 3]; maps.len()];
    for (i, x, y) in picture.pixels() {
        for (cell, share) in picture.shares(x, y) {
            for c in 0..3 {
                v_rgb[i][c] += share * maps[cell][c] * v_filmed[i][c];
                v_maps[cell][c] += share * picture.rgb[i][c] * v_filmed[i][c];
            }
        }
    }
    let mut v_weights = FilmWeights { first: [[0.0; 4]; UNITS], second: [[0.0; 3]; UNITS] };
    let mut v_embedding = [[0.0; 2]; UNITS];
    let mut v_means = vec![[0.0; 3]; maps.len()];
    for (cell, (mean, count)) in means.iter().enumerate() {
        let v_outputs: [f64; 3] = std::array::from_fn(|c| {
            let bent = maps[cell][c].ln() / BOUND;
            v_maps[cell][c] * maps[cell][c] * (1.0 - bent * bent)
        });
        for j in 0..UNITS {
            let (plain, modulated) = unit(weights, embedding, j, *mean);
            let added = modulated.max(0.0) - plain.max(0.0);
            let mut v_added = 0.0;
            for (c, v_output) in v_outputs.iter().enumerate() {
                v_weights.second[j][c] += v_output * added;
                v_added += v_output * weights.second[j][c];
            }
            let v_modulated = if modulated > 0.0 { v_added } else { 0.0 };
            let v_plain = v_modulated * (1.0 + embedding[j][0]) - if plain > 0.0 { v_added } else { 0.0 };
            v_embedding[j][0] += v_modulated * plain;
            v_embedding[j][1] += v_modulated;
            for c in 0..3 {
                v_weights.first[j][c] += v_plain * mean[c];
                v_means[cell][c] += v_plain * weights.first[j][c] / count;
            }
            v_weights.first[j][3] += v_plain;
        }
    }
    for (i, x, y) in picture.pixels() {
        let v_mean = v_means[picture.cell_of(x, y)];
        (0..3).for_each(|c| v_rgb[i][c] += v_mean[c]);
    }
    FilmGradients { rgb: v_rgb, weights: v_weights, embedding: v_embedding }
}

/// Weights and embeddings of a run, with Adam's state.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmState {
    /// Weights that all views share.
    pub weights: FilmWeights,
    /// One per view; their mean is 0.
    pub embeddings: Vec<Embedding>,
    weight_moments: [[[f64; 2]; 7]; UNITS],
    view_moments: Vec<[[[f64; 2]; 2]; UNITS]>,
    steps: u32,
    view_steps: Vec<u32>,
}

impl FilmState {
    /// Zero embeddings for `views` views.
    pub fn new(weights: FilmWeights, views: usize) -> Self {
        Self {
            weights,
            embeddings: vec![[[0.0; 2]; UNITS]; views],
            weight_moments: [[[0.0; 2]; 7]; UNITS],
            view_moments: vec![[[[0.0; 2]; 2]; UNITS]; views],
            steps: 0,
            view_steps: vec![0; views],
        }
    }

    /// Takes one step of Adam on the weights (decay 0.9 and 0.999) and on the embedding of `view` (0.8 and
    /// 0.99, as for exposures). The step of the embedding is subtracted from all views in equal parts.
    pub fn step(&mut self, view: usize, v: &FilmGradients, rate: f64, view_rate: f64) {
        self.steps += 1;
        self.view_steps[view] += 1;
        let share = 1.0 / self.embeddings.len() as f64;
        for j in 0..UNITS {
            let gradients = v.weights.first[j].into_iter().chain(v.weights.second[j]);
            let values = self.weights.first[j].iter_mut().chain(&mut self.weights.second[j]);
            for ((value, v), [first, second]) in values.zip(gradients).zip(&mut self.weight_moments[j]) {
                adam_update_with(value, v, (first, second), self.steps, rate, [0.9, 0.999]);
            }
            for k in 0..2 {
                let mut moved = 0.0;
                let [first, second] = &mut self.view_moments[view][j][k];
                let (v, steps) = (v.embedding[j][k], self.view_steps[view]);
                adam_update_with(&mut moved, v, (first, second), steps, view_rate, [0.8, 0.99]);
                self.embeddings[view][j][k] += moved;
                self.embeddings.iter_mut().for_each(|embedding| embedding[j][k] -= share * moved);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finite_differences::{assert_close, derivative};
    use fathom_core::rng::{Stream, uniform_at};

    fn number(seed: u32, i: usize, j: u32) -> f64 {
        f64::from(uniform_at(seed, Stream::Test, i as u32, j))
    }

    fn some_weights(seed: u32) -> FilmWeights {
        let even = |i, j| 2.0 * number(seed, i, j) - 1.0;
        FilmWeights {
            first: std::array::from_fn(|i| std::array::from_fn(|k| even(i, k as u32))),
            second: std::array::from_fn(|i| std::array::from_fn(|k| 0.6 * even(i, 4 + k as u32))),
        }
    }

    fn some_embedding(seed: u32) -> Embedding {
        std::array::from_fn(|i| std::array::from_fn(|k| 0.6 * number(seed, i, 10 + k as u32) - 0.3))
    }

    fn colours(seed: u32, [width, height]: [u32; 2]) -> Vec<[f64; 3]> {
        let pixels = 0..(width * height) as usize;
        pixels.map(|i| [number(seed, i, 0), number(seed, i, 1), number(seed, i, 2)]).collect()
    }

    #[test]
    fn parts_cover_a_side_evenly_and_pixel_shares_sum_to_one() {
        for (count, side) in [(1, 1), (1, 50), (3, 100), (4, 7), (7, 7), (50, 1607)] {
            let parts: Vec<u32> = (0..side).map(|x| part_of(x, count, side)).collect();
            assert!(parts.is_sorted() && parts[0] == 0 && parts[side as usize - 1] == count - 1);
            for part in 0..count {
                let begin = part * side / count;
                assert_eq!(parts.iter().position(|p| *p == part), Some(begin as usize), "{part} of {count}");
            }
            for x in 0..side {
                let [(first, u), (second, v)] = between(x, count, side);
                assert!((u + v - 1.0).abs() < 1e-15 && second < count && first <= second);
                assert!((0.0..=1.0).contains(&u), "{u} at {x} of {side}");
            }
        }
    }

    #[test]
    fn all_gradients_of_film_are_central_differences() {
        for (seed, size, cells) in [(501, [13, 7], [3, 2]), (502, [5, 4], [1, 1]), (503, [6, 9], [1, 4])] {
            let (rgb, weights, embedding) = (colours(seed, size), some_weights(seed), some_embedding(seed));
            let v: Vec<[f64; 3]> = colours(seed + 50, size).iter().map(|v| v.map(|v| v - 0.4)).collect();
            let value = |rgb: &[[f64; 3]], weights: &FilmWeights, embedding: &Embedding| -> f64 {
                let filmed = film(&FilmPicture { rgb, size, cells }, weights, embedding);
                filmed.iter().flatten().zip(v.iter().flatten()).map(|(x, v)| x * v).sum()
            };
            let by = film_backward(&FilmPicture { rgb: &rgb, size, cells }, &weights, &embedding, &v);
            // No unit may cross its bend within the step of the differences.
            for j in 0..UNITS {
                for (k, found) in by.weights.first[j].iter().enumerate() {
                    let numeric = derivative(|h| {
                        let mut moved = weights.clone();
                        moved.first[j][k] += h;
                        value(&rgb, &moved, &embedding)
                    });
                    assert_close(&format!("{seed}: first {j}, {k}"), *found, numeric, 1e-2);
                }
                for (k, found) in by.weights.second[j].iter().enumerate() {
                    let numeric = derivative(|h| {
                        let mut moved = weights.clone();
                        moved.second[j][k] += h;
                        value(&rgb, &moved, &embedding)
                    });
                    assert_close(&format!("{seed}: second {j}, {k}"), *found, numeric, 1e-2);
                }
                for (k, found) in by.embedding[j].iter().enumerate() {
                    let numeric = derivative(|h| {
                        let mut moved = embedding;
                        moved[j][k] += h;
                        value(&rgb, &weights, &moved)
                    });
                    assert_close(&format!("{seed}: embedding {j}, {k}"), *found, numeric, 1e-2);
                }
            }
            for (i, found) in by.rgb.iter().enumerate() {
                for c in 0..3 {
                    let numeric = derivative(|h| {
                        let mut moved = rgb.clone();
                        moved[i][c] += h;
                        value(&moved, &weights, &embedding)
                    });
                    assert_close(&format!("{seed}: pixel {i}, {c}"), found[c], numeric, 1e-2);
                }
            }
        }
    }

    #[test]
    fn a_zero_embedding_is_the_identity_and_factors_are_bounded() {
        let (rgb, size) = (colours(511, [9, 8]), [9, 8]);
        let picture = FilmPicture { rgb: &rgb, size, cells: [3, 2] };
        for (a, b) in
            film(&picture, &some_weights(512), &[[0.0; 2]; UNITS]).iter().flatten().zip(rgb.iter().flatten())
        {
            assert!((a - b).abs() < 1e-15);
        }
        let large = [[9.0, 30.0]; UNITS];
        for (a, b) in film(&picture, &some_weights(512), &large).iter().flatten().zip(rgb.iter().flatten()) {
            assert!((a / b).ln().abs() <= BOUND + 1e-12, "{a} of {b}");
        }
    }

    #[test]
    fn embeddings_learn_brightness_and_their_mean_stays_zero() {
        let size = [24, 20];
        let rgb = colours(521, size);
        let picture = FilmPicture { rgb: &rgb, size, cells: [2, 2] };
        let gains = [0.8, 1.25, 0.9, 1.1];
        let mut state = FilmState::new(some_weights(522), gains.len());
        let loss = |state: &FilmState, view: usize| {
            let filmed = film(&picture, &state.weights, &state.embeddings[view]);
            let v: Vec<[f64; 3]> = filmed
                .iter()
                .zip(&rgb)
                .map(|(a, b)| std::array::from_fn(|c| a[c] - gains[view] * b[c]))
                .collect();
            (v.iter().flatten().map(|d| d * d).sum::<f64>(), v)
        };
        let total = |state: &FilmState| (0..4).map(|view| loss(state, view).0).sum::<f64>();
        let before = total(&state);
        for k in 0..400 {
            let view = (k * 3) % 4;
            let (_, v) = loss(&state, view);
            let by = film_backward(&picture, &state.weights, &state.embeddings[view], &v);
            state.step(view, &by, 2e-3, 4e-3);
        }
        assert!(total(&state) < 0.02 * before, "{before} before, {} after", total(&state));
        for j in 0..UNITS {
            for k in 0..2 {
                let mean = state.embeddings.iter().map(|embedding| embedding[j][k]).sum::<f64>() / 4.0;
                assert!(mean.abs() < 1e-14, "{j}, {k}: {mean}");
            }
        }
    }

    #[test]
    fn a_single_view_keeps_the_identity() {
        let size = [4, 4];
        let rgb = colours(531, size);
        let picture = FilmPicture { rgb: &rgb, size, cells: [1, 1] };
        let mut state = FilmState::new(some_weights(532), 1);
        let by = film_backward(&picture, &state.weights, &state.embeddings[0], &vec![[0.3; 3]; 16]);
        state.step(0, &by, 0.01, 0.1);
        assert_eq!(state.embeddings[0], [[0.0; 2]; UNITS]);
    }
}
