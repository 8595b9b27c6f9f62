//! The store as a whole: export, import, and the invariants between its tables.

use std::collections::{BTreeMap, HashMap, HashSet};

use sqlx::{Connection, PgConnection};

use super::super::export::{Export, JobExport};
use super::super::record::{decode, encode};
use super::super::{StoreError, StoredEvent, WorkerMark, new_deployment, request_key};
use super::rows::{EventColumns, LeaseColumns, TaskColumns, number, parse_job, write_job};
use super::{begin_reading, datasets, tenants, unavailable};
use crate::schedule::{JobId, TaskRecord};

/// All data at one moment.
pub async fn export(conn: &mut PgConnection) -> Result<Export, StoreError> {
    let mut tx = begin_reading(conn).await?;
    let export = read_all(&mut tx).await?;
    tx.rollback().await.map_err(unavailable)?;
    Ok(export)
}

/// All data at one moment, and the faults of the tables at that moment.
pub async fn verified(conn: &mut PgConnection) -> Result<(Export, Vec<String>), StoreError> {
    let mut tx = begin_reading(conn).await?;
    let export = read_all(&mut tx).await?;
    let faults = index_faults(&mut tx, &export).await?;
    tx.rollback().await.map_err(unavailable)?;
    Ok((export, faults))
}

async fn read_all(tx: &mut PgConnection) -> Result<Export, StoreError> {
    let jobs: Vec<Vec<u8>> = sqlx::query_scalar("SELECT row FROM jobs ORDER BY job_id")
        .fetch_all(&mut *tx)
        .await
        .map_err(unavailable)?;
    let mut export = Export::default();
    let mut tasks =
        by_job::<TaskRecord>(tx, "tasks", "SELECT job_id, row FROM tasks ORDER BY job_id, stage, part")
            .await?;
    let mut events =
        by_job::<StoredEvent>(tx, "events", "SELECT job_id, row FROM events ORDER BY job_id, seq").await?;
    for bytes in &jobs {
        let job: crate::schedule::JobRecord = decode("jobs", bytes)?;
        let id = job.job_id.as_str();
        let mut tasks = tasks.remove(id).unwrap_or_default();
        tasks.sort_by_key(|record| record.task);
        let events = events.remove(id).unwrap_or_default();
        export.jobs.push(JobExport { job, tasks, events });
    }
    let known: HashSet<&JobId> = export.jobs.iter().map(|job| &job.job.job_id).collect();
    let requests: Vec<(Vec<u8>, String)> =
        sqlx::query_as("SELECT request, job_id FROM requests ORDER BY request")
            .fetch_all(&mut *tx)
            .await
            .map_err(unavailable)?;
    for (request, job) in requests {
        let job = parse_job(&job)?;
        if !known.contains(&job) {
            export.taken_requests.push((text(&request), job));
        }
    }
    export.marks = marks(tx).await?;
    export.quotas = tenants::quotas(tx).await?;
    export.tokens = tenants::tokens(tx).await?;
    export.datasets = datasets::read_page(tx, None, None, usize::MAX).await?;
    export.last_fence = last_fence(tx).await?;
    export.deployment = named(tx).await?;
    Ok(export)
}

async fn by_job<T: serde::de::DeserializeOwned>(
    tx: &mut PgConnection,
    table: &'static str,
    query: &'static str,
) -> Result<HashMap<String, Vec<T>>, StoreError> {
    let rows: Vec<(String, Vec<u8>)> = sqlx::query_as(query).fetch_all(tx).await.map_err(unavailable)?;
    let mut by_job = HashMap::<String, Vec<T>>::new();
    for (job, bytes) in rows {
        by_job.entry(job).or_default().push(decode(table, &bytes)?);
    }
    Ok(by_job)
}

/// The name of the deployment, made if it has none.
pub async fn deployment(conn: &mut PgConnection) -> Result<String, StoreError> {
    name(conn, &new_deployment()).await?;
    let name = named(conn).await?;
    name.ok_or_else(|| StoreError::Failed("the name of the deployment is missing".to_owned()))
}

