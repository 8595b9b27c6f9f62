//! Verifies the invariants of jobs, tasks and events in a store.

use std::collections::{BTreeMap, BTreeSet};

use super::export::{Export, JobExport};
use super::request_key;
use crate::datasets::DatasetRecord;
use crate::schedule::{JobId, TaskId, TaskState};

/// A sentence for each fault; empty if there is none.
pub fn faults(export: &Export) -> Vec<String> {
    let mut faults = Vec::new();
    let mut requests = BTreeMap::<String, &JobId>::new();
    let mut fences = BTreeMap::<u64, (&JobId, TaskId)>::new();
    for job in &export.jobs {
        let id = &job.job.job_id;
        faults.extend(faults_of_job(job).into_iter().map(|fault| format!("job {id}: {fault}")));
        let request = request_key(&job.job.tenant, &job.job.request_id);
        if let Some(other) = requests.insert(request, id) {
            faults.push(format!("jobs {other} and {id} came from one request, {}", job.job.request_id));
        }
        for record in job.tasks.iter().filter(|record| record.fence > 0) {
            if let Some((other, task)) = fences.insert(record.fence, (id, record.task)) {
                faults.push(format!(
                    "fence {} was granted twice: for {task} of {other} and {} of {id}",
                    record.fence, record.task
                ));
            }
        }
    }
    if let Some((fence, (id, task))) =
        fences.last_key_value().filter(|(fence, _)| **fence > export.last_fence)
    {
        let last = export.last_fence;
        faults.push(format!(
            "{task} of job {id} has fence {fence}, later than the last one, {last}: it would be granted again"
        ));
    }
    let mut datasets = BTreeMap::new();
    for dataset in &export.datasets {
        let DatasetRecord { id, tenant, .. } = dataset;
        if datasets.insert((tenant, id), dataset).is_some() {
            faults.push(format!("dataset {id} of {tenant} exists twice"));
        }
        if dataset.files == 0 {
            faults.push(format!("dataset {id} of {tenant} has no files"));
        }
    }
    for JobExport { job, .. } in &export.jobs {
        let Some(id) = &job.dataset else { continue };
        match datasets.get(&(&job.tenant, id)) {
            Some(dataset) if dataset.is_committed() => {}
            Some(_) => faults.push(format!("job {}: its dataset {id} is not committed", job.job_id)),
            None => faults.push(format!("job {}: its dataset {id} does not exist", job.job_id)),
        }
    }
    for (request_id, job) in &export.taken_requests {
        if let Some(other) = requests.get(request_id) {
            faults.push(format!("request {request_id} made job {other} and the deleted job {job}"));
        }
    }
    faults
}

fn faults_of_job(JobExport { job, tasks, events }: &JobExport) -> Vec<String> {
    let mut faults = Vec::new();
    let known: BTreeSet<TaskId> = tasks.iter().map(|record| record.task).collect();
    // A number of tasks is only trusted if there are as many: four thousand million do not fit into memory.
    for (count, what) in [(job.shape.partitions, "partitions"), (job.shape.evaluations, "evaluations")] {
        if count as usize > tasks.len() {
            return vec![format!("it should have {count} {what}, and has {} tasks", tasks.len())];
        }
    }
    let wanted: BTreeSet<TaskId> = job.shape.tasks().into_iter().collect();
    for task in wanted.difference(&known) {
        faults.push(format!("{task} is missing"));
    }
    for task in known.difference(&wanted) {
        faults.push(format!("{task} does not belong to it"));
    }
    let seqs: Vec<u64> = events.iter().map(|event| event.seq).collect();
    if !seqs.iter().copied().eq(1..=job.last_seq) {
        faults.push(format!(
            "it should have the events 1 to {}, and has {} of them",
            job.last_seq,
            seqs.len()
        ));
    }
    let leased: usize = tasks.iter().map(|record| record.running().count()).sum();
    let ready = tasks.iter().filter(|record| matches!(record.state, TaskState::Ready { .. })).count();
    for record in tasks {
        if record.second.is_some() && !matches!(record.state, TaskState::Leased(_)) {
            faults.push(format!("{} has a second worker and no first one", record.task));
        }
    }
    if !job.state.is_open() && leased + ready > 0 {
        faults.push(format!("it has ended, and {} of its tasks have not", leased + ready));
    }
    if job.state.is_open() {
        if job.leased_tasks as usize != leased {
            faults.push(format!("{leased} leases run, {} are counted", job.leased_tasks));
        }
        let of_stage = job.shape.tasks_of(job.stage);
        let is_open = |task: &&TaskId| {
            let record = tasks.iter().find(|record| record.task == **task);
            record.is_some_and(|record| !matches!(record.state, TaskState::Done { .. }))
        };
        let open = of_stage.iter().filter(is_open).count();
        if job.open_tasks as usize != open {
            faults.push(format!("{open} tasks of its stage are open, {} are counted", job.open_tasks));
        }
    }
    faults
}

