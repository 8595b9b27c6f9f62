//! Histories of tasks (see [`crate::history`]), which logs keep beside their lines.

use sqlx::postgres::PgRow;
use sqlx::{PgConnection, Row as _};

use super::super::StoreError;
use super::rows::{part, stage, task_of};
use super::unavailable;
use crate::schedule::{JobId, TaskId};

/// Replaces the history of a task.
pub async fn put(
    conn: &mut PgConnection,
    job: &JobId,
    task: TaskId,
    history: &[u8],
) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO histories (job_id, stage, part, history) VALUES ($1, $2, $3, $4) \
         ON CONFLICT (job_id, stage, part) DO UPDATE SET history = excluded.history",
    )
    .bind(job.as_str())
    .bind(stage(task.stage))
    .bind(part(task))
    .bind(history)
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(())
}

/// The history of one task of a job, or of all, by task.
pub async fn read(
    conn: &mut PgConnection,
    job: &JobId,
    task: Option<TaskId>,
) -> Result<Vec<(TaskId, Vec<u8>)>, StoreError> {
    let rows = sqlx::query(
        "SELECT stage, part, history FROM histories WHERE job_id = $1 AND ($2::smallint IS NULL OR \
         (stage = $2 AND part = $3)) ORDER BY stage, part",
    )
    .bind(job.as_str())
    .bind(task.map(|task| stage(task.stage)))
    .bind(task.map(part))
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let history = |row: &PgRow| {
        let (stage, part) = (row.try_get("stage"), row.try_get("part"));
        let task = task_of(stage.map_err(unavailable)?, part.map_err(unavailable)?)?;
        Ok((task, row.try_get("history").map_err(unavailable)?))
    };
    rows.iter().map(history).collect()
}
