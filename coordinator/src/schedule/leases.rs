//! Running leases: their deadlines and the last reports of their holders. Never stored.
//!
//! Heartbeats would be most of a store's writes, and are meaningless after a restart. So only milestones are
//! durable, and a starting coordinator gives every stored lease a full period of grace.

use std::collections::{BTreeMap, HashSet};

use super::{Expired, HeldOut, JobId, Lease, Stage, TaskId};

/// The last report of a worker.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LiveProgress {
    /// Iterations done.
    pub iteration: u32,
    /// Iterations in all.
    pub iterations: u32,
    /// Gaussians in training.
    pub gaussians: u32,
    /// Mean loss of the latest iterations.
    pub loss: f32,
    /// Speed of the latest iterations.
    pub iterations_per_second: f32,
    /// The latest measurement on held-out views.
    pub held_out: Option<HeldOut>,
}

#[derive(Debug)]
struct RunningLease {
    lease: Lease,
    deadline_ms: u64,
    progress: Option<LiveProgress>,
    /// Time of its last reported progress, or of its start.
    still_since_ms: u64,
}

/// Outcome of a renewal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Renewed {
    /// It runs for another period.
    Runs,
    /// It runs, but the job is paused: its holder must release the task.
    ToBeReleased,
    /// It is over.
    Over,
}

/// All running leases.
#[derive(Debug, Default)]
pub struct LeaseTable {
    /// By task and fence: a task may have two.
    running: BTreeMap<JobId, BTreeMap<(TaskId, u64), RunningLease>>,
    /// Jobs that are paused.
    paused: HashSet<JobId>,
}

impl LeaseTable {
    /// Starts or restarts the clock of a lease.
    pub fn grant(&mut self, lease: Lease, now_ms: u64, deadline_ms: u64) {
        let running = RunningLease { lease, deadline_ms, progress: None, still_since_ms: now_ms };
        let of_job = self.running.entry(running.lease.job.clone()).or_default();
        of_job.insert((running.lease.task, running.lease.fence), running);
    }

    /// Moves the deadline.
    pub fn renew(
        &mut self,
        lease: &Lease,
        now_ms: u64,
        deadline_ms: u64,
        progress: Option<LiveProgress>,
    ) -> Renewed {
        let of_job = self.running.get_mut(&lease.job);
        match of_job.and_then(|of_job| of_job.get_mut(&(lease.task, lease.fence))) {
            Some(running) if running.lease == *lease => {
                running.deadline_ms = running.deadline_ms.max(deadline_ms);
                let iteration = |progress: Option<LiveProgress>| progress.map(|progress| progress.iteration);
                if progress.is_some() && iteration(progress) != iteration(running.progress) {
                    running.still_since_ms = now_ms;
                }
                running.progress = progress.or(running.progress);
                self.standing_in(&lease.job)
            }
            _ => Renewed::Over,
        }
    }

    /// The outcome that a renewal would have.
    pub fn standing(&self, lease: &Lease) -> Renewed {
        let of_job = self.running.get(&lease.job);
        match of_job.and_then(|of_job| of_job.get(&(lease.task, lease.fence))) {
            Some(running) if running.lease == *lease => self.standing_in(&lease.job),
            _ => Renewed::Over,
        }
    }

    /// The outcome for running leases of a job.
    fn standing_in(&self, job: &JobId) -> Renewed {
        if self.paused.contains(job) { Renewed::ToBeReleased } else { Renewed::Runs }
    }

    /// Records whether a job is paused.
    pub fn note_paused(&mut self, job: &JobId, paused: bool) {
        if paused {
            self.paused.insert(job.clone());
        } else {
            self.paused.remove(job);
        }
    }

    /// Removes a lease; another one on the same task stays.
    pub fn end(&mut self, lease: &Lease) {
        self.retain_of_job(&lease.job, |held| held != lease);
    }

    /// Removes all leases of a job.
    pub fn end_job(&mut self, job: &JobId) {
        self.running.remove(job);
        self.paused.remove(job);
    }

    /// Keeps those leases of a job for which `holds` returns true.
    pub fn retain_of_job(&mut self, job: &JobId, holds: impl Fn(&Lease) -> bool) {
        let Some(of_job) = self.running.get_mut(job) else { return };
        of_job.retain(|_, running| holds(&running.lease));
        if of_job.is_empty() {
            self.running.remove(job);
        }
    }

    /// Leases to revoke, in a fixed order: expired ones, and those of workers that have reported no progress
    /// for `stall_ms` (0: disabled). The coordinator's own tasks report nothing.
    pub fn expired(&self, now_ms: u64, stall_ms: u64) -> Vec<(Lease, Expired)> {
        let why = |running: &RunningLease| {
            let is_still = stall_ms > 0 && running.still_since_ms.saturating_add(stall_ms) <= now_ms;
            if running.deadline_ms <= now_ms {
                Some(Expired::Silent)
            } else if is_still && !running.lease.task.stage.is_own() {
                Some(Expired::Stalled)
            } else {
                None
            }
        };
        let over = self.all().filter_map(|running| Some((running.lease.clone(), why(running)?)));
        over.collect()
    }

