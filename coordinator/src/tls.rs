//! TLS of the coordinator with rustls, with files that may change while it runs.
//!
//! Certificates expire after days or months, and their renewal must not disturb a job. So the files are
//! checked every few seconds. The next handshake uses their content; open connections stay as they are.
//! tonic's own TLS has a fixed identity, hence the handshakes here.
//!
//! A file may be half written, and the certificate may change before its key. So a change counts once two
//! checks in a row have found the same content. Unusable files are reported once, and the previous ones stay
//! in use.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use futures::{Stream, StreamExt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use tokio_rustls::server::TlsStream;

use crate::config::CoordinatorConfig;
use crate::error::CoordinatorError;
use crate::rate_limited_log::RateLimitedLog;

/// Interval of the checks. A change is in use after two checks.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// The ALPN protocols: gRPC is HTTP/2, and many clients of the HTTP interface speak HTTP/1.1 only.
const HTTP2: &[u8] = b"h2";
const HTTP1: &[u8] = b"http/1.1";

/// The server's identity and trusted authorities, from the latest valid files.
pub struct Tls {
    files: Files,
    /// Content of the files at the start.
    first: Pems,
    in_use: RwLock<Arc<ServerConfig>>,
    /// Handshakes that failed.
    failed: RateLimitedLog,
}

impl Tls {
    /// The TLS of a configuration; `None` for plain text.
    ///
    /// # Errors
    /// When a file cannot be read, or lacks its content.
    pub fn read(config: &CoordinatorConfig) -> Result<Option<Arc<Self>>, CoordinatorError> {
        let clients = Clients { ca: config.client_ca.clone(), ..Clients::default() };
        Self::of(config, clients)
    }

    /// The TLS of the scaler's address, where every client must present a certificate; `None` for plain text.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn of_scaler(config: &CoordinatorConfig) -> Result<Option<Arc<Self>>, CoordinatorError> {
        let Some(ca) = config.scaler_client_ca.clone() else { return Ok(None) };
        Self::of(config, Clients { ca: Some(ca), all_present_certificates: true, ..Clients::default() })
    }

    /// The same identity for the HTTP interface. It asks for no certificates: a browser would ask its user
    /// which one to show. The files are not read again, because a pipe can be read only once.
    ///
    /// # Errors
    /// When the content is unusable.
    pub fn for_web(&self) -> Result<Arc<Self>, CoordinatorError> {
        let clients = Clients { speak_http1: true, ..Clients::default() };
        let files = Files { cert: self.files.cert.clone(), key: self.files.key.clone(), clients };
        let first = Pems {
            client_ca: None,
            all_present_certificates: false,
            speak_http1: true,
            ..self.first.clone()
        };
        let in_use = RwLock::new(first.server_config().map_err(CoordinatorError::Config)?);
        Ok(Arc::new(Self { files, first, in_use, failed: RateLimitedLog::default() }))
    }

    fn of(config: &CoordinatorConfig, clients: Clients) -> Result<Option<Arc<Self>>, CoordinatorError> {
        let (Some(cert), Some(key)) = (&config.tls_cert, &config.tls_key) else { return Ok(None) };
        let files = Files { cert: cert.clone(), key: key.clone(), clients };
        let first = files.read().map_err(CoordinatorError::Config)?;
        let in_use = RwLock::new(first.server_config().map_err(CoordinatorError::Config)?);
        Ok(Some(Arc::new(Self { files, first, in_use, failed: RateLimitedLog::default() })))
    }

    /// Checks the files as long as it runs, and applies changes.
    pub async fn watch(self: Arc<Self>) {
        let mut changes = Changes { judged: Ok(self.first.clone()), seen: Ok(self.first.clone()) };
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let (tls, before) = (Arc::clone(&self), changes.seen.clone().ok());
            let look = tokio::task::spawn_blocking(move || tls.files.read_again(before.as_ref()));
            // Not called when the process ends.
            let Ok(found) = look.await else { continue };
            let Some(changed) = changes.found(found) else { continue };
            match changed.and_then(|pems| pems.server_config()) {
                Ok(config) => {
                    *self.in_use.write().unwrap_or_else(PoisonError::into_inner) = config;
                    tracing::info!(cert = %self.files.cert.display(), "reloaded the certificates");
                }
                Err(error) => {
                    tracing::warn!(%error, "the changed certificates are unusable; the previous ones stay in use")
                }
            }
        }
    }

    /// The same connections over TLS, in the order in which their handshakes complete. A failure ends only
    /// its own connection.
    ///
    /// Handshakes have no time limit or bound of their own. A connection counts as unauthenticated until it
    /// has made a call; [`crate::connections`] limits those in time and number, and reading an ended one
    /// fails.
    pub fn over<C, I>(self: Arc<Self>, incoming: I) -> impl Stream<Item = io::Result<TlsStream<C>>> + Send
    where
        C: AsyncRead + AsyncWrite + Unpin + Send + 'static,
        I: Stream<Item = io::Result<C>> + Send + 'static,
    {
        let begin = (Box::pin(incoming.fuse()), JoinSet::new());
        futures::stream::unfold((self, begin), |(tls, (mut incoming, mut handshakes))| async move {
            loop {
                // Either branch may be dropped half-way; neither loses a connection then.
                tokio::select! {
                    Some(accepted) = incoming.next() => match accepted {
                        Ok(io) => {
                            let acceptor = tls.acceptor();
                            handshakes.spawn(async move { acceptor.accept(io).await });
                        }
                        Err(error) => return Some((Err(error), (tls, (incoming, handshakes)))),
                    },
                    Some(done) = handshakes.join_next() => match done {
                        Ok(Ok(io)) => return Some((Ok(io), (tls, (incoming, handshakes)))),
                        Ok(Err(error)) => {
                            tracing::debug!(%error, "a TLS handshake failed");
                            if let Some(handshakes) = tls.failed.count() {
                                tracing::warn!(handshakes, last = %error, "TLS handshakes failed");
                            }
                        }
                        Err(error) => tracing::warn!(%error, "a TLS handshake was aborted"),
                    },
                    else => return None,
                }
            }
        })
    }

    fn acceptor(&self) -> TlsAcceptor {
        Arc::clone(&self.in_use.read().unwrap_or_else(PoisonError::into_inner)).into()
    }
}

