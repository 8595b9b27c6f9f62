//! Runs the real binary: commands, services that a test may kill, and checks for missing hardware.
#![allow(dead_code, reason = "each test file uses a part of this one")]

use std::io::{BufRead as _, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use serde_json::Value;

/// `fathom` with `arguments`, without FATHOM variables of the tester's environment.
pub fn fathom<S: AsRef<str>>(arguments: &[S]) -> Command {
    fathom_of(Path::new(env!("CARGO_BIN_EXE_fathom")), arguments)
}

/// The same with another version of the program.
pub fn fathom_of<S: AsRef<str>>(program: &Path, arguments: &[S]) -> Command {
    let mut command = Command::new(program);
    // Variables for tests and logs stay.
    let is_setting =
        |name: &str| name.starts_with("FATHOM_") && !name.starts_with("FATHOM_TEST_") && name != "FATHOM_LOG";
    for (name, _) in std::env::vars_os() {
        if name.to_str().is_some_and(is_setting) {
            command.env_remove(name);
        }
    }
    command.args(arguments.iter().map(AsRef::as_ref)).stdin(Stdio::null());
    command
}

/// Kills a process that exceeds the time limit, so that a hanging test fails.
pub struct Watchdog {
    /// Closes when dropped, which stops the watchdog.
    _alive: Sender<()>,
}

impl Watchdog {
    /// Much longer than a job of these tests takes on two busy cores.
    const PATIENCE: Duration = Duration::from_secs(20 * 60);

    pub fn over(child: &Child) -> Self {
        let (alive, gone) = channel::<()>();
        let process = child.id().to_string();
        std::thread::spawn(move || {
            if gone.recv_timeout(Self::PATIENCE) == Err(RecvTimeoutError::Timeout) {
                eprintln!("process {process} is killed: it has run for {:?}", Self::PATIENCE);
                // It may have just ended.
                let _ = Command::new("kill").args(["-9", &process]).status();
            }
        });
        Self { _alive: alive }
    }
}

/// Runs it to its end, with any result.
pub fn output_of<S: AsRef<str>>(arguments: &[S]) -> Output {
    output_in(&[], arguments)
}

/// The same with more variables in its environment.
pub fn output_in<S: AsRef<str>>(environment: &[(&str, String)], arguments: &[S]) -> Output {
    let mut command = fathom(arguments);
    command.envs(environment.iter().map(|(name, value)| (name, value)));
    output_from(command)
}

/// The same for a command that is not started yet.
pub fn output_from(mut command: Command) -> Output {
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let child = child.expect("the binary starts");
    let _watchdog = Watchdog::over(&child);
    child.wait_with_output().expect("its output")
}

/// Runs it to its end; it must succeed.
pub fn succeed<S: AsRef<str>>(arguments: &[S]) -> String {
    let output = output_of(arguments);
    assert!(
        output.status.success(),
        "fathom {} ended with {}\nstdout: {}\nstderr: {}",
        arguments.iter().map(AsRef::as_ref).collect::<Vec<_>>().join(" "),
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("text")
}

/// Runs it to its end; it must fail. Returns its exit code and stderr.
pub fn fail<S: AsRef<str>>(arguments: &[S]) -> (i32, String) {
    let Output { status, stderr, .. } = output_of(arguments);
    let said = String::from_utf8_lossy(&stderr).into_owned();
    let line = arguments.iter().map(AsRef::as_ref).collect::<Vec<_>>().join(" ");
    assert!(!status.success(), "fathom {line} succeeded");
    (status.code().unwrap_or_else(|| panic!("fathom {line} was killed: {said}")), said)
}

/// The JSON output of a verb.
pub fn json<S: AsRef<str>>(arguments: &[S]) -> Value {
    let text = succeed(arguments);
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// Whether this machine can train; prints a note if not, and fails if FATHOM_TEST_REQUIRE_GPU=1.
pub fn can_train(test: &str) -> bool {
    fathom_core::gpu::device_for_test(test).is_some()
}

/// A scene for tests: few small photographs.
pub fn tiny_scene(folder: &Path) -> String {
    let scene = folder.join("scene").to_string_lossy().into_owned();
    succeed(&["synth", &scene, "--views", "64", "--size", "96x72"]);
    scene
}

/// A path under a folder, as an argument.
pub fn under(folder: &Path, name: &str) -> String {
    folder.join(name).to_string_lossy().into_owned()
}

/// A service process; killed when the test ends, however it ends.
pub struct Service {
    child: Child,
    /// The service stops when this closes, even when the test itself is killed.
    stdin: Option<ChildStdin>,
}

impl Service {
    fn start(arguments: &[&str], stdout: Stdio) -> Self {
        Self::logging_to(arguments, stdout, Stdio::inherit())
    }

    /// The same with another log destination.
    pub fn logging_to(arguments: &[&str], stdout: Stdio, stderr: Stdio) -> Self {
        Self::with_environment(arguments, stdout, stderr, &[])
    }

    /// The same with these environment variables.
    pub fn with_environment(
        arguments: &[&str],
        stdout: Stdio,
        stderr: Stdio,
        variables: &[(&str, &str)],
    ) -> Self {
        let mut child = fathom(arguments)
            .arg("--stop-with-stdin")
            .envs(variables.iter().copied())
            .stdin(Stdio::piped())
            .stdout(stdout)
            .stderr(stderr)
            .spawn()
            .expect("the binary starts");
        let stdin = child.stdin.take();
        Self { child, stdin }
    }

    /// A coordinator on `port`, ready to serve.
    pub fn coordinator(data_dir: &str, port: u16) -> Self {
        let listen = format!("127.0.0.1:{port}");
        let (service, url) =
            Self::coordinator_with(&["--data-dir", data_dir, "--listen", &listen, "--lease-ms", "5000"]);
        assert_eq!(url, format!("http://{listen}"));
        service
    }

    /// A coordinator with these flags, ready to serve, and its URL.
    pub fn coordinator_with(flags: &[&str]) -> (Self, String) {
        let mut service = Self::start(&[&["coordinator"], flags].concat(), Stdio::piped());
        let url = service.wait_until_it_listens();
        (service, url)
    }

    /// Waits until a coordinator with piped output is ready, and returns its URL.
    pub fn wait_until_it_listens(&mut self) -> String {
        let stdout = self.stdout();
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("a line");
        let url = line.trim_end().strip_prefix("listening on ");
        url.unwrap_or_else(|| panic!("the coordinator said {line:?}")).to_owned()
    }

    /// A worker with these flags.
    pub fn worker_with(flags: &[&str]) -> Self {
        Self::start(&[&["worker", "--allow-cpu"], flags].concat(), Stdio::null())
    }

    /// A worker with its cache in `cache_dir`, which workers may share.
    pub fn worker(url: &str, name: &str, cache_dir: &str) -> Self {
        let arguments =
            ["worker", "--coordinator", url, "--name", name, "--cache-dir", cache_dir, "--allow-cpu"];
        Self::start(&arguments, Stdio::null())
    }

    /// What a service with piped output prints.
    pub fn stdout(&mut self) -> std::process::ChildStdout {
        self.child.stdout.take().expect("a pipe")
    }

    /// SIGKILL: nothing is cleaned up.
    pub fn kill(&mut self) {
        self.child.kill().expect("the process is there to be killed");
        self.child.wait().expect("it has ended");
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop(self.stdin.take());
        // Either call may fail because the process has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A port that is free now. If another process takes it first, the test fails visibly.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port()
}
