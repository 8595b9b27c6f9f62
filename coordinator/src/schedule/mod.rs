//! Jobs and their transitions: pure rules, without I/O and without a clock.
//!
//! [`step`] takes the rows of one job, an event and the time, changes the rows, and returns the events for
//! watchers. Stores call it inside the transaction that commits, so the check of a fence and the guarded
//! change are atomic. The simulation in `simulation.rs` calls it with virtual workers and a virtual clock.

mod event;
mod fit;
mod ids;
mod job;
mod leases;
mod lost_results;
mod queue;
mod rows;
mod scheduler;
#[cfg(test)]
mod simulation;
mod stages;
mod straggler;
mod task;
mod tenant;
mod time_left;

pub use event::{
    Event, EventBody, Expired, FailClass, Outcome, Planned, PlannedTask, Refusal, TaskChange, TaskOutput,
};
pub use fit::{Requirements, Shortfall, WorkerProfile};
pub use ids::{JobId, ParseIdError, TaskId};
pub use job::{Announcement, JobRecord, JobShape, JobState};
pub use leases::{LeaseTable, LiveProgress, Renewed};
pub use queue::{Next, OpenWork, Queue, ReadyTask, Usage};
pub use rows::{JobRows, Rules};
pub use scheduler::{RowsNeeded, rows_needed, step};
pub use stages::{Artifact, RunsOn, STAGES, Stage, StageSpec, Tasks};
pub use straggler::usual_pace_ms;
pub use task::{Attempt, CheckpointRecord, HeldOut, Lease, TaskRecord, TaskState, TaskStats};
pub use tenant::{Quota, Tenant};
pub use time_left::time_left;
