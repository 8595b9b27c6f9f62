//! Predicts the duration of a run before it begins.
//!
//! A step costs time for every pixel, every visible Gaussian and every Gaussian of the run: `seconds a step =
//! PIXEL * pixels + VISIBLE * visible + GAUSSIAN * gaussians`. The three constants are CPU seconds on
//! llvmpipe with 2 cores, the adapter of the figures in BENCHMARKS.md. Other adapters are faster by an
//! unknown factor. A forecast therefore only compares runs with each other, which is all that a plan needs.
//!
//! | run (bench/history.jsonl) | CPU s a step | by the formula |
//! |---|---|---|
//! | fox at 225x400, 13,500 Gaussians, full size throughout | 0.22 | 0.23 |
//! | sesa-wreck at 480x360, 150,000, the schedule of sizes | 0.27 | 0.28 |
//! | 12 million at 480x270, a view that sees all | 114 | 116 |
//! | the same, a view that sees 2 % | 4.0 | 4.2 |

use crate::config::TrainConfig;

/// CPU seconds a step for each pixel of the picture.
const PIXEL: f64 = 1.8e-6;
/// CPU seconds a step for each Gaussian that the view sees.
const VISIBLE: f64 = 9.5e-6;
/// CPU seconds a step for each Gaussian of the run, visible or not.
const GAUSSIAN: f64 = 0.14e-6;

/// CPU seconds of a run of `config.iterations` steps on `pictures` (width, height). `gaussians` is its cap,
/// trained ones and others together; a view sees `visible` of them on average. 0 without pictures.
pub fn seconds(config: &TrainConfig, pictures: &[[u32; 2]], gaussians: u64, visible: f64) -> f64 {
    let [quarter, half] = config.resolution_at.map(|at| f64::from(at.clamp(0.0, 1.0)));
    let shares = [(quarter, 2), (half - quarter, 1), (1.0 - half, 0)];
    let pixels = |&[width, height]: &[u32; 2]| -> f64 {
        let area = f64::from(width) * f64::from(height);
        let at = |wanted| area / f64::from(1u32 << (2 * TrainConfig::halvings(wanted, width.max(height))));
        shares.iter().map(|&(share, wanted)| share * at(wanted)).sum()
    };
    if pictures.is_empty() {
        return 0.0;
    }
    let mean = pictures.iter().map(pixels).sum::<f64>() / pictures.len() as f64;
    f64::from(config.iterations) * (PIXEL * mean + VISIBLE * visible + GAUSSIAN * gaussians as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_full_size(iterations: u32) -> TrainConfig {
        TrainConfig { iterations, ..TrainConfig::default() }.continued()
    }

    #[test]
    fn the_formula_is_within_a_tenth_of_the_runs_it_was_fitted_to() {
        let sized = TrainConfig { iterations: 1, ..TrainConfig::default() };
        for (config, picture, gaussians, visible, measured) in [
            (at_full_size(1), [225, 400], 13_500, 7_000.0, 0.223),
            (sized, [480, 360], 150_000, 4_000.0, 0.274),
            (at_full_size(1), [480, 270], 12_000_000, 12e6, 114.0),
            (at_full_size(1), [480, 270], 12_000_000, 240e3, 4.0),
        ] {
            let found = seconds(&config, &[picture], gaussians, visible);
            assert!((found / measured - 1.0).abs() < 0.1, "{picture:?}: {found} against {measured}");
        }
    }

    #[test]
    fn time_grows_with_iterations_and_falls_with_picture_size() {
        let run = |iterations| seconds(&at_full_size(iterations), &[[800, 600], [400, 300]], 1000, 500.0);
        assert!((run(300) - 3.0 * run(100)).abs() < 1e-9);
        let sized = TrainConfig { iterations: 300, ..TrainConfig::default() };
        assert!(seconds(&sized, &[[800, 600], [400, 300]], 1000, 500.0) < 0.8 * run(300));
        assert_eq!(seconds(&sized, &[], 1000, 500.0), 0.0);
    }
}
