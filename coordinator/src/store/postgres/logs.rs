//! Log lines of jobs (see [`crate::logs`]), which all coordinators of the database write and read.
//!
//! An append locks the row of its job in `log_jobs` until the commit. So numbers become visible in their
//! order, and a reader that has seen one has seen all smaller ones. Commits do not wait for the disk.
//!
//! A segment of an attempt is a range of numbers: `log_attempts` has the first number of each one after the
//! first.

use std::collections::BTreeMap;
use std::sync::Arc;

use sqlx::postgres::PgRow;
use sqlx::{Connection, PgConnection, Row as _};
use tokio::sync::{Mutex, watch};
use tonic::async_trait;

use super::super::StoreError;
use super::histories;
use super::rows::{number, parse_job, part, stage, task_of};
use super::{Borrowed, Inner, PostgresStore, unavailable};
use crate::logs::{
    ATTEMPTS_KEPT, Attempt, COPIED_SEGMENT_BYTES, KeptLine, LOOKED_AT, LogError, Logs, NewLine, Page,
    Position, Row, SEGMENTS, Severity, Wanted,
};
use crate::schedule::{JobId, TaskId};

/// Bytes of a line besides its text, with its part of the indexes.
const LINE_BYTES: u64 = 256;
/// Appends of this process at a time. Those to one job wait for each other, and must not do so with all
/// connections.
const APPENDS_AT_ONCE: usize = 4;
/// Lines that one statement deletes.
const DELETED_AT_ONCE: u64 = 20_000;

/// Log lines in the database of a [`PostgresStore`].
struct PostgresLogs {
    store: Arc<Inner>,
    segment_bytes: u64,
    appended: watch::Sender<u64>,
    /// A job has one of them.
    lanes: [Arc<Mutex<()>>; APPENDS_AT_ONCE],
}

impl PostgresStore {
    /// Log lines in this database; an attempt keeps at most `attempt_bytes`.
    pub(super) fn logs_of(&self, attempt_bytes: u64) -> Arc<dyn Logs> {
        Arc::new(PostgresLogs {
            store: Arc::clone(&self.0),
            segment_bytes: attempt_bytes / SEGMENTS,
            appended: watch::channel(0).0,
            lanes: std::array::from_fn(|_| Arc::default()),
        })
    }
}

#[async_trait]
impl Logs for PostgresLogs {
    fn appended(&self) -> watch::Receiver<u64> {
        self.appended.subscribe()
    }

    fn is_on_disk(&self) -> bool {
        false
    }

    async fn holder(&self, job: &JobId, attempt: Attempt, fence: u64) -> Result<Option<String>, LogError> {
        let worker = on!(self.store, pool, |conn| holder(conn, job, attempt, fence))?;
        Ok(worker.map(text))
    }

    async fn append(
        &self,
        job: &JobId,
        attempt: Attempt,
        (worker, fence): (&str, u64),
        lines: Vec<NewLine>,
        now_ms: u64,
    ) -> Result<(), LogError> {
        if lines.is_empty() {
            return Ok(());
        }
        let given_ms = self.store.settings.given_ms(now_ms);
        let (store, job, segment_bytes) = (Arc::clone(&self.store), job.clone(), self.segment_bytes);
        let batch = Batch { attempt, worker: worker.to_owned(), fence, lines, segment_bytes };
        let lane = job.as_str().bytes().last().map_or(0, usize::from) % APPENDS_AT_ONCE;
        let lane = Arc::clone(&self.lanes[lane]).lock_owned().await;
        // Goes on when the caller is dropped: a transaction is never left in the middle.
        let added = tokio::spawn(async move {
            let _lane = lane;
            on!(store, pool, |conn| append(conn, &job, batch, given_ms))
        });
        if added.await.unwrap_or_else(|error| Err(StoreError::Unavailable(error.to_string())))? {
            self.appended.send_modify(|count| *count = count.wrapping_add(1));
        }
        Ok(())
    }

