//! Several addresses against real servers, each of which dies as a process does: with all its connections.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::Path;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use http::{Request, Response};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tonic::body::Body;
use tonic::server::NamedService;
use tonic::transport::{Identity, Server, ServerTlsConfig};
use tonic::{Code, Status};
use tower_service::Service;

use super::transport::CONNECT_WITHIN_OF_SEVERAL;
use super::*;
use crate::v1::GetJobRequest;
use crate::v1::job_service_client::JobServiceClient;

/// Answers every call with its name and the authority that the client has sent.
#[derive(Clone)]
struct Named(&'static str);

impl NamedService for Named {
    const NAME: &'static str = "fathom.v1.JobService";
}

impl Service<Request<Body>> for Named {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = std::future::Ready<Result<Response<Body>, Infallible>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let authority = request.uri().authority().map(ToString::to_string).unwrap_or_default();
        let said = format!("{} as {authority}", self.0);
        std::future::ready(Ok(Status::not_found(said).into_http()))
    }
}

/// A server with a thread and a runtime of its own; all of its connections end with it.
struct Running {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Running {
    fn start(name: &'static str, tls: Option<Identity>) -> Self {
        Self::listening(([127, 0, 0, 1], 0).into(), name, tls)
    }

    /// At an address whose server has died.
    fn at(address: SocketAddr, name: &'static str) -> Self {
        Self::listening(address, name, None)
    }

    fn listening(at: SocketAddr, name: &'static str, tls: Option<Identity>) -> Self {
        let (stop, stopped) = oneshot::channel::<()>();
        let (sender, address) = std::sync::mpsc::channel();
        let serve = async move {
            let Ok(listener) = TcpListener::bind(at).await else { panic!("no port") };
            // If the test is gone, nobody waits.
            let _ = listener.local_addr().map(|address| sender.send(address));
            let mut server = Server::builder();
            if let Some(identity) = tls {
                server = match server.tls_config(ServerTlsConfig::new().identity(identity)) {
                    Ok(server) => server,
                    Err(error) => panic!("{error}"),
                };
            }
            let incoming = tokio_stream::wrappers::TcpListenerStream::new(listener);
            tokio::select! {
                served = server.add_service(Named(name)).serve_with_incoming(incoming) => panic!("{served:?}"),
                _ = stopped => {}
            }
        };
        let thread = std::thread::spawn(move || {
            match tokio::runtime::Builder::new_current_thread().enable_all().build() {
                Ok(runtime) => runtime.block_on(serve),
                Err(error) => panic!("{error}"),
            }
        });
        let Ok(address) = address.recv() else { panic!("it does not start") };
        Self { address, stop: Some(stop), thread: Some(thread) }
    }

    /// Returns once its connections are closed.
    fn die(&mut self) {
        self.stop.take();
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok(), "the server panicked");
        }
    }
}

/// The answer to one call.
async fn asked(connection: &Connection) -> Status {
    let call = JobServiceClient::new(connection.clone()).get_job(GetJobRequest::default()).await;
    let Err(status) = call else { panic!("a job") };
    status
}

/// The same. A call that was sent before the loss of the connection was noticed is repeated, as all callers
/// do.
async fn asked_again(connection: &Connection) -> Status {
    let mut status = asked(connection).await;
    for _ in 0..3 {
        if matches!(status.code(), Code::NotFound | Code::Unavailable) {
            break;
        }
        status = asked(connection).await;
    }
    status
}

/// The server that answers.
async fn who_answers(connection: &Connection) -> String {
    asked_again(connection).await.message().to_owned()
}

fn lazily(url: &str) -> Connection {
    Dial::to(url).lazily().unwrap_or_else(|error| panic!("{error}"))
}

/// An address where nothing listens.
async fn nowhere() -> SocketAddr {
    let Ok(listener) = TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
    listener.local_addr().unwrap_or_else(|error| panic!("{error}"))
}

#[tokio::test]
async fn calls_move_to_the_next_address_when_a_server_dies() {
    let (mut a, mut b) = (Running::start("a", None), Running::start("b", None));
    let connection = lazily(&format!("{},{}", a.address, b.address));
    let at_a = format!("a as {}", a.address);
    assert_eq!(who_answers(&connection).await, at_a);
    a.die();
    // The authority is that of the address in use, since a proxy may route by it.
    assert_eq!(who_answers(&connection).await, format!("b as {}", b.address));
    b.die();
    let status = asked_again(&connection).await;
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
}

