//! Processes killed at the worst moment. The model must be the one of an undisturbed run, byte for byte.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use crate::processes::{Service, Watchdog, can_train, fathom, json, succeed, under};
use serde_json::Value;

/// Far more than any step here takes on two busy cores.
const PATIENCE: Duration = Duration::from_secs(240);

/// A job on a service, and the settings that all jobs here share: two partitions with a coarse model before them.
struct Job {
    id: String,
    url: String,
}

impl Job {
    fn submit(scene: &str, url: &str) -> Self {
        let settings = [
            "--partitions=2x1",
            "--iterations=900",
            "--max-gaussians=4000",
            "--set=train.checkpoint_seconds=1",
        ];
        let answer = json(&[&["submit", scene, "--coordinator", url, "--json"][..], &settings].concat());
        Self { id: answer["job"].as_str().expect("an id").to_owned(), url: url.to_owned() }
    }

    fn show(&self) -> Value {
        json(&["show", &self.id, "--coordinator", &self.url, "--json"])
    }

    fn task(&self, id: &str) -> Value {
        let job = self.show();
        let tasks = job["tasks"].as_array().expect("tasks").clone();
        tasks.into_iter().find(|task| task["task"] == id).expect("the task")
    }

    fn watch(&self) -> Child {
        fathom(&["watch", &self.id, "--coordinator", &self.url, "--json"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("the binary starts")
    }

    /// Waits for the first checkpoint of a partition, which is then far from its end; gives its task.
    fn wait_for_checkpoint(&self) -> String {
        let mut watch = self.watch();
        let _watchdog = Watchdog::over(&watch);
        let begin = Instant::now();
        let lines = BufReader::new(watch.stdout.take().expect("a pipe")).lines();
        let mut found = None;
        for line in lines {
            assert!(begin.elapsed() < PATIENCE, "no checkpoint after {PATIENCE:?}");
            let Ok(event) = serde_json::from_str::<Value>(&line.expect("a line")) else { continue };
            let task = event["task"].as_str().unwrap_or_default();
            if event["event"] == "checkpoint" && task.starts_with("partition") {
                found = event["iteration"].as_u64().map(|iteration| (task.to_owned(), iteration));
                break;
            }
        }
        // The watcher may have ended by itself.
        let _ = watch.kill();
        let _ = watch.wait();
        let (task, iteration) = found.expect("a checkpoint of a partition before the end of the job");
        assert!(iteration < 900, "the checkpoint at {iteration} is the end of the run");
        task
    }

    fn model(&self, out: &str) -> Vec<u8> {
        succeed(&["watch", &self.id, "--coordinator", &self.url]);
        succeed(&["download", &self.id, "-o", out, "--coordinator", &self.url]);
        std::fs::read(format!("{out}/model.ply")).expect("a model")
    }
}

#[test]
fn a_killed_worker_and_a_killed_coordinator_change_no_byte_of_the_model() {
    if !can_train("a_killed_worker_and_a_killed_coordinator_change_no_byte_of_the_model") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let data_dir = under(folder.path(), "service");
    let port = crate::processes::free_port();
    let url = format!("http://127.0.0.1:{port}");
    let mut coordinator = Service::coordinator(&data_dir, port);
    let cache = under(folder.path(), "cache");
    let mut workers = ["first-worker", "second-worker"].map(|name| Service::worker(&url, name, &cache));

    // A worker dies after its first checkpoint: the other one goes on from there.
    let disturbed = Job::submit(&scene, &url);
    let orphan = disturbed.wait_for_checkpoint();
    let holder = disturbed.task(&orphan)["worker"].as_str().expect("a worker").to_owned();
    let victim = usize::from(holder.contains("second"));
    workers[victim].kill();
    let after_worker = disturbed.model(&under(folder.path(), "after-worker"));
    let task = disturbed.task(&orphan);
    assert_eq!(task["attempts"], 2, "{task}");
    assert_eq!(task["losses"], 1, "the fault has not fired: {task}");
    assert!(task["resumed_from_iteration"].as_u64() > Some(0), "{task}");
    let successor = task["worker"].as_str().expect("a worker");
    assert_ne!(successor, holder, "{task}");

    // The coordinator dies while a worker trains, and is started again: the job goes on.
    let job = Job::submit(&scene, &url);
    let trained_meanwhile = job.wait_for_checkpoint();
    coordinator.kill();
    std::thread::sleep(Duration::from_millis(500));
    let _coordinator = Service::coordinator(&data_dir, port);
    let after_coordinator = job.model(&under(folder.path(), "after-coordinator"));
    assert_eq!(job.task(&trained_meanwhile)["attempts"], 1, "the worker lost its lease");

    let undisturbed = Job::submit(&scene, &url);
    let model = undisturbed.model(&under(folder.path(), "undisturbed"));
    for partition in ["partition-0000", "partition-0001"] {
        assert_eq!(undisturbed.task(partition)["attempts"], 1);
    }
    assert!(model.starts_with(b"ply\n") && model.len() > 10_000, "{} bytes", model.len());
    assert!(after_worker == model, "the model after the death of a worker is another one");
    assert!(after_coordinator == model, "the model after the death of the coordinator is another one");
}

#[test]
fn children_of_train_die_with_it() {
    if !can_train("children_of_train_die_with_it") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = crate::processes::tiny_scene(folder.path());
    let out = under(folder.path(), "out");
    let mut train =
        fathom(&["train", &scene, "-o", &out, "--allow-cpu", "--iterations", "100000", "--workers", "2"])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the binary starts");
    let begin = Instant::now();
    let mut children = Vec::new();
    while children.len() < 3 {
        assert!(begin.elapsed() < PATIENCE, "a coordinator and two workers should start: {children:?}");
        std::thread::sleep(Duration::from_millis(50));
        children = children_of(train.id());
    }
    assert_eq!(children.len(), 3, "a coordinator and two workers: {children:?}");
    train.kill().expect("the process is there to be killed");
    train.wait().expect("it has ended");
    let begin = Instant::now();
    while children.iter().any(|&child| is_alive(child)) {
        assert!(begin.elapsed() < Duration::from_secs(20), "still alive: {children:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
    let (_, said) = crate::processes::fail(&["train", &scene, "-o", &out, "--allow-cpu"]);
    assert!(said.contains("--resume"), "{said}");
}

/// Process ids whose parent is `parent`, from /proc; empty where there is none.
fn children_of(parent: u32) -> Vec<u32> {
    let Ok(processes) = std::fs::read_dir("/proc") else { return Vec::new() };
    let ids = processes.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse::<u32>().ok());
    ids.filter(|id| stat_fields(*id).is_some_and(|fields| fields[1] == parent.to_string())).collect()
}

/// A process that has ended but was not waited for counts as dead.
fn is_alive(id: u32) -> bool {
    stat_fields(id).is_some_and(|fields| fields[0] != "Z")
}

/// What follows the name in /proc/ID/stat: state, parent, ...
fn stat_fields(id: u32) -> Option<Vec<String>> {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    let (_, rest) = stat.rsplit_once(") ")?;
    Some(rest.split(' ').map(str::to_owned).collect())
}
