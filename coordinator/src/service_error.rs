//! The one place where errors become gRPC statuses. Every status carries `google.rpc.ErrorInfo` with the
//! domain "fathom" and a reason; clients decide by the reason, people read the message.

use std::collections::HashMap;
use std::time::Duration;

use fathom_proto::ERROR_DOMAIN;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::access::{IssueError, Refused, Role};
use crate::datasets::FileFault;
use crate::objects::ObjectError;
use crate::schedule::{ParseIdError, Refusal, Tenant};
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
    /// Files that cannot be in a dataset.
    #[error("{}", first_of(.0))]
    BadFiles(Vec<FileFault>),
    /// A dataset or a manifest some of whose files have not been sent.
    #[error(
        "missing blobs of the {of}: {count}, among them that of {name:?} ({digest}); upload them and call again"
    )]
    FilesMissing {
        /// "dataset" or "manifest".
        of: &'static str,
        /// How many.
        count: u64,
        /// One of the files.
        name: String,
        /// Its digest.
        digest: String,
    },
    /// A worker that did not register with this process.
    #[error("this worker is not registered; register again with the leases that it holds")]
    UnknownWorker,
    /// A worker that another token has registered.
    #[error("another worker has registered under this incarnation; choose a new UUID in every process")]
    OtherWorker,
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
    /// A caller without a token that holds.
    #[error(transparent)]
    Token(#[from] Refused),
    /// A caller whose role is another.
    #[error(
        "this token has the role {role}{of}; {need}; ask an operator for another one",
        of = if *of_tenant && *role == Role::Operator { " of a tenant" } else { "" },
    )]
    RoleRefused {
        /// The token's.
        role: Role,
        /// Which role what was called needs.
        need: String,
        /// Whether it is of one tenant.
        of_tenant: bool,
    },
    /// A worker without a certificate.
    #[error(
        "this coordinator takes only workers that show a certificate: start the worker with --tls-cert FILE and --tls-key FILE"
    )]
    NoCertificate,
    /// A tenant that calls too often.
    #[error("the tenant calls too often; wait {} ms", .0.as_millis().max(1))]
    TooManyCalls(Duration),
    /// A token that nobody knows.
    #[error("there is no token {0}; `fathom token list` shows them")]
    NoSuchToken(String),
    /// The only token that makes others.
    #[error(
        "token {0} is the last one of an operator of all tenants; issue another one first, or revoke it with --last: new \
         ones are then made with `fathom token issue --data-dir DIR` while the coordinator is stopped"
    )]
    LastOperator(String),
    /// A tenant whose photographs and results take as much as they may.
    #[error(
        "{tenant} may have {limit_bytes} bytes and has {used_bytes}; delete jobs that are not needed, or ask an operator for more"
    )]
    TooManyBytes {
        /// Which.
        tenant: Tenant,
        /// What it has.
        used_bytes: u64,
        /// What it may have.
        limit_bytes: u64,
    },
    /// What the door says of a request while it comes.
    #[error("{}", .0.message())]
    Door(Box<Status>),
    /// The store's answer.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The object store's answer.
    #[error(transparent)]
    Object(#[from] ObjectError),
}

impl From<IssueError> for ServiceError {
    fn from(IssueError { field, message }: IssueError) -> Self {
        Self::BadArgument { field, message }
    }
}

impl From<ParseIdError> for ServiceError {
    fn from(error: ParseIdError) -> Self {
        let field = match error.what {
            "job" => "job_id",
            "tenant" => "tenant",
            "dataset" => "dataset_id",
            "role" => "role",
            _ => "task_id",
        };
        let hint = match error.what {
            "dataset" => "; it has 1 to 64 lower-case letters, digits, -, _ and ., a letter or a digit first",
            _ => "",
        };
        Self::BadArgument { field, message: format!("{error}{hint}") }
    }
}

/// The first fault, and how many others there are.
fn first_of(faults: &[FileFault]) -> String {
    let others = faults.len().saturating_sub(1);
    let first =
        faults.first().map(|FileFault { index, of, message }| format!("files[{index}].{of}: {message}"));
    let first = first.unwrap_or_default();
    if others == 0 { first } else { format!("{first}, and {others} more") }
}

