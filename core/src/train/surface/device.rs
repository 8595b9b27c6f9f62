//! The water surface on the device: rays at it, the picture that it makes of three sets of disks, and its own
//! optimiser step.

use crate::gpu::{
    Blocks, Frame, Gpu, MaskLossUniform, Recorder, Size, SurfaceState, SurfaceStepUniform, SurfaceUniform,
};
use crate::{CoreError, Result};

/// Groups of 64 pixels that one row of partial sums stands for.
const GROUP: u64 = 64;

/// The frames of the three sets in one view.
#[derive(Clone, Copy)]
pub struct Frames<'a> {
    /// The scene above water, seen straight.
    pub straight: &'a Frame,
    /// Reflected.
    pub reflected: &'a Frame,
    /// Refracted.
    pub refracted: &'a Frame,
}

/// Gradients of the three sets, written by [`DeviceSurface::record_backward`].
#[derive(Clone, Copy)]
pub struct SetGradients<'a> {
    /// `[H*W]` vec4: with respect to the picture, then to the straight one.
    pub v_image: &'a wgpu::Buffer,
    /// `[H*W]`: with respect to the blended mask.
    pub v_mask: &'a wgpu::Buffer,
}

/// Buffers of picture size.
struct Maps {
    pixels: u64,
    picture: wgpu::Buffer,
    v_reflected: wgpu::Buffer,
    v_refracted: wgpu::Buffer,
    reflected_v: wgpu::Buffer,
    refracted_v: wgpu::Buffer,
    v_fresnel: wgpu::Buffer,
    partials: wgpu::Buffer,
}

/// The surface on the device.
pub struct DeviceSurface {
    plane: wgpu::Buffer,
    state: wgpu::Buffer,
    /// About which the plane turns, world axes.
    turns_about: [f32; 3],
    pivot: wgpu::Buffer,
    step: wgpu::Buffer,
    mask_loss: wgpu::Buffer,
    maps: Maps,
}

impl Maps {
    fn new(gpu: &Gpu, pixels: u64) -> Result<Self> {
        let of = |label, bytes: u64| gpu.buffer(label, bytes * pixels.max(1));
        Ok(Self {
            pixels,
            picture: of("picture of a water surface", 16)?,
            v_reflected: of("gradient of the reflected picture", 16)?,
            v_refracted: of("gradient of the refracted picture", 16)?,
            reflected_v: of("gradient of reflected rays", 32)?,
            refracted_v: of("gradient of refracted rays", 32)?,
            v_fresnel: of("gradient of the reflectance", 4)?,
            partials: gpu.buffer("gradients of the surface", 16 * pixels.div_ceil(GROUP).max(1))?,
        })
    }
}

impl DeviceSurface {
    /// The surface `plane`, which turns about `pivot` (world axes).
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(gpu: &Gpu, plane: SurfaceUniform, pivot: [f32; 3]) -> Result<Self> {
        let buffer = gpu.parameters("water surface", size_of::<SurfaceUniform>() as u64)?;
        gpu.write(&buffer, 0, &[plane]);
        Ok(Self {
            plane: buffer,
            state: gpu.buffer("moments of the surface", size_of::<SurfaceState>() as u64)?,
            turns_about: pivot,
            pivot: gpu.uniform("pivot", &[pivot[0], pivot[1], pivot[2], 0.0]),
            step: gpu.uniform("step of the surface", &SurfaceStepUniform::default()),
            mask_loss: gpu.uniform("mask loss", &MaskLossUniform::default()),
            maps: Maps::new(gpu, 1)?,
        })
    }

    /// `SurfaceUniform`, for frames of its rays.
    pub fn plane(&self) -> &wgpu::Buffer {
        &self.plane
    }

    /// The plane as it is now.
    ///
    /// # Errors
    /// When the device fails.
    pub fn read(&self, gpu: &Gpu) -> Result<SurfaceUniform> {
        let plane: Vec<SurfaceUniform> = gpu.read(&self.plane, 0, 1)?;
        plane.first().copied().ok_or_else(|| CoreError::Gpu("the water surface cannot be read".into()))
    }

