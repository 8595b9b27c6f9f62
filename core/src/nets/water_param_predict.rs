//! WaterParamPredict: the U-Net of SMP-UWGS section 3.2, which maps the ranges of a view to the water
//! parameters (eq. 8).
//!
//! ```text
//! depth [1,H,W] ->  conv 1->C, norm, relu, SE-residual, halve            = e1 [C, H/2, W/2]
//!                 -> conv C->2C, norm, relu, SE-residual, halve           = e2 [2C,H/4, W/4]
//!                 -> transposed conv 2C->C, SE-residual                   = d1 [C, H/2, W/2]
//!                 -> d1 + e1 * gate(d1, e1)
//!                 -> transposed conv C->C, SE-residual                    = d2 [C, H, W]
//!                 -> conv C->4C, mean over pixels -> FC 4C->2C, relu -> FC 2C->9
//! ```
//!
//! C is 64 in the release (`dpr_net/water_param_predictor.py`); a narrower network has the same structure and
//! costs less. Initial values are those of the release: Kaiming by fan-out for convolutions, Xavier with gain
//! 0.35 for the first FC. The last FC has N(0, 0.05^2), and the prior as bias. Differences:
//!
//! - Group normalisation in place of batch normalisation, which fails with a batch of one (`GroupNorm`).
//! - No dropout (0.3 between the FCs in the release). With a batch of one it would add noise to the single
//!   water of all views. The pass repeated in `learn` would also differ from that of `predict`.
//! - The mean over pixels of the last convolution is computed from means of its input. This gives the same
//!   value (`MeanConv`) without the most expensive layer of the network.
//! - The depth map has one unit for the whole scene, and 0 where nothing is seen; the release stretches every
//!   view to 1200 x 800.

use super::attention::{AttentionGate, Gated, Residual, SeResidual};
use super::layers::{
    Conv, GroupNorm, Image, Linear, MeanConv, Normal, Real, UpConv, Windows, add, halve, halve_backward,
    relu, relu_backward,
};
use super::parameters::{Init, Layout, Parameters};
use super::{DepthMap, Learned, WaterParamPredictor};
use crate::water::Water;
use crate::{CoreError, Result};

/// Prior of the release, with the scene scale as unit: `RELEASE_PRIOR.to_raw(1.0)`.
pub const RELEASE_PRIOR: Water =
    Water { beta_d: [0.75, 0.30, 0.50], beta_b: [0.75, 0.40, 0.40], b_inf: [0.10, 0.25, 0.45] };

/// The network with its weights and its Adam state.
pub struct WaterParamNet {
    unet: UNet,
    parameters: Parameters,
}

impl WaterParamNet {
    /// A network of `channels` (C above; 64 in the release, a multiple of 8 here) that starts near `prior`:
    /// the unconstrained water parameters of `Water::to_raw`. The same seed gives the same weights.
    ///
    /// # Errors
    /// [`CoreError::Network`] when `channels` is not a multiple of 8 from 8 to 256, or `prior` is not finite.
    pub fn new(channels: u32, prior: [f64; 9], seed: u32) -> Result<Self> {
        if !channels.is_multiple_of(8) || !(8..=256).contains(&channels) {
            return Err(CoreError::Network(format!(
                "{channels} channels are not possible: their number must be a multiple of 8, from 8 to 256"
            )));
        }
        if !prior.iter().all(|number| number.is_finite()) {
            return Err(CoreError::Network(format!("the prior of the water is not finite: {prior:?}")));
        }
        let mut layout = Layout::default();
        let unet = UNet::new(&mut layout, channels as usize, prior);
        Ok(Self { unet, parameters: Parameters::new(layout, seed) })
    }

    /// Number of weights.
    pub fn weights(&self) -> usize {
        self.parameters.values().len()
    }

    fn shape(&self) -> u32 {
        self.unet.channels as u32
    }
}

impl WaterParamPredictor for WaterParamNet {
    fn predict(&self, depth: &DepthMap) -> Result<[f32; 9]> {
        let (raw, _) = self.unet.forward(self.parameters.values(), image(depth, depth.values()));
        finite(raw)
    }

