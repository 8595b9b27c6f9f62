//! A flat water surface between cameras in air and a scene below it: where it is, and what it does to light.
//!
//! The surface is the plane `normal . x = offset` (WSGS eq. 7) with the normal into the air. A ray that meets
//! it splits into a reflected and a refracted ray ([`optics`]). [`surface_prior`] finds the plane from the
//! tracks of structure from motion, before any training, and sorts the sparse points into wet and dry ones.

mod model;
pub mod optics;
mod prior;
mod record;

pub use crate::config::SurfaceStart;
pub use model::SurfaceModel;
pub use optics::{AIR, Surface, WATER};
pub use prior::{SurfaceError, SurfaceOptions, SurfacePrior, SurfaceStandardErrors, WetPoint, surface_prior};
pub use record::{SurfaceRecord, SurfaceSource};

#[cfg(test)]
mod tests;
