//! Properties that hold for every plan and every model.

use std::collections::BTreeSet;
use std::fs;

use fathom_core::config::MergeConfig;
use glam::DVec3;
use proptest::prelude::*;
use tempfile::TempDir;

use super::*;
use crate::fixtures::{Model, cut_plan, rows_of, sorted_rows, write_row_results};

/// Bytes of a row of [`Model`].
const ROW_BYTES: usize = Model::ROW_BYTES;

fn without_duplicates_removed() -> MergeConfig {
    MergeConfig { duplicates: false, ..MergeConfig::default() }
}

/// Any cut of the plane into rectangles: the cell to cut next, the axis, and the position.
fn cuts() -> impl Strategy<Value = Vec<(usize, bool, f64)>> {
    prop::collection::vec((0_usize..8, any::<bool>(), 0.2_f64..0.8), 0..6)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn a_model_that_was_split_is_the_same_set_of_rows_again(
        cuts in cuts(),
        count in 0_u32..9000,
        seed in any::<u32>(),
    ) {
        let (folder, plan) = (TempDir::new().unwrap(), cut_plan(&cuts));
        let model = Model::random(seed, count);
        let out = folder.path().join("model.ply");
        let results = write_row_results(&plan, &model.rows, folder.path());
        let merged = merge(&plan, &results, &without_duplicates_removed(), u64::MAX, &out).unwrap();
        prop_assert_eq!(merged.gaussians, u64::from(count));
        let bytes = fs::read(&out).unwrap();
        prop_assert_eq!(merged.bytes, bytes.len() as u64);
        prop_assert_eq!(&merged.digest, &blake3::hash(&bytes).to_hex().to_string());
        prop_assert_eq!(sorted_rows(&bytes, ROW_BYTES), sorted_rows(&model.ply(), ROW_BYTES));
    }

    #[test]
    fn any_order_of_arrival_gives_the_same_bytes(
        cuts in cuts(),
        seed in any::<u32>(),
        turn in 0_usize..8,
        cap in 1_u64..3000,
    ) {
        let (folder, plan) = (TempDir::new().unwrap(), cut_plan(&cuts));
        let mut results = write_row_results(&plan, &Model::crowded(seed, 2000, &plan).rows, folder.path());
        let [one, other] = ["one.ply", "other.ply"].map(|name| folder.path().join(name));
        let counts = merge(&plan, &results, &MergeConfig::default(), cap, &one).unwrap();
        let turn = turn % results.len();
        results.rotate_left(turn);
        results.reverse();
        prop_assert_eq!(merge(&plan, &results, &MergeConfig::default(), cap, &other).unwrap(), counts);
        prop_assert_eq!(fs::read(one).unwrap(), fs::read(other).unwrap());
    }

    #[test]
    fn duplicates_are_near_borders_and_a_second_merge_finds_none(
        cuts in cuts(),
        seed in any::<u32>(),
    ) {
        let (folder, plan) = (TempDir::new().unwrap(), cut_plan(&cuts));
        let model = Model::crowded(seed, 3000, &plan);
        let out = folder.path().join("model.ply");
        let config = MergeConfig::default();
        let results = write_row_results(&plan, &model.rows, folder.path());
        let merged = merge(&plan, &results, &config, u64::MAX, &out).unwrap();
        let duplicates: u64 = merged.partitions.iter().map(|p| p.duplicates).sum();
        prop_assert_eq!(merged.gaussians + duplicates, 3000);
        prop_assert!(plan.partitions.len() > 1 || duplicates == 0, "of one partition alone");

        let left: BTreeSet<Vec<u8>> = rows_of(&fs::read(&out).unwrap(), ROW_BYTES).into_iter().collect();
        for row in model.rows.iter().filter(|row| !left.contains(&row[..])) {
            let (distance, band) = distance_and_band(&plan, Model::mean(row), config.band);
            prop_assert!(distance < band, "{distance} from the border, and the band has {band}");
        }

        // The order of rows in the files does not matter either.
        let mut turned = model.rows.clone();
        turned.reverse();
        let results = write_row_results(&plan, &turned, folder.path());
        merge(&plan, &results, &config, u64::MAX, &out).unwrap();
        let again: Vec<Vec<u8>> = rows_of(&fs::read(&out).unwrap(), ROW_BYTES);
        prop_assert!(again.iter().cloned().collect::<BTreeSet<_>>() == left, "other rows go when they come in another order");

        let results = write_row_results(&plan, &again, folder.path());
        let twice = merge(&plan, &results, &config, u64::MAX, &out).unwrap();
        prop_assert_eq!(twice.gaussians, merged.gaussians);
        prop_assert!(twice.partitions.iter().all(|p| p.duplicates == 0));
    }
}

#[test]
fn crowds_at_borders_lose_duplicates_and_the_rest_stays() {
    let (folder, plan) = (TempDir::new().unwrap(), cut_plan(&[(0, true, 0.5), (1, false, 0.4)]));
    let model = Model::crowded(5, 4000, &plan);
    let out = folder.path().join("model.ply");
    let results = write_row_results(&plan, &model.rows, folder.path());
    let merged = merge(&plan, &results, &MergeConfig::default(), u64::MAX, &out).unwrap();
    let duplicates: u64 = merged.partitions.iter().map(|p| p.duplicates).sum();
    assert!((100..2000).contains(&duplicates), "{duplicates} of 4000: the properties above prove little");
}

/// Distance of a Gaussian from the nearest border of its cell, and the width of the band there.
fn distance_and_band(plan: &Plan, mean: [f32; 3], share: f64) -> (f64, f64) {
    let at: DVec3 = plan.alignment.to_aligned(mean);
    let partition = plan.partitions.iter().find(|p| p.cell.contains(at)).unwrap();
    let sides = [(at.x, partition.cell.x, partition.focus.x), (at.z, partition.cell.z, partition.focus.z)];
    let bands = sides.into_iter().flat_map(|(at, cell, focus)| {
        [(cell.lo, focus.lo), (cell.hi, focus.hi)].into_iter().filter_map(move |(side, beyond)| {
            let side = side?;
            Some(((at - side).abs(), share * (beyond? - side).abs()))
        })
    });
    bands.min_by(|a, b| (a.0 - a.1).total_cmp(&(b.0 - b.1))).unwrap_or((f64::INFINITY, 0.0))
}
