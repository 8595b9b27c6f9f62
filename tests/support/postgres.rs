//! A PostgreSQL server of this test program, ended with it. Where there is none, its tests say so and are
//! skipped, unless FATHOM_TEST_REQUIRE_POSTGRES=1.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// Whether the server waits for its disk. Most tests need not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Disk {
    /// Commits survive a crash of the machine.
    Synced,
    /// Commits survive a crash of the server.
    Unsynced,
}

/// A running server.
pub struct Server {
    bin: PathBuf,
    dir: tempfile::TempDir,
    disk: Disk,
    is_shared: bool,
    /// A shell that ends the server when its standard input closes: this program may be killed.
    guard: Option<Child>,
    databases: AtomicU32,
}

/// The URL of a new database on the server that the tests of this program share; `None`: skip the test.
pub fn database() -> Option<String> {
    static SHARED: OnceLock<Option<Server>> = OnceLock::new();
    Some(SHARED.get_or_init(|| Server::start_with(Disk::Unsynced, true)).as_ref()?.database())
}

impl Server {
    /// Starts a server of its own; `None` where PostgreSQL is missing.
    pub fn start(disk: Disk) -> Option<Self> {
        Self::start_with(disk, false)
    }

    /// `is_shared`: it lives as long as the program, and its shell removes the folder.
    fn start_with(disk: Disk, is_shared: bool) -> Option<Self> {
        let Some(bin) = bin() else {
            let required = std::env::var_os("FATHOM_TEST_REQUIRE_POSTGRES").is_some();
            assert!(!required, "PostgreSQL is missing; run scripts/setup.sh");
            eprintln!("skipped: PostgreSQL is missing (scripts/setup.sh installs it)");
            return None;
        };
        let dir = tempfile::Builder::new().prefix("fathom-pg-").tempdir().expect("a folder");
        let mut server = Self { bin, dir, disk, is_shared, guard: None, databases: AtomicU32::new(0) };
        if is_root() {
            // The server refuses to run as root; Debian's package made this user.
            run(Command::new("chown").arg("postgres:postgres").arg(server.dir.path()));
        }
        let mut init = server.command("initdb");
        init.args(["--auth=trust", "--username=fathom", "--encoding=UTF8", "--locale=C", "--no-sync", "-D"]);
        run(init.arg(server.data()));
        server.resume();
        Some(server)
    }

