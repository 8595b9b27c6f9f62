//! Migration of a store from the layout of an earlier release to that of this program.
//!
//! A step rewrites every row from one layout to the next. Each row has its layout number, so an interrupted
//! migration resumes: rows of the next layout are skipped. The store as a whole gets the next number last,
//! once all rows are on disk. The program that wrote the store can then no longer open it, so make a backup
//! first (`fathom store backup`).
//!
//! To change a layout: raise [`LAYOUT`](super::super::record::LAYOUT) and append a step to [`STEPS`].

use std::path::Path;

use serde_json::Value;
use sled::Db;

use super::super::StoreError;
use super::super::record::{encode_as, layout_of};
use super::opening::open_error;
use super::written_by::{self, KEY};

/// From one layout to the next.
pub struct Step {
    /// The layout that it starts from.
    pub from: u8,
    /// Changes a row of a tree; returns a sentence if it cannot.
    pub row: fn(tree: &str, row: Value) -> Result<Value, String>,
}

/// All steps, ascending. Layout 2 is that of the first release, 0.2.0: nothing before it is migrated.
pub const STEPS: &[Step] = &[];

/// Whether `steps` lead from one layout to another.
pub fn leads(steps: &[Step], from: u8, to: u8) -> bool {
    (from..to).all(|layout| steps.iter().any(|step| step.from == layout))
}

/// Migrates a store from layout `from` to layout `to`, to which `steps` lead.
///
/// # Errors
/// When a row cannot be read or changed, or the disk fails. Changed rows stay; the next start resumes.
pub fn run(db: &Db, path: &Path, from: u8, to: u8, steps: &[Step]) -> Result<(), StoreError> {
    for layout in from..to {
        let Some(step) = steps.iter().find(|step| step.from == layout) else { continue };
        tracing::info!(from = layout, to = layout + 1, "migrated the store");
        for name in db.tree_names() {
            migrate_tree(db, path, &name, step)?;
        }
        db.flush().map_err(|error| open_error(path, error))?;
        written_by::note(db, path, layout + 1)?;
    }
    Ok(())
}

fn migrate_tree(db: &Db, path: &Path, name: &[u8], step: &Step) -> Result<(), StoreError> {
    let tree = db.open_tree(name).map_err(|error| open_error(path, error))?;
    let name = String::from_utf8_lossy(name);
    let fault =
        |message: String| StoreError::Corrupt { tree: "migration", message: format!("{name}: {message}") };
    for row in &tree {
        let (key, bytes) = row.map_err(|error| open_error(path, error))?;
        if name == "meta" && key == KEY {
            continue;
        }
        let (layout, json) = layout_of("migration", &bytes)?;
        if layout == step.from + 1 {
            continue;
        }
        if layout != step.from {
            return Err(fault(format!("a row has layout {layout}, but the migration is from {}", step.from)));
        }
        let row = serde_json::from_slice(json).map_err(|error| fault(error.to_string()))?;
        let row = (step.row)(&name, row).map_err(fault)?;
        let bytes = encode_as(layout + 1, "migration", &row)?;
        tree.insert(key, bytes).map_err(|error| open_error(path, error))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::super::record::{LAYOUT, decode};
    use super::super::super::{JobStore, NewJob, SledOptions, SledStore};
    use super::*;
    use crate::schedule::{JobRecord, Rules};

    /// A made-up next layout, in which names of jobs are longer.
    const NEXT: &[Step] = &[Step { from: LAYOUT, row: longer_names }];

    fn longer_names(tree: &str, mut row: Value) -> Result<Value, String> {
        if tree == "jobs" {
            let name = row["name"].as_str().ok_or("a job without a name")?;
            row["name"] = format!("the job {name}").into();
        }
        Ok(row)
    }

    fn options(dir: &Path) -> SledOptions {
        SledOptions { dir: dir.to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 }
    }

    /// Names of jobs in a store, and the layouts of all rows.
    fn look(db: &Db) -> (Vec<String>, Vec<u8>) {
        let (mut names, mut layouts) = (Vec::new(), Vec::new());
        for tree in db.tree_names() {
            for row in &db.open_tree(&tree).unwrap() {
                let (key, bytes) = row.unwrap();
                if key == KEY {
                    continue;
                }
                let (layout, json) = layout_of("test", &bytes).unwrap();
                layouts.push(layout);
                if tree == "jobs" {
                    names.push(serde_json::from_slice::<JobRecord>(json).unwrap().name);
                }
            }
        }
        layouts.dedup();
        (names, layouts)
    }

    #[tokio::test]
    async fn a_migration_changes_every_row_once_even_if_interrupted() {
        let dir = tempfile::tempdir().unwrap();
        let store = SledStore::open(&options(dir.path())).unwrap();
        for number in 0..3 {
            let new = NewJob { name: format!("{number}"), ..NewJob::sample(number) };
            store.submit(new, u64::from(number)).await.unwrap();
        }
        drop(store);
        let path = dir.path().join("sled");
        let db = loop {
            // sled's threads release the lock a moment after the last handle is dropped.
            match sled::open(&path) {
                Ok(db) => break db,
                Err(_) => std::thread::sleep(std::time::Duration::from_millis(10)),
            }
        };
        // Interrupted after the first row of the jobs.
        let jobs = db.open_tree("jobs").unwrap();
        let (key, bytes) = jobs.first().unwrap().unwrap();
        let row: JobRecord = decode("jobs", &bytes).unwrap();
        let row = longer_names("jobs", serde_json::to_value(row).unwrap()).unwrap();
        jobs.insert(key, encode_as(LAYOUT + 1, "jobs", &row).unwrap()).unwrap();

        run(&db, &path, LAYOUT, LAYOUT + 1, NEXT).unwrap();
        let expected = ["the job 0", "the job 1", "the job 2"].map(String::from).to_vec();
        assert_eq!(look(&db), (expected.clone(), vec![LAYOUT + 1]));
        run(&db, &path, LAYOUT, LAYOUT + 1, NEXT).unwrap();
        assert_eq!(look(&db), (expected, vec![LAYOUT + 1]), "migrated twice");
        let error = written_by::check(&db, &path).err().unwrap().to_string();
        assert!(error.contains(&format!("store layout {}", LAYOUT + 1)), "{error}");
    }

    #[test]
    fn steps_lead_only_where_none_is_missing() {
        assert!(leads(NEXT, LAYOUT, LAYOUT + 1) && leads(NEXT, LAYOUT, LAYOUT));
        assert!(!leads(NEXT, LAYOUT - 1, LAYOUT + 1) && !leads(NEXT, LAYOUT, LAYOUT + 2));
        assert!(leads(STEPS, 2, LAYOUT), "a release whose stores cannot be migrated");
    }
}
