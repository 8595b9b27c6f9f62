//! The refinement of partition borders after the merge (docs/decisions/0016).

use serde::{Deserialize, Serialize};

use super::{Strategy, TrainConfig};

/// Border refinement: a separate task after the merge trains the Gaussians near the borders between cells. It
/// uses the views that show them; the rest of the merged model and the water stay fixed. Only jobs with more
/// than one partition have this task. The defaults were chosen by hand, except rate and iterations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BordersConfig {
    /// Whether the job has this task. Default false (BENCHMARKS.md).
    pub enabled: bool,
    /// Width of the trained band on each side of a border, in scene scales. Default 0.25.
    pub width: f64,
    /// Distance beyond the band within which pixels still count, as a share of `width`. Default 1. The
    /// trained Gaussians must fit both sides of the band.
    pub margin: f64,
    /// Iterations of the task as a share of the job's. Default 0.3 (bench/history.jsonl).
    pub iterations: f64,
    /// Factor on the learning rates of Gaussians. Default 0.3 (bench/history.jsonl). The run continues a
    /// trained model, but begins without moments.
    pub learning_rate: f32,
    /// Whether faded Gaussians of the band are relocated to where the band lacks some. Default false. Only
    /// with the strategy `mcmc`. The number of Gaussians is the same in both cases.
    pub relocate: bool,
}

impl Default for BordersConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            width: 0.25,
            margin: 1.0,
            iterations: 0.3,
            learning_rate: 0.3,
            relocate: false,
        }
    }
}

impl BordersConfig {
    /// Whether a job of `partitions` partitions has the task: a single partition has no borders.
    pub fn is_enabled_for(&self, partitions: usize) -> bool {
        self.enabled && partitions > 1
    }

    /// Iterations of the task in a job of `iterations`.
    pub fn iterations_of(&self, iterations: u32) -> u32 {
        (f64::from(iterations) * self.iterations).round().max(1.0) as u32
    }

    /// The configuration of the task's run, from `run`, which has the run's own iterations and its initial
    /// number of Gaussians as cap. Rates are lower, since the model is already trained. Noise is used only
    /// with relocation, since it serves to find new places.
    pub fn of_run(&self, run: TrainConfig) -> TrainConfig {
        let rate = |rate: f32| rate * self.learning_rate;
        TrainConfig {
            means_lr: rate(run.means_lr),
            means_lr_end: rate(run.means_lr_end),
            sh_dc_lr: rate(run.sh_dc_lr),
            sh_rest_lr: rate(run.sh_rest_lr),
            opacity_lr: rate(run.opacity_lr),
            scales_lr: rate(run.scales_lr),
            quats_lr: rate(run.quats_lr),
            refine_steps: if self.relocate { run.refine_steps } else { 0 },
            mean_noise: if self.relocate { run.mean_noise } else { 0.0 },
            ..run.continued()
        }
    }

    /// Reports every invalid value to `require`, by name.
    pub(super) fn validate(&self, train: &TrainConfig, require: &mut impl FnMut(bool, &str)) {
        for (name, length) in [("width", self.width), ("margin", self.margin)] {
            let fault = format!("borders.{name} must be a finite number above 0");
            require(length > 0.0 && length.is_finite(), &fault);
        }
        require(
            self.iterations > 0.0 && self.iterations <= 1.0,
            "borders.iterations must be a share of the job's iterations, above 0 and at most 1",
        );
        require(
            self.learning_rate > 0.0 && self.learning_rate <= 1.0,
            "borders.learning_rate must be a factor above 0 and at most 1",
        );
        require(
            !(self.relocate && train.strategy == Strategy::Classic),
            "borders.relocate needs train.strategy = \"mcmc\": \"classic\" does not relocate Gaussians",
        );
        require(
            !(self.enabled && train.mip_filter),
            "borders.enabled cannot be combined with train.mip_filter: the scales of the merged model already include the \
             filter, so the band would be smoothed twice",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::super::JobConfig;
    use super::*;

    #[test]
    fn only_jobs_of_several_partitions_have_borders() {
        let on = BordersConfig { enabled: true, ..BordersConfig::default() };
        assert!(on.is_enabled_for(2) && !on.is_enabled_for(1));
        assert!(!BordersConfig::default().is_enabled_for(2), "off is the default");
    }

    #[test]
    fn run_has_lower_rates_and_relocates_only_if_enabled() {
        let job = TrainConfig { seed: 7, ..TrainConfig::default() };
        let run = BordersConfig::default().of_run(job.clone());
        assert_eq!((run.iterations, run.max_gaussians, run.seed), (job.iterations, job.max_gaussians, 7));
        assert_eq!((run.refine_steps, run.mean_noise), (0, 0.0));
        assert_eq!((run.sh_degree_at, run.resolution_at), ([0.0; 3], [0.0; 2]));
        let rates = |c: &TrainConfig| {
            [c.means_lr, c.means_lr_end, c.sh_dc_lr, c.sh_rest_lr, c.opacity_lr, c.scales_lr, c.quats_lr]
        };
        assert_eq!(rates(&run), rates(&job).map(|rate| 0.3 * rate));
        let relocating = BordersConfig { relocate: true, ..BordersConfig::default() };
        let run = relocating.of_run(job.clone());
        assert_eq!((run.refine_steps, run.mean_noise), (job.refine_steps, job.mean_noise));
        assert_eq!(
            [1, 12_000].map(|job| relocating.iterations_of(job)),
            [1, 3600],
            "three tenths, never none"
        );
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        let borders = BordersConfig {
            enabled: true,
            width: 0.0,
            margin: f64::NAN,
            iterations: 1.5,
            learning_rate: 0.0,
            relocate: true,
        };
        let mut config = JobConfig { borders, ..JobConfig::default() };
        (config.train.strategy, config.train.mip_filter) = (Strategy::Classic, true);
        let refused = config.validate().err().map(|error| error.to_string()).unwrap_or_default();
        for name in ["width", "margin", "iterations", "learning_rate", "relocate", "enabled"] {
            assert!(refused.contains(&format!("borders.{name} ")), "{name}: {refused}");
        }
    }
}
