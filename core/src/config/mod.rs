//! The configuration of a job: one struct per area, and a source for every default.
//!
//! CLI flags, the file and the code share these defaults. Unknown keys are refused; [`JobConfig::validate`]
//! reports all contradictions together. Each run stores its resolved configuration. Every schedule is a share
//! of the run, so a partition's short run behaves like a long one.

mod borders;
mod composition;
mod cut;
mod dbdr;
mod film;
mod merge;
mod method;
mod network;
mod numbers;
mod partitions;
mod priors;
mod seams;
mod surface;
mod train;
mod water;
mod weights;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

pub use borders::BordersConfig;
pub use composition::Composition;
pub use cut::DEFAULT_MEMORY_GIB;
pub use dbdr::{DbdrConfig, DbdrMode};
pub use film::FilmConfig;
pub use merge::MergeConfig;
pub use method::Method;
pub use network::{NetworkConfig, NetworkStart};
pub use partitions::WaterPartitions;
pub use priors::{DarkChannelOn, PriorsConfig};
pub use seams::SeamsConfig;
pub use surface::{Reflectance, SurfaceConfig, SurfaceJoin, SurfaceLight, SurfaceRefine, SurfaceStart};
pub use train::{ClassicConfig, Moments, Strategy, TrainConfig};
pub use water::{Blend, LossLight, Medium, WaterConfig, WaterPrior};
pub use weights::{WeightMode, WeightTerms};

use crate::{CoreError, Result};

/// Starting values for appearance, medium and loss.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Preset {
    /// The defaults of Fathom: the water acts on pixels blended in sRGB, and is estimated from the sparse
    /// points.
    #[default]
    #[serde(rename = "fathom")]
    Fathom,
    /// Image formation and losses of SMP-UWGS as printed: blended in linear light, with its network.
    #[serde(rename = "paper")]
    Paper,
    /// Plain 3D Gaussian splatting without a medium, in sRGB: the control.
    #[serde(rename = "3dgs")]
    Splatting,
    /// 2D Gaussian splatting (disks) without a medium, in sRGB.
    #[serde(rename = "2dgs")]
    Disks,
    /// A scene seen through a calm water surface: disks in air and below it (WSGS).
    #[serde(rename = "wsgs")]
    Surface,
}

/// Everything except the input that determines the result of a job.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, remote = "Self")]
pub struct JobConfig {
    /// Starting point of all other values.
    pub preset: Preset,
    /// Method that trains the scene: `splats` (3D Gaussians), `2dgs` (2D Gaussians: disks on surfaces) or
    /// `wsgs` (disks seen through a water surface). Default `splats`.
    pub method: Method,
    /// Photographs: sizes, held-out views, masks.
    pub data: DataConfig,
    /// Cells, boxes and visibility.
    pub partition: PartitionConfig,
    /// Optimisation.
    pub train: TrainConfig,
    /// The medium between camera and scene.
    pub water: WaterConfig,
    /// The water surface that cameras in air look through; for method `wsgs`.
    pub surface: SurfaceConfig,
    /// Merging the partitions into one model.
    pub merge: MergeConfig,
    /// Border refinement after the merge.
    pub borders: BordersConfig,
    /// Metrics at the borders of cells.
    pub seams: SeamsConfig,
}

impl Serialize for JobConfig {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        Self::serialize(self, serializer)
    }
}

impl<'de> Deserialize<'de> for JobConfig {
    // However a configuration is read, its method says what its Gaussians are.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        Self::deserialize(deserializer).map(Self::with_shape)
    }
}

impl JobConfig {
    /// The values of a preset.
    pub fn of_preset(preset: Preset) -> Self {
        let water = match preset {
            Preset::Fathom => WaterConfig::default(),
            Preset::Paper => WaterConfig::paper(),
            Preset::Splatting | Preset::Disks | Preset::Surface => WaterConfig::none(),
        };
        let method = match preset {
            Preset::Disks => Method::Disks,
            Preset::Surface => Method::Surface,
            _ => Method::default(),
        };
        let mut partition = PartitionConfig::default();
        if preset == Preset::Surface {
            // Partitions keep the reflected set of the coarse model, and what it lacks ends in the refracted
            // set. A pool of 4 m in 2x2 had 25.7 dB without its water instead of 22.3.
            partition.global_iterations = 1.0;
        }
        Self { preset, method, water, partition, ..Self::default() }.with_shape()
    }

    /// Sets what the method says about its Gaussians.
    fn with_shape(mut self) -> Self {
        self.train.disks = self.method != Method::Splats;
        self.train.sets = (self.method == Method::Surface).then_some(self.surface.shares);
        self
    }

