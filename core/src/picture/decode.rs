//! Decodes picture files strictly: damaged or unusual files give an error that names the photograph.

use std::io::Cursor;

use image::DynamicImage;

use super::colour::{LINEAR_OF_8, LINEAR_OF_16};
use super::header::{Format, UNKNOWN_FORMAT, check_jpeg_end, dimensions_of};
use crate::config::MaskKeep;
use crate::{CoreError, Result};

/// A decoded photograph with its mask, before undistortion.
pub(super) struct Photo {
    image: DynamicImage,
    /// Whether each pixel counts; `None` if all do.
    keep: Option<Vec<bool>>,
}

impl Photo {
    /// Decodes a photograph whose size must be `expected` (columns, rows).
    pub fn decode(name: &str, bytes: &[u8], expected: (u32, u32)) -> Result<Self> {
        let image = decode(name, bytes, |size| size_mismatch(size, expected))?;
        use image::ColorType::{L8, L16, La8, La16, Rgb8, Rgb16, Rgba8, Rgba16};
        if !matches!(image.color(), L8 | La8 | Rgb8 | Rgba8 | L16 | La16 | Rgb16 | Rgba16) {
            let kind = image.color();
            return Err(CoreError::input(
                name,
                format!("has samples of the kind {kind:?}; export it with 8 or 16 bits a channel"),
            ));
        }
        Ok(Self { image, keep: None })
    }

    /// Applies a mask to the photograph. A mask of another size but the same aspect ratio is stretched to it.
    pub fn apply_mask(&mut self, name: &str, bytes: &[u8], keep: MaskKeep) -> Result<()> {
        let (width, height) = self.size();
        let mask = decode(name, bytes, |size| mask_mismatch(size, (width, height)))?.into_luma8();
        let (mask_width, mask_height) = mask.dimensions();
        let nearest =
            |at: u32, from: u32, to: u32| (u64::from(at) * 2 + 1) * u64::from(to) / (u64::from(from) * 2);
        let columns: Vec<u32> = (0..width).map(|x| nearest(x, width, mask_width) as u32).collect();
        let mut flags = Vec::with_capacity(width as usize * height as usize);
        for y in 0..height {
            let row = nearest(y, height, mask_height) as u32;
            flags.extend(columns.iter().map(|x| {
                let white = mask.get_pixel(*x, row).0[0] >= 128;
                white == (keep == MaskKeep::White)
            }));
        }
        self.keep = Some(flags);
        Ok(())
    }

    pub fn size(&self) -> (u32, u32) {
        (self.image.width(), self.image.height())
    }

    /// Linear RGB and 1 if the pixel counts; all 0 if its mask or its transparency leaves it out.
    pub fn linear(&self, x: usize, y: usize) -> [f32; 4] {
        let at = y * self.image.width() as usize + x;
        if self.keep.as_ref().is_some_and(|keep| !keep[at]) {
            return [0.0; 4];
        }
        let lut8 = |code: u8| LINEAR_OF_8[usize::from(code)];
        let lut16 = |code: u16| LINEAR_OF_16[usize::from(code)];
        match &self.image {
            DynamicImage::ImageLuma8(image) => grey(lut8(image.as_raw()[at])),
            DynamicImage::ImageLumaA8(image) => {
                let [value, alpha] = array(&image.as_raw()[at * 2..]);
                opaque(alpha >= 128, grey(lut8(value)))
            }
            DynamicImage::ImageRgb8(image) => {
                let [r, g, b] = array(&image.as_raw()[at * 3..]);
                [lut8(r), lut8(g), lut8(b), 1.0]
            }
            DynamicImage::ImageRgba8(image) => {
                let [r, g, b, alpha] = array(&image.as_raw()[at * 4..]);
                opaque(alpha >= 128, [lut8(r), lut8(g), lut8(b), 1.0])
            }
            DynamicImage::ImageLuma16(image) => grey(lut16(image.as_raw()[at])),
            DynamicImage::ImageLumaA16(image) => {
                let [value, alpha] = array(&image.as_raw()[at * 2..]);
                opaque(alpha >= 32_768, grey(lut16(value)))
            }
            DynamicImage::ImageRgb16(image) => {
                let [r, g, b] = array(&image.as_raw()[at * 3..]);
                [lut16(r), lut16(g), lut16(b), 1.0]
            }
            DynamicImage::ImageRgba16(image) => {
                let [r, g, b, alpha] = array(&image.as_raw()[at * 4..]);
                opaque(alpha >= 32_768, [lut16(r), lut16(g), lut16(b), 1.0])
            }
            // `decode` refuses all other kinds.
            _ => [0.0; 4],
        }
    }
}

