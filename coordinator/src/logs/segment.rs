//! The files of one attempt.

use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use super::files::JobLog;
use super::{Attempt, Row};

/// Upper bound of a row: a message has 4096 bytes, and each may take six in JSON.
pub const MAX_ROW_BYTES: u64 = 32 << 10;

/// Written after a truncated line, so that any part of the line is invalid JSON.
const TORN: &[u8] = b" (torn)\n";

/// Cached data of the files of one attempt.
#[derive(Clone, Debug, Default)]
pub struct Files {
    /// The worker whose lines this process accepted, and its fence.
    pub holder: Option<(String, u64)>,
    /// Numbers of its first and its latest line; 0 when it has none.
    pub first: u64,
    pub last: u64,
    /// Existing segments, ascending.
    pub segments: Vec<u64>,
    /// Bytes of the last segment.
    bytes: u64,
    /// Whether the last segment ends in the middle of a line.
    torn: bool,
    /// Whether lines before the next one were removed: it begins a segment that does not follow the last one.
    pub is_cut: bool,
    /// The highest number from its worker; `None` until it is read.
    pub from_worker: Option<u64>,
}

/// The file of a segment.
pub fn path(folder: &Path, (task, attempt): Attempt, segment: u64) -> PathBuf {
    folder.join(format!("{task}.{attempt}.{segment}"))
}

fn parse_name(name: &str) -> Option<(Attempt, u64)> {
    let (rest, segment) = name.rsplit_once('.')?;
    let (task, attempt) = rest.rsplit_once('.')?;
    Some(((task.parse().ok()?, attempt.parse().ok()?), segment.parse().ok()?))
}

impl JobLog {
    /// The attempts in a folder; empty if it does not exist. Files with other names are ignored.
    pub fn find(folder: &Path) -> io::Result<Self> {
        let mut log = Self::default();
        let entries = match fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(log),
            Err(error) => return Err(error),
        };
        for entry in entries {
            if let Some((attempt, segment)) = entry?.file_name().to_str().and_then(parse_name) {
                log.attempts.entry(attempt).or_default().segments.push(segment);
            }
        }
        for (attempt, files) in &mut log.attempts {
            files.segments.sort_unstable();
            files.look(folder, *attempt)?;
            log.last = log.last.max(files.last);
        }
        Ok(log)
    }
}

impl Files {
    /// Reads the ends of the files.
    fn look(&mut self, folder: &Path, attempt: Attempt) -> io::Result<()> {
        let (Some(&first), Some(&last)) = (self.segments.first(), self.segments.last()) else {
            return Ok(());
        };
        let (rows, _) = rows_from(&path(folder, attempt, first), 0)?;
        self.first = rows.first().map_or(0, |row| row.number);
        let path = path(folder, attempt, last);
        self.bytes = fs::metadata(&path)?.len();
        let (rows, end) = rows_from(&path, self.bytes.saturating_sub(MAX_ROW_BYTES))?;
        self.torn = end < self.bytes;
        self.last = match rows.last() {
            Some(row) => row.number,
            // The segment contains only a truncated line.
            None => self.rows_back(folder, attempt)?.map_or(0, |row| row.number),
        };
        Ok(())
    }

    /// The latest row of the segments before the last.
    fn rows_back(&self, folder: &Path, attempt: Attempt) -> io::Result<Option<Row>> {
        let Some((_, before)) = self.segments.split_last() else { return Ok(None) };
        for &segment in before.iter().rev() {
            if let Some(row) = all_rows(&path(folder, attempt, segment))?.pop() {
                return Ok(Some(row));
            }
        }
        Ok(None)
    }

    /// The highest number of the worker's stored lines; 0 when there are none.
    pub fn last_from_worker(&mut self, folder: &Path, attempt: Attempt) -> io::Result<u64> {
        if let Some(known) = self.from_worker {
            return Ok(known);
        }
        let mut highest = 0;
        for &segment in self.segments.iter().rev() {
            let rows = all_rows(&path(folder, attempt, segment))?;
            highest = rows.iter().filter_map(|row| row.from_worker).max().unwrap_or(0);
            if highest > 0 {
                break;
            }
        }
        self.from_worker = Some(highest);
        Ok(highest)
    }

    /// Records the number of a line before it is written.
    pub fn note(&mut self, number: u64) {
        if self.first == 0 {
            self.first = number;
        }
        self.last = number;
    }

    /// Whether the last segment has room for `bytes` more.
    pub fn has_room(&self, bytes: usize, segment_bytes: u64) -> bool {
        !self.segments.is_empty() && self.bytes + bytes as u64 <= segment_bytes
    }

    /// Appends complete lines; when the last segment is full, begins a new one and removes an old one, so
    /// that at most `segments` are left.
    pub fn write(
        &mut self,
        folder: &Path,
        attempt: Attempt,
        lines: &[u8],
        segment_bytes: u64,
        segments: usize,
    ) -> io::Result<()> {
        let mut segment = self.segments.last().copied();
        let is_cut = std::mem::take(&mut self.is_cut) && segment.is_some();
        if is_cut || !self.has_room(lines.len(), segment_bytes) && (self.bytes > 0 || segment.is_none()) {
            let next = segment.map_or(0, |segment| segment + if is_cut { 2 } else { 1 });
            self.segments.push(next);
            (self.bytes, self.torn, segment) = (0, false, Some(next));
            // The first segment and the latest ones stay.
            while self.segments.len() > segments {
                remove(&path(folder, attempt, self.segments.remove(1)))?;
            }
        }
        let path = path(folder, attempt, segment.unwrap_or(0));
        let mut file = File::options().create(true).append(true).open(path)?;
        // If this fails, the file's content is unknown: the end is closed, and the worker's numbers are
        // reread.
        let torn = std::mem::replace(&mut self.torn, true);
        let from_worker = self.from_worker.take();
        if torn {
            file.write_all(TORN)?;
        }
        file.write_all(lines)?;
        (self.torn, self.from_worker) = (false, from_worker);
        self.bytes += if torn { TORN.len() } else { 0 } as u64 + lines.len() as u64;
        Ok(())
    }

    /// Removes them all.
    pub fn remove(&self, folder: &Path, attempt: Attempt) -> io::Result<()> {
        self.segments.iter().try_for_each(|&segment| remove(&path(folder, attempt, segment)))
    }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn all_rows(path: &Path) -> io::Result<Vec<Row>> {
    let (mut all, mut offset) = (Vec::new(), 0);
    loop {
        let (rows, end) = rows_from(path, offset)?;
        if end == offset {
            return Ok(all);
        }
        all.extend(rows);
        offset = end;
    }
}

/// Rows of a file from `offset` on, about 32 KiB of them, and the end of the last complete line. Invalid rows
/// are skipped.
pub fn rows_from(path: &Path, offset: u64) -> io::Result<(Vec<Row>, u64)> {
    let mut file = File::open(path)?;
    file.seek(SeekFrom::Start(offset))?;
    let mut bytes = Vec::new();
    file.take(MAX_ROW_BYTES).read_to_end(&mut bytes)?;
    let Some(end) = bytes.iter().rposition(|&b| b == b'\n') else {
        // No line is this long, so the data is skipped.
        let passed = if bytes.len() as u64 == MAX_ROW_BYTES { MAX_ROW_BYTES } else { 0 };
        return Ok((Vec::new(), offset + passed));
    };
    let rows = bytes[..end].split(|&b| b == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
    Ok((rows.collect(), offset + end as u64 + 1))
}
