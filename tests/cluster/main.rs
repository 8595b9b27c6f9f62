//! The service in one process: a coordinator, workers whose trainer needs no GPU, and callers, over loopback.
//!
//! One test program, because linking takes most of its build time.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod access;
mod addresses;
mod artifacts;
mod blobs;
#[path = "../support/callers.rs"]
mod callers;
mod datasets;
mod history;
mod hostile;
mod inspection;
mod jobs;
mod leaving;
mod links;
mod memory;
#[path = "../support/postgres.rs"]
mod postgres;
#[path = "../support/memory.rs"]
mod resident;
mod scaler;
mod session;
mod several_gpus;
mod stages;
mod stragglers;
#[path = "../support/cluster.rs"]
mod support;
mod web;
mod webhook;
mod workers;
