//! Leases: silence, repetition, budgets, and reports of their holders.

use super::*;

pub async fn a_silent_worker_loses_its_lease_and_late_messages_fail(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 1).await;
    let zombie = claim(store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    store.checkpoint(&zombie, blob("checkpoint"), 40, T0 + 30).await.unwrap();
    assert!(store.sweep(T0 + 500).await.unwrap().is_empty(), "swept before its time");
    assert_eq!(store.renew(&zombie, None, T0 + 500).await.unwrap(), Renewed::Runs);
    assert!(store.sweep(T0 + 1400).await.unwrap().is_empty(), "the renewal did not count");
    assert_eq!(store.sweep(T0 + 1500).await.unwrap(), [(zombie.clone(), Expired::Silent)]);
    assert_eq!(store.renew(&zombie, None, T0 + 1500).await.unwrap(), Renewed::Over);
    assert!(
        claim(store, &Stage::of_workers(), T0 + 1500).await.is_none(),
        "claimed before its back-off is over"
    );

    let successor = claim(store, &Stage::of_workers(), T0 + 1700).await.unwrap();
    assert_eq!((successor.lease.attempt, successor.task.resumed_from), (2, 40));
    assert_eq!(successor.task.checkpoint.as_ref().unwrap().blob, blob("checkpoint"));
    assert!(successor.lease.fence > zombie.fence);
    assert!(is_stale(store.checkpoint(&zombie, blob("late"), 90, T0 + 1800).await));
    assert!(is_stale(store.complete(&zombie, result_as(zombie.task.stage, "late"), T0 + 1800).await));
    assert!(is_stale(store.fail(&zombie, FailClass::Training, "late".into(), T0 + 1800).await));
    assert!(is_stale(store.release(&zombie, "late".into(), T0 + 1800).await));
    assert_eq!(
        store.renew(&successor.lease, None, T0 + 1800).await.unwrap(),
        Renewed::Runs,
        "a zombie ended its successor's lease"
    );
    store
        .complete(&successor.lease, result_as(successor.lease.task.stage, "right"), T0 + 1900)
        .await
        .unwrap();
    let view = store.job(&id).await.unwrap();
    let (task, _) = view.tasks.iter().find(|(task, _)| task.task == Stage::Partition.task_of(0)).unwrap();
    assert!(matches!(&task.state, TaskState::Done { result, .. } if *result == blob("right")));
    assert_eq!((task.attempts, task.losses, task.errors), (2, 1, 0));
}

pub async fn every_message_may_arrive_twice(store: Arc<dyn Store>) {
    let store = store.as_ref();
    planned_job(store, 1, 1).await;
    let same = claim_as("worker", "one request", &Stage::of_workers());
    let first = store.claim(&same, T0 + 20).await.unwrap().unwrap().lease;
    assert_eq!(store.claim(&same, T0 + 30).await.unwrap().unwrap().lease, first, "a second lease");
    let other = claim_as("another process", "one request", &Stage::of_workers());
    assert!(store.claim(&other, T0 + 30).await.unwrap().is_none(), "another process took the lease over");

    store.checkpoint(&first, blob("checkpoint"), 40, T0 + 30).await.unwrap();
    assert_eq!(store.checkpoint(&first, blob("checkpoint"), 40, T0 + 31).await.unwrap(), Outcome::Already);
    let message = || "out of memory".to_owned();
    store.fail(&first, FailClass::OutOfMemory, message(), T0 + 40).await.unwrap();
    assert_eq!(
        store.fail(&first, FailClass::OutOfMemory, message(), T0 + 41).await.unwrap(),
        Outcome::Already
    );

    let second = claim(store, &Stage::of_workers(), T0 + 1000).await.unwrap().lease;
    assert_eq!(second.attempt, 2);
    store.release(&second, "leaves".into(), T0 + 1001).await.unwrap();
    assert_eq!(store.release(&second, "leaves".into(), T0 + 1002).await.unwrap(), Outcome::Already);
    assert!(is_stale(store.fail(&first, FailClass::Training, message(), T0 + 1003).await));

    let third =
        claim(store, &Stage::of_workers(), T0 + 1010).await.expect("released without a back-off").lease;
    store.complete(&third, result_as(third.task.stage, "right"), T0 + 1020).await.unwrap();
    assert_eq!(
        store.complete(&third, result_as(third.task.stage, "right"), T0 + 1021).await.unwrap(),
        Outcome::Already
    );
    let other = store.complete(&third, result_as(third.task.stage, "wrong"), T0 + 1022).await;
    assert!(matches!(other, Err(StoreError::Refused(Refusal::OtherResult(_)))));
}

pub async fn budgets_end_a_poisoned_job(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 3).await;
    let mut now = T0 + 100;
    let global = claim(store, &Stage::of_workers(), now).await.unwrap().lease;
    store.complete(&global, result_as(global.task.stage, "global"), now).await.unwrap();
    let bystander = claim(store, &Stage::of_workers(), now).await.unwrap().lease;
    for attempt in 1..=3 {
        now += 100_000;
        store.renew(&bystander, None, now).await.unwrap();
        let lease = claim(store, &Stage::of_workers(), now).await.unwrap().lease;
        assert_eq!((lease.task, lease.attempt), (Stage::Partition.task_of(1), attempt));
        store.fail(&lease, FailClass::Training, format!("fault {attempt}"), now).await.unwrap();
    }
    let view = store.job(&id).await.unwrap();
    assert_eq!(view.job.state, JobState::Failed);
    assert!(
        view.job.error.contains("partition-0001") && view.job.error.contains("fault 3"),
        "{}",
        view.job.error
    );
    let ended = store.complete(&bystander, result_as(bystander.task.stage, "late"), now).await;
    assert!(matches!(ended, Err(StoreError::Refused(Refusal::JobEnded))), "{ended:?}");
    assert_eq!(store.renew(&bystander, None, now).await.unwrap(), Renewed::Over);
    assert!(claim(store, &Stage::of_workers(), now + 100_000).await.is_none());

    let id = planned_job(store, 2, 1).await;
    for attempt in 1..=5 {
        now += 100_000;
        let lease = claim(store, &Stage::of_workers(), now).await.unwrap().lease;
        assert_eq!(lease.attempt, attempt);
        assert_eq!(store.sweep(now + LEASE_MS).await.unwrap(), [(lease, Expired::Silent)]);
    }
    assert_eq!(store.job(&id).await.unwrap().job.state, JobState::Failed);

    let id = planned_job(store, 3, 1).await;
    let lease = claim(store, &Stage::of_workers(), now + 200_000).await.unwrap().lease;
    store.fail(&lease, FailClass::Input, "a.jpg is torn".into(), now + 200_000).await.unwrap();
    assert_eq!(store.job(&id).await.unwrap().job.state, JobState::Failed, "bad input was retried");
}
