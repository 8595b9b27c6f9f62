//! The connection below all calls, to one address or to one of several.
//!
//! With one address it is tonic's channel, which connects again by itself.
//!
//! With several there is one connection at a time, to the first address that answers. When it is lost, the
//! next call connects to the next address that answers.
//!
//! A channel of tonic would connect to the same address for ever. So each connection is a channel of its own
//! that connects only once, with the endpoint of its address. A certificate is therefore verified against the
//! name that was really connected to. The calls carry that name too, by which a proxy may route them.
//!
//! All callers share one attempt, which no caller interrupts. So many callers do not multiply the time limits
//! of dead addresses, and a caller with a short limit does not begin at the first address again and again.

use std::fmt;
use std::future::poll_fn;
use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use http::{Request, Response, Uri};
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpStream, lookup_host};
use tokio::sync::watch;
use tonic::Status;
use tonic::body::Body;
use tonic::transport::{Channel, Endpoint};
use tower_service::Service;

use super::{Connector, root_cause};

/// Timeout of a connection attempt where there is another address to try. A machine that is up answers in a
/// round trip. A lost packet is sent again after a second, so one may be lost.
pub const CONNECT_WITHIN_OF_SEVERAL: Duration = Duration::from_secs(2);

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// One of the addresses of a coordinator.
#[derive(Clone, Debug)]
pub struct Address {
    /// The text given, with a scheme.
    pub url: String,
    /// The same with all settings of the connection.
    pub endpoint: Endpoint,
}

/// What calls are sent over; clones share the connection.
#[derive(Clone, Debug)]
pub struct Transport(Route);

#[derive(Clone, Debug)]
enum Route {
    One(Channel),
    Several(Arc<Several>),
}

impl Transport {
    /// Over a channel, which connects again by itself.
    pub(super) fn one(channel: Channel) -> Self {
        Self(Route::One(channel))
    }

    /// Over one of several addresses.
    pub(super) fn several(several: Arc<Several>) -> Self {
        Self(Route::Several(several))
    }
}

impl Service<Request<Body>> for Transport {
    type Response = Response<Body>;
    type Error = Failure;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Body>, Failure>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Failure>> {
        match &mut self.0 {
            Route::One(channel) => channel.poll_ready(context).map_err(Into::into),
            // The call itself waits for the connection.
            Route::Several(_) => Poll::Ready(Ok(())),
        }
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        match &mut self.0 {
            Route::One(channel) => {
                let answer = channel.call(request);
                Box::pin(async move { Ok(answer.await?) })
            }
            Route::Several(several) => {
                let several = Arc::clone(several);
                Box::pin(async move { several.call(request).await })
            }
        }
    }
}

/// Several addresses, and the connection to one of them.
pub struct Several {
    addresses: Arc<[Address]>,
    /// Simulations use their own network.
    connector: Option<Connector>,
    /// The latest attempt to connect; `None` before the first call.
    attempt: Mutex<Option<Attempt>>,
}

/// An attempt to connect, shared by all callers that wait for it.
#[derive(Clone)]
struct Attempt {
    /// Number of the address that it began with.
    first: usize,
    /// `None` while it runs.
    outcome: watch::Receiver<Option<Result<Connected, Unanswered>>>,
}

#[derive(Clone)]
struct Connected {
    channel: Channel,
    /// Number of the address.
    at: usize,
    /// Set when the connection has ended, or takes no further call.
    lost: Arc<AtomicBool>,
}

/// No address answers: each of them, with the reason.
#[derive(Clone, Debug)]
pub struct Unanswered(pub Vec<(String, String)>);

impl fmt::Display for Unanswered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reasons: Vec<_> = self.0.iter().map(|(url, said)| format!("{url} ({said})")).collect();
        write!(f, "no address answers: {}", reasons.join(", "))
    }
}

impl fmt::Debug for Several {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Several").field("addresses", &self.addresses).finish_non_exhaustive()
    }
}

impl Several {
    /// Connects on first use.
    pub fn of(addresses: Vec<Address>, connector: Option<Connector>) -> Arc<Self> {
        Arc::new(Self { addresses: addresses.into(), connector, attempt: Mutex::default() })
    }

    /// Waits until one of the addresses answers.
    pub async fn connect(&self) -> Result<(), Unanswered> {
        self.connected().await.map(drop)
    }

    async fn call(&self, request: Request<Body>) -> Result<Response<Body>, Failure> {
        let unavailable = |unanswered: Unanswered| Status::unavailable(unanswered.to_string());
        let mut connected = self.connected().await.map_err(unavailable)?;
        poll_fn(|context| connected.channel.poll_ready(context)).await?;
        let answer = connected.channel.call(request).await;
        if self.connector.is_some() && answer.is_err() {
            // Such a channel connects by itself and reports a lost connection only here.
            connected.lost.store(true, Ordering::Relaxed);
        }
        Ok(answer?)
    }

