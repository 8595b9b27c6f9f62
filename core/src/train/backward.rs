//! The backward pass of a view and the optimiser step, in one piece or band by band.

use crate::appearance::chain::{Appearance, SplatGradients};
use crate::config::Moments;
use crate::gpu::{
    Block, BlockTraining, Blocks, Frame, FrameUniform, Gpu, Recorder, Size, SurfaceRays, counter,
};
use crate::memory;
use crate::{CoreError, Result};

/// Buffers of the backward pass besides those of the frame and the blocks.
#[derive(Clone, Copy)]
pub struct BackwardBuffers<'a> {
    /// `[H*W]` vec4: gradient of the loss with respect to rgb and alpha of the render.
    pub v_image: &'a wgpu::Buffer,
    /// `[H*W]`: gradient of the loss with respect to the range image.
    pub v_range: &'a wgpu::Buffer,
    /// `[intersections*3]` vec4: gradients of the splats in each tile; of disks `[intersections*5]`.
    pub slot_gradients: &'a wgpu::Buffer,
    /// Of a frame of disks that are seen from the eye.
    pub disks: Option<DiskBuffers<'a>>,
    /// Of a frame of disks that are seen at a water surface. Gradients of the picture are then those here.
    pub traced: Option<TracedBuffers<'a>>,
    /// `StepUniform`.
    pub step: &'a wgpu::Buffer,
    /// Appearances whose parameters move with the Gaussians.
    pub appearances: &'a [&'a dyn Appearance],
}

/// Buffers of the backward pass of disks.
#[derive(Clone, Copy)]
pub struct DiskBuffers<'a> {
    /// `[H*W]` vec4: gradient of the loss with respect to the blended normals.
    pub v_normal: &'a wgpu::Buffer,
    /// `[H*W*2]` vec4, written here: what the backward pass needs of each pixel.
    pub v_pixels: &'a wgpu::Buffer,
    /// `[H*W]`: gradient of the loss with respect to the blended masks.
    pub v_mask: &'a wgpu::Buffer,
}

/// Buffers of the backward pass of disks that are seen at a water surface.
#[derive(Clone, Copy)]
pub struct TracedBuffers<'a> {
    /// `[H*W]` vec4: gradient with respect to the blended colour, and its sum over all disks
    /// (`surface_compose_backward.wgsl`).
    pub v_pixels: &'a wgpu::Buffer,
    /// `[H*W*2]` vec4, written here: gradients of the origin and the direction of each ray. None for a
    /// surface that is not trained.
    pub v_rays: Option<&'a wgpu::Buffer>,
}

/// The kernel that takes the step of the Gaussians of `frame`.
fn step_kernel(frame: &Frame, kind: Moments, in_bands: bool) -> &'static str {
    let refracted = frame.rays() == Some(SurfaceRays::Refracted);
    match (frame.disks.is_some(), refracted, in_bands, kind) {
        (false, _, false, Moments::Compact) => "project_backward",
        (false, _, false, Moments::F32) => "project_backward_f32",
        (false, _, true, Moments::Compact) => "project_backward_bands",
        (false, _, true, Moments::F32) => "project_backward_bands_f32",
        (true, false, false, Moments::Compact) => "project_disks_backward",
        (true, false, false, Moments::F32) => "project_disks_backward_f32",
        (true, false, true, Moments::Compact) => "project_disks_backward_bands",
        (true, false, true, Moments::F32) => "project_disks_backward_bands_f32",
        (true, true, false, Moments::Compact) => "project_refracted_backward",
        (true, true, false, Moments::F32) => "project_refracted_backward_f32",
        (true, true, true, Moments::Compact) => "project_refracted_backward_bands",
        (true, true, true, Moments::F32) => "project_refracted_backward_bands_f32",
    }
}

