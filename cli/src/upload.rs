//! Uploads a scene to a coordinator: digests, missing blobs, resumable uploads, the manifest.

use std::path::{Path, PathBuf};
use std::time::Instant;

use bytes::Bytes;
use fathom_core::config::JobConfig;
use fathom_core::scene::{BlobRef, Manifest, ManifestView, Purpose, Scene, load_scene};
use fathom_proto::direct::Content;
use fathom_proto::v1::{
    self, BeginUploadRequest, CreateJobRequest, Dataset, DatasetFile, FindMissingBlobsRequest, Job,
    QueryBlobRequest, QueryBlobResponse, WriteBlobRequest,
};
use tokio::io::{AsyncReadExt as _, AsyncSeekExt as _};
use tokio_stream::wrappers::ReceiverStream;

use crate::client::{Client, passing};
use crate::error::{CliError, Result};
use crate::progress::{Progress, Unit};

/// Photographs uploaded at a time: enough to hide the latency of a distant coordinator.
const UPLOADS_AT_ONCE: usize = 4;
/// Maximum number of blobs in one request (`upload.proto`).
const BLOBS_PER_QUESTION: usize = 10_000;
/// Maximum number of files in the BeginUpload call itself (`upload.proto`).
const FILES_PER_CALL: usize = 10_000;
/// Number of failures of one blob without a byte of progress before giving up.
const MAX_FAILURES: u32 = 16;

/// A scene that was read and hashed, ready to submit.
pub struct Prepared {
    pub manifest: Manifest,
    pub warnings: Vec<String>,
    files: Vec<(BlobRef, Content)>,
}

/// Reads a scene for training and hashes all of its files.
pub fn prepare(data: &Path, config: &JobConfig) -> Result<Prepared> {
    let scene = load_scene(data, Purpose::Train, &config.data)?;
    let points = Bytes::from(scene.points.to_bytes_for(config.method));
    let points_ref = BlobRef::of(&points);
    let mut files = vec![(points_ref.clone(), Content::Bytes(points))];
    let progress = Progress::new("reading", scene.views.len() as u64, Unit::Count("photographs"));
    let mut views = Vec::with_capacity(scene.views.len());
    for (index, view) in scene.views.iter().enumerate() {
        let image = view.image.as_ref().ok_or_else(|| {
            CliError::Message(format!("{}: view {} has no photograph", scene.root.display(), view.name))
        })?;
        let mut add = |path: &PathBuf| -> Result<BlobRef> {
            let blob = crate::blob::digest_file(path)?;
            files.push((blob.clone(), Content::File(path.clone())));
            Ok(blob)
        };
        views.push(ManifestView {
            name: view.name.clone(),
            camera_id: view.camera_id,
            pose: view.pose,
            image: add(image)?,
            mask: view.mask.as_ref().map(&mut add).transpose()?,
        });
        progress.set(index as u64 + 1, &view.name);
    }
    let Scene { source, cameras, warnings, .. } = scene;
    let manifest = Manifest { format: 1, source: source.to_owned(), cameras, views, points: points_ref };
    Ok(Prepared { manifest, warnings, files })
}

/// Properties of a job besides its scene and configuration.
#[derive(Clone, Copy, Debug)]
pub struct JobTicket<'a> {
    /// Display name.
    pub name: &'a str,
    /// Makes the call idempotent.
    pub request_id: &'a str,
    /// See `fathom update`.
    pub priority: i32,
    /// The same.
    pub max_parallel: u32,
}

/// Uploads the blobs that the coordinator lacks, and creates the job.
pub async fn submit(
    client: &Client,
    prepared: &Prepared,
    config: &JobConfig,
    ticket: JobTicket<'_>,
    begin: Instant,
) -> Result<Job> {
    let manifest = Bytes::from(serde_json::to_vec(&prepared.manifest).map_err(as_json)?);
    let manifest_ref = BlobRef::of(&manifest);
    let mut files = prepared.files.clone();
    files.push((manifest_ref.clone(), Content::Bytes(manifest)));
    upload(client, files).await?;
    let request = request(ticket, config)?;
    client
        .create_job(CreateJobRequest {
            manifest: Some(to_proto(&manifest_ref)),
            ingest_seconds: begin.elapsed().as_secs_f64(),
            ..request
        })
        .await
}

/// Creates a job from an existing dataset.
pub async fn submit_dataset(
    client: &Client,
    dataset: &str,
    config: &JobConfig,
    ticket: JobTicket<'_>,
) -> Result<Job> {
    let request = CreateJobRequest { dataset_id: dataset.to_owned(), ..request(ticket, config)? };
    client.create_job(request).await
}

