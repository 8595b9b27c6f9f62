//! Datasets in sled: one row each, on which only rows of jobs depend. All operations hold the lock of the
//! in-memory state, as does the creation of jobs, so that no job uses a dataset that is being deleted.

use std::ops::Bound;

use fathom_core::scene::BlobRef;

use super::super::record::decode;
use super::super::{StoreError, check_new_dataset};
use super::SledStore;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::schedule::{JobRecord, Tenant};

const TREE: &str = "datasets";

/// Names never contain this separator, so datasets of one tenant are adjacent, by name.
fn key(tenant: &Tenant, id: &DatasetId) -> String {
    format!("{tenant}\0{id}")
}

impl SledStore {
    /// Begins a dataset, or finds the one that this request or another with the same files began; not durable
    /// yet.
    pub(super) fn begin(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError> {
        let _alone = self.live();
        let known = self.dataset_rows(Some(&new.tenant), None, usize::MAX)?;
        let row = match check_new_dataset(&new, &known)? {
            Some(known) => DatasetRecord { asked_ms: now_ms, ..known.clone() },
            None => new.into_row(now_ms),
        };
        self.put_dataset(&row)?;
        Ok(row)
    }

    /// Freezes a dataset with these files; not durable yet.
    pub(super) fn commit(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError> {
        let _alone = self.live();
        let mut row = self.dataset_row(tenant, id)?;
        if row.root != *root {
            return Err(StoreError::DatasetExists(id.clone()));
        }
        if !row.is_committed() {
            row.committed_ms = Some(now_ms);
            self.put_dataset(&row)?;
        }
        Ok(row)
    }

    /// Deletes a dataset that no job uses; not durable yet.
    pub(super) fn forget(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
        let _alone = self.live();
        self.dataset_row(tenant, id)?;
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            if job.tenant == *tenant && job.dataset.as_ref() == Some(id) {
                return Err(StoreError::DatasetInUse { dataset: id.clone(), job: job.job_id });
            }
        }
        self.put_alone::<DatasetRecord>(TREE, &self.trees.datasets, &key(tenant, id), None)
    }

    /// Deletes uploads without activity since `before_ms`; not durable yet.
    pub(super) fn forget_old_uploads(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError> {
        let _alone = self.live();
        let mut given_up = self.dataset_rows(None, None, usize::MAX)?;
        given_up.retain(|row| row.is_given_up(before_ms));
        for row in &given_up {
            let key = key(&row.tenant, &row.id);
            self.put_alone::<DatasetRecord>(TREE, &self.trees.datasets, &key, None)?;
        }
        Ok(given_up)
    }

    pub(super) fn put_dataset(&self, row: &DatasetRecord) -> Result<(), StoreError> {
        self.put_alone(TREE, &self.trees.datasets, &key(&row.tenant, &row.id), Some(row))
    }

    pub(super) fn dataset_row(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError> {
        let found = self.read(TREE, &self.trees.datasets, key(tenant, id).as_bytes())?;
        found.ok_or_else(|| StoreError::DatasetNotFound(id.clone()))
    }

    /// Datasets of a tenant, or of all, by tenant and name, after the given one; at most `limit`.
    pub(super) fn dataset_rows(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError> {
        let begin = match (after, tenant) {
            (Some((tenant, id)), _) => Bound::Excluded(key(tenant, id)),
            (None, Some(tenant)) => Bound::Included(format!("{tenant}\0")),
            (None, None) => Bound::Unbounded,
        };
        let rows = self.trees.datasets.range((begin, Bound::Unbounded)).map(|row| {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            decode::<DatasetRecord>(TREE, &bytes)
        });
        let is_meant = |row: &Result<DatasetRecord, StoreError>| {
            row.as_ref().map_or(true, |row| tenant.is_none_or(|tenant| *tenant == row.tenant))
        };
        rows.take_while(is_meant).take(limit).collect()
    }

    /// Whether a dataset is frozen; `None` if it does not exist. Call it under the lock of the creation of
    /// jobs.
    pub(super) fn is_committed(&self, tenant: &Tenant, id: &DatasetId) -> Result<Option<bool>, StoreError> {
        let row = self.read::<DatasetRecord>(TREE, &self.trees.datasets, key(tenant, id).as_bytes())?;
        Ok(row.map(|row| row.is_committed()))
    }
}
