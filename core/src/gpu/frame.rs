//! The lists of one view and the recording of the forward pass.
//!
//! cull -> scan -> count_visible -> project_forward -> depth sort -> intersect_count -> scan ->
//! count_intersections -> intersect_emit -> tile sort -> tile_ranges -> rasterize_forward.
//! The host reads no count back within an iteration: sizes are passed on as indirect dispatches. A list that
//! is too short sets a sticky bit (see `count_visible.wgsl`), which the host checks later. A view whose lists
//! would exceed the largest binding is rendered in bands of tiles, one after the other.

use super::layout::{DEPTH_BITS, FrameUniform, WaterUniform, counter};
use super::{Block, Blocks, Gpu, ListLimits, Overflow, Recorder, Scan, Size, Sort};
use crate::water::Water;
use crate::{CoreError, Result};

/// The rays of a frame of disks that do not come from the eye.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SurfaceRays {
    /// Reflected by a water surface: they see the disks above it.
    Reflected,
    /// Refracted by it: they see the disks below.
    Refracted,
}

/// Buffers whose size depends on the image.
pub struct FrameTargets {
    /// `[H*W]` vec4: rgb, alpha.
    pub image: wgpu::Buffer,
    /// `[H*W]`. Not written for rays at a water surface.
    pub range_image: wgpu::Buffer,
    /// `[H*W]` vec4 of a frame of disks that are seen from the eye: blended normal, camera axes, towards the
    /// camera.
    pub normal_image: Option<wgpu::Buffer>,
    /// `[H*W*2]` vec4 of a frame of rays at a water surface (`surface_rays.wgsl`).
    pub rays: Option<wgpu::Buffer>,
    /// `[tiles]` of such a frame: which tiles have a ray (`surface_tiles.wgsl`).
    pub tile_rays: Option<wgpu::Buffer>,
    /// `[tiles+1]` first and last of the sorted intersections.
    pub ranges: wgpu::Buffer,
    /// `[tiles]`.
    pub tile_ends: wgpu::Buffer,
    pixels: u64,
    tiles: u64,
}

/// The lists of one view.
pub struct Frame {
    /// `FrameUniform` of the recorded iteration.
    pub uniform: wgpu::Buffer,
    /// `WaterUniform` of the water between camera and scene; read if [`FrameUniform::medium`] is set.
    pub water: wgpu::Buffer,
    /// See [`counter`].
    pub counters: wgpu::Buffer,
    /// Indirect arguments.
    pub args: wgpu::Buffer,
    /// `[gaussians]`; after the forward pass: number of visible Gaussians before each.
    pub flags: wgpu::Buffer,
    /// `[visible*3]` vec4.
    pub projected: wgpu::Buffer,
    /// `[visible*3]` vec4 of a frame of disks: disks in the camera's frame ([`Frame::of_disks`]).
    pub disks: Option<wgpu::Buffer>,
    /// `SurfaceUniform` of a frame of rays at a water surface, and which rays they are.
    pub surface: Option<(SurfaceRays, wgpu::Buffer)>,
    /// `[visible]`.
    pub gaussian_from_visible: wgpu::Buffer,
    /// `[visible]` (first slot, count).
    pub segments: wgpu::Buffer,
    /// `[intersections]`.
    pub visible_from_slot: wgpu::Buffer,
    visible_capacity: u32,
    intersect_capacity: u32,
    gaussian_capacity: u32,
    limits: ListLimits,
    /// Replaces `density_sums` in frozen blocks: one row of zeros, no smoothing.
    no_density_sums: wgpu::Buffer,
    offsets: wgpu::Buffer,
    flag_scan: Scan,
    offset_scan: Scan,
    depth_sort: Sort,
    tile_sort: Sort,
    targets: Option<FrameTargets>,
}

const MAX_BLOCK_ARGS: u32 = 256;

