//! Pictures of a scene with a water surface, from any camera.

use std::sync::Arc;

use super::{
    Blocks, Drawing, Frame, FrameUniform, Gpu, Recorder, Rendered, Renderer, SurfaceRays, spatial_order,
};
use crate::gaussians::Gaussians;
use crate::scene::{PinholeCamera, Pose};
use crate::surface::{AIR, SurfaceModel};
use crate::train::surface::{DeviceSurface, Frames, record_agreement, uniform_of};
use crate::{CoreError, Result};

/// One set of disks.
struct Set {
    blocks: Blocks,
    frame: Frame,
    bands: u32,
}

/// What a picture of a scene with a water surface shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SurfaceOutput {
    /// What a camera sees.
    #[default]
    Wet,
    /// What the surface reflects, over all of it, at full strength.
    Reflected,
    /// What it refracts, at full strength.
    Refracted,
    /// The share of the light that it reflects, as grey; black where there is no surface.
    Reflectance,
    /// Where the scene above water is seen, as grey.
    Mask,
}

/// Renders one [`SurfaceModel`].
pub struct SurfaceRenderer {
    gpu: Arc<Gpu>,
    straight: Set,
    reflected: Set,
    refracted: Set,
    device: DeviceSurface,
}

impl Set {
    fn new(gpu: &Gpu, model: &Gaussians, masks: Option<&[f32]>) -> Result<Self> {
        let mut blocks = Blocks::new(gpu, model.sh_degree)?;
        let order = spatial_order(model);
        match masks {
            None => blocks.push_frozen(gpu, model, &order)?,
            Some(masks) => {
                let mut masked = model.clone();
                masked.log_scales.iter_mut().zip(masks).for_each(|(scales, mask)| scales[2] = *mask);
                blocks.push_frozen_as(gpu, &masked, model, &order)?;
            }
        }
        let count = model.len() as u32;
        let frame = Frame::new(gpu, count, count.clamp(1024, 65_536), count.clamp(4096, 262_144))?;
        Ok(Self { blocks, frame: frame.of_disks(gpu)?, bands: 1 })
    }

    fn at_surface(self, gpu: &Gpu, rays: SurfaceRays, device: &DeviceSurface) -> Result<Self> {
        Ok(Self { frame: self.frame.at_surface(gpu, rays, device.plane())?, ..self })
    }

    fn record(&mut self, gpu: &Gpu, recorder: &mut Recorder<'_>, view: &FrameUniform) -> Result<()> {
        let view = FrameUniform { sh_degree: u32::from(self.blocks.sh_degree()), ..*view };
        for band in view.bands(self.bands, gpu.tile()) {
            self.frame.record_forward(gpu, recorder, &self.blocks, &band)?;
            if self.bands > 1 {
                recorder.flush();
            }
        }
        Ok(())
    }
}

