//! Central differences for the tests of every backward.
//!
//! Two central differences with steps H and H/2 are extrapolated (Richardson), so the error is of
//! order H^4 f^(5) + eps |f| / H. With H = 1e-4 and |f| near 1 the second term is 1e-12; sharper functions
//! (needles fall off within a pixel) make the first one the larger.

/// Step.
pub const H: f64 = 1e-4;
/// Relative error that is allowed. Measured over all scenes of the tests, the worst of a gradient that is not
/// small against its kind's largest is 1e-7 at this step; a wrong term shows at 1e-2 or more.
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
