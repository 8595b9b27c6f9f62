//! Renders one model from any camera, at any size.
//!
//! An image that the device cannot bind is rendered in strips of rows, each an image of its own. The
//! projection is always that of the whole image, so a strip shows the same pixels. If the lists of a strip
//! would be too long, it is rendered in bands of tiles, as in training.

use std::sync::Arc;

use glam::DVec3;

use super::layout::{FrameUniform, medium};
use super::{Blocks, Frame, Gpu, ListLimits, Recorder, spatial_order};
use crate::config::Composition;
use crate::gaussians::{Gaussians, SH_C0};
use crate::memory::MAX_TILES;
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::scene::{PinholeCamera, Pose};
use crate::water::{ByDirection, LEAST_ALPHA, RangeModulation, Water, WaterRecord};
use crate::{CoreError, Result};

/// A weighted sum of unit normals shorter than this share of its weights has no direction.
const NO_DIRECTION: f64 = 1e-3;

/// A rendered view. Arrays are row-major from the top left.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colour over the background, as trained (sRGB for `3dgs`), unclamped.
    pub rgb: Vec<[f32; 3]>,
    /// 1 - remaining transmittance.
    pub alpha: Vec<f32>,
    /// Sum of weight times distance along the ray, scene units; divide by alpha for the expected range.
    pub range: Vec<f32>,
}

impl Rendered {
    /// Expected distance along the ray, scene units, `[H*W]`; 0 where alpha is 0.
    pub fn expected_range(&self) -> Vec<f32> {
        let of_pixel = |(range, alpha): (&f32, &f32)| if *alpha > 0.0 { range / alpha } else { 0.0 };
        self.range.iter().zip(&self.alpha).map(of_pixel).collect()
    }
}

/// Which image of an underwater scene is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// I: as the camera sees it.
    Underwater,
    /// J: without the water.
    Restored,
    /// B: the backscatter alone.
    Backscatter,
}

/// A water to render through.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterView {
    /// The water parameters.
    pub water: Water,
    /// How the coefficients depend on range, if they do; only if the water acts on pixels.
    pub refinement: Option<RangeModulation>,
    /// How the colour of open water changes with direction, if it does; only if the water acts on pixels.
    pub by_direction: Option<ByDirection>,
    /// Where the water acts and how Gaussians are blended: as the model was trained.
    pub composition: Composition,
    /// Which image is rendered.
    pub output: Output,
}

impl WaterView {
    /// The water that a model carries.
    pub fn of_record(record: &WaterRecord, output: Output) -> Self {
        let (water, refinement) = (record.water(), record.refinement);
        let (by_direction, composition) = (record.by_direction, record.composition);
        Self { water, refinement, by_direction, composition, output }
    }

    /// The same with the water along `direction` (unit length, scene axes).
    fn along(&self, direction: DVec3) -> Self {
        let water = self.by_direction.map_or(self.water, |colours| colours.along(&self.water, direction));
        Self { water, ..*self }
    }

