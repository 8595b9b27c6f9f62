//! New jobs, deleted ones, and what is known of all of them.

use std::collections::BTreeMap;

use fathom_core::config::Method;
use sqlx::{Connection, PgConnection};

use super::super::record::{decode, encode};
use super::super::{JobFilter, JobView, Levels, NewJob, StoreError, StoredEvent, request_key};
use super::locks::{self, Held};
use super::rows::{
    EventColumns, TaskColumns, parse_job, parse_job_state, read_job, read_tasks, stages, task_of, write_job,
};
use super::tenants::{parse, quota_of, usage_of};
use super::{Inner, begin_reading, datasets, leases, unavailable, whole};
use crate::schedule::{
    Attempt, JobId, JobRecord, Lease, OpenWork, ReadyTask, Refusal, Requirements, Stage, TaskRecord,
};

/// Jobs that a list reads at a time.
const PAGE: i64 = 256;

/// Creates a job, or finds the one that this request created.
pub async fn create(
    store: &Inner,
    conn: &mut PgConnection,
    new: &NewJob,
    now_ms: u64,
) -> Result<JobRecord, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::tenant(&mut tx, &new.tenant, Held::Alone).await?;
    let request = request_key(&new.tenant, &new.request_id);
    let known: Option<String> = sqlx::query_scalar("SELECT job_id FROM requests WHERE request = $1")
        .bind(request.as_bytes())
        .fetch_optional(&mut *tx)
        .await
        .map_err(unavailable)?;
    if let Some(known) = known {
        let id = parse_job(&known)?;
        return match read_job(&mut tx, &id, false).await? {
            Some(job) if new.is_same_as(&job) => Ok(job),
            _ => Err(StoreError::RequestIdReused { request_id: new.request_id.clone() }),
        };
    }
    if let Some(id) = &new.dataset
        && !datasets::read(&mut tx, &new.tenant, id).await?.is_committed()
    {
        return Err(StoreError::DatasetNotCommitted(id.clone()));
    }
    let limit = store.settings.or_default(quota_of(&mut tx, &new.tenant).await?).max_open_jobs;
    if limit > 0 && usage_of(&mut tx, &new.tenant).await?.open_jobs >= limit {
        return Err(StoreError::TooManyJobs { tenant: new.tenant.clone(), limit });
    }
    let now_ms = store.now_ms(&mut tx, now_ms).await?;
    let first = StoredEvent { seq: 1, time_ms: now_ms, body: new.first_event() };
    let (job, plan) = new.clone().into_rows(now_ms);
    let (mut tasks, mut events) = (TaskColumns::default(), EventColumns::default());
    tasks.push(&plan, encode("tasks", &plan)?);
    events.push(1, encode("events", &first)?);
    whole::write_request(&mut tx, &request, &job.job_id).await?;
    write_job(&mut tx, &job).await?;
    tasks.write(&mut tx, &job.job_id).await?;
    events.write(&mut tx, &job.job_id).await?;
    tx.commit().await.map_err(unavailable)?;
    Ok(job)
}

/// Deletes a job that has ended, except its request.
pub async fn forget(conn: &mut PgConnection, id: &JobId) -> Result<(), StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    let job = read_job(&mut tx, id, true).await?.ok_or_else(|| StoreError::JobNotFound(id.clone()))?;
    if job.state.is_open() {
        return Err(Refusal::NotEnded.into());
    }
    for delete in [
        "DELETE FROM events WHERE job_id = $1",
        "DELETE FROM tasks WHERE job_id = $1",
        "DELETE FROM leases WHERE job_id = $1",
        "DELETE FROM jobs WHERE job_id = $1",
    ] {
        sqlx::query(delete).bind(id.as_str()).execute(&mut *tx).await.map_err(unavailable)?;
    }
    tx.commit().await.map_err(unavailable)
}

/// One job with its tasks, of one moment.
pub async fn view(conn: &mut PgConnection, id: &JobId) -> Result<JobView, StoreError> {
    let mut tx = begin_reading(conn).await?;
    let job = read_job(&mut tx, id, false).await?.ok_or_else(|| StoreError::JobNotFound(id.clone()))?;
    let mut tasks = read_tasks(&mut tx, id, None).await?;
    let mut progress = leases::progress(&mut tx, id).await?;
    tx.rollback().await.map_err(unavailable)?;
    tasks.sort_by_key(|record| record.task);
    let with_progress = |record: TaskRecord| {
        let progress = progress.remove(&record.task);
        (record, progress)
    };
    Ok(JobView { tasks: tasks.into_iter().map(with_progress).collect(), job })
}

/// Jobs that match `filter` and are older than `before`, the newest first.
pub async fn list(
    conn: &mut PgConnection,
    filter: &JobFilter,
    before: Option<&JobId>,
    limit: usize,
) -> Result<Vec<JobRecord>, StoreError> {
    let states: Vec<&str> = filter.states.iter().map(|state| state.name()).collect();
    let mut before = before.cloned();
    let mut found = Vec::new();
    while found.len() < limit {
        let rows: Vec<Vec<u8>> = sqlx::query_scalar(
            "SELECT row FROM jobs WHERE ($1::text IS NULL OR tenant = $1) \
             AND (cardinality($2::text[]) = 0 OR state = ANY($2)) \
             AND ($3::text IS NULL OR job_id < $3) ORDER BY job_id DESC LIMIT $4",
        )
        .bind(filter.tenant.as_ref().map(|tenant| tenant.as_str().to_owned()))
        .bind(&states)
        .bind(before.as_ref().map(|before| before.as_str().to_owned()))
        .bind(PAGE)
        .fetch_all(&mut *conn)
        .await
        .map_err(unavailable)?;
        let jobs = rows.iter().map(|bytes| decode::<JobRecord>("jobs", bytes));
        let jobs = jobs.collect::<Result<Vec<_>, _>>()?;
        let is_last = jobs.len() < PAGE as usize;
        before = jobs.last().map(|job| job.job_id.clone());
        // Names may contain any character, so the database does not look for them.
        found.extend(jobs.into_iter().filter(|job| filter.admits(job)));
        if is_last {
            break;
        }
    }
    found.truncate(limit);
    Ok(found)
}

