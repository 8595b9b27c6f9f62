//! Blobs over loopback: uploads that break or lie, garbage collection, and a cache that workers share.

use std::time::Duration;

use crate::support::{FakeTrainer, TestCluster, reason_of};
use bytes::Bytes;
use fathom_coordinator::objects::Removed;
use fathom_coordinator::retention::Policy;
use fathom_core::scene::BlobRef;
use fathom_proto::v1;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_worker::blobs::{BlobSource, to_proto};
use fathom_worker::cache::BlobCache;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_unreferenced_blobs_are_removed() {
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(FakeTrainer::quick());
    let mut jobs = Vec::new();
    for (name, columns) in [("first", 2), ("second", 1)] {
        let job = cluster.submit(name, columns).await;
        assert_eq!(cluster.finished(&job).await.state(), v1::JobState::Succeeded);
        let files = cluster.artifacts(&job).await;
        jobs.push((job, files));
    }
    let stray = cluster.blobs().upload(&BlobSource::Bytes(Bytes::from("stray"))).await.unwrap();
    let is_there = async |blob: &BlobRef| {
        let request = v1::FindMissingBlobsRequest { blobs: vec![to_proto(blob)], ..Default::default() };
        cluster.uploads().find_missing_blobs(request).await.unwrap().into_inner().missing.is_empty()
    };
    let photograph = &cluster.manifest.views[3].image;
    let keep = |unused_seconds, jobs| Policy {
        jobs,
        unused: Duration::from_secs(unused_seconds),
        uploads: Duration::from_secs(3600),
    };
    assert_eq!(cluster.collect(keep(3600, None)).await.blobs, 0, "all blobs are recent");
    assert!(cluster.collect(keep(0, None)).await.blobs >= 1);
    assert!(!is_there(&stray).await && is_there(photograph).await);
    for (job, files) in &jobs {
        assert_eq!(cluster.artifacts(job).await, *files, "a file of a job was removed");
    }

    // Deleting a job removes the blobs that only it references.
    let delete = v1::DeleteJobRequest { job_id: jobs[0].0.clone() };
    cluster.jobs().delete_job(delete).await.unwrap();
    assert!(cluster.collect(keep(0, None)).await.blobs > 0);
    assert!(is_there(photograph).await, "the other job references it too");
    assert_eq!(cluster.artifacts(&jobs[1].0).await, jobs[1].1);
    let young = cluster.collect(keep(0, Some(Duration::from_secs(3600)))).await;
    assert_eq!(young, Removed::default(), "a job that has just ended was deleted");
    cluster.collect(keep(0, Some(Duration::ZERO))).await;
    assert!(!is_there(photograph).await);
    let gone = cluster.jobs().get_job(v1::GetJobRequest { job_id: jobs[1].0.clone() }).await.unwrap_err();
    assert_eq!(reason_of(&gone), "JOB_NOT_FOUND");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_corrupt_upload_is_refused_and_a_broken_one_goes_on() {
    let cluster = TestCluster::start().await;
    let mut uploads = UploadServiceClient::connect(cluster.url()).await.unwrap();
    let content: Vec<u8> = (0..3_000_000_u32).map(|i| (i * 7 % 251) as u8).collect();
    let blob = to_proto(&BlobSource::Bytes(content.clone().into()).blob_ref().unwrap());
    let piece = |offset: usize, data: &[u8], finish: bool| v1::WriteBlobRequest {
        job_id: String::new(),
        blob: Some(blob.clone()),
        offset_bytes: offset as u64,
        data: data.to_vec().into(),
        finish,
    };
    let half = tokio_stream::iter([piece(0, &content[..900_000], false)]);
    let kept = uploads.write_blob(half).await.unwrap().into_inner();
    assert_eq!((kept.committed_size_bytes, kept.complete), (900_000, false));
    let wrong = tokio_stream::iter([piece(0, &content[..10], false)]);
    let refused = uploads.write_blob(wrong).await.unwrap_err();
    assert_eq!((refused.code(), reason_of(&refused).as_str()), (tonic::Code::OutOfRange, "WRONG_OFFSET"));
    let source = BlobSource::Bytes(content.clone().into());
    cluster.blobs().upload(&source).await.unwrap();
    let target = cluster.dir.path().join("downloaded");
    let known = source.blob_ref().unwrap();
    cluster.blobs().download(&known, &target).await.unwrap();
    assert!(std::fs::read(&target).unwrap() == content, "the download differs");
    assert!(cluster.blobs().missing(&[known]).await.unwrap().is_empty());

    let lie = to_proto(&BlobSource::Bytes("declared".into()).blob_ref().unwrap());
    let corrupt = v1::WriteBlobRequest {
        job_id: String::new(),
        blob: Some(lie.clone()),
        offset_bytes: 0,
        data: "deceived".into(),
        finish: true,
    };
    let refused = uploads.write_blob(tokio_stream::iter([corrupt])).await.unwrap_err();
    assert_eq!((refused.code(), reason_of(&refused).as_str()), (tonic::Code::DataLoss, "DIGEST_MISMATCH"));
    let query = v1::QueryBlobRequest { blob: Some(lie), ..Default::default() };
    let state = uploads.query_blob(query).await.unwrap().into_inner();
    assert_eq!((state.committed_size_bytes, state.complete), (0, false));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_that_share_a_cache_fetch_the_same_blob_at_once() {
    let cluster = TestCluster::start().await;
    let content: Vec<u8> = (0..6_000_000_u32).map(|i| (i % 251) as u8).collect();
    let blob = cluster.blobs().upload(&BlobSource::Bytes(content.clone().into())).await.unwrap();
    let dir = cluster.dir.path().join("shared");
    let open = || BlobCache::open(&dir, u64::MAX).unwrap();
    let (one, other, client) = (open(), open(), cluster.blobs());
    let all = [&one, &other, &one, &other, &one, &other].map(|cache| cache.fetch(&client, &blob));
    for path in futures::future::join_all(all).await {
        assert!(std::fs::read(path.unwrap()).unwrap() == content, "a fetched blob differs");
    }
    let left: Vec<_> = std::fs::read_dir(dir.join(&blob.digest[..2])).unwrap().collect();
    assert_eq!(left.len(), 1, "parts of downloads were left behind: {left:?}");
}
