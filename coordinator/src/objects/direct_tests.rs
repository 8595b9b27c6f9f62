//! Clients that use the bucket themselves, with an S3 server that somebody else wrote.

use std::time::Duration;

use fathom_proto::direct::{Content, Direct, DirectError};

use super::bucket_tests::{at, content, object_count};
use super::direct::{DirectWrite, UNFINISHED_FOR};
use super::s3_server::{S3Server, age};
use super::*;
use crate::schedule::Tenant;

const BYTES: usize = 300_000;

async fn opened(server: &S3Server, data_dir: &Path) -> Arc<BlobStore> {
    let blobs = TenantBlobs::open(at(server), data_dir, 0, Clock::start(), None).await.unwrap();
    blobs.of(&"reef".parse().unwrap()).await.unwrap()
}

fn folder(server: &S3Server, path: &str) -> PathBuf {
    server.folder("scenes/tenants/reef/objects").join(path)
}

pub(super) async fn sent(write: &DirectWrite, content: &[u8]) -> Result<(), DirectError> {
    let (range, content) = (0..content.len() as u64, Content::Bytes(Bytes::copy_from_slice(content)));
    Direct::default().put(&write.request.url, &write.request.headers, &content, range).await
}

pub(super) async fn signed(store: &Arc<BlobStore>, blob: &BlobRef) -> DirectWrite {
    store.sign_write(blob, 0, None).await.unwrap().expect("S3 signs")
}

async fn got(url: &str, offset: u64, bytes: u64) -> Vec<u8> {
    let (mut pieces, mut whole) = (Direct::default().get(url, offset, bytes).await.unwrap(), Vec::new());
    while let Some(piece) = pieces.next().await.unwrap() {
        whole.extend_from_slice(&piece);
    }
    whole
}

#[tokio::test]
async fn a_client_fetches_a_blob_from_the_bucket() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(BYTES);
    let blob = store.put(content.clone().into()).await.unwrap();
    let url = store.url_of(&blob.digest).await.unwrap().expect("S3 signs");
    assert!(got(&url, 0, blob.bytes).await == content);
    assert!(got(&url, 1000, blob.bytes - 1000).await == content[1000..]);

    let other = store.put(Bytes::from_static(b"of the same tenant")).await.unwrap();
    let path_of = |digest: &str| format!("/{}/{digest}?", &digest[..2]);
    let forged = url.replace(&path_of(&blob.digest), &path_of(&other.digest));
    assert_ne!(forged, url, "only the path differs: a wrong date would be refused as malformed");
    let refused = Direct::default().get(&forged, 0, other.bytes).await.unwrap_err();
    assert!(matches!(refused, DirectError::Refused(status) if status == 403), "{refused}");

    let with_tls = at(&server).signed_by(|signing| Some(signing.with_tls()));
    let folder = ObjectsAt::Folder(dir.path().join("folder"));
    for place in [with_tls, at(&server).signed_by(|_| None), folder] {
        let blobs = TenantBlobs::open(place, dir.path(), 0, Clock::start(), None).await.unwrap();
        let store = blobs.of(&Tenant::default()).await.unwrap();
        let blob = store.put(content.clone().into()).await.unwrap();
        assert_eq!(store.url_of(&blob.digest).await.unwrap(), None);
        assert!(store.sign_write(&BlobRef::of(&[1; BYTES]), 0, None).await.unwrap().is_none());
    }
}

