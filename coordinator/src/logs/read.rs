//! Reading the lines of a job in the order in which they arrived, over the files of all its attempts.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::io;
use std::path::Path;

use super::files::{Folders, lock};
use super::segment::{Files, path, rows_from};
use super::{Attempt, KeptLine, LOOKED_AT, Row, Wanted};
use crate::schedule::JobId;

/// Position of a reader.
#[derive(Default)]
pub struct Position {
    /// The number up to which everything was read.
    pub number: u64,
    /// Only of a reader of files.
    cursors: BTreeMap<Attempt, Cursor>,
}

impl Position {
    /// After a number returned before; 0 is the beginning.
    pub fn after(number: u64) -> Self {
        Self { number, cursors: BTreeMap::new() }
    }
}

/// Position of a reader in the files of one attempt.
#[derive(Default)]
struct Cursor {
    segment: u64,
    offset: u64,
    /// Whether segments before this one were removed, and the notice is still due.
    after_cut: bool,
    /// Rows read but not returned yet.
    rows: VecDeque<Row>,
}

impl Folders {
    /// The next lines after `position`, at most `limit`, and whether there may be more at once; advances
    /// `position`.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub(super) fn read(
        &self,
        job: &JobId,
        wanted: &Wanted,
        position: &mut Position,
        limit: usize,
    ) -> io::Result<(Vec<KeptLine>, bool)> {
        let folder = self.folder(job);
        // Only lines in files now: a line written during the read might be seen in one file and missed in
        // another.
        let (last, attempts) = {
            let log = self.open(job)?;
            let log = lock(&log);
            let new = |(attempt, files): &(&Attempt, &Files)| {
                files.last > position.number && wanted.admits(**attempt)
            };
            let attempts: BTreeMap<Attempt, Files> =
                log.attempts.iter().filter(new).map(|(attempt, files)| (*attempt, files.clone())).collect();
            (log.last, attempts)
        };
        let mut next: BinaryHeap<Reverse<(u64, Attempt)>> = attempts
            .iter()
            .map(|(attempt, files)| Reverse((files.first.max(position.number + 1), *attempt)))
            .collect();
        let (mut lines, mut looked_at) = (Vec::new(), 0);
        while let Some(Reverse((_, attempt))) = next.pop() {
            let Some(files) = attempts.get(&attempt) else { continue };
            let cursor = position.cursors.entry(attempt).or_default();
            cursor.fill(&folder, attempt, files, position.number)?;
            let Some(number) = cursor.rows.front().map(|row| row.number) else { continue };
            if number > last {
                continue;
            }
            if next.peek().is_some_and(|Reverse((other, _))| *other < number) {
                next.push(Reverse((number, attempt)));
                continue;
            }
            if lines.len() == limit || looked_at == LOOKED_AT {
                return Ok((lines, true));
            }
            looked_at += 1;
            position.number = number;
            if let Some(row) = cursor.rows.pop_front()
                && row.severity >= wanted.severity
            {
                let (task, attempt) = attempt;
                lines.push(KeptLine { task, attempt, row });
            }
            next.push(Reverse((number + 1, attempt)));
        }
        position.number = position.number.max(last);
        Ok((lines, false))
    }
}

impl Cursor {
    /// Reads more rows when the buffer is empty, up to the first row after `number`.
    fn fill(&mut self, folder: &Path, attempt: Attempt, files: &Files, number: u64) -> io::Result<()> {
        loop {
            while self.rows.front().is_some_and(|row| row.number <= number) {
                self.rows.pop_front();
            }
            if !self.rows.is_empty() {
                return Ok(());
            }
            let (rows, end) = match rows_from(&path(folder, attempt, self.segment), self.offset) {
                Ok(read) => read,
                // The segment was removed, alone or with its job.
                Err(error) if error.kind() == io::ErrorKind::NotFound => (Vec::new(), self.offset),
                Err(error) => return Err(error),
            };
            if std::mem::take(&mut self.after_cut)
                && let Some(first) = rows.first()
            {
                self.rows.push_back(first.notice());
            }
            self.rows.extend(rows);
            if end > self.offset {
                self.offset = end;
                continue;
            }
            let Some(&segment) = files.segments.iter().find(|&&segment| segment > self.segment) else {
                self.rows.shrink_to_fit();
                return Ok(());
            };
            self.after_cut = segment > self.segment + 1;
            (self.segment, self.offset) = (segment, 0);
        }
    }
}
