//! The coordinator of Fathom: accepts jobs, partitions scenes, leases tasks to workers, merges their results.
//!
//! The path of a call: [`access`] authenticates and authorises it, `services` decode it, the [`store`]
//! applies the rules of [`schedule`] in one durable transaction, and the reply is encoded. The coordinator's
//! own work (plan, exchange, merge, artifacts) runs as tasks with leases like all others; `own_tasks` takes
//! them. Bytes are in [`objects`], log lines in `logs`, counters in `metrics`.

pub mod access;
mod capacity;
mod clock;
mod company;
mod config;
mod connections;
mod data_dir;
pub mod datasets;
mod error;
#[cfg(test)]
mod fuzz;
mod history;
pub mod json;
mod logs;
pub mod maintenance;
mod metrics;
pub mod objects;
mod own_tasks;
mod rate_limited_log;
mod references;
pub mod retention;
mod scaler;
pub mod schedule;
mod server;
mod service_error;
mod services;
mod state;
pub mod store;
mod sweep;
mod tls;
mod wakeups;
mod web;
mod webhook;
mod worker_registry;

pub use clock::Clock;
pub use config::CoordinatorConfig;
pub use error::CoordinatorError;
pub use server::{Coordinator, serve, serve_over};
