//! Blobs of a bucket whose rows two coordinators share.

use std::time::{Duration, SystemTime};

use sqlx::{Connection as _, PgConnection};

use super::bucket_tests::{at, content, key, object_count, objects, send};
use super::direct_tests::{sent, signed, until_empty};
use super::s3_server::{S3Server, age};
use super::*;
use crate::schedule::{Rules, Tenant};
use crate::store::conformance::postgres_server::database;
use crate::store::ledger::UsedBlob;
use crate::store::{PostgresOptions, PostgresStore, Store as _};

const DAY: Duration = Duration::from_secs(86_400);

/// A bucket, a database, and what coordinators need beside them.
struct Place {
    server: S3Server,
    url: String,
    dir: tempfile::TempDir,
}

/// One coordinator's view; its name in the database counts until it is dropped.
struct Coordinator {
    blobs: Arc<BlobStore>,
    database: PostgresStore,
}

impl Place {
    fn new() -> Option<Self> {
        Some(Self { url: database()?, server: S3Server::start(), dir: tempfile::tempdir().unwrap() })
    }

    async fn coordinator(&self) -> Coordinator {
        self.coordinator_at(at(&self.server)).await
    }

    async fn coordinator_at(&self, place: ObjectsAt) -> Coordinator {
        let options = PostgresOptions {
            url: self.url.clone(),
            rules: Rules::default(),
            lease_ms: 60_000,
            stall_ms: 0,
            connections: 4,
        };
        let database = PostgresStore::open(&options).await.unwrap();
        database.members().unwrap().meet(&[], 0, 600_000).await.unwrap();
        let ledger = database.ledger();
        let blobs = TenantBlobs::open(place, self.dir.path(), 0, Clock::start(), ledger).await.unwrap();
        Coordinator { blobs: blobs.of(&Tenant::default()).await.unwrap(), database }
    }

    async fn sql(&self, statement: &str) {
        let mut conn = PgConnection::connect(&self.url).await.unwrap();
        sqlx::query(sqlx::AssertSqlSafe(statement.to_owned())).execute(&mut conn).await.unwrap();
    }

    /// Makes the last use of a blob two days older.
    async fn age(&self, blob: &BlobRef) {
        let row = format!("WHERE digest = decode('{}', 'hex')", blob.digest);
        self.sql(&format!("UPDATE blobs SET used_ms = used_ms - 172800000 {row}")).await;
    }
}

#[tokio::test]
async fn what_one_coordinator_signs_another_finishes() {
    let Some(place) = Place::new() else { return };
    let [one, other] = [place.coordinator().await, place.coordinator().await];
    let content = content(300_000);
    let blob = BlobRef::of(&content);
    let write = signed(&one.blobs, &blob).await;
    assert_eq!(other.blobs.used_bytes().await.unwrap(), blob.bytes, "it counts from then on");
    sent(&write, &content).await.unwrap();
    other.blobs.finish_write(&blob, &write.upload, 0, None).await.unwrap();
    assert!(one.blobs.read(&blob).await.unwrap() == content);
    until_empty(&objects(&place.server, "direct")).await;

    assert_eq!(one.blobs.used_bytes().await.unwrap(), blob.bytes, "it counts twice");

    // A limit does not count it twice, wherever it is finished.
    let next = BlobRef::of(&[7; 300_000]);
    let limit = Some(2 * blob.bytes);
    let write = one.blobs.sign_write(&next, 0, limit).await.unwrap().unwrap();
    sent(&write, &[7; 300_000]).await.unwrap();
    other.blobs.finish_write(&next, &write.upload, 0, limit).await.unwrap();
    assert!(other.blobs.contains(&next).await.unwrap());
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 2 * blob.bytes);

    // What the other one refuses counts as long as it may be sent again.
    let wrong = BlobRef::of(&[8; 300_000]);
    let write = signed(&one.blobs, &wrong).await;
    sent(&write, &[9; 300_000]).await.unwrap();
    let refused = other.blobs.finish_write(&wrong, &write.upload, 0, None).await.unwrap_err();
    assert!(matches!(refused, ObjectError::DigestMismatch { .. }), "{refused}");
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 3 * blob.bytes);
}