    /// The last report of a task; of two attempts, that of the one further ahead.
    pub fn progress(&self, job: &JobId, task: TaskId) -> Option<LiveProgress> {
        let leases = self.running.get(job)?.range((task, 0)..=(task, u64::MAX));
        leases.filter_map(|(_, running)| running.progress).max_by_key(|progress| progress.iteration)
    }

    /// Number of running leases by stage, and the sum of their training speeds.
    pub fn levels(&self) -> (BTreeMap<Stage, usize>, f64) {
        let mut by_stage = BTreeMap::new();
        let mut iterations_per_second = 0.0;
        for running in self.all() {
            *by_stage.entry(running.lease.task.stage).or_default() += 1;
            let speed = running.progress.map_or(0.0, |progress| f64::from(progress.iterations_per_second));
            iterations_per_second += if speed.is_finite() { speed } else { 0.0 };
        }
        (by_stage, iterations_per_second)
    }

    /// Iterations reported of all leased tasks of a job.
    pub fn live_iterations(&self, job: &JobId) -> u64 {
        self.progress_of_job(job).iter().map(|(_, progress)| u64::from(progress.iteration)).sum()
    }

    /// Progress of all leased tasks of a job that reported any, in the order of tasks; see
    /// [`Self::progress`].
    pub fn progress_of_job(&self, job: &JobId) -> Vec<(TaskId, LiveProgress)> {
        let mut by_task = BTreeMap::<TaskId, LiveProgress>::new();
        for ((task, _), running) in self.running.get(job).into_iter().flatten() {
            let Some(progress) = running.progress else { continue };
            let kept = by_task.entry(*task).or_insert(progress);
            if progress.iteration > kept.iteration {
                *kept = progress;
            }
        }
        by_task.into_iter().collect()
    }

    fn all(&self) -> impl Iterator<Item = &RunningLease> {
        self.running.values().flat_map(BTreeMap::values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_leases_of_a_task_are_independent_and_the_leader_reports() {
        let lease =
            |fence| Lease { job: JobId::new(0, 0), task: Stage::Partition.task_of(0), attempt: 1, fence };
        let at = |iteration| Some(LiveProgress { iteration, ..LiveProgress::default() });
        let mut table = LeaseTable::default();
        table.grant(lease(2), 0, 100);
        table.grant(lease(1), 0, 200);
        let renewed =
            [(1, 70), (2, 50)].map(|(fence, reached)| table.renew(&lease(fence), 0, 150, at(reached)));
        assert_eq!(renewed, [Renewed::Runs; 2]);
        let job = JobId::new(0, 0);
        assert_eq!(
            (table.progress(&job, Stage::Partition.task_of(0)), table.live_iterations(&job)),
            (at(70), 70)
        );
        assert_eq!(table.expired(150, 0), [(lease(2), Expired::Silent)]);
        table.end(&lease(1));
        assert_eq!(
            [1, 2].map(|fence| table.renew(&lease(fence), 0, 0, None)),
            [Renewed::Over, Renewed::Runs]
        );
        assert_eq!(table.live_iterations(&job), 50);
    }

    #[test]
    fn a_lease_of_a_paused_job_is_to_be_released_until_resumed() {
        let lease = Lease { job: JobId::new(0, 0), task: Stage::Global.task(), attempt: 1, fence: 1 };
        let mut table = LeaseTable::default();
        table.grant(lease.clone(), 0, 100);
        let events = [true, false].map(|paused| {
            table.note_paused(&lease.job, paused);
            table.renew(&lease, 0, 100, None)
        });
        assert_eq!(events, [Renewed::ToBeReleased, Renewed::Runs]);
    }

    #[test]
    fn a_lease_renewed_without_progress_is_revoked() {
        let lease = |task| Lease { job: JobId::new(0, 0), task, attempt: 1, fence: 1 };
        let mut table = LeaseTable::default();
        for task in [Stage::Global.task(), Stage::Merge.task()] {
            table.grant(lease(task), 0, 10_000);
        }
        let at = |iteration| Some(LiveProgress { iteration, ..LiveProgress::default() });
        for (now_ms, progress) in [(100, None), (400, at(0)), (800, at(7)), (1200, at(7)), (1700, at(7))] {
            for task in [Stage::Global.task(), Stage::Merge.task()] {
                assert_eq!(table.renew(&lease(task), now_ms, 10_000, progress), Renewed::Runs);
            }
            assert_eq!(table.expired(now_ms, 1000), [], "{now_ms}");
        }
        assert_eq!(table.expired(1800, 1000), [(lease(Stage::Global.task()), Expired::Stalled)]);
        assert_eq!(table.expired(1800, 0), []);
    }
}
