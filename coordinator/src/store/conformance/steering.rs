//! Control of jobs by users: cancel, pause, retry, delete, prioritise, list.

use super::*;
use crate::schedule::Requirements;

pub async fn a_paused_job_assigns_nothing_and_accepts_results(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 3).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    let first = claim(store, &Stage::of_workers(), T0 + 30).await.unwrap().lease;
    let second = claim(store, &Stage::of_workers(), T0 + 31).await.unwrap().lease;
    let pause = |reason: &str| Event::Pause { reason: reason.to_owned() };
    let view = store.steer(&id, pause("the machines are wanted"), T0 + 40).await.unwrap();
    assert_eq!((view.job.state, view.job.leased_tasks), (JobState::Paused, 2));
    let again = store.steer(&id, pause("again"), T0 + 41).await.unwrap();
    assert_eq!(again.job.last_seq, view.job.last_seq, "a repeated pause has two events");
    assert!(claim(store, &Stage::of_workers(), T0 + 42).await.is_none());

    // A new process knows it too.
    store.recover(T0 + 43).await.unwrap();
    for lease in [&first, &second] {
        assert_eq!(store.renew(lease, None, T0 + 50).await.unwrap(), Renewed::ToBeReleased);
    }
    store.checkpoint(&first, blob("checkpoint"), 40, T0 + 51).await.unwrap();
    store.release(&first, "paused".into(), T0 + 52).await.unwrap();
    store.complete(&second, result_as(second.task.stage, "partition-0001"), T0 + 53).await.unwrap();
    let view = store.job(&id).await.unwrap();
    assert_eq!((view.job.open_tasks, view.job.leased_tasks), (2, 0));
    // Not the second reason: the job was already paused.
    assert_eq!(view.job.pause_reason, "the machines are wanted");
    assert!(view.progress() > view.job.progress(0), "the checkpoint at 40 does not count");
    assert!(claim(store, &Stage::of_workers(), T0 + 5000).await.is_none());

    store.steer(&id, Event::Resume, T0 + 6000).await.unwrap();
    assert_eq!(store.job_row(&id).await.unwrap().pause_reason, "");
    let successor = claim(store, &Stage::of_workers(), T0 + 6001).await.unwrap();
    assert_eq!((successor.lease.task, successor.task.resumed_from), (Stage::Partition.task_of(0), 40));
    assert_eq!((successor.task.errors, successor.task.losses), (0, 0));
    assert_eq!(store.renew(&successor.lease, None, T0 + 6002).await.unwrap(), Renewed::Runs);
    cancel(store, &id, "enough", T0 + 6003).await.unwrap();
    for event in [pause("late"), Event::Resume, Event::Update { priority: Some(1), max_parallel: None }] {
        let refused = store.steer(&id, event, T0 + 6004).await;
        assert!(matches!(refused, Err(StoreError::Refused(Refusal::JobEnded))), "{refused:?}");
    }
}

pub async fn open_work_has_the_waiting_and_leased_tasks_of_running_jobs(store: Arc<dyn Store>) {
    let store = store.as_ref();
    // Tenant, limit, waiting tasks, leased tasks.
    type Found = (String, u32, Vec<(TaskId, u64)>, Vec<TaskId>);
    let work = async || -> Vec<Found> {
        let tasks = |needs: &[Requirements]| needs.iter().map(|need| need.task).collect();
        let of_job = |job: OpenWork| {
            let waiting =
                job.waiting.iter().map(|(need, not_before_ms)| (need.task, *not_before_ms)).collect();
            (job.tenant.to_string(), job.max_parallel, waiting, tasks(&job.leased))
        };
        store.open_work().await.unwrap().into_iter().map(of_job).collect()
    };
    assert_eq!(work().await, []);
    let id = planned_job(store, 1, 2).await;
    let tenant = Tenant::default().to_string();
    do_next(store, Stage::Global.task(), T0 + 20).await;
    let [first, second] = [0, 1].map(|number| Stage::Partition.task_of(number));
    let lease = claim(store, &Stage::of_workers(), T0 + 30).await.unwrap().lease;
    assert_eq!(work().await, [(tenant.clone(), 0, vec![(second, T0 + 20)], vec![first])]);

    // After an error it waits again, at first in back-off.
    store.fail(&lease, FailClass::Training, "a fault".into(), T0 + 40).await.unwrap();
    let limit = Event::Update { priority: None, max_parallel: Some(7) };
    store.steer(&id, limit, T0 + 41).await.unwrap();
    let ready = store.ready().await.unwrap();
    let again_ms = ready.iter().find(|ready| ready.need.task == first).map_or(0, |ready| ready.not_before_ms);
    assert!(again_ms >= T0 + 40 + rules().backoff_ms, "{again_ms}");
    let waiting = vec![(first, again_ms), (second, T0 + 20)];
    assert_eq!(work().await, [(tenant, 7, waiting, vec![])]);
    store.steer(&id, Event::Pause { reason: String::new() }, T0 + 42).await.unwrap();
    assert_eq!(work().await, [], "a paused job needs no worker");
}

