//! A second worker starts a second attempt at a slow task.

use super::*;
use crate::schedule::FailClass;

/// Minimum age of a slow attempt: the default of `Rules`.
const PATIENCE_MS: u64 = 600_000;

/// A job of four partitions of which three are done, each after ten seconds, and the fourth is held by the
/// worker "slow".
async fn with_a_straggler(store: &dyn Store) -> (JobId, Lease) {
    let id = planned_job(store, 1, 4).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    let slow = store.claim(&claim_as("slow", "first", &[Stage::Partition]), T0 + 30).await.unwrap().unwrap();
    for index in 1..4 {
        let grant = claim(store, &[Stage::Partition], T0 + 30).await.unwrap();
        assert_eq!(grant.lease.task, Stage::Partition.task_of(index));
        store
            .complete(&grant.lease, result_as(grant.lease.task.stage, &index.to_string()), T0 + 10_030)
            .await
            .unwrap();
    }
    (id, slow.lease)
}

async fn second(store: &dyn Store, name: &str, now_ms: u64) -> Option<Grant> {
    store.claim(&claim_as(name, &format!("call of {name}"), &[Stage::Partition]), now_ms).await.unwrap()
}

async fn task(store: &dyn Store, id: &JobId) -> TaskRecord {
    store.task_row(id, Stage::Partition.task_of(0)).await.unwrap()
}

/// Attempts, errors and losses.
fn counts(task: &TaskRecord) -> (u32, u32, u32) {
    (task.attempts, task.errors, task.losses)
}

pub async fn a_slow_task_gets_a_second_worker_and_the_first_result_counts(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let (id, slow) = with_a_straggler(store).await;
    let reached =
        |lease: &Lease, iteration| (lease.clone(), blob(&format!("{lease:?} {iteration}")), iteration);
    let (lease, at_40, iteration) = reached(&slow, 40);
    store.checkpoint(&lease, at_40.clone(), iteration, T0 + 40_000).await.unwrap();

    let late = T0 + 30 + PATIENCE_MS;
    assert!(second(store, "early", late - 1).await.is_none(), "a task was taken twice before its time");
    let own = store.claim(&claim_as("slow", "another call", &[Stage::Partition]), late).await.unwrap();
    assert!(own.is_none(), "a worker got a second attempt beside its own");
    let fast = second(store, "fast", late).await.expect("the straggler");
    assert_eq!((fast.lease.task, fast.lease.attempt), (Stage::Partition.task_of(0), 2));
    assert!(fast.lease.fence > slow.fence);
    assert_eq!(fast.task.checkpoint.as_ref().map(|kept| &kept.blob), Some(&at_40));
    // The answer to either call may be lost: it gets its own lease again. A third worker gets none.
    assert_eq!(second(store, "fast", late).await.map(|grant| grant.lease), Some(fast.lease.clone()));
    let again = store.claim(&claim_as("slow", "first", &[Stage::Partition]), late).await.unwrap();
    assert_eq!(again.map(|grant| grant.lease), Some(slow.clone()));
    assert!(second(store, "third", late).await.is_none());
    assert_eq!(store.job_row(&id).await.unwrap().leased_tasks, 2);
    assert_eq!(store.leased().await.unwrap().len(), 2);
    assert_eq!(store.levels().await.unwrap().leased, [(Stage::Partition, 2)].into());

    // Both are alive, and the one ahead determines the progress.
    let at = |iteration| Some(LiveProgress { iteration, ..LiveProgress::default() });
    for (lease, iteration) in [(&slow, 60), (&fast.lease, 90)] {
        assert_eq!(store.renew(lease, at(iteration), late + 500).await.unwrap(), Renewed::Runs);
    }
    let (live, _) = store.progress(&id).await.unwrap();
    assert_eq!(
        live.iter().map(|(task, p)| (*task, p.iteration)).collect::<Vec<_>>(),
        [(Stage::Partition.task_of(0), 90)]
    );
    // A checkpoint of the slower one does not set the task back.
    for (lease, iteration) in [(&fast.lease, 80), (&slow, 50)] {
        let (lease, blob, iteration) = reached(lease, iteration);
        store.checkpoint(&lease, blob, iteration, late + 600).await.unwrap();
    }
    assert_eq!(task(store, &id).await.checkpoint.map(|kept| kept.iteration), Some(80));

    store.complete(&fast.lease, result_as(fast.lease.task.stage, "fast"), late + 700).await.unwrap();
    assert_eq!(store.renew(&slow, at(70), late + 800).await.unwrap(), Renewed::Over);
    let refused = store.complete(&slow, result_as(slow.task.stage, "slow"), late + 900).await.unwrap_err();
    assert!(matches!(refused, StoreError::Refused(Refusal::StaleFence { .. })), "{refused}");
    // The reply to the winner may have been lost.
    store.complete(&fast.lease, result_as(fast.lease.task.stage, "fast"), late + 950).await.unwrap();
    let done = task(store, &id).await;
    assert_eq!((done.worker.as_str(), counts(&done)), ("fast", (2, 0, 0)));
    assert_eq!((done.running().count(), store.leased().await.unwrap().len()), (0, 0));
    let TaskState::Done { result, .. } = &done.state else { panic!("{:?}", done.state) };
    assert_eq!(*result, blob("fast"));
    assert_eq!(store.job_row(&id).await.unwrap().leased_tasks, 0);
    assert!(claim(store, &[Stage::Merge], late + 1000).await.is_some(), "the job continues");
}