async fn named(conn: &mut PgConnection) -> Result<Option<String>, StoreError> {
    sqlx::query_scalar("SELECT name FROM deployment").fetch_optional(conn).await.map_err(unavailable)
}

/// Names the deployment unless it has a name.
async fn name(conn: &mut PgConnection, name: &str) -> Result<(), StoreError> {
    sqlx::query("INSERT INTO deployment (name) VALUES ($1) ON CONFLICT DO NOTHING")
        .bind(name)
        .execute(conn)
        .await
        .map(drop)
        .map_err(unavailable)
}

async fn last_fence(conn: &mut PgConnection) -> Result<u64, StoreError> {
    let (last, is_called): (i64, bool) = sqlx::query_as("SELECT last_value, is_called FROM fences")
        .fetch_one(conn)
        .await
        .map_err(unavailable)?;
    Ok(if is_called { last.unsigned_abs() } else { 0 })
}

/// Marks of workers, by incarnation.
pub async fn marks(conn: &mut PgConnection) -> Result<Vec<(String, WorkerMark)>, StoreError> {
    let rows: Vec<(Vec<u8>, Vec<u8>)> =
        sqlx::query_as("SELECT incarnation, row FROM worker_marks ORDER BY incarnation")
            .fetch_all(conn)
            .await
            .map_err(unavailable)?;
    rows.into_iter().map(|(key, bytes)| Ok((text(&key), decode("workers", &bytes)?))).collect()
}

pub async fn write_mark(
    conn: &mut PgConnection,
    incarnation: &str,
    mark: Option<&WorkerMark>,
) -> Result<(), StoreError> {
    let write = match mark {
        Some(mark) => sqlx::query(
            "INSERT INTO worker_marks (incarnation, row) VALUES ($1, $2) \
             ON CONFLICT (incarnation) DO UPDATE SET row = excluded.row",
        )
        .bind(incarnation.as_bytes().to_vec())
        .bind(encode("workers", mark)?),
        None => sqlx::query("DELETE FROM worker_marks WHERE incarnation = $1")
            .bind(incarnation.as_bytes().to_vec()),
    };
    write.execute(conn).await.map_err(unavailable)?;
    Ok(())
}

pub async fn write_request(conn: &mut PgConnection, request: &str, job: &JobId) -> Result<(), StoreError> {
    sqlx::query("INSERT INTO requests (request, job_id) VALUES ($1, $2)")
        .bind(request.as_bytes())
        .bind(job.as_str())
        .execute(conn)
        .await
        .map_err(unavailable)?;
    Ok(())
}

/// Imports all data of another store into an empty one, in one transaction. Leases begin as over:
/// [`crate::store::JobStore::recover`] gives them their period.
pub async fn import(conn: &mut PgConnection, export: &Export) -> Result<(), StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    // Two imports at a time would mix.
    sqlx::query("LOCK TABLE requests IN EXCLUSIVE MODE").execute(&mut *tx).await.map_err(unavailable)?;
    let is_used: bool = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM requests)")
        .fetch_one(&mut *tx)
        .await
        .map_err(unavailable)?;
    if is_used {
        return Err(StoreError::NotEmpty);
    }
    for JobExport { job, tasks, events } in &export.jobs {
        let id = &job.job_id;
        write_request(&mut tx, &request_key(&job.tenant, &job.request_id), id).await?;
        write_job(&mut tx, job).await?;
        let (mut task_rows, mut event_rows) = (TaskColumns::default(), EventColumns::default());
        let mut leases = LeaseColumns::default();
        for record in tasks {
            task_rows.push(record, encode("tasks", record)?);
            for attempt in record.running().filter(|_| job.state.is_open()) {
                leases.push(record.task, attempt, 0, 0);
            }
        }
        for event in events {
            event_rows.push(event.seq, encode("events", event)?);
        }
        task_rows.write(&mut tx, id).await?;
        event_rows.write(&mut tx, id).await?;
        leases.write(&mut tx, id).await?;
    }
    for (request, job) in &export.taken_requests {
        write_request(&mut tx, request, job).await?;
    }
    for (incarnation, mark) in &export.marks {
        write_mark(&mut tx, incarnation, Some(mark)).await?;
    }
    for (tenant, quota) in &export.quotas {
        tenants::write_quota(&mut tx, tenant, Some(*quota)).await?;
    }
    for token in &export.tokens {
        tenants::write_token(&mut tx, token).await?;
    }
    for dataset in &export.datasets {
        datasets::write(&mut tx, dataset).await?;
    }
    // Its bucket is another one, or will be listed anew.
    let clear = sqlx::query("TRUNCATE blobs, uploads, blob_bytes, filled_ledgers");
    clear.execute(&mut *tx).await.map_err(unavailable)?;
    if let Some(exported) = &export.deployment {
        // An empty database may have been named when a coordinator tried it.
        sqlx::query("DELETE FROM deployment").execute(&mut *tx).await.map_err(unavailable)?;
        name(&mut tx, exported).await?;
    }
    let last = export.last_fence.max(last_fence(&mut tx).await?);
    if last > 0 {
        sqlx::query("SELECT setval('fences', $1)")
            .bind(number(last))
            .execute(&mut *tx)
            .await
            .map_err(unavailable)?;
    }
    tx.commit().await.map_err(unavailable)
}