pub async fn the_duration_of_a_stage_excludes_pauses(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let steer = async |id: &JobId, event, now_ms| store.steer(id, event, now_ms).await.unwrap().job;
    let pause = || Event::Pause { reason: String::new() };
    let id = planned_job(store, 1, 1).await;
    // Paused and resumed within a stage; then one stage ends and the next begins while it is paused.
    let lease = claim(store, &Stage::of_workers(), T0 + 100).await.unwrap().lease;
    steer(&id, pause(), T0 + 1010).await;
    steer(&id, Event::Resume, T0 + 51_010).await;
    steer(&id, pause(), T0 + 52_010).await;
    store.complete(&lease, result_as(lease.task.stage, "partition-0000"), T0 + 90_000).await.unwrap();
    let job = steer(&id, Event::Resume, T0 + 100_000).await;
    assert_eq!(job.stage_seconds[&Stage::Partition], 1.0 + 1.0);
    let merge = claim(store, &[Stage::Merge], T0 + 100_500).await.unwrap().lease;
    let merged = merged();
    store.complete(&merge, merged, T0 + 103_000).await.unwrap();
    assert_eq!(store.job_row(&id).await.unwrap().stage_seconds[&Stage::Merge], 3.0);
}

pub async fn a_retried_job_resumes_where_it_failed(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 2).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    do_next(store, Stage::Partition.task_of(0), T0 + 30).await;
    let lease = claim(store, &Stage::of_workers(), T0 + 40).await.unwrap().lease;
    store.checkpoint(&lease, blob("checkpoint"), 70, T0 + 41).await.unwrap();
    store.fail(&lease, FailClass::Input, "a photograph is torn".into(), T0 + 42).await.unwrap();
    let failed = store.job(&id).await.unwrap();
    assert_eq!((failed.job.state, failed.job.leased_tasks), (JobState::Failed, 0));

    let view = store.steer(&id, Event::Retry, T0 + 50).await.unwrap();
    assert_eq!(
        (view.job.state, view.job.stage, view.job.open_tasks),
        (JobState::Running, Stage::Partition, 1)
    );
    assert_eq!((view.job.error.as_str(), view.job.ended_ms), ("", None));
    let again = store.steer(&id, Event::Retry, T0 + 51).await.unwrap();
    assert_eq!(again.job.last_seq, view.job.last_seq);
    assert!(
        is_refused(&store.complete(&lease, result_as(lease.task.stage, "late"), T0 + 52).await),
        "the failed attempt came back"
    );
    let successor = claim(store, &every_stage(), T0 + 53).await.unwrap();
    assert_eq!((successor.lease.task, successor.task.resumed_from), (Stage::Partition.task_of(1), 70));
    assert_eq!((successor.task.errors, successor.lease.attempt), (0, 2));
    store
        .complete(&successor.lease, result_as(successor.lease.task.stage, "partition-0001"), T0 + 54)
        .await
        .unwrap();
    let merge = claim(store, &Stage::own(), T0 + 55).await.unwrap();
    assert_eq!(merge.lease.task, Stage::Merge.task());
    let refused = store.delete(&id).await;
    assert!(matches!(refused, Err(StoreError::Refused(Refusal::NotEnded))), "{refused:?}");
    cancel(store, &id, "enough", T0 + 60).await.unwrap();
    let refused = store.steer(&id, Event::Retry, T0 + 61).await;
    assert!(matches!(refused, Err(StoreError::Refused(Refusal::NotFailed(_)))), "{refused:?}");
}

pub async fn a_deleted_job_is_gone_and_its_request_makes_no_other(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 2).await;
    let other = planned_job(store, 2, 1).await;
    cancel(store, &id, "enough", T0 + 20).await.unwrap();
    store.delete(&id).await.unwrap();
    assert!(matches!(store.job(&id).await, Err(StoreError::JobNotFound(_))));
    assert!(matches!(store.delete(&id).await, Err(StoreError::JobNotFound(_))));
    assert!(store.events(&id, 0, 100).await.map_or(true, |events| events.is_empty()));
    let listed = store.list(&JobFilter::default(), None, 100).await.unwrap();
    assert_eq!(listed.iter().map(|job| &job.job_id).collect::<Vec<_>>(), [&other]);
    let late = store.submit(new_job(1), T0 + 30).await;
    assert!(matches!(late, Err(StoreError::RequestIdReused { .. })), "{late:?}");
    assert_eq!(claim(store, &Stage::of_workers(), T0 + 40).await.unwrap().lease.job, other);
}

