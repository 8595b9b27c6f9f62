//! TLS of the coordinator, by rustls.

use std::path::Path;

use tonic::transport::{Certificate, Identity, ServerTlsConfig};

use crate::config::CoordinatorConfig;
use crate::error::CoordinatorError;

/// What the server shows and whom it believes; `None` for plain text.
///
/// # Errors
/// When a file cannot be read, or holds nothing of what it should.
pub fn server_tls(config: &CoordinatorConfig) -> Result<Option<ServerTlsConfig>, CoordinatorError> {
    let (Some(cert), Some(key)) = (&config.tls_cert, &config.tls_key) else { return Ok(None) };
    let (cert, key) = (read_pem(cert, "CERTIFICATE")?, read_pem(key, "PRIVATE KEY")?);
    let mut tls = ServerTlsConfig::new().identity(Identity::from_pem(cert, key));
    if let Some(authority) = &config.client_ca {
        let authority = Certificate::from_pem(read_pem(authority, "CERTIFICATE")?);
        // People come with tokens; that workers show one is for the guard to ask.
        tls = tls.client_ca_root(authority).client_auth_optional(true);
    }
    Ok(Some(tls))
}

/// A PEM file, if it has a section of that kind: what TLS says of another file helps nobody.
fn read_pem(path: &Path, kind: &str) -> Result<String, CoordinatorError> {
    let wrong = |message: String| CoordinatorError::Config(format!("{}: {message}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let begins =
        |line: &str| line.starts_with("-----BEGIN ") && line.trim_end().ends_with(&format!("{kind}-----"));
    if text.lines().any(begins) {
        Ok(text)
    } else {
        Err(wrong(format!("it has no section \"BEGIN {kind}\"; give a PEM file")))
    }
}
