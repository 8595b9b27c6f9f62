//! Coordinator, workers and users of Fathom over a simulated network, in tests only.
//!
//! One seed is one run: the real coordinator (all services, tokens, own tasks, sweeper), real workers with a
//! trainer that hashes, and real clients, on one thread, in simulated time (`turmoil`). While the first part
//! of it lasts, hosts crash and come back, links are cut or hold what they carry, disks fail, trainers fail,
//! users change their minds and send things twice. Then nothing fails any more, and all must come to an end.
//! What everybody was told and what the store did is the history ([`history`]), of which the [`invariants`]
//! must hold.
//!
//! The same seed gives the same history: time, network and faults follow from it, files are worked on where
//! they are asked for (`fathom_observe::threads`), and ids and the order of maps come from [`random`].

pub mod campaign;
pub mod disk;
pub mod faults;
pub mod history;
pub mod invariants;
pub mod lines;
pub mod network;
pub mod random;
pub mod results;
pub mod scene;
pub mod trainer;
pub mod users;
pub mod world;

pub use world::{Counts, Options, Run, Safeguard, run};
