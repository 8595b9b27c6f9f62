//! Helpers for the Adam steps of appearances: bias correction and learning-rate decay.

/// 1 / (1 - beta^t) for both moments after `steps` steps, from 1. It corrects the bias of moments that start
/// at 0.
pub(super) fn unbiasing(betas: [f64; 2], steps: u32) -> [f64; 2] {
    betas.map(|beta| 1.0 / (1.0 - beta.powf(f64::from(steps.max(1)))))
}

/// Interpolates from `start` to `end` by a constant factor per iteration (3DGS).
pub(crate) fn interpolate_log(start: f32, end: f32, share: f32) -> f32 {
    if start <= 0.0 || end <= 0.0 {
        return start + (end - start) * share;
    }
    let (start, end) = (f64::from(start).ln(), f64::from(end).ln());
    (start + (end - start) * f64::from(share)).exp() as f32
}
