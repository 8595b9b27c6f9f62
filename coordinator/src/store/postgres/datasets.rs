//! Datasets. Changes hold the lock of their tenant alone, as does the creation of jobs, so that no job uses a
//! dataset that is being deleted.

use fathom_core::scene::BlobRef;
use sqlx::{Connection, PgConnection};

use super::super::record::{decode, encode};
use super::super::{StoreError, check_new_dataset};
use super::locks::{self, Held};
use super::rows::{number, parse_job};
use super::unavailable;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::schedule::Tenant;

pub async fn begin(
    conn: &mut PgConnection,
    new: NewDataset,
    now_ms: u64,
) -> Result<DatasetRecord, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::tenant(&mut tx, &new.tenant, Held::Alone).await?;
    let known = read_page(&mut tx, Some(&new.tenant), None, usize::MAX).await?;
    let row = match check_new_dataset(&new, &known)? {
        Some(known) => DatasetRecord { asked_ms: now_ms, ..known.clone() },
        None => new.into_row(now_ms),
    };
    write(&mut tx, &row).await?;
    tx.commit().await.map_err(unavailable)?;
    Ok(row)
}

pub async fn commit(
    conn: &mut PgConnection,
    tenant: &Tenant,
    id: &DatasetId,
    root: &BlobRef,
    now_ms: u64,
) -> Result<DatasetRecord, StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::tenant(&mut tx, tenant, Held::Alone).await?;
    let mut row = read(&mut tx, tenant, id).await?;
    if row.root != *root {
        return Err(StoreError::DatasetExists(id.clone()));
    }
    if !row.is_committed() {
        row.committed_ms = Some(now_ms);
        write(&mut tx, &row).await?;
    }
    tx.commit().await.map_err(unavailable)?;
    Ok(row)
}

pub async fn forget(conn: &mut PgConnection, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
    let mut tx = conn.begin().await.map_err(unavailable)?;
    locks::tenant(&mut tx, tenant, Held::Alone).await?;
    read(&mut tx, tenant, id).await?;
    let user: Option<String> = sqlx::query_scalar(
        "SELECT job_id FROM jobs WHERE tenant = $1 AND dataset = $2 ORDER BY job_id LIMIT 1",
    )
    .bind(tenant.as_str())
    .bind(id.as_str())
    .fetch_optional(&mut *tx)
    .await
    .map_err(unavailable)?;
    if let Some(job) = user {
        let job = parse_job(&job)?;
        return Err(StoreError::DatasetInUse { dataset: id.clone(), job });
    }
    delete(&mut tx, tenant, id).await?;
    tx.commit().await.map_err(unavailable)
}

/// Deletes uploads without activity since `before_ms`.
pub async fn forget_given_up(
    conn: &mut PgConnection,
    before_ms: u64,
) -> Result<Vec<DatasetRecord>, StoreError> {
    let mut given_up = Vec::new();
    for row in read_page(conn, None, None, usize::MAX).await? {
        if !row.is_given_up(before_ms) {
            continue;
        }
        let mut tx = conn.begin().await.map_err(unavailable)?;
        locks::tenant(&mut tx, &row.tenant, Held::Alone).await?;
        // Somebody may have gone on with it meanwhile.
        match read(&mut tx, &row.tenant, &row.id).await {
            Ok(row) if row.is_given_up(before_ms) => {
                delete(&mut tx, &row.tenant, &row.id).await?;
                tx.commit().await.map_err(unavailable)?;
                given_up.push(row);
            }
            Ok(_) | Err(StoreError::DatasetNotFound(_)) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(given_up)
}

pub async fn read(
    conn: &mut PgConnection,
    tenant: &Tenant,
    id: &DatasetId,
) -> Result<DatasetRecord, StoreError> {
    let found: Option<Vec<u8>> =
        sqlx::query_scalar("SELECT row FROM datasets WHERE tenant = $1 AND dataset = $2")
            .bind(tenant.as_str())
            .bind(id.as_str())
            .fetch_optional(conn)
            .await
            .map_err(unavailable)?;
    let found = found.ok_or_else(|| StoreError::DatasetNotFound(id.clone()))?;
    decode("datasets", &found)
}

/// Datasets of a tenant, or of all, by tenant and name, after the given one; at most `limit`.
pub async fn read_page(
    conn: &mut PgConnection,
    tenant: Option<&Tenant>,
    after: Option<(&Tenant, &DatasetId)>,
    limit: usize,
) -> Result<Vec<DatasetRecord>, StoreError> {
    let rows: Vec<Vec<u8>> = sqlx::query_scalar(
        "SELECT row FROM datasets WHERE ($1::text IS NULL OR tenant = $1) \
         AND ($2::text IS NULL OR (tenant, dataset) > ($2, $3)) ORDER BY tenant, dataset LIMIT $4",
    )
    .bind(tenant.map(Tenant::as_str))
    .bind(after.map(|(tenant, _)| tenant.as_str()))
    .bind(after.map(|(_, id)| id.as_str()))
    .bind(number(limit as u64))
    .fetch_all(conn)
    .await
    .map_err(unavailable)?;
    rows.iter().map(|bytes| decode("datasets", bytes)).collect()
}

pub async fn write(conn: &mut PgConnection, row: &DatasetRecord) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO datasets (tenant, dataset, row) VALUES ($1, $2, $3) \
         ON CONFLICT (tenant, dataset) DO UPDATE SET row = excluded.row",
    )
    .bind(row.tenant.as_str())
    .bind(row.id.as_str())
    .bind(encode("datasets", row)?)
    .execute(conn)
    .await
    .map_err(unavailable)?;
    Ok(())
}

async fn delete(conn: &mut PgConnection, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM datasets WHERE tenant = $1 AND dataset = $2")
        .bind(tenant.as_str())
        .bind(id.as_str())
        .execute(conn)
        .await
        .map_err(unavailable)?;
    Ok(())
}
