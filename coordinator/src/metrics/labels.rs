//! Values of labels.

use crate::schedule::{Expired, FailClass};

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
