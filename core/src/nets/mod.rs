//! Small networks that see little data, on the CPU beside the GPU, each behind a narrow trait.
//!
//! Layers, their gradients and Adam are ours, in plain Rust (docs/decisions/0002 says why no framework):
//! every layer has a pass forward and one backward (`layers`), a network is their composition in order and in
//! reverse.
//!
//! The same weights, input and binary give the same bytes, whatever the number of rayon's threads: outputs
//! are shared out among them, never a sum (`products`; a test compares one thread with several).

mod attention;
mod depth_map;
mod layers;
mod parameters;
mod products;
mod water_param_predict;

pub use depth_map::{DepthMap, MAX_RANGE, RangeImage};
pub use water_param_predict::{RELEASE_PRIOR, WaterParamNet};

use crate::Result;

/// WaterParamPredict (SMP-UWGS section 3.2): nine numbers of a water from what a view sees of the scene's
/// ranges.
///
/// The nine are those before softplus and sigmoid, in the order of eq. 8: `Water::from_raw` makes a water of
/// them.
pub trait WaterParamPredictor: Send {
    /// The nine unconstrained numbers for one view; changes nothing.
    ///
    /// # Errors
    /// [`crate::CoreError::Network`] when the network has diverged.
    fn predict(&self, depth: &DepthMap) -> Result<[f32; 9]>;

    /// One step of Adam for one view. `v_raw` is the gradient of the loss with respect to the nine numbers
    /// that [`WaterParamPredictor::predict`] gave for it, now or a fixed number of iterations ago: the pass
    /// is made again, through the weights of now. `wants_depth` asks for the gradient with respect to the
    /// depth map as well.
    ///
    /// A gradient that is not finite, in `v_raw` or on the way, changes nothing; see [`Learned::stepped`].
    ///
    /// # Errors
    /// [`crate::CoreError::Network`] when `learning_rate` is no length of a step, or the network has
    /// diverged.
    fn learn(
        &mut self,
        depth: &DepthMap,
        v_raw: [f32; 9],
        learning_rate: f32,
        wants_depth: bool,
    ) -> Result<Learned>;

    /// Weights, moments and steps of Adam: with them a resumed run gives the bytes of an uninterrupted one.
    fn to_bytes(&self) -> Vec<u8>;

    /// Takes the state that `to_bytes` gave; on an error nothing has changed.
    ///
    /// # Errors
    /// [`crate::CoreError::Checkpoint`] when the bytes are torn, damaged, or of another network.
    fn restore(&mut self, bytes: &[u8]) -> Result<()>;
}

/// What a step of [`WaterParamPredictor::learn`] gives.
#[derive(Clone, Debug, PartialEq)]
pub struct Learned {
    /// The nine unconstrained numbers before the step.
    pub raw: [f32; 9],
    /// Gradient with respect to the values of the depth map, row-major; 0 where it has nothing or was cut
    /// off. There where it was asked for and the step was taken.
    pub v_depth: Option<Vec<f32>>,
    /// Whether the step was taken: false where a gradient was not finite. Nothing has changed then.
    pub stepped: bool,
}

#[cfg(test)]
mod tests;
