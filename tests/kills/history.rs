//! The history of a job, from its events, and the invariants of any such history.

use std::collections::BTreeMap;
use std::fmt;

use fathom_coordinator::schedule::STAGES;
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

/// Data that the coordinator acknowledged to a worker, by the worker's log.
#[derive(Debug, PartialEq, Eq)]
pub enum Acknowledged {
    Checkpoint { job: String, task: String, attempt: u64, iteration: u64 },
    Result { job: String, task: String, attempt: u64 },
}

/// State of a task, from its events.
#[derive(Default)]
struct Task {
    state: &'static str,
    attempts: u64,
    checkpoint: u64,
    /// Iteration of the last checkpoint of the current attempt.
    in_attempt: Option<u64>,
    losses: u64,
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

/// Whether the message of a returned task counts as a lost worker.
fn is_loss(message: &str) -> bool {
    message.starts_with("lease expired")
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
        returned.filter(|event| is_loss(text(event, "message"))).count()
    }

    /// Leases, checkpoints and ends of tasks.
    pub fn events_of_tasks(&self) -> usize {
        self.events.iter().filter(|event| matches!(text(event, "event"), "task" | "checkpoint")).count()
    }

    /// All violations, one sentence each. `shown` is the job at its end.
    pub fn faults(&self, shown: &Value, max_losses: u64) -> Vec<String> {
        let mut faults = Vec::new();
        let mut tasks = BTreeMap::<String, Task>::new();
        let (mut stage, mut open, mut lost, mut state) = (0, 1, 0, "");
        for (index, event) in self.events.iter().enumerate() {
            let mut fault = |what: String| faults.push(format!("event {}: {what}: {event}", index + 1));
            if number(event, "seq") != index as u64 + 1 {
                fault("numbers have a gap, or repeat".into());
            }
            if matches!(state, "succeeded" | "cancelled") {
                fault("it came after the end of the job".into());
            }
            match text(event, "event") {
                "job_state" => {
                    let next = text(event, "state");
                    let legal = match state {
                        "" => next == "running",
                        "running" => next != "running",
                        "paused" => next != "paused",
                        "failed" => next == "running",
                        _ => false,
                    };
                    if !legal {
                        fault(format!("a job that is {state:?} cannot become this"));
                    }
                    if next == "succeeded" && open > 0 {
                        fault(format!("{open} tasks are open"));
                    }
                    if state == "failed" {
                        // A retry: budgets are reset, and no earlier lease counts.
                        for task in tasks.values_mut() {
                            task.losses = 0;
                            if task.state == "running" {
                                task.state = "ready";
                            }
                        }
                    }
                    state = next;
                }
                "job_stage" => {
                    let next = STAGES.iter().position(|spec| spec.name == text(event, "stage"));
                    let legal = if lost > 0 {
                        text(event, "stage") == "partition" && number(event, "tasks") == lost
                    } else {
                        next.is_some_and(|next| next > stage) && open == 0
                    };
                    if !legal {
                        fault(format!("it cannot follow {} with {open} open tasks", STAGES[stage].name));
                    }
                    (stage, open, lost) = (next.unwrap_or(stage), number(event, "tasks"), 0);
                }
                "task" => {
                    let task = tasks.entry(text(event, "task").to_owned()).or_default();
                    let next = text(event, "state");
                    match (task.state, next) {
                        ("" | "ready" | "failed", "running") => {
                            task.attempts += 1;
                            task.in_attempt = None;
                            if number(event, "resumed_from_iteration") != task.checkpoint {
                                fault(format!("the last stored checkpoint is {}", task.checkpoint));
                            }
                            task.state = "running";
                        }
                        ("running", "ready") => task.state = "ready",
                        ("done", "ready") if text(event, "message").starts_with("result lost") => {
                            task.state = "ready";
                            lost += 1;
                        }
                        ("running" | "ready" | "done", "failed") => task.state = "failed",
                        ("running", "done") => {
                            task.state = "done";
                            open = open.saturating_sub(1);
                        }
                        (before, _) => fault(format!("a task that is {before:?} cannot become this")),
                    }
                    if number(event, "attempt") != task.attempts {
                        fault(format!("the attempt is {}", task.attempts));
                    }
                    task.losses += u64::from(is_loss(text(event, "message")));
                }
                "checkpoint" => {
                    let task = tasks.entry(text(event, "task").to_owned()).or_default();
                    let iteration = number(event, "iteration");
                    if task.state != "running" || number(event, "attempt") != task.attempts {
                        fault("its lease is not held".into());
                    }
                    if task.in_attempt.is_some_and(|before| iteration <= before) {
                        fault("it is behind the one before it".into());
                    }
                    (task.checkpoint, task.in_attempt) = (iteration, Some(iteration));
                }
                _ => {}
            }
        }
        for known in shown["tasks"].as_array().into_iter().flatten() {
            let id = text(known, "task");
            let Some(task) = tasks.get(id) else { continue };
            let counts = (number(known, "attempts"), number(known, "losses"));
            if counts.0 != task.attempts || counts.1 < task.losses {
                faults.push(format!(
                    "{id}: attempts and losses are {counts:?}, by the events {:?}",
                    (task.attempts, task.losses)
                ));
            }
            if counts.1 > max_losses {
                faults.push(format!("{id}: {} losses, at most {max_losses} are allowed", counts.1));
            }
        }
        faults
    }

