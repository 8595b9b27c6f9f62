//! Hostile input for the merge: results of partitions as any worker may submit them.

use fathom_core::config::JobConfig;
use fathom_core::scene::BlobRef;
use fathom_fuzz::{Folder, Target, run};
use fathom_plan::PartitionId;

use crate::{ModelManifest, PartitionResult, fixtures, merge};

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;

#[test]
fn fuzzed_results_of_partitions_are_merged_or_refused() {
    let folder = Folder::new("merge");
    let (plan, config) = (fixtures::grid_plan(1, 1), JobConfig::default().merge);
    let (path, out) = (folder.path().join("result.ply"), folder.path().join("model.ply"));
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let result = PartitionResult {
            partition: PartitionId(0),
            path: path.clone(),
            digest: BlobRef::of(bytes).digest,
        };
        let results = [result];
        let Ok(merged) = merge(&plan, &results, &config, 5, &out) else { return false };
        assert!(merged.gaussians <= 5);
        let digest = BlobRef::of(&std::fs::read(&out).unwrap()).digest;
        let manifest = ModelManifest::new(&plan, "0", &results, &merged);
        let json = serde_json::to_vec(&manifest).unwrap();
        let manifest: ModelManifest = serde_json::from_slice(&json).unwrap();
        manifest.of_changed_rows(&crate::local_files(), &out, &digest).unwrap();
        true
    };
    let words = [
        "element vertex 4294967295\n",
        "property double x\n",
        "property uchar a\n",
        "comment fathom_water {}\n",
    ];
    let corpus =
        vec![fixtures::ply(&fixtures::random_means(9), 9), fixtures::ply(&fixtures::random_means(3), 0)];
    run(&Target {
        words: &words,
        extra_bytes: 64 << 20,
        ..Target::new("result of a partition", corpus, &read)
    });
}

/// The header of the model must count its rows, for any white space in a result's header.
#[test]
fn a_header_with_other_white_space_merges_into_a_readable_model() {
    let folder = Folder::new("white-space");
    let (plan, config) = (fixtures::grid_plan(1, 1), JobConfig::default().merge);
    let (path, out) = (folder.path().join("result.ply"), folder.path().join("model.ply"));
    let bytes = fixtures::ply(&fixtures::random_means(9), 0);
    let at = bytes.windows(15).position(|window| window == b"element vertex ").unwrap();
    let bytes = [&bytes[..at], b"element\t vertex  ", &bytes[at + 15..]].concat();
    std::fs::write(&path, &bytes).unwrap();
    let result = PartitionResult { partition: PartitionId(0), path, digest: BlobRef::of(&bytes).digest };
    let merged = merge(&plan, &[result], &config, 5, &out).unwrap();
    assert_eq!(merged.gaussians, 5);
    let header = String::from_utf8_lossy(&std::fs::read(&out).unwrap()).into_owned();
    assert!(header.contains("\nelement vertex 5\n"), "{header}");
}
