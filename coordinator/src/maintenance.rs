//! What is done to a data directory while no coordinator runs on it: export, import, verification.
//!
//! Who only looks opens a copy of the store, in a folder of its own: what is looked at stays as it is to the byte, and may be on a
//! disk that is read-only or full.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use fathom_core::scene::{BlobRef, Manifest};

use crate::access::{Role, TokenRecord};
use crate::clock::Clock;
use crate::data_dir;
use crate::datasets::{DatasetRecord, FileList};
use crate::error::CoordinatorError;
use crate::objects::{BlobStore, ObjectError, TenantBlobs};
use crate::own_tasks::artifacts::ArtifactIndex;
use crate::references::{Reference, references};
use crate::schedule::{Artifact, Rules, Tenant};
use crate::store::dump::{Dump, JobDump};
use crate::store::{AccessStore, SledOptions, SledStore, Store, StoreError, sync_folder, verify};

/// What a store held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Jobs.
    pub jobs: usize,
    /// Tasks of all of them.
    pub tasks: usize,
    /// Events of all of them.
    pub events: usize,
    /// Datasets.
    pub datasets: usize,
}

/// What was looked at, and what is wrong.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verified {
    /// In the store.
    pub counts: Counts,
    /// Different blobs that jobs and committed datasets refer to.
    pub blobs: usize,
    /// Their bytes.
    pub bytes: u64,
    /// A sentence for each fault.
    pub faults: Vec<String>,
}

impl Counts {
    fn of(dump: &Dump) -> Self {
        Self {
            jobs: dump.jobs.len(),
            tasks: dump.jobs.iter().map(|job| job.tasks.len()).sum(),
            events: dump.jobs.iter().map(|job| job.events.len()).sum(),
            datasets: dump.datasets.len(),
        }
    }
}

/// Writes all jobs of a data directory into one file. Photographs and models are not in it: they are files in `objects`, of
/// other tenants than the default one in `tenants`. The directory is only read: a copy of its store is opened in `scratch`, or else
/// where the system has temporary files.
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, it is damaged, or the copy or the file cannot be written.
pub async fn export(
    data_dir: &Path,
    scratch: Option<&Path>,
    file: &Path,
) -> Result<Counts, CoordinatorError> {
    let dump = open_copy(data_dir, scratch)?.export().await?;
    dump.write(file)?;
    Ok(Counts::of(&dump))
}

/// Makes the store of a data directory of such a file.
///
/// # Errors
/// When the directory has a store already, the file is damaged, or what it holds cannot be what the rules made. Nothing is
/// then left behind.
pub async fn import(file: &Path, data_dir: &Path) -> Result<Counts, CoordinatorError> {
    let refuse = |message: String| Err(CoordinatorError::Maintenance(message));
    let (store, staged) = (data_dir.join("store"), data_dir.join("store.importing"));
    if store.exists() {
        return refuse(format!("{} is there already; import into a new data directory", store.display()));
    }
    let dump = Dump::read(file)?;
    if let Some(fault) = verify::faults(&dump).first() {
        return refuse(format!("{}: {fault}; nothing was imported", file.display()));
    }
    let failed =
        |error: std::io::Error| CoordinatorError::Maintenance(format!("{}: {error}", staged.display()));
    if staged.exists() {
        // Of an import that was interrupted.
        std::fs::remove_dir_all(&staged).map_err(failed)?;
    }
    data_dir::make(data_dir)?;
    let imported = SledStore::open(&options(&staged))?;
    imported.import(&dump).await?;
    drop(imported);
    std::fs::rename(&staged, &store).and_then(|()| sync_folder(data_dir)).map_err(failed)?;
    Ok(Counts::of(&dump))
}

/// Makes a token in the store of a data directory: for when no operator has one any more. Gives what is to be shown.
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, or nobody can mean such a token.
pub async fn issue_token(
    data_dir: &Path,
    name: &str,
    role: Role,
    tenant: &str,
    days: u32,
) -> Result<String, CoordinatorError> {
    let life_seconds = u64::from(days) * 24 * 60 * 60;
    let issued = TokenRecord::issue(name.to_owned(), role, tenant, life_seconds, Clock::start().now_ms());
    let (token, record) = issued.map_err(|error| CoordinatorError::Maintenance(error.to_string()))?;
    let store = SledStore::open(&options(&store_of(data_dir)?)).map_err(|error| busy(data_dir, error))?;
    store.put_token(&record).await?;
    Ok(token.reveal())
}

/// All tokens in the store of a data directory, by time of issue, read of a copy as by [`export`].
///
/// # Errors
/// As [`export`].
pub async fn tokens(data_dir: &Path, scratch: Option<&Path>) -> Result<Vec<TokenRecord>, CoordinatorError> {
    let mut tokens = open_copy(data_dir, scratch)?.tokens().await?;
    tokens.sort_by(|a, b| (a.created_ms, &a.id).cmp(&(b.created_ms, &b.id)));
    Ok(tokens)
}

