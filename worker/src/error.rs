//! The one error type of this crate's outside.

use std::path::PathBuf;

use tonic::Status;

/// Why a worker does not start, or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkerError {
    /// The GPU cannot be used.
    #[error(transparent)]
    Core(#[from] fathom_core::CoreError),
    /// The coordinator's address cannot be one.
    #[error("{url:?} is no address of a coordinator ({message}); it looks like http://HOST:7420")]
    Url {
        /// What was given.
        url: String,
        /// What is wrong with it.
        message: String,
    },
    /// The address for metrics cannot be taken.
    #[error("cannot serve metrics on {listen}: {source}; choose another port or stop what uses it")]
    Listen {
        /// The address.
        listen: std::net::SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file of the cache or of a download.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The coordinator said no, and would again.
    #[error("the coordinator refuses: {}", .0.message())]
    Refused(Box<Status>),
    /// A blob that arrived is not what its digest says.
    #[error("blob {digest} arrived damaged: {message}")]
    Damaged {
        /// Which.
        digest: String,
        /// What is wrong.
        message: String,
    },
    /// A message that cannot be read.
    #[error("the coordinator sent {0}")]
    Protocol(String),
    /// A thread ended by itself.
    #[error("a thread of the worker failed: {0}")]
    Thread(String),
    /// The work was stopped while waiting.
    #[error("stopped")]
    Stopped,
}

impl WorkerError {
    pub(crate) fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }
}

impl From<Status> for WorkerError {
    fn from(status: Status) -> Self {
        Self::Refused(Box::new(status))
    }
}
