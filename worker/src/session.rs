//! The main loop of a worker: register, claim, fetch, execute, submit, repeat.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::time::Duration;

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::{attempt_span, capture, threads};
use fathom_proto::dial::{Connection, Dial, reason};
use fathom_proto::v1::Preview;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use fathom_proto::{WORKER_PROTOCOL_VERSION, stage_name};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::time::Instant;
use tonic::Status;
use tracing::Instrument;
use uuid::Uuid;

use crate::blobs::{BlobClient, BlobSource, to_proto};
use crate::cache::{BlobCache, KEEP_EVERY};
use crate::execute::{Executor, Picture, Stop, TaskError, TaskOutput};
use crate::fetch::Fetch;
use crate::heartbeat::{Heartbeat, Pulse};
use crate::leaving::{SUBMIT_WITHIN, leave_deadline, stop_requested};
use crate::logs::Shipper;
use crate::metrics::{Ended, GpuMetrics};
use crate::retry::{Repeated, is_over, pauses, until_answered, will_pass};
use crate::training_thread::{Mailbox, StopOnDrop, TaskControl, spawn_training};
use crate::{WorkerConfig, WorkerError};

/// Time that a claim may wait in the coordinator.
const CLAIM_WAIT_MS: u32 = 10_000;
/// A claim without an answer this long after its wait is retried.
const CLAIM_GRACE: Duration = Duration::from_secs(10);
/// Time limit for a leaving worker to submit its checkpoint and return its task.
const LEAVE_WITHIN: Duration = Duration::from_secs(20);
/// Time limit for a leaving worker to ask for the answer to a pending claim.
const ANSWERED_WITHIN: Duration = Duration::from_secs(5);
/// Reason that a leaving worker reports when it returns a task.
const ASKED_TO_LEAVE: &str = "the worker was asked to leave";
/// The same of one that was idle for too long.
const IDLE: &str = "the worker was idle for too long, and leaves";
/// Log a warning at this interval while a training thread ignores a stop request.
const WARN_EVERY: Duration = Duration::from_secs(5);

/// One GPU of a worker; a separate worker to the coordinator.
pub struct Session {
    coordinator: Dial,
    client: WorkerServiceClient<Connection>,
    blobs: BlobClient,
    cache: BlobCache,
    executor: Arc<dyn Executor>,
    registration: v1::RegisterRequest,
    pulse: Arc<Pulse>,
    /// The session ends after this long without a task, or after so many of them.
    exit_when_idle: Option<Duration>,
    max_tasks: Option<NonZeroU32>,
    /// Held by the training thread from start to end, so there is never a second one.
    seat: Arc<tokio::sync::Mutex<()>>,
    stopping: watch::Receiver<bool>,
    logs: Shipper,
    metrics: Arc<GpuMetrics>,
    /// Renews until the session is dropped.
    _heartbeat: Heartbeat,
}

/// Additional results of a task, as a message.
fn named((artifact, blob): &(v1::Artifact, BlobRef)) -> v1::NamedBlob {
    v1::NamedBlob { artifact: (*artifact).into(), blob: Some(to_proto(blob)) }
}

impl Session {
    /// Starts the heartbeat; sends nothing yet.
    pub fn open(
        config: WorkerConfig,
        executor: Arc<dyn Executor>,
        cache: BlobCache,
        metrics: Arc<GpuMetrics>,
        stopping: watch::Receiver<bool>,
    ) -> Result<Self, WorkerError> {
        let connection = config.coordinator.lazily()?;
        let registration = v1::RegisterRequest {
            worker_name: config.name,
            incarnation: Uuid::new_v4().to_string(),
            build_version: env!("CARGO_PKG_VERSION").to_owned(),
            protocol_version: WORKER_PROTOCOL_VERSION,
            capabilities: Some(executor.capabilities()),
            held: Vec::new(),
        };
        let pulse = Arc::new(Pulse::default());
        let coordinator = config.coordinator;
        let heartbeat = Heartbeat::start(coordinator.clone(), registration.clone(), Arc::clone(&pulse))?;
        let client = WorkerServiceClient::new(connection.clone());
        Ok(Self {
            coordinator,
            logs: Shipper::start(client.clone()),
            metrics,
            client,
            blobs: BlobClient::new(connection),
            cache,
            executor,
            registration,
            pulse,
            exit_when_idle: config.exit_when_idle.map(|limit| limit.0),
            max_tasks: config.max_tasks,
            seat: Arc::default(),
            stopping,
            _heartbeat: heartbeat,
        })
    }

