//! Rendering of one model from any camera.

use std::sync::Arc;

use super::layout::FrameUniform;
use super::{Blocks, Frame, Gpu, ListLimits, Recorder, spatial_order};
use crate::Result;
use crate::gaussians::Gaussians;
use crate::scene::{PinholeCamera, Pose};

/// A rendered view. Arrays are row-major from the top left.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colour over the background, as trained (sRGB for `3dgs`), unclamped.
    pub rgb: Vec<[f32; 3]>,
    /// 1 - transmittance left.
    pub alpha: Vec<f32>,
    /// Sum of weight times distance along the ray, scene units; divide by alpha for the expected range.
    pub range: Vec<f32>,
}

/// Renders one model from any camera.
pub struct Renderer {
    gpu: Arc<Gpu>,
    blocks: Blocks,
    frame: Frame,
}

impl Renderer {
    /// Uploads a model.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: Arc<Gpu>, model: &Gaussians) -> Result<Self> {
        let mut blocks = Blocks::new(&gpu, model.sh_degree)?;
        blocks.push_frozen(&gpu, model, &spatial_order(model))?;
        let count = model.len() as u32;
        let frame = Frame::new(&gpu, count, count.clamp(1024, 65_536), count.clamp(4096, 262_144))?;
        Ok(Self { gpu, blocks, frame })
    }

    /// Renders over `background`.
    ///
    /// # Errors
    /// When the device fails or the picture is larger than it can bind.
    pub fn render(&mut self, camera: &PinholeCamera, pose: &Pose, background: [f32; 3]) -> Result<Rendered> {
        let view = FrameUniform {
            background,
            sh_degree: u32::from(self.blocks.sh_degree()),
            ..FrameUniform::of_camera(camera, pose, self.gpu.tile())
        };
        // A list that was too short says what it needed: it grows as far as the device can bind it, then the view is cut.
        let mut bands = 1;
        loop {
            self.frame.prepare_targets(&self.gpu, view.size)?;
            for band in view.bands(bands, self.gpu.tile()) {
                let mut recorder = Recorder::new(&self.gpu);
                self.frame.record_forward(&self.gpu, &mut recorder, &self.blocks, &band)?;
                recorder.submit();
            }
            let Some(overflow) = self.frame.overflow(&self.gpu)? else { return self.read(camera) };
            if !overflow.fits(self.frame.limits()) {
                bands = self.frame.limits().more_bands(overflow, bands, view.tile_count())?;
            }
            self.frame = self.frame.grown(&self.gpu, overflow)?;
        }
    }

    /// Renders with lists no longer than these, in as many bands as it takes: tests.
    #[must_use]
    pub fn with_list_limits(mut self, limits: ListLimits) -> Self {
        self.frame = self.frame.with_limits(limits);
        self
    }

    fn read(&self, camera: &PinholeCamera) -> Result<Rendered> {
        let targets = self.frame.targets()?;
        let pixels = camera.width as usize * camera.height as usize;
        let image: Vec<[f32; 4]> = self.gpu.read(&targets.image, 0, pixels)?;
        let range = self.gpu.read(&targets.range_image, 0, pixels)?;
        Ok(Rendered {
            width: camera.width,
            height: camera.height,
            rgb: image.iter().map(|p| [p[0], p[1], p[2]]).collect(),
            alpha: image.iter().map(|p| p[3]).collect(),
            range,
        })
    }
}