/// Paths of the files.
struct Files {
    cert: PathBuf,
    key: PathBuf,
    clients: Clients,
}

/// Who connects.
#[derive(Default)]
struct Clients {
    /// Whose certificates count.
    ca: Option<PathBuf>,
    /// Whether a client without a certificate is refused in the handshake.
    all_present_certificates: bool,
    /// Whether they may speak HTTP/1.1.
    speak_http1: bool,
}

/// Content of the files.
#[derive(Clone, PartialEq, Eq)]
struct Pems {
    cert: String,
    key: String,
    client_ca: Option<String>,
    all_present_certificates: bool,
    speak_http1: bool,
}

impl Files {
    fn read(&self) -> Result<Pems, String> {
        Ok(Pems {
            cert: read_pem(&self.cert, "CERTIFICATE")?,
            key: read_pem(&self.key, "PRIVATE KEY")?,
            client_ca: self.clients.ca.as_deref().map(|path| read_pem(path, "CERTIFICATE")).transpose()?,
            all_present_certificates: self.clients.all_present_certificates,
            speak_http1: self.clients.speak_http1,
        })
    }

    /// Rereads regular files only: a shell's pipe (`--tls-key <(...)`) can be read only once.
    fn read_again(&self, before: Option<&Pems>) -> Result<Pems, String> {
        let is_pipe = |path: &Path| path.metadata().is_ok_and(|found| !found.is_file());
        let mut paths = [Some(&self.cert), Some(&self.key), self.clients.ca.as_ref()].into_iter().flatten();
        match before {
            Some(before) if paths.any(|path| is_pipe(path)) => Ok(before.clone()),
            _ => self.read(),
        }
    }
}

/// A PEM file, if it has a section of that kind: the TLS library's error for another file would not help.
fn read_pem(path: &Path, kind: &str) -> Result<String, String> {
    let wrong = |message: String| format!("{}: {message}", path.display());
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let begins =
        |line: &str| line.starts_with("-----BEGIN ") && line.trim_end().ends_with(&format!("{kind}-----"));
    if text.lines().any(begins) {
        Ok(text)
    } else {
        Err(wrong(format!("it has no section \"BEGIN {kind}\"; use a PEM file")))
    }
}

impl Pems {
    fn server_config(&self) -> Result<Arc<ServerConfig>, String> {
        let wrong = |error: &dyn std::error::Error| format!("TLS: {error}");
        let certificates = |text: &str| {
            let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(text.as_bytes()).collect();
            found.map_err(|error| wrong(&error))
        };
        let key = PrivateKeyDer::from_pem_slice(self.key.as_bytes()).map_err(|error| wrong(&error))?;
        let provider = Arc::new(ring::default_provider());
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider));
        let builder = builder.with_safe_default_protocol_versions().map_err(|error| wrong(&error))?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(authorities) => {
                let mut roots = RootCertStore::empty();
                roots.add_parsable_certificates(certificates(authorities)?);
                let verifier = WebPkiClientVerifier::builder_with_provider(roots.into(), provider);
                // Users authenticate with tokens; the guard requires the certificates of workers.
                let verifier = match self.all_present_certificates {
                    true => verifier,
                    false => verifier.allow_unauthenticated(),
                };
                builder.with_client_cert_verifier(verifier.build().map_err(|error| wrong(&error))?)
            }
        };
        let config = builder.with_single_cert(certificates(&self.cert)?, key);
        let mut config = config.map_err(|error| wrong(&error))?;
        config.alpn_protocols.push(HTTP2.to_vec());
        if self.speak_http1 {
            config.alpn_protocols.push(HTTP1.to_vec());
        }
        Ok(Arc::new(config))
    }
}

/// Detects changes of the files.
struct Changes {
    /// The state last applied or reported.
    judged: Result<Pems, String>,
    /// The result of the last check.
    seen: Result<Pems, String>,
}

impl Changes {
    /// A change, once two checks in a row have found it.
    fn found(&mut self, found: Result<Pems, String>) -> Option<Result<Pems, String>> {
        let is_settled = found == self.seen;
        self.seen = found;
        if !is_settled || self.seen == self.judged {
            return None;
        }
        self.judged = self.seen.clone();
        Some(self.seen.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pems(text: &str) -> Result<Pems, String> {
        let none = Pems {
            cert: text.to_owned(),
            key: String::new(),
            client_ca: None,
            all_present_certificates: false,
            speak_http1: false,
        };
        Ok(none)
    }

    #[test]
    fn a_change_counts_once_two_checks_in_a_row_found_it() {
        let mut changes = Changes { judged: pems("a"), seen: pems("a") };
        let broken = || Err("it cannot be read".to_owned());
        let mut found = |found: Result<Pems, String>| changes.found(found.clone()) == Some(found);
        assert!(!found(pems("a")), "nothing has changed");
        assert!(!found(pems("half of b")) && !found(pems("b")) && found(pems("b")) && !found(pems("b")));
        assert!(!found(broken()) && found(broken()) && !found(broken()));
        assert!(!found(pems("b")) && found(pems("b")), "b was repaired");
        assert!(!found(broken()) && !found(pems("b")) && !found(pems("b")), "nothing to report");
    }
}
