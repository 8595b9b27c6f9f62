//! A photograph on the device, with the ray map of its view if there is one.

use super::Gpu;
use crate::Result;
use crate::views::{PackedImage, RayMap};

/// A photograph on the device.
#[derive(Clone, Debug)]
pub struct DevicePhotograph {
    /// `[H*W]` u32, see [`PackedImage`].
    pub pixels: wgpu::Buffer,
    /// Columns and rows.
    pub size: [u32; 2],
    /// Whether any pixel is masked.
    pub masked: bool,
    /// What the rays of the view hit, if known.
    pub map: Option<DeviceMap>,
}

/// A [`RayMap`] on the device.
#[derive(Clone, Debug)]
pub struct DeviceMap {
    /// Columns and rows of its cells.
    pub size: [u32; 2],
    /// [`RayMap::alike`].
    pub alike: f32,
    /// `[rows*columns]` u32.
    pub cells: wgpu::Buffer,
}

impl DevicePhotograph {
    /// Uploads a photograph.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: &Gpu, image: &PackedImage) -> Result<Self> {
        let pixels = gpu.streamed("photograph", 4 * image.pixels.len() as u64)?;
        gpu.write(&pixels, 0, &image.pixels);
        // A write that failed for lack of memory must not leave a black photograph.
        gpu.check()?;
        let masked = image.pixels.iter().any(|pixel| pixel >> 24 != 255);
        Ok(Self { pixels, size: [image.width, image.height], masked, map: None })
    }

    /// The same with a map of what the rays of the view hit.
    pub(crate) fn with_map(mut self, gpu: &Gpu, map: Option<&RayMap>) -> Result<Self> {
        if let Some(map) = map.filter(|map| !map.cells.is_empty()) {
            let buffer = gpu.streamed("map", 4 * map.cells.len() as u64)?;
            gpu.write(&buffer, 0, &map.packed());
            gpu.check()?;
            self.map = Some(DeviceMap { size: [map.columns, map.rows], alike: map.alike, cells: buffer });
        }
        Ok(self)
    }
}
