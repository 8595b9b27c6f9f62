//! Rows of tables: copies of fields for queries, beside the encoded record.

use sqlx::PgConnection;

use super::super::record::{decode, encode};
use super::super::{StoreError, StoredEvent};
use super::unavailable;
use crate::schedule::{
    Attempt, JobId, JobRecord, JobState, Lease, ParseIdError, Stage, TaskId, TaskRecord, TaskState,
};

/// The number of a stage in keys.
pub fn stage(stage: Stage) -> i16 {
    stage as u8 as i16
}

/// The numbers of stages, in their order.
pub fn stages(of: &[Stage]) -> Vec<i16> {
    let mut sorted = of.to_vec();
    sorted.sort_unstable();
    sorted.into_iter().map(stage).collect()
}

/// The part of a task in keys.
pub fn part(task: TaskId) -> i64 {
    task.number().into()
}

/// The task of a key.
pub fn task_of(stage_number: i16, part: i64) -> Result<TaskId, StoreError> {
    let corrupt = || StoreError::Corrupt {
        tree: "leases",
        message: format!("a task of stage {stage_number}, part {part}"),
    };
    let found = Stage::all().find(|known| stage(*known) == stage_number).ok_or_else(corrupt)?;
    u32::try_from(part).ok().and_then(|number| found.numbered(number)).ok_or_else(corrupt)
}

/// Numbers beyond the range of a column are larger than any that occurs.
pub fn number(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// The state of a `state` column.
pub fn parse_job_state(text: &str) -> Result<JobState, StoreError> {
    let found = JobState::ALL.into_iter().find(|state| state.name() == text);
    found.ok_or_else(|| StoreError::Corrupt { tree: "jobs", message: format!("the state {text:?}") })
}

fn task_state(state: &TaskState) -> &'static str {
    match state {
        TaskState::Blocked => "blocked",
        TaskState::Ready { .. } => "ready",
        TaskState::Leased(_) => "leased",
        TaskState::Done { .. } => "done",
        TaskState::Dead => "dead",
        TaskState::Cancelled => "cancelled",
    }
}

/// The key of a call that got a lease.
pub fn call(incarnation: &str, request_id: &str) -> Vec<u8> {
    [incarnation.as_bytes(), b"\0", request_id.as_bytes()].concat()
}

/// Encoded tasks of one job, as columns for one statement.
#[derive(Default)]
pub struct TaskColumns {
    stages: Vec<i16>,
    parts: Vec<i64>,
    states: Vec<&'static str>,
    not_before_ms: Vec<i64>,
    methods: Vec<&'static str>,
    memory_bytes: Vec<i64>,
    paces_ms: Vec<Option<f64>>,
    rows: Vec<Vec<u8>>,
}

impl TaskColumns {
    pub fn push(&mut self, record: &TaskRecord, encoded: Vec<u8>) {
        let not_before_ms = match record.state {
            TaskState::Ready { not_before_ms } => not_before_ms,
            _ => 0,
        };
        self.stages.push(stage(record.task.stage));
        self.parts.push(part(record.task));
        self.states.push(task_state(&record.state));
        self.not_before_ms.push(number(not_before_ms));
        self.methods.push(record.method.name());
        self.memory_bytes.push(number(record.memory_bytes));
        self.paces_ms.push(record.pace_ms());
        self.rows.push(encoded);
    }

