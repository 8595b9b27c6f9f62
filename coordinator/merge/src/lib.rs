//! The merge: each partition gives the Gaussians of its own cell, and together they are the model.
//!
//! Cells tile the plane, so cropping by cell leaves every Gaussian at most once and no border uncovered
//! (the public code keeps the outer sides closed in grids of one row or column and loses what lies
//! beyond). Of near-duplicates across a border one stays (`duplicates`), and what passes the cap of the job goes, the most
//! transparent first (`thinning`). Rows are copied as bytes, in the order of partitions and of each file, so the result does
//! not depend on who handed in first.
//!
//! Two passes over the results: `survey` looks at every row, `copy` copies most of them by blocks. What stays in memory is a
//! hundred bytes for 4096 rows, the Gaussians near borders up to a bound, and a few buffers. The result appears under its name
//! only when it is complete and on disk.

mod border;
mod candidate;
mod copy;
mod duplicates;
mod manifest;
mod near_borders;
mod ply_rows;
mod source;
mod survey;
mod thinning;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

use fathom_core::config::MergeConfig;
use fathom_plan::{Partition, PartitionId, Plan};

pub use manifest::{BlockEntry, ModelManifest, PartitionEntry};
use ply_rows::PlyFile;
use source::{Extent, Source};
use survey::{Survey, survey};

/// The result of one partition: its Gaussians in focus as an INRIA PLY.
#[derive(Clone, Debug, PartialEq)]
pub struct PartitionResult {
    /// Whose it is.
    pub partition: PartitionId,
    /// The file.
    pub path: PathBuf,
    /// BLAKE3 of it as it was handed in, 64 lower-case hex digits.
    pub digest: String,
}

/// What a merge gave.
#[derive(Clone, Debug, PartialEq)]
pub struct Merged {
    /// Gaussians of the model.
    pub gaussians: u64,
    /// BLAKE3 of the file, 64 lower-case hex digits.
    pub digest: String,
    /// Its length.
    pub bytes: u64,
    /// Bytes before its first row.
    pub header_bytes: u64,
    /// Bytes of a row.
    pub row_bytes: u64,
    /// Partitions in order.
    pub partitions: Vec<MergedPartition>,
    /// All of its rows, in order.
    pub blocks: Vec<MergedBlock>,
}

/// A run of rows of the model: at most 4096, of one partition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MergedBlock {
    /// Its first row.
    pub first: u64,
    /// How many.
    pub rows: u32,
    /// Who gave them.
    pub partition: PartitionId,
    /// Where they are.
    bounds: Extent,
}

/// What one partition gave.
#[derive(Clone, Debug, PartialEq)]
pub struct MergedPartition {
    /// Which.
    pub partition: PartitionId,
    /// Gaussians of its cell that are in the model.
    pub kept: u64,
    /// Gaussians of its cell that went because a neighbour has the same.
    pub duplicates: u64,
    /// Gaussians of its cell that went because of the cap.
    pub thinned: u64,
    /// Gaussians of its margins, which its neighbours keep.
    pub cropped: u64,
    /// Gaussians whose centre or opacity is not finite; they are dropped.
    pub not_finite: u64,
}

/// Why there is no merged model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MergeError {
    /// Some partitions have not handed in.
    #[error(
        "the merge lacks the results of partitions {missing} ({count} of {of}); a model with a gap is refused"
    )]
    Missing {
        /// Their ids.
        missing: String,
        /// How many.
        count: usize,
        /// Of how many.
        of: usize,
    },
    /// More than one result for a partition.
    #[error("partition {partition} has two results; hand in the one that its last fence accepted")]
    Twice {
        /// Which.
        partition: PartitionId,
    },
    /// A result for a partition that the plan does not have.
    #[error("there is no partition {partition} in the plan")]
    Unknown {
        /// Which.
        partition: PartitionId,
    },
    /// Rows that cannot stand in one file.
    #[error(
        "the Gaussians of partition {partition} have other properties than those of partition {first} \
         ({found} against {expected}); all partitions must be trained with one SH degree and one version"
    )]
    Layout {
        /// Which.
        partition: PartitionId,
        /// The first partition.
        first: PartitionId,
        /// Its row, in words.
        found: String,
        /// The first one's row, in words.
        expected: String,
    },
    /// Models that are meant to be shown in different ways.
    #[error(
        "the header of partition {partition} says another water or filter than that of partition {first}; all partitions \
         must be trained with one"
    )]
    Water {
        /// Which.
        partition: PartitionId,
        /// The first partition.
        first: PartitionId,
    },
    /// A file that is not a PLY of Gaussians.
    #[error("{path}: {message}", path = path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Where and what.
        message: String,
    },
    /// A file that cannot be read or written.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl MergeError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Merges the results of all partitions of `plan` into the PLY `out`, whose folder must exist; at most `cap` Gaussians.
