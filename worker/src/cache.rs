//! Blob cache on this worker's disk. Every use checks a file against its digest.
//!
//! Several workers on one machine may share the directory: files appear by rename and never change. The
//! modification time records the last use. A worker refreshes it on its task's files regularly, and no worker
//! removes a file that was used within the last hour.
//!
//! The GPUs of one worker share the cache itself (`BlobCache::for_another`). Each pins its own files; none
//! removes a file that another has pinned, whatever its time; a file that several need is fetched once.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, SystemTime};

use fathom_core::scene::BlobRef;
use fathom_observe::threads;

use crate::WorkerError;
use crate::blobs::{BlobClient, hash_file};
use crate::metrics::GpuMetrics;

/// A file used within this time may be needed by another worker that shares the directory.
const KEPT_FOR: Duration = Duration::from_secs(3600);
/// Pause between two calls of [`BlobCache::keep`] while a task runs.
pub const KEEP_EVERY: Duration = Duration::from_secs(600);

/// One GPU's handle to the cache.
pub struct BlobCache {
    shared: Arc<CacheState>,
    /// Blobs pinned by the current task; also in [`CacheState::pinned`].
    pinned: Arc<Mutex<HashSet<PathBuf>>>,
    metrics: Arc<GpuMetrics>,
}

/// State shared by the GPUs of a worker.
struct CacheState {
    dir: PathBuf,
    limit_bytes: u64,
    /// Blobs pinned by the current tasks of all GPUs.
    pinned: Mutex<Vec<Weak<Mutex<HashSet<PathBuf>>>>>,
    /// Held while a file is looked up and fetched, so that others wait for it.
    fetching: Mutex<HashMap<PathBuf, Weak<tokio::sync::Mutex<()>>>>,
}

impl CacheState {
    fn pins(&self) -> Arc<Mutex<HashSet<PathBuf>>> {
        let pins = Arc::default();
        let mut all = lock(&self.pinned);
        all.retain(|pins| pins.strong_count() > 0);
        all.push(Arc::downgrade(&pins));
        pins
    }

    fn is_pinned(&self, path: &Path) -> bool {
        lock(&self.pinned).iter().filter_map(Weak::upgrade).any(|pins| lock(&pins).contains(path))
    }

    fn turn(&self, path: &Path) -> Arc<tokio::sync::Mutex<()>> {
        let mut fetching = lock(&self.fetching);
        fetching.retain(|_, turn| turn.strong_count() > 0);
        let known = fetching.get(path).and_then(Weak::upgrade);
        known.unwrap_or_else(|| {
            let turn = Arc::default();
            fetching.insert(path.to_owned(), Arc::downgrade(&turn));
            turn
        })
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl BlobCache {
    /// Opens or creates the cache.
    pub fn open(dir: &Path, limit_bytes: u64) -> Result<Self, WorkerError> {
        std::fs::create_dir_all(dir).map_err(WorkerError::io("create", dir))?;
        let shared = CacheState {
            dir: dir.to_owned(),
            limit_bytes,
            pinned: Mutex::default(),
            fetching: Mutex::default(),
        };
        let pinned = shared.pins();
        Ok(Self { shared: Arc::new(shared), pinned, metrics: Arc::default() })
    }

    /// The same cache for another GPU, with its own pinned files. Hits and fetches are counted in `metrics`.
    pub(crate) fn for_another(&self, metrics: Arc<GpuMetrics>) -> Self {
        Self { shared: Arc::clone(&self.shared), pinned: self.shared.pins(), metrics }
    }

    /// The file of a blob, fetched if missing. It stays until [`BlobCache::unpin_all`].
    pub async fn fetch(&self, client: &BlobClient, blob: &BlobRef) -> Result<PathBuf, WorkerError> {
        let is_digest = blob.digest.len() == 64 && blob.digest.bytes().all(|b| b.is_ascii_hexdigit());
        if !is_digest {
            return Err(WorkerError::Protocol(format!("{:?} for a digest", blob.digest)));
        }
        let folder = self.shared.dir.join(&blob.digest[..2]);
        let path = folder.join(&blob.digest);
        lock(&self.pinned).insert(path.clone());
        let turn = self.shared.turn(&path);
        let _turn = turn.lock().await;
        let known = path.clone();
        // Mark it as used before reading, so that other workers do not remove it.
        let look = move || {
            mark_used(&known);
            hash_file(&known).ok()
        };
        let found = threads::blocking(look).await.map_err(|e| WorkerError::Thread(e.to_string()))?;
        match found {
            Some(found) if found == *blob => {
                self.metrics.hit();
                return Ok(path);
            }
            Some(_) => {
                tracing::warn!(digest = %blob.digest, "a cached blob is damaged; fetching it again")
            }
            None => {}
        }
        std::fs::create_dir_all(&folder).map_err(WorkerError::io("create", &folder))?;
        // One file per call: other users of the directory, even in this process, must not append to the same
        // file.
        let prefix = format!("{}.", blob.digest);
        let mut part = tempfile::Builder::new();
        part.prefix(&prefix).suffix(".part");
        // Other users' workers may share the directory, as far as the umask lets them.
        #[cfg(unix)]
        part.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let part = part.tempfile_in(&folder).map_err(WorkerError::io("write to", &folder))?.into_temp_path();
        client.download_part(blob, &part).await?;
        self.metrics.miss(blob.bytes);
        part.persist(&path).map_err(|failed| WorkerError::io("rename to", &path)(failed.error))?;
        Ok(path)
    }

    /// Marks the current task's files as used, for all workers that share the directory.
    pub fn keep(&self) {
        lock(&self.pinned).iter().for_each(|path| mark_used(path));
    }

    /// Unpins all files. Then removes the least recently used ones until the cache is below its limit, or all
    /// remaining files were used within the last hour.
    pub fn unpin_all(&self) -> Result<(), WorkerError> {
        lock(&self.pinned).clear();
        let mut files = self.files()?;
        let mut total: u64 = files.iter().map(|file| file.bytes).sum();
        let now = SystemTime::now();
        files.retain(|file| now.duration_since(file.used).is_ok_and(|age| age > KEPT_FOR));
        files.sort_by(|a, b| (a.used, &a.path).cmp(&(b.used, &b.path)));
        for file in files {
            if total <= self.shared.limit_bytes {
                break;
            }
            // A task that needs it from here on waits for the lock, and then fetches it again.
            let turn = self.shared.turn(&file.path);
            let Ok(_turn) = turn.try_lock() else { continue };
            if self.shared.is_pinned(&file.path) {
                continue;
            }
            // Another worker may have marked it since the folder was read.
            let used = std::fs::metadata(&file.path).and_then(|meta| meta.modified());
            if used.is_ok_and(|used| used != file.used) {
                continue;
            }
            match std::fs::remove_file(&file.path) {
                Ok(()) => {}
                // Another worker has removed it already.
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
                Err(error) => return Err(WorkerError::io("remove", &file.path)(error)),
            }
            total -= file.bytes;
        }
        Ok(())
    }

    fn files(&self) -> Result<Vec<CachedFile>, WorkerError> {
        let mut files = Vec::new();
        let entries = |path: &Path| std::fs::read_dir(path).map_err(WorkerError::io("read", path));
        for folder in entries(&self.shared.dir)? {
            let folder = folder.map_err(WorkerError::io("read", &self.shared.dir))?.path();
            if !folder.is_dir() {
                continue;
            }
            for entry in entries(&folder)? {
                let entry = entry.map_err(WorkerError::io("read", &folder))?;
                // Skip files that another worker has just removed.
                let Ok(meta) = entry.metadata() else { continue };
                let used = meta.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                files.push(CachedFile { path: entry.path(), bytes: meta.len(), used });
            }
        }
        Ok(files)
    }
}

/// Sets a file's time of last use.
fn mark_used(path: &Path) {
    let marked = std::fs::File::options()
        .append(true)
        .open(path)
        .and_then(|file| file.set_modified(SystemTime::now()));
    match marked {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            tracing::warn!(path = %path.display(), %error, "cannot mark a cached file as used; others may remove it");
        }
        _ => {}
    }
}

struct CachedFile {
    path: PathBuf,
    bytes: u64,
    used: SystemTime,
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: u64 = 3600;

