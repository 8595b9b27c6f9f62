//! Blobs in a bucket: S3, Google Cloud Storage or Azure, by the keys of a folder on the disk.
//!
//! Objects cannot be appended to, renamed or touched. So an upload consists of segments (`segments.rs`), and
//! the last use of a blob is the later of two times: the bucket's own, and one in memory. Ages are hours, so
//! the bucket's clock is good enough. A client that learned of a blob before the coordinator restarted may
//! find it gone, and is asked to upload it again.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt};
use object_store::path::Path as ObjectPath;
use object_store::{MultipartUpload, ObjectMeta, ObjectStore, ObjectStoreExt};

use super::disk::spawn_io;
use super::garbage::Removed;
use super::shared::SharedRows;
use super::{ObjectError, check_digest, object_path};
use crate::clock::Clock;

/// Bytes of a part of an upload; S3 asks for at least 5 MiB.
pub(super) const PART_BYTES: usize = 8 << 20;
/// Most parts of one upload; S3 allows 10,000.
const MOST_PARTS: u64 = 9000;
/// Whoever checks an object younger than this is not remembered: it stays for most of a day anyway.
const YOUNG: Duration = Duration::from_secs(3600);
/// Objects that are removed while checks wait.
const REMOVED_AT_ONCE: usize = 100;
/// Deletions at a time.
const DELETIONS_AT_ONCE: usize = 16;

/// Longest damaged blob that is kept for an analysis.
const MOST_KEPT_BYTES: u64 = 1 << 30;

/// The bytes of an object.
type PieceStream = futures::stream::BoxStream<'static, Result<Bytes, ObjectError>>;

/// The blobs of one tenant in a bucket.
pub(super) struct Bucket {
    store: Arc<dyn ObjectStore>,
    /// Whether it is read-only.
    only_looks: bool,
    clock: Clock,
    /// Local folder for files that become blobs.
    pub staging: PathBuf,
    /// When blobs were last checked; neither missing nor young ones, whose number no caller may decide.
    asked: Mutex<HashMap<String, SystemTime>>,
    /// Read-locked while a blob is checked, write-locked while blobs are removed. Whoever publishes a blob
    /// has found it missing before, and gives it a new time, so garbage collection does not take it for old.
    checking: tokio::sync::RwLock<()>,
    /// Held during the whole check of a possibly damaged blob: a new upload may replace it.
    looking: tokio::sync::Mutex<()>,
}

/// What a bucket holds.
#[derive(Debug, Default)]
pub(super) struct Content {
    /// Bytes of all blobs.
    pub whole_bytes: u64,
    /// Bytes of incomplete uploads, by digest.
    pub uploads: BTreeMap<String, u64>,
}

impl Bucket {
    /// The objects of `store`. Files that become blobs are written to `staging` first, which is created.
    pub fn open(store: Arc<dyn ObjectStore>, staging: PathBuf, clock: Clock) -> Result<Self, ObjectError> {
        std::fs::create_dir_all(&staging).map_err(super::io_error("create", &staging))?;
        Ok(Self { only_looks: false, ..Self::existing(store, staging, clock) })
    }

    /// The same, read-only.
    pub fn existing(store: Arc<dyn ObjectStore>, staging: PathBuf, clock: Clock) -> Self {
        Self {
            store,
            only_looks: true,
            clock,
            staging,
            asked: Mutex::default(),
            checking: Default::default(),
            looking: Default::default(),
        }
    }

    pub fn store(&self) -> &Arc<dyn ObjectStore> {
        &self.store
    }

    /// Now, by the clock of ages.
    pub fn now(&self) -> SystemTime {
        self.clock.system_time()
    }

    /// Lists all of it.
    pub async fn content(&self) -> Result<Content, ObjectError> {
        let mut content = Content::default();
        let mut blobs = self.list("cas");
        while let Some(blob) = blobs.try_next().await? {
            content.whole_bytes += blob.size;
        }
        let mut segments = self.list("uploads");
        while let Some(segment) = segments.try_next().await? {
            if let Some(digest) = digest_of_segment(&segment.location) {
                *content.uploads.entry(digest).or_default() += segment.size;
            }
        }
        Ok(content)
    }

