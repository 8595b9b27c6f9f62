//! The one place where errors become gRPC statuses. Every status carries `google.rpc.ErrorInfo` with the
//! domain "fathom" and a reason; clients decide by the reason; the message is for users.

use std::collections::HashMap;
use std::time::Duration;

use fathom_proto::ERROR_DOMAIN;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::access::{IssueError, Refused, Role};
use crate::datasets::FileFault;
use crate::logs::LogError;
use crate::objects::ObjectError;
use crate::schedule::{ParseIdError, Refusal, Tenant};
use crate::store::StoreError;

/// Why a call fails.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// An invalid field.
    #[error("{field}: {message}")]
    BadArgument {
        /// Its name.
        field: &'static str,
        /// The fault, and a remedy.
        message: String,
    },
    /// Files that a dataset cannot have.
    #[error("{}", first_of(.0))]
    BadFiles(Vec<FileFault>),
    /// A dataset or a manifest some of whose files have not been sent.
    #[error(
        "missing blobs of the {of}: {count}, among them that of {name:?} ({digest}); upload them and call again"
    )]
    FilesMissing {
        /// "dataset" or "manifest".
        of: &'static str,
        /// Number of missing blobs.
        count: u64,
        /// One of the files.
        name: String,
        /// Its digest.
        digest: String,
    },
    /// A dataset that no job can train on.
    #[error("{0}")]
    BadScene(String),
    /// Scenes in other datasets are being read.
    #[error("the coordinator is reading the scenes of other datasets; try again in a minute")]
    ReadsOtherScenes,
    /// A worker that did not register with this process.
    #[error("this worker is not registered; register again with the leases that it holds")]
    UnknownWorker,
    /// A worker that another token has registered.
    #[error("another worker has registered under this incarnation; choose a new UUID in every process")]
    OtherWorker,
    /// An unknown worker.
    #[error("there is no worker {0}; it has not called recently, or its process has ended")]
    NoSuchWorker(String),
    /// A worker with another protocol version.
    #[error(
        "the worker speaks protocol {worker}, this coordinator {coordinator}; use programs of one version"
    )]
    ProtocolVersion {
        /// The worker's.
        worker: u32,
        /// Ours.
        coordinator: u32,
    },
    /// A call that references a missing blob.
    #[error("blob {digest} has not been uploaded; upload it and call again")]
    BlobMissing {
        /// Its digest.
        digest: String,
    },
    /// A caller without a valid token.
    #[error(transparent)]
    Token(#[from] Refused),
    /// A caller with another role.
    #[error(
        "this token has the role {role}{of}; {need}; ask an operator for another one",
        of = if *of_tenant && *role == Role::Operator { " of a tenant" } else { "" },
    )]
    RoleRefused {
        /// The token's.
        role: Role,
        /// The role that the call needs.
        need: String,
        /// Whether it belongs to one tenant.
        of_tenant: bool,
    },
    /// The guest of a link, with a call that links may not make.
    #[error("this token is that of a link: it reads one job, and nothing else")]
    OfLink,
    /// A worker without a certificate.
    #[error(
        "this coordinator accepts only workers with a certificate: start the worker with --tls-cert FILE and --tls-key FILE"
    )]
    NoCertificate,
    /// A tenant that calls too often.
    #[error("the tenant calls too often; wait {} ms", .0.as_millis().max(1))]
    TooManyCalls(Duration),
    /// An unknown token.
    #[error("there is no token {0}; `fathom token list` lists all tokens")]
    NoSuchToken(String),
    /// The last token that can issue others.
    #[error(
        "token {0} is the last one of an operator of all tenants; issue another one first, or revoke it with --last: new \
         ones are then made with `fathom token issue --data-dir DIR` while the coordinator is stopped"
    )]
    LastOperator(String),
    /// A tenant that makes too many links.
    #[error(
        "{tenant} has made {most} links in a day, the most that it may; wait a day, or ask an operator for the token of \
         a viewer"
    )]
    TooManyLinks {
        /// The tenant.
        tenant: Tenant,
        /// Links in a day.
        most: usize,
    },
    /// A tenant that has reached its limit of bytes.
    #[error(
        "{tenant} uses {used_bytes} of {limit_bytes} bytes; delete jobs that are not needed, or ask an operator for more"
    )]
    TooManyBytes {
        /// The tenant.
        tenant: Tenant,
        /// Bytes used.
        used_bytes: u64,
        /// Bytes allowed.
        limit_bytes: u64,
    },
    /// An error of the guard while a request arrives.
    #[error("{}", .0.message())]
    Door(Box<Status>),
    /// An error of the store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An error of the object store.
    #[error(transparent)]
    Object(#[from] ObjectError),
}

impl From<IssueError> for ServiceError {
    fn from(IssueError { field, message }: IssueError) -> Self {
        Self::BadArgument { field, message }
    }
}

