//! The twins and the metrics against independent implementations: gsplat, torchmetrics, scikit-image.
//!
//! All other tests of the twins compare them with their own differences or with code of this repository. An
//! error in the model (a sign of a harmonic, a factor in a conic, a missing derivative) could therefore be in
//! both. Here the numbers come from other projects: scripts beside this file recorded them in
//! `expectations/`. README.md explains how to record them again, what is compared, and where conventions
//! differ.

#![expect(clippy::unwrap_used, reason = "a test may stop at what it did not expect")]

mod expectations;
mod metrics;
mod spherical_harmonics;
mod splatting;
