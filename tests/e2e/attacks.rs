//! A coordinator process under attack: its memory, and whether it still answers.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

#[path = "../support/processes.rs"]
mod processes;

use std::io::{BufRead as _, BufReader, Read as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fathom_proto::dial::{Connection, Dial, Secret};
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::v1::{BeginUploadRequest, BlobRef, ReadBlobRequest, WatchJobRequest, WriteBlobRequest};
use processes::{Service, can_train, fathom, json, succeed, tiny_scene, under};

/// Memory limit of the coordinator under any attack, bytes.
const MOST_BYTES: u64 = 640 << 20;
/// Time limit for an answer to a caller with a token during an attack.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);
/// Size of a piece of a blob, bytes.
const PIECE: usize = 1 << 20;

/// Tests run one at a time, because they measure memory and response times.
static ALONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

/// A process that is killed when this is dropped.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        // Either call may fail because the process has already ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `fathom` with these arguments and descriptor limit.
fn with_descriptors(descriptors: u32, words: &[&str]) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", &format!("ulimit -n {descriptors}; exec \"$0\" \"$@\"")]);
    command.arg(fathom::<&str>(&[]).get_program()).args(words);
    command
}

/// A coordinator that requires tokens.
struct Attacked {
    process: Killed,
    url: String,
    dir: tempfile::TempDir,
}

impl Attacked {
    /// The same with a descriptor limit.
    fn start(descriptors: u32) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let words = ["coordinator", "--listen", "127.0.0.1:0", "--tokens", "--min-free-bytes", "0"];
        let mut child = with_descriptors(descriptors, &words)
            .args(["--data-dir", &under(dir.path(), "data")])
            .env("FATHOM_LOG", "info")
            .env("NO_COLOR", "1")
            .stdout(Stdio::piped())
            .stderr(std::fs::File::create(dir.path().join("log")).unwrap())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.split_whitespace().find(|word| word.starts_with("http://"));
        let url = url.unwrap_or_else(|| panic!("no address in {line:?}")).trim_end_matches(['.', ',', ';']);
        Self { process: Killed(child), url: url.to_owned(), dir }
    }

    fn token_file(&self) -> String {
        under(self.dir.path(), "data/operator.token")
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.dir.path().join("log")).unwrap()
    }

    /// Makes a call as an operator; returns its duration.
    fn ask(&self, words: &[&str]) -> (String, Duration) {
        let begun = Instant::now();
        let more = ["--coordinator", &self.url, "--token-file", &self.token_file()];
        let output = fathom(&[words, &more].concat()).output().unwrap();
        assert!(output.status.success(), "{}\n{}", String::from_utf8_lossy(&output.stderr), self.log());
        (String::from_utf8(output.stdout).unwrap(), begun.elapsed())
    }

    fn uploads(&self, token: &str) -> UploadServiceClient<Connection> {
        let dial = Dial { token: Some(Secret::new(token)), ..Dial::to(&self.url) };
        UploadServiceClient::new(dial.lazily().unwrap())
    }

    fn token(&self, role: &str) -> String {
        self.ask(&["token", "issue", "somebody", "--role", role, "--tenant", "reef"]).0.trim().to_owned()
    }

    /// A value of `/proc/PID/status`, bytes.
    fn status(&self, key: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.0.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with(key)).unwrap();
        1024 * line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    }

    /// CPU time used, seconds.
    fn cpu_seconds(&self) -> f64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.process.0.id())).unwrap();
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
        (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
    }
}

fn blob(content: &[u8]) -> BlobRef {
    BlobRef { digest: blake3::hash(content).to_hex().to_string(), size_bytes: content.len() as u64 }
}

async fn upload(client: &mut UploadServiceClient<Connection>, content: &[u8]) -> BlobRef {
    let whole = blob(content);
    let count = content.len().div_ceil(PIECE);
    let pieces: Vec<_> = content
        .chunks(PIECE)
        .enumerate()
        .map(|(k, data)| WriteBlobRequest {
            blob: Some(whole.clone()),
            offset_bytes: (k * PIECE) as u64,
            data: data.to_vec().into(),
            finish: k + 1 == count,
            ..Default::default()
        })
        .collect();
    client.write_blob(futures::stream::iter(pieces)).await.unwrap();
    whole
}

fn is_there(path: &str) -> bool {
    let there = Path::new(path).exists();
    if !there {
        eprintln!("{path} is not there, so this test proves nothing here");
    }
    there
}

