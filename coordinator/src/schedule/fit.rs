//! Matches workers and tasks: by stage, by method, by GPU memory, and by earlier failures.

use fathom_core::config::Method;
use serde::{Deserialize, Serialize};

use super::task::TaskRecord;
use super::{Stage, TaskId, Tenant};

/// A worker, as the assignment of tasks sees it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerProfile {
    /// Its display name.
    pub name: String,
    /// Identifies its process.
    pub incarnation: String,
    /// Stages whose tasks it takes.
    pub stages: Vec<Stage>,
    /// Methods of jobs whose tasks it takes.
    pub methods: Vec<Method>,
    /// GPU memory that it may use, bytes; `None` if it reports none, which counts as enough.
    pub memory_bytes: Option<u64>,
    /// The only tenant whose tasks it takes; `None` takes those of all.
    pub tenant: Option<Tenant>,
}

/// Requirements of a task on its worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Requirements {
    /// The task.
    pub task: TaskId,
    /// The method of its job.
    pub method: Method,
    /// GPU memory needed, bytes; 0 if unknown.
    pub memory_bytes: u64,
}

impl WorkerProfile {
    /// Whether it takes tasks of a tenant.
    pub fn serves(&self, tenant: &Tenant) -> bool {
        self.tenant.as_ref().is_none_or(|own| own == tenant)
    }

    /// Whether it takes tasks of this stage and method.
    fn takes(&self, need: Requirements) -> bool {
        self.stages.contains(&need.task.stage) && self.methods.contains(&need.method)
    }

    /// Whether it takes such a task and has enough memory for it.
    pub fn fits(&self, need: Requirements) -> bool {
        self.takes(need) && self.memory_bytes.is_none_or(|has| has >= need.memory_bytes)
    }
}

impl TaskRecord {
    /// Its requirements on a worker.
    pub fn need(&self) -> Requirements {
        Requirements { task: self.task, method: self.method, memory_bytes: self.memory_bytes }
    }

    /// Whether `worker` may take it while `peers` are connected. Workers that have failed it come last.
    pub fn may_go_to(&self, tenant: &Tenant, worker: &WorkerProfile, peers: &[WorkerProfile]) -> bool {
        may_take(tenant, self.need(), &self.failed_on, worker, peers)
    }
}

/// Whether `worker` may take a task of `tenant` that failed on the processes `failed_on`, while `peers` are
/// connected. Workers that have failed it come last, so that a fault of a machine does not count as one of
/// the task.
pub fn may_take(
    tenant: &Tenant,
    need: Requirements,
    failed_on: &[String],
    worker: &WorkerProfile,
    peers: &[WorkerProfile],
) -> bool {
    let fits = |peer: &WorkerProfile| peer.serves(tenant) && peer.fits(need);
    let has_failed = |peer: &WorkerProfile| failed_on.contains(&peer.incarnation);
    fits(worker) && (!has_failed(worker) || !peers.iter().any(|peer| fits(peer) && !has_failed(peer)))
}

/// Why no connected worker can take a task of a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Shortfall {
    /// None takes tasks of this stage and method.
    Workers,
    /// None has enough memory.
    Memory {
        /// The task and its memory.
        need: Requirements,
        /// The largest memory of any of them, bytes.
        largest: u64,
    },
}

impl Shortfall {
    /// The shortfall for `need` of a tenant; `None` if some worker fits.
    pub fn of(tenant: &Tenant, need: Requirements, peers: &[WorkerProfile]) -> Option<Self> {
        let mut there = peers.iter().filter(|peer| peer.serves(tenant));
        if there.clone().any(|peer| peer.fits(need)) {
            return None;
        }
        let takers = there.by_ref().filter(|peer| peer.takes(need));
        let largest = takers.filter_map(|peer| peer.memory_bytes).max();
        Some(largest.map_or(Self::Workers, |largest| Self::Memory { need, largest }))
    }
}