    /// A cache of 250 bytes with files of 100 bytes, last used the given number of seconds ago.
    fn cache_of(files: &[(&str, u64)]) -> (tempfile::TempDir, BlobCache) {
        let dir = tempfile::tempdir().unwrap();
        let cache = BlobCache::open(dir.path(), 250).unwrap();
        std::fs::create_dir(dir.path().join("aa")).unwrap();
        for (name, age) in files {
            let file = std::fs::File::create(dir.path().join("aa").join(name)).unwrap();
            file.set_len(100).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(*age)).unwrap();
        }
        (dir, cache)
    }

    fn left(cache: &BlobCache) -> Vec<String> {
        let name = |file: CachedFile| file.path.file_name().unwrap().to_str().unwrap().to_owned();
        let mut names: Vec<_> = cache.files().unwrap().into_iter().map(name).collect();
        names.sort();
        names
    }

    #[test]
    fn the_cache_keeps_under_its_limit_and_removes_the_oldest_first() {
        let (_dir, cache) = cache_of(&[("oldest", 4 * HOUR), ("older", 3 * HOUR), ("newest", 2 * HOUR)]);
        cache.unpin_all().unwrap();
        assert_eq!(left(&cache), ["newest", "older"]);
    }

    #[test]
    fn files_used_within_the_last_hour_stay_above_the_limit() {
        let (_dir, cache) = cache_of(&[("a", 60), ("b", 60), ("c", HOUR - 60), ("old", 2 * HOUR)]);
        cache.unpin_all().unwrap();
        assert_eq!(left(&cache), ["a", "b", "c"]);
    }

    #[test]
    fn files_pinned_by_another_gpu_stay_whatever_their_age() {
        let (dir, cache) = cache_of(&[("a", 9 * HOUR), ("b", 8 * HOUR), ("c", 7 * HOUR), ("d", 6 * HOUR)]);
        let pin =
            |cache: &BlobCache, name: &str| lock(&cache.pinned).insert(dir.path().join("aa").join(name));
        let (one, other) = (cache.for_another(Arc::default()), cache.for_another(Arc::default()));
        pin(&one, "a");
        pin(&other, "b");
        pin(&other, "d");
        one.unpin_all().unwrap();
        assert_eq!(left(&cache), ["b", "d"], "of four files of 100 bytes two have room");
        // A finished GPU pins nothing.
        std::fs::File::create(dir.path().join("aa/e")).unwrap().set_len(200).unwrap();
        drop(other);
        one.unpin_all().unwrap();
        assert_eq!(left(&cache), ["e"]);
    }

    #[test]
    fn files_of_a_long_task_are_not_removed_by_another_worker() {
        let files = [("a", 9 * HOUR), ("b", 9 * HOUR), ("c", 9 * HOUR), ("d", 2 * HOUR)];
        let (dir, cache) = cache_of(&files);
        let task = ["a", "b", "c"].map(|name| dir.path().join("aa").join(name));
        lock(&cache.pinned).extend(task);
        cache.keep();
        let other = BlobCache::open(dir.path(), 250).unwrap();
        other.unpin_all().unwrap();
        assert_eq!(left(&cache), ["a", "b", "c"]);
    }
}