    /// Inserts or replaces them.
    pub async fn write(&self, conn: &mut PgConnection, job: &JobId) -> Result<(), StoreError> {
        if self.rows.is_empty() {
            return Ok(());
        }
        let write = sqlx::query(
            "INSERT INTO tasks (job_id, stage, part, state, not_before_ms, method, memory_bytes, pace_ms, row) \
             SELECT $1, * FROM unnest($2::smallint[], $3::bigint[], $4::text[], $5::bigint[], $6::text[], \
             $7::bigint[], $8::double precision[], $9::bytea[]) \
             ON CONFLICT (job_id, stage, part) DO UPDATE SET state = excluded.state, \
             not_before_ms = excluded.not_before_ms, method = excluded.method, \
             memory_bytes = excluded.memory_bytes, pace_ms = excluded.pace_ms, row = excluded.row",
        );
        let write = write.bind(job.as_str()).bind(&self.stages).bind(&self.parts).bind(&self.states);
        let write = write.bind(&self.not_before_ms).bind(&self.methods).bind(&self.memory_bytes);
        write.bind(&self.paces_ms).bind(&self.rows).execute(conn).await.map_err(unavailable)?;
        Ok(())
    }
}

/// Encoded events of one job.
#[derive(Default)]
pub struct EventColumns {
    seqs: Vec<i64>,
    rows: Vec<Vec<u8>>,
}

impl EventColumns {
    pub fn push(&mut self, seq: u64, encoded: Vec<u8>) {
        self.seqs.push(number(seq));
        self.rows.push(encoded);
    }

    pub async fn write(&self, conn: &mut PgConnection, job: &JobId) -> Result<(), StoreError> {
        if self.rows.is_empty() {
            return Ok(());
        }
        let write = sqlx::query(
            "INSERT INTO events (job_id, seq, row) SELECT $1, * FROM unnest($2::bigint[], $3::bytea[])",
        );
        let write = write.bind(job.as_str()).bind(&self.seqs).bind(&self.rows);
        write.execute(conn).await.map_err(unavailable)?;
        Ok(())
    }
}

/// New leases of one job.
#[derive(Default)]
pub struct LeaseColumns {
    stages: Vec<i16>,
    parts: Vec<i64>,
    fences: Vec<i64>,
    attempts: Vec<i64>,
    calls: Vec<Vec<u8>>,
    deadlines_ms: Vec<i64>,
    since_ms: Vec<i64>,
}

impl LeaseColumns {
    pub fn push(&mut self, task: TaskId, attempt: &Attempt, now_ms: u64, deadline_ms: u64) {
        self.stages.push(stage(task.stage));
        self.parts.push(part(task));
        self.fences.push(number(attempt.fence));
        self.attempts.push(attempt.number.into());
        self.calls.push(call(&attempt.incarnation, &attempt.request_id));
        self.deadlines_ms.push(number(deadline_ms));
        self.since_ms.push(number(now_ms));
    }

    pub async fn write(&self, conn: &mut PgConnection, job: &JobId) -> Result<(), StoreError> {
        if self.fences.is_empty() {
            return Ok(());
        }
        let write = sqlx::query(
            "INSERT INTO leases (job_id, stage, part, fence, attempt, call, deadline_ms, still_since_ms) \
             SELECT $1, * FROM unnest($2::smallint[], $3::bigint[], $4::bigint[], $5::bigint[], $6::bytea[], \
             $7::bigint[], $8::bigint[])",
        );
        let write = write.bind(job.as_str()).bind(&self.stages).bind(&self.parts).bind(&self.fences);
        let write = write.bind(&self.attempts).bind(&self.calls).bind(&self.deadlines_ms);
        write.bind(&self.since_ms).execute(conn).await.map_err(unavailable)?;
        Ok(())
    }
}

/// Inserts or replaces the row of a job.
pub async fn write_job(conn: &mut PgConnection, job: &JobRecord) -> Result<(), StoreError> {
    let write = sqlx::query(
        "INSERT INTO jobs (job_id, tenant, state, priority, max_parallel, leased, dataset, row) \
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8) \
         ON CONFLICT (job_id) DO UPDATE SET state = excluded.state, priority = excluded.priority, \
         max_parallel = excluded.max_parallel, leased = excluded.leased, row = excluded.row",
    );
    let write = write.bind(job.job_id.as_str()).bind(job.tenant.as_str()).bind(job.state.name());
    let write = write.bind(job.priority).bind(i64::from(job.max_parallel)).bind(i64::from(job.leased_tasks));
    let write = write.bind(job.dataset.as_ref().map(|dataset| dataset.as_str().to_owned()));
    write.bind(encode("jobs", job)?).execute(conn).await.map_err(unavailable)?;
    Ok(())
}