impl Frame {
    /// Lists with room for `visible` Gaussians and `intersections`.
    ///
    /// # Errors
    /// [`CoreError::BufferTooLarge`] when the device cannot bind them.
    pub fn new(gpu: &Gpu, gaussians: u32, visible: u32, intersections: u32) -> Result<Self> {
        let gaussians = gaussians.max(1);
        let words =
            |label, count: u32, words: u32| gpu.buffer(label, u64::from(count) * u64::from(words) * 4);
        Ok(Self {
            uniform: gpu.uniform("frame", &FrameUniform::default()),
            water: gpu.parameters("water", size_of::<WaterUniform>() as u64)?,
            counters: words("counters", counter::COUNT, 1)?,
            args: words("indirect arguments", counter::ARGS_BLOCK + MAX_BLOCK_ARGS, 3)?,
            flags: words("visible flags", gaussians, 1)?,
            projected: words("projected", visible, 12)?,
            disks: None,
            surface: None,
            gaussian_from_visible: words("gaussian_from_visible", visible, 1)?,
            segments: words("segments", visible, 2)?,
            visible_from_slot: words("visible_from_slot", intersections, 1)?,
            no_density_sums: words("no density sums", 4, 1)?,
            offsets: words("intersect offsets", visible, 1)?,
            flag_scan: Scan::new(gpu, counter::GAUSSIANS, gaussians)?,
            offset_scan: Scan::new(gpu, counter::VISIBLE, visible)?,
            depth_sort: Sort::new(gpu, counter::VISIBLE, counter::DEPTH_HISTOGRAM, visible, DEPTH_BITS)?,
            tile_sort: Sort::new(gpu, counter::INTERSECTIONS, counter::TILE_HISTOGRAM, intersections, 32)?,
            visible_capacity: visible,
            intersect_capacity: intersections,
            gaussian_capacity: gaussians,
            limits: ListLimits::of(gpu),
            targets: None,
        })
    }

    /// The same for 2D Gaussians: disks, whose third scale is not used.
    ///
    /// # Errors
    /// When the device cannot hold 48 more bytes for each visible one.
    pub fn of_disks(mut self, gpu: &Gpu) -> Result<Self> {
        self.disks = Some(gpu.buffer("disks", u64::from(self.visible_capacity) * 48)?);
        self.limits = ListLimits::of_rows(gpu, true);
        self.targets = None;
        Ok(self)
    }

    /// The same for rays at a water surface, of a frame of disks.
    ///
    /// # Errors
    /// When the device fails.
    pub fn at_surface(mut self, gpu: &Gpu, rays: SurfaceRays, surface: &wgpu::Buffer) -> Result<Self> {
        // The view is mirrored on the device.
        self.uniform = gpu.parameters("frame", size_of::<FrameUniform>() as u64)?;
        self.surface = Some((rays, surface.clone()));
        self.targets = None;
        Ok(self)
    }

    /// The rays of the frame, if they begin at a water surface.
    pub fn rays(&self) -> Option<SurfaceRays> {
        self.surface.as_ref().map(|(rays, _)| *rays)
    }

    /// The surface, for kernels that need it.
    pub(crate) fn bound_surface(&self) -> Option<(&'static str, &wgpu::Buffer)> {
        self.surface.as_ref().map(|(_, surface)| ("surface", surface))
    }

    /// The same, for kernels that only refraction concerns.
    pub(crate) fn bound_refraction(&self) -> Option<(&'static str, &wgpu::Buffer)> {
        self.bound_surface().filter(|_| self.rays() == Some(SurfaceRays::Refracted))
    }

    /// Capacities: visible Gaussians and intersections.
    pub fn capacities(&self) -> (u32, u32) {
        (self.visible_capacity, self.intersect_capacity)
    }

    /// Maximum lengths of the lists; see [`Frame::with_limits`].
    pub fn limits(&self) -> ListLimits {
        self.limits
    }

    /// The same with tighter limits than those of the device, for tests.
    #[must_use]
    pub fn with_limits(mut self, limits: ListLimits) -> Self {
        self.limits = limits;
        self
    }

    /// Puts this water between camera and scene, for views whose [`FrameUniform::medium`] is set.
    pub fn set_water(&self, gpu: &Gpu, water: &Water) {
        self.set_water_uniform(gpu, WaterUniform::from(water));
    }

