//! The merge: each partition gives the Gaussians of its own cell, and together they are the model.
//!
//! Cells tile the plane, so cropping by cell leaves every Gaussian at most once and no border uncovered
//! (the public code keeps the outer sides closed in grids of one row or column and loses what lies
//! beyond). Rows are copied as bytes, in the order of partitions and of each file, so the result does not
//! depend on who handed in first. Two passes, count then copy, through one buffer: memory does not grow
//! with the model. What passes the cap of the job goes, the most transparent first. The result appears under its name only when it is complete and on disk.

mod ply_rows;
mod thinning;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::partition::{Partition, PartitionId, Plan};
use ply_rows::{Layout, PlyRows};
use thinning::{Opacities, Thinning};

/// The result of one partition: its Gaussians in focus as an INRIA PLY.
#[derive(Clone, Debug, PartialEq)]
pub struct PartitionResult {
    /// Whose it is.
    pub partition: PartitionId,
    /// The file.
    pub path: PathBuf,
}

/// What a merge took.
#[derive(Clone, Debug, PartialEq)]
pub struct Merged {
    /// Gaussians of the model.
    pub gaussians: u64,
    /// Partitions in order.
    pub partitions: Vec<MergedPartition>,
}

/// What one partition gave.
#[derive(Clone, Debug, PartialEq)]
pub struct MergedPartition {
    /// Which.
    pub partition: PartitionId,
    /// Gaussians of its cell that are in the model.
    pub kept: u64,
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
pub fn merge(plan: &Plan, results: &[PartitionResult], cap: u64, out: &Path) -> Result<Merged, MergeError> {
    let sources = in_order(plan, results)?;
    let mut layout: Option<Layout> = None;
    let mut opacities = Opacities::new();
    let mut partitions = Vec::with_capacity(sources.len());
    for (partition, path) in &sources {
        let mut rows = PlyRows::open(path)?;
        let first = layout.get_or_insert_with(|| rows.layout().clone());
        if !first.same_rows(rows.layout()) {
            return Err(MergeError::Layout {
                partition: partition.id,
                first: sources[0].0.id,
                found: rows.layout().describe(),
                expected: first.describe(),
            });
        }
        if first.comments() != rows.layout().comments() {
            return Err(MergeError::Water { partition: partition.id, first: sources[0].0.id });
        }
        partitions.push(count(plan, partition, &mut rows, &mut opacities)?);
    }
    let gaussians = cap.min(partitions.iter().map(|p| p.kept).sum());
    let header = layout.map(|layout| layout.header(gaussians)).unwrap_or_default();
    let mut merged = Merged { gaussians, partitions };

    let temporary = temporary_name(out);
    let written = write(plan, &sources, opacities.thinning(cap), &mut merged, &header, &temporary);
    let renamed = written.and_then(|()| {
        std::fs::rename(&temporary, out).map_err(MergeError::io("rename to", out))?;
        sync_folder(out)
    });
    if let Err(error) = renamed {
        // The first error is the one to tell; a leftover is overwritten by the next attempt.
        let _ = std::fs::remove_file(&temporary);
        return Err(error);
    }
    Ok(merged)
}

/// The file of every partition, in the plan's order.
fn in_order<'a>(
    plan: &'a Plan,
    results: &'a [PartitionResult],
) -> Result<Vec<(&'a Partition, &'a Path)>, MergeError> {
    let mut by_id = BTreeMap::new();
    for result in results {
        let partition = result.partition;
        if plan.partitions.iter().all(|p| p.id != partition) {
            return Err(MergeError::Unknown { partition });
        }
        if by_id.insert(partition, result.path.as_path()).is_some() {
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

/// Where a Gaussian of a partition's result belongs.
enum Place {
    Cell,
    Margin,
    Nowhere,
}

fn place(plan: &Plan, partition: &Partition, mean: [f32; 3], logit: f32) -> Place {
    if !(logit.is_finite() && mean.iter().all(|v| v.is_finite())) {
        Place::Nowhere
    } else if plan.keeps(partition, mean) {
        Place::Cell
    } else {
        Place::Margin
    }
}

/// First pass: how many rows belong where, and the opacities of those of the cell, all of which count as kept here.
fn count(
    plan: &Plan,
    partition: &Partition,
    rows: &mut PlyRows,
    opacities: &mut Opacities,
) -> Result<MergedPartition, MergeError> {
    let mut counts =
        MergedPartition { partition: partition.id, kept: 0, thinned: 0, cropped: 0, not_finite: 0 };
    rows.for_each(|mean, logit, _| {
        match place(plan, partition, mean, logit) {
            Place::Cell => {
                counts.kept += 1;
                opacities.add(logit);
            }
            Place::Margin => counts.cropped += 1,
            Place::Nowhere => counts.not_finite += 1,
        }
        Ok(())
    })?;
    Ok(counts)
}

/// Second pass: the header and the rows that stay, flushed to disk; moves what goes for the cap from kept to thinned.
fn write(
    plan: &Plan,
    sources: &[(&Partition, &Path)],
    mut thinning: Thinning,
    merged: &mut Merged,
    header: &[u8],
    path: &Path,
) -> Result<(), MergeError> {
    let file = File::create(path).map_err(MergeError::io("create", path))?;
    let mut out = BufWriter::with_capacity(1 << 20, file);
    out.write_all(header).map_err(MergeError::io("write", path))?;
    for ((partition, source), counts) in sources.iter().zip(&mut merged.partitions) {
        let (mut kept, mut thinned) = (0, 0);
        PlyRows::open(source)?.for_each(|mean, logit, row| {
            if !matches!(place(plan, partition, mean, logit), Place::Cell) {
                return Ok(());
            }
            if thinning.keeps(logit) {
                kept += 1;
                out.write_all(row).map_err(MergeError::io("write", path))
            } else {
                thinned += 1;
                Ok(())
            }
        })?;
        if kept + thinned != counts.kept {
            let message = format!(
                "gave {} Gaussians when counted and {} when copied: it changed during the merge",
                counts.kept,
                kept + thinned
            );
            return Err(MergeError::File { path: source.to_path_buf(), message });
        }
        (counts.kept, counts.thinned) = (kept, thinned);
    }
    let written: u64 = merged.partitions.iter().map(|partition| partition.kept).sum();
    if written != merged.gaussians {
        let gaussians = merged.gaussians;
        let message = format!(
            "holds {written} Gaussians and its header says {gaussians}: a result changed during the merge"
        );
        return Err(MergeError::File { path: path.to_path_buf(), message });
    }
    let file = out.into_inner().map_err(|e| MergeError::io("write", path)(e.into_error()))?;
    file.sync_all().map_err(MergeError::io("flush", path))
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
mod tests;
