//! All stages of a job, including optional ones.

use super::*;

pub async fn partitions_resume_their_first_part_after_one_exchange(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = job_of(store, 1, planned_as(2, true)).await;
    assert_eq!(store.job(&id).await.unwrap().job.iterations_total, 500);
    do_next(store, Stage::Global.task(), T0 + 20).await;

    // A worker is lost during the first parts, and the coordinator restarts.
    let lost = claim(store, &Stage::of_workers(), T0 + 30).await.unwrap();
    assert_eq!((lost.lease.task, lost.task.inputs.len()), (Stage::FirstPart.task_of(0), 0));
    store.checkpoint(&lost.lease, blob("checkpoint"), 40, T0 + 40).await.unwrap();
    do_next(store, Stage::FirstPart.task_of(1), T0 + 50).await;
    store.recover(T0 + 60).await.unwrap();
    assert_eq!(store.sweep(T0 + 60 + LEASE_MS).await.unwrap(), [(lost.lease.clone(), Expired::Silent)]);
    let view = store.job(&id).await.unwrap();
    assert_eq!((view.job.stage, view.job.open_tasks), (Stage::FirstPart, 1), "one first part is not enough");
    assert!(claim(store, &Stage::own(), T0 + 2000).await.is_none(), "a consensus of some partitions");
    let successor = do_next(store, Stage::FirstPart.task_of(0), T0 + 2000).await;
    assert_eq!((successor.task.resumed_from, successor.lease.attempt), (40, 2));
    assert!(is_stale(store.complete(&lost.lease, result_as(lost.lease.task.stage, "late"), T0 + 2010).await));
    let again =
        store.complete(&successor.lease, result_of(Stage::FirstPart.task_of(0)), T0 + 2010).await.unwrap();
    assert_eq!(again, Outcome::Already);

    // The coordinator crashes before it submits the consensus: the next process computes it again.
    assert!(
        claim(store, &Stage::of_workers(), T0 + 2020).await.is_none(),
        "a partition continued without it"
    );
    let dead = claim(store, &Stage::own(), T0 + 2020).await.unwrap().lease;
    // Its lease is over by then: where several coordinators run, the others' tasks go on.
    store.recover(T0 + 3030).await.unwrap();
    assert!(is_stale(store.complete(&dead, result_of(Stage::Exchange.task()), T0 + 3040).await));
    let found = do_next(store, Stage::Exchange.task(), T0 + 3050).await;
    assert_eq!((found.lease.attempt, found.task.losses), (2, 0));
    assert_eq!(store.job(&id).await.unwrap().job.output(Artifact::Exchange), Some(&blob("exchange")));
    let again = store.complete(&found.lease, result_of(Stage::Exchange.task()), T0 + 3060).await.unwrap();
    assert_eq!(again, Outcome::Already);

    // Every attempt at a second part resumes from the same result.
    let lost = claim(store, &Stage::of_workers(), T0 + 3070).await.unwrap();
    store.release(&lost.lease, "leaves".into(), T0 + 3080).await.unwrap();
    store.recover(T0 + 3090).await.unwrap();
    for index in 0..2 {
        let grant = do_next(store, Stage::Partition.task_of(index), T0 + 3100).await;
        assert_eq!(
            grant.task.inputs.get(&Artifact::FirstPart),
            Some(&blob(&format!("first_part-{index:04}")))
        );
        assert_eq!(grant.job.output(Artifact::Exchange), Some(&blob("exchange")));
    }
    let view = store.job(&id).await.unwrap();
    assert_eq!((view.job.stage, view.job.iterations_done), (Stage::Merge, 500));
    let tasks: Vec<String> = view.tasks.iter().map(|(task, _)| task.task.to_string()).collect();
    assert_eq!(
        tasks.join(" "),
        "plan global first_part-0000 first_part-0001 exchange partition-0000 partition-0001 merge evaluate artifacts"
    );
    let entered: Vec<Stage> = store
        .events(&id, 0, 1000)
        .await
        .unwrap()
        .into_iter()
        .filter_map(|event| if let EventBody::Stage { stage, .. } = event.body { Some(stage) } else { None })
        .collect();
    assert_eq!(entered, [Stage::Global, Stage::FirstPart, Stage::Exchange, Stage::Partition, Stage::Merge]);
}

