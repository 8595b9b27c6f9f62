//! Schedules: everything is a fraction of the run, so that the short run of a partition behaves like a long
//! one.

use crate::appearance::adam::interpolate_log;
use crate::appearance::water::{MediumRun, WaterSchedule};
use crate::config::{Strategy, TrainConfig};
use crate::gpu::StepUniform;
use crate::rng::{Stream, random_bits, uniform};
use crate::scene::PinholeCamera;

/// When things happen in a run.
pub(super) struct Schedule {
    config: TrainConfig,
    /// `densify_every` is the interval of density decisions, from after `densify_from` up to `densify_last`.
    densify_every: u32,
    densify_from: u32,
    densify_last: u32,
    /// Iterations between two resets of opacities; 0: no resets.
    reset_every: u32,
    /// The schedule of the water, if the run has one.
    water: Option<WaterSchedule>,
}

impl Schedule {
    pub(super) fn new(config: &TrainConfig, medium: Option<&MediumRun>) -> Self {
        let iterations = f64::from(config.iterations);
        let (from, until, reset) = match config.strategy {
            Strategy::Mcmc => (0.0, config.relocate_until, 0.0),
            Strategy::Classic => (config.classic.from, config.classic.until, config.classic.reset_every),
        };
        let (first, last) = (iterations * f64::from(from), iterations * f64::from(until));
        let every = ((last - first) / f64::from(config.refine_steps.max(1))).round();
        Self {
            densify_every: (every as u32).max(1),
            densify_from: first as u32,
            densify_last: last as u32,
            reset_every: if reset > 0.0 {
                ((iterations * f64::from(reset)).round() as u32).max(1)
            } else {
                0
            },
            config: config.clone(),
            water: medium.map(|medium| WaterSchedule::new(medium, config.iterations)),
        }
    }

    /// Share of the run that is done before an iteration.
    pub(super) fn progress(&self, iteration: u32) -> f32 {
        iteration as f32 / self.config.iterations as f32
    }

    /// First iteration after `iteration` at whose start density is decided or opacities are reset.
    pub(super) fn next_refine(&self, iteration: u32) -> u32 {
        let densify = (iteration.max(self.densify_from) - self.densify_from) / self.densify_every + 1;
        let densify = self.densify_from.saturating_add(densify.saturating_mul(self.densify_every));
        let reset = iteration.checked_div(self.reset_every).map(|n| (n + 1) * self.reset_every);
        let densify = if self.densifies_at(densify) { densify } else { u32::MAX };
        densify.min(reset.filter(|&reset| self.resets_at(reset)).unwrap_or(u32::MAX))
    }

    /// Whether density is decided at the start of an iteration.
    pub(super) fn densifies_at(&self, iteration: u32) -> bool {
        self.config.refine_steps > 0
            && (self.densify_from + 1..=self.densify_last).contains(&iteration)
            && (iteration - self.densify_from).is_multiple_of(self.densify_every)
    }

    /// Whether density is decided for the last time at the start of an iteration.
    pub(super) fn decides_last_at(&self, iteration: u32) -> bool {
        self.densifies_at(iteration) && iteration + self.densify_every > self.densify_last
    }

    /// Whether opacities are reset at the start of an iteration; not at the end of densification (3DGS).
    pub(super) fn resets_at(&self, iteration: u32) -> bool {
        self.config.refine_steps > 0
            && self.reset_every > 0
            && (1..self.densify_last).contains(&iteration)
            && iteration.is_multiple_of(self.reset_every)
    }

    /// Whether opacities were reset before an iteration.
    pub(super) fn was_reset(&self, iteration: u32) -> bool {
        self.reset_every > 0 && iteration > self.reset_every
    }

    /// Target number of Gaussians at an iteration: geometric growth from `initial` to the cap.
    pub(super) fn target_count(&self, iteration: u32, initial: u32) -> u32 {
        let cap = self.config.max_gaussians;
        let share = f64::from(self.progress(iteration)) / f64::from(self.config.grow_until.max(1e-6));
        if initial >= cap || share >= 1.0 {
            return cap;
        }
        let ratio = f64::from(cap) / f64::from(initial);
        ((f64::from(initial) * ratio.powf(share)) as u32).min(cap)
    }

