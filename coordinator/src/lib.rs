//! coordinator.

pub mod merge;
pub mod partition;
