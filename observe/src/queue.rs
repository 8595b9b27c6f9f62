//! A bounded queue of log lines on their way to storage. Logging threads never wait for it.
//!
//! When it is full, the newest lines are dropped and counted; the next line that fits reports how many.
//! Consumers leave lines in the queue until they are stored, so no other buffer holds memory.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;
use tracing::Level;

use crate::capture::{LoggedLine, Sink};

/// Number of lines in a batch.
pub const BATCH: usize = 256;
/// Maximum number of waiting lines, and of bytes in their messages: as much as a worker logs in hours without
/// its coordinator.
const MAX_LINES: usize = 4096;
const MAX_BYTES: usize = 1 << 20;

/// Lines of attempts that a `K` identifies.
pub struct Queue<K> {
    waiting: Mutex<Waiting<K>>,
    changed: Notify,
}

struct Waiting<K> {
    lines: VecDeque<Numbered<K>>,
    bytes: usize,
}

struct Numbered<K> {
    of: Arc<K>,
    number: u64,
    line: LoggedLine,
}

/// Lines of one attempt, by ascending number.
pub struct Batch<K> {
    /// The attempt.
    pub of: Arc<K>,
    /// Its lines with their numbers, which count from 1 in each attempt.
    pub lines: Vec<(u64, LoggedLine)>,
}

impl<K> Default for Queue<K> {
    fn default() -> Self {
        let waiting = Mutex::new(Waiting { lines: VecDeque::new(), bytes: 0 });
        Self { waiting, changed: Notify::new() }
    }
}

impl<K: Send + Sync + 'static> Queue<K> {
    /// The sink for the lines of the attempt `of`.
    pub fn sink(self: &Arc<Self>, of: K) -> Arc<dyn Sink> {
        Arc::new(Source { queue: Arc::clone(self), of: Arc::new(of), count: Mutex::default() })
    }

    fn lock(&self) -> MutexGuard<'_, Waiting<K>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for lines, and returns the oldest, all of one attempt; they stay until [`Queue::remove`].
    pub async fn next(&self) -> Batch<K> {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            if let Some(batch) = self.first_batch() {
                return batch;
            }
            changed.await;
        }
    }

    fn first_batch(&self) -> Option<Batch<K>> {
        let waiting = self.lock();
        let of = Arc::clone(&waiting.lines.front()?.of);
        let same = waiting.lines.iter().take_while(|line| Arc::ptr_eq(&line.of, &of));
        let lines = same.take(BATCH).map(|numbered| (numbered.number, numbered.line.clone())).collect();
        Some(Batch { of, lines })
    }

    /// Removes the lines of a batch, once they are stored or can never be.
    pub fn remove(&self, batch: &Batch<K>) {
        let mut waiting = self.lock();
        for _ in &batch.lines {
            if let Some(line) = waiting.lines.pop_front() {
                waiting.bytes -= line.line.message.len();
            }
        }
        drop(waiting);
        self.changed.notify_waiters();
    }

    /// Waits until the queue is empty.
    pub async fn emptied(&self) {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            if self.lock().lines.is_empty() {
                return;
            }
            changed.await;
        }
    }
}

/// The sink of one attempt.
struct Source<K: Send + Sync + 'static> {
    queue: Arc<Queue<K>>,
    of: Arc<K>,
    count: Mutex<Count>,
}

#[derive(Default)]
struct Count {
    last: u64,
    dropped: u64,
}

impl<K: Send + Sync + 'static> Source<K> {
    fn push(&self, waiting: &mut Waiting<K>, count: &mut Count, line: LoggedLine) {
        count.last += 1;
        waiting.bytes += line.message.len();
        waiting.lines.push_back(Numbered { of: Arc::clone(&self.of), number: count.last, line });
    }

    /// Reports how many lines were dropped, if any.
    fn report_dropped(&self, waiting: &mut Waiting<K>, count: &mut Count) {
        let dropped = std::mem::take(&mut count.dropped);
        if dropped > 0 {
            let message = format!("dropped {dropped} lines here: they came faster than they could be stored");
            self.push(waiting, count, LoggedLine::now(Level::WARN, &message));
        }
    }
}

impl<K: Send + Sync + 'static> Sink for Source<K> {
    fn line(&self, line: LoggedLine) {
        let mut waiting = self.queue.lock();
        let mut count = self.count.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.lines.len() >= MAX_LINES || waiting.bytes + line.message.len() > MAX_BYTES {
            count.dropped += 1;
            return;
        }
        self.report_dropped(&mut waiting, &mut count);
        self.push(&mut waiting, &mut count, line);
        drop(waiting);
        self.queue.changed.notify_waiters();
    }
}

impl<K: Send + Sync + 'static> Drop for Source<K> {
    fn drop(&mut self) {
        let mut waiting = self.queue.lock();
        let mut count = self.count.lock().unwrap_or_else(PoisonError::into_inner);
        // One line beyond the bound for each attempt that dropped lines.
        self.report_dropped(&mut waiting, &mut count);
        drop(waiting);
        self.queue.changed.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn messages(batch: &Batch<u8>) -> Vec<(u64, &str)> {
        batch.lines.iter().map(|(number, line)| (*number, line.message.as_str())).collect()
    }

    #[tokio::test]
    async fn batches_are_of_one_attempt_and_stay_until_they_are_safe() {
        let queue = Arc::new(Queue::default());
        let (first, second) = (queue.sink(1), queue.sink(2));
        for (sink, message) in [(&first, "a"), (&first, "b"), (&second, "c"), (&first, "d")] {
            sink.line(LoggedLine::now(Level::INFO, message));
        }
        for _ in 0..2 {
            assert_eq!(messages(&queue.next().await), [(1, "a"), (2, "b")], "kept until it is removed");
        }
        for expected in [[(1, "a"), (2, "b")].as_slice(), &[(1, "c")], &[(3, "d")]] {
            let batch = queue.next().await;
            assert_eq!(messages(&batch), expected);
            queue.remove(&batch);
        }
        tokio::time::timeout(std::time::Duration::from_secs(5), queue.emptied()).await.unwrap();
    }

    #[tokio::test]
    async fn a_full_queue_drops_the_newest_and_says_how_many() {
        let queue = Arc::new(Queue::default());
        let sink = queue.sink(1);
        for _ in 0..MAX_LINES + 7 {
            sink.line(LoggedLine::now(Level::INFO, "x"));
        }
        assert_eq!(queue.lock().lines.len(), MAX_LINES);
        let batch = queue.next().await;
        queue.remove(&batch);
        sink.line(LoggedLine::now(Level::INFO, "after"));
        sink.line(LoggedLine::now(Level::INFO, &"y".repeat(4000)));
        for _ in 0..MAX_BYTES / 4000 {
            sink.line(LoggedLine::now(Level::INFO, &"z".repeat(4000)));
        }
        drop(sink);
        let waiting = queue.lock();
        assert!(waiting.bytes <= MAX_BYTES + 200, "{} bytes wait", waiting.bytes);
        let said: Vec<&str> =
            waiting.lines.iter().map(|l| l.line.message.as_str()).filter(|m| m.contains("dropped")).collect();
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(said[0].starts_with("dropped 7 lines"), "{said:?}");
        let last = waiting.lines.back().unwrap();
        assert!(last.line.message.contains("dropped"), "dropped lines at the end are not reported");
        let numbers: Vec<u64> = waiting.lines.iter().map(|line| line.number).collect();
        assert!(numbers.windows(2).all(|pair| pair[1] == pair[0] + 1), "numbers have gaps");
    }
}