/// Records the backward pass and the step of a view that [`Frame::record_forward`] rendered whole.
///
/// # Errors
/// When a kernel does not compile or the frame has no targets.
pub fn record_backward(
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    frame: &Frame,
    blocks: &Blocks,
    view: &FrameUniform,
    buffers: BackwardBuffers<'_>,
) -> Result<()> {
    record_rasterize(recorder, frame, view, buffers)?;
    let splats = SplatGradients { frame, blocks, slots: buffers.slot_gradients, in_bands: false };
    for appearance in buffers.appearances {
        appearance.record_gradients(gpu, recorder, splats)?;
    }
    for (index, block, training) in blocks.trainable() {
        let kernel = step_kernel(frame, training.kind, false);
        let groups = Size::Indirect(&frame.args, counter::ARGS_BLOCK + index as u32);
        let sources = [
            ("gaussian_from_visible", &frame.gaussian_from_visible),
            ("segments", &frame.segments),
            ("slot_gradients", buffers.slot_gradients),
        ];
        record_step(recorder, kernel, groups, frame, block, training, &sources, buffers.step)?;
    }
    buffers.appearances.iter().try_for_each(|appearance| appearance.record_step(recorder, frame))
}

/// Records the backward pass and the step of a view that was rendered in these bands. Gives the same bytes as
/// a single band.
///
/// For each band the lists are rebuilt, and those of disks ordered by a forward pass. Its gradients are added
/// to those of the earlier bands, per Gaussian. The step follows after the last band. Each band is a
/// submission, because all bands use one uniform buffer.
///
/// # Errors
/// When a kernel does not compile, the frame has no targets, or the device cannot hold the sums.
pub fn record_backward_in_bands(
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    frame: &Frame,
    blocks: &Blocks,
    view: &FrameUniform,
    bands: &[FrameUniform],
    buffers: BackwardBuffers<'_>,
) -> Result<()> {
    let row_bytes = memory::slot_bytes(frame.disks.is_some());
    for (_, block, training) in blocks.trainable() {
        recorder.clear(training.band_gradients(gpu, block.capacity, row_bytes)?);
    }
    for band in bands {
        if frame.disks.is_some() {
            // Moves the disks that are needed to the front of their lists.
            frame.record_forward(gpu, recorder, blocks, band)?;
        } else {
            frame.record_lists(gpu, recorder, blocks, band)?;
        }
        record_rasterize(recorder, frame, band, buffers)?;
        for (index, block, training) in blocks.trainable() {
            recorder.dispatch(
                if frame.disks.is_some() { "add_disk_band_gradients" } else { "add_band_gradients" },
                Size::Indirect(&frame.args, counter::ARGS_BLOCK + index as u32),
                &[
                    ("frame", &frame.uniform),
                    ("block", &block.uniform),
                    ("counters", &frame.counters),
                    ("flags", &frame.flags),
                    ("gaussian_from_visible", &frame.gaussian_from_visible),
                    ("segments", &frame.segments),
                    ("slot_gradients", buffers.slot_gradients),
                    ("band_gradients", training.band_gradients(gpu, block.capacity, row_bytes)?),
                ],
            )?;
        }
        recorder.flush();
    }
    // Weights and rates depend on how many Gaussians the whole view sees.
    frame.record_visibility(gpu, recorder, blocks, view)?;
    let splats = SplatGradients { frame, blocks, slots: buffers.slot_gradients, in_bands: true };
    for appearance in buffers.appearances {
        appearance.record_gradients(gpu, recorder, splats)?;
    }
    for (_, block, training) in blocks.trainable() {
        let kernel = step_kernel(frame, training.kind, true);
        let sources = [("band_gradients", training.band_gradients(gpu, block.capacity, row_bytes)?)];
        let groups = Size::Items(block.count, 64);
        record_step(recorder, kernel, groups, frame, block, training, &sources, buffers.step)?;
    }
    for appearance in buffers.appearances {
        appearance.record_step(recorder, frame)?;
    }
    recorder.flush();
    Ok(())
}

fn record_rasterize(
    recorder: &mut Recorder<'_>,
    frame: &Frame,
    band: &FrameUniform,
    buffers: BackwardBuffers<'_>,
) -> Result<()> {
    let targets = frame.targets()?;
    if let Some(traced) = buffers.traced {
        return record_trace(recorder, frame, band, buffers, traced);
    }
    if let Some(disks) = buffers.disks {
        return record_rasterize_disks(recorder, frame, band, buffers, disks);
    }
    recorder.dispatch(
        "rasterize_backward",
        Size::Groups(band.end_tile - band.first_tile),
        &[
            ("frame", &frame.uniform),
            ("projected", &frame.projected),
            ("slots", frame.sorted_slots(band.tile_count())),
            ("visible_from_slot", &frame.visible_from_slot),
            ("ranges", &targets.ranges),
            ("tile_ends", &targets.tile_ends),
            ("image", &targets.image),
            ("range_image", &targets.range_image),
            ("v_image", buffers.v_image),
            ("v_range_image", buffers.v_range),
            ("slot_gradients", buffers.slot_gradients),
        ],
    )
}