    /// Works until asked to stop, until it was idle for too long, or until it has done all its tasks.
    pub async fn run(self) -> Result<(), WorkerError> {
        let mut stopping = self.stopping.clone();
        let (mut tasks, mut idle_since) = (0, Instant::now());
        if self.unless_idle(&mut stopping, idle_since, self.register_first()).await.transpose()?.is_none() {
            return Ok(());
        }
        // A worker asked to stop during a task claims no further one: it would only have to return it.
        while !*stopping.borrow() {
            if self.max_tasks.is_some_and(|most| tasks >= most.get()) {
                tracing::info!(tasks, "leaving: as many tasks as this worker was to take");
                break;
            }
            if self.unless_idle(&mut stopping, idle_since, self.prepared()).await.transpose()?.is_none() {
                break;
            }
            let request_id = Uuid::new_v4().to_string();
            let claim = self.claim(&request_id, self.idle_time_left(idle_since));
            let Some(claimed) = self.unless_idle(&mut stopping, idle_since, claim).await else {
                let why = if *stopping.borrow() { ASKED_TO_LEAVE } else { IDLE };
                self.give_back_unheard(request_id, why).await;
                break;
            };
            let Some(assignment) = claimed? else { continue };
            let Some(lease) = assignment.lease.clone() else {
                return Err(WorkerError::Protocol("an assignment without a lease".into()));
            };
            let name = &self.registration.worker_name;
            let span = attempt_span(&lease.job_id, &lease.task_id, lease.attempt, name);
            capture::attach(&span, self.logs.sink(lease.clone()));
            self.work(lease, assignment).instrument(span).await?;
            (tasks, idle_since) = (tasks + 1, Instant::now());
        }
        self.logs.finish().await;
        Ok(())
    }

    /// Time until this worker has been idle for too long.
    fn idle_time_left(&self, idle_since: Instant) -> Duration {
        self.exit_when_idle.map_or(Duration::MAX, |limit| limit.saturating_sub(idle_since.elapsed()))
    }

    /// The result of `work`, or `None` once the worker must leave or has been idle for too long. It may
    /// finish what it waits for a little later: the answer to a claim comes at the end of the idle time.
    async fn unless_idle<T>(
        &self,
        stopping: &mut watch::Receiver<bool>,
        idle_since: Instant,
        work: impl Future<Output = T>,
    ) -> Option<T> {
        let left = self.idle_time_left(idle_since);
        if !left.is_zero() {
            let limit = left.saturating_add(CLAIM_GRACE);
            match self.until_stopped(stopping, tokio::time::timeout(limit, work)).await {
                Some(Ok(result)) => return Some(result),
                None => return None,
                Some(Err(_)) => {}
            }
        }
        let seconds = self.exit_when_idle.unwrap_or_default().as_secs();
        let reason = self.blobs.trouble().latest();
        tracing::info!(seconds, trouble = reason.as_deref(), "leaving: there was no task for this long");
        None
    }

    /// The result of `work`, or `None` once the worker must leave.
    async fn until_stopped<T>(
        &self,
        stopping: &mut watch::Receiver<bool>,
        work: impl Future<Output = T>,
    ) -> Option<T> {
        tokio::select! {
            biased;
            result = work => Some(result),
            () = stop_requested(stopping) => None,
        }
    }

    async fn register(&self) -> Result<(), WorkerError> {
        let answer = until_answered("Register", self.blobs.trouble(), || {
            let (mut client, request) = (self.client.clone(), self.registration.clone());
            async move { client.register(request).await }
        })
        .await?
        .into_inner();
        self.note_registered(&answer);
        Ok(())
    }

