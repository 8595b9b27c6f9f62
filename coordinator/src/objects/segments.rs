//! Uploads into a bucket.
//!
//! An object in a bucket is complete or absent, and cannot grow. So an upload is a row of segments,
//! `uploads/<digest>/<offset>-<random>`: each holds what one stream sent, at most 256 MiB. What has arrived
//! is the longest run of segments from byte 0 on, and another coordinator can go on from there. A small blob
//! that arrives in one stream is written under its key at once.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::ObjectStoreExt;
use object_store::path::Path as ObjectPath;
use uuid::Uuid;

use super::bucket::{Bucket, PART_BYTES, Parts, Pieces};
use super::{ObjectError, WriteClaim};

/// Bytes of a segment: a coordinator that crashes loses no more of an upload.
const SEGMENT_BYTES: u64 = 256 << 20;

/// A part of an upload, complete in the bucket.
#[derive(Clone, Debug)]
struct Segment {
    path: ObjectPath,
    bytes: u64,
}

/// The segments of an upload from byte 0 on, without a gap.
async fn arrived(bucket: &Bucket, digest: &str) -> Result<Vec<Segment>, ObjectError> {
    // Of two that begin at one byte, the longer one.
    let mut by_offset = BTreeMap::<u64, Segment>::new();
    let mut listed = bucket.list(&format!("uploads/{digest}"));
    while let Some(meta) = listed.try_next().await? {
        let offset = meta.location.filename().and_then(|name| name.split_once('-')?.0.parse().ok());
        let Some(offset) = offset else { continue };
        let found = Segment { path: meta.location, bytes: meta.size };
        let segment = by_offset.entry(offset).or_insert_with(|| found.clone());
        if segment.bytes < found.bytes {
            *segment = found;
        }
    }
    let (mut run, mut end) = (Vec::new(), 0);
    while let Some(segment) = by_offset.remove(&end).filter(|segment| segment.bytes > 0) {
        end += segment.bytes;
        run.push(segment);
    }
    Ok(run)
}

/// Received bytes of an upload.
pub(super) async fn arrived_bytes(bucket: &Bucket, digest: &str) -> Result<u64, ObjectError> {
    Ok(arrived(bucket, digest).await?.iter().map(|segment| segment.bytes).sum())
}

/// An upload into segments.
pub(super) struct Segments {
    bucket: Arc<Bucket>,
    /// No other stream writes this blob, also while the last bytes are saved after the end of this one.
    claim: Arc<WriteClaim>,
    /// Length of the whole blob.
    bytes: u64,
    complete: Vec<Segment>,
    /// The segment that grows.
    current: Option<Growing>,
    /// Bytes that are in no part yet.
    waiting: Pieces,
}

struct Growing {
    path: ObjectPath,
    parts: Parts,
    bytes: u64,
}

impl Segments {
    /// Goes on at `offset`, and adds the bytes before it to `hasher`. The whole blob has `bytes`.
    pub async fn open(
        bucket: &Arc<Bucket>,
        claim: &Arc<WriteClaim>,
        bytes: u64,
        offset: u64,
        mut hasher: blake3::Hasher,
    ) -> Result<(Self, blake3::Hasher), ObjectError> {
        let complete = if offset > 0 { arrived(bucket, &claim.digest).await? } else { Vec::new() };
        // They are hashed as they are in the bucket, because these bytes will be published.
        for segment in &complete {
            let mut pieces = bucket.pieces(&segment.path).await?;
            while let Some(piece) = pieces.try_next().await? {
                hasher.update(&piece);
            }
        }
        let (bucket, claim) = (Arc::clone(bucket), Arc::clone(claim));
        let opened = Self { bucket, claim, bytes, complete, current: None, waiting: Pieces::default() };
        Ok((opened, hasher))
    }

    fn durable_bytes(&self) -> u64 {
        self.complete.iter().map(|segment| segment.bytes).sum()
    }

    fn is_unsaved(&self) -> bool {
        self.current.is_some() || self.waiting.bytes > 0
    }

