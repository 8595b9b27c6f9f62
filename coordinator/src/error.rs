//! The one error type of this crate's outside.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::objects::ObjectError;
use crate::store::StoreError;
use crate::store::dump::DumpError;

/// Why a coordinator does not start, or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoordinatorError {
    /// Configuration values out of their range.
    #[error("configuration: {0}")]
    Config(String),
    /// The address cannot be taken.
    #[error("cannot listen on {listen}: {source}; choose another port or stop what uses it")]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The data directory cannot be made.
    #[error("cannot make the data directory {path}: {source}", path = path.display())]
    DataDir {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The store cannot be opened, or failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An export cannot be written or read.
    #[error(transparent)]
    Dump(#[from] DumpError),
    /// What was asked of a data directory cannot be done.
    #[error("{0}")]
    Maintenance(String),
    /// The object store cannot be opened.
    #[error(transparent)]
    Objects(#[from] ObjectError),
    /// The server failed.
    #[error("gRPC server: {0}")]
    Server(String),
}
