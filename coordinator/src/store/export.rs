//! A store as one file: a backup independent of the database's format, and a way to move a store.
//!
//! A file is gzip over a line that names the format and then rows,
//! `[length: u32][JSON][CRC-32C of length and JSON: u32]`, little endian. It contains jobs with their tasks
//! and events, the request ids of deleted jobs, marks of workers, quotas, tokens, datasets, the last fence,
//! and the name of the deployment. The last row has the counts, so that a truncated file is detected. The
//! file is written under a temporary name and renamed, and read to its end before anything is imported.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use fathom_core::CoreError;
use fathom_core::ply::write_whole;
use flate2::Compression;
use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;
use serde::{Deserialize, Serialize};

use super::{StoredEvent, WorkerMark};
use crate::access::TokenRecord;
use crate::datasets::DatasetRecord;
use crate::schedule::{JobId, JobRecord, Quota, TaskRecord, Tenant};

/// First line of every file; a later format has another number.
pub(crate) const MAGIC: &[u8] = b"fathom-store 2\n";
/// Longest accepted row: jobs with very many partitions and events.
const MAX_ROW_BYTES: u32 = 1 << 30;

/// All data of one job in a store.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobExport {
    /// Its row.
    pub job: JobRecord,
    /// Its tasks in order.
    pub tasks: Vec<TaskRecord>,
    /// Its events from the first.
    pub events: Vec<StoredEvent>,
}

/// All data of a store.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Export {
    /// Jobs by ascending name.
    pub jobs: Vec<JobExport>,
    /// Request ids of deleted jobs, each with its job.
    pub taken_requests: Vec<(String, JobId)>,
    /// Marks of workers, by incarnation.
    pub marks: Vec<(String, WorkerMark)>,
    /// Quotas of tenants.
    pub quotas: Vec<(Tenant, Quota)>,
    /// Tokens, by id; digests of them.
    pub tokens: Vec<TokenRecord>,
    /// Datasets, by tenant and name.
    pub datasets: Vec<DatasetRecord>,
    /// The highest fence that was ever granted.
    pub last_fence: u64,
    /// The name of the deployment, if it has one.
    pub deployment: Option<String>,
}

/// A row of the file.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Row {
    Job(Box<JobExport>),
    TakenRequest {
        request_id: String,
        job: JobId,
    },
    Mark {
        incarnation: String,
        mark: WorkerMark,
    },
    Quota {
        tenant: Tenant,
        quota: Quota,
    },
    Token(TokenRecord),
    Dataset(DatasetRecord),
    Deployment(String),
    End {
        jobs: u64,
        taken_requests: u64,
        /// Marks, quotas, tokens, datasets, and the name of the deployment.
        others: u64,
        last_fence: u64,
    },
}

/// Errors of writing or reading a file.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file system failed.
    #[error(transparent)]
    Io(#[from] CoreError),
    /// A file that this program did not write, or not completely.
    #[error("{path}: {message}; nothing was imported")]
    Damaged {
        /// The path.
        path: String,
        /// The fault.
        message: String,
    },
}

impl Export {
    /// Writes a file; an existing file of that name is replaced once the new one is complete.
    ///
    /// # Errors
    /// When the file system fails; an existing file then stays as it was.
    pub fn write(&self, path: &Path) -> Result<(), ExportError> {
        Ok(write_whole(path, |file| self.write_to(file).map_err(CoreError::io("write", path)))?)
    }

