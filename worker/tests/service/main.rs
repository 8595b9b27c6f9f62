//! The service in one process: a coordinator, workers whose trainer needs no GPU, and users, over loopback.
//!
//! One program, since most of the time that a test program takes to build is for what all of them link.

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