/// Refuses an id that a call cannot have: empty, too long, or with control characters, which keep ids of different tenants apart.
///
/// # Errors
/// When it is one.
pub fn check_request_id(request_id: &str) -> Result<(), ServiceError> {
    limit_of("request_id", request_id, MAX_REQUEST_ID_BYTES)?;
    let fault = if request_id.is_empty() {
        "is missing; choose a UUID and repeat it when the call is repeated"
    } else if request_id.contains(char::is_control) {
        "has control characters; choose a UUID"
    } else {
        return Ok(());
    };
    Err(ServiceError::BadArgument { field: "request_id", message: fault.into() })
}

/// Longest request id, bytes.
const MAX_REQUEST_ID_BYTES: usize = 128;

/// Refuses a text that others read on one line of a terminal or a log: one that is too long, or has control characters, with which
/// it could rewrite their screen or look like a line of its own.
///
/// # Errors
/// When it is one, with the name of its field.
pub fn check_line(field: &'static str, text: &str, max_bytes: usize) -> Result<(), ServiceError> {
    limit_of(field, text, max_bytes)?;
    match text.chars().find(|c| c.is_control()) {
        Some(found) => {
            let message = format!("has the control character U+{:04X}; leave it out", u32::from(found));
            Err(ServiceError::BadArgument { field, message })
        }
        None => Ok(()),
    }
}

/// Refuses a text that is too long.
///
/// # Errors
/// When it is, with the name of its field.
pub fn limit_of(field: &'static str, text: &str, max_bytes: usize) -> Result<(), ServiceError> {
    if text.len() <= max_bytes {
        return Ok(());
    }
    let message = format!("has {} bytes, at most {max_bytes} are allowed", text.len());
    Err(ServiceError::BadArgument { field, message })
}

/// How long a client should wait before it repeats a call that failed for a passing reason.
const RETRY_AFTER: Duration = Duration::from_secs(1);