///
/// # Errors
/// [`MergeError`]; `out` is then as it was before.
pub fn merge(
    plan: &Plan,
    results: &[PartitionResult],
    config: &MergeConfig,
    cap: u64,
    out: &Path,
) -> Result<Merged, MergeError> {
    let sources = sources(plan, results)?;
    let survey = survey(&sources, config)?;
    let temporary = temporary_name(out);
    let written = write(&sources, &survey, cap, &temporary);
    let renamed = written.and_then(|merged| {
        std::fs::rename(&temporary, out).map_err(MergeError::io("rename to", out))?;
        sync_folder(out)?;
        Ok(merged)
    });
    if renamed.is_err() {
        // The first error is the one to tell; a leftover is removed when the coordinator starts.
        let _ = std::fs::remove_file(&temporary);
    }
    renamed
}

/// The files of all partitions in the plan's order, once their headers agree.
fn sources<'a>(plan: &'a Plan, results: &'a [PartitionResult]) -> Result<Vec<Source<'a>>, MergeError> {
    let mut sources: Vec<Source<'a>> = Vec::with_capacity(plan.partitions.len());
    for (index, (partition, result)) in (0..).zip(in_order(plan, results)?) {
        let file = PlyFile::read(&result.path)?;
        if let Some(Source { partition: Partition { id: first, .. }, file: PlyFile { layout, .. }, .. }) =
            sources.first()
        {
            if !layout.same_rows(&file.layout) {
                return Err(MergeError::Layout {
                    partition: partition.id,
                    first: *first,
                    found: file.layout.describe(),
                    expected: layout.describe(),
                });
            }
            if layout.comments() != file.layout.comments() {
                return Err(MergeError::Water { partition: partition.id, first: *first });
            }
        }
        sources.push(Source { plan, index, partition, file, digest: &result.digest });
    }
    Ok(sources)
}

/// The second pass: the model under a temporary name, flushed to disk.
fn write(sources: &[Source<'_>], survey: &Survey, cap: u64, path: &Path) -> Result<Merged, MergeError> {
    let gaussians = cap.min(survey.opacities.count());
    let layout = sources.first().map(|source| &source.file.layout);
    let header = layout.map(|layout| layout.header(gaussians)).unwrap_or_default();
    let copied = copy::copy(sources, survey, survey.opacities.thinning(cap), &header, path)?;
    let written: u64 = copied.partitions.iter().map(|partition| partition.kept).sum();
    if written != gaussians {
        let message = format!("holds {written} Gaussians and its header says {gaussians}");
        return Err(MergeError::File { path: path.to_path_buf(), message });
    }
    Ok(Merged {
        gaussians,
        digest: copied.digest,
        bytes: copied.bytes,
        header_bytes: header.len() as u64,
        row_bytes: layout.map_or(0, |layout| layout.row_bytes()) as u64,
        partitions: copied.partitions,
        blocks: copied.blocks,
    })
}

/// The result of every partition, in the plan's order.
fn in_order<'a>(
    plan: &'a Plan,
    results: &'a [PartitionResult],
) -> Result<Vec<(&'a Partition, &'a PartitionResult)>, MergeError> {
    let mut by_id = BTreeMap::new();
    for result in results {
        let partition = result.partition;
        if plan.partitions.iter().all(|p| p.id != partition) {
            return Err(MergeError::Unknown { partition });
        }
        if by_id.insert(partition, result).is_some() {
            return Err(MergeError::Twice { partition });
        }
    }
    let missing: Vec<String> =
        plan.partitions.iter().filter(|p| !by_id.contains_key(&p.id)).map(|p| p.id.to_string()).collect();
    if !missing.is_empty() {
        let (count, of) = (missing.len(), plan.partitions.len());
        return Err(MergeError::Missing { missing: missing.join(", "), count, of });
    }
    Ok(plan.partitions.iter().filter_map(|p| Some((p, *by_id.get(&p.id)?))).collect())
}

/// Beside `out`, so that the rename stays on one file system.
fn temporary_name(out: &Path) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    out.with_file_name(name)
}

/// Makes the rename itself durable.
fn sync_folder(out: &Path) -> Result<(), MergeError> {
    let folder = match out.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    // Windows cannot open folders; NTFS journals the rename itself.
    if cfg!(unix) {
        File::open(folder).and_then(|f| f.sync_all()).map_err(MergeError::io("flush", folder))?;
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod fixtures;
#[cfg(test)]
mod fuzz;
#[cfg(test)]
mod properties;
#[cfg(test)]
mod tests;
