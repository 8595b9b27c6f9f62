//! One transaction with all changes of a job that waited for it.
//!
//! Events of a job are numbered without a gap and its limit of leases is exact, so every change locks the row
//! of its job. A commit costs a sync of the database's disk; changes that wait for the same row share it.
//!
//! Order of locks: tenants, calls, job, leases. Every transaction of this store follows it, so none waits in
//! a circle.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use sqlx::{Connection, PgConnection};

use super::super::record::{decode, encode};
use super::super::{Claim, Grant, StoreError, StoredEvent};
use super::locks::{self, Held};
use super::rows::{
    EventColumns, LeaseColumns, TaskColumns, call, number, part, read_job, read_tasks, stage, stages,
    write_job,
};
use super::tenants::{quota_of, usage_of};
use super::{Settings, database_ms, unavailable};
use crate::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, JobRows, JobState, Lease, Outcome, Refusal, RowsNeeded, Stage,
    TaskId, TaskRecord, TaskState, Tenant, rows_needed, step, usual_pace_ms,
};

/// Ready tasks that a query for claims returns at a time.
const PAGE: usize = 64;

/// A change that waits for the lock of its job.
pub enum Change {
    /// An event that is not a claim.
    Event(Event),
    /// The lease is revoked, unless it was renewed meanwhile.
    Expire(Lease),
    /// The next task that is ready and fits.
    ClaimReady(Claim),
    /// A second attempt at a task.
    ClaimSecond(Claim, TaskId),
}

impl Change {
    /// Whether it asks for a lease.
    pub fn is_claim(&self) -> bool {
        self.claim().is_some()
    }

    fn claim(&self) -> Option<&Claim> {
        match self {
            Self::ClaimReady(claim) | Self::ClaimSecond(claim, _) => Some(claim),
            Self::Event(_) | Self::Expire(_) => None,
        }
    }
}

/// The answer to a change.
#[derive(Debug)]
pub enum Answer {
    /// An event was applied.
    Applied(Outcome),
    /// Why the lease was revoked; `None` if it was renewed meanwhile.
    Expired(Option<Expired>),
    /// The lease that was granted.
    Granted(Box<Grant>),
    /// No task of the job is free for this claim.
    NothingFree,
    /// The call has a lease already, perhaps of another job.
    AlreadyGiven,
}

/// A change with the caller's time, Unix milliseconds.
pub type Timed = (Change, u64);

/// Answers in the order of the changes, and whether anything was written.
pub type Answers = (Vec<Result<Answer, StoreError>>, bool);

/// Runs one transaction; an answer for each change, and whether anything was written.
///
/// # Errors
/// When the database fails: no change was applied, or, if the connection broke at the commit, perhaps all.
pub async fn run(
    settings: &Settings,
    conn: &mut PgConnection,
    id: &JobId,
    tenant: Option<&Tenant>,
    changes: Vec<Timed>,
) -> Result<Answers, StoreError> {
    let claims: Vec<&Claim> = changes.iter().filter_map(|(change, _)| change.claim()).collect();
    let tenant = tenant.filter(|_| !claims.is_empty());
    let (mut tx, left_of_tenant) = loop {
        let mut tx = conn.begin().await.map_err(unavailable)?;
        let Some(tenant) = tenant else { break (tx, u32::MAX) };
        if let Some(left) = leases_left(settings, &mut tx, tenant).await? {
            break (tx, left);
        }
        // Its quota changed before the lock was taken.
        tx.rollback().await.map_err(unavailable)?;
    };
    let mut given = BTreeSet::new();
    if !claims.is_empty() {
        let of_claim = |claim: &&Claim| call(&claim.worker.incarnation, &claim.request_id);
        let calls: Vec<Vec<u8>> = claims.iter().map(of_claim).collect();
        locks::calls(&mut tx, &calls).await?;
        let known: Vec<Vec<u8>> = sqlx::query_scalar("SELECT call FROM leases WHERE call = ANY($1)")
            .bind(&calls)
            .fetch_all(&mut *tx)
            .await
            .map_err(unavailable)?;
        given.extend(known);
    }
    let Some(job) = read_job(&mut tx, id, true).await? else {
        return Ok((changes.iter().map(|_| Err(StoreError::JobNotFound(id.clone()))).collect(), false));
    };
    let database_ms = if settings.by_database_clock { Some(database_ms(&mut tx).await?) } else { None };
    let fences = match claims.len() {
        0 => Vec::new(),
        count => next_fences(&mut tx, count).await?,
    };
    let mut batch = Batch {
        settings,
        tx: &mut tx,
        before: job.clone(),
        rows: JobRows { job, tasks: BTreeMap::new() },
        has_all: false,
        fences: fences.into_iter(),
        given,
        left_of_tenant,
        ready: HashMap::new(),
        written: BTreeMap::new(),
        events: EventColumns::default(),
        begun: BTreeMap::new(),
        ended: BTreeSet::new(),
    };
    batch.read_ahead(&changes).await?;
    let mut answers = Vec::with_capacity(changes.len());
    for (change, now_ms) in changes {
        let answer = batch.apply(change, database_ms.unwrap_or(now_ms)).await;
        match answer {
            // Nothing can follow it in this transaction.
            Err(error @ StoreError::Unavailable(_)) => return Err(error),
            answer => answers.push(answer),
        }
    }
    let has_written = batch.write().await?;
    if has_written {
        tx.commit().await.map_err(unavailable)?;
    } else {
        // Frees the locks; there is nothing to keep.
        tx.rollback().await.map_err(unavailable)?;
    }
    Ok((answers, has_written))
}

