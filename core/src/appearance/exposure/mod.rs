//! Exposures of the training views (`train.exposure`).

#[cfg(feature = "gpu")]
mod device;

use super::{Description, PICTURE_BYTES};

#[cfg(feature = "gpu")]
pub use device::{ExposureStep, Exposures};

pub(super) const DESCRIPTION: Description = Description {
    name: "exposure",
    is_on: |settings| settings.train.exposure,
    pixel_bytes: |_| PICTURE_BYTES,
    #[cfg(feature = "gpu")]
    start: |start| Ok(Box::new(Exposures::new(start.gpu, start.views)?.with_rates(start.settings.train))),
};
