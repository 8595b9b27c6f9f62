//! How a client reaches a coordinator: its address, TLS, and the token that it shows.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{GrpcMethod, Request, Status};
use tonic_types::StatusExt;

/// A connection is given up after so long.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);
/// A half-open connection is noticed after the sum of these; without them its streams live for hours.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(20);
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// A call that has no answer after so long is given up; Claim, the longest to wait, does so for half of it.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);
/// Calls that are answered only once everything was sent, which takes as long as it takes.
const SENDS_FIRST: [&str; 1] = ["WriteBlob"];
/// Calls that look on the disk for every file of a scene, of which there may be two million, and how many times as long they have.
const LOOKS_AT_EVERY_FILE: [&str; 3] = ["BeginUpload", "CommitDataset", "CreateJob"];
const LONGER: u32 = 30;

/// A connection whose every call shows the token and has a deadline.
pub type Line = InterceptedService<Channel, Credentials>;

/// Where a coordinator is and how it is spoken to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dial {
    /// `http://HOST:PORT`, or `https://` with TLS.
    pub url: String,
    /// Authorities that the coordinator's certificate is checked against, PEM; `None`: those of the system.
    pub tls_ca: Option<PathBuf>,
    /// The client's own certificate and key, PEM.
    pub tls_identity: Option<(PathBuf, PathBuf)>,
    /// The token; `None` where none is asked for.
    pub token: Option<Secret>,
    /// Whether the token may be sent without TLS beyond this machine. Default false.
    pub insecure: bool,
    /// A call that has no answer after so long is given up, by both ends; of a stream, one whose answer has not begun. Uploads have
    /// no deadline: keep-alives notice a connection that is lost. Calls that look for every file of a scene have half an hour where
    /// others have a minute, which is the default.
    pub answer_within: Duration,
    /// What connects; `None`: TCP. Simulations have a network of their own.
    pub connector: Option<Connector>,
}

/// Makes the connection in the place of TCP.
#[derive(Clone)]
pub struct Connector(Arc<dyn Fn(&Endpoint) -> Channel + Send + Sync>);

impl Connector {
    /// `connect` makes a channel that dials when it is used first, as [`Endpoint::connect_with_connector_lazy`] does.
    pub fn new(connect: impl Fn(&Endpoint) -> Channel + Send + Sync + 'static) -> Self {
        Self(Arc::new(connect))
    }
}

impl fmt::Debug for Connector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Connector")
    }
}

impl PartialEq for Connector {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl Eq for Connector {}
/// A text that is never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

/// Why nobody can be called this way.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// An address that is none.
    #[error("{url:?} is no address of a coordinator ({message}); it looks like http://HOST:7420")]
    Url {
        /// What was given.
        url: String,
        /// What is wrong with it.
        message: String,
    },
    /// A file that cannot be used.
    #[error("{path}: {message}", path = path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A token that everybody on the way could read.
    #[error(
        "the token would be sent to {0} as plain text; give an https:// address, or --insecure where the way is safe by itself"
    )]
    PlainToken(String),
    /// A token with characters that no header has.
    #[error("the token has characters that it cannot have; it is one line, fathom_ID_SECRET")]
    Token,
    /// Nobody answers.
    #[error("{0}")]
    Connect(String),
}

impl Secret {
    /// A token as it stands in a file or in the environment.
    pub fn new(text: &str) -> Self {
        Self(text.trim().to_owned())
    }

    /// Reads a file that holds a token and nothing else.
    ///
    /// # Errors
    /// When it cannot be read or is empty.
    pub fn read(path: &Path) -> Result<Self, DialError> {
        let wrong = |message: String| DialError::File { path: path.to_owned(), message };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        if text.trim().is_empty() {
            return Err(wrong("it is empty; it should hold a token".to_owned()));
        }
        Ok(Self::new(&text))
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret")
    }
}

/// Puts the token and a deadline into every call.
#[derive(Clone, Debug)]
pub struct Credentials {
    token: Option<MetadataValue<Ascii>>,
    answer_within: Duration,
}

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", token.clone());
        }
        let method = request.extensions().get::<GrpcMethod>().map(|known| known.method()).unwrap_or_default();
        if !SENDS_FIRST.contains(&method) {
            let times = if LOOKS_AT_EVERY_FILE.contains(&method) { LONGER } else { 1 };
            request.set_timeout(self.answer_within * times);
        }
        Ok(request)
    }
}