#[tokio::test]
async fn what_a_client_sends_is_hashed_before_it_is_a_blob() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(BYTES);
    let blob = BlobRef::of(&content);
    let write = signed(&store, &blob).await;
    assert_eq!(store.used_bytes().await.unwrap(), blob.bytes, "it counts from then on");
    sent(&write, &content).await.unwrap();
    assert!(!store.contains(&blob).await.unwrap(), "nobody has hashed it");
    store.finish_write(&blob, &write.upload, 0, None).await.unwrap();
    assert!(store.read(&blob).await.unwrap() == content);
    assert_eq!(store.used_bytes().await.unwrap(), blob.bytes, "it counts once");
    assert_eq!(object_count(&folder(&server, "uploads")), 0);
    until_empty(&folder(&server, "direct")).await;

    // The URL is still valid.
    sent(&write, &vec![7; BYTES]).await.unwrap();
    assert!(store.read(&blob).await.unwrap() == content, "a client has changed a blob");
    store.finish_write(&blob, &write.upload, 0, None).await.unwrap();
    assert!(store.read(&blob).await.unwrap() == content, "a client has changed a blob");
    until_empty(&folder(&server, "direct")).await;

    let other = BlobRef::of(&[8; BYTES]);
    let write = signed(&store, &other).await;
    sent(&write, &content).await.unwrap();
    let refused = store.finish_write(&other, &write.upload, 0, None).await.unwrap_err();
    assert!(matches!(refused, ObjectError::DigestMismatch { .. }), "{refused}");
    assert!(!store.contains(&other).await.unwrap());
    let used = store.used_bytes().await.unwrap();
    assert_eq!(used, blob.bytes + other.bytes, "its client can still send it again");
    assert_eq!(object_count(&folder(&server, "uploads")), 0, "a refused upload remains");
    until_empty(&folder(&server, "direct")).await;
}

#[tokio::test]
async fn a_client_sends_no_other_length_and_not_beyond_a_limit() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(BYTES);
    let blob = BlobRef::of(&content);
    let mut write = signed(&store, &blob).await;
    for bytes in [BYTES - 1, BYTES + 1] {
        write.request.headers.insert("content-length".into(), bytes.to_string());
        let refused = sent(&write, &vec![7; bytes]).await.unwrap_err();
        assert!(matches!(refused, DirectError::Refused(status) if status == 403), "{bytes} bytes: {refused}");
    }
    let missing = store.finish_write(&blob, &write.upload, 0, None).await.unwrap_err();
    assert!(matches!(missing, ObjectError::NoUpload), "{missing}");
    let of_other = signed(&store, &BlobRef::of(&[6; BYTES])).await.upload;
    assert_ne!(of_other[..2], blob.digest[..2]);
    for upload in ["", "../cas/00", &"0".repeat(64), &of_other] {
        let missing = store.finish_write(&blob, upload, 0, None).await.unwrap_err();
        assert!(matches!(missing, ObjectError::NoUpload), "{upload}: {missing}");
    }

    // Those two count as long as their client can send them.
    let limit = Some(3 * blob.bytes + 1);
    let first = store.sign_write(&blob, 0, limit).await.unwrap().unwrap();
    let refused = store.sign_write(&BlobRef::of(&[9; BYTES]), 0, limit).await.err().expect("a second one");
    assert!(matches!(refused, ObjectError::OverLimit { used_bytes: 900_000, .. }), "{refused}");
    // Sending it here counts instead of it, as long as it lasts.
    let through = store.begin_write(&blob, 0, limit).await.unwrap().unwrap();
    assert_eq!(store.used_bytes().await.unwrap(), 3 * blob.bytes);
    through.pause().await.unwrap();
    assert_eq!(store.used_bytes().await.unwrap(), 3 * blob.bytes, "it counts no longer");
    sent(&first, &content).await.unwrap();
    store.finish_write(&blob, &first.upload, 0, limit).await.unwrap();

    let long = at(&server).signed_by(|signing| Some(signing.writing_from(BYTES as u64)));
    let long = TenantBlobs::open(long, dir.path(), 0, Clock::start(), None).await.unwrap();
    let store = long.of(&Tenant::default()).await.unwrap();
    assert!(store.takes_directly(&blob, 0) && !store.takes_directly(&blob, 5), "less is missing");
    let short = BlobRef { bytes: blob.bytes - 1, ..blob };
    assert!(!store.takes_directly(&short, 0));
    assert!(store.sign_write(&short, 0, None).await.unwrap().is_none());
}

