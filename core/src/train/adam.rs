//! What stages that step by Adam are told of its memories.

/// 1 / (1 - beta^t) of both memories after `steps` steps, from 1: moments start at 0, and are too small by as much.
pub(super) fn unbiasing(betas: [f64; 2], steps: u32) -> [f64; 2] {
    betas.map(|beta| 1.0 / (1.0 - beta.powf(f64::from(steps.max(1)))))
}
