//! View embeddings of a run under water (`water.film`).

#[cfg(feature = "gpu")]
mod device;

use super::{Description, PICTURE_BYTES};

#[cfg(feature = "gpu")]
pub use device::{FILM_UNITS, Film, FilmEmbedding, FilmStep};

pub(super) const DESCRIPTION: Description = Description {
    name: "film",
    is_on: |settings| settings.water.is_some_and(|(_, water)| water.film.on),
    pixel_bytes: |_| PICTURE_BYTES,
    #[cfg(feature = "gpu")]
    start: device::start,
};