fn record_rasterize_disks(
    recorder: &mut Recorder<'_>,
    frame: &Frame,
    band: &FrameUniform,
    buffers: BackwardBuffers<'_>,
    of_disks: DiskBuffers<'_>,
) -> Result<()> {
    let targets = frame.targets()?;
    let (Some(disks), Some(normal_image)) = (&frame.disks, &targets.normal_image) else {
        return Err(CoreError::Gpu("the backward pass of disks needs a frame of disks".into()));
    };
    recorder.dispatch(
        "gather_pixel_gradients",
        Size::Items(band.size[0] * band.size[1], 64),
        &[
            ("frame", &frame.uniform),
            ("image", &targets.image),
            ("range_image", &targets.range_image),
            ("normal_image", normal_image),
            ("v_image", buffers.v_image),
            ("v_range_image", buffers.v_range),
            ("v_normal_image", of_disks.v_normal),
            ("v_mask_image", of_disks.v_mask),
            ("v_pixels", of_disks.v_pixels),
        ],
    )?;
    recorder.dispatch(
        "rasterize_disks_backward",
        Size::Groups(band.end_tile - band.first_tile),
        &[
            ("frame", &frame.uniform),
            ("projected", &frame.projected),
            ("disks", disks),
            ("slots", frame.sorted_slots(band.tile_count())),
            ("visible_from_slot", &frame.visible_from_slot),
            ("ranges", &targets.ranges),
            ("tile_ends", &targets.tile_ends),
            ("v_pixels", of_disks.v_pixels),
            ("v_mask_image", of_disks.v_mask),
            ("slot_gradients", buffers.slot_gradients),
        ],
    )
}

fn record_trace(
    recorder: &mut Recorder<'_>,
    frame: &Frame,
    band: &FrameUniform,
    buffers: BackwardBuffers<'_>,
    traced: TracedBuffers<'_>,
) -> Result<()> {
    let targets = frame.targets()?;
    let (Some(disks), Some(rays)) = (&frame.disks, &targets.rays) else {
        return Err(CoreError::Gpu("rays at a water surface need a frame of them".into()));
    };
    let mut bound = vec![
        ("frame", &frame.uniform),
        ("projected", &frame.projected),
        ("disks", disks),
        ("slots", frame.sorted_slots(band.tile_count())),
        ("visible_from_slot", &frame.visible_from_slot),
        ("ranges", &targets.ranges),
        ("tile_ends", &targets.tile_ends),
        ("v_pixels", traced.v_pixels),
        ("rays", rays),
        ("slot_gradients", buffers.slot_gradients),
    ];
    bound.extend(traced.v_rays.map(|v_rays| ("v_rays", v_rays)));
    let kernel = match (frame.rays(), traced.v_rays.is_some()) {
        (Some(SurfaceRays::Reflected), false) => "trace_reflected_backward",
        (Some(SurfaceRays::Reflected), true) => "trace_reflected_moving_backward",
        (_, false) => "trace_refracted_backward",
        (_, true) => "trace_refracted_moving_backward",
    };
    recorder.dispatch(kernel, Size::Groups(band.end_tile - band.first_tile), &bound)
}

fn record_step(
    recorder: &mut Recorder<'_>,
    kernel: &'static str,
    groups: Size<'_>,
    frame: &Frame,
    block: &Block,
    training: &BlockTraining,
    sources: &[(&str, &wgpu::Buffer)],
    step: &wgpu::Buffer,
) -> Result<()> {
    let mut bound = vec![
        ("frame", &frame.uniform),
        ("block", &block.uniform),
        ("step", step),
        ("counters", &frame.counters),
        ("flags", &frame.flags),
        ("transforms", &block.transforms),
        ("sh_coeffs", &block.sh_coeffs),
        ("moments", &training.moments),
        ("sh_moments", &training.sh_moments),
        ("density_sums", &training.density_sums),
        ("water", &frame.water),
    ];
    bound.extend_from_slice(sources);
    bound.extend(frame.bound_refraction());
    recorder.dispatch(kernel, groups, &bound)
}
