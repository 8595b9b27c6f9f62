//! Connections before and after authentication. A client without a valid token is a stranger: its time is
//! limited, and it makes room for others.
//!
//! A stranger costs a descriptor and some kilobytes. It has ten seconds for its first call, including TLS and
//! the HTTP/2 preface, and a minute after each call without a valid token. [`Room`] limits the number of
//! strangers. One more ends the one that has been silent longest, so that a caller with a token always gets
//! in.
//!
//! Reading [`Connection`] as a stream of bytes ends with an error once [`Visit::end`] was called, also in the
//! middle of a handshake.

mod accept;
mod room;

use std::collections::{BTreeMap, HashMap};
use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::task::{Context, Poll};
use std::time::Duration;

use futures::task::AtomicWaker;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;
use tonic::transport::server::{Connected, TlsConnectInfo};

use crate::rate_limited_log::LOG_EVERY;

pub use accept::{Accepted, accepted};
pub use room::Room;

/// Time that a stranger has for its first call.
const FIRST_CALL_WITHIN: Duration = Duration::from_secs(10);
/// Time that it has from one call to the next.
const NEXT_CALL_WITHIN: Duration = Duration::from_secs(60);
/// Interval of the checks for silent strangers.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// All connections of a coordinator.
pub struct Connections {
    room: Room,
    all: Mutex<All>,
}

#[derive(Default)]
struct All {
    next: u64,
    open: usize,
    by_number: HashMap<u64, Weak<State>>,
    /// Whether everybody is sent to other coordinators.
    is_closed: bool,
    /// Strangers by the time of their last activity and a unique number, with their end time.
    strangers: BTreeMap<(Instant, u64), (Instant, Arc<State>)>,
    ended: Ended,
}

/// Strangers disconnected since the last log line.
#[derive(Default)]
struct Ended {
    silent: u64,
    crowded: u64,
    /// The last of them.
    from: Option<SocketAddr>,
    logged: Option<Instant>,
}

impl Connections {
    /// An empty set of connections.
    pub fn new(room: Room) -> Arc<Self> {
        Arc::new(Self { room, all: Mutex::default() })
    }

    /// Closes all connections and admits no more, until it is called with false: clients go to the next
    /// coordinator. Returns the number of those that it closed.
    pub fn close(&self, is_closed: bool) -> usize {
        let mut all = self.lock();
        all.is_closed = is_closed;
        if !is_closed {
            return 0;
        }
        let open: Vec<Arc<State>> = all.by_number.drain().filter_map(|(_, state)| state.upgrade()).collect();
        open.iter().for_each(|state| state.end(false));
        open.len()
    }

    /// Admits a connection as a stranger; `None` if there is no room, even without other strangers, or if
    /// everybody is sent away.
    pub fn enter<C>(self: &Arc<Self>, io: C, from: Option<SocketAddr>) -> Option<Connection<C>> {
        let now = Instant::now();
        let mut all = self.lock();
        if all.is_closed {
            return None;
        }
        while all.strangers.len() >= self.room.strangers || all.open >= self.room.connections {
            let Some((_, (_, state))) = all.strangers.pop_first() else {
                all.ended.crowded += 1;
                all.ended.from = from;
                return None;
            };
            all.ended.crowded += 1;
            all.ended.from = state.from;
            // It counts until it is dropped, which happens soon; the new connection must not wait for that.
            all.open = all.open.saturating_sub(1);
            state.end(true);
        }
        all.next += 1;
        all.open += 1;
        let state = Arc::new(State {
            number: all.next,
            from,
            connections: Arc::downgrade(self),
            heard: Mutex::new(Some(now)),
            is_over: AtomicBool::new(false),
            is_uncounted: AtomicBool::new(false),
            wakers: [AtomicWaker::new(), AtomicWaker::new()],
        });
        all.by_number.insert(state.number, Arc::downgrade(&state));
        all.strangers.insert((now, state.number), (now + FIRST_CALL_WITHIN, Arc::clone(&state)));
        Some(Connection { io, state })
    }

    /// Number of connections, and of strangers among them.
    #[cfg(test)]
    fn count(&self) -> (usize, usize) {
        let all = self.lock();
        (all.open, all.strangers.len())
    }

