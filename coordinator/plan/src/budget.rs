//! The budget of a run: iterations, Gaussians and the forecast of GPU memory.
//!
//! `train.iterations` and `train.max_gaussians` are totals of the job as if it were 1x1. A partition gets
//! iterations by its cameras, so that each photograph is seen as often as in one run. It gets Gaussians by
//! its points, so that its density is that of one run. The margins beside its cell come on top, and are
//! cropped at the merge.

use fathom_core::appearance::Settings;
use fathom_core::config::{JobConfig, TrainConfig, WaterConfig};
use fathom_core::duration;
use fathom_core::memory::{
    COMMON_BINDING_BYTES, FLAG_BYTES, RunSize, SMALLEST_TILE, frozen_bytes, intersection_bytes, pixel_bytes,
    visible_bytes, visible_in_views,
};
use fathom_core::scene::{PinholeCamera, Pose};
use glam::DVec3;

use crate::plan::{Forecast, GlobalStage};

/// Fewest Gaussians that a run may have.
const MIN_GAUSSIANS: f64 = 16.0;
/// Fewest iterations.
const MIN_ITERATIONS: f64 = 1.0;

/// Iterations of a partition with `chosen` of `training` cameras.
pub fn iterations(config: &JobConfig, chosen: usize, training: usize) -> u32 {
    match config.partition.iterations_per_partition {
        0 => share_of(config.train.iterations, chosen as f64 / training.max(1) as f64, MIN_ITERATIONS),
        fixed => fixed,
    }
}

/// Cap of a run that trains `share` of the scene.
pub fn max_gaussians(config: &JobConfig, share: f64) -> u32 {
    share_of(config.train.max_gaussians, share, MIN_GAUSSIANS)
}