#[tokio::test]
async fn a_long_blob_is_sent_in_parts_in_any_way() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    const PART: u64 = 100_000;
    let place = at(&server).signed_by(|signing| Some(signing.in_parts_of(PART)));
    let blobs = TenantBlobs::open(place, dir.path(), 0, Clock::start(), None).await.unwrap();
    let store = blobs.of(&"reef".parse().unwrap()).await.unwrap();
    let content = content(BYTES + 5);
    let blob = BlobRef::of(&content);
    let used = async || store.used_bytes().await.unwrap();
    let send = async |offset: u64| {
        let write = store.sign_write(&blob, offset, Some(blob.bytes)).await.unwrap().unwrap();
        assert_eq!(used().await, offset + write.bytes, "from byte {offset} on");
        let (start, end) = (offset as usize, (offset + write.bytes) as usize);
        sent(&write, &content[start..end]).await.unwrap();
        write
    };
    assert!(store.takes_directly(&blob, 0) && !store.takes_at_once(&blob));
    assert!(store.takes_at_once(&BlobRef { bytes: PART, ..blob.clone() }));
    let refused = store.sign_write(&blob, 0, Some(blob.bytes - 1)).await.err().expect("over the limit");
    let ObjectError::OverLimit { limit_bytes, .. } = refused else { panic!("{refused}") };
    assert_eq!(limit_bytes, blob.bytes - 1);
    // The second part does not go in before the first.
    let first = send(0).await;
    assert_eq!(first.bytes, PART);
    let early = store.finish_write(&blob, &first.upload, PART, None).await.unwrap_err();
    assert!(matches!(early, ObjectError::WrongOffset { committed_bytes: 0, .. }), "{early}");
    assert_eq!(store.finish_write(&blob, &first.upload, 0, Some(blob.bytes)).await.unwrap(), PART);
    assert_eq!(store.committed(&blob).await.unwrap(), (PART, false));
    assert_eq!(used().await, PART, "what has arrived");
    until_empty(&folder(&server, "direct")).await;
    let again = store.finish_write(&blob, &first.upload, 0, None).await.unwrap_err();
    assert!(matches!(again, ObjectError::NoUpload), "{again}");

    // The second part goes through the coordinator, the third does not, and the last has five bytes.
    let mut writer = store.begin_write(&blob, PART, Some(blob.bytes)).await.unwrap().unwrap();
    writer.append(PART, Bytes::copy_from_slice(&content[PART as usize..2 * PART as usize])).await.unwrap();
    writer.pause().await.unwrap();
    let third = send(2 * PART).await;
    store.finish_write(&blob, &third.upload, 2 * PART, Some(blob.bytes)).await.unwrap();
    let last = send(3 * PART).await;
    assert_eq!(store.finish_write(&blob, &last.upload, 3 * PART, Some(blob.bytes)).await.unwrap(), 5);
    assert!(store.read(&blob).await.unwrap() == content);
    assert_eq!(used().await, blob.bytes, "it counts once");
    assert_eq!(object_count(&folder(&server, "uploads")), 0);

    // Parts of other content are found out after the last one.
    let other = BlobRef::of(&[8; 150_000]);
    for (offset, bytes) in [(0, PART), (PART, 50_000)] {
        let write = store.sign_write(&other, offset, None).await.unwrap().unwrap();
        assert_eq!(write.bytes, bytes);
        sent(&write, &vec![9; bytes as usize]).await.unwrap();
        let finished = store.finish_write(&other, &write.upload, offset, None).await;
        assert_eq!(finished.is_ok(), offset == 0, "{finished:?}");
    }
    assert!(!store.contains(&other).await.unwrap());
    let write = store.sign_write(&other, PART, None).await.unwrap().unwrap();
    sent(&write, &[8; 50_000]).await.unwrap();
    let beyond = store.finish_write(&other, &write.upload, PART + 1, None).await.unwrap_err();
    assert!(matches!(beyond, ObjectError::DigestMismatch { .. }), "{beyond}");
    assert_eq!(object_count(&folder(&server, "uploads")), 0, "refused parts remain");
}

