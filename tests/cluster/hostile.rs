//! Attacks by hostile or revoked callers, over real connections.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use fathom_proto::admin::v1::{RevokeTokenRequest, Role};
use fathom_proto::dial::reason;
use fathom_proto::v1::{
    BeginUploadRequest, BlobRef, CommitDatasetRequest, CreateJobRequest, DatasetFile,
    FindMissingBlobsRequest, QueryBlobRequest, ReadBlobRequest, WriteBlobRequest,
};
use fathom_proto::worker::v1 as worker_v1;
use futures::StreamExt;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tonic::{Code, Status};

use crate::callers::{Caller, GuardedCluster, INCARNATION, POINTS, blob, is, said};

/// The protocol ends calls of revoked tokens within this time.
const REVOKED_WITHIN: Duration = Duration::from_secs(2);
/// Size of a piece of a blob, bytes.
const PIECE: usize = 1 << 20;

fn address(cluster: &GuardedCluster) -> SocketAddr {
    cluster.coordinator.address()
}

fn piece(blob: &BlobRef, offset: u64, data: Vec<u8>, finish: bool) -> WriteBlobRequest {
    let (blob, data) = (Some(blob.clone()), data.into());
    WriteBlobRequest { blob, offset_bytes: offset, data, finish, ..Default::default() }
}

async fn revoke(cluster: &GuardedCluster, token_id: &str) {
    let request = RevokeTokenRequest { token_id: token_id.to_owned(), ..Default::default() };
    cluster.operator().admin().revoke_token(request).await.unwrap();
}

async fn register(caller: &Caller, incarnation: &str) -> Result<(), Status> {
    let request = worker_v1::RegisterRequest {
        worker_name: "w1".into(),
        incarnation: incarnation.into(),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        ..Default::default()
    };
    caller.workers().register(request).await.map(drop)
}

#[tokio::test]
async fn silent_connections_block_nobody_and_close_after_ten_seconds() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let mut silent = Vec::new();
    for _ in 0..700 {
        silent.push(TcpStream::connect(address(&cluster)).await.unwrap());
    }
    let begun = Instant::now();
    assert!(cluster.operator().list().await.unwrap().is_empty());
    assert!(begun.elapsed() < Duration::from_secs(2), "{:?}", begun.elapsed());
    // There is room for 512 connections; those silent for the longest are closed first.
    let mut is_closed = async |index: usize| {
        // The server has already sent its settings.
        let mut sent = Vec::new();
        tokio::time::timeout(Duration::from_millis(50), silent[index].read_to_end(&mut sent)).await.is_ok()
    };
    assert!(is_closed(0).await, "the oldest connection was not closed");
    assert!(!is_closed(699).await, "the newest connection was closed too early");
    tokio::time::sleep(Duration::from_secs(12).saturating_sub(begun.elapsed())).await;
    assert!(is_closed(698).await, "a silent connection was not closed");
}

