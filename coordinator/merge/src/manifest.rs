//! `model.json` describes `model.ply`, so that a viewer can load it piece by piece, and a reader can see the
//! contribution of each partition.
//!
//! Blocks follow one another in the file and cover it: row `first` is at byte `header_bytes + first *
//! row_bytes`. Within a partition they go along a curve through space, in the order in which workers submit
//! their Gaussians.

use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::files::Files;
use crate::ply_rows::PlyFile;
use crate::source::Extent;
use crate::{MergeError, Merged, MergedBlock, PartitionResult};
use fathom_plan::{Alignment, PartitionId, Plan, Rect};

/// Version of the layout that this program writes.
const FORMAT: u32 = 1;

/// The contents of `model.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelManifest {
    /// Version of this layout.
    pub format: u32,
    /// Name of the file beside this one.
    pub file: String,
    /// Its BLAKE3, 64 lower-case hex digits.
    pub blake3: String,
    /// Its length.
    pub bytes: u64,
    /// Bytes before its first row.
    pub header_bytes: u64,
    /// Bytes of a row.
    pub row_bytes: u64,
    /// Rows.
    pub gaussians: u64,
    /// Axes and unit of the model and of the bounds below: "scene", those of the photographs' poses.
    pub frame: String,
    /// From there to the frame of the cells.
    pub alignment: Alignment,
    /// BLAKE3 of `plan.json`.
    pub plan: String,
    /// The contribution of each partition, in the order of the file.
    pub partitions: Vec<PartitionEntry>,
    /// All rows, in the order of the file.
    pub blocks: Vec<BlockEntry>,
}

/// A partition of the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PartitionEntry {
    /// Its id.
    pub id: PartitionId,
    /// BLAKE3 of its result.
    pub result: String,
    /// Its rectangle of the aligned plane.
    pub cell: Rect,
    /// Its first row.
    pub first: u64,
    /// Its rows in the model.
    pub kept: u64,
    /// Gaussians of its margins, which its neighbours keep.
    pub cropped: u64,
    /// Gaussians that were removed as duplicates of a neighbour's.
    pub duplicates: u64,
    /// Gaussians that were removed because of the cap.
    pub thinned: u64,
    /// Gaussians that were removed because their centre or opacity is not finite.
    pub not_finite: u64,
}

/// A run of rows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BlockEntry {
    /// Its first row.
    pub first: u64,
    /// Number of rows.
    pub rows: u32,
    /// Their partition.
    pub partition: PartitionId,
    /// Smallest coordinates of their centres.
    pub min: [f32; 3],
    /// Largest ones.
    pub max: [f32; 3],
    /// The largest standard deviation of any of them: three times that beyond the box, the block is
    /// invisible. `None` where scales are missing or not finite.
    pub deviation: Option<f32>,
}

impl ModelManifest {
    /// The manifest of a model that [`super::merge`] made from `results`; `plan_digest` is the digest of the
    /// plan's JSON.
    pub fn new(plan: &Plan, plan_digest: &str, results: &[PartitionResult], merged: &Merged) -> Self {
        let mut first = 0;
        let entry = |(given, partition): (&super::MergedPartition, &fathom_plan::Partition)| {
            let result = results.iter().find(|result| result.partition == given.partition);
            let entry = PartitionEntry {
                id: given.partition,
                result: result.map(|result| result.digest.clone()).unwrap_or_default(),
                cell: partition.cell,
                first,
                kept: given.kept,
                cropped: given.cropped,
                duplicates: given.duplicates,
                thinned: given.thinned,
                not_finite: given.not_finite,
            };
            first += given.kept;
            entry
        };
        let partitions = merged.partitions.iter().zip(&plan.partitions).map(entry).collect();
        Self {
            format: FORMAT,
            file: "model.ply".to_owned(),
            blake3: merged.digest.clone(),
            bytes: merged.bytes,
            header_bytes: merged.header_bytes,
            row_bytes: merged.row_bytes,
            gaussians: merged.gaussians,
            frame: "scene".to_owned(),
            alignment: plan.alignment,
            plan: plan_digest.to_owned(),
            partitions,
            blocks: merged.blocks.iter().map(BlockEntry::of).collect(),
        }
    }

    /// The manifest of `model`, a file in `files` with the BLAKE3 `digest` and the rows of the merged model
    /// with other values: digest and bounds are new.
    ///
    /// # Errors
    /// When it cannot be read, or its number or size of rows differs from the merged model.
    pub fn of_changed_rows(
        self,
        files: &Arc<dyn Files>,
        model: &Path,
        digest: &str,
    ) -> Result<Self, MergeError> {
        let file = PlyFile::read(files, model)?;
        let header_bytes = file.header.len() as u64;
        let row_bytes = file.layout.row_bytes();
        if (file.rows, row_bytes as u64) != (self.gaussians, self.row_bytes) {
            let message = format!(
                "has {} rows of {row_bytes} bytes, but {} of {} were merged",
                file.rows, self.gaussians, self.row_bytes
            );
            return Err(MergeError::File { path: model.to_owned(), message });
        }
        let (rows, _) = files.open(model).map_err(MergeError::io("read", model))?;
        let mut rows = BufReader::new(rows);
        rows.seek(SeekFrom::Start(header_bytes)).map_err(MergeError::io("read", model))?;
        let mut bytes = Vec::new();
        let mut blocks = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            bytes.resize(block.rows as usize * row_bytes, 0);
            rows.read_exact(&mut bytes).map_err(MergeError::io("read", model))?;
            let mut bounds = Extent::NONE;
            for row in bytes.chunks_exact(row_bytes) {
                let (mean, _) = file.layout.centre_and_logit(row);
                bounds.add(mean, file.layout.log_scales(row));
            }
            let BlockEntry { first, rows, partition, .. } = *block;
            blocks.push(BlockEntry::of(&MergedBlock { first, rows, partition, bounds }));
        }
        Ok(Self {
            blake3: digest.to_owned(),
            bytes: header_bytes + file.rows * self.row_bytes,
            header_bytes,
            blocks,
            ..self
        })
    }
}

impl BlockEntry {
    fn of(block: &MergedBlock) -> Self {
        let deviation = block.bounds.widest_log.exp();
        Self {
            first: block.first,
            rows: block.rows,
            partition: block.partition,
            min: block.bounds.low,
            max: block.bounds.high,
            deviation: (deviation > 0.0 && deviation.is_finite()).then_some(deviation),
        }
    }
}