fn request(ticket: JobTicket<'_>, config: &JobConfig) -> Result<CreateJobRequest> {
    Ok(CreateJobRequest {
        request_id: ticket.request_id.to_owned(),
        name: ticket.name.to_owned(),
        config_json: serde_json::to_string(config).map_err(as_json)?,
        priority: ticket.priority,
        max_parallel: ticket.max_parallel,
        ..Default::default()
    })
}

fn as_json(error: serde_json::Error) -> CliError {
    CliError::Message(format!("cannot be written as JSON: {error}"))
}

/// Uploads a scene as a dataset, resumes an interrupted upload, and commits the dataset. Files keep their
/// paths in the scene; the manifest is one of them, so a job needs nothing else.
pub async fn upload_dataset(
    client: &Client,
    prepared: &Prepared,
    id: &str,
    request_id: &str,
) -> Result<Dataset> {
    let manifest = prepared.manifest.to_json()?;
    let manifest = (BlobRef::of(&manifest), Content::Bytes(Bytes::from(manifest)));
    let mut named = vec![("manifest.json".to_owned(), manifest.0.clone())];
    named.push(("points.bin".to_owned(), prepared.manifest.points.clone()));
    for view in &prepared.manifest.views {
        named.push((format!("images/{}", view.name), view.image.clone()));
        named.extend(view.mask.iter().map(|mask| (format!("masks/{}", view.name), mask.clone())));
    }
    // Unicode allows several spellings of a name; the service accepts one.
    let nfc = icu_normalizer::ComposingNormalizerBorrowed::new_nfc();
    named.iter_mut().for_each(|(path, _)| *path = nfc.normalize(path).into_owned());
    named.sort();
    let mut files = prepared.files.clone();
    files.push(manifest);
    let mut request = BeginUploadRequest {
        dataset_id: id.to_owned(),
        request_id: request_id.to_owned(),
        ..Default::default()
    };
    let line = |(path, blob): &(String, BlobRef)| format!("{} {} {path}\n", blob.digest, blob.bytes);
    let list = Bytes::from(named.iter().map(line).collect::<String>());
    if named.len() <= FILES_PER_CALL && list.len() <= fathom_proto::CHUNK_BYTES {
        let file = |(path, blob): (String, BlobRef)| DatasetFile { path, blob: Some(to_proto(&blob)) };
        request.files = named.into_iter().map(file).collect();
    } else {
        // Too many for one message.
        let blob = BlobRef::of(&list);
        upload(client, vec![(blob.clone(), Content::Bytes(list))]).await?;
        request.list = Some(to_proto(&blob));
    }
    let begun = client.begin_upload(request).await?;
    let Some(dataset) = begun.dataset else {
        return Err(CliError::Message(
            "the coordinator accepted the upload and named no dataset; use the same version on both sides"
                .to_owned(),
        ));
    };
    if begun.missing_count > 0 {
        upload(client, files).await?;
    }
    client.commit_dataset(&dataset.dataset_id).await
}

async fn upload(client: &Client, mut files: Vec<(BlobRef, Content)>) -> Result<()> {
    files.sort_by(|a, b| a.0.cmp(&b.0));
    files.dedup_by(|a, b| a.0 == b.0);
    let mut missing = std::collections::BTreeSet::new();
    for question in files.chunks(BLOBS_PER_QUESTION) {
        let blobs = question.iter().map(|(blob, _)| to_proto(blob)).collect();
        let answer = client
            .uploads
            .clone()
            .find_missing_blobs(FindMissingBlobsRequest { blobs, ..Default::default() })
            .await
            .map_err(|status| client.fault("say which files it lacks", &status))?;
        missing.extend(answer.into_inner().missing.into_iter().map(|blob| blob.digest));
    }
    files.retain(|(blob, _)| missing.contains(&blob.digest));
    let total = files.iter().map(|(blob, _)| blob.bytes).sum();
    let progress = Progress::new("uploading", total, Unit::Bytes);
    let done = std::sync::atomic::AtomicU64::new(0);
    let uploads = files.into_iter().map(|(blob, content)| {
        let (progress, done) = (&progress, &done);
        async move {
            write_blob(client, &blob, &content).await?;
            let sum = done.fetch_add(blob.bytes, std::sync::atomic::Ordering::Relaxed) + blob.bytes;
            progress.set(sum, "");
            Ok::<_, CliError>(())
        }
    });
    use futures::StreamExt as _;
    let mut running = futures::stream::iter(uploads).buffer_unordered(UPLOADS_AT_ONCE);
    while let Some(result) = running.next().await {
        result?;
    }
    Ok(())
}