    /// Events that a watcher saw changed, twice or not at all, across coordinator restarts.
    pub fn differences(&self, seen: &[Value]) -> Vec<String> {
        let seen: Vec<&Value> = seen.iter().filter(|event| is_durable(event)).collect();
        if seen == self.events.iter().collect::<Vec<_>>() {
            return Vec::new();
        }
        let numbers = |events: Vec<&Value>| events.iter().map(|e| number(e, "seq")).collect::<Vec<_>>();
        vec![format!(
            "the watcher saw {:?}, there are {:?}",
            numbers(seen),
            numbers(self.events.iter().collect())
        )]
    }

    /// Acknowledged data that is missing.
    pub fn lacks(&self, job: &str, acknowledged: &[Acknowledged]) -> Vec<String> {
        let is_there = |what: &Acknowledged| match what {
            Acknowledged::Checkpoint { job: of, task, attempt, iteration } => {
                of != job
                    || self.events.iter().any(|event| {
                        event["event"] == "checkpoint"
                            && text(event, "task") == task
                            && number(event, "attempt") == *attempt
                            && number(event, "iteration") == *iteration
                    })
            }
            Acknowledged::Result { job: of, task, attempt } => {
                of != job
                    || self.events.iter().any(|event| {
                        event["state"] == "done"
                            && text(event, "task") == task
                            && number(event, "attempt") == *attempt
                    })
            }
        };
        let lost = acknowledged.iter().filter(|what| !is_there(what));
        lost.map(|what| format!("acknowledged and lost: {what:?}")).collect()
    }
}

impl fmt::Display for History {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.events.iter().try_for_each(|event| writeln!(f, "{event}"))
    }
}

impl Acknowledged {
    /// All acknowledgements in a worker's log.
    pub fn in_log(log: &str) -> Vec<Self> {
        log.lines().filter_map(Self::in_line).collect()
    }

    fn in_line(line: &str) -> Option<Self> {
        let value = |key: &str| {
            let (_, after) = line.split_once(&format!("{key}="))?;
            Some(after.split([' ', '}']).next().unwrap_or_default().to_owned())
        };
        let (job, task) = (value("job")?, value("task")?);
        let attempt = value("attempt")?.parse().ok()?;
        if line.contains("checkpoint stored") {
            let iteration = value(" iteration")?.parse().ok()?;
            Some(Self::Checkpoint { job, task, attempt, iteration })
        } else if line.contains("task done") {
            Some(Self::Result { job, task, attempt })
        } else {
            None
        }
    }
}

#[test]
fn an_impossible_history_is_noticed() {
    let printed = r#"{"event":"job_state","state":"running","seq":1}
        {"event":"task","task":"plan","state":"running","attempt":1,"worker":"coordinator","seq":2}
        {"event":"task","task":"plan","state":"done","attempt":1,"worker":"coordinator","seq":3}
        {"event":"job_stage","stage":"partition","tasks":1,"seq":4}
        {"event":"task","task":"partition-0000","state":"running","attempt":1,"worker":"a","seq":5}
        {"event":"checkpoint","task":"partition-0000","attempt":1,"iteration":30,"seq":6}
        {"event":"task","task":"partition-0000","state":"ready","attempt":1,"message":"lease expired","seq":7}
        {"event":"task","task":"partition-0000","state":"running","attempt":2,"resumed_from_iteration":30,"seq":8}
        {"event":"task","task":"partition-0000","state":"done","attempt":2,"seq":9}
        {"event":"job_state","state":"succeeded","seq":10}"#;
    let events = || printed.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
    let shown: Value = serde_json::json!({"tasks": [{"task": "partition-0000", "attempts": 2, "losses": 1}]});
    let sound = History::of(events());
    assert_eq!(sound.faults(&shown, 5), Vec::<String>::new());
    assert_eq!(sound.faults(&shown, 0).len(), 1, "losses beyond the budget");
    assert_eq!(sound.differences(&events().skip(1).collect::<Vec<_>>()).len(), 1);
    let fault = |index: usize, key: &str, value: Value| {
        let mut events: Vec<Value> = events().collect();
        events[index][key] = value;
        assert!(
            !History::of(events.into_iter()).faults(&shown, 5).is_empty(),
            "event {index} with another {key}"
        );
    };
    fault(3, "seq", 5.into());
    fault(2, "state", "ready".into());
    fault(4, "attempt", 2.into());
    fault(5, "attempt", 2.into());
    fault(7, "resumed_from_iteration", 0.into());
    fault(7, "state", "done".into());
    fault(9, "state", "running".into());
}

#[test]
fn a_workers_instructions_are_read_from_its_log() {
    let log = "2026-11-22T20:43:20.558881Z  INFO task{job=01a2 task=global attempt=2}: fathom_worker::session: checkpoint stored \
               iteration=8\n\
               2026-11-22T20:43:21.260033Z  INFO task{job=01a2 task=global attempt=2}: fathom_worker::session: task done seconds=4.3\n\
               2026-11-22T20:43:21.260033Z  INFO task{job=01a2 task=global attempt=2}: fathom_worker::session: task taken from=0";
    let (job, task) = ("01a2".to_owned(), "global".to_owned());
    let result = Acknowledged::Result { job: job.clone(), task: task.clone(), attempt: 2 };
    let acknowledged = Acknowledged::in_log(log);
    assert_eq!(acknowledged, [Acknowledged::Checkpoint { job, task, attempt: 2, iteration: 8 }, result]);
    let nothing = History::of(std::iter::empty());
    assert_eq!(nothing.lacks("01a2", &acknowledged).len(), 2);
    assert_eq!(nothing.lacks("another", &acknowledged).len(), 0);
}