    /// A pixel in sRGB from the blended colour, its alpha and range, over `background` (sRGB). `self` is the
    /// water along the ray of the pixel. Twin: `shaders/water.wgsl`.
    fn pixel(&self, blended: [f32; 3], alpha: f32, range: f32, background: [f32; 3]) -> [f32; 3] {
        let b_inf = self.water.b_inf;
        let alpha = f64::from(alpha);
        let as_shown = !self.composition.blends_in_linear_light();
        let over_black = self.composition == Composition::PixelsOverBlack;
        let on_pixels = self.composition.acts_on_pixels();
        if as_shown && (!on_pixels || self.output == Output::Restored) {
            let open = b_inf.map(linear_to_srgb);
            return std::array::from_fn(|c| {
                let behind = if self.output == Output::Restored { f64::from(background[c]) } else { open[c] };
                blended[c] + ((1.0 - alpha) * behind) as f32
            });
        }
        let background = background.map(|value| srgb_to_linear(value.into()));
        let open = alpha < LEAST_ALPHA;
        let r = if open { 0.0 } else { f64::from(range) / alpha };
        let Water { beta_d, beta_b, .. } =
            self.refinement.map_or(self.water, |refinement| refinement.at(&self.water, r));
        std::array::from_fn(|c| {
            let own = match f64::from(blended[c]) {
                shown if over_black => srgb_to_linear(shown.max(0.0)),
                shown if as_shown && !open => alpha * srgb_to_linear((shown / alpha).max(0.0)),
                light => light,
            };
            // Over black, rays that hit nothing have no backscatter.
            let share = match (over_black, open) {
                (true, true) => 0.0,
                (true, false) => alpha,
                (false, _) => 1.0,
            };
            let veil = b_inf[c] * (share - alpha * (-beta_b[c] * r).exp());
            let light = match (self.output, on_pixels) {
                (Output::Restored, _) => own + (1.0 - alpha) * background[c],
                (_, false) => own + (1.0 - alpha) * b_inf[c],
                _ if open => share * b_inf[c],
                (Output::Underwater, _) => own * (-beta_d[c] * r).exp() + veil,
                (Output::Backscatter, _) => veil,
            };
            linear_to_srgb(light) as f32
        })
    }
}

/// How the Gaussians of a model were trained ([`crate::ply::drawing`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Drawing {
    /// With the 2D filter of Mip-Splatting.
    pub mip_filter: bool,
    /// As disks.
    pub disks: bool,
}

/// Renders one model from any camera.
pub struct Renderer {
    gpu: Arc<Gpu>,
    blocks: Blocks,
    /// The same Gaussians with other colours; made on first use.
    recoloured: Option<Blocks>,
    frame: Frame,
    /// Index in the model of each Gaussian on the device.
    order: Vec<u32>,
    options: RenderOptions,
}

/// How images are rendered.
struct RenderOptions {
    strip_tiles: u32,
    mip_filter: bool,
    water: Option<WaterView>,
    /// Largest number of bands that a strip needed so far.
    bands: u32,
}

