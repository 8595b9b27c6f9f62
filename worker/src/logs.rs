//! Sends the log lines of attempts to the coordinator, so that they survive this worker.
//!
//! Logging never blocks (see [`fathom_observe::queue`]). While the coordinator is down, lines wait in a
//! bounded queue; further lines are dropped.

use std::sync::Arc;
use std::time::Duration;

use fathom_observe::capture::{LoggedLine, Sink};
use fathom_observe::queue::{BATCH, Batch, Queue};
use fathom_proto::dial::Connection;
use fathom_proto::v1::LogSeverity;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use prost_types::Timestamp;
use tokio::task::JoinHandle;
use tracing::Level;

use crate::retry::{pauses, will_pass};

/// Lines of this period are sent together.
const GATHER_FOR: Duration = Duration::from_millis(300);
/// Time limit of one call before it is retried.
const CALL_WITHIN: Duration = Duration::from_secs(10);
/// Time limit for a leaving worker to send its last lines.
const LAST_LINES_WITHIN: Duration = Duration::from_secs(2);

/// The sender task; it ends when this is dropped.
pub struct Shipper {
    lines: Arc<Queue<v1::Lease>>,
    task: JoinHandle<()>,
}

impl Shipper {
    /// Starts to send lines.
    pub fn start(client: WorkerServiceClient<Connection>) -> Self {
        let lines = Arc::new(Queue::default());
        let task = tokio::spawn(ship(client, Arc::clone(&lines)));
        Self { lines, task }
    }

    /// The destination of an attempt's lines.
    pub fn sink(&self, lease: v1::Lease) -> Arc<dyn Sink> {
        self.lines.sink(lease)
    }

    /// Waits briefly for the last lines to be sent.
    pub async fn finish(&self) {
        // Lines left after that are lost with this process.
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
                // The lease expired long ago, or the coordinator is older than this worker.
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
    let line = |(number, line): &(u64, LoggedLine)| v1::LogLine {
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
