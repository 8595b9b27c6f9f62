//! Locks on things that are not rows, held until the transaction ends.

use sqlx::PgConnection;

use super::super::StoreError;
use super::unavailable;
use crate::schedule::Tenant;

/// How a lock is held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Held {
    /// Together with others that hold it so.
    WithOthers,
    /// By one transaction.
    Alone,
}

/// Locks a tenant: its quota, its datasets, and the number of its jobs and leases.
pub async fn tenant(tx: &mut PgConnection, tenant: &Tenant, held: Held) -> Result<(), StoreError> {
    lock(tx, key("tenant", tenant.as_str().as_bytes()), held).await
}

/// Locks the bytes of a tenant: one upload after the other looks at them and adds its own.
pub async fn bytes(tx: &mut PgConnection, tenant: &Tenant, held: Held) -> Result<(), StoreError> {
    lock(tx, key("bytes", tenant.as_str().as_bytes()), held).await
}

/// Locks the reports of coordinators.
pub async fn members(tx: &mut PgConnection) -> Result<(), StoreError> {
    lock(tx, key("members", b""), Held::Alone).await
}

/// Locks the revocation of tokens.
pub async fn revocations(tx: &mut PgConnection) -> Result<(), StoreError> {
    lock(tx, key("revocations", b""), Held::Alone).await
}

async fn lock(tx: &mut PgConnection, key: i64, held: Held) -> Result<(), StoreError> {
    let lock = match held {
        Held::WithOthers => sqlx::query("SELECT pg_advisory_xact_lock_shared($1)"),
        Held::Alone => sqlx::query("SELECT pg_advisory_xact_lock($1)"),
    };
    lock.bind(key).execute(tx).await.map_err(unavailable)?;
    Ok(())
}

/// Locks calls that claim: a repeated call may arrive while the first one runs, at another coordinator too.
pub async fn calls(tx: &mut PgConnection, calls: &[Vec<u8>]) -> Result<(), StoreError> {
    let mut keys: Vec<i64> = calls.iter().map(|call| key("call", call)).collect();
    // The same order everywhere, so that no two transactions wait for each other.
    keys.sort_unstable();
    sqlx::query("SELECT pg_advisory_xact_lock(key) FROM unnest($1::bigint[]) AS keys (key)")
        .bind(keys)
        .execute(tx)
        .await
        .map_err(unavailable)?;
    Ok(())
}

fn key(kind: &str, name: &[u8]) -> i64 {
    let mut hasher = blake3::Hasher::new();
    hasher.update(kind.as_bytes()).update(b"\0").update(name);
    let mut first = [0; 8];
    hasher.finalize_xof().fill(&mut first);
    i64::from_le_bytes(first)
}
