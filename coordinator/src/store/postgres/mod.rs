//! The store for several machines, in PostgreSQL.
//!
//! | module | content |
//! |---|---|
//! | `migrations` | the tables |
//! | `opening` | connections and migrations |
//! | `queue`, `batch` | changes of jobs: those that wait for one job share a transaction |
//! | `claims` | the jobs that may have a task for a worker |
//! | `jobs` | new jobs, deleted ones, lists |
//! | `leases` | renewals and what is over |
//! | `tenants`, `datasets` | quotas, tokens, datasets |
//! | `ledger` | the blobs of a bucket |
//! | `members` | the coordinators that use the database, and their workers |
//! | `logs`, `histories` | log lines, and histories of tasks |
//! | `whole` | export, import, verification |
//! | `rows`, `locks` | columns, and locks on things that are not rows |
//!
//! Everything is in the database, so several coordinators may use it. The rules ([`crate::schedule::step`])
//! are applied to the rows of one job, under the lock of that job's row. The clock of leases is that of the
//! database.
//!
//! When the database cannot be reached, a call ends with [`StoreError::Unavailable`]. The next one tries
//! again: nothing in this process has to be started anew.

/// Runs `$work` on a connection, in time.
macro_rules! on {
    ($inner:expr, $pool:ident, |$conn:ident| $work:expr) => {{
        let inner = &$inner;
        let mut borrowed = Borrowed::from(&inner.$pool).await?;
        let $conn = &mut *borrowed.conn;
        let result = inner.in_time($work).await;
        borrowed.done(&result);
        result
    }};
}

mod batch;
mod claims;
mod datasets;
mod histories;
mod jobs;
mod leases;
mod ledger;
mod locks;
mod logs;
mod members;
mod opening;
mod queue;
mod rows;
mod tenants;
mod whole;

use std::future::Future;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use fathom_core::scene::BlobRef;
use sqlx::pool::PoolConnection;
use sqlx::postgres::PgConnectOptions;
use sqlx::{Connection, PgConnection, PgPool, Postgres, Transaction};
use tokio::task::AbortHandle;
use tonic::async_trait;

use self::batch::{Answer, Change};
use self::claims::Hints;
use self::ledger::PostgresLedger;
use self::members::PostgresMembers;
pub use self::opening::{Hold, PostgresOptions};
use self::queue::WaitingChanges;
use super::export::Export;
use super::ledger::Ledger;
use super::members::Members;
use super::{
    AccessStore, Claim, DatasetStore, Grant, JobFilter, JobStore, JobView, Levels, NewJob, Revoked, Store,
    StoreError, StoredEvent, WorkerMark,
};
use crate::access::TokenRecord;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::logs::Logs;
use crate::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, Lease, LiveProgress, OpenWork, Outcome, Quota, ReadyTask,
    Refusal, Renewed, Rules, TaskId, TaskRecord, Tenant, Usage,
};

/// Longest time for one transaction. The database ends statements and waits for locks before
/// (`opening`), so only a cut network takes this long.
const ANSWER_WITHIN: Duration = Duration::from_secs(20);

/// See [`Settings::short_gap_ms`].
const SHORT_GAP_MS: u64 = 2500;

/// Jobs in PostgreSQL.
pub struct PostgresStore(Arc<Inner>);

struct Inner {
    settings: Settings,
    pool: PgPool,
    /// Connections that do not wait for the database's disk.
    renewals: PgPool,
    waiting: WaitingChanges,
    hints: Hints,
    /// Moves with every change by this process that is not a claim.
    version: AtomicU64,
    /// Moves with every lease that this process grants.
    grants: AtomicU64,
    connect: PgConnectOptions,
    /// The name of this process among the coordinators, new in every process.
    member: String,
    /// Keeps other coordinators away, all of them or those that cannot share the files.
    holds: OnceLock<AbortHandle>,
    failure: OnceLock<String>,
}

impl Drop for Inner {
    fn drop(&mut self) {
        if let Some(holds) = self.holds.get() {
            holds.abort();
        }
    }
}