    async fn read(
        &self,
        job: &JobId,
        wanted: &Wanted,
        position: Position,
        limit: usize,
    ) -> Result<Page, LogError> {
        Ok(on!(self.store, pool, |conn| read(conn, job, wanted, position, limit))?)
    }

    async fn put_history(&self, job: &JobId, task: TaskId, history: Vec<u8>) -> Result<(), LogError> {
        Ok(on!(self.store, renewals, |conn| histories::put(conn, job, task, &history))?)
    }

    async fn histories(&self, job: &JobId, task: Option<TaskId>) -> Result<Vec<(TaskId, Vec<u8>)>, LogError> {
        Ok(on!(self.store, pool, |conn| histories::read(conn, job, task))?)
    }

    async fn remove(&self, job: &JobId) -> Result<(), LogError> {
        // A long log takes more than one transaction may.
        while on!(self.store, pool, |conn| remove_first(conn, job))? >= DELETED_AT_ONCE {}
        Ok(on!(self.store, pool, |conn| remove(conn, job))?)
    }

    async fn jobs(&self) -> Result<Vec<JobId>, LogError> {
        Ok(on!(self.store, pool, |conn| jobs(conn))?)
    }

    async fn last(&self, job: &JobId) -> Result<u64, LogError> {
        Ok(on!(self.store, pool, |conn| last(conn, job))?)
    }

    async fn import(&self, job: &JobId, lines: Vec<KeptLine>) -> Result<(), LogError> {
        Ok(on!(self.store, pool, |conn| import(conn, job, lines))?)
    }
}

/// New lines of an attempt.
struct Batch {
    attempt: Attempt,
    worker: String,
    fence: u64,
    lines: Vec<NewLine>,
    segment_bytes: u64,
}

/// Adds lines in one transaction; returns whether any was new.
async fn append(
    conn: &mut PgConnection,
    job: &JobId,
    batch: Batch,
    given_ms: Option<i64>,
) -> Result<bool, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    let Batch { attempt, worker, fence, lines, segment_bytes } = batch;
    let mut next = lock(&mut tx, job, lines.len(), given_ms).await?;
    let mut log = match AttemptLog::read(&mut tx, job, attempt).await? {
        Some(log) => log,
        None => {
            forget_old_attempts(&mut tx, job, attempt).await?;
            AttemptLog::default()
        }
    };
    if lines.iter().any(|line| line.from_worker.is_some()) {
        log.holder = Some((fence, worker.clone()));
    }
    let mut columns = LineColumns::default();
    for NewLine { from_worker, time_ms, severity, message } in lines {
        if from_worker.is_some_and(|number| number <= log.last_from_worker) {
            continue;
        }
        log.last_from_worker = from_worker.unwrap_or(log.last_from_worker);
        let row = Row { number: next, from_worker, time_ms, severity, worker: worker.clone(), message };
        log.add(&row, segment_bytes);
        columns.push(row, false);
        next += 2;
    }
    let removed = log.outgrown();
    log.write(&mut tx, job, attempt, &columns).await?;
    if let Some(range) = removed {
        cut(&mut tx, job, attempt, range).await?;
    }
    tx.commit().await.map_err(unavailable)?;
    Ok(!columns.numbers.is_empty())
}

/// Locks the log of a job until the transaction ends, and reserves numbers for `count` lines; returns the
/// first one.
async fn lock(
    tx: &mut PgConnection,
    job: &JobId,
    count: usize,
    given_ms: Option<i64>,
) -> Result<u64, StoreError> {
    let count = number(count as u64);
    // Even numbers; the odd ones are for notices. What a crash of the database loses was not synced by files
    // either.
    let (last, _): (i64, String) = sqlx::query_as(
        "INSERT INTO log_jobs AS known (job_id, last) VALUES ($1, coalesce($2, now_ms()) * 1000 + 2 * $3 - 2) \
         ON CONFLICT (job_id) DO UPDATE \
         SET last = greatest(known.last, coalesce($2, now_ms()) * 1000 - 2) + 2 * $3 \
         RETURNING last, set_config('synchronous_commit', 'off', true)",
    )
    .bind(job.as_str())
    .bind(given_ms)
    .bind(count)
    .fetch_one(tx)
    .await
    .map_err(unavailable)?;
    Ok((last - 2 * (count - 1)).unsigned_abs())
}

