//! The flags by which every client says how it reaches a coordinator.

use std::path::PathBuf;

use clap::Args;
use fathom_proto::dial::{Dial, DialError, Secret};

use crate::error::{CliError, Result};

/// A token itself, for those who cannot give a file. Not a flag: other users of a machine see flags.
const TOKEN_VARIABLE: &str = "FATHOM_TOKEN";

/// Where help has these flags: after those of the verb itself, of which there are more to know.
pub const HEADING: &str = "Connection";

/// TLS and the token.
#[derive(Args, Clone, Debug, Default)]
pub struct DialArgs {
    /// File that holds the token to show, where the coordinator asks for one; FATHOM_TOKEN may hold the token
    /// itself
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TOKEN_FILE")]
    pub token_file: Option<PathBuf>,
    /// Authorities that the coordinator's certificate is checked against, PEM [default: those of the system]
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_CA")]
    pub tls_ca: Option<PathBuf>,
    /// Own certificate, PEM, where the coordinator asks for one; with --tls-key
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_CERT")]
    pub tls_cert: Option<PathBuf>,
    /// Key of --tls-cert, PEM
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_KEY")]
    pub tls_key: Option<PathBuf>,
    /// Send the token even without TLS beyond this machine: where the way is safe by itself
    #[arg(long, help_heading = HEADING)]
    pub insecure: bool,
}

impl DialArgs {
    /// How `url` is called.
    pub fn dial(&self, url: &str) -> Result<Dial> {
        let tls_identity = match (&self.tls_cert, &self.tls_key) {
            (Some(cert), Some(key)) => Some((cert.clone(), key.clone())),
            (None, None) => None,
            _ => {
                let message = "--tls-cert and --tls-key go together: give both or neither";
                return Err(CliError::Message(message.to_owned()));
            }
        };
        let token = match &self.token_file {
            Some(path) => Some(Secret::read(path).map_err(no_token)?),
            None => std::env::var(TOKEN_VARIABLE)
                .ok()
                .filter(|text| !text.trim().is_empty())
                .map(|text| Secret::new(&text)),
        };
        let insecure = self.insecure;
        Ok(Dial { tls_ca: self.tls_ca.clone(), tls_identity, token, insecure, ..Dial::to(url) })
    }
}

/// Why there is no token, with what said where it should be.
fn no_token(error: DialError) -> CliError {
    CliError::Message(match error {
        DialError::File { path, message } => format!(
            "cannot read the token file {} (--token-file or FATHOM_TOKEN_FILE): {message}",
            path.display()
        ),
        other => other.to_string(),
    })
}