impl SurfaceRenderer {
    /// Uploads a model.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: Arc<Gpu>, model: &SurfaceModel) -> Result<Self> {
        let surface = model.record.surface();
        let pivot = (surface.offset * surface.normal).as_vec3().to_array();
        let device = DeviceSurface::new(&gpu, uniform_of(&model.record), pivot)?;
        let reflected = Set::new(&gpu, &model.reflected, None)?;
        let refracted = Set::new(&gpu, &model.refracted, None)?;
        Ok(Self {
            straight: Set::new(&gpu, &model.straight, Some(&model.masks))?,
            reflected: reflected.at_surface(&gpu, SurfaceRays::Reflected, &device)?,
            refracted: refracted.at_surface(&gpu, SurfaceRays::Refracted, &device)?,
            device,
            gpu,
        })
    }

    /// Renders a scene without its surface: [`SurfaceModel::dry`].
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn dry(gpu: Arc<Gpu>, model: &SurfaceModel) -> Result<Renderer> {
        Renderer::new(gpu, &model.dry())?.drawn(Drawing { disks: true, mip_filter: false })
    }

    /// Fills the basin with another liquid, by its refractive index.
    ///
    /// # Errors
    /// When the index is not above that of air, or the device fails.
    pub fn set_ior(&mut self, ior: f64) -> Result<()> {
        if !(ior.is_finite() && ior > AIR) {
            return Err(CoreError::Scene(format!(
                "the refractive index below the surface must be above that of air, {AIR}, but it is {ior}"
            )));
        }
        let mut plane = self.device.read(&self.gpu)?;
        plane.eta = (AIR / ior) as f32;
        self.gpu.write(self.device.plane(), 0, &[plane]);
        Ok(())
    }

    /// Renders over black what a camera sees. Range and alpha are those of the straight set.
    ///
    /// # Errors
    /// When the device fails, or cannot bind the lists of a single tile.
    pub fn render(&mut self, camera: &PinholeCamera, pose: &Pose) -> Result<Rendered> {
        self.render_as(camera, pose, SurfaceOutput::Wet)
    }

    /// The same, of part of it.
    ///
    /// # Errors
    /// As [`SurfaceRenderer::render`].
    pub fn render_as(
        &mut self,
        camera: &PinholeCamera,
        pose: &Pose,
        output: SurfaceOutput,
    ) -> Result<Rendered> {
        let gpu = Arc::clone(&self.gpu);
        let view = FrameUniform::of_camera(camera, pose, gpu.tile());
        let pixels = view.size[0] * view.size[1];
        loop {
            self.device.prepare(&gpu, view.size)?;
            for set in [&mut self.straight, &mut self.reflected, &mut self.refracted] {
                set.frame.prepare_targets(&gpu, view.size)?;
            }
            let mut recorder = Recorder::new(&gpu);
            self.straight.record(&gpu, &mut recorder, &view)?;
            self.device.record_rays(&mut recorder, self.frames(), pixels)?;
            self.reflected.record(&gpu, &mut recorder, &view)?;
            self.refracted.record(&gpu, &mut recorder, &view)?;
            record_agreement(&mut recorder, self.frames())?;
            self.device.record_compose(&mut recorder, self.frames(), pixels)?;
            recorder.submit();
            if !self.grow(&gpu, &view)? {
                break;
            }
        }
        self.read(camera, output)
    }

    fn frames(&self) -> Frames<'_> {
        Frames {
            straight: &self.straight.frame,
            reflected: &self.reflected.frame,
            refracted: &self.refracted.frame,
        }
    }

    /// Makes room where a list was too short; whether one was.
    fn grow(&mut self, gpu: &Gpu, view: &FrameUniform) -> Result<bool> {
        let mut any = false;
        for set in [&mut self.straight, &mut self.reflected, &mut self.refracted] {
            if let Some(overflow) = set.frame.overflow(gpu)? {
                any = true;
                if !overflow.fits(set.frame.limits()) {
                    let bands = view.band_count(set.bands);
                    set.bands = set.frame.limits().more_bands(overflow, bands, view.tile_count())?;
                }
                set.frame.grow(gpu, overflow)?;
            }
        }
        Ok(any)
    }

    fn read(&self, camera: &PinholeCamera, output: SurfaceOutput) -> Result<Rendered> {
        let pixels = camera.width as usize * camera.height as usize;
        let straight = self.straight.frame.targets()?;
        let four = |buffer: &wgpu::Buffer| self.gpu.read::<[f32; 4]>(buffer, 0, pixels);
        let grey = |value: f32| [value; 3];
        let rgb_of = |image: Vec<[f32; 4]>| image.iter().map(|p| [p[0], p[1], p[2]]).collect();
        let rgb: Vec<[f32; 3]> = match output {
            SurfaceOutput::Wet => rgb_of(four(self.device.picture())?),
            SurfaceOutput::Reflected => rgb_of(four(&self.reflected.frame.targets()?.image)?),
            SurfaceOutput::Refracted => rgb_of(four(&self.refracted.frame.targets()?.image)?),
            SurfaceOutput::Mask => match &straight.normal_image {
                Some(normals) => four(normals)?.iter().map(|normal| grey(normal[3])).collect(),
                None => vec![[0.0; 3]; pixels],
            },
            SurfaceOutput::Reflectance => match &self.refracted.frame.targets()?.rays {
                Some(rays) => self
                    .gpu
                    .read::<[f32; 8]>(rays, 0, pixels)?
                    .iter()
                    .map(|ray| grey(if ray[3] > 0.0 { ray[7] } else { 0.0 }))
                    .collect(),
                None => vec![[0.0; 3]; pixels],
            },
        };
        let image = four(&straight.image)?;
        Ok(Rendered {
            width: camera.width,
            height: camera.height,
            rgb,
            alpha: image.iter().map(|pixel| pixel[3]).collect(),
            range: self.gpu.read(&straight.range_image, 0, pixels)?,
        })
    }
}