    /// How often the image is halved: 2, 1, 0 by schedule, less if the image would become too small.
    pub(super) fn level(&self, progress: f32, camera: &PinholeCamera) -> u32 {
        let wanted = self.config.resolution_at.iter().filter(|&&at| progress < at).count() as u32;
        TrainConfig::halvings(wanted, camera.width.max(camera.height))
    }

    /// The schedule of the water, if the run has one.
    pub(super) fn water(&self) -> Option<&WaterSchedule> {
        self.water.as_ref()
    }

    /// Degree of the spherical harmonics in use.
    pub(super) fn sh_degree(&self, progress: f32) -> u32 {
        if self.water.as_ref().is_some_and(|water| water.has_sh0_only(progress)) {
            return 0;
        }
        let reached = self.config.sh_degree_at.iter().filter(|&&at| progress >= at).count() as u32;
        reached.min(u32::from(self.config.sh_degree))
    }

    /// Background colour at an iteration, sRGB: black, or random (uniform in each channel).
    pub(super) fn background(&self, iteration: u32) -> [f32; 3] {
        if !self.config.random_background {
            return [0.0; 3];
        }
        random_bits(self.config.seed, Stream::Background, iteration, 0).map(uniform)
    }

    /// Learning rates and weights of one step, for a view that sees every Gaussian.
    /// Weight of the normal consistency of disks.
    pub(super) fn normal_consistency(&self, progress: f32) -> f32 {
        let config = &self.config;
        if progress < config.normal_consistency_from {
            0.0
        } else {
            config.loss_factor * config.normal_consistency
        }
    }