struct Settings {
    rules: Rules,
    lease_ms: u64,
    stall_ms: u64,
    /// Whether the database's clock is used, not the times that callers give. Tests give times.
    by_database_clock: bool,
}

impl Settings {
    /// The time for a statement; NULL stands for the database's clock.
    fn given_ms(&self, now_ms: u64) -> Option<i64> {
        (!self.by_database_clock).then(|| rows::number(now_ms))
    }

    /// Time without any coordinator that costs no worker its lease: workers renew every quarter of it, and
    /// coordinators report themselves every second, or more often where leases are short.
    fn short_gap_ms(&self) -> u64 {
        SHORT_GAP_MS.min(self.lease_ms / 4)
    }

    fn or_default(&self, quota: Option<Quota>) -> Quota {
        quota.unwrap_or(self.rules.quota)
    }
}

impl Inner {
    async fn connection(&self) -> Result<Borrowed, StoreError> {
        Borrowed::from(&self.pool).await
    }

    /// Limits the time of a transaction.
    async fn in_time<T>(&self, work: impl Future<Output = Result<T, StoreError>>) -> Result<T, StoreError> {
        let late = |_| StoreError::Unavailable(format!("no answer within {} s", ANSWER_WITHIN.as_secs()));
        tokio::time::timeout(ANSWER_WITHIN, work).await.unwrap_or_else(|elapsed| Err(late(elapsed)))
    }

    /// Records a change by this process: what claims remember is no longer valid.
    fn changed(&self) {
        self.version.fetch_add(1, SeqCst);
    }

    /// The time of a change.
    async fn now_ms(&self, conn: &mut PgConnection, given_ms: u64) -> Result<u64, StoreError> {
        if self.settings.by_database_clock { database_ms(conn).await } else { Ok(given_ms) }
    }

    /// Applies an event and returns its outcome.
    async fn apply(self: &Arc<Self>, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        match self.change(job, None, Change::Event(event), now_ms).await? {
            Answer::Applied(outcome) => Ok(outcome),
            other => Err(StoreError::Failed(format!("an event was answered with {other:?}"))),
        }
    }
}

/// A connection of a pool. It is closed instead of returned unless its user says that it is done: it may be
/// in the middle of a reply that never comes.
struct Borrowed {
    conn: PoolConnection<Postgres>,
    is_done: bool,
}

impl Borrowed {
    async fn from(pool: &PgPool) -> Result<Self, StoreError> {
        Ok(Self { conn: pool.acquire().await.map_err(unavailable)?, is_done: false })
    }

    /// Returns it to its pool, unless the database failed.
    fn done<T>(mut self, result: &Result<T, StoreError>) {
        self.is_done = !matches!(result, Err(StoreError::Unavailable(_)));
    }
}

impl Drop for Borrowed {
    fn drop(&mut self) {
        if !self.is_done {
            self.conn.close_on_drop();
        }
    }
}

/// The database's clock, Unix milliseconds.
async fn database_ms(conn: &mut PgConnection) -> Result<u64, StoreError> {
    let now_ms: i64 = sqlx::query_scalar("SELECT now_ms()").fetch_one(conn).await.map_err(unavailable)?;
    Ok(now_ms.unsigned_abs())
}

/// A transaction in which all statements see the same moment.
async fn begin_reading(conn: &mut PgConnection) -> Result<Transaction<'_, Postgres>, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    let set = sqlx::query("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY");
    set.execute(&mut *tx).await.map_err(unavailable)?;
    Ok(tx)
}

/// Every error of the database passes, as far as this process can know: an operator may repair it while the
/// coordinator runs. The call was not acknowledged.
fn unavailable(error: sqlx::Error) -> StoreError {
    StoreError::Unavailable(error.to_string())
}

