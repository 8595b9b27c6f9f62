//! Quotas, usage and tokens of tenants.

use sqlx::{Connection, PgConnection};

use super::super::record::{decode, encode};
use super::super::{Revoked, StoreError};
use super::locks::{self, Held};
use super::unavailable;
use crate::access::TokenRecord;
use crate::schedule::{Quota, Tenant, Usage};

/// The quota of a tenant, if one was set.
pub async fn quota_of(conn: &mut PgConnection, tenant: &Tenant) -> Result<Option<Quota>, StoreError> {
    let found: Option<Vec<u8>> = sqlx::query_scalar("SELECT row FROM quotas WHERE tenant = $1")
        .bind(tenant.as_str())
        .fetch_optional(conn)
        .await
        .map_err(unavailable)?;
    found.map(|bytes| decode("quotas", &bytes)).transpose()
}

/// Sets or removes a quota. Claims and new jobs of the tenant wait meanwhile: those after it keep to it.
pub async fn set_quota(
    conn: &mut PgConnection,
    tenant: &Tenant,
    quota: Option<Quota>,
) -> Result<(), StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::tenant(&mut tx, tenant, Held::Alone).await?;
    write_quota(&mut tx, tenant, quota).await?;
    tx.commit().await.map_err(unavailable)
}

pub async fn write_quota(
    tx: &mut PgConnection,
    tenant: &Tenant,
    quota: Option<Quota>,
) -> Result<(), StoreError> {
    let write = match quota {
        Some(quota) => sqlx::query(
            "INSERT INTO quotas (tenant, max_parallel, row) VALUES ($1, $2, $3) ON CONFLICT (tenant) \
             DO UPDATE SET max_parallel = excluded.max_parallel, row = excluded.row",
        )
        .bind(tenant.as_str().to_owned())
        .bind(i64::from(quota.max_parallel))
        .bind(encode("quotas", &quota)?),
        None => sqlx::query("DELETE FROM quotas WHERE tenant = $1").bind(tenant.as_str().to_owned()),
    };
    write.execute(tx).await.map_err(unavailable)?;
    Ok(())
}

pub async fn quotas(conn: &mut PgConnection) -> Result<Vec<(Tenant, Quota)>, StoreError> {
    let rows: Vec<(String, Vec<u8>)> = sqlx::query_as("SELECT tenant, row FROM quotas ORDER BY tenant")
        .fetch_all(conn)
        .await
        .map_err(unavailable)?;
    rows.into_iter()
        .map(|(tenant, bytes)| Ok((parse("quotas", &tenant)?, decode("quotas", &bytes)?)))
        .collect()
}

/// Usage of one tenant. Exact for those who hold its lock alone, except that leases may end meanwhile.
pub async fn usage_of(conn: &mut PgConnection, tenant: &Tenant) -> Result<Usage, StoreError> {
    let (open_jobs, leased): (i64, i64) = sqlx::query_as(
        "SELECT count(*), coalesce(sum(leased), 0)::bigint FROM jobs \
         WHERE tenant = $1 AND state IN ('running', 'paused')",
    )
    .bind(tenant.as_str())
    .fetch_one(conn)
    .await
    .map_err(unavailable)?;
    Ok(of_counts(open_jobs, leased))
}

/// Usage of each tenant with any, by tenant.
pub async fn usage(conn: &mut PgConnection) -> Result<Vec<(Tenant, Usage)>, StoreError> {
    let rows: Vec<(String, i64, i64)> = sqlx::query_as(
        "SELECT tenant, count(*), sum(leased)::bigint FROM jobs WHERE state IN ('running', 'paused') \
         GROUP BY tenant ORDER BY tenant",
    )
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    let usage = rows.into_iter();
    usage.map(|(tenant, jobs, leased)| Ok((parse("jobs", &tenant)?, of_counts(jobs, leased)))).collect()
}

fn of_counts(open_jobs: i64, leased: i64) -> Usage {
    let count = |number: i64| u32::try_from(number).unwrap_or(u32::MAX);
    Usage { open_jobs: count(open_jobs), leased_tasks: count(leased) }
}

pub async fn write_token(conn: &mut PgConnection, token: &TokenRecord) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO tokens (token_id, row) VALUES ($1, $2) ON CONFLICT (token_id) DO UPDATE SET row = excluded.row",
    )
    .bind(&token.id)
    .bind(encode("tokens", token)?)
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(())
}

pub async fn forget_token(conn: &mut PgConnection, id: &str) -> Result<(), StoreError> {
    let delete = sqlx::query("DELETE FROM tokens WHERE token_id = $1").bind(id);
    delete.execute(conn).await.map(drop).map_err(unavailable)
}

pub async fn tokens(conn: &mut PgConnection) -> Result<Vec<TokenRecord>, StoreError> {
    let rows: Vec<Vec<u8>> = sqlx::query_scalar("SELECT row FROM tokens ORDER BY token_id")
        .fetch_all(conn)
        .await
        .map_err(unavailable)?;
    rows.iter().map(|bytes| decode("tokens", bytes)).collect()
}

/// The tenant of a column.
pub fn parse(table: &'static str, tenant: &str) -> Result<Tenant, StoreError> {
    tenant.parse().map_err(|error: crate::schedule::ParseIdError| StoreError::Corrupt {
        tree: table,
        message: error.to_string(),
    })
}

/// Revokes a token. Two revocations at once could each count on the other's token, so they take turns, also
/// at several coordinators.
pub async fn revoke(
    conn: &mut PgConnection,
    id: &str,
    now_ms: u64,
    even_last: bool,
) -> Result<Revoked, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::revocations(&mut tx).await?;
    let revoked = Revoked::of(tokens(&mut tx).await?, id, now_ms, even_last);
    if let Revoked::Token(record) = &revoked {
        write_token(&mut tx, record).await?;
    }
    tx.commit().await.map_err(unavailable)?;
    Ok(revoked)
}
