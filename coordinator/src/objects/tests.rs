use super::*;

const YEAR: std::time::Duration = std::time::Duration::from_secs(365 * 86_400);

fn blob_of(bytes: &[u8]) -> BlobRef {
    BlobRef { digest: blake3::hash(bytes).to_hex().to_string(), bytes: bytes.len() as u64 }
}

fn open() -> (tempfile::TempDir, Arc<BlobStore>) {
    let dir = tempfile::tempdir().unwrap();
    let store = Arc::new(BlobStore::open(dir.path(), 0, Clock::start()).unwrap());
    (dir, store)
}

fn part_path(store: &BlobStore, blob: &BlobRef) -> PathBuf {
    match &store.place {
        Place::Disk(disk) => disk.part_path(&blob.digest),
        Place::Bucket(_) => panic!("a bucket has no such file"),
    }
}

#[tokio::test]
async fn a_broken_upload_resumes_even_in_another_process() {
    let (dir, store) = open();
    let content = vec![7_u8; 100_000];
    let blob = blob_of(&content);
    let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
    writer.append(0, Bytes::copy_from_slice(&content[..40_000])).await.unwrap();
    assert_eq!(writer.pause().await.unwrap(), 40_000);
    assert!(!store.contains(&blob).await.unwrap(), "half a blob is visible");

    let store = Arc::new(BlobStore::open(dir.path(), 0, Clock::start()).unwrap());
    assert_eq!(store.committed(&blob).await.unwrap(), (40_000, false));
    let wrong = store.begin_write(&blob, 0, None).await.err().unwrap();
    assert!(matches!(wrong, ObjectError::WrongOffset { committed_bytes: 40_000, .. }), "{wrong}");
    let mut writer = store.begin_write(&blob, 40_000, None).await.unwrap().unwrap();
    writer.append(40_000, Bytes::copy_from_slice(&content[40_000..])).await.unwrap();
    writer.finish().await.unwrap();
    assert_eq!(store.read(&blob).await.unwrap(), content);
    assert!(
        store.begin_write(&blob, 0, None).await.unwrap().is_none(),
        "a blob that is there is written again"
    );
}

#[tokio::test]
async fn bytes_that_differ_from_the_declaration_are_deleted() {
    let (_dir, store) = open();
    let blob = blob_of(b"the truth");
    for lie in [&b"the troth"[..], b"the trut", b"the truth and more"] {
        let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
        let error = match writer.append(0, Bytes::copy_from_slice(lie)).await {
            Ok(()) => writer.finish().await.unwrap_err(),
            Err(error) => error,
        };
        assert!(matches!(error, ObjectError::DigestMismatch { .. }), "{lie:?}: {error}");
        assert_eq!(store.committed(&blob).await.unwrap(), (0, false), "{lie:?} left something behind");
    }
}

#[tokio::test]
async fn bytes_added_by_another_write_are_found_before_publishing() {
    let (_dir, store) = open();
    let blob = blob_of(b"the truth");
    let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
    writer.append(0, Bytes::from_static(b"the truth")).await.unwrap();
    let mut late = std::fs::OpenOptions::new().append(true).open(part_path(&store, &blob)).unwrap();
    std::io::Write::write_all(&mut late, b" and more").unwrap();
    let error = writer.finish().await.unwrap_err();
    assert!(error.to_string().contains("18 bytes are on the disk, 9 were declared"), "{error}");
    assert_eq!(store.committed(&blob).await.unwrap(), (0, false), "it left something behind");
}

#[tokio::test]
async fn two_streams_do_not_write_one_blob() {
    let (_dir, store) = open();
    let blob = blob_of(b"once");
    let first = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
    assert!(matches!(store.begin_write(&blob, 0, None).await, Err(ObjectError::Busy(_))));
    drop(first);
    assert!(store.begin_write(&blob, 0, None).await.unwrap().is_some());
}

#[tokio::test]
async fn an_invalid_digest_reaches_no_file() {
    let (_dir, store) = open();
    for digest in ["", "..", "../../etc/passwd", &"A".repeat(64), &"../".repeat(22)[..64]] {
        let blob = BlobRef { digest: digest.to_owned(), bytes: 1 };
        assert!(matches!(store.size(digest).await, Err(ObjectError::BadDigest(_))), "{digest:?}");
        assert!(
            matches!(store.begin_write(&blob, 0, None).await, Err(ObjectError::BadDigest(_))),
            "{digest:?}"
        );
    }
}

#[tokio::test]
async fn a_blob_that_changed_on_the_disk_is_noticed_by_its_reader() {
    let (_dir, store) = open();
    let blob = store.put(Bytes::from_static(b"sound")).await.unwrap();
    std::fs::write(store.path_of(&blob).unwrap(), b"sOund").unwrap();
    assert!(matches!(store.read(&blob).await, Err(ObjectError::Damaged(_))));
}

#[tokio::test]
async fn a_nearly_full_disk_refuses_uploads() {
    let dir = tempfile::tempdir().unwrap();
    let store = Arc::new(BlobStore::open(dir.path(), u64::MAX, Clock::start()).unwrap());
    assert!(matches!(store.begin_write(&blob_of(b"x"), 0, None).await, Err(ObjectError::LowSpace { .. })));
}

