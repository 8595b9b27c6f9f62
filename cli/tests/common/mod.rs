//! Running the real binary: commands, services that a test may kill, and what a machine lacks.
#![allow(dead_code, reason = "each test file uses a part of this one")]

use std::io::{BufRead as _, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Output, Stdio};

use serde_json::Value;

/// `fathom` with `arguments`, without what the environment of the tester might set.
pub fn fathom<S: AsRef<str>>(arguments: &[S]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fathom"));
    for name in [
        "FATHOM_ALLOW_CPU",
        "FATHOM_CACHE_BYTES",
        "FATHOM_CACHE_DIR",
        "FATHOM_CONFIG",
        "FATHOM_COORDINATOR",
        "FATHOM_DATA_DIR",
        "FATHOM_GPU",
        "FATHOM_LEASE_MS",
        "FATHOM_LISTEN",
        "FATHOM_WORKER_NAME",
    ] {
        command.env_remove(name);
    }
    command.args(arguments.iter().map(AsRef::as_ref)).stdin(Stdio::null());
    command
}

/// Runs it to its end, which must be good.
pub fn succeed<S: AsRef<str>>(arguments: &[S]) -> String {
    let output = fathom(arguments).output().expect("the binary starts");
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

/// Runs it to its end, which must be a failure; gives what it said on stderr.
pub fn fail<S: AsRef<str>>(arguments: &[S]) -> (i32, String) {
    let Output { status, stderr, .. } = fathom(arguments).output().expect("the binary starts");
    let said = String::from_utf8_lossy(&stderr).into_owned();
    let line = arguments.iter().map(AsRef::as_ref).collect::<Vec<_>>().join(" ");
    assert!(!status.success(), "fathom {line} succeeded");
    (status.code().unwrap_or_else(|| panic!("fathom {line} was killed: {said}")), said)
}

/// JSON that a verb printed.
pub fn json<S: AsRef<str>>(arguments: &[S]) -> Value {
    let text = succeed(arguments);
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// Whether something can train here; says so when not, and fails where FATHOM_TEST_REQUIRE_GPU=1.
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
        let mut child = fathom(arguments)
            .arg("--stop-with-stdin")
            .stdin(Stdio::piped())
            .stdout(stdout)
            .spawn()
            .expect("the binary starts");
        let stdin = child.stdin.take();
        Self { child, stdin }
    }

    /// A coordinator on `port`, ready to serve.
    pub fn coordinator(data_dir: &str, port: u16) -> Self {
        let listen = format!("127.0.0.1:{port}");
        let arguments = ["coordinator", "--data-dir", data_dir, "--listen", &listen, "--lease-ms", "5000"];
        let mut service = Self::start(&arguments, Stdio::piped());
        let stdout = service.child.stdout.take().expect("a pipe");
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("a line");
        assert!(line.starts_with("listening on http://"), "the coordinator said {line:?}");
        service
    }

    /// A worker with its cache in `cache_dir`, which workers may share.
    pub fn worker(url: &str, name: &str, cache_dir: &str) -> Self {
        let arguments =
            ["worker", "--coordinator", url, "--name", name, "--cache-dir", cache_dir, "--allow-cpu"];
        Self::start(&arguments, Stdio::null())
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
        // Either may fail because it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A port that is free now. Another process may take it before it is used, which fails the test visibly.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port()
}