#[async_trait]
impl JobStore for PostgresStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        // Goes on when the caller is dropped: a transaction is never left in the middle.
        let inner = Arc::clone(&self.0);
        let created = tokio::spawn(async move {
            let job = on!(inner, pool, |conn| jobs::create(&inner, conn, &new, now_ms))?;
            inner.changed();
            Ok(job)
        });
        created.await.unwrap_or_else(|error| Err(StoreError::Unavailable(error.to_string())))
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        self.0.claim(claim, now_ms).await
    }

    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError> {
        on!(self.0, pool, |conn| leases::standing(conn, lease))
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        let settings = &self.0.settings;
        let given_ms = settings.given_ms(now_ms);
        on!(self.0, renewals, |conn| leases::renew(settings, conn, lease, progress, given_ms))
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        self.0.apply(job, event, now_ms).await
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let settings = &self.0.settings;
        let begin = tokio::time::Instant::now();
        let overdue = on!(self.0, pool, |conn| leases::overdue(settings, conn, settings.given_ms(now_ms)))?;
        let mut taken_back = Vec::new();
        for lease in overdue {
            // The database counts the time in which this call waited for it. If the whole machine was
            // suspended, live workers could not renew in that time. The sweeper notices the pause.
            if begin.elapsed() > Duration::from_millis(settings.lease_ms / 2) {
                break;
            }
            let change = Change::Expire(lease.clone());
            match self.0.change(&lease.job, None, change, now_ms).await {
                Ok(Answer::Expired(why)) => taken_back.extend(why.map(|why| (lease, why))),
                Ok(_) => {}
                // The first one of a job may have ended the job, and with it the others.
                Err(StoreError::Refused(_) | StoreError::JobNotFound(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        let given_ms = self.0.settings.given_ms(now_ms);
        // Other coordinators renew theirs.
        for lease in on!(self.0, pool, |conn| leases::abandoned_own(conn, given_ms))? {
            let job = lease.job.clone();
            match self.0.change(&job, None, Change::Expire(lease), now_ms).await {
                Ok(_) | Err(StoreError::Refused(_) | StoreError::JobNotFound(_)) => {}
                Err(error) => return Err(error),
            }
        }
        self.extend_leases(now_ms).await
    }

    async fn answers(&self) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| async { database_ms(conn).await.map(drop) })
    }

    async fn extend_leases(&self, now_ms: u64) -> Result<(), StoreError> {
        let settings = &self.0.settings;
        match settings.given_ms(now_ms) {
            None => on!(self.0, pool, |conn| members::be_there(&self.0, conn, true)),
            given_ms => on!(self.0, pool, |conn| leases::extend(settings, conn, given_ms)),
        }
    }

    async fn job(&self, job: &JobId) -> Result<JobView, StoreError> {
        on!(self.0, pool, |conn| jobs::view(conn, job))
    }

    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError> {
        let found = on!(self.0, pool, |conn| rows::read_job(conn, job, false))?;
        found.ok_or_else(|| StoreError::JobNotFound(job.clone()))
    }

    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError> {
        let mut found = on!(self.0, pool, |conn| rows::read_tasks(conn, job, Some(&[task])))?;
        found.pop().ok_or(StoreError::Refused(Refusal::NoSuchTask(task)))
    }

    async fn delete(&self, job: &JobId) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| jobs::forget(conn, job))
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        on!(self.0, pool, |conn| jobs::list(conn, filter, before, limit))
    }

    async fn events(
        &self,
        job: &JobId,
        after_seq: u64,
        limit: usize,
    ) -> Result<Vec<StoredEvent>, StoreError> {
        let events = on!(self.0, pool, |conn| rows::read_events(conn, job, after_seq, limit))?;
        if events.is_empty() {
            self.job_row(job).await?;
        }
        Ok(events)
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        let record = self.job_row(job).await?;
        let by_task = on!(self.0, pool, |conn| leases::progress(conn, job))?;
        let live = by_task.values().map(|progress| u64::from(progress.iteration)).sum();
        Ok((by_task.into_iter().collect(), record.progress(live)))
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        on!(self.0, pool, |conn| jobs::ready(conn))
    }

    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError> {
        on!(self.0, pool, |conn| jobs::open_work(conn))
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        on!(self.0, pool, |conn| jobs::leased(conn))
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        on!(self.0, pool, |conn| jobs::levels(conn))
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| whole::write_mark(conn, incarnation, mark))
    }

    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError> {
        on!(self.0, pool, |conn| whole::marks(conn))
    }

    fn failure(&self) -> Option<String> {
        self.0.failure.get().cloned()
    }
}

