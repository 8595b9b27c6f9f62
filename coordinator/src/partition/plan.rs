//! The plan as a value: what `plan.json` holds, and the two questions that everybody asks of it.
//!
//! A worker asks [`Plan::focuses`] (is this Gaussian trained here?), the merge asks [`Plan::keeps`]
//! (is this Gaussian this partition's to give?). Both go through [`Alignment::to_aligned`], so that they
//! agree to the last bit. Whatever a partition keeps, it also has in focus: extended boxes are open
//! where cells are, or the far background of the scene would belong to nobody.

use std::fmt;

use fathom_core::memory::MemoryForecast;
use fathom_core::scene::learning_scale;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Version of the layout that this program writes and reads.
pub const PLAN_FORMAT: u32 = 2;

/// How a scene is cut, who trains what on which photographs, and what it will take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Version of this layout: [`PLAN_FORMAT`].
    pub format: u32,
    /// Columns along aligned x.
    pub columns: u32,
    /// Partitions along aligned z in each column.
    pub rows: u32,
    /// The frame in which the scene is cut.
    pub alignment: Alignment,
    /// Size of the whole scene.
    pub extent: Extent,
    /// Number of views of the scene; every index below is one into its views, sorted by name.
    pub views: u32,
    /// Held-out views, ascending: index % `data.test_every` == 0. They are in no partition.
    pub held_out: Vec<u32>,
    /// Number of sparse points with finite coordinates.
    pub points: u64,
    /// The coarse model of the whole scene; `None` for 1x1.
    pub global: Option<GlobalStage>,
    /// All partitions, column by column, each from low to high z; entry `k` has id `k`.
    pub partitions: Vec<Partition>,
}

/// Number of a partition: `column * rows + row`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PartitionId(pub u32);

impl fmt::Display for PartitionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// The aligned frame: y down, x and z horizontal, the world's origin and unit of length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Alignment {
    /// How down was found.
    pub rule: UpRule,
    /// Down in world axes, unit length.
    pub down: [f64; 3],
    /// Length of the mean of the cameras' down vectors, 0 to 1; above 0.5 it decides.
    pub mean_down_length: f64,
    /// The smallest rotation that takes `down` to +y; order w x y z.
    pub world_to_aligned_quat_wxyz: [f64; 4],
}

/// Which rule found the vertical.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpRule {
    /// The mean camera-down vector is longer than 0.5: it is down.
    MeanCameraDown,
    /// The normal of the plane of camera centres, its sign from the mean viewing direction.
    CentrePlane,
    /// The centres lie on a line or in a point: the mean viewing direction, perpendicular to that line.
    ViewingDirection,
    /// Nothing points anywhere: the world's y axis is taken for down.
    WorldY,
}

/// Size of the scene, scene units; boxes are in the aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extent {
    /// 1.1 x the largest distance of a training camera's centre from their mean (3DGS).
    pub radius: f64,
    /// Median depth of the sparse points in the training views; `None` without points.
    pub viewing_distance: Option<f64>,
    /// Box of the training cameras' centres.
    pub cameras: Box3,
    /// Box between the 2nd and 98th percentile of the points on each axis; `None` without points.
    pub points: Option<Box3>,
}

impl Extent {
    /// What the learning rate of the means is in proportion to: [`fathom_core::scene::learning_scale`].
    pub fn learning_scale(&self) -> f64 {
        learning_scale(self.radius, self.viewing_distance)
    }
}

/// A finite box, aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Box3 {
    /// Smallest x, y, z.
    pub min: [f64; 3],
    /// Largest x, y, z.
    pub max: [f64; 3],
}

impl Box3 {
    /// Whether `point` lies inside or on the border.
    pub fn contains(&self, point: DVec3) -> bool {
        (0..3).all(|axis| point[axis] >= self.min[axis] && point[axis] <= self.max[axis])
    }

    /// Length along one axis.
    pub fn side(&self, axis: usize) -> f64 {
        self.max[axis] - self.min[axis]
    }
}

/// The half-open interval (lo, hi]; `None` is open to infinity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interval {
    /// Lower bound, not in the interval.
    pub lo: Option<f64>,
    /// Upper bound, in the interval.
    pub hi: Option<f64>,
}

impl Interval {
    /// The whole axis.
    pub const ALL: Self = Self { lo: None, hi: None };

    /// Whether a finite `value` lies in the interval.
    pub fn contains(&self, value: f64) -> bool {
        value.is_finite() && self.lo.is_none_or(|lo| value > lo) && self.hi.is_none_or(|hi| value <= hi)
    }
}

