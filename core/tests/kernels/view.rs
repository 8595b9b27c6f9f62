//! One view of one model through the kernels, with the output of each stage.

use std::sync::Arc;

use fathom_core::config::Moments;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{
    Block, BlockTraining, Blocks, Frame, FrameUniform, Gpu, Recorder, StepUniform, counter, sh_stride,
};
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::train::{BackwardBuffers, record_backward, smoothed};
use fathom_twins::samples::{self, off_centre_view};
use fathom_twins::{Gaussians64, RasterGradients, RasterRules, Splat, SplatGradient};

pub const BACKGROUND: [f32; 3] = [0.2, 0.7, 0.4];

/// A model and the camera that renders it.
#[derive(Clone)]
pub struct Scene {
    pub name: String,
    pub model: Gaussians,
    pub camera: PinholeCamera,
    pub pose: Pose,
    pub sh_degree: u8,
    pub background: [f32; 3],
    pub mip_filter: bool,
}

impl Scene {
    pub fn new(name: &str, model: Gaussians, width: u32, height: u32) -> Self {
        let (camera, pose) = off_centre_view(width, height, 3.0);
        let sh_degree = model.sh_degree;
        Self {
            name: name.to_owned(),
            model,
            camera,
            pose,
            sh_degree,
            background: BACKGROUND,
            mip_filter: false,
        }
    }

    /// The same with the 2D filter of Mip-Splatting.
    pub fn filtered(mut self) -> Self {
        self.mip_filter = true;
        self
    }

    /// The blending rules that the kernels apply to it.
    pub fn rules(&self) -> RasterRules {
        RasterRules { mip_filter: self.mip_filter, ..RasterRules::HARD }
    }

    pub fn background64(&self) -> [f64; 3] {
        self.background.map(f64::from)
    }
}

/// The hard scenes of the twins, at a size that is no multiple of a tile: 75 x 53.
pub fn hard_scenes(seed: u32, count: usize, sh_degree: u8) -> Vec<Scene> {
    [
        ("random", samples::random(seed, count, sh_degree)),
        ("needles", samples::needles(seed, count, sh_degree)),
        ("huge", samples::huge(seed, count.min(150), sh_degree)),
        ("beyond the border", samples::beyond_the_border(seed, count, sh_degree)),
    ]
    .into_iter()
    .map(|(name, model)| Scene::new(name, model, 75, 53))
    .collect()
}

/// A model on the device and a frame that rendered it.
pub struct View {
    pub gpu: Arc<Gpu>,
    pub scene: Scene,
    pub blocks: Blocks,
    pub frame: Frame,
    pub uniform: FrameUniform,
}

impl View {
    /// Renders the whole model in one trainable block. Its moments are f32, because raw gradients can be
    /// stored there.
    pub fn render(gpu: &Arc<Gpu>, scene: &Scene) -> Self {
        Self::render_with(gpu, scene, Moments::F32)
    }

    /// The same with moments of the given kind.
    pub fn render_with(gpu: &Arc<Gpu>, scene: &Scene, moments: Moments) -> Self {
        let mut blocks = Blocks::new(gpu, scene.model.sh_degree).unwrap();
        blocks.push_trainable(gpu, &scene.model, scene.model.len() as u32, moments).unwrap();
        Self::render_blocks(gpu, scene, blocks)
    }

    /// The same with the whole filter of Mip-Splatting: two of three Gaussians are smoothed, by up to twice
    /// their size.
    pub fn render_smoothed(gpu: &Arc<Gpu>, scene: &Scene) -> Self {
        let mut blocks = Blocks::new(gpu, scene.model.sh_degree).unwrap();
        blocks.push_trainable(gpu, &scene.model, scene.model.len() as u32, Moments::F32).unwrap();
        let (_, block, training) = blocks.trainable().next().unwrap();
        let size = |i: u32| scene.model.log_scales[i as usize].iter().copied().fold(f32::MIN, f32::max).exp();
        let width = |i| if i % 3 == 0 { 0.0 } else { 2.0 * size(i) * uniform_at(151, Stream::Test, i, 0) };
        let rows: Vec<[f32; 4]> = (0..block.count).map(|i| [0.0, 0.0, width(i), 0.0]).collect();
        gpu.write(&training.density_sums, 0, &rows);
        Self::render_blocks(gpu, &scene.clone().filtered(), blocks)
    }

