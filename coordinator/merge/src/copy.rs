//! The second pass copies the rows that stay, in the order of partitions and rows.
//!
//! Blocks that lie wholly in their cell are copied as they are, and those outside are not read. Rows are
//! examined only in the other blocks: at borders, at duplicates, and where the cap removes rows. While one
//! buffer is hashed and written, the next is filled; this does not affect their content.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use crate::ply_rows::{BLOCK_ROWS, Blocks};
use crate::source::{Extent, Place, RowBlock, Source};
use crate::survey::Survey;
use crate::thinning::{Standing, Thinning};
use crate::{MergeError, MergedBlock, MergedPartition};

/// Bytes after which a buffer is written; the last block may pass it.
const BATCH_BYTES: usize = 4 << 20;
/// Bytes that are hashed and written in turn: few enough to stay in a core's cache in between.
const WRITE_BYTES: usize = 128 << 10;

/// The written file.
pub struct Copied {
    /// BLAKE3 of the file, in hex.
    pub digest: String,
    /// Its length.
    pub bytes: u64,
    /// The contribution of each source.
    pub partitions: Vec<MergedPartition>,
    /// The rows of the file.
    pub blocks: Vec<MergedBlock>,
}

/// Writes the header and the remaining rows, and flushes them to disk.
///
/// # Errors
/// When a file cannot be read or written, or has changed since the first pass.
pub fn copy(
    sources: &[Source<'_>],
    survey: &Survey,
    thinning: Thinning,
    header: &[u8],
    path: &Path,
) -> Result<Copied, MergeError> {
    let mut rows = KeptRows::new(sources, survey, thinning);
    let mut out = Sink::create(path)?;
    out.write(header)?;
    let (mut full, mut empty) = (Vec::new(), Vec::new());
    rows.fill(&mut full)?;
    while !full.is_empty() {
        empty.clear();
        let (written, filled) = rayon::join(|| out.write(&full), || rows.fill(&mut empty));
        written?;
        filled?;
        std::mem::swap(&mut full, &mut empty);
    }
    let (digest, bytes) = out.finish()?;
    Ok(Copied { digest, bytes, partitions: rows.partitions, blocks: rows.written })
}

/// A file that is hashed as it is written.
struct Sink<'a> {
    path: &'a Path,
    file: File,
    hasher: blake3::Hasher,
    bytes: u64,
}

impl<'a> Sink<'a> {
    fn create(path: &'a Path) -> Result<Self, MergeError> {
        let file = File::create(path).map_err(MergeError::io("create", path))?;
        Ok(Self { path, file, hasher: blake3::Hasher::new(), bytes: 0 })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), MergeError> {
        self.bytes += bytes.len() as u64;
        for part in bytes.chunks(WRITE_BYTES) {
            self.hasher.update(part);
            self.file.write_all(part).map_err(MergeError::io("write", self.path))?;
        }
        Ok(())
    }

    fn finish(self) -> Result<(String, u64), MergeError> {
        self.file.sync_all().map_err(MergeError::io("flush", self.path))?;
        Ok((self.hasher.finalize().to_hex().to_string(), self.bytes))
    }
}

/// The remaining rows, batch by batch.
struct KeptRows<'a> {
    sources: &'a [Source<'a>],
    survey: &'a Survey,
    thinning: Thinning,
    /// Source of the next batch.
    source: usize,
    block: usize,
    reader: Option<Blocks<'a>>,
    partitions: Vec<MergedPartition>,
    written: Vec<MergedBlock>,
    rows: u64,
}

