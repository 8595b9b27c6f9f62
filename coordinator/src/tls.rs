//! TLS of the coordinator, by rustls, with files that may change while it runs.
//!
//! Certificates end after months or days, and whoever renews them cannot know when a job may be disturbed. So the files are looked at
//! every few seconds. What they hold is what the next handshake uses; connections that are open stay as they are. tonic's own TLS has
//! one identity for good, hence the handshakes here.
//!
//! A file may be half written, and the certificate is there before its key: a change counts once two looks in a row have found the
//! same. Files that cannot be used are told once, and what was in use stays.

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
use crate::seldom::Seldom;

/// The files are looked at so often. What has changed is in use after two looks.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// What gRPC is spoken over.
const HTTP2: &[u8] = b"h2";

/// What the server shows and whom it believes, as the files had it last.
pub struct Tls {
    files: Files,
    /// What the files held when it started.
    first: Pems,
    in_use: RwLock<Arc<ServerConfig>>,
    /// Handshakes that failed.
    failed: Seldom,
}

impl Tls {
    /// That of a configuration; `None` for plain text.
    ///
    /// # Errors
    /// When a file cannot be read, or holds nothing of what it should.
    pub fn read(config: &CoordinatorConfig) -> Result<Option<Arc<Self>>, CoordinatorError> {
        let (Some(cert), Some(key)) = (&config.tls_cert, &config.tls_key) else { return Ok(None) };
        let files = Files { cert: cert.clone(), key: key.clone(), client_ca: config.client_ca.clone() };
        let first = files.read().map_err(CoordinatorError::Config)?;
        let in_use = RwLock::new(first.server_config().map_err(CoordinatorError::Config)?);
        Ok(Some(Arc::new(Self { files, first, in_use, failed: Seldom::default() })))
    }

    /// Looks at the files as long as it runs, and takes what they hold.
    pub async fn watch(self: Arc<Self>) {
        let mut changes = Changes { judged: Ok(self.first.clone()), seen: Ok(self.first.clone()) };
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let (tls, before) = (Arc::clone(&self), changes.seen.clone().ok());
            let look = tokio::task::spawn_blocking(move || tls.files.read_again(before.as_ref()));
            // It is not run when the process ends.
            let Ok(found) = look.await else { continue };
            let Some(changed) = changes.found(found) else { continue };
            match changed.and_then(|pems| pems.server_config()) {
                Ok(config) => {
                    *self.in_use.write().unwrap_or_else(PoisonError::into_inner) = config;
                    tracing::info!(cert = %self.files.cert.display(), "the certificates were read again");
                }
                Err(error) => {
                    tracing::warn!(%error, "the certificates have changed and cannot be used; those before stay in use")
                }
            }
        }
    }

    /// The same connections over TLS, in the order in which their handshakes are done. What fails in one ends that one alone.
    ///
    /// Handshakes have no time limit of their own and no bound: a connection is a stranger's until it has made a call, which
    /// [`crate::connections`] limits in time and number, and reading one that was ended fails.
    pub fn over<C, I>(self: Arc<Self>, incoming: I) -> impl Stream<Item = io::Result<TlsStream<C>>> + Send
    where
        C: AsyncRead + AsyncWrite + Unpin + Send + 'static,
        I: Stream<Item = io::Result<C>> + Send + 'static,
    {
        let begin = (Box::pin(incoming.fuse()), JoinSet::new());
        futures::stream::unfold((self, begin), |(tls, (mut incoming, mut handshakes))| async move {
            loop {
                // Either branch may be dropped half-way: neither loses a connection by it.
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
                        Err(error) => tracing::warn!(%error, "a TLS handshake was broken off"),
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

/// Where everything lies.
struct Files {
    cert: PathBuf,
    key: PathBuf,
    client_ca: Option<PathBuf>,
}

/// What the files hold.
#[derive(Clone, PartialEq, Eq)]
struct Pems {
    cert: String,
    key: String,
    client_ca: Option<String>,
}

impl Files {
    fn read(&self) -> Result<Pems, String> {
        Ok(Pems {
            cert: read_pem(&self.cert, "CERTIFICATE")?,
            key: read_pem(&self.key, "PRIVATE KEY")?,
            client_ca: self.client_ca.as_deref().map(|path| read_pem(path, "CERTIFICATE")).transpose()?,
        })
    }

    /// The same once more, of files alone: a pipe that a shell made (`--tls-key <(...)`) has nothing to say twice.
    fn read_again(&self, before: Option<&Pems>) -> Result<Pems, String> {
        let is_pipe = |path: &Path| path.metadata().is_ok_and(|found| !found.is_file());
        let mut paths = [Some(&self.cert), Some(&self.key), self.client_ca.as_ref()].into_iter().flatten();
        match before {
            Some(before) if paths.any(|path| is_pipe(path)) => Ok(before.clone()),
            _ => self.read(),
        }
    }
}

/// A PEM file, if it has a section of that kind: what TLS says of another file helps nobody.
fn read_pem(path: &Path, kind: &str) -> Result<String, String> {
    let wrong = |message: String| format!("{}: {message}", path.display());
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let begins =
        |line: &str| line.starts_with("-----BEGIN ") && line.trim_end().ends_with(&format!("{kind}-----"));
    if text.lines().any(begins) {
        Ok(text)
    } else {
        Err(wrong(format!("it has no section \"BEGIN {kind}\"; give a PEM file")))
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
                // People come with tokens; that workers show a certificate is for the guard to ask.
                let verifier = verifier.allow_unauthenticated().build().map_err(|error| wrong(&error))?;
                builder.with_client_cert_verifier(verifier)
            }
        };
        let config = builder.with_single_cert(certificates(&self.cert)?, key);
        let mut config = config.map_err(|error| wrong(&error))?;
        config.alpn_protocols.push(HTTP2.to_vec());
        Ok(Arc::new(config))
    }
}

/// What looks at the files found.
struct Changes {
    /// What was taken or told last.
    judged: Result<Pems, String>,
    /// What the last look found.
    seen: Result<Pems, String>,
}

impl Changes {
    /// A change, once two looks in a row have found it.
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
        Ok(Pems { cert: text.to_owned(), key: String::new(), client_ca: None })
    }

    #[test]
    fn a_change_counts_once_when_two_looks_in_a_row_have_found_it() {
        let mut changes = Changes { judged: pems("a"), seen: pems("a") };
        let broken = || Err("it cannot be read".to_owned());
        let mut found = |found: Result<Pems, String>| changes.found(found.clone()) == Some(found);
        assert!(!found(pems("a")), "nothing has changed");
        assert!(!found(pems("half of b")) && !found(pems("b")) && found(pems("b")) && !found(pems("b")));
        assert!(!found(broken()) && found(broken()) && !found(broken()));
        assert!(!found(pems("b")) && found(pems("b")), "b was mended");
        assert!(!found(broken()) && !found(pems("b")) && !found(pems("b")), "nobody need know");
    }
}
