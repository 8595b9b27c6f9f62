//! How a client reaches a coordinator: its address, TLS, and the client's token.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{GrpcMethod, Request, Status};
use tonic_types::StatusExt;

use crate::v1::GetJobRequest;
use crate::v1::job_service_client::JobServiceClient;

/// Timeout of a connection attempt.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);
/// A half-open connection is detected after the sum of these; without keep-alives its streams would hang for
/// hours.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(20);
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// Default timeout of a call; Claim, the call that waits longest, waits for half of it.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);
/// Timeout of each probe of an address; there are two.
const PROBE_WITHIN: Duration = Duration::from_millis(900);
/// First bytes of an HTTP/2 client: the preface, and empty settings.
const HTTP2_BEGINS: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
/// A request that every HTTP/1 server answers.
const HTTP1_ASKS: &[u8] = b"GET / HTTP/1.0\r\n\r\n";
/// First bytes of a TLS server's answer to a plain-text client: an alert.
const TLS_ALERT: &[u8] = &[0x15, 0x03];

/// Calls that are answered only after the whole upload, which has no time limit.
const SENDS_FIRST: [&str; 1] = ["WriteBlob"];
/// Calls with a longer timeout, and its factor. They check every file of a scene on disk, up to two million,
/// or read the whole store.
const LOOKS_AT_EVERYTHING: [&str; 4] = ["BeginUpload", "CommitDataset", "CreateJob", "BackUpStore"];
const LONGER: u32 = 30;

/// A connection that adds the token and a deadline to every call.
pub type Connection = InterceptedService<Channel, Credentials>;

