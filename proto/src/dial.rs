//! How a client reaches a coordinator: its addresses, TLS, and the client's token.

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

mod misdialled;
mod transport;

#[cfg(test)]
mod several_tests;

pub use transport::Transport;
use transport::{Address, Several};

/// Timeout of a connection attempt.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);
/// A half-open connection is detected after the sum of these; without keep-alives its streams would hang for
/// hours.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(20);
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// The same where there is another address to move to. A machine that dies silently then costs at most twice
/// this, so a worker renews its leases of a minute elsewhere before they expire.
const KEEPALIVE_OF_SEVERAL: Duration = Duration::from_secs(5);

/// Default timeout of a call; Claim, the call that waits longest, waits for half of it.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);
/// Calls that are answered only after the whole upload, which has no time limit.
const SENDS_FIRST: [&str; 1] = ["WriteBlob"];
/// Calls with a longer timeout, and its factor. They check every file of a scene on disk, up to two million,
/// read the whole store, or hash a file in a bucket.
const LOOKS_AT_EVERYTHING: [&str; 5] =
    ["BeginUpload", "CommitDataset", "CreateJob", "BackUpStore", "FinishWrite"];
const LONGER: u32 = 30;

/// A connection that adds the token and a deadline to every call.
pub type Connection = InterceptedService<Transport, Credentials>;

/// Addresses of a coordinator and connection settings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dial {
    /// `http://HOST:PORT`, or `https://` with TLS; several with commas between them. There is one connection
    /// at a time, to the first address that answers; when it is lost, the next address is tried first.
    pub url: String,
    /// Certificate authorities that verify the coordinator's certificate, PEM; `None`: those of the system.
    pub tls_ca: Option<PathBuf>,
    /// The client's own certificate and key, PEM.
    pub tls_identity: Option<(PathBuf, PathBuf)>,
    /// The token; `None` where none is required.
    pub token: Option<Secret>,
    /// Whether the token may be sent without TLS beyond this machine. Default false.
    pub insecure: bool,
    /// Timeout of a call, on both ends; for a stream, until its answer begins. The default is a minute, and
    /// half an hour for calls that check every file of a scene or read the whole store. Uploads have no
    /// deadline: keep-alives detect a lost connection.
    pub answer_within: Duration,
    /// The connector; `None`: TCP. Simulations use their own network.
    pub connector: Option<Connector>,
}

/// Makes the connection instead of TCP.
#[derive(Clone)]
pub struct Connector(Arc<dyn Fn(&Endpoint) -> Channel + Send + Sync>);

impl Connector {
    /// `connect` makes a channel that connects on first use, as [`Endpoint::connect_with_connector_lazy`]
    /// does.
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

/// A text that is never printed or logged.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

/// Why a coordinator cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// An invalid address.
    #[error("{url:?} is not a valid coordinator address ({message}); use the form http://HOST:7420")]
    Url {
        /// The text given.
        url: String,
        /// The fault.
        message: String,
    },
    /// A file that is unusable.
    #[error("{path}: {message}", path = path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// The fault of the file.
        message: String,
    },
    /// A token that would be readable on the network.
    #[error(
        "the token would be sent to {0} as plain text; use an https:// address, or --insecure if the network itself is secure"
    )]
    PlainToken(String),
    /// A token with characters that a header cannot have.
    #[error("the token has invalid characters; it is one line, fathom_ID_SECRET")]
    Token,
    /// The server there is not a coordinator, or expects another protocol: a sentence. Retrying does not
    /// help.
    #[error("{0}")]
    Misdialled(String),
    /// No server answers.
    #[error("{0}")]
    Connect(String),
}

impl Secret {
    /// A token as read from a file or the environment.
    pub fn new(text: &str) -> Self {
        Self(text.trim().to_owned())
    }

    /// Reads a file that contains a token and nothing else.
    ///
    /// # Errors
    /// When it cannot be read or is empty.
    pub fn read(path: &Path) -> Result<Self, DialError> {
        let wrong = |message: String| DialError::File { path: path.to_owned(), message };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(message_of_file(&error)))?;
        if text.trim().is_empty() {
            return Err(wrong("it is empty; it should contain a token".to_owned()));
        }
        Ok(Self::new(&text))
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret")
    }
}

