//! Logs, metrics and traces of Fathom's programs.
//!
//! - [`init`] sets up the log of a process: text or JSON on stderr, on which every line of an attempt has its
//!   job, task, partition, attempt and worker ([`attempt_span`]).
//! - [`capture`] passes the lines of an attempt to the store that keeps them for the job's user, through a
//!   [`queue`] that never blocks.
//! - [`shown()`] makes foreign text safe for a terminal or a log.
//! - [`http`] serves metrics and health to operators.
//! - [`threads`] runs blocking work, on threads or in a simulation.
//! - With the feature `otel`, spans go to a collector as well.
//!
//! Nothing here may block work or make it fail.

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
