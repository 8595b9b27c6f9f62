//! What the programs of Fathom say of themselves.
//!
//! - [`init`] sets up the log of a process: text or JSON on stderr, on which every line of an attempt has its job, task, partition,
//!   attempt and worker ([`attempt_span`]).
//! - [`capture`] hands the lines of an attempt to whoever keeps them for the job's user, through a [`queue`] that never blocks.
//! - [`shown()`] makes text of somebody else fit for a terminal or a log.
//! - [`http`] serves metrics and health to those who operate a service.
//! - [`threads`] runs what blocks, on threads or in a simulation.
//! - With the feature `otel`, spans go to a collector as well.
//!
//! Nothing here may hold work up or make it fail.

pub mod capture;
mod format;
pub mod http;
#[cfg(feature = "otel")]
mod otel;
pub mod queue;
mod scrub;
mod setup;
mod shown;
mod span;
pub mod threads;

pub use scrub::scrub;
pub use setup::{Guard, LogFormat, Logging, init};
pub use shown::{is_unseen, shown};
pub use span::attempt_span;