    fn note_registered(&self, answer: &v1::RegisterResponse) {
        self.pulse.set_period(answer.renew_every_ms);
        self.metrics.registered();
        tracing::info!(worker = %self.registration.worker_name, lease_ms = answer.lease_ms, "registered");
    }

    /// The first registration. If another service answers at the address, or the server refuses our
    /// certificate, a retry does not help. A worker that has just started then exits with an error; a worker
    /// with a task would wait.
    async fn register_first(&self) -> Result<(), WorkerError> {
        match self.client.clone().register(self.registration.clone()).await {
            Ok(answer) => {
                self.note_registered(answer.get_ref());
                return Ok(());
            }
            Err(status) => {
                if let Some(error) = self.coordinator.misdialled(&status).await {
                    return Err(error.into());
                }
            }
        }
        self.register().await
    }

    /// Waits until this worker can execute a task: without a device it would claim task after task and fail
    /// each.
    async fn prepared(&self) -> Result<(), WorkerError> {
        let mut pauses = pauses();
        loop {
            let executor = Arc::clone(&self.executor);
            let prepared = threads::blocking(move || executor.prepare())
                .await
                .map_err(|e| WorkerError::Thread(e.to_string()))?;
            let Err(error) = prepared else { return Ok(()) };
            tracing::warn!(%error, "no task is claimed until this is resolved");
            tokio::time::sleep(pauses.next().unwrap_or_default()).await;
        }
    }

    /// Claims a task once, and waits for one at most `within`. After a lost answer it repeats the claim with
    /// the same id, so no lease is lost.
    async fn claim(&self, request_id: &str, within: Duration) -> Result<Option<v1::Assignment>, WorkerError> {
        let wait_ms = u32::try_from(within.as_millis()).map_or(CLAIM_WAIT_MS, |left| left.min(CLAIM_WAIT_MS));
        let request = v1::ClaimRequest {
            incarnation: self.registration.incarnation.clone(),
            request_id: request_id.to_owned(),
            wait_ms,
        };
        let limit = Duration::from_millis(CLAIM_WAIT_MS.into()) + CLAIM_GRACE;
        loop {
            let answer = until_answered("Claim", self.blobs.trouble(), || {
                let (mut client, request) = (self.client.clone(), request.clone());
                async move {
                    let call = tokio::time::timeout(limit, client.claim(request)).await;
                    call.unwrap_or_else(|_| Err(Status::deadline_exceeded("no answer to a claim")))
                }
            })
            .await;
            match answer {
                Ok(answer) => return Ok(answer.into_inner().assignment),
                Err(status) if reason(&status).as_deref() == Some("UNKNOWN_WORKER") => {
                    self.register().await?
                }
                Err(status) => return Err(status.into()),
            }
        }
    }

    /// Returns the task of a claim that was unanswered when the worker was to leave. Otherwise its
    /// lease would expire and count as a lost worker. Tries once, because an unreachable coordinator must not
    /// keep a worker from leaving.
    async fn give_back_unheard(&self, request_id: String, why: &str) {
        let incarnation = self.registration.incarnation.clone();
        let request = v1::ClaimRequest { incarnation, request_id, wait_ms: 0 };
        let mut client = self.client.clone();
        match tokio::time::timeout(ANSWERED_WITHIN, client.claim(request)).await {
            Ok(Ok(answer)) => {
                let Some(lease) = answer.into_inner().assignment.and_then(|given| given.lease) else {
                    return;
                };
                self.try_to_give_back(&lease, None, why).await;
            }
            Ok(Err(status)) => {
                tracing::debug!(reason = %status.message(), "the answer to the last claim is unknown");
            }
            Err(_) => tracing::warn!(
                "the coordinator did not answer; the lease of a task that it just \
                assigned will expire"
            ),
        }
    }