    /// As [`Frame::set_water`], with all parameters of a water on the device.
    pub fn set_water_uniform(&self, gpu: &Gpu, water: WaterUniform) {
        gpu.write(&self.water, 0, &[water]);
    }

    /// Sets the water parameters only; their dependence on range and direction stays.
    pub fn set_water_parameters(&self, gpu: &Gpu, water: &Water) {
        for (row, values) in [water.beta_d, water.beta_b, water.b_inf].into_iter().enumerate() {
            gpu.write(&self.water, 16 * row as u64, &values.map(|value| value as f32));
        }
    }

    /// Capacity in Gaussians.
    pub fn gaussian_capacity(&self) -> u32 {
        self.gaussian_capacity
    }

    /// Bytes of the per-visible lists and of the per-intersection lists.
    pub fn bytes(&self) -> (u64, u64) {
        (
            self.projected.size()
                + self.disks.as_ref().map_or(0, wgpu::Buffer::size)
                + self.gaussian_from_visible.size()
                + self.segments.size()
                + self.offsets.size()
                + self.depth_sort.bytes(),
            self.visible_from_slot.size() + self.tile_sort.bytes(),
        )
    }

    /// Buffers that a forward pass must write before it reads them. Tests fill them with garbage first.
    pub fn scratch(&self) -> Vec<&wgpu::Buffer> {
        let mut buffers = vec![
            &self.args,
            &self.flags,
            &self.projected,
            &self.gaussian_from_visible,
            &self.segments,
            &self.visible_from_slot,
            &self.offsets,
            self.flag_scan.sums(),
            self.offset_scan.sums(),
        ];
        for sort in [&self.depth_sort, &self.tile_sort] {
            buffers.extend(sort.scratch());
        }
        buffers.extend(&self.disks);
        if let Some(targets) = &self.targets {
            buffers.extend(&targets.normal_image);
            buffers.extend(targets.rays.iter().chain(&targets.tile_rays));
            buffers.extend([&targets.image, &targets.range_image, &targets.ranges, &targets.tile_ends]);
        }
        buffers
    }

    /// The slots sorted by tile, after the forward pass of an image with `tiles` tiles. In the list of a
    /// tile, disks that the backward pass needs come first.
    pub fn sorted_slots(&self, tiles: u32) -> &wgpu::Buffer {
        &self.tile_sort.values[Sort::result(tile_bits(tiles))]
    }

    /// Visible ids by depth rank, front to back, after the forward pass.
    pub fn depth_order(&self) -> &wgpu::Buffer {
        &self.depth_sort.values[Sort::result(DEPTH_BITS)]
    }

    /// The tile of each of [`Frame::sorted_slots`].
    pub fn sorted_tiles(&self, tiles: u32) -> &wgpu::Buffer {
        &self.tile_sort.keys[Sort::result(tile_bits(tiles))]
    }

    /// Makes targets for an image of the given size, or keeps those that are large enough.
    ///
    /// # Errors
    /// When the device cannot bind them.
    pub fn prepare_targets(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        let tiles = u64::from(size[0].div_ceil(gpu.tile())) * u64::from(size[1].div_ceil(gpu.tile()));
        let (have_pixels, have_tiles) = self.targets.as_ref().map_or((0, 0), |t| (t.pixels, t.tiles));
        if self.targets.is_some() && have_pixels >= pixels && have_tiles >= tiles {
            return Ok(());
        }
        // Of two image shapes, one may need more pixels and the other more tiles.
        let (pixels, tiles) = (pixels.max(have_pixels), tiles.max(have_tiles));
        self.targets = None;
        self.targets = Some(FrameTargets {
            image: gpu.buffer("image", pixels * 16)?,
            range_image: gpu.buffer("range image", pixels * 4)?,
            normal_image: match (&self.disks, &self.surface) {
                (Some(_), None) => Some(gpu.buffer("normal image", pixels * 16)?),
                _ => None,
            },
            rays: match &self.surface {
                Some(_) => Some(gpu.buffer("rays at the surface", pixels * 32)?),
                None => None,
            },
            tile_rays: match &self.surface {
                Some(_) => Some(gpu.buffer("tiles with rays at the surface", tiles * 4)?),
                None => None,
            },
            ranges: gpu.buffer("tile ranges", (tiles + 1) * 8)?,
            tile_ends: gpu.buffer("tile ends", tiles * 4)?,
            pixels,
            tiles,
        });
        Ok(())
    }

