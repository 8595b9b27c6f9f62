#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;

use fathom_core::config::JobConfig;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use glam::DVec3;
use tempfile::TempDir;

use super::*;
use crate::partition::{PlanInput, plan};

/// Nadir cameras over a tilted grid, so that the aligned frame is not the world's.
fn grid_plan(columns: u32, rows: u32) -> Plan {
    let camera = PinholeCamera { width: 40, height: 30, fx: 30.0, fy: 30.0, cx: 20.0, cy: 15.0 };
    let down = DVec3::new(0.3, -0.2, 0.9).normalize();
    let x = down.any_orthonormal_vector();
    let z = down.cross(x);
    let views: Vec<TrainView> = (0..144)
        .map(|i| {
            let eye = x * f64::from(i / 12) + z * f64::from(i % 12);
            let pose = Pose::looking_at(eye, eye + down + z * 1e-3 * f64::from(i % 5), x);
            TrainView { name: format!("{i:03}"), camera, pose }
        })
        .collect();
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (columns, rows);
    plan(&PlanInput { views: &views, points: &Points::default(), config: &config }).unwrap()
}

/// A PLY of Gaussians whose other properties are noise; `rest` is the number of f_rest values.
fn ply(means: &[[f32; 3]], rest: usize) -> Vec<u8> {
    let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into_iter();
    let names: Vec<String> =
        names.chain((0..rest).map(|i| format!("f_rest_{i}"))).chain(["opacity".to_owned()]).collect();
    let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", means.len());
    for name in &names {
        bytes.push_str(&format!("property float {name}\n"));
    }
    bytes.push_str("end_header\n");
    let mut bytes = bytes.into_bytes();
    for mean in means {
        for value in mean {
            bytes.extend(value.to_le_bytes());
        }
        for k in 3..names.len() {
            let key = mean[0].to_bits() ^ mean[1].to_bits().rotate_left(7);
            bytes.extend(uniform_at(3, Stream::Test, key, k as u32).to_le_bytes());
        }
    }
    bytes
}

/// Means that spread well beyond the cameras of [`grid_plan`].
fn random_means(count: u32) -> Vec<[f32; 3]> {
    (0..count)
        .map(|i| std::array::from_fn(|k| (uniform_at(9, Stream::Test, i, k as u32) - 0.4) * 60.0))
        .collect()
}

/// Writes what each partition would hand in of the model `means`: everything in its focus.
fn hand_in(plan: &Plan, means: &[[f32; 3]], folder: &Path) -> Vec<PartitionResult> {
    plan.partitions
        .iter()
        .map(|partition| {
            let focus: Vec<[f32; 3]> =
                means.iter().copied().filter(|&m| plan.focuses(partition, m)).collect();
            let path = folder.join(format!("{}.ply", partition.id));
            fs::write(&path, ply(&focus, 9)).unwrap();
            PartitionResult { partition: partition.id, path }
        })
        .collect()
}

fn sorted_rows(bytes: &[u8], row_bytes: usize) -> Vec<Vec<u8>> {
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let mut rows: Vec<Vec<u8>> = bytes[start..].chunks(row_bytes).map(<[u8]>::to_vec).collect();
    rows.sort_unstable();
    rows
}

#[test]
fn a_model_that_was_split_is_whole_again_for_every_grid() {
    let means = random_means(3000);
    let whole = ply(&means, 9);
    for (columns, rows) in [(1, 1), (1, 4), (4, 1), (2, 1), (2, 2), (3, 3)] {
        let folder = TempDir::new().unwrap();
        let plan = grid_plan(columns, rows);
        let out = folder.path().join("model.ply");
        let results = hand_in(&plan, &means, folder.path());
        let merged = merge(&plan, &results, u64::MAX, &out).unwrap();
        assert_eq!(merged.gaussians, 3000, "{columns}x{rows}");
        assert_eq!(merged.partitions.iter().map(|p| p.kept).sum::<u64>(), 3000);
        let bytes = fs::read(&out).unwrap();
        assert_eq!(sorted_rows(&bytes, 16 * 4), sorted_rows(&whole, 16 * 4), "{columns}x{rows}");
        if columns * rows == 1 {
            assert_eq!(bytes, whole, "a model of one partition is handed through");
        } else {
            assert!(merged.partitions.iter().any(|p| p.cropped > 0), "margins overlap");
        }
    }
}

