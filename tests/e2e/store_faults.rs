//! `fathom store` and the coordinator on full and read-only disks, and backups of a running coordinator.

use std::collections::BTreeMap;
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::processes::{Service, fail, fathom, json, output_of, succeed, tiny_scene, under};
use crate::small_disk::{SmallDisk, mount, wait_for};

/// Growth increment of sled's log.
const SEGMENT_BYTES: u64 = 512 << 10;
/// Every file under a folder with its content and mode.
fn files_under(folder: &Path) -> BTreeMap<PathBuf, (Vec<u8>, u32)> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let mode = path.metadata().expect("its mode").permissions().mode();
            if path.is_dir() {
                files.insert(path.clone(), (Vec::new(), mode));
                folders.push(path);
            } else {
                files.insert(path.clone(), (std::fs::read(&path).expect("a file"), mode));
            }
        }
    }
    files
}

/// A coordinator under test, and its output.
struct Coordinator {
    child: Child,
    said: Arc<Mutex<String>>,
}

impl Coordinator {
    /// Starts one; `largest_file` limits the size of files, bytes: every write beyond it fails.
    fn start(data: &str, port: u16, largest_file: Option<u64>) -> Self {
        let listen = format!("127.0.0.1:{port}");
        let words = ["coordinator", "--data-dir", data, "--listen", &listen, "--min-free-bytes", "0"];
        let mut command = fathom(&words);
        if let Some(bytes) = largest_file {
            let limit = bytes.div_ceil(512);
            let script = format!("trap '' XFSZ; ulimit -f {limit}; exec \"$0\" \"$@\"");
            let program = command.get_program().to_owned();
            command = Command::new("sh");
            command.arg("-c").arg(script).arg(program).args(words).env_remove("FATHOM_CONFIG");
        }
        let mut child = command
            .env("FATHOM_LOG", "info")
            .env("NO_COLOR", "1")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the binary starts");
        let said = Arc::<Mutex<String>>::default();
        let outputs: [Box<dyn std::io::Read + Send>; 2] =
            [Box::new(child.stdout.take().expect("a pipe")), Box::new(child.stderr.take().expect("a pipe"))];
        for mut output in outputs {
            let said = Arc::clone(&said);
            std::thread::spawn(move || {
                let mut piece = [0; 4096];
                while let Ok(length @ 1..) = output.read(&mut piece) {
                    let text = String::from_utf8_lossy(&piece[..length]).into_owned();
                    said.lock().unwrap_or_else(PoisonError::into_inner).push_str(&text);
                }
            });
        }
        Self { child, said }
    }

    fn said(&self) -> String {
        self.said.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a status")
    }

    /// Whether it serves, once known.
    fn serves(&mut self) -> bool {
        wait_for("a coordinator that serves or ends", || {
            if self.said().contains("listening on ") { Some(true) } else { self.ended().map(|_| false) }
        })
    }

    fn kill(mut self) {
        self.child.kill().expect("it is there");
        self.child.wait().expect("it has ended");
    }
}

