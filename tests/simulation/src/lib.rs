//! Coordinator, workers and users of Fathom over a simulated network, in tests only.
//!
//! One seed is one run: the real coordinator (all services, tokens, own tasks, sweeper), real workers with a
//! hashing trainer, and real clients, on one thread, in simulated time (`turmoil`). In its first part, hosts
//! crash and restart, links break or delay messages, disks and trainers fail, and users change their minds
//! and repeat calls. Then faults end, and all jobs must finish. The history ([`history`]) records all answers
//! and the actions of the store; the [`invariants`] must hold for it.
//!
//! The same seed gives the same history: time, network and faults follow from it, file I/O runs on the
//! calling thread (`fathom_observe::threads`), and [`random`] provides ids and map orders.

pub mod campaign;
pub mod disk;
pub mod faults;
pub mod history;
pub mod invariants;
pub mod lines;
#[path = "../../support/memory.rs"]
mod memory;
pub mod network;
pub mod random;
pub mod results;
pub mod scene;
pub mod trainer;
pub mod users;
pub mod week;
pub mod world;

pub use world::{Counts, Options, Run, Safeguard, run};
