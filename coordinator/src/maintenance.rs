//! Maintenance of a store: export, import, verification. On a data directory, no coordinator may run
//! meanwhile; a database gives a consistent view while one runs.
//!
//! Read-only operations open a copy of the store of a data directory in a separate folder. The original stays
//! unchanged to the byte, and may be on a disk that is read-only or full.

mod moving;

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use fathom_core::scene::{BlobRef, Manifest};

use crate::access::{Role, TokenRecord};
use crate::clock::Clock;
use crate::data_dir;
use crate::datasets::{DatasetRecord, FileList};
use crate::error::CoordinatorError;
use crate::objects::{BlobStore, ObjectError, ObjectsAt, TenantBlobs};
use crate::own_tasks::artifacts::ArtifactIndex;
use crate::references::{Reference, references};
use crate::schedule::{Artifact, Rules, Tenant};
use crate::store::export::{Export, JobExport};
use crate::store::{
    AccessStore, PostgresOptions, PostgresStore, SledOptions, SledStore, Store, StoreError, sync_folder,
    verify,
};

pub use moving::{Moved, move_service};

/// Where the rows and the files of jobs are.
#[derive(Clone, Debug)]
pub struct Place {
    /// The data directory of the coordinator.
    pub data_dir: PathBuf,
    /// URL of the database that has its jobs; `None`: they are in `data_dir`.
    pub store: Option<String>,
    /// URL of the bucket or folder that has its files; `None`: they are in `data_dir`.
    pub objects: Option<String>,
}

/// The database without its URL, which may contain a password; or the data directory.
impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.store {
            Some(_) => f.write_str("the database"),
            None => self.data_dir.display().fmt(f),
        }
    }
}

/// Content of a store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Number of jobs.
    pub jobs: usize,
    /// Their tasks.
    pub tasks: usize,
    /// Their events.
    pub events: usize,
    /// Datasets.
    pub datasets: usize,
}

/// The result of a verification.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verified {
    /// In the store.
    pub counts: Counts,
    /// Distinct blobs that jobs and committed datasets reference.
    pub blobs: usize,
    /// Their bytes.
    pub bytes: u64,
    /// A sentence for each fault.
    pub faults: Vec<String>,
}

impl Counts {
    fn of(export: &Export) -> Self {
        Self {
            jobs: export.jobs.len(),
            tasks: export.jobs.iter().map(|job| job.tasks.len()).sum(),
            events: export.jobs.iter().map(|job| job.events.len()).sum(),
            datasets: export.datasets.len(),
        }
    }
}

/// Writes all jobs of a store into one file. Photographs and models are not in it: they are files in
/// `objects`, of other tenants than the default one in `tenants`. The directory is only read: a copy of its
/// store is opened in `scratch`, or in the system's folder for temporary files.
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, it is damaged, or the copy or the file
/// cannot be written.
pub async fn export(place: &Place, scratch: Option<&Path>, file: &Path) -> Result<Counts, CoordinatorError> {
    let export = open_to_read(place, scratch).await?.export().await?;
    export.write(file)?;
    Ok(Counts::of(&export))
}

/// Creates the store of a data directory from such a file, or fills an empty database.
///
/// # Errors
/// When there is a store already, the database cannot be reached, the file is damaged, or its content
/// violates the rules. Nothing is left behind then.
pub async fn import(file: &Path, place: &Place) -> Result<Counts, CoordinatorError> {
    if let Some(url) = &place.store {
        let export = sound_export(file)?;
        let store = open_database(url).await?;
        store.import(&export).await?;
        store.close().await;
        return Ok(Counts::of(&export));
    }
    let export = sound_export(file)?;
    import_into_folder(&export, &place.data_dir).await?;
    Ok(Counts::of(&export))
}

/// Creates the store of a data directory, which must have none.
async fn import_into_folder(export: &Export, data_dir: &Path) -> Result<(), CoordinatorError> {
    let (store, staged) = (data_dir.join("store"), data_dir.join("store.importing"));
    if store.exists() {
        return Err(CoordinatorError::Maintenance(format!(
            "{} already exists; import into a new data directory",
            store.display()
        )));
    }
    let failed =
        |error: std::io::Error| CoordinatorError::Maintenance(format!("{}: {error}", staged.display()));
    if staged.exists() {
        // The rest of an interrupted import.
        std::fs::remove_dir_all(&staged).map_err(failed)?;
    }
    data_dir::make(data_dir)?;
    let imported = SledStore::open(&options(&staged))?;
    imported.import(export).await?;
    drop(imported);
    std::fs::rename(&staged, &store).and_then(|()| sync_folder(data_dir)).map_err(failed)
}

/// An export without faults.
fn sound_export(file: &Path) -> Result<Export, CoordinatorError> {
    let export = Export::read(file)?;
    match verify::faults(&export).first() {
        None => Ok(export),
        Some(fault) => {
            Err(CoordinatorError::Maintenance(format!("{}: {fault}; nothing was imported", file.display())))
        }
    }
}