    fn learn(
        &mut self,
        depth: &DepthMap,
        v_raw: [f32; 9],
        learning_rate: f32,
        wants_depth: bool,
    ) -> Result<Learned> {
        if !(learning_rate >= 0.0 && learning_rate.is_finite()) {
            return Err(CoreError::Network(format!(
                "its learning rate is {learning_rate}; it must be a finite number, 0 or more"
            )));
        }
        let pass = self.unet.pass(self.parameters.values(), depth, depth.values(), v_raw, wants_depth);
        let raw = finite(pass.raw)?;
        let usable = |gradient: &Vec<f32>| gradient.iter().all(|v| v.is_finite());
        let stepped =
            pass.v_depth.as_ref().is_none_or(usable) && self.parameters.step(&pass.v_weights, learning_rate);
        Ok(Learned { raw, v_depth: pass.v_depth.filter(|_| stepped), stepped })
    }

    fn to_bytes(&self) -> Vec<u8> {
        self.parameters.to_bytes(self.shape())
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<()> {
        self.parameters.restore(bytes, self.shape())
    }
}

/// Layers of the network; the weights are stored separately.
pub(super) struct UNet {
    channels: usize,
    encoder_1: Encoder,
    encoder_2: Encoder,
    up_1: UpConv,
    decoder_1: SeResidual,
    gate: AttentionGate,
    up_2: UpConv,
    decoder_2: SeResidual,
    global: MeanConv,
    middle: Linear,
    last: Linear,
}

/// Convolution, norm, ReLU and SE-residual, then halving.
struct Encoder {
    conv: Conv,
    norm: GroupNorm,
    residual: SeResidual,
}

impl Encoder {
    fn new(layout: &mut Layout, from: usize, to: usize) -> Self {
        Self {
            conv: Conv::new(layout, from, to, 3),
            norm: GroupNorm::new(layout, to),
            residual: SeResidual::new(layout, to),
        }
    }

    fn forward<R: Real>(&self, weights: &[R], x: &Image<R>) -> (Image<R>, Encoded<R>) {
        let (mut full, normal) = self.norm.forward(weights, self.conv.forward(weights, x));
        relu(&mut full.values);
        let (full, residual) = self.residual.forward(weights, full);
        let (half, places) = halve(&full);
        (half, Encoded { normal, residual, full, places })
    }

    fn backward<R: Real>(
        &self,
        weights: &[R],
        x: &Image<R>,
        Encoded { normal, residual, full, places }: &Encoded<R>,
        v_half: &Image<R>,
        v_weights: &mut [R],
    ) -> Image<R> {
        let v = halve_backward(places, v_half, full.height, full.width);
        let mut v = self.residual.backward(weights, residual, full, v, v_weights);
        relu_backward(&residual.x.values, &mut v.values);
        let v = self.norm.backward(weights, normal, v, v_weights);
        self.conv.backward(weights, x, &v, v_weights)
    }
}

/// State that the layers of an [`Encoder`] keep; `full` is the image before halving.
struct Encoded<R> {
    normal: Normal<R>,
    residual: Residual<R>,
    full: Image<R>,
    places: Vec<usize>,
}

/// State that the layers of a [`UNet`] keep, and their intermediate images, named as in the diagram above.
pub(super) struct Trace<R> {
    depth: Image<R>,
    encoded_1: Encoded<R>,
    e1: Image<R>,
    encoded_2: Encoded<R>,
    e2: Image<R>,
    residual_1: Residual<R>,
    d1: Image<R>,
    gated: Gated<R>,
    joined: Image<R>,
    residual_2: Residual<R>,
    d2: Image<R>,
    windows: Windows<R>,
    features: Vec<R>,
    hidden: Vec<R>,
}

/// Outputs and gradients of a forward and a backward pass.
pub(super) struct Pass<R> {
    pub raw: [R; 9],
    /// Gradient of the weights, in their order.
    pub v_weights: Vec<R>,
    /// Gradient of the values of the depth map.
    pub v_depth: Option<Vec<R>>,
}

impl UNet {
    pub fn new(layout: &mut Layout, channels: usize, prior: [f64; 9]) -> Self {
        let c = channels;
        Self {
            channels,
            encoder_1: Encoder::new(layout, 1, c),
            encoder_2: Encoder::new(layout, c, 2 * c),
            up_1: UpConv::new(layout, 2 * c, c),
            decoder_1: SeResidual::new(layout, c),
            gate: AttentionGate::new(layout, c),
            up_2: UpConv::new(layout, c, c),
            decoder_2: SeResidual::new(layout, c),
            global: MeanConv::new(layout, c, 4 * c),
            middle: Linear::xavier(layout, 4 * c, 2 * c, 0.35),
            last: Linear::new(
                layout,
                2 * c,
                9,
                Init::Normal(0.05),
                Init::Values(prior.map(|number| number as f32).to_vec()),
            ),
        }
    }

