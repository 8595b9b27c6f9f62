//! Errors of the coordinator's own tasks.

use std::io;

use fathom_merge::MergeError;

use crate::objects::ObjectError;
use crate::schedule::{FailClass, TaskId};
use crate::store::StoreError;

/// Why one of the coordinator's own tasks failed.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct OwnTaskError {
    /// The class of the failure.
    pub class: FailClass,
    /// The error, and a remedy.
    pub message: String,
    /// Tasks whose results are damaged: they are requeued, and then this one runs again.
    pub lost: Vec<TaskId>,
    /// The bucket is not available: the task waits for it, which is no failed attempt.
    pub is_outage: bool,
}

impl OwnTaskError {
    /// A fault of the job's input: a retry does not help.
    pub fn input(message: String) -> Self {
        Self::new(FailClass::Input, message)
    }

    /// Another fault: the task is retried.
    pub fn failed(message: String) -> Self {
        Self::new(FailClass::Training, message)
    }

    fn new(class: FailClass, message: String) -> Self {
        Self { class, message, lost: Vec::new(), is_outage: false }
    }

    /// The error of a merge.
    pub fn of_merge(error: &MergeError) -> Self {
        match error {
            MergeError::Io { source, .. } => Self { message: error.to_string(), ..Self::of_io(source) },
            _ => Self::failed(error.to_string()),
        }
    }

    /// The error of a file, which may be a blob in a bucket.
    pub fn of_io(error: &io::Error) -> Self {
        let of_bucket = error.get_ref().and_then(|error| error.downcast_ref::<ObjectError>());
        let is_outage = of_bucket.is_some_and(is_outage);
        Self { is_outage, ..Self::failed(error.to_string()) }
    }

    /// The results of other tasks are damaged.
    pub fn lost(lost: Vec<TaskId>, message: String) -> Self {
        Self { lost, ..Self::new(FailClass::Environment, message) }
    }
}

/// Whether the bucket, or the database that counts its blobs, is not available.
fn is_outage(error: &ObjectError) -> bool {
    matches!(
        error,
        ObjectError::Unavailable(_)
            | ObjectError::Late { .. }
            | ObjectError::Ledger(StoreError::Unavailable(_))
    )
}

impl From<ObjectError> for OwnTaskError {
    fn from(error: ObjectError) -> Self {
        match error {
            ObjectError::NotFound(_) | ObjectError::BadDigest(_) | ObjectError::TooLarge { .. } => {
                Self::input(error.to_string())
            }
            error if is_outage(&error) => {
                Self { is_outage: true, ..Self::new(FailClass::Environment, error.to_string()) }
            }
            _ => Self::new(FailClass::Environment, error.to_string()),
        }
    }
}
