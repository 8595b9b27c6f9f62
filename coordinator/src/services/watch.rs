//! The stream of a job's events.

use std::sync::Arc;
use std::time::Duration;

use fathom_proto::v1;
use fathom_proto::v1::job_event::Event;
use futures::StreamExt;
use futures::stream::BoxStream;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use super::encode;
use crate::access::{Principal, Refused};
use crate::schedule::{EventBody, JobId, LiveProgress, TaskId};
use crate::service_error::ServiceError;
use crate::state::{State, stopped};

/// Events queued for a slow watcher; beyond it only this watcher waits.
const QUEUE: usize = 64;
/// Events per read from the store.
const PAGE: usize = 256;
/// Shortest interval between reads of a watcher.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Longest interval between reads.
const LOOK_AT_LEAST_EVERY: Duration = Duration::from_secs(1);
/// Silence after which a keep-alive is sent.
const KEEP_ALIVE_EVERY: Duration = Duration::from_secs(15);

/// All events of a job after `after_seq`, until it has ended.
pub fn events(
    shared: Arc<State>,
    caller: Principal,
    job: JobId,
    after_seq: u64,
) -> BoxStream<'static, Result<v1::JobEvent, Status>> {
    let (sender, receiver) = mpsc::channel(QUEUE);
    tokio::spawn(async move {
        let mut watcher = Watcher { shared, caller, job, seq: after_seq, reported: Vec::new(), sender };
        if let Err(Ended::Failed(error)) = watcher.run().await {
            // A watcher that has left does not need the error.
            let _ = watcher.sender.send(Err(error.into())).await;
        }
    });
    ReceiverStream::new(receiver).boxed()
}

struct Watcher {
    shared: Arc<State>,
    caller: Principal,
    job: JobId,
    /// The last durable event that was sent.
    seq: u64,
    /// The progress that was sent last.
    reported: Vec<(TaskId, LiveProgress)>,
    sender: mpsc::Sender<Result<v1::JobEvent, Status>>,
}

enum Ended {
    /// The client went away.
    Gone,
    /// The store failed.
    Failed(ServiceError),
}

impl<E: Into<ServiceError>> From<E> for Ended {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

impl Watcher {
    async fn run(&mut self) -> Result<(), Ended> {
        let mut changes = self.shared.wakeups.changes.subscribe();
        let mut stopping = self.shared.stopping.clone();
        let mut last_sent = tokio::time::Instant::now();
        loop {
            changes.mark_unchanged();
            if !self.shared.access.still_holds(&self.caller, self.shared.clock.now_ms()) {
                return Err(Ended::Failed(Refused::NotValid.into()));
            }
            // Read before the events: a job that had ended then gets no further event.
            let ended = !self.shared.jobs.job_row(&self.job).await?.state.is_open();
            let mut sent = self.send_durable().await?;
            if ended {
                return Ok(());
            }
            sent |= self.send_progress().await?;
            if !sent && last_sent.elapsed() >= KEEP_ALIVE_EVERY {
                self.send_passing(Event::KeepAlive(v1::KeepAlive {})).await?;
                sent = true;
            }
            if sent {
                last_sent = tokio::time::Instant::now();
            }
            tokio::time::sleep(LOOK_EVERY).await;
            tokio::select! {
                biased;
                () = self.sender.closed() => return Err(Ended::Gone),
                () = stopped(&mut stopping) => return Ok(()),
                _ = changes.changed() => {}
                () = tokio::time::sleep(LOOK_AT_LEAST_EVERY) => {}
            }
        }
    }

    async fn send_durable(&mut self) -> Result<bool, Ended> {
        let mut sent = false;
        loop {
            let page = self.shared.jobs.events(&self.job, self.seq, PAGE).await?;
            for event in &page {
                if let EventBody::Task { task, .. } = &event.body {
                    self.reported.retain(|(known, _)| known != task);
                }
                self.send(encode::event(self.job.as_str(), event)).await?;
                self.seq = event.seq;
                sent = true;
            }
            if page.len() < PAGE {
                return Ok(sent);
            }
        }
    }

    async fn send_progress(&mut self) -> Result<bool, Ended> {
        let (tasks, job_progress) = self.shared.jobs.progress(&self.job).await?;
        let mut sent = false;
        for (task, live) in &tasks {
            if self.reported.contains(&(*task, *live)) {
                continue;
            }
            let progress = Some(encode::progress(live));
            let event = v1::TaskProgress { task_id: task.to_string(), progress, job_progress };
            self.send_passing(Event::Progress(event)).await?;
            sent = true;
        }
        self.reported = tasks;
        Ok(sent)
    }

    async fn send_passing(&self, event: Event) -> Result<(), Ended> {
        let now_ms = self.shared.clock.now_ms();
        self.send(encode::passing_event(self.job.as_str(), self.seq, now_ms, event)).await
    }

    async fn send(&self, event: v1::JobEvent) -> Result<(), Ended> {
        self.sender.send(Ok(event)).await.map_err(|_| Ended::Gone)
    }
}