/// The row of a job, locked until the transaction ends where `locks`.
pub async fn read_job(
    conn: &mut PgConnection,
    job: &JobId,
    locks: bool,
) -> Result<Option<JobRecord>, StoreError> {
    let found = match locks {
        true => sqlx::query_scalar::<_, Vec<u8>>("SELECT row FROM jobs WHERE job_id = $1 FOR UPDATE"),
        false => sqlx::query_scalar("SELECT row FROM jobs WHERE job_id = $1"),
    };
    let found = found.bind(job.as_str()).fetch_optional(conn).await.map_err(unavailable)?;
    found.map(|bytes| decode("jobs", &bytes)).transpose()
}

/// Rows of tasks of a job; `None`: all of them.
pub async fn read_tasks(
    conn: &mut PgConnection,
    job: &JobId,
    only: Option<&[TaskId]>,
) -> Result<Vec<TaskRecord>, StoreError> {
    let rows: Vec<Vec<u8>> = match only {
        None => sqlx::query_scalar("SELECT row FROM tasks WHERE job_id = $1 ORDER BY stage, part")
            .bind(job.as_str())
            .fetch_all(conn)
            .await
            .map_err(unavailable)?,
        Some(only) => sqlx::query_scalar(
            // OFFSET 0 keeps the planner from reading all tasks of the job: without statistics, it expects
            // one.
            "SELECT found.row FROM unnest($2::smallint[], $3::bigint[]) AS wanted (stage, part) \
             CROSS JOIN LATERAL (SELECT row FROM tasks WHERE job_id = $1 AND tasks.stage = wanted.stage \
             AND tasks.part = wanted.part OFFSET 0) AS found",
        )
        .bind(job.as_str())
        .bind(only.iter().map(|task| stage(task.stage)).collect::<Vec<_>>())
        .bind(only.iter().map(|task| part(*task)).collect::<Vec<_>>())
        .fetch_all(conn)
        .await
        .map_err(unavailable)?,
    };
    rows.iter().map(|bytes| decode("tasks", bytes)).collect()
}

/// Events of a job after `after_seq`, at most `limit`.
pub async fn read_events(
    conn: &mut PgConnection,
    job: &JobId,
    after_seq: u64,
    limit: usize,
) -> Result<Vec<StoredEvent>, StoreError> {
    let rows: Vec<Vec<u8>> =
        sqlx::query_scalar("SELECT row FROM events WHERE job_id = $1 AND seq > $2 ORDER BY seq LIMIT $3")
            .bind(job.as_str())
            .bind(number(after_seq))
            .bind(number(limit as u64))
            .fetch_all(conn)
            .await
            .map_err(unavailable)?;
    rows.iter().map(|bytes| decode("events", bytes)).collect()
}

/// The job of a `job_id` column.
pub fn parse_job(job: &str) -> Result<JobId, StoreError> {
    let corrupt = |message: String| StoreError::Corrupt { tree: "jobs", message };
    job.parse().map_err(|error: ParseIdError| corrupt(error.to_string()))
}

/// The columns of a lease that identify it.
pub type LeaseKey = (String, i16, i64, i64, i64);

/// The lease of `job_id, stage, part, fence, attempt`.
pub fn lease_of((job, stage, part, fence, attempt): LeaseKey) -> Result<Lease, StoreError> {
    let corrupt = |message: String| StoreError::Corrupt { tree: "leases", message };
    let job = parse_job(&job)?;
    let attempt = u32::try_from(attempt).map_err(|error| corrupt(error.to_string()))?;
    let fence = u64::try_from(fence).map_err(|error| corrupt(error.to_string()))?;
    Ok(Lease { job, task: task_of(stage, part)?, attempt, fence })
}
