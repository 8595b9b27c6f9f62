//! Bytes by content: photographs, plans, checkpoints, models.
//!
//! A blob lives at `cas/aa/<digest>` (`aa`: the first two digits of its BLAKE3) of a folder (`disk.rs`) or of
//! a bucket (`bucket.rs`), and is never changed. An upload grows under `uploads`. When length and digest are
//! as declared, it is made durable and moved to its key. So a blob is visible completely or not at all,
//! whatever crashes. The client's digest is never trusted. A blob that the disk or the bucket has changed is
//! quarantined (`damaged.rs`) when a reader notices.

mod bucket;
mod claim;
mod damaged;
mod declared;
mod direct;
mod disk;
mod error;
mod garbage;
mod place;
mod reader;
mod segments;
mod shared;
mod signing;
mod tenants;
mod writer;

use std::collections::{HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use futures::{StreamExt, TryStreamExt};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::clock::Clock;

use bucket::Bucket;
use claim::{Replaced, WriteClaim};
use direct::Signed;
use disk::{Disk, spawn_io};
pub use error::ObjectError;
pub use garbage::Removed;
pub use place::ObjectsAt;
use shared::SharedRows;
pub use signing::{DIRECT_READ_FROM_BYTES, SignedRequest, Signing};
pub use tenants::TenantBlobs;
pub use writer::BlobWriter;

/// Largest blob that is read into memory, bytes. The largest such blobs are sparse points: 100 million, each
/// seen by four views, or 80 million with the pixels.
const MAX_READ_BYTES: u64 = 4 << 30;
/// Blobs that are checked at a time: a bucket answers each after milliseconds.
const CHECKS_AT_ONCE: usize = 32;

/// The blobs of one tenant.
pub struct BlobStore {
    place: Place,
    /// The rows of a bucket's blobs that several coordinators share; they count instead of the fields below.
    shared: Option<SharedRows>,
    /// Signs requests with which clients use a bucket themselves.
    signing: Option<Signing>,
    /// Uploads that clients may send to the bucket themselves, by name.
    signed: Mutex<HashMap<String, Signed>>,
    finishes: direct::Finishes,
    min_free_bytes: u64,
    /// Clock for the age of files.
    clock: Clock,
    /// Digests that a stream of this process is writing.
    writing: Mutex<HashSet<String>>,
    /// Bytes of all complete blobs.
    whole_bytes: AtomicU64,
    /// Bytes of incomplete ones.
    declared: Mutex<declared::Declared>,
}

/// Where blobs are.
enum Place {
    Disk(Arc<Disk>),
    Bucket(Arc<Bucket>),
}

impl BlobStore {
    /// Opens or creates the store in a directory. Writes are refused when less than `min_free_bytes` is free;
    /// `clock` determines the age of files.
    ///
    /// # Errors
    /// When the directory cannot be created.
    pub fn open(root: &Path, min_free_bytes: u64, clock: Clock) -> Result<Self, ObjectError> {
        let disk = Disk::open(root, clock)?;
        let whole_bytes = garbage::count_bytes(&disk).map_err(io_error("read", root))?;
        let uploads = garbage::uploads(&disk).map_err(io_error("read", root))?;
        let store = Self::over(Place::Disk(Arc::new(disk)), min_free_bytes, clock);
        store.start_with(whole_bytes, uploads);
        Ok(store)
    }

    /// Opens the store in a bucket. Files that become blobs are written to `staging` first. The bucket is
    /// listed once: at every start, or for the shared rows of a new database.
    ///
    /// # Errors
    /// When the bucket cannot be listed, `staging` cannot be created, or the database is not available.
    async fn open_bucket(
        store: Arc<dyn ObjectStore>,
        staging: PathBuf,
        clock: Clock,
        shared: Option<SharedRows>,
        signing: Option<Signing>,
    ) -> Result<Self, ObjectError> {
        let bucket = Arc::new(Bucket::open(store, staging, clock)?);
        let store = Self { shared, signing, ..Self::over(Place::Bucket(Arc::clone(&bucket)), 0, clock) };
        match &store.shared {
            Some(shared) => shared.fill(&bucket).await?,
            None => {
                let content = bucket.content().await?;
                store.start_with(content.whole_bytes, content.uploads);
            }
        }
        Ok(store)
    }

    /// Opens an existing store read-only; nothing is created or quarantined.
    ///
    /// # Errors
    /// When the directory does not exist.
    fn existing(root: &Path) -> Result<Self, ObjectError> {
        Ok(Self::over(Place::Disk(Arc::new(Disk::existing(root)?)), 0, Clock::start()))
    }

    /// The same in a bucket.
    fn existing_bucket(store: Arc<dyn ObjectStore>) -> Self {
        let clock = Clock::start();
        Self::over(Place::Bucket(Arc::new(Bucket::existing(store, PathBuf::new(), clock))), 0, clock)
    }

    fn over(place: Place, min_free_bytes: u64, clock: Clock) -> Self {
        Self {
            place,
            shared: None,
            signing: None,
            signed: Mutex::default(),
            finishes: direct::Finishes::default(),
            min_free_bytes,
            clock,
            writing: Mutex::default(),
            whole_bytes: AtomicU64::new(0),
            declared: Mutex::default(),
        }
    }

    fn start_with(&self, whole_bytes: u64, uploads: impl IntoIterator<Item = (String, u64)>) {
        self.whole_bytes.store(whole_bytes, Ordering::Relaxed);
        for (digest, bytes) in uploads {
            self.declare(&digest, bytes);
        }
    }

    fn objects(&self) -> &dyn ObjectStore {
        match &self.place {
            Place::Disk(disk) => disk.store(),
            Place::Bucket(bucket) => bucket.store().as_ref(),
        }
    }

    /// The error of a failed request.
    fn failed(&self, error: object_store::Error) -> ObjectError {
        match self.place {
            Place::Disk(_) => error.into(),
            Place::Bucket(_) => ObjectError::Unavailable(error),
        }
    }

    fn whole_bytes(&self) -> u64 {
        self.whole_bytes.load(Ordering::Relaxed)
    }

    /// Removes files that an earlier process was writing under [`BlobStore::staging_path`] when it crashed.
    /// Call it when no other process has the store.
    ///
    /// # Errors
    /// When the folder cannot be read or a file cannot be removed.
    pub fn discard_staged(&self) -> Result<(), ObjectError> {
        let folder = self.staging();
        for entry in std::fs::read_dir(&folder).map_err(io_error("read", &folder))? {
            let path = entry.map_err(io_error("read", &folder))?.path();
            let removed = match path.is_dir() {
                true => std::fs::remove_dir_all(&path),
                false => std::fs::remove_file(&path),
            };
            removed.map_err(io_error("remove", &path))?;
            tracing::info!(path = %path.display(), "removed unfinished files of a crashed coordinator");
        }
        Ok(())
    }

    /// Whether the blob is present and complete. From now on garbage collection spares it for a while.
    pub async fn contains(&self, blob: &BlobRef) -> Result<bool, ObjectError> {
        let bytes = match (&self.place, &self.shared) {
            (Place::Disk(disk), _) => disk.ask(&blob.digest).await?,
            (Place::Bucket(bucket), None) => bucket.ask(&blob.digest).await?,
            (Place::Bucket(bucket), Some(shared)) => {
                shared.ask(bucket, &[&blob.digest]).await?.pop().flatten()
            }
        };
        Ok(bytes == Some(blob.bytes))
    }

    /// The indices of those blobs that are not present and complete; the others as by
    /// [`BlobStore::contains`].
    pub async fn missing(&self, blobs: &[BlobRef]) -> Result<Vec<usize>, ObjectError> {
        let mut missing = Vec::new();
        if let Place::Disk(_) = self.place {
            for (index, blob) in blobs.iter().enumerate() {
                if !self.contains(blob).await? {
                    missing.push(index);
                }
            }
            return Ok(missing);
        }
        if let (Place::Bucket(bucket), Some(shared)) = (&self.place, &self.shared) {
            let digests: Vec<&str> = blobs.iter().map(|blob| blob.digest.as_str()).collect();
            let lengths = shared.ask(bucket, &digests).await?.into_iter().zip(blobs);
            let is_there = lengths.map(|(bytes, blob)| bytes == Some(blob.bytes));
            missing.extend(is_there.enumerate().filter(|(_, is_there)| !is_there).map(|(index, _)| index));
            return Ok(missing);
        }
        let checks = futures::stream::iter(0..blobs.len()).map(|index| async move {
            let is_there = self.contains(&blobs[index]).await?;
            Ok::<_, ObjectError>((!is_there).then_some(index))
        });
        let mut checks = checks.buffered(CHECKS_AT_ONCE);
        while let Some(index) = checks.try_next().await? {
            missing.extend(index);
        }
        Ok(missing)
    }

    /// Returns an error that names the blob unless it is present.
    pub async fn require(&self, blob: &BlobRef) -> Result<(), ObjectError> {
        if self.contains(blob).await? { Ok(()) } else { Err(ObjectError::NotFound(blob.digest.clone())) }
    }

    /// Length of a blob.
    pub async fn size(&self, digest: &str) -> Result<u64, ObjectError> {
        match threads::by_library(self.objects().head(&object_path(digest)?)).await {
            Ok(meta) => Ok(meta.size),
            Err(object_store::Error::NotFound { .. }) => Err(self.not_found(digest).await),
            Err(error) => Err(self.failed(error)),
        }
    }

    /// All blobs.
    pub async fn list(&self) -> Result<Vec<BlobRef>, ObjectError> {
        let mut listed = self.objects().list(Some(&ObjectPath::from("cas")));
        let mut blobs = Vec::new();
        while let Some(meta) = listed.try_next().await.map_err(|error| self.failed(error))? {
            let digest = meta.location.filename().unwrap_or_default().to_owned();
            // Other files there are not ours.
            if check_digest(&digest).is_ok() {
                blobs.push(BlobRef { digest, bytes: meta.size });
            }
        }
        blobs.sort_by(|a, b| a.digest.cmp(&b.digest));
        Ok(blobs)
    }

    /// Received bytes of a blob, and whether it is complete and visible.
    pub async fn committed(&self, blob: &BlobRef) -> Result<(u64, bool), ObjectError> {
        check_digest(&blob.digest)?;
        if self.contains(blob).await? {
            return Ok((blob.bytes, true));
        }
        let arrived = match &self.place {
            Place::Disk(disk) => disk.arrived(&blob.digest).await?,
            Place::Bucket(bucket) => segments::arrived_bytes(bucket, &blob.digest).await?,
        };
        Ok((arrived, false))
    }

    /// Bytes that a reader of a whole blob asks for at a time: each request to a bucket takes some 20 ms.
    pub fn read_bytes(&self) -> u64 {
        match self.place {
            Place::Disk(_) => 256 << 10,
            Place::Bucket(_) => 2 << 20,
        }
    }

    /// A range that lies within a blob. Not checked against the digest: the reader does.
    pub async fn range(&self, digest: &str, range: std::ops::Range<u64>) -> Result<Bytes, ObjectError> {
        let wanted = range.end - range.start;
        let read = threads::by_library(self.objects().get_range(&object_path(digest)?, range)).await;
        match read {
            Ok(bytes) if bytes.len() as u64 == wanted => Ok(bytes),
            // It has become shorter.
            Ok(_) => Err(ObjectError::Damaged(digest.to_owned())),
            Err(object_store::Error::NotFound { .. }) => Err(self.not_found(digest).await),
            Err(error) => Err(self.failed(error)),
        }
    }

    /// The error of a blob whose object does not exist. A shared row that says otherwise is removed, so that
    /// the next one that asks sends the blob again.
    async fn not_found(&self, digest: &str) -> ObjectError {
        if let (Place::Bucket(bucket), Some(shared)) = (&self.place, &self.shared)
            && let Err(error) = shared.withdraw_lost(bucket, digest).await
        {
            tracing::warn!(%error, digest, "cannot look for a blob whose object is gone");
        }
        ObjectError::NotFound(digest.to_owned())
    }

    /// A whole blob, checked against its digest; at most 4 GiB of it.
    pub async fn read(&self, blob: &BlobRef) -> Result<Bytes, ObjectError> {
        self.read_at_most(blob, MAX_READ_BYTES).await
    }

    /// As [`BlobStore::read`], for small blobs: a reference may name any blob, also photographs and models of
    /// many GB.
    pub async fn read_at_most(&self, blob: &BlobRef, most: u64) -> Result<Bytes, ObjectError> {
        if blob.bytes > most {
            return Err(ObjectError::TooLarge { digest: blob.digest.clone(), bytes: blob.bytes, most });
        }
        // The length must match the reference, or it is not this blob.
        self.require(blob).await?;
        let bytes = match &self.place {
            Place::Disk(disk) => {
                let path = object_path(&blob.digest)?;
                threads::by_library(async { disk.store().get(&path).await?.bytes().await }).await?
            }
            Place::Bucket(bucket) => match bucket.read(&blob.digest, blob.bytes).await {
                Err(ObjectError::NotFound(_)) => return Err(self.not_found(&blob.digest).await),
                read => read?,
            },
        };
        if blake3::hash(&bytes).to_hex().as_str() == blob.digest {
            return Ok(bytes);
        }
        self.set_aside_if_damaged(&blob.digest).await?;
        Err(ObjectError::Damaged(blob.digest.clone()))
    }

    /// Stores bytes that the coordinator made.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobRef, ObjectError> {
        let digest = blake3::hash(&bytes).to_hex().to_string();
        let blob = BlobRef { digest, bytes: bytes.len() as u64 };
        if self.contains(&blob).await? {
            return Ok(blob);
        }
        loop {
            match &self.place {
                Place::Disk(disk) => disk.put(&blob.digest, bytes.clone()).await?,
                Place::Bucket(bucket) => bucket.put(&blob.digest, bytes.clone()).await?,
            }
            if self.count_whole(&blob).await? {
                return Ok(blob);
            }
        }
    }

    /// The local folder of [`BlobStore::staging_path`].
    fn staging(&self) -> PathBuf {
        match &self.place {
            Place::Disk(disk) => disk.root.join("staging"),
            Place::Bucket(bucket) => bucket.staging.clone(),
        }
    }

    /// A path on the local disk for a file that [`BlobStore::adopt`] takes over.
    pub fn staging_path(&self, name: &str) -> PathBuf {
        self.staging().join(name)
    }

    /// Turns a file under [`BlobStore::staging_path`] into a blob. The coordinator has written, hashed and
    /// synced it; the file is moved, or uploaded and removed.
    pub async fn adopt(&self, name: &str, blob: BlobRef) -> Result<BlobRef, ObjectError> {
        let is_new = !self.contains(&blob).await?;
        let file = self.staging_path(name);
        match &self.place {
            Place::Disk(disk) => {
                disk.adopt(&file, &blob.digest).await?;
                if is_new {
                    self.count_whole(&blob).await?;
                }
            }
            Place::Bucket(bucket) => {
                let mut is_missing = is_new;
                while is_missing {
                    bucket.put_file(&file, &blob.digest).await?;
                    is_missing = !self.count_whole(&blob).await?;
                }
                let owned = file.clone();
                spawn_io(&file, move || std::fs::remove_file(owned)).await?;
            }
        }
        Ok(blob)
    }

    /// Counts a complete blob, which others see from now on. False if garbage collection was removing an
    /// earlier one: then its object has to be written again.
    async fn count_whole(&self, blob: &BlobRef) -> Result<bool, ObjectError> {
        if let (Place::Bucket(bucket), Some(shared)) = (&self.place, &self.shared) {
            return shared.publish(bucket, blob).await;
        }
        self.whole_bytes.fetch_add(blob.bytes, Ordering::Relaxed);
        Ok(true)
    }

    /// Opens the upload of a blob at `offset`, which must equal the received bytes; `None` if the blob is
    /// complete. The total may not exceed `limit_bytes`, if set.
    ///
    /// # Errors
    /// When the offset is wrong, another stream writes this blob, the limit would be exceeded, or the disk is
    /// nearly full.
    pub async fn begin_write(
        self: &Arc<Self>,
        blob: &BlobRef,
        offset: u64,
        limit_bytes: Option<u64>,
    ) -> Result<Option<BlobWriter>, ObjectError> {
        check_digest(&blob.digest)?;
        let claim = WriteClaim::take(self, &blob.digest)?;
        let replaced = self.signed_for(&blob.digest);
        if self.admit(&claim, blob, offset, limit_bytes, replaced).await? {
            BlobWriter::open(claim, blob.clone(), offset).await.map(Some)
        } else {
            Ok(None)
        }
    }

    /// Whether an upload may begin or go on at `offset`; false if the blob is complete. From now on the
    /// upload counts, instead of the one that it replaces.
    async fn admit(
        &self,
        claim: &WriteClaim,
        blob: &BlobRef,
        offset: u64,
        limit_bytes: Option<u64>,
        replaced: Option<Replaced>,
    ) -> Result<bool, ObjectError> {
        let (committed_bytes, complete) = self.committed(blob).await?;
        if complete {
            return Ok(false);
        }
        if offset != committed_bytes {
            return Err(ObjectError::WrongOffset {
                digest: blob.digest.clone(),
                offset_bytes: offset,
                committed_bytes,
            });
        }
        self.check_space(blob.bytes.saturating_sub(offset)).await?;
        self.reserve(claim, blob.bytes, offset, limit_bytes, replaced).await?;
        // From here on, garbage collection of all coordinators spares the blob. A removal that was under way
        // has ended before the answer.
        Ok(self.shared.is_none() || !self.contains(blob).await?)
    }

    /// Counts the upload of a claim with its full length, unless the total would exceed the limit. One that
    /// it replaces no longer counts. If the claim ends, `arrived_bytes` count.
    async fn reserve(
        &self,
        claim: &WriteClaim,
        bytes: u64,
        arrived_bytes: u64,
        limit_bytes: Option<u64>,
        replaced: Option<Replaced>,
    ) -> Result<(), ObjectError> {
        let instead_of = replaced.as_ref().map(|replaced| replaced.upload.as_str());
        match &self.shared {
            Some(shared) => {
                // First, so that the claim gives back what was reserved even if this caller leaves meanwhile.
                claim.count(arrived_bytes);
                claim.replace(replaced.clone());
                let upload = BlobRef { digest: claim.digest.clone(), bytes };
                shared.reserve(&upload, limit_bytes, instead_of).await?;
            }
            None => {
                self.declare_within(&claim.digest, bytes, limit_bytes, instead_of)?;
                claim.count(arrived_bytes);
                claim.replace(replaced);
            }
        }
        Ok(())
    }

    /// Refuses if writing `bytes` more would leave too little free. A bucket is never full.
    pub async fn check_space(&self, bytes: u64) -> Result<(), ObjectError> {
        match &self.place {
            Place::Disk(disk) => check_disk(&disk.root, self.min_free_bytes, bytes).await,
            Place::Bucket(_) => Ok(()),
        }
    }

    /// Refuses if copies of `bytes` of its blobs in the local folder would leave too little free. On a disk,
    /// another name of a blob is enough.
    pub async fn check_staging(&self, bytes: u64) -> Result<(), ObjectError> {
        match &self.place {
            Place::Disk(disk) => check_disk(&disk.root, self.min_free_bytes, 0).await,
            Place::Bucket(bucket) => check_disk(&bucket.staging, self.min_free_bytes, bytes).await,
        }
    }

    /// Whether its blobs are files of a local disk.
    pub fn is_on_disk(&self) -> bool {
        matches!(self.place, Place::Disk(_))
    }

    /// Removes blobs and uploads that were last used or written before `before`, except the blobs `used`.
    ///
    /// # Errors
    /// When blobs cannot be listed or removed; those removed before stay removed.
    pub async fn remove_unused(
        self: &Arc<Self>,
        before: std::time::SystemTime,
        used: HashSet<String>,
    ) -> Result<Removed, ObjectError> {
        match &self.place {
            Place::Disk(disk) => {
                let (store, root) = (Arc::clone(self), disk.root.clone());
                let disk = Arc::clone(disk);
                spawn_io(&root, move || garbage::remove_unused(&store, &disk, before, &used)).await
            }
            Place::Bucket(bucket) => {
                if let Some(shared) = &self.shared {
                    let written = self.writing.lock().unwrap_or_else(PoisonError::into_inner).clone();
                    let written: Vec<String> = written.into_iter().collect();
                    return shared.remove_unused(bucket, before, &used, &written).await;
                }
                let gone = |gone: bucket::Gone<'_>| match gone {
                    bucket::Gone::Blob { bytes } => self.count_removed(bytes),
                    bucket::Gone::Damaged { .. } => {}
                    bucket::Gone::Upload { digest, .. } => self.declare(digest, 0),
                };
                bucket.remove_unused(before, &used, |digest| self.is_written(digest), gone).await
            }
        }
    }

    /// A complete blob of `bytes` is gone. Two that notice it at once must not make the sum negative.
    fn count_removed(&self, bytes: u64) {
        let less = |whole: u64| Some(whole.saturating_sub(bytes));
        let _ = self.whole_bytes.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less);
    }

    /// Whether a stream writes the blob.
    fn is_written(&self, digest: &str) -> bool {
        self.writing.lock().unwrap_or_else(PoisonError::into_inner).contains(digest)
    }
}