#[tokio::test]
async fn after_the_last_address_comes_the_first() {
    let (mut a, mut b) = (Running::start("a", None), Running::start("b", None));
    let connection = lazily(&format!("{},{}", a.address, b.address));
    assert!(who_answers(&connection).await.starts_with("a as"));
    a.die();
    assert!(who_answers(&connection).await.starts_with("b as"));
    let again = Running::at(a.address, "a again");
    // A connection that works stays where it is.
    assert!(who_answers(&connection).await.starts_with("b as"));
    b.die();
    assert!(who_answers(&connection).await.starts_with("a again as"));
    drop(again);
}

#[tokio::test]
async fn a_dead_first_address_is_passed_over() {
    let b = Running::start("b", None);
    // The second one is reserved for documents, and nothing answers there, or the network refuses it.
    for dead in [nowhere().await.to_string(), "192.0.2.1:1".to_owned()] {
        let url = format!("{dead},{}", b.address);
        let begun = Instant::now();
        assert!(who_answers(&lazily(&url)).await.starts_with("b as"), "{url}");
        let now = Dial::to(&url).now().await.unwrap_or_else(|error| panic!("{error}"));
        assert!(who_answers(&now).await.starts_with("b as"), "{url}");
        let most = 2 * CONNECT_WITHIN_OF_SEVERAL + Duration::from_secs(1);
        assert!(begun.elapsed() < most, "{:?}", begun.elapsed());
    }
}

#[tokio::test]
async fn waiting_callers_share_one_attempt() {
    // Reserved for documents: nothing answers there, or the network refuses it.
    let connection = lazily("192.0.2.1:1,192.0.2.2:1");
    let begun = Instant::now();
    let calls: Vec<_> = (0..20)
        .map(|_| {
            let connection = connection.clone();
            tokio::spawn(async move { asked(&connection).await.code() })
        })
        .collect();
    for call in calls {
        assert_eq!(call.await.ok(), Some(Code::Unavailable));
    }
    let most = 2 * CONNECT_WITHIN_OF_SEVERAL + Duration::from_secs(1);
    assert!(begun.elapsed() < most, "{:?}", begun.elapsed());
}

#[tokio::test]
async fn a_mute_first_server_is_left_after_its_keep_alives() {
    // It accepts connections, and answers nothing.
    let Ok(mute) = TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
    let address = mute.local_addr().unwrap_or_else(|error| panic!("{error}"));
    let b = Running::start("b", None);
    let connection = lazily(&format!("{address},{}", b.address));
    let begun = Instant::now();
    let lost = asked(&connection).await;
    assert_ne!(lost.code(), Code::NotFound, "{lost:?}");
    assert!(who_answers(&connection).await.starts_with("b as"));
    let most = 2 * KEEPALIVE_OF_SEVERAL + Duration::from_secs(3);
    assert!(begun.elapsed() < most, "{:?}", begun.elapsed());
}

#[tokio::test]
async fn when_nobody_answers_each_address_has_its_reason() {
    let (one, other) = (nowhere().await, nowhere().await);
    let dial = Dial::to(&format!("{one}, {other}"));
    let at_once = dial.now().await.err().map(|error| error.to_string()).unwrap_or_default();
    let status = asked(&lazily(&dial.url)).await;
    for said in [at_once, cause(&status)] {
        assert!(said.starts_with("no address answers: "), "{said}");
        for address in [one, other] {
            assert!(said.contains(&format!("http://{address} (Connection refused")), "{said}");
        }
    }
    assert!(dial.misdialled(&status).await.is_none(), "one may be a coordinator that starts");
}

#[tokio::test]
async fn misdialled_names_every_address_or_none() {
    let dir = tempfile::tempdir().unwrap_or_else(|error| panic!("{error}"));
    let authority = Authority::new(dir.path(), "ours");
    let by_tls = Running::start("a", Some(authority.certify("127.0.0.1")));
    let also = Running::start("b", Some(authority.certify("127.0.0.1")));
    let broken = Status::unknown("h2 protocol error");
    let both = Dial::to(&format!("{},{}", by_tls.address, also.address));
    let said = both.misdialled(&broken).await.map(|error| error.to_string()).unwrap_or_default();
    for address in [by_tls.address, also.address] {
        assert!(said.contains(&format!("use https://{address}")), "{said}");
    }
    let one = Dial::to(&format!("{},{}", by_tls.address, nowhere().await));
    assert!(one.misdialled(&broken).await.is_none());

    // Of two that only TLS could reach, both certificates are of an unknown authority.
    let other = tempfile::tempdir().unwrap_or_else(|error| panic!("{error}"));
    let url = format!("https://{},https://{}", by_tls.address, also.address);
    let dial = Dial { tls_ca: Some(Authority::new(other.path(), "theirs").ca), ..Dial::to(&url) };
    let Err(error) = dial.now().await else { panic!("a connection") };
    assert!(matches!(error, DialError::Misdialled(_)), "{error:?}");
    assert_eq!(error.to_string().matches("is signed by an unknown authority").count(), 2, "{error}");
    let status = asked(&dial.lazily().unwrap_or_else(|error| panic!("{error}"))).await;
    assert!(dial.misdialled(&status).await.is_some(), "{status:?}");
}

