//! A coordinator and workers as child processes of `fathom train`, the same processes as in a service.
//!
//! Children never outlive their parent. Each holds the read end of a pipe from the parent and stops when the
//! pipe closes, which happens however the parent dies. Their output goes to log files.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::mpsc;

use crate::error::{CliError, Result};
use crate::output;

/// Flag that makes a service stop when its standard input closes.
pub const STOP_WITH_PARENT: &str = "--stop-with-stdin";
/// The coordinator prints this before its URL when it is ready.
pub const LISTENING: &str = "listening on ";
/// The coordinator prints this before the link to its page, if it serves one.
pub const PAGE: &str = "page on ";
/// Opening a store and binding a port takes well under a second; repairing a store takes longer.
const START_PATIENCE: Duration = Duration::from_secs(60);
/// Heartbeats within one machine are seconds late at most. After all processes were killed, a resumed run
/// continues within this lease.
const LEASE_MS: &str = "10000";
/// All workers of this run have the same memory, so a task too large for them fails after this time.
const CAPACITY_TIMEOUT_MS: &str = "3000";
/// Environment variables that configure a user's own service. They are removed, because children only talk to
/// each other on this machine.
const NOT_FOR_CHILDREN: [&str; 13] = [
    "FATHOM_CONFIG",
    "FATHOM_WORKER_CONFIG",
    "FATHOM_TOKENS",
    "FATHOM_SERVER_TLS_CERT",
    "FATHOM_SERVER_TLS_KEY",
    "FATHOM_CLIENT_CA",
    "FATHOM_TOKEN",
    "FATHOM_TOKEN_FILE",
    "FATHOM_TLS_CA",
    "FATHOM_TLS_CERT",
    "FATHOM_TLS_KEY",
    "FATHOM_CALLS_PER_SECOND",
    "FATHOM_WEB",
];
/// Maximum number of restarts of a dead worker.
const RESTARTS: u32 = 3;

/// One child and how to start it.
struct Process {
    what: String,
    arguments: Vec<String>,
    log: PathBuf,
    child: Child,
    restarts: u32,
}

/// The coordinator and the workers of one run.
pub struct Children {
    coordinator: Process,
    workers: Vec<Process>,
    pub url: String,
    /// The link to the page that shows the job, if asked for. It can be used once; then the next one arrives.
    pub page: Option<String>,
    /// The later links.
    later_pages: mpsc::UnboundedReceiver<String>,
}

impl Children {
    /// Starts a coordinator on a free loopback port, with a page if asked for, and a worker for each entry of
    /// `worker_arguments`.
    pub async fn start(
        data_dir: &Path,
        logs: &Path,
        worker_arguments: &[Vec<String>],
        with_page: bool,
    ) -> Result<Self> {
        std::fs::create_dir_all(logs).map_err(CliError::io("create", logs))?;
        let arguments = [
            "coordinator",
            "--listen",
            "127.0.0.1:0",
            "--lease-ms",
            LEASE_MS,
            "--capacity-timeout-ms",
            CAPACITY_TIMEOUT_MS,
            "--data-dir",
        ]
        .map(str::to_owned);
        let mut arguments: Vec<_> =
            arguments.into_iter().chain([data_dir.to_string_lossy().into_owned()]).collect();
        if with_page {
            arguments.extend(["--web", "127.0.0.1:0", "--own-page"].map(str::to_owned));
        }
        let mut coordinator = Process::start("coordinator".to_owned(), arguments, logs)?;
        let (sender, later_pages) = mpsc::unbounded_channel();
        let (url, page) = coordinator.wait_for_url(sender).await?;
        let mut workers = Vec::new();
        for (index, extra) in worker_arguments.iter().enumerate() {
            let mut arguments = vec!["worker".to_owned(), "--coordinator".to_owned(), url.clone()];
            arguments.extend(extra.iter().cloned());
            workers.push(Process::start(format!("worker-{index}"), arguments, logs)?);
        }
        Ok(Self { coordinator, workers, url, page, later_pages })
    }

    /// Waits until a process dies that cannot be replaced; workers are restarted a few times. Meanwhile it
    /// prints the next link to the page whenever one has been used.
    pub async fn failure(&mut self) -> CliError {
        loop {
            tokio::time::sleep(Duration::from_millis(300)).await;
            while let Ok(page) = self.later_pages.try_recv() {
                output::remark_over_bar(format!(
                    "the link to the page has been used; the next one is {page}"
                ));
            }
            if let Some(error) = self.coordinator.death() {
                return error;
            }
            for worker in &mut self.workers {
                let Some(error) = worker.death() else { continue };
                if worker.restarts == RESTARTS {
                    return error;
                }
                tracing::warn!("{error}; restarting it");
                if let Err(error) = worker.restart() {
                    return error;
                }
            }
        }
    }

