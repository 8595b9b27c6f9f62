use std::fs;

use fathom_core::config::MergeConfig;
use tempfile::TempDir;

use super::*;
use crate::fixtures::{
    Model, cut_plan, grid_plan, ply, random_means, result, sorted_rows, write_results, write_row_results,
};

fn merge(plan: &Plan, results: &[PartitionResult], cap: u64, out: &Path) -> Result<Merged, MergeError> {
    super::merge(plan, results, &MergeConfig::default(), cap, out)
}

/// The results with the digests of their files now.
fn again(results: &[PartitionResult]) -> Vec<PartitionResult> {
    results.iter().map(|given| result(given.partition, given.path.clone())).collect()
}

/// SMP-UWGS's code keeps the outer sides closed where a grid has one row or column, and loses what lies
/// beyond.
#[test]
fn a_model_that_was_split_is_whole_again_for_every_grid() {
    let means = random_means(3000);
    let whole = ply(&means, 9);
    for (columns, rows) in [(1, 1), (1, 4), (4, 1), (2, 1), (2, 2), (3, 3)] {
        let folder = TempDir::new().unwrap();
        let plan = grid_plan(columns, rows);
        let out = folder.path().join("model.ply");
        let results = write_results(&plan, &means, folder.path());
        let merged = merge(&plan, &results, u64::MAX, &out).unwrap();
        assert_eq!(merged.gaussians, 3000, "{columns}x{rows}");
        assert_eq!(merged.partitions.iter().map(|p| p.kept).sum::<u64>(), 3000);
        let bytes = fs::read(&out).unwrap();
        assert_eq!(sorted_rows(&bytes, 16 * 4), sorted_rows(&whole, 16 * 4), "{columns}x{rows}");
        if columns * rows == 1 {
            assert_eq!(bytes, whole, "a model of one partition is passed through");
        } else {
            assert!(merged.partitions.iter().any(|p| p.cropped > 0), "margins overlap");
        }
    }
}

#[test]
fn the_merged_model_has_the_training_headers_of_its_partitions() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let results = write_results(&plan, &random_means(300), folder.path());
    let out = folder.path().join("model.ply");
    let comment = format!("comment {}\n", fathom_core::ply::ANTIALIASED);
    let says_so = || {
        merge(&plan, &again(&results), u64::MAX, &out).unwrap();
        fs::read(&out).unwrap().windows(comment.len()).any(|bytes| bytes == comment.as_bytes())
    };
    assert!(!says_so());
    for (at, result) in results.iter().enumerate() {
        if at > 0 {
            // Only some have the header: no viewer could show both correctly.
            let error = merge(&plan, &results, u64::MAX, &out).unwrap_err();
            assert!(matches!(error, MergeError::Water { .. }), "{error}");
        }
        let bytes = fs::read(&result.path).unwrap();
        let (format, rest) = bytes.split_at(b"ply\nformat binary_little_endian 1.0\n".len());
        fs::write(&result.path, [format, comment.as_bytes(), rest].concat()).unwrap();
    }
    assert!(says_so());
}

#[test]
fn the_cap_holds_across_partitions_and_the_most_transparent_go() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let means = random_means(1000);
    let results = write_results(&plan, &means, folder.path());
    let [all, capped] = ["all.ply", "capped.ply"].map(|name| folder.path().join(name));
    merge(&plan, &results, u64::MAX, &all).unwrap();
    let merged = merge(&plan, &results, 900, &capped).unwrap();
    assert_eq!(merged.gaussians, 900);
    assert_eq!(
        merged.partitions.iter().map(|p| (p.kept, p.thinned)).fold((0, 0), |a, p| (a.0 + p.0, a.1 + p.1)),
        (900, 100)
    );
    let rows = |path: &Path| sorted_rows(&fs::read(path).unwrap(), 16 * 4);
    let (all, capped) = (rows(&all), rows(&capped));
    let opacity = |row: &Vec<u8>| f32::from_le_bytes(row[60..64].try_into().unwrap());
    let (mut stayed, mut gone) = (Vec::new(), Vec::new());
    for row in &all {
        let side = if capped.binary_search(row).is_ok() { &mut stayed } else { &mut gone };
        side.push(opacity(row));
    }
    assert_eq!((stayed.len(), gone.len()), (900, 100));
    let most = gone.iter().copied().fold(0.0, f32::max);
    assert!(stayed.iter().all(|&opacity| opacity > 0.99 * most), "one above {most} went before one below it");
}

