//! UploadService: bytes in and out.

use std::collections::HashSet;
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_proto::v1::upload_service_server::UploadService;
use fathom_proto::{CHUNK_BYTES, v1};
use futures::stream::{self, BoxStream};
use futures::{Stream, StreamExt};
use tonic::{Code, Request, Response, Status, Streaming, async_trait};

use super::{datasets, encode, inspection, links};
use crate::access::guard::caller;
use crate::access::{Principal, Role};
use crate::metrics::Metrics;
use crate::objects::{BlobStore, BlobWriter, DIRECT_READ_FROM_BYTES, ObjectError, SignedRequest};
use crate::schedule::Tenant;
use crate::service_error::ServiceError;
use crate::state::{State, stopped};

/// Maximum blobs in one call.
pub(super) const MAX_BLOBS: usize = 10_000;
/// Longest blob that is sent in calls of one piece: each call reads and hashes again what has arrived.
const MAX_CHUNKED_BYTES: u64 = 256 << 20;
/// Bytes of a sent piece. Clients that read nothing leave as many pieces in memory as there are places; with
/// blobs in a bucket, as many requests ([`BlobStore::read_bytes`]).
const READ_BYTES: usize = 256 << 10;

/// The service.
pub struct Uploads(pub Arc<State>);

impl Uploads {
    /// The tenant that a call is for: that of the job that it names, else the caller's own.
    async fn tenant(&self, caller: &Principal, job_id: &str) -> Result<Tenant, ServiceError> {
        if job_id.is_empty() {
            return Ok(caller.home());
        }
        Ok(self.0.owner(caller, &job_id.parse()?).await?)
    }

    async fn objects(&self, caller: &Principal, job_id: &str) -> Result<Arc<BlobStore>, ServiceError> {
        Ok(self.0.objects.of(&self.tenant(caller, job_id).await?).await?)
    }

    /// Where a call writes.
    async fn place(&self, caller: &Principal, job_id: &str) -> Result<Destination, ServiceError> {
        let tenant = self.tenant(caller, job_id).await?;
        let objects = self.0.objects.of(&tenant).await?;
        // Uploads of workers are accepted: a quota is no reason to discard hours of work. Without tokens,
        // workers are recognised by the job that they name.
        let is_result =
            if self.0.access.asks_for_tokens() { caller.role == Role::Worker } else { !job_id.is_empty() };
        let limit_bytes = if is_result { None } else { self.0.limit_bytes(&tenant).await? };
        Ok(Destination { tenant, objects, limit_bytes })
    }

    async fn sign(
        &self,
        caller: &Principal,
        request: v1::SignWriteRequest,
    ) -> Result<v1::SignWriteResponse, ServiceError> {
        let blob = encode::required_blob("blob", request.blob)?;
        let place = self.place(caller, &request.job_id).await?;
        let (committed_bytes, complete) = place.objects.committed(&blob).await?;
        if complete {
            return Ok(v1::SignWriteResponse { complete, ..Default::default() });
        }
        let offset_bytes = request.offset_bytes;
        if committed_bytes != offset_bytes {
            // Before the client sends it in vain.
            let digest = blob.digest;
            return Err(ObjectError::WrongOffset { digest, offset_bytes, committed_bytes }.into());
        }
        if !request.in_parts && !place.objects.takes_at_once(&blob) {
            return Ok(v1::SignWriteResponse::default());
        }
        let signed = place.objects.sign_write(&blob, offset_bytes, place.limit_bytes).await;
        let Some(signed) = signed.map_err(|error| place.fault(error))? else {
            return Ok(v1::SignWriteResponse::default());
        };
        let SignedRequest { url, headers } = signed.request;
        let (upload, size_bytes) = (signed.upload, signed.bytes);
        Ok(v1::SignWriteResponse { complete, url, headers, upload, size_bytes })
    }

