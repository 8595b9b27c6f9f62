//! Threads for blocking work, and their replacement in a simulation.
//!
//! A simulation runs coordinator, workers and clients on one thread with simulated time, and the same seed
//! must give the same history. Another thread would finish at a different moment in each run. So all blocking
//! work goes through here. On a thread that [`simulate`]s it runs inline, and takes simulated time.

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

/// Makes this thread the only one of a simulation: `takes` gives the duration of each piece of blocking work.
pub fn simulate(takes: impl FnMut() -> Duration + 'static) {
    SIMULATED.with_borrow_mut(|simulated| *simulated = Some(Box::new(takes)));
}

/// Whether this thread simulates, so that work with a thread of its own must be a task instead.
pub fn are_simulated() -> bool {
    SIMULATED.with_borrow(Option::is_some)
}

fn simulated_time() -> Option<Duration> {
    SIMULATED.with_borrow_mut(|simulated| simulated.as_mut().map(|takes| takes()))
}

/// Runs blocking work on a thread for such work.
///
/// # Errors
/// When it panics.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, JoinError> {
    let Some(takes) = simulated_time() else { return tokio::task::spawn_blocking(work).await };
    let done = std::panic::catch_unwind(AssertUnwindSafe(work));
    tokio::time::sleep(takes).await;
    match done {
        Ok(result) => Ok(result),
        // The same error as from a thread.
        Err(panic) => tokio::spawn(async { std::panic::resume_unwind(panic) }).await,
    }
}

/// Calls a library that runs blocking work on the threads of the runtime that it finds, and inline if it
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

    /// The thread and the time that the work takes distinguish a simulation from threads.
    #[test]
    fn blocking_work_of_a_simulation_runs_inline_in_simulated_time() {
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
