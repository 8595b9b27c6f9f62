#![allow(clippy::unwrap_used)]
use std::sync::Arc;

use fathom_core::scene::BlobRef;

use super::*;
use crate::schedule::{FailClass, Peer, Planned, PlannedTask, TaskOutput};

const NOW_MS: u64 = 1_700_000_000_000;

fn blob() -> BlobRef {
    BlobRef { digest: "0".repeat(64), bytes: 1 }
}

async fn claim(store: &SledStore, kind: TaskKind, request_id: &str) -> Option<Lease> {
    let (name, incarnation) = ("worker".into(), "incarnation".into());
    let worker = Peer { name, incarnation, kinds: vec![kind], memory_bytes: None, tenant: None };
    let claim = Claim { worker, peers: Arc::default(), request_id: request_id.into() };
    store.claim(&claim, NOW_MS).await.unwrap().map(|grant| grant.lease)
}

#[test]
fn a_directory_that_is_open_says_so_to_the_second_one() {
    let dir = tempfile::tempdir().unwrap();
    let options =
        SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
    let first = SledStore::open(&options).unwrap();
    let Err(error) = SledStore::open(&options) else { panic!("opened twice") };
    assert!(matches!(error, StoreError::InUse { .. }), "{error:?}");
    assert!(error.to_string().contains(dir.path().to_str().unwrap()), "{error}");
    drop(first);
    // sled's threads let go of the lock a moment after the last handle is dropped.
    let begin = std::time::Instant::now();
    while let Err(error) = SledStore::open(&options) {
        assert!(begin.elapsed().as_secs() < 10, "{error}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

/// What is kept in memory is what one reads from the rows, whoever did what at the same time.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_queue_says_what_the_rows_say_after_many_threads_have_changed_them() {
    let dir = tempfile::tempdir().unwrap();
    let options =
        SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
    let store = Arc::new(SledStore::open(&options).unwrap());
    let id = store.submit(NewJob::sample(1), NOW_MS).await.unwrap().job_id;
    let plan = claim(&store, TaskKind::Plan, "plan").await.unwrap();
    let planned = Planned {
        refine: Vec::new(),
        borders: None,
        plan: blob(),
        picture: blob(),
        global: None,
        select: false,
        partitions: vec![PlannedTask { spec: blob(), iterations: 1, memory_bytes: 0 }; 40],
        evaluate: None,
        warnings: Vec::new(),
    };
    store.complete(&plan, TaskOutput::Plan(Box::new(planned)), NOW_MS).await.unwrap();
    let lanes = (0..4).map(|lane| {
        let store = Arc::clone(&store);
        tokio::spawn(async move {
            for call in 0..12 {
                let request = format!("{lane} {call}");
                let Some(lease) = claim(&store, TaskKind::Partition, &request).await else { return };
                assert_eq!(claim(&store, TaskKind::Partition, &request).await, Some(lease.clone()));
                match call % 4 {
                    0 => drop(store.fail(&lease, FailClass::Environment, "x".into(), NOW_MS).await),
                    1 => drop(store.release(&lease, "x".into(), NOW_MS).await),
                    2 => {
                        let output = TaskOutput::Blob { blob: blob(), stats: Default::default() };
                        drop(store.complete(&lease, output, NOW_MS).await);
                    }
                    _ => {}
                }
            }
        })
    });
    for lane in lanes.collect::<Vec<_>>() {
        lane.await.unwrap();
    }
    let job = store.job(&id).await.unwrap();
    assert!(job.job.state.is_open() && job.job.leased_tasks > 0, "{:?}", job.job);
    let read = store.read_live().unwrap().queue;
    assert_eq!(format!("{:?}", store.live().queue.leased()), format!("{:?}", read.leased()));
    assert_eq!(store.live().queue.ready(), read.ready());
    let held: usize = store.sweep(NOW_MS + 1000).await.unwrap().len();
    assert_eq!(held, job.job.leased_tasks as usize, "a lease runs that no row knows, or none that one does");
}