    /// A configuration from JSON. Missing values are those of its preset.
    ///
    /// # Errors
    /// If it is not a JSON object, or has an unknown key or value.
    pub fn from_json(json: &str) -> std::result::Result<Self, serde_json::Error> {
        Self::over_its_preset(serde_json::from_str(json)?)
    }

    /// The same from parsed values, of any format.
    ///
    /// # Errors
    /// As [`JobConfig::from_json`].
    pub fn over_its_preset(given: serde_json::Value) -> std::result::Result<Self, serde_json::Error> {
        #[derive(Deserialize)]
        struct Named {
            #[serde(default)]
            preset: Preset,
        }
        numbers::refuse_huge(&given, "").map_err(serde::de::Error::custom)?;
        let mut merged = serde_json::to_value(Self::of_preset(Named::deserialize(&given)?.preset))?;
        overlay(&mut merged, given);
        serde_json::from_value(merged)
    }
}

/// Replaces values of `base` by those of `over`, section by section.
fn overlay(base: &mut serde_json::Value, over: serde_json::Value) {
    match (base, over) {
        (serde_json::Value::Object(base), serde_json::Value::Object(over)) => {
            for (key, value) in over {
                overlay(base.entry(key).or_insert(serde_json::Value::Null), value);
            }
        }
        (base, over) => *base = over,
    }
}

/// How photographs become training views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataConfig {
    /// Longest side of a training picture, pixels. Default 1600, as in 3DGS. Larger ones are reduced in
    /// linear light.
    pub max_resolution: u32,
    /// Interval of held-out views by sorted name (index % n == 0). Default 8, as in 3DGS; 0 holds none out.
    pub test_every: u32,
    /// Mask value of the pixels that are kept. Default white, as in COLMAP and nerfstudio.
    pub mask_keep: MaskKeep,
    /// Metres in a scene unit, for coefficients in 1/m. Default 0. 0 means that it is not known.
    pub metres_per_unit: f64,
}

/// The mask value of the pixels that are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskKeep {
    /// White is kept; black is ignored.
    #[default]
    White,
    /// Black is kept; white is ignored.
    Black,
}

impl Default for DataConfig {
    fn default() -> Self {
        Self { max_resolution: 1600, test_every: 8, mask_keep: MaskKeep::White, metres_per_unit: 0.0 }
    }
}

/// The partitioning of the scene on its x-z plane (SMP-UWGS section 3.1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PartitionConfig {
    /// Whether the plan chooses the partitioning. Default false. It picks a grid or a recursive partitioning
    /// that fits `memory_gib` and keeps `workers` busy. `columns` and `rows` must be 1.
    pub auto: bool,
    /// Columns along x (m of eq. 1). Default 1.
    pub columns: u32,
    /// Partitions along z in each column (n of eq. 1). Default 1.
    pub rows: u32,
    /// GPU memory that `auto` plans for on every worker, GiB. Default 0. 0 takes the smallest that a
    /// connected worker reports, or 8 if none does.
    pub memory_gib: f64,
    /// Workers that `auto` plans for. Default 0. 0 takes the number of connected workers, at least 1.
    pub workers: u32,
    /// Whether the horizontal axes are rotated for compact cells where that pays off. Default true.
    pub rotate: bool,
    /// Base extension of a cell on each side, as a share of its side length. Default 0.2 (VastGaussian,
    /// SMP-UWGS's depth class).
    pub extend_base: f64,
    /// Factor on `extend_base` for edge and corner partitions. Default 2.0 (SMP-UWGS eq. 2).
    pub extend_edge: f64,
    /// Factor on `extend_base` for inner partitions. Default 1.5 (SMP-UWGS eq. 2).
    pub extend_inner: f64,
    /// Share of the image that the extended box must cover for a camera to be selected. Default 0.25
    /// (VastGaussian; eq. 3).
    pub visibility: f64,
    /// Factor on `visibility` for edge partitions. Default 0.3 (SMP-UWGS eq. 3).
    pub visibility_edge_factor: f64,
    /// Iterations of the global stage as a share of the job's. Through a water surface, partitions keep the
    /// reflected set of the coarse model. Default 0.25 (docs/decisions/0028).
    pub global_iterations: f64,
    /// Minimum iterations of the global stage, never more than those of the job. Default 1000 (ours). On fox
    /// in 2x2, 1000 iterations lose 0.52 dB; a coarse model of 1000 iterations instead of 250 regains 0.41 dB
    /// (bench/history.jsonl).
    pub global_least_iterations: u32,
    /// Maximum iterations of the global stage, unless `global_least_iterations` is more. Default 30000
    /// (ours). One worker trains it while all others wait, so it must not grow with the scene.
    pub global_most_iterations: u32,
    /// Cap of the global stage as a share of the job's. Default 0.25 (ours).
    pub global_gaussians: f64,
    /// Maximum Gaussians of the global stage. Default 4000000 (ours). They take about 4 GB of GPU memory.
    pub global_most_gaussians: u32,
    /// Share of a partition's iterations after which it continues beside the Gaussians that its neighbours
    /// have trained so far. Default 1 (bench/history.jsonl: 0.5 to 0.85 changed less than seeds do). Until
    /// then, it trains beside the coarse model around its cell. Must be above 0; 1 disables the exchange.
    pub neighbours_from: f64,
    /// Iterations of every partition. Default 0. 0 gives each partition a share by its cameras.
    pub iterations_per_partition: u32,
    /// Held-out views that one task evaluates, if there are several partitions. Default 64. Each task fetches
    /// the merged model, and there are at most as many tasks as partitions.
    pub evaluation_views: u32,
    /// Target of the depth-aware weight of a partition: `none`, `loss_factor` or `joint`. Default none
    /// (docs/decisions/0014).
    pub weights: WeightMode,
    /// Terms of these weights.
    pub weight_terms: WeightTerms,
}

