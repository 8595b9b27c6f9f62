//! The service in one process: a coordinator, workers whose trainer needs no GPU, and users, over loopback.
//!
//! One program, since most of the time that a test program takes to build is for what all of them link.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

mod artifacts;
mod datasets;
mod jobs;
mod leaving;
mod session;
mod several_gpus;
mod stages;
mod stragglers;
#[path = "../support/mod.rs"]
mod support;