fn opaque(opaque: bool, pixel: [f32; 4]) -> [f32; 4] {
    if opaque { pixel } else { [0.0; 4] }
}

fn grey(value: f32) -> [f32; 4] {
    [value, value, value, 1.0]
}

fn array<T: Copy, const N: usize>(samples: &[T]) -> [T; N] {
    std::array::from_fn(|index| samples[index])
}

/// Decodes PNG, JPEG or TIFF. `mismatch` checks the size before anything is allocated.
fn decode(
    name: &str,
    bytes: &[u8],
    mismatch: impl FnOnce((u32, u32)) -> Option<String>,
) -> Result<DynamicImage> {
    let refuse = |message: String| CoreError::input(name, message);
    let size = dimensions_of(&mut Cursor::new(bytes)).map_err(refuse)?;
    if let Some(message) = mismatch(size) {
        return Err(refuse(message));
    }
    let format = match Format::of(bytes) {
        Some(Format::Png) => image::ImageFormat::Png,
        Some(Format::Jpeg) => {
            check_jpeg_end(bytes).map_err(refuse)?;
            image::ImageFormat::Jpeg
        }
        Some(Format::Tiff) => image::ImageFormat::Tiff,
        None => return Err(refuse(UNKNOWN_FORMAT.to_owned())),
    };
    let mut reader = image::ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    // Four 16-bit channels twice (the picture and the decoder's buffers), and a margin for small pictures.
    limits.max_alloc = Some(u64::from(size.0) * u64::from(size.1) * 16 + (64 << 20));
    reader.limits(limits);
    reader.decode().map_err(|error| {
        refuse(format!("the picture cannot be decoded: {error}; copy it again or export it anew"))
    })
}

/// The message for a picture of size `found` whose camera has size `expected`; `None` if they are equal.
pub(crate) fn size_mismatch(found: (u32, u32), expected: (u32, u32)) -> Option<String> {
    if found == expected {
        return None;
    }
    let ((width, height), (camera_width, camera_height)) = (found, expected);
    let help = if (height, width) == expected {
        "the pixels are stored rotated (EXIF orientation): rotate them, or run the reconstruction on the files \
         as they are stored"
    } else {
        "use the pictures that the cameras were computed from, or the model that belongs to these pictures"
    };
    Some(format!("the picture is {width}x{height}, but its camera is {camera_width}x{camera_height}; {help}"))
}

/// The message for a mask of size `found` that does not fit a photograph of size `photograph`; `None` if it
/// fits.
fn mask_mismatch(found: (u32, u32), photograph: (u32, u32)) -> Option<String> {
    // Masks often have a rounded fraction of the size; one percent covers the rounding.
    const SHAPE_TOLERANCE: f64 = 0.01;
    // A larger mask cannot belong to this photograph, and decoding it could exhaust the memory.
    const MAX_SCALE: f64 = 4.0;
    let scale = [(found.0, photograph.0), (found.1, photograph.1)]
        .map(|(mask, picture)| f64::from(mask) / f64::from(picture));
    let fits = (scale[0] / scale[1] - 1.0).abs() <= SHAPE_TOLERANCE && scale[0] <= MAX_SCALE;
    if fits {
        return None;
    }
    Some(format!(
        "the mask is {}x{}, but its photograph is {}x{}; masks belong to the photographs before undistortion and \
         must have their shape",
        found.0, found.1, photograph.0, photograph.1
    ))
}
