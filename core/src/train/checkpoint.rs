//! Checkpoints: everything that a resumed run needs to give the same bytes as an uninterrupted one.
//!
//! Layout, little-endian:
//!
//! 1. magic, format, digest of the run, iteration, Gaussians at the start, Gaussians in focus
//! 2. for each trainable block its arrays, up to its count
//! 3. the arrays of the appearances, from the loss back to the Gaussians
//! 4. if the run has a network of the water: the number of its bytes, then the network
//! 5. BLAKE3 of all of the above
//!
//! Random numbers are functions of (seed, iteration) and schedules are functions of the iteration, so neither
//! has stored state.

use super::{TrainRun, Trainer};
use crate::gaussians::Gaussians;
use crate::gpu::sh_stride;
use crate::{CoreError, Result};

const MAGIC: &[u8; 8] = b"fathomck";
const FORMAT: u32 = 4;
const HEADER: usize = 8 + 4 + 32 + 3 * 4;

/// BLAKE3 of configuration, extent, water, views, focus, context and surfaces.
pub(super) fn run_digest(run: &TrainRun) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    // The result does not depend on when checkpoints, measurements and previews are made, or on prefetching.
    let config = crate::config::TrainConfig {
        checkpoint_seconds: 0,
        prefetch_threads: 0,
        eval_every: 0,
        preview_seconds: 0,
        preview_views: 0,
        ..run.config.clone()
    };
    hasher.update(format!("{config:?} {:08x}", run.extent.to_bits()).as_bytes());
    if let Some(medium) = &run.medium {
        hasher.update(format!("{medium:?}").as_bytes());
    }
    for view in run.views.views() {
        hasher.update(format!("{view:?}").as_bytes());
    }
    if let Some(weights) = run.views.weights() {
        hasher.update(bytemuck::cast_slice(weights));
    }
    for model in [&run.focus, &run.context, &run.surfaces] {
        hash_gaussians(&mut hasher, model);
    }
    *hasher.finalize().as_bytes()
}

fn hash_gaussians(hasher: &mut blake3::Hasher, model: &Gaussians) {
    hasher.update(&(model.len() as u64).to_le_bytes());
    hasher.update(&[model.sh_degree]);
    hasher.update(bytemuck::cast_slice(&model.means));
    hasher.update(bytemuck::cast_slice(&model.quats));
    hasher.update(bytemuck::cast_slice(&model.log_scales));
    hasher.update(bytemuck::cast_slice(&model.opacity_logits));
    hasher.update(bytemuck::cast_slice(&model.sh_coeffs));
}

pub(super) fn save(trainer: &mut Trainer) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&FORMAT.to_le_bytes());
    bytes.extend_from_slice(&trainer.run_digest);
    for word in [trainer.iteration, trainer.initial, trainer.blocks.trainable_total()] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    let stride = sh_stride(trainer.config.sh_degree);
    for (_, block, _) in trainer.blocks.trainable() {
        for (buffer, row) in block.arrays(stride) {
            bytes.extend(trainer.gpu.read::<u8>(buffer, 0, row * block.count as usize)?);
        }
    }
    for (buffer, length) in extras(trainer) {
        bytes.extend(trainer.gpu.read::<u8>(buffer, 0, length)?);
    }
    if let Some(predictor) = &mut trainer.predictor {
        let state = predictor.save()?;
        bytes.extend((state.len() as u32).to_le_bytes());
        bytes.extend(state);
    }
    let digest = blake3::hash(&bytes);
    bytes.extend_from_slice(digest.as_bytes());
    Ok(bytes)
}

/// The state of a run besides its Gaussians: buffers with the number of bytes in use.
fn extras(trainer: &Trainer) -> impl Iterator<Item = (&wgpu::Buffer, usize)> {
    trainer.appearances.arrays(&trainer.frame)
}

impl Trainer {
    /// The bytes of the state besides the Gaussians, without the network of the water.
    pub(super) fn extras(&self) -> Result<Vec<Vec<u8>>> {
        extras(self).map(|(buffer, length)| self.gpu.read::<u8>(buffer, 0, length)).collect()
    }

