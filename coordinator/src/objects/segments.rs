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
use tokio::sync::{mpsc, oneshot};
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
    let mut by_offset = BTreeMap::<u64, Vec<Segment>>::new();
    let mut listed = bucket.list(&format!("uploads/{digest}"));
    while let Some(meta) = listed.try_next().await? {
        let offset = meta.location.filename().and_then(|name| name.split_once('-')?.0.parse().ok());
        if let Some(offset) = offset
            && meta.size > 0
        {
            by_offset.entry(offset).or_default().push(Segment { path: meta.location, bytes: meta.size });
        }
    }
    Ok(longest_run(by_offset))
}

/// The segments that reach furthest from byte 0 on. Two streams of one upload, at two coordinators, leave
/// segments that overlap.
fn longest_run(by_offset: BTreeMap<u64, Vec<Segment>>) -> Vec<Segment> {
    // From the last offset on: where each run ends, with its first segment.
    let mut runs = BTreeMap::<u64, (u64, Segment)>::new();
    for (offset, segments) in by_offset.into_iter().rev() {
        let reach = |segment: &Segment| {
            let end = offset + segment.bytes;
            runs.get(&end).map_or(end, |(reach, _)| *reach)
        };
        let furthest = segments.into_iter().map(|segment| (reach(&segment), segment));
        if let Some(best) = furthest.max_by_key(|(reach, _)| *reach) {
            runs.insert(offset, best);
        }
    }
    let (mut run, mut end) = (Vec::new(), 0);
    while let Some((_, segment)) = runs.remove(&end) {
        end += segment.bytes;
        run.push(segment);
    }
    run
}

/// The path of a new segment.
pub(super) fn path_at(digest: &str, offset: u64) -> ObjectPath {
    // Two streams at one offset, of two coordinators, write two objects.
    let random = Uuid::new_v4().simple().to_string();
    ObjectPath::from_iter(["uploads", digest, &format!("{offset}-{}", &random[..12])])
}

/// Received bytes of an upload.
pub(super) async fn arrived_bytes(bucket: &Bucket, digest: &str) -> Result<u64, ObjectError> {
    Ok(arrived(bucket, digest).await?.iter().map(|segment| segment.bytes).sum())
}

/// An upload into segments. A task of its own does the work, and no caller interrupts it. When a client
/// disconnects, its call and this handle are dropped, and the task makes its last bytes a segment.
pub(super) struct Segments(mpsc::Sender<(Request, oneshot::Sender<Result<(), ObjectError>>)>);

/// What the task is asked for.
enum Request {
    /// Append these bytes.
    Append(Bytes),
    /// Make all bytes durable.
    Save,
    /// Make the bytes the blob. The caller has hashed them.
    Publish,
    /// Delete everything that has arrived.
    Discard,
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
        let upload = Upload { bucket, claim, bytes, complete, current: None, waiting: Pieces::default() };
        // One message waits while another is written.
        let (requests, queue) = mpsc::channel(1);
        tokio::spawn(upload.run(queue));
        Ok((Self(requests), hasher))
    }

    /// Appends bytes; they are durable after [`Segments::save`].
    pub async fn append(&self, piece: Bytes) -> Result<(), ObjectError> {
        self.ask(Request::Append(piece)).await
    }

    /// Makes all bytes durable: they become a segment. Nothing may follow.
    pub async fn save(&self) -> Result<(), ObjectError> {
        self.ask(Request::Save).await
    }

    /// Makes the bytes the blob; nothing may follow. The caller has hashed them.
    pub async fn publish(&self) -> Result<(), ObjectError> {
        self.ask(Request::Publish).await
    }

    /// Deletes everything that has arrived; nothing may follow.
    pub async fn discard(&self) -> Result<(), ObjectError> {
        self.ask(Request::Discard).await
    }

    async fn ask(&self, request: Request) -> Result<(), ObjectError> {
        let (answer, answered) = oneshot::channel();
        let ended = || ObjectError::Interrupted;
        self.0.send((request, answer)).await.map_err(|_| ended())?;
        answered.await.map_err(|_| ended())?
    }
}

