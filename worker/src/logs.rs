//! Hands log lines of attempts to the coordinator, so that they are there when this worker is gone.
//!
//! Whoever logs never waits (see [`fathom_observe::queue`]). A coordinator that is away is waited for;
//! meanwhile the queue holds what it may hold, and no more.

use std::sync::Arc;
use std::time::Duration;

use fathom_observe::capture::{Line, Sink};
use fathom_observe::queue::{BATCH, Batch, Queue};
use fathom_proto::dial::Line as Connection;
use fathom_proto::v1::LogSeverity;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use prost_types::Timestamp;
use tokio::task::JoinHandle;
use tracing::Level;

use crate::retry::{pauses, will_pass};

/// Lines seldom come alone: those of so long a time go together.
const GATHER_FOR: Duration = Duration::from_millis(300);
/// One call may take so long; then it is made again.
const CALL_WITHIN: Duration = Duration::from_secs(10);
/// How long a worker that leaves tries to hand over its last lines.
const LAST_LINES_WITHIN: Duration = Duration::from_secs(2);

/// What sends the lines; it ends when this is dropped.
pub struct Shipper {
    lines: Arc<Queue<v1::Lease>>,
    task: JoinHandle<()>,
}

impl Shipper {
    /// Begins to send what comes.
    pub fn start(client: WorkerServiceClient<Connection>) -> Self {
        let lines = Arc::new(Queue::default());
        let task = tokio::spawn(ship(client, Arc::clone(&lines)));
        Self { lines, task }
    }

    /// Where the lines of an attempt go.
    pub fn sink(&self, lease: v1::Lease) -> Arc<dyn Sink> {
        self.lines.sink(lease)
    }

    /// Waits a moment for the last lines to be handed over.
    pub async fn finish(&self) {
        // What is left then is lost with this process.
        let _ = tokio::time::timeout(LAST_LINES_WITHIN, self.lines.emptied()).await;
    }
}

impl Drop for Shipper {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn ship(mut client: WorkerServiceClient<Connection>, lines: Arc<Queue<v1::Lease>>) {
    let mut waits = pauses();
    loop {
        let mut batch = lines.next().await;
        if batch.lines.len() < BATCH {
            tokio::time::sleep(GATHER_FOR).await;
            batch = lines.next().await;
        }
        match tokio::time::timeout(CALL_WITHIN, client.append_logs(request(&batch))).await {
            Ok(Ok(_)) => waits = pauses(),
            Ok(Err(status)) if !will_pass(&status) => {
                // The lease has been over for long, or the coordinator is older than this worker.
                tracing::debug!(error = %status.message(), lines = batch.lines.len(), "log lines were refused");
            }
            Ok(Err(_)) | Err(_) => {
                tokio::time::sleep(waits.next().unwrap_or_default()).await;
                continue;
            }
        }
        lines.remove(&batch);
    }
}

fn request(batch: &Batch<v1::Lease>) -> v1::AppendLogsRequest {
    let line = |(number, line): &(u64, Line)| v1::LogLine {
        number: *number,
        time: Some(Timestamp {
            seconds: (line.time_ms / 1000) as i64,
            nanos: (line.time_ms % 1000) as i32 * 1_000_000,
        }),
        severity: severity(line.level).into(),
        message: line.message.clone(),
    };
    v1::AppendLogsRequest {
        lease: Some(batch.of.as_ref().clone()),
        lines: batch.lines.iter().map(line).collect(),
    }
}

fn severity(level: Level) -> LogSeverity {
    match level {
        Level::TRACE => LogSeverity::Trace,
        Level::DEBUG => LogSeverity::Debug,
        Level::INFO => LogSeverity::Info,
        Level::WARN => LogSeverity::Warn,
        Level::ERROR => LogSeverity::Error,
    }
}