    /// How far each trainable Gaussian is smoothed.
    pub fn smoothing(&self) -> Vec<f32> {
        let of_block = |(_, block, training): (_, &Block, &BlockTraining)| -> Vec<f32> {
            let rows: Vec<[f32; 4]> = self.gpu.read(&training.density_sums, 0, block.count as usize).unwrap();
            rows.iter().map(|row| row[2]).collect()
        };
        self.blocks.trainable().flat_map(of_block).collect()
    }

    /// The model with its smoothing applied, as a twin draws it.
    pub fn drawn(&self) -> Gaussians64 {
        Gaussians64::from(&smoothed(self.scene.model.clone(), &self.smoothing()))
    }

    /// The same with blocks that the caller made.
    pub fn render_blocks(gpu: &Arc<Gpu>, scene: &Scene, blocks: Blocks) -> Self {
        let mut view = Self::prepare(gpu, scene, blocks);
        view.forward();
        view
    }

    /// Renders the model as disks.
    pub fn render_disks(gpu: &Arc<Gpu>, scene: &Scene) -> Self {
        let mut blocks = Blocks::new(gpu, scene.model.sh_degree).unwrap();
        blocks.push_trainable(gpu, &scene.model, scene.model.len() as u32, Moments::F32).unwrap();
        let mut view = Self::prepare(gpu, scene, blocks);
        let (visible, intersections) = view.frame.capacities();
        let lists = Frame::new(gpu, view.blocks.total(), visible, intersections).unwrap();
        view.frame = lists.of_disks(gpu).unwrap();
        view.frame.prepare_targets(gpu, view.uniform.size).unwrap();
        view.frame.scratch().into_iter().for_each(|buffer| super::device::poison(gpu, buffer));
        view.forward();
        view
    }

    /// Makes the buffers without rendering, with room for every splat in every tile.
    pub fn prepare(gpu: &Arc<Gpu>, scene: &Scene, blocks: Blocks) -> Self {
        let tile = gpu.tile();
        let tiles = scene.camera.width.div_ceil(tile) * scene.camera.height.div_ceil(tile);
        let intersections = tiles * blocks.total();
        Self::prepare_lists(gpu, scene, blocks, intersections)
    }

    /// The same with room for `intersections` intersections.
    pub fn prepare_lists(gpu: &Arc<Gpu>, scene: &Scene, blocks: Blocks, intersections: u32) -> Self {
        let n = blocks.total();
        let uniform = FrameUniform {
            sh_degree: u32::from(scene.sh_degree),
            background: scene.background,
            mip_filter: u32::from(scene.mip_filter),
            ..FrameUniform::of_camera(&scene.camera, &scene.pose, gpu.tile())
        };
        let mut frame = Frame::new(gpu, n, n, intersections).unwrap();
        frame.prepare_targets(gpu, uniform.size).unwrap();
        Self { gpu: Arc::clone(gpu), scene: scene.clone(), blocks, frame, uniform }
    }

    pub fn forward(&mut self) {
        let mut recorder = Recorder::new(&self.gpu);
        self.frame.record_forward(&self.gpu, &mut recorder, &self.blocks, &self.uniform).unwrap();
        recorder.submit();
        assert_eq!(
            self.frame.overflow(&self.gpu).unwrap(),
            None,
            "{}: the lists must be large enough",
            self.scene.name
        );
    }

    pub fn pixels(&self) -> usize {
        (self.uniform.size[0] * self.uniform.size[1]) as usize
    }

    pub fn counter(&self, slot: u32) -> usize {
        self.gpu.read::<u32>(&self.frame.counters, u64::from(slot) * 4, 1).unwrap()[0] as usize
    }

    /// [H*W] rgb and alpha.
    pub fn image(&self) -> Vec<[f32; 4]> {
        self.gpu.read(&self.frame.targets().unwrap().image, 0, self.pixels()).unwrap()
    }

    pub fn range_image(&self) -> Vec<f32> {
        self.gpu.read(&self.frame.targets().unwrap().range_image, 0, self.pixels()).unwrap()
    }

