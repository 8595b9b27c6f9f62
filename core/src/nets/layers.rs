//! Layers of the networks, each with a forward and a backward pass. All images are [C,H,W].
//!
//! A layer knows the places of its weights; all functions take the weights of the whole network. `forward`
//! returns the output and, if its input and output are not enough for the backward pass, the missing state.
//! `backward` takes the gradient of the output (`v_y`) and returns that of the input. It adds the gradients
//! of the weights to `v_weights`, which has the layout of the weights.
//!
//! Non-finite values must propagate: a ReLU or a maximum that turned NaN into 0 would hide that the network
//! has diverged.

use super::parameters::{Init, Layout, Place};
pub(super) use super::products::{Image, Real};
use super::products::{Lines, add_scaled, correlate, dot, sum, weight_gradient};

/// Number of groups of a normalisation. Few, so that most of the information in the magnitudes of channels
/// remains.
pub(super) const GROUPS: usize = 4;
/// Added to the variance; the usual value.
pub(super) const VARIANCE_FLOOR: f64 = 1e-5;

/// Kaiming's standard deviation by fan-out, for layers before a ReLU (He et al. 2015, eq. 14).
fn kaiming(fan_out: usize) -> Init {
    Init::Normal((2.0 / fan_out as f64).sqrt())
}

/// The usual bias: uniform within 1 / sqrt(fan-in). Not 0: without it, the first layer and its normalisation
/// could not distinguish a scene from the same scene at twice the distance.
fn bias(fan_in: usize) -> Init {
    Init::Uniform(1.0 / (fan_in as f64).sqrt())
}

/// Convolution, 1x1 or 3x3 with a zero border; `kernel` is odd.
pub(super) struct Conv {
    /// [out, kernel, kernel, in].
    pub weight: Place,
    pub bias: Place,
    pub from: usize,
    pub to: usize,
    kernel: usize,
}

impl Conv {
    pub fn new(layout: &mut Layout, from: usize, to: usize, kernel: usize) -> Self {
        let taps = kernel * kernel;
        let weight = layout.add(to * from * taps, kaiming(to * taps));
        let bias = layout.add(to, bias(from * taps));
        Self { weight, bias, from, to, kernel }
    }

    pub fn forward<R: Real>(&self, weights: &[R], x: &Image<R>) -> Image<R> {
        correlate(&Lines::new(x, self.kernel), self.weight.of(weights), self.bias.of(weights))
    }

    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        x: &Image<R>,
        v_y: &Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        add_sums(v_y, self.bias.of_mut(v_weights));
        let v_y = Lines::new(v_y, self.kernel);
        weight_gradient(&Lines::new(x, self.kernel), &v_y, self.weight.of_mut(v_weights));
        // An input contributes to the outputs around it with the weights of the opposite taps.
        let taps = self.kernel * self.kernel;
        let weight = self.weight.of(weights);
        let mut turned = Vec::with_capacity(weight.len());
        for i in 0..self.from {
            for tap in (0..taps).rev() {
                turned.extend((0..self.to).map(|o| weight[(o * taps + tap) * self.from + i]));
            }
        }
        correlate(&v_y, &turned, &vec![R::default(); self.from])
    }
}

/// Mean over all pixels of a 3x3 convolution, at a fraction of its cost. A convolution is linear, so its mean
/// is the kernel applied to the means of the nine shifted windows of its input. The input must be at least 2
/// x 2 pixels.
pub(super) struct MeanConv(pub Conv);

/// The size of the input of a [`MeanConv`], and the means of its windows, [3, 3, in].
pub(super) struct Windows<R> {
    size: [usize; 3],
    means: Vec<R>,
}

impl MeanConv {
    pub fn new(layout: &mut Layout, from: usize, to: usize) -> Self {
        Self(Conv::new(layout, from, to, 3))
    }

