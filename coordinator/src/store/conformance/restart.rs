//! A store on disk when it is reopened, and with many concurrent writers.

use super::*;

#[tokio::test]
async fn acknowledged_data_survives_a_restart_and_leases_get_grace() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path());
    let id = planned_job(&store, 1, 1).await;
    let held = claim(&store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    store.checkpoint(&held, blob("checkpoint"), 40, T0 + 30).await.unwrap();
    let waiting = store.submit(new_job(2), T0 + 40).await.unwrap().job_id;
    let own = claim(&store, &[Stage::Plan], T0 + 50).await.unwrap().lease;
    assert_eq!(own.job, waiting);
    let before = (store.job(&id).await.unwrap().job, store.events(&id, 0, 100).await.unwrap());
    drop(store);

    // Long after the lease's deadline: the coordinator's downtime does not count as silence.
    let now = T0 + 1_000_000;
    let store = open(dir.path());
    store.recover(now).await.unwrap();
    assert_eq!((store.job(&id).await.unwrap().job, store.events(&id, 0, 100).await.unwrap()), before);
    assert!(store.sweep(now + LEASE_MS - 1).await.unwrap().is_empty(), "no grace");
    assert_eq!(store.renew(&held, None, now + 10).await.unwrap(), Renewed::Runs);
    store.complete(&held, result_as(held.task.stage, "right"), now + 20).await.unwrap();
    assert!(
        is_stale(store.complete(&own, planned(1), now + 20).await),
        "the dead process's own task is still held"
    );
    let own_again = claim(&store, &[Stage::Plan], now + 30).await.expect("own task released").lease;
    assert_eq!((own_again.job, own_again.attempt), (waiting, 2));
    assert!(own_again.fence > own.fence.max(held.fence), "a fence was granted twice");
    assert_eq!(store.submit(new_job(1), now).await.unwrap().job_id, id, "the request was forgotten");
}

#[tokio::test]
async fn a_wrong_clock_after_a_restart_ends_no_lease_nor_blocks_tasks() {
    const THREE_DAYS_MS: u64 = 3 * 24 * 3600 * 1000;
    for now in [T0 - THREE_DAYS_MS, T0 + THREE_DAYS_MS] {
        let dir = tempfile::tempdir().unwrap();
        let store = open(dir.path());
        planned_job(&store, 1, 1).await;
        let held = claim(&store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
        // A task that failed, and is in back-off by the old clock.
        planned_job(&store, 2, 1).await;
        let failed = claim(&store, &Stage::of_workers(), T0 + 30).await.unwrap().lease;
        store.fail(&failed, FailClass::Training, "it did".into(), T0 + 40).await.unwrap();
        drop(store);

        let store = open(dir.path());
        store.recover(now).await.unwrap();
        assert!(store.sweep(now + LEASE_MS - 1).await.unwrap().is_empty(), "the lease is over");
        assert_eq!(store.renew(&held, None, now + 10).await.unwrap(), Renewed::Runs);
        let again = claim(&store, &Stage::of_workers(), now + 20).await.expect("a task that is due").lease;
        assert_eq!((again.job, again.task), (failed.job, failed.task));
        assert!(!store.sweep(now + 10 + LEASE_MS).await.unwrap().is_empty(), "silence ends no lease");
    }
}

#[tokio::test]
async fn a_damaged_row_is_named_and_nothing_is_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path());
    let id = store.submit(new_job(1), T0).await.unwrap().job_id;
    drop(store);
    let db =
        when_free(|| ::sled::open(dir.path().join("sled")), |error| matches!(error, ::sled::Error::Io(_)));
    let jobs = db.open_tree("jobs").unwrap();
    let mut row = jobs.get(id.as_str()).unwrap().unwrap().to_vec();
    row[10] ^= 1;
    jobs.insert(id.as_str(), row.clone()).unwrap();
    db.flush().unwrap();
    drop((jobs, db));
    let opened = when_free(
        || match SledStore::open(&options(dir.path())) {
            Err(StoreError::Corrupt { tree, .. }) => Ok(Some(tree)),
            opened => opened.map(|_| None),
        },
        |error| matches!(error, StoreError::InUse { .. }),
    );
    assert_eq!(opened, Some("jobs"), "a damaged store is opened");
    let db =
        when_free(|| ::sled::open(dir.path().join("sled")), |error| matches!(error, ::sled::Error::Io(_)));
    assert_eq!(db.open_tree("jobs").unwrap().get(id.as_str()).unwrap().unwrap(), row);
}

#[tokio::test]
async fn many_writers_share_their_syncs_and_get_different_fences() {
    let dir = tempfile::tempdir().unwrap();
    let store = Arc::new(open(dir.path()));
    let jobs = futures::future::join_all((0..40).map(|number| {
        let store = Arc::clone(&store);
        tokio::spawn(async move { store.submit(new_job(number), T0).await.unwrap() })
    }))
    .await;
    assert_eq!(jobs.len(), 40);
    let grants = futures::future::join_all((0..40).map(|_| {
        let store = Arc::clone(&store);
        tokio::spawn(async move { claim(store.as_ref(), &[Stage::Plan], T0).await.unwrap().lease })
    }))
    .await;
    let mut fences: Vec<u64> = grants.into_iter().map(|lease| lease.unwrap().fence).collect();
    fences.sort_unstable();
    fences.dedup();
    assert_eq!(fences.len(), 40);
}