/// Refuses if writing `bytes` more to the disk of `path` would leave less than `min_free_bytes`.
async fn check_disk(path: &Path, min_free_bytes: u64, bytes: u64) -> Result<(), ObjectError> {
    let free_bytes = free_bytes(path).await?;
    if free_bytes.saturating_sub(bytes) < min_free_bytes {
        return Err(ObjectError::LowSpace { free_bytes, min_free_bytes });
    }
    Ok(())
}

/// Bytes free on the disk of `path`.
async fn free_bytes(path: &Path) -> Result<u64, ObjectError> {
    let owned = path.to_owned();
    spawn_io(path, move || disk::free_bytes(&owned)).await
}

/// This also keeps `..` and `/` out of every path made from a digest.
fn check_digest(digest: &str) -> Result<(), ObjectError> {
    let is_hex = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    if digest.len() == 64 && digest.bytes().all(is_hex) {
        Ok(())
    } else {
        Err(ObjectError::BadDigest(digest.chars().take(80).collect()))
    }
}

fn object_path(digest: &str) -> Result<ObjectPath, ObjectError> {
    check_digest(digest)?;
    Ok(ObjectPath::from_iter(["cas", &digest[..2], digest]))
}

fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> ObjectError + use<> {
    let path = path.to_owned();
    move |source| ObjectError::Io { action, path, source }
}

#[cfg(test)]
mod bucket_tests;
#[cfg(test)]
mod direct_tests;
#[cfg(test)]
#[path = "../../../tests/support/s3.rs"]
pub(crate) mod s3_server;
#[cfg(test)]
mod shared_tests;
#[cfg(test)]
mod tests;