impl Renderer {
    /// Uploads a model.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: Arc<Gpu>, model: &Gaussians) -> Result<Self> {
        let mut blocks = Blocks::new(&gpu, model.sh_degree)?;
        let order = spatial_order(model);
        blocks.push_frozen(&gpu, model, &order)?;
        let count = model.len() as u32;
        let frame = Frame::new(&gpu, count, count.clamp(1024, 65_536), count.clamp(4096, 262_144))?;
        let options = RenderOptions { strip_tiles: MAX_TILES, mip_filter: false, water: None, bands: 1 };
        Ok(Self { gpu, blocks, recoloured: None, frame, order, options })
    }

    /// Renders the Gaussians of a run where they are, without a copy of them.
    ///
    /// # Errors
    /// When the device fails.
    pub(crate) fn of_run(gpu: Arc<Gpu>, run: &Blocks) -> Result<Self> {
        let blocks = run.sharing_all(&gpu)?;
        let count = blocks.total();
        let frame = Frame::new(&gpu, count, count.clamp(1024, 65_536), count.clamp(4096, 262_144))?;
        let options = RenderOptions { strip_tiles: MAX_TILES, mip_filter: false, water: None, bands: 1 };
        Ok(Self { gpu, blocks, recoloured: None, frame, order: Vec::new(), options })
    }

    /// Renders with or without the 2D filter of Mip-Splatting.
    #[must_use]
    pub fn with_mip_filter(mut self, mip_filter: bool) -> Self {
        self.options.mip_filter = mip_filter;
        self
    }

    /// Renders the Gaussians as they were trained.
    ///
    /// # Errors
    /// When the device cannot hold 48 more bytes for each visible disk.
    pub fn drawn(mut self, drawing: Drawing) -> Result<Self> {
        self.options.mip_filter = drawing.mip_filter;
        if drawing.disks {
            self.frame = self.frame.of_disks(&self.gpu)?;
        }
        Ok(self)
    }

    /// Renders through this water, for models whose colours are J; [`WaterView::output`] selects the image.
    /// Images remain in sRGB. Where the water is visible, open water replaces the background.
    #[must_use]
    pub fn with_water(mut self, water: Option<WaterView>) -> Self {
        self.set_water(water);
        self
    }

    /// As [`Renderer::with_water`], from now on.
    pub fn set_water(&mut self, water: Option<WaterView>) {
        if let Some(view) = &water {
            self.frame.set_water(&self.gpu, &view.water);
        }
        self.options.water = water;
    }

    /// The same renderer with strips of at most `tiles` tiles but at least one row of tiles, for devices with
    /// little memory.
    pub fn with_strip_tiles(mut self, tiles: u32) -> Self {
        self.options.strip_tiles = self.options.strip_tiles.min(tiles);
        self
    }

    /// Limits the lengths of the lists, which may require more bands; for tests.
    #[must_use]
    pub fn with_list_limits(mut self, limits: ListLimits) -> Self {
        self.frame = self.frame.with_limits(limits);
        self
    }

    /// Renders over `background`.
    ///
    /// # Errors
    /// When the device fails, or cannot bind the lists of a single tile.
    pub fn render(&mut self, camera: &PinholeCamera, pose: &Pose, background: [f32; 3]) -> Result<Rendered> {
        draw(&self.gpu, &mut self.frame, &self.blocks, &mut self.options, (camera, pose), background)
    }

    /// The normals of `model`, which must be the uploaded model, `[H*W]`. Each is the unit direction of the
    /// blended [`Gaussians::normals_towards`] the camera, in camera axes (x right, y down, z forward). Zero
    /// where alpha is 0 or where normals cancel out.
    ///
    /// # Errors
    /// As [`Renderer::render`]; also when `model` has a different number of Gaussians, or the device cannot
    /// hold 48 more bytes per Gaussian.
    pub fn normals(
        &mut self,
        model: &Gaussians,
        camera: &PinholeCamera,
        pose: &Pose,
    ) -> Result<Vec<[f32; 3]>> {
        let normals = model.normals_towards(pose.centre());
        let in_camera = normals.iter().map(|normal| pose.rotation * DVec3::from(normal.map(f64::from)));
        // Colours are clamped at 0, so (n + 1) / 2 is blended.
        let colours: Vec<[f32; 3]> = in_camera.map(|n| ((n + 1.0) / 2.0).as_vec3().to_array()).collect();
        let rendered = self.render_coloured(&colours, camera, pose)?;
        let unit = |(rgb, alpha): (&[f32; 3], &f32)| {
            let alpha = f64::from(*alpha);
            let sum = 2.0 * DVec3::from(rgb.map(f64::from)) - alpha;
            let usable = sum.length() > NO_DIRECTION * alpha;
            if usable { sum.normalize().as_vec3().to_array() } else { [0.0; 3] }
        };
        Ok(rendered.rgb.iter().zip(&rendered.alpha).map(unit).collect())
    }

    /// Renders over black with `colours` `[N,3]`, not below 0, in place of the model's.
    fn render_coloured(
        &mut self,
        colours: &[[f32; 3]],
        camera: &PinholeCamera,
        pose: &Pose,
    ) -> Result<Rendered> {
        if colours.len() != self.blocks.total() as usize {
            return Err(CoreError::Scene(format!(
                "{} colours for {} Gaussians: the model differs from the uploaded one",
                colours.len(),
                self.blocks.total()
            )));
        }
        let blocks = match self.recoloured.take() {
            Some(blocks) => blocks,
            None => self.blocks.sharing_transforms(&self.gpu)?,
        };
        let mut rest = self.order.as_slice();
        for block in blocks.iter() {
            let (indices, after) = rest.split_at(block.count as usize);
            rest = after;
            // Three vec4 per Gaussian (`sh_stride`), of which only the first coefficient is used.
            let rows: Vec<[f32; 12]> = indices
                .iter()
                .map(|&index| {
                    let mut row = [0.0; 12];
                    row[..3].copy_from_slice(&colours[index as usize].map(|value| (value - 0.5) / SH_C0));
                    row
                })
                .collect();
            self.gpu.write(&block.sh_coeffs, 0, &rows);
        }
        // These are not colours, so the water must not change them.
        let water = self.options.water.take();
        let rendered = draw(&self.gpu, &mut self.frame, &blocks, &mut self.options, (camera, pose), [0.0; 3]);
        self.options.water = water;
        self.recoloured = Some(blocks);
        rendered
    }
}