/// The content and views of a run.
pub struct Content<'a> {
    /// Training views, at the size of their pictures.
    pub views: &'a [(PinholeCamera, Pose)],
    /// Points where it trains Gaussians, and their number at the cap.
    pub trained: (&'a [DVec3], u64),
    /// Points where it has Gaussians that do not change, and their number.
    pub frozen: (&'a [DVec3], u64),
}

/// The run of the coarse model on these views, with images of half the size of the partitions'. One worker
/// trains it while all others wait, so it has a bound that does not grow with the scene.
pub fn global_stage(
    config: &JobConfig,
    max_resolution: u32,
    views: &[(PinholeCamera, Pose)],
    points: &[DVec3],
) -> GlobalStage {
    let partition = &config.partition;
    let max_gaussians =
        max_gaussians(config, partition.global_gaussians).min(partition.global_most_gaussians);
    let of_job = config.train.iterations;
    let least = partition.global_least_iterations.min(of_job);
    let share = share_of(of_job, partition.global_iterations, MIN_ITERATIONS);
    let iterations = share.min(partition.global_most_iterations).max(least);
    let run = TrainConfig { iterations, ..config.train.clone() };
    let content = Content { views, trained: (points, max_gaussians.into()), frozen: (&[], 0) };
    GlobalStage {
        iterations,
        max_gaussians,
        max_resolution,
        forecast: forecast(&run, &config.water, &content, config.train.eval_every > 0),
    }
}

/// Peak GPU memory of a run of this configuration, and its duration; `measures` if it evaluates held-out
/// views during training.
///
/// The adapter is unknown, so the forecast assumes the most expensive case: the smallest tiles, and bindings
/// that hold every list.
pub fn forecast(
    config: &TrainConfig,
    water: &WaterConfig,
    content: &Content<'_>,
    measures: bool,
) -> Forecast {
    let settings = Settings::new(config, water);
    let Content { views, trained, frozen } = content;
    let pictures: Vec<[u32; 2]> = views.iter().map(|(camera, _)| [camera.width, camera.height]).collect();
    let seen = visible_in_views(views.iter().copied(), &[*trained, *frozen]);
    let run = RunSize {
        settings,
        trained: trained.1,
        frozen: frozen.1,
        visible: seen.fullest,
        pictures: &pictures,
        tile: SMALLEST_TILE,
        binding_bytes: COMMON_BINDING_BYTES,
        measures,
    };
    let parts = run.forecast();
    let frozen_bytes = frozen_bytes(config.sh_degree) + FLAG_BYTES;
    let trained_bytes = run.trained_bytes() + FLAG_BYTES;
    let lists = run.lists();
    let pixel_bytes = pixel_bytes(settings);
    let [visible_bytes, intersection_bytes] = [visible_bytes, intersection_bytes].map(|of| of(config.disks));
    Forecast {
        seconds: duration::seconds(config, &pictures, trained.1 + frozen.1, seen.mean),
        bytes: parts.total(),
        parts,
        formula: format!(
            "{} trained Gaussians x {trained_bytes} B + {} frozen x {frozen_bytes} B \
             + {} visible x {visible_bytes} B + {} intersections x {intersection_bytes} B \
             + {} pixels x {pixel_bytes} B + photographs {} B + transfers {} B + measuring {} B",
            trained.1,
            frozen.1,
            lists.visible,
            lists.intersections,
            parts.pixels / pixel_bytes,
            parts.photographs,
            parts.transfers,
            parts.measuring
        ),
    }
}

fn share_of(total: u32, share: f64, least: f64) -> u32 {
    (f64::from(total) * share).round().max(least) as u32
}

#[cfg(test)]
mod tests {
    use fathom_core::config::Moments;

    use super::*;

    #[test]
    fn partitions_get_iterations_by_their_share_of_cameras() {
        let config = JobConfig::default();
        assert_eq!(iterations(&config, 100, 100), config.train.iterations);
        assert_eq!(iterations(&config, 25, 100), config.train.iterations / 4);
        assert_eq!(iterations(&config, 0, 100), 1);
    }

    #[test]
    fn iterations_per_partition_override_the_share() {
        let mut config = JobConfig::default();
        config.partition.iterations_per_partition = 77;
        assert_eq!(iterations(&config, 25, 100), 77);
    }

    #[test]
    fn a_cap_never_falls_below_sixteen() {
        let config = JobConfig::default();
        assert_eq!(max_gaussians(&config, 0.0), 16);
        assert_eq!(max_gaussians(&config, 1.0), config.train.max_gaussians);
    }

    fn pictures(count: usize, width: u32, height: u32) -> Vec<(PinholeCamera, Pose)> {
        let camera = PinholeCamera { width, height, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
        vec![(camera, Pose::looking_at(DVec3::ZERO, DVec3::Z, DVec3::Y)); count]
    }

    /// The sum that a formula writes out.
    fn evaluated(formula: &str) -> u64 {
        let number = |word: &str| word.split(' ').find_map(|word| word.parse::<u64>().ok()).unwrap_or(1);
        formula.split(" + ").map(|term| term.split(" x ").map(number).product::<u64>()).sum()
    }

    #[test]
    fn the_formula_gives_the_bytes_beside_it() {
        let views = pictures(20, 640, 480);
        let points = [DVec3::Z, DVec3::NEG_Z];
        let mut config = TrainConfig::default();
        for (exposure, measures, moments) in [(false, false, Moments::Compact), (true, true, Moments::F32)] {
            (config.exposure, config.moments) = (exposure, moments);
            let content = Content { views: &views, trained: (&points, 100_000), frozen: (&points, 5000) };
            let forecast = forecast(&config, &WaterConfig::none(), &content, measures);
            assert_eq!(evaluated(&forecast.formula), forecast.bytes, "{}", forecast.formula);
            assert_eq!(forecast.parts.measuring > 0, measures);
        }
        let content = Content { views: &views, trained: (&points, 100_000), frozen: (&points, 5000) };
        let formula = forecast(&TrainConfig::default(), &WaterConfig::none(), &content, false).formula;
        // Half of the points are behind the camera; lists have 1.4 times the room.
        for part in ["100000 trained Gaussians x 420 B", "5000 frozen x 244 B", "73500 visible x 80 B"] {
            assert!(formula.contains(part), "{part} is missing in {formula}");
        }
    }

    #[test]
    fn the_global_stage_of_a_short_job_has_at_most_its_iterations() {
        let iterations = |of_job| {
            let mut config = JobConfig::default();
            (config.train.iterations, config.partition.global_least_iterations) = (of_job, 1000);
            global_stage(&config, 240, &pictures(3, 240, 180), &[]).iterations
        };
        assert_eq!([iterations(600), iterations(2000), iterations(8000)], [600, 1000, 2000]);
    }

    #[test]
    fn the_global_stage_does_not_grow_with_the_scene() {
        let mut config = JobConfig::default();
        (config.train.iterations, config.train.max_gaussians) = (20_000_000, 2_000_000_000);
        let stage = global_stage(&config, 240, &pictures(3, 240, 180), &[]);
        assert_eq!((stage.iterations, stage.max_gaussians), (30_000, 4_000_000));
    }

    #[test]
    fn the_global_stage_has_its_shares_of_the_job() {
        let stage = global_stage(&JobConfig::default(), 240, &pictures(3, 240, 180), &[]);
        assert_eq!(stage.max_resolution, 240);
        assert_eq!(stage.iterations, 3000);
        assert_eq!(stage.max_gaussians, 750_000);
        assert_eq!(stage.forecast.parts.pixels, 240 * 180 * (92 + 16), "with the picture under water");
        let in_air = JobConfig::of_preset(fathom_core::config::Preset::Splatting);
        let in_air = global_stage(&in_air, 240, &pictures(3, 240, 180), &[]);
        assert_eq!(in_air.forecast.parts.pixels, 240 * 180 * 92);
        assert_eq!(stage.forecast.parts.per_visible, 750_000 * 80, "without points all may be seen");
        let at_surface = JobConfig::of_preset(fathom_core::config::Preset::Surface);
        let at_surface = global_stage(&at_surface, 240, &pictures(3, 240, 180), &[]);
        assert_eq!(at_surface.iterations, 12_000, "partitions keep its reflected set");
    }
}