/// The row of an attempt.
#[derive(Default)]
struct AttemptLog {
    /// The fence and the worker whose lines were accepted.
    holder: Option<(u64, String)>,
    /// The highest number from the worker.
    last_from_worker: u64,
    /// Bytes of the latest segment.
    bytes: u64,
    /// First numbers of the segments after the first.
    starts: Vec<i64>,
}

impl AttemptLog {
    async fn read(
        tx: &mut PgConnection,
        job: &JobId,
        (task, attempt): Attempt,
    ) -> Result<Option<Self>, StoreError> {
        let found: Option<(i64, i64, Vec<i64>)> = sqlx::query_as(
            "SELECT last_from_worker, bytes, starts FROM log_attempts \
             WHERE job_id = $1 AND stage = $2 AND part = $3 AND attempt = $4",
        )
        .bind(job.as_str())
        .bind(stage(task.stage))
        .bind(part(task))
        .bind(i64::from(attempt))
        .fetch_optional(tx)
        .await
        .map_err(unavailable)?;
        Ok(found.map(|(last_from_worker, bytes, starts)| Self {
            holder: None,
            last_from_worker: last_from_worker.unsigned_abs(),
            bytes: bytes.unsigned_abs(),
            starts,
        }))
    }

    /// Counts a line, which begins a segment when the latest one is full.
    fn add(&mut self, row: &Row, segment_bytes: u64) {
        let bytes = LINE_BYTES + (row.message.len() + row.worker.len()) as u64;
        if self.bytes > 0 && self.bytes + bytes > segment_bytes {
            self.begin_segment(row.number);
        }
        self.bytes += bytes;
    }

    fn begin_segment(&mut self, first: u64) {
        self.starts.push(number(first));
        self.bytes = 0;
    }

    /// Forgets the segments that are too many; returns their first number, and the first one after them.
    fn outgrown(&mut self) -> Option<(i64, i64)> {
        let excess = (self.starts.len() + 1).checked_sub(SEGMENTS as usize).filter(|excess| *excess > 0)?;
        let from = self.starts.drain(..excess).next()?;
        Some((from, *self.starts.first()?))
    }

    /// Writes it with its new lines.
    async fn write(
        &self,
        tx: &mut PgConnection,
        job: &JobId,
        (task, attempt): Attempt,
        lines: &LineColumns,
    ) -> Result<(), StoreError> {
        let (fence, worker) = match &self.holder {
            Some((fence, worker)) => (Some(number(*fence)), Some(worker.as_bytes())),
            None => (None, None),
        };
        let write = sqlx::query(
            "WITH noted AS (INSERT INTO log_attempts AS known \
             (job_id, stage, part, attempt, fence, worker, last_from_worker, bytes, starts) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9) \
             ON CONFLICT (job_id, stage, part, attempt) DO UPDATE SET \
             fence = coalesce(excluded.fence, known.fence), worker = coalesce(excluded.worker, known.worker), \
             last_from_worker = excluded.last_from_worker, bytes = excluded.bytes, starts = excluded.starts) \
             INSERT INTO log_lines (job_id, stage, part, attempt, \
             number, from_worker, time_ms, severity, after_cut, worker, message) \
             SELECT $1, $2, $3, $4, * FROM unnest($10::bigint[], $11::bigint[], $12::bigint[], \
             $13::smallint[], $14::boolean[], $15::bytea[], $16::bytea[])",
        );
        let write =
            write.bind(job.as_str()).bind(stage(task.stage)).bind(part(task)).bind(i64::from(attempt));
        let write = write.bind(fence).bind(worker).bind(number(self.last_from_worker));
        let write = write.bind(number(self.bytes)).bind(&self.starts);
        let write = write.bind(&lines.numbers).bind(&lines.from_worker).bind(&lines.times_ms);
        let write = write.bind(&lines.severities).bind(&lines.after_cut);
        write.bind(&lines.workers).bind(&lines.messages).execute(tx).await.map_err(unavailable)?;
        Ok(())
    }
}

