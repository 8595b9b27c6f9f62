//! Central differences for the tests of every backward.
//!
//! Two central differences with steps H and H/2 are extrapolated (Richardson), so the error is of
//! order H^4 f^(5) + eps |f| / H. With H = 1e-4 and values near 1 that is 1e-16 f^(5) + 1e-12.

/// Step.
pub const H: f64 = 1e-4;
/// Relative error that is allowed: f^(5) H^4 / 480 for the sharpest scenes here (a mean moves its splat by
/// some 50 px per unit, a needle falls off within a pixel: f^(5) / f' up to 1e8 or so) stays below.
pub const RELATIVE: f64 = 1e-6;

/// d f(h) / dh at 0.
pub fn derivative(mut f: impl FnMut(f64) -> f64) -> f64 {
    let wide = (f(H) - f(-H)) / (2.0 * H);
    let narrow = (f(0.5 * H) - f(-0.5 * H)) / H;
    (4.0 * narrow - wide) / 3.0
}

/// Fails unless both agree within `RELATIVE` of the larger one or of `scale`, the size below which a
/// gradient of this quantity is rounding of the function's value.
#[track_caller]
pub fn assert_close(what: &str, analytic: f64, numeric: f64, scale: f64) {
    let tolerance = RELATIVE * analytic.abs().max(numeric.abs()).max(scale);
    assert!(
        (analytic - numeric).abs() <= tolerance,
        "{what}: analytic {analytic:e}, central difference {numeric:e}, tolerance {tolerance:e}"
    );
}
