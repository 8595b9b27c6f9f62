//! Rate-limited log lines about unauthenticated clients: a count, at most once a minute. A line for each
//! event would let them fill the log.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Minimum time between two lines.
pub const LOG_EVERY: Duration = Duration::from_secs(60);

/// Counts events, and decides when a line is due.
#[derive(Debug, Default)]
pub struct RateLimitedLog(Mutex<(u64, Option<Instant>)>);

impl RateLimitedLog {
    /// Counts one more; returns the number since the last line when another is due.
    pub fn count(&self) -> Option<u64> {
        let now = Instant::now();
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        state.0 += 1;
        if state.1.is_some_and(|logged| now - logged < LOG_EVERY) {
            return None;
        }
        let count = state.0;
        *state = (0, Some(now));
        Some(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn many_in_a_minute_make_one_line_that_counts_them() {
        let log = RateLimitedLog::default();
        let logged: Vec<_> = (0..1000).map(|_| log.count()).collect();
        assert_eq!((logged[0], logged[1..].iter().flatten().count()), (Some(1), 0));
        tokio::time::advance(LOG_EVERY).await;
        assert_eq!((log.count(), log.count()), (Some(1000), None));
    }
}