/// Adds the token and a deadline to every call.
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
            let times = if LOOKS_AT_EVERYTHING.contains(&method) { LONGER } else { 1 };
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
    /// In plain text, without a token; `http://` is added where there is no scheme.
    pub fn to(url: &str) -> Self {
        let with_scheme =
            |one: &str| if one.contains("://") { one.to_owned() } else { format!("http://{one}") };
        let url = url.split(',').map(|one| with_scheme(one.trim())).collect::<Vec<_>>().join(",");
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

    /// A connection that is made on first use, and again whenever it is lost.
    ///
    /// # Errors
    /// When an address or a file cannot be used, or the token would be sent in plain text.
    pub fn lazily(&self) -> Result<Connection, DialError> {
        let (addresses, credentials) = self.prepare()?;
        let transport = match (addresses.as_slice(), &self.connector) {
            ([only], Some(Connector(connect))) => Transport::one(connect(&only.endpoint)),
            ([only], None) => Transport::one(only.endpoint.connect_lazy()),
            _ => Transport::several(Several::of(addresses, self.connector.clone())),
        };
        Ok(InterceptedService::new(transport, credentials))
    }

    /// An established connection; with a custom connector, one that is made on first use.
    ///
    /// # Errors
    /// As [`Dial::lazily`], and when no server answers.
    pub async fn now(&self) -> Result<Connection, DialError> {
        if self.connector.is_some() {
            return self.lazily();
        }
        let (addresses, credentials) = self.prepare()?;
        let transport = if let [only] = addresses.as_slice() {
            match only.endpoint.connect().await {
                Ok(channel) => Transport::one(channel),
                Err(error) => {
                    let said = root_cause(&error);
                    return Err(match self.fault_of_connecting(&said).await {
                        Some(error) => error,
                        None => DialError::Connect(said),
                    });
                }
            }
        } else {
            let several = Several::of(addresses, None);
            match several.connect().await {
                Ok(()) => Transport::several(several),
                Err(unanswered) => return Err(self.fault_of_each(unanswered).await),
            }
        };
        Ok(InterceptedService::new(transport, credentials))
    }

    /// The same for each address alone.
    fn each(&self) -> impl Iterator<Item = Self> {
        self.url.split(',').map(|url| Self { url: url.trim().to_owned(), ..self.clone() })
    }

    fn prepare(&self) -> Result<(Vec<Address>, Credentials), DialError> {
        let are_several = self.url.contains(',');
        let addresses: Vec<_> =
            self.each().map(|one| one.address(are_several)).collect::<Result<_, DialError>>()?;
        let scheme = |address: &Address| address.endpoint.uri().scheme().cloned();
        if addresses.windows(2).any(|pair| scheme(&pair[0]) != scheme(&pair[1])) {
            let message = "several addresses must all begin with http://, or all with https://".to_owned();
            return Err(DialError::Url { url: self.url.clone(), message });
        }
        Ok((addresses, self.credentials()?))
    }

    /// The only address, as one of several or not.
    fn address(&self, is_of_several: bool) -> Result<Address, DialError> {
        let wrong = |message: String| DialError::Url { url: self.url.clone(), message };
        let mut endpoint =
            Endpoint::from_shared(self.url.clone()).map_err(|error| wrong(root_cause(&error)))?;
        let is_tls = match endpoint.uri().scheme_str() {
            Some("https") => true,
            Some("http") => false,
            _ => return Err(wrong("it must begin with http:// or https://".to_owned())),
        };
        let host = endpoint.uri().host().unwrap_or_default().to_owned();
        let is_here = host == "localhost"
            || host.trim_matches(['[', ']']).parse().is_ok_and(|ip: std::net::IpAddr| ip.is_loopback());
        if is_tls {
            let tls = self.tls()?;
            endpoint = endpoint.tls_config(tls).map_err(|error| self.unusable(&root_cause(&error)))?;
        } else if self.token.is_some() && !is_here && !self.insecure {
            return Err(DialError::PlainToken(self.url.clone()));
        }
        let endpoint = if is_of_several {
            // The timeout of a connection attempt is that of `transport`.
            endpoint.http2_keep_alive_interval(KEEPALIVE_OF_SEVERAL).keep_alive_timeout(KEEPALIVE_OF_SEVERAL)
        } else {
            endpoint
                .connect_timeout(CONNECT_WITHIN)
                .http2_keep_alive_interval(KEEPALIVE_EVERY)
                .keep_alive_timeout(KEEPALIVE_TIMEOUT)
        };
        let endpoint = endpoint.keep_alive_while_idle(true).tcp_nodelay(true);
        Ok(Address { url: self.url.clone(), endpoint })
    }

    fn tls(&self) -> Result<ClientTlsConfig, DialError> {
        let read = |path: &Path| {
            let wrong = |message: String| DialError::File { path: path.to_owned(), message };
            let text = std::fs::read_to_string(path).map_err(|error| wrong(message_of_file(&error)))?;
            if text.contains("-----BEGIN ") {
                Ok(text)
            } else {
                Err(wrong("it is not a PEM file".to_owned()))
            }
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
        // Not printed with headers, and not kept in the compression table of HTTP/2.
        value.set_sensitive(true);
        Ok(Credentials { token: Some(value), answer_within })
    }
}

/// The reason that the coordinator gave, such as "STALE_FENCE"; `None` when the error is not from the
/// coordinator.
pub fn reason(status: &Status) -> Option<String> {
    let info = status.get_details_error_info()?;
    (info.domain == crate::ERROR_DOMAIN).then_some(info.reason)
}

/// The error message of a failed call: the coordinator's sentence, or the root cause of a failed connection.
/// "transport error" alone does not help.
pub fn cause(status: &Status) -> String {
    let said = status.message();
    match std::error::Error::source(status) {
        Some(source) if reason(status).is_none() => {
            let deepest = root_cause(source);
            if said.contains(&deepest) { said.to_owned() } else { format!("{said}: {deepest}") }
        }
        _ => said.to_owned(),
    }
}

/// The system's error text for a file, without its number.
fn message_of_file(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "no such file".to_owned(),
        std::io::ErrorKind::PermissionDenied => "this user may not read it".to_owned(),
        _ => error.to_string(),
    }
}