#[tokio::test]
async fn uploads_that_fit_are_finished_at_once_and_in_any_way() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let contents: Vec<Vec<u8>> = (1..=4).map(|byte| vec![byte; BYTES]).collect();
    let blobs: Vec<BlobRef> = contents.iter().map(|content| BlobRef::of(content)).collect();
    let limit = Some(4 * BYTES as u64);
    let mut writes = Vec::new();
    for (blob, content) in blobs.iter().zip(&contents) {
        let write = store.sign_write(blob, 0, limit).await.unwrap().unwrap();
        sent(&write, content).await.unwrap();
        writes.push(write);
    }
    let finish = |index: usize| store.finish_write(&blobs[index], &writes[index].upload, 0, limit);
    let (first, second) = tokio::join!(finish(0), finish(1));
    first.unwrap();
    second.unwrap();
    let third = send_within(&store, &contents[2], limit).await;
    third.finish().await.unwrap();
    finish(3).await.unwrap();
    assert_eq!(store.missing(&blobs).await.unwrap(), [] as [usize; 0]);
    assert_eq!(store.used_bytes().await.unwrap(), 4 * BYTES as u64);
}

async fn send_within(store: &Arc<BlobStore>, content: &[u8], limit: Option<u64>) -> BlobWriter {
    let mut writer = store.begin_write(&BlobRef::of(content), 0, limit).await.unwrap().unwrap();
    writer.append(0, Bytes::copy_from_slice(content)).await.unwrap();
    writer
}

#[tokio::test]
async fn a_part_that_has_arrived_stays_counted() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(BYTES);
    let blob = BlobRef::of(&content);
    let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
    writer.append(0, Bytes::copy_from_slice(&content[..100_000])).await.unwrap();
    writer.pause().await.unwrap();
    let write = signed(&store, &blob).await;
    sent(&write, &[7; BYTES]).await.unwrap();
    let refused = store.finish_write(&blob, &write.upload, 0, None).await.unwrap_err();
    assert!(matches!(refused, ObjectError::WrongOffset { committed_bytes: 100_000, .. }), "{refused}");
    assert_eq!(store.used_bytes().await.unwrap(), 100_000 + blob.bytes);
    let mut writer = store.begin_write(&blob, 100_000, None).await.unwrap().unwrap();
    writer.append(100_000, Bytes::copy_from_slice(&content[100_000..])).await.unwrap();
    writer.finish().await.unwrap();
    assert_eq!(store.used_bytes().await.unwrap(), blob.bytes);
}

#[tokio::test]
async fn what_a_client_does_not_finish_is_deleted_in_time() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(BYTES);
    let blob = BlobRef::of(&content);
    let write = signed(&store, &blob).await;
    sent(&write, &content).await.unwrap();
    assert_eq!(object_count(&folder(&server, "direct")), 1);
    tokio::time::pause();
    tokio::time::advance(Duration::from_secs(50)).await;
    tokio::time::resume();
    assert_eq!(store.used_bytes().await.unwrap(), blob.bytes, "it may still be on its way");
    tokio::time::pause();
    tokio::time::advance(Duration::from_secs(20)).await;
    tokio::time::resume();
    until_empty(&folder(&server, "direct")).await;
    for _ in 0..100 {
        if store.used_bytes().await.unwrap() == 0 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(store.used_bytes().await.unwrap(), 0);
    let missing = store.finish_write(&blob, &write.upload, 0, None).await.unwrap_err();
    assert!(matches!(missing, ObjectError::NoUpload), "{missing}");
}

#[tokio::test]
async fn garbage_collection_removes_what_a_dead_coordinator_signed() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let content = content(BYTES);
    let write = signed(&opened(&server, dir.path()).await, &BlobRef::of(&content)).await;
    sent(&write, &content).await.unwrap();
    let store = opened(&server, dir.path()).await;
    assert_eq!(store.used_bytes().await.unwrap(), 0);
    let collect = async || {
        let week = std::time::SystemTime::now() - Duration::from_secs(7 * 86_400);
        store.remove_unused(week, HashSet::new()).await.unwrap();
        object_count(&folder(&server, "direct"))
    };
    assert_eq!(collect().await, 1, "it may still be finished");
    age(&folder(&server, "direct").join(&write.upload), UNFINISHED_FOR + Duration::from_secs(60));
    assert_eq!(collect().await, 0);
}

pub(super) async fn until_empty(folder: &Path) {
    for _ in 0..100 {
        if object_count(folder) == 0 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{} still has {} files", folder.display(), object_count(folder));
}