/// Lines of one attempt, as columns for one statement.
#[derive(Default)]
struct LineColumns {
    numbers: Vec<i64>,
    from_worker: Vec<Option<i64>>,
    times_ms: Vec<i64>,
    severities: Vec<i16>,
    after_cut: Vec<bool>,
    workers: Vec<Vec<u8>>,
    messages: Vec<Vec<u8>>,
}

impl LineColumns {
    fn push(&mut self, row: Row, after_cut: bool) {
        self.numbers.push(number(row.number));
        self.from_worker.push(row.from_worker.map(number));
        self.times_ms.push(number(row.time_ms));
        self.severities.push(row.severity as i16);
        self.after_cut.push(after_cut);
        self.workers.push(row.worker.into_bytes());
        self.messages.push(row.message.into_bytes());
    }
}

/// Removes the lines of an attempt from one number up to another one, whose line then follows a cut.
async fn cut(
    tx: &mut PgConnection,
    job: &JobId,
    (task, attempt): Attempt,
    (from, to): (i64, i64),
) -> Result<(), StoreError> {
    sqlx::query(
        "WITH removed AS (DELETE FROM log_lines WHERE job_id = $1 AND stage = $2 AND part = $3 \
         AND number >= $5 AND number < $6 AND attempt = $4) \
         UPDATE log_lines SET after_cut = true WHERE job_id = $1 AND number = $6",
    )
    .bind(job.as_str())
    .bind(stage(task.stage))
    .bind(part(task))
    .bind(i64::from(attempt))
    .bind(from)
    .bind(to)
    .execute(tx)
    .await
    .map_err(unavailable)?;
    Ok(())
}

/// Removes too old attempts at the same task.
async fn forget_old_attempts(
    tx: &mut PgConnection,
    job: &JobId,
    (task, attempt): Attempt,
) -> Result<(), StoreError> {
    let Some(first) = attempt.checked_sub(ATTEMPTS_KEPT - 1).filter(|first| *first > 0) else {
        return Ok(());
    };
    sqlx::query(
        "WITH old AS (DELETE FROM log_attempts \
         WHERE job_id = $1 AND stage = $2 AND part = $3 AND attempt < $4 RETURNING attempt) \
         DELETE FROM log_lines WHERE job_id = $1 AND stage = $2 AND part = $3 \
         AND attempt IN (SELECT attempt FROM old)",
    )
    .bind(job.as_str())
    .bind(stage(task.stage))
    .bind(part(task))
    .bind(i64::from(first))
    .execute(tx)
    .await
    .map_err(unavailable)?;
    Ok(())
}

async fn holder(
    conn: &mut PgConnection,
    job: &JobId,
    (task, attempt): Attempt,
    fence: u64,
) -> Result<Option<Vec<u8>>, StoreError> {
    let found: Option<Option<Vec<u8>>> = sqlx::query_scalar(
        "SELECT worker FROM log_attempts \
         WHERE job_id = $1 AND stage = $2 AND part = $3 AND attempt = $4 AND fence = $5",
    )
    .bind(job.as_str())
    .bind(stage(task.stage))
    .bind(part(task))
    .bind(i64::from(attempt))
    .bind(number(fence))
    .fetch_optional(conn)
    .await
    .map_err(unavailable)?;
    Ok(found.flatten())
}

