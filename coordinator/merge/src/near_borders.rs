//! The Gaussians that may be duplicates: all of them in memory, or reread region by region where they are too
//! many.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::MergeError;
use crate::border::Bands;
use crate::candidate::Candidate;
use crate::duplicates::{CANDIDATE_BYTES, Decisions, Duplicate, Region};
use crate::ply_rows::Blocks;
use crate::source::{Extent, RowBlock, Source};
use crate::survey::Pass;

impl Pass {
    /// The rows to remove as duplicates of another partition's, by partition and row.
    ///
    /// # Errors
    /// When a file cannot be reread.
    pub fn duplicates(
        &self,
        sources: &[Source<'_>],
        blocks: &[Vec<RowBlock>],
    ) -> Result<BTreeMap<u32, Vec<Duplicate>>, MergeError> {
        let Some(bounds) = &self.bounds else { return Ok(BTreeMap::new()) };
        let mut decisions = Decisions::default();
        if let Some(candidates) = self.near_borders.take() {
            decisions.decide(&candidates, &Region::ALL, bounds);
        } else {
            let (region, reach) = around(blocks);
            decisions.decide_in_parts(region, reach, bounds, &mut |region, bounded| {
                self.load(sources, blocks, region, bounded)
            })?;
        }
        Ok(decisions.finish())
    }

    /// Rereads the candidates in a region and those that reach into it; `None` if `bounded` and they are too
    /// many.
    fn load(
        &self,
        sources: &[Source<'_>],
        blocks: &[Vec<RowBlock>],
        region: &Region,
        bounded: bool,
    ) -> Result<Option<Vec<Candidate>>, MergeError> {
        let mut found = Vec::new();
        for (source, blocks) in sources.iter().zip(blocks) {
            let bands = Bands::new(source.partition, self.share);
            let mut reader: Option<Blocks<'_>> = None;
            let mut buffer = Vec::new();
            for (number, block) in (0..).zip(blocks) {
                let near =
                    block.reach >= 0.0 && region.meets(block.bounds.low, block.bounds.high, block.reach);
                if !near {
                    continue;
                }
                let reader = match &mut reader {
                    Some(reader) => reader,
                    none => none.insert(source.file.open()?),
                };
                buffer.resize(source.file.block_bytes(number), 0);
                reader.read(number, &mut buffer)?;
                block.check(&buffer, &source.file, number)?;
                let mut candidates = Vec::new();
                self.look(source, number, &buffer, &bands, |_| {}, &mut candidates);
                found.extend(candidates.into_iter().filter(|c| region.meets(c.mean, c.mean, c.reach)));
                if bounded && found.len() > self.near_borders.most {
                    return Ok(None);
                }
            }
        }
        Ok(Some(found))
    }
}

/// The box of all blocks with candidates, and the greatest reach.
fn around(blocks: &[Vec<RowBlock>]) -> (Region, f32) {
    let (mut extent, mut reach) = (Extent::NONE, 0.0_f32);
    for block in blocks.iter().flatten().filter(|block| block.reach >= 0.0) {
        extent.add(block.bounds.low, None);
        extent.add(block.bounds.high, None);
        reach = reach.max(block.reach);
    }
    (Region { low: extent.low, high: extent.high.map(f32::next_up) }, reach)
}

/// The candidates of all sources, up to a limit.
pub struct NearBorders {
    most: usize,
    is_over: AtomicBool,
    parts: Mutex<(usize, Vec<Vec<Candidate>>)>,
}

impl NearBorders {
    /// No candidates yet; `bytes` is their memory limit during the decision.
    pub fn new(bytes: usize) -> Self {
        Self { most: bytes / CANDIDATE_BYTES, is_over: AtomicBool::new(false), parts: Mutex::default() }
    }

    /// Adds candidates, and drops all when they are too many.
    pub fn add(&self, mut candidates: Vec<Candidate>) {
        if candidates.is_empty() || self.is_over.load(Ordering::Relaxed) {
            return;
        }
        candidates.shrink_to_fit();
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        parts.0 += candidates.len();
        if parts.0 > self.most {
            self.is_over.store(true, Ordering::Relaxed);
            parts.1 = Vec::new();
        } else {
            parts.1.push(candidates);
        }
    }

    /// All of them, in any order; `None` where they were too many.
    fn take(&self) -> Option<Vec<Candidate>> {
        if self.is_over.load(Ordering::Relaxed) {
            return None;
        }
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all = Vec::with_capacity(parts.0);
        parts.1.drain(..).for_each(|part| all.extend(part));
        Some(all)
    }
}
