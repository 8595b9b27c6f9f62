//! What the services, the coordinator's own tasks and the sweeper share.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use fathom_observe::queue::Queue;
use tokio::sync::watch;

use crate::access::{Access, Principal};
use crate::capacity::Gap;
use crate::clock::Clock;
use crate::logs::JobLogs;
use crate::metrics::Metrics;
use crate::objects::TenantBlobs;
use crate::retention::Policy;
use crate::schedule::{JobId, Lease, Tenant};
use crate::service_error::ServiceError;
use crate::store::{JobStore, Store, StoreError};
use crate::wakeups::Wakeups;
use crate::worker_registry::WorkerRegistry;

/// What all services share.
pub struct State {
    /// Jobs, leases and results; what goes through it is counted.
    pub jobs: Arc<dyn JobStore>,
    /// Datasets, tokens, quotas, and everything for a file.
    pub store: Arc<dyn Store>,
    /// Bytes.
    pub objects: TenantBlobs,
    /// Tokens.
    pub access: Arc<Access>,
    /// Log lines of jobs.
    pub logs: Arc<JobLogs>,
    /// Lines of the coordinator's own tasks on their way there.
    pub own_lines: Arc<Queue<Lease>>,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// The one clock.
    pub clock: Clock,
    /// Silence after which a lease is over, milliseconds.
    pub lease_ms: u32,
    /// How those that wait hear of changes.
    pub wakeups: Wakeups,
    /// Ends waiting calls when the coordinator stops.
    pub stopping: watch::Receiver<bool>,
    /// Workers that have called.
    pub workers: WorkerRegistry,
    /// Jobs that no connected worker can go on with.
    pub gaps: Mutex<HashMap<JobId, Gap>>,
    /// Held while a token is revoked.
    pub revoking: tokio::sync::Mutex<()>,
    /// Held while a backup is made.
    pub backing_up: tokio::sync::Mutex<()>,
    /// What is kept for how long.
    pub policy: Policy,
    /// See [`crate::CoordinatorConfig::capacity_timeout_ms`].
    pub capacity_timeout_ms: u32,
}

impl State {
    /// The tenant of a job, if the caller may know of it: what belongs to another is not there.
    pub async fn owner(&self, caller: &Principal, job: &JobId) -> Result<Tenant, StoreError> {
        let tenant = self.jobs.job_row(job).await?.tenant;
        if caller.sees(&tenant) { Ok(tenant) } else { Err(StoreError::JobNotFound(job.clone())) }
    }

    /// Refuses when a tenant would have more than it may with `more` bytes.
    pub async fn check_bytes(&self, tenant: &Tenant, more: u64) -> Result<(), ServiceError> {
        let used_bytes = self.objects.used_bytes(tenant)?;
        match self.limit_bytes(tenant).await? {
            Some(limit_bytes) if used_bytes.saturating_add(more) > limit_bytes => {
                Err(ServiceError::TooManyBytes { tenant: tenant.clone(), used_bytes, limit_bytes })
            }
            _ => Ok(()),
        }
    }

    /// Bytes that a tenant may have; `None`: any number.
    pub async fn limit_bytes(&self, tenant: &Tenant) -> Result<Option<u64>, StoreError> {
        Ok(Some(self.store.quota(tenant).await?.max_bytes).filter(|&bytes| bytes > 0))
    }
}

/// Waits until the coordinator stops.
pub async fn stopped(stopping: &mut watch::Receiver<bool>) {
    // An error means that its owner is gone, which is the same.
    let _ = stopping.wait_for(|stopping| *stopping).await;
}
