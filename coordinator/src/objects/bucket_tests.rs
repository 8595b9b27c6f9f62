//! Blobs in a bucket of an S3 server that somebody else wrote.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use object_store::RetryConfig;
use object_store::aws::{AmazonS3, AmazonS3Builder};
use object_store::prefix::PrefixStore;

use super::bucket::PART_BYTES;
use super::s3_server::{BUCKET, Fault, S3Server, age};
use super::*;
use crate::own_tasks::OwnTaskError;
use crate::schedule::Tenant;

const DAY: Duration = Duration::from_secs(86_400);
const PREFIX: &str = "scenes";

fn s3_of(server: &S3Server, retries: RetryConfig) -> AmazonS3 {
    let mut builder = AmazonS3Builder::new().with_bucket_name(BUCKET).with_retry(retries);
    for (name, value) in server.environment() {
        let key = name.to_ascii_lowercase().parse().unwrap();
        builder = builder.with_config(key, value);
    }
    place::use_one_provider();
    builder.build().unwrap()
}

fn at_with(server: &S3Server, retries: RetryConfig) -> ObjectsAt {
    let s3 = Arc::new(s3_of(server, retries));
    let signing = Some(Signing::of_s3(Arc::clone(&s3), PREFIX.into()));
    ObjectsAt::Bucket { url: server.url(PREFIX), store: Arc::new(PrefixStore::new(s3, PREFIX)), signing }
}

pub(super) fn at(server: &S3Server) -> ObjectsAt {
    at_with(server, place::retries())
}

/// The store of the default tenant, as after a start of the coordinator.
async fn opened(server: &S3Server, data_dir: &Path) -> Arc<BlobStore> {
    let blobs = TenantBlobs::open(at(server), data_dir, 0, Clock::start(), None).await.unwrap();
    blobs.of(&Tenant::default()).await.unwrap()
}

pub(super) fn objects(server: &S3Server, path: &str) -> PathBuf {
    server.folder(PREFIX).join("objects").join(path)
}

pub(super) fn key(server: &S3Server, blob: &BlobRef) -> PathBuf {
    objects(server, "cas").join(&blob.digest[..2]).join(&blob.digest)
}

pub(super) fn content(bytes: usize) -> Vec<u8> {
    (0..bytes).map(|index| (index as u32).wrapping_mul(2_654_435_761).to_le_bytes()[3]).collect()
}

pub(super) async fn send(store: &Arc<BlobStore>, content: &[u8], offset: usize, end: usize) -> BlobWriter {
    let blob = BlobRef::of(content);
    let mut writer = store.begin_write(&blob, offset as u64, None).await.unwrap().unwrap();
    for at in (offset..end).step_by(1 << 20) {
        let piece = &content[at..end.min(at + (1 << 20))];
        writer.append(at as u64, Bytes::copy_from_slice(piece)).await.unwrap();
    }
    writer
}

#[tokio::test]
async fn blobs_small_and_large_arrive_and_are_read() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    for bytes in [0, 1, 100_000, PART_BYTES, 2 * PART_BYTES + 12_345] {
        let content = content(bytes);
        let blob = BlobRef::of(&content);
        assert!(!store.contains(&blob).await.unwrap());
        send(&store, &content, 0, bytes).await.finish().await.unwrap();
        assert_eq!(store.missing(&[blob.clone(), BlobRef::of(b"other")]).await.unwrap(), [1]);
        assert!(store.read(&blob).await.unwrap() == content, "{bytes} bytes");
        let middle = bytes / 2..bytes.min(bytes / 2 + 1000);
        if !middle.is_empty() {
            let read = store.range(&blob.digest, middle.start as u64..middle.end as u64).await.unwrap();
            assert!(read == content[middle], "{bytes} bytes");
        }
        assert!(store.begin_write(&blob, 0, None).await.unwrap().is_none(), "it is sent again");
    }
    let beyond = store.range(&BlobRef::of(&content(1)).digest, 0..2).await.unwrap_err();
    assert!(!matches!(beyond, ObjectError::NotFound(_)), "{beyond}");
    let total = (100_001 + 3 * PART_BYTES + 12_345) as u64;
    assert_eq!(store.used_bytes().await.unwrap(), total);
    assert_eq!(
        opened(&server, dir.path()).await.used_bytes().await.unwrap(),
        total,
        "the next process counts others"
    );
    assert_eq!(
        store.used_bytes().await.unwrap(),
        opened(&server, dir.path()).await.used_bytes().await.unwrap()
    );
    let rest = object_count(&objects(&server, "uploads"));
    assert_eq!(rest, 0, "segments of complete uploads remain");
}