/// `job_id, tenant, max_parallel, stage, part, method, memory_bytes, not_before_ms` of a task.
type Waiting = (String, String, i64, i16, i64, String, i64, i64);

/// Waiting tasks of running jobs, in order, without their rows: the sweeper asks every second, and there may
/// be ten thousand.
async fn waiting(conn: &mut PgConnection) -> Result<Vec<Waiting>, StoreError> {
    sqlx::query_as(
        "SELECT ready_job, tenant, max_parallel, stage, part, method, memory_bytes, not_before_ms \
         FROM jobs JOIN tasks ON ready_job = jobs.job_id WHERE jobs.state = 'running' \
         ORDER BY ready_job, array_position($1::smallint[], stage), part",
    )
    .bind(stages(&Stage::all().collect::<Vec<_>>()))
    .fetch_all(conn)
    .await
    .map_err(unavailable)
}

fn need(stage: i16, part: i64, method: &str, memory_bytes: i64) -> Result<Requirements, StoreError> {
    let corrupt = || StoreError::Corrupt { tree: "tasks", message: format!("the method {method:?}") };
    let method = Method::ALL.into_iter().find(|known| known.name() == method).ok_or_else(corrupt)?;
    Ok(Requirements { task: task_of(stage, part)?, method, memory_bytes: memory_bytes.unsigned_abs() })
}

/// Waiting tasks of running jobs, including those in back-off.
pub async fn ready(conn: &mut PgConnection) -> Result<Vec<ReadyTask>, StoreError> {
    let rows = waiting(conn).await?.into_iter();
    let ready = rows.map(|(job, tenant, _, stage, part, method, memory_bytes, not_before_ms)| {
        Ok(ReadyTask {
            job: parse_job(&job)?,
            tenant: parse("jobs", &tenant)?,
            need: need(stage, part, &method, memory_bytes)?,
            not_before_ms: not_before_ms.unsigned_abs(),
        })
    });
    ready.collect()
}

/// The tasks of each running job.
pub async fn open_work(conn: &mut PgConnection) -> Result<Vec<OpenWork>, StoreError> {
    let mut tx = begin_reading(conn).await?;
    let jobs: Vec<(String, String, i64)> =
        sqlx::query_as("SELECT job_id, tenant, max_parallel FROM jobs WHERE state = 'running'")
            .fetch_all(&mut *tx)
            .await
            .map_err(unavailable)?;
    let mut work = BTreeMap::new();
    for (job, tenant, max_parallel) in jobs {
        let (tenant, max_parallel) =
            (parse("jobs", &tenant)?, u32::try_from(max_parallel).unwrap_or(u32::MAX));
        let of_job = OpenWork { tenant, max_parallel, waiting: Vec::new(), leased: Vec::new() };
        work.insert(job, of_job);
    }
    for (job, _, _, stage, part, method, memory_bytes, not_before_ms) in waiting(&mut tx).await? {
        let need = need(stage, part, &method, memory_bytes)?;
        work.entry(job).and_modify(|work| work.waiting.push((need, not_before_ms.unsigned_abs())));
    }
    let leased: Vec<(String, i16, i64, String, i64)> = sqlx::query_as(
        "SELECT job_id, stage, part, method, memory_bytes FROM leases JOIN tasks USING (job_id, stage, part) \
         ORDER BY job_id, array_position($1::smallint[], stage), part, fence",
    )
    .bind(stages(&Stage::all().collect::<Vec<_>>()))
    .fetch_all(&mut *tx)
    .await
    .map_err(unavailable)?;
    tx.rollback().await.map_err(unavailable)?;
    for (job, stage, part, method, memory_bytes) in leased {
        let need = need(stage, part, &method, memory_bytes)?;
        work.entry(job).and_modify(|work| work.leased.push(need));
    }
    Ok(work.into_values().collect())
}

/// All leases that are held, each with its attempt.
pub async fn leased(conn: &mut PgConnection) -> Result<Vec<(Lease, Attempt)>, StoreError> {
    let rows: Vec<(String, Vec<u8>)> = sqlx::query_as(
        "SELECT leased_job, tasks.row FROM jobs JOIN tasks ON leased_job = jobs.job_id \
         WHERE jobs.state IN ('running', 'paused')",
    )
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let mut held = Vec::new();
    for (job, bytes) in rows {
        let job = parse_job(&job)?;
        let record: TaskRecord = decode("tasks", &bytes)?;
        held.extend(record.running().map(|attempt| (record.lease_of(&job, attempt), attempt.clone())));
    }
    held.sort_by(|(a, _), (b, _)| (&a.job, a.task, a.fence).cmp(&(&b.job, b.task, b.fence)));
    Ok(held)
}

/// The gauges. Ended jobs are counted in an index.
pub async fn levels(conn: &mut PgConnection) -> Result<Levels, StoreError> {
    let counts: Vec<(String, i64)> = sqlx::query_as("SELECT state, count(*) FROM jobs GROUP BY state")
        .fetch_all(&mut *conn)
        .await
        .map_err(unavailable)?;
    let mut jobs = BTreeMap::new();
    for (state, count) in counts {
        jobs.insert(parse_job_state(&state)?, usize::try_from(count).unwrap_or(0));
    }
    let ready = ready(conn).await?;
    Ok(Levels::of(jobs, &ready, leases::levels(conn).await?))
}
