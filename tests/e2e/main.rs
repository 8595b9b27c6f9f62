//! The program `fathom` as a user runs it: real processes, real files, loopback.
//!
//! One test program for all verbs, because linking takes most of its build time.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test fails by panicking")]

mod access;
mod command_line;
mod datasets;
mod direct;
mod disks;
mod drivers;
#[cfg(unix)]
mod faults;
#[cfg(unix)]
mod gpu_kit;
mod handover;
mod held_out;
mod hostile;
#[cfg(unix)]
mod logs;
#[cfg(unix)]
mod on_demand;
mod page;
#[path = "../support/postgres.rs"]
mod postgres;
#[path = "../support/processes.rs"]
mod processes;
mod render;
#[path = "../support/s3.rs"]
mod s3;
#[cfg(unix)]
mod several_machines;
#[cfg(unix)]
#[path = "../support/small_disk.rs"]
mod small_disk;
mod steer;
mod store;
#[cfg(unix)]
mod store_faults;
mod train;
mod two_coordinators;
mod view;
mod water_surface;