impl Default for Dial {
    fn default() -> Self {
        Self::to("http://127.0.0.1:7420")
    }
}

impl Dial {
    /// In plain text, without a token; `http://` is added where no scheme stands.
    pub fn to(url: &str) -> Self {
        let url = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
        let answer_within = ANSWER_WITHIN;
        Self {
            url,
            tls_ca: None,
            tls_identity: None,
            token: None,
            insecure: false,
            answer_within,
            connector: None,
        }
    }

    /// A connection that dials when it is used first and again whenever it is lost.
    ///
    /// # Errors
    /// When the address or a file cannot be used, or the token would go out in plain text.
    pub fn lazily(&self) -> Result<Line, DialError> {
        let (endpoint, credentials) = self.prepare()?;
        let channel = match &self.connector {
            Some(Connector(connect)) => connect(&endpoint),
            None => endpoint.connect_lazy(),
        };
        Ok(InterceptedService::new(channel, credentials))
    }

    /// A connection that is there; with a connector of its own, one that dials when it is used first.
    ///
    /// # Errors
    /// As [`Dial::lazily`], and when nobody answers.
    pub async fn now(&self) -> Result<Line, DialError> {
        if self.connector.is_some() {
            return self.lazily();
        }
        let (endpoint, credentials) = self.prepare()?;
        let channel = endpoint.connect().await.map_err(|error| self.not_connected(&root_cause(&error)))?;
        Ok(InterceptedService::new(channel, credentials))
    }

    /// What the libraries say, and what helps where they do not.
    fn not_connected(&self, said: &str) -> DialError {
        let hint = if said.contains("UnknownIssuer") {
            "; say with --tls-ca FILE which authority to trust"
        } else if said.contains("NotValidForName") {
            "; its certificate is not for this name or address"
        } else if said.contains("http2 error") && self.url.starts_with("http://") {
            "; it may speak TLS, and its address then begins with https://"
        } else {
            ""
        };
        DialError::Connect(format!("{said}{hint}"))
    }

    fn prepare(&self) -> Result<(Endpoint, Credentials), DialError> {
        let wrong = |message: String| DialError::Url { url: self.url.clone(), message };
        let mut endpoint =
            Endpoint::from_shared(self.url.clone()).map_err(|error| wrong(root_cause(&error)))?;
        let is_tls = match endpoint.uri().scheme_str() {
            Some("https") => true,
            Some("http") => false,
            _ => return Err(wrong("it begins with http:// or https://".to_owned())),
        };
        let host = endpoint.uri().host().unwrap_or_default().to_owned();
        let is_here = host == "localhost"
            || host.trim_matches(['[', ']']).parse().is_ok_and(|ip: std::net::IpAddr| ip.is_loopback());
        if is_tls {
            let tls = self.tls()?;
            endpoint = endpoint.tls_config(tls).map_err(|error| wrong(root_cause(&error)))?;
        } else if self.token.is_some() && !is_here && !self.insecure {
            return Err(DialError::PlainToken(self.url.clone()));
        }
        let endpoint = endpoint
            .connect_timeout(CONNECT_WITHIN)
            .http2_keep_alive_interval(KEEPALIVE_EVERY)
            .keep_alive_timeout(KEEPALIVE_TIMEOUT)
            .keep_alive_while_idle(true)
            .tcp_nodelay(true);
        Ok((endpoint, self.credentials()?))
    }

    fn tls(&self) -> Result<ClientTlsConfig, DialError> {
        let read = |path: &Path| {
            let wrong = |message: String| DialError::File { path: path.to_owned(), message };
            let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
            if text.contains("-----BEGIN ") { Ok(text) } else { Err(wrong("it is no PEM file".to_owned())) }
        };
        let mut tls = match &self.tls_ca {
            Some(path) => ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read(path)?)),
            None => ClientTlsConfig::new().with_native_roots(),
        };
        if let Some((cert, key)) = &self.tls_identity {
            tls = tls.identity(Identity::from_pem(read(cert)?, read(key)?));
        }
        Ok(tls)
    }

    fn credentials(&self) -> Result<Credentials, DialError> {
        let answer_within = self.answer_within;
        let Some(Secret(token)) = &self.token else { return Ok(Credentials { token: None, answer_within }) };
        let mut value: MetadataValue<Ascii> =
            format!("Bearer {token}").parse().map_err(|_| DialError::Token)?;
        // Not printed by what prints headers, and not kept in the compression table of HTTP/2.
        value.set_sensitive(true);
        Ok(Credentials { token: Some(value), answer_within })
    }
}