#[test]
fn silent_connections_beyond_the_descriptor_limit_cost_nothing() {
    if !is_there("/proc/self/status") {
        return;
    }
    let _alone = ALONE.blocking_lock();
    let attacked = Attacked::start(64);
    let address = attacked.url.trim_start_matches("http://").to_owned();
    let mut silent: Vec<TcpStream> = (0..120).map(|_| TcpStream::connect(&address).unwrap()).collect();
    let (before, begun) = (attacked.cpu_seconds(), Instant::now());
    for _ in 0..5 {
        let (_, took) = attacked.ask(&["ls"]);
        assert!(took < ANSWERED_WITHIN, "{took:?}\n{}", attacked.log());
        silent.push(TcpStream::connect(&address).unwrap());
    }
    std::thread::sleep(Duration::from_secs(12));
    for (index, stream) in silent.iter_mut().enumerate() {
        stream.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
        let end = stream.read_to_end(&mut Vec::new());
        let timed_out = |kind| matches!(kind, std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut);
        assert!(!end.is_err_and(|error| timed_out(error.kind())), "connection {index} is still open");
    }
    let share = (attacked.cpu_seconds() - before) / begun.elapsed().as_secs_f64();
    assert!(share < 0.3, "it took {share:.2} of a core");
    let log = attacked.log();
    let said = log.lines().filter(|line| line.contains("connections without a token were closed")).count();
    assert!((1..=2).contains(&said), "logged {said} times:\n{log}");
}

