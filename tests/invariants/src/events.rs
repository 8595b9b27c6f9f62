//! I3, I6, I7, I10: the events of one job, and its rows by them.

use std::collections::BTreeMap;

use fathom_coordinator::schedule::{EventBody, JobState, Stage, TaskChange, TaskId};
use fathom_coordinator::store::export::JobExport;

/// What the events said of a task so far.
struct Task {
    last: TaskChange,
    attempts: u32,
    /// Attempts that run, each with the iteration of its last checkpoint.
    running: BTreeMap<u32, Option<u32>>,
    /// Iteration of the last stored checkpoint.
    checkpoint: u32,
    /// Attempts that ended with a lost worker since the job was last started.
    losses: u32,
}

impl Default for Task {
    fn default() -> Self {
        let (last, running) = (TaskChange::Ready, BTreeMap::new());
        Self { last, attempts: 0, running, checkpoint: 0, losses: 0 }
    }
}

/// Adds a sentence for each event that cannot follow those before it, and for each row that contradicts them.
/// `loses_results` as in [`crate::Record`].
pub fn check(job: &JobExport, loses_results: bool, violations: &mut Vec<String>) {
    let id = &job.job.job_id;
    let mut tasks = BTreeMap::<TaskId, Task>::new();
    let (mut state, mut stage) = (None::<JobState>, Stage::Plan);
    // Tasks of the stage that are not done, and results that were lost since it began.
    let (mut open, mut lost) = (1, 0);
    for (index, event) in job.events.iter().enumerate() {
        let mut illegal = |name: &str, why: &str| {
            violations.push(format!("{name}: event {} of {id} {why}: {:?}", index + 1, event.body));
        };
        let is_cancelled = state == Some(JobState::Cancelled);
        if event.seq != index as u64 + 1 {
            illegal("I6", &format!("has number {}", event.seq));
        }
        if matches!(state, Some(JobState::Succeeded | JobState::Cancelled)) {
            illegal("I6", "came after the end of the job");
        }
        match &event.body {
            EventBody::JobState { state: next, .. } => {
                use JobState::{Failed, Paused, Running, Succeeded};
                let legal = match state {
                    None => *next == Running,
                    Some(Running) => *next != Running,
                    Some(Paused) => *next != Paused,
                    Some(Failed) => *next == Running,
                    Some(_) => false,
                };
                if !legal {
                    illegal("I6", &format!("cannot follow {state:?}"));
                }
                if *next == Succeeded && open > 0 {
                    illegal("I3", &format!("came with {open} open tasks"));
                }
                if state == Some(Failed) {
                    // A retry: unfinished tasks become ready, and their budgets are full again.
                    for task in tasks.values_mut() {
                        task.losses = 0;
                        task.running.clear();
                        if task.last != TaskChange::Done {
                            task.last = TaskChange::Ready;
                        }
                    }
                }
                state = Some(*next);
            }
            EventBody::Stage { stage: next, tasks: count } => {
                let is_next = lost == 0 && *next > stage && open == 0;
                let is_again = lost > 0 && *next == Stage::Partition && *count == lost;
                if !is_next && !is_again {
                    illegal("I6", &format!("cannot follow {stage:?} with {open} open tasks"));
                }
                (stage, open, lost) = (*next, *count, 0);
            }
            EventBody::Task { task, state: next, attempt, message, resumed_from, .. } => {
                use TaskChange::{Dead, Done, Leased, Ready};
                if is_cancelled {
                    illegal(if *next == Done { "I10" } else { "I6" }, "came after the job was cancelled");
                }
                let task = tasks.entry(*task).or_default();
                let is_new = *attempt == task.attempts + 1;
                let is_second = message.starts_with("beside ");
                let runs = task.running.contains_key(attempt);
                let is_lost = loses_results && (message.starts_with("result lost") || *next == Dead);
                let legal = match (task.last, next) {
                    (Ready | Dead, Leased) => is_new && !is_second,
                    (Leased, Leased) => is_new && is_second && task.running.len() == 1,
                    (Leased, Ready | Done | Dead) => runs,
                    (Done, Ready | Dead) => is_lost && *attempt == task.attempts,
                    (Ready, Dead) => *attempt == task.attempts,
                    _ => false,
                };
                if !legal {
                    let name = if (task.last, *next) == (Done, Done) { "I3" } else { "I6" };
                    illegal(name, &format!("cannot follow {:?} of attempt {}", task.last, task.attempts));
                }
                if *next == Leased && *resumed_from != task.checkpoint {
                    illegal("I5", &format!("does not begin at the stored checkpoint {}", task.checkpoint));
                }
                lost += u32::from(task.last == Done && *next == Ready);
                open -= u32::from(*next == Done && open > 0);
                match next {
                    Leased => _ = task.running.insert(*attempt, None),
                    _ => task.running.clear(),
                }
                task.last = *next;
                task.attempts = task.attempts.max(*attempt);
                task.losses += u32::from(message.starts_with("lease expired"));
            }
            EventBody::Checkpoint { task, attempt, iteration } => {
                let task = tasks.entry(*task).or_default();
                let before = task.running.get(attempt).copied();
                if is_cancelled || before.is_none() {
                    illegal("I6", "came while no worker had that attempt");
                }
                if before.flatten().is_some_and(|before| *iteration <= before) {
                    illegal("I6", &format!("is behind {before:?}"));
                }
                task.running.insert(*attempt, Some(*iteration));
                task.checkpoint = *iteration;
            }
            EventBody::Updated { .. } | EventBody::Warning { .. } => {}
        }
    }
    if job.job.state == JobState::Succeeded && tasks.values().any(|task| task.last != TaskChange::Done) {
        violations.push(format!("I3: {id} has succeeded, and not all of its tasks are done"));
    }
    for row in &job.tasks {
        let Some(task) = tasks.get(&row.task) else { continue };
        if row.attempts != task.attempts || row.losses < task.losses {
            violations.push(format!(
                "I7: {} of {id} has {} attempts and {} losses, by its events {} and {}",
                row.task, row.attempts, row.losses, task.attempts, task.losses
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use fathom_coordinator::schedule::{JobId, JobRecord, JobShape, TaskRecord, Tenant};
    use fathom_coordinator::store::StoredEvent;
    use fathom_core::scene::BlobRef;
    use serde_json::{Value, json};

    use super::*;

    /// A job that has succeeded, with one partition whose first worker was lost after a checkpoint.
    fn events() -> Vec<Value> {
        let task = |task: &str, state: &str, attempt: u32, message: &str, from: u32| {
            json!({"task": {"task": task, "state": state, "attempt": attempt, "worker": "", "message": message,
                "resumed_from": from}})
        };
        let state = |state: &str| json!({"job_state": {"state": state, "message": ""}});
        vec![
            state("running"),
            task("plan", "leased", 1, "", 0),
            task("plan", "done", 1, "", 0),
            json!({"stage": {"stage": "partition", "tasks": 1}}),
            task("partition-0000", "leased", 1, "", 0),
            json!({"checkpoint": {"task": "partition-0000", "attempt": 1, "iteration": 30}}),
            task("partition-0000", "ready", 1, "lease expired", 0),
            task("partition-0000", "leased", 2, "", 30),
            task("partition-0000", "done", 2, "", 30),
            state("succeeded"),
        ]
    }

    fn job(bodies: Vec<Value>, losses: u32) -> JobExport {
        let events: Vec<StoredEvent> = bodies
            .into_iter()
            .zip(1..)
            .map(|(body, seq)| StoredEvent { seq, time_ms: 0, body: serde_json::from_value(body).unwrap() })
            .collect();
        let job = JobRecord {
            job_id: JobId::new(0, 0),
            tenant: Tenant::default(),
            name: String::new(),
            request_id: String::new(),
            config_json: String::new(),
            manifest: BlobRef { digest: "0".repeat(64), bytes: 1 },
            dataset: None,
            ingest_seconds: 0.0,
            state: JobState::Succeeded,
            stage: Stage::Partition,
            stage_since_ms: 0,
            paused_since_ms: None,
            pause_reason: String::new(),
            open_tasks: 0,
            leased_tasks: 0,
            priority: 0,
            max_parallel: 0,
            created_ms: 0,
            ended_ms: None,
            announcement: Default::default(),
            error: String::new(),
            last_seq: events.len() as u64,
            shape: JobShape::unplanned(),
            outputs: Default::default(),
            iterations_total: 0,
            iterations_done: 0,
            stage_seconds: Default::default(),
        };
        let partition =
            TaskRecord { attempts: 2, losses, ..TaskRecord::new(Stage::Partition.task_of(0), None, 0) };
        JobExport { job, tasks: vec![partition], events }
    }

    fn violations(job: &JobExport) -> Vec<String> {
        let mut violations = Vec::new();
        check(job, true, &mut violations);
        violations
    }

    #[test]
    fn a_sound_history_has_no_violation() {
        assert_eq!(violations(&job(events(), 1)), Vec::<String>::new());
    }

    #[test]
    fn each_change_of_a_sound_history_is_noticed() {
        // The event, where in it, another value, and the invariant that it violates.
        for (at, pointer, value, name) in [
            (0, "/job_state/state", json!("succeeded"), "I6"),
            (2, "/task/state", json!("ready"), "I6"),
            (3, "/stage/stage", json!("plan"), "I6"),
            (4, "/task/attempt", json!(2), "I6"),
            (5, "/checkpoint/attempt", json!(2), "I6"),
            (7, "/task/resumed_from", json!(0), "I5"),
            (7, "/task/state", json!("done"), "I6"),
            (8, "/task/state", json!("ready"), "I3"),
            (9, "/job_state/state", json!("running"), "I6"),
        ] {
            let mut events = events();
            *events[at].pointer_mut(pointer).unwrap() = value;
            let found = violations(&job(events, 1));
            assert!(found.iter().any(|said| said.starts_with(name)), "event {at}, {pointer}: {found:?}");
        }
        let mut gap = job(events(), 1);
        gap.events.remove(5);
        assert!(violations(&gap).iter().any(|said| said.contains("has number 7")), "a gap");
        assert!(violations(&job(events(), 0))[0].starts_with("I7"), "the row knows of no loss");
        let mut twice = events();
        twice.insert(9, twice[8].clone());
        assert!(violations(&job(twice, 1)).iter().any(|said| said.starts_with("I3")), "done twice");
    }

    #[test]
    fn nothing_follows_a_cancellation() {
        let mut events = events();
        events[7] = json!({"job_state": {"state": "cancelled", "message": ""}});
        let found = violations(&job(events, 1));
        assert!(found.iter().any(|said| said.starts_with("I10")), "{found:?}");
    }

    #[test]
    fn a_lost_result_leads_back_to_its_stage() {
        let mut lost = events();
        let message = json!("result lost: the task is requeued");
        let mut again = lost[8].clone();
        again["task"]["state"] = json!("ready");
        again["task"]["message"] = message;
        let mut third = lost[7].clone();
        third["task"]["attempt"] = json!(3);
        let mut done = lost[8].clone();
        done["task"]["attempt"] = json!(3);
        let back = json!({"stage": {"stage": "partition", "tasks": 1}});
        lost.splice(9..9, [again, back.clone(), third, done]);
        let mut sound = job(lost.clone(), 2);
        sound.tasks[0].attempts = 3;
        assert_eq!(violations(&sound), Vec::<String>::new());
        let mut found = Vec::new();
        check(&sound, false, &mut found);
        assert!(!found.is_empty(), "a result that was lost on a sound disk");
        lost.remove(9);
        assert!(!violations(&job(lost, 2)).is_empty(), "the same without a lost result");
    }
}
