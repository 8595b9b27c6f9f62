//! Water and Gaussians that partitions exchange in a job with more than one (docs/internals/water.md,
//! docs/internals/trainer.md).

use serde::{Deserialize, Serialize};

use super::{DbdrMode, JobConfig, Medium, PartitionConfig, WaterConfig};

/// How partitions use the water of the global stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WaterPartitions {
    /// Partitions keep it fixed.
    #[default]
    Frozen,
    /// Each partition refines its own copy of the water parameters up to `water.freeze_at` of its run. The
    /// rest of the run uses a consensus of all partitions ([`crate::water::consensus`]).
    Joint,
}

impl WaterPartitions {
    /// Reports to `require` each setting that `joint` cannot be combined with.
    pub(super) fn validate(self, water: &WaterConfig, require: &mut impl FnMut(bool, &str)) {
        require(
            self == Self::Frozen
                || water.medium == Medium::None
                || (water.start_at < water.freeze_at && water.freeze_at < 1.0),
            "water.partitions = \"joint\" needs water.start_at < water.freeze_at < 1: a partition trains its water between the two, \
             and uses the consensus for the rest of its run",
        );
        require(
            self == Self::Frozen || water.medium == Medium::None || water.dbdr.mode == DbdrMode::Constants,
            "water.partitions = \"joint\" needs water.dbdr.mode = \"constants\": the consensus covers the water parameters, which \
             \"none\" keeps fixed, but not the range factors of \"maps\"",
        );
        require(
            self == Self::Frozen
                || water.medium == Medium::None
                || (water.l2_weight == 0.0 && water.priors.dark_channel == 0.0),
            "water.partitions = \"joint\" needs water.l2_weight = 0 and water.priors.dark_channel = 0: the consensus would count \
             these priors as evidence from photographs",
        );
    }
}

impl WaterConfig {
    /// Whether partitions have their own tasks to refine the water. A single partition needs no consensus and
    /// refines its water itself.
    pub fn is_joint_for(&self, partitions: u32) -> bool {
        self.partitions == WaterPartitions::Joint && partitions > 1 && self.medium != Medium::None
    }

    /// The first iteration of a run of `iterations` in which a trained water is fixed.
    pub fn free_iterations(&self, iterations: u32) -> u32 {
        // Must be the same comparison as in the trainer's schedule, in the same precision.
        let is_over = |iteration: u32| iteration as f32 / iterations as f32 >= self.freeze_at;
        let mut first = ((f64::from(self.freeze_at) * f64::from(iterations)) as u32).min(iterations);
        while first > 0 && is_over(first - 1) {
            first -= 1;
        }
        while first < iterations && !is_over(first) {
            first += 1;
        }
        first
    }
}

impl PartitionConfig {
    /// Whether each of `partitions` partitions ends its run beside the Gaussians that its neighbours have
    /// trained.
    pub fn has_neighbours(&self, partitions: u32) -> bool {
        self.neighbours_from < 1.0 && partitions > 1
    }
}

impl JobConfig {
    /// The first iteration of the second part of a partition's run of `iterations`, in a job of `partitions`
    /// partitions. `None` if the run has one part. A run that exchanges both water and Gaussians does so
    /// once, at the later of the two points.
    pub fn exchange_at(&self, iterations: u32, partitions: u32) -> Option<u32> {
        let water = self.water.is_joint_for(partitions).then(|| self.water.free_iterations(iterations));
        let gaussians = self.partition.has_neighbours(partitions).then(|| {
            let first = (f64::from(iterations) * self.partition.neighbours_from).round() as u32;
            first.clamp(1, iterations.saturating_sub(1).max(1))
        });
        water.max(gaussians)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_iterations_end_where_the_schedule_stops_the_water() {
        let config = WaterConfig::default();
        for iterations in [1_u32, 2, 3, 10, 333, 12_000, 9_999_991] {
            let first = config.free_iterations(iterations);
            assert!(first <= iterations && first >= iterations / 2, "{first} of {iterations}");
            assert!(first == iterations || first as f32 / iterations as f32 >= config.freeze_at);
            assert!(((first - 1) as f32 / iterations as f32) < config.freeze_at, "{first} of {iterations}");
        }
        assert_eq!(config.free_iterations(12_000), 8004);
        assert_eq!(WaterConfig { freeze_at: 0.0, ..config.clone() }.free_iterations(100), 0);
        assert_eq!(WaterConfig { freeze_at: 1.0, ..config }.free_iterations(100), 100);
    }

    #[test]
    fn run_of_two_parts_exchanges_everything_once() {
        let mut config = JobConfig::default();
        assert_eq!(config.exchange_at(1000, 4), None);
        config.partition.neighbours_from = 0.7;
        assert_eq!(config.exchange_at(1000, 4), Some(700));
        assert_eq!(config.exchange_at(1000, 1), None, "one partition has no neighbours");
        assert_eq!(
            [1, 2, 3].map(|iterations| config.exchange_at(iterations, 4)),
            [Some(1), Some(1), Some(2)]
        );
        config.water.partitions = WaterPartitions::Joint;
        assert_eq!(config.exchange_at(1000, 4), Some(700), "the water is fixed from 667");
        config.partition.neighbours_from = 0.5;
        assert_eq!(config.exchange_at(1000, 4), Some(667));
        config.partition.neighbours_from = 1.0;
        assert_eq!(config.exchange_at(1000, 4), Some(667));
    }

    #[test]
    fn consensus_needs_the_mode_constants() {
        for (mode, refused) in [(DbdrMode::None, true), (DbdrMode::Constants, false), (DbdrMode::Maps, true)]
        {
            let mut water = WaterConfig { medium: Medium::PerPixel, ..WaterConfig::default() };
            (water.dbdr.mode, water.partitions) = (mode, WaterPartitions::Joint);
            let mut faults = Vec::new();
            water.partitions.validate(&water, &mut |holds, fault| {
                if !holds {
                    faults.push(fault.to_owned());
                }
            });
            assert_eq!(
                faults.iter().any(|fault| fault.contains("water.dbdr.mode")),
                refused,
                "{mode:?}: {faults:?}"
            );
        }
    }

    #[test]
    fn only_several_partitions_under_water_refine_it() {
        let joint = WaterConfig { partitions: WaterPartitions::Joint, ..WaterConfig::default() };
        assert!(joint.is_joint_for(2) && !joint.is_joint_for(1));
        assert!(!WaterConfig { medium: Medium::None, ..joint }.is_joint_for(2));
        assert!(!WaterConfig::default().is_joint_for(2), "frozen is the default");
    }
}