/// Renders strip by strip.
fn draw(
    gpu: &Gpu,
    frame: &mut Frame,
    blocks: &Blocks,
    options: &mut RenderOptions,
    (camera, pose): (&PinholeCamera, &Pose),
    background: [f32; 3],
) -> Result<Rendered> {
    let view = FrameUniform {
        background: if options.water.is_some() { [0.0; 3] } else { background },
        medium: options.water.map_or(medium::NONE, |water| medium::of(water.composition, water.output)),
        sh_degree: u32::from(blocks.sh_degree()),
        mip_filter: u32::from(options.mip_filter),
        ..FrameUniform::of_camera(camera, pose, gpu.tile())
    };
    let pixels = camera.width as usize * camera.height as usize;
    let mut picture = Rendered {
        width: camera.width,
        height: camera.height,
        rgb: Vec::with_capacity(pixels),
        alpha: Vec::with_capacity(pixels),
        range: Vec::with_capacity(pixels),
    };
    let tile = gpu.tile();
    let rows = (options.strip_tiles / view.tiles[0].max(1)).max(1) * tile;
    for first in (0..camera.height).step_by(rows as usize) {
        let count = rows.min(camera.height - first);
        // The principal point moves with the strip; the bounds of the projection stay those of the whole
        // image.
        let strip = FrameUniform {
            principal: [view.principal[0], (camera.cy - f64::from(first)) as f32],
            ..view.with_size([camera.width, count], tile)
        };
        draw_strip(gpu, frame, blocks, &mut options.bands, &strip, &mut picture)?;
    }
    if let Some(water) = &options.water {
        let to_world = pose.rotation.inverse();
        for (i, rgb) in picture.rgb.iter_mut().enumerate() {
            // The directions cost as much as the rest of the loop, and most waters do not depend on them.
            let here = match water.by_direction {
                Some(_) => water.along(to_world * camera.direction(i)),
                None => *water,
            };
            *rgb = here.pixel(*rgb, picture.alpha[i], picture.range[i], background);
        }
    }
    Ok(picture)
}

/// Renders the rows of `strip` and appends them to `picture`.
fn draw_strip(
    gpu: &Gpu,
    frame: &mut Frame,
    blocks: &Blocks,
    bands: &mut u32,
    strip: &FrameUniform,
    picture: &mut Rendered,
) -> Result<()> {
    // A list that was too short reports the length it needed. It grows up to the largest binding; then the
    // strip is cut into bands.
    loop {
        frame.prepare_targets(gpu, strip.size)?;
        for band in strip.bands(*bands, gpu.tile()) {
            let mut recorder = Recorder::new(gpu);
            frame.record_forward(gpu, &mut recorder, blocks, &band)?;
            recorder.submit();
        }
        let Some(overflow) = frame.overflow(gpu)? else { break };
        if !overflow.fits(frame.limits()) {
            *bands = frame.limits().more_bands(overflow, strip.band_count(*bands), strip.tile_count())?;
        }
        frame.grow(gpu, overflow)?;
    }
    let targets = frame.targets()?;
    let pixels = strip.size[0] as usize * strip.size[1] as usize;
    let image: Vec<[f32; 4]> = gpu.read(&targets.image, 0, pixels)?;
    let range: Vec<f32> = gpu.read(&targets.range_image, 0, pixels)?;
    picture.rgb.extend(image.iter().map(|p| [p[0], p[1], p[2]]));
    picture.alpha.extend(image.iter().map(|p| p[3]));
    picture.range.extend(range);
    Ok(())
}
