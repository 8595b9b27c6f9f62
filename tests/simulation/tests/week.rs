//! A simulated week of calls on real stores: the invariants hold, and memory does not grow with the week.

use std::path::PathBuf;
use std::sync::Arc;

use fathom_coordinator::store::{PostgresOptions, PostgresStore, SledOptions, SledStore, Store, StoreError};
use fathom_simulation::week::{LEASE_MS, Opens, Played, play, rules};

#[path = "../../support/postgres.rs"]
mod postgres;

const WORKERS: usize = 8;
/// Hours.
const WEEK: u64 = 7 * 24;

struct Directory(PathBuf);

impl Opens for Directory {
    async fn open(&self) -> Result<Arc<dyn Store>, StoreError> {
        let options = SledOptions { dir: self.0.clone(), rules: rules(), lease_ms: LEASE_MS, stall_ms: 0 };
        Ok(Arc::new(SledStore::open(&options)?))
    }
}

struct Database(String);

impl Opens for Database {
    async fn open(&self) -> Result<Arc<dyn Store>, StoreError> {
        let options = PostgresOptions {
            url: self.0.clone(),
            rules: rules(),
            lease_ms: LEASE_MS,
            stall_ms: 0,
            connections: 8,
        };
        Ok(Arc::new(PostgresStore::open_with_own_clock(&options).await?))
    }
}

/// Plays it, and checks that it was a busy one.
fn played(opens: &impl Opens, hours: u64) -> Played {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.expect("a runtime");
    let played = runtime.block_on(play(opens, 7, hours, WORKERS)).expect("the store works");
    assert!(played.violations.is_empty(), "{:#?}", played.violations);
    let count = |what: &str| played.calls.get(what).copied().unwrap_or(0);
    for (what, least) in [("submit", 2), ("claim", 100), ("renew", 500), ("complete", 20)] {
        assert!(count(what) >= least * hours, "{what}: {:?}", played.calls);
    }
    for what in ["taken back", "refused", "repeated", "restart", "checkpoint", "end"] {
        assert!(count(what) > 0, "{what}: {:?}", played.calls);
    }
    let calls: u64 = played.calls.values().sum();
    println!(
        "{hours} hours of {WORKERS} workers: {calls} calls in {:.0?}, {:.0}/s: {:?}\nmemory after each day, MiB: {:.0?}",
        played.took,
        calls as f64 / played.took.as_secs_f64(),
        played.calls,
        played.memory_mib
    );
    played
}

/// From the second day on, as many jobs are deleted as are submitted.
fn does_not_grow(played: &Played) {
    let [_, second, .., last] = played.memory_mib[..] else { panic!("{:?}", played.memory_mib) };
    assert!(last < 1.2 * second + 8.0, "{:?}", played.memory_mib);
}

#[test]
fn both_stores_have_the_same_history_of_some_hours() {
    let folder = tempfile::tempdir().expect("a folder");
    let one = played(&Directory(folder.path().join("store")), 4);
    if let Some(url) = postgres::database() {
        assert_eq!(played(&Database(url), 4).history, one.history, "the same calls gave other events");
    }
}

#[test]
#[ignore = "minutes; run `make soak`"]
fn the_memory_of_a_week_does_not_grow_in_a_data_directory() {
    let folder = tempfile::tempdir().expect("a folder");
    does_not_grow(&played(&Directory(folder.path().join("store")), WEEK));
}

#[test]
#[ignore = "minutes; run `make soak`"]
fn the_memory_of_a_week_does_not_grow_with_a_database() {
    if let Some(url) = postgres::database() {
        does_not_grow(&played(&Database(url), WEEK));
    }
}
