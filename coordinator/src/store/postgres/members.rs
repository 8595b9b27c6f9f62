//! The coordinators of a database and their workers: [`Members`].

use std::collections::HashSet;
use std::sync::Arc;

use futures::StreamExt;
use futures::stream::BoxStream;
use sqlx::postgres::PgListener;
use sqlx::{Connection, PgConnection};
use tonic::async_trait;

use super::super::StoreError;
use super::super::members::{Hint, Meeting, Members, SharedWorker};
use super::rows::number;
use super::{Borrowed, Inner, database_ms, leases, locks, opening, unavailable};

/// The channel of hints.
const CHANNEL: &str = "fathom";
/// A coordinator that has not reported itself for this long takes no calls any more.
const THERE_FOR_MS: i64 = 5_000;
/// A coordinator that has not reported itself for this long is forgotten.
const FORGOTTEN_AFTER_MS: i64 = 600_000;
/// Longest time from the moment at which a worker registers to the moment at which its row is visible.
const VISIBLE_WITHIN_MS: u64 = 30_000;

/// The members of a database.
pub struct PostgresMembers(pub(super) Arc<Inner>);

#[async_trait]
impl Members for PostgresMembers {
    async fn meet(
        &self,
        seen: &[(String, u64)],
        since_ms: u64,
        forget_after_ms: u64,
    ) -> Result<Meeting, StoreError> {
        on!(self.0, renewals, |conn| async {
            be_there(&self.0, conn, since_ms == 0).await?;
            meet(conn, seen, since_ms, forget_after_ms).await
        })
    }

