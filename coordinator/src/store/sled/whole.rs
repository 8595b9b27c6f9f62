//! The store as a whole: export, import, and the invariants between its trees.

use sled::{IVec, Tree};

use super::super::export::{Export, JobExport};
use super::super::record::decode;
use super::super::{StoreError, StoredEvent, request_key};
use super::rows::{DEPLOYMENT, LAST_FENCE, event_key, job_of_key, task_key};
use super::{SledStore, Trees};
use crate::schedule::{JobId, JobRecord, Quota, TaskRecord, Tenant};

/// Keys and rows of a tree, ascending.
type Rows = Vec<(IVec, IVec)>;

/// The rows of all trees at one moment, not decoded yet.
pub(super) struct AllRows {
    jobs: Rows,
    tasks: Rows,
    events: Rows,
    requests: Rows,
    workers: Rows,
    quotas: Rows,
    tokens: Rows,
    datasets: Rows,
    last_fence: Option<IVec>,
    deployment: Option<IVec>,
}

impl SledStore {
    /// Reads all rows while no job changes: sled has no readable snapshots, and a mixture of rows before and
    /// after a change would be inconsistent. Writers wait while the rows are copied in memory; they are
    /// decoded later. Tokens and marks are independent rows.
    pub(super) fn all_rows(&self) -> Result<AllRows, StoreError> {
        let _alone = self.live();
        let Trees { jobs, tasks, events, requests, workers, quotas, tokens, datasets, meta } = &self.trees;
        let all =
            |tree: &Tree| tree.iter().collect::<Result<Rows, _>>().map_err(|error| self.storage_error(error));
        Ok(AllRows {
            jobs: all(jobs)?,
            tasks: all(tasks)?,
            events: all(events)?,
            requests: all(requests)?,
            workers: all(workers)?,
            quotas: all(quotas)?,
            tokens: all(tokens)?,
            datasets: all(datasets)?,
            last_fence: meta.get(LAST_FENCE).map_err(|error| self.storage_error(error))?,
            deployment: meta.get(DEPLOYMENT).map_err(|error| self.storage_error(error))?,
        })
    }

    /// Imports all data of another store into an empty one; not durable yet.
    pub(super) fn take_all(&self, export: &Export) -> Result<(), StoreError> {
        if !self.trees.requests.is_empty() {
            return Err(StoreError::NotEmpty);
        }
        for JobExport { job, tasks, events } in &export.jobs {
            let id = &job.job_id;
            self.transact(|tx| {
                let request = request_key(&job.tenant, &job.request_id);
                tx.put("requests", tx.requests, request.as_bytes(), id)?;
                tx.put("jobs", tx.jobs, id.as_str().as_bytes(), job)?;
                for record in tasks {
                    tx.write_task(id, record)?;
                }
                for event in events {
                    tx.put("events", tx.events, &event_key(id, event.seq), event)?;
                }
                Ok(())
            })?;
        }
        self.transact(|tx| {
            for (request, job) in &export.taken_requests {
                tx.put("requests", tx.requests, request.as_bytes(), job)?;
            }
            tx.put("meta", tx.meta, LAST_FENCE, &export.last_fence)
        })?;
        if let Some(name) = &export.deployment {
            self.put_alone("meta", &self.trees.meta, DEPLOYMENT, Some(name))?;
        }
        for (incarnation, mark) in &export.marks {
            self.put_alone("workers", &self.trees.workers, incarnation, Some(mark))?;
        }
        for (tenant, quota) in &export.quotas {
            self.put_alone("quotas", &self.trees.quotas, tenant.as_str(), Some(quota))?;
        }
        for token in &export.tokens {
            self.put_alone("tokens", &self.trees.tokens, &token.id, Some(token))?;
        }
        for dataset in &export.datasets {
            self.put_dataset(dataset)?;
        }
        *self.live() = self.read_live()?;
        Ok(())
    }

