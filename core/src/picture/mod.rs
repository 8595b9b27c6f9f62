//! Prepares photographs for training: decodes, undistorts, masks, reduces and packs them.
//!
//! Everything works on bytes, because a worker has blobs and no paths; names are for messages. Pixels are
//! only mixed in linear light. Results do not depend on threads: equal input bytes give equal output bytes.

mod colour;
mod decode;
mod header;
mod npy;
mod resample;
mod tiff;

use image::ImageEncoder;

pub use colour::{linear_to_srgb, srgb_slope, srgb_to_linear};
pub(crate) use decode::size_mismatch;
pub use header::{dimensions, dimensions_of_complete};
pub use npy::encode_npy;

use crate::config::MaskKeep;
use crate::scene::{Camera, PinholeCamera};
use crate::views::PackedImage;
use crate::{CoreError, Result};
use decode::Photo;
use resample::{Undistorted, reduce};

/// A photograph before preparation.
#[derive(Clone, Copy, Debug)]
pub struct Photograph<'a> {
    /// Its name, for messages.
    pub name: &'a str,
    /// The bytes of its PNG, JPEG or TIFF file.
    pub image: &'a [u8],
    /// The bytes of its mask, which has the same aspect ratio.
    pub mask: Option<&'a [u8]>,
}

/// The camera of the pixels that [`prepare`] returns, computed without a picture.
///
/// # Errors
/// When Fathom cannot undistort the camera model.
pub fn prepared_camera(camera: &Camera, max_resolution: u32) -> Result<PinholeCamera> {
    Ok(camera.pinhole()?.fitted(max_resolution))
}

/// Decodes, undistorts, masks and reduces a photograph so that its longest side is at most `max_resolution`.
///
/// Transparent pixels (alpha below one half) never count; `mask_keep` says whether the white or the black
/// pixels of a mask file count.
///
/// # Errors
/// When the camera model cannot be undistorted, or when a file is damaged, has an unknown format or another
/// size than its camera; the message names the photograph.
pub fn prepare(
    photograph: &Photograph<'_>,
    camera: &Camera,
    mask_keep: MaskKeep,
    max_resolution: u32,
) -> Result<(PinholeCamera, PackedImage)> {
    let undistortion = camera.undistortion()?;
    let mut photo = Photo::decode(photograph.name, photograph.image, (camera.width, camera.height))?;
    if let Some(mask) = photograph.mask {
        photo.apply_mask(&format!("mask of {}", photograph.name), mask, mask_keep)?;
    }
    let pinhole = undistortion.pinhole().fitted(max_resolution);
    let image = if undistortion.is_identity() {
        reduce(&photo, pinhole.width, pinhole.height)
    } else {
        reduce(&Undistorted { photo: &photo, undistortion }, pinhole.width, pinhole.height)
    };
    Ok((pinhole, image))
}

/// The size of [`half`]: each side halved, rounded down, at least 1.
///
/// The camera of the result is [`PinholeCamera::resized`] to this size, for odd sides too.
pub fn half_size(width: u32, height: u32) -> (u32, u32) {
    ((width / 2).max(1), (height / 2).max(1))
}

/// The picture at [`half_size`], averaged in linear light over the pixels that count.
pub fn half(image: &PackedImage) -> PackedImage {
    let (width, height) = half_size(image.width, image.height);
    reduce(image, width, height)
}

impl PackedImage {
    /// From 8-bit RGB; every pixel counts. `rgb` has `width * height * 3` entries.
    pub fn from_rgb8(width: u32, height: u32, rgb: &[u8]) -> Self {
        let pixels = rgb.chunks_exact(3).map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect();
        Self { width, height, pixels }
    }

    /// 8-bit RGB, three bytes a pixel; masked pixels keep their stored colour.
    pub fn to_rgb8(&self) -> Vec<u8> {
        self.pixels
            .iter()
            .flat_map(|pixel| {
                let [r, g, b, _] = pixel.to_le_bytes();
                [r, g, b]
            })
            .collect()
    }

    /// The share of pixels that count, 0 to 1.
    pub fn kept_share(&self) -> f64 {
        let kept = self.pixels.iter().filter(|pixel| pixel.to_le_bytes()[3] == 255).count();
        kept as f64 / self.pixels.len().max(1) as f64
    }
}

/// A PNG of 8-bit RGB pixels, three bytes each.
///
/// # Errors
/// When `rgb` does not have `width * height * 3` bytes.
pub fn encode_png(width: u32, height: u32, rgb: &[u8]) -> Result<Vec<u8>> {
    encode(width, height, rgb, image::ExtendedColorType::Rgb8)
}

/// A JPEG of 8-bit RGB pixels, three bytes each, for previews.
///
/// # Errors
/// When `rgb` does not have `width * height * 3` bytes.
pub fn encode_jpeg(width: u32, height: u32, rgb: &[u8]) -> Result<Vec<u8>> {
    const QUALITY: u8 = 85;
    check_size("JPEG", width, height, rgb, image::ExtendedColorType::Rgb8)?;
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .write_image(rgb, width, height, image::ExtendedColorType::Rgb8)
        .map_err(|error| CoreError::Scene(format!("a JPEG of {width}x{height} pixels: {error}")))?;
    Ok(jpeg)
}

/// A PNG of 8-bit grey pixels, one byte each.
///
/// # Errors
/// When `grey` does not have `width * height` bytes.
pub fn encode_grey_png(width: u32, height: u32, grey: &[u8]) -> Result<Vec<u8>> {
    encode(width, height, grey, image::ExtendedColorType::L8)
}

fn check_size(
    format: &str,
    width: u32,
    height: u32,
    pixels: &[u8],
    colour: image::ExtendedColorType,
) -> Result<()> {
    let expected = u64::from(width) * u64::from(height) * u64::from(colour.channel_count());
    if pixels.len() as u64 == expected {
        return Ok(());
    }
    Err(CoreError::Scene(format!(
        "a {format} of {width}x{height} pixels needs {expected} bytes, but {} were given",
        pixels.len()
    )))
}

fn encode(width: u32, height: u32, pixels: &[u8], colour: image::ExtendedColorType) -> Result<Vec<u8>> {
    check_size("PNG", width, height, pixels, colour)?;
    let mut png = Vec::new();
    image::codecs::png::PngEncoder::new(&mut png)
        .write_image(pixels, width, height, colour)
        .map_err(|error| CoreError::Scene(format!("a PNG of {width}x{height} pixels: {error}")))?;
    Ok(png)
}

#[cfg(test)]
mod tests;
