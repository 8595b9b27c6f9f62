//! Checkpoints of a run with a water surface: those of its three sets, the surface and the pseudo-masks.
//!
//! Layout, little-endian:
//!
//! 1. magic, format, digest of the run, iteration
//! 2. iteration of the pseudo-masks plus 1 (0: none), number of their words, the words
//! 3. the arrays of the surface
//! 4. three checkpoints, each with its length in 8 bytes
//! 5. BLAKE3 of all of the above

use glam::DVec3;

use super::SurfaceTrainer;
use crate::config::SurfaceConfig;
use crate::surface::SurfaceRecord;
use crate::train::{Trainer, checkpoint};
use crate::{CoreError, Result};

const MAGIC: &[u8; 8] = b"fathomcs";
const FORMAT: u32 = 1;
const HEADER: usize = 8 + 4 + 32 + 3 * 4;

/// BLAKE3 of the surface, its configuration and the three runs.
pub(super) fn digest(
    config: &SurfaceConfig,
    record: &SurfaceRecord,
    pivot: DVec3,
    sets: [&Trainer; 3],
) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{config:?} {record:?} {pivot:?}").as_bytes());
    for set in sets {
        hasher.update(&set.run_digest);
    }
    *hasher.finalize().as_bytes()
}

impl SurfaceTrainer {
    /// Everything that a resumed run needs, followed by a digest.
    ///
    /// # Errors
    /// When the device fails.
    pub fn checkpoint(&mut self) -> Result<Vec<u8>> {
        let gpu = std::sync::Arc::clone(&self.straight.gpu);
        let mut bytes = Vec::new();
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&FORMAT.to_le_bytes());
        bytes.extend_from_slice(&self.digest);
        let words = self.masks.words();
        let made_at = self.masks.made_at().map_or(0, |at| at + 1);
        for word in [self.iteration, made_at, words.len() as u32] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(bytemuck::cast_slice(words));
        for (buffer, length) in self.device.arrays() {
            bytes.extend(gpu.read::<u8>(buffer, 0, length)?);
        }
        self.count_sets();
        for set in self.sets() {
            let own = checkpoint::save(set)?;
            bytes.extend_from_slice(&(own.len() as u64).to_le_bytes());
            bytes.extend(own);
        }
        let digest = blake3::hash(&bytes);
        bytes.extend_from_slice(digest.as_bytes());
        Ok(bytes)
    }

    /// Sets the iteration of the three sets to that of the run.
    fn count_sets(&mut self) {
        self.straight.iteration = self.iteration;
        for set in [&mut self.reflected, &mut self.refracted] {
            set.iteration = self.iteration.saturating_sub(self.from);
        }
    }

    /// Sets the run to the state of `checkpoint`.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when it is damaged or belongs to another run; the run then keeps its state.
    pub fn go_to(&mut self, bytes: &[u8]) -> Result<()> {
        let refused = |why: &str| CoreError::Checkpoint(why.to_owned());
        if bytes.len() < HEADER + 32 || &bytes[..8] != MAGIC {
            return Err(refused("this is not a checkpoint of method wsgs, or it is torn"));
        }
        let (content, digest) = bytes.split_at(bytes.len() - 32);
        if blake3::hash(content).as_bytes() != digest {
            return Err(refused("its digest does not match: it is torn or damaged"));
        }
        let word =
            |at: usize| u32::from_le_bytes([content[at], content[at + 1], content[at + 2], content[at + 3]]);
        if word(8) != FORMAT {
            return Err(refused(&format!("its format is {}, but this program reads {FORMAT}", word(8))));
        }
        if content[12..44] != self.digest {
            return Err(refused("it belongs to another run: configuration, views or starting model differ"));
        }
        let (iteration, made_at, count) = (word(44), word(48), word(52) as usize);
        let mut rest = &content[HEADER..];
        let mut take = |length: usize| {
            let (array, after) = rest.split_at_checked(length).ok_or_else(|| refused("it ends too early"))?;
            rest = after;
            Ok::<&[u8], CoreError>(array)
        };
        if count != self.masks.words().len() {
            return Err(refused("its pseudo-masks are those of other views"));
        }
        let masks: Vec<u32> = take(4 * count)?
            .chunks_exact(4)
            .map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
            .collect();
        let arrays = self.device.arrays().map(|(_, length)| length);
        let arrays = [take(arrays[0])?, take(arrays[1])?];
        let mut sets = Vec::with_capacity(3);
        for _ in 0..3 {
            let length = take(8)?.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
            sets.push(take(usize::try_from(length).map_err(|_| refused("it ends too early"))?)?);
        }
        if !rest.is_empty() {
            return Err(refused("it is longer than it should be"));
        }
        for (set, bytes) in self.sets().into_iter().zip(sets) {
            checkpoint::restore(set, bytes)?;
        }
        let gpu = std::sync::Arc::clone(&self.straight.gpu);
        for ((buffer, _), bytes) in self.device.arrays().into_iter().zip(arrays) {
            gpu.write(buffer, 0, bytes);
        }
        self.masks.restore(&gpu, masks, made_at.checked_sub(1));
        self.iteration = iteration;
        gpu.wait()
    }
}