    /// Asks all children to stop and waits; kills those that do not stop in time.
    pub async fn stop(mut self) {
        // Workers first: they would wait for a coordinator that is gone.
        for process in self.workers.iter_mut().chain([&mut self.coordinator]) {
            drop(process.child.stdin.take());
            if tokio::time::timeout(Duration::from_secs(5), process.child.wait()).await.is_err() {
                // If this fails, the process has already ended by itself.
                let _ = process.child.kill().await;
            }
        }
    }
}

impl Process {
    fn start(what: String, arguments: Vec<String>, logs: &Path) -> Result<Self> {
        let log = logs.join(format!("{what}.log"));
        let child = spawn(&arguments, &log)?;
        Ok(Self { what, arguments, log, child, restarts: 0 })
    }

    fn restart(&mut self) -> Result<()> {
        self.restarts += 1;
        self.child = spawn(&self.arguments, &self.log)?;
        Ok(())
    }

    /// The URL of a coordinator, and the link to its page. Later links go to `later_pages`.
    async fn wait_for_url(
        &mut self,
        later_pages: mpsc::UnboundedSender<String>,
    ) -> Result<(String, Option<String>)> {
        let stdout: ChildStdout =
            self.child.stdout.take().ok_or_else(|| self.ended("has no output".to_owned()))?;
        let mut lines = BufReader::new(stdout).lines();
        let mut page = None;
        let found = tokio::time::timeout(START_PATIENCE, async {
            while let Ok(Some(line)) = lines.next_line().await {
                if let Some(link) = line.strip_prefix(PAGE) {
                    page = Some(link.trim().to_owned());
                }
                if let Some(url) = line.strip_prefix(LISTENING) {
                    return Some(url.trim().to_owned());
                }
            }
            None
        })
        .await;
        match found {
            Ok(Some(url)) => {
                tokio::spawn(async move {
                    while let Ok(Some(line)) = lines.next_line().await {
                        if let Some(link) = line.strip_prefix(PAGE)
                            && later_pages.send(link.trim().to_owned()).is_err()
                        {
                            return;
                        }
                    }
                });
                Ok((url, page))
            }
            Ok(None) => Err(self.ended("ended before it was ready".to_owned())),
            Err(_) => Err(self.ended(format!("was not ready after {} s", START_PATIENCE.as_secs()))),
        }
    }

    /// The error if this process has ended.
    fn death(&mut self) -> Option<CliError> {
        match self.child.try_wait() {
            Ok(None) => None,
            Ok(Some(status)) => Some(self.ended(format!("ended ({status})"))),
            Err(error) => Some(self.ended(format!("cannot be watched ({error})"))),
        }
    }

    fn ended(&self, how: String) -> CliError {
        let log = std::fs::read(&self.log).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        let last = match &log {
            Ok(log) => {
                log.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("its log is empty").trim()
            }
            Err(error) => &format!("its log cannot be read ({error})"),
        };
        CliError::Message(format!("the {} {how}: {last}; see {}", self.what, self.log.display()))
    }
}

fn spawn(arguments: &[String], log: &Path) -> Result<Child> {
    let program = std::env::current_exe().map_err(CliError::io("find", "the program itself"))?;
    let log_file = File::options().create(true).append(true).open(log).map_err(CliError::io("write", log))?;
    let mut command = Command::new(&program);
    // Ctrl-C in a terminal goes to the whole process group. Here the parent stops its children in order
    // instead.
    #[cfg(unix)]
    command.process_group(0);
    for name in NOT_FOR_CHILDREN {
        command.env_remove(name);
    }
    command
        .args(arguments)
        .arg(STOP_WITH_PARENT)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::from(log_file))
        .env("NO_COLOR", "1")
        // Meant for one process; several would compete for the address.
        .env_remove("FATHOM_METRICS_LISTEN")
        .env_remove("FATHOM_WORKER_METRICS_LISTEN")
        .kill_on_drop(true)
        .spawn()
        .map_err(CliError::io("start", program))
}

/// In a child process: completes when the parent's end of standard input closes.
pub fn stdin_closes() -> tokio::sync::oneshot::Receiver<()> {
    let (sender, receiver) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        let mut sink = [0; 256];
        while matches!(std::io::Read::read(&mut std::io::stdin(), &mut sink), Ok(1..)) {}
        tracing::info!("the parent process has exited; stopping");
        // The send fails only when this process is already stopping.
        let _ = sender.send(());
    });
    receiver
}

/// Ends when this process is asked to stop: Ctrl-C, or SIGTERM.
pub async fn stop_signal() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let Ok(mut terminate) = signal(SignalKind::terminate()) else {
            return std::future::pending().await;
        };
        tokio::select! {
            _ = terminate.recv() => {}
            _ = tokio::signal::ctrl_c() => {}
        }
    }
    #[cfg(not(unix))]
    {
        // Without a handler there is nothing to wait for: the system's default ends the process.
        if tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}