impl Drop for Coordinator {
    fn drop(&mut self) {
        // Either call may fail because it has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Changes the priority of a job until the coordinator ends; returns the last acknowledged one.
fn update_until_it_ends(coordinator: &mut Coordinator, url: &str, job: &str) -> (u64, ExitStatus) {
    let (mut priority, mut acknowledged) = (0, 0);
    let ended = wait_for("the end of the coordinator", || {
        priority += 1;
        let words = ["update", job, "--priority", &priority.to_string(), "--coordinator", url];
        let mut client =
            fathom(&words).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("it starts");
        // The client waits for a lost coordinator; the test does not wait for the client.
        let (answered, ended) = wait_for("an answer, or the end of the coordinator", || {
            let (answered, ended) = (client.try_wait().expect("a status"), coordinator.ended());
            (answered.is_some() || ended.is_some()).then_some((answered, ended))
        });
        let _ = client.kill();
        let _ = client.wait();
        if answered.is_some_and(|status| status.success()) {
            acknowledged = priority;
        }
        ended
    });
    (acknowledged, ended)
}

/// A store write without space ends the coordinator, and a service manager restarts it on the full disk. Once
/// there is room, it serves with everything that it ever acknowledged.
fn lives_through_a_full_disk(folder: &Path, data: &str, disk: Option<&SmallDisk>) {
    let port = crate::processes::free_port();
    let url = format!("http://127.0.0.1:{port}");
    let scene = tiny_scene(folder);
    let mut coordinator = Coordinator::start(data, port, None);
    assert!(coordinator.serves(), "{}", coordinator.said());
    let job = succeed(&["submit", &scene, "--coordinator", &url, "--iterations=50"]).trim().to_owned();
    // Started on an existing log, sled writes to the end of its last segment. It has that room even on a full
    // disk, as in a long-running service. The next segment ends it.
    coordinator.kill();
    let limit = match disk {
        Some(_) => None,
        None => {
            let largest = files_under(Path::new(data)).values().map(|(bytes, _)| bytes.len() as u64).max();
            Some(largest.expect("a file").next_multiple_of(SEGMENT_BYTES) + SEGMENT_BYTES / 8)
        }
    };
    let mut coordinator = Coordinator::start(data, port, limit);
    assert!(coordinator.serves(), "{}", coordinator.said());
    let ballast = disk.map(SmallDisk::fill);
    let (acknowledged, ended) = update_until_it_ends(&mut coordinator, &url, &job);
    let said = coordinator.said();
    assert_eq!(ended.code(), Some(1), "{said}");
    assert!(said.contains("free space or repair the disk and start the coordinator again"), "{said}");
    let sled = Path::new(data).join("store/sled");
    for _ in 0..2 {
        let mut again = Coordinator::start(data, port, limit.map(|_| 0));
        assert!(!again.serves(), "a coordinator serves on a full disk: {}", again.said());
        assert_eq!(again.ended().and_then(|status| status.code()), Some(1), "{}", again.said());
    }
    match ballast {
        Some(ballast) => {
            let unfinished = sled.join("set-aside.unfinished-snapshot");
            assert!(
                unfinished.exists(),
                "no start was cut off in the middle of a snapshot, so this shows nothing"
            );
            std::fs::remove_file(ballast).expect("room");
        }
        // Under such a limit sled fails before its snapshot, so write the leftovers of a full disk.
        None => std::fs::write(sled.join("snap.7FFFFFFFFFFFFFFF.generating"), "").expect("a file"),
    }
    let mut coordinator = Coordinator::start(data, port, None);
    assert!(coordinator.serves(), "{}", coordinator.said());
    let stored = json(&["show", &job, "--json", "--coordinator", &url])["priority"].as_u64();
    assert!(stored >= Some(acknowledged), "priority {acknowledged} was acknowledged, it is {stored:?}");
    succeed(&["update", &job, "--priority", "7", "--coordinator", &url]);
    coordinator.kill();
    succeed(&["store", "verify", "--data-dir", data, "--deep"]);
}

#[test]
fn a_file_size_limit_loses_nothing_acknowledged() {
    let folder = tempfile::tempdir().expect("a folder");
    lives_through_a_full_disk(folder.path(), &under(folder.path(), "data"), None);
}

#[test]
fn a_full_disk_loses_nothing_acknowledged() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(disk) = SmallDisk::mounted(&folder.path().join("disk"), 24 << 20) else {
        eprintln!(
            "skipped, since nothing can be mounted here; the test with a limit on the size of files runs everywhere"
        );
        return;
    };
    lives_through_a_full_disk(folder.path(), &under(folder.path(), "disk/data"), Some(&disk));
}

#[test]
fn verify_export_and_token_list_never_write_the_data_dir() {
    let folder = tempfile::tempdir().expect("a folder");
    let disk = SmallDisk::mounted(&folder.path().join("disk"), 24 << 20);
    if disk.is_none() {
        eprintln!("nothing can be mounted here, so the disk is neither full nor read-only");
    }
    let data = under(folder.path(), "disk/data");
    let scene = tiny_scene(folder.path());
    let port = crate::processes::free_port();
    let url = format!("http://127.0.0.1:{port}");
    let mut coordinator = Coordinator::start(&data, port, None);
    assert!(coordinator.serves(), "{}", coordinator.said());
    succeed(&["submit", &scene, "--coordinator", &url, "--iterations=50"]);
    // Killed, so that sled has to repair its log.
    coordinator.kill();
    succeed(&["token", "issue", "ana", "--role", "operator", "--data-dir", &data]);
    std::fs::write(folder.path().join("disk/data/store/sled/snap.7FFFFFFFFFFFFFFF.generating"), "")
        .expect("a file");
    let before = files_under(Path::new(&data));
    let export = under(folder.path(), "store.gz");
    let look = |how: &str| {
        let verified = json(&["store", "verify", "--data-dir", &data, "--deep", "--json"]);
        assert_eq!(
            (&verified["jobs"], verified["faults"].as_array().map(Vec::len)),
            (&1.into(), Some(0)),
            "{how}"
        );
        let said = succeed(&["store", "export", "--data-dir", &data, "-o", &export]);
        assert!(said.starts_with("1 jobs, "), "{how}: {said}");
        let said = succeed(&["token", "list", "--data-dir", &data]);
        assert!(said.contains("operator") && said.contains("ana"), "{how}: {said}");
        let after = files_under(Path::new(&data));
        assert_eq!(before.keys().collect::<Vec<_>>(), after.keys().collect::<Vec<_>>(), "{how}");
        for (path, found) in &after {
            assert!(before[path] == *found, "{how}: {} was changed", path.display());
        }
    };
    look("as it is");
    if let Some(disk) = &disk {
        let ballast = disk.fill();
        look("on a full disk");
        let (_, error) =
            fail(&["store", "verify", "--data-dir", &data, "--scratch", &disk.0.to_string_lossy()]);
        assert!(error.contains("--scratch DIR"), "{error}");
        std::fs::remove_file(ballast).expect("room");
        assert!(mount(&["-o", "remount,ro"], &disk.0), "it was mounted before");
        look("on a read-only disk");
    }
    let scratch = under(folder.path(), "scratch");
    std::fs::create_dir(&scratch).expect("a folder");
    succeed(&["store", "verify", "--data-dir", &data, "--scratch", &scratch]);
    assert_eq!(std::fs::read_dir(&scratch).expect("a folder").count(), 0, "the copy is still there");
}

/// A coordinator that requires tokens, and the flags of its first operator.
fn with_tokens(data: &str) -> (Service, Vec<String>) {
    let (service, url) =
        Service::coordinator_with(&["--data-dir", data, "--listen", "127.0.0.1:0", "--tokens"]);
    let token = Path::new(data).join("operator.token").to_string_lossy().into_owned();
    (service, ["--coordinator", &url, "--token-file", &token].map(str::to_owned).to_vec())
}

fn words<'a>(verb: &[&'a str], service: &'a [String]) -> Vec<&'a str> {
    verb.iter().copied().chain(service.iter().map(String::as_str)).collect()
}

