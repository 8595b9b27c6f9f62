//! Gaussians on the device, in blocks.
//!
//! A block holds at most [`BLOCK_CAPACITY`] Gaussians, and half as many with moments in f32
//! ([`block_capacity`]). None of its arrays then exceeds the smallest storage binding of 128 MiB (the
//! coefficients of SH degree 3 take 96). A model has up to [`MAX_BLOCKS`] blocks.
//! Only the flags of all Gaussians (`Frame`) share one binding, 4 bytes each. Bindings of 128 MiB allow 33
//! million Gaussians; beyond that there is a typed error.
//! Trainable blocks come first, then frozen ones. Blocks are filled in order: all but the last trainable one
//! are full.

use std::sync::OnceLock;

use super::bounds::{CULL_CHUNK, chunk_bounds};
use super::layout::BlockUniform;
use super::{Gpu, Recorder};
use crate::config::Moments;
use crate::gaussians::{Gaussians, Transform};
use crate::memory::FLAG_BYTES;
use crate::{CoreError, Result};

pub use crate::memory::{BLOCK_CAPACITY, block_capacity};

/// Number of vec4 for the coefficients of one Gaussian: three for every four of the K coefficients.
pub fn sh_stride(sh_degree: u8) -> u32 {
    3 * (u32::from(sh_degree) + 1).pow(2).div_ceil(4)
}

/// State of Adam and of density control.
///
/// The moments of a Gaussian are undefined until it has taken a step; see `shaders/shared/adam.wgsl`.
pub struct BlockTraining {
    /// `[N*4]` or, in f32, `[N*6]` vec4: moments of the transforms; see `shaders/shared/moments_*.wgsl`.
    pub moments: wgpu::Buffer,
    /// Moments of the coefficients: first ones in half the size of the coefficients, or first and second ones
    /// in twice that size in f32.
    pub sh_moments: wgpu::Buffer,
    /// `[N]` vec4: sums of density control and, in z, the smoothing; see `project_backward.wgsl` and
    /// `smoothing.wgsl`.
    pub density_sums: wgpu::Buffer,
    /// How the moments are stored.
    pub kind: Moments,
    /// `[N*3]` vec4: sums over the bands of a view that is rendered in several, allocated on first use.
    band_gradients: OnceLock<wgpu::Buffer>,
}

impl BlockTraining {
    /// Its arrays whose content outlives an iteration, each with its bytes per Gaussian; `stride` as given by
    /// [`sh_stride`].
    pub fn arrays(&self, stride: u32) -> Vec<(&wgpu::Buffer, usize)> {
        let colour = 16 * stride as usize;
        let (of_transform, of_colour) = match self.kind {
            Moments::Compact => (64, colour / 2),
            Moments::F32 => (96, 2 * colour),
        };
        vec![(&self.moments, of_transform), (&self.sh_moments, of_colour), (&self.density_sums, 16)]
    }

    /// The sums of bands, in rows of this many bytes; allocated at the first call.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn band_gradients(&self, gpu: &Gpu, capacity: u32, row_bytes: u64) -> Result<&wgpu::Buffer> {
        if let Some(buffer) = self.band_gradients.get() {
            return Ok(buffer);
        }
        let buffer = gpu.buffer("band gradients", u64::from(capacity.max(1)) * row_bytes)?;
        Ok(self.band_gradients.get_or_init(|| buffer))
    }
}

/// One block. Layouts: `shaders/shared/gaussian.wgsl`.
pub struct Block {
    /// Gaussians that fit.
    pub capacity: u32,
    /// Gaussians that it holds.
    pub count: u32,
    /// `BlockUniform`.
    pub uniform: wgpu::Buffer,
    /// `[capacity*3]` vec4.
    pub transforms: wgpu::Buffer,
    /// `[capacity*stride]` vec4.
    pub sh_coeffs: wgpu::Buffer,
    /// `[chunks]`: whether the view may see each chunk of [`CULL_CHUNK`] Gaussians; always true in trainable
    /// blocks.
    pub chunk_seen: wgpu::Buffer,
    /// Bounding boxes of the chunks of a frozen block; see `cull_chunks.wgsl`.
    pub bounds: Option<wgpu::Buffer>,
    /// Present in trainable blocks.
    pub training: Option<BlockTraining>,
}

