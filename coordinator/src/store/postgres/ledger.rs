//! The blobs of a bucket: [`Ledger`].
//!
//! Triggers keep the sums of bytes, in several rows for each tenant, so that uploads that end at one time do
//! not wait for each other. No two transactions wait for each other in a circle: statements that touch
//! several blobs lock their rows by digest, and those that change several sums take turns (`locks::bytes`).

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use fathom_core::scene::BlobRef;
use sqlx::{Connection, PgConnection};
use tonic::async_trait;

use super::super::StoreError;
use super::super::ledger::{Known, Ledger, REMOVAL_WITHIN, Removal, Reserved, UsedBlob};
use super::locks::{self, Held};
use super::rows::number;
use super::{Borrowed, Inner, unavailable};
use crate::schedule::Tenant;

/// How much older than its last use a row may be: a blob that is asked for again and again is not written
/// each time. Unused blobs are kept for a day at least.
const USED_WITHIN_MS: i64 = 10 * 60_000;
/// An upload that began later may be missing in a list of those that this process writes.
const BEGUN_WITHIN_MS: i64 = 60_000;
/// Rows that one statement adds.
const ADDED_AT_ONCE: usize = 1000;

/// The ledger of a database.
pub struct PostgresLedger(pub(super) Arc<Inner>);

/// A digest as its 32 bytes.
fn key(digest: &str) -> Result<Vec<u8>, StoreError> {
    let hash = blake3::Hash::from_hex(digest);
    hash.map(|hash| hash.as_bytes().to_vec())
        .map_err(|error| StoreError::Failed(format!("{digest:?} is not a digest: {error}")))
}

fn keys<'a>(digests: impl IntoIterator<Item = &'a str>) -> Result<Vec<Vec<u8>>, StoreError> {
    digests.into_iter().map(key).collect()
}

fn digest_of(key: &[u8]) -> Result<String, StoreError> {
    let hash = blake3::Hash::from_slice(key).map_err(|error| StoreError::Corrupt {
        tree: "blobs",
        message: format!("a digest of {} bytes: {error}", key.len()),
    })?;
    Ok(hash.to_hex().to_string())
}

fn blob_of((key, bytes): (Vec<u8>, i64)) -> Result<BlobRef, StoreError> {
    Ok(BlobRef { digest: digest_of(&key)?, bytes: bytes.unsigned_abs() })
}

