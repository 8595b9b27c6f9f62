//! Runs one input: turns a panic into a message, counts memory, and reports an input that never ends.

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, Once, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use crate::allocations;

/// After this time an input counts as endless and the test process exits, because a loop cannot be stopped
/// from outside.
const NEVER: Duration = Duration::from_secs(120);

thread_local! {
    /// Seed and number of what this thread reads.
    static CURRENT: Cell<(u64, u64)> = const { Cell::new((0, 0)) };
    static READING: Cell<bool> = const { Cell::new(false) };
    static PANIC: RefCell<String> = const { RefCell::new(String::new()) };
}

/// An input that is being read.
struct Reading {
    thread: ThreadId,
    since: Instant,
    name: String,
    seed: u64,
    number: u64,
}

/// The current input of each thread.
static NOW: Mutex<Vec<Reading>> = Mutex::new(Vec::new());

/// Seed and number of the input that this thread reads.
pub fn current() -> (u64, u64) {
    CURRENT.get()
}

/// Calls `read`; returns its result or panic message, and its peak memory, bytes.
pub fn watched(
    name: &str,
    seed: u64,
    number: u64,
    read: impl FnOnce() -> bool,
) -> (Result<bool, String>, u64) {
    static ONCE: Once = Once::new();
    ONCE.call_once(start);
    begin(name, seed, number);
    CURRENT.set((seed, number));
    READING.set(true);
    allocations::start();
    let result = catch_unwind(AssertUnwindSafe(read));
    let bytes = allocations::stop();
    READING.set(false);
    (result.map_err(|_| PANIC.take()), bytes)
}

/// Records that this thread starts an input; the previous one has ended.
fn begin(name: &str, seed: u64, number: u64) {
    let thread = std::thread::current().id();
    let since = Instant::now();
    let mut now = NOW.lock().unwrap_or_else(PoisonError::into_inner);
    match now.iter_mut().find(|reading| reading.thread == thread) {
        Some(reading) => (reading.since, reading.seed, reading.number) = (since, seed, number),
        None => now.push(Reading { thread, since, name: name.to_owned(), seed, number }),
    }
}

/// Records that this thread has no input.
pub fn ended() {
    let me = std::thread::current().id();
    NOW.lock().unwrap_or_else(PoisonError::into_inner).retain(|reading| reading.thread != me);
}

/// Redirects panic messages inside an input to the caller, and starts the watch for endless loops.
fn start() {
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if READING.get() {
            PANIC.set(info.to_string());
        } else {
            // The thread has a finding or belongs to another test: its input has ended.
            ended();
            usual(info);
        }
    }));
    std::thread::spawn(|| {
        loop {
            std::thread::sleep(Duration::from_secs(5));
            let now = NOW.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(Reading { since, name, seed, number, .. }) =
                now.iter().find(|reading| reading.since.elapsed() > NEVER)
            {
                let seconds = since.elapsed().as_secs();
                let text = format!(
                    "{name}: input {number} of seed {seed} has not ended after {seconds} s; replay it with \
                     FATHOM_FUZZ_SEED={seed} FATHOM_FUZZ_INPUT={number}\n"
                );
                let _ = std::io::Write::write_all(&mut std::io::stderr(), text.as_bytes());
                std::process::abort();
            }
        }
    });
}