/// The work of an upload.
struct Upload {
    bucket: Arc<Bucket>,
    /// No other stream writes this blob, until the last bytes are saved.
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

impl Upload {
    /// Serves an upload to its end, or to its first error: what comes after an error does not belong behind
    /// the durable bytes. The claim is given back before the last answer, so that the caller may begin again.
    async fn run(mut self, mut queue: mpsc::Receiver<(Request, oneshot::Sender<Result<(), ObjectError>>)>) {
        while let Some((request, answer)) = queue.recv().await {
            let is_last = !matches!(request, Request::Append(_));
            let done = match request {
                Request::Append(piece) => self.append(piece).await,
                Request::Save => self.save().await,
                Request::Publish => self.publish().await,
                Request::Discard => self.discard().await,
            };
            if is_last || done.is_err() {
                self.claim.settle().await;
                drop(self);
                // The caller may be gone.
                let _ = answer.send(done);
                return;
            }
            let _ = answer.send(done);
        }
        if let Err(error) = self.save().await {
            tracing::warn!(%error, digest = self.claim.digest, "the end of an interrupted upload is lost");
        }
        self.claim.settle().await;
    }

    fn durable_bytes(&self) -> u64 {
        self.complete.iter().map(|segment| segment.bytes).sum()
    }

    async fn append(&mut self, piece: Bytes) -> Result<(), ObjectError> {
        self.waiting.push(piece);
        while self.bytes > PART_BYTES as u64
            && let Some(part) = self.waiting.take_part(PART_BYTES)
        {
            let mut current = match self.current.take() {
                Some(current) => current,
                None => {
                    let path = self.segment_path();
                    let parts = Parts::begin(self.bucket.store(), &path).await?;
                    Growing { path, parts, bytes: 0 }
                }
            };
            current.parts.put(part).await?;
            current.bytes += PART_BYTES as u64;
            let is_full = current.bytes >= SEGMENT_BYTES;
            self.current = Some(current);
            if is_full {
                self.complete_segment(Pieces::default()).await?;
            }
        }
        Ok(())
    }

    fn segment_path(&self) -> ObjectPath {
        path_at(&self.claim.digest, self.durable_bytes())
    }

    async fn save(&mut self) -> Result<(), ObjectError> {
        let waiting = std::mem::take(&mut self.waiting);
        self.complete_segment(waiting).await
    }

    /// Ends the segment that grows, with some last bytes.
    async fn complete_segment(&mut self, mut last: Pieces) -> Result<(), ObjectError> {
        let bytes = last.bytes as u64;
        if let Some(mut current) = self.current.take() {
            if bytes > 0 {
                current.parts.put(last.take()).await?;
            }
            current.parts.complete().await?;
            self.complete.push(Segment { path: current.path, bytes: current.bytes + bytes });
        } else if bytes > 0 {
            let path = self.segment_path();
            let payload = last.take().into_iter().collect();
            self.bucket.store().put(&path, payload).await.map_err(ObjectError::Unavailable)?;
            self.complete.push(Segment { path, bytes });
        }
        self.claim.count(self.durable_bytes());
        Ok(())
    }

    async fn publish(&mut self) -> Result<(), ObjectError> {
        if self.complete.is_empty() && self.current.is_none() {
            let whole: Vec<u8> = self.waiting.take().concat();
            let whole = Bytes::from(whole);
            loop {
                self.bucket.put(&self.claim.digest, whole.clone()).await?;
                if self.claim.complete(self.bytes).await? {
                    return Ok(());
                }
            }
        }
        self.save().await?;
        let paths: Vec<ObjectPath> = self.complete.drain(..).map(|segment| segment.path).collect();
        loop {
            self.bucket.publish(&self.claim.digest, self.bytes, &paths).await?;
            // Before the segments go: after a crash here, the client need not send it again.
            if self.claim.complete(self.bytes).await? {
                break;
            }
        }
        // Garbage collection finds what stays here.
        if let Err(error) = self.bucket.delete(paths, |_| ()).await {
            let digest = &self.claim.digest;
            tracing::warn!(%error, digest, "segments of a complete upload remain in the bucket");
        }
        Ok(())
    }

    async fn discard(&mut self) -> Result<(), ObjectError> {
        self.waiting.take();
        if let Some(mut current) = self.current.take() {
            current.parts.abort().await;
        }
        self.complete.clear();
        // Also what two coordinators received at one offset, of which only one counts as arrived.
        let listed = self.bucket.list(&format!("uploads/{}", self.claim.digest));
        let paths = listed.map_ok(|meta| meta.location).try_collect().await?;
        self.bucket.delete(paths, |_| ()).await?;
        self.claim.count(0);
        Ok(())
    }
}
