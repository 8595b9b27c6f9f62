//! The history of a job, from the events that its watchers saw, and the facts of a scenario: what clients and
//! workers were answered. The invariants of both are those of the simulation (`fathom-invariants`).

use std::fmt;

use fathom_coordinator::schedule::JobId;
use fathom_invariants::Fact;
use serde_json::Value;

/// Durable events of one job, in order.
pub struct History {
    events: Vec<Value>,
}

/// One lease of a task, from its event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leased {
    pub worker: String,
    pub attempt: u64,
    pub resumed_from: u64,
    /// The reason why the attempt was returned; `None` if it was not.
    pub returned: Option<String>,
}

fn text<'a>(event: &'a Value, key: &str) -> &'a str {
    event[key].as_str().unwrap_or_default()
}

fn number(event: &Value, key: &str) -> u64 {
    event[key].as_u64().unwrap_or_default()
}

/// Progress events are not durable. An object without a name is the job, printed at its end; one without a
/// number is a remark of the watcher.
fn is_durable(event: &Value) -> bool {
    event["event"].is_string() && event["event"] != "progress" && event["seq"].is_u64()
}

impl History {
    /// The history printed by `fathom watch --json`.
    pub fn of(events: impl Iterator<Item = Value>) -> Self {
        Self { events: events.filter(is_durable).collect() }
    }

    /// Every lease of a task, in order.
    pub fn leases(&self, task: &str) -> Vec<Leased> {
        let mut leases: Vec<Leased> = Vec::new();
        for event in self.events.iter().filter(|event| event["event"] == "task" && event["task"] == task) {
            match (text(event, "state"), leases.last_mut()) {
                ("running", _) => leases.push(Leased {
                    worker: text(event, "worker").to_owned(),
                    attempt: number(event, "attempt"),
                    resumed_from: number(event, "resumed_from_iteration"),
                    returned: None,
                }),
                ("ready" | "failed", Some(lease)) => {
                    lease.returned = Some(text(event, "message").to_owned());
                }
                _ => {}
            }
        }
        leases
    }

    /// Leases of all tasks whose worker was lost.
    pub fn losses(&self) -> usize {
        let returned = self.events.iter().filter(|event| event["event"] == "task");
        returned.filter(|event| text(event, "message").starts_with("lease expired")).count()
    }

    /// Leases, checkpoints and ends of tasks.
    pub fn events_of_tasks(&self) -> usize {
        self.events.iter().filter(|event| matches!(text(event, "event"), "task" | "checkpoint")).count()
    }
}

impl fmt::Display for History {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.events.iter().try_for_each(|event| writeln!(f, "{event}"))
    }
}

/// What a watcher of a job saw: events as they came, or `again` when all had happened.
pub fn seen(user: usize, job: &JobId, events: &[Value], again: bool) -> Vec<Fact> {
    let durable = events.iter().filter(|event| is_durable(event));
    let fact = |event: &Value| {
        let (seq, digest) = (number(event, "seq"), event.to_string());
        match again {
            false => Fact::Seen { user, job: job.clone(), seq, digest },
            true => Fact::Reread { user, job: job.clone(), seq, digest },
        }
    };
    durable.map(fact).collect()
}

/// All acknowledgements in a worker's log.
pub fn acknowledged(log: &str) -> Vec<Fact> {
    log.lines().filter_map(acknowledgement).collect()
}

fn acknowledgement(line: &str) -> Option<Fact> {
    let value = |key: &str| {
        let (_, after) = line.split_once(&format!("{key}="))?;
        Some(after.split([' ', '}']).next().unwrap_or_default().trim_matches('"').to_owned())
    };
    let (job, task) = (value("job")?, value("task")?);
    let attempt = value("attempt")?.parse().ok()?;
    if line.contains("checkpoint stored") {
        let iteration = value(" iteration")?.parse().ok()?;
        Some(Fact::CheckpointSafe { job, task, attempt, iteration })
    } else if line.contains("task done") {
        Some(Fact::ResultTaken { job, task, attempt })
    } else {
        None
    }
}

#[test]
fn a_workers_acknowledgements_are_read_from_its_log() {
    let log = "2026-11-22T20:43:20.558881Z  INFO task{job=\"01a2\" task=\"global\" attempt=2 worker=\"far\"}: fathom_worker::session: checkpoint stored \
               iteration=8\n\
               2026-11-22T20:43:21.260033Z  INFO task{job=\"01a2\" task=\"global\" attempt=2 worker=\"far\"}: fathom_worker::session: task done seconds=4.3\n\
               2026-11-22T20:43:21.260033Z  INFO task{job=\"01a2\" task=\"global\" attempt=2 worker=\"far\"}: fathom_worker::session: task taken from=0";
    let found: Vec<String> = acknowledged(log).iter().map(|fact| format!("{fact:?}")).collect();
    assert_eq!(
        found,
        [
            r#"CheckpointSafe { job: "01a2", task: "global", attempt: 2, iteration: 8 }"#,
            r#"ResultTaken { job: "01a2", task: "global", attempt: 2 }"#,
        ]
    );
}