    /// Starts the server again after [`Self::kill`].
    pub fn resume(&mut self) {
        let mut postgres = self.command("postgres");
        postgres.arg("-D").arg(self.data()).arg("-k").arg(self.dir.path());
        for setting in [
            "listen_addresses=",
            "max_connections=300",
            "shared_buffers=64MB",
            "logging_collector=off",
            if self.disk == Disk::Synced { "fsync=on" } else { "fsync=off" },
        ] {
            postgres.arg("-c").arg(setting);
        }
        let log = std::fs::OpenOptions::new().create(true).append(true).open(self.log()).expect("a log");
        let mut guard = Command::new("sh");
        let ends = r#""$@" <&- & server=$!; read -r _; kill -QUIT $server; wait $server; rm -rf $REMOVE"#;
        guard.args(["-c", ends, "sh"]);
        let remove = format!("{} {}", self.dir.path().display(), self.log().display());
        guard.env("REMOVE", if self.is_shared { &remove } else { "" });
        guard.arg(postgres.get_program()).args(postgres.get_args());
        let guard = guard.current_dir("/").stdin(Stdio::piped());
        let guard = guard.stdout(log.try_clone().expect("a log")).stderr(log).spawn().expect("a shell");
        self.guard = Some(guard);
        let begin = Instant::now();
        while !self
            .command("pg_isready")
            .arg("-q")
            .arg("-h")
            .arg(self.dir.path())
            .status()
            .is_ok_and(|s| s.success())
        {
            let log = || std::fs::read_to_string(self.log()).unwrap_or_default();
            assert!(begin.elapsed() < Duration::from_secs(60), "PostgreSQL does not start: {}", log());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Kills the server's processes without a word.
    pub fn kill(&mut self) {
        let pid = std::fs::read_to_string(self.data().join("postmaster.pid")).expect("a running server");
        let pid: u32 = pid.lines().next().and_then(|pid| pid.parse().ok()).expect("its process");
        // A child that outlives its parent for a moment would keep the next server from starting.
        let processes: Vec<String> =
            std::iter::once(pid).chain(children(pid)).map(|pid| pid.to_string()).collect();
        // One of them may have ended just now.
        let _ = Command::new("kill").arg("-KILL").args(&processes).stderr(Stdio::null()).status();
        let mut guard = self.guard.take().expect("a running server");
        drop(guard.stdin.take());
        guard.wait().expect("its shell");
        let begin = Instant::now();
        while processes.iter().any(|pid| is_running(pid)) {
            assert!(begin.elapsed() < Duration::from_secs(20), "a process of PostgreSQL does not end");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The folder of its socket.
    pub fn folder(&self) -> &Path {
        self.dir.path()
    }

    /// Creates a database; returns its URL.
    pub fn database(&self) -> String {
        let name = format!("test{}", self.databases.fetch_add(1, Ordering::Relaxed));
        run(self.command("createdb").arg("-h").arg(self.dir.path()).args(["-U", "fathom", &name]));
        self.url(&name)
    }

    /// The URL of a database.
    pub fn url(&self, database: &str) -> String {
        format!("postgres://fathom@localhost/{database}?host={}", self.dir.path().display())
    }

    /// Runs SQL in the database of `url`; what it prints.
    pub fn sql(&self, url: &str, sql: &str) -> String {
        let database =
            url.rsplit('/').find_map(|part| part.split_once('?')).map_or("postgres", |(name, _)| name);
        let mut psql = self.command("psql");
        psql.arg("-h").arg(self.dir.path()).args(["-U", "fathom", "-d", database, "-qAtc", sql]);
        run(&mut psql)
    }

    /// Writes the database of `url` as SQL, as its operators would.
    pub fn dump(&self, url: &str, file: &Path) {
        let sql = run(self.command("pg_dump").arg("--dbname").arg(url));
        std::fs::write(file, sql).expect("written");
    }

    /// Creates a database of what [`Self::dump`] wrote; returns its URL.
    pub fn restored(&self, file: &Path) -> String {
        let url = self.database();
        let sql = std::fs::File::open(file).expect("a dump");
        let mut psql = self.command("psql");
        run(psql.args(["-q", "-v", "ON_ERROR_STOP=1", "-d", &url]).stdin(sql));
        url
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn log(&self) -> PathBuf {
        std::env::temp_dir().join(self.dir.path().file_name().expect("a name")).with_extension("log")
    }

    /// A program of the server, as the user that may run it.
    fn command(&self, program: &str) -> Command {
        let program = self.bin.join(program);
        let mut command = if is_root() {
            let mut command = Command::new("setpriv");
            command.args(["--reuid=postgres", "--regid=postgres", "--clear-groups", "--"]).arg(program);
            command
        } else {
            Command::new(program)
        };
        command.current_dir("/").stdin(Stdio::null());
        command
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(mut guard) = self.guard.take() {
            drop(guard.stdin.take());
            let _ = guard.wait();
        }
        let _ = std::fs::remove_file(self.log());
    }
}

/// The folder of the server's programs: on the PATH, or where Debian puts the newest version.
fn bin() -> Option<PathBuf> {
    let has_all = |bin: &Path| {
        ["initdb", "postgres", "createdb", "pg_isready", "pg_dump", "psql"]
            .iter()
            .all(|name| bin.join(name).is_file())
    };
    let path = std::env::var_os("PATH").unwrap_or_default();
    if let Some(bin) = std::env::split_paths(&path).find(|bin| has_all(bin)) {
        return Some(bin);
    }
    let versions = std::fs::read_dir("/usr/lib/postgresql").ok()?;
    let bins = versions.filter_map(|entry| Some(entry.ok()?.path().join("bin")));
    let mut bins: Vec<PathBuf> = bins.filter(|bin| has_all(bin)).collect();
    bins.sort_by_key(|bin| {
        let version =
            bin.parent().and_then(Path::file_name).and_then(|name| name.to_str()?.parse::<u32>().ok());
        version.unwrap_or(0)
    });
    bins.pop()
}

/// Fields of `/proc/PID/stat` after the name: state, parent, ...
fn stat(pid: &str) -> Option<Vec<String>> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let (_, after_name) = stat.rsplit_once(')')?;
    Some(after_name.split_whitespace().map(str::to_owned).collect())
}

/// Whether a process runs; a dead one that nobody has waited for does not.
fn is_running(pid: &str) -> bool {
    stat(pid).is_some_and(|fields| fields[0] != "Z")
}

fn children(parent: u32) -> Vec<u32> {
    let processes = std::fs::read_dir("/proc").expect("processes").filter_map(|entry| entry.ok());
    let names = processes.filter_map(|process| process.file_name().into_string().ok());
    let numbers = names.filter_map(|name| name.parse::<u32>().ok());
    let is_child = |pid: &u32| stat(&pid.to_string()).is_some_and(|fields| fields[1] == parent.to_string());
    numbers.filter(is_child).collect()
}

fn is_root() -> bool {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata("/proc/self").is_ok_and(|process| process.uid() == 0)
}

/// Runs a program; what it prints.
fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{command:?}: {}{}", text(&output.stdout), text(&output.stderr));
    text(&output.stdout)
}
