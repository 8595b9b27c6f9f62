//! Datasets: begin, commit, use by jobs, delete.

use super::*;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};

pub fn id(name: &str) -> DatasetId {
    name.parse().unwrap()
}

pub fn reef() -> Tenant {
    "reef".parse().unwrap()
}

/// A dataset of the tenant reef whose files derive from a word.
pub fn dataset(name: &str, request: &str, files: &str) -> NewDataset {
    let root = blob(files);
    NewDataset { id: id(name), tenant: reef(), request_id: request.into(), root, files: 3, bytes: 70 }
}

fn names(rows: &[DatasetRecord]) -> Vec<&str> {
    rows.iter().map(|row| row.id.as_str()).collect()
}

pub async fn a_dataset_is_frozen_once_and_its_files_never_change(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let begun = store.begin_dataset(dataset("a", "one", "files"), T0).await.unwrap();
    assert_eq!((begun.is_committed(), begun.asked_ms, begun.files, begun.bytes), (false, T0, 3, 70));
    // After a lost reply, and by another client with the same files.
    for request in ["one", "two"] {
        let again = store.begin_dataset(dataset("a", request, "files"), T0 + 5).await.unwrap();
        assert_eq!(again, DatasetRecord { asked_ms: T0 + 5, ..begun.clone() });
    }
    let refused = store.begin_dataset(dataset("a", "three", "other files"), T0).await;
    assert!(matches!(refused, Err(StoreError::DatasetExists(_))), "{refused:?}");
    for (name, files) in [("a", "other files"), ("b", "files")] {
        let refused = store.begin_dataset(dataset(name, "one", files), T0).await;
        assert!(matches!(refused, Err(StoreError::RequestIdReused { .. })), "{refused:?}");
    }

    let refused = store.commit_dataset(&reef(), &id("a"), &blob("other files"), T0 + 9).await;
    assert!(matches!(refused, Err(StoreError::DatasetExists(_))), "{refused:?}");
    for later in [10, 20] {
        let frozen = store.commit_dataset(&reef(), &id("a"), &blob("files"), T0 + later).await.unwrap();
        assert_eq!(frozen.committed_ms, Some(T0 + 10), "a repeated call froze it again");
    }
    let again = store.begin_dataset(dataset("a", "one", "files"), T0 + 30).await.unwrap();
    assert_eq!(again.committed_ms, Some(T0 + 10));
    assert_eq!(store.dataset(&reef(), &id("a")).await.unwrap(), again);

    let wreck = "wreck".parse::<Tenant>().unwrap();
    for refused in [
        store.dataset(&wreck, &id("a")).await,
        store.commit_dataset(&wreck, &id("a"), &blob("files"), T0).await,
        store.delete_dataset(&wreck, &id("a")).await.map(|()| again.clone()),
    ] {
        assert!(matches!(refused, Err(StoreError::DatasetNotFound(_))), "another tenant's: {refused:?}");
    }
    let others = NewDataset { tenant: wreck, ..dataset("a", "one", "other files") };
    assert!(!store.begin_dataset(others, T0).await.unwrap().is_committed());
}

pub async fn datasets_are_listed_by_page_and_abandoned_uploads_end(store: Arc<dyn Store>) {
    let store = store.as_ref();
    for (index, name) in ["c", "a", "b", "d"].into_iter().enumerate() {
        store.begin_dataset(dataset(name, name, "files"), T0 + 10 * index as u64).await.unwrap();
    }
    store.commit_dataset(&reef(), &id("a"), &blob("files"), T0).await.unwrap();
    // "reef-2" begins as "reef" does.
    let near = NewDataset { tenant: "reef-2".parse().unwrap(), ..dataset("e", "e", "files") };
    store.begin_dataset(near, T0 + 50).await.unwrap();
    let page = store.datasets(Some(&reef()), None, 3).await.unwrap();
    assert_eq!(names(&page), ["a", "b", "c"]);
    let rest = store.datasets(Some(&reef()), Some((&reef(), &id("c"))), 3).await.unwrap();
    assert_eq!(names(&rest), ["d"]);
    assert_eq!(store.datasets(None, None, 100).await.unwrap().len(), 5);

    // Activity keeps an upload.
    store.begin_dataset(dataset("c", "c", "files"), T0 + 40).await.unwrap();
    let ended = store.forget_given_up(T0 + 40).await.unwrap();
    assert_eq!(names(&ended), ["b", "d"]);
    assert_eq!(names(&store.datasets(None, None, 100).await.unwrap()), ["a", "c", "e"]);
    store.begin_dataset(dataset("b", "another", "other files"), T0 + 60).await.unwrap();
}

