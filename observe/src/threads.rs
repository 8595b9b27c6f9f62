//! Threads for work that blocks, and what takes their place in a simulation.
//!
//! A simulation runs coordinator, workers and clients on one thread, in a time of its own, and the same seed must give the same
//! history. A thread beside it would end its work sooner or later than the time before. So everything that blocks goes through
//! here; on a thread that [`simulate`]s, it is done where it is called, and takes simulated time.

use std::cell::RefCell;
use std::panic::AssertUnwindSafe;
use std::pin::pin;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use tokio::task::JoinError;

type Takes = Box<dyn FnMut() -> Duration>;

thread_local! {
    static SIMULATED: RefCell<Option<Takes>> = const { RefCell::new(None) };
}

/// From now on this thread has no others beside it: `takes` says how long each piece of blocking work takes.
pub fn simulate(takes: impl FnMut() -> Duration + 'static) {
    SIMULATED.with_borrow_mut(|simulated| *simulated = Some(Box::new(takes)));
}

/// Whether this thread simulates, so that what otherwise has a thread of its own has to be a task.
pub fn are_simulated() -> bool {
    SIMULATED.with_borrow(Option::is_some)
}

fn simulated_time() -> Option<Duration> {
    SIMULATED.with_borrow_mut(|simulated| simulated.as_mut().map(|takes| takes()))
}

/// Runs work that blocks on a thread for it.
///
/// # Errors
/// When it panics.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, JoinError> {
    let Some(takes) = simulated_time() else { return tokio::task::spawn_blocking(work).await };
    let done = std::panic::catch_unwind(AssertUnwindSafe(work));
    tokio::time::sleep(takes).await;
    match done {
        Ok(result) => Ok(result),
        // As the error that a thread would have left.
        Err(panic) => tokio::spawn(async { std::panic::resume_unwind(panic) }).await,
    }
}

/// Makes a call of a library that hands what blocks to the threads of the runtime that it finds, and does it itself where it
/// finds none, as `object_store` does.
pub async fn by_library<T: Send>(call: impl Future<Output = T> + Send) -> T {
    let Some(takes) = simulated_time() else { return call.await };
    // A new thread belongs to no runtime.
    let done = std::thread::scope(|scope| scope.spawn(|| done_at_once(call)).join());
    let result = done.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    tokio::time::sleep(takes).await;
    result
}

fn done_at_once<T>(call: impl Future<Output = T>) -> T {
    let mut call = pin!(call);
    loop {
        match call.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(result) => return result,
            Poll::Pending => std::thread::yield_now(),
        }
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    /// What a simulation does is told from what threads do by the thread that does it, and by the time that it takes.
    #[test]
    fn blocking_work_of_a_simulation_is_done_where_it_is_called_and_takes_simulated_time() {
        let here = std::thread::current().id();
        let run = |simulated: bool| {
            if simulated {
                simulate(|| Duration::from_secs(3));
            }
            assert_eq!(are_simulated(), simulated);
            let mut runtime = tokio::runtime::Builder::new_current_thread();
            runtime.enable_time().start_paused(true).build().unwrap().block_on(async {
                let since = tokio::time::Instant::now();
                let thread = blocking(|| std::thread::current().id()).await.unwrap();
                let finds_a_runtime =
                    by_library(async { tokio::runtime::Handle::try_current().is_ok() }).await;
                let panicked = blocking(|| std::panic::resume_unwind(Box::new("on purpose"))).await;
                let is_panic = panicked.is_err_and(|error: JoinError| error.is_panic());
                (thread == here, finds_a_runtime, is_panic, since.elapsed().as_secs())
            })
        };
        assert_eq!(run(false), (false, true, true, 0));
        assert_eq!(run(true), (true, false, true, 9));
    }
}
