//! The plan as a value: the content of `plan.json`, and two membership tests.
//!
//! [`Plan::focuses`] tests whether a partition trains a Gaussian, and [`Plan::keeps`] whether the merge takes
//! a Gaussian from it. Both go through [`Alignment::to_aligned`], so that they agree to the last bit. Every
//! Gaussian that a partition keeps is also in its focus. So extended boxes are open where cells are;
//! otherwise the far background would belong to no partition.

use std::fmt;

use fathom_core::config::WeightMode;
use fathom_core::memory::MemoryForecast;
use fathom_core::scene::learning_scale;
use serde::{Deserialize, Serialize};

use crate::geometry::{Alignment, Box3, Rect, Segment};

/// Version of the layout that this program writes and reads.
pub const PLAN_FORMAT: u32 = 4;

/// The partitions of a scene, their photographs, and the forecast of their runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Version of this layout: [`PLAN_FORMAT`].
    pub format: u32,
    /// The cut of the plane, and its reason.
    pub cut: Cut,
    /// Columns along aligned x; `None` where the cut is recursive.
    pub columns: Option<u32>,
    /// Partitions along aligned z in each column; `None` where the cut is recursive.
    pub rows: Option<u32>,
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
    /// Balance of the work.
    pub balance: Balance,
    /// The effect of the weights of the partitions.
    pub weights: WeightMode,
    /// All partitions; entry `k` has id `k`. A grid goes column by column, each from low to high z; a
    /// recursive cut goes through the low side of each cut before its high side.
    pub partitions: Vec<Partition>,
    /// The training near borders after the merge; `None` unless `borders.enabled` is set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub borders: Option<BorderStage>,
    /// For each view, the range up to which it sees only water ([`fathom_core::floaters::clear_ranges`]),
    /// scene units; 0 where unknown, and for held-out views. Empty where it is not needed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clear_ranges: Vec<f32>,
}

/// The cut of the plane, and its reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cut {
    /// The kind of cut.
    pub shape: CutShape,
    /// The reason for the choice: a sentence.
    pub reason: String,
    /// The workers that `partition.auto` chose it for; `None` for a grid that was asked for.
    pub planned_for: Option<PlannedFor>,
}

/// Kind of a cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CutShape {
    /// Columns of as many cameras, each cut into rows of as many (SMP-UWGS eq. 1).
    Grid,
    /// Cells are cut in two across their longer side, by rank of their cameras, the largest load first.
    Recursive,
}

/// The workers that `partition.auto` fits partitions to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedFor {
    /// Workers that share the work.
    pub workers: u32,
    /// GPU memory of the smallest of them, bytes.
    pub memory_bytes: u64,
    /// How that memory is known.
    pub memory_from: MemoryFrom,
}

/// How the memory of workers is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MemoryFrom {
    /// From `partition.memory_gib`.
    Configuration,
    /// The smallest that a connected worker reported.
    Workers,
    /// Unknown: [`DEFAULT_MEMORY_GIB`](fathom_core::config::DEFAULT_MEMORY_GIB).
    Default,
}

/// Balance of the work: the largest value of all partitions divided by their mean, at least 1; 1 is even.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Balance {
    /// Of the cameras that partitions train on.
    pub cameras: f64,
    /// Of the sparse points that they train.
    pub points: f64,
    /// Of the forecast of time.
    pub seconds: f64,
    /// Of the forecast of memory.
    pub bytes: f64,
}

/// Number of a partition: its place in [`Plan::partitions`]; `column * rows + row` in a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PartitionId(pub u32);

impl fmt::Display for PartitionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// Size of the scene, scene units; boxes are in the aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extent {
    /// 1.1 x the largest distance of a training camera's centre from their mean (3DGS).
    pub radius: f64,
    /// The scene scale: median depth of the sparse points in the training views; `None` without points.
    pub viewing_distance: Option<f64>,
    /// Box of the training cameras' centres.
    pub cameras: Box3,
    /// Box between the 2nd and 98th percentile of the points on each axis; `None` without points.
    pub points: Option<Box3>,
}

impl Extent {
    /// The learning rate of the means is proportional to this: [`fathom_core::scene::learning_scale`].
    pub fn learning_scale(&self) -> f64 {
        learning_scale(self.radius, self.viewing_distance)
    }
}

/// Position of a partition on the plane; determines its extension, its threshold and its gamma in eq. 5.
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
    /// Column along x, from 0; `None` where the cut is recursive.
    pub column: Option<u32>,
    /// Row along z, from 0; `None` where the cut is recursive.
    pub row: Option<u32>,
    /// Cuts from the whole plane to its cell, first to last. `x-` is the low side of a cut across x, `z+` the
    /// high side of one across z. Empty in a grid.
    pub path: String,
    /// Its open sides.
    pub layer: Layer,
    /// The rectangle whose Gaussians it keeps; cells tile the plane.
    pub cell: Rect,
    /// The rectangle whose Gaussians it trains: the extended box, open where the cell is.
    pub focus: Rect,
    /// The box that cameras must see: the extended box with its open sides closed by the partition's own
    /// cameras and points. Its height is the 2nd to 98th percentile of the y of its points.
    pub extended_box: Box3,
    /// Training views that are its own by rank, ascending.
    pub base_views: Vec<u32>,
    /// Training views that it trains on, ascending; all of `base_views` and those that see enough of
    /// `extended_box`.
    pub chosen_views: Vec<u32>,
    /// Number of selected views below the threshold, added to reach the minimum.
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
    /// Depth-aware weight (eq. 5), clamped to 0..`partition.weight_terms.clamp`.
    pub weight: f64,
    /// Its effects in this job.
    pub weighed: Weighed,
    /// Iterations of its run.
    pub iterations: u32,
    /// Cap on the Gaussians in focus.
    pub max_gaussians: u32,
    /// Forecast of its run.
    pub forecast: Forecast,
}

