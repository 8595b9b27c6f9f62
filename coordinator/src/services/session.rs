//! The stream on which a worker renews its leases and learns at once when work must stop.

use std::pin::pin;

use fathom_proto::worker::v1;
use futures::stream::BoxStream;
use futures::{Stream, StreamExt};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use super::encode;
use super::workers::{Workers, verdict};
use crate::access::{Principal, Refused};
use crate::service_error::ServiceError;
use crate::state::stopped;

/// Answers queued for a slow worker; beyond it only this worker's stream waits.
const QUEUE: usize = 4;

/// The outcomes of the leases in a worker's renewals, until it ends the stream.
pub fn answers(
    workers: Workers,
    caller: Principal,
    renewals: impl Stream<Item = Result<v1::SessionRequest, Status>> + Send + 'static,
) -> BoxStream<'static, Result<v1::SessionResponse, Status>> {
    let (sender, receiver) = mpsc::channel(QUEUE);
    tokio::spawn(async move {
        let mut session = Session { workers, caller, incarnation: String::new(), sent: Vec::new(), sender };
        if let Err(error) = session.run(renewals).await {
            // A worker that has left does not need the error.
            let _ = session.sender.send(Err(error.into())).await;
        }
    });
    ReceiverStream::new(receiver).boxed()
}

struct Session {
    workers: Workers,
    caller: Principal,
    /// As in the last renewal.
    incarnation: String,
    /// The outcome last sent for each lease of the last renewal.
    sent: Vec<v1::RenewOutcome>,
    sender: mpsc::Sender<Result<v1::SessionResponse, Status>>,
}

impl Session {
    async fn run(
        &mut self,
        renewals: impl Stream<Item = Result<v1::SessionRequest, Status>>,
    ) -> Result<(), ServiceError> {
        let mut renewals = pin!(renewals);
        let mut interrupts = self.workers.0.wakeups.interrupts.subscribe();
        let mut stopping = self.workers.0.stopping.clone();
        loop {
            let news = tokio::select! {
                biased;
                message = renewals.next() => match message {
                    Some(Ok(message)) => Some(self.renew(message).await?),
                    // Its end, or a lost connection: leases do not depend on it.
                    Some(Err(_)) | None => return Ok(()),
                },
                _ = interrupts.changed() => self.look().await?,
                () = self.sender.closed() => return Ok(()),
                () = stopped(&mut stopping) => return Ok(()),
            };
            if let Some(news) = news
                && self.sender.send(Ok(v1::SessionResponse { renewed: Some(news) })).await.is_err()
            {
                return Ok(());
            }
        }
    }

    async fn renew(&mut self, message: v1::SessionRequest) -> Result<v1::RenewResponse, ServiceError> {
        let shared = &self.workers.0;
        if !shared.access.still_holds(&self.caller, shared.clock.now_ms()) {
            return Err(Refused::NotValid.into());
        }
        let renewal = message.renewal.ok_or_else(|| ServiceError::BadArgument {
            field: "renewal",
            message: "must be set in every message of a session".into(),
        })?;
        self.incarnation.clone_from(&renewal.incarnation);
        let answer = self.workers.renew(&self.caller, renewal).await?;
        self.sent.clone_from(&answer.outcomes);
        Ok(answer)
    }

    /// Outcomes that have changed since they were sent.
    async fn look(&mut self) -> Result<Option<v1::RenewResponse>, ServiceError> {
        let shared = &self.workers.0;
        let drains = shared.workers.drains(&self.incarnation);
        let mut outcomes = Vec::new();
        for sent in &mut self.sent {
            let lease = encode::required_lease(sent.lease.clone())?;
            let (verdict, reason) = verdict(shared.jobs.standing(&lease).await?, drains);
            if verdict != sent.verdict() && !self.workers.ended_it(&lease).await {
                sent.set_verdict(verdict);
                reason.clone_into(&mut sent.reason);
                outcomes.push(sent.clone());
            }
        }
        Ok((!outcomes.is_empty()).then_some(v1::RenewResponse { outcomes }))
    }
}