pub(super) fn object_count(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| if entry.path().is_dir() { object_count(&entry.path()) } else { 1 }).sum()
}

#[tokio::test]
async fn a_broken_upload_goes_on_in_another_process() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let content = content(3 * PART_BYTES);
    let blob = BlobRef::of(&content);
    let first = PART_BYTES + 5000;
    let store = opened(&server, dir.path()).await;
    assert_eq!(send(&store, &content, 0, first).await.pause().await.unwrap(), first as u64);
    assert!(!store.contains(&blob).await.unwrap(), "a part of a blob is visible");

    // This client disconnects: its writer is dropped, and the bytes are saved in the background.
    let store = opened(&server, dir.path()).await;
    assert_eq!(store.committed(&blob).await.unwrap(), (first as u64, false));
    assert_eq!(store.used_bytes().await.unwrap(), first as u64);
    let second = 2 * PART_BYTES;
    drop(send(&store, &content, first, second).await);
    while matches!(store.begin_write(&blob, 0, None).await, Err(ObjectError::Busy(_))) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let wrong = store.begin_write(&blob, 0, None).await.err().unwrap();
    assert!(
        matches!(wrong, ObjectError::WrongOffset { committed_bytes, .. } if committed_bytes == second as u64)
    );

    let store = opened(&server, dir.path()).await;
    send(&store, &content, second, content.len()).await.finish().await.unwrap();
    assert!(store.read(&blob).await.unwrap() == content);
    assert_eq!(
        (store.used_bytes().await.unwrap(), store.declared_bytes(&[&blob.digest]).await.unwrap()),
        (content.len() as u64, 0)
    );
}

