//! The settings of `--partitions auto` (`partition.auto`).

use super::PartitionConfig;

/// GPU memory that a plan assumes if neither the user nor a worker states it: that of common cards.
pub const DEFAULT_MEMORY_GIB: f64 = 8.0;
/// Largest number of workers that a plan supports.
const MOST_WORKERS: u32 = 4096;

impl PartitionConfig {
    /// Reports contradictions in the partitioning to `require`.
    pub(super) fn validate_cut(&self, require: &mut impl FnMut(bool, &str)) {
        require(
            !self.auto || (self.columns == 1 && self.rows == 1),
            "partition.auto chooses columns and rows; leave both at 1, or set partition.auto to false",
        );
        require(
            self.memory_gib >= 0.0 && self.memory_gib.is_finite(),
            "partition.memory_gib must be a finite number above 0, or 0 to use the memory that workers report",
        );
        require(self.workers <= MOST_WORKERS, "partition.workers must be at most 4096");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::JobConfig;

    fn faults(change: impl FnOnce(&mut PartitionConfig)) -> String {
        let mut config = JobConfig::default();
        change(&mut config.partition);
        config.validate().err().map(|error| error.to_string()).unwrap_or_default()
    }

    #[test]
    fn automatic_partitioning_contradicts_a_grid() {
        assert_eq!(faults(|p| p.auto = true), "");
        assert!(faults(|p| (p.auto, p.columns) = (true, 2)).contains("partition.auto"));
        assert!(faults(|p| (p.auto, p.rows) = (true, 3)).contains("partition.auto"));
    }

    #[test]
    fn impossible_memory_and_too_many_workers_are_refused() {
        for wrong in [-1.0, f64::NAN, f64::INFINITY] {
            assert!(faults(|p| p.memory_gib = wrong).contains("memory_gib"), "{wrong}");
        }
        assert_eq!(faults(|p| p.memory_gib = 0.5), "");
        assert!(faults(|p| p.workers = 5000).contains("partition.workers"));
    }
}