#[tokio::test]
async fn parts_are_finished_at_any_coordinator_and_counted_once() {
    let Some(place) = Place::new() else { return };
    let in_parts = || at(&place.server).signed_by(|signing| Some(signing.in_parts_of(100_000)));
    let [one, other] = [place.coordinator_at(in_parts()).await, place.coordinator_at(in_parts()).await];
    let content = content(250_000);
    let blob = BlobRef::of(&content);
    let limit = Some(blob.bytes);
    for (offset, signer, finisher) in [(0, &one, &other), (100_000, &other, &other), (200_000, &one, &other)]
    {
        let write = signer.blobs.sign_write(&blob, offset, limit).await.unwrap().unwrap();
        let used = finisher.blobs.used_bytes().await.unwrap();
        assert_eq!(used, offset + write.bytes, "from byte {offset} on");
        let range = offset as usize..(offset + write.bytes) as usize;
        sent(&write, &content[range.clone()]).await.unwrap();
        finisher.blobs.finish_write(&blob, &write.upload, offset, limit).await.unwrap();
        assert_eq!(signer.blobs.used_bytes().await.unwrap(), range.end as u64, "after byte {}", range.end);
    }
    assert!(one.blobs.read(&blob).await.unwrap() == content);
    assert_eq!(object_count(&objects(&place.server, "uploads")), 0);
}

#[tokio::test]
async fn many_direct_uploads_are_finished_at_once() {
    let Some(place) = Place::new() else { return };
    let both = [place.coordinator().await, place.coordinator().await];
    let mut finished = Vec::new();
    for number in 0..48_usize {
        let mut content = content(300_000);
        content[..8].copy_from_slice(&number.to_le_bytes());
        let blob = BlobRef::of(&content);
        let write = signed(&both[number % 2].blobs, &blob).await;
        sent(&write, &content).await.unwrap();
        let blobs = Arc::clone(&both[number / 2 % 2].blobs);
        finished.push(tokio::spawn(async move { blobs.finish_write(&blob, &write.upload, 0, None).await }));
    }
    for finished in finished {
        finished.await.unwrap().unwrap();
    }
    assert_eq!(both[0].blobs.used_bytes().await.unwrap(), 48 * 300_000);
}