    /// Index among all Gaussians of each visible one.
    pub fn visible(&self) -> Vec<usize> {
        let visible = self.counter(counter::VISIBLE);
        let inside: Vec<u32> = self.gpu.read(&self.frame.gaussian_from_visible, 0, visible).unwrap();
        let flags: Vec<u32> = self.gpu.read(&self.frame.flags, 0, self.blocks.total() as usize).unwrap();
        let mut all = Vec::new();
        let mut base = 0;
        for block in self.blocks.iter().filter(|block| block.count > 0) {
            let start = flags[base] as usize;
            base += block.count as usize;
            let end = flags.get(base).map_or(visible, |&flag| flag as usize);
            all.extend(inside[start..end].iter().map(|&i| base - block.count as usize + i as usize));
        }
        assert_eq!(all.len(), visible, "{}: visible Gaussians by block", self.scene.name);
        all
    }

    /// The projected records by Gaussian; `None` where it is culled or touches no tile. The records have no
    /// depth, so depth comes from the twin.
    pub fn splats(&self) -> Vec<Option<Splat>> {
        let visible = self.visible();
        let records: Vec<[f32; 12]> = self.gpu.read(&self.frame.projected, 0, visible.len()).unwrap();
        let model = Gaussians64::from(&self.scene.model);
        let mut splats = vec![None; self.blocks.total() as usize];
        for (&id, record) in visible.iter().zip(&records) {
            let r = record.map(f64::from);
            if r[7] < 0.0 {
                continue;
            }
            let determinant = r[2] * r[4] - r[3] * r[3];
            splats[id] = Some(Splat {
                mean2d: [r[0], r[1]],
                conic: [r[2], r[3], r[4]],
                rgb: [r[8], r[9], r[10]],
                opacity: r[5],
                range: r[6],
                depth: self.scene.pose.transform(model.means[id].into()).z,
                extent: r[7],
                half_size: [
                    (2.0 * r[7] * r[4] / determinant).sqrt(),
                    (2.0 * r[7] * r[2] / determinant).sqrt(),
                ],
            });
        }
        splats
    }

    /// Gaussians of each tile in blending order.
    pub fn tile_lists(&self) -> Vec<Vec<usize>> {
        let visible = self.visible();
        let tiles = self.uniform.tile_count();
        let count = self.counter(counter::INTERSECTIONS);
        let slots: Vec<u32> = self.gpu.read(self.frame.sorted_slots(tiles), 0, count).unwrap();
        let owner: Vec<u32> = self.gpu.read(&self.frame.visible_from_slot, 0, count).unwrap();
        let ranges: Vec<[u32; 2]> =
            self.gpu.read(&self.frame.targets().unwrap().ranges, 0, tiles as usize).unwrap();
        let gaussian = |&slot: &u32| visible[owner[slot as usize] as usize];
        ranges.iter().map(|r| slots[r[0] as usize..r[1] as usize].iter().map(gaussian).collect()).collect()
    }

    /// Runs the backward pass with these gradients of the images and returns the gradients of the slots.
    pub fn backward(&self, v: &ImageGradients, step: &StepUniform) -> Vec<[f32; 12]> {
        let slots = self.record_backward(v, step);
        self.gpu.read(&slots, 0, self.counter(counter::INTERSECTIONS)).unwrap()
    }

    /// The same, but the gradients stay on the device. The buffer starts filled with rubbish.
    pub fn record_backward(&self, v: &ImageGradients, step: &StepUniform) -> wgpu::Buffer {
        let gpu = &self.gpu;
        let v_image = super::device::storage(gpu, &v.image);
        let v_range = super::device::storage(gpu, &v.range);
        let step = gpu.uniform("step", step);
        let bytes = 48 * (self.counter(counter::INTERSECTIONS) as u64).max(1);
        let slots = gpu.buffer("slot gradients", bytes).unwrap();
        super::device::poison(gpu, &slots);
        let mut recorder = Recorder::new(gpu);
        record_backward(
            gpu,
            &mut recorder,
            &self.frame,
            &self.blocks,
            &self.uniform,
            BackwardBuffers {
                v_image: &v_image,
                v_range: &v_range,
                slot_gradients: &slots,
                disks: None,
                traced: None,
                step: &step,
                appearances: &[],
            },
        )
        .unwrap();
        recorder.submit();
        gpu.wait().unwrap();
        slots
    }

