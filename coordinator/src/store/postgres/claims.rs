//! Claims: which jobs may have a task for a worker, in their order. The order is that of
//! [`crate::schedule::Queue`], by SQL. What is found here is a hint; the transaction of the job decides.
//!
//! A thousand idle workers ask several times a second. So one query serves all workers that take the same
//! tasks, for as long as this process changes nothing, and at most for [`HINT_FOR`]: others may have changed
//! something.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use sqlx::PgConnection;

use super::super::record::decode;
use super::super::{Claim, Grant, StoreError};
use super::batch::{Answer, Change, read_paces};
use super::rows::{call, number, parse_job, read_job, read_tasks, stages, task_of};
use super::tenants::parse;
use super::{Inner, Settings, unavailable};
use crate::schedule::{JobId, Stage, TaskRecord, TaskState, Tenant, usual_pace_ms};

/// How long a hint may be used.
const HINT_FOR: Duration = Duration::from_millis(200);
/// How long a call that had no lease is taken for one without a lease. Only its own transaction gives it one,
/// unless the call is repeated at another coordinator.
const NEW_FOR: Duration = Duration::from_secs(2);
/// Most entries of each memory; beyond it, it starts anew.
const REMEMBERED: usize = 8192;

/// A job that may have a task.
type Candidate = (JobId, Tenant);

/// Tasks that workers take.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Takes {
    stages: Vec<i16>,
    methods: Vec<&'static str>,
    memory_bytes: i64,
    tenant: Option<Tenant>,
}

/// The changes by this process that a result contains.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Version {
    changes: u64,
    grants: u64,
}

/// A result, with what it was when.
struct Hint<T> {
    version: Version,
    since: Instant,
    value: Arc<Vec<T>>,
}

impl Hint<Candidate> {
    /// Whether nothing that it names has changed. The order within a tenant does not depend on leases.
    fn holds(&self, version: Version) -> bool {
        let of_one_tenant = self.value.windows(2).all(|pair| pair[0].1 == pair[1].1);
        self.version == version || (self.version.changes == version.changes && of_one_tenant)
    }
}

/// A task that is slow, with the job's tenant.
struct Slow {
    job: JobId,
    tenant: Tenant,
    record: TaskRecord,
}

/// What claims remember. One query at a time: the others then use its result.
#[derive(Default)]
pub struct Hints {
    ready: tokio::sync::Mutex<HashMap<Takes, Hint<Candidate>>>,
    slow: tokio::sync::Mutex<Option<Hint<Slow>>>,
    new_calls: Mutex<HashMap<Vec<u8>, Instant>>,
}

/// The result of one look at all jobs.
enum Found {
    Granted(Box<Grant>),
    Nothing,
    AlreadyGiven,
}

impl Inner {
    /// The lease for a claim.
    pub async fn claim(self: &Arc<Self>, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let key = call(&claim.worker.incarnation, &claim.request_id);
        loop {
            if !self.is_new(&key)
                && let Some(grant) = self.given(claim, &key).await?
            {
                return Ok(Some(grant));
            }
            match self.claim_new(claim, now_ms).await? {
                Found::Granted(grant) => {
                    self.forget_new(&key);
                    return Ok(Some(*grant));
                }
                Found::Nothing => return Ok(None),
                // By a repeated call, in this moment.
                Found::AlreadyGiven => self.forget_new(&key),
            }
        }
    }

    async fn claim_new(self: &Arc<Self>, claim: &Claim, now_ms: u64) -> Result<Found, StoreError> {
        if claim.worker.stages.is_empty() {
            return Ok(Found::Nothing);
        }
        for (job, tenant) in self.with_ready_tasks(claim, now_ms).await?.iter() {
            let change = Change::ClaimReady(claim.clone());
            match self.change_if_it_exists(job, tenant, change, now_ms).await? {
                Answer::Granted(grant) => return Ok(Found::Granted(grant)),
                Answer::AlreadyGiven => return Ok(Found::AlreadyGiven),
                // The hint is out of date; others need not find that out too.
                _ => self.changed(),
            }
        }
        for slow in self.slow_tasks(now_ms).await?.iter() {
            let Slow { job, tenant, record } = slow;
            let holds_it = record.running().any(|attempt| attempt.incarnation == claim.worker.incarnation);
            if holds_it || !record.may_go_to(tenant, &claim.worker, &claim.peers) {
                continue;
            }
            let change = Change::ClaimSecond(claim.clone(), record.task);
            match self.change_if_it_exists(job, tenant, change, now_ms).await? {
                Answer::Granted(grant) => return Ok(Found::Granted(grant)),
                Answer::AlreadyGiven => return Ok(Found::AlreadyGiven),
                _ => {}
            }
        }
        Ok(Found::Nothing)
    }