    /// The unconstrained water parameters of a depth image [1,H,W].
    pub fn forward<R: Real>(&self, weights: &[R], depth: Image<R>) -> ([R; 9], Trace<R>) {
        let (e1, encoded_1) = self.encoder_1.forward(weights, &depth);
        let (e2, encoded_2) = self.encoder_2.forward(weights, &e1);
        let (d1, residual_1) = self.decoder_1.forward(weights, self.up_1.forward(weights, &e2));
        let (mut joined, gated) = self.gate.forward(weights, &d1, &e1);
        add(&mut joined.values, &d1.values);
        let (d2, residual_2) = self.decoder_2.forward(weights, self.up_2.forward(weights, &joined));
        let (features, windows) = self.global.forward(weights, &d2);
        let mut hidden = self.middle.forward(weights, &features);
        relu(&mut hidden);
        let numbers = self.last.forward(weights, &hidden);
        let raw = std::array::from_fn(|i| numbers[i]);
        let trace = Trace {
            depth,
            encoded_1,
            e1,
            encoded_2,
            e2,
            residual_1,
            d1,
            gated,
            joined,
            residual_2,
            d2,
            windows,
            features,
            hidden,
        };
        (raw, trace)
    }

    /// Returns the gradient of the depth image from that of the outputs; adds the gradient of the weights to
    /// `v_weights`.
    pub fn backward<R: Real>(
        &self,
        weights: &[R],
        trace: &Trace<R>,
        v_raw: [R; 9],
        v_weights: &mut [R],
    ) -> Image<R> {
        let t = trace;
        let mut v_hidden = self.last.backward(weights, &t.hidden, &v_raw, v_weights);
        relu_backward(&t.hidden, &mut v_hidden);
        let v_features = self.middle.backward(weights, &t.features, &v_hidden, v_weights);
        let v_d2 = self.global.backward(weights, &t.windows, &v_features, v_weights);
        let v = self.decoder_2.backward(weights, &t.residual_2, &t.d2, v_d2, v_weights);
        let v_joined = self.up_2.backward(weights, &t.joined, &v, v_weights);
        let (mut v_d1, mut v_e1) = self.gate.backward(weights, &t.d1, &t.e1, &t.gated, &v_joined, v_weights);
        add(&mut v_d1.values, &v_joined.values);
        let v = self.decoder_1.backward(weights, &t.residual_1, &t.d1, v_d1, v_weights);
        let v_e2 = self.up_1.backward(weights, &t.e2, &v, v_weights);
        let v = self.encoder_2.backward(weights, &t.e1, &t.encoded_2, &v_e2, v_weights);
        add(&mut v_e1.values, &v.values);
        self.encoder_1.backward(weights, &t.depth, &t.encoded_1, &v_e1, v_weights)
    }

    /// Forward and backward pass, with `v_raw` the gradient of the outputs; `values` are the values of
    /// `depth`.
    pub fn pass<R: Real>(
        &self,
        weights: &[R],
        depth: &DepthMap,
        values: &[R],
        v_raw: [R; 9],
        wants_depth: bool,
    ) -> Pass<R> {
        let (raw, trace) = self.forward(weights, image(depth, values));
        let mut v_weights = vec![R::default(); weights.len()];
        let mut v_depth = self.backward(weights, &trace, v_raw, &mut v_weights).values;
        // Empty or clipped values have no gradient.
        for (v, value) in v_depth.iter_mut().zip(depth.values()) {
            if !DepthMap::is_live(*value) {
                *v = R::default();
            }
        }
        Pass { raw, v_weights, v_depth: wants_depth.then_some(v_depth) }
    }
}

/// `values` as an image [1,H,W], in the layout of `depth`.
pub(super) fn image<R: Real>(depth: &DepthMap, values: &[R]) -> Image<R> {
    let (height, width) = (depth.height() as usize, depth.width() as usize);
    Image { channels: 1, height, width, values: values.to_vec() }
}

fn finite(raw: [f32; 9]) -> Result<[f32; 9]> {
    if raw.iter().all(|number| number.is_finite()) {
        return Ok(raw);
    }
    Err(CoreError::Network(format!("it has diverged ({raw:?}); lower its learning rate")))
}