    /// Processes one task from its claim to its end. Only faults of this worker itself are errors.
    async fn work(&self, lease: v1::Lease, assignment: v1::Assignment) -> Result<(), WorkerError> {
        tracing::info!(stage = %stage_name(assignment.stage()), from = assignment.checkpoint_iteration, "task taken");
        self.pulse.begin(lease.clone());
        let started = Instant::now();
        let ended = tokio::select! {
            biased;
            ended = self.attempt(&lease, &assignment, started) => ended,
            // Pending transfers are no longer useful.
            () = self.pulse.stopped_for(Stop::Abandon) => Err(TaskError::Stopped { checkpoint: None }),
            () = self.keep_files() => unreachable!("it runs until it is dropped"),
        };
        let ended = match ended {
            Ok(()) => {
                tracing::info!(seconds = started.elapsed().as_secs_f64(), "task done");
                Ended::Done
            }
            Err(TaskError::Stopped { checkpoint }) => {
                let why = match self.pulse.stop_reason() {
                    Some(Stop::Leave) => Some(ASKED_TO_LEAVE),
                    Some(Stop::GiveBack) => Some("the coordinator asked for it"),
                    Some(Stop::Abandon) | None => None,
                };
                if let Some(why) = why {
                    self.try_to_give_back(&lease, checkpoint, why).await;
                    Ended::GivenBack
                } else {
                    tracing::info!("task abandoned");
                    Ended::Abandoned
                }
            }
            Err(TaskError::Failed { class, message }) => {
                tracing::error!(?class, reason = %message, "task failed");
                self.fail(&lease, class, message).await?;
                Ended::Failed
            }
        };
        self.metrics.ended(assignment.stage(), ended);
        self.pulse.end();
        let mut stopping = self.stopping.clone();
        // A leaving worker does not wait: the thread ends with the process.
        self.until_stopped(&mut stopping, self.training_ended()).await;
        self.cache.unpin_all()
    }

    /// Keeps marking the task's files as used for other workers, also during the fetch.
    async fn keep_files(&self) {
        let mut tick = tokio::time::interval(KEEP_EVERY);
        loop {
            tick.tick().await;
            self.cache.keep();
        }
    }

    /// Waits until no thread trains. Abandoned work is dropped at once, but its thread checks for a stop only
    /// between iterations. Until then it owns the GPU and the cached files.
    async fn training_ended(&self) {
        let since = Instant::now();
        while tokio::time::timeout(WARN_EVERY, self.seat.lock()).await.is_err() {
            let seconds = since.elapsed().as_secs();
            tracing::warn!(
                seconds,
                "abandoned training has not stopped yet; no task is claimed before it \
                stops"
            );
        }
    }

