//! Weights of a network as plain arrays: initial values, Adam, and serialisation.

use crate::rng::{Stream, random_bits};
use crate::{CoreError, Result};

/// Adam (Kingma and Ba 2015), with the constants of the paper.
const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const EPSILON: f64 = 1e-8;
/// Largest gradient that Adam accepts: its square divided by 1 - beta_2 still fits an f32. A larger one
/// counts as not finite.
const MAX_GRADIENT: f32 = 1e15;

const MAGIC: &[u8; 8] = b"fathomwp";
const FORMAT: u32 = 1;
const HEADER: usize = 8 + 3 * 4;
const DIGEST: usize = 32;

/// Initial values of a weight array.
pub(super) enum Init {
    /// One value for all.
    Constant(f32),
    /// Uniform in -bound..bound.
    Uniform(f64),
    /// Normal with mean 0 and this standard deviation.
    Normal(f64),
    /// Explicit values.
    Values(Vec<f32>),
}

/// Place of a weight array among all weights of its network, which are contiguous.
#[derive(Clone, Copy)]
pub(super) struct Place {
    start: usize,
    length: usize,
}

impl Place {
    /// Number of weights in the array.
    #[cfg(test)]
    pub fn length(self) -> usize {
        self.length
    }

    /// This array in all `weights`, or in their gradient.
    pub fn of<R>(self, weights: &[R]) -> &[R] {
        &weights[self.start..self.start + self.length]
    }

    /// Mutable version of [`Place::of`].
    pub fn of_mut<R>(self, weights: &mut [R]) -> &mut [R] {
        &mut weights[self.start..self.start + self.length]
    }
}

/// Collects the weight arrays of a network while its layers are created.
#[derive(Default)]
pub(super) struct Layout {
    arrays: Vec<(Place, Init)>,
    weights: usize,
}

impl Layout {
    /// Adds an array of `length`.
    pub fn add(&mut self, length: usize, init: Init) -> Place {
        let place = Place { start: self.weights, length };
        self.arrays.push((place, init));
        self.weights += length;
        place
    }

    /// The arrays in order.
    #[cfg(test)]
    pub fn places(&self) -> Vec<Place> {
        self.arrays.iter().map(|(place, _)| *place).collect()
    }
}

/// Weights of a network and its Adam state.
pub(super) struct Parameters {
    values: Vec<f32>,
    first_moments: Vec<f32>,
    second_moments: Vec<f32>,
    steps: u32,
}

impl Parameters {
    /// Initial values; each depends only on seed, array and element.
    pub fn new(layout: Layout, seed: u32) -> Self {
        let mut values = Vec::with_capacity(layout.weights);
        for ((Place { length, .. }, init), array) in layout.arrays.into_iter().zip(0..) {
            let random = |i: usize| random_bits(seed, Stream::Networks, array, i as u32);
            match init {
                Init::Constant(value) => values.extend(std::iter::repeat_n(value, length)),
                Init::Uniform(bound) => values.extend((0..length).map(|i| {
                    let [bits, ..] = random(i);
                    (bound * (2.0 * unit(bits) - 1.0)) as f32
                })),
                Init::Normal(deviation) => values.extend((0..length).map(|i| {
                    // Box and Muller 1958; unit() is never 0.
                    let [a, b, _] = random(i);
                    let radius = (-2.0 * unit(a).ln()).sqrt();
                    (deviation * radius * (std::f64::consts::TAU * unit(b)).cos()) as f32
                })),
                Init::Values(given) => values.extend(given),
            }
        }
        let zeros = vec![0.0; values.len()];
        Self { first_moments: zeros.clone(), second_moments: zeros, values, steps: 0 }
    }

    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// One step of Adam; returns whether it was taken. A non-finite value in `gradient` changes nothing: it
    /// would stay in Adam's moments forever.
    pub fn step(&mut self, gradient: &[f32], learning_rate: f32) -> bool {
        if gradient.len() != self.values.len() || !gradient.iter().all(|g| g.abs() < MAX_GRADIENT) {
            return false;
        }
        self.steps = self.steps.saturating_add(1);
        let steps = self.steps.min(i32::MAX as u32) as i32;
        let (bias_1, bias_2) = (1.0 - BETA_1.powi(steps), 1.0 - BETA_2.powi(steps));
        let moments = self.first_moments.iter_mut().zip(&mut self.second_moments);
        for ((value, (first, second)), g) in self.values.iter_mut().zip(moments).zip(gradient) {
            let g = f64::from(*g);
            *first = (BETA_1 * f64::from(*first) + (1.0 - BETA_1) * g) as f32;
            *second = (BETA_2 * f64::from(*second) + (1.0 - BETA_2) * g * g) as f32;
            let slope = (f64::from(*second) / bias_2).sqrt() + EPSILON;
            *value -= (f64::from(learning_rate) * f64::from(*first) / bias_1 / slope) as f32;
        }
        true
    }