/// One statement, so that it sees the lines and the highest number of one moment. Where fewer lines than the
/// limit are found, it also returns up to which number it has looked; NULL: to the end.
macro_rules! page_where {
    ($of_task:literal) => {
        concat!(
            "WITH found AS MATERIALIZED (SELECT * FROM (SELECT * FROM log_lines \
             WHERE job_id = $1 AND number > $2",
            $of_task,
            " ORDER BY number LIMIT $3) AS looked_at \
             WHERE (severity >= $4 OR after_cut) AND ($5::bigint IS NULL OR attempt = $5) LIMIT $6) \
             SELECT ends.last, ends.looked_up_to, found.* FROM (SELECT \
             coalesce((SELECT last FROM log_jobs WHERE job_id = $1), 0) AS last, \
             CASE WHEN (SELECT count(*) FROM found) < $6 THEN (SELECT number FROM log_lines \
             WHERE job_id = $1 AND number > $2",
            $of_task,
            " ORDER BY number OFFSET $3 - 1 LIMIT 1) END AS looked_up_to) AS ends \
             LEFT JOIN found ON true ORDER BY found.number"
        )
    };
}

async fn read(
    conn: &mut PgConnection,
    job: &JobId,
    wanted: &Wanted,
    mut position: Position,
    limit: usize,
) -> Result<Page, StoreError> {
    let query = match wanted.task {
        None => sqlx::query(page_where!("")),
        Some(_) => sqlx::query(page_where!(" AND stage = $7 AND part = $8")),
    };
    let query = query.bind(job.as_str()).bind(number(position.number)).bind(LOOKED_AT as i64);
    let query = query.bind(wanted.severity as i16).bind(wanted.attempt.map(i64::from));
    let query = query.bind(number(limit as u64));
    let query = match wanted.task {
        None => query,
        Some(task) => query.bind(stage(task.stage)).bind(part(task)),
    };
    let rows = query.fetch_all(conn).await.map_err(unavailable)?;
    let (mut lines, mut count) = (Vec::new(), 0);
    for row in &rows {
        let Some((line, after_cut)) = kept_line(row)? else { continue };
        count += 1;
        let notice = after_cut.then(|| KeptLine { row: line.row.notice(), ..line });
        let read = position.number;
        for line in notice.into_iter().chain([line]).filter(|line| line.row.number > read) {
            if lines.len() == limit {
                return Ok(Page { lines, position, more: true });
            }
            position.number = line.row.number;
            if line.row.severity >= wanted.severity {
                lines.push(line);
            }
        }
    }
    let Some(first) = rows.first() else { return Ok(Page { lines, position, more: false }) };
    let last: i64 = first.try_get("last").map_err(unavailable)?;
    let looked_up_to: Option<i64> = first.try_get("looked_up_to").map_err(unavailable)?;
    let more = count >= limit || looked_up_to.is_some();
    if count < limit {
        position.number = position.number.max(looked_up_to.unwrap_or(last).unsigned_abs());
    }
    Ok(Page { lines, position, more })
}

/// The line of a row, and whether lines before it were removed; `None` where no line was found.
fn kept_line(row: &PgRow) -> Result<Option<(KeptLine, bool)>, StoreError> {
    let corrupt = |message: String| StoreError::Corrupt { tree: "log_lines", message };
    let Some(line_number) = get::<Option<i64>>(row, "number")? else { return Ok(None) };
    let severity: i16 = get(row, "severity")?;
    let severity = Severity::ALL.into_iter().find(|known| *known as i16 == severity);
    let severity = severity.ok_or_else(|| corrupt(format!("line {line_number} has no severity")))?;
    let attempt = u32::try_from(get::<i64>(row, "attempt")?).map_err(|error| corrupt(error.to_string()))?;
    let line = Row {
        number: line_number.unsigned_abs(),
        from_worker: get::<Option<i64>>(row, "from_worker")?.map(i64::unsigned_abs),
        time_ms: get::<i64>(row, "time_ms")?.unsigned_abs(),
        severity,
        worker: text(get(row, "worker")?),
        message: text(get(row, "message")?),
    };
    let task = task_of(get(row, "stage")?, get(row, "part")?)?;
    Ok(Some((KeptLine { task, attempt, row: line }, get(row, "after_cut")?)))
}

