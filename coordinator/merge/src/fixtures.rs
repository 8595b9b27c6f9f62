//! Plans and files that the tests of the merge share.

use std::fs;
use std::path::{Path, PathBuf};

use fathom_core::config::JobConfig;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Points, Pose};
use fathom_core::views::TrainView;
use glam::DVec3;

use crate::PartitionResult;
use fathom_plan::{Interval, Partition, PartitionId, Plan, PlanInput, Rect, plan};

/// Nadir cameras over a tilted grid, so that the aligned frame is not the world's.
pub fn grid_plan(columns: u32, rows: u32) -> Plan {
    let camera = PinholeCamera { width: 40, height: 30, fx: 30.0, fy: 30.0, cx: 20.0, cy: 15.0 };
    let down = DVec3::new(0.3, -0.2, 0.9).normalize();
    let x = down.any_orthonormal_vector();
    let z = down.cross(x);
    let views: Vec<TrainView> = (0..144)
        .map(|i| {
            let eye = x * f64::from(i / 12) + z * f64::from(i % 12);
            let pose = Pose::looking_at(eye, eye + down + z * 1e-3 * f64::from(i % 5), x);
            TrainView { name: format!("{i:03}"), camera, pose, clear_range: 0.0 }
        })
        .collect();
    let mut config = JobConfig::default();
    (config.partition.columns, config.partition.rows) = (columns, rows);
    plan(&PlanInput { views: &views, points: &Points::default(), config: &config }).unwrap()
}

