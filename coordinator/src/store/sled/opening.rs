//! Opening a store: refusals, repairs, and syncs before anything is acknowledged.

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::Mutex;

use sled::Mode;

use super::super::StoreError;
use super::super::flusher::{Disk, Flusher, SledDisk};
use super::super::record::decode;
use super::live::Live;
use super::rows::LAST_FENCE;
use super::{SledOptions, SledStore, Trees, snapshots, written_by};
use crate::schedule::{JobRecord, JobState};

impl SledStore {
    /// Opens or creates the store.
    ///
    /// # Errors
    /// When another process has it open, the disk fails, it is damaged, or a program with another layout
    /// wrote it. No row is repaired here, and nothing is deleted. Snapshots that sled did not finish or
    /// cannot read are set aside: its log has the same content.
    pub fn open(options: &SledOptions) -> Result<Self, StoreError> {
        Self::open_on(options, |disk| disk)
    }

    /// As [`SledStore::open`], with a wrapper around the disk.
    pub(in crate::store) fn open_on<D: Disk>(
        options: &SledOptions,
        before: impl FnOnce(SledDisk) -> D,
    ) -> Result<Self, StoreError> {
        let path = options.dir.join("sled");
        let aside = snapshots::set_aside(&path)
            .map_err(|e| StoreError::Failed(format!("{}: a snapshot: {e}", path.display())))?;
        for snapshots::Aside { name, why, now } in aside {
            tracing::warn!(
                "the store's snapshot {name} was set aside: {why}; nothing is lost, it is rebuilt from the log; {} may be deleted",
                now.display()
            );
        }
        let db = sled::Config::new()
            .path(&path)
            .mode(Mode::LowSpace)
            .cache_capacity(64 << 20)
            // sled's periodic flusher also collects its garbage; acknowledgements never wait for it.
            .flush_every_ms(Some(500))
            .open()
            .map_err(|e| open_error(&path, e))?;
        // Before a tree is made or a row is read.
        let written_by = written_by::check(&db, &path)?;
        let tree = |name: &str| db.open_tree(name).map_err(|e| open_error(&path, e));
        let trees = Trees {
            jobs: tree("jobs")?,
            tasks: tree("tasks")?,
            events: tree("events")?,
            requests: tree("requests")?,
            workers: tree("workers")?,
            quotas: tree("quotas")?,
            tokens: tree("tokens")?,
            datasets: tree("datasets")?,
            meta: tree("meta")?,
        };
        sync_names(&options.dir)
            .map_err(|e| StoreError::Failed(format!("{}: {e}", options.dir.display())))?;
        let flusher = Flusher::start(before(SledDisk::open(db.clone(), &path.join("db"))?))?;
        // Reads the number that every transaction needs: this detects another layout or a damaged store at
        // once.
        if let Some(bytes) = trees.meta.get(LAST_FENCE).map_err(|e| open_error(&path, e))? {
            decode::<u64>("meta", &bytes)?;
        }
        let store = Self {
            trees,
            flusher,
            rules: options.rules.clone(),
            lease_ms: options.lease_ms,
            stall_ms: options.stall_ms,
            live: Mutex::default(),
            _copy: None,
        };
        *store.live() = store.read_live()?;
        store.note_program(written_by.as_ref())?;
        Ok(store)
    }

    /// The in-memory state from the rows of open jobs. Leases start in [`Store::recover`].
    pub(super) fn read_live(&self) -> Result<Live, StoreError> {
        let mut live = Live::default();
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            *live.jobs.entry(job.state).or_default() += 1;
            if !job.state.is_open() {
                continue;
            }
            let mut tasks = Vec::new();
            for task in job.shape.tasks() {
                tasks.extend(self.task_record(&job.job_id, task)?);
            }
            live.queue.note(&job, &tasks);
            live.leases.note_paused(&job.job_id, job.state == JobState::Paused);
        }
        live.quotas = self.quota_rows()?.into_iter().collect();
        Ok(live)
    }
}

/// Syncs the folders and files that opening has created. The database sled syncs its log, but neither its
/// settings nor any folder: after a power cut the whole store could be lost.
fn sync_names(dir: &Path) -> io::Result<()> {
    let sled = dir.join("sled");
    File::open(sled.join("conf"))?.sync_all()?;
    for folder in [&sled.join("blobs"), &sled, dir].into_iter().chain(dir.parent()) {
        sync_folder(folder)?;
    }
    Ok(())
}

/// Makes the names in a folder durable.
#[cfg(unix)]
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    File::open(folder)?.sync_all()
}

/// Where a folder cannot be opened as a file, the system itself makes its names durable.
#[cfg(not(unix))]
pub(crate) fn sync_folder(_folder: &Path) -> io::Result<()> {
    Ok(())
}

pub(super) fn open_error(path: &Path, error: sled::Error) -> StoreError {
    match error {
        sled::Error::Corruption { at, .. } => StoreError::Corrupt {
            tree: "sled",
            message: format!("{} cannot be read at {at:?}; nothing in it was changed", path.display()),
        },
        // sled's own message; the system's would only be "would block".
        sled::Error::Io(error) if error.to_string().contains("could not acquire lock") => {
            StoreError::InUse { path: path.display().to_string() }
        }
        other => StoreError::Failed(format!("{}: {other}", path.display())),
    }
}