    pub(super) fn rates(&self, progress: f32, extent: f32) -> StepUniform {
        let c = &self.config;
        let means = extent * interpolate_log(c.means_lr, c.means_lr_end, progress);
        let falling = ((progress - c.anneal_from) / (1.0 - c.anneal_from).max(1e-6)).clamp(0.0, 1.0);
        let left = interpolate_log(1.0, c.anneal_to, falling);
        let (opacity_reg, scale_reg, noise) = match c.strategy {
            // Gaussians that fade now are not relocated any more.
            Strategy::Mcmc if progress >= self.progress(self.densify_last) => (0.0, 0.0, c.mean_noise),
            Strategy::Mcmc => (c.loss_factor * c.opacity_reg, c.loss_factor * c.scale_reg, c.mean_noise),
            Strategy::Classic => (0.0, 0.0, 0.0),
        };
        StepUniform {
            means_lr: means,
            quats_lr: left * c.quats_lr,
            scales_lr: left * c.scales_lr,
            opacity_lr: left * c.opacity_lr,
            sh_dc_lr: left * c.sh_dc_lr,
            sh_rest_lr: left * c.sh_rest_lr,
            opacity_reg,
            scale_reg,
            mean_noise: noise * interpolate_log(c.means_lr, c.means_lr_end, progress),
            seed: c.seed,
            ..StepUniform::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(iterations: u32, max_gaussians: u32) -> TrainConfig {
        TrainConfig { iterations, max_gaussians, ..TrainConfig::default() }
    }

    #[test]
    fn the_cap_is_reached_by_half_of_the_run_and_not_exceeded() {
        for iterations in [10, 333, 12_000] {
            let schedule = Schedule::new(&config(iterations, 5000), None);
            let counts: Vec<u32> = (0..=iterations).map(|i| schedule.target_count(i, 100)).collect();
            assert!(counts.is_sorted(), "{iterations} iterations");
            assert_eq!(counts[iterations.div_ceil(2) as usize], 5000, "{iterations} iterations");
            assert!(counts.iter().all(|&count| (100..=5000).contains(&count)));
        }
    }

    #[test]
    fn density_is_decided_as_often_as_configured_and_in_time() {
        let schedule = Schedule::new(&config(12_000, 5000), None);
        let mut at = Vec::new();
        let mut next = schedule.next_refine(0);
        while next != u32::MAX {
            at.push(next);
            next = schedule.next_refine(next);
        }
        assert_eq!(at.len(), 40);
        let last: Vec<u32> = (0..=12_000).filter(|&iteration| schedule.decides_last_at(iteration)).collect();
        assert_eq!(Some(&last[..]), at.last().map(std::slice::from_ref));
        assert!(at.iter().all(|&iteration| iteration <= 10_200), "{at:?}");
    }

    #[test]
    fn classic_densifies_and_resets_at_the_shares_of_3dgs() {
        let config = TrainConfig { strategy: Strategy::Classic, refine_steps: 145, ..config(30_000, 5000) };
        let schedule = Schedule::new(&config, None);
        let (mut densifies, mut resets, mut at) = (Vec::new(), Vec::new(), 0);
        while schedule.next_refine(at) != u32::MAX {
            at = schedule.next_refine(at);
            assert!(schedule.densifies_at(at) || schedule.resets_at(at), "nothing is due at {at}");
            densifies.extend(schedule.densifies_at(at).then_some(at));
            resets.extend(schedule.resets_at(at).then_some(at));
        }
        assert_eq!(densifies, (6..=150).map(|n| 100 * n).collect::<Vec<u32>>());
        assert_eq!(resets, [3000, 6000, 9000, 12_000]);
        assert_eq!([2999, 3000, 3001].map(|at| schedule.was_reset(at)), [false, false, true]);
        let step = schedule.rates(0.1, 2.0);
        assert_eq!([step.opacity_reg, step.scale_reg, step.mean_noise], [0.0; 3]);
        let never = Schedule::new(&TrainConfig { refine_steps: 0, ..config }, None);
        assert_eq!(never.next_refine(0), u32::MAX);
    }

    #[test]
    fn rates_fall_at_the_end_and_weights_end_with_relocation() {
        let config =
            TrainConfig { anneal_from: 0.6, anneal_to: 0.25, relocate_until: 0.75, ..config(1000, 5000) };
        let schedule = Schedule::new(&config, None);
        let rates = |progress| {
            let step = schedule.rates(progress, 2.0);
            let weights = if progress < 0.75 { [config.opacity_reg, config.scale_reg] } else { [0.0; 2] };
            assert_eq!([step.opacity_reg, step.scale_reg], weights, "at {progress} of the run");
            [step.quats_lr, step.scales_lr, step.opacity_lr, step.sh_dc_lr, step.sh_rest_lr]
        };
        let start =
            [config.quats_lr, config.scales_lr, config.opacity_lr, config.sh_dc_lr, config.sh_rest_lr];
        assert_eq!(rates(0.0), start);
        assert_eq!(rates(0.6), start);
        let half_way = rates(0.8);
        let end = rates(1.0);
        for (i, start) in start.into_iter().enumerate() {
            assert!((half_way[i] / start - 0.5).abs() < 1e-5, "exponentially: {half_way:?}");
            assert!((end[i] / start - 0.25).abs() < 1e-5, "{end:?}");
        }
        assert!((schedule.rates(0.0, 2.0).means_lr / (2.0 * config.means_lr) - 1.0).abs() < 1e-5);
        assert!((schedule.rates(1.0, 2.0).means_lr / (2.0 * config.means_lr_end) - 1.0).abs() < 1e-5);
    }

    #[test]
    fn small_images_are_not_halved_below_the_smallest_side() {
        let schedule = Schedule::new(&config(1000, 5000), None);
        let camera = |side| PinholeCamera { width: side, height: 60, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        assert_eq!(schedule.level(0.0, &camera(1600)), 2);
        assert_eq!(schedule.level(0.2, &camera(1600)), 1);
        assert_eq!(schedule.level(0.5, &camera(1600)), 0);
        assert_eq!(schedule.level(0.0, &camera(240)), 1);
        assert_eq!(schedule.level(0.0, &camera(100)), 0);
    }
}
