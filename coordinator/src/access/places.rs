//! Bounds the memory that callers can occupy by making data wait.
//!
//! A partial message, and a piece of a blob that the client does not read, stay in memory as long as the
//! client likes. So a call holds a place while its request arrives, and a download until it ends. Calls
//! without a place wait in order of arrival. The users of one tenant share a part of the places, so that they
//! can only delay each other, and workers have their own places.
//!
//! At worst that is 32 requests of users, of 12 MiB each (`MAX_UPLOAD_MESSAGE_BYTES`), and 160 uploads with a
//! piece of a MiB each. 448 downloads hold two or three pieces of a quarter of a MiB each, in HTTP/2. No
//! tenant has more than a quarter of the users' places.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::{Principal, Role};
use crate::schedule::Tenant;

/// Places of one kind.
struct Pool {
    /// Places of all users.
    people: Arc<Semaphore>,
    /// Places of the users of one tenant.
    of_tenant: usize,
    tenants: Mutex<HashMap<Tenant, Arc<Semaphore>>>,
    /// Places of workers; `None`: no limit.
    workers: Option<Arc<Semaphore>>,
}

/// The right to be in memory; given back when dropped.
#[derive(Debug)]
pub struct Place(#[expect(dead_code, reason = "held for its end")] Vec<OwnedSemaphorePermit>);

impl Pool {
    fn new(people: usize, of_tenant: usize, workers: Option<usize>) -> Self {
        let of = |count| Arc::new(Semaphore::new(count));
        Self { people: of(people), of_tenant, tenants: Mutex::default(), workers: workers.map(of) }
    }

    async fn take(&self, caller: &Principal) -> Place {
        let mut of = Vec::new();
        if caller.token_id.is_none() {
            // Without tokens, workers and users cannot be distinguished, nor can tenants.
            of.push(Arc::clone(&self.people));
        } else if caller.role == Role::Worker {
            of.extend(self.workers.clone());
        } else {
            let mut tenants = self.tenants.lock().unwrap_or_else(PoisonError::into_inner);
            // There is one for each tenant with tokens, so callers cannot make the table grow.
            let own =
                tenants.entry(caller.home()).or_insert_with(|| Arc::new(Semaphore::new(self.of_tenant)));
            of.extend([Arc::clone(own), Arc::clone(&self.people)]);
        }
        let mut permits = Vec::with_capacity(of.len());
        for semaphore in of {
            // They are never closed.
            permits.extend(semaphore.acquire_owned().await.ok());
        }
        Place(permits)
    }
}

/// All places.
pub struct Places {
    requests: Pool,
    uploads: Pool,
    downloads: Pool,
}

impl Default for Places {
    fn default() -> Self {
        Self {
            // Workers call often, with short messages: a lease must not wait behind an upload.
            requests: Pool::new(32, 8, None),
            uploads: Pool::new(128, 16, Some(32)),
            downloads: Pool::new(256, 64, Some(192)),
        }
    }
}

/// The kind of a call, which determines its places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One message.
    Request,
    /// An incoming blob.
    Upload,
    /// An outgoing blob.
    Download,
    /// A stream of short messages, as long as a worker runs.
    Session,
}

impl Kind {
    /// The kind of a method.
    pub fn of(method: &str) -> Self {
        match method {
            "WriteBlob" | "WriteChunk" => Self::Upload,
            "ReadBlob" => Self::Download,
            "Session" => Self::Session,
            _ => Self::Request,
        }
    }
}

impl Places {
    /// A place for an arriving request.
    pub async fn to_arrive(&self, kind: Kind, caller: &Principal) -> Option<Place> {
        match kind {
            Kind::Session => None,
            Kind::Upload => Some(self.uploads.take(caller).await),
            Kind::Request | Kind::Download => Some(self.requests.take(caller).await),
        }
    }

    /// A place for an answer that a client reads at its own pace.
    pub async fn to_leave(&self, kind: Kind, caller: &Principal) -> Option<Place> {
        match kind {
            Kind::Download => Some(self.downloads.take(caller).await),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    fn caller(role: Role, tenant: &str) -> Principal {
        let tenant = Some(tenant.parse().unwrap_or_default());
        Principal { role, tenant, token_id: Some(String::new()), ..Principal::anonymous() }
    }

    #[test]
    fn a_tenant_without_places_delays_neither_others_nor_workers() {
        let places = Places::default();
        let take = |role, tenant| places.to_leave(Kind::Download, &caller(role, tenant)).now_or_never();
        let held: Vec<_> = (0..100).map_while(|_| take(Role::Viewer, "reef")).collect();
        assert_eq!(held.len(), 64);
        assert!(take(Role::Submitter, "reef").is_none(), "users of one tenant share its places");
        assert!(take(Role::Viewer, "wreck").is_some());
        assert!(take(Role::Worker, "reef").is_some());
        drop(held);
        assert!(take(Role::Viewer, "reef").is_some());
    }

    #[test]
    fn workers_wait_for_no_place_to_renew_a_lease() {
        let places = Places::default();
        let worker = caller(Role::Worker, "reef");
        let held: Vec<_> =
            (0..100).map_while(|_| places.to_arrive(Kind::Upload, &worker).now_or_never()).collect();
        assert_eq!(held.len(), 32);
        assert!(places.to_arrive(Kind::of("Renew"), &worker).now_or_never().is_some());
        assert!(places.to_arrive(Kind::of("Session"), &worker).now_or_never().is_some());
    }
}
