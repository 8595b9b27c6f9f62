//! The floor that a training step on a CPU adapter is related to: what rasterisation alone takes at these
//! rates, which a step of the trainer is measured against. Kernels may pass it. An evaluation is one splat at
//! one pixel.

/// Evaluations a CPU second, forward.
pub const FORWARD_RATE: f64 = 110e6;
/// Evaluations a CPU second, backward.
pub const BACKWARD_RATE: f64 = 169e6;

/// CPU seconds of both for so many evaluations in each.
pub fn floor_cpu_seconds(evaluations: f64) -> f64 {
    evaluations / FORWARD_RATE + evaluations / BACKWARD_RATE
}