    /// A hint may name a job that was deleted.
    async fn change_if_it_exists(
        self: &Arc<Self>,
        job: &JobId,
        tenant: &Tenant,
        change: Change,
        now_ms: u64,
    ) -> Result<Answer, StoreError> {
        match self.change(job, Some(tenant), change, now_ms).await {
            Err(StoreError::JobNotFound(_)) => Ok(Answer::NothingFree),
            answer => answer,
        }
    }

    /// The lease that this call got before, if it is still held.
    async fn given(&self, claim: &Claim, key: &[u8]) -> Result<Option<Grant>, StoreError> {
        let mut borrowed = self.connection().await?;
        let conn = &mut *borrowed.conn;
        let work = async {
            let found: Option<(String, i16, i64)> =
                sqlx::query_as("SELECT job_id, stage, part FROM leases WHERE call = $1")
                    .bind(key)
                    .fetch_optional(&mut *conn)
                    .await
                    .map_err(unavailable)?;
            let Some((job, stage, part)) = found else { return Ok(None) };
            let job = parse_job(&job)?;
            let (job_row, mut tasks) = (
                read_job(conn, &job, false).await?,
                read_tasks(conn, &job, Some(&[task_of(stage, part)?])).await?,
            );
            let (Some(job), Some(task)) = (job_row, tasks.pop()) else { return Ok(None) };
            Ok(Grant::of_call(claim, job, task))
        };
        let given = self.in_time(work).await;
        borrowed.done(&given);
        let given = given?;
        if given.is_none() {
            let mut calls = self.hints.new_calls.lock().unwrap_or_else(PoisonError::into_inner);
            if calls.len() >= REMEMBERED {
                calls.clear();
            }
            calls.insert(key.to_vec(), Instant::now());
        }
        Ok(given)
    }

    fn is_new(&self, key: &[u8]) -> bool {
        let calls = self.hints.new_calls.lock().unwrap_or_else(PoisonError::into_inner);
        calls.get(key).is_some_and(|since| since.elapsed() < NEW_FOR)
    }

    fn forget_new(&self, key: &[u8]) {
        self.hints.new_calls.lock().unwrap_or_else(PoisonError::into_inner).remove(key);
    }

    /// Running jobs with a ready task that the worker takes, in the order of service.
    async fn with_ready_tasks(&self, claim: &Claim, now_ms: u64) -> Result<Arc<Vec<Candidate>>, StoreError> {
        let worker = &claim.worker;
        let takes = Takes {
            stages: stages(&worker.stages),
            methods: worker.methods.iter().map(|method| method.name()).collect(),
            memory_bytes: worker.memory_bytes.map_or(i64::MAX, number),
            tenant: worker.tenant.clone(),
        };
        self.in_time(async {
            let mut hints = self.hints.ready.lock().await;
            let version = self.version();
            if let Some(hint) = hints.get(&takes).filter(|hint| self.may_use(hint) && hint.holds(version)) {
                return Ok(Arc::clone(&hint.value));
            }
            let (mut borrowed, since) = (self.connection().await?, Instant::now());
            let given_ms = self.settings.given_ms(now_ms);
            let found = ready_jobs(&self.settings, &mut borrowed.conn, &takes, given_ms).await;
            borrowed.done(&found);
            let value = Arc::new(found?);
            if hints.len() >= REMEMBERED {
                hints.clear();
            }
            hints.insert(takes, Hint { version, since, value: Arc::clone(&value) });
            Ok(value)
        })
        .await
    }

    /// Tasks that are slow, in the order of service.
    async fn slow_tasks(&self, now_ms: u64) -> Result<Arc<Vec<Slow>>, StoreError> {
        if self.settings.rules.straggler_factor <= 0.0 {
            return Ok(Arc::default());
        }
        self.in_time(async {
            let mut known = self.hints.slow.lock().await;
            let version = self.version();
            // Changes make no task slow, so only the time counts.
            if let Some(hint) = known.as_ref().filter(|hint| self.may_use(hint)) {
                return Ok(Arc::clone(&hint.value));
            }
            let (mut borrowed, since) = (self.connection().await?, Instant::now());
            let given_ms = self.settings.given_ms(now_ms);
            let found = slow_tasks(&self.settings, &mut borrowed.conn, given_ms).await;
            borrowed.done(&found);
            let value = Arc::new(found?);
            *known = Some(Hint { version, since, value: Arc::clone(&value) });
            Ok(value)
        })
        .await
    }

    fn version(&self) -> Version {
        Version { changes: self.version.load(SeqCst), grants: self.grants.load(SeqCst) }
    }

    /// Times that callers give may be far apart, so nothing is remembered then.
    fn may_use<T>(&self, hint: &Hint<T>) -> bool {
        self.settings.by_database_clock && hint.since.elapsed() < HINT_FOR
    }
}

