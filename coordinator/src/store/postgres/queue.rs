//! Changes that wait for the transaction of their job.

use std::collections::HashMap;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

use super::super::StoreError;
use super::Inner;
use super::batch::{Answer, Change, Timed, run};
use crate::schedule::{JobId, Tenant};

/// Most changes of one transaction.
const AT_ONCE: usize = 256;

/// Changes by job. A job is in the map exactly while a task runs its transactions.
#[derive(Default)]
pub struct WaitingChanges(Mutex<HashMap<JobId, Vec<Waiting>>>);

struct Waiting {
    change: Timed,
    tenant: Option<Tenant>,
    answer: oneshot::Sender<Result<Answer, StoreError>>,
}

impl WaitingChanges {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, Vec<Waiting>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Applies a change to a job, with those of other callers that wait meanwhile. `tenant` is needed for
    /// claims. The change goes on when the caller is dropped.
    pub async fn change(
        self: &Arc<Self>,
        job: &JobId,
        tenant: Option<&Tenant>,
        change: Change,
        now_ms: u64,
    ) -> Result<Answer, StoreError> {
        let (answer, answered) = oneshot::channel();
        let waiting = Waiting { change: (change, now_ms), tenant: tenant.cloned(), answer };
        let is_first = {
            let mut jobs = self.waiting.lock();
            let is_first = !jobs.contains_key(job);
            jobs.entry(job.clone()).or_default().push(waiting);
            is_first
        };
        if is_first {
            let runs = Runs { store: Arc::clone(self), job: job.clone(), is_done: false };
            tokio::spawn(runs.until_none_waits());
        }
        answered.await.unwrap_or_else(|_| Err(StoreError::Unavailable("its transaction was given up".into())))
    }
}

/// Runs the transactions of a job.
struct Runs {
    store: Arc<Inner>,
    job: JobId,
    is_done: bool,
}

impl Runs {
    async fn until_none_waits(mut self) {
        while let Some(batch) = self.next_batch() {
            let tenant = batch.iter().find_map(|waiting| waiting.tenant.clone());
            let (changes, callers): (Vec<Timed>, Vec<_>) =
                batch.into_iter().map(|waiting| (waiting.change, waiting.answer)).unzip();
            let answers = self.transact(tenant.as_ref(), changes).await;
            match answers {
                Ok(answers) => {
                    for (caller, answer) in callers.into_iter().zip(answers) {
                        // A caller may have gone.
                        let _ = caller.send(answer);
                    }
                }
                Err(error) => {
                    let message = error.to_string();
                    for caller in callers {
                        let _ = caller.send(Err(match &error {
                            StoreError::Unavailable(message) => StoreError::Unavailable(message.clone()),
                            StoreError::Corrupt { tree, message } => {
                                StoreError::Corrupt { tree, message: message.clone() }
                            }
                            _ => StoreError::Failed(message.clone()),
                        }));
                    }
                }
            }
        }
    }

    async fn transact(
        &self,
        tenant: Option<&Tenant>,
        changes: Vec<Timed>,
    ) -> Result<Vec<Result<Answer, StoreError>>, StoreError> {
        let mut borrowed = self.store.connection().await?;
        let has_others = changes.iter().any(|(change, _)| !change.is_claim());
        let work = run(&self.store.settings, &mut borrowed.conn, &self.job, tenant, changes);
        let result = self.store.in_time(work).await;
        borrowed.done(&result);
        let (answers, has_written) = result?;
        match (has_written, has_others) {
            (true, true) => self.store.changed(),
            (true, false) => drop(self.store.grants.fetch_add(1, SeqCst)),
            (false, _) => {}
        }
        Ok(answers)
    }

    /// The changes that wait; `None` ends the task.
    fn next_batch(&mut self) -> Option<Vec<Waiting>> {
        let mut jobs = self.store.waiting.lock();
        let waiting = jobs.get_mut(&self.job)?;
        if waiting.is_empty() {
            jobs.remove(&self.job);
            self.is_done = true;
            return None;
        }
        let rest = waiting.split_off(waiting.len().min(AT_ONCE));
        Some(std::mem::replace(waiting, rest))
    }
}

/// After a panic, callers get an error instead of waiting forever.
impl Drop for Runs {
    fn drop(&mut self) {
        if !self.is_done {
            self.store.waiting.lock().remove(&self.job);
        }
    }
}