pub async fn borders_are_trained_before_evaluation_and_change_the_model(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let borders = PlannedTask::new(blob("borders"), 30);
    let id = job_of(store, 1, planned_and(Stage::Borders.task(), borders)).await;
    assert_eq!(store.job(&id).await.unwrap().job.iterations_total, 330);
    for task in [Stage::Global.task(), Stage::Partition.task_of(0), Stage::Partition.task_of(1)] {
        do_next(store, task, T0 + 20).await;
    }
    let merge = claim(store, &Stage::own(), T0 + 30).await.unwrap().lease;
    assert_eq!(merge.task, Stage::Merge.task());
    assert!(claim(store, &Stage::of_workers(), T0 + 30).await.is_none(), "borders of no model");
    let (model, report) = (blob("merged"), blob("report"));
    let merged = TaskOutput::merged(model.clone(), report, TaskStats::default());
    store.complete(&merge, merged, T0 + 40).await.unwrap();

    // The worker is lost, and the coordinator restarts: the next attempt has the same model, and its
    // checkpoint.
    let lost = claim(store, &Stage::of_workers(), T0 + 50).await.unwrap();
    assert_eq!((lost.lease.task, lost.job.output(Artifact::Model)), (Stage::Borders.task(), Some(&model)));
    store.checkpoint(&lost.lease, blob("checkpoint"), 10, T0 + 60).await.unwrap();
    store.recover(T0 + 70).await.unwrap();
    assert_eq!(store.sweep(T0 + 70 + LEASE_MS).await.unwrap(), [(lost.lease.clone(), Expired::Silent)]);
    let successor = do_next(store, Stage::Borders.task(), T0 + 2000).await;
    assert_eq!((successor.task.resumed_from, successor.lease.attempt), (10, 2));
    assert_eq!(successor.job.output(Artifact::Model), Some(&model));
    assert!(is_stale(store.complete(&lost.lease, result_as(lost.lease.task.stage, "late"), T0 + 2010).await));
    let again = store.complete(&successor.lease, result_of(Stage::Borders.task()), T0 + 2010).await.unwrap();
    assert_eq!(again, Outcome::Already);

    let evaluate = do_next(store, Stage::Evaluate.task(), T0 + 2020).await;
    assert_eq!(
        evaluate.job.output(Artifact::Model),
        Some(&blob("borders")),
        "the model before it was measured"
    );
    let view = store.job(&id).await.unwrap();
    assert_eq!((view.job.stage, view.job.iterations_done), (Stage::Artifacts, 330));
    let tasks: Vec<String> = view.tasks.iter().map(|(task, _)| task.task.to_string()).collect();
    assert_eq!(tasks.join(" "), "plan global partition-0000 partition-0001 merge borders evaluate artifacts");
    let entered = store.events(&id, 0, 1000).await.unwrap().into_iter();
    let entered: Vec<Stage> = entered
        .filter_map(|event| if let EventBody::Stage { stage, .. } = event.body { Some(stage) } else { None })
        .collect();
    assert_eq!(
        entered,
        [Stage::Global, Stage::Partition, Stage::Merge, Stage::Borders, Stage::Evaluate, Stage::Artifacts]
    );
}

