//! Nothing is acknowledged before it is durable: tested with a disk that delays its syncs, and one that loses
//! unsynced writes.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use super::super::flusher::{Disk, SledDisk};
use super::datasets::{dataset, id, reef};
use super::*;

/// A disk whose syncs return only when released.
struct Gate {
    disk: SledDisk,
    asked: Sender<()>,
    let_go: std::sync::Mutex<Receiver<()>>,
}

impl Disk for Gate {
    fn sync(&self) -> Result<(), String> {
        self.asked.send(()).map_err(|error| error.to_string())?;
        // A finished test releases everything.
        let _ = self.let_go.lock().unwrap().recv();
        self.disk.sync()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_reply_leaves_before_its_sync_has_returned() {
    let dir = tempfile::tempdir().unwrap();
    let ((asked, asks), (go, let_go)) = (channel(), channel());
    let gate = |disk| Gate { disk, asked, let_go: std::sync::Mutex::new(let_go) };
    let store = Arc::new(SledStore::open_on(&options(dir.path()), gate).unwrap());
    // Dropped before the store, whose thread would otherwise wait for it forever when this test fails.
    let go = go;
    let mut held: Option<Lease> = None;
    let steps = [
        "submit",
        "claim",
        "checkpoint",
        "complete",
        "claim",
        "fail",
        "steer",
        "token",
        "begin",
        "commit",
        "forget",
        "mark",
    ];
    for step in steps {
        let (store, lease) = (Arc::clone(&store), held.clone());
        let mut reply = tokio::spawn(async move {
            let lease = lease.unwrap_or(Lease {
                job: JobId::new(0, 0),
                task: Stage::Plan.task(),
                attempt: 1,
                fence: 1,
            });
            match step {
                "submit" => drop(store.submit(new_job(1), T0).await.unwrap()),
                "claim" => {
                    return claim(store.as_ref(), &every_stage(), T0 + 90).await;
                }
                "checkpoint" => drop(store.checkpoint(&lease, blob("checkpoint"), 40, T0).await.unwrap()),
                "complete" => drop(store.complete(&lease, planned(1), T0).await.unwrap()),
                "fail" => {
                    let class = FailClass::Environment;
                    drop(store.fail(&lease, class, "a fan is broken".into(), T0).await.unwrap());
                }
                "steer" => {
                    let update = Event::Update { priority: Some(3), max_parallel: None };
                    drop(store.apply(&lease.job, update, T0).await.unwrap());
                }
                "token" => {
                    let token = crate::access::Token::random();
                    let role = crate::access::Role::Viewer;
                    let token = TokenRecord::new(&token, "ci".into(), role, None, T0, None);
                    store.put_token(&token).await.unwrap();
                }
                "begin" => drop(store.begin_dataset(dataset("a", "one", "files"), T0).await.unwrap()),
                "commit" => drop(store.commit_dataset(&reef(), &id("a"), &blob("files"), T0).await.unwrap()),
                "forget" => store.delete_dataset(&reef(), &id("a")).await.unwrap(),
                _ => {
                    let mark = WorkerMark { drains: false, reason: String::new(), since_ms: T0 };
                    store.mark_worker("one", Some(&mark)).await.unwrap();
                }
            }
            None
        });
        let asked = tokio::task::block_in_place(|| asks.recv_timeout(Duration::from_secs(20)));
        assert!(asked.is_ok(), "{step}: no sync was asked for");
        tokio::time::sleep(Duration::from_millis(30)).await;
        assert!(!reply.is_finished(), "{step}: the reply left before its sync");
        go.send(()).unwrap();
        let replied = tokio::time::timeout(Duration::from_secs(20), &mut reply).await;
        let granted = replied.unwrap_or_else(|_| panic!("{step}: no reply after its sync")).unwrap();
        held = granted.map(|grant| grant.lease).or(held);
    }
}

/// A disk that after a crash has the state of its last sync.
struct Torn {
    disk: SledDisk,
    from: PathBuf,
    kept: PathBuf,
}

impl Disk for Torn {
    fn sync(&self) -> Result<(), String> {
        self.disk.sync()?;
        let copy = |from: &Path, to: &Path| std::fs::copy(from, to).map_err(|error| error.to_string());
        std::fs::create_dir_all(&self.kept).map_err(|error| error.to_string())?;
        for name in ["conf", "db"] {
            copy(&self.from.join(name), &self.kept.join(name))?;
        }
        Ok(())
    }
}

#[tokio::test]
async fn acknowledged_data_survives_a_crash_that_loses_all_else() {
    for acknowledged in [1_u32, 2, 5] {
        let dir = tempfile::tempdir().unwrap();
        let (from, kept) = (dir.path().join("live/sled"), dir.path().join("torn/sled"));
        let torn = |disk| Torn { disk, from: from.clone(), kept: kept.clone() };
        let live = SledOptions { dir: dir.path().join("live"), ..options(dir.path()) };
        let store = SledStore::open_on(&live, torn).unwrap();
        let mut ids = Vec::new();
        for number in 0..acknowledged {
            ids.push(store.submit(new_job(number), T0).await.unwrap().job_id);
        }
        let lease = claim(&store, &[Stage::Plan], T0 + 10).await.unwrap().lease;
        store.complete(&lease, planned(1), T0 + 20).await.unwrap();
        // Power fails; unsynced writes are lost.
        let after =
            SledStore::open(&SledOptions { dir: dir.path().join("torn"), ..options(dir.path()) }).unwrap();
        for id in &ids {
            after.job(id).await.unwrap_or_else(|error| panic!("{id} of {acknowledged} is lost: {error}"));
        }
        let plan = after.task_row(&lease.job, Stage::Plan.task()).await.unwrap();
        assert!(matches!(plan.state, TaskState::Done { .. }), "an acknowledged result is lost: {plan:?}");
        assert_eq!(verify::faults(&after.export().await.unwrap()), Vec::<String>::new());
    }
}