#[tokio::test]
async fn bytes_that_differ_from_the_declaration_are_deleted() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let blob = BlobRef::of(b"the truth");
    for lie in [&b"the troth"[..], b"the trut", b"the truth and more"] {
        let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
        let error = match writer.append(0, Bytes::copy_from_slice(lie)).await {
            Ok(()) => writer.finish().await.unwrap_err(),
            Err(error) => error,
        };
        assert!(matches!(error, ObjectError::DigestMismatch { .. }), "{lie:?}: {error}");
        assert_eq!(store.committed(&blob).await.unwrap(), (0, false), "{lie:?} left something behind");
    }
    // Also when the bucket has changed what arrived before.
    let content = content(2 * PART_BYTES);
    send(&store, &content, 0, PART_BYTES).await.pause().await.unwrap();
    let segments = objects(&server, "uploads").join(&BlobRef::of(&content).digest);
    let segment = std::fs::read_dir(segments).unwrap().next().unwrap().unwrap().path();
    std::fs::write(&segment, vec![7; PART_BYTES]).unwrap();
    let error = send(&store, &content, PART_BYTES, content.len()).await.finish().await.unwrap_err();
    assert!(matches!(error, ObjectError::DigestMismatch { .. }), "{error}");
    assert_eq!(store.committed(&BlobRef::of(&content)).await.unwrap(), (0, false));
    assert_eq!(store.used_bytes().await.unwrap(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_of_the_coordinator_becomes_a_blob() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(2 * PART_BYTES + 77);
    let blob = BlobRef::of(&content);
    std::fs::write(store.staging_path("merged"), &content).unwrap();
    store.adopt("merged", blob.clone()).await.unwrap();
    assert!(!store.staging_path("merged").exists());
    assert_eq!(store.digest_of(&blob).await.unwrap(), blob.digest);
    let (files, path) = (store.files(), store.path_of(&blob).unwrap());
    // As a thread of the merge.
    let thread = std::thread::spawn(move || {
        use std::io::{Read, Seek, SeekFrom};
        let (mut file, bytes) = files.open(&path).unwrap();
        let mut end = Vec::new();
        file.seek(SeekFrom::Start(bytes - 100)).unwrap();
        file.read_to_end(&mut end).unwrap();
        let mut start = [0; 100];
        file.seek(SeekFrom::Start(5)).unwrap();
        file.read_exact(&mut start).unwrap();
        (start.to_vec(), end, bytes)
    });
    let read = tokio::task::spawn_blocking(move || thread.join().unwrap());
    let (start, end, bytes) = read.await.unwrap();
    assert_eq!(bytes, blob.bytes);
    assert!(start == content[5..105] && end == content[content.len() - 100..]);
    // A file that the disk changed is not uploaded.
    std::fs::write(store.staging_path("changed"), b"changed").unwrap();
    let refused = store.adopt("changed", BlobRef::of(b"written")).await.unwrap_err();
    assert!(matches!(refused, ObjectError::Damaged(_)), "{refused}");
    assert!(!store.contains(&BlobRef::of(b"written")).await.unwrap());
}

#[tokio::test]
async fn a_blob_that_the_bucket_changed_is_quarantined() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let blob = store.put(Bytes::from_static(b"the truth")).await.unwrap();
    assert!(!store.set_aside_if_damaged(&blob.digest).await.unwrap());
    assert!(!store.set_aside_if_damaged(&"0".repeat(64)).await.unwrap(), "a missing blob cannot be damaged");
    std::fs::write(key(&server, &blob), b"the troth").unwrap();
    let looking = TenantBlobs::existing(&at(&server), &Tenant::default()).unwrap().unwrap();
    assert!(matches!(looking.read(&blob).await, Err(ObjectError::Damaged(_))));
    assert!(store.contains(&blob).await.unwrap(), "a reader that only looks has moved it");
    assert!(matches!(store.read(&blob).await, Err(ObjectError::Damaged(_))));
    assert!(matches!(store.read(&blob).await, Err(ObjectError::NotFound(_))));
    assert_eq!(std::fs::read(objects(&server, "damaged").join(&blob.digest)).unwrap(), b"the troth");
    send(&store, b"the truth", 0, 9).await.finish().await.unwrap();
    assert_eq!(store.read(&blob).await.unwrap(), &b"the truth"[..]);
}

