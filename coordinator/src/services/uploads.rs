//! UploadService: bytes in and out.

use std::collections::HashSet;
use std::sync::Arc;

use fathom_core::scene::BlobRef;
use fathom_proto::v1::upload_service_server::UploadService;
use fathom_proto::{CHUNK_BYTES, v1};
use futures::StreamExt;
use futures::stream::{self, BoxStream};
use tonic::{Request, Response, Status, Streaming, async_trait};

use super::convert::ServiceError;
use super::{Shared, encode};
use crate::objects::BlobWriter;

/// Most blobs in one question.
const MAX_BLOBS: usize = 10_000;

/// The service.
pub struct Uploads(pub Arc<Shared>);

impl Uploads {
    async fn missing(&self, blobs: Vec<v1::BlobRef>) -> Result<Vec<v1::BlobRef>, ServiceError> {
        if blobs.len() > MAX_BLOBS {
            let message = format!("has {} entries, at most {MAX_BLOBS} are allowed", blobs.len());
            return Err(ServiceError::BadArgument { field: "blobs", message });
        }
        let mut seen = HashSet::new();
        let mut missing = Vec::new();
        for blob in blobs {
            let known = BlobRef { digest: blob.digest.clone(), bytes: blob.size_bytes };
            if seen.insert(blob.digest.clone()) && !self.0.objects.contains(&known).await? {
                missing.push(blob);
            }
        }
        Ok(missing)
    }

    async fn write(
        &self,
        mut pieces: Streaming<v1::WriteBlobRequest>,
    ) -> Result<v1::WriteBlobResponse, ServiceError> {
        let empty = || ServiceError::BadArgument { field: "blob", message: "the stream is empty".into() };
        let first = pieces.message().await.ok().flatten().ok_or_else(empty)?;
        let blob = encode::required_blob("blob", first.blob.clone())?;
        let Some(mut writer) = self.0.objects.begin_write(&blob, first.offset_bytes).await? else {
            return Ok(v1::WriteBlobResponse { committed_size_bytes: blob.bytes, complete: true });
        };
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
            match pieces.message().await {
                Ok(Some(next)) => piece = next,
                // The client ended or broke off without `finish`: what has come is kept for the next stream.
                Ok(None) | Err(_) => {
                    let committed_size_bytes = writer.pause().await?;
                    return Ok(v1::WriteBlobResponse { committed_size_bytes, complete: false });
                }
            }
        }
    }

    /// Pieces of a blob from `offset`, read one at a time as the client takes them.
    async fn read(
        &self,
        digest: String,
        offset: u64,
    ) -> Result<BoxStream<'static, Result<v1::ReadBlobResponse, Status>>, ServiceError> {
        let (objects, metrics) = (Arc::clone(&self.0.objects), Arc::clone(&self.0.metrics));
        let size_bytes = objects.size(&digest).await?;
        if offset > size_bytes {
            let message = format!("{offset} is behind the end of the blob, which has {size_bytes} bytes");
            return Err(ServiceError::BadArgument { field: "offset_bytes", message });
        }
        let pieces = stream::unfold((offset, false), move |(offset, told)| {
            let (objects, metrics, digest) = (Arc::clone(&objects), Arc::clone(&metrics), digest.clone());
            async move {
                // One message even for an empty rest, so that the client learns the size.
                if told && offset >= size_bytes {
                    return None;
                }
                let piece = objects.read_range(&digest, offset, CHUNK_BYTES as u64).await;
                match piece {
                    Ok(data) => {
                        metrics.served(data.len());
                        let next = offset + data.len() as u64;
                        let response = v1::ReadBlobResponse { offset_bytes: offset, size_bytes, data };
                        Some((Ok(response), (next, true)))
                    }
                    Err(error) => Some((Err(ServiceError::from(error).into()), (size_bytes, true))),
                }
            }
        });
        Ok(pieces.boxed())
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
        let missing = self.missing(request.into_inner().blobs).await?;
        Ok(Response::new(v1::FindMissingBlobsResponse { missing }))
    }

    async fn write_blob(
        &self,
        request: Request<Streaming<v1::WriteBlobRequest>>,
    ) -> Result<Response<v1::WriteBlobResponse>, Status> {
        Ok(Response::new(self.write(request.into_inner()).await?))
    }

    async fn query_blob(
        &self,
        request: Request<v1::QueryBlobRequest>,
    ) -> Result<Response<v1::QueryBlobResponse>, Status> {
        let blob = encode::required_blob("blob", request.into_inner().blob)?;
        let (committed_size_bytes, complete) =
            self.0.objects.committed(&blob).await.map_err(ServiceError::from)?;
        Ok(Response::new(v1::QueryBlobResponse { committed_size_bytes, complete }))
    }

    type ReadBlobStream = BoxStream<'static, Result<v1::ReadBlobResponse, Status>>;

    async fn read_blob(
        &self,
        request: Request<v1::ReadBlobRequest>,
    ) -> Result<Response<Self::ReadBlobStream>, Status> {
        let v1::ReadBlobRequest { digest, offset_bytes } = request.into_inner();
        Ok(Response::new(self.read(digest, offset_bytes).await?))
    }
}
