//! A database that several processes use, that may be away for a while, and that leaves one store for
//! another.

use std::time::{Duration, Instant};

use super::postgres_server::{Disk, Server, database};
use super::*;

fn options_of(url: &str) -> PostgresOptions {
    PostgresOptions {
        url: url.to_owned(),
        rules: rules(),
        lease_ms: LEASE_MS,
        stall_ms: STALL_MS,
        connections: 8,
    }
}

/// Two stores on one database, as in two coordinators.
async fn two_stores() -> Option<[Arc<PostgresStore>; 2]> {
    let url = database()?;
    Some([Arc::new(open_postgres(&url).await), Arc::new(open_postgres(&url).await)])
}

/// Claims by both stores at once; the leases that were granted.
async fn claim_at_both(stores: &[Arc<PostgresStore>; 2], calls: usize, now_ms: u64) -> Vec<Lease> {
    let lanes = (0..calls).map(|call| {
        let store = Arc::clone(&stores[call % 2]);
        tokio::spawn(async move { claim(store.as_ref(), &Stage::of_workers(), now_ms).await })
    });
    let granted = futures::future::join_all(lanes).await;
    granted.into_iter().filter_map(|grant| Some(grant.unwrap()?.lease)).collect()
}

fn assert_all_differ(leases: &[Lease]) {
    let fences: std::collections::BTreeSet<u64> = leases.iter().map(|lease| lease.fence).collect();
    let tasks: std::collections::BTreeSet<(&JobId, TaskId)> =
        leases.iter().map(|lease| (&lease.job, lease.task)).collect();
    assert_eq!((fences.len(), tasks.len()), (leases.len(), leases.len()), "{leases:?}");
}

