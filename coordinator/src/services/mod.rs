//! What is called over gRPC. Handlers only decode, send and encode: rules are in [`crate::schedule`].

mod admin;
mod backup;
mod datasets;
pub mod encode;
mod jobs;
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

/// Lists and manifests of clients that take more memory than this are long. Most have a few hundred kilobytes.
const LONG_BYTES: u64 = 4 << 20;
/// Memory that the long ones have, of up to 256 MiB each, for all callers together, and memory that the short ones have, KiB: so nobody
/// waits for a long one who has a short one.
const LONG_KIB: u32 = 288 << 10;
const SHORT_KIB: u32 = 64 << 10;
static LONG_ONES: Semaphore = Semaphore::const_new(LONG_KIB as usize);
static SHORT_ONES: Semaphore = Semaphore::const_new(SHORT_KIB as usize);

/// The right to have something in memory; given back when dropped.
pub struct Turn(#[expect(dead_code, reason = "held for its end")] Option<SemaphorePermit<'static>>);

/// The right to read something that takes so many bytes, and to have it for as long as it lives. What takes more than there is has all of
/// it.
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
    fn long_lists_share_a_bounded_memory_for_as_long_as_they_live_and_short_ones_wait_for_none_of_them() {
        let take = |bytes: u64| turn_to_read(bytes).now_or_never();
        let first = [take(200 << 20), take(80 << 20)];
        assert!(first.iter().all(Option::is_some), "there is room for both");
        assert!(take(20 << 20).is_none(), "a third one waits");
        assert!(take(LONG_BYTES).is_some(), "who is short waits for nobody");
        drop(first);
        let longest = take(1 << 40);
        assert!(longest.is_some() && take(LONG_BYTES + 1).is_none(), "the longest has all there is");
    }
}