impl From<LogError> for ServiceError {
    fn from(error: LogError) -> Self {
        match error {
            LogError::File(error) => error.into(),
            LogError::Store(error) => error.into(),
        }
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

/// Refuses an invalid request id: empty, too long, or with control characters, which separate ids of
/// different tenants.
///
/// # Errors
/// When it is invalid.
pub fn check_request_id(request_id: &str) -> Result<(), ServiceError> {
    limit_of("request_id", request_id, MAX_REQUEST_ID_BYTES)?;
    let fault = if request_id.is_empty() {
        "is missing; choose a UUID and use it again when the call is repeated"
    } else if request_id.contains(char::is_control) {
        "has control characters; choose a UUID"
    } else {
        return Ok(());
    };
    Err(ServiceError::BadArgument { field: "request_id", message: fault.into() })
}

/// Longest request id, bytes.
const MAX_REQUEST_ID_BYTES: usize = 128;

/// Refuses an invalid text for one line of a terminal or a log. The text must not be too long or have control
/// characters, which could rewrite the screen or forge a line.
///
/// # Errors
/// When it is invalid, with the name of its field.
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

/// Time that a client should wait before it repeats a call after a transient failure.
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
            // Returned above.
            ServiceError::Door(status) => (status.code(), "BAD_ARGUMENT"),
            ServiceError::UnknownWorker | ServiceError::NoSuchWorker(_) => (Code::NotFound, "UNKNOWN_WORKER"),
            ServiceError::OtherWorker => (Code::PermissionDenied, "OTHER_WORKER"),
            ServiceError::ProtocolVersion { .. } => (Code::FailedPrecondition, "PROTOCOL_VERSION"),
            ServiceError::BlobMissing { .. } | ServiceError::FilesMissing { .. } => {
                (Code::FailedPrecondition, "BLOB_NOT_FOUND")
            }
            ServiceError::BadScene(_) => (Code::FailedPrecondition, "BAD_SCENE"),
            ServiceError::Token(Refused::Missing) => (Code::Unauthenticated, "TOKEN_MISSING"),
            ServiceError::Token(Refused::NotValid) => (Code::Unauthenticated, "TOKEN_REFUSED"),
            ServiceError::RoleRefused { .. } | ServiceError::OfLink => {
                (Code::PermissionDenied, "ROLE_REFUSED")
            }
            ServiceError::NoCertificate => (Code::Unauthenticated, "CERTIFICATE_MISSING"),
            ServiceError::ReadsOtherScenes => (Code::ResourceExhausted, "RATE_LIMITED"),
            ServiceError::TooManyCalls(_) => (Code::ResourceExhausted, "RATE_LIMITED"),
            ServiceError::NoSuchToken(_) => (Code::NotFound, "TOKEN_NOT_FOUND"),
            ServiceError::LastOperator(_) => (Code::FailedPrecondition, "LAST_OPERATOR"),
            ServiceError::TooManyBytes { .. } | ServiceError::TooManyLinks { .. } => {
                (Code::ResourceExhausted, "QUOTA_SPENT")
            }
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
                StoreError::InUse { .. }
                | StoreError::NoCopy { .. }
                | StoreError::BadUrl
                | StoreError::DatabaseInUse
                | StoreError::OtherSchema { .. }
                | StoreError::Failed(_) => (Code::Unavailable, "STORE_FAILED"),
                StoreError::Unavailable(error) => {
                    message = without_database(error);
                    (Code::Unavailable, "STORE_FAILED")
                }
            },
            ServiceError::Object(ObjectError::Ledger(StoreError::Unavailable(error))) => {
                message = without_database(error);
                (Code::Unavailable, "STORE_FAILED")
            }
            ServiceError::Object(error) => match error {
                ObjectError::BadDigest(_) => (Code::InvalidArgument, "BAD_ARGUMENT"),
                ObjectError::TooLarge { .. } => (Code::InvalidArgument, "BLOB_TOO_LARGE"),
                ObjectError::NotFound(_) => (Code::NotFound, "BLOB_NOT_FOUND"),
                ObjectError::NoUpload => (Code::NotFound, "UPLOAD_NOT_FOUND"),
                ObjectError::WrongOffset { committed_bytes, .. } => {
                    metadata.insert("committed_size_bytes".into(), committed_bytes.to_string());
                    (Code::OutOfRange, "WRONG_OFFSET")
                }
                ObjectError::DigestMismatch { .. } | ObjectError::Damaged(_) => {
                    (Code::DataLoss, "DIGEST_MISMATCH")
                }
                ObjectError::Busy(_) => (Code::Aborted, "WRITE_IN_PROGRESS"),
                ObjectError::Interrupted => (Code::Unavailable, "STORE_UNAVAILABLE"),
                ObjectError::OverLimit { .. } => (Code::ResourceExhausted, "QUOTA_SPENT"),
                ObjectError::LowSpace { .. } => (Code::ResourceExhausted, "LOW_DISK_SPACE"),
                ObjectError::Unavailable(_) => {
                    // Clients must not learn names of buckets.
                    tracing::warn!(%error, "a request to the object store failed");
                    message = "the coordinator's object store is not available; try again".into();
                    (Code::Unavailable, "STORE_UNAVAILABLE")
                }
                ObjectError::Io { .. }
                | ObjectError::Store(_)
                | ObjectError::Ledger(_)
                | ObjectError::Late { .. }
                | ObjectError::BadUrl { .. }
                | ObjectError::OfOther { .. } => {
                    // Clients must not learn paths of this machine.
                    tracing::warn!(%error, "cannot read or write a blob");
                    if error.is_full() {
                        message = "the coordinator's disk is full; free some space".into();
                        (Code::ResourceExhausted, "LOW_DISK_SPACE")
                    } else {
                        message = "the coordinator cannot read or write its files; see its log".into();
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
/// The message while the database is not available. Clients must not learn addresses of this network, and
/// the sweeper reports the outage once.
fn without_database(error: &str) -> String {
    tracing::debug!(%error, "the database is not available");
    "the coordinator's database is not available; repeat the call".into()
}