/// Address of a coordinator and connection settings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dial {
    /// `http://HOST:PORT`, or `https://` with TLS.
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
    /// In plain text, without a token; `http://` is added if there is no scheme.
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

    /// A connection that is made on first use, and again whenever it is lost.
    ///
    /// # Errors
    /// When the address or a file cannot be used, or the token would be sent in plain text.
    pub fn lazily(&self) -> Result<Connection, DialError> {
        let (endpoint, credentials) = self.prepare()?;
        let channel = match &self.connector {
            Some(Connector(connect)) => connect(&endpoint),
            None => endpoint.connect_lazy(),
        };
        Ok(InterceptedService::new(channel, credentials))
    }

    /// An established connection; with a custom connector, one that is made on first use.
    ///
    /// # Errors
    /// As [`Dial::lazily`], and when no server answers.
    pub async fn now(&self) -> Result<Connection, DialError> {
        if self.connector.is_some() {
            return self.lazily();
        }
        let (endpoint, credentials) = self.prepare()?;
        match endpoint.connect().await {
            Ok(channel) => Ok(InterceptedService::new(channel, credentials)),
            Err(error) => {
                let said = root_cause(&error);
                Err(match self.other_protocol().await.or_else(|| self.fault_of_tls(&said)) {
                    Some(error) => error,
                    None => DialError::Connect(said),
                })
            }
        }
    }

    /// The reason why a call that failed with `status` will always fail: the server speaks another protocol,
    /// or refuses our certificate. `None` where the coordinator itself refused the call, or where a retry may
    /// help.
    pub async fn misdialled(&self, status: &Status) -> Option<DialError> {
        if reason(status).is_some() || self.connector.is_some() {
            return None;
        }
        match self.fault_of_tls(&cause(status)) {
            Some(error) => Some(error),
            None if self.url.starts_with("http://") => self.other_protocol().await,
            None if self.tls_identity.is_some() => self.not_trusted().await,
            None => None,
        }
    }

    /// Whether the coordinator closes every connection once it has our certificate. In TLS 1.3 the client has
    /// finished its handshake by then, so the alert with the reason may be lost. An unreachable coordinator
    /// never gets that far.
    async fn not_trusted(&self) -> Option<DialError> {
        for _ in 0..3 {
            let (endpoint, credentials) = self.prepare().ok()?;
            let channel = tokio::time::timeout(PROBE_WITHIN, endpoint.connect()).await.ok()?.ok()?;
            let mut jobs = JobServiceClient::new(InterceptedService::new(channel, credentials));
            let asked =
                tokio::time::timeout(PROBE_WITHIN, jobs.get_job(GetJobRequest::default())).await.ok()?;
            let Err(status) = asked else { return None };
            // A server that answers with a status has accepted our certificate.
            if reason(&status).is_some() || std::error::Error::source(&status).is_none() {
                return None;
            }
            if let Some(error) = self.fault_of_tls(&cause(&status)) {
                return Some(error);
            }
        }
        Some(DialError::Misdialled(self.refused_certificate("it closes every connection")))
    }

    fn refused_certificate(&self, said: &str) -> String {
        format!(
            "the coordinator at {} refused the certificate of --tls-cert: it accepts those that the authority in its --client-ca \
             has signed ({said})",
            self.url
        )
    }

    /// Probes which protocol an `http://` address speaks. Only positive evidence counts: a silent server may
    /// be a coordinator.
    async fn other_protocol(&self) -> Option<DialError> {
        let rest = self.url.strip_prefix("http://")?;
        let host = rest.split(['/', '?']).next().unwrap_or_default();
        let has_port = host.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        let address = if has_port { host.to_owned() } else { format!("{host}:80") };
        // An HTTP/1 server closes the connection on an HTTP/2 preface, often silently.
        for begin in [HTTP2_BEGINS, HTTP1_ASKS] {
            let answer = tokio::time::timeout(PROBE_WITHIN, answer_to(&address, begin)).await.ok()?.ok()?;
            let text = String::from_utf8_lossy(&answer);
            // Some servers answer in text that they expect TLS.
            if answer.starts_with(TLS_ALERT) || (text.starts_with("HTTP/1.") && text.contains("HTTPS")) {
                return Some(DialError::Misdialled(format!("{} speaks TLS: use https://{rest}", self.url)));
            }
            if text.starts_with("HTTP/1.") {
                return Some(DialError::Misdialled(format!(
                    "{} answers HTTP/1, so it is not the coordinator; is it the metrics address?",
                    self.url
                )));
            }
            if !answer.is_empty() {
                return None;
            }
        }
        None
    }

    /// A sentence for an error of the TLS library. Certificates do not change by themselves, so a retry never
    /// helps.
    fn fault_of_tls(&self, said: &str) -> Option<DialError> {
        let has = |word: &str| said.contains(word);
        let url = &self.url;
        let fault = if has("InvalidContentType") || has("corrupt message") {
            let rest = url.strip_prefix("https://").unwrap_or(url);
            format!("{url} does not speak TLS; if it is the coordinator, use http://{rest}")
        } else if has("received fatal alert") {
            if has("CertificateRequired") || has("certificate required") {
                format!(
                    "the coordinator at {url} requires a certificate: pass --tls-cert FILE and --tls-key FILE ({said})"
                )
            } else if self.tls_identity.is_some() {
                self.refused_certificate(said)
            } else {
                return None;
            }
        } else if has("UnknownIssuer") {
            format!(
                "the certificate of {url} is signed by an unknown authority; pass --tls-ca FILE with the authority to \
                 trust ({said})"
            )
        } else if has("NotValidForName") || has("not valid for name") {
            format!(
                "the certificate of {url} is not for this name or address; connect with one that it lists ({said})"
            )
        } else if has("CaUsedAsEndEntity") {
            format!(
                "the certificate of {url} is that of an authority, which a server cannot use; make one with the extension \
                 basicConstraints=CA:FALSE ({said})"
            )
        } else if has("certificate expired") || has("Expired") {
            format!("the certificate of {url} has expired; make a new one ({said})")
        } else if has("not valid yet") || has("NotValidYet") {
            format!("the certificate of {url} is not valid yet; check the clocks of both machines ({said})")
        } else if has("UnsupportedCertVersion") {
            format!("the certificate of {url} is an X.509 v1 certificate; make a v3 one ({said})")
        } else if has("invalid peer certificate") {
            format!("the certificate of {url} cannot be used ({said})")
        } else {
            return None;
        };
        Some(DialError::Misdialled(fault))
    }

    fn prepare(&self) -> Result<(Endpoint, Credentials), DialError> {
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
        let endpoint = endpoint
            .connect_timeout(CONNECT_WITHIN)
            .http2_keep_alive_interval(KEEPALIVE_EVERY)
            .keep_alive_timeout(KEEPALIVE_TIMEOUT)
            .keep_alive_while_idle(true)
            .tcp_nodelay(true);
        Ok((endpoint, self.credentials()?))
    }

    /// The fault of our own certificates.
    fn unusable(&self, said: &str) -> DialError {
        let fault = match &self.tls_identity {
            Some((cert, _)) if said.contains("UnsupportedCertVersion") => {
                format!("--tls-cert {} is an X.509 v1 certificate; make a v3 one", cert.display())
            }
            Some((cert, key)) => {
                let (cert, key) = (cert.display(), key.display());
                format!("--tls-cert {cert} and --tls-key {key}, or --tls-ca, cannot be used ({said})")
            }
            None => format!("--tls-ca cannot be used ({said})"),
        };
        DialError::Misdialled(fault)
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

/// The first bytes that an address answers to `begin`; empty where it closes silently.
async fn answer_to(address: &str, begin: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(begin).await?;
    let mut answer = vec![0; 512];
    let bytes = match stream.read(&mut answer).await {
        Ok(bytes) => bytes,
        // A server that closes before it has read everything gives this error too.
        Err(error) if error.kind() == std::io::ErrorKind::ConnectionReset => 0,
        Err(error) => return Err(error),
    };
    answer.truncate(bytes);
    Ok(answer)
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

    /// An address that answers each connection that begins with `begin` with `answer`, and closes every
    /// connection.
    async fn server_answering(begin: &'static [u8], answer: &'static [u8]) -> String {
        let Ok(listener) = tokio::net::TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
        let Ok(address) = listener.local_addr() else { panic!("no address") };
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                let mut heard = vec![0; 1024];
                let bytes = stream.read(&mut heard).await.unwrap_or_default();
                if heard[..bytes].starts_with(begin) {
                    // If the client is gone, the test fails anyway.
                    let _ = stream.write_all(answer).await;
                }
            }
        });
        format!("http://{address}")
    }

    #[tokio::test]
    async fn other_servers_differ_from_an_absent_coordinator() {
        let alert: &[u8] = &[0x15, 3, 3, 0, 2, 2, 10];
        let settings: &[u8] = &[0, 0, 0, 4, 0, 0, 0, 0, 0];
        let broken = Status::unknown("h2 protocol error");
        for (begin, answer, says) in [
            (&b""[..], alert, Some("speaks TLS: use https://127.0.0.1:")),
            (
                b"GET ",
                b"HTTP/1.1 400 The plain HTTP request was sent to HTTPS port\r\n\r\n",
                Some("speaks TLS"),
            ),
            (b"GET ", b"HTTP/1.1 404 Not Found\r\n\r\n", Some("is it the metrics address?")),
            (
                b"PRI ",
                b"HTTP/1.1 400 Bad Request\r\n\r\n",
                Some("answers HTTP/1, so it is not the coordinator"),
            ),
            (b"PRI ", settings, None),
            (b"nobody", b"", None),
        ] {
            let dial = Dial::to(&server_answering(begin, answer).await);
            let error = dial.misdialled(&broken).await.map(|error| error.to_string());
            match says {
                Some(words) => {
                    assert!(
                        error.as_ref().is_some_and(|error| error.contains(words)),
                        "{error:?}, not {words}"
                    )
                }
                None => assert!(error.is_none(), "{error:?}"),
            }
        }
        assert!(Dial::to("http://127.0.0.1:1").misdialled(&broken).await.is_none(), "no server is there");
    }

    #[tokio::test]
    async fn a_silent_server_does_not_delay_a_client() {
        let Ok(mute) = tokio::net::TcpListener::bind("127.0.0.1:0").await else { panic!("no port") };
        let Ok(address) = mute.local_addr() else { panic!("no address") };
        let begin = std::time::Instant::now();
        let dial = Dial::to(&address.to_string());
        assert!(dial.misdialled(&Status::unknown("h2 protocol error")).await.is_none());
        assert!(begin.elapsed() < 2 * PROBE_WITHIN + Duration::from_millis(200), "{:?}", begin.elapsed());
    }

    #[test]
    fn refused_certificates_are_reported_in_sentences() {
        let with_own = Dial {
            tls_identity: Some(("w.pem".into(), "w.key".into())),
            ..Dial::to("https://reef.example:1")
        };
        for (said, says) in [
            ("invalid peer certificate: UnknownIssuer", "--tls-ca FILE"),
            (
                "invalid peer certificate: certificate not valid for name; NotValidForName",
                "is not for this name",
            ),
            ("invalid peer certificate: Other(OtherError(CaUsedAsEndEntity))", "basicConstraints=CA:FALSE"),
            ("invalid peer certificate: certificate not valid for name \"a\"", "is not for this name"),
            ("received fatal alert: UnknownCA", "refused the certificate of --tls-cert"),
            ("received fatal alert: CertificateRequired", "requires a certificate"),
            ("received corrupt message of type InvalidContentType", "does not speak TLS"),
        ] {
            let error = with_own.fault_of_tls(said).map(|error| error.to_string()).unwrap_or_default();
            assert!(error.contains(says), "{error}");
        }
        assert!(with_own.fault_of_tls("Connection refused (os error 111)").is_none());
        let v1 = with_own.unusable("invalid certificate: UnsupportedCertVersion").to_string();
        assert_eq!(v1, "--tls-cert w.pem is an X.509 v1 certificate; make a v3 one");
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
