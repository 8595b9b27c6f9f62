//! Leases: renewals, the reports of their holders, and which of them are over.

use std::collections::BTreeMap;

use sqlx::PgConnection;

use super::super::StoreError;
use super::super::record::{decode, encode};
use super::rows::{LeaseKey, lease_of, number, part, stage, stages, task_of};
use super::{Settings, unavailable};
use crate::schedule::{JobId, Lease, LiveProgress, Renewed, Stage, TaskId};

/// Moves the deadline. The caller's connection need not wait for the disk: a renewal that a crash of the
/// database loses costs a part of the period, not data.
pub async fn renew(
    settings: &Settings,
    conn: &mut PgConnection,
    lease: &Lease,
    progress: Option<LiveProgress>,
    now_ms: Option<i64>,
) -> Result<Renewed, StoreError> {
    let held_out = progress.and_then(|progress| progress.held_out);
    let held_out = held_out.map(|held_out| encode("leases", &held_out)).transpose()?;
    let paused: Option<bool> = sqlx::query_scalar(
        "UPDATE leases SET deadline_ms = greatest(deadline_ms, clock.now_ms + $6), \
         still_since_ms = CASE WHEN $8::bigint IS NOT NULL AND iteration IS DISTINCT FROM $8 \
         THEN clock.now_ms ELSE still_since_ms END, \
         iteration = coalesce($8, iteration), iterations = coalesce($9, iterations), \
         gaussians = coalesce($10, gaussians), loss = coalesce($11, loss), speed = coalesce($12, speed), \
         held_out = CASE WHEN $8::bigint IS NULL THEN held_out ELSE $13 END \
         FROM (SELECT coalesce($7::bigint, now_ms()) AS now_ms) AS clock \
         WHERE job_id = $1 AND stage = $2 AND part = $3 AND fence = $4 AND attempt = $5 \
         RETURNING (SELECT state = 'paused' FROM jobs WHERE jobs.job_id = leases.job_id)",
    )
    .bind(lease.job.as_str())
    .bind(stage(lease.task.stage))
    .bind(part(lease.task))
    .bind(number(lease.fence))
    .bind(i64::from(lease.attempt))
    .bind(number(settings.lease_ms))
    .bind(now_ms)
    .bind(progress.map(|progress| i64::from(progress.iteration)))
    .bind(progress.map(|progress| i64::from(progress.iterations)))
    .bind(progress.map(|progress| i64::from(progress.gaussians)))
    .bind(progress.map(|progress| progress.loss))
    .bind(progress.map(|progress| progress.iterations_per_second))
    .bind(held_out)
    .fetch_optional(conn)
    .await
    .map_err(unavailable)?;
    Ok(of_paused(paused))
}

/// The outcome that a renewal would have.
pub async fn standing(conn: &mut PgConnection, lease: &Lease) -> Result<Renewed, StoreError> {
    let paused: Option<bool> = sqlx::query_scalar(
        "SELECT jobs.state = 'paused' FROM leases JOIN jobs USING (job_id) \
         WHERE job_id = $1 AND stage = $2 AND part = $3 AND fence = $4 AND attempt = $5",
    )
    .bind(lease.job.as_str())
    .bind(stage(lease.task.stage))
    .bind(part(lease.task))
    .bind(number(lease.fence))
    .bind(i64::from(lease.attempt))
    .fetch_optional(conn)
    .await
    .map_err(unavailable)?;
    Ok(of_paused(paused))
}

fn of_paused(paused: Option<bool>) -> Renewed {
    match paused {
        None => Renewed::Over,
        Some(true) => Renewed::ToBeReleased,
        Some(false) => Renewed::Runs,
    }
}