#[test]
fn the_order_of_arrival_does_not_change_a_byte() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(3, 2);
    let mut results = write_results(&plan, &random_means(500), folder.path());
    let [one, other] = ["one.ply", "other.ply"].map(|name| folder.path().join(name));
    let counts = merge(&plan, &results, u64::MAX, &one).unwrap();
    results.rotate_left(2);
    results.reverse();
    assert_eq!(merge(&plan, &results, u64::MAX, &other).unwrap(), counts);
    assert_eq!(fs::read(one).unwrap(), fs::read(other).unwrap());
}

/// SMP-UWGS's code silently skips a cell whose file is missing.
#[test]
fn a_gap_is_refused_by_name() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let mut results = write_results(&plan, &random_means(100), folder.path());
    results.remove(3);
    results.remove(1);
    let out = folder.path().join("model.ply");
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("partitions 1, 3 are missing (2 of 4)"), "{error}");
    assert!(!out.exists());
}

#[test]
fn two_results_of_one_partition_and_results_of_none_are_refused() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let out = folder.path().join("model.ply");
    let mut results = write_results(&plan, &random_means(10), folder.path());
    results.push(results[0].clone());
    assert!(matches!(
        merge(&plan, &results, u64::MAX, &out),
        Err(MergeError::Twice { partition: PartitionId(0) })
    ));
    results[2].partition = PartitionId(7);
    assert!(matches!(
        merge(&plan, &results, u64::MAX, &out),
        Err(MergeError::Unknown { partition: PartitionId(7) })
    ));
}

#[test]
fn different_sh_degrees_are_refused_by_partition() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let results = write_results(&plan, &random_means(10), folder.path());
    fs::write(&results[1].path, ply(&random_means(4), 45)).unwrap();
    let error = merge(&plan, &results, u64::MAX, &folder.path().join("model.ply")).unwrap_err().to_string();
    assert!(error.contains("partition 1") && error.contains("SH 3") && error.contains("SH 1"), "{error}");
}

#[test]
fn a_truncated_result_is_refused_and_the_old_model_stays() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let results = write_results(&plan, &random_means(50), folder.path());
    let whole = fs::read(&results[1].path).unwrap();
    let out = folder.path().join("model.ply");
    fs::write(&out, "the old one").unwrap();

    fs::write(&results[1].path, &whole[..whole.len() - 5]).unwrap();
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    let last_row = format!("starts at byte {}", whole.len() - 64);
    assert!(error.contains("1.ply") && error.contains(&last_row), "{error}");

    fs::write(&results[1].path, [&whole[..], b"x"].concat()).unwrap();
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("after its last row"), "{error}");

    fs::write(&results[1].path, &whole[..40]).unwrap();
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("no end_header"), "{error}");
    assert_eq!(fs::read(&out).unwrap(), b"the old one");
    assert!(!temporary_name(&out).exists());
}

#[test]
fn gaussians_without_a_finite_centre_are_dropped_and_counted() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(1, 1);
    let path = folder.path().join("0.ply");
    let means = [[0.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0], [1.0, f32::INFINITY, 0.0], [1.0, 2.0, 3.0]];
    fs::write(&path, ply(&means, 0)).unwrap();
    let results = [result(PartitionId(0), path)];
    let merged = merge(&plan, &results, u64::MAX, &folder.path().join("model.ply")).unwrap();
    assert_eq!((merged.gaussians, merged.partitions[0].not_finite), (2, 2));
}