/// Running jobs below their limits, in the order of service, that also satisfy `$condition`. `$1` is the
/// default limit of tenants, `$2` the only tenant or NULL.
macro_rules! jobs_in_turn {
    ($condition:literal) => {
        concat!(
            "WITH usage AS (SELECT tenant, sum(leased) AS leased FROM jobs \
             WHERE state IN ('running', 'paused') GROUP BY tenant) \
             SELECT jobs.job_id, jobs.tenant FROM jobs JOIN usage USING (tenant) \
             LEFT JOIN quotas USING (tenant) WHERE jobs.state = 'running' \
             AND ($2::text IS NULL OR jobs.tenant = $2) \
             AND (jobs.max_parallel = 0 OR jobs.leased < jobs.max_parallel) \
             AND (coalesce(quotas.max_parallel, $1) = 0 OR usage.leased < coalesce(quotas.max_parallel, $1)) \
             AND ",
            $condition,
            " ORDER BY usage.leased, jobs.priority DESC, jobs.job_id"
        )
    };
}

async fn ready_jobs(
    settings: &Settings,
    conn: &mut PgConnection,
    takes: &Takes,
    now_ms: Option<i64>,
) -> Result<Vec<Candidate>, StoreError> {
    let found: Vec<(String, String)> = sqlx::query_as(jobs_in_turn!(
        "EXISTS (SELECT 1 FROM tasks, (SELECT coalesce($6::bigint, now_ms()) AS now_ms) AS clock \
         WHERE tasks.ready_job = jobs.job_id AND tasks.stage = ANY($3) \
         AND tasks.method = ANY($4) AND tasks.memory_bytes <= $5 \
         AND (tasks.not_before_ms <= clock.now_ms OR tasks.not_before_ms > clock.now_ms + $7))"
    ))
    .bind(i64::from(settings.rules.quota.max_parallel))
    .bind(takes.tenant.as_ref().map(Tenant::as_str))
    .bind(&takes.stages)
    .bind(&takes.methods)
    .bind(takes.memory_bytes)
    .bind(now_ms)
    .bind(number(settings.rules.longest_pause_ms()))
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    found.into_iter().map(|(job, tenant)| Ok((parse_job(&job)?, parse("jobs", &tenant)?))).collect()
}

async fn slow_tasks(
    settings: &Settings,
    conn: &mut PgConnection,
    given_ms: Option<i64>,
) -> Result<Vec<Slow>, StoreError> {
    let with_siblings: Vec<Stage> = Stage::all().filter(|stage| stage.is_per_partition()).collect();
    let numbers = stages(&with_siblings);
    let found: Vec<(String, String)> = sqlx::query_as(jobs_in_turn!(
        "EXISTS (SELECT 1 FROM tasks WHERE tasks.leased_job = jobs.job_id \
         AND tasks.stage = ANY($3))"
    ))
    .bind(i64::from(settings.rules.quota.max_parallel))
    .bind(None::<&str>)
    .bind(&numbers)
    .fetch_all(&mut *conn)
    .await
    .map_err(unavailable)?;
    let now_ms = match given_ms {
        Some(now_ms) => now_ms.unsigned_abs(),
        None => super::database_ms(conn).await?,
    };
    let mut slow = Vec::new();
    for (job, tenant) in found {
        let (job, tenant) = (parse_job(&job)?, parse("jobs", &tenant)?);
        let rows: Vec<Vec<u8>> =
            sqlx::query_scalar("SELECT row FROM tasks WHERE leased_job = $1 AND stage = ANY($2)")
                .bind(job.as_str())
                .bind(&numbers)
                .fetch_all(&mut *conn)
                .await
                .map_err(unavailable)?;
        let records = rows.iter().map(|bytes| decode("tasks", bytes));
        let mut records = records.collect::<Result<Vec<TaskRecord>, _>>()?;
        records.retain(TaskRecord::may_have_second_attempt);
        records.sort_by_key(|record| record.task);
        let mut usual_ms = HashMap::<Stage, Option<f64>>::new();
        for record in records {
            let TaskState::Leased(first) = &record.state else { continue };
            // Nothing is slow before this age, and paces of thousands of tasks are much to read.
            if now_ms < first.since_ms.saturating_add(settings.rules.straggler_after_ms) {
                continue;
            }
            let stage = record.task.stage;
            let usual_ms = match usual_ms.entry(stage) {
                Entry::Occupied(known) => *known.get(),
                Entry::Vacant(unknown) => {
                    let paces_ms = read_paces(conn, &job, stage).await?;
                    *unknown.insert(usual_pace_ms(paces_ms.into_iter()))
                }
            };
            let iterations = record.iterations_of(first);
            let from_ms = usual_ms.and_then(|ms| settings.rules.slow_from_ms(first.since_ms, iterations, ms));
            if from_ms.is_some_and(|from_ms| from_ms <= now_ms) {
                slow.push(Slow { job: job.clone(), tenant: tenant.clone(), record });
            }
        }
    }
    Ok(slow)
}
