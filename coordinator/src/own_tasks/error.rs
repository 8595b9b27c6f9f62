//! Why a task of the coordinator itself has no result.

use crate::objects::ObjectError;
use crate::schedule::{FailClass, TaskId};

/// Why one of the coordinator's own tasks failed.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct OwnTaskError {
    /// What follows from it.
    pub class: FailClass,
    /// What happened, and what helps.
    pub message: String,
    /// Tasks whose results are not what they handed in: they are done again, and then this one.
    pub lost: Vec<TaskId>,
}

impl OwnTaskError {
    /// The job's input is at fault: trying again is of no use.
    pub fn input(message: String) -> Self {
        Self { class: FailClass::Input, message, lost: Vec::new() }
    }

    /// Something else is: it is tried again.
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