#[tokio::test]
async fn a_revoked_token_ends_an_upload_that_is_under_way() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let (secret, token_id) = cluster.issue(Role::Submitter, "reef").await;
    let thief = cluster.with(Some(&secret));
    let content = vec![7; 3 * PIECE];
    let whole = blob(&content);
    let (first, second) = content.split_at(PIECE);
    let (sender, receiver) = tokio::sync::mpsc::channel(4);
    sender.send(piece(&whole, 0, first.to_vec(), false)).await.unwrap();
    let mut client = thief.uploads();
    let upload = tokio::spawn(async move {
        client.write_blob(tokio_stream::wrappers::ReceiverStream::new(receiver)).await.map(drop)
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    revoke(&cluster, &token_id).await;
    let begun = Instant::now();
    let answer = tokio::time::timeout(REVOKED_WITHIN, upload).await.expect("the upload continued").unwrap();
    assert_eq!(said(answer), is(Code::Unauthenticated, "TOKEN_REFUSED"));
    assert!(begun.elapsed() < REVOKED_WITHIN, "{:?}", begun.elapsed());
    // Received bytes are kept, and a caller with a token resumes the upload.
    let successor = cluster.caller(Role::Submitter, "reef").await;
    let query = QueryBlobRequest { blob: Some(whole.clone()), ..Default::default() };
    let arrived = successor.uploads().query_blob(query).await.unwrap().into_inner().committed_size_bytes;
    assert_eq!(arrived, PIECE as u64);
    let rest = piece(&whole, arrived, second[..PIECE].to_vec(), false);
    let end = piece(&whole, arrived + PIECE as u64, second[PIECE..].to_vec(), true);
    assert!(
        successor
            .uploads()
            .write_blob(futures::stream::iter([rest, end]))
            .await
            .unwrap()
            .into_inner()
            .complete
    );
}

#[tokio::test]
async fn a_revoked_token_ends_a_download_however_slowly_it_is_read() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let owner = cluster.caller(Role::Submitter, "reef").await;
    let content = vec![7; 24 * PIECE];
    let whole = blob(&content);
    let pieces: Vec<_> = content
        .chunks(PIECE)
        .enumerate()
        .map(|(k, data)| piece(&whole, (k * PIECE) as u64, data.to_vec(), k == 23))
        .collect();
    owner.uploads().write_blob(futures::stream::iter(pieces)).await.unwrap();
    let (secret, token_id) = cluster.issue(Role::Viewer, "reef").await;
    let request = || ReadBlobRequest { digest: whole.digest.clone(), ..Default::default() };
    let thief = cluster.with(Some(&secret));
    let mut taken = thief.uploads().read_blob(request()).await.unwrap().into_inner();
    taken.next().await.unwrap().unwrap();
    // A download that is never read: HTTP/2 holds the ready data, and nothing requests more.
    let other = cluster.with(Some(&secret));
    let mut held = other.uploads().read_blob(request()).await.unwrap().into_inner();
    tokio::time::sleep(Duration::from_millis(300)).await;
    revoke(&cluster, &token_id).await;
    tokio::time::sleep(REVOKED_WITHIN).await;
    for stream in [&mut taken, &mut held] {
        let (mut bytes, mut end) = (0, None);
        while let Some(next) = stream.next().await {
            match next {
                Ok(piece) => bytes += piece.data.len(),
                Err(status) => end = Some(status),
            }
        }
        // Data in flight may still arrive: the windows of HTTP/2.
        assert!(bytes < 12 * PIECE, "{bytes} bytes arrived after the token was revoked");
        let end = end.expect("it ended as if it were complete");
        // A stream that is not read cannot be answered; only the end of its connection frees it. An answer
        // now would mean that it waited for its client until here.
        assert_eq!(reason(&end), None, "the connection was still open: {end:?}");
    }
}

#[tokio::test]
async fn waiting_downloads_delay_no_short_call_of_their_tenant() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let owner = cluster.caller(Role::Submitter, "reef").await;
    let content = vec![7; 8 * PIECE];
    let whole = blob(&content);
    let pieces = content.chunks(PIECE).enumerate();
    let pieces = pieces.map(|(k, data)| piece(&whole, (k * PIECE) as u64, data.to_vec(), k == 7));
    owner.uploads().write_blob(futures::stream::iter(pieces.collect::<Vec<_>>())).await.unwrap();
    let held: Vec<_> = (0..200)
        .map(|_| {
            let mut client = owner.uploads();
            let digest = whole.digest.clone();
            tokio::spawn(async move {
                let request = ReadBlobRequest { digest, ..Default::default() };
                let answer = client.read_blob(request).await;
                std::future::pending::<()>().await;
                drop(answer);
            })
        })
        .collect();
    tokio::time::sleep(Duration::from_millis(500)).await;
    let other = cluster.caller(Role::Viewer, "reef").await;
    let answer = tokio::time::timeout(Duration::from_secs(2), other.list()).await;
    assert!(answer.expect("it waits for downloads").unwrap().is_empty());
    held.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test]
