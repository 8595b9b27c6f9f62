//! A job, and what its watcher saw of it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::process::Process;
use crate::small_disk::wait_for;

/// A job, and all events of its watcher from the start, across restarts.
pub struct Job {
    pub id: String,
    /// The number of its watcher.
    pub user: usize,
    pub watch: Mutex<Process>,
    pub seen: Arc<Mutex<Vec<(Instant, Value)>>>,
}

impl Job {
    /// The events that its watcher has received.
    pub fn seen(&self) -> Vec<Value> {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.iter().map(|(_, event)| event.clone()).collect()
    }

    /// Waits for an event, which may have arrived already.
    pub fn wait_for(&self, what: &str, is_it: impl Fn(&Value) -> bool) -> Value {
        self.wait_after(0, what, is_it).1
    }

    /// Waits for an event after the first `after`; returns the number of events up to it, its time, and the
    /// event.
    pub fn wait_after(&self, after: usize, what: &str, is_it: impl Fn(&Value) -> bool) -> (usize, Value) {
        let mut looked_at = after;
        wait_for(what, || {
            let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
            let found = seen.iter().enumerate().skip(looked_at).find(|(_, (_, event))| is_it(event));
            looked_at = seen.len().max(after);
            found.map(|(index, (_, event))| (index + 1, event.clone()))
        })
    }

    /// Whether its watcher has seen its end.
    pub fn is_over(&self) -> bool {
        self.watch.lock().unwrap_or_else(PoisonError::into_inner).ended().is_some()
    }

    /// Time from the last saved state of an attempt (its checkpoint, or else its lease) until `end`, as the
    /// watcher saw it.
    pub fn lost_work(&self, task: &str, attempt: u64, end: Instant) -> Option<Duration> {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let is_safe = |event: &Value| {
            event["task"] == task
                && event["attempt"] == attempt
                && (event["state"] == "running" || event["event"] == "checkpoint")
        };
        let safe = seen.iter().rfind(|(when, event)| *when <= end && is_safe(event));
        safe.map(|(when, _)| end.duration_since(*when))
    }

    /// Time at which the watcher first saw an attempt change to `state`.
    pub fn when(&self, task: &str, attempt: u64, state: &str) -> Option<Instant> {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let is_it =
            |event: &Value| event["task"] == task && event["attempt"] == attempt && event["state"] == state;
        seen.iter().find(|(_, event)| is_it(event)).map(|(when, _)| *when)
    }

    /// Progress of a task in the last report before `end`.
    pub fn iteration(&self, task: &str, end: Instant) -> u64 {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let reports = seen
            .iter()
            .filter(|(when, event)| *when <= end && event["task"] == task && event["event"] == "progress");
        reports.filter_map(|(_, event)| event["iteration"].as_u64()).next_back().unwrap_or(0)
    }

    /// Waits until a worker has a task; returns the worker's name.
    pub fn wait_until_leased(&self, task: &str) -> String {
        let event = self.wait_for(&format!("a worker for {task}"), |event| {
            event["task"] == task && event["state"] == "running"
        });
        event["worker"].as_str().expect("a name").to_owned()
    }

    /// Waits until a task is well under way: it has a checkpoint, or it was done before the first one was
    /// stored.
    pub fn wait_until_well_begun(&self, task: &str) {
        self.wait_for(&format!("a checkpoint or the end of {task}"), |event| {
            event["task"] == task && (event["event"] == "checkpoint" || event["state"] == "done")
        });
    }

    /// Waits for the first checkpoint of a task; returns its iteration.
    pub fn wait_for_checkpoint(&self, task: &str) -> u64 {
        let event = self.wait_for(&format!("a checkpoint of {task}"), |event| {
            event["task"] == task && event["event"] == "checkpoint"
        });
        event["iteration"].as_u64().expect("a number")
    }
}