    /// [out].
    pub fn forward<R: Real>(&self, weights: &[R], x: &Image<R>) -> (Vec<R>, Windows<R>) {
        let pixels = R::of(x.pixels() as f64);
        let mut means = vec![R::default(); 9 * x.channels];
        for (channel, plane) in x.planes().enumerate() {
            // Per row: the sum without its last pixel, of all pixels, and without its first.
            let mut rows = [R::default(); 3];
            let (mut first, mut last) = (rows, rows);
            for (y, row) in plane.chunks_exact(x.width).enumerate() {
                let all = sum(row);
                last = [all - row[x.width - 1], all, all - row[0]];
                if y == 0 {
                    first = last;
                }
                (0..3).for_each(|kx| rows[kx] += last[kx]);
            }
            for kx in 0..3 {
                for (ky, sum) in [rows[kx] - last[kx], rows[kx], rows[kx] - first[kx]].into_iter().enumerate()
                {
                    means[(ky * 3 + kx) * x.channels + channel] = sum / pixels;
                }
            }
        }
        let y = (self.0.weight.of(weights).chunks_exact(means.len()).zip(self.0.bias.of(weights)))
            .map(|(weight, bias)| dot(weight, &means) + *bias)
            .collect();
        (y, Windows { size: [x.channels, x.height, x.width], means })
    }

    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        Windows { size: [channels, height, width], means }: &Windows<R>,
        v_y: &[R],
        v_weights: &mut [R],
    ) -> Image<R> {
        add(self.0.bias.of_mut(v_weights), v_y);
        add_outer(self.0.weight.of_mut(v_weights), v_y, means);
        let mut v_means = vec![R::default(); means.len()];
        for (weight, v) in self.0.weight.of(weights).chunks_exact(means.len()).zip(v_y) {
            add_scaled(&mut v_means, *v, weight);
        }
        let mut v_x = Image::zeros(*channels, *height, *width);
        let pixels = R::of(v_x.pixels() as f64);
        for (channel, plane) in v_x.planes_mut().enumerate() {
            let v_window = |ky: usize, kx: usize| v_means[(ky * 3 + kx) * channels + channel] / pixels;
            for (y, row) in plane.chunks_exact_mut(*width).enumerate() {
                // The windows of the upper taps omit the last row, those of the lower taps the first.
                let mut by_column = [R::default(); 3];
                for ky in (0..3).filter(|ky| (*ky < 2 || y > 0) && (*ky > 0 || y + 1 < *height)) {
                    (0..3).for_each(|kx| by_column[kx] += v_window(ky, kx));
                }
                let [left, middle, right] = by_column;
                row.fill(left + middle + right);
                row[0] = left + middle;
                row[width - 1] = middle + right;
            }
        }
        v_x
    }
}

/// Transposed 2x2 convolution with stride 2, which doubles the size. Its 2x2 outputs do not overlap. It is
/// therefore a 1x1 convolution with four times the outputs, which are then interleaved.
pub(super) struct UpConv {
    /// [out, 2, 2, in].
    pub weight: Place,
    pub bias: Place,
    from: usize,
    to: usize,
}

impl UpConv {
    pub fn new(layout: &mut Layout, from: usize, to: usize) -> Self {
        let weight = layout.add(from * to * 4, kaiming(to * 4));
        let bias = layout.add(to, bias(to * 4));
        Self { weight, bias, from, to }
    }

    pub fn forward<R: Real>(&self, weights: &[R], x: &Image<R>) -> Image<R> {
        let repeated: Vec<R> = self.bias.of(weights).iter().flat_map(|bias| [*bias; 4]).collect();
        let parts = correlate(&Lines::new(x, 1), self.weight.of(weights), &repeated);
        let mut y = Image::zeros(self.to, 2 * x.height, 2 * x.width);
        self.each_part(x, |part, pixel| y.values[pixel] = parts.values[part]);
        y
    }

    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        x: &Image<R>,
        v_y: &Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        add_sums(v_y, self.bias.of_mut(v_weights));
        let mut v_parts = Image::zeros(4 * self.to, x.height, x.width);
        self.each_part(x, |part, pixel| v_parts.values[part] = v_y.values[pixel]);
        let v_parts = Lines::new(&v_parts, 1);
        weight_gradient(&Lines::new(x, 1), &v_parts, self.weight.of_mut(v_weights));
        let weight = self.weight.of(weights);
        let turned: Vec<R> =
            (0..self.from).flat_map(|i| weight.iter().skip(i).step_by(self.from).copied()).collect();
        correlate(&v_parts, &turned, &vec![R::default(); self.from])
    }

    /// Calls `visit(part, pixel)` with the index of each output in [out, y, x, H, W] and in the image [out,
    /// 2H, 2W].
    fn each_part<R: Real>(&self, x: &Image<R>, mut visit: impl FnMut(usize, usize)) {
        let mut pixel = 0;
        for row in 0..self.to * 2 * x.height {
            let (channel, y) = (row / (2 * x.height), row % (2 * x.height));
            let start = ((channel * 4 + y % 2 * 2) * x.height + y / 2) * x.width;
            for column in 0..x.width {
                visit(start + column, pixel);
                visit(start + x.pixels() + column, pixel + 1);
                pixel += 2;
            }
        }
    }
}