async fn a_revoked_token_ends_a_waiting_claim_and_its_worker() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let (secret, token_id) = cluster.issue(Role::Worker, "").await;
    let worker = cluster.with(Some(&secret));
    register(&worker, INCARNATION).await.unwrap();
    let mut client = worker.workers();
    let claim =
        worker_v1::ClaimRequest { incarnation: INCARNATION.into(), request_id: "a".into(), wait_ms: 30_000 };
    let waits = tokio::spawn(async move { client.claim(claim).await.map(drop) });
    tokio::time::sleep(Duration::from_millis(300)).await;
    revoke(&cluster, &token_id).await;
    let answer = tokio::time::timeout(REVOKED_WITHIN, waits).await.expect("the claim still waits").unwrap();
    assert_eq!(said(answer), is(Code::Unauthenticated, "TOKEN_REFUSED"));
}

#[tokio::test]
async fn revoking_ones_own_token_is_confirmed() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let (secret, token_id) = cluster.issue(Role::Operator, "").await;
    let operator = cluster.with(Some(&secret));
    let request = RevokeTokenRequest { token_id, ..Default::default() };
    assert!(operator.admin().revoke_token(request).await.unwrap().into_inner().revoke_time.is_some());
    assert_eq!(said(operator.list().await), is(Code::Unauthenticated, "TOKEN_REFUSED"));
}

#[tokio::test]
async fn an_incarnation_belongs_only_to_the_token_that_registered_it() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let (own, other) =
        (cluster.caller(Role::Worker, "reef").await, cluster.caller(Role::Worker, "wreck").await);
    register(&own, INCARNATION).await.unwrap();
    register(&own, INCARNATION).await.expect("the same worker, after a lost answer");
    assert_eq!(said(register(&other, INCARNATION).await), is(Code::PermissionDenied, "OTHER_WORKER"));
    let claim =
        worker_v1::ClaimRequest { incarnation: INCARNATION.into(), request_id: "a".into(), wait_ms: 0 };
    assert_eq!(said(other.workers().claim(claim).await), is(Code::NotFound, "UNKNOWN_WORKER"));
    let upper = INCARNATION.to_uppercase();
    for wrong in ["", "../../x", "worker 1", &upper, &INCARNATION.replace('-', "")] {
        assert_eq!(said(register(&own, wrong).await), is(Code::InvalidArgument, "BAD_ARGUMENT"), "{wrong}");
    }
}

#[tokio::test]
async fn uploads_count_from_their_first_message_even_in_a_burst() {
    let cluster = GuardedCluster::start(|config, _| config.tenant_bytes = 4_000_000).await;
    let caller = cluster.caller(Role::Submitter, "reef").await;
    let spent = is(Code::ResourceExhausted, "QUOTA_SPENT");
    // None of them ever finishes, and each alone would fit.
    let begun = (0..12_u8).map(|k| {
        let caller = &caller;
        async move {
            let content = vec![k; 960_000];
            let half = piece(&blob(&content), 0, content[..800_000].to_vec(), false);
            caller.uploads().write_blob(futures::stream::iter([half])).await.map(drop)
        }
    });
    let answers = futures::future::join_all(begun).await;
    let taken = answers.iter().filter(|answer| answer.is_ok()).count();
    assert!(taken <= 5, "{taken} uploads were accepted");
    for refused in answers.into_iter().filter(Result::is_err) {
        assert_eq!(said(refused), spent);
    }
    // Afterwards the received bytes count, complete or not, also in the next process.
    let room = 4_000_000 - 800_000 * taken;
    let too_much = vec![99; room + 1];
    assert_eq!(said(caller.upload(&too_much).await), spent);
    let fits = vec![98; room.min(PIECE)];
    caller.upload(&fits).await.unwrap();
}

