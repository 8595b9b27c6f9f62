use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use fathom_core::scene::BlobRef;

use super::super::PROGRAM;
use super::*;
use crate::schedule::{FailClass, Planned, PlannedTask, Stage, TaskOutput, WorkerProfile};

const NOW_MS: u64 = 1_700_000_000_000;

fn blob() -> BlobRef {
    BlobRef { digest: "0".repeat(64), bytes: 1 }
}

async fn claim(store: &SledStore, stage: Stage, request_id: &str) -> Option<Lease> {
    let (name, incarnation) = ("worker".into(), "incarnation".into());
    let worker = WorkerProfile {
        name,
        incarnation,
        stages: vec![stage],
        methods: fathom_core::config::Method::ALL.to_vec(),
        memory_bytes: None,
        tenant: None,
    };
    let claim = Claim { worker, peers: Arc::default(), request_id: request_id.into() };
    store.claim(&claim, NOW_MS).await.unwrap().map(|grant| grant.lease)
}

/// The plan of a job with this many partitions and no optional stages.
fn planned(partitions: u32) -> TaskOutput {
    let own = [Stage::Merge, Stage::Artifacts].map(|stage| (stage.task(), PlannedTask::default()));
    let trained = (0..partitions).map(|index| (Stage::Partition.task_of(index), PlannedTask::new(blob(), 1)));
    let planned = Planned { tasks: trained.chain(own).collect(), warnings: Vec::new() };
    TaskOutput::planned(blob(), blob(), planned)
}

