//! The trainer of Fathom: scenes, models, pictures, GPU kernels and training.
//!
//! No network and no async here: a caller passes views and Gaussians and gets Gaussians back. Everything that
//! needs a GPU is behind the feature `gpu`; a coordinator alone builds without it.

pub mod appearance;
pub mod axes;
pub mod config;
pub mod cover;
pub mod duration;
mod error;
pub mod exchange;
pub mod floaters;

pub mod gaussians;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod harmonics;
pub mod linear_colours;
pub mod memory;
#[cfg(feature = "gpu")]
pub mod method;
pub mod metrics;
pub mod nets;
pub mod paths;
pub mod picture;
pub mod ply;
pub mod rng;
pub mod scene;
pub mod seams;
pub mod surface;
pub mod synth;
#[cfg(feature = "gpu")]
pub mod train;
#[cfg(feature = "gpu")]
pub mod viewer_colours;
pub mod views;
pub mod water;
pub mod white_point;

pub use error::{CoreError, Result};
