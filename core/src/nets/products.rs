//! Sums of products: the whole cost of a convolution, forward and backward.
//!
//! An image with a zero border is stored as one line of values per channel ([`Lines`]). A tap of a kernel
//! then reads that line, shifted by a constant. The convolution and its input gradient are thus sums of
//! shifted lines, each times a weight ([`correlate`]). The weight gradient has the same form if the channels
//! of a pixel are adjacent. It sums the values that the taps read for each pixel, times the gradient of that
//! pixel ([`weight_gradient`]). Nothing is copied per tap, and one inner loop serves all of these.
//!
//! Every sum is computed by one thread in an order fixed by the code. The bytes therefore depend neither on
//! the number of threads nor on the width of the vectors.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

use rayon::prelude::*;

/// A float: f32 for training, f64 for tests against central differences.
pub(super) trait Real:
    Copy
    + std::fmt::Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// The nearest value to `x`.
    fn of(x: f64) -> Self;
    /// The exponential function.
    fn exp(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
}

impl Real for f32 {
    fn of(x: f64) -> Self {
        x as f32
    }
    fn exp(self) -> Self {
        self.exp()
    }
    fn sqrt(self) -> Self {
        self.sqrt()
    }
}

impl Real for f64 {
    fn of(x: f64) -> Self {
        x
    }
    fn exp(self) -> Self {
        self.exp()
    }
    fn sqrt(self) -> Self {
        self.sqrt()
    }
}

/// An image [C,H,W], row-major.
#[derive(Clone, Debug)]
pub(super) struct Image<R> {
    pub channels: usize,
    pub height: usize,
    pub width: usize,
    pub values: Vec<R>,
}

impl<R: Real> Image<R> {
    /// An image of zeros.
    pub fn zeros(channels: usize, height: usize, width: usize) -> Self {
        Self { channels, height, width, values: vec![R::default(); channels * height * width] }
    }

    /// Number of pixels per channel.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// The channels, each [H,W].
    pub fn planes(&self) -> std::slice::ChunksExact<'_, R> {
        self.values.chunks_exact(self.pixels())
    }

    /// Mutable access to the channels.
    pub fn planes_mut(&mut self) -> std::slice::ChunksExactMut<'_, R> {
        let pixels = self.pixels();
        self.values.chunks_exact_mut(pixels)
    }
}

/// Number of partial sums of a sum over pixels.
const LANES: usize = 16;
/// Number of terms added at once, so that a sum is not loaded and stored for each term.
const TERMS: usize = 8;
/// Number of channels per task.
const CHANNELS: usize = 4;
/// Number of outputs computed at once: the input of a narrow network for them fits into the L1 cache.
const OUTPUTS: usize = 256;

/// The sum of `values`, in [`LANES`] partial sums.
pub(super) fn sum<R: Real>(values: &[R]) -> R {
    let mut lanes = [R::default(); LANES];
    for chunk in values.chunks(LANES) {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += *value;
        }
    }
    total(lanes)
}

/// The dot product of `a` and `b`, in [`LANES`] partial sums.
pub(super) fn dot<R: Real>(a: &[R], b: &[R]) -> R {
    let mut lanes = [R::default(); LANES];
    for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
        for (lane, (a, b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += *a * *b;
        }
    }
    total(lanes)
}

fn total<R: Real>(lanes: [R; LANES]) -> R {
    lanes.into_iter().fold(R::default(), |sum, lane| sum + lane)
}

/// An image with a zero border for kernels of `kernel` x `kernel`, odd.
///
/// Each row is preceded by kernel / 2 zeros; the zeros of the next row serve as the border behind it. A line
/// has `outputs` outputs. For an output at some position, the tap at row `ky` and column `kx` reads
/// `ky * stride + kx` further on. Outputs beyond the right edge are computed too, and discarded.
pub(super) struct Lines<R> {
    channels: usize,
    height: usize,
    width: usize,
    kernel: usize,
    /// Distance from a row to the next.
    stride: usize,
    /// Outputs per line: those of all rows, rounded up to a multiple of [`TERMS`].
    outputs: usize,
    /// Distance from a channel to the next.
    length: usize,
    values: Vec<R>,
}

impl<R: Real> Lines<R> {
    /// `image` with the zero border for `kernel`.
    pub fn new(image: &Image<R>, kernel: usize) -> Self {
        let &Image { channels, height, width, .. } = image;
        let border = kernel / 2;
        let stride = width + border;
        let outputs = (height * stride).next_multiple_of(TERMS);
        let length = outputs + (kernel - 1) * (stride + 1);
        let mut values = vec![R::default(); channels * length];
        for (line, plane) in values.chunks_exact_mut(length).zip(image.planes()) {
            let rows = line[border * (stride + 1)..].chunks_mut(stride);
            for (to, from) in rows.zip(plane.chunks_exact(width)) {
                to[..width].copy_from_slice(from);
            }
        }
        Self { channels, height, width, kernel, stride, outputs, length, values }
    }