/// Linear layer on [in].
pub(super) struct Linear {
    /// [in, out].
    weight: Place,
    bias: Place,
}

impl Linear {
    pub fn new(layout: &mut Layout, from: usize, to: usize, weight: Init, bias: Init) -> Self {
        let weight = layout.add(from * to, weight);
        let bias = layout.add(to, bias);
        Self { weight, bias }
    }

    /// A 1x1 convolution on a single pixel, with the same initial values.
    pub fn pointwise(layout: &mut Layout, from: usize, to: usize) -> Self {
        Self::new(layout, from, to, kaiming(to), bias(from))
    }

    /// Xavier's standard deviation times `gain` (Glorot and Bengio 2010).
    pub fn xavier(layout: &mut Layout, from: usize, to: usize, gain: f64) -> Self {
        let weight = Init::Normal(gain * (2.0 / (from + to) as f64).sqrt());
        Self::new(layout, from, to, weight, bias(from))
    }

    /// [out].
    pub fn forward<R: Real>(&self, weights: &[R], x: &[R]) -> Vec<R> {
        let mut y = self.bias.of(weights).to_vec();
        for (x, weight) in x.iter().zip(self.weight.of(weights).chunks_exact(y.len())) {
            add_scaled(&mut y, *x, weight);
        }
        y
    }

    pub fn backward<R: Real>(&self, weights: &[R], x: &[R], v_y: &[R], v_weights: &mut [R]) -> Vec<R> {
        add(self.bias.of_mut(v_weights), v_y);
        add_outer(self.weight.of_mut(v_weights), x, v_y);
        self.weight.of(weights).chunks_exact(v_y.len()).map(|weight| dot(weight, v_y)).collect()
    }
}

/// Group normalisation (Wu and He 2018), in place of the batch normalisation of the release.
///
/// A batch here is one view. With a batch of one, batch normalisation would train with the statistics of the
/// image itself, but predict with running means of other images. Training and prediction would then disagree.
/// Group normalisation has no state and is the same in both.
pub(super) struct GroupNorm {
    pub scale: Place,
    pub shift: Place,
}

/// Output of [`GroupNorm`] before scale and shift, and 1 / deviation of each group.
pub(super) struct Normal<R> {
    image: Image<R>,
    inverses: [R; GROUPS],
}

impl GroupNorm {
    pub fn new(layout: &mut Layout, channels: usize) -> Self {
        let scale = layout.add(channels, Init::Constant(1.0));
        let shift = layout.add(channels, Init::Constant(0.0));
        Self { scale, shift }
    }

