//! Accepts connections from a listener, and continues after failures.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use futures::{Stream, StreamExt};
use tokio::net::{TcpListener, TcpStream};

use super::{Connection, Connections};
use crate::rate_limited_log::RateLimitedLog;

/// Pause after a failure, such as no free descriptor: without a pause the loop would occupy a core.
const PAUSE: Duration = Duration::from_millis(100);

/// A connection with the address that it comes from, where that is known.
pub type Accepted<C> = (C, Option<SocketAddr>);

/// Connections of a listener. The stream never ends, and failures of single connections do not affect it.
pub fn accepted(listener: TcpListener) -> impl Stream<Item = Accepted<TcpStream>> + Send {
    futures::stream::unfold((listener, RateLimitedLog::default()), |(listener, failed)| async move {
        loop {
            match listener.accept().await {
                Ok((stream, from)) => return Some(((stream, Some(from)), (listener, failed))),
                // The client left before the connection was accepted.
                Err(error) if is_of_one(&error) => {}
                Err(error) => {
                    if failed.count().is_some() {
                        tracing::warn!(
                            %error,
                            "cannot accept connections for now; if too many files are open, raise LimitNOFILE"
                        );
                    }
                    tokio::time::sleep(PAUSE).await;
                }
            }
        }
    })
}

fn is_of_one(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionReset, Interrupted};
    matches!(error.kind(), ConnectionAborted | ConnectionReset | Interrupted)
}

impl Connections {
    /// The same connections, each unauthenticated at first.
    pub fn of<C, I>(self: Arc<Self>, incoming: I) -> impl Stream<Item = io::Result<Connection<C>>> + Send
    where
        C: Send,
        I: Stream<Item = Accepted<C>> + Send,
    {
        incoming.filter_map(move |(io, from)| std::future::ready(self.enter(io, from).map(Ok)))
    }
}