impl std::fmt::Display for Shortfall {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let gib = |bytes: u64| bytes as f64 / f64::from(1_u32 << 30);
        match self {
            Self::Workers => f.write_str(
                "no worker is connected that takes its tasks; start one with `fathom worker --coordinator URL`, or return a cordoned \
                 or drained worker to service (`fathom worker list`, `fathom worker uncordon`)",
            ),
            Self::Memory { need, largest } => write!(
                f,
                "{} needs {:.2} GiB of GPU memory and the largest connected worker may take {:.2} GiB; start one with more, \
                 raise its --gpu-memory-limit, or submit again with more partitions or a lower --max-gaussians",
                need.task,
                gib(need.memory_bytes),
                gib(*largest)
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(incarnation: &str, memory_bytes: Option<u64>) -> WorkerProfile {
        let name = "worker".to_owned();
        WorkerProfile {
            name,
            incarnation: incarnation.to_owned(),
            stages: vec![Stage::Partition],
            methods: vec![Method::Splats],
            memory_bytes,
            tenant: None,
        }
    }

    fn task(memory_bytes: u64, failed_on: &[&str]) -> TaskRecord {
        let failed_on = failed_on.iter().map(|&name| name.to_owned()).collect();
        TaskRecord { memory_bytes, failed_on, ..TaskRecord::new(Stage::Partition.task_of(3), None, 10) }
    }

    #[test]
    fn a_worker_without_the_method_takes_no_task_of_the_job() {
        let other = WorkerProfile { methods: Vec::new(), ..peer("other", Some(8)) };
        let task = task(1, &[]);
        assert!(!task.may_go_to(&Tenant::default(), &other, std::slice::from_ref(&other)));
        assert_eq!(Shortfall::of(&Tenant::default(), task.need(), &[other]), Some(Shortfall::Workers));
    }

    #[test]
    fn memory_decides_where_it_is_stated() {
        let peers = [peer("small", Some(4)), peer("large", Some(8)), peer("silent", None)];
        let may = |needed| {
            peers.each_ref().map(|worker| task(needed, &[]).may_go_to(&Tenant::default(), worker, &peers))
        };
        assert_eq!(may(0), [true; 3]);
        assert_eq!(may(5), [false, true, true]);
        assert_eq!(may(9), [false, false, true]);
        let global = TaskRecord::new(Stage::Global.task(), None, 10);
        assert!(
            !global.may_go_to(&Tenant::default(), &peers[1], &peers),
            "a stage that the worker does not take"
        );
    }

    #[test]
    fn a_worker_retakes_its_failed_task_only_after_all_others() {
        let peers = [peer("a", Some(8)), peer("b", Some(8)), peer("small", Some(1))];
        let may = |failed_on: &[&str]| {
            peers.each_ref().map(|worker| task(5, failed_on).may_go_to(&Tenant::default(), worker, &peers))
        };
        assert_eq!(may(&["a"]), [false, true, false]);
        assert_eq!(may(&["a", "b"]), [true, true, false]);
        assert!(
            task(5, &["a"]).may_go_to(&Tenant::default(), &peers[0], &peers[..1]),
            "the only one there is"
        );
    }

    #[test]
    fn a_worker_of_another_tenant_takes_nothing_and_delays_none() {
        let [reef, wreck] = ["reef", "wreck"].map(|name| name.parse::<Tenant>().unwrap_or_default());
        let peers = [peer("a", None), WorkerProfile { tenant: Some(wreck.clone()), ..peer("b", None) }];
        let failed = task(0, &["a"]);
        assert!(!failed.may_go_to(&reef, &peers[1], &peers));
        assert!(failed.may_go_to(&reef, &peers[0], &peers), "the other one may not take it");
        assert!(!failed.may_go_to(&wreck, &peers[0], &peers), "the other one has not failed it");
        assert_eq!(Shortfall::of(&reef, failed.need(), &peers[1..]), Some(Shortfall::Workers));
    }

    #[test]
    fn a_shortfall_names_the_needed_and_the_available_memory() {
        let need = task(3 << 30, &[]).need();
        assert_eq!(Shortfall::of(&Tenant::default(), need, &[peer("silent", None)]), None);
        assert_eq!(Shortfall::of(&Tenant::default(), need, &[]), Some(Shortfall::Workers));
        let shortfall =
            Shortfall::of(&Tenant::default(), need, &[peer("a", Some(1 << 30)), peer("b", Some(2 << 30))])
                .map(|shortfall| shortfall.to_string());
        let said = shortfall.unwrap_or_default();
        assert!(
            said.contains("partition-0003 needs 3.00 GiB") && said.contains("may take 2.00 GiB"),
            "{said}"
        );
    }
}
