//! Renews leases from a thread and a runtime that nothing else uses.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fathom_observe::threads;
use fathom_proto::dial::{Connection, Dial, reason};
use fathom_proto::v1::{Preview, Progress};
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use crate::WorkerError;
use crate::retry::is_sent_away;

/// Pause between renewals until the coordinator sets one.
const FIRST_PERIOD: Duration = Duration::from_millis(250);
/// Time limit of one renewal; then the next is tried.
const CALL_WITHIN: Duration = Duration::from_secs(10);
/// Points of curves that wait for the next renewal at most. With the previews, the coordinator reads 64.
const MOST_MEASURED: usize = 60;
/// Batches of previews that wait for it at most.
const MOST_BATCHES: usize = 4;

/// The reason why work stops early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The lease has expired: discard the work.
    Abandon,
    /// The worker leaves: checkpoint and return the task.
    Leave,
    /// The coordinator reclaims the task because its job is paused or this worker is drained: the same, but
    /// the worker stays.
    GiveBack,
}

/// Data that the heartbeat sends, and the answers that it received.
#[derive(Default)]
struct PulseState {
    lease: Option<v1::Lease>,
    /// When the lease began.
    since: Option<Instant>,
    /// Time until the input was there.
    fetching: Duration,
    progress: Option<Progress>,
    /// Points of the curves that have not been sent, each with its time.
    measured: Vec<(Instant, Progress)>,
    /// Batches of previews that have not been sent, each with the time of its upload.
    previews: Vec<(Instant, Vec<Preview>)>,
    stop: Option<Stop>,
    renew_every: Option<Duration>,
}

/// State shared between the session, the training thread and the heartbeat.
#[derive(Default)]
pub struct Pulse {
    state: Mutex<PulseState>,
    /// Notified when the work must stop.
    stopped: Notify,
    /// Notified when there is a lease or something to show: the next renewal is due at once.
    begun: Notify,
}

impl Pulse {
    fn lock(&self) -> MutexGuard<'_, PulseState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts to renew `lease`.
    pub fn begin(&self, lease: v1::Lease) {
        let mut state = self.lock();
        *state = PulseState {
            lease: Some(lease),
            since: Some(Instant::now()),
            renew_every: state.renew_every,
            ..PulseState::default()
        };
        drop(state);
        self.begun.notify_one();
    }

    /// Stops renewing.
    pub fn end(&self) {
        let mut state = self.lock();
        (state.lease, state.progress, state.stop) = (None, None, None);
        state.measured.clear();
        state.previews.clear();
    }

    /// The input of the task is there.
    pub fn has_input(&self) {
        let mut state = self.lock();
        state.fetching = state.since.map_or(Duration::ZERO, |since| since.elapsed());
    }

    /// The result was stored after this time: the last point of the curves says so.
    pub fn has_sent(&self, sending: Duration) {
        let Some(mut progress) = self.lock().progress else { return };
        if let Some(spent) = &mut progress.time_spent {
            spent.sending_seconds = sending.as_secs_f32();
            self.report(progress);
        }
    }

    /// Progress for the next renewal.
    pub fn report(&self, mut progress: Progress) {
        let mut state = self.lock();
        if let Some(spent) = &mut progress.time_spent {
            spent.seconds = state.since.map_or(0.0, |since| since.elapsed().as_secs_f32());
            spent.fetching_seconds = state.fetching.as_secs_f32();
        }
        state.progress = Some(progress);
        if state.measured.len() >= MOST_MEASURED {
            // Every other one: the coordinator does not answer, or training is much faster than renewals.
            let mut place = 0;
            state.measured.retain(|_| {
                place += 1;
                place % 2 == 1
            });
        }
        state.measured.push((Instant::now(), progress));
    }

    /// Uploaded previews. They are rare, so they do not wait for the next renewal: one is sent at once.
    pub fn show(&self, previews: Vec<Preview>) {
        let mut state = self.lock();
        if !previews.is_empty() && state.previews.len() < MOST_BATCHES {
            state.previews.push((Instant::now(), previews));
            drop(state);
            self.begun.notify_one();
        }
    }

    /// The points of the curves and the previews since the last call. Those of a message that is lost are
    /// lost too: they only show how the training went.
    pub fn take_measured(&self) -> Vec<v1::Measured> {
        let mut state = self.lock();
        let points = std::mem::take(&mut state.measured);
        let previews = std::mem::take(&mut state.previews);
        drop(state);
        let points = points.into_iter().map(|(at, progress)| (at, Some(progress), Vec::new()));
        // The point of a preview was sent when it was measured.
        let previews = previews.into_iter().map(|(at, previews)| (at, None, previews));
        let sent = points.chain(previews).map(|(at, progress, previews)| v1::Measured {
            progress,
            age_ms: u32::try_from(at.elapsed().as_millis()).unwrap_or(u32::MAX),
            previews,
        });
        sent.collect()
    }