#[test]
fn a_worker_with_a_revoked_token_stops_without_a_loss() {
    let test = "a_worker_with_a_revoked_token_stops_without_a_loss";
    if !can_train(test) {
        return;
    }
    let _alone = ALONE.blocking_lock();
    let attacked = Attacked::start(4096);
    let file = |name: &str, role: &str| {
        let path = under(attacked.dir.path(), name);
        std::fs::write(&path, attacked.token(role)).unwrap();
        path
    };
    let (submitter, worker) = (file("submitter", "submitter"), file("worker", "worker"));
    let scene = tiny_scene(attacked.dir.path());
    let submit = fathom(&["submit", &scene, "--coordinator", &attacked.url, "--token-file", &submitter])
        .args(["--partitions", "1x1", "--iterations", "100000", "--max-gaussians", "2000", "--json"])
        .output()
        .unwrap();
    assert!(submit.status.success(), "{}", String::from_utf8_lossy(&submit.stderr));
    let worker_log = std::fs::File::create(attacked.dir.path().join("worker.log")).unwrap();
    let mut process = fathom(&["worker", "--coordinator", &attacked.url, "--token-file", &worker])
        .args(["--allow-cpu", "--cache-dir", &under(attacked.dir.path(), "cache")])
        .stderr(worker_log)
        .spawn()
        .unwrap();
    let leased = |state: &str| -> serde_json::Value {
        let begun = Instant::now();
        loop {
            let jobs: serde_json::Value = serde_json::from_str(&attacked.ask(&["ls", "--json"]).0).unwrap();
            let id = jobs.as_array().and_then(|jobs| jobs[0]["job"].as_str()).unwrap().to_owned();
            let job: serde_json::Value =
                serde_json::from_str(&attacked.ask(&["show", &id, "--json"]).0).unwrap();
            let tasks = job["tasks"].as_array().unwrap();
            let found = tasks.iter().find(|task| task["stage"] == "partition" && task["state"] == state);
            if let Some(task) = found {
                return task.clone();
            }
            assert!(
                begun.elapsed() < Duration::from_secs(60),
                "no partition is {state}: {job:#}\n{}",
                attacked.log()
            );
            std::thread::sleep(Duration::from_millis(200));
        }
    };
    let task = leased("running");
    assert_eq!(task["losses"], 0);
    let token = std::fs::read_to_string(&worker).unwrap();
    let id = token.split('_').nth(1).unwrap().to_owned();
    attacked.ask(&["token", "revoke", &id]);
    let begun = Instant::now();
    let status = loop {
        if let Some(status) = process.try_wait().unwrap() {
            break status;
        }
        assert!(begun.elapsed() < Duration::from_secs(10), "the worker still trains");
        std::thread::sleep(Duration::from_millis(50));
    };
    assert!(!status.success());
    let said = std::fs::read_to_string(attacked.dir.path().join("worker.log")).unwrap();
    assert!(said.contains("the token is not known, has expired or was revoked"), "{said}");
    let task = leased("ready");
    assert_eq!((&task["losses"], &task["errors"]), (&0.into(), &0.into()), "{task:#}\n{}", attacked.log());
    assert!(attacked.log().contains("its worker's token is no longer valid"), "{}", attacked.log());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unread_downloads_cost_bounded_memory() {
    if !is_there("/proc/self/status") {
        return;
    }
    let _alone = ALONE.lock().await;
    let attacked = Attacked::start(4096);
    let content = vec![7; 8 * PIECE];
    let whole = upload(&mut attacked.uploads(&attacked.token("submitter")), &content).await;
    let viewer = attacked.token("viewer");
    let mut held = Vec::new();
    for _ in 0..12 {
        let client = attacked.uploads(&viewer);
        for _ in 0..100 {
            let mut client = client.clone();
            let digest = whole.digest.clone();
            held.push(tokio::spawn(async move {
                let request = ReadBlobRequest { digest, ..Default::default() };
                let answer = client.read_blob(request).await;
                tokio::time::sleep(Duration::from_secs(600)).await;
                drop(answer);
            }));
        }
    }
    tokio::time::sleep(Duration::from_secs(6)).await;
    let (_, took) = attacked.ask(&["ls"]);
    assert!(took < ANSWERED_WITHIN, "{took:?}");
    let other = attacked.ask(&["token", "issue", "x", "--role", "submitter", "--tenant", "wreck"]).0;
    let began = Instant::now();
    upload(&mut attacked.uploads(other.trim()), b"a photograph of another tenant").await;
    assert!(began.elapsed() < ANSWERED_WITHIN, "{:?}", began.elapsed());
    let most = attacked.status("VmHWM");
    println!("1200 downloads that are never read: {} MiB at most", most >> 20);
    assert!(most <= MOST_BYTES, "{} MiB", most >> 20);
    held.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn thousands_of_watches_cost_bounded_memory_and_see_the_end() {
    if !is_there("/proc/self/status") {
        return;
    }
    let _alone = ALONE.lock().await;
    let attacked = Attacked::start(4096);
    let token = attacked.token("submitter");
    let file = under(attacked.dir.path(), "submitter");
    std::fs::write(&file, &token).unwrap();
    let scene = tiny_scene(attacked.dir.path());
    let submit = fathom(&["submit", &scene, "--coordinator", &attacked.url, "--token-file", &file, "--json"]);
    let submitted = { submit }.output().unwrap();
    assert!(submitted.status.success(), "{}", String::from_utf8_lossy(&submitted.stderr));
    let jobs: serde_json::Value = serde_json::from_str(&attacked.ask(&["ls", "--json"]).0).unwrap();
    let job_id = jobs.as_array().and_then(|jobs| jobs[0]["job"].as_str()).unwrap().to_owned();
    let mut watches = Vec::new();
    for _ in 0..6 {
        let dial = Dial { token: Some(Secret::new(&token)), ..Dial::to(&attacked.url) };
        let client = JobServiceClient::new(dial.lazily().unwrap());
        for _ in 0..500 {
            let (mut client, job_id) = (client.clone(), job_id.clone());
            watches.push(tokio::spawn(async move {
                // The call rate of a tenant is limited.
                for _ in 0..200 {
                    let request = WatchJobRequest { job_id: job_id.clone(), after_seq: 0 };
                    if let Ok(answer) = client.watch_job(request).await {
                        return futures::StreamExt::count(answer.into_inner()).await;
                    }
                    tokio::time::sleep(Duration::from_millis(500)).await;
                }
                0
            }));
        }
    }
    tokio::time::sleep(Duration::from_secs(20)).await;
    let (_, took) = attacked.ask(&["ls"]);
    assert!(took < ANSWERED_WITHIN, "{took:?}");
    attacked.ask(&["cancel", &job_id]);
    let heard = tokio::time::timeout(Duration::from_secs(30), futures::future::join_all(watches)).await;
    let heard: Vec<usize> =
        heard.expect("watches outlive their job").into_iter().map(Result::unwrap).collect();
    assert!(
        heard.iter().all(|&events| events > 1),
        "{} received nothing",
        heard.iter().filter(|&&n| n < 2).count()
    );
    let most = attacked.status("VmHWM");
    println!("3000 watches: {} MiB at most", most >> 20);
    assert!(most <= MOST_BYTES, "{} MiB", most >> 20);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stalled_uploads_cost_bounded_memory_and_block_no_tenant() {
    if !is_there("/proc/self/status") {
        return;
    }
    let _alone = ALONE.lock().await;
    let attacked = Attacked::start(4096);
    let token = attacked.token("submitter");
    let mut held = Vec::new();
    for connection in 0..10_u32 {
        let client = attacked.uploads(&token);
        for k in 0..40_u32 {
            let mut client = client.clone();
            held.push(tokio::spawn(async move {
                // Of a size that is never sent completely.
                let whole = BlobRef {
                    size_bytes: 2 * PIECE as u64,
                    ..blob(&[connection, k].map(u32::to_le_bytes).concat())
                };
                let first =
                    WriteBlobRequest { blob: Some(whole), data: vec![7; PIECE].into(), ..Default::default() };
                let stream = futures::StreamExt::chain(
                    futures::stream::iter([first]),
                    futures::stream::pending::<WriteBlobRequest>(),
                );
                client.write_blob(stream).await.map(drop)
            }));
        }
    }
    tokio::time::sleep(Duration::from_secs(4)).await;
    let (other, took) = attacked.ask(&["token", "issue", "x", "--role", "submitter", "--tenant", "wreck"]);
    assert!(took < ANSWERED_WITHIN, "{took:?}");
    let began = Instant::now();
    upload(&mut attacked.uploads(other.trim()), b"a photograph of another tenant").await;
    assert!(began.elapsed() < ANSWERED_WITHIN, "{:?}", began.elapsed());
    let most = attacked.status("VmHWM");
    println!("400 uploads that stand still: {} MiB at most", most >> 20);
    assert!(most <= MOST_BYTES, "{} MiB", most >> 20);
    held.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_longest_lists_at_once_cost_bounded_memory() {
    if !is_there("/proc/self/status") {
        return;
    }
    let _alone = ALONE.lock().await;
    let attacked = Attacked::start(4096);
    let token = attacked.token("submitter");
    let photograph = upload(&mut attacked.uploads(&token), b"a photograph").await;
    // 76 MB, a million files.
    let mut list = String::new();
    for k in 0..1_000_000 {
        list += &format!("{} {} {k:07}\n", photograph.digest, photograph.size_bytes);
    }
    let whole = upload(&mut attacked.uploads(&token), list.as_bytes()).await;
    drop(list);
    let begun = (0..8).map(|k| {
        let (mut client, list) = (attacked.uploads(&token), Some(whole.clone()));
        tokio::spawn(async move {
            let (dataset_id, request_id) = (format!("scene-{k}"), format!("request {k}"));
            let request = BeginUploadRequest { dataset_id, request_id, files: Vec::new(), list };
            client.begin_upload(request).await.map(|answer| answer.into_inner().dataset.unwrap().files)
        })
    });
    let begun: Vec<_> = begun.collect();
    let (_, took) = attacked.ask(&["ls"]);
    assert!(took < ANSWERED_WITHIN, "{took:?}");
    for answer in begun {
        assert_eq!(answer.await.unwrap().unwrap(), 1_000_000);
    }
    let most = attacked.status("VmHWM");
    println!("eight lists of a million files at once: {} MiB at most", most >> 20);
    assert!(most <= MOST_BYTES, "{} MiB", most >> 20);
}

#[test]
fn two_workers_of_one_name_train_over_ipv6() {
    let test = "two_workers_of_one_name_train_over_ipv6";
    if !can_train(test) {
        return;
    }
    if std::net::TcpListener::bind("[::1]:0").is_err() {
        eprintln!("there is no IPv6 here, so {test} proves nothing");
        return;
    }
    let _alone = ALONE.blocking_lock();
    let dir = tempfile::tempdir().unwrap();
    let (_coordinator, url) =
        Service::coordinator_with(&["--data-dir", &under(dir.path(), "data"), "--listen", "[::1]:0"]);
    assert!(url.starts_with("http://[::1]:"), "{url}");
    let _workers = ["cache-a", "cache-b"].map(|cache| {
        let flags = ["worker", "--allow-cpu", "--name", "twin", "--coordinator", &url];
        let log = std::fs::File::create(dir.path().join(format!("{cache}.log"))).unwrap();
        let mut command = with_descriptors(40, &flags);
        Killed(command.args(["--cache-dir", &under(dir.path(), cache)]).stderr(log).spawn().unwrap())
    });
    let scene = tiny_scene(dir.path());
    let settings = ["--partitions=2x1", "--iterations=60", "--max-gaussians=1000"];
    let job = succeed(&[&["submit", &scene, "--coordinator", &url][..], &settings].concat());
    succeed(&["watch", job.trim(), "--coordinator", &url]);
    let shown = json(&["show", job.trim(), "--coordinator", &url, "--json"]);
    assert_eq!(shown["state"], "succeeded", "{shown}");
}