#[test]
fn a_far_gaussian_is_trained_by_the_partition_that_keeps_it() {
    for (columns, rows) in [(1, 1), (1, 4), (4, 1), (3, 3)] {
        let plan = grid_plan(columns, rows);
        for mean in random_means(2000).into_iter().map(|m| m.map(|v| v * 1e4)) {
            let keepers: Vec<_> = plan.partitions.iter().filter(|p| plan.keeps(p, mean)).collect();
            assert_eq!(keepers.len(), 1, "{mean:?}");
            assert!(plan.focuses(keepers[0], mean), "{mean:?} would be lost");
        }
    }
}

#[test]
fn a_changed_result_is_refused_and_the_old_model_stays() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let results = write_results(&plan, &random_means(50), folder.path());
    let out = folder.path().join("model.ply");
    fs::write(&out, "the old one").unwrap();
    let mut bytes = fs::read(&results[1].path).unwrap();
    // In a property that the merge never decodes.
    let at = bytes.len() - 10;
    bytes[at] ^= 1;
    fs::write(&results[1].path, &bytes).unwrap();
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("1.ply") && error.contains(&results[1].digest), "{error}");
    assert!(error.contains(blake3::hash(&bytes).to_hex().as_str()), "{error}");
    assert_eq!(fs::read(&out).unwrap(), b"the old one");
    assert!(!temporary_name(&out).exists());
}

#[test]
fn a_result_that_changes_between_the_passes_is_noticed_by_block() {
    let folder = TempDir::new().unwrap();
    // No border crosses it, so the second pass examines none of its rows.
    let plan = grid_plan(1, 1);
    let results = write_results(&plan, &random_means(9000), folder.path());
    let sources = sources(&local_files(), &plan, &results).unwrap();
    let survey = survey(&sources, &MergeConfig::default()).unwrap();
    let out = folder.path().join("model.ply");
    let mut bytes = fs::read(&results[0].path).unwrap();
    let header = bytes.len() - 9000 * 64;
    bytes[header + 5000 * 64 + 30] ^= 1;
    fs::write(&results[0].path, &bytes).unwrap();
    let error = write(&sources, &survey, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("0.ply") && error.contains("4096 rows from row 4096 on"), "{error}");
    fs::write(&results[0].path, &bytes[..bytes.len() - 64]).unwrap();
    assert!(matches!(write(&sources, &survey, u64::MAX, &out), Err(MergeError::File { .. })));
}

#[test]
fn uncut_blocks_are_copied_whole_and_outside_blocks_not_read() {
    let folder = TempDir::new().unwrap();
    let plan = cut_plan(&[(0, true, 0.5)]);
    // Three whole blocks on either side, in order: partition 0 has its neighbour's in its margin.
    let rotation = plan.alignment.rotation().inverse();
    let mean = |i: u32| {
        let x = if i < 3 * 4096 { -1.0 } else { 1.0 };
        (rotation * glam::DVec3::new(x, 0.0, f64::from(i) * 1e-3)).as_vec3().to_array()
    };
    let means: Vec<[f32; 3]> = (0..6 * 4096).map(mean).collect();
    let results = write_results(&plan, &means, folder.path());
    let sources = sources(&local_files(), &plan, &results).unwrap();
    let survey = survey(&sources, &MergeConfig::default()).unwrap();
    let inside = |source: usize| survey.blocks[source].iter().map(|block| block.inside).collect::<Vec<_>>();
    assert_eq!(inside(0), [4096, 4096, 4096, 0, 0, 0]);
    assert_eq!(inside(1), [0, 0, 0, 4096, 4096, 4096]);
    // The rows outside may even be missing by now.
    let bytes = fs::read(&results[0].path).unwrap();
    fs::write(&results[0].path, &bytes[..bytes.len() - 3 * 4096 * 64]).unwrap();
    let out = folder.path().join("model.ply");
    let merged = write(&sources, &survey, u64::MAX, &out).unwrap();
    assert_eq!(merged.gaussians, 6 * 4096);
    assert_eq!(fs::read(&out).unwrap(), ply(&means, 9));
}

