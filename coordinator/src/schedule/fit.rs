//! Which worker may take which task: by its kind, by the memory of its GPU, and by who has failed it before.

use serde::{Deserialize, Serialize};

use super::task::TaskRecord;
use super::{TaskId, TaskKind};

/// A worker, as far as tasks are concerned.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// For people.
    pub name: String,
    /// Which process.
    pub incarnation: String,
    /// Kinds of task that it takes.
    pub kinds: Vec<TaskKind>,
    /// GPU memory that it may take, bytes; `None` where it does not say, which is taken for enough.
    pub memory_bytes: Option<u64>,
}

/// What a task asks of its worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Need {
    /// Which task.
    pub task: TaskId,
    /// GPU memory that it will need, bytes; 0 where nobody knows.
    pub memory_bytes: u64,
}

impl Peer {
    /// Whether it takes such tasks and has the memory for this one.
    pub fn fits(&self, need: Need) -> bool {
        self.kinds.contains(&need.task.kind()) && self.memory_bytes.is_none_or(|has| has >= need.memory_bytes)
    }
}

impl TaskRecord {
    /// What it asks of its worker.
    pub fn need(&self) -> Need {
        Need { task: self.task, memory_bytes: self.memory_bytes }
    }

    /// Whether `worker` may take it while `peers` are connected. One that has failed it comes after all that have not: a fault
    /// of a machine is then not taken for one of the task.
    pub fn may_go_to(&self, worker: &Peer, peers: &[Peer]) -> bool {
        let has_failed = |peer: &Peer| self.failed_on.contains(&peer.incarnation);
        worker.fits(self.need())
            && (!has_failed(worker) || !peers.iter().any(|peer| peer.fits(self.need()) && !has_failed(peer)))
    }
}

/// Why no connected worker can take a task of a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Lack {
    /// None takes such tasks.
    Workers,
    /// None has the memory.
    Memory {
        /// For which task, and how much it needs.
        need: Need,
        /// The most that one of them has, bytes.
        largest: u64,
    },
}

impl Lack {
    /// What is lacking for `need`; `None` when some peer fits.
    pub fn of(need: Need, peers: &[Peer]) -> Option<Self> {
        if peers.iter().any(|peer| peer.fits(need)) {
            return None;
        }
        let of_kind = peers.iter().filter(|peer| peer.kinds.contains(&need.task.kind()));
        let largest = of_kind.filter_map(|peer| peer.memory_bytes).max();
        Some(largest.map_or(Self::Workers, |largest| Self::Memory { need, largest }))
    }
}

impl std::fmt::Display for Lack {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let gib = |bytes: u64| bytes as f64 / f64::from(1_u32 << 30);
        match self {
            Self::Workers => f.write_str(
                "tasks are ready but no worker is connected; start one with `fathom worker --coordinator URL`",
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

    fn peer(incarnation: &str, memory_bytes: Option<u64>) -> Peer {
        let name = "worker".to_owned();
        Peer { name, incarnation: incarnation.to_owned(), kinds: vec![TaskKind::Partition], memory_bytes }
    }

    fn task(memory_bytes: u64, failed_on: &[&str]) -> TaskRecord {
        let failed_on = failed_on.iter().map(|&name| name.to_owned()).collect();
        TaskRecord { memory_bytes, failed_on, ..TaskRecord::new(TaskId::Partition(3), None, 10) }
    }

    #[test]
    fn memory_decides_where_it_is_stated() {
        let peers = [peer("small", Some(4)), peer("large", Some(8)), peer("silent", None)];
        let may = |needed| peers.each_ref().map(|worker| task(needed, &[]).may_go_to(worker, &peers));
        assert_eq!(may(0), [true; 3]);
        assert_eq!(may(5), [false, true, true]);
        assert_eq!(may(9), [false, false, true]);
        let global = TaskRecord::new(TaskId::Global, None, 10);
        assert!(!global.may_go_to(&peers[1], &peers), "a kind that the worker does not take");
    }

    #[test]
    fn who_has_failed_a_task_takes_it_again_only_when_all_others_have_too() {
        let peers = [peer("a", Some(8)), peer("b", Some(8)), peer("small", Some(1))];
        let may =
            |failed_on: &[&str]| peers.each_ref().map(|worker| task(5, failed_on).may_go_to(worker, &peers));
        assert_eq!(may(&["a"]), [false, true, false]);
        assert_eq!(may(&["a", "b"]), [true, true, false]);
        assert!(task(5, &["a"]).may_go_to(&peers[0], &peers[..1]), "the only one there is");
    }

    #[test]
    fn what_is_lacking_is_said_with_need_and_stock() {
        let need = task(3 << 30, &[]).need();
        assert_eq!(Lack::of(need, &[peer("silent", None)]), None);
        assert_eq!(Lack::of(need, &[]), Some(Lack::Workers));
        let lack = Lack::of(need, &[peer("a", Some(1 << 30)), peer("b", Some(2 << 30))])
            .map(|lack| lack.to_string());
        let said = lack.unwrap_or_default();
        assert!(
            said.contains("partition-0003 needs 3.00 GiB") && said.contains("may take 2.00 GiB"),
            "{said}"
        );
    }
}