    /// Sums of slots by Gaussian.
    pub fn splat_gradients(&self, slots: &[[f32; 12]]) -> Vec<SplatGradient> {
        let visible = self.visible();
        let segments: Vec<[u32; 2]> = self.gpu.read(&self.frame.segments, 0, visible.len()).unwrap();
        let mut sums = vec![SplatGradient::default(); self.blocks.total() as usize];
        for (&id, &[first, count]) in visible.iter().zip(&segments) {
            let mut g = [0.0_f64; 12];
            for slot in &slots[first as usize..(first + count) as usize] {
                g.iter_mut().zip(slot).for_each(|(sum, &value)| *sum += f64::from(value));
            }
            sums[id] = SplatGradient {
                mean2d: [g[0], g[1]],
                conic: [g[2], g[3], g[4]],
                opacity: g[5],
                range: g[6],
                abs: g[7],
                rgb: [g[8], g[9], g[10]],
                contribution: g[11],
            };
        }
        sums
    }

    /// Sums of the absolute values of slots by Gaussian: the size of [`View::splat_gradients`] without
    /// cancellation.
    pub fn slot_sizes(&self, slots: &[[f32; 12]]) -> Vec<[f64; 12]> {
        let visible = self.visible();
        let segments: Vec<[u32; 2]> = self.gpu.read(&self.frame.segments, 0, visible.len()).unwrap();
        let mut sizes = vec![[0.0; 12]; self.blocks.total() as usize];
        for (&id, &[first, count]) in visible.iter().zip(&segments) {
            for slot in &slots[first as usize..(first + count) as usize] {
                sizes[id].iter_mut().zip(slot).for_each(|(sum, &value)| *sum += f64::from(value.abs()));
            }
        }
        sizes
    }

    /// Gradients of all parameters after a backward pass with `gradients_only`; zeros where nothing was
    /// written.
    pub fn parameter_gradients(&self) -> Gaussians64 {
        let mut v = Gaussians64::zeros(self.blocks.trainable_total() as usize, self.scene.model.sh_degree);
        let (stride, coeffs) = (4 * sh_stride(self.scene.model.sh_degree) as usize, v.coeffs());
        let mut index = 0;
        for (_, block, training) in self.blocks.trainable() {
            let n = block.count as usize;
            let moments: Vec<[f32; 24]> = self.gpu.read(&training.moments, 0, n).unwrap();
            // First and second moments, vec4 by vec4; gradients are where first moments would be.
            let pairs: Vec<[[f32; 4]; 2]> = self.gpu.read(&training.sh_moments, 0, stride * n / 4).unwrap();
            let sh: Vec<f32> = pairs.into_iter().flat_map(|[first, _]| first).collect();
            for (row, m) in moments.iter().map(|m| m.map(f64::from)).enumerate() {
                v.means[index] = [m[0], m[1], m[2]];
                v.opacity_logits[index] = m[3];
                v.quats[index] = [m[4], m[5], m[6], m[7]];
                v.log_scales[index] = [m[8], m[9], m[10]];
                for k in 0..coeffs {
                    v.sh_coeffs[index * coeffs + k] =
                        std::array::from_fn(|c| f64::from(sh[row * stride + 3 * k + c]));
                }
                index += 1;
            }
        }
        v
    }
}

/// Requests raw gradients instead of steps.
pub fn gradients_only() -> StepUniform {
    StepUniform { gradients_only: 1, ..StepUniform::default() }
}

/// Gradients of a loss with respect to the images, in the layout of the kernels.
#[derive(Clone)]
pub struct ImageGradients {
    pub image: Vec<[f32; 4]>,
    pub range: Vec<f32>,
}

impl ImageGradients {
    /// One random number from -1 to 1 for each number of the images.
    pub fn random(seed: u32, pixels: usize) -> Self {
        let u = |i, j| 2.0 * uniform_at(seed, Stream::Test, i, j) - 1.0;
        let pixels = 0..pixels as u32;
        Self {
            image: pixels.clone().map(|i| [u(i, 0), u(i, 1), u(i, 2), u(i, 3)]).collect(),
            range: pixels.map(|i| u(i, 4)).collect(),
        }
    }

    pub fn in_f64(&self) -> RasterGradients {
        RasterGradients {
            rgb: self.image.iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect(),
            alpha: self.image.iter().map(|v| f64::from(v[3])).collect(),
            range: self.range.iter().map(|&v| f64::from(v)).collect(),
        }
    }
}