pub async fn an_evaluation_in_parts_ends_with_the_last_of_them(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let mut output = planned(2);
    let tasks = &mut output.planned.as_mut().unwrap().tasks;
    tasks.remove(&Stage::Evaluate.task());
    let parts = [1, 2, 3].map(|part| Stage::Evaluate.task_of(part));
    for part in parts {
        tasks.insert(part, PlannedTask::new(blob(&part.to_string()), 0));
    }
    let id = job_of(store, 1, output).await;
    for task in [Stage::Global.task(), Stage::Partition.task_of(0), Stage::Partition.task_of(1)] {
        do_next(store, task, T0 + 20).await;
    }
    let merge = claim(store, &Stage::own(), T0 + 30).await.unwrap().lease;
    store.complete(&merge, merged(), T0 + 40).await.unwrap();
    // All parts are leased at once, each with the model, and a lost one is evaluated again alone.
    let mut leases = Vec::new();
    for part in parts {
        let grant = claim(store, &Stage::of_workers(), T0 + 50).await.unwrap();
        assert_eq!((grant.lease.task, grant.job.output(Artifact::Model)), (part, Some(&blob("model"))));
        leases.push(grant.lease);
    }
    assert!(claim(store, &every_stage(), T0 + 50).await.is_none(), "work beside the evaluation");
    for lease in &leases[1..] {
        store.complete(lease, result_of(lease.task), T0 + 60).await.unwrap();
    }
    assert_eq!(store.sweep(T0 + 60 + LEASE_MS).await.unwrap(), [(leases[0].clone(), Expired::Silent)]);
    assert_eq!(store.job(&id).await.unwrap().job.stage, Stage::Evaluate);
    do_next(store, parts[0], T0 + 3000).await;
    let view = store.job(&id).await.unwrap();
    assert_eq!((view.job.stage, view.job.output(Artifact::Evaluation)), (Stage::Artifacts, None));
    let done = view.tasks.iter().filter_map(|(task, _)| match &task.state {
        TaskState::Done { result, .. } if task.task.stage == Stage::Evaluate => Some(result.clone()),
        _ => None,
    });
    assert_eq!(done.collect::<Vec<_>>(), parts.map(|part| blob(&part.to_string())));
}

pub async fn a_stage_that_fails_for_good_ends_the_job(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let before = [
        Stage::Global.task(),
        Stage::FirstPart.task_of(0),
        Stage::FirstPart.task_of(1),
        Stage::Exchange.task(),
    ];
    for (number, fails) in
        [(1, Stage::FirstPart.task_of(0)), (2, Stage::Exchange.task()), (3, Stage::Partition.task_of(0))]
    {
        let id = job_of(store, number, planned_as(2, true)).await;
        for task in before.into_iter().take_while(|task| *task != fails) {
            do_next(store, task, T0 + 20).await;
        }
        let lease = claim(store, &[fails.stage], T0 + 30).await.unwrap().lease;
        store.fail(&lease, FailClass::Input, "unusable".into(), T0 + 40).await.unwrap();
        let view = store.job(&id).await.unwrap();
        assert_eq!(view.job.state, JobState::Failed);
        assert!(view.job.error.starts_with(&fails.to_string()), "{}", view.job.error);
        let open = view.tasks.iter().filter(|(task, _)| !task.is_final()).count();
        assert_eq!(open, 0, "tasks of a job that failed in {fails}");
    }
}

pub async fn a_job_goes_through_all_its_stages(store: Arc<dyn Store>) {
    let store = store.as_ref();
    let id = planned_job(store, 1, 2).await;
    let mut now = T0 + 100;
    let mut seen = Vec::new();
    while store.job(&id).await.unwrap().job.state == JobState::Running {
        let grant = claim(store, &Stage::all().collect::<Vec<_>>(), now).await.expect("work");
        now += 50;
        let task = grant.lease.task;
        let output = match task {
            task if task.stage == Stage::Merge => merged(),
            task => result_of(task),
        };
        store.complete(&grant.lease, output, now).await.unwrap();
        seen.push(task);
    }
    assert_eq!(
        seen,
        [
            Stage::Global.task(),
            Stage::Partition.task_of(0),
            Stage::Partition.task_of(1),
            Stage::Merge.task(),
            Stage::Evaluate.task(),
            Stage::Artifacts.task()
        ]
    );
    let view = store.job(&id).await.unwrap();
    assert_eq!(view.job.state, JobState::Succeeded);
    assert_eq!(view.job.output(Artifact::CoarseModel), Some(&blob("global")));
    assert_eq!(view.job.output(Artifact::Model), Some(&blob("model")));
    assert_eq!(view.job.output(Artifact::Index), Some(&blob("artifacts")));
    assert_eq!(view.progress(), 1.0);
    assert!(view.tasks.iter().all(|(task, _)| matches!(task.state, TaskState::Done { .. })));
    let events = store.events(&id, 0, 1000).await.unwrap();
    let numbers: Vec<u64> = events.iter().map(|event| event.seq).collect();
    assert_eq!(numbers, (1..=view.job.last_seq).collect::<Vec<_>>(), "a gap in the events");
    assert_eq!(store.events(&id, 3, 2).await.unwrap(), events[3..5]);
    assert!(store.ready().await.unwrap().is_empty());
}
