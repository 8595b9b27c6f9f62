//! The first pass: it summarises each block of each result, verifies the digests, and finds Gaussians near
//! borders.
//!
//! Every row is read once, while it is hashed. The summary of a block is its bounds, three counts and a
//! checksum. So the second pass can copy or skip most blocks without reading rows, and notices changed ones.

use std::sync::{Mutex, PoisonError};

use fathom_core::config::MergeConfig;
use fathom_core::gaussians::is_shared;
use glam::DVec3;
use rayon::prelude::*;

use crate::MergeError;
use crate::border::Bands;
use crate::candidate::{Bounds, Candidate, RowId};
use crate::near_borders::NearBorders;
use crate::ply_rows::BLOCK_ROWS;
use crate::source::{Extent, Place, RowBlock, Source};
use crate::thinning::{Opacities, Standing, bin};

/// The result of the first pass.
pub struct Survey {
    /// Blocks of each source, in order.
    pub blocks: Vec<Vec<RowBlock>>,
    /// Opacities of all Gaussians that lie in their cell and are not duplicates.
    pub opacities: Opacities,
    /// Rows to remove as duplicates, by source, ascending.
    pub duplicates: Vec<Vec<u32>>,
}

/// Surveys all sources.
///
/// # Errors
/// When a file cannot be read or differs from its digest: the error of the first such source.
pub fn survey(sources: &[Source<'_>], config: &MergeConfig) -> Result<Survey, MergeError> {
    let pass = Pass::new(sources, config);
    let surveyed: Vec<Result<Vec<RowBlock>, MergeError>> =
        sources.par_iter().map(|source| pass.survey(source)).collect();
    let blocks: Vec<Vec<RowBlock>> = surveyed.into_iter().collect::<Result<_, _>>()?;
    let gone = pass.duplicates(sources, &blocks)?;
    let mut opacities = pass.opacities.into_inner().unwrap_or_else(PoisonError::into_inner);
    gone.values().flatten().for_each(|row| opacities.remove(row.standing));
    let rows_of = |source: &Source<'_>| {
        let rows = gone.get(&source.index).into_iter().flatten();
        rows.map(|row| row.row).collect()
    };
    let duplicates = sources.iter().map(rows_of).collect();
    Ok(Survey { blocks, opacities, duplicates })
}

/// Settings of the pass, shared by all sources.
pub struct Pass {
    /// The bounds for duplicates; `None` where duplicates stay.
    pub bounds: Option<Bounds>,
    /// Width of a band as a share of the extension.
    pub share: f64,
    viewing_distance: Option<f32>,
    opacities: Mutex<Opacities>,
    /// The candidates so far.
    pub near_borders: NearBorders,
}

impl Pass {
    fn new(sources: &[Source<'_>], config: &MergeConfig) -> Self {
        let viewing_distance = sources.first().and_then(|source| source.plan.extent.viewing_distance);
        Self {
            bounds: config.duplicates.then(|| Bounds::new(config)),
            share: config.band,
            viewing_distance: viewing_distance.map(|distance| distance as f32),
            opacities: Mutex::new(Opacities::default()),
            near_borders: NearBorders::new((config.memory_mib as usize) << 20),
        }
    }

    fn survey(&self, source: &Source<'_>) -> Result<Vec<RowBlock>, MergeError> {
        let file = &source.file;
        let bands = Bands::new(source.partition, self.share);
        let mut opacities = Opacities::default();
        let mut hasher = blake3::Hasher::new();
        hasher.update(&file.header);
        let mut reader = file.open()?;
        let mut buffer = vec![0; file.largest_block_bytes()];
        let mut blocks = Vec::with_capacity(file.blocks() as usize);
        for block in 0..file.blocks() {
            let rows = &mut buffer[..file.block_bytes(block)];
            reader.read(block, rows)?;
            hasher.update(rows);
            let mut candidates = Vec::new();
            let visit = |standing| opacities.add(standing);
            blocks.push(self.look(source, block, rows, &bands, visit, &mut candidates));
            self.near_borders.add(candidates);
        }
        let found = hasher.finalize().to_hex();
        if found.as_str() != source.digest {
            let message = format!(
                "has the digest {found} but was submitted as {}: the disk changed it; check the disk and run the job again",
                source.digest
            );
            return Err(MergeError::File { path: file.path.clone(), message });
        }
        self.opacities.lock().unwrap_or_else(PoisonError::into_inner).add_all(&opacities);
        Ok(blocks)
    }

    /// Surveys one block: calls `visit` with set and opacity of each Gaussian of the cell, and adds possible
    /// duplicates to `candidates`.
    pub fn look(
        &self,
        source: &Source<'_>,
        block: u64,
        rows: &[u8],
        bands: &Bands,
        mut visit: impl FnMut(Standing),
        candidates: &mut Vec<Candidate>,
    ) -> RowBlock {
        let layout = &source.file.layout;
        let (mut inside, mut not_finite) = (0, 0);
        let (mut lowest_bin, mut bounds, mut reach) = (u16::MAX, Extent::NONE, -1.0_f32);
        for (at, row) in rows.chunks_exact(layout.row_bytes()).enumerate() {
            let (mean, logit) = layout.centre_and_logit(row);
            let aligned = match source.place(mean, logit) {
                Place::Cell(aligned) => aligned,
                Place::Margin => continue,
                Place::Nowhere => {
                    not_finite += 1;
                    continue;
                }
            };
            inside += 1;
            lowest_bin = lowest_bin.min(bin(logit));
            visit(Standing { set: layout.set(row), logit });
            bounds.add(mean, layout.log_scales(row));
            let id = RowId { partition: source.index, row: (block * BLOCK_ROWS) as u32 + at as u32 };
            if let Some(candidate) = self.candidate(source, id, row, aligned, bands) {
                reach = reach.max(candidate.reach);
                candidates.push(candidate);
            }
        }
        RowBlock { crc: crc32c::crc32c(rows), inside, not_finite, lowest_bin, bounds, reach }
    }

    /// A row of the cell that may be a duplicate: near a border, and not one of the shared Gaussians.
    fn candidate(
        &self,
        source: &Source<'_>,
        id: RowId,
        row: &[u8],
        aligned: DVec3,
        bands: &Bands,
    ) -> Option<Candidate> {
        let bounds = self.bounds.as_ref()?;
        // Few rows are near enough for any size of Gaussian.
        if !bands.reaches(aligned, f64::INFINITY) {
            return None;
        }
        let splat = source.file.layout.splat(row)?;
        if !bands.reaches(aligned, bounds.reach(splat.log_scales))
            || is_shared(splat.log_scales, self.viewing_distance)
        {
            return None;
        }
        let (mean, logit) = source.file.layout.centre_and_logit(row);
        bounds.candidate(id, row, mean, logit, &splat)
    }
}
