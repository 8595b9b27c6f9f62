//! Measures the cost of a merge: synthetic Gaussians of 8 x 8 partitions, written as a stream, merged, and
//! compared with a plain copy.
//!
//! `cargo run -p fathom-merge --example merge_scale -- ROWS [SH_DEGREE] [DIR]`: ROWS Gaussians of all
//! partitions together, margins included, as rows of SH_DEGREE (default 0). Files lie under DIR (default: the
//! folder for temporary files) and are removed at the end. DIR needs twice the files' size. It prints seconds
//! and bytes a second, cold (on Linux the files are dropped from the page cache first) and warm. It also
//! prints the peak resident memory of the merge and the speed of copying the same files to the same disk. Two
//! orders of arrival must give the same bytes.

use std::error::Error;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use fathom_core::config::JobConfig;
use fathom_core::ply::Layout;
use fathom_core::scene::{PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use fathom_merge::{Merged, PartitionResult, merge};
use fathom_plan::{Partition, Plan, PlanInput, plan};
use glam::DVec3;
use rayon::prelude::*;

/// Partitions along each side.
const SIDE: u32 = 8;
/// Cameras along each side, a unit apart.
const CAMERAS: u32 = 64;
/// Rows of a compact run.
const BLOCK_ROWS: u64 = 4096;

type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

fn main() -> Outcome<()> {
    let mut args = std::env::args().skip(1);
    let rows: u64 = args.next().ok_or("merge_scale ROWS [SH_DEGREE] [DIR]")?.replace('_', "").parse()?;
    let degree: u8 = args.next().map_or(Ok(0), |degree| degree.parse())?;
    let layout = Layout::new(degree).ok_or("SH_DEGREE is 0 to 3")?;
    let dir = args.next().map_or_else(std::env::temp_dir, PathBuf::from);
    let folder = tempfile::Builder::new().prefix("merge-scale-").tempdir_in(dir)?;

    let plan = synthetic_plan()?;
    let started = Instant::now();
    let results = write_results(&plan, rows, layout, folder.path())?;
    let paths: Vec<&Path> = results.iter().map(|result| result.path.as_path()).collect();
    let bytes: u64 = paths.iter().map(|path| Ok(path.metadata()?.len())).sum::<Outcome<u64>>()?;
    let gib = bytes as f64 / f64::from(1 << 30);
    println!(
        "{rows} rows of SH {degree} in {} files, {gib:.2} GiB, made in {:.0} s",
        results.len(),
        started.elapsed().as_secs_f64()
    );

    let mut digests = Vec::new();
    for (name, is_cold) in [("cold", true), ("warm", false)] {
        let [copied, merged] = [&copy_all, &merge_all as &dyn Fn(&Plan, &[PartitionResult], &Path) -> _].map(
            |work| -> Outcome<(f64, f64, Option<Merged>)> {
                if is_cold {
                    paths.iter().try_for_each(|path| drop_from_cache(path))?;
                }
                let mut arrived = results.clone();
                // Another order of arrival for each.
                arrived.sort_by_key(|result| {
                    blake3::hash(format!("{name} {}", result.partition).as_bytes()).to_hex()
                });
                let (started, cpu) = (Instant::now(), cpu_seconds());
                let merged = work(&plan, &arrived, folder.path())?;
                Ok((started.elapsed().as_secs_f64(), cpu_seconds() - cpu, merged))
            },
        );
        let ((copy_seconds, copy_cpu, _), (seconds, cpu, merged)) = (copied?, merged?);
        let merged = merged.ok_or("nothing was merged")?;
        let sum =
            |of: fn(&fathom_merge::MergedPartition) -> u64| merged.partitions.iter().map(of).sum::<u64>();
        println!(
            "{name}: merged to {} rows ({} cropped, {} duplicates) in {seconds:.1} s ({cpu:.1} of CPU), {:.0} MiB/s of input; \
             copied in {copy_seconds:.1} s ({copy_cpu:.1} of CPU), {:.0} MiB/s; ratio {:.2}",
            merged.gaussians,
            sum(|p| p.cropped),
            sum(|p| p.duplicates),
            gib * 1024.0 / seconds,
            gib * 1024.0 / copy_seconds,
            copy_seconds / seconds,
        );
        digests.push(merged.digest);
    }
    let same = digests.windows(2).all(|pair| pair[0] == pair[1]);
    println!(
        "two orders of arrival give {} bytes; BLAKE3 {}",
        if same { "the same" } else { "OTHER" },
        digests[0]
    );
    if same { Ok(()) } else { Err("the order of arrival changed the model".into()) }
}

/// Merges, and prints the peak resident memory.
fn merge_all(plan: &Plan, results: &[PartitionResult], folder: &Path) -> Outcome<Option<Merged>> {
    let out = folder.join("model.ply");
    reset_peak();
    let merged = merge(plan, results, &JobConfig::default().merge, u64::MAX, &out)?;
    println!(
        "peak resident memory of the merge: {}",
        peak().unwrap_or_else(|| "unknown on this system".into())
    );
    std::fs::remove_file(out)?;
    Ok(Some(merged))
}

/// Copies every file, down to the disk.
fn copy_all(_: &Plan, results: &[PartitionResult], folder: &Path) -> Outcome<Option<Merged>> {
    let copies = folder.join("copies");
    std::fs::create_dir(&copies)?;
    for result in results {
        let to = copies.join(result.partition.to_string());
        std::fs::copy(&result.path, &to)?;
        File::open(&to)?.sync_all()?;
    }
    std::fs::remove_dir_all(copies)?;
    Ok(None)
}

/// Upright cameras a unit apart, cut into 8 x 8, with margins of a tenth of a cell on every side.
fn synthetic_plan() -> Outcome<Plan> {
    let camera = PinholeCamera { width: 400, height: 300, fx: 300.0, fy: 300.0, cx: 200.0, cy: 150.0 };
    let view = |i: u32| {
        let eye = DVec3::new(f64::from(i / CAMERAS), 0.0, f64::from(i % CAMERAS));
        TrainView {
            name: format!("{i:05}"),
            camera,
            pose: Pose::looking_at(eye, eye + DVec3::Z, DVec3::Y),
            clear_range: 0.0,
        }
    };
    let views: Vec<TrainView> = (0..CAMERAS * CAMERAS).map(view).collect();
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (SIDE, SIDE);
    (config.partition.extend_base, config.partition.extend_edge, config.partition.extend_inner) =
        (0.1, 1.0, 1.0);
    config.data.test_every = 0;
    Ok(plan(&PlanInput { views: &views, points: &Points::default(), config: &config })?)
}

/// The results of all partitions: `rows` in total.
fn write_results(plan: &Plan, rows: u64, layout: Layout, folder: &Path) -> Outcome<Vec<PartitionResult>> {
    let each = rows / plan.partitions.len() as u64;
    let write = |partition: &Partition| -> Outcome<PartitionResult> {
        let path = folder.join(format!("{}.ply", partition.id));
        let digest = write_result(plan, partition, each, layout, &path)?;
        Ok(PartitionResult { partition: partition.id, path, digest })
    };
    plan.partitions.par_iter().map(write).collect()
}

/// Gaussians across the focus of a partition, 4096 to a tile, the tiles along a Morton curve; returns the
/// digest of the file.
fn write_result(
    plan: &Plan,
    partition: &Partition,
    rows: u64,
    layout: Layout,
    path: &Path,
) -> Outcome<String> {
    let to_scene = plan.alignment.rotation().inverse();
    let closed = partition.extended_box;
    let [x, z] = [0, 2].map(|axis| (closed.min[axis], closed.max[axis]));
    let order = (rows.div_ceil(BLOCK_ROWS) as f64).log2().div_euclid(2.0) as u32 + 1;
    let tiles = 1_u64 << (2 * order);
    let spacing = ((x.1 - x.0) * (z.1 - z.0) / rows as f64).sqrt();
    let mut hasher = blake3::Hasher::new();
    let mut file = BufWriter::with_capacity(1 << 20, File::create(path)?);
    let header = layout.header(rows, &[]);
    hasher.update(header.as_bytes());
    file.write_all(header.as_bytes())?;
    let mut block = Vec::with_capacity(BLOCK_ROWS as usize * layout.row_bytes());
    for tile in 0..tiles {
        let (from, to) = (rows * tile / tiles, rows * (tile + 1) / tiles);
        let corner = [compact(tile), compact(tile >> 1)].map(|v| v as f64 / f64::from(1 << order));
        block.clear();
        for row in from..to {
            let mut random = Random(u64::from(partition.id.0) << 40 | row);
            let mut place = |corner: f64, (lo, hi): (f64, f64)| {
                lo + (corner + random.next() / f64::from(1 << order)) * (hi - lo)
            };
            let at = DVec3::new(place(corner[0], x), 0.0, place(corner[1], z));
            let mean = (to_scene * at).as_vec3();
            let mut put = |value: f64| block.extend_from_slice(&(value as f32).to_le_bytes());
            mean.to_array().into_iter().chain([0.0; 3]).for_each(|v| put(f64::from(v)));
            // Colours that change slowly, so that neighbours agree in them.
            [0.3, 0.5, 0.7].into_iter().for_each(|f| put((at.x * f + at.z * 0.4).sin()));
            (0..3 * layout.rest_per_channel()).for_each(|_| put(random.next() - 0.5));
            put(random.next() * 8.0 - 4.0);
            (0..3).for_each(|_| put((0.5 * spacing * (0.9 + 0.2 * random.next())).ln()));
            [1.0, 0.0, 0.0, 0.0].into_iter().for_each(&mut put);
        }
        hasher.update(&block);
        file.write_all(&block)?;
    }
    file.into_inner()?.sync_all()?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Every second bit.
fn compact(mut v: u64) -> u64 {
    let mut out = 0;
    let mut bit = 0;
    while v > 0 {
        out |= (v & 1) << bit;
        (v, bit) = (v >> 2, bit + 1);
    }
    out
}

/// Uniform numbers in [0, 1) (SplitMix64, Steele et al. 2014).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut v = self.0.wrapping_mul(0xD1B5_4A32_D192_ED03);
        v = (v ^ v >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        v = (v ^ v >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((v ^ v >> 31) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// CPU time of this process, user and system; 0 where /proc does not report it (ticks of 10 ms).
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = after_name.split_whitespace().skip(11).take(2).filter_map(|field| field.parse::<f64>().ok());
    ticks.sum::<f64>() / 100.0
}

/// Resets the peak (Linux).
fn reset_peak() {
    // Where this is not possible, the peak includes writing the files.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

fn peak() -> Option<String> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().trim_end_matches(" kB").parse().ok()?;
    Some(format!("{:.0} MiB", kib / 1024.0))
}

#[cfg(target_os = "linux")]
fn drop_from_cache(path: &Path) -> Outcome<()> {
    let file = File::open(path)?;
    file.sync_all()?;
    rustix::fs::fadvise(&file, 0, None, rustix::fs::Advice::DontNeed)?;
    Ok(())
}

#[cfg(not(target_os = "linux"))]
fn drop_from_cache(_: &Path) -> Outcome<()> {
    Ok(())
}