#[tokio::test]
async fn a_silent_upload_ends_and_lets_another_continue() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let caller = cluster.caller(Role::Submitter, "reef").await;
    let content = vec![7; 2 * PIECE];
    let whole = blob(&content);
    let (sender, receiver) = tokio::sync::mpsc::channel(4);
    sender.send(piece(&whole, 0, content[..PIECE].to_vec(), false)).await.unwrap();
    let mut client = caller.uploads();
    let idle = tokio::spawn(async move {
        client.write_blob(tokio_stream::wrappers::ReceiverStream::new(receiver)).await
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    let rest = || piece(&whole, PIECE as u64, content[PIECE..].to_vec(), true);
    let busy = said(caller.uploads().write_blob(futures::stream::iter([rest()])).await);
    assert_eq!(busy, is(Code::Aborted, "WRITE_IN_PROGRESS"));
    let answer =
        tokio::time::timeout(Duration::from_secs(25), idle).await.expect("it still locks the blob").unwrap();
    let answer = answer.unwrap().into_inner();
    assert_eq!((answer.complete, answer.committed_size_bytes), (false, PIECE as u64));
    assert!(
        caller.uploads().write_blob(futures::stream::iter([rest()])).await.unwrap().into_inner().complete
    );
    drop(sender);
}

#[tokio::test]
async fn unknown_methods_are_unimplemented_and_reflection_answers() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let call = async |caller: &Caller, path: &'static str| {
        let mut grpc = tonic::client::Grpc::new(caller.connection.clone());
        grpc.ready().await.unwrap();
        let codec = tonic_prost::ProstCodec::<FindMissingBlobsRequest, FindMissingBlobsRequest>::default();
        let request = tonic::Request::new(FindMissingBlobsRequest::default());
        let answer = grpc.unary(request, http::uri::PathAndQuery::from_static(path), codec).await;
        answer.unwrap_err().code()
    };
    for caller in [cluster.with(None), cluster.operator()] {
        for path in ["/fathom.v9.Nothing/Do", "/fathom.v1.JobService/Nothing", "/x"] {
            assert_eq!(call(&caller, path).await, Code::Unimplemented, "{path}");
        }
    }
    let path = "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo";
    assert_eq!(call(&cluster.with(None), path).await, Code::Unauthenticated);
    assert_ne!(call(&cluster.operator(), path).await, Code::Unimplemented);
}

#[tokio::test]
async fn ten_thousand_files_with_longest_paths_fit_one_message() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let caller = cluster.caller(Role::Submitter, "reef").await;
    let photograph = caller.upload(b"a photograph").await.unwrap();
    let files = |count: usize| {
        let folder = "d/".repeat(507);
        let path = |index| format!("{folder}{index:06}.jpg");
        (0..count).map(|k| DatasetFile { path: path(k), blob: Some(photograph.clone()) }).collect()
    };
    let request = |files| BeginUploadRequest {
        dataset_id: "scene".into(),
        request_id: "one".into(),
        files,
        list: None,
    };
    let begun = caller.uploads().begin_upload(request(files(10_000))).await.unwrap().into_inner();
    assert_eq!((begun.missing_count, begun.dataset.unwrap().files), (0, 10_000));
    let many = said(caller.uploads().begin_upload(request(files(10_001))).await);
    assert_eq!(many, is(Code::InvalidArgument, "BAD_ARGUMENT"));
}

/// The HTTP/2 preface, with empty settings.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

/// An HTTP/2 frame (RFC 9113, 4.1).
fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// Request fields in HPACK without a table and without Huffman coding (RFC 7541, 6.2.2).
fn fields(of: &[(&str, &str)]) -> Vec<u8> {
    let text = |text: &str| [&[u8::try_from(text.len()).unwrap()], text.as_bytes()].concat();
    of.iter().flat_map(|(name, value)| [vec![0], text(name), text(value)].concat()).collect()
}