    async fn finish(
        &self,
        caller: &Principal,
        request: v1::FinishWriteRequest,
    ) -> Result<v1::FinishWriteResponse, ServiceError> {
        let blob = encode::required_blob("blob", request.blob)?;
        let place = self.place(caller, &request.job_id).await?;
        let v1::FinishWriteRequest { upload, offset_bytes, .. } = request;
        let finished = place.objects.finish_write(&blob, &upload, offset_bytes, place.limit_bytes).await;
        self.0.metrics.uploaded_directly(finished.map_err(|error| place.fault(error))?);
        Ok(v1::FinishWriteResponse {})
    }

    async fn missing(
        &self,
        objects: &BlobStore,
        blobs: Vec<v1::BlobRef>,
    ) -> Result<Vec<v1::BlobRef>, ServiceError> {
        if blobs.len() > MAX_BLOBS {
            let message = format!("has {} entries, at most {MAX_BLOBS} are allowed", blobs.len());
            return Err(ServiceError::BadArgument { field: "blobs", message });
        }
        let mut seen = HashSet::new();
        let asked: Vec<BlobRef> = blobs
            .into_iter()
            .filter(|blob| seen.insert(blob.digest.clone()))
            .map(|blob| BlobRef { digest: blob.digest, bytes: blob.size_bytes })
            .collect();
        let missing = objects.missing(&asked).await?;
        Ok(missing.into_iter().map(|index| encode::blob(&asked[index])).collect())
    }

    async fn write(
        &self,
        caller: &Principal,
        mut pieces: impl Stream<Item = Result<v1::WriteBlobRequest, Status>> + Unpin,
    ) -> Result<v1::WriteBlobResponse, ServiceError> {
        let empty = || ServiceError::BadArgument { field: "blob", message: "the stream is empty".into() };
        let first = pieces.next().await.ok_or_else(empty)?;
        let first = first.map_err(|status| ServiceError::Door(Box::new(status)))?;
        let blob = encode::required_blob("blob", first.blob.clone())?;
        let place = self.place(caller, &first.job_id).await?;
        let begun = place.objects.begin_write(&blob, first.offset_bytes, place.limit_bytes).await;
        let Some(mut writer) = begun.map_err(|error| place.fault(error))? else {
            return Ok(v1::WriteBlobResponse { committed_size_bytes: blob.bytes, complete: true });
        };
        let mut stopping = self.0.stopping.clone();
        let mut piece = first;
        loop {
            let finish = piece.finish;
            let bytes = piece.data.len();
            writer = append(writer, piece).await?;
            self.0.metrics.uploaded(bytes);
            if finish {
                writer.finish().await?;
                return Ok(v1::WriteBlobResponse { committed_size_bytes: blob.bytes, complete: true });
            }
            let next = tokio::select! {
                biased;
                // What has arrived is kept, and the client continues at the next process.
                () = stopped(&mut stopping) => {
                    writer.pause().await?;
                    return Err(ObjectError::Interrupted.into());
                }
                next = pieces.next() => next,
            };
            match next {
                Some(Ok(next)) => piece = next,
                // The client ended or disconnected without `finish`: the received bytes are kept for the next
                // stream.
                ended => {
                    let committed_size_bytes = writer.pause().await?;
                    if let Some(Err(status)) = ended
                        && status.code() == Code::InvalidArgument
                    {
                        return Err(ServiceError::Door(Box::new(status)));
                    }
                    return Ok(v1::WriteBlobResponse { committed_size_bytes, complete: false });
                }
            }
        }
    }

