//! Errors of the coordinator's own tasks.

use crate::objects::ObjectError;
use crate::schedule::{FailClass, TaskId};

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
}

impl OwnTaskError {
    /// A fault of the job's input: a retry does not help.
    pub fn input(message: String) -> Self {
        Self { class: FailClass::Input, message, lost: Vec::new() }
    }

    /// Another fault: the task is retried.
    pub fn failed(message: String) -> Self {
        Self { class: FailClass::Training, message, lost: Vec::new() }
    }

    /// The results of other tasks are damaged.
    pub fn lost(lost: Vec<TaskId>, message: String) -> Self {
        Self { class: FailClass::Environment, message, lost }
    }
}

impl From<ObjectError> for OwnTaskError {
    fn from(error: ObjectError) -> Self {
        match error {
            ObjectError::NotFound(_) | ObjectError::BadDigest(_) | ObjectError::TooLarge { .. } => {
                Self::input(error.to_string())
            }
            _ => Self { class: FailClass::Environment, message: error.to_string(), lost: Vec::new() },
        }
    }
}
