//! The gRPC services. Handlers only decode, dispatch and encode: rules are in [`crate::schedule`].

mod admin;
mod backup;
mod datasets;
pub mod encode;
mod inspection;
mod jobs;
pub mod links;
pub mod logs;
mod manifests;
mod results;
mod session;
mod tenants;
mod uploads;
mod watch;
mod workers;

use tokio::sync::{Semaphore, SemaphorePermit};

pub use admin::Admin;
pub use jobs::Jobs;
pub use uploads::Uploads;
pub use workers::{Workers, release_disowned};

/// Lists and manifests of clients that take more memory than this count as long. Most have a few hundred
/// kilobytes.
const LONG_BYTES: u64 = 4 << 20;
/// Memory for long ones (up to 256 MiB each) and for short ones, of all callers together, KiB. They are
/// separate, so that a short one never waits for a long one.
const LONG_KIB: u32 = 288 << 10;
const SHORT_KIB: u32 = 64 << 10;
static LONG_ONES: Semaphore = Semaphore::const_new(LONG_KIB as usize);
static SHORT_ONES: Semaphore = Semaphore::const_new(SHORT_KIB as usize);

/// A memory permit; returned when dropped.
pub struct Turn(#[expect(dead_code, reason = "held for its end")] Option<SemaphorePermit<'static>>);

/// Waits for a permit for this many bytes, held as long as the value. A value larger than the pool takes the
/// whole pool.
async fn turn_to_read(bytes: u64) -> Turn {
    let (ones, most) = if bytes <= LONG_BYTES { (&SHORT_ONES, SHORT_KIB) } else { (&LONG_ONES, LONG_KIB) };
    let kib = u32::try_from(bytes.div_ceil(1024)).unwrap_or(most).clamp(1, most);
    // They are never closed.
    Turn(ones.acquire_many(kib).await.ok())
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    #[test]
    fn long_lists_share_bounded_memory_and_short_ones_do_not_wait() {
        let take = |bytes: u64| turn_to_read(bytes).now_or_never();
        let first = [take(200 << 20), take(80 << 20)];
        assert!(first.iter().all(Option::is_some), "there is room for both");
        assert!(take(20 << 20).is_none(), "a third one waits");
        assert!(take(LONG_BYTES).is_some(), "a short one does not wait");
        drop(first);
        let longest = take(1 << 40);
        assert!(longest.is_some() && take(LONG_BYTES + 1).is_none(), "the longest has all there is");
    }
}
