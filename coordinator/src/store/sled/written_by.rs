//! The program that wrote a store, and its layout.
//!
//! Every row has its layout number too. This record is read first and names the program, so that another
//! program can name it in its error. It is plain JSON in every layout, for any program to read. A store of an
//! earlier release is migrated (`migrate`).

use std::path::Path;

use serde::{Deserialize, Serialize};
use sled::Db;

use super::super::record::LAYOUT;
use super::super::{PROGRAM, StoreError};
use super::opening::open_error;
use super::{SledStore, migrate};

/// Its key in `meta`.
pub(super) const KEY: &str = "written_by";

/// The program that opened a store last.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct WrittenBy {
    /// Layout of its rows.
    layout: u8,
    /// Its version.
    program: String,
}

/// The program that wrote the store; `None` if not recorded. Creates no tree.
///
/// # Errors
/// When it has a layout that this program does not read, or cannot be read.
pub(super) fn check(db: &Db, path: &Path) -> Result<Option<WrittenBy>, StoreError> {
    if !db.tree_names().iter().any(|name| name.as_ref() == b"meta") {
        return Ok(None);
    }
    let found =
        db.open_tree("meta").and_then(|meta| meta.get(KEY)).map_err(|error| open_error(path, error))?;
    let Some(bytes) = found else { return Ok(None) };
    let written_by: WrittenBy = serde_json::from_slice(&bytes).map_err(|error| StoreError::Corrupt {
        tree: "meta",
        message: format!("{KEY} cannot be read: {error}"),
    })?;
    if written_by.layout < LAYOUT && migrate::leads(migrate::STEPS, written_by.layout, LAYOUT) {
        migrate::run(db, path, written_by.layout, LAYOUT, migrate::STEPS)?;
        return Ok(None);
    }
    if written_by.layout != LAYOUT {
        let WrittenBy { layout: found, program } = written_by;
        return Err(StoreError::OtherLayout { found, program: Some(program), known: LAYOUT });
    }
    Ok(Some(written_by))
}

/// Records that the rows of a store have `layout` now. Durable when it returns.
pub(super) fn note(db: &Db, path: &Path, layout: u8) -> Result<(), StoreError> {
    let text = format!(r#"{{"layout":{layout},"program":"{PROGRAM}"}}"#);
    let noted = db.open_tree("meta").and_then(|meta| meta.insert(KEY, text.as_bytes()));
    noted.and_then(|_| db.flush()).map(drop).map_err(|error| open_error(path, error))
}

impl SledStore {
    /// Records that this program writes the store now, if that is new. Not durable yet: new rows have their
    /// layout in themselves.
    pub(super) fn note_program(&self, found: Option<&WrittenBy>) -> Result<(), StoreError> {
        let now = WrittenBy { layout: LAYOUT, program: PROGRAM.to_owned() };
        if found == Some(&now) {
            return Ok(());
        }
        let unwritable =
            |error: serde_json::Error| StoreError::Unwritable { tree: "meta", message: error.to_string() };
        let bytes = serde_json::to_vec(&now).map_err(unwritable)?;
        let _writing = self.flusher.writing();
        self.trees.meta.insert(KEY, bytes).map(drop).map_err(|error| self.storage_error(error))
    }
}