#[cfg(test)]
mod tests {
    use fathom_core::scene::BlobRef;

    use super::*;
    use crate::datasets::{DatasetId, NewDataset};
    use crate::schedule::{JobShape, JobState, Stage, TaskRecord, Tenant};
    use crate::store::{NewJob, StoredEvent};

    fn dataset() -> DatasetId {
        DatasetId::try_from("a".to_owned()).unwrap()
    }

    fn sound() -> Export {
        let job = |number: u32| {
            let dataset = (number == 0).then(dataset);
            let new = NewJob { dataset, ..NewJob::sample(number) };
            let body = new.first_event();
            let (job, mut plan) = new.into_rows(7);
            plan.fence = u64::from(number) + 1;
            JobExport { job, tasks: vec![plan], events: vec![StoredEvent { seq: 1, time_ms: 7, body }] }
        };
        let dataset = NewDataset {
            id: dataset(),
            tenant: Tenant::default(),
            request_id: "one".into(),
            root: BlobRef { digest: "1".repeat(64), bytes: 80 },
            files: 1,
            bytes: 7,
        };
        let dataset = DatasetRecord { committed_ms: Some(9), ..dataset.into_row(7) };
        Export { jobs: vec![job(0), job(1)], datasets: vec![dataset], last_fence: 2, ..Export::default() }
    }

    #[test]
    fn a_sound_store_has_no_faults_and_each_fault_is_named() {
        assert_eq!(faults(&sound()), Vec::<String>::new());
        type Break = fn(&mut Export);
        let broken: [(&str, Break); 17] = [
            ("4294967295 partitions, and has 1 tasks", |export| {
                export.jobs[0].job.shape = JobShape {
                    partitions: u32::MAX,
                    stages: [Stage::Partition].into(),
                    ..JobShape::default()
                }
            }),
            ("4294967295 evaluations, and has 1 tasks", |export| {
                export.jobs[0].job.shape.evaluations = u32::MAX
            }),
            ("came from one request", |export| export.jobs[1].job.request_id = "request 0".into()),
            ("was granted twice", |export| export.jobs[1].tasks[0].fence = 1),
            ("would be granted again", |export| export.last_fence = 1),
            ("the deleted job", |export| export.taken_requests.push(("request 1".into(), JobId::new(9, 9)))),
            ("plan is missing", |export| export.jobs[0].tasks.clear()),
            ("merge does not belong", |export| {
                export.jobs[0].tasks.push(TaskRecord::new(Stage::Merge.task(), None, 0))
            }),
            ("the events 1 to 2, and has 1", |export| export.jobs[0].job.last_seq = 2),
            ("the events 1 to 1, and has 1", |export| export.jobs[0].events[0].seq = 2),
            ("it has ended, and 1 of its tasks", |export| export.jobs[0].job.state = JobState::Failed),
            ("0 leases run, 1 are counted", |export| export.jobs[0].job.leased_tasks = 1),
            ("1 tasks of its stage are open, 0", |export| export.jobs[0].job.open_tasks = 0),
            ("its dataset a does not exist", |export| export.datasets.clear()),
            ("its dataset a is not committed", |export| export.datasets[0].committed_ms = None),
            ("dataset a of default exists twice", |export| export.datasets.push(export.datasets[0].clone())),
            ("dataset a of default has no files", |export| export.datasets[0].files = 0),
        ];
        for (expected, breaks) in broken {
            let mut export = sound();
            breaks(&mut export);
            let found = faults(&export);
            assert!(found.iter().any(|fault| fault.contains(expected)), "{expected:?}: {found:?}");
        }
    }
}