#[test]
fn a_backup_of_a_running_coordinator_restores_all_of_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let (data, file) = (at("data"), at("backup.gz"));
    let (service, operator) = with_tokens(&data);
    let scene = tiny_scene(folder.path());
    let submit = |id: &str| {
        let id = format!("--request-id={id}");
        let verb = ["submit", &scene, "--iterations=50", &id];
        succeed(&words(&verb, &operator)).trim().to_owned()
    };
    let jobs = ["first", "second", "third"].map(submit);
    let stop = Arc::new(AtomicBool::new(false));
    let acknowledged = Arc::new(Mutex::new(BTreeMap::<String, u64>::new()));
    let writers = jobs.clone().map(|job| {
        let (stop, acknowledged, operator) = (Arc::clone(&stop), Arc::clone(&acknowledged), operator.clone());
        std::thread::spawn(move || {
            for turn in 1.. {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                succeed(&words(&["update", &job, "--priority", &turn.to_string()], &operator));
                acknowledged.lock().unwrap_or_else(PoisonError::into_inner).insert(job.clone(), turn);
                let steer = if turn % 2 == 0 { "resume" } else { "pause" };
                succeed(&words(&[steer, &job], &operator));
            }
        })
    });
    let mut before = BTreeMap::new();
    for _ in 0..4 {
        std::thread::sleep(Duration::from_millis(300));
        before = acknowledged.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let said = succeed(&words(&["store", "backup", "-o", &file], &operator));
        assert!(said.starts_with("3 jobs, ") && said.contains("backed up to"), "{said}");
    }
    stop.store(true, Ordering::Relaxed);
    writers.into_iter().for_each(|writer| writer.join().expect("a writer"));
    assert!(before.len() == 3, "nothing was changed before the backup: {before:?}");

    // An operator of one tenant gets no backup of all.
    let issue = ["token", "issue", "reef", "--role", "operator", "--tenant", "reef"];
    std::fs::write(at("reef.token"), succeed(&words(&issue, &operator))).expect("a file");
    let mut reef = operator.clone();
    reef[3] = at("reef.token");
    let (_, error) = fail(&words(&["store", "backup", "-o", &at("reef.gz")], &reef));
    assert!(error.contains("operator") && !Path::new(&at("reef.gz")).exists(), "{error}");
    drop(service);

    let restored = at("restored");
    succeed(&["store", "import", &file, "--data-dir", &restored]);
    std::fs::rename(folder.path().join("data/objects"), folder.path().join("restored/objects"))
        .expect("objects");
    succeed(&["store", "verify", "--data-dir", &restored, "--deep"]);
    let mode = Path::new(&restored).metadata().expect("it is there").permissions().mode() & 0o777;
    assert_eq!(mode, 0o700, "a data directory is for its owner alone");
    // The token that was issued before the backup opens the restored service.
    let url = {
        let token = operator[3].clone();
        let (_service, url) =
            Service::coordinator_with(&["--data-dir", &restored, "--listen", "127.0.0.1:0", "--tokens"]);
        let service = ["--coordinator", &url, "--token-file", &token].map(str::to_owned);
        for (job, priority) in &before {
            let stored = json(&words(&["show", job, "--json"], &service))["priority"].as_u64();
            assert!(stored >= Some(*priority), "{job}: {priority} was acknowledged, {stored:?} is restored");
        }
        url
    };
    assert!(url.starts_with("http://"));
}