/// Leases that may have to be revoked, in a fixed order; each is looked at again under the lock of its job.
pub async fn overdue(
    settings: &Settings,
    conn: &mut PgConnection,
    now_ms: Option<i64>,
) -> Result<Vec<Lease>, StoreError> {
    let found: Vec<LeaseKey> = sqlx::query_as(
        "SELECT job_id, stage, part, fence, attempt FROM leases, \
         (SELECT coalesce($1::bigint, now_ms()) AS now_ms) AS clock WHERE deadline_ms <= clock.now_ms \
         OR ($2 > 0 AND still_since_ms + $2 <= clock.now_ms AND stage <> ALL($3)) \
         ORDER BY job_id, stage, part, fence",
    )
    .bind(now_ms)
    .bind(number(settings.stall_ms))
    .bind(stages(&Stage::own()))
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let mut leases = found.into_iter().map(lease_of).collect::<Result<Vec<_>, _>>()?;
    leases.sort_by(|a, b| (&a.job, a.task, a.fence).cmp(&(&b.job, b.task, b.fence)));
    Ok(leases)
}

/// Gives every lease a full period. A lease that was already over starts its report anew, because its holder
/// could not report.
pub async fn extend(
    settings: &Settings,
    conn: &mut PgConnection,
    now_ms: Option<i64>,
) -> Result<(), StoreError> {
    sqlx::query(
        "UPDATE leases SET deadline_ms = greatest(deadline_ms, clock.now_ms + $1), \
         still_since_ms = CASE WHEN deadline_ms <= clock.now_ms THEN clock.now_ms ELSE still_since_ms END \
         FROM (SELECT coalesce($2::bigint, now_ms()) AS now_ms) AS clock",
    )
    .bind(number(settings.lease_ms))
    .bind(now_ms)
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(())
}

/// The coordinator's own tasks whose leases are over.
pub async fn abandoned_own(conn: &mut PgConnection, now_ms: Option<i64>) -> Result<Vec<Lease>, StoreError> {
    let found: Vec<LeaseKey> = sqlx::query_as(
        "SELECT job_id, stage, part, fence, attempt FROM leases \
         WHERE stage = ANY($1) AND deadline_ms <= coalesce($2::bigint, now_ms()) ORDER BY job_id, stage, part",
    )
    .bind(stages(&Stage::own()))
    .bind(now_ms)
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    found.into_iter().map(lease_of).collect()
}

type Report = (i16, i64, Option<i64>, Option<i64>, Option<i64>, Option<f32>, Option<f32>, Option<Vec<u8>>);

/// The last reports of the leased tasks of a job, in the order of tasks; of two attempts at a task, the one
/// further ahead.
pub async fn progress(
    conn: &mut PgConnection,
    job: &JobId,
) -> Result<BTreeMap<TaskId, LiveProgress>, StoreError> {
    let rows: Vec<Report> = sqlx::query_as(
        "SELECT stage, part, iteration, iterations, gaussians, loss, speed, held_out FROM leases \
         WHERE job_id = $1 AND iteration IS NOT NULL ORDER BY stage, part, fence",
    )
    .bind(job.as_str())
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let mut by_task = BTreeMap::new();
    for (stage, part, iteration, iterations, gaussians, loss, speed, held_out) in rows {
        let count = |number: Option<i64>| u32::try_from(number.unwrap_or(0)).unwrap_or(u32::MAX);
        let progress = LiveProgress {
            iteration: count(iteration),
            iterations: count(iterations),
            gaussians: count(gaussians),
            loss: loss.unwrap_or(0.0),
            iterations_per_second: speed.unwrap_or(0.0),
            held_out: held_out.map(|bytes| decode("leases", &bytes)).transpose()?,
        };
        let kept = by_task.entry(task_of(stage, part)?).or_insert(progress);
        if progress.iteration > kept.iteration {
            *kept = progress;
        }
    }
    Ok(by_task)
}

/// Number of running leases by stage, and the sum of their training speeds.
pub async fn levels(conn: &mut PgConnection) -> Result<(BTreeMap<Stage, usize>, f64), StoreError> {
    let rows: Vec<(i16, i64, Option<f64>)> = sqlx::query_as(
        "SELECT stage, count(*), sum(speed::double precision) \
         FILTER (WHERE speed NOT IN ('NaN', 'Infinity', '-Infinity')) FROM leases GROUP BY stage",
    )
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let (mut by_stage, mut speed) = (BTreeMap::new(), 0.0);
    for (stage, count, speed_of_stage) in rows {
        by_stage.insert(task_of(stage, 0)?.stage, usize::try_from(count).unwrap_or(0));
        speed += speed_of_stage.unwrap_or(0.0);
    }
    Ok((by_stage, speed))
}