#[test]
fn what_partitions_say_about_their_training_is_said_by_the_merged_model() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let results = hand_in(&plan, &random_means(300), folder.path());
    let out = folder.path().join("model.ply");
    let comment = format!("comment {}\n", fathom_core::ply::ANTIALIASED);
    let says_so = || {
        merge(&plan, &results, u64::MAX, &out).unwrap();
        fs::read(&out).unwrap().windows(comment.len()).any(|bytes| bytes == comment.as_bytes())
    };
    assert!(!says_so());
    for (at, result) in results.iter().enumerate() {
        if at > 0 {
            // Some say it and others do not: no viewer could show both right.
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
fn the_cap_of_the_job_holds_across_partitions_and_the_most_transparent_go() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let means = random_means(1000);
    let results = hand_in(&plan, &means, folder.path());
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
    let mut results = hand_in(&plan, &random_means(500), folder.path());
    let [one, other] = ["one.ply", "other.ply"].map(|name| folder.path().join(name));
    let counts = merge(&plan, &results, u64::MAX, &one).unwrap();
    results.rotate_left(2);
    results.reverse();
    assert_eq!(merge(&plan, &results, u64::MAX, &other).unwrap(), counts);
    assert_eq!(fs::read(one).unwrap(), fs::read(other).unwrap());
}

#[test]
fn a_gap_is_refused_by_name() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 2);
    let mut results = hand_in(&plan, &random_means(100), folder.path());
    results.remove(3);
    results.remove(1);
    let out = folder.path().join("model.ply");
    let error = merge(&plan, &results, u64::MAX, &out).unwrap_err().to_string();
    assert!(error.contains("partitions 1, 3 (2 of 4)"), "{error}");
    assert!(!out.exists());
}

#[test]
fn two_results_of_one_partition_and_results_of_none_are_refused() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let out = folder.path().join("model.ply");
    let mut results = hand_in(&plan, &random_means(10), folder.path());
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
    let results = hand_in(&plan, &random_means(10), folder.path());
    fs::write(&results[1].path, ply(&random_means(4), 45)).unwrap();
    let error = merge(&plan, &results, u64::MAX, &folder.path().join("model.ply")).unwrap_err().to_string();
    assert!(error.contains("partition 1") && error.contains("SH 3") && error.contains("SH 1"), "{error}");
}

#[test]
fn a_truncated_result_is_refused_by_file_and_offset_and_leaves_the_old_model() {
    let folder = TempDir::new().unwrap();
    let plan = grid_plan(2, 1);
    let results = hand_in(&plan, &random_means(50), folder.path());
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
    let results = [PartitionResult { partition: PartitionId(0), path }];
    let merged = merge(&plan, &results, u64::MAX, &folder.path().join("model.ply")).unwrap();
    assert_eq!((merged.gaussians, merged.partitions[0].not_finite), (2, 2));
}

#[test]
fn a_gaussian_far_outside_of_all_cameras_is_trained_by_the_partition_that_keeps_it() {
    for (columns, rows) in [(1, 1), (1, 4), (4, 1), (3, 3)] {
        let plan = grid_plan(columns, rows);
        for mean in random_means(2000).into_iter().map(|m| m.map(|v| v * 1e4)) {
            let keepers: Vec<_> = plan.partitions.iter().filter(|p| plan.keeps(p, mean)).collect();
            assert_eq!(keepers.len(), 1, "{mean:?}");
            assert!(plan.focuses(keepers[0], mean), "{mean:?} would be lost");
        }
    }
}