    /// Pieces of a blob from `offset`, read one at a time as the client consumes them. If the disk has
    /// changed the blob, a client that reads from the beginning does not get the last piece. A client that
    /// resumes in the middle finds the change itself, and reads the blob again.
    async fn read(
        objects: Arc<BlobStore>,
        metrics: Arc<Metrics>,
        digest: String,
        offset: u64,
        direct: bool,
    ) -> Result<BoxStream<'static, Result<v1::ReadBlobResponse, Status>>, ServiceError> {
        let size_bytes = objects.size(&digest).await?;
        if offset > size_bytes {
            let message = format!("{offset} is beyond the end of the blob, which has {size_bytes} bytes");
            return Err(ServiceError::BadArgument { field: "offset_bytes", message });
        }
        if direct
            && size_bytes - offset >= DIRECT_READ_FROM_BYTES
            && let Some(url) = objects.url_of(&digest).await?
        {
            metrics.served_directly(size_bytes - offset);
            let answer = v1::ReadBlobResponse { offset_bytes: offset, size_bytes, data: Bytes::new(), url };
            return Ok(stream::iter([Ok(answer)]).boxed());
        }
        let hasher = (offset == 0).then(blake3::Hasher::new);
        let reading = Reading { objects, digest, offset, size_bytes, hasher, ahead: Bytes::new() };
        let pieces = stream::unfold((reading, false), move |(mut reading, sent_any)| {
            let metrics = Arc::clone(&metrics);
            async move {
                // One message even for an empty rest, so that the client learns the size.
                let offset_bytes = reading.offset;
                if sent_any && offset_bytes >= size_bytes {
                    return None;
                }
                match reading.next_piece().await {
                    Ok(data) => {
                        metrics.served(data.len());
                        let response =
                            v1::ReadBlobResponse { offset_bytes, size_bytes, data, url: String::new() };
                        Some((Ok(response), (reading, true)))
                    }
                    Err(error) => {
                        reading.offset = size_bytes;
                        Some((Err(ServiceError::from(error).into()), (reading, true)))
                    }
                }
            }
        });
        Ok(pieces.boxed())
    }
}

/// Where a call writes.
struct Destination {
    tenant: Tenant,
    objects: Arc<BlobStore>,
    /// Maximum bytes of the tenant, if its uploads are limited.
    limit_bytes: Option<u64>,
}

impl Destination {
    fn fault(&self, error: ObjectError) -> ServiceError {
        match error {
            ObjectError::OverLimit { used_bytes, limit_bytes } => {
                ServiceError::TooManyBytes { tenant: self.tenant.clone(), used_bytes, limit_bytes }
            }
            error => error.into(),
        }
    }
}

/// A blob on its way to a client.
struct Reading {
    objects: Arc<BlobStore>,
    digest: String,
    /// Of the next piece.
    offset: u64,
    size_bytes: u64,
    /// Where it is read from the beginning.
    hasher: Option<blake3::Hasher>,
    /// Bytes that are read and not sent.
    ahead: Bytes,
}

impl Reading {
    /// The next piece; the last one only if all bytes read match the blob's digest.
    async fn next_piece(&mut self) -> Result<Bytes, ObjectError> {
        if self.ahead.is_empty() && self.offset < self.size_bytes {
            let end = self.size_bytes.min(self.offset + self.objects.read_bytes());
            self.ahead = self.objects.range(&self.digest, self.offset..end).await?;
        }
        let data = self.ahead.split_to(self.ahead.len().min(READ_BYTES));
        self.offset += data.len() as u64;
        let Some(hasher) = &mut self.hasher else { return Ok(data) };
        hasher.update(&data);
        if self.offset >= self.size_bytes && hasher.finalize().to_hex().as_str() != self.digest {
            self.objects.set_aside_if_damaged(&self.digest).await?;
            return Err(ObjectError::Damaged(self.digest.clone()));
        }
        Ok(data)
    }
}

async fn append(mut writer: BlobWriter, piece: v1::WriteBlobRequest) -> Result<BlobWriter, ServiceError> {
    if piece.data.len() > CHUNK_BYTES {
        let message = format!("has {} bytes, at most {CHUNK_BYTES} are allowed", piece.data.len());
        return Err(ServiceError::BadArgument { field: "data", message });
    }
    writer.append(piece.offset_bytes, piece.data).await?;
    Ok(writer)
}

#[async_trait]
impl UploadService for Uploads {
    async fn find_missing_blobs(
        &self,
        request: Request<v1::FindMissingBlobsRequest>,
    ) -> Result<Response<v1::FindMissingBlobsResponse>, Status> {
        let caller = caller(&request)?;
        let v1::FindMissingBlobsRequest { blobs, job_id } = request.into_inner();
        let missing = self.missing(&*self.objects(&caller, &job_id).await?, blobs).await?;
        Ok(Response::new(v1::FindMissingBlobsResponse { missing }))
    }

