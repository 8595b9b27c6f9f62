//! How many workers of a pool the open tasks need.
//!
//! A pool is a kind of worker that KEDA starts, described by the metadata of its trigger. Its tasks are those
//! that such a worker can take.

use std::collections::HashMap;

use fathom_core::config::Method;

use crate::schedule::{OpenWork, Quota, Requirements, Tenant};

const MIB: u64 = 1 << 20;

/// A pool of workers, from the metadata of a trigger. KEDA sends other keys too, so unknown ones are ignored.
#[derive(Clone, Debug, PartialEq)]
pub struct Pool {
    /// GPU memory of its workers, bytes (`memoryMib`); `None` counts as enough for every task.
    memory_bytes: Option<u64>,
    /// It leaves tasks that need at most this to a smaller pool, bytes (`aboveMib`).
    above_bytes: u64,
    /// Methods that its workers have (`methods`, separated by commas); empty for all.
    methods: Vec<Method>,
    /// The tenant whose tokens its workers have (`tenant`); `None` for workers of all.
    tenant: Option<Tenant>,
    /// Tasks for which one worker is started (`tasksPerWorker`).
    pub tasks_per_worker: u32,
    /// What the metric counts (`count`).
    pub count: Count,
}

/// What the metric counts. It belongs to the strategy of the ScaledJob.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Count {
    /// Waiting and running tasks, for the strategy `default`, which subtracts the jobs that run.
    Demand,
    /// Waiting tasks alone, for the strategy `accurate`, which subtracts the jobs that have not started.
    Backlog,
}

impl Count {
    /// The name of the metric.
    pub fn metric(self) -> &'static str {
        match self {
            Self::Demand => "fathom-demand",
            Self::Backlog => "fathom-backlog",
        }
    }
}

impl Pool {
    /// # Errors
    /// When a value makes no sense: the key, and what to write instead.
    pub fn of(metadata: &HashMap<String, String>) -> Result<Self, String> {
        let number = |key: &str| -> Result<Option<u64>, String> {
            let Some(text) = metadata.get(key) else { return Ok(None) };
            let number = text.parse().map_err(|_| format!("{key} is {text:?}; write a whole number"))?;
            Ok(Some(number))
        };
        let bytes = |key: &str| -> Result<Option<u64>, String> {
            let Some(mib) = number(key)? else { return Ok(None) };
            mib.checked_mul(MIB).map(Some).ok_or_else(|| format!("{key} is {mib}, which is too much"))
        };
        let method =
            |name: &str| Method::try_from(name.to_owned()).map_err(|error| format!("methods: {error}"));
        let names = metadata.get("methods").map(String::as_str).unwrap_or_default();
        let names = names.split(',').map(str::trim).filter(|name| !name.is_empty());
        let tasks_per_worker = number("tasksPerWorker")?.unwrap_or(1);
        let pool = Self {
            memory_bytes: bytes("memoryMib")?,
            above_bytes: bytes("aboveMib")?.unwrap_or(0),
            methods: names.map(method).collect::<Result<_, _>>()?,
            tenant: match metadata.get("tenant") {
                None => None,
                Some(name) => Some(name.parse().map_err(|error| format!("tenant: {error}"))?),
            },
            tasks_per_worker: u32::try_from(tasks_per_worker)
                .ok()
                .filter(|&count| count > 0)
                .ok_or_else(|| format!("tasksPerWorker is {tasks_per_worker}; use 1 or more"))?,
            count: match metadata.get("count").map(String::as_str) {
                None | Some("demand") => Count::Demand,
                Some("backlog") => Count::Backlog,
                Some(other) => return Err(format!("count is {other:?}; use demand or backlog")),
            },
        };
        match pool.memory_bytes {
            Some(memory) if memory <= pool.above_bytes => {
                Err("memoryMib must be more than aboveMib, or the pool takes no task".to_owned())
            }
            _ => Ok(pool),
        }
    }

    /// Whether this pool is for such a task. A task of unknown needs, 0 bytes, goes to the smallest pool.
    fn takes(&self, tenant: &Tenant, need: Requirements) -> bool {
        let is_large_enough = self.memory_bytes.is_none_or(|memory| memory >= need.memory_bytes);
        let is_for_a_smaller_pool = self.above_bytes > 0 && need.memory_bytes <= self.above_bytes;
        !need.task.stage.is_own()
            && (self.methods.is_empty() || self.methods.contains(&need.method))
            && self.tenant.as_ref().is_none_or(|own| own == tenant)
            && is_large_enough
            && !is_for_a_smaller_pool
    }

