//! Why an address does not lead to a coordinator: another protocol, or a certificate that one side refuses.

use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tonic::Status;
use tonic::service::interceptor::InterceptedService;

use super::transport::Unanswered;
use super::{Dial, DialError, cause, reason, root_cause};
use crate::v1::GetJobRequest;
use crate::v1::job_service_client::JobServiceClient;

/// Timeout of each probe of an address; there are two.
const PROBE_WITHIN: Duration = Duration::from_millis(900);
/// First bytes of an HTTP/2 client: the preface, and empty settings.
const HTTP2_BEGINS: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
/// A request that every HTTP/1 server answers.
const HTTP1_ASKS: &[u8] = b"GET / HTTP/1.0\r\n\r\n";
/// First bytes of a TLS server's answer to a plain-text client: an alert.
const TLS_ALERT: &[u8] = &[0x15, 0x03];

impl Dial {
    /// The reason why a call that failed with `status` will always fail: the server speaks another protocol,
    /// or refuses our certificate. `None` where the coordinator itself refused the call, or where a retry may
    /// help. With several addresses, the faults of all of them: a retry may reach any other.
    pub async fn misdialled(&self, status: &Status) -> Option<DialError> {
        if reason(status).is_some() || self.connector.is_some() {
            return None;
        }
        if self.url.contains(',') {
            let mut faults = Vec::new();
            for one in self.each() {
                faults.push(one.lasting_fault().await?);
            }
            return Some(all_of(faults));
        }
        match self.fault_of_tls(&cause(status)) {
            Some(error) => Some(error),
            None if self.url.starts_with("http://") => self.other_protocol().await,
            None if self.tls_identity.is_some() => self.not_trusted().await,
            None => None,
        }
    }

    /// Why a connection attempt that failed with `said` will always fail.
    pub(super) async fn fault_of_connecting(&self, said: &str) -> Option<DialError> {
        self.other_protocol().await.or_else(|| self.fault_of_tls(said))
    }

    /// The error for several addresses of which none answers.
    pub(super) async fn fault_of_each(&self, unanswered: Unanswered) -> DialError {
        let (mut reasons, mut faults, of) = (Vec::new(), Vec::new(), unanswered.0.len());
        for (url, said) in unanswered.0 {
            let one = Self { url, ..self.clone() };
            match one.fault_of_connecting(&said).await {
                Some(fault) => {
                    reasons.push((one.url, fault.to_string()));
                    faults.push(fault);
                }
                None => reasons.push((one.url, said)),
            }
        }
        if faults.len() == of && of > 0 {
            return all_of(faults);
        }
        DialError::Connect(Unanswered(reasons).to_string())
    }

    /// Why this one address will never lead to a coordinator, by an attempt; `None` where it may.
    async fn lasting_fault(&self) -> Option<DialError> {
        if self.url.starts_with("http://") {
            return self.other_protocol().await;
        }
        let endpoint = self.prepare().ok()?.0.pop()?.endpoint;
        match tokio::time::timeout(PROBE_WITHIN, endpoint.connect()).await.ok()? {
            Ok(_) => self.not_trusted().await,
            Err(error) => self.fault_of_tls(&root_cause(&error)),
        }
    }

    /// Whether the coordinator closes every connection once it has our certificate. In TLS 1.3 the client has
    /// finished its handshake by then, so the alert with the reason may be lost. An unreachable coordinator
    /// never gets that far.
    async fn not_trusted(&self) -> Option<DialError> {
        for _ in 0..3 {
            let (mut addresses, credentials) = self.prepare().ok()?;
            let endpoint = addresses.pop()?.endpoint;
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
        let refused = || DialError::Misdialled(self.refused_certificate("it closes every connection"));
        self.tls_identity.is_some().then(refused)
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
    pub(super) async fn other_protocol(&self) -> Option<DialError> {
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
    pub(super) fn fault_of_tls(&self, said: &str) -> Option<DialError> {
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

    /// The fault of our own certificates.
    pub(super) fn unusable(&self, said: &str) -> DialError {
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
}

/// One error for the faults of all addresses.
fn all_of(faults: Vec<DialError>) -> DialError {
    let said: Vec<_> = faults.iter().map(ToString::to_string).collect();
    DialError::Misdialled(said.join("; "))
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

#[cfg(test)]
mod tests {
    use super::*;

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
}