async fn assert_sound(store: &PostgresStore) {
    let (export, faults) = store.verified().await.unwrap();
    assert_eq!((faults, verify::faults(&export)), (Vec::new(), Vec::new()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn two_coordinators_grant_no_task_twice_and_keep_to_every_limit() {
    let Some(stores) = two_stores().await else { return };
    let store = stores[0].as_ref();
    let free = planned_job(store, 1, 30).await;
    do_next(store, Stage::Global.task(), T0 + 20).await;
    store.steer(&free, Event::Update { priority: None, max_parallel: Some(7) }, T0 + 21).await.unwrap();
    let leases = claim_at_both(&stores, 40, T0 + 30).await;
    assert_all_differ(&leases);
    assert_eq!(leases.len(), 7, "the limit of the job");
    store.steer(&free, Event::Update { priority: None, max_parallel: Some(0) }, T0 + 31).await.unwrap();
    // Two jobs of the tenant: its limit holds for both together.
    planned_job(store, 2, 30).await;
    stores[1]
        .set_quota(&Tenant::default(), Some(Quota { max_parallel: 12, ..Quota::default() }))
        .await
        .unwrap();
    let more = claim_at_both(&stores, 40, T0 + 40).await;
    assert_eq!(more.len(), 5, "the limit of the tenant");
    assert_all_differ(&[leases.clone(), more].concat());
    // Leases that end make room while others claim.
    let ends = leases.iter().map(|lease| store.release(lease, "leaves".into(), T0 + 50));
    let (ended, granted) = tokio::join!(futures::future::join_all(ends), claim_at_both(&stores, 40, T0 + 50));
    assert!(ended.iter().all(Result::is_ok) && granted.len() <= 7, "{granted:?}");
    let usage = store.usage().await.unwrap();
    assert!(usage[0].1.leased_tasks <= 12, "{usage:?}");
    assert_sound(store).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_call_repeated_at_another_coordinator_gets_the_same_lease() {
    let Some(stores) = two_stores().await else { return };
    planned_job(stores[0].as_ref(), 1, 20).await;
    do_next(stores[0].as_ref(), Stage::Global.task(), T0 + 20).await;
    for round in 0..10 {
        let call = claim_as("worker", &format!("call {round}"), &Stage::of_workers());
        let both = stores.each_ref().map(|store| store.claim(&call, T0 + 30));
        let leases = futures::future::join_all(both).await;
        let leases: Vec<Option<Lease>> =
            leases.into_iter().map(|grant| grant.unwrap().map(|grant| grant.lease)).collect();
        assert!(leases[0].is_some() && leases[0] == leases[1], "{leases:?}");
    }
    assert_sound(&stores[0]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn one_request_at_two_coordinators_makes_one_job() {
    let Some(stores) = two_stores().await else { return };
    for number in 0..10 {
        let both = stores.each_ref().map(|store| store.submit(new_job(number), T0));
        let jobs = futures::future::join_all(both).await;
        assert_eq!(jobs[0].as_ref().unwrap().job_id, jobs[1].as_ref().unwrap().job_id);
    }
    assert_eq!(stores[0].list(&JobFilter::default(), None, 100).await.unwrap().len(), 10);
    stores[0]
        .set_quota(&Tenant::default(), Some(Quota { max_open_jobs: 13, ..Quota::default() }))
        .await
        .unwrap();
    let many = (10..30).map(|number| stores[number as usize % 2].submit(new_job(number), T0));
    let made = futures::future::join_all(many).await;
    assert_eq!(made.iter().filter(|job| job.is_ok()).count(), 3, "the limit of open jobs");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_change_that_is_refused_spoils_none_that_waited_with_it() {
    let Some(url) = database() else { return };
    let store = Arc::new(open_postgres(&url).await);
    let id = planned_job(store.as_ref(), 1, 12).await;
    do_next(store.as_ref(), Stage::Global.task(), T0 + 20).await;
    let mut leases = Vec::new();
    for _ in 0..12 {
        leases.push(claim(store.as_ref(), &Stage::of_workers(), T0 + 30).await.unwrap().lease);
    }
    let stale = Lease { fence: 1, ..leases[0].clone() };
    let mut calls = Vec::new();
    for lease in &leases {
        calls.push(store.complete(lease, result_of(lease.task), T0 + 40));
        calls.push(store.complete(&stale, result_of(stale.task), T0 + 40));
        // Its row would be too large.
        calls.push(store.fail(&stale, FailClass::Training, "x".repeat(1 << 17), T0 + 40));
    }
    let answers = futures::future::join_all(calls).await;
    assert_eq!(answers.iter().filter(|answer| answer.is_ok()).count(), 12);
    assert_eq!(store.job_row(&id).await.unwrap().stage, Stage::Merge);
    let too_large = Event::Pause { reason: "x".repeat(1 << 17) };
    let (large, small) = tokio::join!(
        store.apply(&id, too_large, T0 + 50),
        store.apply(&id, Event::Update { priority: Some(3), max_parallel: None }, T0 + 50)
    );
    assert!(matches!(large, Err(StoreError::RowTooLarge { .. })), "{large:?}");
    small.unwrap();
    assert_eq!(store.job_row(&id).await.unwrap().priority, 3);
    assert_sound(&store).await;
}

#[tokio::test]
async fn a_reopened_database_has_everything_and_leases_get_grace() {
    let Some(url) = database() else { return };
    let store = open_postgres(&url).await;
    let id = planned_job(&store, 1, 1).await;
    let held = claim(&store, &Stage::of_workers(), T0 + 20).await.unwrap().lease;
    store.checkpoint(&held, blob("checkpoint"), 40, T0 + 30).await.unwrap();
    let before = (store.job(&id).await.unwrap().job, store.events(&id, 0, 100).await.unwrap());
    store.close().await;

    // Days later by the clock, or earlier if it was set back: downtime is no silence.
    for now in [T0 + 259_200_000, T0 - 259_200_000] {
        let store = open_postgres(&url).await;
        store.recover(now).await.unwrap();
        assert_eq!((store.job(&id).await.unwrap().job, store.events(&id, 0, 100).await.unwrap()), before);
        assert!(store.sweep(now + LEASE_MS - 1).await.unwrap().is_empty(), "no grace");
        assert_eq!(store.renew(&held, None, now + 10).await.unwrap(), Renewed::Runs);
        store.close().await;
    }
}

#[tokio::test]
async fn leases_end_by_the_clock_of_the_database() {
    let Some(url) = database() else { return };
    let store = PostgresStore::open(&options_of(&url)).await.unwrap();
    let id = store.submit(new_job(1), 0).await.unwrap().job_id;
    // Whatever time this process has: the database's decides.
    let begin = Instant::now();
    let lease = claim(&store, &[Stage::Plan], u64::MAX / 4).await.unwrap().lease;
    assert_eq!(lease.job, id);
    assert!(store.sweep(u64::MAX / 4).await.unwrap().is_empty());
    assert_eq!(store.renew(&lease, None, 0).await.unwrap(), Renewed::Runs);
    let swept = loop {
        let swept = store.sweep(0).await.unwrap();
        if !swept.is_empty() || begin.elapsed() > Duration::from_secs(30) {
            break swept;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert_eq!(swept, [(lease, Expired::Silent)]);
    assert!(begin.elapsed() >= Duration::from_millis(LEASE_MS), "{:?}", begin.elapsed());
}

#[tokio::test]
async fn a_sweep_that_waited_for_the_database_takes_nothing_back() {
    let Some(url) = database() else { return };
    let store = Arc::new(PostgresStore::open(&options_of(&url)).await.unwrap());
    store.submit(new_job(1), 0).await.unwrap();
    let lease = claim(store.as_ref(), &[Stage::Plan], 0).await.unwrap().lease;
    // As if the machine was suspended in the middle of a call.
    let mut holder = <::sqlx::PgConnection as ::sqlx::Connection>::connect(&url).await.unwrap();
    ::sqlx::query("BEGIN").execute(&mut holder).await.unwrap();
    ::sqlx::query("LOCK TABLE leases IN ACCESS EXCLUSIVE MODE").execute(&mut holder).await.unwrap();
    let waits = tokio::spawn({
        let store = Arc::clone(&store);
        async move { store.sweep(0).await }
    });
    tokio::time::sleep(Duration::from_millis(LEASE_MS + 500)).await;
    assert!(!waits.is_finished());
    ::sqlx::query("COMMIT").execute(&mut holder).await.unwrap();
    assert_eq!(waits.await.unwrap().unwrap(), [], "nobody could renew meanwhile");
    assert_eq!(store.sweep(0).await.unwrap(), [(lease, Expired::Silent)], "a later one");
}

#[tokio::test]
async fn a_store_moves_into_a_database_and_back_without_a_loss() {
    let (Some(first), Some(second)) = (database(), database()) else { return };
    let dir = tempfile::tempdir().unwrap();
    let sled = open(dir.path());
    let id = planned_job(&sled, 1, 3).await;
    do_next(&sled, Stage::Global.task(), T0 + 20).await;
    let held = claim(&sled, &Stage::of_workers(), T0 + 30).await.unwrap().lease;
    let deleted = planned_job(&sled, 2, 1).await;
    cancel(&sled, &deleted, "", T0 + 40).await.unwrap();
    sled.delete(&deleted).await.unwrap();
    sled.set_quota(&Tenant::default(), Some(Quota { max_bytes: u64::MAX, ..Quota::default() }))
        .await
        .unwrap();
    let export = sled.export().await.unwrap();

    let (postgres, again) = (open_postgres(&first).await, open_postgres(&second).await);
    postgres.import(&export).await.unwrap();
    let refused = postgres.import(&export).await;
    assert!(matches!(refused, Err(StoreError::NotEmpty)), "{refused:?}");
    let (moved, faults) = postgres.verified().await.unwrap();
    assert_eq!((&moved, faults), (&export, Vec::new()));
    again.import(&moved).await.unwrap();
    for store in [&postgres, &again] {
        store.recover(T0 + 100).await.unwrap();
        store_goes_on(store, &id, &held).await;
        assert_sound(store).await;
    }
    let back = tempfile::tempdir().unwrap();
    let back = open(back.path());
    back.import(&again.export().await.unwrap()).await.unwrap();
    assert_eq!(back.export().await.unwrap(), again.export().await.unwrap());
    assert_eq!(back.index_faults().unwrap(), Vec::<String>::new());
}

#[tokio::test]
async fn what_a_database_cannot_serve_is_refused_with_the_reason() {
    let Some(url) = database() else { return };
    let open = async |url: &str| PostgresStore::open(&options_of(url)).await.map(drop).unwrap_err();
    let said = open("postgres://fathom:secret@localhost:port/x").await.to_string();
    assert!(said.contains("cannot be read") && !said.contains("secret"), "{said}");
    let said = open("postgres://fathom:secret@127.0.0.1:1/x").await.to_string();
    assert!(said.contains("is not available") && !said.contains("secret"), "{said}");

    let store = open_postgres(&url).await;
    let id = store.submit(new_job(1), T0).await.unwrap().job_id;
    let admin = ::sqlx::PgPool::connect(&url).await.unwrap();
    let flip = "UPDATE jobs SET row = set_byte(row, 10, get_byte(row, 10) # 1)";
    ::sqlx::query(flip).execute(&admin).await.unwrap();
    let damaged = store.job(&id).await;
    assert!(matches!(damaged, Err(StoreError::Corrupt { tree: "jobs", .. })), "{damaged:?}");
    ::sqlx::query(flip).execute(&admin).await.unwrap();
    store.job(&id).await.unwrap();
    // A column that differs from its row is found.
    ::sqlx::query("UPDATE jobs SET leased = 5").execute(&admin).await.unwrap();
    assert_eq!(store.verified().await.unwrap().1.len(), 1);

    ::sqlx::query(
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
         VALUES (9999, 'of a newer program', true, '', 0)",
    )
    .execute(&admin)
    .await
    .unwrap();
    let said = open(&url).await;
    assert!(matches!(said, StoreError::OtherSchema { found: 9999, .. }), "{said}");
}

#[tokio::test]
async fn a_second_coordinator_is_kept_away_until_the_first_is_gone() {
    let Some(url) = database() else { return };
    let held = || tempfile::tempfile().unwrap();
    let first = PostgresStore::open(&options_of(&url)).await.unwrap();
    first.hold(Hold::Alone, Some(held())).await.unwrap();
    let second = PostgresStore::open(&options_of(&url)).await.unwrap();
    let waits =
        tokio::time::timeout(Duration::from_millis(1500), second.hold(Hold::Alone, Some(held()))).await;
    assert!(waits.is_err(), "two coordinators have it");
    drop(first);
    second.hold(Hold::Alone, Some(held())).await.unwrap();
    assert_eq!(second.failure(), None);
    drop(second);
    // Those whose files are in a bucket hold it together, and keep away others.
    let mut together = Vec::new();
    for _ in 0..2 {
        let store = PostgresStore::open(&options_of(&url)).await.unwrap();
        store.hold(Hold::WithOthers, None).await.unwrap();
        together.push(store);
    }
    let other = PostgresStore::open(&options_of(&url)).await.unwrap();
    let waits = tokio::time::timeout(Duration::from_millis(1500), other.hold(Hold::Alone, None)).await;
    assert!(waits.is_err(), "one that cannot share its files has it too");
}

#[tokio::test]
async fn leases_are_extended_after_a_time_without_coordinators() {
    let Some(url) = database() else { return };
    let mut admin = <::sqlx::PgConnection as ::sqlx::Connection>::connect(&url).await.unwrap();
    // A busy machine needs no quarter of a lease from one call to the next.
    let options = PostgresOptions { lease_ms: 60_000, ..options_of(&url) };
    let one = PostgresStore::open(&options).await.unwrap();
    let other = PostgresStore::open(&options).await.unwrap();
    let lease = "INSERT INTO leases (job_id, stage, part, fence, attempt, call, deadline_ms, still_since_ms) \
                 VALUES ('job', 0, 0, 1, 1, '', 1, 1)";
    ::sqlx::query(lease).execute(&mut admin).await.unwrap();
    let deadline_ms = async |admin: &mut ::sqlx::PgConnection| -> i64 {
        ::sqlx::query_scalar("SELECT deadline_ms FROM leases").fetch_one(admin).await.unwrap()
    };
    one.extend_leases(0).await.unwrap();
    let extended_ms = deadline_ms(&mut admin).await;
    assert!(extended_ms > 1, "the first coordinator");
    other.extend_leases(0).await.unwrap();
    assert_eq!(deadline_ms(&mut admin).await, extended_ms, "workers could renew at the first one");
    ::sqlx::query("UPDATE members SET seen_ms = seen_ms - 60000").execute(&mut admin).await.unwrap();
    ::sqlx::query("UPDATE leases SET deadline_ms = 1").execute(&mut admin).await.unwrap();
    // The first report does it, whichever call that is.
    other.members().unwrap().meet(&[], 0, 60_000).await.unwrap();
    let extended_ms = deadline_ms(&mut admin).await;
    assert!(extended_ms > 1, "nobody could renew");
    one.extend_leases(0).await.unwrap();
    assert_eq!(deadline_ms(&mut admin).await, extended_ms);
}

#[tokio::test]
async fn coordinators_know_the_workers_of_each_other() {
    let Some(url) = database() else { return };
    let mut members = Vec::new();
    for _ in 0..2 {
        members.push(PostgresStore::open(&options_of(&url)).await.unwrap().members().unwrap());
    }
    let id = "0b2f5d6e-9d9e-4a54-8c1c-0a1f7c1b0001";
    assert!(members[0].register(id, "ana", b"a row").await.unwrap());
    assert!(!members[1].register(id, "eve", b"another").await.unwrap(), "an id is no secret");
    let seen = [(id.to_owned(), 5)];
    let first = members[0].meet(&seen, 0, 60_000).await.unwrap();
    assert_eq!(first.forgotten, Vec::<String>::new());
    let met = members[1].meet(&[], 0, 60_000).await.unwrap();
    assert_eq!((met.members, met.workers[0].registered.as_deref()), (2, Some(&b"a row"[..])));
    members[0].leave().await.unwrap();
    assert_eq!(members[1].meet(&[], 0, 60_000).await.unwrap().members, 1);
    // Forgotten while the database was away: its coordinator hears of it.
    members[1].forget(&[id.to_owned()]).await.unwrap();
    assert_eq!(members[0].meet(&seen, 0, 60_000).await.unwrap().forgotten, [id]);
}

/// A killed server forgets nothing that it acknowledged; calls meanwhile end with an error that passes.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_killed_server_loses_nothing_and_calls_go_on_after_it() {
    let Some(mut server) = Server::start(Disk::Synced) else { return };
    let url = server.database();
    let store = Arc::new(PostgresStore::open(&options_of(&url)).await.unwrap());
    let (mut acknowledged, mut failures) = (Vec::new(), 0);
    for round in 0..2_u32 {
        let writers = (0..8_u32).map(|lane| {
            let store = Arc::clone(&store);
            tokio::spawn(async move {
                let mut made = Vec::new();
                for number in 0..10_000 {
                    match store.submit(new_job(round * 1_000_000 + lane * 100_000 + number), T0).await {
                        Ok(job) => made.push(job.job_id),
                        Err(StoreError::Unavailable(_)) => return made,
                        Err(error) => panic!("{error}"),
                    }
                }
                panic!("the server was not killed")
            })
        });
        let writers: Vec<_> = writers.collect();
        tokio::time::sleep(Duration::from_millis(400)).await;
        tokio::task::block_in_place(|| server.kill());
        let lease = Lease { job: JobId::new(T0, 0), task: Stage::Plan.task(), attempt: 1, fence: 1 };
        let renewed = store.renew(&lease, None, T0).await;
        assert!(matches!(renewed, Err(StoreError::Unavailable(_))), "{renewed:?}");
        for writer in writers {
            acknowledged.extend(writer.await.unwrap());
            failures += 1;
        }
        tokio::task::block_in_place(|| server.resume());
        store.answers().await.unwrap();
        for id in &acknowledged {
            store.job(id).await.unwrap_or_else(|error| panic!("{id} is lost: {error}"));
        }
        let leased = claim(store.as_ref(), &[Stage::Plan], T0).await.expect("work").lease;
        store.complete(&leased, planned(1), T0).await.unwrap();
    }
    assert!(acknowledged.len() > 30 && failures == 16, "{} jobs", acknowledged.len());
    assert_sound(&store).await;
}
