//! What a run may cost: iterations, Gaussians and the GPU memory that they will take.
//!
//! `train.iterations` and `train.max_gaussians` are totals of the job as if it were 1x1. A partition
//! gets iterations by its cameras, so that each photograph is seen as often as in one run, and Gaussians
//! by the points that it trains, so that its density is that of one run; the margins that it trains
//! besides its cell come on top and fall away at the merge.

use fathom_core::config::JobConfig;

use super::plan::{Forecast, GlobalStage};

/// Fewest Gaussians that a run may have.
const MIN_GAUSSIANS: f64 = 16.0;
/// Bytes per Gaussian in the lists of a frame: projected means, conics, colours, depths and their
/// gradients, sort keys in two buffers.
const VISIBLE_BYTES: u64 = 160;
/// Tiles that a Gaussian touches on average at a cap that fits the picture.
const INTERSECTS_PER_GAUSSIAN: u64 = 4;
/// Bytes per intersection: key and index in two buffers, and the slot of its gradient.
const INTERSECT_BYTES: u64 = 56;
/// Bytes per pixel: photograph, render, alpha, range, transmittance, and the maps and gradients of the loss.
const PIXEL_BYTES: u64 = 192;

/// Iterations of a partition with `chosen` of `training` cameras.
pub fn iterations(config: &JobConfig, chosen: usize, training: usize) -> u32 {
    match config.partition.iterations_per_partition {
        0 => share_of(config.train.iterations, chosen as f64 / training.max(1) as f64, 1.0),
        fixed => fixed,
    }
}

/// Cap of a run that trains `share` of the scene.
pub fn max_gaussians(config: &JobConfig, share: f64) -> u32 {
    share_of(config.train.max_gaussians, share, MIN_GAUSSIANS)
}

/// The run of the coarse model; `longest_side` is that of the partitions' pictures and `pixels` their area.
pub fn global_stage(config: &JobConfig, longest_side: u32, pixels: u64) -> GlobalStage {
    let max_gaussians = max_gaussians(config, config.partition.global_gaussians);
    GlobalStage {
        iterations: share_of(config.train.iterations, config.partition.global_iterations, 1.0),
        max_gaussians,
        max_resolution: longest_side.div_ceil(2).max(1),
        forecast: forecast(config, max_gaussians.into(), 0, pixels.div_ceil(4)),
    }
}

/// GPU memory of a run that trains `trained` Gaussians and renders `frozen` more.
pub fn forecast(config: &JobConfig, trained: u64, frozen: u64, pixels: u64) -> Forecast {
    // Mean, quaternion, log scale, opacity and the SH coefficients of three channels, f32.
    let coeffs = (u64::from(config.train.sh_degree) + 1).pow(2);
    let frozen_bytes = 4 * (3 + 4 + 3 + 1 + 3 * coeffs);
    // Value and two moments, and a step count and a relocation score besides.
    let trained_bytes = 3 * frozen_bytes + 8;
    let all = trained + frozen;
    let frame_bytes = VISIBLE_BYTES + INTERSECTS_PER_GAUSSIAN * INTERSECT_BYTES;
    Forecast {
        bytes: trained * trained_bytes + frozen * frozen_bytes + all * frame_bytes + pixels * PIXEL_BYTES,
        formula: format!(
            "{trained} trained Gaussians x {trained_bytes} B + {frozen} frozen x {frozen_bytes} B \
             + {all} x ({VISIBLE_BYTES} B visible + {INTERSECTS_PER_GAUSSIAN} tiles x {INTERSECT_BYTES} B) \
             + {pixels} pixels x {PIXEL_BYTES} B"
        ),
    }
}

fn share_of(total: u32, share: f64, least: f64) -> u32 {
    (f64::from(total) * share).round().max(least) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_partition_with_all_cameras_gets_all_iterations_and_one_with_few_their_share() {
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

    #[test]
    fn the_formula_gives_the_bytes_beside_it() {
        let config = JobConfig::default();
        let forecast = forecast(&config, 1000, 50, 640 * 480);
        assert_eq!(forecast.bytes, 1000 * (3 * 236 + 8) + 50 * 236 + 1050 * (160 + 4 * 56) + 640 * 480 * 192);
        for number in ["1000 trained", "716 B", "50 frozen", "236 B", "307200 pixels"] {
            assert!(forecast.formula.contains(number), "{number} is missing in {}", forecast.formula);
        }
    }

    #[test]
    fn the_global_stage_takes_half_of_the_size_that_pictures_really_have() {
        let stage = global_stage(&JobConfig::default(), 479, 479 * 360);
        assert_eq!(stage.max_resolution, 240);
        assert_eq!(stage.iterations, 3000);
        assert_eq!(stage.max_gaussians, 750_000);
    }
}