    pub fn forward<R: Real>(&self, weights: &[R], mut x: Image<R>) -> (Image<R>, Normal<R>) {
        let count = x.values.len() / GROUPS;
        let n = R::of(count as f64);
        let mut inverses = [R::default(); GROUPS];
        for (group, inverse) in x.values.chunks_exact_mut(count).zip(&mut inverses) {
            let mean = sum(group) / n;
            group.iter_mut().for_each(|value| *value -= mean);
            *inverse = R::of(1.0) / (dot(group, group) / n + R::of(VARIANCE_FLOOR)).sqrt();
            group.iter_mut().for_each(|value| *value = *value * *inverse);
        }
        let normal = Normal { image: x.clone(), inverses };
        let parameters = self.scale.of(weights).iter().zip(self.shift.of(weights));
        for (plane, (scale, shift)) in x.planes_mut().zip(parameters) {
            plane.iter_mut().for_each(|value| *value = *value * *scale + *shift);
        }
        (x, normal)
    }

    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        normal: &Normal<R>,
        mut v_y: Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        add_sums(&v_y, self.shift.of_mut(v_weights));
        let planes = v_y.planes_mut().zip(normal.image.planes());
        let scales = self.scale.of(weights).iter().zip(self.scale.of_mut(v_weights));
        for ((v_plane, plane), (scale, v_scale)) in planes.zip(scales) {
            *v_scale += dot(v_plane, plane);
            v_plane.iter_mut().for_each(|v| *v = *v * *scale);
        }
        // Mean and deviation depend on every value, so the shift and scale components of a group are removed.
        let count = v_y.values.len() / GROUPS;
        let n = R::of(count as f64);
        let groups = v_y.values.chunks_exact_mut(count).zip(normal.image.values.chunks_exact(count));
        for ((v_group, group), inverse) in groups.zip(normal.inverses) {
            let (shift, factor) = (sum(v_group) / n, dot(v_group, group) / n);
            for (v, value) in v_group.iter_mut().zip(group) {
                *v = (*v - shift - *value * factor) * inverse;
            }
        }
        v_y
    }
}

/// The largest value of each 2x2 block and its index in the channel; the first of equal values.
pub(super) fn halve<R: Real>(x: &Image<R>) -> (Image<R>, Vec<usize>) {
    let mut y = Image::zeros(x.channels, x.height / 2, x.width / 2);
    let mut places = Vec::with_capacity(y.values.len());
    for (to, plane) in y.planes_mut().zip(x.planes()) {
        for (at, to) in to.iter_mut().enumerate() {
            let corner = at / (x.width / 2) * 2 * x.width + at % (x.width / 2) * 2;
            let mut largest = corner;
            for place in [corner + 1, corner + x.width, corner + x.width + 1] {
                // Not `>` alone: NaN must propagate.
                if plane[place] > plane[largest] || is_nan(plane[place]) {
                    largest = place;
                }
            }
            *to = plane[largest];
            places.push(largest);
        }
    }
    (y, places)
}

/// The gradient of the `x` of [`halve`], of `height` x `width`.
pub(super) fn halve_backward<R: Real>(
    places: &[usize],
    v_y: &Image<R>,
    height: usize,
    width: usize,
) -> Image<R> {
    let mut v_x = Image::zeros(v_y.channels, height, width);
    let planes = v_x.planes_mut().zip(v_y.planes().zip(places.chunks_exact(v_y.pixels())));
    for (v_plane, (v_values, places)) in planes {
        for (v, place) in v_values.iter().zip(places) {
            v_plane[*place] = *v;
        }
    }
    v_x
}

/// max(x, 0) in place.
pub(super) fn relu<R: Real>(values: &mut [R]) {
    for value in values {
        // Not a maximum: NaN must propagate.
        if *value < R::default() {
            *value = R::default();
        }
    }
}

/// Turns the gradient `v` of the output of [`relu`], `values`, into that of its input.
pub(super) fn relu_backward<R: Real>(values: &[R], v: &mut [R]) {
    for (v, value) in v.iter_mut().zip(values) {
        if *value <= R::default() {
            *v = R::default();
        }
    }
}

fn is_nan<R: Real>(x: R) -> bool {
    x.partial_cmp(&x).is_none()
}

/// Adds `from` to `to`.
pub(super) fn add<R: Real>(to: &mut [R], from: &[R]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += *from;
    }
}

/// Adds the outer product of `rows` and `columns` to `to` [rows, columns].
fn add_outer<R: Real>(to: &mut [R], rows: &[R], columns: &[R]) {
    for (to, row) in to.chunks_exact_mut(columns.len()).zip(rows) {
        add_scaled(to, *row, columns);
    }
}

/// Adds the sum of each channel to `to` [C].
fn add_sums<R: Real>(image: &Image<R>, to: &mut [R]) {
    for (to, plane) in to.iter_mut().zip(image.planes()) {
        *to += sum(plane);
    }
}