    /// Little-endian: magic, format, `shape` of the network, steps, values, both moments, BLAKE3 of
    /// everything before.
    pub fn to_bytes(&self, shape: u32) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER + 12 * self.values.len() + DIGEST);
        bytes.extend_from_slice(MAGIC);
        for word in [FORMAT, shape, self.steps] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        for number in self.values.iter().chain(&self.first_moments).chain(&self.second_moments) {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        let digest = blake3::hash(&bytes);
        bytes.extend_from_slice(digest.as_bytes());
        bytes
    }

    /// Restores the result of [`Parameters::to_bytes`] for the same `shape`; nothing changes on an error.
    pub fn restore(&mut self, bytes: &[u8], shape: u32) -> Result<()> {
        let refuse = |why: String| Err(CoreError::Checkpoint(format!("the state of a network: {why}")));
        let Some((content, digest)) = bytes
            .split_at_checked(bytes.len().saturating_sub(DIGEST))
            .filter(|(content, _)| content.len() >= HEADER && content.starts_with(MAGIC))
        else {
            return refuse("these are other bytes, or it is torn".into());
        };
        if blake3::hash(content).as_bytes() != digest {
            return refuse("its digest does not match: it is torn or damaged".into());
        }
        let words: Vec<u32> =
            content[8..HEADER].chunks_exact(4).map(|four| u32::from_le_bytes(word(four))).collect();
        let &[format, found, steps] = words.as_slice() else { return refuse("it is torn".into()) };
        if format != FORMAT {
            return refuse(format!("its format is {format} and this program reads {FORMAT}"));
        }
        let count = self.values.len();
        if found != shape || content.len() != HEADER + 12 * count {
            return refuse(format!(
                "it is of a network with {found} channels and {} weights, not {shape} and {count}",
                (content.len() - HEADER) / 12
            ));
        }
        let mut numbers = content[HEADER..].chunks_exact(4).map(|four| f32::from_le_bytes(word(four)));
        for array in [&mut self.values, &mut self.first_moments, &mut self.second_moments] {
            for (to, from) in array.iter_mut().zip(&mut numbers) {
                *to = from;
            }
        }
        self.steps = steps;
        Ok(())
    }
}

/// Uniform in (0, 1), at the centres of 2^32 intervals.
fn unit(bits: u32) -> f64 {
    (f64::from(bits) + 0.5) / 4_294_967_296.0
}

fn word(four: &[u8]) -> [u8; 4] {
    [four[0], four[1], four[2], four[3]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn initial_values_have_the_requested_deviation() {
        let mut layout = Layout::default();
        let n = 100_000;
        for init in [Init::Normal(0.5), Init::Uniform(0.5), Init::Constant(3.0)] {
            layout.add(n, init);
        }
        let parameters = Parameters::new(layout, 5);
        let moments = |values: &[f32]| {
            let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n as f64;
            (mean, (values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n as f64).sqrt())
        };
        let arrays: Vec<(f64, f64)> = parameters.values().chunks(n).map(moments).collect();
        // Three standard errors of mean and deviation are 0.0047 and 0.0034.
        for (at, deviation) in [(0, 0.5), (1, 0.5 / 3.0_f64.sqrt())] {
            let (mean, found) = arrays[at];
            assert!(mean.abs() < 0.0048 && (found - deviation).abs() < 0.0035, "{at}: {mean} {found}");
        }
        assert_eq!(arrays[2], (3.0, 0.0));
        assert!(parameters.values()[n..2 * n].iter().all(|v| v.abs() <= 0.5));
    }

    #[test]
    fn step_matches_the_adam_paper() {
        let mut layout = Layout::default();
        layout.add(2, Init::Constant(1.0));
        let mut parameters = Parameters::new(layout, 0);
        // The first step has the size of the learning rate, against the sign of the gradient. The second has
        // the opposite gradient g2 = -g1 / 2: m = (0.9 * 0.1 - 0.1 * 0.5) g1 / (1 - 0.81), v = (0.999 *
        // 0.001 + 0.001 * 0.25) g1^2 / (1 - 0.999^2).
        assert!(parameters.step(&[2.0, -4.0], 0.1));
        assert!((parameters.values()[0] - 0.9).abs() < 1e-6 && (parameters.values()[1] - 1.1).abs() < 1e-6);
        assert!(parameters.step(&[-1.0, 2.0], 0.1));
        let expected = 0.9 - 0.1 * (0.04 / 0.19) / f64::sqrt(0.001_249 / 0.001_999);
        assert!((f64::from(parameters.values()[0]) - expected).abs() < 1e-6, "{:?}", parameters.values());
    }

    #[test]
    fn non_finite_gradient_changes_nothing() {
        let mut layout = Layout::default();
        layout.add(2, Init::Constant(1.0));
        let mut parameters = Parameters::new(layout, 0);
        assert!(parameters.step(&[1.0, 1.0], 0.1));
        let before = parameters.to_bytes(0);
        for bad in [f32::NAN, f32::NEG_INFINITY, 1e20] {
            assert!(!parameters.step(&[1.0, bad], 0.1), "{bad}");
        }
        assert_eq!(parameters.to_bytes(0), before);
        assert!(parameters.step(&[1e14, -1e14], 0.1));
        assert!(parameters.values().iter().all(|v| v.is_finite()));
    }
}
