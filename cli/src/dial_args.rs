//! The flags of every client for its connection to a coordinator.

use std::path::PathBuf;

use clap::Args;
use fathom_proto::dial::{Dial, DialError, Secret};
use serde::{Deserialize, Serialize};

use crate::error::{CliError, Result};

/// The token itself, for users who cannot give a file. Not a flag, because other users of the machine see
/// flags.
const TOKEN_VARIABLE: &str = "FATHOM_TOKEN";

/// Help lists these flags under this heading, after the verb's own flags.
pub const HEADING: &str = "Connection";

/// TLS and the token.
#[derive(Args, Clone, Debug, Default, Serialize, Deserialize)]
pub struct DialArgs {
    /// File with the token for a coordinator that requires one; FATHOM_TOKEN can hold the token itself
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TOKEN_FILE")]
    pub token_file: Option<PathBuf>,
    /// CA certificates to check the coordinator's certificate against, PEM [default: those of the system]
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_CA")]
    pub tls_ca: Option<PathBuf>,
    /// Client certificate for a coordinator that requires one, PEM; needs --tls-key
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_CERT")]
    pub tls_cert: Option<PathBuf>,
    /// Private key of --tls-cert, PEM
    #[arg(long, value_name = "FILE", help_heading = HEADING, env = "FATHOM_TLS_KEY")]
    pub tls_key: Option<PathBuf>,
    /// Send the token to other machines even without TLS; only for networks that are already secure
    #[arg(long, help_heading = HEADING)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub insecure: bool,
}

impl DialArgs {
    /// Connection settings for `url`.
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

/// Explains a missing token and names the flag or variable that set its path.
fn no_token(error: DialError) -> CliError {
    CliError::Message(match error {
        DialError::File { path, message } => format!(
            "cannot read the token file {} (--token-file or FATHOM_TOKEN_FILE): {message}",
            path.display()
        ),
        other => other.to_string(),
    })
}
