//! When a water moves, and how fast.

use super::MediumRun;
use crate::appearance::adam::interpolate_log;
use crate::config::{DbdrMode, WaterConfig};

/// The schedule of a water in a run of some length.
#[derive(Clone, Debug)]
pub struct WaterSchedule {
    iterations: u32,
    /// First iteration whose water WaterParamPredict does not decide; 0 where it decides none.
    network_end: u32,
    /// Where the water is free to move.
    free: Option<WaterConfig>,
}

impl WaterSchedule {
    /// The schedule of `medium` over a run of `iterations`.
    pub fn new(medium: &MediumRun, iterations: u32) -> Self {
        Self {
            iterations,
            network_end: network_end(medium, iterations),
            free: medium.is_free.then(|| medium.config.clone()),
        }
    }

    /// First iteration whose water WaterParamPredict does not decide; 0 where it decides none.
    pub fn network_end(&self) -> u32 {
        self.network_end
    }

    fn progress(&self, iteration: u32) -> f32 {
        iteration as f32 / self.iterations as f32
    }

    /// Learning rate of the water at an iteration, and how many steps it has had after that one; `None` where
    /// it stays.
    pub fn step(&self, iteration: u32) -> Option<(f32, u32)> {
        let water = self.free.as_ref().filter(|water| water.dbdr.mode != DbdrMode::None)?;
        let progress = self.progress(iteration);
        let first = (f64::from(water.start_at) * f64::from(self.iterations)).ceil() as u32;
        let first = first.max(self.network_end);
        if iteration < first || progress >= water.freeze_at {
            return None;
        }
        let from = water.start_at.max(self.progress(self.network_end));
        let share = (progress - from) / (water.freeze_at - from).max(1e-6);
        Some((interpolate_log(water.lr, water.lr_end, share.clamp(0.0, 1.0)), iteration - first + 1))
    }

    /// Whether colours are limited to SH degree 0 at this share of the run (`water.sh0_while_free`).
    pub fn has_sh0_only(&self, progress: f32) -> bool {
        let decided = self.network_end as f32 / self.iterations as f32;
        let moves = |water: &WaterConfig| progress < if water.descends() { water.freeze_at } else { decided };
        self.free.as_ref().is_some_and(|water| water.sh0_while_free && moves(water))
    }
}

/// [`WaterSchedule::network_end`]: at least one iteration where there is a network.
fn network_end(medium: &MediumRun, iterations: u32) -> u32 {
    if !medium.is_free || medium.network.is_none() {
        return 0;
    }
    let share = f64::from(medium.config.network.until);
    ((share * f64::from(iterations)).round() as u32).clamp(1, iterations)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::appearance::water::NetworkRun;
    use crate::config::Composition;

    #[test]
    fn descent_begins_where_the_network_ends() {
        let water =
            WaterConfig { start_at: 0.125, freeze_at: 0.5, lr: 1e-2, lr_end: 1e-3, ..WaterConfig::default() };
        let run = |network: Option<NetworkRun>, is_free: bool| {
            let fixed = MediumRun::fixed(&water, Composition::PixelsSrgb, 1.0);
            WaterSchedule::new(&MediumRun { network, is_free, ..fixed }, 1000)
        };
        let schedule = run(Some(NetworkRun::default()), true);
        assert_eq!(schedule.network_end(), 250);
        assert_eq!([0, 100, 249, 500].map(|at| schedule.step(at)), [None; 4]);
        assert_eq!(schedule.step(250), Some((1e-2, 1)));
        let (rate, steps) = schedule.step(375).unwrap_or_default();
        assert!((rate / 10.0_f32.powf(-2.5) - 1.0).abs() < 1e-4 && steps == 126, "{rate}");
        let without = run(None, true);
        assert_eq!((without.network_end(), without.step(125)), (0, Some((1e-2, 1))));
        let frozen = run(Some(NetworkRun::default()), false);
        assert_eq!((frozen.network_end(), frozen.step(300)), (0, None));
    }
}