#[test]
fn addresses_of_different_schemes_are_refused() {
    let said = |url: &str| Dial::to(url).lazily().err().map(|error| error.to_string()).unwrap_or_default();
    let mixed = said("http://a:1,https://b:1");
    assert!(mixed.contains("must all begin with http://, or all with https://"), "{mixed}");
    for url in ["http://a:1,", "http://a:1,,http://b:1", "http://a:1,ftp://b:1"] {
        assert!(said(url).contains("is not a valid coordinator address"), "{url}: {}", said(url));
    }
    assert_eq!(Dial::to("a:1, http://b:2").url, "http://a:1,http://b:2");
}

#[test]
fn no_address_of_several_gets_a_token_in_plain_text() {
    let dial = |url: &str| Dial { token: Some(Secret::new("fathom_a_b")), ..Dial::to(url) };
    for url in ["http://127.0.0.1:1,http://reef.example:1", "http://reef.example:1,http://127.0.0.1:1"] {
        let Err(DialError::PlainToken(named)) = dial(url).lazily() else { panic!("{url}") };
        assert_eq!(named, "http://reef.example:1");
        assert!(Dial { insecure: true, ..dial(url) }.lazily().is_ok(), "{url}");
    }
    assert!(dial("http://127.0.0.1:1,http://localhost:2").lazily().is_ok());
}

/// A certificate authority in a file.
struct Authority {
    ca: PathBuf,
    issuer: CertifiedIssuer<'static, KeyPair>,
}

impl Authority {
    fn new(dir: &Path, name: &str) -> Self {
        let made = || {
            let mut params = CertificateParams::new(Vec::new())?;
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            // The issuer is found by its name.
            params.distinguished_name.push(rcgen::DnType::CommonName, name);
            CertifiedIssuer::self_signed(params, KeyPair::generate()?)
        };
        let issuer = made().unwrap_or_else(|error: rcgen::Error| panic!("{error}"));
        let ca = dir.join("ca.pem");
        std::fs::write(&ca, issuer.pem()).unwrap_or_else(|error| panic!("{error}"));
        Self { ca, issuer }
    }

    /// A certificate for one name only.
    fn certify(&self, name: &str) -> Identity {
        let made = || {
            let key = KeyPair::generate()?;
            let cert = CertificateParams::new(vec![name.to_owned()])?.signed_by(&key, &self.issuer)?;
            Ok(Identity::from_pem(cert.pem(), key.serialize_pem()))
        };
        made().unwrap_or_else(|error: rcgen::Error| panic!("{error}"))
    }
}

#[tokio::test]
async fn each_certificate_is_checked_for_its_own_address() {
    let dir = tempfile::tempdir().unwrap_or_else(|error| panic!("{error}"));
    let authority = Authority::new(dir.path(), "ours");
    let mut a = Running::start("a", Some(authority.certify("localhost")));
    let b = Running::start("b", Some(authority.certify("127.0.0.1")));
    let (port_a, port_b) = (a.address.port(), b.address.port());
    let dial = |url: String| {
        let dial = Dial { tls_ca: Some(authority.ca.clone()), ..Dial::to(&url) };
        dial.lazily().unwrap_or_else(|error| panic!("{error}"))
    };
    let right = dial(format!("https://localhost:{port_a},https://127.0.0.1:{port_b}"));
    assert_eq!(who_answers(&right).await, format!("a as localhost:{port_a}"));
    a.die();
    assert_eq!(who_answers(&right).await, format!("b as 127.0.0.1:{port_b}"));

    // A certificate for the name of the one address is not good for the other.
    let a = Running::start("a", Some(authority.certify("localhost")));
    let port_a = a.address.port();
    let swapped = dial(format!("https://127.0.0.1:{port_a},https://localhost:{port_b}"));
    let status = asked(&swapped).await;
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    assert_eq!(status.message().matches("not valid for name").count(), 2, "{status:?}");
}
