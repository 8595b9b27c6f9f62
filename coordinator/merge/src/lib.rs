//! The merge: each partition contributes the Gaussians of its own cell, and together they form the model.
//!
//! Cells tile the plane, so cropping by cell keeps every Gaussian at most once and leaves no gap. (The public
//! code closes the outer sides in grids of one row or column, and loses Gaussians beyond them.) Of
//! near-duplicates across a border one stays (`duplicates`). Beyond the cap of the job the most transparent
//! Gaussians are removed (`thinning`). Rows are copied as bytes, in the order of partitions and of each file,
//! so the result does not depend on the order of submission.
//!
//! There are two passes over the results: `survey` reads every row, `copy` copies most of them by blocks.
//! Memory holds a hundred bytes for 4096 rows, the Gaussians near borders up to a bound, and a few buffers.
//! The result appears under its name only when it is complete and on disk.

mod border;
mod candidate;
mod copy;
mod duplicates;
mod files;
mod manifest;
mod near_borders;
mod ply_rows;
mod source;
mod survey;
mod thinning;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use fathom_core::config::MergeConfig;
use fathom_plan::{Partition, PartitionId, Plan};

pub use files::{Files, LocalFiles, ReadSeek, local_files};
pub use manifest::{BlockEntry, ModelManifest, PartitionEntry};
use ply_rows::PlyFile;
use source::{Extent, Source};
use survey::{Survey, survey};

/// The result of one partition: its Gaussians in focus as an INRIA PLY.
#[derive(Clone, Debug, PartialEq)]
pub struct PartitionResult {
    /// Its partition.
    pub partition: PartitionId,
    /// The file.
    pub path: PathBuf,
    /// BLAKE3 of the submitted file, 64 lower-case hex digits.
    pub digest: String,
}

/// The result of a merge.
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
    /// Number of them.
    pub rows: u32,
    /// Their partition.
    pub partition: PartitionId,
    /// Their bounds.
    bounds: Extent,
}

/// The contribution of one partition.
#[derive(Clone, Debug, PartialEq)]
pub struct MergedPartition {
    /// Its id or path.
    pub partition: PartitionId,
    /// Gaussians of its cell that are in the model.
    pub kept: u64,
    /// Gaussians of its cell that were removed as duplicates of a neighbour's.
    pub duplicates: u64,
    /// Gaussians of its cell that were removed because of the cap.
    pub thinned: u64,
    /// Gaussians of its margins, which its neighbours keep.
    pub cropped: u64,
    /// Gaussians whose centre or opacity is not finite; they are dropped.
    pub not_finite: u64,
}

/// Errors of a merge.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MergeError {
    /// Some partitions have no result.
    #[error(
        "the results of partitions {missing} are missing ({count} of {of}); a model with gaps is refused"
    )]
    Missing {
        /// Their ids.
        missing: String,
        /// Number of them.
        count: usize,
        /// Number of partitions.
        of: usize,
    },
    /// More than one result for a partition.
    #[error("partition {partition} has two results; pass the one that its last fence accepted")]
    Twice {
        /// Its id.
        partition: PartitionId,
    },
    /// A result for a partition that the plan does not have.
    #[error("there is no partition {partition} in the plan")]
    Unknown {
        /// Its id.
        partition: PartitionId,
    },
    /// Rows that do not fit into one file.
    #[error(
        "the Gaussians of partition {partition} have different properties from those of partition {first} \
         ({found} against {expected}); all partitions must be trained with one SH degree and one version"
    )]
    Layout {
        /// Its id.
        partition: PartitionId,
        /// The first partition.
        first: PartitionId,
        /// Its row layout, for messages.
        found: String,
        /// Row layout of the first one, for messages.
        expected: String,
    },
    /// Models with different water or filter headers.
    #[error(
        "the header of partition {partition} has a different water or filter from that of partition {first}; all partitions \
         must be trained with the same one"
    )]
    Water {
        /// Its id.
        partition: PartitionId,
        /// The first partition.
        first: PartitionId,
    },
    /// A file that is not a PLY of Gaussians.
    #[error("{path}: {message}", path = path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// The place and the fault.
        message: String,
    },
    /// A file that cannot be read or written.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Its path.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
}

impl MergeError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Merges the results of all partitions of `plan`, on the local disk, into the PLY `out`, whose folder must
/// exist; at most `cap` Gaussians.
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
    merge_from(&local_files(), plan, results, config, cap, out)
}

/// As [`merge`], of results in `files`; `out` is on the local disk.
///
/// # Errors
/// As [`merge`].
pub fn merge_from(
    files: &Arc<dyn Files>,
    plan: &Plan,
    results: &[PartitionResult],
    config: &MergeConfig,
    cap: u64,
    out: &Path,
) -> Result<Merged, MergeError> {
    let sources = sources(files, plan, results)?;
    let survey = survey(&sources, config)?;
    let temporary = temporary_name(out);
    let written = write(&sources, &survey, cap, &temporary);
    let renamed = written.and_then(|merged| {
        std::fs::rename(&temporary, out).map_err(MergeError::io("rename to", out))?;
        sync_folder(out)?;
        Ok(merged)
    });
    if renamed.is_err() {
        // Report the first error; a leftover file is removed when the coordinator starts.
        let _ = std::fs::remove_file(&temporary);
    }
    renamed
}

/// The files of all partitions in the plan's order, once their headers agree.
fn sources<'a>(
    files: &Arc<dyn Files>,
    plan: &'a Plan,
    results: &'a [PartitionResult],
) -> Result<Vec<Source<'a>>, MergeError> {
    let mut sources: Vec<Source<'a>> = Vec::with_capacity(plan.partitions.len());
    for (index, (partition, result)) in (0..).zip(in_order(plan, results)?) {
        let file = PlyFile::read(files, &result.path)?;
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
        let message = format!("contains {written} Gaussians, but its header counts {gaussians}");
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

/// Surroundings `out`, so that the rename stays on one file system.
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
