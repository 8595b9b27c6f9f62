//! A service for one scenario, and the checks at its end.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fathom_coordinator::objects::TenantBlobs;
use fathom_coordinator::schedule::{JobId, Tenant};
use fathom_core::scene::BlobRef;
use fathom_invariants::Fact;
use serde_json::Value;

use crate::files::files_in;
use crate::history::{History, seen};
use crate::job::Job;
use crate::postgres::Server;
use crate::process::{Process, Random};
use crate::processes::{fathom, fathom_of, free_port, output_from, output_of, under};
use crate::reference;
use crate::s3::S3Server;

mod engines;
mod kept;

pub use engines::has_data_directory;

/// Number of lines of each log shown on a failure.
const LAST_LINES: usize = 14;

/// Where files are in a bucket.
const PREFIX: &str = "scenes";

/// Settings that differ between scenarios.
#[derive(Clone)]
pub struct Rules {
    /// Short, so that silence is detected soon.
    pub lease_ms: u64,
    /// Above the losses of a scenario, except in scenarios about the budget.
    pub max_losses: u64,
    pub min_free_bytes: u64,
}

impl Default for Rules {
    fn default() -> Self {
        Self { lease_ms: 1000, max_losses: 50, min_free_bytes: 0 }
    }
}

/// The service.
pub struct Harness {
    scenario: &'static str,
    seed: u64,
    pub random: Random,
    folder: tempfile::TempDir,
    pub data: PathBuf,
    pub port: u16,
    pub rules: Rules,
    /// The program of coordinators and workers that are started from now on; `None`: that of this build.
    pub program: Option<PathBuf>,
    coordinator: Option<Process>,
    /// The port of a second one on the same database and bucket, and the process once it is started.
    second: Option<(u16, Option<Process>)>,
    /// The database of its jobs, and its URL; without one, they are in the data directory.
    database: Option<(Server, String)>,
    /// The server of its files; without one, they are in the data directory.
    bucket: Option<S3Server>,
    /// Whether workers and clients use the bucket themselves, also for the small files of these scenarios.
    is_direct: bool,
    workers: BTreeMap<String, Process>,
    /// What its clients were answered, by the time since its start.
    facts: Vec<(Duration, Fact)>,
    begin: Instant,
    /// Number of watched jobs, of those that have ended, and of those that have succeeded.
    watched: usize,
    ended: usize,
    succeeded: usize,
    /// Killed processes.
    pub kills: u32,
}

fn job_id(id: &str) -> JobId {
    id.parse().expect("a job's name")
}

/// The seed of this process, which `FATHOM_KILLS_SEED` sets.
fn seed() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.subsec_nanos());
    std::env::var("FATHOM_KILLS_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(now.into())
}

impl Harness {
    /// A coordinator without workers.
    pub fn new(scenario: &'static str) -> Self {
        Self::with(scenario, Rules::default())
    }

    /// The same with other settings.
    pub fn with(scenario: &'static str, rules: Rules) -> Self {
        let mut harness = Self::stopped(scenario, rules);
        harness.start_coordinator();
        harness
    }

    fn of(scenario: &'static str, rules: Rules) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let seed = seed();
        Self {
            scenario,
            seed,
            random: Random::new(seed, scenario),
            data: folder.path().join("data"),
            folder,
            port: free_port(),
            rules,
            program: None,
            coordinator: None,
            second: None,
            database: None,
            bucket: None,
            is_direct: false,
            workers: BTreeMap::new(),
            facts: Vec::new(),
            begin: Instant::now(),
            watched: 0,
            ended: 0,
            succeeded: 0,
            kills: 0,
        }
    }

    /// The address of the coordinator, or of both.
    pub fn url(&self) -> String {
        let first = format!("http://127.0.0.1:{}", self.port);
        match &self.second {
            Some((port, _)) => format!("{first},http://127.0.0.1:{port}"),
            None => first,
        }
    }

    /// A path in the folder of this scenario, as an argument.
    pub fn path(&self, name: &str) -> String {
        under(self.folder.path(), name)
    }

    fn log_folder(&self) -> PathBuf {
        let logs = self.folder.path().join("logs");
        std::fs::create_dir_all(&logs).expect("a folder");
        logs
    }

    // Processes

    /// Starts a coordinator on the existing data directory; returns the time until it serves.
    pub fn start_coordinator(&mut self) -> Duration {
        let begin = Instant::now();
        let ready = self.try_coordinator();
        assert!(ready, "the coordinator did not start");
        begin.elapsed()
    }

    /// Tells clients and workers from now on of a second coordinator, which is started later.
    pub fn announce_second(&mut self) {
        self.second = Some((free_port(), None));
    }

