//! How those that wait hear of changes.

use tokio::sync::watch;

/// Counters that move when something has changed. They are hints: all who wait also look from time to time.
pub struct Wakeups {
    /// Moves with every change: watchers of jobs look again.
    pub changes: watch::Sender<u64>,
    /// Moves when there may be work: a thousand workers wait for it, and renewals, which bring none, come all the time.
    pub work: watch::Sender<u64>,
    /// Moves when work may have to stop that its worker did not stop itself.
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
    /// Tells all that wait to look again.
    pub fn changed(&self) {
        self.progressed();
        self.work.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Tells watchers to look again, where there can be no more work than before.
    pub fn progressed(&self) {
        self.changes.send_modify(|version| *version = version.wrapping_add(1));
    }

    /// Tells all that wait to look again, and workers whether they are to stop.
    pub fn interrupted(&self) {
        self.changed();
        self.interrupts.send_modify(|version| *version = version.wrapping_add(1));
    }
}
