//! Transfers blobs to and from the coordinator: resumes after a lost connection, checks BLAKE3 on arrival.

use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use fathom_proto::dial::{Connection, reason};
use fathom_proto::direct::{Content, Direct};
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::{CHUNK_BYTES, v1};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use crate::WorkerError;
use crate::retry::{Repeated, Trouble, pauses, until_answered, will_pass};

/// Pieces read ahead of the network.
const PIECES_AHEAD: usize = 2;
/// Maximum number of blobs in one query.
const BLOBS_PER_QUESTION: usize = 10_000;

/// Source of the bytes of an upload.
#[derive(Clone, Debug)]
pub enum BlobSource {
    /// Bytes in memory.
    Bytes(Bytes),
    /// A file, read during the upload.
    File(PathBuf),
}

impl BlobSource {
    /// Digest and length.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn blob_ref(&self) -> Result<BlobRef, WorkerError> {
        match self {
            Self::Bytes(bytes) => {
                Ok(BlobRef { digest: blake3::hash(bytes).to_hex().to_string(), bytes: bytes.len() as u64 })
            }
            Self::File(path) => hash_file(path),
        }
    }

    /// At most one piece, from `offset`.
    fn piece(&self, offset: u64) -> std::io::Result<Bytes> {
        match self {
            Self::Bytes(bytes) => {
                let start = usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len());
                Ok(bytes.slice(start..bytes.len().min(start + CHUNK_BYTES)))
            }
            Self::File(path) => {
                let mut file = std::fs::File::open(path)?;
                file.seek(SeekFrom::Start(offset))?;
                let mut piece = Vec::new();
                file.take(CHUNK_BYTES as u64).read_to_end(&mut piece)?;
                Ok(piece.into())
            }
        }
    }
}

/// Digest and length of a file.
///
/// # Errors
/// When it cannot be read.
pub fn hash_file(path: &Path) -> Result<BlobRef, WorkerError> {
    let mut hasher = blake3::Hasher::new();
    let mut file = std::fs::File::open(path).map_err(WorkerError::io("read", path))?;
    let bytes = std::io::copy(&mut file, &mut hasher).map_err(WorkerError::io("read", path))?;
    Ok(BlobRef { digest: hasher.finalize().to_hex().to_string(), bytes })
}

/// The object store of a coordinator.
#[derive(Clone, Debug)]
pub struct BlobClient {
    client: UploadServiceClient<Connection>,
    /// See [`BlobClient::of_job`].
    job_id: String,
    trouble: Trouble,
    direct: Direct,
}

impl BlobClient {
    /// Uses an existing connection, for the blobs of the caller's own tenant.
    pub fn new(connection: Connection) -> Self {
        Self {
            client: UploadServiceClient::new(connection),
            job_id: String::new(),
            trouble: Trouble::default(),
            direct: Direct::default(),
        }
    }

    /// For the blobs of the tenant that a job belongs to.
    pub fn of_job(&self, job_id: &str) -> Self {
        Self { job_id: job_id.to_owned(), ..self.clone() }
    }

    /// The reason why calls are being retried.
    pub(crate) fn trouble(&self) -> &Trouble {
        &self.trouble
    }

    /// Returns those of `blobs` that the coordinator lacks.
    ///
    /// # Errors
    /// When it refuses.
    pub async fn missing(&self, blobs: &[BlobRef]) -> Result<Vec<BlobRef>, WorkerError> {
        let mut missing = Vec::new();
        for question in blobs.chunks(BLOBS_PER_QUESTION) {
            let request = v1::FindMissingBlobsRequest {
                blobs: question.iter().map(to_proto).collect(),
                job_id: self.job_id.clone(),
            };
            let answer = until_answered("FindMissingBlobs", &self.trouble, || {
                let (mut client, request) = (self.client.clone(), request.clone());
                async move { client.find_missing_blobs(request).await }
            })
            .await?;
            missing.extend(answer.into_inner().missing.into_iter().map(from_proto));
        }
        Ok(missing)
    }

    /// Uploads a blob unless the coordinator has it, resuming an earlier upload. Retries until it is stored.
    ///
    /// # Errors
    /// When the source cannot be read, or the coordinator refuses the content.
    pub async fn upload(&self, source: &BlobSource) -> Result<BlobRef, WorkerError> {
        let hashed = source.clone();
        let blob = on_disk(move || hashed.blob_ref()).await?;
        self.upload_as(&blob, source).await?;
        Ok(blob)
    }

