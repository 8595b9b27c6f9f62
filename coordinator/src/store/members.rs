//! What the coordinators of one database know of each other, and of the workers that call any of them.

use futures::stream::BoxStream;
use tonic::async_trait;

use super::StoreError;

/// A worker that has called one of the coordinators.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedWorker {
    /// Its incarnation.
    pub incarnation: String,
    /// Time since its last call, milliseconds.
    pub silent_ms: u64,
    /// What it registered with, if that was after the time that the caller gave.
    pub registered: Option<Vec<u8>>,
}

/// The state of all coordinators at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Meeting {
    /// Coordinators that have reported themselves within the last seconds, this one included.
    pub members: u32,
    /// Workers that have called lately.
    pub workers: Vec<SharedWorker>,
    /// Those that called this coordinator and that the database does not know: they were forgotten while it
    /// was away.
    pub forgotten: Vec<String>,
    /// The time to give at the next meeting, by the database's clock.
    pub time_ms: u64,
}

/// A hint from another coordinator. Waiting calls also look at intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hint {
    /// There may be work.
    Work,
    /// Work may also have to stop.
    Interrupt,
}

/// The coordinators of one database.
#[async_trait]
pub trait Members: Send + Sync {
    /// Reports this coordinator, and how long ago workers called it last, milliseconds. Reads the workers
    /// that called others since `since_ms`; 0, all of them, also says that the database was gone until now.
    /// Workers that have not called any coordinator for `forget_after_ms` are forgotten.
    async fn meet(
        &self,
        seen: &[(String, u64)],
        since_ms: u64,
        forget_after_ms: u64,
    ) -> Result<Meeting, StoreError>;
    /// Reports that this coordinator stops.
    async fn leave(&self) -> Result<(), StoreError>;
    /// Records what a worker registers with; false if the worker belongs to another owner.
    async fn register(&self, incarnation: &str, owner: &str, row: &[u8]) -> Result<bool, StoreError>;
    /// Forgets workers.
    async fn forget(&self, incarnations: &[String]) -> Result<(), StoreError>;
    /// Gives the other coordinators a hint.
    async fn notify(&self, hint: Hint) -> Result<(), StoreError>;
    /// Hints from the other coordinators, until the database fails.
    async fn listen(&self) -> Result<BoxStream<'static, Hint>, StoreError>;
}
