//! The thread that trains, and its connection to the session: reports, checkpoints, stops.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use fathom_proto::v1::Progress;
use futures::future::BoxFuture;
use tokio::runtime::Handle;
use tokio::sync::{Notify, OwnedMutexGuard, oneshot, watch};
use tracing::Instrument;

use crate::blobs::{BlobClient, BlobSource};
use crate::execute::{Control, Executor, Picture, Stop, TaskError, TaskInput, TaskOutput};
use crate::heartbeat::Pulse;
use crate::leaving::{SUBMIT_WITHIN, leave_deadline};
use crate::metrics::GpuMetrics;

/// Starts the training thread (in a simulation, a task).
pub fn spawn_training(
    executor: Arc<dyn Executor>,
    input: TaskInput,
    control: Arc<TaskControl>,
    seat: OwnedMutexGuard<()>,
) -> oneshot::Receiver<Result<TaskOutput, TaskError>> {
    let (sender, receiver) = oneshot::channel();
    let span = tracing::Span::current();
    if threads::are_simulated() {
        let training = async move {
            let _seat = seat;
            let result = executor.simulate(&input, control.as_ref()).await;
            // The receiver is gone if the work was abandoned.
            let _ = sender.send(result);
        };
        tokio::spawn(training.instrument(span));
        return receiver;
    }
    let started = std::thread::Builder::new().name("training".into()).spawn(move || {
        let _seat = seat;
        let result = span.in_scope(|| executor.execute(&input, control.as_ref()));
        // As above.
        let _ = sender.send(result);
    });
    if let Err(error) = started {
        tracing::error!(%error, "the training thread cannot start");
    }
    receiver
}

/// Stops the training thread when its result is no longer awaited.
pub struct StopOnDrop(pub Arc<TaskControl>);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.gone.send_replace(true);
    }
}

/// The latest of what the training thread submits, until it is uploaded.
pub struct Mailbox<T> {
    waiting: Mutex<Option<T>>,
    arrived: Notify,
}

impl<T> Default for Mailbox<T> {
    fn default() -> Self {
        Self { waiting: Mutex::new(None), arrived: Notify::new() }
    }
}

impl<T> Mailbox<T> {
    fn put(&self, latest: T) {
        *self.waiting.lock().unwrap_or_else(PoisonError::into_inner) = Some(latest);
        self.arrived.notify_one();
    }

    pub async fn take(&self) -> T {
        loop {
            if let Some(latest) = self.waiting.lock().unwrap_or_else(PoisonError::into_inner).take() {
                return latest;
            }
            self.arrived.notified().await;
        }
    }
}

/// The control of one attempt's thread.
pub struct TaskControl {
    pub pulse: Arc<Pulse>,
    pub blobs: BlobClient,
    pub runtime: Handle,
    /// Checkpoints, each with its iteration.
    pub checkpoints: Mailbox<(Bytes, u32)>,
    /// Previews, each with their iteration.
    pub previews: Mailbox<(u32, Vec<Picture>)>,
    pub metrics: Arc<GpuMetrics>,
    pub executor: Arc<dyn Executor>,
    /// The last reported iteration.
    pub reported: AtomicU32,
    /// Whether this attempt was abandoned. The pulse soon serves the next task, and reports of this attempt
    /// must not be attributed to that one.
    pub gone: watch::Sender<bool>,
    /// Whether the worker must leave.
    pub stopping: watch::Receiver<bool>,
}

impl TaskControl {
    fn is_gone(&self) -> bool {
        *self.gone.borrow()
    }
}

impl Control for TaskControl {
    fn report(&self, progress: Progress) {
        if !self.is_gone() {
            let before = self.reported.swap(progress.iteration, Ordering::Relaxed);
            self.metrics.trained(before, &progress);
            let memory_bytes = self.executor.memory().map_or(0, |memory| memory.allocated_bytes);
            self.pulse.report(Progress { memory_bytes, ..progress });
        }
    }

    fn checkpoint(&self, bytes: Bytes, iteration: u32) {
        self.checkpoints.put((bytes, iteration));
    }

    fn preview(&self, iteration: u32, pictures: Vec<Picture>) {
        self.previews.put((iteration, pictures));
    }

    fn stop_reason(&self) -> Option<Stop> {
        if self.is_gone() { Some(Stop::Abandon) } else { self.pulse.stop_reason() }
    }

    fn upload(&self, bytes: Bytes) -> Result<BlobRef, TaskError> {
        self.runtime.block_on(self.uploading(bytes))
    }

    fn uploading(&self, bytes: Bytes) -> BoxFuture<'_, Result<BlobRef, TaskError>> {
        let (mut gone, source) = (self.gone.subscribe(), BlobSource::Bytes(bytes));
        let mut stopping = self.stopping.clone();
        Box::pin(async move {
            tokio::select! {
                // Abandoned work uploads nothing, not even small files.
                biased;
                _ = gone.wait_for(|gone| *gone) => Err(TaskError::Stopped { checkpoint: None }),
                uploaded = self.blobs.upload(&source) => uploaded.map_err(TaskError::environment),
                () = leave_deadline(&mut stopping, SUBMIT_WITHIN) => {
                    let reason = self.blobs.trouble().latest();
                    let reason = reason.as_deref().unwrap_or("it does not answer");
                    tracing::warn!(reason, "leaving without an answer from the coordinator: a part of the \
                        result was not submitted");
                    Err(TaskError::Stopped { checkpoint: None })
                }
            }
        })
    }
}