    /// Start of the input of the first output, for each weight of an output, [kernel, kernel, channels].
    fn starts(&self) -> Vec<usize> {
        let taps = (0..self.kernel).flat_map(|ky| (0..self.kernel).map(move |kx| ky * self.stride + kx));
        taps.flat_map(|tap| (0..self.channels).map(move |channel| channel * self.length + tap)).collect()
    }

    /// The values at the positions of the outputs in the line of a channel; 0 for discarded outputs.
    fn centre(&self, channel: usize) -> &[R] {
        let start = channel * self.length + self.kernel / 2 * (self.stride + 1);
        &self.values[start..start + self.outputs]
    }

    /// The values with all channels of a position adjacent, in order of position.
    fn by_place(&self) -> Vec<R> {
        let mut values = vec![R::default(); self.values.len()];
        for (channel, line) in self.values.chunks_exact(self.length).enumerate() {
            for (to, from) in values[channel..].iter_mut().step_by(self.channels).zip(line) {
                *to = *from;
            }
        }
        values
    }
}

/// The image whose channel o sums what the taps of `x` read times `weight` [out, kernel, kernel, channels],
/// plus `bias` [out].
pub(super) fn correlate<R: Real>(x: &Lines<R>, weight: &[R], bias: &[R]) -> Image<R> {
    let starts = x.starts();
    let mut image = Image::zeros(bias.len(), x.height, x.width);
    let pixels = image.pixels();
    let blocks = image.values.par_chunks_mut(CHANNELS * pixels);
    let parameters = weight.par_chunks(CHANNELS * starts.len()).zip(bias.par_chunks(CHANNELS));
    blocks.zip(parameters).for_each(|(planes, (weight, bias))| {
        let mut lines: Vec<R> = bias.iter().flat_map(|bias| std::iter::repeat_n(*bias, x.outputs)).collect();
        with_widest_vectors(
            CorrelateBlock { x: &x.values, starts: &starts, weight, outputs: x.outputs },
            &mut lines,
        );
        for (plane, line) in planes.chunks_exact_mut(pixels).zip(lines.chunks_exact(x.outputs)) {
            for (to, from) in plane.chunks_exact_mut(x.width).zip(line.chunks(x.stride)) {
                to.copy_from_slice(&from[..x.width]);
            }
        }
    });
    image
}

/// Adds the gradient of `weight`, as in [`correlate`], to `v_weight`; `v_y` is the gradient of the output
/// image.
pub(super) fn weight_gradient<R: Real>(x: &Lines<R>, v_y: &Lines<R>, v_weight: &mut [R]) {
    let by_place = x.by_place();
    let length = x.kernel * x.kernel * x.channels;
    v_weight.par_chunks_mut(CHANNELS * length).enumerate().for_each(|(block, v_weight)| {
        let first = block * CHANNELS;
        let v_y = (first..first + v_weight.len() / length)
            .map(|channel| v_y.centre(channel).as_chunks().0)
            .collect();
        let work = WeightGradientBlock {
            x: &by_place,
            v_y,
            row: x.kernel * x.channels,
            from_row: x.stride * x.channels,
            from_pixel: x.channels,
        };
        with_widest_vectors(work, v_weight);
    });
}

/// A sum computed by one thread.
trait Work<R> {
    /// Adds to `sums`. Must be inlined, so that it is compiled for the vectors of its caller.
    fn add_to(self, sums: &mut [R]);
}

/// Calls `work.add_to(sums)`, compiled for AVX2 if the CPU has it. FMA is not used, because it rounds once
/// less and would change the bytes.
fn with_widest_vectors<R: Real>(work: impl Work<R>, sums: &mut [R]) {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2")]
        fn with_avx2<R: Real>(work: impl Work<R>, sums: &mut [R]) {
            work.add_to(sums);
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: this CPU has AVX2.
            return unsafe { with_avx2(work, sums) };
        }
    }
    work.add_to(sums);
}

/// The lines of some channels of [`correlate`], in sequence.
struct CorrelateBlock<'a, R> {
    x: &'a [R],
    starts: &'a [usize],
    weight: &'a [R],
    outputs: usize,
}