    /// The targets that [`Frame::prepare_targets`] made.
    ///
    /// # Errors
    /// When it was not called.
    pub fn targets(&self) -> Result<&FrameTargets> {
        self.targets
            .as_ref()
            .ok_or_else(|| CoreError::Gpu("a frame was recorded before its targets were made".into()))
    }

    /// Records the forward pass of one view, or of the band that `view` selects. This fills in the counts and
    /// capacities of `view`.
    ///
    /// # Errors
    /// When a kernel does not compile or targets are missing.
    pub fn record_forward(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        blocks: &Blocks,
        view: &FrameUniform,
    ) -> Result<()> {
        self.record_lists(gpu, recorder, blocks, view)?;
        let targets = self.targets()?;
        let mut bound = vec![
            ("frame", &self.uniform),
            ("projected", &self.projected),
            ("slots", self.sorted_slots(view.tile_count())),
            ("visible_from_slot", &self.visible_from_slot),
            ("ranges", &targets.ranges),
            ("image", &targets.image),
            ("tile_ends", &targets.tile_ends),
        ];
        bound.extend(self.disks.iter().map(|disks| ("disks", disks)));
        match &targets.rays {
            Some(rays) => bound.push(("rays", rays)),
            None => bound.push(("range_image", &targets.range_image)),
        }
        bound.extend(targets.normal_image.iter().map(|image| ("normal_image", image)));
        let kernel = match (&self.disks, self.rays()) {
            (None, _) => "rasterize_forward",
            (Some(_), None) => "rasterize_disks",
            (Some(_), Some(SurfaceRays::Reflected)) => "trace_reflected",
            (Some(_), Some(SurfaceRays::Refracted)) => "trace_refracted",
        };
        recorder.dispatch(kernel, Size::Groups(view.end_tile - view.first_tile), &bound)
    }

    /// Records the visibility test of a view: flags and counters only, so no list can overflow.
    ///
    /// # Errors
    /// When a kernel does not compile.
    pub fn record_visibility(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        blocks: &Blocks,
        view: &FrameUniform,
    ) -> Result<()> {
        self.record_cull(gpu, recorder, blocks, &FrameUniform { visible_capacity: u32::MAX, ..*view })
    }

    /// Records the kernels up to the number of visible Gaussians, within the capacities of `view`.
    fn record_cull(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        blocks: &Blocks,
        view: &FrameUniform,
    ) -> Result<()> {
        let total = blocks.total();
        let uniform = FrameUniform { gaussians: total, blocks: blocks.iter().len() as u32, ..*view };
        gpu.write(&self.uniform, 0, &[uniform]);
        gpu.write(&self.counters, 0, &[total]);
        let (frame, counters) = (("frame", &self.uniform), ("counters", &self.counters));
        let cull = match (&self.disks, self.rays()) {
            (None, _) => "cull",
            (Some(_), None) => "cull_disks",
            (Some(_), Some(SurfaceRays::Reflected)) => "cull_reflected",
            (Some(_), Some(SurfaceRays::Refracted)) => "cull_refracted",
        };
        if let Some((SurfaceRays::Reflected, surface)) = &self.surface {
            let bound = [("surface", surface), ("view", &self.uniform)];
            recorder.dispatch("mirror_view", Size::Groups(1), &bound)?;
        }
        for block in blocks.iter() {
            // Chunks are tested for rays from an eye, mirrored or not.
            let bounds = block.bounds.as_ref().filter(|_| self.rays() != Some(SurfaceRays::Refracted));
            if let Some(bounds) = bounds {
                recorder.dispatch(
                    if self.disks.is_some() { "cull_disk_chunks" } else { "cull_chunks" },
                    Size::Items(block.chunks(), 64),
                    &[
                        frame,
                        ("block", &block.uniform),
                        ("bounds", bounds),
                        ("chunk_seen", &block.chunk_seen),
                    ],
                )?;
            }
            let mut bound = vec![
                frame,
                ("block", &block.uniform),
                ("transforms", &block.transforms),
                ("chunk_seen", &block.chunk_seen),
                ("density_sums", self.density_sums(block)),
                ("flags", &self.flags),
            ];
            bound.extend(self.bound_surface());
            recorder.dispatch(cull, Size::Items(block.count, 64), &bound)?;
        }
        let chunks = Size::Groups(Scan::groups(total));
        self.flag_scan.record(recorder, &self.counters, &self.flags, chunks)?;
        recorder.dispatch(
            "count_visible",
            Size::Groups(1),
            &[
                frame,
                ("sums", self.flag_scan.sums()),
                ("flags", &self.flags),
                ("block_bases", blocks.bases()),
                counters,
                ("args", &self.args),
            ],
        )
    }

