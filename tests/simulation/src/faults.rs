//! The faults, their times and durations, drawn from the seed before the run starts.

use std::cmp::Reverse;
use std::sync::Arc;
use std::time::Duration;

use fathom_invariants::Fact;
use turmoil::Sim;

use crate::network::COORDINATOR;
use crate::random::Random;
use crate::world::World;

/// No fault occurs before a first job can exist.
const FIRST_MS: u64 = 1500;
/// The last fault starts before this time.
const LAST_MS: u64 = 44_000;

/// A fault of a host, or of its link to the coordinator.
#[derive(Clone, Debug)]
enum Fault {
    /// The process dies at once; its connections break.
    Crash,
    /// The machine dies at once, without notice.
    PowerCut,
    /// A worker is asked to leave.
    Leave,
    /// The link drops everything.
    Cut,
    /// The link drops everything in one direction: to the coordinator, or from it.
    CutOneWay { to: bool },
    /// The link holds everything back and delivers it later.
    Hold,
}

/// A change of the world at its time.
struct Step {
    at: Duration,
    host: String,
    fault: Fault,
    begins: bool,
}

/// All faults of a run.
pub struct Faults {
    world: Arc<World>,
    /// Hosts other than the coordinator.
    others: Vec<String>,
    /// Sorted by time, last one first.
    steps: Vec<Step>,
}

impl Faults {
    /// The faults of a seed.
    pub fn of(world: &Arc<World>, none: bool) -> Self {
        let workers = (0..world.scenario.workers.len()).map(|index| format!("worker-{index}"));
        let users = (0..world.scenario.jobs.len()).map(|index| format!("user-{index}"));
        let others: Vec<String> = workers.chain(users).collect();
        let mut random = Random::new(world.seed, "faults");
        let mut steps = Vec::new();
        for host in others.iter().map(String::as_str).chain([COORDINATOR]) {
            // Faults on one host or link do not overlap, so that each can end.
            let mut at = Duration::ZERO;
            loop {
                at += random.ms(FIRST_MS, 16_000);
                if none || at.as_millis() as u64 >= LAST_MS {
                    break;
                }
                let to = random.permille(500);
                let is_worker = host.starts_with("worker");
                let fault = match random.within(0, 10) {
                    0..6 if host == COORDINATOR => Fault::Crash,
                    _ if host == COORDINATOR => Fault::PowerCut,
                    0 if is_worker => Fault::Crash,
                    1 if is_worker => Fault::PowerCut,
                    2 if is_worker => Fault::Leave,
                    0..5 => Fault::Cut,
                    5 | 6 => Fault::CutOneWay { to },
                    _ => Fault::Hold,
                };
                let lasts = random.ms(200, 9000);
                let step = |at, begins| Step { at, host: host.to_owned(), fault: fault.clone(), begins };
                steps.extend([step(at, true), step(at + lasts, false)]);
                at += lasts;
            }
        }
        steps.sort_by_key(|step| Reverse(step.at));
        Self { world: Arc::clone(world), others, steps }
    }

    /// Applies the faults that are due.
    pub fn go_on(&mut self, sim: &mut Sim<'_>, now: Duration) {
        while let Some(step) = self.steps.pop_if(|step| step.at <= now) {
            self.take(sim, step);
        }
    }

    /// Ends all active faults.
    pub fn end(&mut self, sim: &mut Sim<'_>) {
        while let Some(step) = self.steps.pop() {
            if !step.begins {
                self.take(sim, step);
            }
        }
        for host in &self.others {
            sim.release(host.as_str(), COORDINATOR);
            sim.repair(host.as_str(), COORDINATOR);
        }
        for host in self.others.iter().map(String::as_str).chain([COORDINATOR]) {
            if !sim.is_host_running(host) && !host.starts_with("user") {
                sim.bounce(host);
            }
        }
        self.world.history.note(Fact::Fault("there are no more faults".to_owned()));
    }

    /// All hosts that `host` has a link to.
    fn peers<'a>(&'a self, host: &str) -> Vec<&'a str> {
        if host == COORDINATOR { self.others.iter().map(String::as_str).collect() } else { vec![COORDINATOR] }
    }

    fn take(&self, sim: &mut Sim<'_>, Step { host, fault, begins, .. }: Step) {
        let name = host.as_str();
        match (&fault, begins) {
            (Fault::Crash, true) => sim.crash(name),
            (Fault::PowerCut, true) => {
                for peer in self.peers(name) {
                    sim.partition(name, peer);
                }
                sim.crash(name);
            }
            (Fault::Crash | Fault::PowerCut, false) => {
                if matches!(fault, Fault::PowerCut) {
                    for peer in self.peers(name) {
                        sim.repair(name, peer);
                    }
                }
                if !sim.is_host_running(name) {
                    sim.bounce(name);
                }
            }
            (Fault::Leave, true) => {
                let index = name.rsplit_once('-').and_then(|(_, index)| index.parse().ok());
                index.into_iter().for_each(|index| self.world.ask_to_leave(index));
            }
            (Fault::Leave, false) => return,
            (Fault::Cut, true) => sim.partition(name, COORDINATOR),
            (Fault::CutOneWay { to: true }, true) => sim.partition_oneway(name, COORDINATOR),
            (Fault::CutOneWay { to: false }, true) => sim.partition_oneway(COORDINATOR, name),
            (Fault::Cut | Fault::CutOneWay { .. }, false) => sim.repair(name, COORDINATOR),
            (Fault::Hold, true) => sim.hold(name, COORDINATOR),
            (Fault::Hold, false) => sim.release(name, COORDINATOR),
        }
        if begins {
            self.world.counts(|counts| match fault {
                Fault::Crash | Fault::PowerCut | Fault::Leave => {
                    counts.workers += u64::from(name.starts_with("worker"));
                }
                Fault::Cut | Fault::CutOneWay { .. } => counts.partitions += 1,
                Fault::Hold => counts.holds += 1,
            });
        }
        let when = if begins { "" } else { " ends" };
        self.world.history.note(Fact::Fault(format!("{fault:?} of {host}{when}")));
    }
}