    /// The reason for the current work to stop, if any.
    pub fn stop_reason(&self) -> Option<Stop> {
        self.lock().stop
    }

    /// Asks the current work to stop; the first reason stays.
    pub fn stop(&self, reason: Stop) {
        let mut state = self.lock();
        if state.lease.is_some() {
            state.stop.get_or_insert(reason);
        }
        drop(state);
        self.stopped.notify_waiters();
    }

    /// Discards the current work, whatever the earlier reason: its result is not accepted.
    pub fn give_up(&self) {
        let mut state = self.lock();
        if state.lease.is_some() {
            state.stop = Some(Stop::Abandon);
        }
        drop(state);
        self.stopped.notify_waiters();
    }

    /// Waits until the current work must stop for `reason`.
    pub async fn stopped_for(&self, reason: Stop) {
        loop {
            let notified = self.stopped.notified();
            tokio::pin!(notified);
            notified.as_mut().enable();
            if self.stop_reason() == Some(reason) {
                return;
            }
            notified.await;
        }
    }

    /// The period set by the coordinator.
    pub fn set_period(&self, renew_every_ms: u32) {
        self.lock().renew_every = Some(Duration::from_millis(renew_every_ms.max(10).into()));
    }

    fn period(&self) -> Duration {
        self.lock().renew_every.unwrap_or(FIRST_PERIOD)
    }

    fn held(&self) -> Option<(v1::Lease, Option<Progress>)> {
        let state = self.lock();
        Some((state.lease.clone()?, state.progress))
    }

    /// Acts on the coordinator's answers about leases.
    fn apply(&self, outcomes: Vec<v1::RenewOutcome>) {
        for outcome in outcomes {
            let Some(lease) = &outcome.lease else { continue };
            match outcome.verdict() {
                v1::RenewVerdict::Abandon => {
                    tracing::warn!(reason = %outcome.reason, "the coordinator asked to abandon the task");
                    self.stop_under(lease, Stop::Abandon);
                }
                v1::RenewVerdict::Release => {
                    tracing::info!(reason = %outcome.reason, "the coordinator asked to return the task");
                    self.stop_under(lease, Stop::GiveBack);
                }
                v1::RenewVerdict::Continue | v1::RenewVerdict::Unspecified => {}
            }
        }
    }

    /// Asks the current work to stop if it runs under `lease`. An expired lease overrides any earlier reason.
    fn stop_under(&self, lease: &v1::Lease, reason: Stop) {
        let mut state = self.lock();
        if state.lease.as_ref() == Some(lease) {
            if reason == Stop::Abandon && state.stop == Some(Stop::GiveBack) {
                state.stop = Some(reason);
            }
            state.stop.get_or_insert(reason);
        }
        drop(state);
        self.stopped.notify_waiters();
    }
}

/// The thread (in a simulation, a task); it ends when this is dropped.
pub struct Heartbeat {
    _alive: watch::Sender<()>,
}

impl Heartbeat {
    /// Starts it.
    pub fn start(
        coordinator: Dial,
        registration: v1::RegisterRequest,
        pulse: Arc<Pulse>,
    ) -> Result<Self, WorkerError> {
        let (alive, ended) = watch::channel(());
        if threads::are_simulated() {
            tokio::spawn(async move { beat(&coordinator, registration, &pulse, ended).await });
            return Ok(Self { _alive: alive });
        }
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|e| WorkerError::Thread(e.to_string()))?;
        std::thread::Builder::new()
            .name("heartbeat".into())
            .spawn(move || runtime.block_on(beat(&coordinator, registration, &pulse, ended)))
            .map_err(|e| WorkerError::Thread(e.to_string()))?;
        Ok(Self { _alive: alive })
    }
}