/// Issues a token in a store, for when no operator has one any more. Returns the text
/// to show.
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, or the token's settings are invalid.
pub async fn issue_token(
    place: &Place,
    name: &str,
    role: Role,
    tenant: &str,
    days: u32,
) -> Result<String, CoordinatorError> {
    let life_seconds = u64::from(days) * 24 * 60 * 60;
    let issued = TokenRecord::issue(name.to_owned(), role, tenant, life_seconds, Clock::start().now_ms());
    let (token, record) = issued.map_err(|error| CoordinatorError::Maintenance(error.to_string()))?;
    match &place.store {
        Some(url) => open_database(url).await?.put_token(&record).await?,
        None => {
            let store = SledStore::open(&options(&store_of(&place.data_dir)?));
            store.map_err(|error| busy(&place.data_dir, error))?.put_token(&record).await?;
        }
    }
    Ok(token.reveal())
}

/// All tokens in a store, by time of issue, read from a copy as by [`export`].
///
/// # Errors
/// As [`export`].
pub async fn tokens(place: &Place, scratch: Option<&Path>) -> Result<Vec<TokenRecord>, CoordinatorError> {
    let mut tokens = open_to_read(place, scratch).await?.tokens().await?;
    tokens.sort_by(|a, b| (a.created_ms, &a.id).cmp(&(b.created_ms, &b.id)));
    Ok(tokens)
}

/// Writes a backup that a coordinator sent, once it is verified to be complete and valid.
///
/// # Errors
/// When it is not, or the file cannot be written; an existing file then stays as it was.
pub fn keep_backup(backup: &[u8], file: &Path) -> Result<Counts, CoordinatorError> {
    let refuse = |fault: String| {
        CoordinatorError::Maintenance(format!(
            "the backup that arrived cannot be used: {fault}; nothing was written"
        ))
    };
    let export = Export::parse(backup).map_err(refuse)?;
    if let Some(fault) = verify::faults(&export).into_iter().next() {
        return Err(refuse(fault));
    }
    export.write(file)?;
    Ok(Counts::of(&export))
}

/// Verifies every row of a store, the invariants between them, and the blobs that jobs and committed datasets
/// reference. Blobs must exist with the right length and, with `deep`, the right content. Changes nothing, as
/// [`export`].
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, a row cannot be read, or the copy
/// cannot be written.
pub async fn verify(place: &Place, scratch: Option<&Path>, deep: bool) -> Result<Verified, CoordinatorError> {
    let data_dir = place.data_dir.as_path();
    let at = ObjectsAt::parse(place.objects.as_deref(), data_dir)?;
    let (export, mut faults) = match &place.store {
        Some(url) => open_database(url).await?.verified().await?,
        None => {
            let store = open_copy(data_dir, scratch)?;
            let faults = store.index_faults()?;
            (store.export().await?, faults)
        }
    };
    faults.extend(verify::faults(&export));
    let mut verified = Verified { counts: Counts::of(&export), faults, ..Verified::default() };
    // Missing files of an upload are not a fault.
    let committed = || export.datasets.iter().filter(|dataset| dataset.is_committed());
    let of_jobs = export.jobs.iter().map(|job| &job.job.tenant);
    let tenants: BTreeSet<&Tenant> = of_jobs.chain(committed().map(|dataset| &dataset.tenant)).collect();
    for tenant in tenants {
        let jobs: Vec<&JobExport> = export.jobs.iter().filter(|job| job.job.tenant == *tenant).collect();
        let datasets: Vec<&DatasetRecord> = committed().filter(|dataset| dataset.tenant == *tenant).collect();
        let Some(objects) = TenantBlobs::existing(&at, tenant)? else {
            let fault =
                format!("{tenant} has no folder of files, so all files of its jobs and datasets are missing");
            verified.faults.push(fault);
            continue;
        };
        verify_blobs(&Arc::new(objects), &jobs, &datasets, deep, &mut verified).await?;
    }
    Ok(verified)
}

