//! The one error type of this crate's outside.

use std::path::PathBuf;

use fathom_proto::dial::reason;
use tonic::Status;

/// Why a worker does not start, or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkerError {
    /// The GPU cannot be used.
    #[error(transparent)]
    Core(#[from] fathom_core::CoreError),
    /// The coordinator cannot be called in this way.
    #[error(transparent)]
    Dial(#[from] fathom_proto::dial::DialError),
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
    /// One of several GPUs takes no more tasks.
    #[error("{worker}: {source}")]
    Gpu {
        /// Its name as a worker.
        worker: String,
        /// Why.
        source: Box<WorkerError>,
    },
    /// The work was stopped while waiting.
    #[error("stopped")]
    Stopped,
}

impl WorkerError {
    /// Whether the coordinator lacks a blob, or has another one in its place.
    pub(crate) fn is_loss_of_data(&self) -> bool {
        match self {
            Self::Damaged { .. } => true,
            Self::Refused(status) => {
                matches!(reason(status).as_deref(), Some("DIGEST_MISMATCH" | "BLOB_NOT_FOUND"))
            }
            _ => false,
        }
    }

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
