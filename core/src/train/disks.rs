//! What the training of disks needs beside that of 3D Gaussians: normals, and their consistency with the
//! expected range (2DGS, Huang et al. 2024, eq. 14).

use crate::gpu::{Frame, FrameUniform, Gpu, NormalsUniform, Recorder, Size};
use crate::{CoreError, Result};

use super::DiskBuffers;

/// A pixel has a surface if its alpha and those of its neighbours are at least this. Fainter pixels are
/// blended from several distances, so that their expected range lies on none of them.
pub const LEAST_ALPHA: f32 = 0.5;

/// Buffers of picture size for disks.
pub struct DiskMaps {
    uniform: wgpu::Buffer,
    pixels: u64,
    v_normal: wgpu::Buffer,
    /// Zeros, unless the run has a water surface.
    v_mask: wgpu::Buffer,
    /// First the gradients of slopes, then what the backward pass needs of each pixel.
    v_pixels: wgpu::Buffer,
}

impl DiskMaps {
    /// Buffers without room for any picture.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            uniform: gpu.uniform("normals", &NormalsUniform::default()),
            pixels: 0,
            v_normal: gpu.buffer("gradient of normals", 16)?,
            v_mask: gpu.buffer("gradient of masks", 4)?,
            v_pixels: gpu.buffer("pixel gradients", 32)?,
        })
    }

    /// Makes room for pictures of `size`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        if pixels > self.pixels {
            self.v_normal = gpu.buffer("gradient of normals", 16 * pixels)?;
            self.v_mask = gpu.buffer("gradient of masks", 4 * pixels)?;
            self.v_pixels = gpu.buffer("pixel gradients", 32 * pixels)?;
            self.pixels = pixels;
        }
        Ok(())
    }

    /// For the backward pass.
    pub fn buffers(&self) -> DiskBuffers<'_> {
        DiskBuffers { v_normal: &self.v_normal, v_pixels: &self.v_pixels, v_mask: &self.v_mask }
    }

    /// Records the normal consistency with this weight per pixel. It sets the gradient of the normals, and
    /// adds to those of colour and alpha (`v_image`) and of range (`v_range`).
    ///
    /// # Errors
    /// When a kernel does not compile, or the frame is not one of disks.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        frame: &Frame,
        view: &FrameUniform,
        weight: f32,
        [v_image, v_range]: [&wgpu::Buffer; 2],
    ) -> Result<()> {
        if weight <= 0.0 {
            recorder.clear(&self.v_normal);
            return Ok(());
        }
        let targets = frame.targets()?;
        let Some(normal_image) = &targets.normal_image else {
            return Err(CoreError::Gpu("normals need a frame of disks".into()));
        };
        gpu.write(
            &self.uniform,
            0,
            &[NormalsUniform { weight, least_alpha: LEAST_ALPHA, ..NormalsUniform::default() }],
        );
        let pixels = Size::Items(view.size[0] * view.size[1], 64);
        let (uniform, image, range_image) =
            (("frame", &frame.uniform), ("image", &targets.image), ("range_image", &targets.range_image));
        let v_slopes = ("v_slopes", &self.v_pixels);
        recorder.dispatch(
            "normal_consistency",
            pixels,
            &[
                uniform,
                ("normals", &self.uniform),
                image,
                range_image,
                ("normal_image", normal_image),
                ("v_normal_image", &self.v_normal),
                v_slopes,
            ],
        )?;
        recorder.dispatch(
            "normal_consistency_backward",
            pixels,
            &[uniform, image, range_image, v_slopes, ("v_image", v_image), ("v_range_image", v_range)],
        )
    }
}