pub async fn the_job_with_higher_priority_goes_first_within_limits(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let [older, newer] = [planned_job(store, 1, 1).await, planned_job(store, 2, 3).await];
    let update = |priority, max_parallel| Event::Update { priority, max_parallel };
    let view = store.steer(&newer, update(Some(5), Some(2)), T0 + 20).await.unwrap();
    assert_eq!((view.job.priority, view.job.max_parallel), (5, 2));
    let again = store.steer(&newer, update(Some(5), None), T0 + 21).await.unwrap();
    assert_eq!(again.job.last_seq, view.job.last_seq, "a change without effect has an event");
    do_next(store, Stage::Global.task(), T0 + 22).await;
    let order = [&newer, &newer, &older];
    let mut leases = Vec::new();
    for (index, expected) in order.into_iter().enumerate() {
        let lease = claim(store, &Stage::of_workers(), T0 + 30 + index as u64).await.unwrap().lease;
        assert_eq!(&lease.job, expected, "claim {index}");
        leases.push(lease);
    }
    assert!(
        claim(store, &Stage::of_workers(), T0 + 40).await.is_none(),
        "more workers than the job may have"
    );
    store.release(&leases[0], "leaves".into(), T0 + 41).await.unwrap();
    assert_eq!(claim(store, &Stage::of_workers(), T0 + 42).await.unwrap().lease.task, leases[0].task);
    store.steer(&newer, update(None, Some(0)), T0 + 43).await.unwrap();
    assert_eq!(
        claim(store, &Stage::of_workers(), T0 + 44).await.unwrap().lease.task,
        Stage::Partition.task_of(2)
    );
}

pub async fn a_list_has_all_jobs_of_its_filter_page_by_page(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let mut ids = Vec::new();
    for number in 0..25 {
        ids.push(store.submit(new_job(number), T0).await.unwrap().job_id);
    }
    for id in ids.iter().step_by(2) {
        cancel(store, id, "", T0 + 10).await.unwrap();
    }
    let filter = JobFilter {
        states: vec![JobState::Cancelled],
        name_contains: "job 1".into(),
        ..JobFilter::default()
    };
    let mut found = Vec::new();
    loop {
        let page = store.list(&filter, found.last(), 2).await.unwrap();
        assert!(page.len() <= 2);
        if page.is_empty() {
            break;
        }
        found.extend(page.into_iter().map(|job| job.job_id));
    }
    let wanted: Vec<JobId> =
        [18, 16, 14, 12, 10].into_iter().map(|number: usize| ids[number].clone()).collect();
    assert_eq!(found, wanted);
}

pub async fn the_end_of_a_job_is_announced_by_one_coordinator_once(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = store.submit(NewJob { announce: true, ..new_job(1) }, T0).await.unwrap().job_id;
    let silent = store.submit(new_job(2), T0).await.unwrap().job_id;
    let apply = async |id: &JobId, event| store.apply(id, event, T0 + 30).await.unwrap();
    let announce = |ended_ms, known_ms, until_ms| Event::Announce { ended_ms, known_ms, until_ms };
    let row = async |id: &JobId| store.job_row(id).await.unwrap().announcement;
    assert!(matches!(apply(&id, announce(T0, 0, T0)).await, Outcome::Already), "it has not ended");
    let lease = claim(store, &[Stage::Plan], T0 + 5).await.unwrap().lease;
    store.fail(&lease, FailClass::Input, "no points".into(), T0 + 20).await.unwrap();
    cancel(store, &silent, "enough", T0 + 20).await.unwrap();
    assert!(matches!(apply(&silent, announce(T0 + 20, 0, T0)).await, Outcome::Already), "nobody wants it");

    assert!(matches!(apply(&id, announce(T0 + 20, 0, T0 + 90)).await, Outcome::Changed(_)));
    assert!(matches!(apply(&id, announce(T0 + 20, 0, T0 + 99)).await, Outcome::Already), "two are at it");
    assert_eq!(row(&id).await, Announcement::Due { not_before_ms: T0 + 90 });
    // It was retried before the webhook took it, and ended again: the first end is of no interest.
    store.steer(&id, Event::Retry, T0 + 31).await.unwrap();
    cancel(store, &id, "enough", T0 + 40).await.unwrap();
    assert!(matches!(apply(&id, Event::Announced { ended_ms: T0 + 20 }).await, Outcome::Already));
    assert!(matches!(apply(&id, Event::Announced { ended_ms: T0 + 40 }).await, Outcome::Changed(_)));
    assert!(matches!(apply(&id, Event::Announced { ended_ms: T0 + 40 }).await, Outcome::Already));
    assert_eq!(row(&id).await, Announcement::Made);
    assert_eq!(verify::faults(&store.export().await.unwrap()), Vec::<String>::new());
}
