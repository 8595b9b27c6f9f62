//! A reference for training steps on a CPU adapter: the time of rasterisation alone at these rates. Kernels
//! may be faster. An evaluation is one splat at one pixel.

/// Evaluations a CPU second, forward.
pub const FORWARD_RATE: f64 = 110e6;
/// Evaluations a CPU second, backward.
pub const BACKWARD_RATE: f64 = 169e6;

/// CPU seconds of both passes with this many evaluations in each.
pub fn floor_cpu_seconds(evaluations: f64) -> f64 {
    evaluations / FORWARD_RATE + evaluations / BACKWARD_RATE
}