    /// Records everything before the blending: the splats of each tile, front to back.
    ///
    /// # Errors
    /// When a kernel does not compile or targets are missing.
    pub fn record_lists(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        blocks: &Blocks,
        view: &FrameUniform,
    ) -> Result<()> {
        let (frame, counters) = (("frame", &self.uniform), ("counters", &self.counters));
        let targets = self.targets()?;
        let within = FrameUniform {
            visible_capacity: self.visible_capacity,
            intersect_capacity: self.intersect_capacity,
            ..*view
        };
        self.record_cull(gpu, recorder, blocks, &within)?;
        for block in blocks.iter() {
            self.record_projection(recorder, block)?;
        }
        let groups =
            [counter::ARGS_DEPTH_SORT, counter::ARGS_DEPTH_SCAN].map(|slot| Size::Indirect(&self.args, slot));
        self.depth_sort.record(recorder, &self.counters, DEPTH_BITS, groups)?;
        let per_visible = Size::Indirect(&self.args, counter::ARGS_VISIBLE);
        let order = self.depth_order();
        let (count, emit) = match self.surface {
            None => ("intersect_count", "intersect_emit"),
            Some(_) => ("intersect_count_at_surface", "intersect_emit_at_surface"),
        };
        let tile_rays = targets.tile_rays.as_ref().map(|tile_rays| ("tile_rays", tile_rays));
        let mut bound = vec![
            frame,
            counters,
            ("projected", &self.projected),
            ("order", order),
            ("counts", &self.offsets),
        ];
        bound.extend(tile_rays);
        recorder.dispatch(count, per_visible, &bound)?;
        let chunks = Size::Indirect(&self.args, counter::ARGS_VISIBLE_SCAN);
        self.offset_scan.record(recorder, &self.counters, &self.offsets, chunks)?;
        recorder.dispatch(
            "count_intersections",
            Size::Groups(1),
            &[frame, ("sums", self.offset_scan.sums()), counters, ("args", &self.args)],
        )?;
        let mut bound = vec![
            frame,
            counters,
            ("projected", &self.projected),
            ("order", order),
            ("offsets", &self.offsets),
            ("tile_keys", &self.tile_sort.keys[0]),
            ("slots", &self.tile_sort.values[0]),
            ("visible_from_slot", &self.visible_from_slot),
            ("segments", &self.segments),
        ];
        bound.extend(tile_rays);
        recorder.dispatch(emit, per_visible, &bound)?;
        let tiles = view.tile_count();
        let groups =
            [counter::ARGS_TILE_SORT, counter::ARGS_TILE_SCAN].map(|slot| Size::Indirect(&self.args, slot));
        self.tile_sort.record(recorder, &self.counters, tile_bits(tiles), groups)?;
        recorder.clear(&targets.ranges);
        recorder.dispatch(
            "tile_ranges",
            Size::Indirect(&self.args, counter::ARGS_INTERSECT),
            &[counters, ("tile_keys", self.sorted_tiles(tiles)), ("ranges", &targets.ranges)],
        )
    }

