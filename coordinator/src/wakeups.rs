//! Wakes waiting calls on changes, here and at the other coordinators.

use tokio::sync::watch;

use crate::store::members::Hint;

/// Counters that move on changes. They are hints: waiting calls also check at intervals.
pub struct Wakeups {
    /// Moves with every change: watchers of jobs check again.
    pub changes: watch::Sender<u64>,
    /// Moves when there may be work. A thousand workers wait for it, and frequent renewals bring none.
    pub work: watch::Sender<u64>,
    /// Moves when work may have to stop for a reason other than its own worker.
    pub interrupts: watch::Sender<u64>,
    /// Changes by this process, for the other coordinators.
    pub made_here: watch::Sender<MadeHere>,
}

/// Counts of changes by this process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MadeHere {
    /// Changes that may bring work.
    pub work: u64,
    /// Those of them after which work may have to stop.
    pub interrupts: u64,
}

impl Default for Wakeups {
    fn default() -> Self {
        Self {
            changes: watch::Sender::new(0),
            work: watch::Sender::new(0),
            interrupts: watch::Sender::new(0),
            made_here: watch::Sender::default(),
        }
    }
}

fn advance(counter: &watch::Sender<u64>) {
    counter.send_modify(|version| *version = version.wrapping_add(1));
}

impl Wakeups {
    /// Wakes all waiting calls.
    pub fn changed(&self) {
        self.heard(Hint::Work);
        self.made_here.send_modify(|made| made.work = made.work.wrapping_add(1));
    }

    /// Wakes watchers, after a change that creates no work.
    pub fn progressed(&self) {
        advance(&self.changes);
    }

    /// Wakes all waiting calls, and workers that may have to stop.
    pub fn interrupted(&self) {
        self.heard(Hint::Interrupt);
        self.made_here.send_modify(|made| {
            made.work = made.work.wrapping_add(1);
            made.interrupts = made.interrupts.wrapping_add(1);
        });
    }

    /// Wakes calls after a change at another coordinator.
    pub fn heard(&self, hint: Hint) {
        advance(&self.changes);
        advance(&self.work);
        if hint == Hint::Interrupt {
            advance(&self.interrupts);
        }
    }
}
