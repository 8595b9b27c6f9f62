//! Wakes waiting calls on changes.

use tokio::sync::watch;

/// Counters that move on changes. They are hints: waiting calls also check at intervals.
pub struct Wakeups {
    /// Moves with every change: watchers of jobs check again.
    pub changes: watch::Sender<u64>,
    /// Moves when there may be work. A thousand workers wait for it, and frequent renewals bring none.
    pub work: watch::Sender<u64>,
    /// Moves when work may have to stop for a reason other than its own worker.
    pub interrupts: watch::Sender<u64>,
}

impl Default for Wakeups {
    fn default() -> Self {
        Self {
            changes: watch::Sender::new(0),
            work: watch::Sender::new(0),
            interrupts: watch::Sender::new(0),
        }
    }
}

impl Wakeups {
    /// Wakes all waiting calls.
    pub fn changed(&self) {
        self.progressed();
        self.work.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Wakes watchers, after a change that creates no work.
    pub fn progressed(&self) {
        self.changes.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Wakes all waiting calls, and workers that may have to stop.
    pub fn interrupted(&self) {
        self.changed();
        self.interrupts.send_modify(|version| *version = version.wrapping_add(1));
    }
}