#[test]
fn the_last_operator_token_is_revoked_only_with_the_flag() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = under(folder.path(), "data");
    let (service, operator) = with_tokens(&data);
    let id = |name: &str, operator: &[String]| {
        let tokens = json(&words(&["token", "list", "--json"], operator));
        let tokens = tokens.as_array().expect("tokens").clone();
        let found = tokens.iter().find(|token| token["name"] == name).expect("the token");
        found["id"].as_str().expect("an id").to_owned()
    };
    let first = id("first operator", &operator);
    // An operator of one tenant, or with an expired token, cannot make tokens.
    succeed(&words(&["token", "issue", "reef", "--role", "operator", "--tenant", "reef"], &operator));
    let (code, error) = fail(&words(&["token", "revoke", &first], &operator));
    assert!(code == 1 && error.contains("last one of an operator") && error.contains("--last"), "{error}");
    let ana = under(folder.path(), "ana.token");
    std::fs::write(&ana, succeed(&words(&["token", "issue", "ana", "--role", "operator"], &operator)))
        .expect("a file");
    let mut by_ana = operator.clone();
    by_ana[3] = ana;
    succeed(&words(&["token", "revoke", &first], &by_ana));
    let second = id("ana", &by_ana);
    fail(&words(&["token", "revoke", &second], &by_ana));
    succeed(&words(&["token", "revoke", &second, "--last"], &by_ana));
    drop(service);
    let said = succeed(&["token", "list", "--data-dir", &data]);
    assert_eq!(said.matches(", revoked").count(), 2, "{said}");
    assert_eq!(
        output_of(&["token", "list", "--data-dir", &under(folder.path(), "no")]).status.code(),
        Some(1)
    );
}

#[test]
fn a_coordinator_that_is_asked_to_stop_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = under(folder.path(), "data");
    let mut coordinator = Coordinator::start(&data, 0, None);
    assert!(coordinator.serves(), "{}", coordinator.said());
    let sent = Command::new("kill").args(["-s", "TERM", &coordinator.child.id().to_string()]).status();
    assert!(sent.expect("kill").success());
    let ended = wait_for("its end", || coordinator.ended());
    assert!(ended.success(), "{ended}");
    wait_for("the line", || coordinator.said().contains("asked to stop by SIGTERM").then_some(()));
    let mode = Path::new(&data).metadata().expect("it is there").permissions().mode() & 0o777;
    assert_eq!(mode, 0o700, "a data directory is for its owner alone");
}

/// The status line and body of a coordinator's readiness response over HTTP.
fn readiness(address: &str) -> (String, String) {
    use std::io::Write as _;
    let mut stream = std::net::TcpStream::connect(address).expect("a connection");
    write!(stream, "GET /readyz HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("a request");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let (head, said) = answer.split_once("\r\n\r\n").expect("a head");
    (head.lines().next().expect("a status").to_owned(), said.to_owned())
}

#[test]
fn a_coordinator_without_its_data_directory_is_not_ready() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = under(folder.path(), "data");
    let metrics = format!("127.0.0.1:{}", crate::processes::free_port());
    let (_service, url) = Service::coordinator_with(&[
        "--data-dir",
        &data,
        "--listen",
        "127.0.0.1:0",
        "--metrics-listen",
        &metrics,
        "--min-free-bytes",
        "0",
    ]);
    assert_eq!(readiness(&metrics), ("HTTP/1.1 200 OK".to_owned(), "ready\n".to_owned()));
    std::fs::rename(&data, under(folder.path(), "elsewhere")).expect("it can be moved");
    let (status, said) = readiness(&metrics);
    assert_eq!(status, "HTTP/1.1 503 Service Unavailable", "{said}");
    assert!(said.contains(&data), "the missing directory is not named: {said}");
    // It still answers from memory.
    succeed(&["ls", "--coordinator", &url]);
    std::fs::rename(under(folder.path(), "elsewhere"), &data).expect("it can be moved back");
    assert_eq!(readiness(&metrics).0, "HTTP/1.1 200 OK");
}