#[test]
fn the_manifest_covers_the_model_and_bounds_every_centre() {
    let folder = TempDir::new().unwrap();
    let plan = cut_plan(&[(0, true, 0.3), (1, false, 0.6), (0, false, 0.5)]);
    let model = Model::crowded(3, 20_000, &plan);
    let out = folder.path().join("model.ply");
    let results = write_row_results(&plan, &model.rows, folder.path());
    let merged = merge(&plan, &results, 14_000, &out).unwrap();
    let text = serde_json::to_string(&ModelManifest::new(&plan, "plan", &results, &merged)).unwrap();
    let manifest: ModelManifest = serde_json::from_str(&text).unwrap();

    let bytes = fs::read(&out).unwrap();
    assert_eq!((manifest.bytes, manifest.gaussians), (bytes.len() as u64, 14_000));
    assert_eq!(manifest.blake3, blake3::hash(&bytes).to_hex().to_string());
    assert_eq!(
        (manifest.header_bytes + 14_000 * manifest.row_bytes, manifest.row_bytes),
        (manifest.bytes, 68)
    );
    let mut next = 0;
    for block in &manifest.blocks {
        assert_eq!(block.first, next);
        assert!((1..=4096).contains(&block.rows));
        next += u64::from(block.rows);
        let at = (manifest.header_bytes + block.first * manifest.row_bytes) as usize;
        let rows: Vec<&[u8]> = bytes[at..].chunks(68).take(block.rows as usize).collect();
        for axis in 0..3 {
            let along = || rows.iter().map(|row| Model::mean(row)[axis]);
            assert_eq!(block.min[axis], along().fold(f32::MAX, f32::min), "tight from below");
            assert_eq!(block.max[axis], along().fold(f32::MIN, f32::max), "tight from above");
        }
        let widest = rows
            .iter()
            .flat_map(|row| [40, 44, 48].map(|at| f32::from_le_bytes(row[at..at + 4].try_into().unwrap())));
        assert_eq!(block.deviation, Some(widest.fold(f32::MIN, f32::max).exp()));
        let cell = &plan.partitions[block.partition.0 as usize];
        assert!(rows.iter().all(|row| plan.keeps(cell, Model::mean(row))), "of its partition's cell");
    }
    assert_eq!(next, 14_000);
    assert!(manifest.partitions.iter().any(|partition| partition.thinned > 0));
    let mut first = 0;
    for (partition, result) in manifest.partitions.iter().zip(&results) {
        assert_eq!((partition.first, &partition.result), (first, &result.digest));
        first += partition.kept;
        let all = partition.kept + partition.cropped + partition.duplicates + partition.thinned;
        assert_eq!(all, PlyFile::read(&local_files(), &result.path).unwrap().rows);
        assert!(partition.duplicates > 0, "{partition:?}");
    }
}

