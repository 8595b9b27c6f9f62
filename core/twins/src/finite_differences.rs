//! Central differences for the tests of every backward pass.
//!
//! Two central differences with steps H and H/2 are extrapolated (Richardson). The error is of order H^4
//! f^(5) + eps |f| / H. With H = 1e-4 and |f| near 1, the second term is 1e-12. The first term is larger for
//! sharp functions, such as needles that fall off within a pixel.

/// The wider of the two steps.
pub const H: f64 = 1e-4;
/// Allowed relative error. Over all test scenes, the worst measured error is 1e-7 at this step, without
/// gradients that are small against the largest of their kind. A wrong term causes 1e-2 or more.
pub const RELATIVE: f64 = 1e-6;

/// d f(h) / dh at 0.
pub fn derivative(mut f: impl FnMut(f64) -> f64) -> f64 {
    let wide = (f(H) - f(-H)) / (2.0 * H);
    let narrow = (f(0.5 * H) - f(-0.5 * H)) / H;
    (4.0 * narrow - wide) / 3.0
}

/// Fails unless both agree within `RELATIVE` of the larger one or of `scale`. Below that size, a gradient of
/// this quantity is only rounding error of the function's value.
#[track_caller]
pub fn assert_close(what: &str, analytic: f64, numeric: f64, scale: f64) {
    let tolerance = RELATIVE * analytic.abs().max(numeric.abs()).max(scale);
    assert!(
        (analytic - numeric).abs() <= tolerance,
        "{what}: analytic {analytic:e}, central difference {numeric:e}, tolerance {tolerance:e}"
    );
}
