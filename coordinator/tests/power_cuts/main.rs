//! The store and power cuts.
//!
//! All file operations of the store are recorded ([`record`]): writes, syncs, names. From the recording,
//! [`disk`] builds possible disk images after a power cut at some moment: unsynced writes are lost, kept,
//! torn or reordered. On each image the store must open without a fault, with everything acknowledged before
//! that moment. Work then continues from one of these images, so that recoveries are interrupted as well.
//!
//! `FATHOM_POWER_CUTS=N` sets the number of images, `FATHOM_POWER_CUTS_SEED` the seed. The recording depends
//! on thread timing; the first failing images are kept, and their paths are printed.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod disk;
mod record;
#[path = "../workload/mod.rs"]
mod workload;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use fathom_coordinator::store::{JobStore, SledOptions, SledStore, Store, verify};

use self::disk::{Disk, Fate, Image, Random};
use self::record::{Op, Recording};
use self::workload::{Acknowledged, LEASE_MS, ROUND_MS, T0, block_on, rules, write};

/// Threads that change the store concurrently.
const WRITERS: u32 = 3;
/// Jobs that each of them creates before the store is closed; two or three segments of sled's log.
const TURNS: u32 = 6;
/// Maximum failing images kept, and the count.
const MOST_KEPT: usize = 3;
static KEPT: AtomicUsize = AtomicUsize::new(0);
/// Images of one recording.
const IMAGES: usize = 100;
/// Generations after which a new store is begun, because the rows to check accumulate.
const GENERATIONS: usize = 5;

#[test]
fn power_cuts_lose_nothing_that_was_acknowledged() {
    cut(number("FATHOM_POWER_CUTS").unwrap_or(200));
}

#[test]
#[ignore = "takes minutes; `make soak`"]
fn ten_thousand_power_cuts_lose_nothing_that_was_acknowledged() {
    cut(number("FATHOM_POWER_CUTS").unwrap_or(10_000));
}

fn number(variable: &str) -> Option<usize> {
    std::env::var(variable).ok()?.parse().ok()
}

/// An image, with the changes acknowledged before it.
struct Cut {
    image: Image,
    known: Acknowledged,
    /// A description for debugging.
    description: String,
}

fn cut(images: usize) {
    let started = Instant::now();
    let seed = number("FATHOM_POWER_CUTS_SEED").unwrap_or(1) as u64;
    let mut random = Random(seed);
    let (mut figures, mut faults) = (BTreeMap::<String, usize>::new(), Vec::new());
    let (mut next, mut acknowledged, mut operations) = (None, 0, 0);
    // If more bytes are written than the log is long, segments of the log were reused.
    let (mut written, mut largest) = (0, 0);
    let mut made = 0;
    for generation in 0.. {
        if made >= images {
            break;
        }
        if generation % GENERATIONS == 0 {
            next = None;
        }
        let begin = next.take().unwrap_or_else(|| Cut {
            image: Image::default(),
            known: Acknowledged::default(),
            description: "a new store".to_owned(),
        });
        let dir = tempfile::tempdir().unwrap();
        begin.image.write(dir.path());
        let recording = work(dir.path(), generation as u64);
        assert_complete(&begin.image, &recording, dir.path());
        operations += recording.ops.len();
        let of_write = |op: &Op| if let Op::Write { bytes, .. } = op { bytes.len() } else { 0 };
        written += recording.ops.iter().map(of_write).sum::<usize>();
        largest = largest.max(Image::read(dir.path()).files.values().map(Vec::len).max().unwrap_or(0));
        acknowledged += recording.ops.iter().filter(|op| matches!(op, Op::Acknowledged(_))).count();
        let cuts = cuts(&begin, &recording, IMAGES.min(images - made), generation, &mut random);
        made += cuts.len();
        for cut in &cuts {
            let fate = cut.description.split(' ').next().unwrap_or_default().to_owned();
            *figures.entry(fate).or_default() += 1;
        }
        faults.extend(faults_of(&cuts));
        if !faults.is_empty() {
            // Work after a fault shows nothing new.
            break;
        }
        next = cuts.into_iter().nth(random.below(IMAGES as u64 / 2) as usize);
        if images > 4 * IMAGES {
            println!("{made} images, {} faults, {:.0?}", faults.len(), started.elapsed());
        }
    }
    println!(
        "{made} images of {operations} operations with {acknowledged} acknowledgements ({written} bytes written, the longest log has \
         {largest}), {figures:?}: {} faults, {:.0?}",
        faults.len(),
        started.elapsed()
    );
    assert!(
        faults.is_empty(),
        "seed {seed}: {} of {made} images have faults, the first:\n{}",
        faults.len(),
        faults[..faults.len().min(10)].join("\n")
    );
}

