//! Layers that weight channels and pixels: squeeze and excitation, the residual block with it, and the
//! attention gate. Their interface is that of `layers`.

use super::layers::{Conv, GroupNorm, Image, Linear, Normal, Real, add, relu, relu_backward};
use super::parameters::Layout;
use super::products::{dot, sum};

/// Squeeze and excitation (Hu et al. 2018): a gain for each channel from the means of all channels.
pub(super) struct SqueezeExcite {
    squeeze: Linear,
    excite: Linear,
}

/// Input of [`SqueezeExcite`], its means, the output of the ReLU, and the gains.
pub(super) struct Excited<R> {
    x: Image<R>,
    means: Vec<R>,
    hidden: Vec<R>,
    gains: Vec<R>,
}

impl SqueezeExcite {
    pub fn new(layout: &mut Layout, channels: usize) -> Self {
        // A sixteenth, as in the release (4 of 64). Narrow networks keep 4, since a single unit could die
        // permanently.
        let inner = (channels / 16).max(4);
        let squeeze = Linear::pointwise(layout, channels, inner);
        let excite = Linear::pointwise(layout, inner, channels);
        Self { squeeze, excite }
    }

    pub fn forward<R: Real>(&self, weights: &[R], x: Image<R>) -> (Image<R>, Excited<R>) {
        let pixels = R::of(x.pixels() as f64);
        let means: Vec<R> = x.planes().map(|plane| sum(plane) / pixels).collect();
        let mut hidden = self.squeeze.forward(weights, &means);
        relu(&mut hidden);
        let gains: Vec<R> = self.excite.forward(weights, &hidden).into_iter().map(sigmoid).collect();
        let mut y = x.clone();
        for (plane, gain) in y.planes_mut().zip(&gains) {
            plane.iter_mut().for_each(|value| *value = *value * *gain);
        }
        (y, Excited { x, means, hidden, gains })
    }

    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        excited: &Excited<R>,
        mut v_y: Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        let Excited { x, means, hidden, gains } = excited;
        let v_before: Vec<R> = (v_y.planes().zip(x.planes()).zip(gains))
            .map(|((v_plane, plane), gain)| dot(v_plane, plane) * sigmoid_slope(*gain))
            .collect();
        let mut v_hidden = self.excite.backward(weights, hidden, &v_before, v_weights);
        relu_backward(hidden, &mut v_hidden);
        let v_means = self.squeeze.backward(weights, means, &v_hidden, v_weights);
        let pixels = R::of(x.pixels() as f64);
        for (v_plane, (gain, v_mean)) in v_y.planes_mut().zip(gains.iter().zip(v_means)) {
            let v_pixel = v_mean / pixels;
            v_plane.iter_mut().for_each(|v| *v = *v * *gain + v_pixel);
        }
        v_y
    }
}

/// Residual block with squeeze and excitation: relu(x + se(norm(conv(relu(norm(conv(x))))))).
pub(super) struct SeResidual {
    conv_1: Conv,
    norm_1: GroupNorm,
    conv_2: Conv,
    norm_2: GroupNorm,
    squeeze_excite: SqueezeExcite,
}

/// State that the layers of a [`SeResidual`] keep; `middle` is the output of the first ReLU.
pub(super) struct Residual<R> {
    pub x: Image<R>,
    normal_1: Normal<R>,
    middle: Image<R>,
    normal_2: Normal<R>,
    excited: Excited<R>,
}

impl SeResidual {
    pub fn new(layout: &mut Layout, channels: usize) -> Self {
        Self {
            conv_1: Conv::new(layout, channels, channels, 3),
            norm_1: GroupNorm::new(layout, channels),
            conv_2: Conv::new(layout, channels, channels, 3),
            norm_2: GroupNorm::new(layout, channels),
            squeeze_excite: SqueezeExcite::new(layout, channels),
        }
    }

    pub fn forward<R: Real>(&self, weights: &[R], x: Image<R>) -> (Image<R>, Residual<R>) {
        let (mut middle, normal_1) = self.norm_1.forward(weights, self.conv_1.forward(weights, &x));
        relu(&mut middle.values);
        let (y, normal_2) = self.norm_2.forward(weights, self.conv_2.forward(weights, &middle));
        let (mut y, excited) = self.squeeze_excite.forward(weights, y);
        add(&mut y.values, &x.values);
        relu(&mut y.values);
        (y, Residual { x, normal_1, middle, normal_2, excited })
    }

