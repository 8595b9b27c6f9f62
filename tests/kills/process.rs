//! A process that a test may kill, stop and continue, and its output.

use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::time::Duration;

use crate::processes::fathom;
use crate::small_disk::wait_for;

/// `fathom` with its log in a file; killed when this is dropped, and when the test itself is killed.
pub struct Process {
    pub name: String,
    child: Child,
    log: PathBuf,
    /// A service stops when this closes.
    _stdin: Option<ChildStdin>,
}

impl Process {
    /// Starts it; appends its log to `logs`/`name`.log.
    pub fn start(name: &str, arguments: &[String], logs: &Path) -> Self {
        Self::start_in(name, arguments, &[], logs)
    }

    /// The same with more variables in its environment.
    pub fn start_in(name: &str, arguments: &[String], environment: &[(&str, String)], logs: &Path) -> Self {
        Self::start_command(name, fathom(arguments), environment, logs)
    }

    /// The same with another version of the program.
    pub fn start_command(
        name: &str,
        mut command: Command,
        environment: &[(&str, String)],
        logs: &Path,
    ) -> Self {
        let log = logs.join(format!("{name}.log"));
        let file = File::options().create(true).append(true).open(&log).expect("a log");
        let mut child = command
            .env("FATHOM_LOG", "info")
            .env("NO_COLOR", "1")
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(file)
            .spawn()
            .expect("the binary starts");
        let _stdin = child.stdin.take();
        Self { name: name.to_owned(), child, log, _stdin }
    }

    /// The next line that it prints; `None` if it ends first.
    pub fn line(&mut self) -> Option<String> {
        let mut line = String::new();
        let stdout = self.child.stdout.take().expect("its output is taken once");
        BufReader::new(stdout).read_line(&mut line).expect("text");
        Some(line).filter(|line| !line.is_empty())
    }

    /// Its stdout, for a reader thread.
    pub fn lines(&mut self) -> impl Iterator<Item = String> + use<> {
        let stdout = self.child.stdout.take().expect("its output is taken once");
        BufReader::new(stdout).lines().map_while(Result::ok)
    }

    /// SIGKILL: nothing is cleaned up.
    pub fn kill(&mut self) {
        self.child.kill().expect("the process is there to be killed");
        self.child.wait().expect("it has ended");
    }

    /// SIGSTOP: the process stops without notice.
    pub fn suspend(&self) {
        self.signal("STOP");
    }

    /// SIGCONT.
    pub fn go_on(&self) {
        self.signal("CONT");
    }

    /// SIGTERM.
    pub fn ask_to_leave(&self) {
        self.signal("TERM");
    }

    fn signal(&self, name: &str) {
        let sent = Command::new("kill").args(["-s", name, &self.child.id().to_string()]).status();
        assert!(sent.expect("kill").success(), "{} is not there for SIG{name}", self.name);
    }

    /// Its exit status, if it has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a status")
    }

    /// Waits for its end.
    pub fn end(&mut self) -> ExitStatus {
        wait_for(&format!("the end of {}", self.name), || self.ended())
    }

    /// Its log so far.
    pub fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Either call may fail because the process has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Pseudorandom numbers from a seed (SplitMix64).
pub struct Random(u64);

impl Random {
    /// For one scenario; scenarios with the same seed get different numbers.
    pub fn new(seed: u64, scenario: &str) -> Self {
        Self(scenario.bytes().fold(seed, |state, byte| state.wrapping_mul(31).wrapping_add(byte.into())))
    }

    /// From 0 up to, but not including, `end`.
    pub fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % end
    }

    /// Sleeps for a random time between the two, milliseconds.
    pub fn sleep(&mut self, from_ms: u64, to_ms: u64) {
        std::thread::sleep(Duration::from_millis(from_ms + self.below(to_ms - from_ms)));
    }
}
