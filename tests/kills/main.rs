//! Real processes, killed at random times. Whatever is killed, the model equals that of the undisturbed run,
//! byte for byte, and nothing acknowledged is lost.
//!
//! Every test is one scenario with its own service ([`harness::Harness`]): a coordinator, workers and clients
//! as processes on loopback. A scenario ends with [`harness::Harness::conclude`], which compares the model
//! with that of [`reference`], checks the history of the job ([`history`]) and looks at every blob. Random
//! times come from a seed; a scenario that fails prints it, with the last lines of every log, and
//! `FATHOM_KILLS_SEED=... cargo test --test kills NAME` replays it.
//!
//! With `FATHOM_KILLS_STORE=postgres`, all of them have their jobs in PostgreSQL and files in a bucket, as
//! some always do. `make soak` does that, and kills for longer (`FATHOM_KILLS_ROUNDS`).
#![cfg(unix)]

#[path = "../support/postgres.rs"]
mod postgres;
#[path = "../support/processes.rs"]
mod processes;

mod clients;
mod coordinators;
mod cut;
mod databases;
mod disks;
mod files;
mod harness;
mod history;
mod job;
mod process;
mod reference;
#[path = "../support/s3.rs"]
mod s3;
mod slow_link;
#[path = "../support/small_disk.rs"]
mod small_disk;
mod soak;
mod upgrade;
mod workers;