impl<R: Real> Work<R> for CorrelateBlock<'_, R> {
    #[inline(always)]
    fn add_to(self, lines: &mut [R]) {
        let Self { x, starts, weight, outputs } = self;
        for at in (0..outputs).step_by(OUTPUTS) {
            let end = (at + OUTPUTS).min(outputs);
            for (line, weight) in lines.chunks_exact_mut(outputs).zip(weight.chunks_exact(starts.len())) {
                let line = &mut line[at..end];
                let (groups, rest) = starts.as_chunks::<TERMS>();
                let (weight_groups, weight_rest) = weight.as_chunks::<TERMS>();
                for (starts, factors) in groups.iter().zip(weight_groups) {
                    add_terms(line, &x[at..], starts, factors);
                }
                for (start, factor) in rest.iter().zip(weight_rest) {
                    add_scaled(line, *factor, &x[start + at..]);
                }
            }
        }
    }
}

/// [`weight_gradient`] of some channels with the lines `v_y`.
struct WeightGradientBlock<'a, R> {
    /// [`Lines::by_place`]: the values that the taps of one row read for an output are contiguous.
    x: &'a [R],
    /// By channel, in groups of [`TERMS`] outputs.
    v_y: Vec<&'a [[R; TERMS]]>,
    /// Number of weights in a row of a kernel.
    row: usize,
    /// Distance between the inputs of consecutive kernel rows.
    from_row: usize,
    /// Distance between the inputs of consecutive outputs.
    from_pixel: usize,
}

impl<R: Real> Work<R> for WeightGradientBlock<'_, R> {
    #[inline(always)]
    fn add_to(self, v_weight: &mut [R]) {
        let Self { x, v_y, row, from_row, from_pixel } = self;
        let (outputs, length) = (v_y[0].len() * TERMS, v_weight.len() / v_y.len());
        let starts: [usize; TERMS] = std::array::from_fn(|term| term * from_pixel);
        for at in (0..outputs).step_by(TERMS) {
            for (v_weight, v_y) in v_weight.chunks_exact_mut(length).zip(&v_y) {
                let factors = &v_y[at / TERMS];
                for (ky, v_weight) in v_weight.chunks_exact_mut(row).enumerate() {
                    add_terms(v_weight, &x[ky * from_row + at * from_pixel..], &starts, factors);
                }
            }
        }
    }
}

/// Adds to `to` the slices of `x` that begin at `starts`, each times its factor, in order.
// Inlined, so that it is compiled for the vectors of its caller. The terms have names, because the compiler
// vectorises the loop over `to`, but at opt-level 2 not arrays inside it: a step took up to ten times as
// long.
#[inline(always)]
fn add_terms<R: Real>(to: &mut [R], x: &[R], starts: &[usize; TERMS], factors: &[R; TERMS]) {
    let term = |term: usize| &x[starts[term]..starts[term] + to.len()];
    let (x0, x1, x2, x3) = (term(0), term(1), term(2), term(3));
    let (x4, x5, x6, x7) = (term(4), term(5), term(6), term(7));
    let [f0, f1, f2, f3, f4, f5, f6, f7] = *factors;
    for (i, to) in to.iter_mut().enumerate() {
        let sum = *to + f0 * x0[i] + f1 * x1[i] + f2 * x2[i] + f3 * x3[i];
        *to = sum + f4 * x4[i] + f5 * x5[i] + f6 * x6[i] + f7 * x7[i];
    }
}

/// Adds `factor` times `from` to `to`.
#[inline(always)]
pub(super) fn add_scaled<R: Real>(to: &mut [R], factor: R, from: &[R]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += factor * *from;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Stream, uniform_at};

    fn random(seed: u32, n: usize) -> Vec<f32> {
        (0..n as u32).map(|i| uniform_at(seed, Stream::Test, 5, i) - 0.5).collect()
    }

    #[test]
    fn sums_have_the_same_bytes_with_any_vector_width() {
        let (channels, height, width, to) = (7, 23, 29, 3);
        let image = Image { channels, height, width, values: random(1, channels * height * width) };
        let lines = Lines::new(&image, 3);
        let starts = lines.starts();
        let weight = random(2, to * starts.len());
        let correlate =
            || CorrelateBlock { x: &lines.values, starts: &starts, weight: &weight, outputs: lines.outputs };
        let (mut widest, mut plain) = (random(3, to * lines.outputs), random(3, to * lines.outputs));
        with_widest_vectors(correlate(), &mut widest);
        correlate().add_to(&mut plain);
        assert!(widest == plain && plain != random(3, to * lines.outputs), "correlate");

        let by_place = lines.by_place();
        let v_y = random(4, to * lines.outputs);
        let gradient = || WeightGradientBlock {
            x: &by_place,
            v_y: v_y.chunks_exact(lines.outputs).map(|line| line.as_chunks().0).collect(),
            row: 3 * channels,
            from_row: lines.stride * channels,
            from_pixel: channels,
        };
        let (mut widest, mut plain) = (weight.clone(), weight.clone());
        with_widest_vectors(gradient(), &mut widest);
        gradient().add_to(&mut plain);
        assert!(widest == plain && plain != weight, "gradient by weights");
    }
}