    /// Objects under a prefix.
    pub fn list(&self, prefix: &str) -> futures::stream::BoxStream<'static, Result<ObjectMeta, ObjectError>> {
        self.store.list(Some(&ObjectPath::from(prefix))).map_err(ObjectError::Unavailable).boxed()
    }

    /// The length of a blob, which is last used now; `None` if there is none.
    pub async fn ask(&self, digest: &str) -> Result<Option<u64>, ObjectError> {
        let path = object_path(digest)?;
        let _nothing_is_removed = self.checking.read().await;
        let Some(found) = self.head(&path).await? else { return Ok(None) };
        let now = self.clock.system_time();
        let is_young = now.duration_since(found.last_modified.into()).is_ok_and(|age| age < YOUNG);
        if !self.only_looks && !is_young {
            self.asked.lock().unwrap_or_else(PoisonError::into_inner).insert(digest.to_owned(), now);
        }
        Ok(Some(found.size))
    }

    /// What is known of an object; `None` if there is none.
    pub async fn head(&self, path: &ObjectPath) -> Result<Option<ObjectMeta>, ObjectError> {
        match self.store.head(path).await {
            Ok(meta) => Ok(Some(meta)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(ObjectError::Unavailable(error)),
        }
    }

    /// Writes a blob.
    pub async fn put(&self, digest: &str, bytes: Bytes) -> Result<(), ObjectError> {
        let path = object_path(digest)?;
        if bytes.len() <= PART_BYTES {
            self.store.put(&path, bytes.into()).await.map_err(ObjectError::Unavailable)?;
            return Ok(());
        }
        let mut parts = Parts::begin(&self.store, &path).await?;
        let size = part_bytes(bytes.len() as u64) as usize;
        for at in (0..bytes.len()).step_by(size) {
            parts.put(vec![bytes.slice(at..bytes.len().min(at + size))]).await?;
        }
        parts.complete().await
    }

    /// Uploads a file as a blob, once its bytes have the blob's digest.
    pub async fn put_file(&self, file: &Path, digest: &str) -> Result<(), ObjectError> {
        let path = object_path(digest)?;
        let owned = file.to_owned();
        let opened = spawn_io(file, move || {
            let opened = std::fs::File::open(owned)?;
            let bytes = opened.metadata()?.len();
            Ok((opened, bytes))
        });
        let (mut opened, bytes) = opened.await?;
        let mut hasher = blake3::Hasher::new();
        let mut parts = Parts::begin(&self.store, &path).await?;
        let size = part_bytes(bytes);
        loop {
            let read = spawn_io(file, move || {
                let mut part = Vec::with_capacity(size as usize);
                (&mut opened).take(size).read_to_end(&mut part)?;
                Ok((opened, part))
            });
            let (still_open, part) = read.await?;
            if part.is_empty() {
                break;
            }
            opened = still_open;
            hasher.update(&part);
            parts.put(vec![part.into()]).await?;
        }
        if hasher.finalize().to_hex().as_str() != digest {
            parts.abort().await;
            return Err(ObjectError::Damaged(digest.to_owned()));
        }
        parts.complete().await
    }

    /// Makes the bytes of segments a blob. The bucket copies a single segment itself. Several are copied
    /// through the coordinator, and hashed again.
    pub async fn publish(&self, digest: &str, bytes: u64, from: &[ObjectPath]) -> Result<(), ObjectError> {
        let path = object_path(digest)?;
        if let [one] = from {
            return self.store.copy(one, &path).await.map_err(ObjectError::Unavailable);
        }
        let (size, mut part) = (part_bytes(bytes) as usize, Pieces::default());
        let mut hasher = blake3::Hasher::new();
        let mut parts = Parts::begin(&self.store, &path).await?;
        for segment in from {
            let mut pieces = self.pieces(segment).await?;
            while let Some(piece) = pieces.try_next().await? {
                hasher.update(&piece);
                part.push(piece);
                while let Some(full) = part.take_part(size) {
                    parts.put(full).await?;
                }
            }
        }
        if part.bytes > 0 {
            parts.put(part.take()).await?;
        }
        if hasher.finalize().to_hex().as_str() != digest {
            parts.abort().await;
            return Err(ObjectError::Damaged(digest.to_owned()));
        }
        parts.complete().await
    }

    /// All bytes of a blob, of which there are `bytes`.
    pub async fn read(&self, digest: &str, bytes: u64) -> Result<Bytes, ObjectError> {
        let path = object_path(digest)?;
        let mut pieces = self.pieces(&path).await?;
        let mut whole = match pieces.try_next().await? {
            Some(piece) if piece.len() as u64 == bytes => return Ok(piece),
            Some(piece) => Vec::from(piece),
            None => return Ok(Bytes::new()),
        };
        while let Some(piece) = pieces.try_next().await? {
            whole.extend_from_slice(&piece);
        }
        Ok(whole.into())
    }

    /// The bytes of an object, piece by piece.
    pub async fn pieces(&self, path: &ObjectPath) -> Result<PieceStream, ObjectError> {
        let meta = self.head(path).await?.ok_or_else(|| ObjectError::NotFound(path.to_string()))?;
        Ok(self.pieces_of(path, meta.size))
    }

    fn pieces_of(&self, path: &ObjectPath, bytes: u64) -> PieceStream {
        let (store, path) = (Arc::clone(&self.store), path.clone());
        let starts = (0..bytes).step_by(PART_BYTES);
        let ranges = futures::stream::iter(starts.map(move |at| at..bytes.min(at + PART_BYTES as u64)));
        let pieces = ranges.map(move |range| {
            let (store, path) = (Arc::clone(&store), path.clone());
            async move { store.get_range(&path, range).await.map_err(ObjectError::Unavailable) }
        });
        // The next one travels while this one is used.
        pieces.buffered(2).boxed()
    }

    /// Moves a blob aside if its bytes have another digest; returns its length, or `None` if they have not.
    pub async fn set_aside_if_damaged(
        &self,
        digest: &str,
        shared: Option<&SharedRows>,
    ) -> Result<Option<u64>, ObjectError> {
        let path = object_path(digest)?;
        let _alone = self.looking.lock().await;
        let Some(before) = self.head(&path).await? else { return Ok(None) };
        let mut hasher = blake3::Hasher::new();
        let mut pieces = self.pieces_of(&path, before.size);
        while let Some(piece) = pieces.try_next().await? {
            hasher.update(&piece);
        }
        let found = hasher.finalize().to_hex();
        if found.as_str() == digest {
            return Ok(None);
        }
        if self.only_looks {
            return Ok(Some(0));
        }
        // Buckets copy no object of more than 5 GB, and a long copy takes longer than a request may.
        let aside = ObjectPath::from_iter(["damaged", digest]);
        if before.size <= MOST_KEPT_BYTES {
            self.store.copy(&path, &aside).await.map_err(ObjectError::Unavailable)?;
            tracing::error!(%digest, %found, %aside, "the bucket has changed a blob; check it");
        } else {
            tracing::error!(%digest, %found, bytes = before.size, "the bucket has changed a blob, which is too long to be kept");
        }
        // It may have been sent again meanwhile.
        let is_same = |now: &ObjectMeta| {
            (now.last_modified, &now.e_tag, now.size) == (before.last_modified, &before.e_tag, before.size)
        };
        let remove = async {
            if !self.head(&path).await?.is_some_and(|now| is_same(&now)) {
                return Ok(false);
            }
            self.delete(vec![path.clone()], |_| ()).await?;
            Ok(true)
        };
        let is_removed = match shared {
            Some(shared) => shared.withdraw(digest, remove).await?,
            None => {
                let _nobody_asks = self.checking.write().await;
                remove.await?
            }
        };
        Ok(is_removed.then_some(before.size))
    }

    /// Removes objects that were last used or written before `before`, except the blobs `used` and the
    /// uploads that a stream writes. Calls `gone` for each.
    pub async fn remove_unused(
        &self,
        before: SystemTime,
        used: &HashSet<String>,
        is_written: impl Fn(&str) -> bool,
        gone: impl Fn(Gone<'_>),
    ) -> Result<Removed, ObjectError> {
        let removed = Mutex::new(Removed::default());
        let counted = |of: Gone<'_>| {
            let mut removed = removed.lock().unwrap_or_else(PoisonError::into_inner);
            match &of {
                Gone::Blob { bytes } | Gone::Damaged { bytes } => {
                    removed.blobs += 1;
                    removed.bytes += bytes;
                }
                Gone::Upload { bytes, .. } => {
                    removed.uploads += 1;
                    removed.bytes += bytes;
                }
            }
            gone(of);
        };
        let is_old = |meta: &ObjectMeta| SystemTime::from(meta.last_modified) < before;
        self.remove_unfinished().await?;
        for prefix in ["cas", "damaged"] {
            let old = self.list(prefix).try_filter(|meta| std::future::ready(is_old(meta)));
            let mut batches = old.try_chunks(REMOVED_AT_ONCE);
            while let Some(batch) = batches.next().await {
                let mut batch = batch.map_err(|failed| failed.1)?;
                let _nobody_asks = self.checking.write().await;
                if prefix == "cas" {
                    batch.retain(|meta| {
                        meta.location.filename().is_some_and(|digest| {
                            check_digest(digest).is_ok()
                                && !used.contains(digest)
                                && !self.is_asked_since(digest, before)
                        })
                    });
                }
                let sizes: HashMap<ObjectPath, u64> =
                    batch.into_iter().map(|meta| (meta.location, meta.size)).collect();
                let report = |path: &ObjectPath| {
                    let bytes = sizes.get(path).copied().unwrap_or(0);
                    counted(if prefix == "cas" { Gone::Blob { bytes } } else { Gone::Damaged { bytes } });
                };
                self.delete(sizes.keys().cloned().collect(), report).await?;
            }
        }
        // An upload is as young as its youngest segment.
        for (digest, segments) in self.uploads().await? {
            if !segments.iter().all(is_old) || is_written(&digest) {
                continue;
            }
            let bytes = segments.iter().map(|segment| segment.size).sum();
            self.delete(segments.into_iter().map(|segment| segment.location).collect(), |_| ()).await?;
            counted(Gone::Upload { digest: &digest, bytes });
        }
        let mut asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        asked.retain(|_, when| *when >= before);
        drop(asked);
        Ok(removed.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// Removes what clients sent here directly, and no coordinator has removed in time.
    pub async fn remove_unfinished(&self) -> Result<(), ObjectError> {
        let before = self.now().checked_sub(super::direct::UNFINISHED_FOR).unwrap_or(SystemTime::UNIX_EPOCH);
        let is_old = |meta: &ObjectMeta| SystemTime::from(meta.last_modified) < before;
        let old = self.list("direct").try_filter(|meta| std::future::ready(is_old(meta)));
        let mut batches = old.try_chunks(REMOVED_AT_ONCE);
        while let Some(batch) = batches.next().await {
            let batch = batch.map_err(|failed| failed.1)?;
            self.delete(batch.into_iter().map(|meta| meta.location).collect(), |_| ()).await?;
        }
        Ok(())
    }

    fn is_asked_since(&self, digest: &str, before: SystemTime) -> bool {
        let asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        asked.get(digest).is_some_and(|when| *when >= before)
    }

    /// Number of blobs whose last check is in memory.
    #[cfg(test)]
    pub fn remembered(&self) -> usize {
        self.asked.lock().unwrap_or_else(PoisonError::into_inner).len()
    }

    /// Deletes objects, and calls `gone` for each that was deleted. Those that do not exist count as deleted.
    pub async fn delete(
        &self,
        paths: Vec<ObjectPath>,
        gone: impl Fn(&ObjectPath),
    ) -> Result<(), ObjectError> {
        let mut deletions = futures::stream::iter(paths)
            .map(|path| async move {
                match self.store.delete(&path).await {
                    Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(path),
                    Err(error) => Err(ObjectError::Unavailable(error)),
                }
            })
            .buffer_unordered(DELETIONS_AT_ONCE);
        let mut failed = Ok(());
        while let Some(deleted) = deletions.next().await {
            match deleted {
                Ok(path) => gone(&path),
                Err(error) => failed = Err(error),
            }
        }
        failed
    }
}

/// What garbage collection has removed.
pub(super) enum Gone<'a> {
    /// A blob.
    Blob {
        /// Its length.
        bytes: u64,
    },
    /// A damaged blob that was set aside.
    Damaged {
        /// Its length.
        bytes: u64,
    },
    /// An upload.
    Upload {
        /// Of this blob.
        digest: &'a str,
        /// Its length.
        bytes: u64,
    },
}

/// The digest of the upload that a segment belongs to.
pub(super) fn digest_of_segment(path: &ObjectPath) -> Option<String> {
    let mut parts = path.parts();
    parts.next_back()?;
    let digest = parts.next_back()?.as_ref().to_owned();
    check_digest(&digest).is_ok().then_some(digest)
}

fn part_bytes(total: u64) -> u64 {
    total.div_ceil(MOST_PARTS).max(PART_BYTES as u64)
}

/// Received bytes that are not written yet.
#[derive(Default)]
pub(super) struct Pieces {
    pieces: VecDeque<Bytes>,
    pub bytes: usize,
}

impl Pieces {
    pub fn push(&mut self, piece: Bytes) {
        self.bytes += piece.len();
        self.pieces.push_back(piece);
    }

    /// A part of exactly `size` bytes, if there are as many: R2 wants parts of one size.
    pub fn take_part(&mut self, size: usize) -> Option<Vec<Bytes>> {
        if self.bytes < size {
            return None;
        }
        let (mut part, mut missing) = (Vec::new(), size);
        while let Some(mut piece) = self.pieces.pop_front() {
            if piece.len() > missing {
                self.pieces.push_front(piece.split_off(missing));
            }
            missing -= piece.len();
            part.push(piece);
            if missing == 0 {
                break;
            }
        }
        self.bytes -= size;
        Some(part)
    }

    /// All that is left.
    pub fn take(&mut self) -> Vec<Bytes> {
        self.bytes = 0;
        std::mem::take(&mut self.pieces).into()
    }
}

/// An upload in parts. The object is visible when it is complete.
pub(super) struct Parts {
    upload: Box<dyn MultipartUpload>,
    store: Arc<dyn ObjectStore>,
    path: ObjectPath,
    bytes: u64,
}

impl Parts {
    pub async fn begin(store: &Arc<dyn ObjectStore>, path: &ObjectPath) -> Result<Self, ObjectError> {
        let upload = store.put_multipart(path).await.map_err(ObjectError::Unavailable)?;
        Ok(Self { upload, store: Arc::clone(store), path: path.clone(), bytes: 0 })
    }

    pub async fn put(&mut self, part: Vec<Bytes>) -> Result<(), ObjectError> {
        self.bytes += part.iter().map(|piece| piece.len() as u64).sum::<u64>();
        let put = self.upload.put_part(part.into_iter().collect()).await.map_err(ObjectError::Unavailable);
        if put.is_err() {
            self.abort().await;
        }
        put
    }

    pub async fn complete(mut self) -> Result<(), ObjectError> {
        let Err(error) = self.upload.complete().await else { return Ok(()) };
        // If an answer is lost, the request is repeated, and then there is no such upload any more. The key
        // belongs to these bytes alone, so the object tells.
        match self.store.head(&self.path).await {
            Ok(meta) if meta.size == self.bytes => Ok(()),
            _ => Err(ObjectError::Unavailable(error)),
        }
    }

    /// Gives it up. If that fails, the bucket's rules for incomplete uploads remove its parts.
    pub async fn abort(&mut self) {
        if let Err(error) = self.upload.abort().await {
            tracing::warn!(%error, "the parts of an upload remain in the bucket");
        }
    }
}