#[async_trait]
impl DatasetStore for PostgresStore {
    async fn begin_dataset(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError> {
        on!(self.0, pool, |conn| async {
            let now_ms = self.0.now_ms(conn, now_ms).await?;
            datasets::begin(conn, new, now_ms).await
        })
    }

    async fn commit_dataset(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError> {
        on!(self.0, pool, |conn| async {
            let now_ms = self.0.now_ms(conn, now_ms).await?;
            datasets::commit(conn, tenant, id, root, now_ms).await
        })
    }

    async fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError> {
        on!(self.0, pool, |conn| datasets::read(conn, tenant, id))
    }

    async fn datasets(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError> {
        on!(self.0, pool, |conn| datasets::read_page(conn, tenant, after, limit))
    }

    async fn delete_dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| datasets::forget(conn, tenant, id))
    }

    async fn forget_given_up(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError> {
        on!(self.0, pool, |conn| datasets::forget_given_up(conn, before_ms))
    }
}

#[async_trait]
impl AccessStore for PostgresStore {
    async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError> {
        let set = on!(self.0, pool, |conn| tenants::set_quota(conn, tenant, quota));
        self.0.changed();
        set
    }

    async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError> {
        let quota = on!(self.0, pool, |conn| tenants::quota_of(conn, tenant))?;
        Ok(self.0.settings.or_default(quota))
    }

    async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        on!(self.0, pool, |conn| tenants::quotas(conn))
    }

    async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError> {
        on!(self.0, pool, |conn| tenants::usage(conn))
    }

    async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| tenants::write_token(conn, token))
    }

    async fn forget_token(&self, id: &str) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| tenants::forget_token(conn, id))
    }

    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
        on!(self.0, pool, |conn| tenants::tokens(conn))
    }

    async fn revoke_token(&self, id: &str, now_ms: u64, even_last: bool) -> Result<Revoked, StoreError> {
        on!(self.0, pool, |conn| tenants::revoke(conn, id, now_ms, even_last))
    }
}

#[async_trait]
impl Store for PostgresStore {
    async fn deployment(&self) -> Result<String, StoreError> {
        on!(self.0, pool, |conn| whole::deployment(conn))
    }

    fn ledger(&self) -> Option<Arc<dyn Ledger>> {
        Some(Arc::new(PostgresLedger(Arc::clone(&self.0))))
    }

    fn members(&self) -> Option<Arc<dyn Members>> {
        Some(Arc::new(PostgresMembers(Arc::clone(&self.0))))
    }

    async fn export(&self) -> Result<Export, StoreError> {
        let mut borrowed = self.0.connection().await?;
        let export = whole::export(&mut borrowed.conn).await;
        borrowed.done(&export);
        export
    }

    async fn import(&self, export: &Export) -> Result<(), StoreError> {
        let mut borrowed = self.0.connection().await?;
        let imported = whole::import(&mut borrowed.conn, export).await;
        borrowed.done(&imported);
        self.0.changed();
        imported
    }

    fn logs(&self, attempt_bytes: u64) -> Option<Arc<dyn Logs>> {
        Some(self.logs_of(attempt_bytes))
    }
}

impl PostgresStore {
    /// All data, and a sentence for each difference between the tables; [`super::verify`] checks the rows.
    /// Both are of one moment.
    ///
    /// # Errors
    /// When the database cannot be reached.
    pub async fn verified(&self) -> Result<(Export, Vec<String>), StoreError> {
        let mut borrowed = self.0.connection().await?;
        let verified = whole::verified(&mut borrowed.conn).await;
        borrowed.done(&verified);
        verified
    }
}
