//! The cap of the job: removes Gaussians when the cells together hold more than the user allows.
//!
//! Every partition has its own cap, for its cell and margins together. The split between cell and margins is
//! not known before training ends. So the cells together may exceed the cap by a few percent; then the most
//! transparent Gaussians are removed. A histogram finds them, so memory does not grow with the model.

use crate::candidate::ascending;

/// Bins of the histogram: the upper half of an f32.
const BINS: usize = 1 << 16;

/// Histogram of opacities.
pub struct Opacities(Vec<u64>);

impl Opacities {
    pub fn new() -> Self {
        Self(vec![0; BINS])
    }

    pub fn add(&mut self, logit: f32) {
        self.0[usize::from(bin(logit))] += 1;
    }

    /// Removes one that was added.
    pub fn remove(&mut self, logit: f32) {
        self.0[usize::from(bin(logit))] -= 1;
    }

    pub fn add_all(&mut self, other: &Self) {
        self.0.iter_mut().zip(&other.0).for_each(|(sum, count)| *sum += count);
    }

    /// Number of Gaussians.
    pub fn count(&self) -> u64 {
        self.0.iter().sum()
    }

    /// The thinning that keeps at most `cap` of the Gaussians added.
    pub fn thinning(&self, cap: u64) -> Thinning {
        let mut surplus = self.count().saturating_sub(cap);
        for (bin, &count) in self.0.iter().enumerate() {
            if surplus <= count {
                return Thinning { bin: bin as u16, left: surplus };
            }
            surplus -= count;
        }
        Thinning { bin: 0, left: 0 }
    }
}

/// Decides for each Gaussian, in the order of the merge, whether it stays.
pub struct Thinning {
    /// All below this bin are removed.
    bin: u16,
    /// Number of Gaussians of the bin itself that are still to be removed, the first ones.
    left: u64,
}

impl Thinning {
    /// Whether a block stays whole whose most transparent Gaussian is in `lowest_bin`.
    pub fn keeps_all(&self, lowest_bin: u16) -> bool {
        lowest_bin > self.bin || (lowest_bin == self.bin && self.left == 0)
    }

    pub fn keeps(&mut self, logit: f32) -> bool {
        let bin = bin(logit);
        if bin == self.bin && self.left > 0 {
            self.left -= 1;
            return false;
        }
        bin >= self.bin
    }
}

/// The bin of a finite value; ascends with it.
pub fn bin(logit: f32) -> u16 {
    (ascending(logit) >> 16) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(logits: &[f32], cap: u64) -> Vec<f32> {
        let mut opacities = Opacities::new();
        logits.iter().for_each(|&logit| opacities.add(logit));
        let mut thinning = opacities.thinning(cap);
        logits.iter().copied().filter(|&logit| thinning.keeps(logit)).collect()
    }

    #[test]
    fn the_most_transparent_go_first_and_of_equals_the_first() {
        let logits = [0.5, -3.0, 2.0, -7.0, -3.0, 0.0, -3.0];
        assert_eq!(kept(&logits, 7), logits);
        assert_eq!(kept(&logits, 100), logits);
        assert_eq!(kept(&logits, 6), [0.5, -3.0, 2.0, -3.0, 0.0, -3.0]);
        assert_eq!(kept(&logits, 5), [0.5, 2.0, -3.0, 0.0, -3.0]);
        assert_eq!(kept(&logits, 2), [0.5, 2.0]);
        assert!(kept(&logits, 0).is_empty());
        assert!(kept(&[], 3).is_empty());
    }

    #[test]
    fn exactly_the_cap_is_left_of_many() {
        let logits: Vec<f32> = (0..10_000).map(|i| (i * 7919 % 10_007) as f32 / 1000.0 - 5.0).collect();
        for cap in [1, 77, 5000, 9999] {
            let kept = kept(&logits, cap);
            assert_eq!(kept.len() as u64, cap);
            let least = kept.iter().copied().fold(f32::INFINITY, f32::min);
            let above = logits.iter().filter(|&&logit| logit > least + 0.05).count() as u64;
            assert!(above <= cap, "at a cap of {cap} one of {least} stays and more opaque ones went");
        }
    }
}