/// Opens the store, works on it, and closes it, twice: the second time sled has a log to read. Returns the
/// recording.
fn work(dir: &Path, generation: u64) -> Recording {
    record::start(dir);
    for half in 0..2 {
        let round = 2 * generation + half;
        let store = Arc::new(open(dir));
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        runtime.block_on(async {
            let now_ms = T0 + round * ROUND_MS;
            store.recover(now_ms).await.unwrap();
            store.sweep(now_ms + LEASE_MS).await.unwrap();
            let writers = (0..WRITERS).map(|writer| {
                tokio::spawn(write(Arc::clone(&store), round, writer, TURNS, record::acknowledge))
            });
            for ended in futures::future::join_all(writers).await {
                ended.unwrap();
            }
        });
        drop(store);
        // sled's threads still write for a moment after the last handle is dropped.
        wait_until_closed(dir);
    }
    record::stop()
}

fn options(dir: &Path) -> SledOptions {
    SledOptions { dir: dir.join("store"), rules: rules(), lease_ms: LEASE_MS, stall_ms: 0 }
}

fn open(dir: &Path) -> SledStore {
    SledStore::open(&options(dir)).unwrap_or_else(|error| panic!("the store does not open: {error}"))
}

/// Waits until sled's lock is free.
fn wait_until_closed(dir: &Path) {
    let log = std::fs::File::open(dir.join("store/sled/db")).unwrap();
    let begin = Instant::now();
    while log.try_lock().is_err() {
        assert!(begin.elapsed().as_secs() < 20, "the store is still open");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

/// Asserts that nothing was missed: replaying the recording gives the actual files.
fn assert_complete(begin: &Image, recording: &Recording, dir: &Path) {
    let mut disk = Disk::new(begin, recording);
    recording.ops.iter().for_each(|op| disk.step(op));
    let (again, found) = (disk.image(Fate::Kept, &mut Random(0)), Image::read(dir));
    assert_eq!(again.folders, found.folders);
    assert_eq!(again.files.keys().collect::<Vec<_>>(), found.files.keys().collect::<Vec<_>>());
    for (name, bytes) in &found.files {
        assert!(again.files[name] == *bytes, "writes to {} were not recorded", name.display());
    }
}

/// Images of the disk at `count` moments, in order, after the first acknowledgement.
fn cuts(
    begin: &Cut,
    recording: &Recording,
    count: usize,
    generation: usize,
    random: &mut Random,
) -> Vec<Cut> {
    let ops = &recording.ops;
    let mut moments: Vec<usize> = (0..count).map(|_| random.below(ops.len() as u64 + 1) as usize).collect();
    moments.sort_unstable();
    let mut disk = Disk::new(&begin.image, recording);
    let mut known = begin.known.clone();
    let fence_before = known.last_fence();
    let (mut done, mut cuts) = (0, Vec::new());
    for (at, moment) in moments.into_iter().enumerate() {
        for op in &ops[done..moment] {
            disk.step(op);
            if let Op::Acknowledged(line) = op {
                known.add(line, fence_before);
            }
        }
        done = moment;
        let fate = Fate::ALL[at % Fate::ALL.len()];
        let description =
            format!("{fate:?} generation {generation}, after {moment} of {} operations", ops.len());
        cuts.push(Cut { image: disk.image(fate, random), known: known.clone(), description });
    }
    cuts
}

/// A sentence for each failing image.
fn faults_of(cuts: &[Cut]) -> Vec<String> {
    let (next, faults) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some(cut) = cuts.get(next.fetch_add(1, Ordering::Relaxed)) {
                    if let Err(fault) = look_at(cut) {
                        faults.lock().unwrap().push(format!("{}: {fault}", cut.description));
                    }
                }
            });
        }
    });
    faults.into_inner().unwrap()
}

fn look_at(cut: &Cut) -> Result<(), String> {
    let dir = tempfile::tempdir_in(in_memory()).unwrap();
    cut.image.write(dir.path());
    let looked = catch_unwind(AssertUnwindSafe(|| {
        let store =
            SledStore::open(&options(dir.path())).map_err(|error| format!("does not open: {error}"))?;
        block_on(async {
            let found = store.export().await.map_err(|error| error.to_string())?;
            let faults =
                [verify::faults(&found), store.index_faults().map_err(|error| error.to_string())?].concat();
            if let Some(fault) = faults.first() {
                return Err(format!("{} faults: {fault}", faults.len()));
            }
            cut.known.check(&store, 0).await;
            Ok(())
        })
    }));
    let result = looked.unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        Err(said.or_else(|| panic.downcast_ref::<&str>().map(|said| (*said).to_owned())).unwrap_or_default())
    });
    result.map_err(|fault| {
        // The first few are enough to find the cause.
        if KEPT.fetch_add(1, Ordering::Relaxed) >= MOST_KEPT {
            return fault;
        }
        let kept = tempfile::tempdir().unwrap().keep();
        cut.image.write(&kept.join("image"));
        format!("{fault} ({})", kept.display())
    })
}

/// A folder in memory, if there is one.
fn in_memory() -> PathBuf {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() }
}