    async fn attempt(
        &self,
        lease: &v1::Lease,
        assignment: &v1::Assignment,
        started: Instant,
    ) -> Result<(), TaskError> {
        let mut stopping = self.stopping.clone();
        let fetch = Fetch { cache: &self.cache, blobs: self.blobs.of_job(&lease.job_id) };
        let fetched = async {
            tokio::select! {
                biased;
                input = fetch.everything(assignment) => input,
                // Fetched files stay in the cache, in case this machine gets the task again.
                () = self.pulse.stopped_for(Stop::GiveBack) => Err(TaskError::Stopped { checkpoint: None }),
            }
        };
        let input = match self.until_stopped(&mut stopping, fetched).await {
            Some(input) => input?,
            None => {
                self.pulse.stop(Stop::Leave);
                return Err(TaskError::Stopped { checkpoint: None });
            }
        };
        self.pulse.has_input();
        let iterations = input.common.own_iterations();
        let seat = Arc::clone(&self.seat).lock_owned().await;
        let control = Arc::new(TaskControl {
            pulse: Arc::clone(&self.pulse),
            blobs: self.blobs.of_job(&lease.job_id),
            runtime: Handle::current(),
            checkpoints: Mailbox::default(),
            previews: Mailbox::default(),
            metrics: Arc::clone(&self.metrics),
            executor: Arc::clone(&self.executor),
            reported: AtomicU32::new(assignment.checkpoint_iteration),
            gone: watch::Sender::new(false),
            stopping: self.stopping.clone(),
        });
        // If this future is dropped (the task is abandoned or the worker ends), the thread must stop.
        let _guard = StopOnDrop(Arc::clone(&control));
        let mut thread = spawn_training(Arc::clone(&self.executor), input, Arc::clone(&control), seat);
        let checkpoints = self.upload_checkpoints(lease, &control.checkpoints);
        let previews = self.upload_previews(lease, &control.previews);
        tokio::pin!(checkpoints, previews);
        let result = loop {
            tokio::select! {
                biased;
                result = &mut thread => break result,
                () = &mut checkpoints => unreachable!("the uploader has no end"),
                () = &mut previews => unreachable!("the uploader has no end"),
                () = stop_requested(&mut stopping), if self.pulse.stop_reason().is_none() => {
                    self.pulse.stop(Stop::Leave);
                }
            }
        };
        let output = result.unwrap_or_else(|_| {
            let message = "the training thread ended without a result; see the worker's log".to_owned();
            Err(TaskError::Failed { class: v1::FailClass::Training, message })
        })?;
        let submitted = tokio::select! {
            biased;
            submitted = self.complete(lease, output, started, iterations) => Some(submitted),
            () = leave_deadline(&mut stopping, SUBMIT_WITHIN) => None,
        };
        submitted.unwrap_or_else(|| {
            let reason = self.blobs.trouble().latest();
            let reason = reason.as_deref().unwrap_or("it does not answer");
            let seconds = SUBMIT_WITHIN.as_secs();
            tracing::warn!(
                reason,
                seconds,
                "leaving without an answer from the coordinator: the result of \
                the task was not submitted; its lease will expire"
            );
            self.pulse.give_up();
            Err(TaskError::Stopped { checkpoint: None })
        })
    }

    /// Uploads and reports checkpoints as they arrive; a newer one replaces a waiting one.
    async fn upload_checkpoints(&self, lease: &v1::Lease, mailbox: &Mailbox<(Bytes, u32)>) {
        loop {
            let (bytes, iteration) = mailbox.take().await;
            match self.report_checkpoint(lease, bytes, iteration).await {
                Ok(()) => tracing::info!(iteration, "checkpoint stored"),
                Err(WorkerError::Refused(status)) if is_over(&status) => self.pulse.stop(Stop::Abandon),
                Err(error) => tracing::warn!(%error, iteration, "a checkpoint was not accepted"),
            }
        }
    }

    /// Uploads previews as they arrive and puts them into the next renewal. Some may be lost: they only show
    /// how the training goes.
    async fn upload_previews(&self, lease: &v1::Lease, mailbox: &Mailbox<(u32, Vec<Picture>)>) {
        let blobs = self.blobs.of_job(&lease.job_id);
        loop {
            let (iteration, pictures) = mailbox.take().await;
            let mut uploaded = Vec::with_capacity(pictures.len());
            for Picture { view, render, clear, psnr_db } in pictures {
                let send = async |jpeg: Bytes| blobs.upload(&BlobSource::Bytes(jpeg)).await.ok();
                let Some(render) = send(render).await else { continue };
                let clear = match clear {
                    Some(clear) => send(clear).await,
                    None => None,
                };
                let (render, clear) = (Some(to_proto(&render)), clear.as_ref().map(to_proto));
                uploaded.push(Preview { view, iteration, render, clear, psnr_db });
            }
            self.pulse.show(uploaded);
        }
    }

    async fn report_checkpoint(
        &self,
        lease: &v1::Lease,
        bytes: Bytes,
        iteration: u32,
    ) -> Result<(), WorkerError> {
        let blob = self.blobs.of_job(&lease.job_id).upload(&BlobSource::Bytes(bytes)).await?;
        let request =
            v1::CheckpointRequest { lease: Some(lease.clone()), blob: Some(to_proto(&blob)), iteration };
        until_answered("Checkpoint", self.blobs.trouble(), || {
            let (mut client, request) = (self.client.clone(), request.clone());
            async move { client.checkpoint(request).await }
        })
        .await?;
        Ok(())
    }