/// The reason that the coordinator gave, such as "STALE_FENCE"; `None` when it was not the coordinator that spoke.
pub fn reason(status: &Status) -> Option<String> {
    let info = status.get_details_error_info()?;
    (info.domain == crate::ERROR_DOMAIN).then_some(info.reason)
}

/// What lies at the bottom of an error.
fn root_cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(next) = cause.source() {
        cause = next;
    }
    cause.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_token(url: &str) -> Dial {
        Dial { token: Some(Secret::new("fathom_a_b\n")), ..Dial::to(url) }
    }

    #[tokio::test]
    async fn a_token_never_leaves_the_machine_in_plain_text() {
        for (url, goes) in [
            ("http://127.0.0.1:1", true),
            ("localhost:1", true),
            ("http://[::1]:1", true),
            ("https://reef.example:1", true),
            ("http://reef.example:1", false),
            ("http://10.0.0.7:1", false),
            ("http://127.0.0.1.example:1", false),
        ] {
            let dialled = with_token(url).lazily();
            assert_eq!(dialled.is_ok(), goes, "{url}: {dialled:?}");
            assert!(goes || matches!(dialled, Err(DialError::PlainToken(_))), "{url}: {dialled:?}");
        }
        assert!(Dial { insecure: true, ..with_token("http://10.0.0.7:1") }.lazily().is_ok());
        assert!(Dial::to("http://10.0.0.7:1").lazily().is_ok(), "no token, no secret");
    }

    #[tokio::test]
    async fn a_token_is_in_every_call_and_in_no_text() {
        let dial = with_token("http://127.0.0.1:1");
        let Ok(mut credentials) = dial.credentials() else { panic!("no credentials") };
        let request = credentials.call(Request::new(())).unwrap_or_else(|status| panic!("{status}"));
        let value = request.metadata().get("authorization");
        assert_eq!(value.and_then(|value| value.to_str().ok()), Some("Bearer fathom_a_b"));
        for text in [format!("{dial:?}"), format!("{credentials:?}"), format!("{request:?}")] {
            assert!(!text.contains("fathom_a_b"), "{text}");
        }
        let odd = Dial { token: Some(Secret::new("a\u{0}b")), ..Dial::to("127.0.0.1:1") };
        assert!(matches!(odd.lazily(), Err(DialError::Token)));
    }

    #[tokio::test]
    async fn a_call_that_nobody_answers_ends_at_its_deadline_and_an_upload_has_none() {
        use crate::v1::{ListJobsRequest, WriteBlobRequest};
        // It takes connections, and says nothing.
        let Ok(mute) = tokio::net::TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
        let Ok(address) = mute.local_addr() else { panic!("no address") };
        let answer_within = Duration::from_millis(200);
        let dial = Dial { answer_within, ..Dial::to(&address.to_string()) };
        let Ok(line) = dial.lazily() else { panic!("no line") };
        let mut jobs = crate::v1::job_service_client::JobServiceClient::new(line.clone());
        let Err(status) = jobs.list_jobs(ListJobsRequest::default()).await else { panic!("an answer") };
        // So tonic calls it.
        assert_eq!((status.code(), status.message()), (tonic::Code::Cancelled, "Timeout expired"));

        let mut uploads = crate::v1::upload_service_client::UploadServiceClient::new(line);
        let upload = uploads.write_blob(futures::stream::iter([WriteBlobRequest::default()]));
        let waited = tokio::time::timeout(answer_within * 5, upload).await;
        assert!(waited.is_err(), "an upload was given up: {waited:?}");
    }

    #[tokio::test]
    async fn addresses_and_files_that_cannot_be_used_are_named() {
        for url in ["", "ftp://reef", "http://", "http://a b"] {
            let said = Dial::to(url).lazily().err().map(|error| error.to_string()).unwrap_or_default();
            assert!(said.contains("no address of a coordinator"), "{url:?}: {said}");
        }
        let missing = Dial { tls_ca: Some("/no/such.pem".into()), ..Dial::to("https://reef.example:1") };
        let said = missing.lazily().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(said.starts_with("/no/such.pem: "), "{said}");
    }
}
