//! The folder of a coordinator. It holds photographs, models and digests of tokens: no other user of the
//! machine may read them.

use std::fs::{self, DirBuilder};
use std::io;
use std::path::Path;

use crate::error::CoordinatorError;
use crate::store::sync_folder;

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
}
