//! What this coordinator reports to the others that share its database, and what it hears from them.
//!
//! Every second it reports itself and the workers that called it. It reads how many coordinators there are,
//! the workers that called others, their marks, and the tokens. Changes of jobs travel as hints at once; what
//! a lost hint would have said is found within a second.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use futures::StreamExt;
use tokio::sync::watch;
use tokio::time::Instant;

use crate::connections::Connections;
use crate::state::{State, stopped};
use crate::store::StoreError;
use crate::store::members::{Hint, Members};

/// Interval of reports. A revoked token must be refused everywhere within two seconds.
const MEET_EVERY: Duration = Duration::from_secs(1);
/// Shortest and longest time without the database after which clients are sent away; a quarter of a lease in
/// between. A busy machine answers late, and a worker still has to register elsewhere before its lease ends.
const AWAY_AFTER: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(5)];
/// Changes within this time are one hint.
const NOTIFY_EVERY: Duration = Duration::from_millis(50);
/// Pause before it listens again after a failure of the database.
const LISTEN_AGAIN_AFTER: Duration = Duration::from_secs(1);

/// Keeps in touch with the other coordinators until this one stops.
pub async fn keep_in_touch(shared: Arc<State>, members: Arc<dyn Members>, connections: Arc<Connections>) {
    let mut stopping = shared.stopping.clone();
    let met = watch::Sender::new(Instant::now());
    tokio::select! {
        biased;
        () = stopped(&mut stopping) => {}
        () = meet(&shared, members.as_ref(), &met) => {}
        () = send_away(&shared, &connections, &met) => {}
        () = notify(&shared, members.as_ref()) => {}
        () = listen(&shared, members.as_ref()) => {}
    }
    if let Err(error) = members.leave().await {
        tracing::debug!(%error, "the other coordinators notice later that this one is gone");
    }
}

/// Reports this coordinator to the others, and notes in `met` when that succeeded.
async fn meet(shared: &State, members: &dyn Members, met: &watch::Sender<Instant>) {
    let mut since_ms = 0;
    loop {
        // All workers anew after a failure: some may have been forgotten here meanwhile.
        since_ms = match meet_once(shared, members, since_ms).await {
            Ok(time_ms) => {
                met.send_replace(Instant::now());
                time_ms
            }
            // The sweeper reports an outage.
            Err(StoreError::Unavailable(_)) => 0,
            Err(error) => {
                tracing::error!(%error, "cannot read what the other coordinators know; what is known stays valid");
                // The database answers, so clients can stay.
                met.send_replace(Instant::now());
                0
            }
        };
        // Twice as often as a gap in these reports extends the leases.
        let of_lease = Duration::from_millis(u64::from(shared.lease_ms) / 8);
        tokio::time::sleep(MEET_EVERY.min(of_lease)).await;
    }
}

async fn meet_once(shared: &State, members: &dyn Members, since_ms: u64) -> Result<u64, StoreError> {
    let seen = shared.workers.take_seen();
    let marks_version = shared.workers.marks_version();
    let meeting = members.meet(&seen, since_ms, shared.workers.forget_after_ms()).await?;
    shared.members.store(meeting.members, Relaxed);
    // After the workers were read and before they are known here: one whose token is unknown would lose its
    // tasks.
    shared.access.read_again(shared.store.as_ref()).await?;
    let knows_all = shared.workers.add_others(meeting.workers);
    for incarnation in meeting.forgotten {
        if let Some(worker) = shared.workers.get(&incarnation) {
            members.register(&incarnation, worker.owner_key(), &worker.to_row()?).await?;
        }
    }
    let marks = shared.jobs.worker_marks().await?;
    if shared.workers.set_marks(marks_version, marks) {
        // A worker may have to be drained.
        shared.wakeups.heard(Hint::Interrupt);
    }
    Ok(if knows_all { meeting.time_ms } else { 0 })
}

/// Closes all connections while this coordinator cannot reach the database, if there were others. Clients go
/// on at another one, which may reach it, before they lose their leases.
async fn send_away(shared: &State, connections: &Connections, met: &watch::Sender<Instant>) {
    let [shortest, longest] = AWAY_AFTER;
    let patience = (Duration::from_millis(shared.lease_ms.into()) / 4).clamp(shortest, longest);
    let mut is_away = false;
    loop {
        tokio::time::sleep(patience / 8).await;
        let is_cut_off = met.borrow().elapsed() > patience && shared.members.load(Relaxed) > 1;
        let closed = connections.close(is_cut_off);
        if is_cut_off != is_away {
            is_away = is_cut_off;
            if is_away {
                tracing::warn!(closed, "clients are sent to other coordinators: this one has no database");
            } else {
                tracing::info!("clients are admitted again");
            }
        }
    }
}

/// Sends hints about the changes of this process.
async fn notify(shared: &State, members: &dyn Members) {
    let mut made_here = shared.wakeups.made_here.subscribe();
    let mut before = *made_here.borrow_and_update();
    while made_here.changed().await.is_ok() {
        let made = *made_here.borrow_and_update();
        let hint = if made.interrupts == before.interrupts { Hint::Work } else { Hint::Interrupt };
        if let Err(error) = members.notify(hint).await {
            tracing::debug!(%error, "a hint is lost");
        }
        before = made;
        tokio::time::sleep(NOTIFY_EVERY).await;
    }
}

/// Wakes the calls that wait here when another coordinator has changed something.
async fn listen(shared: &State, members: &dyn Members) {
    loop {
        match members.listen().await {
            Ok(mut hints) => {
                // Something may have changed before.
                shared.wakeups.heard(Hint::Interrupt);
                while let Some(hint) = hints.next().await {
                    shared.wakeups.heard(hint);
                }
            }
            Err(error) => tracing::debug!(%error, "cannot listen to the other coordinators"),
        }
        tokio::time::sleep(LISTEN_AGAIN_AFTER).await;
    }
}
