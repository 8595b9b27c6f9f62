//! Says that this worker lives, from a thread and a runtime that nothing else uses.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fathom_observe::threads;
use fathom_proto::dial::{Dial, Line, reason};
use fathom_proto::v1::Progress;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use tokio::sync::{Notify, watch};

use crate::WorkerError;

/// Pause between renewals when the coordinator has not said one yet.
const FIRST_PERIOD: Duration = Duration::from_millis(250);
/// One renewal may take so long; then the next is tried.
const CALL_WITHIN: Duration = Duration::from_secs(10);

/// Why work stops before its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The lease is over: throw the work away.
    Abandon,
    /// The worker leaves: checkpoint, and give the task back.
    Leave,
    /// The coordinator wants the task back, since its job is paused or this worker is drained: the same, but the worker stays.
    GiveBack,
}

/// What the heartbeat says, and what it was told.
#[derive(Default)]
struct Beating {
    lease: Option<v1::Lease>,
    progress: Option<Progress>,
    stop: Option<Stop>,
    renew_every: Option<Duration>,
}

/// Shared between the session, the training thread and the heartbeat.
#[derive(Default)]
pub struct Pulse {
    state: Mutex<Beating>,
    /// Woken when the work is to stop.
    stopped: Notify,
}

impl Pulse {
    fn lock(&self) -> MutexGuard<'_, Beating> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins to renew `lease`.
    pub fn begin(&self, lease: v1::Lease) {
        let mut state = self.lock();
        (state.lease, state.progress, state.stop) = (Some(lease), None, None);
    }

    /// Stops renewing.
    pub fn end(&self) {
        let mut state = self.lock();
        (state.lease, state.progress, state.stop) = (None, None, None);
    }

    /// What the next renewal reports.
    pub fn report(&self, progress: Progress) {
        self.lock().progress = Some(progress);
    }

    /// Why the work at hand is to stop, if it is.
    pub fn stop_reason(&self) -> Option<Stop> {
        self.lock().stop
    }

    /// Tells the work at hand to stop; what was said first holds.
    pub fn stop(&self, reason: Stop) {
        let mut state = self.lock();
        if state.lease.is_some() {
            state.stop.get_or_insert(reason);
        }
        drop(state);
        self.stopped.notify_waiters();
    }

    /// Waits until the work at hand is to stop for `reason`.
    pub async fn told_to(&self, reason: Stop) {
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

    /// The period that the coordinator asked for.
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

    /// Tells the work at hand to stop if it is under `lease`. That a lease is over holds whatever was said before.
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

/// The thread, in a simulation a task; it ends when this is dropped.
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
    let mut client = match coordinator.lazily() {
        Ok(line) => WorkerServiceClient::new(line),
        Err(error) => {
            tracing::error!(%error, "no heartbeat");
            return;
        }
    };
    loop {
        let period = pulse.period();
        tokio::select! {
            biased;
            // The only message is that the other end is gone.
            _ = ended.changed() => return,
            () = tokio::time::sleep(period) => {}
        }
        let Some((lease, progress)) = pulse.held() else { continue };
        let call = renew(&mut client, &registration, pulse, lease, progress);
        tokio::select! {
            biased;
            answered = tokio::time::timeout(CALL_WITHIN, call) => match answered {
                Ok(Ok(())) => {}
                // Training goes on; the next beat tries again.
                Ok(Err(status)) => tracing::debug!(error = %status.message(), "renewal not answered"),
                Err(_) => tracing::debug!("renewal took too long"),
            },
            _ = ended.changed() => return,
        }
    }
}

async fn renew(
    client: &mut WorkerServiceClient<Line>,
    registration: &v1::RegisterRequest,
    pulse: &Pulse,
    lease: v1::Lease,
    progress: Option<Progress>,
) -> Result<(), tonic::Status> {
    let request = v1::RenewRequest {
        incarnation: registration.incarnation.clone(),
        renewals: vec![v1::Renewal { lease: Some(lease.clone()), progress }],
    };
    match client.renew(request).await {
        Ok(answer) => {
            for outcome in answer.into_inner().outcomes {
                match outcome.verdict() {
                    v1::RenewVerdict::Abandon => {
                        tracing::warn!(reason = %outcome.reason, "told to abandon the task");
                        pulse.stop_under(&lease, Stop::Abandon);
                    }
                    v1::RenewVerdict::Release => {
                        tracing::info!(reason = %outcome.reason, "told to give the task back");
                        pulse.stop_under(&lease, Stop::GiveBack);
                    }
                    v1::RenewVerdict::Continue | v1::RenewVerdict::Unspecified => {}
                }
            }
            Ok(())
        }
        // The coordinator was restarted: it learns of us and of what we hold.
        Err(status) if reason(&status).as_deref() == Some("UNKNOWN_WORKER") => {
            let request = v1::RegisterRequest { held: vec![lease.clone()], ..registration.clone() };
            let answer = client.register(request).await?.into_inner();
            pulse.set_period(answer.renew_every_ms);
            if answer.abandon.contains(&lease) {
                tracing::warn!("the coordinator came back and gave the task to another worker");
                pulse.stop_under(&lease, Stop::Abandon);
            }
            Ok(())
        }
        Err(status) => Err(status),
    }
}