#[tokio::test]
async fn old_objects_are_removed_unless_used_or_checked() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let mut blobs = Vec::new();
    for name in ["used", "asked", "old", "young"] {
        blobs.push(store.put(Bytes::from(name)).await.unwrap());
    }
    let [used, asked, old, young]: [BlobRef; 4] = blobs.try_into().unwrap();
    let half = content(PART_BYTES + 10);
    let store = opened(&server, dir.path()).await;
    send(&store, &half, 0, 10).await.pause().await.unwrap();
    let uploads = objects(&server, "uploads").join(&BlobRef::of(&half).digest);
    let segment = || std::fs::read_dir(&uploads).unwrap().next().unwrap().unwrap().path();
    for blob in [&used, &asked, &old] {
        age(&key(&server, blob), 2 * DAY);
    }
    age(&segment(), 2 * DAY);
    let kept = HashSet::from([used.digest.clone()]);
    let remembered = || match &store.place {
        Place::Bucket(bucket) => bucket.remembered(),
        Place::Disk(_) => panic!("it is in a bucket"),
    };
    assert!(store.contains(&young).await.unwrap() && !store.contains(&BlobRef::of(b"no")).await.unwrap());
    assert_eq!(remembered(), 0, "callers fill the memory with missing or young blobs");
    assert!(store.contains(&asked).await.unwrap());
    assert_eq!(remembered(), 1);
    let running = send(&store, &half, 10, 20).await;
    let before = SystemTime::now() - DAY;
    let removed = store.remove_unused(before, kept.clone()).await.unwrap();
    assert_eq!(removed, Removed { blobs: 1, uploads: 0, bytes: 3 }, "a running upload is not garbage");
    for (blob, is_there) in [(&used, true), (&asked, true), (&old, false), (&young, true)] {
        assert_eq!(store.contains(blob).await.unwrap(), is_there, "{blob:?}");
    }
    running.pause().await.unwrap();
    let removed = store.remove_unused(SystemTime::now() + DAY, kept).await.unwrap();
    assert_eq!((removed.blobs, removed.uploads), (2, 1));
    assert_eq!(store.committed(&BlobRef::of(&half)).await.unwrap(), (0, false), "it restarts");
    assert_eq!(store.used_bytes().await.unwrap(), 4);
}

#[tokio::test]
async fn tenants_are_apart_and_found_again() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let [reef, wreck] = ["reef", "wreck"].map(|name| name.parse::<Tenant>().unwrap());
    let blobs = TenantBlobs::open(at(&server), dir.path(), 0, Clock::start(), None).await.unwrap();
    let blob = blobs.of(&reef).await.unwrap().put(Bytes::from_static(b"a photograph")).await.unwrap();
    assert!(!blobs.of(&wreck).await.unwrap().contains(&blob).await.unwrap());
    let blobs = TenantBlobs::open(at(&server), dir.path(), 0, Clock::start(), None).await.unwrap();
    let all = blobs.all().await.unwrap();
    let names: Vec<String> = all.iter().map(|(tenant, _)| tenant.to_string()).collect();
    assert_eq!(names, ["default", "reef"]);
    assert_eq!(blobs.used_bytes(&reef).await.unwrap(), 12);
}

#[tokio::test]
async fn a_bucket_serves_one_deployment_only() {
    let server = S3Server::start();
    let place = at(&server);
    place.hold_for("one", Path::new("data")).await.unwrap();
    place.hold_for("one", Path::new("data")).await.unwrap();
    let refused = place.hold_for("other", Path::new("data")).await.unwrap_err().to_string();
    assert!(
        refused.contains("s3://reef/scenes has the files of another deployment (one, this is other)"),
        "{refused}"
    );
    assert!(refused.contains("remove fathom-deployment"), "{refused}");
}

#[tokio::test]
async fn faults_of_the_server_pass() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let slow = Fault::Slow(Duration::from_millis(20));
    for (round, fault) in
        [Fault::Status(500), Fault::Status(503), slow, Fault::Truncated].into_iter().enumerate()
    {
        server.break_every(3, Some(fault));
        let before = server.requests();
        let mut content = content(PART_BYTES + 1000);
        content[0] = round as u8;
        let blob = BlobRef::of(&content);
        send(&store, &content, 0, content.len() / 2).await.pause().await.unwrap();
        send(&store, &content, content.len() / 2, content.len()).await.finish().await.unwrap();
        assert!(store.read(&blob).await.unwrap() == content, "{fault:?}");
        assert_eq!(store.digest_of(&blob).await.unwrap(), blob.digest, "{fault:?}");
        assert!(server.requests().1 > before.1, "{fault:?} never happened");
    }
    // Whichever request of a blob's way it is.
    for every in 1..8 {
        server.break_every(1 + every % 4, Some(Fault::Truncated));
        let mut content = content(PART_BYTES + 2000);
        content[0] = every as u8;
        if every % 4 > 0 {
            let blob = store.put(content.clone().into()).await.unwrap();
            assert!(store.read(&blob).await.unwrap() == content, "every {every}");
        }
    }
    server.break_every(1, None);
    assert_eq!(object_count(&objects(&server, "cas")), 10);
}

