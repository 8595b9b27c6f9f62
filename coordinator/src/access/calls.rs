//! Open calls: each ends when its token becomes invalid, and a download when its client has read nothing for
//! a minute.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use fathom_proto::CHUNK_BYTES;
use http::HeaderMap;
use http_body::{Frame, SizeHint};
use tokio::time::{Instant, Sleep};
use tonic::Status;
use tonic::body::Body;

use super::places::{Kind, Place};
use super::{Access, Principal, Refused};
use crate::clock::Clock;
use crate::connections::Visit;
use crate::service_error::ServiceError;

/// Interval of the checks for calls that must end.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// A call whose token becomes invalid ends by itself. If its client reads nothing it cannot: after this time
/// its connection is closed.
const END_WITHIN: Duration = Duration::from_millis(800);
/// Time in which the client of a download must read a piece; pieces wait in memory.
const TAKE_WITHIN: Duration = Duration::from_secs(60);
/// Time in which more of a request must arrive.
const SEND_WITHIN: Duration = Duration::from_secs(20);

/// Longest message of an upload: a piece, with margin for its names.
const MAX_PIECE_BYTES: usize = CHUNK_BYTES + 4096;

/// All open calls.
#[derive(Default)]
pub struct OpenCalls {
    all: Mutex<(u64, HashMap<u64, Arc<OpenCall>>)>,
}

struct OpenCall {
    caller: Principal,
    visit: Option<Visit>,
    kind: Kind,
    state: Mutex<CallState>,
}

#[derive(Default)]
struct CallState {
    /// Since when data waits that the client has not read.
    offered: Option<Instant>,
    /// Since when its token is known to be invalid.
    void: Option<Instant>,
}

/// Registers an open call until it is dropped.
pub struct Entry {
    calls: Arc<OpenCalls>,
    number: u64,
    call: Arc<OpenCall>,
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.calls.all.lock().unwrap_or_else(PoisonError::into_inner).1.remove(&self.number);
    }
}

impl Entry {
    fn offered(&self, at: Option<Instant>) {
        self.call.state.lock().unwrap_or_else(PoisonError::into_inner).offered = at;
    }
}

impl OpenCalls {
    /// Begins a call.
    pub fn begin(self: &Arc<Self>, caller: Principal, visit: Option<Visit>, kind: Kind) -> Entry {
        let call = Arc::new(OpenCall { caller, visit, kind, state: Mutex::default() });
        let mut all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        all.0 += 1;
        let number = all.0;
        all.1.insert(number, Arc::clone(&call));
        Entry { calls: Arc::clone(self), number, call }
    }

    /// Closes the connections of calls that must end but do not, as long as it runs.
    pub async fn watch(self: Arc<Self>, access: Arc<Access>, clock: Clock) {
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            self.look(&access, clock.now_ms());
        }
    }

    fn look(&self, access: &Access, now_ms: u64) {
        let now = Instant::now();
        let all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        for call in all.1.values() {
            let mut state = call.state.lock().unwrap_or_else(PoisonError::into_inner);
            let why = if !access.still_holds(&call.caller, now_ms) {
                let void = *state.void.get_or_insert(now);
                (now - void >= END_WITHIN).then_some("its token is no longer valid")
            } else if call.kind == Kind::Download {
                let is_late = state.offered.is_some_and(|since| now - since >= TAKE_WITHIN);
                is_late.then_some("its client read nothing of a download for a minute")
            } else {
                None
            };
            if let (Some(why), Some(visit)) = (why, &call.visit) {
                tracing::info!(by = %call.caller.name, why, "closed a connection");
                // Logged once; the call ends with its connection.
                *state = CallState::default();
                visit.end();
            }
        }
    }
}

/// Waits until the token of a caller becomes invalid.
pub type Void = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The status for a caller whose token is no longer valid.
pub fn refused() -> Status {
    ServiceError::from(Refused::NotValid).into()
}

/// An arriving request: it has a place until it is complete, and ends if no data arrives for 20 seconds.
pub struct Arriving<B> {
    inner: Pin<Box<B>>,
    place: Option<Place>,
    /// For uploads, whose messages lie in memory until they are complete.
    lengths: Option<Lengths>,
    /// Runs while data is awaited. Not for long-lived streams.
    patience: Option<Pin<Box<Sleep>>>,
    waits: bool,
}