    async fn leave(&self) -> Result<(), StoreError> {
        on!(self.0, renewals, |conn| async {
            sqlx::query("DELETE FROM members WHERE member = $1")
                .bind(&self.0.member)
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn register(&self, incarnation: &str, owner: &str, row: &[u8]) -> Result<bool, StoreError> {
        let registered: Option<bool> = on!(self.0, renewals, |conn| async {
            sqlx::query_scalar(
                "INSERT INTO workers (incarnation, owner, seen_ms, registered_ms, row) \
                 VALUES ($1, $2, now_ms(), now_ms(), $3) ON CONFLICT (incarnation) DO UPDATE \
                 SET seen_ms = excluded.seen_ms, registered_ms = excluded.registered_ms, row = excluded.row \
                 WHERE workers.owner = excluded.owner RETURNING true",
            )
            .bind(incarnation)
            .bind(owner)
            .bind(row)
            .fetch_optional(conn)
            .await
            .map_err(unavailable)
        })?;
        Ok(registered.is_some())
    }

    async fn forget(&self, incarnations: &[String]) -> Result<(), StoreError> {
        on!(self.0, renewals, |conn| async {
            sqlx::query("DELETE FROM workers WHERE incarnation = ANY($1)")
                .bind(incarnations)
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn notify(&self, hint: Hint) -> Result<(), StoreError> {
        let kind = match hint {
            Hint::Work => "work",
            Hint::Interrupt => "interrupt",
        };
        // In no transaction of a change: those would then commit one after the other.
        on!(self.0, renewals, |conn| async {
            sqlx::query("SELECT pg_notify($1, $2)")
                .bind(CHANNEL)
                .bind(format!("{kind} {}", self.0.member))
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn listen(&self) -> Result<BoxStream<'static, Hint>, StoreError> {
        let pool = opening::pool(self.0.connect.clone(), 1);
        let mut listener = PgListener::connect_with(&pool).await.map_err(unavailable)?;
        listener.listen(CHANNEL).await.map_err(unavailable)?;
        let inner = Arc::downgrade(&self.0);
        let hints = futures::stream::unfold(listener, move |mut listener| {
            let inner = inner.clone();
            async move {
                loop {
                    let Ok(notice) = listener.recv().await else { return None };
                    let inner = inner.upgrade()?;
                    let Some((kind, member)) = notice.payload().split_once(' ') else { continue };
                    if member == inner.member {
                        continue;
                    }
                    inner.changed();
                    let hint = if kind == "interrupt" { Hint::Interrupt } else { Hint::Work };
                    return Some((hint, listener));
                }
            }
        });
        Ok(hints.boxed())
    }
}

async fn meet(
    conn: &mut PgConnection,
    seen: &[(String, u64)],
    since_ms: u64,
    forget_after_ms: u64,
) -> Result<Meeting, StoreError> {
    let now_ms = database_ms(conn).await?;
    let mut forgotten = Vec::new();
    if !seen.is_empty() {
        let (incarnations, ages): (Vec<&str>, Vec<i64>) =
            seen.iter().map(|(incarnation, age_ms)| (incarnation.as_str(), number(*age_ms))).unzip();
        let known: Vec<String> = sqlx::query_scalar(
            "WITH seen AS (SELECT w.incarnation, given.age FROM workers AS w \
             JOIN unnest($1::text[], $2::bigint[]) AS given (incarnation, age) USING (incarnation) \
             ORDER BY w.incarnation FOR UPDATE OF w) \
             UPDATE workers SET seen_ms = greatest(seen_ms, now_ms() - seen.age) FROM seen \
             WHERE workers.incarnation = seen.incarnation RETURNING workers.incarnation",
        )
        .bind(incarnations)
        .bind(ages)
        .fetch_all(&mut *conn)
        .await
        .map_err(unavailable)?;
        let known: HashSet<String> = known.into_iter().collect();
        forgotten.extend(
            seen.iter().map(|(incarnation, _)| incarnation).filter(|one| !known.contains(*one)).cloned(),
        );
    }
    for (statement, after_ms) in [
        (
            "DELETE FROM workers WHERE incarnation IN (SELECT incarnation FROM workers \
             WHERE seen_ms < now_ms() - $1 ORDER BY incarnation FOR UPDATE SKIP LOCKED)",
            number(forget_after_ms),
        ),
        (
            "DELETE FROM members WHERE member IN (SELECT member FROM members \
             WHERE seen_ms < now_ms() - $1 ORDER BY member FOR UPDATE SKIP LOCKED)",
            FORGOTTEN_AFTER_MS,
        ),
    ] {
        sqlx::query(statement).bind(after_ms).execute(&mut *conn).await.map_err(unavailable)?;
    }
    let members: i64 = sqlx::query_scalar("SELECT count(*) FROM members WHERE seen_ms > now_ms() - $1")
        .bind(THERE_FOR_MS)
        .fetch_one(&mut *conn)
        .await
        .map_err(unavailable)?;
    let workers: Vec<(String, i64, Option<Vec<u8>>)> = sqlx::query_as(
        "SELECT incarnation, now_ms() - seen_ms, CASE WHEN registered_ms >= $1 THEN row END FROM workers",
    )
    .bind(number(since_ms))
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let workers = workers.into_iter().map(|(incarnation, silent_ms, registered)| SharedWorker {
        incarnation,
        silent_ms: silent_ms.max(0).unsigned_abs(),
        registered,
    });
    Ok(Meeting {
        members: u32::try_from(members).unwrap_or(1).max(1),
        workers: workers.collect(),
        forgotten,
        time_ms: now_ms.saturating_sub(VISIBLE_WITHIN_MS),
    })
}

/// Reports this coordinator. If none has reported itself for a while, no worker could renew: then every lease
/// gets a full period, by the first coordinator that is back. While another one takes calls, workers can
/// renew there, and a coordinator that crashes at every start would keep the leases of dead workers alive.
///
/// `was_away`: this process has just started, or has found the database gone. Otherwise the gap must be half
/// a lease: with a database that is merely slow, each report would extend the leases.
pub async fn be_there(inner: &Inner, conn: &mut PgConnection, was_away: bool) -> Result<(), StoreError> {
    let settings = &inner.settings;
    let gap_ms = if was_away { settings.short_gap_ms() } else { settings.lease_ms / 2 };
    // Without a lock: a coordinator that is cut off while it has one would keep the others waiting.
    if !are_all_away(conn, gap_ms).await? {
        return report(inner, conn).await;
    }
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::members(&mut tx).await?;
    if are_all_away(&mut tx, gap_ms).await? {
        leases::extend(settings, &mut tx, None).await?;
    }
    report(inner, &mut tx).await?;
    tx.commit().await.map_err(unavailable)
}

/// Whether no coordinator has reported itself for longer than `gap_ms`.
async fn are_all_away(conn: &mut PgConnection, gap_ms: u64) -> Result<bool, StoreError> {
    let alone_for_ms: Option<i64> = sqlx::query_scalar("SELECT now_ms() - max(seen_ms) FROM members")
        .fetch_one(conn)
        .await
        .map_err(unavailable)?;
    Ok(alone_for_ms.is_none_or(|alone_for_ms| alone_for_ms > number(gap_ms)))
}

async fn report(inner: &Inner, conn: &mut PgConnection) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO members VALUES ($1, now_ms()) ON CONFLICT (member) DO UPDATE SET seen_ms = excluded.seen_ms",
    )
    .bind(&inner.member)
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(())
}