    /// Starts the second coordinator.
    pub fn start_second(&mut self) {
        let url = self.database.as_ref().map(|(_, url)| url.clone());
        self.start_second_at(url);
    }

    /// The same with another way to the database.
    pub fn start_second_at(&mut self, database: Option<String>) {
        let of_first =
            self.database.as_mut().zip(database).map(|((_, url), other)| std::mem::replace(url, other));
        let (port, _) = self.second.take().expect("it was announced");
        let (first_port, first_data) = (self.port, self.data.clone());
        let first = self.coordinator.take();
        (self.port, self.data) = (port, self.folder.path().join("second-data"));
        assert!(self.try_named("second-coordinator"), "the second coordinator did not start");
        self.second = Some((port, self.coordinator.take()));
        (self.port, self.data, self.coordinator) = (first_port, first_data, first);
        if let (Some((_, url)), Some(first)) = (&mut self.database, of_first) {
            *url = first;
        }
    }

    /// Stops the first coordinator as its operator would, and starts it again.
    pub fn restart_coordinator(&mut self) {
        self.coordinator().ask_to_leave();
        self.coordinator().end();
        self.start_coordinator();
    }

    /// The same for the second one.
    pub fn restart_second(&mut self) {
        let (port, process) = self.second.take().expect("it was announced");
        let mut process = process.expect("it was started");
        process.ask_to_leave();
        process.end();
        self.second = Some((port, None));
        self.start_second();
    }

    /// The address of the second coordinator.
    pub fn second_url(&self) -> String {
        let (port, _) = self.second.as_ref().expect("it was announced");
        format!("http://127.0.0.1:{port}")
    }

    /// The server of its jobs, and their database.
    pub fn database(&self) -> &(Server, String) {
        self.database.as_ref().expect("a database")
    }

    /// As [`Harness::start_coordinator`], but may fail; returns whether it serves.
    pub fn try_coordinator(&mut self) -> bool {
        self.try_named("coordinator")
    }

    fn try_named(&mut self, name: &str) -> bool {
        let Rules { lease_ms, max_losses, min_free_bytes } = &self.rules;
        let mut arguments = vec![
            "coordinator".to_owned(),
            "--stop-with-stdin".to_owned(),
            "--backoff-ms=100".to_owned(),
            format!("--data-dir={}", self.data.display()),
            format!("--listen=127.0.0.1:{}", self.port),
            format!("--lease-ms={lease_ms}"),
            format!("--max-losses={max_losses}"),
            format!("--min-free-bytes={min_free_bytes}"),
        ];
        arguments.extend(self.database.as_ref().map(|(_, url)| format!("--store={url}")));
        arguments.extend(self.bucket.as_ref().map(|bucket| format!("--objects={}", bucket.url(PREFIX))));
        let command = self.command(&arguments);
        let mut process = Process::start_command(name, command, &self.environment(), &self.log_folder());
        let ready = process.line().is_some_and(|line| line.starts_with("listening on http://"));
        self.coordinator = Some(process);
        ready
    }

    fn command<S: AsRef<str>>(&self, arguments: &[S]) -> Command {
        match &self.program {
            Some(program) => fathom_of(program, arguments),
            None => fathom(arguments),
        }
    }

    pub fn coordinator(&mut self) -> &mut Process {
        self.coordinator.as_mut().expect("a coordinator")
    }

    pub fn kill_coordinator(&mut self) {
        self.coordinator().kill();
        self.kills += 1;
    }

    /// Variables that the coordinator needs for its bucket. Coordinators of other versions may not know all
    /// of them.
    fn environment(&self) -> Vec<(&'static str, String)> {
        let transfers = [
            ("FATHOM_DIRECT_TRANSFERS", self.is_direct.to_string()),
            ("FATHOM_DIRECT_UPLOADS_FROM_BYTES", "262144".to_owned()),
        ];
        self.bucket.iter().flat_map(S3Server::environment).chain(transfers).collect()
    }

    pub fn has_database(&self) -> bool {
        self.database.is_some()
    }

    /// The server of its files.
    pub fn bucket(&self) -> &S3Server {
        self.bucket.as_ref().expect("a bucket")
    }

    /// Kills the database server, and starts it again after `pause`.
    pub fn kill_database(&mut self, pause: Duration) {
        let (server, _) = self.database.as_mut().expect("a database");
        server.kill();
        std::thread::sleep(pause);
        server.resume();
        self.kills += 1;
    }

    /// Starts another coordinator on the database, which must be refused; what it says.
    pub fn refused_coordinator(&self) -> String {
        let (_, url) = self.database.as_ref().expect("a database");
        let other = self.path("other-data");
        Self::refused_start(&["coordinator", "--data-dir", &other, "--store", url, "--listen", "127.0.0.1:0"])
    }

