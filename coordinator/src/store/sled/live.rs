//! In-memory state derived from the rows.

use std::collections::{BTreeMap, HashMap};

use crate::schedule::{JobRows, JobState, LeaseTable, Queue, Quota, Tenant};

/// State known without reading rows. Its lock is held from before a transaction until this state is updated,
/// so that readers see both or neither.
#[derive(Default)]
pub struct Live {
    /// Waiting and leased tasks.
    pub queue: Queue,
    /// Running leases.
    pub leases: LeaseTable,
    /// Quotas of tenants.
    pub quotas: HashMap<Tenant, Quota>,
    /// Jobs by state.
    pub jobs: BTreeMap<JobState, usize>,
}

impl Live {
    /// Records that a job is in the state `now` and was in `before`.
    pub fn count_job(&mut self, before: Option<JobState>, now: Option<JobState>) {
        if let Some(count) = before.and_then(|before| self.jobs.get_mut(&before)) {
            *count = count.saturating_sub(1);
        }
        if let Some(now) = now {
            *self.jobs.entry(now).or_default() += 1;
        }
        self.jobs.retain(|_, count| *count > 0);
    }

    /// Applies written rows.
    pub fn follow(&mut self, rows: &JobRows) {
        let job = &rows.job;
        self.queue.note(job, rows.tasks.values());
        if job.state.is_open() {
            self.leases.note_paused(&job.job_id, job.state == JobState::Paused);
            self.leases.retain_of_job(&job.job_id, |lease| {
                rows.tasks.get(&lease.task).is_none_or(|record| record.is_held_by(lease))
            });
        } else {
            self.leases.end_job(&job.job_id);
        }
    }
}
