//! Counts the duplicates found in an existing model: at its own borders, and at shifted ones.
//!
//! `cargo run -p fathom-merge --example merge_again -- OUT [MODEL.ply]`: merges `OUT/model.ply` with
//! itself by the cells of `OUT/plan.json`, with several bounds, and prints how many Gaussians are removed.
//! Then it does the same with all borders moved by three eighths of the extension to either side. There both
//! sides of a border come from one partition, so removed Gaussians are neighbours, not duplicates. With
//! MODEL.ply it writes the merge with default bounds there.

use std::error::Error;
use std::path::PathBuf;

use fathom_core::config::MergeConfig;
use fathom_merge::{PartitionResult, merge};
use fathom_plan::{Interval, Partition, Plan, Rect};

type Outcome<T> = Result<T, Box<dyn Error>>;

fn main() -> Outcome<()> {
    let mut args = std::env::args().skip(1);
    let out = PathBuf::from(args.next().ok_or("merge_again OUT [MODEL.ply]")?);
    let kept = args.next().map(PathBuf::from);
    let plan: Plan = serde_json::from_slice(&std::fs::read(out.join("plan.json"))?)?;
    let path = out.join("model.ply");
    let digest = blake3::hash(&std::fs::read(&path)?).to_hex().to_string();
    let folder = tempfile::tempdir()?;
    let gone = |plan: &Plan, config: &MergeConfig, to: PathBuf| -> Outcome<u64> {
        let result = |partition: &Partition| PartitionResult {
            partition: partition.id,
            path: path.clone(),
            digest: digest.clone(),
        };
        let results: Vec<PartitionResult> = plan.partitions.iter().map(result).collect();
        let merged = merge(plan, &results, config, u64::MAX, &to)?;
        Ok(merged.partitions.iter().map(|partition| partition.duplicates).sum())
    };
    let default = MergeConfig::default();
    println!("band centre width colour | gone at the borders, 3/8 before, 3/8 behind");
    for (band, centre, width, colour) in [
        (default.band, default.centre, default.width, default.colour),
        (1.0, default.centre, default.width, default.colour),
        (default.band, 0.25, default.width, default.colour),
        (default.band, 1.0, default.width, default.colour),
        (default.band, default.centre, 1.25, default.colour),
        (default.band, default.centre, 2.0, default.colour),
        (default.band, default.centre, default.width, 0.05),
        (default.band, default.centre, default.width, 0.2),
    ] {
        let config = MergeConfig { band, centre, width, colour, ..default.clone() };
        let at = |share: f64| gone(&moved(&plan, share), &config, folder.path().join("model.ply"));
        println!("{band} {centre} {width} {colour} | {} {} {}", at(0.0)?, at(-0.375)?, at(0.375)?);
    }
    if let Some(kept) = kept {
        gone(&plan, &default, kept)?;
    }
    Ok(())
}

/// The plan with all borders moved, on each axis by a share of the smallest extension.
fn moved(plan: &Plan, share: f64) -> Plan {
    let smallest = |side: fn(&Rect) -> Interval| {
        let of = |partition: &Partition| {
            let (cell, focus) = (side(&partition.cell), side(&partition.focus));
            [(cell.lo, focus.lo), (cell.hi, focus.hi)]
                .into_iter()
                .filter_map(|(at, beyond)| Some((at? - beyond?).abs()))
        };
        plan.partitions.iter().flat_map(of).min_by(f64::total_cmp).unwrap_or(0.0)
    };
    let (x, z) = (share * smallest(|rect| rect.x), share * smallest(|rect| rect.z));
    let moved =
        |Interval { lo, hi }: Interval, by: f64| Interval { lo: lo.map(|v| v + by), hi: hi.map(|v| v + by) };
    let rect = |rect: Rect| Rect { x: moved(rect.x, x), z: moved(rect.z, z) };
    let mut plan = plan.clone();
    for partition in &mut plan.partitions {
        (partition.cell, partition.focus) = (rect(partition.cell), rect(partition.focus));
    }
    plan
}
