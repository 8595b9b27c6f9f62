//! coordinator.

pub mod schedule;
pub mod store;
