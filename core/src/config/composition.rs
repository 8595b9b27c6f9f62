//! How water and blending are combined: one type for the valid pairs of `water.medium` and `water.blend`.

use super::{Blend, Medium, WaterConfig};
use crate::{CoreError, Result};

/// Where the water acts, and in which light Gaussians are blended.
///
/// The configuration and `water.json` have two keys for this, and not every pair of values is valid. They are
/// decoded only here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Composition {
    /// On each Gaussian, in linear light. The resulting colour is then encoded and blended in sRGB.
    GaussiansSrgb,
    /// On each Gaussian, whose colours are blended in linear light.
    GaussiansLinear,
    /// On each pixel, after blending in sRGB; open water is behind everything.
    PixelsSrgb,
    /// On each pixel, after blending in linear light; open water is behind everything.
    PixelsLinear,
    /// On each pixel, after blending in sRGB over black: nothing is behind the Gaussians.
    PixelsOverBlack,
}

impl Composition {
    /// Every composition.
    pub const ALL: [Self; 5] = [
        Self::GaussiansSrgb,
        Self::GaussiansLinear,
        Self::PixelsSrgb,
        Self::PixelsLinear,
        Self::PixelsOverBlack,
    ];

    /// The composition of a pair of keys; `None` without a medium.
    ///
    /// # Errors
    /// [`CoreError::Config`] for an invalid pair.
    pub fn of(medium: Medium, blend: Blend) -> Result<Option<Self>> {
        Ok(Some(match (medium, blend) {
            (Medium::None, _) => return Ok(None),
            (Medium::PerGaussian, Blend::Srgb) => Self::GaussiansSrgb,
            (Medium::PerGaussian, Blend::Linear) => Self::GaussiansLinear,
            (Medium::PerPixel, Blend::Srgb) => Self::PixelsSrgb,
            (Medium::PerPixel, Blend::Linear) => Self::PixelsLinear,
            (Medium::PerPixel, Blend::OverBlack) => Self::PixelsOverBlack,
            (Medium::PerGaussian, Blend::OverBlack) => {
                let message = "water.blend = \"over_black\" needs water.medium = \"per_pixel\"";
                return Err(CoreError::Config(message.to_owned()));
            }
        }))
    }

    /// The key `medium`.
    pub fn medium(self) -> Medium {
        if self.acts_on_pixels() { Medium::PerPixel } else { Medium::PerGaussian }
    }

    /// The key `blend`.
    pub fn blend(self) -> Blend {
        match self {
            Self::GaussiansSrgb | Self::PixelsSrgb => Blend::Srgb,
            Self::GaussiansLinear | Self::PixelsLinear => Blend::Linear,
            Self::PixelsOverBlack => Blend::OverBlack,
        }
    }

    /// Whether the water acts on the blended picture; otherwise it acts on each Gaussian.
    pub fn acts_on_pixels(self) -> bool {
        matches!(self, Self::PixelsSrgb | Self::PixelsLinear | Self::PixelsOverBlack)
    }

    /// Whether Gaussians are blended in linear light, so that viewers show colours other than J.
    pub fn blends_in_linear_light(self) -> bool {
        self.blend() == Blend::Linear
    }
}

impl WaterConfig {
    /// How water and blending are combined; `None` without a medium.
    ///
    /// # Errors
    /// [`CoreError::Config`] for an invalid pair of `water.medium` and `water.blend`.
    /// A validated configuration has a valid pair.
    pub fn composition(&self) -> Result<Option<Composition>> {
        Composition::of(self.medium, self.blend)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_composition_is_restored_from_its_keys() {
        for composition in Composition::ALL {
            let keys = (composition.medium(), composition.blend());
            assert_eq!(Composition::of(keys.0, keys.1).unwrap(), Some(composition), "{keys:?}");
        }
    }

    #[test]
    fn invalid_pair_of_keys_is_refused() {
        for blend in [Blend::Srgb, Blend::Linear, Blend::OverBlack] {
            assert_eq!(Composition::of(Medium::None, blend).unwrap(), None);
        }
        let error = Composition::of(Medium::PerGaussian, Blend::OverBlack).unwrap_err().to_string();
        assert!(error.contains("per_pixel"), "{error}");
    }
}