pub async fn one_of_two_attempts_may_fail_and_nothing_is_counted(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let (id, slow) = with_a_straggler(store).await;
    let late = T0 + 30 + PATIENCE_MS;
    let fast = second(store, "fast", late).await.expect("the straggler").lease;
    // The first one stops renewing: the second continues alone, under its own fence.
    store.renew(&fast, None, late + LEASE_MS / 2).await.unwrap();
    let over = store.sweep(late + LEASE_MS).await.unwrap();
    assert_eq!(over, [(slow.clone(), Expired::Silent)]);
    let alone = task(store, &id).await;
    assert_eq!((alone.worker.as_str(), counts(&alone)), ("fast", (2, 0, 0)));
    assert!(alone.is_held_by(&fast) && !alone.is_held_by(&slow), "{alone:?}");
    assert_eq!(store.job_row(&id).await.unwrap().leased_tasks, 1);
    // There is no third one beside it, however slow it is.
    store.renew(&fast, None, late + PATIENCE_MS * 2).await.unwrap();
    assert!(second(store, "third", late + PATIENCE_MS * 2).await.is_none());
    // Now it is an attempt like any other.
    store.fail(&fast, FailClass::Training, "a fault".into(), late + PATIENCE_MS * 2).await.unwrap();
    let waits = task(store, &id).await;
    assert_eq!(counts(&waits), (2, 1, 0));
    assert!(matches!(waits.state, TaskState::Ready { .. }), "{:?}", waits.state);
    let events = store.events(&id, 0, 1000).await.unwrap();
    let warned = |event: &StoredEvent| matches!(&event.body, EventBody::Warning { message } if message.contains("the one on fast continues"));
    assert_eq!(events.iter().filter(|event| warned(event)).count(), 1, "{events:?}");
}

pub async fn a_second_worker_that_fails_leaves_the_task_to_the_first(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let (id, slow) = with_a_straggler(store).await;
    let late = T0 + 30 + PATIENCE_MS;
    let fast = second(store, "fast", late).await.expect("the straggler").lease;
    store.renew(&slow, None, late).await.unwrap();
    store.fail(&fast, FailClass::Training, "a fault".into(), late + 1).await.unwrap();
    // The answer may have been lost.
    store.fail(&fast, FailClass::Training, "a fault".into(), late + 2).await.unwrap();
    let alone = task(store, &id).await;
    assert_eq!((alone.worker.as_str(), counts(&alone)), ("slow", (2, 0, 0)));
    assert!(alone.last_errors[0].contains("attempt 2 on fast: a fault"), "{:?}", alone.last_errors);
    assert_eq!(store.renew(&slow, None, late + 10).await.unwrap(), Renewed::Runs);
    store.complete(&slow, result_as(slow.task.stage, "slow"), late + 20).await.unwrap();
    assert_eq!(task(store, &id).await.worker, "slow");
}

pub async fn a_paused_or_ended_job_ends_both_workers_at_a_task(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let (id, slow) = with_a_straggler(store).await;
    let late = T0 + 30 + PATIENCE_MS;
    let fast = second(store, "fast", late).await.expect("the straggler").lease;
    store.renew(&slow, None, late).await.unwrap();
    store.steer(&id, Event::Pause { reason: String::new() }, late).await.unwrap();
    for lease in [&slow, &fast] {
        assert_eq!(store.renew(lease, None, late + 1).await.unwrap(), Renewed::ToBeReleased);
    }
    store.release(&slow, "paused".into(), late + 2).await.unwrap();
    assert!(task(store, &id).await.is_held_by(&fast));
    store.steer(&id, Event::Resume, late + 3).await.unwrap();
    cancel(store, &id, "enough", late + 4).await.unwrap();
    assert_eq!(store.renew(&fast, None, late + 5).await.unwrap(), Renewed::Over);
    assert!(store.leased().await.unwrap().is_empty());
    assert_eq!(task(store, &id).await.running().count(), 0);
}
