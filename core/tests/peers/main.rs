//! The twins and the metrics against independent implementations: gsplat, torchmetrics, scikit-image.
//!
//! Every other test of the twins compares them with differences of themselves or with code of this
//! repository, so an error in the model (a sign of a harmonic, a factor in a conic, what is held fixed) could
//! stand in both. Here the numbers come from elsewhere: scripts beside this file recorded them into
//! `expectations/`. README.md says how to make them again, what is compared, and where conventions differ.

#![expect(clippy::unwrap_used, reason = "a test may stop at what it did not expect")]

mod expectations;
mod metrics;
mod spherical_harmonics;
mod splatting;
