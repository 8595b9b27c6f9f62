//! The history in order: answers to clients and workers, actions of the store, and faults.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use fathom_invariants::Fact;

/// Number of log lines kept for a failure report.
const LINES_KEPT: usize = 60;

/// Everything, by one simulated clock.
#[derive(Default)]
pub struct History {
    inner: Mutex<Inner>,
}

#[derive(Default)]
struct Inner {
    now: Duration,
    facts: Vec<(Duration, Fact)>,
    lines: VecDeque<String>,
}

impl History {
    /// Advances the simulated time.
    pub fn set_now(&self, now: Duration) {
        self.lock().now = now;
    }

    /// Simulated time since the beginning.
    pub fn now(&self) -> Duration {
        turmoil::sim_elapsed().unwrap_or_else(|| self.lock().now)
    }

    /// Records a fact.
    pub fn note(&self, fact: Fact) {
        let now = self.now();
        self.lock().facts.push((now, fact));
    }

    /// Records a log line, for the analysis of a failure.
    pub fn line(&self, line: String) {
        let now = self.now();
        let mut inner = self.lock();
        if inner.lines.len() == LINES_KEPT {
            inner.lines.pop_front();
        }
        inner.lines.push_back(format!("{:>9.3} {line}", now.as_secs_f64()));
    }

    /// All facts so far.
    pub fn facts(&self) -> Vec<(Duration, Fact)> {
        self.lock().facts.clone()
    }

    /// All facts with their times, one per line.
    pub fn report(&self) -> Vec<String> {
        self.lock().facts.iter().map(|(at, fact)| format!("{} {fact:?}", at.as_micros())).collect()
    }

    /// The last facts and lines.
    pub fn tail(&self, facts: usize) -> String {
        let inner = self.lock();
        // The final re-read is omitted.
        let first_time: Vec<_> =
            inner.facts.iter().filter(|(_, fact)| !matches!(fact, Fact::Reread { .. })).collect();
        let from = first_time.len().saturating_sub(facts);
        let mut text = String::new();
        for (at, fact) in &first_time[from..] {
            text += &format!("{:>9.3} {fact}\n", at.as_secs_f64());
        }
        text += "log:\n";
        for line in &inner.lines {
            text += &format!("{line}\n");
        }
        text
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
