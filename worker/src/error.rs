//! The public error type of this crate.

use std::path::PathBuf;

use fathom_proto::dial::reason;
use tonic::Status;

/// The reason why a worker does not start, or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkerError {
    /// The GPU cannot be used.
    #[error(transparent)]
    Core(#[from] fathom_core::CoreError),
    /// The connection settings are invalid.
    #[error(transparent)]
    Dial(#[from] fathom_proto::dial::DialError),
    /// The address for metrics cannot be bound.
    #[error(
        "cannot serve metrics on {listen}: {source}; choose another port, or stop the program that uses \
        it"
    )]
    Listen {
        /// The address.
        listen: std::net::SocketAddr,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file of the cache or of a download.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The coordinator refused for good; a retry would not help.
    #[error("the coordinator refuses: {}", .0.message())]
    Refused(Box<Status>),
    /// A transfer with the coordinator's bucket failed.
    #[error(transparent)]
    Bucket(#[from] fathom_proto::direct::DirectError),
    /// A received blob does not match its digest.
    #[error("blob {digest} arrived damaged: {message}")]
    Damaged {
        /// Digest of the blob.
        digest: String,
        /// Description of the fault.
        message: String,
    },
    /// A message that cannot be read.
    #[error("the coordinator sent {0}")]
    Protocol(String),
    /// A thread ended unexpectedly.
    #[error("a thread of the worker failed: {0}")]
    Thread(String),
    /// One of several GPUs stopped taking tasks.
    #[error("{worker}: {source}")]
    Gpu {
        /// Its name as a worker.
        worker: String,
        /// Why.
        source: Box<WorkerError>,
    },
    /// The work was stopped during a wait.
    #[error("stopped")]
    Stopped,
}

impl WorkerError {
    /// Whether the coordinator lacks a blob, or has a different one in its place.
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