#[tokio::test]
async fn unfinished_files_are_removed_and_blobs_stay() {
    let (_dir, store) = open();
    let blob = store.put(Bytes::from_static(b"a model")).await.unwrap();
    std::fs::write(store.staging_path("merge-1-2.ply"), b"half a model").unwrap();
    store.discard_staged().unwrap();
    assert!(!store.staging_path("merge-1-2.ply").exists());
    assert_eq!(store.read(&blob).await.unwrap(), &b"a model"[..]);
    store.discard_staged().unwrap();
}

#[tokio::test]
async fn old_blobs_are_removed_unless_used_or_checked() {
    let (dir, store) = open();
    let mut blobs = Vec::new();
    for name in ["used", "asked", "old", "young"] {
        blobs.push(store.put(Bytes::from(name)).await.unwrap());
    }
    let [used, asked, old, young]: [BlobRef; 4] = blobs.try_into().unwrap();
    let half = blob_of(b"half");
    let mut upload = store.begin_write(&half, 0, None).await.unwrap().unwrap();
    upload.append(0, Bytes::from("ha")).await.unwrap();

    let now = std::time::SystemTime::now();
    let day = std::time::Duration::from_secs(86_400);
    let age = |path: std::path::PathBuf| {
        std::fs::File::options().append(true).open(path).unwrap().set_modified(now - 2 * day).unwrap();
    };
    let part = || dir.path().join("uploads").join(format!("{}.part", half.digest));
    for blob in [&used, &asked, &old] {
        age(store.path_of(blob).unwrap());
    }
    age(part());
    let kept = std::collections::HashSet::from([used.digest.clone()]);
    assert!(store.contains(&asked).await.unwrap());
    assert!(BlobStore::existing(dir.path()).unwrap().contains(&old).await.unwrap(), "only looks");
    let removed = store.remove_unused(now - day, kept.clone()).await.unwrap();
    assert_eq!(removed, Removed { blobs: 1, uploads: 0, bytes: 3 }, "a running upload is not garbage");
    for (blob, is_there) in [(&used, true), (&asked, true), (&old, false), (&young, true)] {
        assert_eq!(store.contains(blob).await.unwrap(), is_there, "{blob:?}");
    }
    upload.pause().await.unwrap();
    age(part());
    let removed = store.remove_unused(now - day, kept.clone()).await.unwrap();
    assert_eq!(removed, Removed { blobs: 0, uploads: 1, bytes: 2 });
    assert_eq!(store.committed(&half).await.unwrap(), (0, false), "it restarts");
    // A used blob becomes garbage once it is unused.
    age(store.path_of(&used).unwrap());
    assert_eq!(store.remove_unused(now - day, HashSet::new()).await.unwrap().blobs, 1);
}

#[tokio::test]
async fn the_age_of_files_follows_the_coordinators_clock() {
    let dir = tempfile::tempdir().unwrap();
    let in_1999 = Clock::starting_at(925_000_000_000);
    let store = Arc::new(BlobStore::open(dir.path(), 0, in_1999).unwrap());
    let made = store.put(Bytes::from_static(b"made")).await.unwrap();
    std::fs::write(store.staging_path("merged"), b"merged").unwrap();
    let adopted = store.adopt("merged", blob_of(b"merged")).await.unwrap();
    let sent = blob_of(b"sent");
    let mut upload = store.begin_write(&sent, 0, None).await.unwrap().unwrap();
    upload.append(0, Bytes::from_static(b"sent")).await.unwrap();
    upload.finish().await.unwrap();
    let half = blob_of(b"half");
    let mut upload = store.begin_write(&half, 0, None).await.unwrap().unwrap();
    upload.append(0, Bytes::from_static(b"ha")).await.unwrap();
    drop(upload);
    for blob in [&made, &adopted, &sent] {
        let file = std::fs::metadata(store.path_of(blob).unwrap()).unwrap();
        assert!(file.modified().unwrap() < in_1999.system_time() + YEAR, "{blob:?}");
    }
    let removed = store.remove_unused(in_1999.system_time() + YEAR, HashSet::new()).await.unwrap();
    assert_eq!(removed, Removed { blobs: 3, uploads: 1, bytes: 16 });
}

#[tokio::test]
async fn files_from_the_future_count_as_made_now() {
    let dir = tempfile::tempdir().unwrap();
    let (day_ms, now_ms) = (24 * 3600 * 1000, 925_000_000_000);
    let ahead = Arc::new(BlobStore::open(dir.path(), 0, Clock::starting_at(now_ms + 3 * day_ms)).unwrap());
    let blob = ahead.put(Bytes::from_static(b"of the day after tomorrow")).await.unwrap();
    drop(ahead);
    let now = Clock::starting_at(now_ms);
    let store = Arc::new(BlobStore::open(dir.path(), 0, now).unwrap());
    let an_hour = std::time::Duration::from_secs(3600);
    let none = HashSet::new();
    assert_eq!(
        store.remove_unused(now.system_time() - an_hour, none.clone()).await.unwrap(),
        Removed::default()
    );
    let file = std::fs::metadata(store.path_of(&blob).unwrap()).unwrap();
    assert!(file.modified().unwrap() <= now.system_time(), "it would stay for three days");
    assert_eq!(store.remove_unused(now.system_time() + an_hour, none.clone()).await.unwrap().blobs, 1);
}

