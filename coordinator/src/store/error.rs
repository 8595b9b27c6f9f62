//! Errors of stores.

use std::path::PathBuf;

use super::PROGRAM;
use crate::datasets::{DatasetId, MAX_DATASETS};
use crate::schedule::{JobId, Refusal, Tenant};

/// Errors of a store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// There is no such job.
    #[error("there is no job {0}")]
    JobNotFound(JobId),
    /// One request id, two bodies.
    #[error("request id {request_id} was used for another call before; choose a new one")]
    RequestIdReused {
        /// The id.
        request_id: String,
    },
    /// A tenant has reached its limit of open jobs.
    #[error("{tenant} has {limit} open jobs, which is its limit; wait until one ends, or cancel one")]
    TooManyJobs {
        /// The tenant.
        tenant: Tenant,
        /// The limit.
        limit: u32,
    },
    /// The tenant has no such dataset.
    #[error("there is no dataset {0}; `fathom dataset list` lists all datasets")]
    DatasetNotFound(DatasetId),
    /// A name that is already in use.
    #[error("there is a dataset {0} with other files; choose another name, or delete that one first")]
    DatasetExists(DatasetId),
    /// A dataset that is still uploaded.
    #[error("dataset {0} is not committed; upload the missing files and commit it")]
    DatasetNotCommitted(DatasetId),
    /// A dataset that a job uses.
    #[error("dataset {dataset} is used by job {job}; delete that job first")]
    DatasetInUse {
        /// Its id.
        dataset: DatasetId,
        /// One of the jobs that use it.
        job: JobId,
    },
    /// A tenant has reached the limit of datasets.
    #[error("{0} has {MAX_DATASETS} datasets, which is the limit; delete some")]
    TooManyDatasets(Tenant),
    /// The rules forbid it.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// A damaged row.
    #[error(
        "the store is damaged: {tree}: {message}; restore the data directory from a backup, or the database if it has the jobs"
    )]
    Corrupt {
        /// The tree.
        tree: &'static str,
        /// The fault.
        message: String,
    },
    /// A row that is too large; nothing was written.
    #[error(
        "{tree}: a row of {bytes} bytes is larger than {limit}; shorten the configuration or the messages"
    )]
    RowTooLarge {
        /// The tree.
        tree: &'static str,
        /// Its size.
        bytes: usize,
        /// The largest that is written.
        limit: usize,
    },
    /// A row that cannot be written as JSON; nothing was written.
    #[error("{tree}: a row cannot be written: {message}")]
    Unwritable {
        /// The tree.
        tree: &'static str,
        /// Why.
        message: String,
    },
    /// A store with another row layout.
    #[error("{}", of_another_program(*found, program.as_deref(), *known))]
    OtherLayout {
        /// The layout found.
        found: u8,
        /// Version of the program that wrote it, if recorded.
        program: Option<String>,
        /// The layout that this program reads.
        known: u8,
    },
    /// A store that is not empty.
    #[error("the store already contains jobs; import into a new data directory or an empty database")]
    NotEmpty,
    /// Another process has the directory open.
    #[error(
        "{path} is in use by another coordinator; a data directory serves one at a time: stop the coordinator first, or \
         start this one with another --data-dir"
    )]
    InUse {
        /// The store in the data directory.
        path: String,
    },
    /// Another coordinator uses the database.
    #[error(
        "the database is in use by another coordinator; stop that one first, or keep the files of both in one bucket \
         (--objects)"
    )]
    DatabaseInUse,
    /// No room for the copy of a store that is opened read-only.
    #[error(
        "the store is read from a copy, but {scratch} cannot hold it: {message}; pass --scratch DIR with enough space",
        scratch = scratch.display()
    )]
    NoCopy {
        /// The folder of the copy.
        scratch: PathBuf,
        /// The error of the system.
        message: String,
    },
    /// The database server did not answer, or refused. It may come back: nothing has to be started again.
    #[error("the database is not available: {0}")]
    Unavailable(String),
    /// The URL of a database that cannot be read. It may contain a password, so it is not repeated.
    #[error(
        "the URL of the database cannot be read; write postgres://USER@HOST:PORT/DATABASE, and the password in PGPASSWORD or \
         a password file"
    )]
    BadUrl,
    /// A newer program has changed the tables.
    #[error(
        "the tables of the database are those of a newer Fathom (migration {found}), and this is Fathom {program}; start the \
         newer one"
    )]
    OtherSchema {
        /// The migration that this program does not know.
        found: i64,
        /// Version of this program.
        program: &'static str,
    },
    /// The database or its disk failed. Nothing was acknowledged; the coordinator must be started again.
    #[error("the store failed: {0}; free space or repair the disk and start the coordinator again")]
    Failed(String),
}

/// The layout of the first release, 0.2.0.
const FIRST_RELEASED: u8 = 2;

/// Names both programs and a remedy: an older store is not a damaged one.
fn of_another_program(found: u8, program: Option<&str>, known: u8) -> String {
    let is_newer = found > known;
    if found < FIRST_RELEASED {
        return format!(
            "the store was written by Fathom 0.1.0, which was never released, and Fathom {PROGRAM} cannot read it: start with \
             an empty --data-dir and submit its jobs again, or finish them with the program that wrote it"
        );
    }
    let writer = match program {
        Some(version) => format!("Fathom {version}"),
        None => format!("{} Fathom", if is_newer { "a newer" } else { "an older" }),
    };
    let way_out = match is_newer {
        true => format!("start {writer} on it"),
        false => format!(
            "it is older, not damaged: export it with {writer} (`fathom store export`) and import the file with this one"
        ),
    };
    format!(
        "the store was written by {writer} with store layout {found}, and this is Fathom {PROGRAM}, which reads layout \
         {known}; {way_out}"
    )
}
