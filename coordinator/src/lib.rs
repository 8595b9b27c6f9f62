//! The coordinator of Fathom: takes jobs, cuts scenes, leases tasks to workers, merges what they trained.
//!
//! The way of a call: [`access`] finds out who calls and what they may, `services` decode it, the [`store`] applies the rules of [`schedule`] in one durable
//! transaction, the reply is encoded. Work that the coordinator does itself (plan, choice of cameras, consensus, merge, artifacts) are
//! tasks with leases as all others; `launcher` takes them. Bytes are in [`objects`], log lines in `logs`; `metrics` counts.

pub mod access;
mod capacity;
mod clock;
mod config;
mod connections;
mod data_dir;
pub mod datasets;
mod error;
#[cfg(test)]
mod fuzz;
mod logs;
pub mod maintenance;
mod metrics;
pub mod objects;
mod own_tasks;
mod references;
pub mod retention;
pub mod schedule;
mod seldom;
mod server;
mod service_error;
mod services;
mod state;
pub mod store;
mod sweep;
mod tls;
mod wakeups;
mod worker_registry;

pub use clock::Clock;
pub use config::CoordinatorConfig;
pub use error::CoordinatorError;
pub use server::{Coordinator, serve, serve_over};
