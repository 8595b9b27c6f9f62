//! State shared by the services, the coordinator's own tasks and the sweeper.

use std::collections::HashMap;
use std::sync::atomic::AtomicU32;
use std::sync::{Arc, Mutex};

use fathom_observe::queue::Queue;
use tokio::sync::watch;

use crate::access::{Access, Principal};
use crate::capacity::Gap;
use crate::clock::Clock;
use crate::history::Waiting;
use crate::logs::Logs;
use crate::metrics::Metrics;
use crate::objects::TenantBlobs;
use crate::retention::Policy;
use crate::schedule::{JobId, Lease, Tenant};
use crate::service_error::ServiceError;
use crate::services::links::Links;
use crate::store::{JobStore, Store, StoreError};
use crate::wakeups::Wakeups;
use crate::worker_registry::WorkerRegistry;

/// State shared by all services.
pub struct State {
    /// Jobs, leases and results; counts all changes.
    pub jobs: Arc<dyn JobStore>,
    /// Datasets, tokens, quotas, and exports.
    pub store: Arc<dyn Store>,
    /// Bytes.
    pub objects: TenantBlobs,
    /// Tokens.
    pub access: Arc<Access>,
    /// Log lines of jobs.
    pub logs: Arc<dyn Logs>,
    /// Log lines of the coordinator's own tasks on their way there.
    pub own_lines: Arc<Queue<Lease>>,
    /// Points of curves on their way there.
    pub history: Waiting,
    /// Links to jobs.
    pub links: Links,
    /// Metrics.
    pub metrics: Arc<Metrics>,
    /// The one clock.
    pub clock: Clock,
    /// Lease duration, milliseconds.
    pub lease_ms: u32,
    /// Wakes waiting calls on changes.
    pub wakeups: Wakeups,
    /// Ends waiting calls when the coordinator stops.
    pub stopping: watch::Receiver<bool>,
    /// Workers that have called recently.
    pub workers: WorkerRegistry,
    /// Number of coordinators that share the store and take calls, this one included.
    pub members: Arc<AtomicU32>,
    /// Jobs that no connected worker can continue.
    pub gaps: Mutex<HashMap<JobId, Gap>>,
    /// Held while a token is revoked.
    pub revoking: tokio::sync::Mutex<()>,
    /// Held while a backup is made.
    pub backing_up: tokio::sync::Mutex<()>,
    /// Retention times.
    pub policy: Policy,
    /// Whether the ends of new jobs are announced ([`crate::webhook`]).
    pub has_webhook: bool,
    /// See [`crate::CoordinatorConfig::capacity_timeout_ms`].
    pub capacity_timeout_ms: u32,
}

impl State {
    /// The tenant of a job, if the caller may see it: objects of other tenants do not exist for the caller.
    pub async fn owner(&self, caller: &Principal, job: &JobId) -> Result<Tenant, StoreError> {
        if !caller.sees_job(job) {
            return Err(StoreError::JobNotFound(job.clone()));
        }
        let tenant = self.jobs.job_row(job).await?.tenant;
        if caller.sees(&tenant) { Ok(tenant) } else { Err(StoreError::JobNotFound(job.clone())) }
    }

    /// Refuses if `more` bytes would exceed the tenant's quota.
    pub async fn check_bytes(&self, tenant: &Tenant, more: u64) -> Result<(), ServiceError> {
        let used_bytes = self.objects.used_bytes(tenant).await?;
        match self.limit_bytes(tenant).await? {
            Some(limit_bytes) if used_bytes.saturating_add(more) > limit_bytes => {
                Err(ServiceError::TooManyBytes { tenant: tenant.clone(), used_bytes, limit_bytes })
            }
            _ => Ok(()),
        }
    }

    /// Maximum bytes of a tenant; `None`: no limit.
    pub async fn limit_bytes(&self, tenant: &Tenant) -> Result<Option<u64>, StoreError> {
        Ok(Some(self.store.quota(tenant).await?.max_bytes).filter(|&bytes| bytes > 0))
    }
}

/// Waits until the coordinator stops.
pub async fn stopped(stopping: &mut watch::Receiver<bool>) {
    // An error means that its owner is gone, which is equivalent.
    let _ = stopping.wait_for(|stopping| *stopping).await;
}
