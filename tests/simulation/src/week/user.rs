//! What users do in a week.

use fathom_coordinator::schedule::{Event, JobId};
use fathom_coordinator::store::{NewJob, StoreError};
use fathom_invariants::Fact;

use super::{BEGIN_MS, HOUR_MS, MINUTE_MS, TENANTS, Turn, Week};
use crate::scene::blob_ref;

impl Week {
    /// Submits a job, or changes one.
    pub(super) async fn user(&mut self) -> Result<(), StoreError> {
        let hour = (self.now_ms - BEGIN_MS) / HOUR_MS % 24;
        let pause = if hour < 10 { 8 * MINUTE_MS } else { 60 * MINUTE_MS };
        let next = self.random.within(pause / 2, 2 * pause);
        self.after(next, Turn::User);
        if self.random.permille(250) {
            return self.steer().await;
        }
        self.submitted += 1;
        let partitions = self.random.within(1, 13) as u32;
        let request = format!("request-{}", self.submitted);
        let job = || NewJob {
            announce: false,
            job_id: JobId::new(self.now_ms, self.submitted),
            tenant: TENANTS[self.submitted as usize % TENANTS.len()].parse().expect("a tenant"),
            request_id: request.clone(),
            name: request.clone(),
            config_json: "{}".into(),
            manifest: blob_ref(b"manifest"),
            dataset: None,
            ingest_seconds: 0.0,
            priority: (self.submitted % 3) as i32,
            max_parallel: if self.submitted.is_multiple_of(4) { 3 } else { 0 },
        };
        let (first, again) = (job(), job());
        let record = self.store.submit(first, self.now_ms).await?;
        self.count("submit");
        self.jobs.insert(record.job_id.clone(), partitions);
        let user = self.submitted as usize;
        self.note(Fact::Created { user, request: request.clone(), job: record.job_id });
        if self.random.permille(100) {
            // The answer was lost.
            let again = self.store.submit(again, self.now_ms).await?;
            self.note(Fact::Created { user, request, job: again.job_id });
        }
        Ok(())
    }

    /// A user pauses, resumes, cancels, retries or changes one of the latest jobs.
    async fn steer(&mut self) -> Result<(), StoreError> {
        let recent: Vec<JobId> = self.jobs.keys().rev().take(20).cloned().collect();
        if recent.is_empty() {
            return Ok(());
        }
        let job = &recent[self.random.within(0, recent.len() as u64) as usize];
        let event = match self.random.within(0, 10) {
            0 => Event::Cancel { reason: "enough".into() },
            1 | 2 => Event::Retry,
            3..6 => Event::Update { priority: Some(2), max_parallel: Some(2) },
            6 | 7 => Event::Pause { reason: "later".into() },
            _ => Event::Resume,
        };
        if matches!(event, Event::Pause { .. }) {
            self.paused.push(job.clone());
        }
        self.apply(job, event, "steer").await.map(drop)
    }
}