    /// A sentence for each row without a job, and for each job that its request id does not lead to.
    /// [`crate::store::verify`] checks the rows themselves.
    ///
    /// # Errors
    /// When a row cannot be read.
    pub fn index_faults(&self) -> Result<Vec<String>, StoreError> {
        let mut faults = Vec::new();
        for row in &self.trees.tasks {
            let (key, bytes) = row.map_err(|e| self.storage_error(e))?;
            let record: TaskRecord = decode("tasks", &bytes)?;
            let id = job_of_key(&key)?;
            if task_key(&id, record.task) != *key {
                faults.push(format!("{} of job {id} has a wrong key", record.task));
            }
            if self.read::<JobRecord>("jobs", &self.trees.jobs, id.as_str().as_bytes())?.is_none() {
                faults.push(format!("{} belongs to job {id}, which does not exist", record.task));
            }
        }
        let mut events = 0;
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            events += job.last_seq;
            let request = request_key(&job.tenant, &job.request_id);
            let known: Option<JobId> = self.read("requests", &self.trees.requests, request.as_bytes())?;
            if known.as_ref() != Some(&job.job_id) {
                faults.push(format!("request {} does not lead to its job {}", job.request_id, job.job_id));
            }
        }
        let found = self.trees.events.len() as u64;
        if found != events {
            faults.push(format!("there are {found} events, but jobs have {events}"));
        }
        Ok(faults)
    }
}

impl AllRows {
    /// Decodes the rows.
    ///
    /// # Errors
    /// When a row cannot be read.
    pub(super) fn into_export(self) -> Result<Export, StoreError> {
        let mut export = Export::default();
        for (_, bytes) in &self.jobs {
            let job: JobRecord = decode("jobs", bytes)?;
            let id = &job.job_id;
            let mut tasks = Vec::new();
            for task in job.shape.tasks() {
                let key = task_key(id, task);
                if let Ok(at) = self.tasks.binary_search_by(|(known, _)| known.as_ref().cmp(&key)) {
                    tasks.push(decode::<TaskRecord>("tasks", &self.tasks[at].1)?);
                }
            }
            let begin = self.events.partition_point(|(key, _)| key.as_ref() < &event_key(id, 0)[..]);
            let of_job =
                self.events[begin..].iter().take_while(|(key, _)| key.starts_with(id.as_str().as_bytes()));
            let events =
                of_job.map(|(_, bytes)| decode::<StoredEvent>("events", bytes)).collect::<Result<_, _>>()?;
            export.jobs.push(JobExport { job, tasks, events });
        }
        for (request, bytes) in &self.requests {
            let job: JobId = decode("requests", bytes)?;
            if export.jobs.binary_search_by(|known| known.job.job_id.cmp(&job)).is_err() {
                export.taken_requests.push((text(request), job));
            }
        }
        for (incarnation, bytes) in &self.workers {
            export.marks.push((text(incarnation), decode("workers", bytes)?));
        }
        export.quotas = quotas(&self.quotas)?;
        export.tokens = decoded("tokens", &self.tokens)?;
        export.datasets = decoded("datasets", &self.datasets)?;
        export.last_fence = self.last_fence.map(|bytes| decode("meta", &bytes)).transpose()?.unwrap_or(0);
        export.deployment = self.deployment.map(|bytes| decode("meta", &bytes)).transpose()?;
        Ok(export)
    }
}

fn text(key: &IVec) -> String {
    String::from_utf8_lossy(key).into_owned()
}

fn decoded<T: serde::de::DeserializeOwned>(tree: &'static str, rows: &Rows) -> Result<Vec<T>, StoreError> {
    rows.iter().map(|(_, bytes)| decode(tree, bytes)).collect()
}

/// The quotas of tenants, from the rows of their tree.
pub(super) fn quotas(rows: &Rows) -> Result<Vec<(Tenant, Quota)>, StoreError> {
    let quotas = rows.iter().map(|(tenant, bytes)| {
        let corrupt = |message: String| StoreError::Corrupt { tree: "quotas", message };
        let tenant = text(tenant).parse::<Tenant>().map_err(|error| corrupt(error.to_string()))?;
        Ok((tenant, decode("quotas", bytes)?))
    });
    quotas.collect()
}