    /// The connection, which may have to be made first.
    async fn connected(&self) -> Result<Connected, Unanswered> {
        let mut outcome = self.current_attempt().outcome;
        // Fails when the attempt was dropped, as its runtime ends.
        match outcome.wait_for(Option::is_some).await.as_deref() {
            Ok(Some(outcome)) => outcome.clone(),
            Ok(None) | Err(_) => Err(Unanswered(Vec::new())),
        }
    }

    /// The attempt that runs or whose connection lives; otherwise a new one.
    fn current_attempt(&self) -> Attempt {
        let mut latest = self.attempt.lock().unwrap_or_else(PoisonError::into_inner);
        let first = match &*latest {
            None => 0,
            Some(attempt) => match &*attempt.outcome.borrow() {
                // It runs, unless its task is gone.
                None if attempt.outcome.has_changed().is_ok() => return attempt.clone(),
                None | Some(Err(_)) => attempt.first,
                Some(Ok(connected)) if !connected.lost.load(Ordering::Relaxed) => return attempt.clone(),
                Some(Ok(connected)) => (connected.at + 1) % self.addresses.len(),
            },
        };
        let (sender, outcome) = watch::channel(None);
        let attempt = Attempt { first, outcome };
        let (addresses, connector) = (Arc::clone(&self.addresses), self.connector.clone());
        // A task of its own, so that no caller interrupts it.
        tokio::spawn(async move {
            let outcome = first_that_answers(&addresses, first, connector.as_ref()).await;
            sender.send_replace(Some(outcome));
        });
        *latest = Some(attempt.clone());
        attempt
    }
}

/// Tries all addresses once, from number `first` on.
async fn first_that_answers(
    addresses: &[Address],
    first: usize,
    connector: Option<&Connector>,
) -> Result<Connected, Unanswered> {
    let mut faults = Vec::new();
    for at in (first..addresses.len()).chain(0..first) {
        let address = &addresses[at];
        let made = match connector {
            Some(Connector(connect)) => Ok((connect(&address.endpoint), Arc::default())),
            None => address.connect().await,
        };
        match made {
            Ok((channel, lost)) => {
                tracing::info!(address = %address.url, "connected to a coordinator");
                return Ok(Connected { channel, at, lost });
            }
            Err(said) => {
                tracing::debug!(address = %address.url, reason = %said, "it does not answer");
                faults.push((address.url.clone(), said));
            }
        }
    }
    Err(Unanswered(faults))
}

impl Address {
    /// A connection, and whether it is lost. A name may stand for several machines; all are tried.
    async fn connect(&self) -> Result<(Channel, Arc<AtomicBool>), String> {
        let seconds = CONNECT_WITHIN_OF_SEVERAL.as_secs();
        let uri = self.endpoint.uri();
        let host = uri.host().unwrap_or_default().trim_matches(['[', ']']);
        let port = uri.port_u16().unwrap_or(if uri.scheme_str() == Some("https") { 443 } else { 80 });
        let found = match tokio::time::timeout(CONNECT_WITHIN_OF_SEVERAL, lookup_host((host, port))).await {
            Ok(found) => found.map_err(|error| error.to_string())?,
            Err(_) => return Err(format!("its name was not resolved within {seconds} s")),
        };
        let mut fault = "its name has no address".to_owned();
        for to in found {
            let lost = Arc::default();
            let once = Once { to: Some(to), lost: Arc::clone(&lost) };
            let connecting = self.endpoint.connect_with_connector(once);
            match tokio::time::timeout(CONNECT_WITHIN_OF_SEVERAL, connecting).await {
                Ok(Ok(channel)) => return Ok((channel, lost)),
                Ok(Err(error)) => fault = root_cause(&error),
                Err(_) => fault = format!("no answer within {seconds} s"),
            }
        }
        Err(fault)
    }
}

/// Connects once. The second time the channel wants to replace a lost connection, or one that takes no
/// further call because the coordinator is about to leave.
struct Once {
    to: Option<SocketAddr>,
    lost: Arc<AtomicBool>,
}

impl Service<Uri> for Once {
    type Response = TokioIo<Watched>;
    type Error = io::Error;
    type Future = Pin<Box<dyn Future<Output = io::Result<Self::Response>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        let Some(to) = self.to.take() else {
            self.lost.store(true, Ordering::Relaxed);
            let error = io::Error::new(io::ErrorKind::NotConnected, "the connection was lost");
            return Box::pin(std::future::ready(Err(error)));
        };
        let lost = Arc::clone(&self.lost);
        Box::pin(async move {
            let stream = TcpStream::connect(to).await?;
            stream.set_nodelay(true)?;
            Ok(TokioIo::new(Watched { stream, lost }))
        })
    }
}

/// A stream that tells when it is dropped: HTTP/2 drops it as soon as the connection has failed.
struct Watched {
    stream: TcpStream,
    lost: Arc<AtomicBool>,
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.lost.store(true, Ordering::Relaxed);
    }
}

impl AsyncRead for Watched {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Watched {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        pieces: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, pieces)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