/// Verifies the blobs that the jobs and datasets of one tenant reference.
async fn verify_blobs(
    objects: &Arc<BlobStore>,
    jobs: &[&JobExport],
    datasets: &[&DatasetRecord],
    deep: bool,
    verified: &mut Verified,
) -> Result<(), CoordinatorError> {
    let mut blobs = Blobs { objects, deep, seen: BTreeSet::new(), bytes: 0, faults: Vec::new() };
    for job in jobs {
        for Reference { what, blob, .. } in references(&job.job, &job.tasks) {
            blobs.look(&what, blob).await?;
        }
    }
    for job in jobs {
        let id = &job.job.job_id;
        if let Some(manifest) = blobs.read::<Manifest>(&job.job.manifest).await {
            blobs.look(&format!("points of job {id}"), &manifest.points).await?;
            for view in &manifest.views {
                for blob in std::iter::once(&view.image).chain(&view.mask) {
                    blobs.look(&format!("{} of job {id}", view.name), blob).await?;
                }
            }
        }
        let index = match job.job.output(Artifact::Index) {
            Some(blob) => {
                objects.read(blob).await.ok().and_then(|bytes| ArtifactIndex::from_bytes(&bytes).ok())
            }
            None => None,
        };
        for (path, blob) in index.into_iter().flat_map(|index| index.files) {
            blobs.look(&format!("{path} of job {id}"), &blob).await?;
        }
    }
    for dataset in datasets {
        let id = &dataset.id;
        blobs.look(&format!("list of files of dataset {id}"), &dataset.root).await?;
        // The fault of the list itself is already reported.
        let Ok(text) = objects.read(&dataset.root).await else { continue };
        match FileList::parse(text.into()) {
            Ok(list) => {
                if (list.count(), list.bytes()) != (dataset.files, dataset.bytes) {
                    blobs.faults.push(format!("dataset {id} has other files than its list"));
                }
                for file in list.files() {
                    blobs.look(&format!("{} of dataset {id}", file.path), &file.blob()).await?;
                }
            }
            Err(fault) => blobs.faults.push(format!("list of files of dataset {id} {fault}")),
        }
    }
    verified.blobs += blobs.seen.len();
    verified.bytes += blobs.bytes;
    verified.faults.append(&mut blobs.faults);
    Ok(())
}

/// Blobs to verify, each once.
struct Blobs<'a> {
    objects: &'a Arc<BlobStore>,
    deep: bool,
    seen: BTreeSet<String>,
    bytes: u64,
    faults: Vec<String>,
}

impl Blobs<'_> {
    async fn look(&mut self, what: &str, blob: &BlobRef) -> Result<(), CoordinatorError> {
        if !self.seen.insert(blob.digest.clone()) {
            return Ok(());
        }
        self.bytes += blob.bytes;
        let found = match self.objects.size(&blob.digest).await {
            Ok(bytes) if bytes == blob.bytes => None,
            Ok(bytes) => Some(format!("has {bytes} bytes instead of {}", blob.bytes)),
            Err(ObjectError::NotFound(_)) => Some("does not exist".to_owned()),
            Err(ObjectError::BadDigest(_)) => Some("has no digest".to_owned()),
            Err(error) => return Err(error.into()),
        };
        let found = match found {
            None if self.deep => match self.objects.digest_of(blob).await {
                Ok(digest) if digest == blob.digest => None,
                Ok(digest) => Some(format!("has other content: its digest is {digest}")),
                Err(error) => Some(format!("cannot be read: {error}")),
            },
            found => found,
        };
        self.faults.extend(found.map(|fault| format!("{what} {fault} (blob {})", blob.digest)));
        Ok(())
    }

    async fn read<T: serde::de::DeserializeOwned>(&self, blob: &BlobRef) -> Option<T> {
        // The fault of the blob itself is already reported.
        serde_json::from_slice(&self.objects.read(blob).await.ok()?).ok()
    }
}

fn options(dir: &Path) -> SledOptions {
    // Neither is used: nothing is leased here.
    SledOptions { dir: dir.to_owned(), rules: Rules::default(), lease_ms: 60_000, stall_ms: 0 }
}

/// The store of a data directory, which must exist: a wrong path must not create an empty one.
fn store_of(data_dir: &Path) -> Result<PathBuf, CoordinatorError> {
    let dir = data_dir.join("store");
    if dir.join("sled/db").is_file() {
        return Ok(dir);
    }
    Err(CoordinatorError::Maintenance(format!(
        "{} contains no store; pass the --data-dir of a coordinator",
        data_dir.display()
    )))
}

/// A store for read-only operations.
async fn open_to_read(place: &Place, scratch: Option<&Path>) -> Result<Box<dyn Store>, CoordinatorError> {
    Ok(match &place.store {
        Some(url) => Box::new(open_database(url).await?),
        None => Box::new(open_copy(&place.data_dir, scratch)?),
    })
}

/// The store in a database, beside the coordinator that uses it.
async fn open_database(url: &str) -> Result<PostgresStore, CoordinatorError> {
    // Rules and times are not used: nothing is leased here.
    let options = PostgresOptions {
        url: url.to_owned(),
        rules: Rules::default(),
        lease_ms: 60_000,
        stall_ms: 0,
        connections: 2,
    };
    Ok(PostgresStore::open(&options).await?)
}

/// A copy of the store of a data directory, for read-only operations.
fn open_copy(data_dir: &Path, scratch: Option<&Path>) -> Result<SledStore, CoordinatorError> {
    let options = options(&store_of(data_dir)?);
    SledStore::open_copy(&options, scratch).map_err(|error| busy(data_dir, error))
}

/// A remedy where a coordinator runs: another data directory, as for a second coordinator, does not help
/// here.
fn busy(data_dir: &Path, error: StoreError) -> CoordinatorError {
    match error {
        StoreError::InUse { .. } => CoordinatorError::Maintenance(format!(
            "a coordinator runs on {}; stop it first (`fathom store backup` backs up a running one)",
            data_dir.display()
        )),
        other => other.into(),
    }
}