#[tokio::test]
async fn two_coordinators_agree_on_blobs_uploads_and_bytes() {
    let Some(place) = Place::new() else { return };
    let [one, other] = [place.coordinator().await, place.coordinator().await];
    let small = one.blobs.put(Bytes::from_static(b"a photograph")).await.unwrap();
    assert_eq!(other.blobs.missing(&[small.clone(), BlobRef::of(b"no")]).await.unwrap(), [1]);
    assert!(other.blobs.begin_write(&small, 0, None).await.unwrap().is_none(), "it is sent again");

    // An upload that breaks at one goes on at the other, and is counted once.
    let content = content(3 << 20);
    let (large, total) = (BlobRef::of(&content), content.len() as u64 + 12);
    send(&one.blobs, &content, 0, 1 << 20).await.pause().await.unwrap();
    assert_eq!(other.blobs.committed(&large).await.unwrap(), (1 << 20, false));
    assert_eq!(other.blobs.used_bytes().await.unwrap(), (1 << 20) + 12);
    let mut rest = other.blobs.begin_write(&large, 1 << 20, Some(total)).await.unwrap().unwrap();
    assert_eq!(one.blobs.declared_bytes(&[&large.digest]).await.unwrap(), large.bytes, "all of it counts");
    let third = BlobRef::of(b"one more");
    let refused = one.blobs.begin_write(&third, 0, Some(total)).await.err().unwrap();
    assert!(matches!(refused, ObjectError::OverLimit { used_bytes, .. } if used_bytes == total), "{refused}");
    rest.append(1 << 20, Bytes::copy_from_slice(&content[1 << 20..])).await.unwrap();
    rest.finish().await.unwrap();
    assert!(one.blobs.read(&large).await.unwrap() == content);
    for coordinator in [&one, &other] {
        assert_eq!(coordinator.blobs.used_bytes().await.unwrap(), total);
        assert_eq!(coordinator.blobs.declared_bytes(&[&large.digest]).await.unwrap(), 0);
    }

    // A database without rows, as after an import, is filled from the bucket.
    send(&one.blobs, b"half of it", 0, 4).await.pause().await.unwrap();
    place.sql("TRUNCATE blobs, uploads, blob_bytes, filled_ledgers").await;
    let next = place.coordinator().await;
    assert!(next.blobs.contains(&large).await.unwrap());
    assert_eq!(next.blobs.used_bytes().await.unwrap(), total + 4);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn uploads_at_two_coordinators_keep_to_one_limit() {
    let Some(place) = Place::new() else { return };
    let both = [place.coordinator().await, place.coordinator().await];
    // Of 40 blobs of 100 bytes that begin at once, 25 fit.
    let uploads = (0..40_u8).map(|number| {
        let blobs = Arc::clone(&both[usize::from(number) % 2].blobs);
        tokio::spawn(async move {
            let content = vec![number; 100];
            match blobs.begin_write(&BlobRef::of(&content), 0, Some(2500)).await {
                Ok(writer) => {
                    let mut writer = writer.unwrap();
                    writer.append(0, content.into()).await.unwrap();
                    writer.finish().await.unwrap();
                    true
                }
                Err(ObjectError::OverLimit { .. }) => false,
                Err(error) => panic!("{error}"),
            }
        })
    });
    let accepted = futures::future::join_all(uploads).await;
    assert_eq!(accepted.into_iter().filter(|accepted| *accepted.as_ref().unwrap()).count(), 25);
    for coordinator in &both {
        assert_eq!(coordinator.blobs.used_bytes().await.unwrap(), 2500);
    }
}

#[tokio::test]
async fn garbage_collection_spares_what_another_coordinator_uses() {
    let Some(place) = Place::new() else { return };
    let [one, other] = [place.coordinator().await, place.coordinator().await];
    let mut blobs = Vec::new();
    for name in ["used", "asked", "old", "young"] {
        blobs.push(one.blobs.put(Bytes::from(name)).await.unwrap());
    }
    let [used, asked, old, young]: [BlobRef; 4] = blobs.try_into().unwrap();
    for blob in [&used, &asked, &old] {
        place.age(blob).await;
    }
    assert!(other.blobs.contains(&asked).await.unwrap());
    // The other one also goes on with an old upload.
    let half = content(3 << 20);
    send(&one.blobs, &half, 0, 1 << 20).await.pause().await.unwrap();
    let uploads = objects(&place.server, "uploads").join(&BlobRef::of(&half).digest);
    for segment in std::fs::read_dir(&uploads).unwrap() {
        age(&segment.unwrap().path(), 2 * DAY);
    }
    let mut running = other.blobs.begin_write(&BlobRef::of(&half), 1 << 20, None).await.unwrap().unwrap();
    let before = SystemTime::now() - DAY;
    let kept = HashSet::from([used.digest.clone()]);
    let removed = one.blobs.remove_unused(before, kept.clone()).await.unwrap();
    assert_eq!(removed, Removed { blobs: 1, uploads: 0, bytes: 3 });
    for (blob, is_there) in [(&used, true), (&asked, true), (&old, false), (&young, true)] {
        assert_eq!(other.blobs.contains(blob).await.unwrap(), is_there, "{blob:?}");
        assert_eq!(key(&place.server, blob).exists(), is_there, "{blob:?}");
    }
    running.append(1 << 20, Bytes::copy_from_slice(&half[1 << 20..])).await.unwrap();
    running.finish().await.unwrap();
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4 + 5 + 5 + half.len() as u64);

    // An object without a row, of a coordinator that died between the two, gets one and is garbage then.
    let lost = BlobRef::of(b"orphan");
    std::fs::create_dir_all(key(&place.server, &lost).parent().unwrap()).unwrap();
    std::fs::write(key(&place.server, &lost), b"orphan").unwrap();
    age(&key(&place.server, &lost), 2 * DAY);
    let removed = other.blobs.remove_unused(before, kept).await.unwrap();
    assert_eq!(removed, Removed { blobs: 1, uploads: 0, bytes: 6 });
    assert!(!key(&place.server, &lost).exists());
}

#[tokio::test]
async fn what_a_dead_coordinator_left_half_done_is_put_right() {
    let Some(place) = Place::new() else { return };
    let one = place.coordinator().await;
    let [kept, gone] = ["kept", "gone"].map(Bytes::from);
    let (kept, gone) = (one.blobs.put(kept).await.unwrap(), one.blobs.put(gone).await.unwrap());
    // It announced removals, and died before and after the object went.
    place.sql("UPDATE blobs SET going_until_ms = now_ms() - 1").await;
    std::fs::remove_file(key(&place.server, &gone)).unwrap();
    assert!(one.blobs.contains(&kept).await.unwrap() && !one.blobs.contains(&gone).await.unwrap());
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4);
    // While another coordinator removes it, callers wait.
    place.sql("UPDATE blobs SET going_until_ms = now_ms() + 700").await;
    let begin = std::time::Instant::now();
    assert!(one.blobs.contains(&kept).await.unwrap());
    assert!(begin.elapsed() > Duration::from_millis(500), "{:?}", begin.elapsed());

    // Its upload counts what was declared, until garbage collection looks.
    let dead = place.coordinator().await;
    let half = content(1 << 20);
    let blob = BlobRef::of(&half);
    std::mem::forget(dead.blobs.begin_write(&blob, 0, None).await.unwrap().unwrap());
    dead.database.members().unwrap().leave().await.unwrap();
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4 + blob.bytes);
    place.sql("UPDATE uploads SET changed_ms = changed_ms - 120000").await;
    one.blobs.remove_unused(SystemTime::now() - DAY, HashSet::new()).await.unwrap();
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4);

    // The same where a living coordinator could not report the end of its stream.
    one.database.ledger().unwrap().reserve(&Tenant::default(), &blob, None, None).await.unwrap();
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4 + blob.bytes);
    place.sql("UPDATE uploads SET changed_ms = changed_ms - 120000").await;
    one.blobs.remove_unused(SystemTime::now() - DAY, HashSet::new()).await.unwrap();
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 4);

    // The bucket has lost an object.
    std::fs::remove_file(key(&place.server, &kept)).unwrap();
    assert!(matches!(one.blobs.read(&kept).await, Err(ObjectError::NotFound(_))));
    assert!(!one.blobs.contains(&kept).await.unwrap(), "its client is not asked to send it again");
    assert_eq!(one.blobs.used_bytes().await.unwrap(), 0);
}

