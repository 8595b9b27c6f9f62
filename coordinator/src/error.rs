//! The public error type of this crate.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::logs::LogError;
use crate::objects::ObjectError;
use crate::store::StoreError;
use crate::store::export::ExportError;

/// Why a coordinator did not start, or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoordinatorError {
    /// Configuration values out of their range.
    #[error("configuration: {0}")]
    Config(String),
    /// The address cannot be taken.
    #[error("cannot listen on {listen}: {source}; choose another port or stop the program that uses it")]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The data directory cannot be made.
    #[error("cannot make the data directory {path}: {source}", path = path.display())]
    DataDir {
        /// Its path.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The store cannot be opened, or failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An export cannot be written or read.
    #[error(transparent)]
    Export(#[from] ExportError),
    /// An operation on a data directory failed.
    #[error("{0}")]
    Maintenance(String),
    /// The object store cannot be opened.
    #[error(transparent)]
    Objects(#[from] ObjectError),
    /// Logs cannot be read or written.
    #[error(transparent)]
    Logs(#[from] LogError),
    /// The server failed.
    #[error("gRPC server: {0}")]
    Server(String),
}
