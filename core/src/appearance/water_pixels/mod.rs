//! Water that acts on pixels (`water.medium = "per_pixel"`).

#[cfg(feature = "gpu")]
mod device;

use super::Description;

#[cfg(feature = "gpu")]
pub use device::WaterOnPixels;

pub(super) const DESCRIPTION: Description = Description {
    name: "water on pixels",
    is_on: |settings| settings.water.is_some_and(|(composition, _)| composition.acts_on_pixels()),
    pixel_bytes: super::water_bytes,
    #[cfg(feature = "gpu")]
    start: |start| Ok(Box::new(WaterOnPixels::new(super::water::StartedWater::new(start)?))),
};