/// The root cause of an error.
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
    async fn an_unanswered_call_times_out_and_an_upload_does_not() {
        use crate::v1::{ListJobsRequest, WriteBlobRequest};
        // It accepts connections, and sends nothing.
        let Ok(mute) = tokio::net::TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
        let Ok(address) = mute.local_addr() else { panic!("no address") };
        let answer_within = Duration::from_millis(200);
        let dial = Dial { answer_within, ..Dial::to(&address.to_string()) };
        let Ok(connection) = dial.lazily() else { panic!("no connection") };
        let mut jobs = crate::v1::job_service_client::JobServiceClient::new(connection.clone());
        let Err(status) = jobs.list_jobs(ListJobsRequest::default()).await else { panic!("an answer") };
        // tonic's name for it.
        assert_eq!((status.code(), status.message()), (tonic::Code::Cancelled, "Timeout expired"));

        let mut uploads = crate::v1::upload_service_client::UploadServiceClient::new(connection);
        let upload = uploads.write_blob(futures::stream::iter([WriteBlobRequest::default()]));
        let waited = tokio::time::timeout(answer_within * 5, upload).await;
        assert!(waited.is_err(), "an upload was given up: {waited:?}");
    }

    #[tokio::test]
    async fn addresses_and_files_that_cannot_be_used_are_named() {
        for url in ["", "ftp://reef", "http://", "http://a b"] {
            let said = Dial::to(url).lazily().err().map(|error| error.to_string()).unwrap_or_default();
            assert!(said.contains("is not a valid coordinator address"), "{url:?}: {said}");
        }
        let missing = Dial { tls_ca: Some("/no/such.pem".into()), ..Dial::to("https://reef.example:1") };
        let said = missing.lazily().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(said.starts_with("/no/such.pem: "), "{said}");
    }
}