#[test]
fn a_second_opener_is_refused_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    let options =
        SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
    let first = SledStore::open(&options).unwrap();
    let Err(error) = SledStore::open(&options) else { panic!("opened twice") };
    assert!(matches!(error, StoreError::InUse { .. }), "{error:?}");
    assert!(error.to_string().contains(dir.path().to_str().unwrap()), "{error}");
    drop(first);
    // sled's threads release the lock a moment after the last handle is dropped.
    let begin = std::time::Instant::now();
    while let Err(error) = SledStore::open(&options) {
        assert!(begin.elapsed().as_secs() < 10, "{error}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

/// The in-memory state equals that of the rows, after any concurrent changes.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_queue_matches_the_rows_after_concurrent_changes() {
    let dir = tempfile::tempdir().unwrap();
    let options =
        SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
    let store = Arc::new(SledStore::open(&options).unwrap());
    let id = store.submit(NewJob::sample(1), NOW_MS).await.unwrap().job_id;
    let plan = claim(&store, Stage::Plan, "plan").await.unwrap();
    store.complete(&plan, planned(40), NOW_MS).await.unwrap();
    let lanes = (0..4).map(|lane| {
        let store = Arc::clone(&store);
        tokio::spawn(async move {
            for call in 0..12 {
                let request = format!("{lane} {call}");
                let Some(lease) = claim(&store, Stage::Partition, &request).await else { return };
                assert_eq!(claim(&store, Stage::Partition, &request).await, Some(lease.clone()));
                match call % 4 {
                    0 => drop(store.fail(&lease, FailClass::Environment, "x".into(), NOW_MS).await),
                    1 => drop(store.release(&lease, "x".into(), NOW_MS).await),
                    2 => {
                        let output = TaskOutput::of(lease.task.stage, blob(), Default::default());
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
    assert_eq!(held, job.job.leased_tasks as usize, "running leases differ from the rows");
}

fn options_in(dir: &tempfile::TempDir) -> SledOptions {
    SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 }
}

/// Reopens a store whose last handle was just dropped.
fn open_again(options: &SledOptions) -> Result<SledStore, StoreError> {
    let begin = std::time::Instant::now();
    loop {
        match SledStore::open(options) {
            Err(StoreError::InUse { .. }) if begin.elapsed().as_secs() < 10 => {
                std::thread::sleep(std::time::Duration::from_millis(20));
            }
            opened => return opened,
        }
    }
}

/// A store with jobs, opened often enough to have a snapshot, and its rows.
async fn store_with_a_snapshot(options: &SledOptions) -> (PathBuf, Export) {
    let store = SledStore::open(options).unwrap();
    for seed in 1..40 {
        store.submit(NewJob::sample(seed), NOW_MS).await.unwrap();
    }
    drop(store);
    let store = open_again(options).unwrap();
    let rows = store.export().await.unwrap();
    drop(store);
    let sled = options.dir.join("sled");
    let names = std::fs::read_dir(&sled).unwrap().map(|entry| entry.unwrap().path());
    let is_snapshot = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with("snap.");
    let snapshots: Vec<PathBuf> = names.filter(is_snapshot).collect();
    let [snapshot] = <[PathBuf; 1]>::try_from(snapshots).expect("one snapshot");
    (snapshot, rows)
}

async fn assert_whole(options: &SledOptions, rows: &Export, what: &str) {
    let store = open_again(options).unwrap_or_else(|error| panic!("{what}: {error}"));
    assert!(&store.export().await.unwrap() == rows, "{what}: other rows");
}

#[tokio::test]
async fn a_truncated_snapshot_is_set_aside_and_no_row_is_missing() {
    let dir = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let (snapshot, rows) = store_with_a_snapshot(&options).await;
    let whole = std::fs::read(&snapshot).unwrap();
    // Later by name than every snapshot, as a full disk leaves it: empty, or truncated anywhere.
    let unfinished = dir.path().join("sled/snap.7FFFFFFFFFFFFFFF.generating");
    for length in [0, 5, 12, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&unfinished, &whole[..length]).unwrap();
        assert_whole(&options, &rows, &format!("{length} bytes")).await;
        assert!(!unfinished.exists(), "{length}");
        assert_eq!(
            std::fs::read(dir.path().join("sled/set-aside.unfinished-snapshot")).unwrap(),
            &whole[..length]
        );
    }
}

#[tokio::test]
async fn a_snapshot_with_a_flipped_bit_is_made_again_from_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let (snapshot, rows) = store_with_a_snapshot(&options).await;
    let whole = std::fs::read(&snapshot).unwrap();
    for at in [0, whole.len() / 3, whole.len() - 4, whole.len() - 1] {
        let mut flipped = whole.clone();
        flipped[at] ^= 4;
        std::fs::write(&snapshot, &flipped).unwrap();
        assert_whole(&options, &rows, &format!("byte {at}")).await;
        assert_eq!(std::fs::read(dir.path().join("sled/set-aside.unreadable-snapshot")).unwrap(), flipped);
        // The new snapshot of sled may have another name.
        for entry in std::fs::read_dir(dir.path().join("sled")).unwrap() {
            let path = entry.unwrap().path();
            if path.file_name().unwrap().to_string_lossy().starts_with("snap.") {
                std::fs::remove_file(path).unwrap();
            }
        }
    }
}

#[tokio::test]
async fn the_snapshot_that_an_open_store_is_writing_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let store = SledStore::open(&options).unwrap();
    let under_way = dir.path().join("sled/snap.7FFFFFFFFFFFFFFF.generating");
    std::fs::write(&under_way, [1, 2, 3]).unwrap();
    assert!(matches!(SledStore::open(&options), Err(StoreError::InUse { .. })));
    assert_eq!(std::fs::read(&under_way).unwrap(), [1, 2, 3]);
    drop(store);
}

/// Writes a raw row of `meta`, bypassing the store.
fn put_in_meta(options: &SledOptions, key: &str, bytes: &[u8]) {
    let begin = std::time::Instant::now();
    let db = loop {
        // sled's threads release the lock a moment after the last handle is dropped.
        match sled::open(options.dir.join("sled")) {
            Err(sled::Error::Io(_)) if begin.elapsed().as_secs() < 10 => {
                std::thread::sleep(std::time::Duration::from_millis(20));
            }
            opened => break opened.unwrap(),
        }
    };
    db.open_tree("meta").unwrap().insert(key, bytes).unwrap();
    db.flush().unwrap();
}

#[tokio::test]
async fn a_store_of_another_layout_is_refused_with_both_versions() {
    let dir = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let store = SledStore::open(&options).unwrap();
    store.submit(NewJob::sample(1), NOW_MS).await.unwrap();
    drop(store);
    for (layout, expected) in [
        (
            3,
            "written by Fathom 9.8.7 with store layout 3, and this is Fathom VERSION, which reads layout 2; start Fathom",
        ),
        (
            1,
            "written by Fathom 0.1.0, which was never released, and Fathom VERSION cannot read it: start with an empty",
        ),
    ] {
        // This program ignores fields that a later program may add.
        let text = format!(r#"{{"layout":{layout},"program":"9.8.7","cipher":"none"}}"#);
        put_in_meta(&options, "written_by", text.as_bytes());
        let Err(error) = open_again(&options) else { panic!("layout {layout} was opened") };
        let said = error.to_string();
        assert!(said.contains(&expected.replace("VERSION", PROGRAM)), "{said}");
        put_in_meta(&options, "written_by", br#"{"layout":2,"program":"0.0.1"}"#);
    }
}

#[tokio::test]
async fn a_store_without_a_program_is_accepted_and_gets_this_one() {
    let dir = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let store = SledStore::open(&options).unwrap();
    store.submit(NewJob::sample(1), NOW_MS).await.unwrap();
    let rows = store.export().await.unwrap();
    drop(store);
    for earlier in [None, Some(r#"{"layout":2,"program":"0.0.1"}"#)] {
        let store = open_again_with(&options, earlier);
        assert!(store.export().await.unwrap() == rows, "{earlier:?}");
        let noted = store.trees.meta.get("written_by").unwrap().unwrap();
        let noted = String::from_utf8(noted.to_vec()).unwrap();
        assert_eq!(noted, format!(r#"{{"layout":2,"program":"{PROGRAM}"}}"#));
    }

    fn open_again_with(options: &SledOptions, earlier: Option<&str>) -> SledStore {
        let store = open_again(options).unwrap();
        match earlier {
            Some(text) => drop(store.trees.meta.insert("written_by", text).unwrap()),
            None => drop(store.trees.meta.remove("written_by").unwrap()),
        }
        drop(store);
        open_again(options).unwrap()
    }
}

/// Every file under a folder, with what is in it.
fn files_under(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => drop(files.insert(path.clone(), std::fs::read(&path).unwrap())),
            }
        }
    }
    files
}

#[tokio::test]
async fn read_only_access_opens_a_copy_and_changes_no_byte() {
    let dir = tempfile::tempdir().unwrap();
    let scratch = tempfile::tempdir().unwrap();
    let options = options_in(&dir);
    let (_, rows) = store_with_a_snapshot(&options).await;
    // As a full disk leaves it.
    std::fs::write(dir.path().join("sled/snap.7FFFFFFFFFFFFFFF.generating"), "").unwrap();
    // sled's threads have released the directory once it can be copied.
    while let Err(error) = SledStore::open_copy(&options, Some(scratch.path())) {
        assert!(matches!(error, StoreError::InUse { .. }), "{error}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let before = files_under(dir.path());
    let copy = SledStore::open_copy(&options, Some(scratch.path())).unwrap();
    assert!(copy.export().await.unwrap() == rows);
    // The copy is a store of its own, and the other one is free.
    copy.submit(NewJob::sample(99), NOW_MS).await.unwrap();
    assert!(
        before == files_under(dir.path()),
        "a read-only operation changed {:?}",
        files_under(dir.path()).keys()
    );
    let other = open_again(&options).unwrap();
    assert!(other.export().await.unwrap() == rows);
    let busy = SledStore::open_copy(&options, Some(scratch.path()));
    assert!(matches!(busy, Err(StoreError::InUse { .. })), "a store was copied while it was written");
    drop(copy);
    assert_eq!(files_under(scratch.path()).len(), 0, "the copy is still there");
    let nowhere = SledStore::open_copy(&options, Some(Path::new("/dev/null")));
    drop(other);
    let Err(error) = nowhere else { panic!("a copy was made nowhere") };
    assert!(error.to_string().contains("--scratch"), "{error}");
}

/// A backup is the store at one moment, despite concurrent changes, and includes everything acknowledged
/// before.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_backup_during_work_is_valid_and_has_all_acknowledged_data() {
    const WRITERS: u32 = 4;
    let dir = tempfile::tempdir().unwrap();
    let store = Arc::new(SledStore::open(&options_in(&dir)).unwrap());
    let acknowledged = Arc::new(Mutex::new(Vec::<(JobId, u64)>::new()));
    let stop = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let writers = (0..WRITERS).map(|writer| {
        let (store, acknowledged, stop) = (Arc::clone(&store), Arc::clone(&acknowledged), Arc::clone(&stop));
        tokio::spawn(async move {
            for turn in 0_u32.. {
                if stop.load(std::sync::atomic::Ordering::Relaxed) {
                    return turn;
                }
                let number = (writer << 20) + turn;
                let id = store.submit(NewJob::sample(number), NOW_MS).await.unwrap().job_id;
                for _ in 0..3 {
                    let Some(lease) = claim(&store, Stage::Plan, &format!("{number}")).await else {
                        break;
                    };
                    drop(store.complete(&lease, planned(6), NOW_MS).await);
                }
                let last_seq = store.job(&id).await.unwrap().job.last_seq;
                acknowledged.lock().unwrap().push((id.clone(), last_seq));
                if turn % 5 == 4 {
                    store.apply(&id, Event::Cancel { reason: "x".into() }, NOW_MS).await.unwrap();
                    store.delete(&id).await.unwrap();
                    acknowledged.lock().unwrap().retain(|(known, _)| *known != id);
                }
            }
            0
        })
    });
    let writers: Vec<_> = writers.collect();
    let mut backups = Vec::new();
    for _ in 0..12 {
        tokio::time::sleep(std::time::Duration::from_millis(40)).await;
        let before = acknowledged.lock().unwrap().clone();
        backups.push((before, store.export().await.unwrap()));
    }
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    for writer in writers {
        assert!(writer.await.unwrap() > 2, "a writer had no turn");
    }
    let mut grew = 0;
    for (at, (before, backup)) in backups.iter().enumerate() {
        assert_eq!(super::super::verify::faults(backup), Vec::<String>::new(), "backup {at}");
        // Data deleted during the backup may be missing.
        let lacking = before.iter().filter(|(id, last_seq)| {
            let found = backup.jobs.iter().find(|known| known.job.job_id == *id);
            let was_deleted = backup.taken_requests.iter().any(|(_, job)| job == id);
            !was_deleted && found.is_none_or(|job| job.job.last_seq < *last_seq)
        });
        assert_eq!(lacking.count(), 0, "backup {at} of {} jobs", backup.jobs.len());
        grew += usize::from(backup.jobs.len() > before.len());
    }
    assert!(grew > 0, "no backup was made in the middle of work");
    let (_, last) = backups.pop().unwrap();
    let restored = tempfile::tempdir().unwrap();
    let restored = SledStore::open(&options_in(&restored)).unwrap();
    restored.import(&last).await.unwrap();
    assert!(restored.export().await.unwrap() == last);
    assert_eq!(restored.index_faults().unwrap(), Vec::<String>::new());
}