    /// Restores the state from [`Trainer::extras`] of a run on the same views with the same configuration,
    /// and the state of its network.
    pub(super) fn take_extras(&mut self, bytes: &[Vec<u8>], network: Option<&[u8]>) -> Result<()> {
        for ((buffer, _), bytes) in extras(self).zip(bytes) {
            self.gpu.write(buffer, 0, bytes);
        }
        take_network(self, network)
    }
}

/// Restores the network of the water, if the run has one.
fn take_network(trainer: &mut Trainer, state: Option<&[u8]>) -> Result<()> {
    if let (Some(predictor), Some(state)) = (&mut trainer.predictor, state) {
        predictor.restore(state)?;
        if let (Some(errors), Some(medium)) = (predictor.standard_error(), trainer.appearances.water_mut()) {
            medium.set_standard_error(errors);
        }
    }
    Ok(())
}

/// Moves the run to the checkpoint `bytes`. If they are refused, the run stays where it is.
pub(super) fn restore(trainer: &mut Trainer, bytes: &[u8]) -> Result<()> {
    let refuse = |why: &str| Err(CoreError::Checkpoint(why.to_owned()));
    if bytes.len() < HEADER + 32 || &bytes[..8] != MAGIC {
        return refuse("this is not a checkpoint, or it is torn");
    }
    let (content, digest) = bytes.split_at(bytes.len() - 32);
    if blake3::hash(content).as_bytes() != digest {
        return refuse("its digest does not match: it is torn or damaged");
    }
    let word =
        |at: usize| u32::from_le_bytes([content[at], content[at + 1], content[at + 2], content[at + 3]]);
    if word(8) != FORMAT {
        return refuse(&format!("its format is {}, but this program reads {FORMAT}", word(8)));
    }
    if content[12..44] != trainer.run_digest {
        return refuse("it belongs to another run: configuration, views or starting model differ");
    }
    let (iteration, initial, count) = (word(44), word(48), word(52));
    let before = trainer.blocks.trainable_total();
    trainer.blocks.set_trainable_total(&trainer.gpu, count);
    if let Err(error) = fill(trainer, count, &content[HEADER..]) {
        trainer.blocks.set_trainable_total(&trainer.gpu, before);
        return Err(error);
    }
    trainer.iteration = iteration;
    trainer.initial = initial;
    trainer.gpu.wait()
}

/// Reads a checkpoint of `count` Gaussians, after checking that it is neither longer nor shorter than needed.
fn fill(trainer: &mut Trainer, count: u32, mut rest: &[u8]) -> Result<()> {
    let refused = |why: &str| CoreError::Checkpoint(why.to_owned());
    if trainer.blocks.trainable_total() != count {
        return Err(refused("it holds more Gaussians than this run allows"));
    }
    let mut take = |length: usize| {
        let (array, after) = rest.split_at_checked(length).ok_or_else(|| refused("it ends too early"))?;
        rest = after;
        Ok::<&[u8], CoreError>(array)
    };
    let stride = sh_stride(trainer.config.sh_degree);
    let of_blocks = trainer.blocks.trainable().flat_map(|(_, block, _)| {
        block.arrays(stride).into_iter().map(|(buffer, row)| (buffer, row * block.count as usize))
    });
    let mut arrays = Vec::new();
    for (buffer, length) in of_blocks.chain(extras(trainer)) {
        arrays.push((buffer.clone(), take(length)?));
    }
    let predicted = match &trainer.predictor {
        None => None,
        Some(_) => {
            let length = take(4)?.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes));
            Some(take(length as usize)?)
        }
    };
    if !rest.is_empty() {
        return Err(refused("it is longer than it should be"));
    }
    take_network(trainer, predicted)?;
    for (buffer, array) in arrays {
        trainer.gpu.write(&buffer, 0, array);
    }
    Ok(())
}
