//! Small networks for small amounts of data, on the CPU in parallel with the GPU, each behind a narrow trait.
//!
//! Layers, gradients and Adam are our own, in plain Rust (docs/decisions/0002 says why there is no
//! framework). Every layer has a forward and a backward pass (`layers`). A network composes them in order and
//! in reverse.
//!
//! The same weights, input and binary give the same bytes with any number of rayon threads. Threads share
//! outputs, but never a sum (`products`; a test compares one thread with several).

mod attention;
mod depth_map;
mod layers;
mod parameters;
mod products;
mod water_param_predict;

pub use depth_map::{DepthMap, MAX_RANGE, RangeImage};
pub use water_param_predict::{RELEASE_PRIOR, WaterParamNet};

use crate::Result;

/// WaterParamPredict (SMP-UWGS section 3.2) predicts the water parameters from the ranges that a view sees.
///
/// The nine values are those before softplus and sigmoid, in the order of eq. 8; `Water::from_raw` converts
/// them to a water.
pub trait WaterParamPredictor: Send {
    /// The unconstrained water parameters for one view; changes nothing.
    ///
    /// # Errors
    /// [`crate::CoreError::Network`] when the network has diverged.
    fn predict(&self, depth: &DepthMap) -> Result<[f32; 9]>;

    /// One step of Adam for one view. `v_raw` is the gradient of the loss with respect to the values that
    /// [`WaterParamPredictor::predict`] returned for it, now or a fixed number of iterations ago. The forward
    /// pass is repeated with the current weights. `wants_depth` also requests the gradient with respect to
    /// the depth map.
    ///
    /// A non-finite gradient, in `v_raw` or in any layer, changes nothing; see [`Learned::stepped`].
    ///
    /// # Errors
    /// [`crate::CoreError::Network`] when `learning_rate` is negative or not finite, or the network has
    /// diverged.
    fn learn(
        &mut self,
        depth: &DepthMap,
        v_raw: [f32; 9],
        learning_rate: f32,
        wants_depth: bool,
    ) -> Result<Learned>;

    /// Weights, moments and steps of Adam: a run resumed from them gives the same bytes as an uninterrupted
    /// one.
    fn to_bytes(&self) -> Vec<u8>;

    /// Restores the state from `to_bytes`; nothing changes on an error.
    ///
    /// # Errors
    /// [`crate::CoreError::Checkpoint`] when the bytes are truncated, damaged, or from another network.
    fn restore(&mut self, bytes: &[u8]) -> Result<()>;
}

/// The result of [`WaterParamPredictor::learn`].
#[derive(Clone, Debug, PartialEq)]
pub struct Learned {
    /// The unconstrained water parameters before the step.
    pub raw: [f32; 9],
    /// Gradient with respect to the values of the depth map, row-major; 0 where the map is empty or clipped.
    /// `None` if it was not requested or the step was skipped.
    pub v_depth: Option<Vec<f32>>,
    /// Whether the step was taken. It is skipped if a gradient is not finite; nothing changes then.
    pub stepped: bool,
}

#[cfg(test)]
mod tests;