/// Locks the tenant as its quota requires; returns how many more tasks it may have leased. `None`: its quota
/// changed before the lock was taken.
async fn leases_left(
    settings: &Settings,
    tx: &mut PgConnection,
    tenant: &Tenant,
) -> Result<Option<u32>, StoreError> {
    // Without a limit, claims of one tenant need not wait for each other. The lock is shared even then, so
    // that nobody sets a limit in the middle of a claim.
    let expected = settings.or_default(quota_of(tx, tenant).await?).max_parallel;
    let lock = if expected == 0 { Held::WithOthers } else { Held::Alone };
    locks::tenant(tx, tenant, lock).await?;
    let limit = settings.or_default(quota_of(tx, tenant).await?).max_parallel;
    if (limit == 0) != (expected == 0) {
        return Ok(None);
    }
    if limit == 0 {
        return Ok(Some(u32::MAX));
    }
    Ok(Some(limit.saturating_sub(usage_of(tx, tenant).await?.leased_tasks)))
}

/// Fences that nobody has got, ascending. Asked under the lock of the job: they are then larger than all that
/// its tasks have.
async fn next_fences(tx: &mut PgConnection, count: usize) -> Result<Vec<u64>, StoreError> {
    let fences: Vec<i64> = sqlx::query_scalar("SELECT nextval('fences') FROM generate_series(1, $1)")
        .bind(number(count as u64))
        .fetch_all(tx)
        .await
        .map_err(unavailable)?;
    let mut fences: Vec<u64> = fences.into_iter().map(|fence| fence.unsigned_abs()).collect();
    fences.sort_unstable();
    Ok(fences)
}

/// Requirements that claims share: one query serves them all.
#[derive(PartialEq, Eq, Hash)]
struct Fit {
    stages: Vec<i16>,
    methods: Vec<&'static str>,
    memory_bytes: i64,
}

/// Ready tasks for claims of one [`Fit`], read by page.
#[derive(Default)]
struct Ready {
    tasks: Vec<TaskRecord>,
    is_complete: bool,
}

struct Batch<'a> {
    settings: &'a Settings,
    tx: &'a mut PgConnection,
    before: JobRecord,
    /// The job and the tasks that were read, with all changes so far.
    rows: JobRows,
    has_all: bool,
    fences: std::vec::IntoIter<u64>,
    /// Calls that have a lease.
    given: BTreeSet<Vec<u8>>,
    left_of_tenant: u32,
    ready: HashMap<Fit, Ready>,
    /// Encoded rows of changed tasks.
    written: BTreeMap<TaskId, Vec<u8>>,
    events: EventColumns,
    /// New leases, by task and fence, with the time of their grant.
    begun: BTreeMap<(TaskId, u64), (Attempt, u64)>,
    /// Ended ones that are in the database.
    ended: BTreeSet<(TaskId, u64)>,
}