    /// Skipped steps because a gradient was not finite.
    ///
    /// # Errors
    /// When the device fails.
    pub fn steps_left_out(&self, gpu: &Gpu) -> Result<u32> {
        let state: Vec<SurfaceState> = gpu.read(&self.state, 0, 1)?;
        Ok(state.first().map_or(0, |state| state.left_out as u32))
    }

    /// What outlives an iteration, with the number of bytes.
    pub fn arrays(&self) -> [(&wgpu::Buffer, usize); 2] {
        [(&self.plane, size_of::<SurfaceUniform>()), (&self.state, size_of::<SurfaceState>())]
    }

    /// Makes room for pictures of `size`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        if pixels > self.maps.pixels {
            self.maps = Maps::new(gpu, pixels)?;
        }
        Ok(())
    }

    /// `[H*W]` vec4: the picture of [`DeviceSurface::record_compose`].
    pub fn picture(&self) -> &wgpu::Buffer {
        &self.maps.picture
    }

    /// For the backward pass of the reflected and of the refracted set: gradients of their pixels, and where
    /// those of their rays go.
    pub fn traced(&self) -> [super::super::TracedBuffers<'_>; 2] {
        let maps = &self.maps;
        [(&maps.v_reflected, &maps.reflected_v), (&maps.v_refracted, &maps.refracted_v)]
            .map(|(v_pixels, v_rays)| super::super::TracedBuffers { v_pixels, v_rays: Some(v_rays) })
    }

    /// Records the rays at the surface, of pixels that the straight picture does not cover, and their tiles.
    ///
    /// # Errors
    /// When a kernel does not compile or a frame is not what it should be.
    pub fn record_rays(&self, recorder: &mut Recorder<'_>, frames: Frames<'_>, pixels: u32) -> Result<()> {
        let (reflected, refracted) = (rays_of(frames.reflected)?, rays_of(frames.refracted)?);
        let frame = ("frame", &frames.straight.uniform);
        recorder.dispatch(
            "surface_rays",
            Size::Items(pixels, 64),
            &[
                frame,
                ("surface", &self.plane),
                ("image", &frames.straight.targets()?.image),
                ("normal_image", masks_of(frames.straight)?),
                ("reflected_rays", reflected),
                ("refracted_rays", refracted),
            ],
        )?;
        for side in [frames.reflected, frames.refracted] {
            let Some(tile_rays) = &side.targets()?.tile_rays else { continue };
            let tiles = Size::Items((tile_rays.size() / 4) as u32, 64);
            let bound = [frame, ("rays", rays_of(side)?), ("tile_rays", tile_rays)];
            recorder.dispatch("surface_tiles", tiles, &bound)?;
        }
        Ok(())
    }

    /// Records the picture from those of the three sets.
    ///
    /// # Errors
    /// When a kernel does not compile or a frame is not what it should be.
    pub fn record_compose(&self, recorder: &mut Recorder<'_>, frames: Frames<'_>, pixels: u32) -> Result<()> {
        let mut bound = self.pictures(frames)?;
        bound.push(("picture", &self.maps.picture));
        recorder.dispatch("surface_compose", Size::Items(pixels, 64), &bound)
    }

    /// Records the gradients of the three pictures.
    ///
    /// # Errors
    /// When a kernel does not compile or a frame is not what it should be.
    pub fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        frames: Frames<'_>,
        pixels: u32,
        v: SetGradients<'_>,
    ) -> Result<()> {
        let mut bound = self.pictures(frames)?;
        bound.extend([
            ("v_image", v.v_image),
            ("v_mask_image", v.v_mask),
            ("v_reflected", &self.maps.v_reflected),
            ("v_refracted", &self.maps.v_refracted),
            ("v_fresnel", &self.maps.v_fresnel),
        ]);
        recorder.dispatch("surface_compose_backward", Size::Items(pixels, 64), &bound)
    }

    fn pictures<'a>(&'a self, frames: Frames<'a>) -> Result<Vec<(&'static str, &'a wgpu::Buffer)>> {
        Ok(vec![
            ("frame", &frames.straight.uniform),
            ("surface", &self.plane),
            ("image", &frames.straight.targets()?.image),
            ("normal_image", masks_of(frames.straight)?),
            ("reflected", &frames.reflected.targets()?.image),
            ("refracted", &frames.refracted.targets()?.image),
            ("refracted_rays", rays_of(frames.refracted)?),
        ])
    }

    /// Records the loss between the blended mask and the pseudo-mask of a view (WSGS eq. 15): it adds to the
    /// gradient of the mask.
    ///
    /// # Errors
    /// When a kernel does not compile or a frame is not what it should be.
    pub fn record_mask_loss(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        straight: &Frame,
        pixels: u32,
        bits: &wgpu::Buffer,
        loss: MaskLossUniform,
        v_mask: &wgpu::Buffer,
    ) -> Result<()> {
        gpu.write(&self.mask_loss, 0, &[loss]);
        recorder.dispatch(
            "surface_mask",
            Size::Items(pixels, 64),
            &[
                ("frame", &straight.uniform),
                ("mask_loss", &self.mask_loss),
                ("normal_image", masks_of(straight)?),
                ("bits", bits),
                ("v_mask_image", v_mask),
            ],
        )
    }

    /// Records the step of the plane, after the backward passes of the reflected and the refracted set.
    ///
    /// # Errors
    /// When a kernel does not compile or a frame is not what it should be.
    pub fn record_step(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        frames: Frames<'_>,
        pixels: u32,
        step: SurfaceStepUniform,
    ) -> Result<()> {
        let rows = u64::from(pixels).div_ceil(GROUP) as u32;
        gpu.write(&self.step, 0, &[SurfaceStepUniform { rows, pivot: self.turns_about, ..step }]);
        recorder.dispatch(
            "surface_gradients",
            Size::Items(pixels, 64),
            &[
                ("frame", &frames.straight.uniform),
                ("surface", &self.plane),
                ("pivot", &self.pivot),
                ("reflected_v", &self.maps.reflected_v),
                ("refracted_v", &self.maps.refracted_v),
                ("refracted_rays", rays_of(frames.refracted)?),
                ("v_fresnel", &self.maps.v_fresnel),
                ("partials", &self.maps.partials),
            ],
        )?;
        recorder.dispatch(
            "surface_step",
            Size::Groups(1),
            &[
                ("step", &self.step),
                ("counters", &frames.straight.counters),
                ("partials", &self.maps.partials),
                ("state", &self.state),
                ("plane", &self.plane),
            ],
        )
    }

    /// `[groups]` vec4: gradients of normal and offset, summed over 64 pixels; for tests.
    pub fn partials(&self) -> &wgpu::Buffer {
        &self.maps.partials
    }

    /// Records that disks of `blocks` below the surface become black and mostly masked.
    ///
    /// # Errors
    /// When a kernel does not compile.
    pub fn record_reset(&self, recorder: &mut Recorder<'_>, blocks: &Blocks) -> Result<()> {
        for (_, block, _) in blocks.trainable() {
            recorder.dispatch(
                "mask_reset",
                Size::Items(block.count, 64),
                &[
                    ("block", &block.uniform),
                    ("surface", &self.plane),
                    ("transforms", &block.transforms),
                    ("sh_coeffs", &block.sh_coeffs),
                ],
            )?;
        }
        Ok(())
    }
}

/// Records that none of the frames of a view takes a step if the lists of one were too short.
///
/// # Errors
/// When a kernel does not compile.
pub fn record_agreement(recorder: &mut Recorder<'_>, frames: Frames<'_>) -> Result<()> {
    let Frames { straight, reflected, refracted } = frames;
    recorder.dispatch(
        "agree",
        Size::Groups(1),
        &[
            ("frame", &straight.uniform),
            ("counters", &straight.counters),
            ("args", &straight.args),
            ("counters_b", &reflected.counters),
            ("args_b", &reflected.args),
            ("counters_c", &refracted.counters),
            ("args_c", &refracted.args),
        ],
    )
}

fn rays_of(frame: &Frame) -> Result<&wgpu::Buffer> {
    let rays = frame.targets()?.rays.as_ref();
    rays.ok_or_else(|| CoreError::Gpu("a frame has no rays at the water surface".into()))
}

fn masks_of(frame: &Frame) -> Result<&wgpu::Buffer> {
    let masks = frame.targets()?.normal_image.as_ref();
    masks.ok_or_else(|| CoreError::Gpu("masks need a frame of disks".into()))
}
