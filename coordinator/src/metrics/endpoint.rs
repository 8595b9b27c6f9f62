//! The HTTP endpoint. Gauges are read from the store at most once a second, for any number of requests.

use std::sync::{PoisonError, Weak};
use std::time::{Duration, Instant};

use fathom_observe::http::Observed;
use prometheus_client::encoding::text;

use crate::schedule::{JobState, Stage};
use crate::state::State;
use crate::store::{Levels, StoreError};

/// Cache time of gauges.
const LEVELS_FOR: Duration = Duration::from_secs(1);

/// Cached gauges.
pub struct Snapshot {
    taken: Instant,
    levels: Levels,
}

/// An observed coordinator. It holds weak references only: connections must not keep the store open.
pub struct Endpoint(pub Weak<State>);

impl Endpoint {
    fn stopped() -> String {
        "the coordinator is stopping".to_owned()
    }
}

impl Observed for Endpoint {
    async fn metrics(&self) -> Result<String, String> {
        let shared = self.0.upgrade().ok_or_else(Self::stopped)?;
        let levels = levels(&shared).await.map_err(|error| error.to_string())?;
        set_levels(&shared, &levels);
        if let Ok((free, min_free)) = shared.objects.space().await {
            shared.metrics.levels.free_bytes.set(free as f64);
            shared.metrics.levels.min_free_bytes.set(min_free as f64);
        }
        let mut page = String::new();
        text::encode(&mut page, &shared.metrics.registry).map_err(|error| error.to_string())?;
        Ok(page)
    }

    async fn ready(&self) -> Result<(), String> {
        let shared = self.0.upgrade().ok_or_else(Self::stopped)?;
        if let Some(failure) = shared.jobs.failure() {
            return Err(StoreError::Failed(failure).to_string());
        }
        shared.jobs.answers().await.map_err(|error| error.to_string())?;
        shared.objects.check_space(0).await.map_err(|error| error.to_string())
    }
}

async fn levels(shared: &State) -> Result<Levels, StoreError> {
    let lock = || shared.metrics.snapshot.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = lock().as_ref().filter(|known| known.taken.elapsed() < LEVELS_FOR) {
        return Ok(known.levels.clone());
    }
    let (taken, levels) = (Instant::now(), shared.jobs.levels().await?);
    *lock() = Some(Snapshot { taken, levels: levels.clone() });
    Ok(levels)
}

fn set_levels(shared: &State, now: &Levels) {
    use JobState::{Cancelled, Failed, Paused, Running, Succeeded};
    let levels = &shared.metrics.levels;
    let count = |count: usize| i64::try_from(count).unwrap_or(i64::MAX);
    for state in [Running, Paused, Succeeded, Failed, Cancelled] {
        let jobs = now.jobs.get(&state).copied().unwrap_or(0);
        levels.jobs.get_or_create(&[("state", state.name())]).set(count(jobs));
    }
    for stage in Stage::all() {
        let of_stage = [("stage", stage.name())];
        levels.ready.get_or_create(&of_stage).set(count(now.ready.get(&stage).copied().unwrap_or(0)));
        levels.leases.get_or_create(&of_stage).set(count(now.leased.get(&stage).copied().unwrap_or(0)));
    }
    let waits = |since_ms: u64| shared.clock.now_ms().saturating_sub(since_ms) as f64 / 1e3;
    levels.oldest_ready_seconds.set(now.oldest_ready_ms.map_or(0.0, waits));
    levels.iterations_per_second.set(now.iterations_per_second);
    let mut by_state = [("active", 0), ("cordoned", 0), ("draining", 0)];
    for (_, worker) in shared.workers.all().into_iter().filter(|(_, worker)| shared.workers.lives(worker)) {
        let state = match shared.workers.mark_of(&worker.profile.incarnation) {
            None => 0,
            Some(mark) if !mark.drains => 1,
            Some(_) => 2,
        };
        by_state[state].1 += 1;
    }
    for (state, found) in by_state {
        levels.workers.get_or_create(&[("state", state)]).set(found);
    }
}