    /// The value of its metric. Waiting tasks count once they are due, and only as many as the limits of job
    /// and tenant let run beside those that run.
    pub fn value(&self, work: &[OpenWork], quota_of: impl Fn(&Tenant) -> Quota, now_ms: u64) -> u64 {
        let mut room = HashMap::<&Tenant, u64>::new();
        for job in work {
            let limit = quota_of(&job.tenant).max_parallel;
            let left = room.entry(&job.tenant).or_insert(if limit == 0 { u64::MAX } else { limit.into() });
            *left = left.saturating_sub(job.leased.len() as u64);
        }
        let mut value = 0;
        for job in work {
            let running = job.leased.len() as u64;
            let of_job = match job.max_parallel {
                0 => u64::MAX,
                limit => u64::from(limit).saturating_sub(running),
            };
            let is_one = |(need, not_before_ms): &&(Requirements, u64)| {
                *not_before_ms <= now_ms && self.takes(&job.tenant, *need)
            };
            let waiting = job.waiting.iter().filter(is_one).count() as u64;
            let left = room.get_mut(&job.tenant);
            let may_start = left.as_deref().map_or(0, |left| waiting.min(of_job).min(*left));
            if let Some(left) = left {
                *left -= may_start;
            }
            value += may_start;
            if self.count == Count::Demand {
                value += job.leased.iter().filter(|need| self.takes(&job.tenant, **need)).count() as u64;
            }
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Stage;

    const NOW_MS: u64 = 1000;

    fn pool(metadata: &[(&str, &str)]) -> Result<Pool, String> {
        Pool::of(&metadata.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect())
    }

    fn need(number: u32, mib: u64) -> Requirements {
        let task = Stage::Partition.task_of(number);
        Requirements { task, method: Method::default(), memory_bytes: mib * MIB }
    }

    /// A job with waiting and leased tasks, each of these MiB.
    fn job(tenant: &str, max_parallel: u32, waiting: &[u64], leased: &[u64]) -> OpenWork {
        OpenWork {
            tenant: tenant.parse().unwrap(),
            max_parallel,
            waiting: waiting.iter().map(|&mib| (need(0, mib), 0)).collect(),
            leased: leased.iter().map(|&mib| need(1, mib)).collect(),
        }
    }

    fn value(metadata: &[(&str, &str)], work: &[OpenWork]) -> u64 {
        pool(metadata).unwrap().value(work, |_| Quota::default(), NOW_MS)
    }

    #[test]
    fn demand_counts_running_tasks_and_backlog_does_not() {
        let work = [job("a", 0, &[10; 5], &[10; 3]), job("b", 0, &[10; 2], &[])];
        assert_eq!(value(&[], &work), 10);
        assert_eq!(value(&[("count", "backlog")], &work), 7);
        assert_eq!(value(&[("tenant", "b")], &work), 2);
        assert_eq!(value(&[], &[]), 0);
    }

    #[test]
    fn pools_by_memory_share_the_tasks_between_them() {
        let work = [job("a", 0, &[0, 4000, 8000, 8001, 24_000, 24_001], &[6000, 20_000])];
        let (small, large) = ([("memoryMib", "8000")], [("aboveMib", "8000"), ("memoryMib", "24000")]);
        assert_eq!((value(&small, &work), value(&large, &work)), (4, 3));
        assert_eq!(value(&[("aboveMib", "24000")], &work), 1, "what no other pool can take");
    }

    #[test]
    fn tasks_in_back_off_and_own_tasks_start_no_worker() {
        let mut work = job("a", 0, &[10; 3], &[]);
        work.waiting[0].1 = NOW_MS + 1;
        work.waiting[1].0.task = Stage::Merge.task();
        assert_eq!(value(&[], &[work]), 1);
    }

    #[test]
    fn limits_of_job_and_tenant_bound_the_demand() {
        assert_eq!(value(&[], &[job("a", 4, &[10; 9], &[10; 3])]), 4);
        let limited = |tenant: &Tenant| Quota {
            max_parallel: if tenant.to_string().ends_with('a') { 5 } else { 0 },
            ..Quota::default()
        };
        let work =
            [job("a", 0, &[10; 9], &[10; 3]), job("a", 0, &[10; 9], &[10]), job("b", 0, &[10; 2], &[])];
        assert_eq!(pool(&[]).unwrap().value(&work, limited, NOW_MS), 5 + 2);
        assert_eq!(pool(&[("count", "backlog")]).unwrap().value(&work, limited, NOW_MS), 1 + 2);
    }

    #[test]
    fn senseless_metadata_is_refused_and_foreign_keys_are_not() {
        assert_eq!(pool(&[("scalerAddress", "fathom:7430"), ("other", "")]), pool(&[]));
        for (key, text, part) in [
            ("memoryMib", "8 GiB", "memoryMib is \"8 GiB\"; write a whole number"),
            ("memoryMib", "99999999999999999", "too much"),
            ("memoryMib", "0", "must be more than aboveMib"),
            ("tasksPerWorker", "0", "use 1 or more"),
            ("count", "all", "use demand or backlog"),
            ("methods", "nerf", "methods: there is no method \"nerf\""),
            ("tenant", "a b", "tenant: "),
        ] {
            let error = pool(&[(key, text)]).unwrap_err();
            assert!(error.contains(part), "{key}: {error}");
        }
    }
}
