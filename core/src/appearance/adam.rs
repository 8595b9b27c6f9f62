//! Adam of appearances: what its stages are given besides gradients.

/// 1 / (1 - beta^t) of both memories after `steps` steps, from 1: moments start at 0, and are too small by as
/// much.
pub(super) fn unbiasing(betas: [f64; 2], steps: u32) -> [f64; 2] {
    betas.map(|beta| 1.0 / (1.0 - beta.powf(f64::from(steps.max(1)))))
}

/// From `start` to `end` with a constant factor an iteration (3DGS).
pub(crate) fn interpolate_log(start: f32, end: f32, share: f32) -> f32 {
    if start <= 0.0 || end <= 0.0 {
        return start + (end - start) * share;
    }
    let (start, end) = (f64::from(start).ln(), f64::from(end).ln());
    (start + (end - start) * f64::from(share)).exp() as f32
}
