//! Rate limits of tenants, by one token bucket each. Each of several coordinators allows an equal share, so
//! that the limit holds for all of them together.

use std::collections::HashMap;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::schedule::Tenant;

/// Burst size, in seconds of the rate.
const BURST_SECONDS: f64 = 2.0;

/// A bucket for each tenant.
pub struct RateLimit {
    per_second: f64,
    /// Coordinators that take calls.
    members: Arc<AtomicU32>,
    buckets: Mutex<HashMap<Tenant, Bucket>>,
}

struct Bucket {
    calls: f64,
    filled_ms: u64,
}

impl RateLimit {
    /// Limits to `per_second` calls a second at `members` coordinators together; 0: no limit.
    pub fn new(per_second: u32, members: Arc<AtomicU32>) -> Self {
        Self { per_second: per_second.into(), members, buckets: Mutex::default() }
    }

    /// Accepts a call of a tenant, or returns the time until one will be accepted.
    pub fn take(&self, tenant: &Tenant, now_ms: u64) -> Result<(), Duration> {
        if self.per_second <= 0.0 {
            return Ok(());
        }
        let per_second = self.per_second / f64::from(self.members.load(Relaxed).max(1));
        // A share of less than one call would refuse every call.
        let most = (per_second * BURST_SECONDS).max(1.0);
        let mut buckets = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        // There is one bucket for each tenant with tokens, so callers cannot make the table grow.
        let bucket = buckets.entry(tenant.clone()).or_insert(Bucket { calls: most, filled_ms: now_ms });
        let seconds = now_ms.saturating_sub(bucket.filled_ms) as f64 / 1e3;
        bucket.calls = (bucket.calls + seconds * per_second).min(most);
        bucket.filled_ms = now_ms;
        if bucket.calls >= 1.0 {
            bucket.calls -= 1.0;
            return Ok(());
        }
        Err(Duration::from_secs_f64((1.0 - bucket.calls) / per_second))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tenant(name: &str) -> Tenant {
        name.parse().unwrap_or_default()
    }

    #[test]
    fn a_tenant_that_calls_too_often_delays_only_itself() {
        let members = Arc::new(AtomicU32::new(1));
        let limit = RateLimit::new(10, Arc::clone(&members));
        let taken = |name, now_ms| (0..100).filter(|_| limit.take(&tenant(name), now_ms).is_ok()).count();
        assert_eq!(taken("reef", 0), 20);
        assert_eq!(taken("wreck", 0), 20);
        let pause = limit.take(&tenant("reef"), 0).err().map(|pause| pause.as_millis());
        assert_eq!(pause, Some(100));
        assert_eq!(taken("reef", 1000), 10);
        assert_eq!(taken("reef", 60_000), 20);
        members.store(2, Relaxed);
        assert_eq!(taken("reef", 120_000), 10, "another coordinator allows the other half");
        assert_eq!(taken("reef", 121_000), 5);
        members.store(100, Relaxed);
        assert_eq!(taken("reef", 200_000), 1, "a small share refuses every call");
    }

    #[test]
    fn a_rate_of_zero_sets_no_limit() {
        let limit = RateLimit::new(0, Arc::default());
        assert!((0..10_000).all(|_| limit.take(&Tenant::default(), 0).is_ok()));
    }
}
