//! Takes connections from a listener, and goes on when the system has none to give.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use futures::{Stream, StreamExt};
use tokio::net::{TcpListener, TcpStream};

use super::{Connection, Connections};
use crate::seldom::Seldom;

/// Pause after a failure, such as when there is no descriptor left: without one the loop would take a core and change nothing.
const PAUSE: Duration = Duration::from_millis(100);

/// A connection with the address that it comes from, where that is known.
pub type Accepted<C> = (C, Option<SocketAddr>);

/// Connections of a listener. They never end, and failures of single ones are none of its own.
pub fn accepted(listener: TcpListener) -> impl Stream<Item = Accepted<TcpStream>> + Send {
    futures::stream::unfold((listener, Seldom::default()), |(listener, failed)| async move {
        loop {
            match listener.accept().await {
                Ok((stream, from)) => return Some(((stream, Some(from)), (listener, failed))),
                // The other side was gone before it was taken.
                Err(error) if is_of_one(&error) => {}
                Err(error) => {
                    if failed.count().is_some() {
                        tracing::warn!(
                            %error,
                            "no connection can be taken for now; if these are too many open files, raise LimitNOFILE"
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
    /// The same connections, each a stranger's at first.
    pub fn of<C, I>(self: Arc<Self>, incoming: I) -> impl Stream<Item = io::Result<Connection<C>>> + Send
    where
        C: Send,
        I: Stream<Item = Accepted<C>> + Send,
    {
        incoming.filter_map(move |(io, from)| std::future::ready(self.enter(io, from).map(Ok)))
    }
}