impl Block {
    /// Number of chunks of its Gaussians.
    pub fn chunks(&self) -> u32 {
        self.count.div_ceil(CULL_CHUNK)
    }

    /// Its arrays whose content outlives an iteration, each with its bytes per Gaussian; `stride` as given by
    /// [`sh_stride`].
    pub fn arrays(&self, stride: u32) -> Vec<(&wgpu::Buffer, usize)> {
        let mut arrays = vec![(&self.transforms, 48), (&self.sh_coeffs, 16 * stride as usize)];
        if let Some(training) = &self.training {
            arrays.extend(training.arrays(stride));
        }
        arrays
    }
}

/// A model on the device.
pub struct Blocks {
    sh_degree: u8,
    blocks: Vec<Block>,
    bases: wgpu::Buffer,
}

/// Largest number of blocks of a model: 128 million Gaussians.
const MAX_BLOCKS: usize = 256;

/// Coefficients of a Gaussian in device layout for a degree: RGB after RGB, padded to whole groups of four
/// coefficients.
fn coefficients(model: &Gaussians, i: usize, sh_degree: u8) -> Vec<f32> {
    let coeffs = model.coeffs();
    let used = coeffs.min((usize::from(sh_degree) + 1).pow(2));
    let mut row: Vec<f32> =
        model.sh_coeffs[i * coeffs..i * coeffs + used].iter().flatten().copied().collect();
    row.resize(4 * sh_stride(sh_degree) as usize, 0.0);
    row
}