    /// The same in memory.
    ///
    /// # Errors
    /// When a row is too large.
    pub fn to_bytes(&self) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.write_to(&mut bytes)?;
        Ok(bytes)
    }

    fn write_to(&self, file: &mut dyn Write) -> io::Result<()> {
        let mut out = GzEncoder::new(file, Compression::default());
        out.write_all(MAGIC)?;
        for job in &self.jobs {
            write_row(&mut out, &Row::Job(Box::new(job.clone())))?;
        }
        for (request_id, job) in &self.taken_requests {
            write_row(&mut out, &Row::TakenRequest { request_id: request_id.clone(), job: job.clone() })?;
        }
        for (incarnation, mark) in &self.marks {
            write_row(&mut out, &Row::Mark { incarnation: incarnation.clone(), mark: mark.clone() })?;
        }
        for (tenant, quota) in &self.quotas {
            write_row(&mut out, &Row::Quota { tenant: tenant.clone(), quota: *quota })?;
        }
        for token in &self.tokens {
            write_row(&mut out, &Row::Token(token.clone()))?;
        }
        for dataset in &self.datasets {
            write_row(&mut out, &Row::Dataset(dataset.clone()))?;
        }
        if let Some(name) = &self.deployment {
            write_row(&mut out, &Row::Deployment(name.clone()))?;
        }
        let (jobs, taken_requests, others) = self.counts();
        write_row(&mut out, &Row::End { jobs, taken_requests, others, last_fence: self.last_fence })?;
        out.finish().map(drop)
    }

    /// Jobs, taken requests, and everything else.
    fn counts(&self) -> (u64, u64, u64) {
        let others = self.marks.len()
            + self.quotas.len()
            + self.tokens.len()
            + self.datasets.len()
            + usize::from(self.deployment.is_some());
        (self.jobs.len() as u64, self.taken_requests.len() as u64, others as u64)
    }

    /// Reads a file that [`Export::write`] wrote.
    ///
    /// # Errors
    /// When it cannot be read, or is incomplete.
    pub fn read(path: &Path) -> Result<Self, ExportError> {
        let file = File::open(path).map_err(CoreError::io("read", path))?;
        let damaged = |message| ExportError::Damaged { path: path.display().to_string(), message };
        Self::parse(BufReader::new(file)).map_err(damaged)
    }

    /// Parses the content of a file.
    pub(crate) fn parse(bytes: impl Read) -> Result<Self, String> {
        let mut bytes = MultiGzDecoder::new(bytes);
        let mut magic = [0; MAGIC.len()];
        let read = bytes.read_exact(&mut magic);
        if read.is_err() || magic != *MAGIC {
            return Err("this is not an export of a store, or it is from a newer program".to_owned());
        }
        let mut export = Self::default();
        loop {
            match read_row(&mut bytes)? {
                Row::Job(job) => export.jobs.push(*job),
                Row::TakenRequest { request_id, job } => export.taken_requests.push((request_id, job)),
                Row::Mark { incarnation, mark } => export.marks.push((incarnation, mark)),
                Row::Quota { tenant, quota } => export.quotas.push((tenant, quota)),
                Row::Token(token) => export.tokens.push(token),
                Row::Dataset(dataset) => export.datasets.push(dataset),
                Row::Deployment(name) => export.deployment = Some(name),
                Row::End { jobs, taken_requests, others, last_fence } => {
                    let found = export.counts();
                    if found != (jobs, taken_requests, others) {
                        return Err(format!("it has {} of {jobs} jobs", found.0));
                    }
                    // The end must be present, with the checksum of gzip, and nothing may follow it.
                    match bytes.read(&mut [0]) {
                        Ok(0) => {}
                        Ok(_) => return Err("extra data follows its end".to_owned()),
                        Err(error) => return Err(format!("it ends too early or is damaged ({error})")),
                    }
                    export.last_fence = last_fence;
                    return Ok(export);
                }
            }
        }
    }
}

fn write_row(out: &mut impl Write, row: &Row) -> io::Result<()> {
    let json = serde_json::to_vec(row)?;
    let length = u32::try_from(json.len()).ok().filter(|&length| length <= MAX_ROW_BYTES);
    let length = length.ok_or_else(|| io::Error::other(format!("a row of {} bytes", json.len())))?;
    out.write_all(&length.to_le_bytes())?;
    out.write_all(&json)?;
    out.write_all(&checksum(length, &json).to_le_bytes())
}

fn read_row(bytes: &mut impl Read) -> Result<Row, String> {
    let cut = |error: io::Error| format!("it ends too early or is damaged ({error})");
    let mut word = [0; 4];
    bytes.read_exact(&mut word).map_err(cut)?;
    let length = u32::from_le_bytes(word);
    if length > MAX_ROW_BYTES {
        return Err(format!("a row of {length} bytes"));
    }
    // Grows with the data: a false length takes no memory.
    let mut json = Vec::new();
    let read = bytes.by_ref().take(length.into()).read_to_end(&mut json).map_err(cut)?;
    if read < length as usize {
        return Err("it ends in the middle of a row".to_owned());
    }
    bytes.read_exact(&mut word).map_err(cut)?;
    if checksum(length, &json) != u32::from_le_bytes(word) {
        return Err("a row has a wrong checksum".to_owned());
    }
    serde_json::from_slice(&json).map_err(|error| format!("a row cannot be read: {error}"))
}

