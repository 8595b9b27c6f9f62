//! Water that acts on Gaussians (`water.medium = "per_gaussian"`).

#[cfg(feature = "gpu")]
mod device;

use super::Description;

#[cfg(feature = "gpu")]
pub use device::WaterOnGaussians;

pub(super) const DESCRIPTION: Description = Description {
    name: "water on Gaussians",
    is_on: |settings| settings.water.is_some_and(|(composition, _)| !composition.acts_on_pixels()),
    pixel_bytes: super::water_bytes,
    #[cfg(feature = "gpu")]
    start: |start| Ok(Box::new(WaterOnGaussians::new(super::water::StartedWater::new(start)?))),
};