    /// `y` is the output of `forward`.
    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        residual: &Residual<R>,
        y: &Image<R>,
        mut v_y: Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        relu_backward(&y.values, &mut v_y.values);
        let v = self.squeeze_excite.backward(weights, &residual.excited, v_y.clone(), v_weights);
        let v = self.norm_2.backward(weights, &residual.normal_2, v, v_weights);
        let mut v = self.conv_2.backward(weights, &residual.middle, &v, v_weights);
        relu_backward(&residual.middle.values, &mut v.values);
        let v = self.norm_1.backward(weights, &residual.normal_1, v, v_weights);
        let mut v_x = self.conv_1.backward(weights, &residual.x, &v, v_weights);
        add(&mut v_x.values, &v_y.values);
        v_x
    }
}

/// Additive attention gate (Oktay et al. 2018): a gain for each pixel of `skip`, from `gating` and `skip`.
pub(super) struct AttentionGate {
    pub gating: Conv,
    pub skip: Conv,
    pub psi: Conv,
}

/// Output of the ReLU of an [`AttentionGate`], and the gains [1,H,W].
pub(super) struct Gated<R> {
    joint: Image<R>,
    gains: Image<R>,
}

impl AttentionGate {
    pub fn new(layout: &mut Layout, channels: usize) -> Self {
        // Half as in the release: 32 of 64.
        let inner = channels / 2;
        Self {
            gating: Conv::new(layout, channels, inner, 1),
            skip: Conv::new(layout, channels, inner, 1),
            psi: Conv::new(layout, inner, 1, 1),
        }
    }

    pub fn forward<R: Real>(
        &self,
        weights: &[R],
        gating: &Image<R>,
        skip: &Image<R>,
    ) -> (Image<R>, Gated<R>) {
        let mut joint = self.gating.forward(weights, gating);
        add(&mut joint.values, &self.skip.forward(weights, skip).values);
        relu(&mut joint.values);
        let mut gains = self.psi.forward(weights, &joint);
        gains.values.iter_mut().for_each(|gain| *gain = sigmoid(*gain));
        let mut y = skip.clone();
        for plane in y.planes_mut() {
            plane.iter_mut().zip(&gains.values).for_each(|(value, gain)| *value = *value * *gain);
        }
        (y, Gated { joint, gains })
    }

    /// Returns the gradients of `gating` and of `skip`.
    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        gating: &Image<R>,
        skip: &Image<R>,
        Gated { joint, gains }: &Gated<R>,
        v_y: &Image<R>,
        v_weights: &mut [R],
    ) -> (Image<R>, Image<R>) {
        let mut v_psi = Image::zeros(1, skip.height, skip.width);
        for (v_plane, plane) in v_y.planes().zip(skip.planes()) {
            for (v_gain, (v, value)) in v_psi.values.iter_mut().zip(v_plane.iter().zip(plane)) {
                *v_gain += *v * *value;
            }
        }
        for (v, gain) in v_psi.values.iter_mut().zip(&gains.values) {
            *v = *v * sigmoid_slope(*gain);
        }
        let mut v_joint = self.psi.backward(weights, joint, &v_psi, v_weights);
        relu_backward(&joint.values, &mut v_joint.values);
        let v_gating = self.gating.backward(weights, gating, &v_joint, v_weights);
        let mut v_skip = self.skip.backward(weights, skip, &v_joint, v_weights);
        for (v_skip, v_plane) in v_skip.planes_mut().zip(v_y.planes()) {
            for (v_skip, (v, gain)) in v_skip.iter_mut().zip(v_plane.iter().zip(&gains.values)) {
                *v_skip += *v * *gain;
            }
        }
        (v_gating, v_skip)
    }
}

fn sigmoid<R: Real>(x: R) -> R {
    R::of(1.0) / (R::of(1.0) + (-x).exp())
}

/// The derivative of a sigmoid at the point where its value is `y`.
fn sigmoid_slope<R: Real>(y: R) -> R {
    y * (R::of(1.0) - y)
}