async fn beat(
    coordinator: &Dial,
    registration: v1::RegisterRequest,
    pulse: &Pulse,
    mut ended: watch::Receiver<()>,
) {
    let client = match coordinator.lazily() {
        Ok(connection) => WorkerServiceClient::new(connection),
        Err(error) => {
            tracing::error!(%error, "the heartbeat cannot start");
            return;
        }
    };
    let mut renewals =
        Renewals { client, registration, session: None, tries_session: true, has_sessions: true };
    let mut due = Instant::now() + pulse.period();
    loop {
        tokio::select! {
            biased;
            // The only message is that the other end was dropped.
            _ = ended.changed() => return,
            // At once: the coordinator can report the end of a lease on the session only after it has
            // received it there.
            () = pulse.begun.notified() => {}
            heard = renewals.receive() => {
                match heard {
                    Ok(outcomes) => pulse.apply(outcomes),
                    // The next beat, which comes soon, asks again and decides.
                    Err(status) => {
                        tracing::debug!(error = %status.message(), "the session ended");
                        due = due.min(Instant::now() + FIRST_PERIOD);
                    }
                }
                continue;
            }
            () = tokio::time::sleep_until(due) => {}
        }
        if let Some((lease, progress)) = pulse.held() {
            tokio::select! {
                biased;
                answered = tokio::time::timeout(CALL_WITHIN, renewals.renew(pulse, lease, progress)) => match answered {
                    Ok(Ok(())) => {}
                    Ok(Err(status)) if is_sent_away(&status) => {
                        tracing::error!(reason = %status.message(), "the coordinator rejected this worker; \
                            its work ends");
                        pulse.stop(Stop::Abandon);
                    }
                    // Training continues; the next beat tries again.
                    Ok(Err(status)) => tracing::debug!(error = %status.message(), "renewal not answered"),
                    Err(_) => tracing::debug!("renewal took too long"),
                },
                _ = ended.changed() => return,
            }
        }
        due = Instant::now() + pulse.period();
    }
}

/// Renews over a session, which delivers a stop request at once, or over single calls if there is none.
struct Renewals {
    client: WorkerServiceClient<Connection>,
    registration: v1::RegisterRequest,
    session: Option<Session>,
    /// Whether a session may be opened: after one ended, only once a single call was answered.
    tries_session: bool,
    /// Whether the coordinator supports sessions, as far as known.
    has_sessions: bool,
}

/// A stream of renewals and lease outcomes.
struct Session {
    renewals: mpsc::Sender<v1::SessionRequest>,
    answers: Streaming<v1::SessionResponse>,
    /// Whether the last renewal is unanswered.
    waits: bool,
}

impl Renewals {
    /// The coordinator's messages on the session; pending for ever without one.
    async fn receive(&mut self) -> Result<Vec<v1::RenewOutcome>, Status> {
        let Some(session) = &mut self.session else { return std::future::pending().await };
        let heard = session.answers.message().await.and_then(|answer| {
            let renewed = answer.ok_or_else(|| Status::unavailable("the coordinator ended it"))?.renewed;
            Ok(renewed.unwrap_or_default().outcomes)
        });
        session.waits = false;
        if heard.is_err() {
            self.close();
        }
        heard
    }

    /// Closes the session; single calls then report why it ended and what to do.
    fn close(&mut self) {
        self.session = None;
        self.tries_session = false;
    }

    async fn renew(
        &mut self,
        pulse: &Pulse,
        lease: v1::Lease,
        progress: Option<Progress>,
    ) -> Result<(), Status> {
        let request = v1::RenewRequest {
            incarnation: self.registration.incarnation.clone(),
            renewals: vec![v1::Renewal {
                lease: Some(lease.clone()),
                progress,
                measured: pulse.take_measured(),
            }],
        };
        if self.session.is_none() && self.tries_session && self.has_sessions {
            self.open(pulse.period()).await;
        }
        if let Some(session) = &mut self.session {
            let message = v1::SessionRequest { renewal: Some(request.clone()) };
            if !session.waits && session.renewals.try_send(message).is_ok() {
                session.waits = true;
                return Ok(());
            }
            tracing::debug!("the session is silent");
            self.close();
        }
        match self.client.renew(request).await {
            Ok(answer) => {
                self.tries_session = true;
                pulse.apply(answer.into_inner().outcomes);
                Ok(())
            }
            // The coordinator was restarted: register again with our current lease.
            Err(status) if reason(&status).as_deref() == Some("UNKNOWN_WORKER") => {
                let request = v1::RegisterRequest { held: vec![lease.clone()], ..self.registration.clone() };
                let answer = self.client.register(request).await?.into_inner();
                self.tries_session = true;
                pulse.set_period(answer.renew_every_ms);
                if answer.abandon.contains(&lease) {
                    tracing::warn!("the coordinator restarted and gave the task to another worker");
                    pulse.stop_under(&lease, Stop::Abandon);
                }
                Ok(())
            }
            Err(status) => Err(status),
        }
    }

    async fn open(&mut self, within: Duration) {
        let (renewals, receiver) = mpsc::channel(1);
        self.tries_session = false;
        // A proxy may delay a stream; the single call is then still sent in time.
        let opening = self.client.session(ReceiverStream::new(receiver));
        match tokio::time::timeout(within.min(CALL_WITHIN / 2), opening).await {
            Ok(Ok(answers)) => {
                self.session = Some(Session { renewals, answers: answers.into_inner(), waits: false });
            }
            Ok(Err(status)) => {
                tracing::debug!(error = %status.message(), "no session");
                self.has_sessions &= status.code() != Code::Unimplemented;
            }
            Err(_) => tracing::debug!("a session took too long to open"),
        }
    }
}