    /// Appends bytes; they are durable after [`Segments::save`].
    pub async fn append(&mut self, piece: Bytes) -> Result<(), ObjectError> {
        self.waiting.push(piece);
        while self.bytes > PART_BYTES as u64
            && let Some(part) = self.waiting.take_part(PART_BYTES)
        {
            self.put(part, PART_BYTES as u64).await?;
            if self.current.as_ref().is_some_and(|current| current.bytes >= SEGMENT_BYTES) {
                self.save().await?;
            }
        }
        Ok(())
    }

    async fn put(&mut self, part: Vec<Bytes>, bytes: u64) -> Result<(), ObjectError> {
        let put = self.put_into_current(part, bytes).await;
        if put.is_err() {
            // A gap: what comes later does not belong behind what is durable.
            self.current = None;
            self.waiting.take();
        }
        put
    }

    async fn put_into_current(&mut self, part: Vec<Bytes>, bytes: u64) -> Result<(), ObjectError> {
        let mut current = match self.current.take() {
            Some(current) => current,
            None => {
                let path = self.segment_path(self.durable_bytes());
                let parts = Parts::begin(self.bucket.store(), &path).await?;
                Growing { path, parts, bytes: 0 }
            }
        };
        current.parts.put(part).await?;
        current.bytes += bytes;
        self.current = Some(current);
        Ok(())
    }

    fn segment_path(&self, offset: u64) -> ObjectPath {
        // Two streams at one offset, of two coordinators, write two objects.
        let random = Uuid::new_v4().simple().to_string();
        let name = format!("{offset}-{}", &random[..12]);
        ObjectPath::from_iter(["uploads", &self.claim.digest, &name])
    }

    /// Makes all bytes durable: they become a segment.
    pub async fn save(&mut self) -> Result<(), ObjectError> {
        let (waiting_bytes, waiting) = (self.waiting.bytes as u64, self.waiting.take());
        if let Some(mut current) = self.current.take() {
            if waiting_bytes > 0 {
                current.parts.put(waiting).await?;
            }
            current.parts.complete().await?;
            self.complete.push(Segment { path: current.path, bytes: current.bytes + waiting_bytes });
        } else if waiting_bytes > 0 {
            let path = self.segment_path(self.durable_bytes());
            let payload = waiting.into_iter().collect();
            self.bucket.store().put(&path, payload).await.map_err(ObjectError::Unavailable)?;
            self.complete.push(Segment { path, bytes: waiting_bytes });
        }
        self.claim.count(self.durable_bytes());
        Ok(())
    }

    /// Makes the bytes the blob. The caller has hashed them.
    pub async fn publish(&mut self) -> Result<(), ObjectError> {
        if self.complete.is_empty() && self.current.is_none() {
            let whole: Vec<u8> = self.waiting.take().concat();
            return self.bucket.put(&self.claim.digest, whole.into()).await;
        }
        self.save().await?;
        let paths: Vec<ObjectPath> = self.complete.iter().map(|segment| segment.path.clone()).collect();
        self.bucket.publish(&self.claim.digest, self.bytes, &paths).await?;
        // Garbage collection finds what stays here.
        if let Err(error) = self.bucket.delete(paths).await {
            let digest = &self.claim.digest;
            tracing::warn!(%error, digest, "segments of a complete upload remain in the bucket");
        }
        Ok(())
    }

    /// Deletes everything that has arrived.
    pub async fn discard(&mut self) -> Result<(), ObjectError> {
        self.waiting.take();
        if let Some(mut current) = self.current.take() {
            current.parts.abort().await;
        }
        let paths = arrived(&self.bucket, &self.claim.digest).await?;
        self.complete.clear();
        self.bucket.delete(paths.into_iter().map(|segment| segment.path).collect()).await
    }
}

impl Drop for Segments {
    /// A client that disconnects ends the call, and with it the writer. Its last bytes become a segment, and
    /// the next stream waits for that.
    fn drop(&mut self) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        if !self.is_unsaved() {
            return;
        }
        let mut rest = Self {
            bucket: Arc::clone(&self.bucket),
            claim: Arc::clone(&self.claim),
            bytes: self.bytes,
            complete: std::mem::take(&mut self.complete),
            current: self.current.take(),
            waiting: std::mem::take(&mut self.waiting),
        };
        runtime.spawn(async move {
            if let Err(error) = rest.save().await {
                let digest = &rest.claim.digest;
                tracing::warn!(%error, digest, "the end of an interrupted upload is lost");
            }
        });
    }
}
