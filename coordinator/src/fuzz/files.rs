//! Files on the coordinator's disk that may come from elsewhere: exports of a store, rows.

use std::io::Write as _;

use fathom_fuzz::{Target, run};
use flate2::Compression;
use flate2::write::GzEncoder;

use crate::schedule::{JobRecord, JobShape, Stage, TaskRecord};
use crate::services::encode;
use crate::store::export::{self, Export};
use crate::store::memory::MemoryStore;
use crate::store::{Store, record, verify};

fn packed(plain: &[u8]) -> Vec<u8> {
    // Stored, not compressed: this is fast, and the decompressed bytes are the input.
    let mut out = GzEncoder::new(Vec::new(), Compression::none());
    out.write_all(plain).unwrap();
    out.finish().unwrap()
}

/// Corrects the checksums of rows.
fn mend(plain: &mut [u8]) {
    let mut at = export::MAGIC.len();
    while let Some(head) = plain.get(at..at + 4) {
        let length = u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let end = at + 4 + length;
        if end + 4 > plain.len() {
            return;
        }
        let sum = crc32c::crc32c(&plain[at..end]);
        plain[end..end + 4].copy_from_slice(&sum.to_le_bytes());
        at = end + 4;
    }
}

#[test]
fn fuzzed_exports_of_a_store_are_imported_or_refused() {
    let mut sound = export::sample();
    // One that is planned, with its tasks.
    let planned = &mut sound.jobs[1];
    planned.job.shape = JobShape { partitions: 2, evaluations: 2, stages: Stage::all().collect() };
    planned.tasks =
        planned.job.shape.tasks().into_iter().map(|task| TaskRecord::new(task, None, 7)).collect();
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let use_export = |export: &Export| {
        let _ = verify::faults(export);
        for job in &export.jobs {
            let _ = encode::job(&job.job, 0.5, None);
        }
        let store = MemoryStore::new(crate::schedule::Rules::default(), 30_000, 0);
        runtime.block_on(store.import(export)).is_ok()
    };
    let read = |plain: &[u8]| Export::parse(packed(plain).as_slice()).is_ok_and(|export| use_export(&export));
    let words = ["4294967295", "\"partitions\":4294967295", "\"leased\"", "null"];
    let plain = export::plain(&sound);
    let target = Target::new("export of a store", vec![plain.clone()], &read);
    run(&Target { words: &words, mend: Some(mend), ..target });

    // The compressed bytes, whose own checksums are not corrected.
    let read = |bytes: &[u8]| Export::parse(bytes).is_ok_and(|export| use_export(&export));
    let mut tight = GzEncoder::new(Vec::new(), Compression::best());
    tight.write_all(&plain).unwrap();
    let corpus = vec![packed(&plain), tight.finish().unwrap()];
    run(&Target { extra_bytes: 32 << 20, ..Target::new("packed export of a store", corpus, &read) });
}

#[test]
fn fuzzed_rows_of_a_store_are_read_or_called_damaged() {
    fn mend(row: &mut [u8]) {
        if let Some(end) = row.len().checked_sub(4) {
            let sum = crc32c::crc32c(&row[..end]);
            row[end..].copy_from_slice(&sum.to_le_bytes());
        }
    }
    let sound = export::sample();
    let (job, task) = (&sound.jobs[0].job, &sound.jobs[0].tasks[0]);
    let read = |bytes: &[u8]| record::decode::<JobRecord>("jobs", bytes).is_ok();
    let corpus = vec![record::encode("jobs", job).unwrap()];
    run(&Target { mend: Some(mend), ..Target::new("row of a job", corpus, &read) });
    let read = |bytes: &[u8]| record::decode::<TaskRecord>("tasks", bytes).is_ok();
    let corpus = vec![record::encode("tasks", task).unwrap()];
    run(&Target { mend: Some(mend), ..Target::new("row of a task", corpus, &read) });
}