/// Sends one blob; after a lost connection it continues from the coordinator's offset.
async fn write_blob(client: &Client, blob: &BlobRef, content: &Content) -> Result<()> {
    let mut failures = 0;
    let mut known = 0;
    // One attempt sends it to the bucket.
    let mut may_be_direct = true;
    loop {
        let status = match write_once(client, blob, content, &mut may_be_direct).await {
            Ok(true) => return Ok(()),
            Ok(false) => tonic::Status::unavailable("the stream ended before the file did"),
            Err(WriteFault::File(error)) => return Err(error),
            Err(WriteFault::Call(status)) => status,
        };
        // The server reports a different offset when two streams race: ask again.
        if !passing(&status) && status.code() != tonic::Code::OutOfRange {
            return Err(client.fault("take a file", &status));
        }
        let committed = query(client, blob).await.map_or(known, |arrived| arrived.committed_size_bytes);
        failures = if committed > known { 0 } else { failures + 1 };
        known = committed;
        if failures > MAX_FAILURES {
            return Err(client.fault("take a file", &status));
        }
        tokio::time::sleep(std::time::Duration::from_millis(200 * u64::from(failures.min(20)))).await;
    }
}

enum WriteFault {
    File(CliError),
    Call(tonic::Status),
}

async fn query(client: &Client, blob: &BlobRef) -> std::result::Result<QueryBlobResponse, tonic::Status> {
    let request = QueryBlobRequest { blob: Some(to_proto(blob)), ..Default::default() };
    Ok(client.uploads.clone().query_blob(request).await?.into_inner())
}

async fn write_once(
    client: &Client,
    blob: &BlobRef,
    content: &Content,
    may_be_direct: &mut bool,
) -> std::result::Result<bool, WriteFault> {
    let arrived = query(client, blob).await.map_err(WriteFault::Call)?;
    let mut begin = arrived.committed_size_bytes;
    if arrived.direct && std::mem::take(may_be_direct) && client.direct.is_wanted() {
        begin = client.direct.upload(&client.uploads, &to_proto(blob), "", content.clone(), begin).await;
        if begin == blob.bytes {
            return Ok(true);
        }
    }
    let (sender, receiver) = tokio::sync::mpsc::channel(4);
    let (target, content) = (blob.clone(), content.clone());
    let reader = tokio::spawn(async move { send_pieces(&target, &content, begin, &sender).await });
    let answer = client.uploads.clone().write_blob(ReceiverStream::new(receiver)).await;
    match reader.await {
        Ok(Err(error)) => return Err(WriteFault::File(error)),
        Ok(Ok(())) => {}
        Err(panic) => return Err(WriteFault::File(CliError::Message(format!("reading a file: {panic}")))),
    }
    answer.map(|answer| answer.into_inner().complete).map_err(WriteFault::Call)
}

async fn send_pieces(
    blob: &BlobRef,
    content: &Content,
    begin: u64,
    sender: &tokio::sync::mpsc::Sender<WriteBlobRequest>,
) -> Result<()> {
    let mut offset = begin.min(blob.bytes);
    let mut file = match content {
        Content::Bytes(_) => None,
        Content::File(path) => {
            let mut file = tokio::fs::File::open(path).await.map_err(CliError::io("read", path))?;
            file.seek(std::io::SeekFrom::Start(offset)).await.map_err(CliError::io("read", path))?;
            Some((file, path))
        }
    };
    loop {
        let size = (blob.bytes - offset).min(fathom_proto::CHUNK_BYTES as u64) as usize;
        let data = match (&mut file, content) {
            (Some((file, path)), _) => {
                let mut piece = vec![0; size];
                file.read_exact(&mut piece)
                    .await
                    .map_err(CliError::io("read (it changed meanwhile)", *path))?;
                Bytes::from(piece)
            }
            (None, Content::Bytes(bytes)) => bytes.slice(offset as usize..offset as usize + size),
            (None, Content::File(_)) => Bytes::new(),
        };
        let finish = offset + size as u64 == blob.bytes;
        let message = WriteBlobRequest {
            blob: Some(to_proto(blob)),
            offset_bytes: offset,
            data,
            finish,
            ..Default::default()
        };
        // A closed channel means that the call has ended; its response gives the reason.
        if sender.send(message).await.is_err() || finish {
            return Ok(());
        }
        offset += size as u64;
    }
}

fn to_proto(blob: &BlobRef) -> v1::BlobRef {
    v1::BlobRef { digest: blob.digest.clone(), size_bytes: blob.bytes }
}
