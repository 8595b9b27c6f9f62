//! The folder of a coordinator. It holds photographs, models and digests of tokens: no other user of the
//! machine may read them.

use std::fs::{self, DirBuilder, File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::path::Path;

use crate::error::CoordinatorError;
use crate::store::{StoreError, sync_folder};

/// Creates a data directory that only the owner of this process may enter. An existing one stays as it is:
/// its creator has decided its permissions.
///
/// # Errors
/// When it cannot be made.
pub(crate) fn make(dir: &Path) -> Result<(), CoordinatorError> {
    let made = || -> io::Result<()> {
        if dir.is_dir() {
            return Ok(());
        }
        if let Some(parent) = dir.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            fs::create_dir_all(parent)?;
        }
        match private().create(dir) {
            // Another process has just created it.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && dir.is_dir() => Ok(()),
            Err(error) => Err(error),
            // Data acknowledged later lies in it.
            Ok(()) => sync_folder(dir.parent().unwrap_or(Path::new(""))),
        }
    };
    made().map_err(|error| CoordinatorError::DataDir { path: dir.to_owned(), source: error })
}

/// Names the database that has the jobs of a data directory, and is locked by its coordinator.
const OF_DATABASE: &str = "database.lock";

/// Takes a data directory for a coordinator whose jobs are in the database `place`. The file is locked until
/// it is closed.
///
/// # Errors
/// When another process holds it, or it belongs to the jobs of another store. Without those jobs, garbage
/// collection would delete their files.
pub(crate) fn hold_for_database(dir: &Path, place: &str) -> Result<File, CoordinatorError> {
    let refuse = |message: String| CoordinatorError::Maintenance(message);
    if dir.join("store").exists() {
        return Err(refuse(format!(
            "{dir} has a store of its own, and this coordinator would delete the files of its jobs: move the jobs with \
             `fathom store export` and `fathom store import`, and then remove {store}; or pass another --data-dir",
            dir = dir.display(),
            store = dir.join("store").display()
        )));
    }
    let path = dir.join(OF_DATABASE);
    let failed = |source: io::Error| CoordinatorError::DataDir { path: path.clone(), source };
    let mut file = OpenOptions::new().read(true).append(true).create(true).open(&path).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            return Err(StoreError::InUse { path: dir.display().to_string() }.into());
        }
        Err(TryLockError::Error(error)) => return Err(failed(error)),
    }
    let mut known = String::new();
    file.read_to_string(&mut known).map_err(failed)?;
    match known.trim_end() {
        "" => {
            file.write_all(format!("{place}\n").as_bytes()).and_then(|()| file.sync_all()).map_err(failed)?
        }
        known if known == place => {}
        other => {
            return Err(refuse(format!(
                "the jobs of {dir} are in the database {other}, not in {place}, and this coordinator would delete their \
                 files: pass the right --store, or remove {path} if the database was moved",
                dir = dir.display(),
                path = path.display()
            )));
        }
    }
    sync_folder(dir).map_err(failed)?;
    Ok(file)
}

/// Refuses a data directory whose jobs are in a database.
///
/// # Errors
/// As [`hold_for_database`].
pub(crate) fn refuse_if_of_database(dir: &Path) -> Result<(), CoordinatorError> {
    let path = dir.join(OF_DATABASE);
    let Ok(place) = fs::read_to_string(&path) else { return Ok(()) };
    Err(CoordinatorError::Maintenance(format!(
        "the jobs of {dir} are in the database {place}, and this coordinator would delete their files: pass its --store; or, \
         if the jobs were moved into {dir}, remove {path}",
        dir = dir.display(),
        place = place.trim_end(),
        path = path.display()
    )))
}

#[cfg(unix)]
fn private() -> DirBuilder {
    use std::os::unix::fs::DirBuilderExt as _;
    let mut builder = DirBuilder::new();
    builder.mode(0o700);
    builder
}

/// Without folder modes, the parent folder decides.
#[cfg(not(unix))]
fn private() -> DirBuilder {
    DirBuilder::new()
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn only_a_new_data_directory_is_restricted_to_its_owner() {
        let mode = |dir: &Path| dir.metadata().unwrap().permissions().mode() & 0o777;
        let folder = tempfile::tempdir().unwrap();
        let new = folder.path().join("deep/data");
        make(&new).unwrap();
        assert_eq!(mode(&new), 0o700);
        fs::set_permissions(&new, fs::Permissions::from_mode(0o750)).unwrap();
        make(&new).unwrap();
        assert_eq!(mode(&new), 0o750);
        fs::write(folder.path().join("file"), "").unwrap();
        let error = make(&folder.path().join("file")).unwrap_err().to_string();
        assert!(error.contains("cannot make the data directory"), "{error}");
    }

    #[test]
    fn a_data_directory_serves_the_jobs_of_one_store_only() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path();
        refuse_if_of_database(dir).unwrap();
        let held = hold_for_database(dir, "db:5432/fathom").unwrap();
        let second = hold_for_database(dir, "db:5432/fathom").unwrap_err();
        assert!(matches!(second, CoordinatorError::Store(StoreError::InUse { .. })), "{second}");
        drop(held);
        hold_for_database(dir, "db:5432/fathom").unwrap();
        for (refused, said) in [
            (hold_for_database(dir, "db:5432/empty").map(drop), "are in the database db:5432/fathom, not in"),
            (refuse_if_of_database(dir), "are in the database db:5432/fathom, and"),
        ] {
            let refused = refused.unwrap_err().to_string();
            assert!(refused.contains(said), "{refused}");
        }
        fs::remove_file(dir.join(OF_DATABASE)).unwrap();
        fs::create_dir(dir.join("store")).unwrap();
        let refused = hold_for_database(dir, "db:5432/fathom").unwrap_err().to_string();
        assert!(refused.contains("has a store of its own") && !dir.join(OF_DATABASE).exists(), "{refused}");
    }
}
