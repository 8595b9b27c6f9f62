//! The coordinator of Fathom: takes jobs, cuts scenes, leases tasks to workers, merges what they trained.
//!
//! The way of a call: [`access`] finds out who calls and what they may, `services` decode it, the [`store`] applies the rules of [`schedule`] in one durable
//! transaction, the reply is encoded. Work that the coordinator does itself (plan, choice of cameras, consensus, merge, artifacts) are
//! tasks with leases as all others; `launcher` takes them. Bytes are in [`objects`], log lines in `logs`; `metrics` counts.

pub mod access;
mod artifacts;
mod clock;
mod config;
mod connections;
mod consensus;
mod data_dir;
pub mod datasets;
mod error;
#[cfg(test)]
mod fuzz;
mod launcher;
mod logs;
pub mod maintenance;
mod metrics;
pub mod objects;
mod pipeline;
mod references;
pub mod retention;
pub mod schedule;
mod seldom;
mod select;
mod server;
mod services;
pub mod store;
mod tls;

pub use clock::Clock;
pub use config::CoordinatorConfig;
pub use error::CoordinatorError;
pub use server::{Coordinator, serve, serve_over};