impl Blocks {
    /// An empty model.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(gpu: &Gpu, sh_degree: u8) -> Result<Self> {
        Ok(Self { sh_degree, blocks: Vec::new(), bases: gpu.buffer("block bases", MAX_BLOCKS as u64 * 4)? })
    }

    /// Degree of the coefficients.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// All blocks, trainable ones first.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Block> {
        self.blocks.iter()
    }

    /// The trainable blocks.
    pub fn trainable(&self) -> impl Iterator<Item = (usize, &Block, &BlockTraining)> {
        self.blocks.iter().enumerate().filter_map(|(i, block)| Some((i, block, block.training.as_ref()?)))
    }

    /// Gaussians in all blocks.
    pub fn total(&self) -> u32 {
        self.blocks.iter().map(|block| block.count).sum()
    }

    /// Gaussians in trainable blocks.
    pub fn trainable_total(&self) -> u32 {
        self.trainable().map(|(_, block, _)| block.count).sum()
    }

    /// First index of each block among all Gaussians, for shaders.
    pub fn bases(&self) -> &wgpu::Buffer {
        &self.bases
    }

    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        let size = |buffer: &wgpu::Buffer| buffer.size();
        self.blocks
            .iter()
            .map(|block| {
                let arrays = block.training.as_ref().map(|training| training.arrays(0));
                let training = arrays.iter().flatten().map(|(buffer, _)| size(buffer)).sum::<u64>();
                size(&block.transforms) + size(&block.sh_coeffs) + training
            })
            .sum()
    }

    /// Bytes on the device of the sums of bands.
    pub fn band_bytes(&self) -> u64 {
        self.trainable()
            .filter_map(|(_, _, training)| training.band_gradients.get())
            .map(wgpu::Buffer::size)
            .sum()
    }

    /// Appends frozen Gaussians in the given order, with culling bounds. [`super::spatial_order`] makes the
    /// bounds tight.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn push_frozen(&mut self, gpu: &Gpu, model: &Gaussians, order: &[u32]) -> Result<()> {
        self.push_frozen_as(gpu, model, model, order)
    }

    /// The same for disks with masks: their third numbers are no scales, so the bounds are those of `flat`,
    /// the same disks without masks.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn push_frozen_as(
        &mut self,
        gpu: &Gpu,
        model: &Gaussians,
        flat: &Gaussians,
        order: &[u32],
    ) -> Result<()> {
        for rows in order.chunks(BLOCK_CAPACITY as usize) {
            let mut block = self.allocate(gpu, rows.len() as u32, None)?;
            let bounds = chunk_bounds(flat, rows);
            let buffer = gpu.buffer("culling bounds", bounds.len() as u64 * 16)?;
            gpu.write(&buffer, 0, &bounds);
            block.bounds = Some(buffer);
            self.blocks.push(block);
            let at = self.blocks.len() - 1;
            self.fill(gpu, at, model, rows.iter().map(|&row| row as usize));
            // Writes are staged on the host until they are submitted.
            self.flush(gpu);
        }
        self.write_uniforms(gpu);
        Ok(())
    }

    /// Appends trainable Gaussians with room for `cap` in all. There must be no frozen Gaussians yet.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn push_trainable(&mut self, gpu: &Gpu, model: &Gaussians, cap: u32, moments: Moments) -> Result<()> {
        let cap = cap.max(model.len() as u32);
        let mut first = 0;
        let full = block_capacity(moments);
        for start in (0..cap).step_by(full as usize) {
            let capacity = (cap - start).min(full);
            let block = self.allocate(gpu, capacity, Some(moments))?;
            self.blocks.push(block);
            let at = self.blocks.len() - 1;
            let count = (model.len() - first).min(capacity as usize) as u32;
            self.fill(gpu, at, model, first..first + count as usize);
            first += count as usize;
            self.flush(gpu);
        }
        self.write_uniforms(gpu);
        Ok(())
    }

    fn allocate(&self, gpu: &Gpu, capacity: u32, training: Option<Moments>) -> Result<Block> {
        if self.blocks.len() == MAX_BLOCKS {
            let flags = |blocks: usize| FLAG_BYTES * u64::from(BLOCK_CAPACITY) * blocks as u64;
            return Err(CoreError::BufferTooLarge {
                buffer: "the flags of all Gaussians",
                needed_bytes: flags(MAX_BLOCKS + 1),
                limit_bytes: flags(MAX_BLOCKS),
            });
        }
        let halves = |label, count: u32| gpu.buffer(label, u64::from(capacity.max(1)) * u64::from(count) * 8);
        let rows = |label, vec4s: u32| halves(label, 2 * vec4s);
        let stride = sh_stride(self.sh_degree);
        let training = match training {
            None => None,
            Some(kind) => Some(BlockTraining {
                moments: rows("moments", if kind == Moments::F32 { 6 } else { 4 })?,
                sh_moments: halves("sh_moments", if kind == Moments::F32 { 4 * stride } else { stride })?,
                density_sums: rows("density_sums", 1)?,
                kind,
                band_gradients: OnceLock::new(),
            }),
        };
        let chunks = capacity.div_ceil(CULL_CHUNK).max(1);
        let chunk_seen = gpu.buffer("chunk_seen", u64::from(chunks) * 4)?;
        gpu.write(&chunk_seen, 0, &vec![1_u32; chunks as usize]);
        Ok(Block {
            capacity,
            count: 0,
            chunk_seen,
            bounds: None,
            uniform: gpu.uniform("block", &BlockUniform::default()),
            transforms: rows("transforms", 3)?,
            sh_coeffs: rows("sh_coeffs", stride)?,
            training,
        })
    }

    fn fill(&mut self, gpu: &Gpu, at: usize, model: &Gaussians, rows: impl ExactSizeIterator<Item = usize>) {
        let count = rows.len();
        let stride = 4 * sh_stride(self.sh_degree) as usize;
        let mut transforms = Vec::with_capacity(count);
        let mut sh = Vec::with_capacity(count * stride);
        for i in rows {
            transforms.push(model.transform(i));
            sh.extend(coefficients(model, i, self.sh_degree));
        }
        let block = &mut self.blocks[at];
        gpu.write(&block.transforms, 0, &transforms);
        gpu.write(&block.sh_coeffs, 0, &sh);
        block.count = count as u32;
    }

    /// Rows of a model in the layout of `densify_place.wgsl`: transforms, then coefficients.
    pub fn staged_rows(&self, model: &Gaussians, rows: &[u32]) -> Vec<f32> {
        let row = |i: &u32| {
            let transform = model.transform(*i as usize).into_iter().flatten();
            transform.chain(coefficients(model, *i as usize, self.sh_degree)).collect::<Vec<f32>>()
        };
        rows.iter().flat_map(row).collect()
    }

    /// Reads the transforms of the trainable Gaussians.
    ///
    /// # Errors
    /// When the device fails.
    pub fn transforms(&self, gpu: &Gpu) -> Result<Vec<Transform>> {
        let mut all = Vec::with_capacity(self.trainable_total() as usize);
        for (_, block, _) in self.trainable() {
            all.extend(gpu.read::<Transform>(&block.transforms, 0, block.count as usize)?);
        }
        Ok(all)
    }

    /// Sets the number of Gaussians in trainable blocks. A kernel must write the new entries.
    pub fn set_trainable_total(&mut self, gpu: &Gpu, total: u32) {
        let mut left = total;
        for block in self.blocks.iter_mut().filter(|block| block.training.is_some()) {
            block.count = left.min(block.capacity);
            left -= block.count;
        }
        self.write_uniforms(gpu);
    }

    fn write_uniforms(&self, gpu: &Gpu) {
        let mut base = 0;
        let mut bases = Vec::with_capacity(self.blocks.len());
        for (index, block) in self.blocks.iter().enumerate() {
            let uniform = BlockUniform {
                base,
                count: block.count,
                index: index as u32,
                sh_stride: sh_stride(self.sh_degree),
            };
            gpu.write(&block.uniform, 0, &[uniform]);
            bases.push(base);
            base += block.count;
        }
        gpu.write(&self.bases, 0, &bases);
    }

    /// Submits the writes so far, so that writes and later recordings keep their order.
    pub fn flush(&self, gpu: &Gpu) {
        Recorder::new(gpu).submit();
    }

    /// Reads the trainable Gaussians, or all Gaussians if none is trainable.
    ///
    /// # Errors
    /// When the device fails.
    pub fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        let only_trainable = self.blocks.iter().any(|block| block.training.is_some());
        let stride = sh_stride(self.sh_degree) as usize;
        let mut model = Gaussians::empty(self.sh_degree);
        let coeffs = model.coeffs();
        for block in self.blocks.iter().filter(|block| !only_trainable || block.training.is_some()) {
            let n = block.count as usize;
            let transforms: Vec<[f32; 4]> = gpu.read(&block.transforms, 0, 3 * n)?;
            let sh: Vec<f32> = gpu.read(&block.sh_coeffs, 0, 4 * stride * n)?;
            for i in 0..n {
                let [t0, t1, t2] = [transforms[3 * i], transforms[3 * i + 1], transforms[3 * i + 2]];
                model.means.push([t0[0], t0[1], t0[2]]);
                model.opacity_logits.push(t0[3]);
                model.quats.push(t1);
                model.log_scales.push([t2[0], t2[1], t2[2]]);
                for k in 0..coeffs {
                    let from = i * stride * 4 + 3 * k;
                    model.sh_coeffs.push([sh[from], sh[from + 1], sh[from + 2]]);
                }
            }
        }
        Ok(model)
    }

    /// The same Gaussians, to be rendered: all their buffers are shared, so that a run can be rendered
    /// without a copy of its model. Valid until the Gaussians of the run are moved or increased.
    ///
    /// # Errors
    /// When the device fails.
    pub fn sharing_all(&self, gpu: &Gpu) -> Result<Self> {
        let mut shared = Self::new(gpu, self.sh_degree)?;
        let same = |block: &Block| Block {
            capacity: block.capacity,
            count: block.count,
            uniform: gpu.uniform("block", &BlockUniform::default()),
            transforms: block.transforms.clone(),
            sh_coeffs: block.sh_coeffs.clone(),
            chunk_seen: block.chunk_seen.clone(),
            bounds: block.bounds.clone(),
            training: None,
        };
        shared.blocks.extend(self.blocks.iter().map(same));
        shared.write_uniforms(gpu);
        Ok(shared)
    }

    /// The same Gaussians, sharing their transforms on the device, with coefficients of degree 0 of their
    /// own, all 0. For images of quantities other than the model's colours.
    ///
    /// # Errors
    /// When the device cannot hold the coefficients: 48 bytes per Gaussian.
    pub fn sharing_transforms(&self, gpu: &Gpu) -> Result<Self> {
        let mut shared = Self::new(gpu, 0)?;
        for block in &self.blocks {
            let bytes = u64::from(block.capacity.max(1)) * u64::from(sh_stride(0)) * 16;
            shared.blocks.push(Block {
                capacity: block.capacity,
                count: block.count,
                uniform: gpu.uniform("block", &BlockUniform::default()),
                transforms: block.transforms.clone(),
                sh_coeffs: gpu.buffer("sh_coeffs", bytes)?,
                chunk_seen: block.chunk_seen.clone(),
                bounds: block.bounds.clone(),
                training: None,
            });
        }
        shared.write_uniforms(gpu);
        Ok(shared)
    }
}