impl From<ServiceError> for Status {
    fn from(error: ServiceError) -> Self {
        let error = match error {
            ServiceError::Door(status) => return *status,
            error => error,
        };
        let mut message = error.to_string();
        let mut metadata = HashMap::new();
        let (code, reason) = match &error {
            ServiceError::BadArgument { .. } | ServiceError::BadFiles(_) => {
                (Code::InvalidArgument, "BAD_ARGUMENT")
            }
            // Given back above.
            ServiceError::Door(status) => (status.code(), "BAD_ARGUMENT"),
            ServiceError::UnknownWorker | ServiceError::NoSuchWorker(_) => (Code::NotFound, "UNKNOWN_WORKER"),
            ServiceError::OtherWorker => (Code::PermissionDenied, "OTHER_WORKER"),
            ServiceError::ProtocolVersion { .. } => (Code::FailedPrecondition, "PROTOCOL_VERSION"),
            ServiceError::BlobMissing { .. } | ServiceError::FilesMissing { .. } => {
                (Code::FailedPrecondition, "BLOB_NOT_FOUND")
            }
            ServiceError::Token(Refused::Missing) => (Code::Unauthenticated, "TOKEN_MISSING"),
            ServiceError::Token(Refused::NotValid) => (Code::Unauthenticated, "TOKEN_REFUSED"),
            ServiceError::RoleRefused { .. } => (Code::PermissionDenied, "ROLE_REFUSED"),
            ServiceError::NoCertificate => (Code::Unauthenticated, "CERTIFICATE_MISSING"),
            ServiceError::TooManyCalls(_) => (Code::ResourceExhausted, "RATE_LIMITED"),
            ServiceError::NoSuchToken(_) => (Code::NotFound, "TOKEN_NOT_FOUND"),
            ServiceError::LastOperator(_) => (Code::FailedPrecondition, "LAST_OPERATOR"),
            ServiceError::TooManyBytes { .. } => (Code::ResourceExhausted, "QUOTA_SPENT"),
            ServiceError::Store(error) => match error {
                StoreError::JobNotFound(_) => (Code::NotFound, "JOB_NOT_FOUND"),
                StoreError::RequestIdReused { .. } => (Code::AlreadyExists, "REQUEST_ID_REUSED"),
                StoreError::TooManyJobs { .. } | StoreError::TooManyDatasets(_) => {
                    (Code::ResourceExhausted, "QUOTA_SPENT")
                }
                StoreError::DatasetNotFound(_) => (Code::NotFound, "DATASET_NOT_FOUND"),
                StoreError::DatasetExists(_) => (Code::AlreadyExists, "DATASET_EXISTS"),
                StoreError::DatasetNotCommitted(_) => (Code::FailedPrecondition, "DATASET_NOT_COMMITTED"),
                StoreError::DatasetInUse { .. } => (Code::FailedPrecondition, "DATASET_IN_USE"),
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
                StoreError::Corrupt { .. } | StoreError::OtherLayout { .. } => {
                    (Code::DataLoss, "STORE_DAMAGED")
                }
                StoreError::RowTooLarge { .. } => (Code::InvalidArgument, "ROW_TOO_LARGE"),
                StoreError::Unwritable { .. } => (Code::Internal, "ROW_UNWRITABLE"),
                StoreError::NotEmpty => (Code::FailedPrecondition, "STORE_NOT_EMPTY"),
                StoreError::InUse { .. } | StoreError::NoCopy { .. } | StoreError::Failed(_) => {
                    (Code::Unavailable, "STORE_FAILED")
                }
            },
            ServiceError::Object(error) => match error {
                ObjectError::BadDigest(_) => (Code::InvalidArgument, "BAD_ARGUMENT"),
                ObjectError::TooLarge { .. } => (Code::InvalidArgument, "BLOB_TOO_LARGE"),
                ObjectError::NotFound(_) => (Code::NotFound, "BLOB_NOT_FOUND"),
                ObjectError::WrongOffset { committed_bytes, .. } => {
                    metadata.insert("committed_size_bytes".into(), committed_bytes.to_string());
                    (Code::OutOfRange, "WRONG_OFFSET")
                }
                ObjectError::DigestMismatch { .. } | ObjectError::Damaged(_) => {
                    (Code::DataLoss, "DIGEST_MISMATCH")
                }
                ObjectError::Busy(_) => (Code::Aborted, "WRITE_IN_PROGRESS"),
                ObjectError::OverLimit { .. } => (Code::ResourceExhausted, "QUOTA_SPENT"),
                ObjectError::LowSpace { .. } => (Code::ResourceExhausted, "LOW_DISK_SPACE"),
                ObjectError::Io { .. } | ObjectError::Store(_) => {
                    // The paths of this machine are of no use to others, and nobody's business.
                    tracing::warn!(%error, "a blob cannot be read or written");
                    if error.is_full() {
                        message = "the coordinator's disk is full; free some of it".into();
                        (Code::ResourceExhausted, "LOW_DISK_SPACE")
                    } else {
                        message = "the coordinator cannot read or write its files; its log says why".into();
                        (Code::Unavailable, "STORE_FAILED")
                    }
                }
            },
        };
        let mut details = ErrorDetails::with_error_info(reason, ERROR_DOMAIN, metadata);
        if matches!(code, Code::Unavailable | Code::Aborted | Code::ResourceExhausted) {
            let pause = match &error {
                ServiceError::TooManyCalls(pause) => (*pause).max(Duration::from_millis(10)),
                _ => RETRY_AFTER,
            };
            details.set_retry_info(Some(pause));
        }
        match &error {
            ServiceError::BadArgument { field, message } => {
                details.add_bad_request_violation(*field, message);
            }
            ServiceError::BadFiles(faults) => {
                for FileFault { index, of, message } in faults {
                    details.add_bad_request_violation(format!("files[{index}].{of}"), message);
                }
            }
            _ => {}
        }
        Status::with_error_details(code, message, details)
    }
}