fn checksum(length: u32, json: &[u8]) -> u32 {
    crc32c::crc32c_append(crc32c::crc32c(&length.to_le_bytes()), json)
}

/// Three jobs and one that was deleted.
#[cfg(test)]
pub(crate) fn sample() -> Export {
    use fathom_core::scene::BlobRef;

    use crate::access::{Role, Token};
    use crate::datasets::{DatasetId, NewDataset};
    use crate::schedule::{EventBody, JobState};
    use crate::store::NewJob;

    let job = |number: u32| {
        let new = NewJob { priority: 3, ..NewJob::sample(number) };
        let body = EventBody::JobState { state: JobState::Running, message: String::new() };
        let (job, plan) = new.into_rows(1_700_000_000_000);
        JobExport { job, tasks: vec![plan], events: vec![StoredEvent { seq: 1, time_ms: 7, body }] }
    };
    let taken_requests = vec![("late".to_owned(), JobId::new(1, 2))];
    let mark = WorkerMark { drains: true, reason: "hot".into(), since_ms: 9 };
    let quota = Quota { max_open_jobs: 3, ..Quota::default() };
    let token = Token::parse(&format!("fathom_{}_{}", "a".repeat(12), "b".repeat(64)));
    let reef = "reef".parse::<Tenant>().unwrap_or_default();
    let dataset = NewDataset {
        id: DatasetId::of_request(&reef, "one"),
        tenant: reef.clone(),
        request_id: "one".into(),
        root: BlobRef { digest: "1".repeat(64), bytes: 80 },
        files: 1,
        bytes: 7,
    };
    let dataset = dataset.into_row(1_700_000_000_000);
    Export {
        jobs: (0..3).map(job).collect(),
        taken_requests,
        marks: vec![("incarnation".into(), mark)],
        quotas: vec![(reef.clone(), quota)],
        tokens: token
            .map(|token| TokenRecord::new(&token, "ci".into(), Role::Viewer, Some(reef), 1, Some(2)))
            .into_iter()
            .collect(),
        datasets: vec![dataset],
        last_fence: 41,
        deployment: Some("of the sample".into()),
    }
}

/// The content of a file before compression.
#[cfg(test)]
pub(crate) fn plain(export: &Export) -> Vec<u8> {
    let mut packed = Vec::new();
    let mut plain = Vec::new();
    // Writes to memory do not fail.
    let written = export
        .write_to(&mut packed)
        .and_then(|()| MultiGzDecoder::new(packed.as_slice()).read_to_end(&mut plain));
    assert!(written.is_ok(), "{written:?}");
    plain
}

#[cfg(test)]
mod tests {
    use super::sample as export;
    use super::*;

    #[test]
    fn a_file_reads_back_and_replaces_an_older_one_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("store.gz");
        std::fs::write(&path, "older").unwrap();
        export().write(&path).unwrap();
        assert_eq!(Export::read(&path).unwrap(), export());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "something was left beside it");
        let nowhere = folder.path().join("no such folder/store.gz");
        assert!(export().write(&nowhere).unwrap_err().to_string().contains("no such folder"));
    }

    #[test]
    fn a_file_that_is_cut_or_changed_anywhere_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("store.gz");
        export().write(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let plain = plain(&export());
        let packed = |plain: &[u8]| {
            let mut out = GzEncoder::new(Vec::new(), Compression::fast());
            out.write_all(plain).unwrap();
            out.finish().unwrap()
        };
        assert_eq!(Export::parse(packed(&plain).as_slice()).unwrap(), export());
        for length in 0..plain.len() {
            assert!(
                Export::parse(packed(&plain[..length]).as_slice()).is_err(),
                "{length} bytes of it are accepted"
            );
        }
        for at in 0..plain.len() {
            let mut changed = plain.clone();
            changed[at] ^= 0x20;
            assert!(
                Export::parse(packed(&changed).as_slice()).is_err(),
                "a change of byte {at} is not noticed"
            );
        }
        for length in (0..whole.len()).step_by(7) {
            assert!(Export::parse(&whole[..length]).is_err(), "{length} packed bytes of it are accepted");
        }
    }
}
