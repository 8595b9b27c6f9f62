//! The simulated network as streams for tonic, at both ends.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use fathom_proto::dial::{Connector, Dial, Secret};
use futures::Stream;
use futures::future::BoxFuture;
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tonic::transport::Uri;
use tonic::transport::server::Connected;
use tower_service::Service;
use turmoil::net::{TcpListener, TcpStream};

/// Name of the coordinator's host.
pub const COORDINATOR: &str = "coordinator";
/// Its port.
pub const PORT: u16 = 7420;

/// Connection settings of all callers: the simulated network, with a token.
pub fn dial(token: &str) -> Dial {
    let connector = Connector::new(|endpoint| endpoint.connect_with_connector_lazy(Connect));
    Dial {
        token: Some(Secret::new(token)),
        insecure: true,
        connector: Some(connector),
        ..Dial::to(&format!("http://{COORDINATOR}:{PORT}"))
    }
}

/// Incoming connections.
pub async fn listen() -> io::Result<impl Stream<Item = io::Result<Wire>>> {
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    Ok(futures::stream::unfold(listener, |listener| async {
        let accepted = listener.accept().await;
        Some((accepted.map(|(stream, _)| Wire(stream)), listener))
    }))
}

#[derive(Clone)]
struct Connect;

impl Service<Uri> for Connect {
    type Response = TokioIo<TcpStream>;
    type Error = io::Error;
    type Future = BoxFuture<'static, io::Result<Self::Response>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, to: Uri) -> Self::Future {
        Box::pin(async move {
            let address = (to.host().unwrap_or_default().to_owned(), to.port_u16().unwrap_or_default());
            Ok(TokioIo::new(TcpStream::connect(address).await?))
        })
    }
}

/// A connection at the coordinator's end.
pub struct Wire(TcpStream);

impl Connected for Wire {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Wire {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_read(context, buffer)
    }
}

impl AsyncWrite for Wire {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_shutdown(context)
    }
}
