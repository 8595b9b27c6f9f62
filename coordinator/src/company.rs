//! What this coordinator reports to the others that share its database, and what it hears from them.
//!
//! Every second it reports itself and the workers that called it. It reads how many coordinators there are,
//! the workers that called others, their marks, and the tokens. Changes of jobs travel as hints at once; what
//! a lost hint would have said is found within a second.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use futures::StreamExt;

use crate::state::{State, stopped};
use crate::store::StoreError;
use crate::store::members::{Hint, Members};

/// Interval of reports. A revoked token must be refused everywhere within two seconds.
const MEET_EVERY: Duration = Duration::from_secs(1);
/// Changes within this time are one hint.
const NOTIFY_EVERY: Duration = Duration::from_millis(50);
/// Pause before it listens again after a failure of the database.
const LISTEN_AGAIN_AFTER: Duration = Duration::from_secs(1);

/// Keeps in touch with the other coordinators until this one stops.
pub async fn keep_in_touch(shared: Arc<State>, members: Arc<dyn Members>) {
    let mut stopping = shared.stopping.clone();
    tokio::select! {
        biased;
        () = stopped(&mut stopping) => {}
        () = meet(&shared, members.as_ref()) => {}
        () = notify(&shared, members.as_ref()) => {}
        () = listen(&shared, members.as_ref()) => {}
    }
    if let Err(error) = members.leave().await {
        tracing::debug!(%error, "the other coordinators notice later that this one is gone");
    }
}

async fn meet(shared: &State, members: &dyn Members) {
    let mut since_ms = 0;
    loop {
        match meet_once(shared, members, since_ms).await {
            Ok(time_ms) => since_ms = time_ms,
            // The sweeper reports an outage.
            Err(StoreError::Unavailable(_)) => {}
            Err(error) => {
                tracing::error!(%error, "cannot read what the other coordinators know; what is known stays valid");
            }
        }
        tokio::time::sleep(MEET_EVERY).await;
    }
}

async fn meet_once(shared: &State, members: &dyn Members, since_ms: u64) -> Result<u64, StoreError> {
    let seen = shared.workers.take_seen();
    let marks_version = shared.workers.marks_version();
    let meeting = members.meet(&seen, since_ms, shared.workers.forget_after_ms()).await?;
    shared.members.store(meeting.members, Relaxed);
    shared.workers.add_others(meeting.workers);
    let marks = shared.jobs.worker_marks().await?;
    if shared.workers.set_marks(marks_version, marks) {
        // A worker may have to be drained.
        shared.wakeups.heard(Hint::Interrupt);
    }
    shared.access.read_again(shared.store.as_ref()).await?;
    Ok(meeting.time_ms)
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
