//! The one clock of the coordinator.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tokio::time::Instant;

/// Unix milliseconds that never run backwards: the wall clock at the start of the process plus a monotonic
/// clock. Setting the wall clock during a run neither ends leases nor keeps them alive. The monotonic clock
/// is the runtime's, which a simulation advances by hand.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    started: Instant,
    started_ms: u64,
}

impl Clock {
    /// Starts now.
    pub fn start() -> Self {
        // A wall clock before 1970 counts as 1970: times are for display and pauses only.
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self::starting_at(since_epoch.as_millis() as u64)
    }

    /// Starts now, at a given time in Unix milliseconds.
    pub fn starting_at(unix_ms: u64) -> Self {
        Self { started: Instant::now(), started_ms: unix_ms }
    }

    /// Now.
    pub fn now_ms(&self) -> u64 {
        self.started_ms + self.started.elapsed().as_millis() as u64
    }

    /// Now, as a file time.
    pub fn system_time(&self) -> SystemTime {
        UNIX_EPOCH + Duration::from_millis(self.now_ms())
    }
}