impl Default for PartitionConfig {
    fn default() -> Self {
        Self {
            auto: false,
            columns: 1,
            rows: 1,
            memory_gib: 0.0,
            workers: 0,
            rotate: true,
            extend_base: 0.2,
            extend_edge: 2.0,
            extend_inner: 1.5,
            visibility: 0.25,
            visibility_edge_factor: 0.3,
            global_iterations: 0.25,
            global_least_iterations: 1000,
            global_most_iterations: 30_000,
            global_gaussians: 0.25,
            global_most_gaussians: 4_000_000,
            neighbours_from: 1.0,
            iterations_per_partition: 0,
            evaluation_views: 64,
            weights: WeightMode::None,
            weight_terms: WeightTerms::default(),
        }
    }
}

impl JobConfig {
    /// Checks every value and reports all faults together.
    ///
    /// # Errors
    /// [`CoreError::Config`] with one clause per fault.
    pub fn validate(&self) -> Result<()> {
        let mut faults = Vec::new();
        let mut require = |holds: bool, fault: &str| {
            if !holds {
                faults.push(fault.to_owned());
            }
        };
        let (p, t, d) = (&self.partition, &self.train, &self.data);
        require(d.max_resolution >= 16, "data.max_resolution must be at least 16 pixels");
        require(
            d.test_every != 1,
            "data.test_every = 1 would hold out every view; use 0 (none), or 2 or more",
        );
        require(p.columns >= 1 && p.rows >= 1, "partition.columns and partition.rows must be at least 1");
        require(
            p.columns.saturating_mul(p.rows) <= 4096,
            "partition.columns * partition.rows must be at most 4096",
        );
        require(
            !t.disks || !t.mip_filter,
            "methods 2dgs and wsgs have a low-pass of their own; train.mip_filter must be false",
        );
        require(
            self.method != Method::Disks || self.water.medium != Medium::PerGaussian,
            "method = \"2dgs\" blends disks before the water acts; water.medium must be \"none\" or \"per_pixel\"",
        );
        require(
            (0.0..=10.0).contains(&t.normal_consistency) && (0.0..=1.0).contains(&t.normal_consistency_from),
            "train.normal_consistency must be from 0 to 10, and normal_consistency_from a share of the run",
        );
        if self.method == Method::Surface {
            require(
                self.surface.join == SurfaceJoin::Over || (p.columns == 1 && p.rows == 1 && !p.auto),
                "surface.join = \"masked\" trains one partition; partition.columns and rows must be 1, and auto \
                 false",
            );
            require(
                p.neighbours_from >= 1.0,
                "method = \"wsgs\" does not exchange neighbours; partition.neighbours_from must be 1",
            );
            require(
                self.water.medium == Medium::None,
                "method = \"wsgs\" looks through the surface of clear water; water.medium must be \"none\"",
            );
            require(
                t.strategy == Strategy::Mcmc,
                "method = \"wsgs\" needs train.strategy = \"mcmc\": the caps of its sets are fixed",
            );
            self.surface.validate(&mut require);
        }
        p.validate_cut(&mut require);
        require((0.0..=10.0).contains(&p.extend_base), "partition.extend_base must be between 0 and 10");
        require(
            p.extend_edge >= 0.0 && p.extend_inner >= 0.0,
            "partition.extend_edge and extend_inner must not be negative",
        );
        require((0.0..=1.0).contains(&p.visibility), "partition.visibility must be between 0 and 1");
        require(
            (0.0..=1.0).contains(&p.visibility_edge_factor),
            "partition.visibility_edge_factor must be between 0 and 1",
        );
        p.weight_terms.validate(&mut require);
        require(
            p.global_iterations > 0.0 && p.global_iterations <= 1.0,
            "partition.global_iterations must be above 0 and at most 1",
        );
        require(
            p.global_gaussians > 0.0 && p.global_gaussians <= 1.0,
            "partition.global_gaussians must be above 0 and at most 1",
        );
        require(
            p.global_most_iterations >= 1 && p.global_most_gaussians >= 16,
            "partition.global_most_iterations must be at least 1, and global_most_gaussians at least 16",
        );
        require(p.evaluation_views >= 1, "partition.evaluation_views must be at least 1");
        require(
            p.neighbours_from > 0.0 && p.neighbours_from <= 1.0,
            "partition.neighbours_from must be a share of a partition's run, above 0 and at most 1 (1 disables it)",
        );
        require(t.iterations >= 1, "train.iterations must be at least 1");
        require(t.max_gaussians >= 16, "train.max_gaussians must be at least 16");
        require(t.sh_degree <= 3, "train.sh_degree must be 0 to 3");
        require((0.0..=1.0).contains(&t.ssim_weight), "train.ssim_weight must be between 0 and 1");
        for (name, rate) in [
            ("means_lr", t.means_lr),
            ("means_lr_end", t.means_lr_end),
            ("sh_dc_lr", t.sh_dc_lr),
            ("sh_rest_lr", t.sh_rest_lr),
            ("opacity_lr", t.opacity_lr),
            ("scales_lr", t.scales_lr),
            ("quats_lr", t.quats_lr),
            ("opacity_reg", t.opacity_reg),
            ("scale_reg", t.scale_reg),
            ("mean_noise", t.mean_noise),
            ("exposure_lr", t.exposure_lr),
            ("exposure_lr_end", t.exposure_lr_end),
            ("classic.gradient", t.classic.gradient),
            ("classic.clone_scale", t.classic.clone_scale),
            ("classic.prune_scale", t.classic.prune_scale),
        ] {
            require(
                rate >= 0.0 && rate.is_finite(),
                &format!("train.{name} must be a finite number, 0 or more"),
            );
        }
        require(t.anneal_to > 0.0 && t.anneal_to <= 1.0, "train.anneal_to must be above 0 and at most 1");
        for (name, share) in [
            ("grow_until", t.grow_until),
            ("relocate_until", t.relocate_until),
            ("anneal_from", t.anneal_from),
            ("classic.reset_every", t.classic.reset_every),
            ("classic.from", t.classic.from),
            ("classic.until", t.classic.until),
        ] {
            require(
                (0.0..=1.0).contains(&share),
                &format!("train.{name} must be a share of the run, from 0 to 1"),
            );
        }
        require(
            t.classic.from <= t.classic.until,
            "train.classic.from must not be after train.classic.until",
        );
        require(
            (0.0..1.0).contains(&t.classic.prune_opacity),
            "train.classic.prune_opacity must be 0 or more and below 1",
        );
        require(
            t.sh_degree_at.is_sorted() && t.resolution_at.is_sorted(),
            "train.sh_degree_at and train.resolution_at must be in ascending order",
        );
        require(t.prefetch_threads <= 64, "train.prefetch_threads must be at most 64");
        require(
            t.eval_every == 0 || d.test_every != 0,
            "train.eval_every needs held-out views, but data.test_every = 0 holds none out",
        );
        require(t.checkpoint_seconds >= 1, "train.checkpoint_seconds must be at least 1");
        require(t.preview_views <= 8, "train.preview_views must be at most 8");
        require(
            d.metres_per_unit >= 0.0 && d.metres_per_unit.is_finite(),
            "data.metres_per_unit must be a finite number above 0, or 0 if it is not known",
        );
        self.water.validate(&mut require);
        self.merge.validate(&mut require);
        self.borders.validate(t, &mut require);
        self.seams.validate(&mut require);
        require(
            self.water.medium == Medium::None || !t.random_background,
            "train.random_background needs water.medium = \"none\": under water, open water ends every ray",
        );
        require(
            !(self.water.has_film() && t.exposure),
            "train.exposure and water.film.on both learn the brightness of each view; disable one of them",
        );
        if faults.is_empty() { Ok(()) } else { Err(CoreError::Config(faults.join("; "))) }
    }
}