#[tokio::test]
async fn an_outage_of_the_bucket_is_no_failed_attempt() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let once = RetryConfig { max_retries: 0, ..RetryConfig::default() };
    let at = at_with(&server, once);
    let blobs = TenantBlobs::open(at, dir.path(), 0, Clock::start(), None).await.unwrap();
    let store = blobs.of(&Tenant::default()).await.unwrap();
    let blob = store.put(Bytes::from_static(b"a result")).await.unwrap();
    let opened = |store: Arc<BlobStore>, blob: BlobRef| async move {
        let (files, path) = (store.files(), store.path_of(&blob).unwrap());
        let opened = tokio::task::spawn_blocking(move || files.open(&path).map(drop)).await.unwrap();
        OwnTaskError::of_io(&opened.unwrap_err())
    };
    server.break_every(1, Some(Fault::Status(503)));
    assert!(opened(Arc::clone(&store), blob.clone()).await.is_outage);
    let error = store.read(&blob).await.unwrap_err();
    assert!(matches!(error, ObjectError::Unavailable(_)), "{error}");
    assert!(OwnTaskError::from(error).is_outage);
    server.break_every(1, None);
    assert!(!opened(store, BlobRef::of(b"never sent")).await.is_outage, "a missing file is no outage");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_leaves_while_a_part_travels_loses_nothing() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let store = opened(&server, dir.path()).await;
    let content = content(2 * PART_BYTES + 10);
    let blob = BlobRef::of(&content);
    let mut writer = send(&store, &content, 0, PART_BYTES - 5).await;
    server.break_every(1, Some(Fault::Slow(Duration::from_millis(300))));
    let piece = Bytes::copy_from_slice(&content[PART_BYTES - 5..PART_BYTES + 7]);
    let append = writer.append((PART_BYTES - 5) as u64, piece);
    assert!(
        tokio::time::timeout(Duration::from_millis(100), append).await.is_err(),
        "the part is there already"
    );
    drop(writer);
    assert!(matches!(store.begin_write(&blob, 0, None).await, Err(ObjectError::Busy(_))));
    server.break_every(1, None);
    while matches!(store.begin_write(&blob, 1, None).await, Err(ObjectError::Busy(_))) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let arrived = PART_BYTES + 7;
    assert_eq!(store.committed(&blob).await.unwrap(), (arrived as u64, false));
    send(&store, &content, arrived, content.len()).await.finish().await.unwrap();
    assert!(store.read(&blob).await.unwrap() == content);
}

#[test]
fn a_process_may_end_in_the_middle_of_an_upload() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let content = content(2 * PART_BYTES);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (writer, store) = runtime.block_on(async {
        let store = opened(&server, dir.path()).await;
        (send(&store, &content, 0, PART_BYTES + 100).await, store)
    });
    drop(runtime);
    drop(writer);
    drop(store);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let store = opened(&server, dir.path()).await;
        let (arrived, _) = store.committed(&BlobRef::of(&content)).await.unwrap();
        send(&store, &content, arrived as usize, content.len()).await.finish().await.unwrap();
        assert!(store.read(&BlobRef::of(&content)).await.unwrap() == content);
    });
}

#[tokio::test]
async fn a_bucket_that_is_gone_is_no_bucket_without_blobs() {
    let (server, dir) = (S3Server::start(), tempfile::tempdir().unwrap());
    let place = at(&server);
    place.hold_for("one", Path::new("data")).await.unwrap();
    let blobs = TenantBlobs::open(place, dir.path(), 0, Clock::start(), None).await.unwrap();
    blobs.answers().await.unwrap();
    std::fs::remove_dir_all(server.folder("")).unwrap();
    assert!(matches!(blobs.answers().await, Err(ObjectError::Unavailable(_))));
}
