//! Values of labels.

use crate::schedule::{Expired, FailClass, JobState};

pub fn state(state: JobState) -> &'static str {
    match state {
        JobState::Running => "running",
        JobState::Paused => "paused",
        JobState::Succeeded => "succeeded",
        JobState::Failed => "failed",
        JobState::Cancelled => "cancelled",
    }
}

pub fn class(class: FailClass) -> &'static str {
    match class {
        FailClass::Input => "input",
        FailClass::Training => "training",
        FailClass::OutOfMemory => "out_of_memory",
        FailClass::Device => "device",
        FailClass::Environment => "environment",
    }
}

pub fn expired(why: Expired) -> &'static str {
    match why {
        Expired::Silent => "silent",
        Expired::Stalled => "stalled",
    }
}