    /// As [`BlobClient::upload`], for a source whose digest is known.
    ///
    /// # Errors
    /// As [`BlobClient::upload`].
    pub async fn upload_as(&self, blob: &BlobRef, source: &BlobSource) -> Result<(), WorkerError> {
        let mut pauses = pauses();
        let mut repeated = Repeated::new("an upload", &self.trouble);
        let mut may_be_direct = true;
        loop {
            match self.try_upload(blob, source, &mut may_be_direct).await {
                Ok(true) => {
                    repeated.answered();
                    return Ok(());
                }
                // The server has kept the received bytes; ask for the offset.
                Ok(false) => {}
                Err(status) if reason(&status).as_deref() == Some("WRONG_OFFSET") => {}
                Err(status) if will_pass(&status) => repeated.again(&status),
                Err(status) => return Err(status.into()),
            }
            tokio::time::sleep(pauses.next().unwrap_or_default()).await;
        }
    }

    /// One attempt: true if the blob is stored, false if the stream ended early. At most one attempt sends it
    /// to the bucket.
    async fn try_upload(
        &self,
        blob: &BlobRef,
        source: &BlobSource,
        may_be_direct: &mut bool,
    ) -> Result<bool, Status> {
        let mut client = self.client.clone();
        let query = v1::QueryBlobRequest { blob: Some(to_proto(blob)), job_id: self.job_id.clone() };
        let arrived = client.query_blob(query).await?.into_inner();
        if arrived.complete {
            return Ok(true);
        }
        let mut start = arrived.committed_size_bytes;
        if arrived.direct && std::mem::take(may_be_direct) && self.direct.is_wanted() {
            let content = match source.clone() {
                BlobSource::Bytes(bytes) => Content::Bytes(bytes),
                BlobSource::File(path) => Content::File(path),
            };
            start = self.direct.upload(&self.client, &to_proto(blob), &self.job_id, content, start).await;
            if start == blob.bytes {
                return Ok(true);
            }
        }
        let (sender, pieces) = mpsc::channel(PIECES_AHEAD);
        let (source, first, job_id) = (source.clone(), to_proto(blob), self.job_id.clone());
        let size = blob.bytes;
        // A failing reader ends the stream without `finish`; the caller gets the reader's error.
        let read = async move {
            let mut offset = start;
            loop {
                let from = source.clone();
                let data =
                    threads::blocking(move || from.piece(offset)).await.map_err(std::io::Error::other)??;
                if data.is_empty() && offset < size {
                    return Err(std::io::ErrorKind::UnexpectedEof.into());
                }
                let next = offset + data.len() as u64;
                let request = v1::WriteBlobRequest {
                    blob: (offset == start).then(|| first.clone()),
                    offset_bytes: offset,
                    data,
                    finish: next >= size,
                    job_id: job_id.clone(),
                };
                let finished = request.finish;
                // A closed channel means that the call has ended, which the caller notices.
                if sender.send(request).await.is_err() || finished {
                    return Ok::<(), std::io::Error>(());
                }
                offset = next;
            }
        };
        let (answer, read) = tokio::join!(client.write_blob(ReceiverStream::new(pieces)), read);
        read.map_err(|error| Status::invalid_argument(format!("the source cannot be read: {error}")))?;
        Ok(answer?.into_inner().complete)
    }

    /// Downloads a blob into the file `path`, which appears only when complete and checked. Resumes a file
    /// `path`.part of an earlier attempt; nothing else may write to it.
    ///
    /// # Errors
    /// When the coordinator does not have it, the file cannot be written, or the content does not match the
    /// digest.
    pub async fn download(&self, blob: &BlobRef, path: &Path) -> Result<(), WorkerError> {
        let mut name = path.as_os_str().to_owned();
        name.push(".part");
        let part = PathBuf::from(name);
        self.download_part(blob, &part).await?;
        std::fs::rename(&part, path).map_err(WorkerError::io("rename to", path))
    }