fn get<'r, T>(row: &'r PgRow, column: &str) -> Result<T, StoreError>
where
    T: sqlx::Decode<'r, sqlx::Postgres> + sqlx::Type<sqlx::Postgres>,
{
    row.try_get(column).map_err(unavailable)
}

/// Deletes the first lines of a job; returns their number.
async fn remove_first(conn: &mut PgConnection, job: &JobId) -> Result<u64, StoreError> {
    let deleted = sqlx::query(
        "DELETE FROM log_lines WHERE job_id = $1 AND number <= (SELECT max(number) FROM \
         (SELECT number FROM log_lines WHERE job_id = $1 ORDER BY number LIMIT $2) AS first)",
    )
    .bind(job.as_str())
    .bind(number(DELETED_AT_ONCE))
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(deleted.rows_affected())
}

/// Deletes what is left of a job.
async fn remove(conn: &mut PgConnection, job: &JobId) -> Result<(), StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    // First the row that an append locks: one that runs ends before.
    for delete in [
        "DELETE FROM log_jobs WHERE job_id = $1",
        "DELETE FROM log_attempts WHERE job_id = $1",
        "DELETE FROM log_lines WHERE job_id = $1",
        "DELETE FROM histories WHERE job_id = $1",
    ] {
        sqlx::query(delete).bind(job.as_str()).execute(&mut *tx).await.map_err(unavailable)?;
    }
    tx.commit().await.map_err(unavailable)
}

async fn jobs(conn: &mut PgConnection) -> Result<Vec<JobId>, StoreError> {
    let all = "SELECT job_id FROM log_jobs UNION SELECT job_id FROM histories ORDER BY job_id";
    let jobs: Vec<String> = sqlx::query_scalar(all).fetch_all(conn).await.map_err(unavailable)?;
    jobs.iter().map(|job| parse_job(job)).collect()
}

async fn last(conn: &mut PgConnection, job: &JobId) -> Result<u64, StoreError> {
    let last: Option<i64> = sqlx::query_scalar("SELECT last FROM log_jobs WHERE job_id = $1")
        .bind(job.as_str())
        .fetch_optional(conn)
        .await
        .map_err(unavailable)?;
    Ok(last.unwrap_or(0).unsigned_abs())
}

/// Adds lines with their numbers in one transaction. A notice marks the next line of its attempt.
async fn import(conn: &mut PgConnection, job: &JobId, lines: Vec<KeptLine>) -> Result<(), StoreError> {
    let Some(last) = lines.last().map(|line| line.row.number) else { return Ok(()) };
    let mut tx = conn.begin().await.map_err(unavailable)?;
    sqlx::query(
        "INSERT INTO log_jobs AS known (job_id, last) VALUES ($1, $2) \
         ON CONFLICT (job_id) DO UPDATE SET last = greatest(known.last, excluded.last)",
    )
    .bind(job.as_str())
    .bind(number(last))
    .execute(&mut *tx)
    .await
    .map_err(unavailable)?;
    let mut by_attempt = BTreeMap::<Attempt, Vec<Row>>::new();
    for KeptLine { task, attempt, row } in lines {
        by_attempt.entry((task, attempt)).or_default().push(row);
    }
    for (attempt, rows) in by_attempt {
        let mut log = AttemptLog::read(&mut tx, job, attempt).await?.unwrap_or_default();
        let (mut columns, mut after_cut) = (LineColumns::default(), false);
        for row in rows {
            if row.is_notice() {
                after_cut = true;
                continue;
            }
            if after_cut {
                log.begin_segment(row.number);
            }
            log.last_from_worker = log.last_from_worker.max(row.from_worker.unwrap_or(0));
            log.add(&row, COPIED_SEGMENT_BYTES);
            columns.push(row, std::mem::take(&mut after_cut));
        }
        log.write(&mut tx, job, attempt, &columns).await?;
    }
    tx.commit().await.map_err(unavailable)
}

fn text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes).unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned())
}