    async fn complete(
        &self,
        lease: &v1::Lease,
        output: TaskOutput,
        started: Instant,
        iterations: u32,
    ) -> Result<(), TaskError> {
        let begin = Instant::now();
        let blob = self
            .blobs
            .of_job(&lease.job_id)
            .upload(&BlobSource::Bytes(output.result))
            .await
            .map_err(TaskError::environment)?;
        self.pulse.has_sent(begin.elapsed());
        let request = v1::CompleteRequest {
            lease: Some(lease.clone()),
            result: Some(to_proto(&blob)),
            stats: Some(v1::TaskStats {
                seconds: started.elapsed().as_secs_f64(),
                iterations,
                gaussians: output.gaussians,
                adapter: self.registration.capabilities.clone().unwrap_or_default().adapter,
                resumed_from_iteration: output.resumed_from,
                held_out: output.held_out,
                measured: self.pulse.take_measured(),
            }),
            further: output.further.iter().map(named).collect(),
        };
        let answer = until_answered("Complete", self.blobs.trouble(), || {
            let (mut client, request) = (self.client.clone(), request.clone());
            async move { client.complete(request).await }
        })
        .await;
        match answer {
            Ok(_) => Ok(()),
            Err(status) if is_over(&status) => {
                tracing::warn!(reason = %status.message(), "the result is no longer needed");
                self.pulse.stop(Stop::Abandon);
                Err(TaskError::Stopped { checkpoint: None })
            }
            Err(status) => Err(TaskError::environment(status.into())),
        }
    }

    async fn fail(
        &self,
        lease: &v1::Lease,
        class: v1::FailClass,
        message: String,
    ) -> Result<(), WorkerError> {
        let request = v1::FailRequest { lease: Some(lease.clone()), class: class.into(), message };
        let mut stopping = self.stopping.clone();
        let call = until_answered("Fail", self.blobs.trouble(), || {
            let (mut client, request) = (self.client.clone(), request.clone());
            async move { client.fail(request).await }
        });
        match self.until_stopped(&mut stopping, call).await {
            // A leaving worker does not wait: the lease will expire.
            Some(Ok(_)) | None => Ok(()),
            Some(Err(status)) if is_over(&status) => Ok(()),
            Some(Err(status)) => Err(status.into()),
        }
    }

    /// Submits the checkpoint and returns the task, if the coordinator answers.
    async fn try_to_give_back(&self, lease: &v1::Lease, checkpoint: Option<(Bytes, u32)>, why: &str) {
        let leaving = self.give_back(lease, checkpoint, why);
        if tokio::time::timeout(LEAVE_WITHIN, leaving).await.is_err() {
            let reason = self.blobs.trouble().latest();
            let reason = reason.as_deref().unwrap_or("it does not answer");
            tracing::warn!(
                reason,
                "leaving without an answer from the coordinator: the task was not returned; its lease will \
                 expire"
            );
        }
    }

    async fn give_back(&self, lease: &v1::Lease, checkpoint: Option<(Bytes, u32)>, why: &str) {
        if let Some((bytes, iteration)) = checkpoint
            && let Err(error) = self.report_checkpoint(lease, bytes, iteration).await
        {
            tracing::warn!(%error, "the last checkpoint was not accepted");
        }
        let request = v1::ReleaseRequest { lease: Some(lease.clone()), reason: why.to_owned() };
        let mut pauses = pauses();
        let mut repeated = Repeated::new("Release", self.blobs.trouble());
        loop {
            match self.client.clone().release(request.clone()).await {
                Ok(_) => return tracing::info!("task returned"),
                Err(status) if will_pass(&status) => {
                    repeated.again(&status);
                    tokio::time::sleep(pauses.next().unwrap_or_default()).await;
                }
                Err(status) => {
                    return tracing::warn!(reason = %status.message(), "the coordinator did not accept the \
                        returned task");
                }
            }
        }
    }
}