pub async fn a_job_is_made_of_a_frozen_dataset_of_its_tenant_and_holds_it(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let job = |number, tenant| NewJob { dataset: Some(id("a")), tenant, ..new_job(number) };
    let refused = store.submit(job(1, reef()), T0).await;
    assert!(matches!(refused, Err(StoreError::DatasetNotFound(_))), "{refused:?}");
    store.begin_dataset(dataset("a", "one", "files"), T0).await.unwrap();
    let refused = store.submit(job(1, reef()), T0).await;
    assert!(matches!(refused, Err(StoreError::DatasetNotCommitted(_))), "{refused:?}");
    store.commit_dataset(&reef(), &id("a"), &blob("files"), T0).await.unwrap();
    let refused = store.submit(job(1, Tenant::default()), T0).await;
    assert!(matches!(refused, Err(StoreError::DatasetNotFound(_))), "of another tenant: {refused:?}");

    let made = store.submit(job(1, reef()), T0).await.unwrap();
    assert_eq!(made.dataset, Some(id("a")));
    assert_eq!(store.submit(job(1, reef()), T0 + 1).await.unwrap(), made);
    let without = NewJob { dataset: None, ..job(1, reef()) };
    let refused = store.submit(without, T0).await;
    assert!(matches!(refused, Err(StoreError::RequestIdReused { .. })), "{refused:?}");

    let refused = store.delete_dataset(&reef(), &id("a")).await;
    assert!(matches!(refused, Err(StoreError::DatasetInUse { .. })), "{refused:?}");
    assert_eq!(store.forget_given_up(u64::MAX).await.unwrap(), []);
    cancel(store, &made.job_id, "", T0 + 2).await.unwrap();
    store.delete(&made.job_id).await.unwrap();
    store.delete_dataset(&reef(), &id("a")).await.unwrap();
    assert_eq!(store.datasets(None, None, 100).await.unwrap(), []);
    let refused = store.delete_dataset(&reef(), &id("a")).await;
    assert!(matches!(refused, Err(StoreError::DatasetNotFound(_))), "{refused:?}");
}

pub async fn datasets_travel_with_an_export(store: Arc<dyn Store>) {
    let store = store.as_ref();
    store.begin_dataset(dataset("a", "one", "files"), T0).await.unwrap();
    store.commit_dataset(&reef(), &id("a"), &blob("files"), T0).await.unwrap();
    store.begin_dataset(dataset("b", "two", "files"), T0).await.unwrap();
    store.submit(NewJob { dataset: Some(id("a")), tenant: reef(), ..new_job(1) }, T0).await.unwrap();
    let export = store.export().await.unwrap();
    assert_eq!((names(&export.datasets), verify::faults(&export)), (vec!["a", "b"], Vec::new()));
    let dir = tempfile::tempdir().unwrap();
    let sled = open(dir.path());
    let others: [&dyn Store; 2] = [&MemoryStore::new(rules(), LEASE_MS, STALL_MS), &sled];
    for other in others {
        other.import(&export).await.unwrap();
        assert_eq!(other.export().await.unwrap(), export);
        let refused = other.delete_dataset(&reef(), &id("a")).await;
        assert!(matches!(refused, Err(StoreError::DatasetInUse { .. })), "{refused:?}");
    }
    drop(sled);
    assert_eq!(names(&open(dir.path()).datasets(None, None, 9).await.unwrap()), ["a", "b"]);
}