#[tokio::test]
async fn a_damaged_blob_is_quarantined_for_all_coordinators() {
    let Some(place) = Place::new() else { return };
    let [one, other] = [place.coordinator().await, place.coordinator().await];
    let blob = one.blobs.put(Bytes::from_static(b"the truth")).await.unwrap();
    std::fs::write(key(&place.server, &blob), b"the troth").unwrap();
    assert!(matches!(one.blobs.read(&blob).await, Err(ObjectError::Damaged(_))));
    assert!(!other.blobs.contains(&blob).await.unwrap());
    assert_eq!(std::fs::read(objects(&place.server, "damaged").join(&blob.digest)).unwrap(), b"the troth");
    send(&other.blobs, b"the truth", 0, 9).await.finish().await.unwrap();
    assert_eq!(one.blobs.read(&blob).await.unwrap(), &b"the truth"[..]);
}

#[tokio::test]
async fn a_removal_of_another_coordinator_takes_no_new_blob() {
    let Some(place) = Place::new() else { return };
    let [one, other] = [place.coordinator().await, place.coordinator().await];
    let (ledger, tenant) = (other.database.ledger().unwrap(), Tenant::default());
    let blob = one.blobs.put(Bytes::from_static(b"a plan")).await.unwrap();
    let digests = [blob.digest.clone()];
    // The other one's removal was late, was announced again by this one, and ended: it cannot end it again.
    let late = ledger.condemn(&tenant, &digests, None).await.unwrap();
    assert!(ledger.condemn(&tenant, &digests, None).await.unwrap().is_empty(), "two remove it");
    place.sql("UPDATE blobs SET going_until_ms = now_ms() - 1").await;
    assert!(one.blobs.contains(&blob).await.unwrap());
    ledger.removed(&tenant, &late).await.unwrap();
    assert!(one.blobs.contains(&blob).await.unwrap());

    // A blob that is complete in the moment of a removal is written again once the removal has ended.
    let removal = ledger.condemn(&tenant, &digests, None).await.unwrap();
    assert!(!ledger.publish(&tenant, &blob).await.unwrap(), "it counts, and its object goes");
    std::fs::remove_file(key(&place.server, &blob)).unwrap();
    ledger.removed(&tenant, &removal).await.unwrap();
    assert!(!one.blobs.contains(&blob).await.unwrap());

    // An object that was listed before the other one removed it gets no row that counts.
    let listed = UsedBlob { blob: blob.clone(), used_ms: 1 };
    ledger.add(&tenant, &[listed], false).await.unwrap();
    assert!(!one.blobs.contains(&blob).await.unwrap());
    one.blobs.put(Bytes::from_static(b"a plan")).await.unwrap();
    assert_eq!(other.blobs.read(&blob).await.unwrap(), &b"a plan"[..]);
    assert_eq!(other.blobs.used_bytes().await.unwrap(), 6);
}

#[tokio::test]
async fn an_upload_whose_caller_leaves_at_its_begin_counts_nothing() {
    let Some(place) = Place::new() else { return };
    let one = place.coordinator().await;
    let blob = BlobRef::of(&content(1 << 20));
    drop(one.blobs.begin_write(&blob, 0, None).await.unwrap().unwrap());
    for _ in 0..100 {
        if one.blobs.used_bytes().await.unwrap() == 0 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{} bytes count", one.blobs.used_bytes().await.unwrap());
}