/// The effects of the weight of a partition, by the mode of [`Plan::weights`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Weighed {
    /// Factor on the whole loss of its run; 1 without effect.
    pub loss_factor: f64,
    /// Sampling weight of its own views in the global stage, relative to the mean over all views; 1 where all
    /// are equal.
    pub sampling: f64,
}

impl Default for Weighed {
    /// No effect.
    fn default() -> Self {
        Self { loss_factor: 1.0, sampling: 1.0 }
    }
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
    /// Forecast of its run.
    pub forecast: Forecast,
}

/// The task that trains the part of the merged model near borders, on the views that show it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BorderStage {
    /// The borders between cells.
    pub segments: Vec<Segment>,
    /// Half-width of the trained band, scene units.
    pub width: f64,
    /// Margin beyond the band in which surfaces count in the loss, scene units.
    pub margin: f64,
    /// Training views in whose images some sparse point of the band lies, ascending; all where it has none.
    /// The worker skips those that do not show it.
    pub views: Vec<u32>,
    /// Iterations of its run.
    pub iterations: u32,
    /// Forecast of its run.
    pub forecast: Forecast,
}

impl BorderStage {
    /// Boxes whose union is trained.
    pub fn band(&self) -> Vec<Rect> {
        self.boxes(self.width)
    }

    /// Boxes whose union contains the surfaces that count.
    pub fn surroundings(&self) -> Vec<Rect> {
        self.boxes(self.width + self.margin)
    }

    fn boxes(&self, reach: f64) -> Vec<Rect> {
        self.segments.iter().map(|segment| segment.band(reach)).collect()
    }
}

/// Peak GPU memory of a run with its formula, and its duration. [`fathom_core::memory`] documents which terms
/// are measured and which estimated.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Forecast {
    /// CPU seconds of the whole run on the adapter of [`fathom_core::duration`]; use them only to compare
    /// runs.
    pub seconds: f64,
    /// GPU memory, the sum, bytes.
    pub bytes: u64,
    /// Its terms.
    pub parts: MemoryForecast,
    /// Its formula, with numbers.
    pub formula: String,
}

impl Balance {
    /// The balance of these partitions; 1 where the total is 0.
    pub fn of(partitions: &[Partition]) -> Self {
        let of = |value: fn(&Partition) -> f64| {
            let largest = partitions.iter().map(value).fold(0.0, f64::max);
            let mean = partitions.iter().map(value).sum::<f64>() / partitions.len().max(1) as f64;
            if mean > 0.0 { largest / mean } else { 1.0 }
        };
        Self {
            cameras: of(|p| p.chosen_views.len() as f64),
            points: of(|p| p.focus_points as f64),
            seconds: of(|p| p.forecast.seconds),
            bytes: of(|p| p.forecast.bytes as f64),
        }
    }
}

impl Plan {
    /// Reads `plan.json`.
    ///
    /// # Errors
    /// A sentence if it has another version or is not a plan.
    pub fn from_json(json: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Versioned {
            format: u32,
        }
        let fault = |error: serde_json::Error| format!("the plan cannot be read: {error}");
        let Versioned { format } = serde_json::from_slice(json).map_err(fault)?;
        if format != PLAN_FORMAT {
            return Err(format!(
                "the plan has format {format}, but this version reads {PLAN_FORMAT}; finish the job with the version that \
                 planned it, or submit it again"
            ));
        }
        serde_json::from_slice(json).map_err(fault)
    }

    /// Training views, ascending: all that are not held out.
    pub fn training_views(&self) -> Vec<u32> {
        (0..self.views).filter(|view| self.held_out.binary_search(view).is_err()).collect()
    }

    /// Sampling weight of each training view in the global stage, in the order of [`Plan::training_views`]:
    /// that of its own partition. Empty where all are equal.
    pub fn view_weights(&self) -> Vec<f32> {
        if self.partitions.iter().all(|partition| partition.weighed.sampling == 1.0) {
            return Vec::new();
        }
        let own = |view: &u32| self.partitions.iter().find(|p| p.base_views.binary_search(view).is_ok());
        let weight = |view: u32| own(&view).map_or(1.0, |home| home.weighed.sampling as f32);
        self.training_views().into_iter().map(weight).collect()
    }

    /// Whether `partition` trains a Gaussian with this mean (world axes).
    pub fn focuses(&self, partition: &Partition, mean: [f32; 3]) -> bool {
        partition.focus.contains(self.alignment.to_aligned(mean))
    }

    /// Whether `partition` keeps a Gaussian with this mean (world axes) at the merge. No partition keeps a
    /// mean that is not finite.
    pub fn keeps(&self, partition: &Partition, mean: [f32; 3]) -> bool {
        partition.cell.contains(self.alignment.to_aligned(mean))
    }

    /// The partitions whose cells reach into what `partition` trains, by ascending index.
    pub fn neighbours_of<'a>(&'a self, partition: &'a Partition) -> impl Iterator<Item = &'a Partition> {
        let reaches = |other: &&Partition| other.id != partition.id && other.cell.meets(&partition.focus);
        self.partitions.iter().filter(reaches)
    }
}
