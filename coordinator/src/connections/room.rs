//! Limits on the number of connections.

/// Maximum strangers, for any number of descriptors.
const MOST_STRANGERS: usize = 512;
/// Minimum descriptors for files: the store, blobs, logs.
const FOR_FILES: u64 = 32;

/// Limits on the number of connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// In all.
    pub connections: usize,
    /// Of them without a token: at most half, so that callers with one find room.
    pub strangers: usize,
}

impl Room {
    /// The limits of a process that may open this many descriptors: a quarter of them, and at least 32, are
    /// for files.
    pub fn of_descriptors(limit: Option<u64>) -> Self {
        let limit = limit.unwrap_or(u64::MAX);
        let connections = limit.saturating_sub(FOR_FILES.max(limit / 4)).max(4);
        let connections = usize::try_from(connections).unwrap_or(usize::MAX);
        Self { connections, strangers: (connections / 2).min(MOST_STRANGERS) }
    }

    /// The limits of this process, after raising its descriptor limit.
    pub fn of_this_process() -> Self {
        let limit = raise_limit();
        tracing::debug!(descriptors = ?limit, "limit of open descriptors");
        Self::of_descriptors(limit)
    }
}

/// Raises the soft limit of open descriptors to the hard one, because systemd and shells start with 1024.
/// Returns the new limit; `None` if there is none.
#[cfg(unix)]
fn raise_limit() -> Option<u64> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    match setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
        Ok(()) => maximum,
        Err(_) => current,
    }
}

#[cfg(not(unix))]
fn raise_limit() -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_have_room_and_strangers_leave_half_of_the_rest() {
        let of = |limit| {
            let Room { connections, strangers } = Room::of_descriptors(limit);
            (connections, strangers)
        };
        assert_eq!(of(Some(64)), (32, 16));
        assert_eq!(of(Some(1024)), (768, 384));
        assert_eq!(of(Some(65_536)), (49_152, 512));
        assert_eq!(of(Some(10)), (4, 2));
        assert_eq!(of(None).1, 512);
    }
}
