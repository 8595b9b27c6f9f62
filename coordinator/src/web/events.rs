//! The events of a job as server-sent events (WHATWG HTML, 9.2).

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::IntoResponse;
use axum::response::sse::{Event, Sse};
use fathom_proto::v1;
use futures::{StreamExt, stream};
use serde::Deserialize;
use serde_json::json;

use super::Web;
use super::answer::Fault;
use super::read::{Asked, At, Caller};
use crate::json;

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct After {
    after: Option<u64>,
}

/// All events of a job after a number, until it has ended. A client that lost its connection goes on behind
/// the last event that it has seen: browsers send its number as `Last-Event-ID`.
pub async fn watch(
    State(web): State<Web>,
    At(job_id): At<String>,
    Asked(After { after }): Asked<After>,
    headers: HeaderMap,
    caller: Caller,
) -> Result<impl IntoResponse, Fault> {
    let last = match headers.get("last-event-id").filter(|last| !last.is_empty()) {
        None => None,
        Some(last) => {
            let number = last.to_str().ok().and_then(|last| last.parse::<u64>().ok());
            Some(number.ok_or_else(|| Fault::bad("Last-Event-ID is not a number of an event"))?)
        }
    };
    let after_seq = last.or(after).unwrap_or_default();
    let request = v1::WatchJobRequest { job_id: job_id.clone(), after_seq };
    let events = web.jobs().watch_job(caller.asks(request)).await?.into_inner();
    // The number of the last event that was sent; `None` once the stream has said that it cannot go on.
    let sent = Arc::new(Mutex::new(Some(after_seq)));
    let progress = Arc::clone(&sent);
    let events = events.map(move |event| {
        let mut sent = progress.lock().unwrap_or_else(PoisonError::into_inner);
        match event {
            Ok(event) => {
                *sent = sent.map(|_| event.seq);
                said(&event)
            }
            Err(status) => {
                *sent = None;
                of("fault", None, &Fault::of(status).json())
            }
        }
    });
    let end = stream::once(async move {
        let last = *sent.lock().unwrap_or_else(PoisonError::into_inner);
        last_word(&web, job_id, &caller, last).await
    });
    // A proxy that collects answers would hold events back.
    let at_once = [("x-accel-buffering", "no")];
    Ok((at_once, Sse::new(events.chain(end).map(Ok::<_, Infallible>))))
}

fn said(event: &v1::JobEvent) -> Event {
    use v1::job_event::Event::{KeepAlive, Progress};
    // Progress passes: it has the number of the event before it, and a client must not skip that one.
    let passes = matches!(event.event, Some(Progress(_) | KeepAlive(_)));
    match json::event(event) {
        Some(value) => {
            let kind = value["event"].as_str().unwrap_or_default().to_owned();
            of(&kind, (!passes).then_some(event.seq), &value)
        }
        None => Event::default().comment("still there"),
    }
}

fn of(kind: &str, number: Option<u64>, value: &serde_json::Value) -> Event {
    // JSON has no line breaks of its own, which is all that could fail here.
    let event = Event::default().event(kind).data(value.to_string());
    match number {
        Some(number) => event.id(number.to_string()),
        None => event,
    }
}

/// The stream also ends when the coordinator stops, or by a fault. `end` is sent only where the job has ended
/// and its last event was sent, so that a client knows whether to come back.
async fn last_word(web: &Web, job_id: String, caller: &Caller, sent: Option<u64>) -> Event {
    if let Some(sent) = sent
        && let Ok(job) = web.jobs().get_job(caller.asks(v1::GetJobRequest { job_id })).await
    {
        let job = job.into_inner();
        let is_open = matches!(job.state(), v1::JobState::Running | v1::JobState::Paused);
        if !is_open && sent >= job.last_seq {
            return of("end", None, &json!({"state": json::job_state(job.state())}));
        }
    }
    Event::default().comment("interrupted; connect again")
}
