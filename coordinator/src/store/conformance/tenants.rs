//! Isolation of tenants.

use super::*;
use crate::access::{Role, Token};

fn tenant(name: &str) -> Tenant {
    name.parse().unwrap()
}

fn job_of_tenant(number: u32, name: &str) -> NewJob {
    NewJob { tenant: tenant(name), ..new_job(number) }
}

/// Submits jobs of tenants and returns the names of the tenants whose plans are claimed, in order.
async fn claims(store: &dyn Store, limit: usize) -> Vec<String> {
    let mut order = Vec::new();
    for _ in 0..limit {
        let Some(grant) = claim(store, &[Stage::Plan], T0 + 100).await else { break };
        order.push(grant.job.tenant.to_string());
    }
    order
}

pub async fn tenants_share_workers_but_not_requests_and_lists(store: Arc<dyn Store>) {
    let store = store.as_ref();
    for number in 0..4 {
        store.submit(NewJob { priority: 9, ..job_of_tenant(number, "reef") }, T0).await.unwrap();
    }
    for number in 4..6 {
        store.submit(job_of_tenant(number, "wreck"), T0).await.unwrap();
    }
    // One id, two tenants: two jobs, each invisible to the other tenant.
    let same_id = NewJob { request_id: "request-0".into(), ..job_of_tenant(6, "wreck") };
    let other = store.submit(same_id.clone(), T0).await.unwrap();
    assert_eq!(other.job_id, same_id.job_id);
    assert_eq!(store.submit(same_id, T0 + 1).await.unwrap().job_id, other.job_id);

    assert_eq!(claims(store, 7).await, ["reef", "wreck", "reef", "wreck", "reef", "wreck", "reef"]);
    let filter = JobFilter { tenant: Some(tenant("wreck")), ..JobFilter::default() };
    let listed = store.list(&filter, None, 100).await.unwrap();
    assert_eq!(listed.len(), 3);
    assert!(listed.iter().all(|job| job.tenant == tenant("wreck")));
    let usage = store.usage().await.unwrap();
    let of = |open_jobs, leased_tasks| Usage { open_jobs, leased_tasks };
    assert_eq!(usage, [(tenant("reef"), of(4, 4)), (tenant("wreck"), of(3, 3))]);

    let mut own = claim_as("own", "a call", &[Stage::Plan]);
    own.worker.tenant = Some(tenant("kelp"));
    store.submit(job_of_tenant(7, "reef"), T0).await.unwrap();
    assert!(
        store.claim(&own, T0 + 100).await.unwrap().is_none(),
        "a worker of another tenant was assigned a task"
    );
    store.submit(job_of_tenant(8, "kelp"), T0).await.unwrap();
    assert_eq!(store.claim(&own, T0 + 100).await.unwrap().unwrap().job.tenant, tenant("kelp"));
}

pub async fn a_tenant_stays_within_its_quota(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let reef = tenant("reef");
    let quota = Quota { max_open_jobs: 2, max_parallel: 1, max_bytes: 0 };
    store.set_quota(&reef, Some(quota)).await.unwrap();
    let first = store.submit(job_of_tenant(0, "reef"), T0).await.unwrap();
    store.submit(job_of_tenant(1, "reef"), T0).await.unwrap();
    let refused = store.submit(job_of_tenant(2, "reef"), T0).await;
    assert!(matches!(refused, Err(StoreError::TooManyJobs { limit: 2, .. })), "{refused:?}");
    // A repeated call makes no job, so it is answered; another tenant has its own limits.
    assert_eq!(store.submit(job_of_tenant(0, "reef"), T0).await.unwrap(), first);
    store.submit(job_of_tenant(3, "wreck"), T0).await.unwrap();
    assert_eq!(claims(store, 4).await, ["reef", "wreck"]);

    cancel(store, &first.job_id, "", T0 + 60).await.unwrap();
    store.submit(job_of_tenant(2, "reef"), T0 + 61).await.unwrap();
    assert_eq!(claims(store, 4).await, ["reef"]);
    store.set_quota(&reef, None).await.unwrap();
    store.submit(job_of_tenant(4, "reef"), T0 + 62).await.unwrap();
    assert_eq!(claims(store, 4).await, ["reef", "reef"]);
}

pub async fn tokens_and_quotas_are_kept_and_travel_with_an_export(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let token = Token::random();
    let record = TokenRecord::new(&token, "ci".into(), Role::Submitter, Some(tenant("reef")), T0, None);
    store.put_token(&record).await.unwrap();
    let revoked = TokenRecord { revoked_ms: Some(T0 + 5), ..record };
    store.put_token(&revoked).await.unwrap();
    let quota = Quota { max_bytes: 7, ..Quota::default() };
    store.set_quota(&tenant("reef"), Some(quota)).await.unwrap();
    store.set_quota(&tenant("wreck"), Some(quota)).await.unwrap();
    store.set_quota(&tenant("wreck"), None).await.unwrap();
    store.submit(job_of_tenant(0, "reef"), T0).await.unwrap();
    let mark = WorkerMark { drains: false, reason: "hot".into(), since_ms: T0 };
    store.mark_worker("one", Some(&mark)).await.unwrap();

    let export = store.export().await.unwrap();
    assert_eq!(verify::faults(&export), Vec::<String>::new());
    let dir = tempfile::tempdir().unwrap();
    let sled = open(dir.path());
    let others: [&dyn Store; 2] = [&MemoryStore::new(rules(), LEASE_MS, STALL_MS), &sled];
    for other in others {
        other.import(&export).await.unwrap();
        assert_eq!(other.export().await.unwrap(), export);
        assert_eq!(other.tokens().await.unwrap(), std::slice::from_ref(&revoked));
        assert_eq!(other.quotas().await.unwrap(), [(tenant("reef"), quota)]);
        assert_eq!(other.worker_marks().await.unwrap(), [("one".to_owned(), mark.clone())]);
        assert_eq!(claims(other, 2).await, ["reef"], "an imported job's tasks are not assigned");
    }
    drop(sled);
    let again = open(dir.path());
    assert_eq!(again.quotas().await.unwrap(), [(tenant("reef"), quota)]);
}