/// The head of a method call, with a token.
fn head(path: &str, token: &str) -> Vec<u8> {
    let bearer = format!("Bearer {token}");
    fields(&[
        (":method", "POST"),
        (":scheme", "http"),
        (":path", path),
        (":authority", "x"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
        ("authorization", &bearer),
    ])
}

#[tokio::test]
async fn broken_and_flooding_http_2_is_closed_and_delays_nobody() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let token = cluster.first_token();
    let call = "/fathom.v1.JobService/ListJobs";
    let open = |stream| frame(1, 4, stream, &head(call, &token));
    let begin = frame(1, 0, 1, &head(call, &token));
    let flood = |one: Vec<u8>, times: usize| [PREFACE.to_vec(), one.repeat(times)].concat();
    let resets = (0..20_000).flat_map(|k| [open(2 * k + 1), frame(3, 0, 2 * k + 1, &[0, 0, 0, 8])].concat());
    let too_long = [open(1), frame(0, 0, 1, &[0, 255, 255, 255, 255, 7])].concat();
    let packed = [open(1), frame(0, 1, 1, &[1, 0, 0, 0, 2, 31, 139])].concat();
    for (name, bytes) in [
        ("garbage", vec![0x5a; 100_000]),
        ("HTTP/1.1", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n".to_vec()),
        ("half a preface", PREFACE[..12].to_vec()),
        ("a frame that is too long", [PREFACE, &[255, 255, 255, 0, 0, 0, 0, 0, 1]].concat()),
        ("settings on a stream", flood(frame(4, 0, 1, &[]), 1)),
        ("rapid resets", [PREFACE.to_vec(), resets.collect()].concat()),
        ("continuations without an end", [flood(begin, 1), frame(9, 0, 1, &[0; 16]).repeat(50_000)].concat()),
        ("pings", flood(frame(6, 0, 0, &[7; 8]), 50_000)),
        ("settings", flood(frame(4, 0, 0, &[0, 4, 0, 0, 255, 255]), 50_000)),
        ("empty data", [flood(open(1), 1), frame(0, 0, 1, &[]).repeat(50_000)].concat()),
        ("a length of 4 GiB", flood(too_long, 1)),
        ("a message that says it is packed", flood(packed, 1)),
        ("HPACK that names nothing", flood(frame(1, 5, 1, &[0xff; 200]), 1)),
    ] {
        let mut stream = TcpStream::connect(address(&cluster)).await.unwrap();
        // The server may send GOAWAY in the middle of a flood, and stops reading from a client that reads no
        // answers.
        let _ = tokio::time::timeout(Duration::from_secs(1), stream.write_all(&bytes)).await;
        let begun = Instant::now();
        assert!(cluster.operator().list().await.unwrap().is_empty());
        assert!(begun.elapsed() < Duration::from_secs(2), "after {name}: {:?}", begun.elapsed());
    }
}

#[tokio::test]
async fn a_message_longer_than_a_piece_is_refused_by_length() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let caller = cluster.caller(Role::Submitter, "reef").await;
    let content = vec![7; 2 * PIECE];
    let long = piece(&blob(&content), 0, content, true);
    assert_eq!(
        said(caller.uploads().write_blob(futures::stream::iter([long])).await),
        is(Code::InvalidArgument, "BAD_ARGUMENT")
    );
}

#[tokio::test]
async fn no_job_is_created_from_a_dataset_with_a_lost_file() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let caller = cluster.caller(Role::Submitter, "reef").await;
    let manifest = caller.upload_scene().await.unwrap();
    let file = |path: &str, blob: &BlobRef| DatasetFile { path: path.into(), blob: Some(blob.clone()) };
    let begin = BeginUploadRequest {
        dataset_id: "scene".into(),
        request_id: "one".into(),
        files: vec![file("manifest.json", &manifest), file("points.bin", &blob(POINTS))],
        list: None,
    };
    caller.uploads().begin_upload(begin).await.unwrap();
    let commit = CommitDatasetRequest { dataset_id: "scene".into() };
    caller.uploads().commit_dataset(commit).await.unwrap();
    let digest = blob(POINTS).digest;
    let objects = cluster.dir.path().join("data/tenants/reef/objects/cas");
    std::fs::remove_file(objects.join(&digest[..2]).join(&digest)).unwrap();
    let create = CreateJobRequest {
        request_id: "a request".into(),
        config_json: "{}".into(),
        dataset_id: "scene".into(),
        ..Default::default()
    };
    let refused = caller.jobs().create_job(create).await.unwrap_err();
    assert!(refused.message().contains("the sparse points"), "{}", refused.message());
    assert_eq!(said(Err::<(), _>(refused)), is(Code::FailedPrecondition, "BLOB_NOT_FOUND"));
    assert!(caller.list().await.unwrap().is_empty());
}
