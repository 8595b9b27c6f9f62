//! Blobs on this worker's disk. A file is checked against its digest whenever it is taken out.
//!
//! Several workers of one machine may share the directory: files appear by rename and never change, and a file
//! that another worker removed is fetched again.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use fathom_core::scene::BlobRef;

use crate::WorkerError;
use crate::blobs::{BlobClient, hash_file};

/// The cache.
pub struct BlobCache {
    dir: PathBuf,
    limit_bytes: u64,
    /// What the task at hand needs; never removed here.
    pinned: Mutex<HashSet<String>>,
}

impl BlobCache {
    /// Opens or creates the cache.
    pub fn open(dir: &Path, limit_bytes: u64) -> Result<Self, WorkerError> {
        std::fs::create_dir_all(dir).map_err(WorkerError::io("create", dir))?;
        Ok(Self { dir: dir.to_owned(), limit_bytes, pinned: Mutex::default() })
    }

    /// The file of a blob, fetched when it is not there. It stays until [`BlobCache::unpin_all`].
    pub async fn fetch(&self, client: &BlobClient, blob: &BlobRef) -> Result<PathBuf, WorkerError> {
        let is_digest = blob.digest.len() == 64 && blob.digest.bytes().all(|b| b.is_ascii_hexdigit());
        if !is_digest {
            return Err(WorkerError::Protocol(format!("{:?} for a digest", blob.digest)));
        }
        self.pinned.lock().unwrap_or_else(PoisonError::into_inner).insert(blob.digest.clone());
        let folder = self.dir.join(&blob.digest[..2]);
        let path = folder.join(&blob.digest);
        let known = path.clone();
        let found = tokio::task::spawn_blocking(move || hash_file(&known).ok())
            .await
            .map_err(|e| WorkerError::Thread(e.to_string()))?;
        match found {
            Some(found) if found == *blob => return Ok(path),
            Some(_) => {
                tracing::warn!(digest = %blob.digest, "the cache holds a damaged blob; fetching it again")
            }
            None => {}
        }
        tokio::fs::create_dir_all(&folder).await.map_err(WorkerError::io("create", &folder))?;
        // Two workers that share the cache must not append to one file.
        let temporary = folder.join(format!("{}.{}", blob.digest, std::process::id()));
        client.download(blob, &temporary).await?;
        tokio::fs::rename(&temporary, &path).await.map_err(WorkerError::io("rename to", &path))?;
        Ok(path)
    }

    /// Lets go of everything and removes what was not used for longest until the cache is under its limit.
    pub fn unpin_all(&self) -> Result<(), WorkerError> {
        self.pinned.lock().unwrap_or_else(PoisonError::into_inner).clear();
        let mut files = self.files()?;
        let mut total: u64 = files.iter().map(|file| file.bytes).sum();
        files.sort_by(|a, b| (a.used, &a.path).cmp(&(b.used, &b.path)));
        for file in files {
            if total <= self.limit_bytes {
                break;
            }
            match std::fs::remove_file(&file.path) {
                Ok(()) => {}
                // Another worker was faster.
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
        for folder in entries(&self.dir)? {
            let folder = folder.map_err(WorkerError::io("read", &self.dir))?.path();
            if !folder.is_dir() {
                continue;
            }
            for entry in entries(&folder)? {
                let entry = entry.map_err(WorkerError::io("read", &folder))?;
                // A file that another worker removes meanwhile is none.
                let Ok(meta) = entry.metadata() else { continue };
                let used = meta.accessed().or_else(|_| meta.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
                files.push(CachedFile { path: entry.path(), bytes: meta.len(), used });
            }
        }
        Ok(files)
    }
}

struct CachedFile {
    path: PathBuf,
    bytes: u64,
    used: SystemTime,
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_cache_keeps_under_its_limit_and_removes_the_oldest_first() {
        let dir = tempfile::tempdir().unwrap();
        let cache = BlobCache::open(dir.path(), 250).unwrap();
        std::fs::create_dir(dir.path().join("aa")).unwrap();
        for (age, name) in [(300, "oldest"), (200, "older"), (100, "newest")] {
            let file = std::fs::File::create(dir.path().join("aa").join(name)).unwrap();
            file.set_len(100).unwrap();
            let time = SystemTime::now() - std::time::Duration::from_secs(age);
            file.set_times(std::fs::FileTimes::new().set_accessed(time).set_modified(time)).unwrap();
        }
        cache.unpin_all().unwrap();
        let mut left: Vec<_> = cache.files().unwrap().into_iter().map(|file| file.path).collect();
        left.sort();
        assert_eq!(left, [dir.path().join("aa/newest"), dir.path().join("aa/older")]);
    }
}