/// A PLY of Gaussians with noise in the other properties; `rest` is the number of f_rest values.
pub fn ply(means: &[[f32; 3]], rest: usize) -> Vec<u8> {
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

/// Means far beyond the cameras of [`grid_plan`].
pub fn random_means(count: u32) -> Vec<[f32; 3]> {
    (0..count)
        .map(|i| std::array::from_fn(|k| (uniform_at(9, Stream::Test, i, k as u32) - 0.4) * 60.0))
        .collect()
}

/// A file with its current digest.
pub fn result(partition: PartitionId, path: PathBuf) -> PartitionResult {
    let digest = blake3::hash(&fs::read(&path).unwrap()).to_hex().to_string();
    PartitionResult { partition, path, digest }
}

/// Writes the result of each partition for the model `means`: everything in its focus.
pub fn write_results(plan: &Plan, means: &[[f32; 3]], folder: &Path) -> Vec<PartitionResult> {
    plan.partitions
        .iter()
        .map(|partition| {
            let focus: Vec<[f32; 3]> =
                means.iter().copied().filter(|&m| plan.focuses(partition, m)).collect();
            let path = folder.join(format!("{}.ply", partition.id));
            fs::write(&path, ply(&focus, 9)).unwrap();
            result(partition.id, path)
        })
        .collect()
}

/// The rows of a file, in order.
pub fn rows_of(bytes: &[u8], row_bytes: usize) -> Vec<Vec<u8>> {
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    bytes[start..].chunks(row_bytes).map(<[u8]>::to_vec).collect()
}

/// The rows of a file as a set.
pub fn sorted_rows(bytes: &[u8], row_bytes: usize) -> Vec<Vec<u8>> {
    let mut rows = rows_of(bytes, row_bytes);
    rows.sort_unstable();
    rows
}

/// A plan of arbitrary rectangles: each cut splits one of the cells so far, across x or z, at a share of its
/// part within 6 units of the origin. Training reaches 2 units beyond each border.
pub fn cut_plan(cuts: &[(usize, bool, f64)]) -> Plan {
    let mut plan = grid_plan(1, 1);
    let mut cells = vec![plan.partitions[0].cell];
    for &(which, across_x, share) in cuts {
        let which = which % cells.len();
        let (mut lower, mut upper) = (cells[which], cells[which]);
        let whole = if across_x { lower.x } else { lower.z };
        let (from, to) = (whole.lo.unwrap_or(-6.0), whole.hi.unwrap_or(6.0));
        let at = Some(from + share * (to - from));
        if across_x {
            (lower.x.hi, upper.x.lo) = (at, at);
        } else {
            (lower.z.hi, upper.z.lo) = (at, at);
        }
        cells[which] = lower;
        cells.push(upper);
    }
    let beyond =
        |Interval { lo, hi }: Interval| Interval { lo: lo.map(|v| v - 2.0), hi: hi.map(|v| v + 2.0) };
    let template = plan.partitions[0].clone();
    plan.partitions = (0..)
        .zip(cells)
        .map(|(id, cell)| Partition {
            id: PartitionId(id),
            cell,
            focus: Rect { x: beyond(cell.x), z: beyond(cell.z) },
            ..template.clone()
        })
        .collect();
    plan
}

/// Gaussians of SH 0 as rows of the layout that the trainer writes.
pub struct Model {
    /// The rows.
    pub rows: Vec<Vec<u8>>,
}

impl Model {
    /// 17 numbers: x y z, a normal, colour, opacity, scales, rotation.
    pub const ROW_BYTES: usize = 17 * 4;

    /// All over the plane, and beyond it.
    pub fn random(seed: u32, count: u32) -> Self {
        let at = |i: u32, k: u32| (uniform_at(seed, Stream::Test, i, k) - 0.5) * 24.0;
        let of = |i: u32| row(seed, i, std::array::from_fn(|k| at(i, k as u32)), 0.1);
        Self { rows: (0..count).map(of).collect() }
    }

    /// Near the corners and borders of a plan, in a thin layer where most agree with a neighbour.
    pub fn crowded(seed: u32, count: u32, plan: &Plan) -> Self {
        let to_scene = plan.alignment.rotation().inverse();
        let of = |i: u32| {
            let u = |k: u32| f64::from(uniform_at(seed, Stream::Test, i, 100 + k));
            let cell = &plan.partitions[(u(0) * plan.partitions.len() as f64) as usize].cell;
            let near = |Interval { lo, hi }: Interval, pick: f64, off: f64| {
                let border = if pick < 0.5 { lo.or(hi) } else { hi.or(lo) }.unwrap_or(0.0);
                border + (off - 0.5) * 0.8
            };
            let at = DVec3::new(near(cell.x, u(1), u(2)), 0.2 * u(5), near(cell.z, u(3), u(4)));
            row(seed, i, (to_scene * at).as_vec3().to_array(), 0.25)
        };
        Self { rows: (0..count).map(of).collect() }
    }

    /// As a file.
    pub fn ply(&self) -> Vec<u8> {
        let names =
            "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", self.rows.len());
        names.split(' ').for_each(|name| bytes.push_str(&format!("property float {name}\n")));
        bytes.push_str("end_header\n");
        [bytes.as_bytes(), &self.rows.concat()].concat()
    }

    /// Centre of a row.
    pub fn mean(row: &[u8]) -> [f32; 3] {
        std::array::from_fn(|k| f32::from_le_bytes(row[4 * k..4 * k + 4].try_into().unwrap()))
    }
}

/// A Gaussian of about this standard deviation with other values random; opacities repeat, so that hashes
/// break ties.
fn row(seed: u32, i: u32, mean: [f32; 3], deviation: f32) -> Vec<u8> {
    let u = |k: u32| uniform_at(seed, Stream::Test, i, 50 + k);
    let scale = |k: u32| (deviation * (1.0 + 0.3 * u(k))).ln();
    let opacity = (u(6) * 8.0).floor() - 3.0;
    let numbers = mean.into_iter().chain([0.0; 3]).chain([0, 1, 2].map(|k| 0.2 * u(k))).chain([
        opacity,
        scale(3),
        scale(4),
        scale(5),
        u(7) - 0.5,
        u(8) - 0.5,
        u(9) - 0.5,
        u(10) - 0.5,
    ]);
    numbers.flat_map(f32::to_le_bytes).collect()
}

/// Writes the result of each partition for rows of [`Model`]: everything in its focus.
pub fn write_row_results(plan: &Plan, rows: &[Vec<u8>], folder: &Path) -> Vec<PartitionResult> {
    let of = |partition: &Partition| {
        let focus = rows.iter().filter(|row| plan.focuses(partition, Model::mean(row)));
        let model = Model { rows: focus.cloned().collect() };
        let path = folder.join(format!("{}.ply", partition.id));
        fs::write(&path, model.ply()).unwrap();
        result(partition.id, path)
    };
    plan.partitions.iter().map(of).collect()
}