#[test]
fn the_manifest_follows_rows_that_were_trained_after_the_merge() {
    let folder = TempDir::new().unwrap();
    let plan = cut_plan(&[(0, true, 0.3)]);
    let model = Model::crowded(3, 9000, &plan);
    let out = folder.path().join("model.ply");
    let results = write_row_results(&plan, &model.rows, folder.path());
    let merged = merge(&plan, &results, 9000, &out).unwrap();
    let manifest = ModelManifest::new(&plan, "plan", &results, &merged);
    let same = manifest.clone().of_changed_rows(&local_files(), &out, &manifest.blake3).unwrap();
    assert_eq!(same, manifest);

    let (mut bytes, row_bytes) = (fs::read(&out).unwrap(), manifest.row_bytes as usize);
    let moved = manifest.blocks[1].first as usize + 7;
    let at = manifest.header_bytes as usize + moved * row_bytes;
    bytes[at..at + 4].copy_from_slice(&1e6_f32.to_le_bytes());
    fs::write(&out, &bytes).unwrap();
    let digest = blake3::hash(&bytes).to_hex().to_string();
    let after = manifest.clone().of_changed_rows(&local_files(), &out, &digest).unwrap();
    assert_eq!((after.blake3.as_str(), after.blocks[1].max[0]), (digest.as_str(), 1e6));
    for (index, (block, before)) in after.blocks.iter().zip(&manifest.blocks).enumerate() {
        assert_eq!((block.first, block.rows), (before.first, before.rows));
        assert_eq!(block == before, index != 1, "block {index}");
    }
    fs::write(&out, ply(&[[0.0; 3]; 12], 9)).unwrap();
    let refused = manifest.of_changed_rows(&local_files(), &out, &digest).unwrap_err().to_string();
    assert!(refused.contains("12 rows"), "{refused}");
}

#[test]
fn deciding_region_by_region_gives_the_same_bytes() {
    let folder = TempDir::new().unwrap();
    let plan = cut_plan(&[(0, true, 0.3), (1, false, 0.6), (0, false, 0.5)]);
    let model = Model::crowded(4, 30_000, &plan);
    let results = write_row_results(&plan, &model.rows, folder.path());
    let [one, other] = ["one.ply", "other.ply"].map(|name| folder.path().join(name));
    let in_memory = MergeConfig::default();
    let in_regions = MergeConfig { memory_mib: 1, ..in_memory.clone() };
    let near = survey(&sources(&local_files(), &plan, &results).unwrap(), &in_memory).unwrap();
    let candidates: usize = near.blocks.iter().flatten().filter(|block| block.reach >= 0.0).count();
    assert!(candidates > 3, "{candidates} blocks with candidates");
    let counts = super::merge(&plan, &results, &in_memory, u64::MAX, &one).unwrap();
    assert_eq!(super::merge(&plan, &results, &in_regions, u64::MAX, &other).unwrap(), counts);
    assert_eq!(fs::read(one).unwrap(), fs::read(other).unwrap());
    assert!(counts.partitions.iter().map(|p| p.duplicates).sum::<u64>() > 5000, "{counts:?}");
}

#[test]
fn gaussians_that_partitions_share_are_no_duplicates() {
    let folder = TempDir::new().unwrap();
    let mut plan = cut_plan(&[(0, true, 0.5)]);
    let model = Model::crowded(6, 3000, &plan);
    let results = write_row_results(&plan, &model.rows, folder.path());
    let out = folder.path().join("model.ply");
    let mut gone_at = |distance: f64| {
        plan.extent.viewing_distance = Some(distance);
        let merged = merge(&plan, &results, u64::MAX, &out).unwrap();
        merged.partitions.iter().map(|p| p.duplicates).sum::<u64>()
    };
    assert!(gone_at(10.0) > 100);
    assert_eq!(gone_at(1.0), 0, "all are wider than a fifth of it");
}

#[test]
fn without_shapes_or_with_the_switch_off_nothing_is_compared() {
    let folder = TempDir::new().unwrap();
    let plan = cut_plan(&[(0, true, 0.5)]);
    let out = folder.path().join("model.ply");
    let off = MergeConfig { duplicates: false, ..MergeConfig::default() };
    let results = write_row_results(&plan, &Model::crowded(6, 3000, &plan).rows, folder.path());
    assert_eq!(super::merge(&plan, &results, &off, u64::MAX, &out).unwrap().gaussians, 3000);
    let results = write_results(&plan, &random_means(3000), folder.path());
    assert_eq!(merge(&plan, &results, u64::MAX, &out).unwrap().gaussians, 3000);
}