#[tokio::test]
async fn a_blob_larger_than_its_type_allows_is_not_read() {
    let (_dir, store) = open();
    let blob = store.put(Bytes::from(vec![7_u8; 1000])).await.unwrap();
    assert_eq!(store.read_at_most(&blob, 1000).await.unwrap().len(), 1000);
    let refused = store.read_at_most(&blob, 999).await.err().unwrap();
    assert!(matches!(refused, ObjectError::TooLarge { bytes: 1000, most: 999, .. }), "{refused}");
    // A reference with a smaller length names no blob.
    let lie = BlobRef { bytes: 10, ..blob };
    let refused = store.read_at_most(&lie, 999).await.err().unwrap();
    assert!(matches!(refused, ObjectError::NotFound(_)), "{refused}");
}

#[tokio::test]
async fn a_changed_blob_is_quarantined_and_can_be_sent_again() {
    let (dir, store) = open();
    let blob = store.put(Bytes::from_static(b"the truth")).await.unwrap();
    assert!(!store.set_aside_if_damaged(&blob.digest).await.unwrap(), "an intact blob was quarantined");
    assert!(!store.set_aside_if_damaged(&"0".repeat(64)).await.unwrap(), "a missing blob cannot be damaged");
    std::fs::write(store.path_of(&blob).unwrap(), b"the troth").unwrap();

    // A read-only store changes nothing.
    let looking = BlobStore::existing(dir.path()).unwrap();
    assert!(matches!(looking.read(&blob).await, Err(ObjectError::Damaged(digest)) if digest == blob.digest));
    assert!(store.contains(&blob).await.unwrap());

    assert!(matches!(store.read(&blob).await, Err(ObjectError::Damaged(_))));
    assert!(matches!(store.read(&blob).await, Err(ObjectError::NotFound(_))));
    let aside = dir.path().join("damaged").join(&blob.digest);
    assert_eq!(std::fs::read(&aside).unwrap(), b"the troth");
    let mut writer = store.begin_write(&blob, 0, None).await.unwrap().unwrap();
    writer.append(0, Bytes::from_static(b"the truth")).await.unwrap();
    writer.finish().await.unwrap();
    assert_eq!(store.read(&blob).await.unwrap(), &b"the truth"[..]);

    // It is removed when it is old.
    let removed = store.remove_unused(std::time::SystemTime::UNIX_EPOCH, HashSet::new()).await.unwrap();
    assert_eq!((removed.blobs, aside.exists()), (0, true));
    let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
    let used = HashSet::from([blob.digest.clone()]);
    assert_eq!(store.remove_unused(later, used).await.unwrap().blobs, 1);
    assert!(!aside.exists() && store.contains(&blob).await.unwrap());
}

#[tokio::test]
async fn uploads_count_declared_bytes_then_received_bytes() {
    let (dir, store) = open();
    let blob = blob_of(&[7; 1000]);
    let other = blob_of(&[8; 600]);
    let mut upload = store.begin_write(&blob, 0, Some(1500)).await.unwrap().unwrap();
    upload.append(0, Bytes::from(vec![7; 300])).await.unwrap();
    assert_eq!(store.used_bytes().await.unwrap(), 1000);
    let too_much = store.begin_write(&other, 0, Some(1500)).await.err().unwrap();
    assert!(matches!(too_much, ObjectError::OverLimit { used_bytes: 1000, limit_bytes: 1500 }), "{too_much}");
    // As when its client disconnects silently.
    drop(upload);
    assert_eq!(
        (store.used_bytes().await.unwrap(), store.declared_bytes(&[&blob.digest]).await.unwrap()),
        (300, 300)
    );
    drop(store);

    let store = std::sync::Arc::new(BlobStore::open(dir.path(), 0, Clock::start()).unwrap());
    assert_eq!(store.used_bytes().await.unwrap(), 300, "the next process forgets the received bytes");
    let mut upload =
        store.begin_write(&blob, 300, Some(1000)).await.unwrap().expect("its own part counts once");
    upload.append(300, Bytes::from(vec![7; 700])).await.unwrap();
    upload.finish().await.unwrap();
    assert_eq!(
        (store.used_bytes().await.unwrap(), store.declared_bytes(&[&blob.digest]).await.unwrap()),
        (1000, 0)
    );

    let mut upload = store.begin_write(&other, 0, None).await.unwrap().unwrap();
    upload.append(0, Bytes::from(vec![9; 600])).await.unwrap();
    assert!(upload.finish().await.is_err());
    assert_eq!(store.used_bytes().await.unwrap(), 1000, "deleted bytes count");
}