/// Keeps the backup that a coordinator has sent, once it is known to be whole and sound.
///
/// # Errors
/// When it is not, or the file cannot be written; what was there is then as it was.
pub fn keep_backup(backup: &[u8], file: &Path) -> Result<Counts, CoordinatorError> {
    let refuse = |fault: String| {
        CoordinatorError::Maintenance(format!(
            "the backup that arrived cannot be used: {fault}; nothing was written"
        ))
    };
    let dump = Dump::parse(backup).map_err(refuse)?;
    if let Some(fault) = verify::faults(&dump).into_iter().next() {
        return Err(refuse(fault));
    }
    dump.write(file)?;
    Ok(Counts::of(&dump))
}

/// Looks at every row of a store, at what must hold between them, and at the blobs that jobs and committed datasets refer to: whether they are there
/// with the right length and, when `deep`, with the right content. Changes nothing, as [`export`].
///
/// # Errors
/// When a coordinator runs on the directory, there is no store in it, a row cannot be read, or the copy cannot be written.
pub async fn verify(
    data_dir: &Path,
    scratch: Option<&Path>,
    deep: bool,
) -> Result<Verified, CoordinatorError> {
    let store = open_copy(data_dir, scratch)?;
    let mut faults = store.index_faults()?;
    let dump = store.export().await?;
    faults.extend(verify::faults(&dump));
    let mut verified = Verified { counts: Counts::of(&dump), faults, ..Verified::default() };
    // What an upload lacks is no fault.
    let committed = || dump.datasets.iter().filter(|dataset| dataset.is_committed());
    let of_jobs = dump.jobs.iter().map(|job| &job.job.tenant);
    let tenants: BTreeSet<&Tenant> = of_jobs.chain(committed().map(|dataset| &dataset.tenant)).collect();
    for tenant in tenants {
        let jobs: Vec<&JobDump> = dump.jobs.iter().filter(|job| job.job.tenant == *tenant).collect();
        let datasets: Vec<&DatasetRecord> = committed().filter(|dataset| dataset.tenant == *tenant).collect();
        let folder = TenantBlobs::folder(data_dir, tenant);
        if !folder.is_dir() {
            let fault =
                format!("{} is not there, so no file of any job or dataset of {tenant} is", folder.display());
            verified.faults.push(fault);
            continue;
        }
        verify_blobs(&BlobStore::existing(&folder)?, &jobs, &datasets, deep, &mut verified).await?;
    }
    Ok(verified)
}

/// Looks at the blobs that the jobs and datasets of one tenant refer to.
async fn verify_blobs(
    objects: &BlobStore,
    jobs: &[&JobDump],
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
        // What is wrong with the list itself has been said.
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

/// Blobs that are looked at, each once.
struct Blobs<'a> {
    objects: &'a BlobStore,
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
            Ok(bytes) => Some(format!("has {bytes} bytes in place of {}", blob.bytes)),
            Err(ObjectError::NotFound(_)) => Some("is not there".to_owned()),
            Err(ObjectError::BadDigest(_)) => Some("has no digest".to_owned()),
            Err(error) => return Err(error.into()),
        };
        let found = match found {
            None if self.deep => {
                let path = self.objects.local_path(blob)?;
                let digest = tokio::task::spawn_blocking(move || {
                    let mut hasher = blake3::Hasher::new();
                    hasher.update_reader(std::fs::File::open(&path)?)?;
                    Ok::<_, std::io::Error>(hasher.finalize().to_hex().to_string())
                });
                match digest.await.map_err(|error| CoordinatorError::Maintenance(error.to_string()))? {
                    Ok(digest) if digest == blob.digest => None,
                    Ok(digest) => Some(format!("has other content: its digest is {digest}")),
                    Err(error) => Some(format!("cannot be read: {error}")),
                }
            }
            found => found,
        };
        self.faults.extend(found.map(|fault| format!("{what} {fault} (blob {})", blob.digest)));
        Ok(())
    }

    async fn read<T: serde::de::DeserializeOwned>(&self, blob: &BlobRef) -> Option<T> {
        // What is wrong with the blob itself has been said.
        serde_json::from_slice(&self.objects.read(blob).await.ok()?).ok()
    }
}

fn options(dir: &Path) -> SledOptions {
    // Neither is used: nothing is leased here.
    SledOptions { dir: dir.to_owned(), rules: Rules::default(), lease_ms: 60_000, stall_ms: 0 }
}

/// The store of a data directory, which must be there: a wrong path must not make an empty one.
fn store_of(data_dir: &Path) -> Result<PathBuf, CoordinatorError> {
    let dir = data_dir.join("store");
    if dir.join("sled/db").is_file() {
        return Ok(dir);
    }
    Err(CoordinatorError::Maintenance(format!(
        "{} holds no store; give the --data-dir of a coordinator",
        data_dir.display()
    )))
}

/// A copy of the store of a data directory, for who only looks.
fn open_copy(data_dir: &Path, scratch: Option<&Path>) -> Result<SledStore, CoordinatorError> {
    let options = options(&store_of(data_dir)?);
    SledStore::open_copy(&options, scratch).map_err(|error| busy(data_dir, error))
}

/// Says what helps where a coordinator runs: another data directory, as for a second coordinator, is not it.
fn busy(data_dir: &Path, error: StoreError) -> CoordinatorError {
    match error {
        StoreError::InUse { .. } => CoordinatorError::Maintenance(format!(
            "a coordinator runs on {}; stop it first (of one that runs, `fathom store backup` takes a backup)",
            data_dir.display()
        )),
        other => other.into(),
    }
}