impl Batch<'_> {
    /// Reads the tasks that most changes need, with one query.
    async fn read_ahead(&mut self, changes: &[Timed]) -> Result<(), StoreError> {
        let mut wanted = Vec::new();
        for (change, _) in changes {
            match change {
                Change::Event(event) => match rows_needed(&self.rows.job, event) {
                    RowsNeeded::All => return self.read(None).await,
                    RowsNeeded::Some(tasks) => wanted.extend(tasks),
                },
                Change::Expire(_) => return self.read(None).await,
                Change::ClaimSecond(_, task) => wanted.push(*task),
                Change::ClaimReady(_) => {}
            }
        }
        self.read(Some(wanted)).await
    }

    /// Reads tasks that are not known yet; `None`: all of them.
    async fn read(&mut self, wanted: Option<Vec<TaskId>>) -> Result<(), StoreError> {
        if self.has_all {
            return Ok(());
        }
        let missing = wanted.map(|mut tasks| {
            tasks.retain(|task| !self.rows.tasks.contains_key(task));
            tasks.sort_unstable();
            tasks.dedup();
            tasks
        });
        if missing.as_ref().is_some_and(Vec::is_empty) {
            return Ok(());
        }
        self.has_all = missing.is_none();
        let records = read_tasks(self.tx, &self.rows.job.job_id, missing.as_deref()).await?;
        for record in records {
            // Known ones may have changed in this transaction.
            self.rows.tasks.entry(record.task).or_insert(record);
        }
        Ok(())
    }

    async fn apply(&mut self, change: Change, now_ms: u64) -> Result<Answer, StoreError> {
        match change {
            Change::Event(event) => self.step(event, now_ms).await.map(Answer::Applied),
            Change::Expire(lease) => match self.expires(&lease, now_ms).await? {
                None => Ok(Answer::Expired(None)),
                Some(why) => {
                    self.step(Event::Expire { lease, why }, now_ms).await?;
                    Ok(Answer::Expired(Some(why)))
                }
            },
            Change::ClaimReady(claim) => {
                if let Some(refused) = self.refuses(&claim) {
                    return Ok(refused);
                }
                match self.next_ready(&claim, now_ms).await? {
                    None => Ok(Answer::NothingFree),
                    Some(task) => self.grant(claim, task, false, now_ms).await,
                }
            }
            Change::ClaimSecond(claim, task) => {
                if let Some(refused) = self.refuses(&claim) {
                    return Ok(refused);
                }
                if !self.is_slow(task, now_ms).await? {
                    return Ok(Answer::NothingFree);
                }
                self.grant(claim, task, true, now_ms).await
            }
        }
    }

    /// Applies an event to the rows; an error changes none of them.
    async fn step(&mut self, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        let needed = match rows_needed(&self.rows.job, &event) {
            RowsNeeded::All => {
                self.read(None).await?;
                self.rows.tasks.keys().copied().collect()
            }
            RowsNeeded::Some(tasks) => {
                self.read(Some(tasks.clone())).await?;
                tasks
            }
        };
        let known = |task: TaskId| Some((task, self.rows.tasks.get(&task)?.clone()));
        let mut after =
            JobRows { job: self.rows.job.clone(), tasks: needed.into_iter().filter_map(known).collect() };
        let outcome = step(&mut after, event, now_ms, &self.settings.rules)?;
        let Outcome::Changed(bodies) = &outcome else { return Ok(outcome) };
        // Encoded at once: a row that is too large is the fault of this event alone.
        encode("jobs", &after.job)?;
        let first_seq = self.rows.job.last_seq + 1;
        let mut events = Vec::with_capacity(bodies.len());
        for (seq, body) in (first_seq..).zip(bodies) {
            events.push((seq, encode("events", &StoredEvent { seq, time_ms: now_ms, body: body.clone() })?));
        }
        let mut changed = Vec::new();
        for (task, record) in after.tasks {
            if self.rows.tasks.get(&task) != Some(&record) {
                changed.push((encode("tasks", &record)?, record));
            }
        }
        self.rows.job = after.job;
        events.into_iter().for_each(|(seq, bytes)| self.events.push(seq, bytes));
        for (bytes, record) in changed {
            self.note_leases(&record, now_ms);
            self.written.insert(record.task, bytes);
            self.rows.tasks.insert(record.task, record);
        }
        Ok(outcome)
    }

    /// Compares the leases of a task before and after a change.
    fn note_leases(&mut self, after: &TaskRecord, now_ms: u64) {
        let task = after.task;
        let held = |record: &TaskRecord| -> Vec<Attempt> { record.running().cloned().collect() };
        let before = self.rows.tasks.get(&task).map(held).unwrap_or_default();
        let after = held(after);
        for attempt in before.iter().filter(|attempt| !after.contains(attempt)) {
            if self.begun.remove(&(task, attempt.fence)).is_none() {
                self.ended.insert((task, attempt.fence));
            }
        }
        for attempt in after.into_iter().filter(|attempt| !before.contains(attempt)) {
            self.begun.insert((task, attempt.fence), (attempt, now_ms));
        }
    }

    /// Why a lease is over, if it still is.
    async fn expires(&mut self, lease: &Lease, now_ms: u64) -> Result<Option<Expired>, StoreError> {
        let found: Option<(i64, i64)> = sqlx::query_as(
            "SELECT deadline_ms, still_since_ms FROM leases \
             WHERE job_id = $1 AND stage = $2 AND part = $3 AND fence = $4 AND attempt = $5 FOR UPDATE",
        )
        .bind(lease.job.as_str())
        .bind(stage(lease.task.stage))
        .bind(part(lease.task))
        .bind(number(lease.fence))
        .bind(i64::from(lease.attempt))
        .fetch_optional(&mut *self.tx)
        .await
        .map_err(unavailable)?;
        let Some((deadline_ms, still_since_ms)) = found else { return Ok(None) };
        let (now_ms, stall_ms) = (number(now_ms), number(self.settings.stall_ms));
        let is_still = stall_ms > 0 && still_since_ms.saturating_add(stall_ms) <= now_ms;
        Ok(if deadline_ms <= now_ms {
            Some(Expired::Silent)
        } else if is_still && !lease.task.stage.is_own() {
            Some(Expired::Stalled)
        } else {
            None
        })
    }

    /// The answer to a claim for which no task has to be looked for.
    fn refuses(&self, claim: &Claim) -> Option<Answer> {
        if self.given.contains(&call(&claim.worker.incarnation, &claim.request_id)) {
            return Some(Answer::AlreadyGiven);
        }
        let job = &self.rows.job;
        let may = job.state == JobState::Running && !job.is_at_its_limit() && self.left_of_tenant > 0;
        (!may).then_some(Answer::NothingFree)
    }

    /// The first ready task, in order, that the worker may take.
    async fn next_ready(&mut self, claim: &Claim, now_ms: u64) -> Result<Option<TaskId>, StoreError> {
        let fit = Fit {
            stages: stages(&claim.worker.stages),
            methods: claim.worker.methods.iter().map(|method| method.name()).collect(),
            memory_bytes: claim.worker.memory_bytes.map_or(i64::MAX, number),
        };
        let mut page = self.ready.remove(&fit).unwrap_or_default();
        let mut at = 0;
        let found = loop {
            if at == page.tasks.len() {
                if page.is_complete {
                    break None;
                }
                let more = self.read_ready(&fit, at, now_ms).await?;
                page.is_complete = more.len() < PAGE;
                page.tasks.extend(more);
                continue;
            }
            let task = page.tasks[at].task;
            // It may have changed in this transaction.
            let record = self.rows.tasks.get(&task).unwrap_or(&page.tasks[at]);
            let is_due = match record.state {
                TaskState::Ready { not_before_ms } => self.settings.rules.is_due(not_before_ms, now_ms),
                _ => false,
            };
            if is_due && record.may_go_to(&self.rows.job.tenant, &claim.worker, &claim.peers) {
                let record = record.clone();
                self.rows.tasks.entry(task).or_insert(record);
                break Some(task);
            }
            at += 1;
        };
        self.ready.insert(fit, page);
        Ok(found)
    }

    /// A page of ready tasks. Nobody else changes tasks of this job now, so pages do not overlap.
    async fn read_ready(
        &mut self,
        fit: &Fit,
        offset: usize,
        now_ms: u64,
    ) -> Result<Vec<TaskRecord>, StoreError> {
        let latest_ms = now_ms.saturating_add(self.settings.rules.longest_pause_ms());
        let rows: Vec<Vec<u8>> = sqlx::query_scalar(
            "SELECT ready.row FROM unnest($2::smallint[]) WITH ORDINALITY AS wanted (stage, place) \
             CROSS JOIN LATERAL (SELECT part, row FROM tasks \
             WHERE ready_job = $1 AND tasks.stage = wanted.stage AND method = ANY($3) \
             AND memory_bytes <= $4 AND (not_before_ms <= $5 OR not_before_ms > $6) \
             ORDER BY part LIMIT $7 + $8) AS ready \
             ORDER BY wanted.place, ready.part LIMIT $7 OFFSET $8",
        )
        .bind(self.rows.job.job_id.as_str())
        .bind(&fit.stages)
        .bind(&fit.methods)
        .bind(fit.memory_bytes)
        .bind(number(now_ms))
        .bind(number(latest_ms))
        .bind(PAGE as i64)
        .bind(number(offset as u64))
        .fetch_all(&mut *self.tx)
        .await
        .map_err(unavailable)?;
        rows.iter().map(|bytes| decode("tasks", bytes)).collect()
    }

    /// Whether a second attempt at the task is due.
    async fn is_slow(&mut self, task: TaskId, now_ms: u64) -> Result<bool, StoreError> {
        self.read(Some(vec![task])).await?;
        let Some(record) = self.rows.tasks.get(&task) else { return Ok(false) };
        let TaskState::Leased(first) = &record.state else { return Ok(false) };
        if !record.may_have_second_attempt() {
            return Ok(false);
        }
        let (since_ms, iterations) = (first.since_ms, record.iterations_of(first));
        let paces_ms = read_paces(self.tx, &self.rows.job.job_id, task.stage).await?;
        let usual_ms = usual_pace_ms(paces_ms.into_iter());
        let from_ms = usual_ms.and_then(|ms| self.settings.rules.slow_from_ms(since_ms, iterations, ms));
        Ok(from_ms.is_some_and(|from_ms| from_ms <= now_ms))
    }

    async fn grant(
        &mut self,
        claim: Claim,
        task: TaskId,
        is_second: bool,
        now_ms: u64,
    ) -> Result<Answer, StoreError> {
        let Some(fence) = self.fences.next() else { return Ok(Answer::NothingFree) };
        let event = Event::Claim {
            task,
            worker: claim.worker.clone(),
            peers: claim.peers.clone(),
            request_id: claim.request_id.clone(),
            fence,
            is_second,
        };
        match self.step(event, now_ms).await {
            Ok(_) => {}
            // The worker holds it itself.
            Err(StoreError::Refused(Refusal::Unfit(_) | Refusal::NotReady(_))) => {
                return Ok(Answer::NothingFree);
            }
            Err(error) => return Err(error),
        }
        self.left_of_tenant = self.left_of_tenant.saturating_sub(1);
        self.given.insert(call(&claim.worker.incarnation, &claim.request_id));
        let record = self.rows.tasks.get(&task).cloned();
        let granted = record.and_then(|record| Grant::of_call(&claim, self.rows.job.clone(), record));
        Ok(granted.map_or(Answer::NothingFree, |grant| Answer::Granted(Box::new(grant))))
    }

    /// Writes everything that changed; whether anything did.
    async fn write(self) -> Result<bool, StoreError> {
        let id = &self.rows.job.job_id;
        if self.rows.job == self.before && self.written.is_empty() {
            return Ok(false);
        }
        let mut tasks = TaskColumns::default();
        for (task, bytes) in self.written {
            if let Some(record) = self.rows.tasks.get(&task) {
                tasks.push(record, bytes);
            }
        }
        tasks.write(self.tx, id).await?;
        write_job(self.tx, &self.rows.job).await?;
        self.events.write(self.tx, id).await?;
        if !self.rows.job.state.is_open() {
            let end = sqlx::query("DELETE FROM leases WHERE job_id = $1").bind(id.as_str());
            end.execute(&mut *self.tx).await.map_err(unavailable)?;
            return Ok(true);
        }
        if !self.ended.is_empty() {
            let end = sqlx::query(
                "DELETE FROM leases USING unnest($2::smallint[], $3::bigint[], $4::bigint[]) \
                 AS ended (stage, part, fence) WHERE leases.job_id = $1 AND leases.stage = ended.stage \
                 AND leases.part = ended.part AND leases.fence = ended.fence",
            );
            let end = end.bind(id.as_str());
            let end = end.bind(self.ended.iter().map(|(task, _)| stage(task.stage)).collect::<Vec<_>>());
            let end = end.bind(self.ended.iter().map(|(task, _)| part(*task)).collect::<Vec<_>>());
            let end = end.bind(self.ended.iter().map(|(_, fence)| number(*fence)).collect::<Vec<_>>());
            end.execute(&mut *self.tx).await.map_err(unavailable)?;
        }
        let mut leases = LeaseColumns::default();
        for ((task, _), (attempt, since_ms)) in self.begun {
            leases.push(task, &attempt, since_ms, since_ms + self.settings.lease_ms);
        }
        leases.write(self.tx, id).await?;
        Ok(true)
    }
}

/// Milliseconds per iteration of the done tasks of a stage.
pub async fn read_paces(conn: &mut PgConnection, job: &JobId, of: Stage) -> Result<Vec<f64>, StoreError> {
    sqlx::query_scalar("SELECT pace_ms FROM tasks WHERE job_id = $1 AND stage = $2 AND pace_ms IS NOT NULL")
        .bind(job.as_str())
        .bind(stage(of))
        .fetch_all(conn)
        .await
        .map_err(unavailable)
}