impl<'a> KeptRows<'a> {
    fn new(sources: &'a [Source<'a>], survey: &'a Survey, thinning: Thinning) -> Self {
        let counts = |(source, blocks): (&Source<'_>, &Vec<RowBlock>)| {
            let sum = |count: fn(&RowBlock) -> u32| blocks.iter().map(|block| u64::from(count(block))).sum();
            let (inside, not_finite): (u64, u64) = (sum(|block| block.inside), sum(|block| block.not_finite));
            MergedPartition {
                partition: source.partition.id,
                kept: 0,
                thinned: 0,
                duplicates: 0,
                cropped: source.file.rows - inside - not_finite,
                not_finite,
            }
        };
        Self {
            partitions: sources.iter().zip(&survey.blocks).map(counts).collect(),
            sources,
            survey,
            thinning,
            source: 0,
            block: 0,
            reader: None,
            written: Vec::new(),
            rows: 0,
        }
    }

    /// Fills an empty `buffer`; it stays empty at the end.
    fn fill(&mut self, buffer: &mut Vec<u8>) -> Result<(), MergeError> {
        while self.source < self.sources.len() && buffer.len() < BATCH_BYTES {
            let blocks = &self.survey.blocks[self.source];
            let Some(block) = blocks.get(self.block) else {
                (self.source, self.block, self.reader) = (self.source + 1, 0, None);
                continue;
            };
            if block.inside > 0 {
                self.append(block, buffer)?;
            }
            self.block += 1;
        }
        Ok(())
    }

    /// Appends the remaining rows of the current block.
    fn append(&mut self, block: &RowBlock, buffer: &mut Vec<u8>) -> Result<(), MergeError> {
        let (file, number) = (&self.sources[self.source].file, self.block as u64);
        let reader = match &mut self.reader {
            Some(reader) => reader,
            none => none.insert(file.open()?),
        };
        let start = buffer.len();
        buffer.resize(start + file.block_bytes(number), 0);
        reader.read(number, &mut buffer[start..])?;
        block.check(&buffer[start..], file, number)?;

        let (first, rows) = ((number * BLOCK_ROWS) as u32, file.rows_of(number) as u32);
        let duplicates = &self.survey.duplicates[self.source];
        let from = duplicates.partition_point(|&row| row < first);
        let duplicates = &duplicates[from..];
        let is_whole = block.inside == rows && duplicates.first().is_none_or(|&row| row >= first + rows);
        let bounds = if is_whole && self.thinning.keeps_all(block.lowest_bin) {
            self.partitions[self.source].kept += u64::from(rows);
            block.bounds
        } else {
            self.pick(first, duplicates, start, buffer)
        };
        let kept = ((buffer.len() - start) / file.layout.row_bytes()) as u32;
        if kept > 0 {
            let partition = self.sources[self.source].partition.id;
            self.written.push(MergedBlock { first: self.rows, rows: kept, partition, bounds });
            self.rows += u64::from(kept);
        }
        Ok(())
    }

    /// Keeps those of the rows from `start` on that stay; returns their bounds.
    fn pick(&mut self, first: u32, mut duplicates: &[u32], start: usize, buffer: &mut Vec<u8>) -> Extent {
        let source = &self.sources[self.source];
        let (layout, counts) = (&source.file.layout, &mut self.partitions[self.source]);
        let row_bytes = layout.row_bytes();
        let (mut bounds, mut end) = (Extent::NONE, start);
        for (row, at) in (first..).zip((start..buffer.len()).step_by(row_bytes)) {
            let bytes = &buffer[at..at + row_bytes];
            let (mean, logit) = layout.centre_and_logit(bytes);
            if !matches!(source.place(mean, logit), Place::Cell(_)) {
                continue;
            }
            if duplicates.first() == Some(&row) {
                duplicates = &duplicates[1..];
                counts.duplicates += 1;
            } else if self.thinning.keeps(Standing { set: layout.set(bytes), logit }) {
                bounds.add(mean, layout.log_scales(bytes));
                buffer.copy_within(at..at + row_bytes, end);
                end += row_bytes;
                counts.kept += 1;
            } else {
                counts.thinned += 1;
            }
        }
        buffer.truncate(end);
        bounds
    }
}