impl<B> Arriving<B> {
    /// The same request.
    pub fn new(inner: B, place: Option<Place>, kind: Kind) -> Self {
        let patience = (kind != Kind::Session).then(|| Box::pin(tokio::time::sleep(SEND_WITHIN)));
        let lengths = (kind == Kind::Upload).then(Lengths::default);
        Self { inner: Box::pin(inner), place, lengths, patience, waits: false }
    }
}

impl<B> http_body::Body for Arriving<B>
where
    B: http_body::Body<Data = Bytes>,
    B::Error: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        let polled = this.inner.as_mut().poll_frame(context);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                this.waits = false;
                if let (Some(lengths), Some(data)) = (&mut this.lengths, frame.data_ref()) {
                    lengths.take(data)?;
                }
            }
            Poll::Ready(None | Some(Err(_))) => this.place = None,
            Poll::Pending => {
                if let Some(patience) = &mut this.patience {
                    if !std::mem::replace(&mut this.waits, true) {
                        patience.as_mut().reset(Instant::now() + SEND_WITHIN);
                    }
                    ready!(patience.as_mut().poll(context));
                    // As if it had ended: the received part of a blob is kept, and its writer is freed.
                    this.place = None;
                    return Poll::Ready(None);
                }
            }
        }
        if this.inner.is_end_stream() {
            this.place = None;
        }
        polled.map_err(|error| Status::from_error(error.into()))
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

/// Follows the lengths of messages, each behind five bytes (a flag, and the length with its highest byte
/// first).
#[derive(Default)]
struct Lengths {
    head: Vec<u8>,
    left: usize,
}

impl Lengths {
    /// Processes received bytes.
    fn take(&mut self, mut data: &[u8]) -> Result<(), Status> {
        while !data.is_empty() {
            let skipped = self.left.min(data.len());
            (self.left, data) = (self.left - skipped, &data[skipped..]);
            let missing = (5 - self.head.len()).min(data.len());
            self.head.extend_from_slice(&data[..missing]);
            data = &data[missing..];
            if let [_, length @ ..] = self.head.as_slice()
                && let Ok(length) = <[u8; 4]>::try_from(length)
            {
                self.left = u32::from_be_bytes(length) as usize;
                self.head.clear();
                if self.left > MAX_PIECE_BYTES {
                    let error = ServiceError::BadArgument {
                        field: "data",
                        message: format!(
                            "is in a message of {} bytes; at most {CHUNK_BYTES} bytes of data are allowed",
                            self.left
                        ),
                    };
                    return Err(error.into());
                }
            }
        }
        Ok(())
    }
}

/// An answer whose caller must have a valid token until its end.
pub struct Standing {
    inner: Body,
    void: Void,
    entry: Entry,
    _place: Option<Place>,
    is_over: bool,
}

impl Standing {
    /// The same answer.
    pub fn new(inner: Body, void: Void, entry: Entry, place: Option<Place>) -> Self {
        Self { inner, void, entry, _place: place, is_over: false }
    }
}

impl http_body::Body for Standing {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.is_over {
            return Poll::Ready(None);
        }
        self.entry.offered(None);
        if self.void.as_mut().poll(context).is_ready() {
            self.is_over = true;
            let mut trailers = HeaderMap::new();
            refused().add_header(&mut trailers)?;
            return Poll::Ready(Some(Ok(Frame::trailers(trailers))));
        }
        let polled = Pin::new(&mut self.inner).poll_frame(context);
        if polled.is_ready() {
            self.entry.offered(Some(Instant::now()));
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.is_over || self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        // It may end before the inner one.
        SizeHint::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_of_messages_are_followed_however_they_are_cut() {
        let message = |length: usize| {
            let mut bytes = vec![0];
            bytes.extend((length as u32).to_be_bytes());
            bytes.extend(vec![7; length]);
            bytes
        };
        let stream = [message(0), message(300), message(MAX_PIECE_BYTES), message(1)].concat();
        for piece in [1, 3, 5, 1000, stream.len()] {
            let mut lengths = Lengths::default();
            assert!(stream.chunks(piece).all(|data| lengths.take(data).is_ok()), "in pieces of {piece}");
            assert_eq!((lengths.left, lengths.head.len()), (0, 0), "in pieces of {piece}");
            let long = message(MAX_PIECE_BYTES + 1);
            let error = long.chunks(piece).find_map(|data| lengths.take(data).err());
            assert!(error.is_some_and(|status| status.message().contains("message of 1052673 bytes")));
        }
    }
}