#[async_trait]
impl Ledger for PostgresLedger {
    async fn is_filled(&self, tenant: &Tenant) -> Result<bool, StoreError> {
        on!(self.0, pool, |conn| async {
            sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM filled_ledgers WHERE tenant = $1)")
                .bind(tenant.as_str())
                .fetch_one(conn)
                .await
                .map_err(unavailable)
        })
    }

    async fn set_filled(&self, tenant: &Tenant) -> Result<(), StoreError> {
        on!(self.0, pool, |conn| async {
            sqlx::query("INSERT INTO filled_ledgers VALUES ($1) ON CONFLICT DO NOTHING")
                .bind(tenant.as_str())
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn add(&self, tenant: &Tenant, found: &[UsedBlob], is_sure: bool) -> Result<(), StoreError> {
        let mut found: Vec<&UsedBlob> = found.iter().collect();
        found.sort_by(|a, b| a.blob.digest.cmp(&b.blob.digest));
        for some in found.chunks(ADDED_AT_ONCE) {
            let digests = keys(some.iter().map(|used| used.blob.digest.as_str()))?;
            let bytes: Vec<i64> = some.iter().map(|used| number(used.blob.bytes)).collect();
            let used_ms: Vec<i64> = some.iter().map(|used| number(used.used_ms)).collect();
            on!(self.0, pool, |conn| async {
                let mut tx = conn.begin().await.map_err(unavailable)?;
                locks::bytes(&mut tx, tenant, Held::Alone).await?;
                sqlx::query(
                    "INSERT INTO blobs (tenant, digest, bytes, used_ms, going_until_ms) \
                     SELECT $1, *, $5 FROM unnest($2::bytea[], $3::bigint[], $4::bigint[]) ON CONFLICT DO NOTHING",
                )
                .bind(tenant.as_str())
                .bind(digests)
                .bind(bytes)
                .bind(used_ms)
                .bind((!is_sure).then_some(0_i64))
                .execute(&mut *tx)
                .await
                .map_err(unavailable)?;
                tx.commit().await.map_err(unavailable)
            })?;
        }
        Ok(())
    }

    async fn add_upload(&self, tenant: &Tenant, found: &BlobRef) -> Result<(), StoreError> {
        let digest = key(&found.digest)?;
        on!(self.0, pool, |conn| async {
            sqlx::query(
                "INSERT INTO uploads (tenant, digest, bytes, member, is_written, changed_ms) \
                 VALUES ($1, $2, $3, $4, false, now_ms()) ON CONFLICT DO NOTHING",
            )
            .bind(tenant.as_str())
            .bind(digest)
            .bind(number(found.bytes))
            .bind(&self.0.member)
            .execute(conn)
            .await
            .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn ask(&self, tenant: &Tenant, digests: &[&str]) -> Result<Vec<Known>, StoreError> {
        let keys = keys(digests.iter().copied())?;
        let found = on!(self.0, pool, |conn| ask(conn, tenant, &keys))?;
        let known = keys.iter().map(|key| found.get(key).copied().unwrap_or(Known::Missing));
        Ok(known.collect())
    }

    async fn reserve(
        &self,
        tenant: &Tenant,
        blob: &BlobRef,
        limit_bytes: Option<u64>,
        instead_of: Option<&str>,
    ) -> Result<Reserved, StoreError> {
        let (digest, member) = (key(&blob.digest)?, &self.0.member);
        let replaced = instead_of.map(key).transpose()?;
        let replaced = replaced.as_deref();
        on!(self.0, pool, |conn| reserve(conn, tenant, member, &digest, blob.bytes, limit_bytes, replaced))
    }

    async fn leave(&self, tenant: &Tenant, digest: &str, bytes: u64) -> Result<(), StoreError> {
        let digest = key(digest)?;
        on!(self.0, pool, |conn| async {
            // The client may have gone on at another coordinator, whose upload it is then. That one may have
            // ended already, and what this one leaves still counts.
            let statement = match bytes {
                0 => {
                    "DELETE FROM uploads WHERE tenant = $1 AND digest = $2 AND member = $3 AND $4::bigint = 0"
                }
                _ => {
                    "INSERT INTO uploads (tenant, digest, member, bytes, is_written, changed_ms) \
                     VALUES ($1, $2, $3, $4, false, now_ms()) ON CONFLICT (tenant, digest) DO UPDATE \
                     SET bytes = excluded.bytes, is_written = false, changed_ms = excluded.changed_ms \
                     WHERE uploads.member = excluded.member"
                }
            };
            sqlx::query(statement)
                .bind(tenant.as_str())
                .bind(digest)
                .bind(&self.0.member)
                .bind(number(bytes))
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn publish(&self, tenant: &Tenant, blob: &BlobRef) -> Result<bool, StoreError> {
        let digest = key(&blob.digest)?;
        let published: Option<bool> = on!(self.0, pool, |conn| async {
            sqlx::query_scalar(
                "WITH published AS (INSERT INTO blobs (tenant, digest, bytes, used_ms) \
                 VALUES ($1, $2, $3, now_ms()) ON CONFLICT (tenant, digest) DO UPDATE \
                 SET bytes = excluded.bytes, used_ms = excluded.used_ms WHERE blobs.going_until_ms IS NULL \
                 RETURNING true AS is_done), ended AS (DELETE FROM uploads \
                 WHERE tenant = $1 AND digest = $2 AND EXISTS (SELECT 1 FROM published)) \
                 SELECT is_done FROM published",
            )
            .bind(tenant.as_str())
            .bind(digest)
            .bind(number(blob.bytes))
            .fetch_optional(conn)
            .await
            .map_err(unavailable)
        })?;
        Ok(published.is_some())
    }

    async fn used_bytes(&self, tenant: &Tenant) -> Result<u64, StoreError> {
        on!(self.0, pool, |conn| used_bytes(conn, tenant))
    }

    async fn declared_bytes(&self, tenant: &Tenant, digests: &[&str]) -> Result<u64, StoreError> {
        let keys = keys(digests.iter().copied())?;
        on!(self.0, pool, |conn| async {
            let bytes: i64 = sqlx::query_scalar(
                "SELECT coalesce(sum(bytes), 0)::bigint FROM uploads WHERE tenant = $1 AND digest = ANY($2)",
            )
            .bind(tenant.as_str())
            .bind(keys)
            .fetch_one(conn)
            .await
            .map_err(unavailable)?;
            Ok(bytes.unsigned_abs())
        })
    }

    async fn written(&self, tenant: &Tenant, digests: &[String]) -> Result<HashSet<String>, StoreError> {
        let keys = keys(digests.iter().map(String::as_str))?;
        let found: Vec<Vec<u8>> = on!(self.0, pool, |conn| async {
            sqlx::query_scalar(
                "SELECT digest FROM uploads WHERE tenant = $1 AND digest = ANY($2) AND is_written \
                 AND is_member(member)",
            )
            .bind(tenant.as_str())
            .bind(keys)
            .fetch_all(conn)
            .await
            .map_err(unavailable)
        })?;
        found.iter().map(|key| digest_of(key)).collect()
    }

    async fn unused(
        &self,
        tenant: &Tenant,
        before_ms: u64,
        after: &str,
        limit: usize,
    ) -> Result<Vec<BlobRef>, StoreError> {
        let after = if after.is_empty() { Vec::new() } else { key(after)? };
        let found: Vec<(Vec<u8>, i64)> = on!(self.0, pool, |conn| async {
            sqlx::query_as(
                "SELECT digest, bytes FROM blobs WHERE tenant = $1 AND digest > $2 AND used_ms < $3 \
                 ORDER BY digest LIMIT $4",
            )
            .bind(tenant.as_str())
            .bind(after)
            .bind(number(before_ms))
            .bind(number(limit as u64))
            .fetch_all(conn)
            .await
            .map_err(unavailable)
        })?;
        found.into_iter().map(blob_of).collect()
    }

    async fn condemn(
        &self,
        tenant: &Tenant,
        digests: &[String],
        before_ms: Option<u64>,
    ) -> Result<Vec<Removal>, StoreError> {
        let keys = keys(digests.iter().map(String::as_str))?;
        let found: Vec<(Vec<u8>, i64, i64)> = on!(self.0, pool, |conn| async {
            sqlx::query_as(
                "WITH due AS (SELECT digest FROM blobs WHERE tenant = $1 AND digest = ANY($2) \
                 AND (going_until_ms IS NULL OR going_until_ms <= now_ms()) \
                 AND ($3::bigint IS NULL OR (used_ms < $3 \
                 AND NOT EXISTS (SELECT 1 FROM uploads AS u WHERE u.tenant = $1 AND u.digest = blobs.digest \
                 AND u.is_written AND is_member(u.member)))) ORDER BY digest FOR UPDATE) \
                 UPDATE blobs SET going_until_ms = now_ms() + $4 FROM due \
                 WHERE blobs.tenant = $1 AND blobs.digest = due.digest \
                 RETURNING blobs.digest, blobs.bytes, blobs.going_until_ms",
            )
            .bind(tenant.as_str())
            .bind(keys)
            .bind(before_ms.map(number))
            .bind(number(REMOVAL_WITHIN.as_millis() as u64))
            .fetch_all(conn)
            .await
            .map_err(unavailable)
        })?;
        let removal = |(key, bytes, until_ms): (Vec<u8>, i64, i64)| {
            Ok(Removal { blob: blob_of((key, bytes))?, until_ms: until_ms.unsigned_abs() })
        };
        found.into_iter().map(removal).collect()
    }

    async fn removed(&self, tenant: &Tenant, removals: &[Removal]) -> Result<(), StoreError> {
        let keys = keys(removals.iter().map(|removal| removal.blob.digest.as_str()))?;
        let until_ms: Vec<i64> = removals.iter().map(|removal| number(removal.until_ms)).collect();
        on!(self.0, pool, |conn| async {
            let mut tx = conn.begin().await.map_err(unavailable)?;
            locks::bytes(&mut tx, tenant, Held::Alone).await?;
            sqlx::query(
                "WITH gone AS (SELECT blobs.digest FROM blobs \
                 JOIN unnest($2::bytea[], $3::bigint[]) AS ended (digest, until_ms) \
                 ON blobs.digest = ended.digest AND blobs.going_until_ms = ended.until_ms \
                 WHERE blobs.tenant = $1 ORDER BY blobs.digest FOR UPDATE OF blobs) \
                 DELETE FROM blobs USING gone WHERE blobs.tenant = $1 AND blobs.digest = gone.digest",
            )
            .bind(tenant.as_str())
            .bind(keys)
            .bind(until_ms)
            .execute(&mut *tx)
            .await
            .map_err(unavailable)?;
            tx.commit().await.map_err(unavailable)
        })
    }

    async fn keep(&self, tenant: &Tenant, removal: &Removal) -> Result<(), StoreError> {
        let digest = key(&removal.blob.digest)?;
        on!(self.0, pool, |conn| async {
            sqlx::query(
                "UPDATE blobs SET going_until_ms = NULL, used_ms = now_ms() \
                 WHERE tenant = $1 AND digest = $2 AND going_until_ms = $3",
            )
            .bind(tenant.as_str())
            .bind(digest)
            .bind(number(removal.until_ms))
            .execute(conn)
            .await
            .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn close_uploads(&self, tenant: &Tenant, written: &[String]) -> Result<(), StoreError> {
        let keys = keys(written.iter().map(String::as_str))?;
        on!(self.0, pool, |conn| async {
            sqlx::query(
                "UPDATE uploads SET is_written = false \
                 WHERE tenant = $1 AND member = $2 AND is_written AND digest <> ALL($3) \
                 AND changed_ms < now_ms() - $4",
            )
            .bind(tenant.as_str())
            .bind(&self.0.member)
            .bind(keys)
            .bind(BEGUN_WITHIN_MS)
            .execute(conn)
            .await
            .map_err(unavailable)?;
            Ok(())
        })
    }

    async fn left_uploads(&self, tenant: &Tenant, before_ms: u64) -> Result<Vec<BlobRef>, StoreError> {
        let found: Vec<(Vec<u8>, i64)> = on!(self.0, pool, |conn| async {
            sqlx::query_as(
                "SELECT digest, bytes FROM uploads WHERE tenant = $1 AND changed_ms < $2 \
                 AND NOT (is_written AND is_member(member)) ORDER BY digest",
            )
            .bind(tenant.as_str())
            .bind(number(before_ms))
            .fetch_all(conn)
            .await
            .map_err(unavailable)
        })?;
        found.into_iter().map(blob_of).collect()
    }

    async fn correct(
        &self,
        tenant: &Tenant,
        digest: &str,
        bytes: u64,
        before_ms: u64,
    ) -> Result<(), StoreError> {
        let digest = key(digest)?;
        on!(self.0, pool, |conn| async {
            let statement = match bytes {
                0 => {
                    "DELETE FROM uploads WHERE tenant = $1 AND digest = $2 AND changed_ms < $3 \
                     AND NOT (is_written AND is_member(member)) AND $4::bigint = 0"
                }
                _ => {
                    "UPDATE uploads SET bytes = $4, is_written = false WHERE tenant = $1 AND digest = $2 \
                     AND changed_ms < $3 AND NOT (is_written AND is_member(member))"
                }
            };
            sqlx::query(statement)
                .bind(tenant.as_str())
                .bind(digest)
                .bind(number(before_ms))
                .bind(number(bytes))
                .execute(conn)
                .await
                .map_err(unavailable)?;
            Ok(())
        })
    }
}

async fn ask(
    conn: &mut PgConnection,
    tenant: &Tenant,
    keys: &[Vec<u8>],
) -> Result<HashMap<Vec<u8>, Known>, StoreError> {
    let rows: Vec<(Vec<u8>, i64, bool, Option<bool>)> = sqlx::query_as(
        "SELECT digest, bytes, used_ms < now_ms() - $3, going_until_ms <= now_ms() FROM blobs \
         WHERE tenant = $1 AND digest = ANY($2)",
    )
    .bind(tenant.as_str())
    .bind(keys)
    .bind(USED_WITHIN_MS)
    .fetch_all(&mut *conn)
    .await
    .map_err(unavailable)?;
    let (mut known, mut old) = (HashMap::with_capacity(rows.len()), Vec::new());
    for (key, bytes, is_old, late) in rows {
        let found = match late {
            Some(is_late) => Known::Going { is_late },
            None => Known::There { bytes: bytes.unsigned_abs() },
        };
        if is_old && late.is_none() {
            old.push(key.clone());
        }
        known.insert(key, found);
    }
    if old.is_empty() {
        return Ok(known);
    }
    let used: Vec<Vec<u8>> = sqlx::query_scalar(
        "WITH old AS (SELECT digest FROM blobs WHERE tenant = $1 AND digest = ANY($2) \
         AND going_until_ms IS NULL ORDER BY digest FOR UPDATE) \
         UPDATE blobs SET used_ms = now_ms() FROM old \
         WHERE blobs.tenant = $1 AND blobs.digest = old.digest RETURNING blobs.digest",
    )
    .bind(tenant.as_str())
    .bind(&old)
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let used: HashSet<Vec<u8>> = used.into_iter().collect();
    for key in old.into_iter().filter(|key| !used.contains(key)) {
        // Condemned between the two statements.
        known.insert(key, Known::Going { is_late: false });
    }
    Ok(known)
}

async fn used_bytes(conn: &mut PgConnection, tenant: &Tenant) -> Result<u64, StoreError> {
    let bytes: i64 =
        sqlx::query_scalar("SELECT coalesce(sum(bytes), 0)::bigint FROM blob_bytes WHERE tenant = $1")
            .bind(tenant.as_str())
            .fetch_one(conn)
            .await
            .map_err(unavailable)?;
    Ok(bytes.max(0).unsigned_abs())
}

async fn reserve(
    conn: &mut PgConnection,
    tenant: &Tenant,
    member: &str,
    digest: &[u8],
    bytes: u64,
    limit_bytes: Option<u64>,
    replaced: Option<&[u8]>,
) -> Result<Reserved, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    // It need not wait for the database's disk. What a crash of the database loses counts again when the
    // upload is complete.
    let unsynced = sqlx::query("SET LOCAL synchronous_commit = off");
    unsynced.execute(&mut *tx).await.map_err(unavailable)?;
    if let Some(limit_bytes) = limit_bytes {
        // One after the other: many that begin at once could exceed the limit together.
        locks::bytes(&mut tx, tenant, Held::Alone).await?;
        let counted: Vec<i64> =
            sqlx::query_scalar("SELECT bytes FROM uploads WHERE tenant = $1 AND digest IN ($2, $3)")
                .bind(tenant.as_str())
                .bind(digest)
                .bind(replaced)
                .fetch_all(&mut *tx)
                .await
                .map_err(unavailable)?;
        let counted = counted.into_iter().fold(0_u64, |sum, bytes| sum.saturating_add(bytes.unsigned_abs()));
        let used_bytes = used_bytes(&mut tx, tenant).await?.saturating_sub(counted);
        if used_bytes.saturating_add(bytes) > limit_bytes {
            return Ok(Reserved::OverLimit { used_bytes });
        }
    }
    if let Some(replaced) = replaced {
        sqlx::query("DELETE FROM uploads WHERE tenant = $1 AND digest = $2")
            .bind(tenant.as_str())
            .bind(replaced)
            .execute(&mut *tx)
            .await
            .map_err(unavailable)?;
    }
    sqlx::query(
        "INSERT INTO uploads (tenant, digest, bytes, member, is_written, changed_ms) \
         VALUES ($1, $2, $3, $4, true, now_ms()) ON CONFLICT (tenant, digest) DO UPDATE \
         SET bytes = excluded.bytes, member = excluded.member, is_written = true, changed_ms = excluded.changed_ms",
    )
    .bind(tenant.as_str())
    .bind(digest)
    .bind(number(bytes))
    .bind(member)
    .execute(&mut *tx)
    .await
    .map_err(unavailable)?;
    tx.commit().await.map_err(unavailable)?;
    Ok(Reserved::Counts)
}
