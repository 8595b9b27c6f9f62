//! The one place where errors become gRPC statuses. Every status carries `google.rpc.ErrorInfo` with the
//! domain "fathom" and a reason; clients decide by the reason, people read the message.

use std::collections::HashMap;
use std::time::Duration;

use fathom_proto::ERROR_DOMAIN;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::objects::ObjectError;
use crate::schedule::{ParseIdError, Refusal};
use crate::store::StoreError;

/// Why a call is not answered.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// A field that cannot be used.
    #[error("{field}: {message}")]
    BadArgument {
        /// Which.
        field: &'static str,
        /// What is wrong, and what helps.
        message: String,
    },
    /// A worker that did not register with this process.
    #[error("this worker is not registered; register again with the leases that it holds")]
    UnknownWorker,
    /// A worker that nobody knows.
    #[error("there is no worker {0}; it has not called for long, or its process has ended")]
    NoSuchWorker(String),
    /// A worker of another protocol.
    #[error(
        "the worker speaks protocol {worker}, this coordinator {coordinator}; use programs of one version"
    )]
    ProtocolVersion {
        /// The worker's.
        worker: u32,
        /// Ours.
        coordinator: u32,
    },
    /// A call that refers to a blob that is not there.
    #[error("blob {digest} has not been uploaded; upload it and call again")]
    BlobMissing {
        /// Which.
        digest: String,
    },
    /// The store's answer.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The object store's answer.
    #[error(transparent)]
    Object(#[from] ObjectError),
}

impl From<ParseIdError> for ServiceError {
    fn from(error: ParseIdError) -> Self {
        let field = if error.what == "job" { "job_id" } else { "task_id" };
        Self::BadArgument { field, message: error.to_string() }
    }
}

/// How long a client should wait before it repeats a call that failed for a passing reason.
const RETRY_AFTER: Duration = Duration::from_secs(1);

impl From<ServiceError> for Status {
    fn from(error: ServiceError) -> Self {
        let message = error.to_string();
        let mut metadata = HashMap::new();
        let (code, reason) = match &error {
            ServiceError::BadArgument { .. } => (Code::InvalidArgument, "BAD_ARGUMENT"),
            ServiceError::UnknownWorker | ServiceError::NoSuchWorker(_) => (Code::NotFound, "UNKNOWN_WORKER"),
            ServiceError::ProtocolVersion { .. } => (Code::FailedPrecondition, "PROTOCOL_VERSION"),
            ServiceError::BlobMissing { .. } => (Code::FailedPrecondition, "BLOB_NOT_FOUND"),
            ServiceError::Store(error) => match error {
                StoreError::JobNotFound(_) => (Code::NotFound, "JOB_NOT_FOUND"),
                StoreError::RequestIdReused { .. } => (Code::AlreadyExists, "REQUEST_ID_REUSED"),
                StoreError::Refused(refusal) => match refusal {
                    Refusal::StaleFence { .. } => (Code::FailedPrecondition, "STALE_FENCE"),
                    Refusal::JobEnded => (Code::FailedPrecondition, "JOB_ENDED"),
                    Refusal::JobPaused => (Code::Aborted, "JOB_PAUSED"),
                    Refusal::AtItsLimit(_) => (Code::Aborted, "JOB_AT_ITS_LIMIT"),
                    Refusal::NotFailed(_) => (Code::FailedPrecondition, "JOB_NOT_FAILED"),
                    Refusal::NotEnded => (Code::FailedPrecondition, "JOB_NOT_ENDED"),
                    Refusal::NoSuchTask(_) => (Code::NotFound, "TASK_NOT_FOUND"),
                    Refusal::NotReady(_) | Refusal::Unfit(_) => (Code::Aborted, "TASK_NOT_READY"),
                    Refusal::OtherResult(_) => (Code::AlreadyExists, "OTHER_RESULT"),
                    Refusal::WrongOutput(_) => (Code::InvalidArgument, "BAD_ARGUMENT"),
                },
                StoreError::Corrupt { .. } | StoreError::NewerLayout { .. } => {
                    (Code::DataLoss, "STORE_DAMAGED")
                }
                StoreError::RowTooLarge { .. } => (Code::InvalidArgument, "ROW_TOO_LARGE"),
                StoreError::Unwritable { .. } => (Code::Internal, "ROW_UNWRITABLE"),
                StoreError::NotEmpty => (Code::FailedPrecondition, "STORE_NOT_EMPTY"),
                StoreError::InUse { .. } | StoreError::Failed(_) => (Code::Unavailable, "STORE_FAILED"),
            },
            ServiceError::Object(error) => match error {
                ObjectError::BadDigest(_) => (Code::InvalidArgument, "BAD_ARGUMENT"),
                ObjectError::NotFound(_) => (Code::NotFound, "BLOB_NOT_FOUND"),
                ObjectError::WrongOffset { committed_bytes, .. } => {
                    metadata.insert("committed_size_bytes".into(), committed_bytes.to_string());
                    (Code::OutOfRange, "WRONG_OFFSET")
                }
                ObjectError::DigestMismatch { .. } | ObjectError::Damaged(_) => {
                    (Code::DataLoss, "DIGEST_MISMATCH")
                }
                ObjectError::Busy(_) => (Code::Aborted, "WRITE_IN_PROGRESS"),
                ObjectError::LowSpace { .. } => (Code::ResourceExhausted, "LOW_DISK_SPACE"),
                ObjectError::Io { .. } | ObjectError::Store(_) => (Code::Unavailable, "STORE_FAILED"),
            },
        };
        let mut details = ErrorDetails::with_error_info(reason, ERROR_DOMAIN, metadata);
        if matches!(code, Code::Unavailable | Code::Aborted | Code::ResourceExhausted) {
            details.set_retry_info(Some(RETRY_AFTER));
        }
        if let ServiceError::BadArgument { field, message } = &error {
            details.add_bad_request_violation(*field, message);
        }
        Status::with_error_details(code, message, details)
    }
}