/// A sentence for each row without a job, for each job that its request does not lead to, and for each column
/// that differs from its row. [`crate::store::verify`] checks the rows themselves.
async fn index_faults(conn: &mut PgConnection, export: &Export) -> Result<Vec<String>, StoreError> {
    let mut faults = Vec::new();
    let lost: Vec<(String, String)> = sqlx::query_as(
        "SELECT 'tasks', job_id FROM tasks WHERE job_id NOT IN (SELECT job_id FROM jobs) \
         UNION SELECT 'events', job_id FROM events WHERE job_id NOT IN (SELECT job_id FROM jobs) \
         UNION SELECT 'leases', job_id FROM leases WHERE job_id NOT IN (SELECT job_id FROM jobs)",
    )
    .fetch_all(&mut *conn)
    .await
    .map_err(unavailable)?;
    faults.extend(
        lost.into_iter().map(|(table, job)| format!("{table} has rows of job {job}, which does not exist")),
    );
    let requests: Vec<(Vec<u8>, String)> = sqlx::query_as("SELECT request, job_id FROM requests")
        .fetch_all(&mut *conn)
        .await
        .map_err(unavailable)?;
    let requests: BTreeMap<Vec<u8>, String> = requests.into_iter().collect();
    let jobs: Vec<(String, String, String, i64)> =
        sqlx::query_as("SELECT job_id, tenant, state, leased FROM jobs")
            .fetch_all(&mut *conn)
            .await
            .map_err(unavailable)?;
    let columns: HashMap<String, (String, String, i64)> =
        jobs.into_iter().map(|(job, tenant, state, leased)| (job, (tenant, state, leased))).collect();
    let leases: Vec<(String, i64)> = sqlx::query_as("SELECT job_id, count(*) FROM leases GROUP BY job_id")
        .fetch_all(&mut *conn)
        .await
        .map_err(unavailable)?;
    let leases: HashMap<String, i64> = leases.into_iter().collect();
    for JobExport { job, tasks, .. } in &export.jobs {
        let id = job.job_id.as_str();
        if requests.get(request_key(&job.tenant, &job.request_id).as_bytes()).map(String::as_str) != Some(id)
        {
            faults.push(format!("job {id}: its request does not lead to it"));
        }
        let wanted =
            (job.tenant.as_str().to_owned(), job.state.name().to_owned(), i64::from(job.leased_tasks));
        if columns.get(id) != Some(&wanted) {
            faults.push(format!("job {id}: its columns differ from its row"));
        }
        let held = tasks.iter().map(|record| record.running().count()).sum::<usize>() as i64;
        if leases.get(id).copied().unwrap_or(0) != held {
            faults.push(format!("job {id}: it has {held} leases, and the table leases has others"));
        }
    }
    Ok(faults)
}

fn text(key: &[u8]) -> String {
    String::from_utf8_lossy(key).into_owned()
}