    fn record_projection(&self, recorder: &mut Recorder<'_>, block: &Block) -> Result<()> {
        let (kernel, of_shape) = match &self.disks {
            Some(disks) if self.rays() == Some(SurfaceRays::Refracted) => {
                ("project_refracted", ("disks", disks))
            }
            Some(disks) => ("project_disks", ("disks", disks)),
            None => ("project_forward", ("density_sums", self.density_sums(block))),
        };
        let mut bound = vec![
            ("frame", &self.uniform),
            ("block", &block.uniform),
            ("transforms", &block.transforms),
            ("sh_coeffs", &block.sh_coeffs),
            of_shape,
            ("flags", &self.flags),
            ("counters", &self.counters),
            ("projected", &self.projected),
            ("depth_keys", &self.depth_sort.keys[0]),
            ("order", &self.depth_sort.values[0]),
            ("gaussian_from_visible", &self.gaussian_from_visible),
            ("water", &self.water),
        ];
        bound.extend(self.bound_refraction());
        recorder.dispatch(kernel, Size::Items(block.count, 64), &bound)
    }

    fn density_sums<'a>(&'a self, block: &'a Block) -> &'a wgpu::Buffer {
        block.training.as_ref().map_or(&self.no_density_sums, |training| &training.density_sums)
    }

    /// Waits and reports whether a list was too short since the lists were made or [`Frame::grow`] was
    /// called.
    ///
    /// # Errors
    /// When the device failed.
    pub fn overflow(&self, gpu: &Gpu) -> Result<Option<Overflow>> {
        let counters: Vec<u32> = gpu.read(&self.counters, 0, counter::COUNT as usize)?;
        let at = |slot: u32| counters[slot as usize];
        Ok((at(counter::OVERFLOW) != 0).then(|| Overflow {
            failed_at: at(counter::FAILED_AT),
            visible: at(counter::NEEDED_VISIBLE),
            intersections: at(counter::NEEDED_INTERSECTIONS),
        }))
    }

    /// Capacities with room for what overflowed plus a quarter, within the limits.
    pub fn capacities_for(&self, overflow: Overflow) -> (u32, u32) {
        let roomy = |have: u32, need: u32, most: u32| {
            if need > have { need.saturating_add(need / 4).min(most).max(have) } else { have }
        };
        (
            roomy(self.visible_capacity, overflow.visible, self.limits.visible),
            roomy(self.intersect_capacity, overflow.intersections, self.limits.intersections),
        )
    }

    /// Grows the lists to [`Frame::capacities_for`] the overflow and clears the sticky bit.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn grow(&mut self, gpu: &Gpu, overflow: Overflow) -> Result<()> {
        let (visible, intersections) = self.capacities_for(overflow);
        if (visible, intersections) == self.capacities() {
            self.forget_overflow(gpu);
            return Ok(());
        }
        // The old lists are freed first: both together could be the peak of memory use.
        for (visible, intersections) in [(1, 1), (visible, intersections)] {
            self.replace_lists(gpu, visible, intersections)?;
            gpu.release_unused()?;
        }
        Ok(())
    }

    /// Replaces the lists, keeping targets and limits, and clears the sticky bit.
    ///
    /// # Errors
    /// When the device cannot hold them in addition to the old ones, which then stay.
    pub fn replace_lists(&mut self, gpu: &Gpu, visible: u32, intersections: u32) -> Result<()> {
        let new = Self::new(gpu, self.gaussian_capacity, visible, intersections)?;
        let mut new = if self.disks.is_some() { new.of_disks(gpu)? } else { new };
        if let Some((rays, surface)) = &self.surface {
            new = new.at_surface(gpu, *rays, surface)?;
        }
        let targets = self.targets.take();
        *self = Self { targets, water: self.water.clone(), limits: self.limits, ..new };
        Ok(())
    }

    /// Clears the sticky bit.
    pub fn forget_overflow(&self, gpu: &Gpu) {
        gpu.write(&self.counters, 0, &[0_u32; counter::COUNT as usize]);
    }

    /// As [`Frame::with_limits`].
    pub fn set_limits(&mut self, limits: ListLimits) {
        self.limits = limits;
    }
}

/// Bits of a tile number; one more number marks entries that no kernel reads.
fn tile_bits(tiles: u32) -> u32 {
    u32::BITS - tiles.leading_zeros()
}