    async fn write_blob(
        &self,
        request: Request<Streaming<v1::WriteBlobRequest>>,
    ) -> Result<Response<v1::WriteBlobResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.write(&caller, request.into_inner()).await?))
    }

    async fn write_chunk(
        &self,
        request: Request<v1::WriteBlobRequest>,
    ) -> Result<Response<v1::WriteBlobResponse>, Status> {
        let caller = caller(&request)?;
        let request = request.into_inner();
        if request.blob.as_ref().is_some_and(|blob| blob.size_bytes > MAX_CHUNKED_BYTES) {
            let message = format!("has more than {MAX_CHUNKED_BYTES} bytes; send it with WriteBlob");
            return Err(ServiceError::BadArgument { field: "blob", message }.into());
        }
        let only = stream::iter([Ok(request)]);
        Ok(Response::new(self.write(&caller, only).await?))
    }

    async fn query_blob(
        &self,
        request: Request<v1::QueryBlobRequest>,
    ) -> Result<Response<v1::QueryBlobResponse>, Status> {
        let caller = caller(&request)?;
        let v1::QueryBlobRequest { blob, job_id } = request.into_inner();
        let blob = encode::required_blob("blob", blob)?;
        let objects = self.objects(&caller, &job_id).await?;
        let (committed_size_bytes, complete) = objects.committed(&blob).await.map_err(ServiceError::from)?;
        let direct = !complete && objects.takes_directly(&blob, committed_size_bytes);
        Ok(Response::new(v1::QueryBlobResponse { committed_size_bytes, complete, direct }))
    }

    async fn sign_write(
        &self,
        request: Request<v1::SignWriteRequest>,
    ) -> Result<Response<v1::SignWriteResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.sign(&caller, request.into_inner()).await?))
    }

    async fn finish_write(
        &self,
        request: Request<v1::FinishWriteRequest>,
    ) -> Result<Response<v1::FinishWriteResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.finish(&caller, request.into_inner()).await?))
    }

    type ReadBlobStream = BoxStream<'static, Result<v1::ReadBlobResponse, Status>>;

    async fn read_blob(
        &self,
        request: Request<v1::ReadBlobRequest>,
    ) -> Result<Response<Self::ReadBlobStream>, Status> {
        let caller = caller(&request)?;
        let v1::ReadBlobRequest { digest, offset_bytes, job_id, direct } = request.into_inner();
        let objects = self.objects(&caller, &job_id).await?;
        links::check_read(&self.0, &caller, &objects, &digest).await?;
        let metrics = Arc::clone(&self.0.metrics);
        Ok(Response::new(Self::read(objects, metrics, digest, offset_bytes, direct).await?))
    }

    async fn begin_upload(
        &self,
        request: Request<v1::BeginUploadRequest>,
    ) -> Result<Response<v1::BeginUploadResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(datasets::begin(&self.0, &caller, request.into_inner()).await?))
    }

    async fn commit_dataset(
        &self,
        request: Request<v1::CommitDatasetRequest>,
    ) -> Result<Response<v1::Dataset>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(datasets::commit(&self.0, &caller, &request.get_ref().dataset_id).await?))
    }

    async fn get_dataset(
        &self,
        request: Request<v1::GetDatasetRequest>,
    ) -> Result<Response<v1::Dataset>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(datasets::get(&self.0, &caller, &request.get_ref().dataset_id).await?))
    }

    async fn list_datasets(
        &self,
        request: Request<v1::ListDatasetsRequest>,
    ) -> Result<Response<v1::ListDatasetsResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(datasets::list(&self.0, &caller, request.get_ref()).await?))
    }

    async fn inspect_dataset(
        &self,
        request: Request<v1::InspectDatasetRequest>,
    ) -> Result<Response<v1::Inspection>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(inspection::inspect(&self.0, &caller, request.into_inner()).await?))
    }

    async fn delete_dataset(
        &self,
        request: Request<v1::DeleteDatasetRequest>,
    ) -> Result<Response<v1::DeleteDatasetResponse>, Status> {
        let caller = caller(&request)?;
        datasets::delete(&self.0, &caller, &request.get_ref().dataset_id).await?;
        Ok(Response::new(v1::DeleteDatasetResponse {}))
    }
}