    /// Starts a coordinator on the data directory without its database; what it says.
    pub fn refused_without_store(&self) -> String {
        let data = self.data.to_string_lossy();
        Self::refused_start(&["coordinator", "--data-dir", &data, "--listen", "127.0.0.1:0"])
    }

    fn refused_start(words: &[&str]) -> String {
        let Output { status, stderr, .. } = output_of(words);
        assert!(!status.success(), "fathom {} was not refused", words.join(" "));
        String::from_utf8_lossy(&stderr).into_owned()
    }

    /// A worker that shares its photograph cache with other scenarios.
    pub fn start_worker(&mut self, name: &str) {
        let url = self.url();
        self.start_worker_at(name, &url, &reference::cache());
    }

    /// A worker with another address of the coordinator.
    pub fn start_worker_at(&mut self, name: &str, url: &str, cache: &Path) {
        let arguments = [
            "worker".to_owned(),
            "--stop-with-stdin".to_owned(),
            "--allow-cpu".to_owned(),
            format!("--coordinator={url}"),
            format!("--name={name}"),
            format!("--cache-dir={}", cache.display()),
        ];
        let process = Process::start_command(name, self.command(&arguments), &[], &self.log_folder());
        self.workers.insert(name.to_owned(), process);
    }

    pub fn worker(&mut self, name: &str) -> &mut Process {
        self.workers.get_mut(name).unwrap_or_else(|| panic!("no worker {name}"))
    }

    pub fn kill_worker(&mut self, name: &str) {
        self.worker(name).kill();
        self.kills += 1;
    }

    // User commands

    /// Runs a verb against the coordinator to its end.
    pub fn call(&self, words: &[&str]) -> Output {
        let url = self.url();
        let words = [words, &["--coordinator", &url]].concat();
        output_from(self.command(&words))
    }

    /// The same; it must succeed.
    pub fn ask(&self, words: &[&str]) -> String {
        let Output { status, stdout, stderr } = self.call(words);
        let said = String::from_utf8_lossy(&stderr).into_owned();
        assert!(status.success(), "fathom {} ended with {status}: {said}", words.join(" "));
        String::from_utf8(stdout).expect("text")
    }

    /// The same; it must fail. Returns its output.
    pub fn refused(&self, words: &[&str]) -> String {
        let Output { status, stderr, .. } = self.call(words);
        assert!(!status.success(), "fathom {} was not refused", words.join(" "));
        String::from_utf8_lossy(&stderr).into_owned()
    }

    pub fn show(&self, job: &str) -> Value {
        serde_json::from_str(&self.ask(&["show", job, "--json"])).expect("JSON")
    }

    pub fn task(&self, job: &Job, id: &str) -> Value {
        let job = self.show(&job.id);
        let tasks = job["tasks"].as_array().expect("tasks");
        tasks.iter().find(|task| task["task"] == id).unwrap_or_else(|| panic!("no {id} in {job}")).clone()
    }

