//! Rows of the store inside a transaction, and their keys.

use sled::transaction::{ConflictableTransactionError, TransactionalTree};

use super::super::record::{decode, encode};
use super::super::{StoreError, StoredEvent};
use crate::schedule::{EventBody, JobId, JobRows, TaskId, TaskRecord};

/// Key of the highest granted fence, in `meta`.
pub const LAST_FENCE: &[u8] = b"last_fence";
/// Its key in `meta`.
pub const DEPLOYMENT: &str = "deployment";

/// The same trees inside a transaction.
pub struct Tx<'a> {
    pub jobs: &'a TransactionalTree,
    pub tasks: &'a TransactionalTree,
    pub events: &'a TransactionalTree,
    pub requests: &'a TransactionalTree,
    pub meta: &'a TransactionalTree,
}

pub type TxResult<T> = Result<T, ConflictableTransactionError<StoreError>>;

impl Tx<'_> {
    pub fn get<T: serde::de::DeserializeOwned>(
        &self,
        name: &'static str,
        tree: &TransactionalTree,
        key: &[u8],
    ) -> TxResult<Option<T>> {
        tree.get(key)?.map(|bytes| decode(name, &bytes)).transpose().map_err(abort)
    }

    pub fn put<T: serde::Serialize>(
        &self,
        name: &'static str,
        tree: &TransactionalTree,
        key: &[u8],
        row: &T,
    ) -> TxResult<()> {
        tree.insert(key, encode(name, row).map_err(abort)?)?;
        Ok(())
    }

    pub fn next_fence(&self) -> TxResult<u64> {
        let fence = self.get::<u64>("meta", self.meta, LAST_FENCE)?.unwrap_or(0) + 1;
        self.put("meta", self.meta, LAST_FENCE, &fence)?;
        Ok(fence)
    }

    /// Writes the rows that changed.
    pub fn write(&self, id: &JobId, before: &JobRows, after: &JobRows) -> TxResult<()> {
        self.put("jobs", self.jobs, id.as_str().as_bytes(), &after.job)?;
        for (task, record) in &after.tasks {
            if before.tasks.get(task) != Some(record) {
                self.write_task(id, record)?;
            }
        }
        Ok(())
    }

    pub fn write_task(&self, id: &JobId, record: &TaskRecord) -> TxResult<()> {
        self.put("tasks", self.tasks, &task_key(id, record.task), record)
    }

    pub fn append_events(
        &self,
        id: &JobId,
        last_seq: u64,
        events: &[EventBody],
        now_ms: u64,
    ) -> TxResult<()> {
        for (seq, body) in (last_seq + 1..).zip(events) {
            let event = StoredEvent { seq, time_ms: now_ms, body: body.clone() };
            self.put("events", self.events, &event_key(id, seq), &event)?;
        }
        Ok(())
    }
}

pub fn abort(error: StoreError) -> ConflictableTransactionError<StoreError> {
    ConflictableTransactionError::Abort(error)
}

pub fn task_key(id: &JobId, task: TaskId) -> Vec<u8> {
    let mut key = id.as_str().as_bytes().to_vec();
    key.push(task.stage as u8);
    key.extend_from_slice(&task.number().to_be_bytes());
    key
}

/// The job in a key of `tasks`.
pub fn job_of_key(key: &[u8]) -> Result<JobId, StoreError> {
    let corrupt = || StoreError::Corrupt { tree: "tasks", message: format!("a key is {key:02x?}") };
    let (id, _) = key.split_at_checked(JobId::LENGTH).ok_or_else(corrupt)?;
    std::str::from_utf8(id).ok().and_then(|id| id.parse().ok()).ok_or_else(corrupt)
}

pub fn event_key(id: &JobId, seq: u64) -> Vec<u8> {
    let mut key = id.as_str().as_bytes().to_vec();
    key.extend_from_slice(&seq.to_be_bytes());
    key
}