    /// Ends the connections of strangers that have been silent for too long, as long as it runs.
    pub async fn watch(self: Arc<Self>) {
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            self.look(Instant::now());
        }
    }

    fn look(&self, now: Instant) {
        let mut all = self.lock();
        let late: Vec<_> =
            all.strangers.iter().filter(|(_, (ends, _))| *ends <= now).map(|(key, _)| *key).collect();
        for key in late {
            if let Some((_, state)) = all.strangers.remove(&key) {
                all.ended.silent += 1;
                all.ended.from = state.from;
                state.end(false);
            }
        }
        let ended = &mut all.ended;
        let is_time = ended.logged.is_none_or(|logged| now - logged >= LOG_EVERY);
        if is_time && ended.silent + ended.crowded > 0 {
            let from = ended.from.map(|from| from.to_string()).unwrap_or_default();
            tracing::warn!(
                silent = ended.silent, crowded = ended.crowded, last_from = %from,
                "connections without a token were closed: they made no call in time, or there were too many of them"
            );
            *ended = Ended { logged: Some(now), ..Ended::default() };
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, All> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct State {
    number: u64,
    from: Option<SocketAddr>,
    connections: Weak<Connections>,
    /// Time of its last activity; `None` once it has used a valid token.
    heard: Mutex<Option<Instant>>,
    is_over: AtomicBool,
    /// Whether it was removed from the count before it was dropped.
    is_uncounted: AtomicBool,
    /// Of the reader and the writer.
    wakers: [AtomicWaker; 2],
}

impl State {
    fn end(&self, is_uncounted: bool) {
        self.is_uncounted.fetch_or(is_uncounted, Ordering::AcqRel);
        self.is_over.store(true, Ordering::Release);
        for waker in &self.wakers {
            waker.wake();
        }
    }

    /// Whether it is still open; the waker is woken when it ends.
    fn check(&self, waker: &AtomicWaker, context: &Context<'_>) -> io::Result<()> {
        waker.register(context.waker());
        if self.is_over.load(Ordering::Acquire) {
            return Err(io::Error::new(io::ErrorKind::ConnectionAborted, "the coordinator ended it"));
        }
        Ok(())
    }
}

/// A connection, as the calls that come over it know it.
#[derive(Clone)]
pub struct Visit(Arc<State>);

impl Visit {
    /// The visit of a request.
    pub fn of<B>(request: &http::Request<B>) -> Option<&Self> {
        Self::in_extensions(request.extensions())
    }

    /// The visit in what a request carries.
    pub fn in_extensions(carried: &http::Extensions) -> Option<&Self> {
        let over_tls = carried.get::<TlsConnectInfo<Self>>().map(TlsConnectInfo::get_ref);
        over_tls.or_else(|| carried.get::<Self>())
    }

    /// Its remote address.
    pub fn from(&self) -> Option<SocketAddr> {
        self.0.from
    }

    /// Records a valid token: it is no longer a stranger.
    pub fn admit(&self) {
        self.heard(None);
    }

    /// Records a call without a valid token.
    pub fn call_without_token(&self) {
        self.heard(Some(Instant::now()));
    }

    fn heard(&self, now: Option<Instant>) {
        let mut heard = self.0.heard.lock().unwrap_or_else(PoisonError::into_inner);
        let (Some(before), Some(connections)) = (*heard, self.0.connections.upgrade()) else { return };
        let mut all = connections.lock();
        // It may be ending already.
        let Some((_, state)) = all.strangers.remove(&(before, self.0.number)) else { return };
        if let Some(now) = now {
            all.strangers.insert((now, self.0.number), (now + NEXT_CALL_WITHIN, state));
        }
        *heard = now;
    }

    /// Ends it with all calls.
    pub fn end(&self) {
        self.0.end(false);
    }
}

/// The bytes of a connection.
pub struct Connection<C> {
    io: C,
    state: Arc<State>,
}

impl<C> Drop for Connection<C> {
    fn drop(&mut self) {
        let Some(connections) = self.state.connections.upgrade() else { return };
        let heard = *self.state.heard.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all = connections.lock();
        if let Some(heard) = heard {
            all.strangers.remove(&(heard, self.state.number));
        }
        all.by_number.remove(&self.state.number);
        if !self.state.is_uncounted.load(Ordering::Acquire) {
            all.open = all.open.saturating_sub(1);
        }
    }
}

impl<C> Connected for Connection<C> {
    type ConnectInfo = Visit;

    fn connect_info(&self) -> Visit {
        Visit(Arc::clone(&self.state))
    }
}

impl<C: AsyncRead + Unpin> AsyncRead for Connection<C> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.state.check(&self.state.wakers[0], context)?;
        Pin::new(&mut self.io).poll_read(context, buffer)
    }
}

impl<C: AsyncWrite + Unpin> AsyncWrite for Connection<C> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.state.check(&self.state.wakers[1], context)?;
        Pin::new(&mut self.io).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.state.check(&self.state.wakers[1], context)?;
        Pin::new(&mut self.io).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.state.check(&self.state.wakers[1], context)?;
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.state.check(&self.state.wakers[1], context)?;
        Pin::new(&mut self.io).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests;