    /// The arguments that submit the scene.
    pub fn submission<'a>(scene: &'a str, more: &[&'a str]) -> Vec<&'a str> {
        [&["submit", scene][..], &reference::JOB, more].concat()
    }

    /// A job, watched from its start.
    pub fn submit(&mut self) -> Job {
        self.submit_with(&[])
    }

    /// The same with more settings.
    pub fn submit_with(&mut self, more: &[&str]) -> Job {
        let scene = reference::scene().to_string_lossy().into_owned();
        let id = self.ask(&Self::submission(&scene, more)).trim().to_owned();
        self.watch(id)
    }

    /// Records an acknowledged job.
    pub fn watch(&mut self, id: String) -> Job {
        let user = self.watched;
        self.watched += 1;
        let (request, job) = (id.clone(), job_id(&id));
        self.note([Fact::Created { user, request, job }]);
        let words = ["watch", &id, "--json", "--coordinator", &self.url()].map(str::to_owned);
        let mut watch = Process::start(&format!("watch-{id}"), &words, &self.log_folder());
        let seen = Arc::<Mutex<Vec<(Instant, Value)>>>::default();
        let (lines, sink) = (watch.lines(), Arc::clone(&seen));
        std::thread::spawn(move || {
            for event in lines.filter_map(|line| serde_json::from_str(&line).ok()) {
                sink.lock().unwrap_or_else(PoisonError::into_inner).push((Instant::now(), event));
            }
        });
        Job { id, user, watch: Mutex::new(watch), seen }
    }

    fn note(&mut self, facts: impl IntoIterator<Item = Fact>) {
        let now = self.begin.elapsed();
        self.facts.extend(facts.into_iter().map(|fact| (now, fact)));
    }

    /// Waits for the given end state of a job, and records what was seen of it.
    pub fn ended(&mut self, job: &Job, state: &str) -> History {
        job.watch.lock().unwrap_or_else(PoisonError::into_inner).end();
        let shown = self.show(&job.id);
        assert_eq!(shown["state"], state, "{shown:#}");
        let printed = String::from_utf8_lossy(&self.call(&["watch", &job.id, "--json"]).stdout).into_owned();
        let events: Vec<Value> = printed.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
        self.note(seen(job.user, &job_id(&job.id), &job.seen(), false));
        self.note(seen(job.user, &job_id(&job.id), &events, true));
        self.ended += 1;
        self.succeeded += usize::from(state == "succeeded");
        History::of(events.into_iter())
    }

    /// The model of a job that has succeeded.
    pub fn download(&mut self, job: &Job) -> Vec<u8> {
        let out = self.path(&format!("out-{}", job.id));
        self.ask(&["download", &job.id, "-o", &out]);
        let bytes = std::fs::read(format!("{out}/model.ply")).expect("a model");
        let model = blake3::hash(&bytes).to_hex().to_string();
        self.note([Fact::Fetched { user: job.user, job: job_id(&job.id), model }]);
        bytes
    }

    /// Waits until a job succeeds; its model must equal the undisturbed one.
    pub fn succeeded(&mut self, job: &Job) -> History {
        let history = self.ended(job, "succeeded");
        assert!(self.download(job) == reference::model(), "job {} has another model\n{history}", job.id);
        history
    }

    /// Jobs deleted by their user need not be known.
    pub fn forget(&mut self, job: &Job) {
        let (user, job) = (job.user, job_id(&job.id));
        self.note([Fact::Deleting { user, job: job.clone() }, Fact::Deleted { user, job }]);
        self.ended += 1;
    }

    // Contents of the disk

    /// Where a tenant's files are: in the data directory, or in the folder of the bucket.
    fn objects(&self, tenant: &Tenant) -> PathBuf {
        let root = self.bucket.as_ref().map_or_else(|| self.data.clone(), |bucket| bucket.folder(PREFIX));
        TenantBlobs::folder(&root, tenant)
    }

    /// The file of a blob.
    fn blob(&self, tenant: &Tenant, blob: &BlobRef) -> PathBuf {
        self.objects(tenant).join("cas").join(&blob.digest[..2]).join(&blob.digest)
    }

    /// Complete blobs, with their names.
    pub fn blobs(&self) -> Vec<PathBuf> {
        let folders = files_in(&self.objects(&Tenant::default()).join("cas"));
        folders.iter().flat_map(|folder| files_in(folder)).collect()
    }

    /// Lengths of incomplete uploads, bytes.
    pub fn partial_uploads(&self) -> Vec<u64> {
        let length = |path: &PathBuf| path.metadata().map_or(0, |file| file.len());
        let uploads = files_in(&self.objects(&Tenant::default()).join("uploads"));
        if self.bucket.is_none() {
            return uploads.iter().map(length).collect();
        }
        // A folder of segments each.
        let segments = uploads.iter().map(|folder| files_in(folder)).filter(|files| !files.is_empty());
        segments.map(|files| files.iter().map(length).sum()).collect()
    }

    /// Stalls the next merge of a job before its first byte: it opens a pipe without a reader.
    pub fn hold_merge(&self, job: &Job) -> Vec<String> {
        // A merge names its file by its fence, and a scenario grants few fences.
        let staging = self.data.join("objects/staging");
        let pipe = |fence: u32| under(&staging, &format!("merge-{}-{fence}.ply.part", job.id));
        let pipes: Vec<String> = (1..100).map(pipe).collect();
        let made = std::process::Command::new("mkfifo").args(&pipes).status();
        assert!(made.expect("mkfifo").success(), "pipes could not be made");
        pipes
    }

    pub fn log_of(&self, process: &str) -> String {
        self.logs().into_iter().find(|(name, _)| name == process).map(|(_, log)| log).unwrap_or_default()
    }

    fn logs(&self) -> Vec<(String, String)> {
        let logs = files_in(&self.folder.path().join("logs")).into_iter().map(|path| {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            (name, std::fs::read_to_string(path).unwrap_or_default())
        });
        logs.collect()
    }
}

impl Drop for Harness {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            return;
        }
        for (name, log) in self.logs() {
            let lines: Vec<&str> = log.lines().collect();
            let last = lines[lines.len().saturating_sub(LAST_LINES)..].join("\n  ");
            eprintln!("--- {name}\n  {last}");
        }
        let Self { scenario, seed, .. } = self;
        eprintln!(
            "--- scenario {scenario}; again: FATHOM_KILLS_SEED={seed} cargo test --test kills {scenario}"
        );
    }
}