/// A rectangle on the aligned x-z plane, endless in y.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rect {
    /// Along x.
    pub x: Interval,
    /// Along z.
    pub z: Interval,
}

impl Rect {
    /// Whether an aligned point with finite coordinates lies in it.
    pub fn contains(&self, aligned: DVec3) -> bool {
        aligned.y.is_finite() && self.x.contains(aligned.x) && self.z.contains(aligned.z)
    }
}

/// Where a partition lies in the grid; decides its extension, its threshold and its gamma in eq. 5.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// Open on a side of x and a side of z.
    Corner,
    /// Open on one axis only.
    Edge,
    /// Neighbours on all four sides.
    Inner,
}

/// The unit of training: cameras, extended box and budget, and the cell that it keeps at the merge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Partition {
    /// Its place in [`Plan::partitions`].
    pub id: PartitionId,
    /// Column along x, from 0.
    pub column: u32,
    /// Row along z, from 0.
    pub row: u32,
    /// Place in the grid.
    pub layer: Layer,
    /// The rectangle whose Gaussians it keeps; cells tile the plane.
    pub cell: Rect,
    /// The rectangle whose Gaussians it trains: the extended box, open where the cell is.
    pub focus: Rect,
    /// The extended box with its open sides closed by the partition's own cameras and points, and the
    /// 2nd to 98th percentile of the y of its points; what cameras must see.
    pub extended_box: Box3,
    /// Training views that are its own by rank, ascending.
    pub base_views: Vec<u32>,
    /// Training views that it trains on, ascending; contains `base_views`.
    pub chosen_views: Vec<u32>,
    /// Of the chosen ones, those with too small a view of the box, taken to reach the minimum number.
    pub filled_views: u32,
    /// Mean share of the image that the extended box covers, over the chosen views (r of eq. 5).
    pub mean_visibility: f64,
    /// Sparse points in `focus`.
    pub focus_points: u64,
    /// Sparse points in `cell`.
    pub cell_points: u64,
    /// `focus_points` / all points: the focusing ratio of SMP-UWGS section 3.1; 0 without points.
    pub r_focus: f64,
    /// Mean over its base views of the median depth of its points (eq. 6), scene units; 0 without points.
    pub depth: f64,
    /// Depth-aware weight (eq. 5), clamped to 0..1; reported, nothing is scaled by it.
    pub weight: f64,
    /// Iterations of its run.
    pub iterations: u32,
    /// Cap on the Gaussians in focus.
    pub max_gaussians: u32,
    /// GPU memory that its run will need.
    pub forecast: Forecast,
}

/// The coarse model of the whole scene, trained on all training views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GlobalStage {
    /// Iterations of its run.
    pub iterations: u32,
    /// Cap on its Gaussians.
    pub max_gaussians: u32,
    /// Longest side of its pictures: half of the longest one that partitions train on, pixels.
    pub max_resolution: u32,
    /// GPU memory that its run will need.
    pub forecast: Forecast,
}

/// GPU memory of a run at its largest, by the formula that stands beside it ([`fathom_core::memory`] says what is
/// measured and what is estimated).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Forecast {
    /// The sum, bytes.
    pub bytes: u64,
    /// What it is made of.
    pub parts: MemoryForecast,
    /// How it comes about, with its numbers.
    pub formula: String,
}

impl Plan {
    /// Training views, ascending: all that are not held out.
    pub fn training_views(&self) -> Vec<u32> {
        (0..self.views).filter(|view| self.held_out.binary_search(view).is_err()).collect()
    }

    /// Whether `partition` trains a Gaussian with this mean (world axes).
    pub fn focuses(&self, partition: &Partition, mean: [f32; 3]) -> bool {
        partition.focus.contains(self.alignment.to_aligned(mean))
    }

    /// Whether a Gaussian with this mean (world axes) is `partition`'s at the merge. A mean that is not
    /// finite is nobody's.
    pub fn keeps(&self, partition: &Partition, mean: [f32; 3]) -> bool {
        partition.cell.contains(self.alignment.to_aligned(mean))
    }
}

impl Alignment {
    /// The rotation from world to aligned axes.
    pub fn rotation(&self) -> DQuat {
        let [w, x, y, z] = self.world_to_aligned_quat_wxyz;
        DQuat::from_xyzw(x, y, z, w)
    }

    /// A world point in the aligned frame.
    pub fn to_aligned(&self, world: [f32; 3]) -> DVec3 {
        self.rotation() * DVec3::from(world.map(f64::from))
    }
}