    /// Appends to `part` until the blob is complete; removes a damaged file.
    pub(crate) async fn download_part(&self, blob: &BlobRef, part: &Path) -> Result<(), WorkerError> {
        let mut pauses = pauses();
        let mut repeated = Repeated::new("a download", &self.trouble);
        let (mut may_be_direct, mut was_direct) = (self.direct.is_wanted(), false);
        loop {
            match self.try_download(blob, part, may_be_direct, &mut was_direct).await {
                Ok(()) => repeated.answered(),
                Err(WorkerError::Bucket(error)) => {
                    self.direct.failed(&error);
                    may_be_direct = false;
                    continue;
                }
                Err(WorkerError::Refused(status)) if will_pass(&status) => {
                    repeated.again(&status);
                    tokio::time::sleep(pauses.next().unwrap_or_default()).await;
                    continue;
                }
                Err(error) => return Err(error),
            }
            let hashed = part.to_owned();
            let found = on_disk(move || hash_file(&hashed)).await?;
            if found == *blob {
                return Ok(());
            }
            std::fs::remove_file(part).map_err(WorkerError::io("remove", part))?;
            let message = format!("received {} bytes with digest {}", found.bytes, found.digest);
            if !was_direct {
                return Err(WorkerError::Damaged { digest: blob.digest.clone(), message });
            }
            // The coordinator looks at the blob when it sends it, and sets it aside if it is damaged.
            tracing::warn!(
                digest = blob.digest,
                message,
                "the bucket sent other bytes; asking the coordinator"
            );
            (may_be_direct, was_direct) = (false, false);
        }
    }

    /// Appends what is missing, and sets `was_direct` if it came from the bucket.
    async fn try_download(
        &self,
        blob: &BlobRef,
        part: &Path,
        may_be_direct: bool,
        was_direct: &mut bool,
    ) -> Result<(), WorkerError> {
        let (path, most) = (part.to_owned(), blob.bytes);
        let (file, mut offset) =
            on_disk(move || open_part(&path, most).map_err(WorkerError::io("write", &path))).await?;
        let write = |data: Bytes| {
            let (file, path) = (Arc::clone(&file), part.to_owned());
            on_disk(move || (&*file).write_all(&data).map_err(WorkerError::io("write", path)))
        };
        let request = v1::ReadBlobRequest {
            digest: blob.digest.clone(),
            offset_bytes: offset,
            job_id: self.job_id.clone(),
            direct: may_be_direct,
        };
        let mut pieces = self.client.clone().read_blob(request).await?.into_inner();
        while let Some(piece) = pieces.message().await? {
            if piece.offset_bytes != offset {
                let message = format!("byte {} where byte {offset} was expected", piece.offset_bytes);
                return Err(WorkerError::Protocol(message));
            }
            if !piece.url.is_empty() && !may_be_direct {
                return Err(WorkerError::Protocol("a URL that nobody asked for".to_owned()));
            }
            if !piece.url.is_empty() {
                *was_direct = true;
                let missing = blob.bytes.saturating_sub(offset);
                let mut pieces = self.direct.get(&piece.url, offset, missing).await?;
                while let Some(data) = pieces.next().await? {
                    write(data).await?;
                }
                return Ok(());
            }
            offset += piece.data.len() as u64;
            write(piece.data).await?;
        }
        Ok(())
    }
}

/// Opens a download to resume and returns its length. A file longer than the blob starts over.
fn open_part(path: &Path, most_bytes: u64) -> std::io::Result<(Arc<std::fs::File>, u64)> {
    let file = std::fs::File::options().create(true).append(true).open(path)?;
    let mut bytes = file.metadata()?.len();
    if bytes > most_bytes {
        file.set_len(0)?;
        bytes = 0;
    }
    Ok((Arc::new(file), bytes))
}

/// Runs file I/O on a blocking thread.
async fn on_disk<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, WorkerError> + Send + 'static,
) -> Result<T, WorkerError> {
    threads::blocking(work).await.map_err(|error| WorkerError::Thread(error.to_string()))?
}

/// Converts to a message.
pub fn to_proto(blob: &BlobRef) -> v1::BlobRef {
    v1::BlobRef { digest: blob.digest.clone(), size_bytes: blob.bytes }
}

/// Converts from a message.
pub fn from_proto(blob: v1::BlobRef) -> BlobRef {
    BlobRef { digest: blob.digest, bytes: blob.size_bytes }
}
